"""Find pictures that are mirrored, upside down or turned, by sun discs at the wrong place in them.

In a file of another program, columns may begin at another azimuth, the ground may be on top, or the
sphere may be seen from outside. Nothing else shows it: the model of such captures has small errors.
"""

from typing import NamedTuple, cast

import numpy as np
from scipy.ndimage import label

from fieldlum.core.arrays import ArrayLike, Floats, Mask
from fieldlum.core.records import counted
from fieldlum.optics import projection
from fieldlum.optics.projection import direction, row_altitudes_deg, signed_angle_deg
from fieldlum.sky.sun_disc import find_disc

# Least share of the beam that makes a bright spot the sun: glass, water and polish reflect less up
# to 80 degrees of incidence (Fresnel, n = 1.5), so that a low sun in a floor does not count.
DISC_SHARE = 0.4
_LOW_SUN_DEG = 10.0  # a floor can mirror a lower sun as bright (incidence over 80 degrees)
_HALO_DEG = 1.5  # of a clipped disc, at most (`sun_disc`)
_WITHIN_DEG = 6.0  # largest error of a compass near steel, and a degree for level and clock
_SURE_DISCS = 2  # that support an explanation until it is certain; chosen


class WrongAxes(NamedTuple):
    """What is wrong with the axes of pictures, and what to do.

    found: what is wrong, remedy: what to do, as sentences without a full stop. sure: a single
    explanation fits, and at least two discs support it that no mirror would show there.
    """

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
    """Return altitude and azimuth [deg] of a spot in a map that can only be the sun, or None.

    The azimuth is clockwise from north, 0 to 360. luminance_cdm2 [H, W]: without a disc at the
    sun's own place; heading_deg: azimuth of the map's centre; beam_lx: illuminance of the sun on a
    plane normal to it; altitude_deg: of the sun, apparent. The spot is a disc with `DISC_SHARE` of
    the beam; or the only clipped area, if it is not larger than the sun's halo and near
    `altitude_deg` (a polished desk shows the sun below the horizon). clipped [H, W]: mask of
    clipped pixels, None if unknown.
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
    azimuths = projection.column_azimuths_deg(width, heading_deg)[columns]
    rays = direction(row_altitudes_deg(height)[rows], azimuths)  # of the spot's pixels [k, 3]
    middle = rays.mean(axis=0) / np.linalg.norm(rays.mean(axis=0))
    if np.degrees(np.arccos(np.clip(rays @ middle, -1, 1)).max()) > _HALO_DEG + 180.0 / height:
        return None
    spot_altitude, azimuth = map(float, projection.altitude_azimuth_deg(middle))
    is_high = abs(spot_altitude - altitude_deg) < _WITHIN_DEG
    return (spot_altitude, azimuth % 360.0) if is_high else None


def wrong_axes(
    suns_deg: ArrayLike, shown_deg: ArrayLike, heading_deg: float, rows: int
) -> WrongAxes | None:
    """Return what explains discs away from the sun's place; None if each is at its place.

    suns_deg [n, 2]: apparent altitude and azimuth of the sun in n captures; shown_deg [n, 2]: those
    of the disc that the picture shows there, or elsewhere (`sun_elsewhere`). heading_deg: stated
    azimuth of the pictures' centre column; rows: their height in pixels. Azimuths are clockwise
    from north. A disc is at its place within 6 degrees (a compass near steel) or 2.5 pixels. If no
    explanation fits all captures, `found` reports that.
    """
    shown_altitude, shown_azimuth = np.reshape(np.asarray(shown_deg, float), (-1, 2)).T
    altitude, azimuth = np.reshape(np.asarray(suns_deg, float), (-1, 2)).T
    ahead = signed_angle_deg(azimuth - heading_deg)  # of the sun from the centre column
    within_deg = max(_WITHIN_DEG, 2.5 * 180.0 / rows)  # two pixels and a half; chosen

    def explained(altitude_deg: Floats, ahead_deg: Floats) -> Mask:
        """Return which captures show the disc at a place of the picture, [n].

        altitude_deg, ahead_deg: the place's altitude, and its azimuth clockwise from the centre
        column, [n] each.
        """
        across = signed_angle_deg(heading_deg + ahead_deg - shown_azimuth)
        across = across * np.cos(np.radians(altitude_deg))
        return np.hypot(altitude_deg - shown_altitude, across) < within_deg

    elsewhere = ~explained(altitude, ahead)
    if not elsewhere.any():
        return None
    count = counted(int(elsewhere.sum()), "capture")
    turn_deg = float(np.median(signed_angle_deg(shown_azimuth - azimuth)))
    true_deg = (heading_deg - turn_deg) % 360.0
    heading = f"set heading_deg = {true_deg:.0f}, if clock and place are right"
    high_suns = int((elsewhere & (altitude > _LOW_SUN_DEG)).sum())
    turned = f"turned by {turn_deg:.0f} degrees"
    # Elsewhere at one time of the day, a mirror, a facade of glass or a lamp shows the same place.
    apart_deg = np.abs(signed_angle_deg(ahead[elsewhere] - ahead[elsewhere][:, None])).max()
    turned_suns = int(elsewhere.sum()) if apart_deg > 2.0 * within_deg else 0
    # an explanation's captures, text, remedy, and number of discs that no mirror would show there
    explanations = (
        (explained(altitude, ahead + turn_deg), turned, heading, turned_suns),
        (explained(-altitude, ahead), "upside down", "exchange top and bottom", high_suns),
        (explained(-altitude, -ahead), "turned about its axis by 180", "turn it back", high_suns),
        (explained(altitude, -ahead), "mirrored left to right", "mirror the pictures", 0),
    )
    likely = [(kind, fix, discs) for captures, kind, fix, discs in explanations if captures.all()]
    if not likely:
        found = f"the sun's disc in {count} is not where the sun was"
        remedy = "check t_utc, the place, heading_deg and the pictures' axes"
        return WrongAxes(found, remedy, sure=False)
    kinds = " or ".join(kind for kind, _, _ in likely)
    found = f"the sun's disc in {count} is where a picture shows it that is {kinds}"
    sure = len(likely) == 1 and max(discs for _, _, discs in likely) >= _SURE_DISCS
    doubt = "" if sure else ", unless a mirror shows the sun"
    return WrongAxes(found, " or ".join(fix for _, fix, _ in likely) + doubt, sure)
