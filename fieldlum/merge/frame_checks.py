"""Check saturation, black level and camera roll of the frames before the merge."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fieldlum.merge.frames import Plateau
from fieldlum.merge.shots import Shot
from fieldlum.optics.photometry import saturation_plateau
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import signed_angle_deg
from fieldlum.optics.raw import (
    channel_positions,
    read_mosaic,
    roll_deg_of,
    white_balance_is_fixed,
)

_LOOKED_AT = 6_000_000  # pixels that are examined, to limit the time; chosen
# A frame whose EXIF roll differs from the profile's by more than the first value counts as turned;
# a lens within the second value of the horizon counts as level. Not measured.
_HELD_DEG, _LEVEL_DEG = 60.0, 45.0


def saturation_and_black(
    shots: Sequence[Shot], profile: CameraProfile
) -> tuple[dict[float, Plateau], float]:
    """Measure saturation and black level in the most exposed frame of each ISO.

    shots: of one heading, longest exposure first. Return the counts at which R, G1, G2 and B
    saturate by ISO, black included, None for a colour that does not saturate in the frame; and the
    files' black level minus the profile's [DN], for the colour with the largest difference, 0 if
    the profile has none. For a JPEG camera there are none. One colour can saturate at lower counts
    than the others. The counts depend on the ISO: at a low ISO the full well limits, at a high ISO
    the converter.
    """
    plateau_dn: dict[float, Plateau] = {}
    off = 0.0
    for shot in shots if profile.camera.kind == "raw" else ():
        if shot.exposure.iso in plateau_dn:
            continue
        mosaic = read_mosaic(shot.path, lens_f_number=shot.exposure.f_number)
        step = 2 * max(1, mosaic.counts.size // _LOOKED_AT)
        plateau_dn[shot.exposure.iso] = tuple(
            saturation_plateau(mosaic.counts[row::step, column::2], mosaic.white_dn)
            for row, column in channel_positions(mosaic.cfa)
        )
        if any(profile.sensor.black_dn):
            differences = np.subtract(mosaic.black_dn, profile.sensor.black_dn).tolist()
            off = max([off, *differences], key=abs)
    return plateau_dn, off


def orientation_conflict(shots: Sequence[Shot], profile: CameraProfile) -> str:
    """Return a text for the verdict if the frames' EXIF roll is wrong; "" if it is not.

    The roll is wrong if it changes within the bracket, or differs by over 60 degrees from the
    profile's: a camera on its side gives a rotated map, and no other figure of the merge shows
    that. Cameras with several lenses, lenses tilted by over 45 degrees, and frames without EXIF
    orientation are not checked.
    """
    lens = profile.lens[0]
    # Cameras with two fisheyes have no upright position, and the EXIF roll is unreliable when the
    # camera points up.
    if len(profile.lens) > 1 or abs(lens.tilt_deg) > _LEVEL_DEG:
        return ""
    rolls_deg = {roll for shot in shots if (roll := roll_deg_of(shot.path)) is not None}
    if len(rolls_deg) > 1:
        return (
            "the camera was turned within the bracket: its EXIF has the roll angles "
            f"{_degrees(rolls_deg)}; capture the bracket again with a fixed camera"
        )
    off = float(signed_angle_deg(rolls_deg.pop() - lens.roll_deg)) if rolls_deg else 0.0
    if abs(off) <= _HELD_DEG:
        return ""
    return (
        f"by EXIF, the camera was held {abs(off):.0f} deg off the profile's roll of "
        f"{lens.roll_deg:g} deg: hold it as in the calibration, or correct roll_deg of the profile"
    )


def floating_white_balance(shots: Sequence[Shot], profile: CameraProfile) -> str:
    """Return the first JPEG frame without a fixed white balance; "" if there is none.

    Its colours are unknown. Only frames of a profile with a melanopic weight are examined; raw
    counts have no white balance.
    """
    if profile.camera.kind == "raw" or not profile.colour.melanopic_from_rgb:
        return ""
    names = (shot.path.name for shot in shots if not white_balance_is_fixed(shot.path))
    return next(names, "")


def _degrees(values: set[float]) -> str:
    return " and ".join(f"{value:g}" for value in sorted(values)) + " deg"
