"""Fit a box room to clicks on its corners in a panorama, with the camera's height as the scale.

The camera's height above the floor gives the scale: a floor corner under a known angle is at a
known distance. All clicks are then fitted together, so that each length has the uncertainty that
the pixels of the clicks give it. Which corner a click means follows from its direction; the wall of
window 1 becomes the room's "south" wall.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np

from fieldlum.core import strict_csv, strict_toml
from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.core.records import Room, Window
from fieldlum.optics.projection import altitude_azimuth_deg, direction, equirect_pixel
from fieldlum.room.scene.box_room import FROM_HIGH_END, WALLS, room_axes

# standard uncertainty of a careful click on a zoomed picture; chosen, not measured with people
CLICK_PX = 0.5
# a click farther than this from the fitted room gets a note: six times `CLICK_PX`; chosen
_MISFIT_PX = 3.0
_HORIZON_DEG = 0.5  # a corner nearer to the horizon is no corner of floor or ceiling; chosen
_MIN_WINDOW_M = 0.02  # corners closer than this are one corner; chosen
# walls that are turned by less are the same walls by a better compass; chosen
_SAME_WALLS_DEG = 5.0
_BARS = ("bar", "transom")  # kinds of clicks that mean no corner

Kind = Literal["floor", "ceiling", "window", "bar", "transom"]
KINDS: tuple[Kind, ...] = ("floor", "ceiling", "window", "bar", "transom")
COLUMNS = ("kind", "window", "x_px", "y_px")


@dataclass(frozen=True, slots=True)
class Click:
    """A click on a panorama, on a corner, a bar or a transom of a room.

    kind: floor, ceiling or window for one of its corners, bar or transom. window: number from 1, 0
    for corners of the room. x_px, y_px: to the right and down from the panorama's upper left
    corner. line: of the csv, or the number of the click from 1.
    """

    kind: Kind
    window: int
    x_px: float
    y_px: float
    line: int = 0


@dataclass(frozen=True, slots=True)
class ClickGrid:
    """Size of the panorama with the clicks, and azimuth of its middle, clockwise from north."""

    height_px: int
    width_px: int
    heading_deg: float

    def angles(self, x_px: float, y_px: float) -> tuple[float, float]:
        """Return altitude and azimuth [deg] of a pixel position.

        The azimuth is clockwise from north, in [0, 360).
        """
        azimuth = self.heading_deg + (x_px / self.width_px - 0.5) * 360.0
        return 90.0 - y_px / self.height_px * 180.0, azimuth % 360.0

    def ray(self, click: Click) -> Floats:
        """Return the direction of a click, a unit vector [3]: x east, y north, z up."""
        return direction(*self.angles(click.x_px, click.y_px))

    def pixels(self, points: Floats) -> Floats:
        """Return pixel positions (x, y) [n, 2] of directions [n, 3] (x east, y north, z up)."""
        angles = altitude_azimuth_deg(points / np.linalg.norm(points, axis=1, keepdims=True))
        row, column = equirect_pixel(*angles, self.height_px, self.width_px, self.heading_deg)
        return np.stack([column, row], axis=1)


def read_clicks(path: Path) -> list[Click]:
    """Read a csv with exactly the columns kind, window, x_px, y_px, in this order.

    Raises InputError for a file that cannot be read, other columns, or a wrong cell (with its
    line).
    """
    expected, remedy = "a csv of clicks", "check the path of the csv"
    table = strict_csv.read_table(path, expected, remedy)
    if table.names != COLUMNS:
        found = f"columns {','.join(table.names)[:80]}"
        expected = f"exactly the columns {','.join(COLUMNS)} in this order"
        remedy = "correct the first line and the order of the columns"
        raise InputError(path, found, expected, remedy)
    return [_click(f"{path}:{line}", line, row) for line, row in table.dicts()]


def clicks_from_rows(rows: Any) -> list[Click]:
    """Return the clicks of a page's list of at most 500 dicts (keys: kind, window, x_px, y_px).

    Raises InputError for anything else.
    """
    if not isinstance(rows, list) or len(rows) > 500:
        found, expected = "no list, or over 500 clicks", "a list of at most 500 clicks"
        raise InputError("clicks", found, expected, "load the page again, and click fewer corners")
    return [_click(f"click {k}", k, row) for k, row in enumerate(rows, start=1)]


def _click(where: str, line: int, row: Any) -> Click:
    """Return a click from a table's row or a page's dict. Raises InputError for a wrong cell.

    where: the place that the error names; line: of the csv, or the number of the click.
    """
    expected = f"a kind of {', '.join(KINDS)}; numbers x_px and y_px; 1 to 50 for a window"
    try:
        click = strict_toml.convert({**row, "window": row.get("window") or 0, "line": line}, Click)
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(where, str(error)[:120], expected, "correct the click") from None
    if (click.kind in ("floor", "ceiling")) != (click.window == 0) or not 0 <= click.window <= 50:
        found = f"kind {click.kind} with window number {click.window}"
        raise InputError(where, found, expected, "correct the window's number")
    return click


@dataclass(frozen=True, slots=True)
class ClickedRoom:
    """A room that was fitted to clicks.

    room : lengths [m]. u : standard uncertainty of each length or angle by name [m, deg]; names are
    fields of `Room`, such as width_m, and window.K.FIELD for fields of window K (from 0), such as
    window.0.left_m. misfit_px : rms over the clicks on corners. notes : one sentence for each click
    more than 3 px from the fitted room, and for what of an earlier room is doubtful or left out.
    """

    room: Room
    u: dict[str, float]
    misfit_px: float
    notes: tuple[str, ...]


def room_from_clicks(
    clicks: Sequence[Click],
    grid: ClickGrid,
    camera_height_m: float,
    earlier: Room | None = None,
    *,
    where: str = "clicks",
) -> ClickedRoom:
    """Fit a box room to clicks on its corners in a panorama.

    camera_height_m : of the lens above the floor, 0.05 to 50 m. earlier : a room that, if it is a
    box, states what clicks do not measure. where : the source that errors name. A room needs three
    floor corners around the camera, one ceiling corner, and two opposite corners of each window.
    The wall of the window with the lowest number becomes the "south" wall. Raises InputError for
    fewer corners, for clicks that cannot be such corners, and for another camera height.
    """
    _check(clicks, grid, where)
    if not 0.05 <= camera_height_m <= 50.0:
        found = f"camera height {camera_height_m:g} m"
        raise InputError(where, found, "0.05 to 50 m", "measure the lens above the floor")
    start, corners = _start(clicks, grid, camera_height_m, where)
    clicked = _fit(start, corners, clicks, grid, camera_height_m)
    return _with_known(clicked, earlier) if earlier and earlier.kind == "box" else clicked


def _check(clicks: Sequence[Click], grid: ClickGrid, where: str) -> None:
    """Raise InputError for a click off the panorama or the wrong side of the horizon, or too few.

    grid: from pixels to directions; where: the file, for the error.
    """
    for click in clicks:
        place = f"{where}:{click.line}"
        if not (0 <= click.x_px <= grid.width_px and 0 <= click.y_px <= grid.height_px):
            found = f"a click at x {click.x_px:g}, y {click.y_px:g} px"
            expected = f"a click within {grid.width_px} x {grid.height_px} px"
            remedy = "click on the panorama, or correct x_px and y_px"
            raise InputError(place, found, expected, remedy)
        altitude, _ = grid.angles(click.x_px, click.y_px)
        sign = {"floor": -1.0, "ceiling": 1.0}.get(click.kind, 0.0)  # of the corner's altitude
        if sign and altitude * sign < _HORIZON_DEG:
            found = f"a {click.kind} corner at an altitude of {altitude:+.1f} deg"
            limit = f"{'below' if sign < 0 else 'above'} {sign * _HORIZON_DEG:+g} deg"
            remedy = "correct the kind of this click, or its place"
            raise InputError(place, found, f"an altitude {limit}", remedy)
    count = {kind: sum(click.kind == kind for click in clicks) for kind in KINDS}
    if count["floor"] < 3 or count["ceiling"] < 1:
        found = f"{count['floor']} floor and {count['ceiling']} ceiling corners"
        expected = "three corners of the floor and one of the ceiling"
        raise InputError(where, found, expected, "click more corners")
    for number in _numbers(clicks):
        corners = sum(click.kind == "window" and click.window == number for click in clicks)
        if corners < 2:
            found, expected = f"window {number} has {corners} corners", "two opposite corners"
            raise InputError(where, found, expected, "click the missing corner")


def _numbers(clicks: Sequence[Click]) -> list[int]:
    """Return the numbers of the clicked windows, ascending."""
    return sorted({click.window for click in clicks if click.window})


class _Corner(NamedTuple):
    """The corner that a click means.

    wall: of its window, "" for a corner of the room; place: index of the window from 0; ends: 0 or
    1 for the low or high end of x, y and z, or for a window of its width (from the left) and
    height; between 0 and 1 for its bars.
    """

    wall: str
    place: int
    ends: tuple[float, ...]

    def point(self, values: Floats, camera_height_m: float) -> Floats:
        """Return the corner in room axes [m], relative to the camera.

        values: azimuth of the "south" wall [deg], then width, depth, height, camera x, camera y,
        and left, width, sill, height of each window [m]. camera_height_m: above the floor.
        """
        size, camera = values[1:4], np.array([values[4], values[5], camera_height_m])
        if not self.wall:
            return np.array(self.ends) * size - camera
        axis, side = WALLS[self.wall]
        left, width, sill, height = values[6 + 4 * self.place : 10 + 4 * self.place]
        along = left + self.ends[0] * width
        point = np.zeros(3)
        point[axis] = side * size[axis]
        point[1 - axis] = size[1 - axis] - along if self.wall in FROM_HIGH_END else along
        point[2] = sill + self.ends[1] * height
        return point - camera


def _start(
    clicks: Sequence[Click], grid: ClickGrid, camera_height_m: float, where: str
) -> tuple[Floats, list[_Corner | None]]:
    """Return a first guess of the values of `_Corner.point`, and the corner that each click means.

    A click on a bar or transom means no corner. grid: from pixels to directions; camera_height_m:
    above the floor; where: the file, for the error.
    """
    rays = np.array([grid.ray(click) for click in clicks])
    floor = np.array([click.kind == "floor" for click in clicks])
    ground = rays[floor, :2] * (camera_height_m / -rays[floor, 2])[:, None]  # [n, 2] east, north
    turn_deg = min(np.arange(0.0, 90.0, 0.5).tolist(), key=lambda turn: _spread(ground, turn))
    window = np.array([click.window if click.kind == "window" else 0 for click in clicks])
    numbers = _numbers(clicks)
    first = window == min(numbers, default=-1)
    facing = rays[first, :2].sum(axis=0) if first.any() else direction(0.0, grid.heading_deg)[:2]
    azimuth_deg = _main_wall(ground, turn_deg, facing)
    distances = _distances(ground @ room_axes(azimuth_deg)[:2, :2].T, where)
    rays = rays @ room_axes(azimuth_deg).T
    south, west, north, east = distances
    ceiling = [ray for ray, click in zip(rays, clicks, strict=True) if click.kind == "ceiling"]
    above_m = [float(np.mean(_factors(ray[:2], distances))) * ray[2] for ray in ceiling]
    height_m = camera_height_m + float(np.mean(above_m))
    values, corners = [azimuth_deg, west + east, south + north, height_m, west, south], []
    for ray, click in zip(rays, clicks, strict=True):
        ends = (float(ray[0] > 0), float(ray[1] > 0), float(click.kind == "ceiling"))
        corners.append(_Corner("", 0, ends) if click.kind in ("floor", "ceiling") else None)
    camera = (*values[4:6], camera_height_m)
    for place, number in enumerate(numbers):
        own = np.flatnonzero(window == number)
        wall = _wall_of(rays[own, :2].sum(axis=0), distances)
        at = np.array([_on_wall(rays[k], wall, values[1:3], camera) for k in own])
        low, span = at.min(axis=0), np.ptp(at, axis=0)  # [2] along the wall and in height
        if span.min() < _MIN_WINDOW_M:
            found = f"the corners of window {number} have no width or no height"
            remedy = "click its opposite corners again"
            raise InputError(where, found, "two opposite corners at least", remedy)
        values += [low[0], span[0], low[1], span[1]]
        for k, ends in zip(own, (at > low + span / 2).astype(float), strict=True):
            corners[k] = _Corner(wall, place, tuple(ends))
    return np.array(values, float), corners


def _spread(ground: Floats, azimuth_deg: float) -> float:
    """Return how far floor corners are from the lines of four walls, as a sum of squares [m2].

    ground: corners, east and north of the camera [n, 2] m; azimuth_deg: of the "south" wall.
    Corners on one side of the camera, along x or y, belong to one wall.
    """
    xy = ground @ room_axes(azimuth_deg)[:2, :2].T
    parts = [x[side] for x in xy.T for side in (x < 0, x >= 0)]
    return sum(float(((x - x.mean()) ** 2).sum()) if len(x) else 1e6 for x in parts)


def _main_wall(ground: Floats, azimuth_deg: float, facing: Floats) -> float:
    """Return the azimuth of the wall, of four, that is in the direction `facing` from the camera.

    ground: floor corners, east and north of the camera [n, 2] m; azimuth_deg: of one wall; facing:
    east and north [2].
    """
    for azimuth in (azimuth_deg + np.arange(0.0, 360.0, 90.0)).tolist():
        turn = room_axes(azimuth)[:2, :2]
        if _wall_of(turn @ facing, _distances(ground @ turn.T, "clicks")) == "south":
            return azimuth % 360.0
    return azimuth_deg


def _distances(xy: Floats, where: str) -> list[float]:
    """Return the distances [m] from the camera to the south, west, north and east wall.

    xy: floor corners in room axes, from the camera [n, 2] m. Raises InputError if all are on one
    side of it; where: the file, for the error.
    """
    parts = [-xy[xy[:, 1] < 0, 1], -xy[xy[:, 0] < 0, 0], xy[xy[:, 1] >= 0, 1], xy[xy[:, 0] >= 0, 0]]
    if any(len(part) == 0 for part in parts):
        found = "all floor corners are on one side of the camera"
        expected = "three corners of the floor around the camera"
        raise InputError(where, found, expected, "click a floor corner on the other side")
    return [float(part.mean()) for part in parts]


def _factors(xy: Floats, distances: Sequence[float]) -> tuple[float, float]:
    """Return the factors that extend a direction [2] to the walls across x and y that it meets.

    distances: by `_distances`.
    """
    south, west, north, east = distances
    across_x = (east if xy[0] > 0 else west) / max(abs(float(xy[0])), 1e-9)
    across_y = (north if xy[1] > 0 else south) / max(abs(float(xy[1])), 1e-9)
    return across_x, across_y


def _wall_of(xy: Floats, distances: Sequence[float]) -> str:
    """Return the wall that the camera sees in a direction [2], in room axes."""
    across_x, across_y = _factors(xy, distances)
    if across_x < across_y:  # the wall across x is met first
        return "east" if xy[0] > 0 else "west"
    return "north" if xy[1] > 0 else "south"


def _on_wall(
    ray: Floats, wall: str, size: Floats | Sequence[float], camera: Sequence[float]
) -> tuple[float, float]:
    """Return where a ray meets a wall: from its left end, seen from inside, and from the floor [m].

    ray: direction from the camera in room axes [3]; size: width and depth of the room [m]; camera:
    its x, y, z [m].
    """
    axis, side = WALLS[wall]
    factor = (side * size[axis] - camera[axis]) / ray[axis]
    along = camera[1 - axis] + ray[1 - axis] * factor
    along = size[1 - axis] - along if wall in FROM_HIGH_END else along
    return float(along), float(camera[2] + ray[2] * factor)


def _fit(
    start: Floats,
    corners: Sequence[_Corner | None],
    clicks: Sequence[Click],
    grid: ClickGrid,
    camera_height_m: float,
) -> ClickedRoom:
    """Return the room whose corners are nearest to the clicks, by robust least squares in pixels.

    start [6 + 4 w]: azimuth of the "south" wall [deg], then width, depth, height, camera x, camera
    y, and left, width, sill, height of each of w windows [m]; corners: the corner that each click
    means, None for a click that means none; camera_height_m: above the floor. Uncertainties follow
    from `CLICK_PX`.
    """
    from scipy.optimize import least_squares

    used = [(click, c) for click, c in zip(clicks, corners, strict=True) if c is not None]

    def residuals_px(values: Floats) -> Floats:
        return _off_px(used, values, grid, camera_height_m).ravel()

    # a gross click must not bend the room: beyond some pixels its weight falls
    solution = least_squares(residuals_px, start, loss="soft_l1", f_scale=2.0)
    jacobian = np.asarray(solution.jac)
    u = np.sqrt(np.diag(np.linalg.pinv(jacobian.T @ jacobian))) * CLICK_PX
    walls: dict[int, Any] = {corner.place: corner.wall for _, corner in used if corner.wall}
    names = [*_LENGTHS, *(f"window.{k}.{name}" for k in sorted(walls) for name in _WINDOW_LENGTHS)]
    rounded = [round(value, 4) for value in solution.x.tolist()]
    windows, placed = [], [*used]
    for place, number in enumerate(_numbers(clicks)):
        own = [click for click in clicks if click.window == number and click.kind in _BARS]
        middle = _Corner(walls[place], place, (0.5, 0.5))
        panes, transom, bars = _bars(middle, own, solution.x, grid, camera_height_m)
        lengths = dict(zip(_WINDOW_LENGTHS, rounded[6 + 4 * place :][:4], strict=True))
        lengths |= {name: max(lengths[name], 0.0) for name in ("left_m", "sill_m")}
        above_m = round(lengths["sill_m"] + transom * lengths["height_m"], 4) if transom else 0.0
        windows.append(Window(walls[place], **lengths, panes=panes, transom_m=above_m))
        placed += bars
    off_px = np.hypot(*_off_px(placed, solution.x, grid, camera_height_m).T)
    text = ", where windows have equal panes and at most one transom"
    notes = [
        f"{click.kind} click {click.line} is {distance:.1f} px from the fitted room"
        f"{text if click.kind in _BARS else ''}"
        for (click, _), distance in zip(placed, off_px, strict=True)
        if distance > _MISFIT_PX
    ]
    lengths = dict(zip(_LENGTHS, [rounded[0] % 360.0, *rounded[1:6]], strict=True))
    room = Room(**lengths, camera_z_m=camera_height_m, window=tuple(windows))
    misfit_px = float(np.sqrt((off_px[: len(used)] ** 2).mean() / 2.0))  # of x and y
    return ClickedRoom(room, dict(zip(names, u.tolist(), strict=True)), misfit_px, tuple(notes))


_LENGTHS = ("wall_azimuth_deg", "width_m", "depth_m", "height_m", "camera_x_m", "camera_y_m")
_WINDOW_LENGTHS = ("left_m", "width_m", "sill_m", "height_m")
_Placed = tuple[Click, _Corner]  # a click, and where the fitted room has what it means


def _off_px(
    placed: Sequence[_Placed], values: Floats, grid: ClickGrid, camera_height_m: float
) -> Floats:
    """Return how far n corners are to the right of their clicks, and below them, [n, 2] px.

    values, camera_height_m: see `_Corner.point`; grid: from pixels to directions.
    """
    points = np.array([corner.point(values, camera_height_m) for _, corner in placed])
    off = grid.pixels(points @ room_axes(values[0])) - [(c.x_px, c.y_px) for c, _ in placed]
    # across the panorama's edge, the shorter way
    off[:, 0] = (off[:, 0] + grid.width_px / 2) % grid.width_px - grid.width_px / 2
    return off


def _bars(
    window: _Corner, clicks: Sequence[Click], values: Floats, grid: ClickGrid, height_m: float
) -> tuple[int, float, list[_Placed]]:
    """Return a window's number of panes, its transom, and the places of clicks on its bars.

    The transom is a share of the window's height, 0 for none. Panes are equal: of the numbers for
    which each bar has a click, that one is taken whose bars are nearest to the clicks. Of several
    transoms the middle one is taken. Clicks over 3 px outside of the window, or on its frame, count
    as none. window: any place in it; values, height_m: see `_Corner.point`, of the camera.
    """
    if not clicks:
        return 1, 0.0, []
    axes, camera = room_axes(values[0]), (values[4], values[5], height_m)
    left, width, sill, height = values[6 + 4 * window.place :][:4]
    rays = [grid.ray(click) @ axes.T for click in clicks]
    at = np.array([_on_wall(ray, window.wall, values[1:3], camera) for ray in rays])  # [n, 2]
    ends = np.clip((at - (left, sill)) / (width, height), 0.0, 1.0)

    def placed() -> list[_Placed]:
        corners = [window._replace(ends=tuple(end)) for end in ends.tolist()]
        return list(zip(clicks, corners, strict=True))

    is_bar = np.array([click.kind == "bar" for click in clicks])
    across = np.where(is_bar, *ends.T)  # a bar's place along the window, a transom's in height
    near = np.hypot(*_off_px(placed(), values, grid, height_m).T) <= _MISFIT_PX
    bars, transoms = (kind & near & (across > 0) & (across < 1) for kind in (is_bar, ~is_bar))

    def nearest(panes: int) -> Floats:
        """Return the place of the bar between equal panes that is nearest to each click."""
        return np.clip(np.rint(across[bars] * panes), 1, panes - 1) / panes

    def misfit(panes: int) -> tuple[bool, float]:
        """Return whether a bar has no click, and the largest distance of a click from a bar."""
        off = np.abs(across[bars] - nearest(panes))
        return len(np.unique(nearest(panes))) < panes - 1, float(off.max())

    panes = min(range(2, int(bars.sum()) + 2), key=misfit, default=1)
    ends[bars, 0] = nearest(panes)
    heights = np.sort(across[transoms])
    ends[transoms, 1] = transom = float(heights[(len(heights) - 1) // 2]) if len(heights) else 0.0
    return panes, transom, placed()


# ----------------------------------------------------------------------------------------------
# earlier room


_BOX = ("x_m", "y_m", "z_m", "width_m", "depth_m", "height_m")  # fields of `Obstruction`


def _with_known(clicked: ClickedRoom, earlier: Room) -> ClickedRoom:
    """Return a clicked room with what clicks do not measure, such as reflectances, from a box room.

    A window has transmittance and frame_m of the earlier window that is seen nearest to it, and its
    panes and transom_m too if no bar was clicked. If another earlier window is about as near, or
    none is near, it has no bars of an earlier one, and a note names it. Obstructions stay where
    they are from the camera, parallel to the walls; if the walls are not turned by quarters, they
    are left out, and a note names them.
    """
    room, notes, windows = clicked.room, [*clicked.notes], [*clicked.room.window]
    glass = [(window.transmittance, window.frame_m) for window in earlier.window]
    for k, window in enumerate(windows if glass else ()):
        off_rad = np.arccos(np.clip(_window_rays(earlier) @ _window_rays(room)[k], -1.0, 1.0))
        near = int(off_rad.argmin())
        was = earlier.window[near]
        known = {"transmittance": was.transmittance, "frame_m": was.frame_m}
        if 2 * off_rad[near] > off_rad[[other != glass[near] for other in glass]].min(initial=1.0):
            notes.append(
                f"window {k + 1}: check {' and '.join(known)}, of window {near + 1} before"
            )
        elif (window.panes, window.transom_m) == (1, 0.0):  # no bar was clicked
            is_inside = 0.0 < was.transom_m - window.sill_m < window.height_m
            known |= {"panes": was.panes, "transom_m": was.transom_m if is_inside else 0.0}
        windows[k] = replace(window, **known)
    turn = room_axes(room.wall_azimuth_deg) @ room_axes(earlier.wall_azimuth_deg).T
    quarters, boxes = np.rint(turn), []
    is_turned = np.abs(turn - quarters).max() > np.sin(np.radians(_SAME_WALLS_DEG))
    camera, new_camera = (np.array([r.camera_x_m, r.camera_y_m, 0.0]) for r in (earlier, room))
    for k, box in enumerate(earlier.obstruction, start=1):
        low, size = np.array([getattr(box, name) for name in _BOX]).reshape(2, 3)
        if is_turned:
            at = f"{box.x_m:g}, {box.y_m:g} m"
            notes.append(f"obstruction {k} at {at} is left out, because the walls have turned")
            continue
        ends = ([low, low + size] - camera) @ quarters.T + new_camera
        new = np.concatenate([ends.min(axis=0), np.ptp(ends, axis=0)]).round(4).tolist()
        boxes.append(replace(box, **dict(zip(_BOX, new, strict=True))))
    measured = {name: getattr(room, name) for name in (*_LENGTHS, "camera_z_m")}
    new_room = replace(earlier, **measured, window=tuple(windows), obstruction=tuple(boxes))
    return replace(clicked, room=new_room, notes=tuple(notes))


def _window_rays(room: Room) -> Floats:
    """Return the directions from the camera to the middles of a room's n windows, [n, 3].

    They are unit vectors: x east, y north, z up.
    """
    owners = [(room, _LENGTHS), *((window, _WINDOW_LENGTHS) for window in room.window)]
    values = np.array([getattr(owner, name) for owner, names in owners for name in names])
    middles = [_Corner(window.wall, k, (0.5, 0.5)) for k, window in enumerate(room.window)]
    points = np.array([middle.point(values, room.camera_z_m) for middle in middles])
    return points / np.linalg.norm(points, axis=1, keepdims=True) @ room_axes(values[0])
