"""Define the numbers of a scene that a search changes, with their steps and priors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Room
from fieldlum.room.fit.guess import Bar, Guess
from fieldlum.room.scene.geometry import WALLS

Change = Callable[[Guess, float], Guess]

# Standard deviations of values measured with a tape measure and a compass (docs/scene.md).
NORTH_SD_DEG, CLOCK_SD_MIN, LEVEL_SD_DEG = 2.0, 5.0, 0.3
LENGTH_SD_SHARE, EDGE_SD_M, CAMERA_SD_M, THICKNESS_SD_M = 0.02, 0.05, 0.05, 0.05
POSE_NAMES = ("north_deg", "tilt_deg", "roll_deg", "clock_min")
# The mean sun's 360 degrees in 24 hours, by definition: a late clock and a turned north have
# similar effects.
SUN_DEG_PER_MIN = 0.25


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number of the scene that a search changes, in m, degrees, minutes or, for an albedo, 1.

    read(guess) returns its value; change(guess, by) returns a guess in which it is changed by `by`,
    as far as its limits allow; for u0 and u1 of a window in the south or east wall `read` counts
    from the opposite end and falls. first_step, last_step: step at the start and the end of the
    search; sd: standard deviation of its prior, inf without one.
    """

    name: str
    read: Callable[[Guess], float]
    change: Change
    first_step: float
    last_step: float
    sd: float


def _tuple_at(values: tuple[float, ...], index: int, by: float) -> tuple[float, ...]:
    return (*values[:index], values[index] + by, *values[index + 1 :])


def room_parameters(
    guess: Guess, *, with_wall: bool = True, clock_sd_min: float = CLOCK_SD_MIN
) -> list[Parameter]:
    """Return a guess's parameters: pose, clock, sizes, camera, wall thickness and window edges.

    Pose is north, tilt and roll; sizes are width and depth; camera is its x and y. with_wall:
    include the walls' azimuth; clock_sd_min: standard deviation of the clock's prior, in minutes.
    Priors are relative to the stated values. The camera's height is not a parameter: it sets the
    scale of all lengths. Nor is the room's height.
    """
    size, camera = guess.size_m, guess.camera_m

    def sized(axis: int) -> Change:
        return lambda g, by: replace(g, size_m=_tuple_at(g.size_m, axis, by))

    def placed(axis: int) -> Change:
        return lambda g, by: replace(g, camera_m=_tuple_at(g.camera_m, axis, by))

    parameters = [
        Parameter(
            "north_deg",
            lambda g: g.north_deg,
            lambda g, by: replace(g, north_deg=g.north_deg + by),
            0.5,
            0.03,
            NORTH_SD_DEG,
        ),
        Parameter(
            "clock_min",
            lambda g: g.clock_min,
            lambda g, by: replace(g, clock_min=float(np.clip(g.clock_min + by, -19.0, 19.0))),
            2.0,
            0.12,
            clock_sd_min,
        ),
        _level("tilt_deg"),
        _level("roll_deg"),
    ]
    if with_wall:
        parameters.append(
            Parameter(
                "wall_azimuth_deg",
                lambda g: g.wall_azimuth_deg,
                lambda g, by: replace(g, wall_azimuth_deg=g.wall_azimuth_deg + by),
                0.5,
                0.03,
                NORTH_SD_DEG,
            )
        )
    for axis, name in enumerate(("width_m", "depth_m")):
        sd = max(LENGTH_SD_SHARE * size[axis], 0.03)
        reader = _reader(lambda g, a: g.size_m[a], axis)
        parameters.append(Parameter(name, reader, sized(axis), 0.04, 0.004, sd))
    for axis, name in enumerate(("camera_x_m", "camera_y_m")):
        reader = _reader(lambda g, a: g.camera_m[a], axis)
        parameters.append(Parameter(name, reader, placed(axis), 0.04, 0.004, CAMERA_SD_M))
    del camera
    parameters.append(
        Parameter(
            "thickness_m",
            lambda g: g.thickness_m,
            lambda g, by: replace(g, thickness_m=max(g.thickness_m + by, 0.01)),
            0.04,
            0.004,
            THICKNESS_SD_M,
        )
    )
    for number in range(len(guess.windows)):
        parameters += _window_parameters(number)
    return parameters


