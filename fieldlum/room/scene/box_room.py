"""Describe a box room by axis-aligned boxes and glass panes, in room coordinates.

x is to the right and y away from the "south" wall, as seen from inside facing "north"; z is up.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, pairwise
from typing import NamedTuple, TypeGuard

import numpy as np

from fieldlum.core.arrays import ArrayLike, Floats, Mask
from fieldlum.core.errors import InputError
from fieldlum.core.records import Room, Window
from fieldlum.optics.projection import compass_name

SLAB_M = 0.05  # thickness of the floor: the ground is this much lower. Chosen, not measured.
ROOF_M = 0.3  # thickness of the roof. Chosen, not measured.
# the ground is modelled this far around the room, with an open plain beyond; chosen
GROUND_REACH_M = 60.0
_ROUNDING_M = 1e-9  # 1.1 + 2.2 is 3.3 m, although their binary sum is larger
INDEX = 1.52  # refractive index of glass, as in Radiance's m_glass.c

Span = tuple[float, float]  # lower and upper end along an axis, m

# name: (axis of the wall's normal, side: 0 at the low end or 1 at the high end)
WALLS = {"south": (1, 0), "north": (1, 1), "west": (0, 0), "east": (0, 1)}
# Walls whose left end, seen from inside, is the high end of x or y.
FROM_HIGH_END = ("south", "east")
# Turn of each wall's outward normal from the "south" wall, clockwise [deg].
WALL_TURN_DEG = {"south": 0.0, "west": 90.0, "north": 180.0, "east": 270.0}


def turned(matrix: ArrayLike, vectors: ArrayLike) -> Floats:
    """Return matrix [3, 3] times each of the direction vectors [..., 3]."""
    # Three products, added in the order x, y, z: a BLAS library adds in another order for another
    # number of rows, and files that a resumed run writes again must be equal bit by bit.
    rows = np.asarray(matrix, np.float64)
    x, y, z = np.moveaxis(np.asarray(vectors, np.float64), -1, 0)
    return np.stack([r[0] * x + r[1] * y + r[2] * z for r in rows], axis=-1)


def transmissivity(transmittance: float) -> float:
    """Return the transmissivity (0 to 1) that Radiance's glass needs for a transmittance.

    transmittance : of the pane at normal incidence. Source: Radiance's materials manual, "glass".
    """
    if transmittance <= 0.0:
        return 0.0
    root = np.sqrt(0.8402528435 + 0.0072522239 * transmittance**2)
    return float((root - 0.9166530661) / 0.0036261119 / transmittance)


def glass_optics(transmittance: float, cosine: ArrayLike) -> tuple[Floats, Floats]:
    """Return transmittance and reflectance of a pane at an angle of incidence, 0 to 1, [...] each.

    transmittance : at normal incidence. cosine : of the angle of incidence [...]. Source:
    Radiance's m_glass.c.
    """
    outside = np.maximum(np.abs(np.asarray(cosine, float)), 1e-6)  # cosines in air and in glass
    within = np.sqrt((1 - 1 / INDEX**2) + (outside / INDEX) ** 2)
    path = transmissivity(transmittance) ** (1 / within)  # the share that one way through leaves
    passed, mirrored = np.zeros_like(outside), np.zeros_like(outside)
    # Fresnel's reflectance r of one face for both polarisations, with all bounces between the faces
    for a, b in ((outside, INDEX * within), (1 / outside, INDEX / within)):
        r = ((a - b) / (a + b)) ** 2
        passed += 0.5 * (1 - r) ** 2 * path / (1 - (r * path) ** 2)
        mirrored += 0.5 * r * (1 + (1 - 2 * r) * path**2) / (1 - (r * path) ** 2)
    return passed, mirrored


class Box(NamedTuple):
    """An opaque matt box from corner `low` to corner `high`.

    low, high: (x, y, z) in m, in room axes. reflectance: 0 to 1. kind: floor, ceiling, wall,
    frame, obstruction or ground.
    """

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    reflectance: float
    kind: str


@dataclass(frozen=True, slots=True)
class Opening:
    """The hole of a window through its wall, and the pane in it.

    axis: of the wall's normal, 0 for x and 1 for y; outward: -1 or 1, the direction out of the
    room along that axis. inner_m, outer_m: coordinates of the wall's inside and outside face
    along that axis. u_m: from and to along the wall, in x or y; z_m: from and to in height.
    transmittance: of the pane.
    """

    axis: int
    outward: int
    inner_m: float
    outer_m: float
    u_m: Span
    z_m: Span
    transmittance: float

    @property
    def pane_m(self) -> float:
        """Coordinate of the pane, in the middle of the wall."""
        return (self.inner_m + self.outer_m) / 2

    @property
    def along(self) -> int:
        """Index of the horizontal axis along the wall."""
        return 1 - self.axis

    def contains(self, u_m: Floats, z_m: Floats) -> Mask:
        """Return a mask [n], True for points in the opening: u_m along the wall, z_m height."""
        (left, right), (bottom, top) = self.u_m, self.z_m
        return (u_m > left) & (u_m < right) & (z_m > bottom) & (z_m < top)


def room_axes(wall_azimuth_deg: float) -> Floats:
    """Return a room's axes as rows in world coordinates, [3, 3]: room = axes @ world.

    World axes are x east, y north, z up. wall_azimuth_deg: azimuth that the room's south wall
    faces, clockwise from north.
    """
    azimuth = np.radians(wall_azimuth_deg)
    x = (-np.cos(azimuth), np.sin(azimuth), 0.0)  # azimuth - 90 degrees
    y = (-np.sin(azimuth), -np.cos(azimuth), 0.0)  # azimuth - 180 degrees
    return np.array([x, y, (0.0, 0.0, 1.0)])


@dataclass(frozen=True)
class BoxScene:
    """The boxes, openings and camera of a box room.

    camera_m: (x, y, z) in room axes. shell: the corners (low, high) of the building's outside.
    wall_azimuth_deg: of the "south" wall's outward normal, clockwise from north.
    """

    boxes: tuple[Box, ...]
    openings: tuple[Opening, ...]
    camera_m: tuple[float, float, float]
    shell: tuple[tuple[float, float, float], tuple[float, float, float]]
    wall_azimuth_deg: float

    @cached_property
    def low(self) -> Floats:
        """Lower corners of the boxes [b, 3], m."""
        return np.array([box.low for box in self.boxes], float)

    @cached_property
    def high(self) -> Floats:
        """Upper corners of the boxes [b, 3], m."""
        return np.array([box.high for box in self.boxes], float)

    @cached_property
    def reflectance(self) -> Floats:
        """Reflectances of the boxes, 0 to 1, [b]."""
        return np.array([box.reflectance for box in self.boxes])

    @cached_property
    def turn(self) -> Floats:
        """The room's axes as rows in world axes (`room_axes`), [3, 3]: room = turn @ world."""
        return room_axes(self.wall_azimuth_deg)

    def to_room(self, world: ArrayLike) -> Floats:
        """Return directions [..., 3] (x east, y north, z up) in room axes."""
        return turned(self.turn, world)

    def of_kind(self, *kinds: str) -> list[int]:
        """Return the indices of the boxes of some kinds (`Box.kind`), such as "wall" or "frame"."""
        return [k for k, box in enumerate(self.boxes) if box.kind in kinds]


