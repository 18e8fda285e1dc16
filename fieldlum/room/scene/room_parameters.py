"""Name the parameters of a box room that a fit or a tape measure can have wrong."""

from __future__ import annotations

from fieldlum.core.records import Room

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
