"""Fit a box room to clicks on its corners in a panorama, with the camera's height as the scale.

The camera's height above the floor gives the scale: a floor corner under a known angle is at a
known distance. All clicks are then fitted together, so that each length has the uncertainty that
the pixels of the clicks give it. Which corner a click means follows from its direction; the wall of
window 1 becomes the room's "south" wall.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.core.records import Room, Window
from fieldlum.optics.projection import direction
from fieldlum.room.scene.clicks import KINDS, Click, ClickGrid
from fieldlum.room.scene.geometry import room_axes

# standard uncertainty of a careful click on a zoomed picture; chosen, not measured with people
CLICK_PX = 0.5
_WALLS = ("south", "west", "north", "east")
# Of a wall, seen in the room's axes: which of x, y its plane fixes, and on which side.
_PLANES = {"south": (1, -1), "west": (0, -1), "north": (1, 1), "east": (0, 1)}
# a click this far from the fitted room is named: six times a careful click; chosen
_MISFIT_PX = 3.0
_HORIZON_DEG = 0.5  # a corner nearer to the horizon is no corner of floor or ceiling; chosen


@dataclass(frozen=True, slots=True)
class ClickedRoom:
    """A room that was fitted to clicks.

    room : lengths [m]. u : standard uncertainty of each length or angle by name [m, deg]. misfit_px
    : rms over the clicks. notes : one sentence for each click more than 3 px from the fitted room.
    """

    room: Room
    u: dict[str, float]
    misfit_px: float
    notes: tuple[str, ...]


def room_from_clicks(
    clicks: Sequence[Click], grid: ClickGrid, camera_height_m: float, *, where: str = "clicks"
) -> ClickedRoom:
    """Fit a box room to clicks on its corners in a panorama.

    camera_height_m : of the lens above the floor, 0.05 to 50 m. where : the source that errors
    name. A room needs three floor corners around the camera, one ceiling corner, and two opposite
    corners of each window. Raises InputError for fewer, for clicks that cannot be such corners, and
    for another camera height.
    """
    _check(clicks, grid, where)
    if not 0.05 <= camera_height_m <= 50.0:
        raise InputError(
            where,
            f"camera height {camera_height_m:g} m",
            "0.05 to 50 m",
            "measure the lens above the floor",
        )
    start = _start(clicks, grid, camera_height_m, where)
    return _fit(start, clicks, grid, camera_height_m)


def _check(clicks: Sequence[Click], grid: ClickGrid, where: str) -> None:
    for click in clicks:
        inside = 0 <= click.x_px <= grid.width_px and 0 <= click.y_px <= grid.height_px
        if not inside:
            raise InputError(
                f"{where}:{click.line}",
                f"a click at x {click.x_px:g}, y {click.y_px:g} px",
                f"a click within {grid.width_px} x {grid.height_px} px",
                "click on the panorama, or correct x_px and y_px",
            )
        altitude, _ = grid.angles(click.x_px, click.y_px)
        side = {"floor": -1.0, "ceiling": 1.0}.get(click.kind, 0.0)
        if side and altitude * side < _HORIZON_DEG:
            below = "lower" if side < 0 else "higher"
            raise InputError(
                f"{where}:{click.line}",
                f"a {click.kind} corner at an altitude of {altitude:+.1f} deg",
                f"an altitude of {side * _HORIZON_DEG:+g} deg or {below}",
                "correct the kind of this click, or its place",
            )
    count = {kind: sum(click.kind == kind for click in clicks) for kind in KINDS}
    if count["floor"] < 3 or count["ceiling"] < 1:
        raise InputError(
            where,
            f"{count['floor']} floor and {count['ceiling']} ceiling corners",
            "three corners of the floor and one of the ceiling",
            "click more corners",
        )
    for number in _numbers(clicks):
        corners = sum(click.kind == "window" and click.window == number for click in clicks)
        if corners < 2:
            raise InputError(
                where,
                f"window {number} has {corners} corners",
                "two opposite corners",
                "click two corners that are opposite each other",
            )


def _numbers(clicks: Sequence[Click]) -> list[int]:
    return sorted({click.window for click in clicks if click.window})


@dataclass(frozen=True, slots=True)
class _Start:
    """First guess, and the meaning of each click.

    values: azimuth of "south" [deg], distances to the four walls and height [m]; then along0,
    along1, low, high of each window in the frame of the camera [m].
    """

    values: Floats
    walls: dict[int, str]  # of each window
    sides: list[tuple[int, int, int]]  # of each click: sign of x, y (or along, up), window's place


def _start(clicks: Sequence[Click], grid: ClickGrid, h: float, where: str) -> _Start:
    rays = np.array([direction(*grid.angles(c.x_px, c.y_px)) for c in clicks]).reshape(-1, 3)
    floor = [k for k, click in enumerate(clicks) if click.kind == "floor"]
    ground = rays[floor, :2] * (h / -rays[floor, 2])[:, None]  # [n, 2] east, north
    theta = min(np.arange(0.0, 90.0, 0.5), key=lambda t: _spread(ground, float(t)))
    numbers = _numbers(clicks)
    first = [
        k
        for k, c in enumerate(clicks)
        if c.kind == "window" and c.window == min(numbers, default=0)
    ]
    facing = rays[first, :2].sum(axis=0) if first else direction(0.0, grid.heading_deg)[:2]
    theta = _main_wall(ground, float(theta), np.asarray(facing))
    xy = ground @ room_axes(theta)[:2, :2].T
    distances = _distances(xy, where)
    turned = rays @ room_axes(theta).T
    ceiling = [k for k, click in enumerate(clicks) if click.kind == "ceiling"]
    heights = [_reach(turned[k, :2], distances, corner=True) * turned[k, 2] for k in ceiling]
    values = [theta, *distances, h + float(np.mean(heights))]
    walls: dict[int, str] = {}
    for number in numbers:
        own = [k for k, c in enumerate(clicks) if c.kind == "window" and c.window == number]
        wall = _wall_of(turned[own, :2].sum(axis=0), distances)
        walls[number] = wall
        at = np.array([_on_wall(turned[k], wall, distances) for k in own])
        if np.ptp(at[:, 0]) < 0.02 or np.ptp(at[:, 1]) < 0.02:
            raise InputError(
                where,
                f"the corners of window {number} have no width or no height",
                "two opposite corners at least",
                "click its opposite corners again",
            )
        values += [*np.sort(at[:, 0])[[0, -1]], *(np.sort(at[:, 1])[[0, -1]] + h)]
    sides = [
        _side(click, turned[k], distances, walls, numbers, values, h)
        for k, click in enumerate(clicks)
    ]
    return _Start(np.array(values, float), walls, sides)


def _spread(ground: Floats, theta_deg: float) -> float:
    """Return how far corners on one side are from a common line."""
    xy = ground @ room_axes(theta_deg)[:2, :2].T
    total = 0.0
    for axis in (0, 1):
        for side in (xy[:, axis] < 0, xy[:, axis] >= 0):
            values = xy[side, axis]
            total += float(((values - values.mean()) ** 2).sum()) if len(values) else 1e6
    return total


def _main_wall(ground: Floats, theta_deg: float, facing: Floats) -> float:
    """Return the turn, of four possible ones, whose "south" wall is in a given direction."""
    for quarter in range(4):
        theta = (theta_deg + 90.0 * quarter) % 360.0
        turn = room_axes(theta)[:2, :2]
        xy = ground @ turn.T
        if _wall_of(turn @ facing, _distances(xy, "clicks")) == "south":
            return theta
    return theta_deg


def _distances(xy: Floats, where: str) -> list[float]:
    """Return distances [m] from the camera to south, west, north and east."""
    parts = [-xy[xy[:, 1] < 0, 1], -xy[xy[:, 0] < 0, 0], xy[xy[:, 1] >= 0, 1], xy[xy[:, 0] >= 0, 0]]
    if any(len(part) == 0 for part in parts):
        raise InputError(
            where,
            "all floor corners are on one side of the camera",
            "three corners of the floor around the camera",
            "click a floor corner on the other side",
        )
    return [float(part.mean()) for part in parts]


def _reach(xy: Floats, distances: Sequence[float], *, corner: bool = False) -> float:
    """Return the factor that extends a direction [2] to the wall or corner to which it points."""
    south, west, north, east = distances
    steps = [
        (east if xy[0] > 0 else west) / max(abs(float(xy[0])), 1e-9),
        (north if xy[1] > 0 else south) / max(abs(float(xy[1])), 1e-9),
    ]
    return float(np.mean(steps)) if corner else min(steps)


def _wall_of(xy: Floats, distances: Sequence[float]) -> str:
    point = xy * _reach(xy, distances)
    south, west, north, east = distances
    gaps = {"south": point[1] + south, "west": point[0] + west}
    gaps |= {"north": north - point[1], "east": east - point[0]}
    return min(gaps, key=lambda wall: abs(gaps[wall]))


def _on_wall(ray: Floats, wall: str, distances: Sequence[float]) -> tuple[float, float]:
    """Return where a ray meets a wall's plane [m]: along the wall, and above the camera."""
    axis, sign = _PLANES[wall]
    factor = sign * distances[_WALLS.index(wall)] / ray[axis]
    return float(ray[1 - axis] * factor), float(ray[2] * factor)