# ----------------------------------------------------------------------------------------------
# building


def is_box_with_window(room: Room | None) -> TypeGuard[Room]:
    """Return whether a room is stated as a box with at least one window."""
    return room is not None and room.kind == "box" and bool(room.window)


def build(room: Room) -> BoxScene:
    """Build the floor, ceiling, walls, frames, obstructions, ground and openings of a box room.

    Raises InputError for a room of another kind, or an impossible one: a size of 0 or less, a
    window outside its wall, overlapping windows, a camera outside the room or inside an
    obstruction, a reflectance below 0 or not below 1, a transmittance not above 0 or over 0.92, or
    no pane.
    """
    for is_wrong, place, found, expected in _checks(room):
        if is_wrong:
            raise InputError(f"[room]{place}", found, expected, "correct the [room] of the site")
    openings = tuple(_opening(room, window) for window in room.window)
    _check_overlap(openings)
    wall_m = room.wall_thickness_m
    low = (-wall_m, -wall_m, -SLAB_M)  # corners of the building
    high = (room.width_m + wall_m, room.depth_m + wall_m, room.height_m + ROOF_M)
    boxes = [
        Box(low, (high[0], high[1], 0.0), room.reflectance_floor, "floor"),
        Box((low[0], low[1], room.height_m), high, room.reflectance_ceiling, "ceiling"),
        *(box for wall in WALLS for box in _wall_boxes(room, wall, openings)),
        *(box for pair in zip(room.window, openings, strict=True) for box in _frame(room, *pair)),
    ]
    for o in room.obstruction:
        far = (o.x_m + o.width_m, o.y_m + o.depth_m, o.z_m + o.height_m)
        boxes.append(Box((o.x_m, o.y_m, o.z_m), far, o.reflectance, "obstruction"))
    far = (room.width_m + GROUND_REACH_M, room.depth_m + GROUND_REACH_M, -SLAB_M)
    near = (-GROUND_REACH_M, -GROUND_REACH_M, -1.0)
    boxes.append(Box(near, far, room.reflectance_ground, "ground"))
    camera_m = (room.camera_x_m, room.camera_y_m, room.camera_z_m)
    return BoxScene(tuple(boxes), openings, camera_m, (low, high), room.wall_azimuth_deg)


