"""Compute melanopic equivalent daylight illuminance (EDI, CIE S 026:2018) from camera colour.

Under daylight, melanopic luminance is nearly linear in X, Y and Z (Trinh, Bodrogi and Khanh,
Sensors 23:5000, 2023). The spectrum of an LED does not follow from its colour, so the uncertainty
of warm light is larger. bench/melanopic.py computes the constants and compares them with cameras.
"""

import numpy as np

from fieldlum.core.arrays import ArrayLike, Floats, Floats32
from fieldlum.core.records import Panorama, SunSource

# Melanopic EDI over X, Y and Z: least squares over CIE daylight of 4000 to 25000 K through eight
# glazings of Rubin 1985 and from three walls; rms 1.7 % (bench/melanopic.py).
MELANOPIC_FROM_XYZ = np.array([-0.7898, 1.1566, 0.5489])
# The weights of X, Y and Z and the relative standard uncertainty of the ratio under daylight: by a
# chart; by the colour matrices of 22 cameras, which see too little blue light, with the gains of a
# white surface and without; and what glass adds that may be grey, bronze or a film. Each u covers
# 95 % of 28 cameras (22 matrices) at their worst of six daylights behind the worst of 8 and 14
# glazings (the same bench).
BY_CHART = (MELANOPIC_FROM_XYZ, 0.025)
BY_WHITE = (np.array([-0.7351, 1.0703, 0.5794]), 0.035)
BY_MATRIX = (np.array([-1.0546, 1.4292, 0.5542]), 0.07)
# By the ratio, what light that may be a lamp's adds: 95 % of 139 lamps of IES TM-30-15 (LED,
# fluorescent, incandescent), of 25 to 100 % of the light; and the mean of true over estimated
# ratios of LED alone and with daylight (the same bench).
_LAMP_RATIOS, _U_LAMPS = (0.65, 0.85, 1.05, 1.25), (0.21, 0.17, 0.09, 0.0)
U_GLASS, LAMP_RATIO = 0.055, 0.96
# Melanopic over photopic illuminance of direct sunlight: 0.94 exp(-0.058 air mass), within 2 % of
# SPECTRL2 (Bird and Riordan 1986) with an aerosol depth of 0.1 and air mass 1 to 15.
_SUN_RATIO, _SUN_RATIO_DECAY = 0.94, 0.058
# relative u of its ratio, by aerosol and glass, and of its melanopic illuminance with 5 % of the
# disc's; chosen
U_SUN_RATIO, U_SUN = 0.05, 0.07
_RADIANCE_Y = (0.265, 0.670, 0.065)  # weights of R, G, B in the luminance of a stored picture
ATTRIBUTE = "melanopic"  # of a picture: weights of R, G and B, and the ratio's relative u


def attribute_text(melanopic_from_rgb: Floats, rgb_to_radiance: Floats, u_rel: float) -> str:
    """Return the weights of a picture's R, G, B in melanopic luminance, as text for its file.

    melanopic_from_rgb [3]: weights of the camera's colours; rgb_to_radiance [3, 3]: matrix from
    these to the picture's colours (radiance RGB); u_rel: relative standard uncertainty under
    daylight, the last number of the text. The four numbers are separated by blanks;
    `melanopic_ratio` reads them.
    """
    weights = np.asarray(melanopic_from_rgb) @ np.linalg.inv(rgb_to_radiance)
    return " ".join(f"{value:.6g}" for value in (*weights, u_rel))


def melanopic_ratio(panorama: Panorama) -> tuple[Floats32, float] | None:
    """Return melanopic over photopic luminance of each pixel [H, W], and its relative u.

    The uncertainty is that under daylight. The ratio is 1 in pixels without light. None for a
    picture without calibrated colour. Raises ValueError for an attribute that `attribute_text` did
    not write.
    """
    text = panorama.attributes.get(ATTRIBUTE)
    if text is None or panorama.rgb is None:
        return None
    *weights, u_rel = (float(word) for word in text.split())
    rgb = np.asarray(panorama.rgb, np.float32)
    light = rgb @ np.array(_RADIANCE_Y, np.float32)
    ratio = np.ones_like(light)
    np.divide(rgb @ np.array(weights, np.float32), light, out=ratio, where=light > 0)
    return np.maximum(ratio, 0.0), u_rel


def melanopic_edi(
    panorama: Panorama,
    luminance_cdm2: Floats,
    weights_sr: Floats,
    sun: SunSource | None,
    sun_ev_lx: Floats,
    *,
    lamps: bool | None = None,
) -> tuple[Floats, Floats]:
    """Return melanopic EDI and its standard uncertainty in d view directions, [d] each, in lx.

    panorama: gives the pixels' colours and uncertainties. luminance_cdm2: of its n pixels, row by
    row [n], without the sun. weights_sr [n, d]: solid angle times cosine. sun: separate from the
    pixels, with the illuminance sun_ev_lx [d] in each direction. lamps: electric light is on, or
    off; None if unknown. With it the map's part is `LAMP_RATIO` of that by colour, because the
    spectra of most LED have a gap at 480 nm. Without calibrated colour the first result is the
    illuminance, an estimate with the spectrum of D65, and the second is NaN. Errors of all pixels
    count as equal in sign.
    """
    map_lx = luminance_cdm2 @ weights_sr
    colour = melanopic_ratio(panorama)
    if colour is None:
        return map_lx + sun_ev_lx, np.full_like(map_lx, np.nan)
    edi = (luminance_cdm2 * colour[0].ravel()) @ weights_sr * (LAMP_RATIO if lamps else 1.0)
    own_lx, u_cdm2 = panorama.luminance_cdm2.ravel() @ weights_sr, panorama.u_cdm2
    u_lx = np.nan if u_cdm2 is None else np.nan_to_num(u_cdm2.ravel()) @ weights_sr
    u_ratio_rel = ratio_u_rel(edi / np.maximum(map_lx, 1e-9), colour[1], lamps=lamps)
    u_map_rel = np.hypot(u_lx / np.maximum(own_lx, 1e-9), u_ratio_rel)
    sun_edi = sun_ev_lx * (np.zeros(1) if sun is None else sun_melanopic_ratio(sun.altitude_deg))
    return edi + sun_edi, np.hypot(edi * u_map_rel, sun_edi * U_SUN)


