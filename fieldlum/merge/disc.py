"""The sun's disc of a merged panorama, taken out where the ephemeris expects it and it shows.

With frames through a filter the disc's illuminance is measured. Without, every frame clips in it:
what is taken out is a lower bound, its pixels keep CLIPPED_HIGH, and `pair` completes the source
from the irradiance of that hour.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fieldlum.profiles import Lens
from fieldlum.records import Flag, Panorama, Site, SunSource
from fieldlum.sun import position
from fieldlum.sun_disc import SUN_RADIUS_RAD, find_disc, without_disc

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
    """Return the panorama as `take_out_sun` does, for a sun at a given apparent position."""
    flags = (
        np.zeros(panorama.luminance_cdm2.shape, np.uint16)
        if panorama.flags is None
        else panorama.flags.astype(np.uint16)
    )
    disc = find_disc(
        panorama.luminance_cdm2,
        panorama.heading_deg,
        near_deg=(altitude_deg, azimuth_deg),
        clipped=(flags & Flag.CLIPPED_HIGH) > 0,
    )
    if disc is None:
        return panorama
    filtered = bool(((flags & Flag.ND) > 0)[disc.pixels].any())
    origin = CLIPPED if disc.clipped else MEASURED if filtered else OPEN
    flags[disc.pixels] |= np.uint16(Flag.FILLED)
    light, u_cdm2, rgb = panorama.luminance_cdm2, panorama.u_cdm2, panorama.rgb
    if u_cdm2 is not None:
        u_cdm2 = np.where(disc.pixels, disc.surroundings_cdm2, u_cdm2).astype(np.float32)
    if rgb is not None:
        darker = np.where(disc.pixels, disc.surroundings_cdm2 / np.maximum(light, 1e-12), 1.0)
        rgb = (rgb * darker[..., None]).astype(np.float32)
    return replace(
        panorama,
        luminance_cdm2=without_disc(light, disc),
        u_cdm2=u_cdm2,
        flags=flags,
        sun=SunSource(altitude_deg, azimuth_deg, disc.normal_lx, 1.0, origin),
        rgb=rgb,
    )


def disc_px(lenses: Sequence[Lens]) -> float:
    """Diameter of the disc on the sensor in the middle of the field of the lens that shows it
    smallest. [px]
    """
    return min(
        2 * SUN_RADIUS_RAD * lens.radius_px / np.radians(lens.full_angle_deg / 2) for lens in lenses
    )


def mosaic_u_rel(diameter_px: float) -> float:
    """Relative u of a small disc's luminance because each colour stands on some pixels of a mosaic
    only.

    That of sharp optics, rms over the places where the disc may fall, to a quarter for 0.7 to 16
    pixels (the law is that of lattice points in a circle; bench/sun_on_mosaic.py). It is an upper
    bound: where the optics spread a point over two pixels, a twentieth of it is left.
    """
    return min(_POINT_ON_MOSAIC, _ON_MOSAIC * diameter_px**-1.5)
