"""Decide whether a wrong measure of the room explains sun patches at a wrong place.

A camera 15 cm from its stated place, or a window displaced by 10 cm, moves patches much like a
wrong north or clock. If such an error explains about as much, no north, clock or wall is reported
as certain.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Progress, Room, quiet
from fieldlum.learn.transport.misalignment import SUB, Evidence
from fieldlum.room.scene.room_parameters import room_parameters, with_parameters
from fieldlum.room.scene.view import look

# Errors of a tape measure over furniture. A larger one is a writing error, which one step shows.
# Chosen.
STEPS_M = (-0.15, -0.1, -0.05, 0.05, 0.1, 0.15)
_MOVED = ("camera_x_m", "camera_y_m", "camera_z_m", "window left_m", "window sill_m")


@dataclass(frozen=True, slots=True)
class RoomError:
    """A measure in [room] that may be wrong.

    name: key in SITE.toml; amount_m: to be added to the stated value [m]; gain: by how much the
    change lowers the misfit (share of wrong pixels near sun patches, `Evidence.misfit`).
    """

    name: str
    amount_m: float
    gain: float


def room_error(evidence: Evidence, progress: Progress = quiet) -> RoomError | None:
    """Return the measure of the room that, if wrong, explains the misfit of sun patches best.

    Return None without a box room, or if no change lowers the misfit. Changes by 5, 10 and 15 cm
    in both directions are tried, one measure at a time: the camera's x, y and z, the left edge of
    all windows together, the sill of all windows together.
    """
    room = evidence.data.setup.room
    if evidence.points is None or room is None:
        return None
    stated = _misfit(evidence, room)
    best = RoomError("", 0.0, 0.0)
    tries = list(_tries(room))
    for k, (name, amount, other) in enumerate(tries):
        progress(k, len(tries), f"room: {name}")
        try:
            gain = stated - _misfit(evidence, other)
        except InputError:  # a window outside its wall, a camera in the furniture
            continue
        if gain > best.gain:
            best = RoomError(name, amount, gain)
    return best if best.name else None


def _tries(room: Room) -> Iterator[tuple[str, float, Room]]:
    values = room_parameters(room)
    for moved in _MOVED:
        last = moved.split()[-1]
        names = [
            name
            for name in values
            if name == moved
            or (moved.startswith("window") and name.startswith("window") and name.endswith(last))
        ]
        for step in STEPS_M:
            yield moved, step, with_parameters(room, {name: values[name] + step for name in names})


def _misfit(evidence: Evidence, room: Room) -> float:
    """Return the mean misfit with the patches of a room."""
    data = evidence.data
    points = look(room, data.shape[0], data.heading_deg, SUB).sun_points(evidence.pixels)
    light = data.light[evidence.rows]
    towards = points.scene.to_room(light.shown_sun_direction)
    patch = np.stack([points.direct(d) * e for d, e in zip(towards, light.direct_lx, strict=True)])
    return float(evidence.misfit(patch, evidence.gains[1]).mean())
