"""Find pictures that are mirrored, upside down or turned, by sun discs that are elsewhere in them.

A file of another program may begin its columns at another azimuth, have the ground on top, or be
seen from outside. Nothing else shows it: such captures give a model with small errors.
"""

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import label

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import counted
from fieldlum.optics.projection import (
    altitude_azimuth_deg,
    column_azimuths_deg,
    direction,
    row_altitudes_deg,
    signed_angle_deg,
)
from fieldlum.sky.sun_disc import find_disc

# Least share of the beam that makes a bright spot the sun: glass, water and polish reflect less up
# to 80 degrees of incidence (Fresnel, n = 1.5), so that a low sun in a floor does not count.
DISC_SHARE = 0.4
_LOW_SUN_DEG = 10.0
_HALO_DEG = 1.5  # of a clipped disc, at most (`sun_disc`)
_WITHIN_DEG = 6.0  # of a compass near steel, and a degree for level and clock
_SURE_DISCS = 2  # chosen


@dataclass(frozen=True, slots=True)
class WrongAxes:
    """What is wrong with the axes of pictures. sure: no reflection explains it."""

    found: str
    remedy: str
    sure: bool


def sun_elsewhere(
    luminance_cdm2: Floats,
    heading_deg: float,
    beam_lx: float,
    clipped: Mask | None = None,
    altitude_deg: float = 0.0,
) -> tuple[float, float] | None:
    """Return altitude and azimuth [deg] of what only the sun can be in a map [H, W], or None.

    It is a disc with `DISC_SHARE` of the beam; or the only clipped spot, of the size of the sun's
    halo and near `altitude_deg`, that of the sun: a polished desk shows it below the horizon. The
    disc at the sun's place is taken out before. clipped [H, W]: None if unknown.
    """
    disc = find_disc(luminance_cdm2, heading_deg)
    if disc is not None and disc.normal_lx > DISC_SHARE * beam_lx:
        return disc.altitude_deg, disc.azimuth_deg
    if clipped is None:
        return None
    spots: Mask = np.asarray(clipped, bool)
    _, count = cast(tuple[Mask, int], label(spots))
    if count != 1:
        return None
    rows, columns = np.nonzero(spots)
    height, width = clipped.shape
    altitude = row_altitudes_deg(height)[rows]
    rays = direction(altitude, column_azimuths_deg(width, heading_deg)[columns])
    middle = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
    if np.degrees(np.arccos(np.clip(rays @ middle, -1, 1)).max()) > _HALO_DEG + 180.0 / height:
        return None
    at = altitude_azimuth_deg(middle)
    is_high = abs(float(at[0]) - altitude_deg) < _WITHIN_DEG
    return (float(at[0]), float(at[1]) % 360.0) if is_high else None


def wrong_axes(
    suns_deg: ArrayLike, shown_deg: ArrayLike, heading_deg: float, rows: int
) -> WrongAxes | None:
    """Return what explains discs away from the sun's place; None without such a disc.

    suns_deg, shown_deg [n, 2]: apparent altitude and azimuth of the sun, and those at which the
    pictures, of `rows` pixels, show what `sun_elsewhere` finds, or a disc at the sun's place.
    heading_deg: stated azimuth of their centre column. All azimuths are clockwise from north.
    """
    shown = np.reshape(np.asarray(shown_deg, float), (-1, 2))
    altitude, azimuth = np.reshape(np.asarray(suns_deg, float), (-1, 2)).T
    ahead = signed_angle_deg(azimuth - heading_deg)
    within_deg = max(_WITHIN_DEG, 2.5 * 180.0 / rows)  # two pixels and a half; chosen

    def explained(altitude_deg: Floats, ahead_deg: Floats) -> Mask:
        across = signed_angle_deg(heading_deg + ahead_deg - shown[:, 1])
        across = across * np.cos(np.radians(altitude_deg))
        return np.hypot(altitude_deg - shown[:, 0], across) < within_deg

    elsewhere = ~explained(altitude, ahead)
    if not elsewhere.any():
        return None
    count = counted(int(elsewhere.sum()), "capture")
    turn_deg = float(np.median(signed_angle_deg(shown[:, 1] - azimuth)))
    true_deg = (heading_deg - turn_deg) % 360.0
    heading = f"set heading_deg = {true_deg:.0f}, if clock and place are right"
    high_suns = int((elsewhere & (altitude > _LOW_SUN_DEG)).sum())
    turned = f"turned by {turn_deg:.0f} degrees"
    # Elsewhere at one time of the day, a mirror, a facade of glass or a lamp shows the same place.
    apart_deg = np.abs(signed_angle_deg(ahead[elsewhere] - ahead[elsewhere][:, None])).max()
    turned_suns = int(elsewhere.sum()) if apart_deg > 2.0 * within_deg else 0
    # which captures an explanation is true of, its text, its remedy, and the number of discs that
    # support it: none where a mirror would show the same
    explanations = (
        (explained(altitude, ahead + turn_deg), turned, heading, turned_suns),
        (explained(-altitude, ahead), "upside down", "exchange top and bottom", high_suns),
        (explained(-altitude, -ahead), "turned about its axis by 180", "turn it back", high_suns),
        (explained(altitude, -ahead), "mirrored left to right", "mirror the pictures", 0),
    )
    likely = [candidate for candidate in explanations if candidate[0].all()]
    if not likely:
        found = f"the sun's disc in {count} is not where the sun was"
        remedy = "check t_utc, the place, heading_deg and the pictures' axes"
        return WrongAxes(found, remedy, sure=False)
    kinds = " or ".join(kind for _, kind, _, _ in likely)
    remedies = " or ".join(remedy for _, _, remedy, _ in likely)
    found = f"the sun's disc in {count} is where a picture shows it that is {kinds}"
    sure = len(likely) == 1 and likely[0][3] >= _SURE_DISCS
    return WrongAxes(
        found, remedies if sure else f"{remedies}, unless a mirror shows the sun", sure
    )
