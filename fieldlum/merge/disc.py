"""The sun's disc out of the map: by energy, where the ephemeris says it stands and the picture
shows it.

With frames through a filter the disc's illuminance is measured. Without, every frame clips in it:
what is taken out is a lower bound, its pixels keep CLIPPED_HIGH, and `pair` completes the source
from the irradiance of that hour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fieldlum.profiles import Lens
from fieldlum.projection import direction, equirect_rays, equirect_solid_angles
from fieldlum.records import Flag, Panorama, Site, SunSource
from fieldlum.sun import SUN_SOLID_ANGLE_SR, position

_DISC_RAD = 0.004654  # mean angular radius of the sun
_SEARCH_RAD = np.radians(3.0)  # pointing of a camera set up by hand
# of the disc averaged over its surface: a sun dimmer than this (1.6e9 clear) casts no shadow
_BRIGHT_CDM2 = 2e5
_LOWEST_DEG = -0.3
_ON_MOSAIC, _POINT_ON_MOSAIC = 0.3, 0.5  # relative, of a disc one pixel wide, and of a point
CLIPPED = "clipped"
MEASURED = "nd-frames"
OPEN = "merge"


def take_out_sun(panorama: Panorama, site: Site) -> Panorama:
    """The panorama with the disc's pixels brought down to their surroundings (FILLED) and the
    source beside it.

    Unchanged when the sun is down, hidden, or the time is unknown. Its origin says how far to trust
    it: nd-frames (measured), merge (no frame clipped), clipped (a lower bound).
    """
    if panorama.t_utc is None:
        return panorama
    sun = position([panorama.t_utc], site)
    altitude, azimuth = float(sun.apparent_altitude_deg[0]), float(sun.azimuth_deg[0])
    if altitude < _LOWEST_DEG:
        return panorama
    return take_out_disc(panorama, altitude, azimuth)


def take_out_disc(panorama: Panorama, altitude_deg: float, azimuth_deg: float) -> Panorama:
    """As `take_out_sun`, for a sun at a given apparent position."""
    light = np.asarray(panorama.luminance_cdm2, np.float64)
    height, width = light.shape
    pixel = np.pi / height
    rays = equirect_rays(height, width, panorama.heading_deg)
    solid = equirect_solid_angles(height, width)
    flags = (
        np.zeros(light.shape, np.uint16)
        if panorama.flags is None
        else panorama.flags.astype(np.uint16)
    )
    centre = _brightest(light, solid, rays, direction(altitude_deg, azimuth_deg), pixel)
    away = np.arccos(np.clip(rays @ centre, -1.0, 1.0))
    disc = away <= _DISC_RAD + pixel
    ring = (away > _DISC_RAD + 1.5 * pixel) & (away <= _DISC_RAD + 4.5 * pixel + np.radians(1.0))
    around = float(np.median(light[ring])) if ring.any() else 0.0
    excess = np.where(disc, np.maximum(light - around, 0.0), 0.0)
    normal_lx = float((excess * solid).sum())
    clipped = bool(((flags & Flag.CLIPPED_HIGH) > 0)[disc].any())
    if normal_lx < _BRIGHT_CDM2 * SUN_SOLID_ANGLE_SR and not clipped:
        return panorama
    if light[disc].max(initial=0.0) < 5 * max(around, 1e-6) and not clipped:
        return panorama
    taken = disc & (excess > 0.05 * around)
    filtered = bool(((flags & Flag.ND) > 0)[disc].any())
    origin = CLIPPED if clipped else MEASURED if filtered else OPEN
    flags[taken] |= np.uint16(Flag.FILLED)
    factor = np.where(taken, around / np.maximum(light, 1e-12), 1.0)
    u = (
        None
        if panorama.u_cdm2 is None
        else np.where(taken, around, panorama.u_cdm2).astype(np.float32)
    )
    rgb = None if panorama.rgb is None else (panorama.rgb * factor[..., None]).astype(np.float32)
    source = SunSource(altitude_deg, azimuth_deg, normal_lx, 1.0, origin)
    return replace(
        panorama,
        luminance_cdm2=(light * factor).astype(np.float32),
        u_cdm2=u,
        flags=flags,
        sun=source,
        rgb=rgb,
    )


def disc_px(lenses: Sequence[Lens]) -> float:
    """Diameter of the disc on the sensor in the middle of the field of the lens that shows it
    smallest. [px]
    """
    return min(
        2 * _DISC_RAD * lens.radius_px / np.radians(lens.full_angle_deg / 2) for lens in lenses
    )


def mosaic_u_rel(diameter_px: float) -> float:
    """Relative u of a small disc's luminance because each colour stands on some pixels of a mosaic
    only.

    That of sharp optics, rms over the places where the disc may fall, to a quarter for 0.7 to 16
    pixels (the law is that of lattice points in a circle; bench/sun_on_mosaic.py). It is an upper
    bound: where the optics spread a point over two pixels, a twentieth of it is left.
    """
    return min(_POINT_ON_MOSAIC, _ON_MOSAIC * diameter_px**-1.5)


def _brightest(
    light: NDArray[np.float64],
    solid: NDArray[np.float64],
    rays: NDArray[np.float64],
    expected: NDArray[np.float64],
    pixel: float,
) -> NDArray[np.float64]:
    """Centre of the brightest spot near where the sun is expected; the expected place when
    nothing stands out.
    """
    near = rays @ expected >= np.cos(max(_SEARCH_RAD, 1.5 * pixel))
    if not near.any():
        return expected
    values = light[near]
    bright = values >= 0.5 * values.max()
    if values.max() <= 5 * np.median(values):  # also where no lens looks: all is 0 there
        return expected
    weights = (values * solid[near])[bright]
    mean = (rays[near][bright] * weights[:, None]).sum(axis=0)
    return mean / np.linalg.norm(mean)
