"""Define what is fitted: a box room with windows, bars and solid boxes; north; and the clock.

Room axes: x to the right of the "south" wall as seen from outside, y away from that wall, z up, as
in `fieldlum.core.records.Room`. Lengths are in m, angles in degrees, the clock in minutes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Obstruction, Room, Window
from fieldlum.optics.projection import rotation
from fieldlum.room.scene.box_room import WALLS, Span, build, room_axes, upright, window_bars

# thinner solids and bars only explain noise; chosen
_THIN_SOLID_M, _THIN_BAR_M = 0.04, 0.01


@dataclass(frozen=True, slots=True)
class WindowRect:
    """A window's opening: its extent along the wall (u_m) and in height (z_m), in room axes.

    u is x in the "south" and "north" walls and y in the others. transmittance: of the glass.
    """

    wall: Literal["south", "west", "north", "east"]
    u_m: Span
    z_m: Span
    transmittance: float


@dataclass(frozen=True, slots=True)
class Bar:
    """A bar in a window, vertical if `upright`, else horizontal.

    window: index of its window from 0. span_m: from and to, across the bar's length: along the wall
    if upright, else in height. depth_m: from and to, outwards from the wall's inner face.
    """

    window: int
    upright: bool
    span_m: Span
    depth_m: Span


@dataclass(frozen=True, slots=True)
class Solid:
    """An opaque box in room axes, from corner `low_m` to corner `high_m`, each (x, y, z).

    It is furniture, a column or a building outside. albedo: 0 to 1.
    """

    low_m: tuple[float, float, float]
    high_m: tuple[float, float, float]
    albedo: float


@dataclass(frozen=True, slots=True)
class Guess:
    """One possible scene: a box room with windows, bars and solids, the camera, and the clock.

    size_m: x, y, z; camera_m: its place in room axes, x along the "south" wall, y away from it, z
    up. wall_azimuth_deg: of the south wall's outward normal, clockwise from the stated north.
    thickness_m: of the walls. north_deg: room and camera are turned further clockwise than stated
    by this angle. clock_min: how much later the stated times are than the true ones. axis_deg:
    azimuth of the picture's centre, clockwise from the stated north. tilt_deg: how far this centre
    points up. roll_deg: how far the picture's right-hand side is low.
    """

    size_m: tuple[float, float, float]
    camera_m: tuple[float, float, float]
    wall_azimuth_deg: float
    thickness_m: float
    windows: tuple[WindowRect, ...]
    bars: tuple[Bar, ...] = ()
    solids: tuple[Solid, ...] = ()
    north_deg: float = 0.0
    clock_min: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    axis_deg: float = 180.0

    @property
    def camera_turn(self) -> Floats:
        """The rotation from the picture's world axes to room axes, [3, 3].

        room = camera_turn @ picture. The picture's axes are x east, y north, z up for a level
        camera with the stated heading.
        """
        return _camera_turn(self.wall_azimuth_deg, self.tilt_deg, self.roll_deg, self.axis_deg)


def is_possible(guess: Guess) -> bool:
    """Return whether the camera is in the room and in no solid.

    The sizes of windows, bars and solids must be above 0, too.
    """

    def holds_camera(low: Sequence[float], high: Sequence[float]) -> bool:
        return all(a < at < b for a, at, b in zip(low, guess.camera_m, high, strict=True))

    spans = [span for s in guess.solids for span in zip(s.low_m, s.high_m, strict=True)]
    spans += [span for rect in guess.windows for span in (rect.u_m, rect.z_m)]
    spans += [span for bar in guess.bars for span in (bar.span_m, bar.depth_m)]
    in_solid = any(holds_camera(solid.low_m, solid.high_m) for solid in guess.solids)
    in_room = holds_camera((0.0, 0.0, 0.0), guess.size_m)
    return in_room and not in_solid and all(end > start for start, end in spans)


def thickened(guess: Guess) -> Guess:
    """Return the guess with solids at least 4 cm and bars at least 1 cm thick.

    Without it a search would stop at the first element that becomes thinner than this.
    """
    bars = tuple(
        replace(bar, span_m=_wide(bar.span_m, _THIN_BAR_M), depth_m=_wide(bar.depth_m, _THIN_BAR_M))
        for bar in guess.bars
    )
    solids = []
    for solid in guess.solids:
        spans = zip(solid.low_m, solid.high_m, strict=True)
        x_m, y_m, z_m = (_wide(span, _THIN_SOLID_M) for span in spans)
        solids.append(solid_of(x_m, y_m, z_m, solid.albedo))
    return replace(guess, bars=bars, solids=tuple(solids))


def solid_of(x_m: Span, y_m: Span, z_m: Span, albedo: float) -> Solid:
    """Return a solid by its extents (from, to) along the room's axes, m; albedo: 0 to 1."""
    return Solid((x_m[0], y_m[0], z_m[0]), (x_m[1], y_m[1], z_m[1]), albedo)