def _side(
    click: Click,
    ray: Floats,
    distances: Sequence[float],
    walls: dict[int, str],
    numbers: Sequence[int],
    values: Sequence[float],
    h: float,
) -> tuple[int, int, int]:
    if click.window == 0:
        return (1 if ray[0] > 0 else 0), (1 if ray[1] > 0 else 0), -1
    place = numbers.index(click.window)
    along, up = _on_wall(ray, walls[click.window], distances)
    left, right, low, high = values[6 + 4 * place : 10 + 4 * place]
    return int(along > (left + right) / 2), int(up + h > (low + high) / 2), place


def _fit(start: _Start, clicks: Sequence[Click], grid: ClickGrid, h: float) -> ClickedRoom:
    from scipy.optimize import least_squares

    used = [k for k, click in enumerate(clicks) if click.kind in ("floor", "ceiling", "window")]
    wanted = np.array([(clicks[k].x_px, clicks[k].y_px) for k in used])

    def residual(values: Floats) -> Floats:
        points = np.array([_point(values, start, clicks[k], start.sides[k], h) for k in used])
        off = grid.pixels(points @ room_axes(values[0])) - wanted
        off[:, 0] = (off[:, 0] + grid.width_px / 2) % grid.width_px - grid.width_px / 2
        return off.ravel()

    # a gross click must not bend the room: beyond some pixels its weight falls
    solution = least_squares(residual, start.values, loss="soft_l1", f_scale=2.0)
    off = residual(solution.x).reshape(-1, 2)
    jacobian = np.asarray(solution.jac)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * CLICK_PX**2
    distance = np.hypot(off[:, 0], off[:, 1])
    notes = [
        f"{clicks[k].kind} click {clicks[k].line} is {distance[i]:.1f} px from the fitted room"
        for i, k in enumerate(used)
        if distance[i] > _MISFIT_PX
    ]
    room, u = _room(solution.x, covariance, start, clicks, grid, h)
    return ClickedRoom(room, u, float(np.sqrt((off**2).mean())), tuple(notes))


