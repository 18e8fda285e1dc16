"""Propose furniture: boxes and table tops of usual sizes all over the room.

The search adds a box only if it lowers the misfit enough. `pixel_depths` proposes boxes of other
sizes, but needs pixels that are close together.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.room.fit.guess import Guess, Solid
from fieldlum.room.fit.parameters import Parameter
from fieldlum.room.scene.geometry import WALLS

# Solids from which searches start: columns and boxes of three heights and up to the ceiling, and
# table tops with thin legs at these heights, below which the sun passes. A desk has 0.74 m (EN
# 527-1); the others are chosen so that a search reaches every height between. Sides in plan and
# distances are chosen, not varied.
TABLE_TOP_M = 0.05
SIDES_M = (0.3, 0.8)
HEIGHTS_M = (0.4, 0.75, 1.1)
LATTICE_M = 0.4
SOLID_ALBEDO = 0.4
CLEAR_M = 0.1
APART_M = 0.45
MAX_PROPOSALS = 6
# Cabinets and shelves against walls: depths, length and heights; chosen as usual sizes. A depth
# that is 0.1 m wrong moves sun patches on the front so far that no cabinet would cost less.
CABINET_DEPTHS_M = (0.3, 0.4, 0.6)
CABINET_LENGTH_M = 1.6
CABINET_HEIGHTS_M = (0.75, 1.1, 2.0)
MIN_SIDE_M = 0.04  # a thinner solid only explains noise; chosen, not measured

# Chosen: twice the tape's 5 cm; places between window and camera, thickness and albedo (that of
# walls) from which the search of a column starts.
MIN_HIDDEN_M = 0.1
COLUMN_SHARES = (0.2, 0.45, 0.7)
COLUMN_M, COLUMN_ALBEDO = 0.2, 0.5


def lattice(guess: Guess) -> list[Solid]:
    """Return solids of usual sizes at every 0.4 m of the room's floor and along its walls.

    At each place: columns (0.3 m) and boxes (0.8 m) that are 0.4, 0.75 or 1.1 m high or reach the
    ceiling, and table tops (0.8 m) at the same three heights. Along walls: cabinets of 1.6 m that
    are 0.3, 0.4 or 0.6 m deep and 0.75, 1.1 or 2 m high. Walls cut them off. Solids around the
    camera are left out.
    """
    width, length, height = guess.size_m
    boxes = [(side, 0.0, min(top, height)) for side in SIDES_M for top in (*HEIGHTS_M, height)]
    tables = [(SIDES_M[-1], top - TABLE_TOP_M, top) for top in HEIGHTS_M if top < height]
    solids: list[Solid] = []
    for side, bottom, top in boxes + tables:
        for x, y in product(_places(width), _places(length)):
            low = (max(x - side / 2.0, 0.0), max(y - side / 2.0, 0.0), bottom)
            high = (min(x + side / 2.0, width), min(y + side / 2.0, length), top)
            solids.append(Solid(low, high, SOLID_ALBEDO))
    solids += _cabinets(guess)
    return [solid for solid in solids if not _holds_camera(guess, solid)]


def _cabinets(guess: Guess) -> list[Solid]:
    """Return cabinets of three depths and three heights at every 0.4 m along the four walls."""
    solids: list[Solid] = []
    for (axis, side), deep, top in product(WALLS.values(), CABINET_DEPTHS_M, CABINET_HEIGHTS_M):
        along = 1 - axis
        extent = guess.size_m[axis]
        for middle in _places(guess.size_m[along]):
            low, high = [0.0, 0.0, 0.0], [0.0, 0.0, min(top, guess.size_m[2])]
            low[axis], high[axis] = (extent - deep, extent) if side else (0.0, deep)
            low[along] = max(middle - CABINET_LENGTH_M / 2.0, 0.0)
            high[along] = min(middle + CABINET_LENGTH_M / 2.0, guess.size_m[along])
            solids.append(
                Solid((low[0], low[1], low[2]), (high[0], high[1], high[2]), SOLID_ALBEDO)
            )
    return solids


def _places(extent_m: float) -> Floats:
    """Return the lattice's coordinates along one side of the room [k]."""
    return np.arange(LATTICE_M / 2.0, extent_m, LATTICE_M)


def _holds_camera(guess: Guess, solid: Solid) -> bool:
    """Return whether the camera is in a solid, or at most 0.1 m from its sides or 0.2 m above."""
    x, y, z = guess.camera_m
    beside = all(
        low - CLEAR_M < at < high + CLEAR_M
        for at, low, high in zip((x, y), solid.low_m[:2], solid.high_m[:2], strict=True)
    )
    return beside and solid.high_m[2] > z - 2.0 * CLEAR_M


def propose_solids(guess: Guess, cost: Callable[[Guess], float], least: float) -> list[Solid]:
    """Return the at most six solids of the lattice with the lowest costs, best first.

    cost: of a guess; least: a cost that each must be below. The middles of all are 0.45 m apart
    along x or y, so that one missing object is not proposed six times.
    """
    solids = lattice(guess)
    costs = [cost(replace(guess, solids=(*guess.solids, solid))) for solid in solids]
    chosen: list[Solid] = []
    for k in np.argsort(costs):
        if costs[k] >= least or len(chosen) == MAX_PROPOSALS:
            break
        if all(_apart_m(solids[k], other) > APART_M for other in chosen):
            chosen.append(solids[k])
    return chosen