def _checks(room: Room) -> Iterator[tuple[bool, str, str, str]]:
    """Yield the checks of a room: whether it is wrong, the place, what was found and expected."""
    size = np.array([room.width_m, room.depth_m, room.height_m])
    eye = np.array([room.camera_x_m, room.camera_y_m, room.camera_z_m])
    yield room.kind != "box", "", f"kind '{room.kind}'", "kind 'box'"
    flat = not (size > 0).all() or room.wall_thickness_m <= 0
    yield flat, "", "a size of zero or less", "width, depth, height and wall thickness above 0"
    inside = bool(((eye > 0) & (eye < size)).all())
    found = f"the camera at {tuple(eye.tolist())} m is outside the room"
    yield not inside, "", found, f"x, y, z between 0 and {tuple(size.tolist())} m, the room's size"
    for name in ("walls", "ceiling", "floor", "ground", "frame"):
        value = getattr(room, f"reflectance_{name}")
        yield not 0 <= value < 1, "", f"reflectance_{name} = {value:g}", "0 to below 1"
    for k, o in enumerate(room.obstruction, start=1):
        low, edges = np.array([o.x_m, o.y_m, o.z_m]), np.array([o.width_m, o.depth_m, o.height_m])
        place, found = f" obstruction {k}", f"reflectance = {o.reflectance:g}"
        yield not 0 <= o.reflectance < 1, place, found, "0 to below 1"
        yield bool((edges <= 0).any()), place, "a size of zero or less", "sizes above 0"
        within = bool(((low < eye) & (eye < low + edges)).all())
        yield within, place, "the camera is inside it", "a camera outside of all obstructions"
    for k, window in enumerate(room.window, start=1):
        is_wrong = not 0 < window.transmittance <= 0.92 or window.panes < 1
        found = f"transmittance {window.transmittance:g}, panes {window.panes}"
        expected = "transmittance above 0 up to .92 (clear float glass), panes 1 or more"
        yield is_wrong, f" window {k}", found, expected


def wall_named(wall: str, wall_azimuth_deg: float) -> str:
    """Return the name of a wall by the compass and in the room, such as ``N wall ("south")``.

    wall: its name in the room, a key of `WALLS`; wall_azimuth_deg: azimuth that the "south" wall
    faces, clockwise from north.
    """
    return f'{compass_name(wall_azimuth_deg + WALL_TURN_DEG[wall])} wall ("{wall}")'


def _opening(room: Room, window: Window) -> Opening:
    """Return the hole of a window in its wall.

    Raises InputError for a window that is not within its wall.
    """
    axis, side = WALLS[window.wall]
    length = room.width_m if axis == 1 else room.depth_m
    top = window.sill_m + window.height_m
    right = window.left_m + window.width_m
    fits = 0 <= window.left_m < right <= length + _ROUNDING_M
    if not fits or not 0 <= window.sill_m < top <= room.height_m + _ROUNDING_M:
        along = f"from {window.left_m:g} to {right:g} m along the wall"
        wall = wall_named(window.wall, room.wall_azimuth_deg)
        finding = f"a window {along}, {window.sill_m:g} to {top:g} m above the floor"
        expected = f"a window inside the {wall} of {length:g} x {room.height_m:g} m"
        raise InputError("[room]", finding, expected, "correct the window")
    high_end = length - window.left_m - window.width_m
    start = high_end if window.wall in FROM_HIGH_END else window.left_m
    inner, outer = _faces_m(room, window.wall)
    return Opening(
        axis,
        outward=2 * side - 1,
        inner_m=inner,
        outer_m=outer,
        u_m=(max(start, 0.0), min(start + window.width_m, length)),
        z_m=(window.sill_m, min(top, room.height_m)),
        transmittance=window.transmittance,
    )


def _faces_m(room: Room, wall: str) -> Span:
    """Return the coordinates of a wall's inner and outer face along the axis of its normal, m."""
    axis, side = WALLS[wall]
    inner = side * (room.width_m, room.depth_m)[axis]
    return inner, inner + (2 * side - 1) * room.wall_thickness_m