def _point(
    values: Floats, start: _Start, click: Click, side: tuple[int, int, int], h: float
) -> Floats:
    """Return a click's point in room axes [m], relative to the camera."""
    south, west, north, east, height = values[1:6]
    if click.window == 0:
        z = -h if click.kind == "floor" else height - h
        return np.array([east if side[0] else -west, north if side[1] else -south, z])
    wall = start.walls[click.window]
    axis, sign = _PLANES[wall]
    part = values[6 + 4 * side[2] : 10 + 4 * side[2]]
    point = np.zeros(3)
    point[axis] = sign * values[1 + _WALLS.index(wall)]
    point[1 - axis] = part[side[0]]
    point[2] = part[2 + side[1]] - h
    return point


def _room(
    values: Floats,
    covariance: Floats,
    start: _Start,
    clicks: Sequence[Click],
    grid: ClickGrid,
    h: float,
) -> tuple[Room, dict[str, float]]:
    """Return the room as a `Room`, and the uncertainty of each length."""
    count = len(values)
    rows: dict[str, Floats] = {}  # each figure as a linear form of the values

    def form(**parts: float) -> Floats:
        row = np.zeros(count)
        for name, factor in parts.items():
            row[int(name[1:])] = factor
        return row

    rows["wall_azimuth_deg"] = form(v0=1.0)
    rows["width_m"], rows["depth_m"] = form(v2=1.0, v4=1.0), form(v1=1.0, v3=1.0)
    rows["height_m"] = form(v5=1.0)
    rows["camera_x_m"], rows["camera_y_m"] = form(v2=1.0), form(v1=1.0)
    numbers = _numbers(clicks)
    for place, number in enumerate(numbers):
        k, wall = 6 + 4 * place, start.walls[number]
        # left_m runs from the left end seen from inside: the high end for south and east
        end = {"south": 4, "east": 3, "north": 2, "west": 1}[wall]
        far = wall in ("south", "east")
        row = np.zeros(count)
        row[end], row[k + 1 if far else k] = 1.0, -1.0 if far else 1.0
        name = f"window.{place}."
        rows[name + "left_m"] = row
        rows[name + "width_m"] = form(**{f"v{k + 1}": 1.0, f"v{k}": -1.0})
        rows[name + "sill_m"] = form(**{f"v{k + 2}": 1.0})
        rows[name + "height_m"] = form(**{f"v{k + 3}": 1.0, f"v{k + 2}": -1.0})
    figure = {name: float(row @ values) for name, row in rows.items()}
    u = {name: float(np.sqrt(row @ covariance @ row)) for name, row in rows.items()}
    windows = tuple(
        _window(place, number, figure, start, clicks, values, grid, h)
        for place, number in enumerate(numbers)
    )
    room = Room(
        width_m=round(figure["width_m"], 4),
        depth_m=round(figure["depth_m"], 4),
        height_m=round(figure["height_m"], 4),
        camera_x_m=round(figure["camera_x_m"], 4),
        camera_y_m=round(figure["camera_y_m"], 4),
        camera_z_m=h,
        wall_azimuth_deg=round(figure["wall_azimuth_deg"] % 360.0, 3),
        window=windows,
    )
    return room, u


def _window(
    place: int,
    number: int,
    figure: dict[str, float],
    start: _Start,
    clicks: Sequence[Click],
    values: Floats,
    grid: ClickGrid,
    h: float,
) -> Window:
    wall: Any = start.walls[number]
    bars = sum(click.kind == "bar" and click.window == number for click in clicks)
    axes, distances = room_axes(values[0]), values[1:5].tolist()
    transoms = [
        h + _on_wall(axes @ direction(*grid.angles(c.x_px, c.y_px)), wall, distances)[1]
        for c in clicks
        if c.kind == "transom" and c.window == number
    ]
    name = f"window.{place}."
    lengths = {
        key: round(figure[name + key], 4) for key in ("left_m", "width_m", "sill_m", "height_m")
    }
    lengths["left_m"], lengths["sill_m"] = max(lengths["left_m"], 0.0), max(lengths["sill_m"], 0.0)
    transom = round(float(np.mean(transoms)), 4) if transoms else 0.0
    return Window(wall, **lengths, panes=bars + 1, transom_m=transom)