def _level(name: str) -> Parameter:
    def change(g: Guess, by: float) -> Guess:
        return replace(g, **{name: getattr(g, name) + by})

    return Parameter(name, lambda g: getattr(g, name), change, 0.25, 0.03, LEVEL_SD_DEG)


def _reader(read: Callable[[Guess, int], float], index: int) -> Callable[[Guess], float]:
    return lambda g: read(g, index)


def _window_parameters(number: int) -> list[Parameter]:
    def edge(which: str, end: int) -> Parameter:
        def change(g: Guess, by: float) -> Guess:
            rect = g.windows[number]
            spans = _tuple_at(getattr(rect, which), end, by)
            moved = replace(rect, **{which: spans})
            return replace(g, windows=(*g.windows[:number], moved, *g.windows[number + 1 :]))

        def read(g: Guess) -> float:
            rect = g.windows[number]
            value = getattr(rect, which)[end]
            if which == "u_m" and rect.wall in ("south", "east"):
                # from the left end, as it is measured
                return g.size_m[1 - WALLS[rect.wall][0]] - value
            return value

        name = f"window {number + 1} {which[0]}{end}"
        return Parameter(name, read, change, 0.04, 0.004, EDGE_SD_M)

    return [edge("u_m", 0), edge("u_m", 1), edge("z_m", 0), edge("z_m", 1)]


def bar_parameters(guess: Guess) -> list[Parameter]:
    """Return place, width and depth of each of the guess's bars as parameters without a prior.

    They are in m; depth is the place of the outer face, outwards from the wall's inner face.
    """
    parameters: list[Parameter] = []
    for number in range(len(guess.bars)):

        def changed(change: Callable[[Bar, float], Bar], number: int = number) -> Change:
            def apply(g: Guess, by: float) -> Guess:
                bars = list(g.bars)
                bars[number] = change(bars[number], by)
                return replace(g, bars=tuple(bars))

            return apply

        moves: dict[str, tuple[Callable[[Bar], float], Callable[[Bar, float], Bar]]] = {
            "place": (lambda b: b.span_m[0], _moved_bar),
            "width": (lambda b: b.span_m[1] - b.span_m[0], _widened_bar),
            "depth": (lambda b: b.depth_m[1], _deepened_bar),
        }
        for name, (read, change) in moves.items():
            reader = _bar_reader(read, number)
            label = f"bar {number + 1} {name}"
            parameters.append(Parameter(label, reader, changed(change), 0.02, 0.004, np.inf))
    return parameters


def _bar_reader(read: Callable[[Bar], float], number: int) -> Callable[[Guess], float]:
    return lambda g: read(g.bars[number])


def _moved_bar(bar: Bar, by: float) -> Bar:
    return replace(bar, span_m=(bar.span_m[0] + by, bar.span_m[1] + by))


def _widened_bar(bar: Bar, by: float) -> Bar:
    low, high = bar.span_m[0] - by / 2.0, bar.span_m[1] + by / 2.0
    return replace(bar, span_m=(low, high)) if high > low else bar


def _deepened_bar(bar: Bar, by: float) -> Bar:
    return replace(bar, depth_m=(bar.depth_m[0], max(bar.depth_m[1] + by, bar.depth_m[0] + 0.005)))


def stated_albedo(room: Room) -> Floats:
    """Return stated albedos, 0 to 1, of west, east, south, north, floor and ceiling, [6]."""
    walls = [room.reflectance_walls] * 4
    return np.array([*walls, room.reflectance_floor, room.reflectance_ceiling])