def _check_overlap(openings: tuple[Opening, ...]) -> None:
    """Raise InputError for two windows of one wall that overlap."""

    def overlap(first: Span, other: Span) -> bool:
        return first[0] < other[1] - _ROUNDING_M and other[0] < first[1] - _ROUNDING_M

    for (j, first), (k, other) in combinations(enumerate(openings, start=1), 2):
        same_wall = (first.axis, first.outward) == (other.axis, other.outward)
        if same_wall and overlap(first.u_m, other.u_m) and overlap(first.z_m, other.z_m):
            found, expected = f"windows {j} and {k} of one wall overlap", "separate windows"
            remedy = "correct left_m, width_m, sill_m or height_m"
            raise InputError("[room]", found, expected, remedy)


def _wall_boxes(room: Room, wall: str, openings: tuple[Opening, ...]) -> Iterator[Box]:
    """Yield a wall without its windows, as vertical strips between the windows' edges.

    openings: of all the room's windows; wall: one of `WALLS`. u is along the wall, n across it, z
    up. The ends of the strips are the reveals.
    """
    axis, side = WALLS[wall]
    holes = [o for o in openings if (o.axis, o.outward) == (axis, 2 * side - 1)]
    # South and north walls include the corners; west and east walls are between them.
    corner_m = room.wall_thickness_m
    first, last = (-corner_m, room.width_m + corner_m) if axis == 1 else (0.0, room.depth_m)
    n0, n1 = sorted(_faces_m(room, wall))
    edges = sorted({first, last, *(u for o in holes for u in o.u_m)})
    for u0, u1 in pairwise(edges):
        cut = sorted(o.z_m for o in holes if o.u_m[0] <= u0 and u1 <= o.u_m[1])
        levels = [0.0, *(z for hole in cut for z in hole), room.height_m]
        for z0, z1 in zip(levels[::2], levels[1::2], strict=True):
            if z1 > z0:
                yield upright(axis, (n0, n1), (u0, u1), (z0, z1), room.reflectance_walls, "wall")


def upright(axis: int, n: Span, u: Span, z: Span, reflectance: float, kind: str) -> Box:
    """Return a box by its extent across the wall, along it, and in height, (from, to) each [m].

    axis : index of the axis n across the wall, 0 x or 1 y; u : along the wall; z : height.
    reflectance : 0 to 1; kind : "floor", "ceiling", "wall", "frame", "obstruction" or "ground".
    """
    if axis == 1:
        return Box((u[0], n[0], z[0]), (u[1], n[1], z[1]), reflectance, kind)
    return Box((n[0], u[0], z[0]), (n[1], u[1], z[1]), reflectance, kind)


def _frame(room: Room, window: Window, o: Opening) -> Iterator[Box]:
    """Yield the boxes of a window's outer frame, of the bars between its panes and of its transom.

    o: the window's opening; n is across the wall, u along it, z up. Rails are between the outer
    posts.
    """
    posts, rails, half_m = window_bars(window, o, room.wall_thickness_m)
    n = (o.pane_m - half_m, o.pane_m + half_m)
    for u in posts:
        yield upright(o.axis, n, u, o.z_m, room.reflectance_frame, "frame")
    between = (o.u_m[0] + window.frame_m, o.u_m[1] - window.frame_m)
    for z in rails:
        yield upright(o.axis, n, between, z, room.reflectance_frame, "frame")


def window_bars(
    window: Window, opening: Opening, wall_thickness_m: float
) -> tuple[list[Span], list[Span], float]:
    """Return a window's posts (spans along the wall), its rails (in height), and half their depth.

    opening: of this window. Posts are the frame's two and those between panes, rails the frame's
    two and the transom; none without a frame. Each is as deep across the wall as it is wide, but at
    most 0.9 of the wall. All in m.
    """
    wide = window.frame_m
    if wide <= 0:
        return [], [], 0.0
    (u0, u1), (z0, z1) = opening.u_m, opening.z_m
    middles = [u0 + k * ((u1 - u0) / window.panes) for k in range(1, window.panes)]
    posts = [(u0, u0 + wide), (u1 - wide, u1)]
    posts += [(u - wide / 2, u + wide / 2) for u in middles]
    rails = [(z0, z0 + wide), (z1 - wide, z1)]
    if z0 < window.transom_m < z1:
        rails.append((window.transom_m - wide / 2, window.transom_m + wide / 2))
    return posts, rails, min(wide, 0.9 * wall_thickness_m) / 2
