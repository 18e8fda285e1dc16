"""Propose what shades a window from outside: a facade opposite, or a canopy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from fieldlum.room.fit.guess import Guess, Solid, WindowRect
from fieldlum.room.fit.parameters import Parameter
from fieldlum.room.scene.geometry import WALLS

# Grids from which searches start; chosen, not varied. A farther and higher facade gives nearly the
# same shade, so that a factor of two in distance is fine enough; the facade's angle of elevation
# decides which suns it hides.
FACADE_DISTANCES_M = (2.0, 5.0, 12.0, 30.0)
FACADE_ELEVATIONS_DEG = (6.0, 10.0, 14.0, 18.0, 24.0, 30.0, 40.0)
FACADE_THICKNESS_M = 2.0  # chosen: hardly changes the shade of a facade that starts at the ground
# extent of a facade to either side of the window, beyond every sun that enters; chosen
REACH_M = 40.0
# Chosen, not measured: gaps above the window's upper edge, depths and thickness of common canopies,
# the overhang to either side. A thinner shade
# than `THINNEST_M` explains noise; no captured patch shows the outside, so that a common facade's
# albedo is taken.
CANOPY_GAPS_M = (0.05, 0.3)
CANOPY_DEPTHS_M = (0.4, 0.8, 1.3, 2.0)
CANOPY_THICKNESS_M = 0.1
THINNEST_M = 0.08
CANOPY_OVERHANG_M = 1.5
ALBEDO = 0.4

Side = Literal["all", "low", "high"]


def propose_exterior(guess: Guess) -> list[Solid]:
    """Return boxes as facades and canopies in front of each window, on a coarse grid.

    Facades vary in distance, height and side (all, left or right half), canopies in gap and depth.
    """
    proposals: list[Solid] = []
    for rect in guess.windows:
        middle_u, middle_z = (float(np.mean(span)) for span in (rect.u_m, rect.z_m))
        for distance in FACADE_DISTANCES_M:
            for elevation in FACADE_ELEVATIONS_DEG:
                top = middle_z + distance * float(np.tan(np.radians(elevation)))
                low, high = middle_u - REACH_M, middle_u + REACH_M
                sides = ((low, high), (low, middle_u), (middle_u, high))
                proposals += [opposite(guess, rect, along, distance, top) for along in sides]
        for gap in CANOPY_GAPS_M:
            for depth in CANOPY_DEPTHS_M:
                z = rect.z_m[1] + gap
                along = (rect.u_m[0] - CANOPY_OVERHANG_M, rect.u_m[1] + CANOPY_OVERHANG_M)
                out = (guess.thickness_m, guess.thickness_m + depth)
                height = (z, z + CANOPY_THICKNESS_M)
                proposals.append(_outside(guess, rect, along, out, height))
    return proposals


def opposite(
    guess: Guess, rect: WindowRect, along: tuple[float, float], distance_m: float, top_m: float
) -> Solid:
    """Return a facade parallel to a window's wall, from the floor's height to `top_m`.

    along: its extent along the wall; distance_m: from the wall's inner face.
    """
    out = (distance_m, distance_m + FACADE_THICKNESS_M)
    return _outside(guess, rect, along, out, (0.0, top_m))


def _outside(
    guess: Guess,
    rect: WindowRect,
    along: tuple[float, float],
    out: tuple[float, float],
    height: tuple[float, float],
) -> Solid:
    """Return a box in front of a window.

    along: extent along the window's wall; out: extent outwards from the wall's inner face; height:
    extent in height.
    """
    axis, side = WALLS[rect.wall]
    inner = guess.size_m[axis] if side else 0.0
    across = (inner + out[0], inner + out[1]) if side else (-out[1], -out[0])
    low, high = [0.0, 0.0, height[0]], [0.0, 0.0, height[1]]
    low[axis], high[axis] = across
    low[1 - axis], high[1 - axis] = along
    return Solid((low[0], low[1], low[2]), (high[0], high[1], high[2]), ALBEDO)


def is_outside(guess: Guess, solid: Solid) -> bool:
    """Return whether a solid is beyond the inner face of a wall with its full extent."""
    return any(
        solid.high_m[axis] <= 0.0 or solid.low_m[axis] >= guess.size_m[axis] for axis in (0, 1)
    )


def exterior_parameters(number: int) -> list[Parameter]:
    """Return the six faces and three shifts of a solid outside as parameters without a prior.

    number: index of the solid from 0. A change that would make the solid thinner than 8 cm or move
    it inside does nothing. Its albedo is not a parameter, because no sun patch inside depends on
    it.
    """

    def parameter(name: str, move: Callable[[Solid, float], Solid]) -> Parameter:
        def change(g: Guess, by: float) -> Guess:
            solids = list(g.solids)
            moved = move(solids[number], by)
            if all(h - low > THINNEST_M for low, h in zip(moved.low_m, moved.high_m, strict=True)):
                solids[number] = moved
            trial = replace(g, solids=tuple(solids))
            return trial if is_outside(trial, moved) else g

        label = f"solid {number + 1} {name}"
        return Parameter(label, lambda _: 0.0, change, 0.5, 0.02, np.inf)

    def face(which: Literal["low_m", "high_m"], axis: int) -> Parameter:
        def move(solid: Solid, by: float) -> Solid:
            values = list(getattr(solid, which))
            values[axis] += by
            return replace(solid, **{which: tuple(values)})

        return parameter(f"{which[0]}{'xyz'[axis]}", move)

    def slide(axis: int) -> Parameter:
        def move(solid: Solid, by: float) -> Solid:
            low, high = list(solid.low_m), list(solid.high_m)
            low[axis] += by
            high[axis] += by
            return replace(solid, low_m=tuple(low), high_m=tuple(high))

        return parameter(f"slide {'xyz'[axis]}", move)

    faces = [face(which, axis) for axis in (0, 1, 2) for which in ("low_m", "high_m")]
    return [*faces, slide(0), slide(1), slide(2)]
