"""Propose what a stated box lacks: shade outside, bars in windows, furniture.

Proposals are a coarse grid of usual sizes; the search moves their faces, and keeps an element only
if its gain exceeds its standard error over the hours.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations, product

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.room.fit.guess import Bar, Guess, WindowRect, is_outside, solid_of
from fieldlum.room.fit.parameters import Parameter, bar_parameters, solid_parameters
from fieldlum.room.scene.box_room import WALLS, Span

# Buildings, seen from the middle of a window: distance, and elevation of their tops straight out;
# bearings of their ends from the window's normal, of which the outermost hide every sun that
# enters. A farther and higher one gives nearly the same shade, so that a factor of two in distance
# is fine enough. Their thickness hardly changes the shade. Canopies: gap above the window, depth,
# thickness, overhang to either side. Screens (blinds, lintels): share of the window's height. No
# patch shows their albedo. All chosen, not measured.
BUILDING_DISTANCES_M = (2.0, 5.0, 12.0, 30.0)
BUILDING_ELEVATIONS_DEG = (6.0, 10.0, 15.0, 22.0, 35.0)
BUILDING_BEARINGS_DEG = (-80.0, -45.0, -20.0, 0.0, 20.0, 45.0, 80.0)
BUILDING_THICKNESS_M = 2.0
CANOPY_GAPS_M, CANOPY_DEPTHS_M = (0.05, 0.3), (0.4, 0.8, 1.3, 2.0)
CANOPY_THICKNESS_M, CANOPY_OVERHANG_M = 0.1, 1.5
SCREEN_SHARES = (0.25, 0.5, 0.75)
ALBEDO = 0.4  # of anything that is added; chosen
# Bars: width, spacing and half depth, chosen.
BAR_M, BAR_SPACING_M, BAR_HALF_DEPTH_M = 0.06, 0.06, 0.06
# Furniture: boxes and tables at every 0.5 m, cabinets against walls. A desk has 0.74 m (EN 527-1);
# the others are chosen so that a search reaches every size between.
LATTICE_M, CLEAR_M, TABLE_TOP_M = 0.5, 0.1, 0.05
BOX_M, COLUMN_M, HEIGHTS_M, TABLE_M = 0.8, 0.3, (0.4, 0.75, 1.1), 0.74
CABINET_DEPTHS_M, CABINET_LENGTH_M, CABINET_HEIGHTS_M = (0.3, 0.6), 1.6, (0.75, 1.1, 2.0)


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of element, such as furniture, that a search adds to a scene.

    propose: yields guesses with one element more than the given guess; parameters: returns what a
    search changes of the element that was added last to the given guess; gain: share of the cost (0
    to 1) that an element must save to be accepted; apart_m: distance from which two proposals are
    different.
    """

    name: str
    propose: Callable[[Guess], Iterator[Guess]]
    parameters: Callable[[Guess], list[Parameter]]
    gain: float
    apart_m: float

    def best(self, proposals: list[Guess], costs: Floats, count: int) -> list[Guess]:
        """Return at most `count` proposals of the lowest costs, `apart_m` or more from each other.

        costs: of the proposals, in their order, as `SceneCost` returns them; the result has the
        lowest cost first.
        """
        chosen: list[Guess] = []
        for k in np.argsort(costs):
            place = _place(proposals[k])
            if all(np.abs(place - _place(c)).max() >= self.apart_m for c in chosen):
                chosen.append(proposals[k])
            if len(chosen) == count:
                break
        return chosen


def _place(guess: Guess) -> Floats:
    """Return numbers [k] that tell where a guess's last solid and last bar are, m.

    These are the middle of the solid in plan and, in the room, its top; then the bar's window,
    direction and lower end. The largest difference of these numbers is the distance of two guesses'
    last elements; bars of another window, or an upright and a level one, count as far (1000 and 100
    m).
    """
    last_solid, last_bar = guess.solids[-1:], guess.bars[-1:]  # without any: empty
    middles = [np.add(s.low_m, s.high_m)[:2] / 2.0 for s in last_solid]
    middles += [np.array(s.high_m[2:]) for s in last_solid if not is_outside(guess, s)]
    spans = [np.array([1e3 * b.window, 1e2 * b.upright, b.span_m[0]]) for b in last_bar]
    return np.concatenate([*middles, *spans])


def _shades(guess: Guess) -> Iterator[Guess]:
    """Yield guesses with a building, screen or canopy at one of the windows."""
    for rect in guess.windows:
        middle_u, middle_z = (float(np.mean(span)) for span in (rect.u_m, rect.z_m))
        ends = np.tan(np.radians(BUILDING_BEARINGS_DEG)).tolist()
        distances = product(BUILDING_DISTANCES_M, BUILDING_ELEVATIONS_DEG)
        for (out, elevation), (left, right) in product(distances, combinations(ends, 2)):
            along = (middle_u + out * left, middle_u + out * right)
            top = middle_z + out * float(np.tan(np.radians(elevation)))
            away = (out, out + BUILDING_THICKNESS_M)
            yield with_box_outside(guess, rect, along, away, (0.0, top))
        along = (rect.u_m[0] - CANOPY_OVERHANG_M, rect.u_m[1] + CANOPY_OVERHANG_M)
        in_wall = (0.3 * guess.thickness_m, 0.7 * guess.thickness_m)
        for share in SCREEN_SHARES:
            bottom = rect.z_m[1] - share * (rect.z_m[1] - rect.z_m[0])
            yield with_box_outside(guess, rect, along, in_wall, (bottom, rect.z_m[1]))
        for gap, depth in product(CANOPY_GAPS_M, CANOPY_DEPTHS_M):
            bottom = rect.z_m[1] + gap
            before_wall = (guess.thickness_m, guess.thickness_m + depth)
            height = (bottom, bottom + CANOPY_THICKNESS_M)
            yield with_box_outside(guess, rect, along, before_wall, height)


