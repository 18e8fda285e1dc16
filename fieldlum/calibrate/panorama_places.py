"""Read the places of merged panoramas that a meter or a black trap compares."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fieldlum.calibrate.readings_csv import CsvRow
from fieldlum.core.arrays import Mask
from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, Panorama
from fieldlum.optics.images import calibration_mark
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import direction, equirect_rays
from fieldlum.session.panorama_sun import read_panorama_with_sun


def read_panoramas(
    rows: Sequence[CsvRow], profile: CameraProfile, remedy: str = ""
) -> dict[Path, Panorama]:
    """Return the panoramas of a table, by file.

    remedy : what else to do before merging again. Raises InputError for a panorama that was merged
    with another calibration than the profile's.
    """
    own, pictures = calibration_mark(profile)["calibration"], {}
    for file in dict.fromkeys(row["panorama"] for row in rows):
        pictures[file] = read_panorama_with_sun(file)
        attributes = pictures[file].attributes
        if attributes.get("calibration", own) != own:
            raise InputError(
                file,
                f"the picture was merged with another calibration ({attributes.get('camera')})",
                f"the calibration of {profile.camera.name}",
                f"merge it again with this profile (fieldlum merge){remedy}",
            )
    return pictures


def pixels_within(
    picture: Panorama, azimuth_deg: float, altitude_deg: float, radius_rad: float
) -> Mask:
    """Return a mask [h, w] of the pixels within an angle of a direction, clockwise from north."""
    height, width = picture.luminance_cdm2.shape
    rays = equirect_rays(height, width, picture.heading_deg)
    return rays @ direction(altitude_deg, azimuth_deg) >= np.cos(radius_rad)


def disc_radius_rad(picture: Panorama, radius_deg: float) -> float:
    """Return the radius of a disc that is at least a few pixels wide [rad]."""
    return float(np.radians(max(radius_deg, 1.2 * 180.0 / len(picture.luminance_cdm2))))


def is_flagged(picture: Panorama, inside: Mask, flag: Flag) -> bool:
    """Return whether a pixel of a mask has a flag."""
    return picture.flags is not None and bool((picture.flags[inside] & flag).any())
