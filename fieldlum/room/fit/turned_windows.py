"""Reject captures that no scene can explain, before a search.

Captures are rejected if the windows are at other places in the pictures than in the stated room.
Captures of another view are left out when they are read (`learn.models`).
"""

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Room
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics.projection import equirect_solid_angles, signed_angle_deg
from fieldlum.room.fit import evidence, renderer
from fieldlum.room.fit.guess import guess_of
from fieldlum.room.scene.view import pixel_rays

_TURN_STEP_DEG = 10.0  # chosen: a third of the smallest turn that is reported
_MIN_TURN_DEG = 30.0  # chosen: more than the search corrects for a compass near steel
# Gain of ln luminance in the windows by a turn of the room. Measured in the office and in three
# rendered rooms: 0 with the correct room; 2.6 to 3.0 with the room turned by 180 degrees.
_WINDOW_LOG_GAIN = 1.0


def check_captures(data: Dataset, room: Room) -> None:
    """Raise InputError for a room or captures that cannot be fitted.

    These are a room that is not a box, has no window or is impossible, and captures whose bright
    windows fit the room only after a turn of 30 degrees or more.
    """
    evidence.require_box(room)
    if finding := turned_windows_note(data, room):
        expected = "windows at the places stated in [room]"
        remedy = (
            "check heading_deg, wall_azimuth_deg and the windows' walls; nothing was written, and "
            "train uses the stated [room], or no sun patches with --patch none"
        )
        raise InputError(data.source or "the captures", finding, expected, remedy)


def turned_windows_note(data: Dataset, room: Room) -> str:
    """Return a clause if bright windows fit the room only after 30 degrees or more; "" if not.

    room: a box. Its windows are turned around the camera in steps of 10 degrees, to where the
    captures' median is brightest. Raises InputError for an impossible room.
    """
    height, width = data.shape
    _, rays = pixel_rays(height, data.heading_deg, 1)
    ends = renderer.surfaces(guess_of(room, data.heading_deg), rays.astype(np.float32))
    glass = (ends.surface == renderer.OUTSIDE).reshape(height, width)
    omega = np.where(data.seen, equirect_solid_angles(height, width), 0.0)
    level = np.log(np.maximum(np.median(data.luminance_cdm2, axis=0), evidence.MIN_CDM2))  # [H, W]
    turns_px = np.arange(0, width, max(1, round(_TURN_STEP_DEG / 360.0 * width)))
    weights = [np.roll(glass, turn, axis=1) * omega for turn in turns_px]
    if min(weight.sum() for weight in weights) <= 0.0:
        return ""
    bright = np.array([np.average(level, weights=weight) for weight in weights])
    best = int(bright.argmax())
    turn_deg = float(signed_angle_deg(turns_px[best] / width * 360.0))
    room_level = float(np.average(level, weights=omega))
    # A stated window that is bright exists, even if another place is brighter.
    is_absent = bright[0] - room_level < _WINDOW_LOG_GAIN
    is_elsewhere = is_absent and bright[best] - bright[0] > _WINDOW_LOG_GAIN
    if not is_elsewhere or abs(turn_deg) < _MIN_TURN_DEG:
        return ""
    return (
        f"bright windows about {turn_deg:+.0f} degrees (clockwise) from where [room] and "
        "heading_deg place windows"
    )