def with_box_outside(guess: Guess, rect: WindowRect, along: Span, out: Span, height: Span) -> Guess:
    """Return the guess with an opaque box outside, in front of the window `rect`.

    Extents are (from, to) in m. along: along the window's wall, in room axes; out: outwards from
    the wall's inner face; height: above the floor.
    """
    axis, side = WALLS[rect.wall]
    wall_m = guess.size_m[axis]
    across = (wall_m + out[0], wall_m + out[1]) if side else (-out[1], -out[0])
    spans = (across, along) if axis == 0 else (along, across)
    return replace(guess, solids=(*guess.solids, solid_of(*spans, height, ALBEDO)))


def _barred(guess: Guess) -> Iterator[Guess]:
    """Yield guesses with an upright or a level bar, at every 6 cm of each window."""
    middle = guess.thickness_m / 2.0
    half = min(BAR_HALF_DEPTH_M, 0.8 * middle)
    depth = (middle - half, middle + half)
    for number, rect in enumerate(guess.windows):
        for is_upright, (low, high) in ((True, rect.u_m), (False, rect.z_m)):
            for at in np.arange(low, high - BAR_M, BAR_SPACING_M).tolist():
                bar = Bar(number, is_upright, (at, at + BAR_M), depth)
                yield replace(guess, bars=(*guess.bars, bar))


def _furnished(guess: Guess) -> Iterator[Guess]:
    """Yield guesses with a box, column, table or cabinet that is cut off by walls.

    Boxes of 0.8 m by 0.8 m are 0.4, 0.75 or 1.1 m high, columns of 0.3 m by 0.3 m reach the
    ceiling, cabinets 1.6 m long are 0.3 or 0.6 m deep and 0.75, 1.1 or 2 m high. None holds the
    camera.
    """
    width, length, height = guess.size_m
    shapes = [(BOX_M, 0.0, min(top, height)) for top in HEIGHTS_M]
    shapes += [(COLUMN_M, 0.0, height), (BOX_M, TABLE_M - TABLE_TOP_M, TABLE_M)]
    solids = [
        (_around(x, side, width), _around(y, side, length), (bottom, top))
        for side, bottom, top in shapes
        for x, y in product(_places(width), _places(length))
    ]
    for (axis, side), deep, top in product(WALLS.values(), CABINET_DEPTHS_M, CABINET_HEIGHTS_M):
        extent, wall_length = guess.size_m[axis], guess.size_m[1 - axis]
        across = (extent - deep, extent) if side else (0.0, deep)
        for middle in _places(wall_length):
            along = _around(middle, CABINET_LENGTH_M, wall_length)
            plan = (across, along) if axis == 0 else (along, across)
            solids.append((*plan, (0.0, min(top, height))))
    for spans in solids:
        if not _holds_camera(guess, spans):
            yield replace(guess, solids=(*guess.solids, solid_of(*spans, ALBEDO)))


def _places(extent_m: float) -> list[float]:
    """Return coordinates at every 0.5 m along a side of the room [m]; extent_m: its length."""
    return np.arange(LATTICE_M / 2.0, extent_m, LATTICE_M).tolist()


def _around(middle: float, side: float, extent: float) -> Span:
    """Return the interval of length `side` around `middle`, cut off at 0 and at `extent` [m]."""
    return max(middle - side / 2.0, 0.0), min(middle + side / 2.0, extent)


def _holds_camera(guess: Guess, spans: tuple[Span, Span, Span]) -> bool:
    """Return whether the camera is in a solid, or at most 0.1 m from its sides or 0.2 m above.

    spans: extents of the solid along x, y and z [m].
    """
    x_m, y_m, z_m = guess.camera_m
    near_x = spans[0][0] - CLEAR_M < x_m < spans[0][1] + CLEAR_M
    near_y = spans[1][0] - CLEAR_M < y_m < spans[1][1] + CLEAR_M
    return near_x and near_y and spans[2][1] > z_m - 2.0 * CLEAR_M


def _of_last_solid(guess: Guess) -> list[Parameter]:
    """Return the parameters of the solid that was added last."""
    return solid_parameters(guess, len(guess.solids) - 1)


# Gains are chosen, not varied: low for a bar, which shades few pixels; above what a solid gains
# that only explains noise; highest for shade outside, because a wrong facade moves north, clock and
# edges.
SHADES = Kind("shade outside", _shades, _of_last_solid, 0.02, 0.3)
BARS = Kind("bars", _barred, lambda guess: bar_parameters(len(guess.bars) - 1), 0.002, 0.15)
FURNITURE = Kind("furniture", _furnished, _of_last_solid, 0.01, 0.45)
KINDS = (SHADES, BARS, FURNITURE)