def _wide(span_m: Span, width_m: float) -> Span:
    """Return an interval of at least this width, with the same middle, m."""
    missing_m = max(width_m - (span_m[1] - span_m[0]), 0.0) / 2.0
    return span_m[0] - missing_m, span_m[1] + missing_m


def is_outside(guess: Guess, solid: Solid) -> bool:
    """Return whether a solid is completely beyond the inner face of a wall."""
    return any(
        solid.high_m[axis] <= 0.0 or solid.low_m[axis] >= guess.size_m[axis] for axis in (0, 1)
    )


@lru_cache(maxsize=64)
def _camera_turn(
    wall_azimuth_deg: float, tilt_deg: float, roll_deg: float, axis_deg: float
) -> Floats:
    """Return `Guess.camera_turn`, [3, 3]; stored, because searches repeat the same angles."""
    return room_axes(wall_azimuth_deg) @ rotation(0.0, tilt_deg, roll_deg, axis_deg)


def guess_of(room: Room, axis_deg: float = 180.0) -> Guess:
    """Return a stated box room as a guess.

    Window frames, glazing bars and transoms become bars, obstructions become solids. axis_deg: the
    stated azimuth of the picture's centre, clockwise from north. Raises InputError for an
    impossible room.
    """
    scene = build(room)
    windows, bars, middle = [], [], room.wall_thickness_m / 2.0
    for number, (window, opening) in enumerate(zip(room.window, scene.openings, strict=True)):
        rect = WindowRect(window.wall, opening.u_m, opening.z_m, window.transmittance)
        windows.append(rect)
        posts, rails, half_m = window_bars(window, opening, room.wall_thickness_m)
        depth = (middle - half_m, middle + half_m)
        bars += [Bar(number, True, span, depth) for span in posts]  # upright
        bars += [Bar(number, False, span, depth) for span in rails]  # level
    obstructions = [scene.boxes[k] for k in scene.of_kind("obstruction")]
    return Guess(
        size_m=(room.width_m, room.depth_m, room.height_m),
        camera_m=(room.camera_x_m, room.camera_y_m, room.camera_z_m),
        wall_azimuth_deg=room.wall_azimuth_deg,
        thickness_m=room.wall_thickness_m,
        windows=tuple(windows),
        bars=tuple(bars),
        solids=tuple(Solid(box.low, box.high, box.reflectance) for box in obstructions),
        tilt_deg=room.camera_tilt_deg,
        roll_deg=room.camera_roll_deg,
        axis_deg=axis_deg,
    )