def _apart_m(first: Solid, other: Solid) -> float:
    """Return the larger of the distances along x and y between two solids' middles [m]."""
    middles = [np.add(solid.low_m, solid.high_m)[:2] / 2.0 for solid in (first, other)]
    return float(np.abs(middles[0] - middles[1]).max())


def propose_columns(
    guess: Guess, stated: Guess, parameters: Sequence[Parameter]
) -> list[tuple[Parameter, Guess]]:
    """Return guesses in which a column explains why a window ends inside its stated end.

    These are windows whose fitted left or right end is 10 cm or more inside the stated one. In each
    guess that end is back at the stated place, and a column at one of three distances from the
    window hides the difference from the camera. Each guess comes with the parameter of its window's
    end. parameters: must include those of all windows.
    """
    by_name = {p.name: p for p in parameters}
    proposals: list[tuple[Parameter, Guess]] = []
    for number, end in product(range(len(guess.windows)), (0, 1)):
        p = by_name[f"window {number + 1} u{end}"]
        rect = guess.windows[number]
        axis, side = WALLS[rect.wall]
        along = 1 - axis
        edge = p.read(stated)
        if rect.wall in ("south", "east"):  # as `parameters` reads it
            edge = guess.size_m[along] - edge
        now = rect.u_m[end]
        if (now - edge) * (1.0 if end == 0 else -1.0) < MIN_HIDDEN_M:
            continue
        back = replace(rect, u_m=(edge, rect.u_m[1]) if end == 0 else (rect.u_m[0], edge))
        windows = (*guess.windows[:number], back, *guess.windows[number + 1 :])
        inner = guess.size_m[axis] if side else 0.0
        eye_u, eye_across = guess.camera_m[along], guess.camera_m[axis]
        for share in COLUMN_SHARES:
            low, high = [0.0, 0.0, 0.0], list(guess.size_m)
            low[along], high[along] = sorted(u + share * (eye_u - u) for u in (edge, now))
            middle = inner + share * (eye_across - inner)
            low[axis], high[axis] = middle - COLUMN_M / 2.0, middle + COLUMN_M / 2.0
            column = Solid((low[0], low[1], low[2]), (high[0], high[1], high[2]), COLUMN_ALBEDO)
            trial = replace(guess, windows=windows, solids=(*guess.solids, column))
            proposals.append((p, trial))
    return proposals


def solid_parameters(number: int) -> list[Parameter]:
    """Return place, faces, top and albedo of a solid inside as parameters without a prior.

    number: index of the solid from 0. A solid is on the floor, or is a table's top of constant
    thickness. Its bottom is no parameter, because a near high box hides the same pixels as a far
    low box.
    """

    def changed(change: Callable[[Solid, float], Solid]) -> Callable[[Guess, float], Guess]:
        def apply(g: Guess, by: float) -> Guess:
            solids = list(g.solids)
            solids[number] = change(solids[number], by)
            return replace(g, solids=tuple(solids))

        return apply

    def face(which: str, axis: int) -> Parameter:
        def move(solid: Solid, by: float) -> Solid:
            values = list(getattr(solid, which))
            values[axis] += by
            other = solid.high_m if which == "low_m" else solid.low_m
            extent = (other[axis] - values[axis]) * (1.0 if which == "low_m" else -1.0)
            if extent < MIN_SIDE_M:
                return solid
            return replace(solid, **{which: tuple(values)})

        def read(g: Guess) -> float:
            return getattr(g.solids[number], which)[axis]

        name = f"solid {number + 1} {which[0]}{'xyz'[axis]}"
        return Parameter(name, read, changed(move), 0.16, 0.01, np.inf)

    def lift(solid: Solid, by: float) -> Solid:
        """Return a box with its top raised, or a table's top at another height."""
        low, high = list(solid.low_m), list(solid.high_m)
        high[2] += by
        if low[2] > 0.0:
            low[2] += by
        if low[2] < 0.0 or high[2] - low[2] < 0.8 * TABLE_TOP_M:
            return solid
        return replace(solid, low_m=tuple(low), high_m=tuple(high))

    def tone(solid: Solid, by: float) -> Solid:
        return replace(solid, albedo=float(np.clip(solid.albedo + by, 0.03, 0.9)))

    def slide(axis: int) -> Parameter:
        def move(solid: Solid, by: float) -> Solid:
            low, high = list(solid.low_m), list(solid.high_m)
            low[axis] += by
            high[axis] += by
            return replace(solid, low_m=tuple(low), high_m=tuple(high))

        def read(g: Guess) -> float:
            return g.solids[number].low_m[axis]

        name = f"solid {number + 1} slide {'xyz'[axis]}"
        return Parameter(name, read, changed(move), 0.16, 0.01, np.inf)

    albedo = Parameter(
        f"solid {number + 1} albedo",
        lambda g: g.solids[number].albedo,
        changed(tone),
        0.1,
        0.01,
        np.inf,
    )
    faces = [face("low_m", 0), face("high_m", 0), face("low_m", 1), face("high_m", 1)]
    top = Parameter(
        f"solid {number + 1} hz",
        lambda g: g.solids[number].high_m[2],
        changed(lift),
        0.16,
        0.01,
        np.inf,
    )
    return [slide(0), slide(1), *faces, top, albedo]
