"""Name the parameters of a box room that a fit or a tape measure can have wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace

from fieldlum.core.records import Obstruction, Room, Window

_ROOM_LENGTHS = ("camera_x_m", "camera_y_m", "camera_z_m")
_WINDOW_LENGTHS = ("left_m", "width_m", "sill_m", "height_m", "transom_m")
_OBSTRUCTION_LENGTHS = ("x_m", "y_m", "z_m", "width_m", "depth_m", "height_m")


def room_parameters(room: Room) -> dict[str, float]:
    """Return the parameters of a box room that can be uncertain, by name, in m and deg.

    Names are camera_x_m, wall_azimuth_deg, window.0.left_m, obstruction.0.x_m and so on.
    """
    values = {name: float(getattr(room, name)) for name in (*_ROOM_LENGTHS, "wall_azimuth_deg")}
    for k, window in enumerate(room.window):
        values |= {f"window.{k}.{name}": getattr(window, name) for name in _WINDOW_LENGTHS}
    for k, obstruction in enumerate(room.obstruction):
        values |= {
            f"obstruction.{k}.{name}": getattr(obstruction, name) for name in _OBSTRUCTION_LENGTHS
        }
    return values


def with_parameters(room: Room, values: Mapping[str, float]) -> Room:
    """Return the room with some of its `room_parameters` replaced by `values` [m, deg].

    Raises KeyError for a name that the room does not have.
    """
    if unknown := set(values) - set(room_parameters(room)):
        raise KeyError(f"the room has no {', '.join(sorted(unknown))}")

    def part(kind: str, k: int, of: Window | Obstruction) -> dict[str, float]:
        names = {f"{kind}.{k}.{f.name}": f.name for f in fields(of)}
        return {names[name]: float(v) for name, v in values.items() if name in names}

    own = {name: float(value) for name, value in values.items() if "." not in name}
    return replace(
        room,
        window=tuple(replace(w, **part("window", k, w)) for k, w in enumerate(room.window)),
        obstruction=tuple(
            replace(o, **part("obstruction", k, o)) for k, o in enumerate(room.obstruction)
        ),
        **own,
    )
