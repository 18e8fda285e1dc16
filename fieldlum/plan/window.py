"""Whether the sun can come in: through a box room's windows, past its reveals and its neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.records import Obstruction, Room, Window

Points = NDArray[np.float64]
GRID = 6  # points across and up a window


def room_directions(altitude_deg: NDArray[np.float64], azimuth_deg: NDArray[np.float64], room: Room) -> Points:
    """Sun directions [n, 3] in the room's own axes: x along its south wall, y into the room, z up."""
    return sun.direction(altitude_deg, azimuth_deg - (room.wall_azimuth_deg - 180.0))


def sun_enters(room: Room, altitude_deg: NDArray[np.float64], azimuth_deg: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[n]: some ray of the sun passes some window. Frame bars are left out."""
    rays = room_directions(altitude_deg, azimuth_deg, room)
    enters = np.zeros(len(rays), bool)
    for window in room.window:
        points = _points(window, room)
        for i in np.flatnonzero(~enters & (rays[:, 2] > 0)):
            enters[i] = _free(points, rays[i], window, room).any()
    return enters


def sun_in_view(room: Room, altitude_deg: NDArray[np.float64], azimuth_deg: NDArray[np.float64]) -> NDArray[np.bool_]:
    """[n]: the camera sees the disc itself through a window."""
    rays = room_directions(altitude_deg, azimuth_deg, room)
    camera = np.array([room.camera_x_m, room.camera_y_m, room.camera_z_m])
    seen = np.zeros(len(rays), bool)
    for window in room.window:
        axis, face, outward = _wall(window, room)
        for i in np.flatnonzero(~seen & (rays[:, 2] > 0) & (outward * rays[:, axis] > 1e-9)):
            hit = camera + rays[i] * (face - camera[axis]) / rays[i, axis]
            seen[i] = bool(_inside(hit[None], window, room)[0] and _free(hit[None], rays[i], window, room)[0])
    return seen


def _wall(window: Window, room: Room) -> tuple[int, float, float]:
    """Axis across the wall, where its inner face lies on it, and which way is out."""
    return {
        "south": (1, 0.0, -1.0),
        "north": (1, room.depth_m, 1.0),
        "west": (0, 0.0, -1.0),
        "east": (0, room.width_m, 1.0),
    }[window.wall]


def _extent(window: Window, room: Room) -> tuple[float, float]:
    """From where to where the window runs along its wall: left is as seen from inside."""
    left, right = window.left_m, window.left_m + window.width_m
    if window.wall == "south":
        return room.width_m - right, room.width_m - left
    if window.wall == "east":
        return room.depth_m - right, room.depth_m - left
    return left, right


def _points(window: Window, room: Room) -> Points:
    """A grid [GRID * GRID, 3] over the window's inner opening."""
    axis, face, _ = _wall(window, room)
    low, high = _extent(window, room)
    steps = (np.arange(GRID) + 0.5) / GRID
    along, up = np.meshgrid(low + (high - low) * steps, window.sill_m + window.height_m * steps)
    points = np.empty((along.size, 3))
    points[:, axis], points[:, 1 - axis], points[:, 2] = face, along.ravel(), up.ravel()
    return points


def _inside(points: Points, window: Window, room: Room) -> NDArray[np.bool_]:
    axis, _, _ = _wall(window, room)
    low, high = _extent(window, room)
    along, up = points[:, 1 - axis], points[:, 2]
    return (along >= low) & (along <= high) & (up >= window.sill_m) & (up <= window.sill_m + window.height_m)


def _free(points: Points, ray: Points, window: Window, room: Room) -> NDArray[np.bool_]:
    """Which points of the opening see the sun: out through the outer edge of the reveal, past all obstructions."""
    axis, _, outward = _wall(window, room)
    if outward * ray[axis] <= 1e-6:
        return np.zeros(len(points), bool)
    outer = points + ray * (room.wall_thickness_m / abs(ray[axis]))
    free = _inside(outer, window, room)
    for box in room.obstruction:
        free &= ~_hits(outer, ray, box)
    return free


def _hits(points: Points, ray: Points, box: Obstruction) -> NDArray[np.bool_]:
    """Slab test of Kay and Kajiya 1986: rays from points [n, 3] against one box."""
    low = np.array([box.x_m, box.y_m, box.z_m])
    high = low + np.array([box.width_m, box.depth_m, box.height_m])
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = (low - points) / ray, (high - points) / ray
    near, far = np.fmax.reduce(np.fmin(one, two), axis=1), np.fmin.reduce(np.fmax(one, two), axis=1)
    return (far >= np.maximum(near, 0.0)) & (far > 1e-9)