def sun_melanopic_ratio(altitude_deg: Floats | float) -> Floats:
    """Return melanopic over photopic illuminance of direct sunlight, without glazing, [...].

    It is 0.94 exp(-0.058 air mass), a fit to SPECTRL2 (Bird and Riordan 1986) within 2 %.
    altitude_deg: apparent [...]; below 0 it counts as 0.
    """
    return np.asarray(_SUN_RATIO * np.exp(-_SUN_RATIO_DECAY * _air_mass(altitude_deg)))


def _air_mass(altitude_deg: Floats | float) -> Floats:
    """Return the relative air mass of Kasten and Young 1989; altitudes below 0 count as 0."""
    altitude = np.maximum(altitude_deg, 0.0)
    return 1.0 / (np.sin(np.radians(altitude)) + 0.50572 * (altitude + 6.07995) ** -1.6364)


def ratio_u_rel(ratio: Floats, u_rel: float, *, lamps: bool | None = None) -> Floats:
    """Return the relative standard uncertainty of melanopic ratios [...], in their shape.

    u_rel: under daylight. lamps: electric light is on, or off; None if unknown, which counts as on.
    What lamps add is from 139 lamps of IES TM-30-15 (bench/melanopic.py). The spectrum of a lamp
    does not follow from its colour, but few lamps have the colour of a blue sky.
    """
    return np.hypot(u_rel, np.interp(ratio, _LAMP_RATIOS, _U_LAMPS) * (lamps is not False))


# ----------------------------------------------------------------------------------------------
# colours of daylight

# The polynomial of CIE 015:2018, 3.1: x of daylight by 1 / T, descending; to 7000 K, and above.
_X_LOW = (-4.6070e9, 2.9678e6, 0.09911e3, 0.244063)
_X_HIGH = (-2.0064e9, 1.9018e6, 0.24748e3, 0.237040)
# The sky's colour temperature: Diakite's model in Radiance's perezlum_c.cal (gendaylit -C), by
# luminance for a clear sky, fixed for an overcast one. Between their values of Perez's clearness,
# where gendaylit has no colour, 1 / T is interpolated (chosen).
_CLEAR_MIRED, _CLEAR_MIRED_PER_DECADE, _OVERCAST_K = -180.956, 78.648, 6191.0
_OVERCAST_CLEARNESS, _CLEAR_CLEARNESS = 1.065, 4.5
# ln of X / Y and Z / Y of direct sunlight by air mass, descending: fits to SPECTRL2 with an aerosol
# depth of 0.1, within 1.5 % to air mass 26 (1 degree).
_SUN_X, _SUN_Z, _SUN_MAX_MASS = (0.000287, 0.007412, -0.049279), (-0.1163, 0.0329), 26.0


def daylight_xy(cct_k: ArrayLike) -> tuple[Floats, Floats]:
    """Return x and y of CIE daylight, [...] each.

    cct_k: correlated colour temperature [...], 4000 to 25 000 K. Source: CIE 15.
    """
    inverse = 1.0 / np.asarray(cct_k, float)
    low = np.asarray(cct_k) <= 7000.0
    x = np.where(low, np.polyval(_X_LOW, inverse), np.polyval(_X_HIGH, inverse))
    return x, -3.000 * x * x + 2.870 * x - 0.275


def sky_xyz(luminance_cdm2: Floats, clearness: Floats) -> Floats:
    """Return X, Z and Y = 1 of places of the sky, in the order X, Y, Z [..., 3].

    The colours are those of CIE daylight, with the colour temperature of Diakite's model
    (`gendaylit -C`), 4000 to 25 000 K. luminance_cdm2 [...]: of the places; clearness: Perez's
    epsilon, in a shape that broadcasts to [...].
    """
    clear = _CLEAR_MIRED + _CLEAR_MIRED_PER_DECADE * np.log10(np.maximum(luminance_cdm2, 1.0))
    share = (clearness - _OVERCAST_CLEARNESS) / (_CLEAR_CLEARNESS - _OVERCAST_CLEARNESS)
    share = np.clip(share, 0.0, 1.0)
    mired = share * clear + (1.0 - share) * 1e6 / _OVERCAST_K  # 1e6 / colour temperature [K]
    x, y = daylight_xy(1e6 / np.clip(mired, 40.0, 250.0))  # 25 000 to 4000 K
    return np.stack([x / y, np.ones_like(x), (1.0 - x - y) / y], axis=-1)


def sun_xyz(altitude_deg: Floats) -> Floats:
    """Return X, Z and Y = 1 of direct sunlight, in the order X, Y, Z [..., 3].

    altitude_deg [...]: apparent altitude of the sun. A fit to SPECTRL2 by air mass, within 1.5 %
    from 1 degree on; lower suns count as 1 degree.
    """
    mass = np.minimum(_air_mass(altitude_deg), _SUN_MAX_MASS)
    x, z = (np.exp(np.polyval(p, mass)) for p in (_SUN_X, _SUN_Z))
    return np.stack([x, np.ones_like(x), z], axis=-1)