def room_of(guess: Guess, stated: Room) -> Room:
    """Return the guess as a `Room`: bars and solids become boxes.

    Windows end at the edges of their wall and at windows earlier in the list, beyond which no light
    enters. stated: the room from which other fields are taken, also the walls' azimuth; neither
    `guess.wall_azimuth_deg` nor `guess.north_deg` is applied.
    """
    windows = tuple(_window(guess, rect) for rect in _cut_windows(guess))
    bars = tuple(_bar_obstruction(guess, bar, stated.reflectance_frame) for bar in guess.bars)
    solids = tuple(_obstruction(s.low_m, s.high_m, s.albedo) for s in guess.solids)
    return replace(
        stated,
        width_m=guess.size_m[0],
        depth_m=guess.size_m[1],
        height_m=guess.size_m[2],
        camera_x_m=guess.camera_m[0],
        camera_y_m=guess.camera_m[1],
        camera_z_m=guess.camera_m[2],
        camera_tilt_deg=guess.tilt_deg,
        camera_roll_deg=guess.roll_deg,
        wall_thickness_m=guess.thickness_m,
        window=windows,
        obstruction=bars + solids,
    )


def _cut_windows(guess: Guess) -> list[WindowRect]:
    """Return the windows without their parts beyond the wall or inside an earlier window.

    Windows of which nothing remains are left out. Of two windows that overlap, the later one loses
    the overlap, by becoming narrower or lower, whichever is less.
    """
    kept: list[WindowRect] = []
    for rect in guess.windows:
        length = guess.size_m[1 - WALLS[rect.wall][0]]
        u, z = _overlap(rect.u_m, (0.0, length)), _overlap(rect.z_m, (0.0, guess.size_m[2]))
        for other in kept:
            if other.wall != rect.wall:
                continue
            along, up = _overlap(u, other.u_m), _overlap(z, other.z_m)
            width, height = along[1] - along[0], up[1] - up[0]
            if width > 0.0 and height > 0.0:
                u, z = (_without(u, along), z) if width <= height else (u, _without(z, up))
        if min(u[1] - u[0], z[1] - z[0]) > 1e-3:  # a millimetre
            kept.append(replace(rect, u_m=u, z_m=z))
    return kept


def _overlap(first: Span, other: Span) -> Span:
    """Return the overlap of two intervals; without one its end is not after its start."""
    return max(first[0], other[0]), min(first[1], other[1])


def _without(interval: Span, part: Span) -> Span:
    """Return what remains of an interval without a part of it: the longer of the two ends."""
    below, above = (interval[0], part[0]), (part[1], interval[1])
    return below if below[1] - below[0] >= above[1] - above[0] else above


def _window(guess: Guess, rect: WindowRect) -> Window:
    """Return a window of SITE.toml; its left_m is from the wall's left end as seen from inside.

    It has no frame and no transom: the guess's bars become obstructions.
    """
    length = guess.size_m[1 - WALLS[rect.wall][0]]
    (u0, u1), (z0, z1) = rect.u_m, rect.z_m
    return Window(
        rect.wall,
        left_m=length - u1 if rect.wall in ("south", "east") else u0,
        width_m=u1 - u0,
        sill_m=z0,
        height_m=z1 - z0,
        transmittance=rect.transmittance,
        frame_m=0.0,
    )


def _bar_obstruction(guess: Guess, bar: Bar, albedo: float) -> Obstruction:
    """Return a glazing bar as a box in room axes; albedo: its reflectance."""
    rect = guess.windows[bar.window]
    axis, side = WALLS[rect.wall]
    inner, outward = (guess.size_m[axis], 1.0) if side else (0.0, -1.0)
    start, end = sorted(inner + outward * depth for depth in bar.depth_m)
    u, z = (bar.span_m, rect.z_m) if bar.upright else (rect.u_m, bar.span_m)
    box = upright(axis, (start, end), u, z, albedo, "frame")
    return _obstruction(box.low, box.high, albedo)


def _obstruction(low: Sequence[float], high: Sequence[float], albedo: float) -> Obstruction:
    """Return a box by its lowest and highest corner (x, y, z) in m; albedo: its reflectance."""
    return Obstruction(
        x_m=low[0],
        y_m=low[1],
        z_m=low[2],
        width_m=high[0] - low[0],
        depth_m=high[1] - low[1],
        height_m=high[2] - low[2],
        reflectance=albedo,
    )
