"""What frames show about sensor and camera before they are merged: saturation, black, roll."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from fieldlum.merge.shots import Shot
from fieldlum.photometry import saturation_plateau
from fieldlum.profiles import CameraProfile
from fieldlum.projection import signed_angle_deg
from fieldlum.raw import channel_positions, read_mosaic, roll_deg_of

Plateau = tuple[float | None, float | None, float | None, float | None]  # of R, G1, G2, B [DN]
NO_PLATEAU: Plateau = (None, None, None, None)
_LOOKED_AT = 6_000_000  # pixels; bounds the time
# Differences of EXIF's roll that count as turned, and as level. Not measured.
_HELD_DEG, _LEVEL_DEG = 60.0, 45.0


@dataclass(frozen=True, slots=True)
class FirstLook:
    """Result of the first look at the frames.

    plateau_dn: the counts at which each colour saturates, by ISO; black_off_dn: the file's black
    level minus the profile's, largest over the colours.
    """

    plateau_dn: dict[float, Plateau]
    black_off_dn: float = 0.0

    def plateau(self, shot: Shot) -> Plateau:
        """Return the saturation of a frame's colours [DN]."""
        return self.plateau_dn.get(shot.exposure.iso, NO_PLATEAU)


def first_look(shots: Sequence[Shot], profile: CameraProfile) -> FirstLook:
    """Find saturation and black level in the most exposed frame of each ISO.

    shots: of one heading, sorted. JPEG frames give no result. A colour can saturate below the
    others, and at another count for each ISO: at a low one the full well limits, at a high one the
    converter.
    """
    if profile.camera.kind == "jpeg":
        return FirstLook({})
    found: dict[float, Plateau] = {}
    off = 0.0
    for shot in shots:
        if shot.exposure.iso in found:
            continue
        mosaic = read_mosaic(shot.path, lens_f_number=shot.exposure.f_number)
        step = 2 * max(1, mosaic.counts.size // _LOOKED_AT)
        planes = (
            mosaic.counts[row::step, column::2] for row, column in channel_positions(mosaic.cfa)
        )
        red, green_1, green_2, blue = (
            saturation_plateau(plane, mosaic.white_dn) for plane in planes
        )
        found[shot.exposure.iso] = red, green_1, green_2, blue
        if any(profile.sensor.black_dn):
            each = [
                file - own
                for file, own in zip(mosaic.black_dn, profile.sensor.black_dn, strict=True)
            ]
            off = max([off, *each], key=abs)
    return FirstLook(found, off)


def orientation_conflict(shots: Sequence[Shot], profile: CameraProfile) -> str:
    """Return how the frames' EXIF contradicts the profile's roll, or "".

    The map of a camera on its side is itself rotated, and no figure shows that.
    """
    lens = profile.lens[0]
    # Dual-fisheye bodies have no upright position, and EXIF roll is unreliable when the camera
    # points up.
    if len(profile.lens) > 1 or abs(lens.tilt_deg) > _LEVEL_DEG:
        return ""
    told = {roll for shot in shots if (roll := roll_deg_of(shot.path)) is not None}
    if len(told) > 1:
        return f"the camera was turned within the bracket, by its EXIF: roll {_degrees(told)}"
    off = float(signed_angle_deg(told.pop() - lens.roll_deg)) if told else 0.0
    if abs(off) <= _HELD_DEG:
        return ""
    return (
        f"by its EXIF the camera was held {abs(off):.0f} deg off the profile's roll of "
        f"{lens.roll_deg:g}"
    )


def _degrees(values: set[float]) -> str:
    return " and ".join(f"{value:g}" for value in sorted(values)) + " deg"
