"""Pattern search for the scene that explains the captures: one number at a time, and pairs that
trade against each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from fieldlum.records import Room
from fieldlum.scene.geometry import WALLS
from fieldlum.scene_fit.evidence import WIDTH, SceneEvidence
from fieldlum.scene_fit.guess import Bar, Guess

if TYPE_CHECKING:
    from fieldlum.scene_fit.pose_prior import PosePrior

Array = NDArray[np.floating]

Change = Callable[[Guess, float], Guess]

# Standard deviations of what a person states with a tape measure and a compass (docs/scene.md).
NORTH_SD_DEG, CLOCK_SD_MIN, LEVEL_SD_DEG = 2.0, 5.0, 0.3
LENGTH_SD_SHARE, EDGE_SD_M, CAMERA_SD_M, THICKNESS_SD_M = 0.02, 0.05, 0.05, 0.05
PRIOR_SHARE = 0.0015  # of the stated misfit: what one standard deviation of one number must pay
MIN_GAIN_SHARE = 1e-5
POSE_NAMES = ("north_deg", "tilt_deg", "roll_deg", "clock_min")
SUN_DEG_PER_MIN = 0.25  # of azimuth: a late clock and a turned north look alike
MAX_MOVES = 6
_PRINCIPAL_GAIN = 0.02  # of the cost: what the first step along a principal axis would change
_LONGEST_STEPS = 3.0  # first steps of the parameters, along axes that hardly change the misfit


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number of the scene: how it changes, its first and last step, and its prior's sd."""

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
    """North, clock, level, sizes, camera, wall thickness and the edges of each window.

    The camera's height is the one known length: it sets the scale.
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
                return g.size_m[1 - WALLS[rect.wall][0]] - value  # as measured, from the left end
            return value

        name = f"window {number + 1} {which[0]}{end}"
        return Parameter(name, read, change, 0.04, 0.004, EDGE_SD_M)

    return [edge("u_m", 0), edge("u_m", 1), edge("z_m", 0), edge("z_m", 1)]


def bar_parameters(guess: Guess) -> list[Parameter]:
    """Place, width and depth of each bar; no prior, bars were found and not stated."""
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


class GuessCost(Protocol):
    """What a search makes small: a function of a guess; pose as in `Objective`."""

    @property
    def pose(self) -> PosePrior | None: ...

    def __call__(self, guess: Guess) -> float: ...


@dataclass(slots=True)
class Objective:
    """Misfit plus prior of a guess, at some evidence; counts its evaluations.

    pose: replaces the priors of `POSE_NAMES`.
    """

    evidence: SceneEvidence
    start: Guess
    parameters: Sequence[Parameter]
    albedo: Array
    prior_unit: float
    pose: PosePrior | None = None
    count: int = field(default=0)

    def __call__(self, guess: Guess) -> float:
        self.count += 1
        return self.evidence.mean_misfit(guess, self._albedo(guess)) + self.prior(guess)

    def residuals(self, guess: Guess) -> Array:
        """Return numbers [n m] whose squares add up to the misfit."""
        evidence = self.evidence
        patch = evidence.patches(guess, self._albedo(guess))
        error = np.log(evidence.below + patch) - evidence.log_seen  # [n, m]
        scale = np.sqrt(evidence.weights / len(evidence))
        return (scale * error / np.sqrt(error**2 + WIDTH**2)).ravel()

    def _albedo(self, guess: Guess) -> Array:
        missing = 6 + len(guess.solids) - len(self.albedo)
        more = [solid.albedo for solid in guess.solids[len(guess.solids) - max(missing, 0) :]]
        return np.concatenate([self.albedo, more]) if missing > 0 else self.albedo

    def prior(self, guess: Guess) -> float:
        """What departing from the stated numbers costs."""
        by_disc = POSE_NAMES if self.pose is not None else ()
        z = [
            (p.read(guess) - p.read(self.start)) / p.sd
            for p in self.parameters
            if p.name not in by_disc
        ]
        pose = 0.0 if self.pose is None else self.pose.cost(guess)
        return self.prior_unit * (float(np.sum(np.square(z))) + pose)


def stated_albedo(room: Room) -> Array:
    """Albedo of the six surfaces of the shell as stated: west, east, south, north, floor,
    ceiling.
    """
    walls = [room.reflectance_walls] * 4
    return np.array([*walls, room.reflectance_floor, room.reflectance_ceiling])


def pattern_search(
    objective: GuessCost,
    guess: Guess,
    parameters: Sequence[Parameter],
    *,
    coarse: float = 1.0,
    fine: float = 1.0,
) -> tuple[Guess, float]:
    """Return the best guess found and its cost.

    Each parameter is stepped up and down, on while it pays, with its own step, which is halved
    when neither direction pays. Steps begin at `coarse` times the first step and end at `fine`
    times the last one. Clock and north also move together, along the valley between them.
    """
    moves = [(p.name, p.change, coarse * p.first_step, fine * p.last_step) for p in parameters]
    for name, change, first, last in compound_moves(guess, parameters, objective.pose):
        moves.append((name, change, coarse * first, fine * last))
    return search_moves(objective, guess, moves)


def principal_search(
    objective: Objective, guess: Guess, parameters: Sequence[Parameter]
) -> tuple[Guess, float]:
    """Return the best guess along the principal axes of the misfit's curvature, and its cost.

    Numbers that trade against each other, such as a wall's azimuth, a window and the camera, leave
    valleys that single numbers do not follow. Their directions are the eigenvectors of the
    Gauss-Newton matrix of numeric differences; flat ones get the longest steps.
    """
    base = objective.residuals(guess)
    cost = objective(guess)
    columns = [
        2.0 * (objective.residuals(p.change(guess, 0.5 * p.first_step)) - base) for p in parameters
    ]
    slopes = np.stack(columns, axis=1)  # [n m, p] per first step
    values, vectors = np.linalg.eigh(slopes.T @ slopes + _prior_curvature(objective, parameters))
    moves: list[tuple[str, Change, float, float]] = []
    for k, value in enumerate(values):
        first = min(np.sqrt(_PRINCIPAL_GAIN * cost / max(value, 1e-12)), _LONGEST_STEPS)
        change = _along(parameters, vectors[:, k])
        moves.append((f"axis {k}", change, float(first), float(first) / 8.0))
    return search_moves(objective, guess, moves)


def _prior_curvature(objective: Objective, parameters: Sequence[Parameter]) -> Array:
    """Return half of the prior's second derivatives by the parameters' first steps, [p, p]."""
    pose = objective.pose
    names = [p.name for p in parameters]
    step = np.array([p.first_step for p in parameters])
    sd = np.array([p.sd for p in parameters])
    if pose is None:
        return objective.prior_unit * np.diag((step / sd) ** 2)
    curvature = np.diag([0.0 if n in POSE_NAMES else s**-2 for n, s in zip(names, sd, strict=True)])
    at = [names.index(name) for name in POSE_NAMES]
    curvature[np.ix_(at, at)] = np.linalg.inv(pose.covariance)
    return objective.prior_unit * curvature * np.outer(step, step)


def _along(parameters: Sequence[Parameter], direction: Array) -> Change:
    """A move of all parameters by `direction` [p] times their first steps."""

    def change(guess: Guess, by: float) -> Guess:
        for p, share in zip(parameters, direction, strict=True):
            guess = p.change(guess, float(by * share * p.first_step))
        return guess

    return change


def search_moves(
    objective: GuessCost, guess: Guess, moves: Sequence[tuple[str, Change, float, float]]
) -> tuple[Guess, float]:
    """Return the best guess by moves (name, change, first and last step), and its cost."""
    best, cost = guess, objective(guess)
    step = {name: first for name, _, first, _ in moves}
    active = True
    while active:
        active = False
        for name, change, _, last in moves:
            if step[name] < last:
                continue
            active = True
            moved = False
            for sign in (1.0, -1.0):
                for _ in range(MAX_MOVES):
                    trial = change(best, sign * step[name])
                    trial_cost = objective(trial)
                    if trial_cost >= cost * (1.0 - MIN_GAIN_SHARE):
                        break
                    best, cost, moved = trial, trial_cost, True
                if moved:
                    break
            if not moved:
                step[name] /= 2.0
    return best, cost


def compound_moves(
    guess: Guess, parameters: Sequence[Parameter], pose: PosePrior | None = None
) -> list[tuple[str, Change, float, float]]:
    """Moves of several numbers at once, along which the misfit hardly changes: name, change, first
    and last step.

    A search along single numbers stops in such valleys: north and clock; a window, the camera and
    a wall that shift together; a window's two edges; the wall and north.
    """
    by_name = {p.name: p.change for p in parameters}

    def together(*parts: tuple[str, float]) -> Change:
        def apply(g: Guess, by: float) -> Guess:
            for name, factor in parts:
                g = by_name[name](g, factor * by)
            return g

        return apply

    moves: list[tuple[str, Change, float, float]] = []
    if {"north_deg", "clock_min"} <= by_name.keys():
        moves.append(("valley", along_valley, 2.0, 0.12))
    if pose is not None and set(POSE_NAMES) <= by_name.keys():
        moves.append(("discs", _along_discs(pose), 2.0, 0.12))
    if {"north_deg", "wall_azimuth_deg"} <= by_name.keys():
        change = together(("north_deg", -1.0), ("wall_azimuth_deg", 1.0))
        moves.append(("wall and north", change, 0.5, 0.03))
    if "width_m" in by_name:
        across = [("camera_x_m", 1.0), ("width_m", 1.0)]
        along = [("camera_y_m", 1.0), ("depth_m", 1.0)]
        moves.append(("west wall", together(*across), 0.04, 0.004))
        moves.append(("south wall", together(*along), 0.04, 0.004))
        for number, rect in enumerate(guess.windows, start=1):
            left, right = f"window {number} u0", f"window {number} u1"
            low, high = f"window {number} z0", f"window {number} z1"
            if left not in by_name:
                continue
            free = across if rect.wall in ("south", "north") else along
            slide = [(left, 1.0), (right, 1.0)]
            moves.append((f"slide {number}", together(*slide), 0.04, 0.004))
            moves.append((f"lift {number}", together((low, 1.0), (high, 1.0)), 0.04, 0.004))
            moves.append((f"grow {number}", together((left, -1.0), (right, 1.0)), 0.04, 0.004))
            moves.append((f"shell {number}", together(*slide, *free), 0.04, 0.004))
            moves.append((f"camera {number}", together(*slide, free[0]), 0.04, 0.004))
    return moves


def _along_discs(pose: PosePrior) -> Change:
    """A later clock with the pose that keeps the sun's discs where they are."""
    slopes = pose.covariance[:3, 3] / pose.covariance[3, 3]

    def change(guess: Guess, by_min: float) -> Guess:
        clock = float(np.clip(guess.clock_min + by_min, -19.0, 19.0))
        moved = clock - guess.clock_min
        fields = {
            name: getattr(guess, name) + float(slope) * moved
            for name, slope in zip(POSE_NAMES[:3], slopes, strict=True)
        }
        return replace(guess, clock_min=clock, **fields)

    return change


def along_valley(guess: Guess, by_min: float) -> Guess:
    """A later clock with north following the sun, so that patches stay where they are at noon."""
    clock = float(np.clip(guess.clock_min + by_min, -19.0, 19.0))
    moved = clock - guess.clock_min
    north = guess.north_deg - SUN_DEG_PER_MIN * moved
    return replace(guess, clock_min=clock, north_deg=north)
