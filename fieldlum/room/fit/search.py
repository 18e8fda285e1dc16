"""Search for the scene that explains the captures, by a pattern search.

Each step changes one number, or several numbers that compensate for each other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from fieldlum.room.fit.evidence import SceneEvidence
from fieldlum.room.fit.guess import Bar, Guess, Solid, WindowRect, camera_is_free
from fieldlum.room.fit.parameters import POSE_NAMES, SUN_DEG_PER_MIN, Change, Parameter
from fieldlum.room.fit.renderer import SHELL
from fieldlum.room.scene.geometry import WALLS

if TYPE_CHECKING:
    from fieldlum.room.fit.pose_prior import PosePrior

Array = NDArray[np.floating]

# Chosen, not varied. After `MAX_MOVES` in one direction the other numbers have their turn. A gain
# below `MIN_GAIN_SHARE` of the cost is noise.
MAX_MOVES = 6
MIN_GAIN_SHARE = 1e-4
# Of the stated misfit: what one standard deviation of one number must pay. With a third of it the
# coarse search of a room with a canopy moved the clock by 13 minutes (bench/scene_rooms.py).
PRIOR_SHARE = 0.0015


class GuessCost(Protocol):
    """The cost that a search minimises, as a function of a guess."""

    @property
    def pose(self) -> PosePrior | None:
        """The prior of north, tilt, roll [deg] and clock [min]; None for under three sun discs."""
        ...

    def __call__(self, guess: Guess) -> float:
        """Return the cost of a guess."""
        ...


@dataclass(slots=True)
class Objective:
    """Misfit plus prior of a guess, for some evidence.

    start: the stated guess; parameters: those that have a prior; albedo: of west, east, south and
    north wall, floor, ceiling [6 or more, of which 6 count: solids have their own]; prior_unit:
    cost of one standard deviation of one parameter; pose: replaces the priors of north, tilt, roll
    and clock; count: number of evaluations so far.
    """

    evidence: SceneEvidence
    start: Guess
    parameters: Sequence[Parameter]
    albedo: Array
    prior_unit: float
    pose: PosePrior | None = None
    count: int = field(default=0)
    _seen: tuple[Guess | None, float] = field(default=(None, 0.0), init=False)

    def __call__(self, guess: Guess) -> float:
        """Return the misfits of sun patches and of the windows' picture, plus the prior."""
        self.count += 1
        return self.evidence.mean_misfit(guess, self.albedo_of(guess)) + self.without_patches(guess)

    def without_patches(self, guess: Guess) -> float:
        """Return the cost that all hours share: misfit of the windows' picture plus the prior.

        It is infinite if a solid holds the camera.
        """
        if not camera_is_free(guess):
            return np.inf
        key = replace(guess, north_deg=0.0, clock_min=0.0)  # neither moves the windows' picture
        if key != self._seen[0]:
            self._seen = key, self.evidence.view.misfit(guess)
        return self._seen[1] + self.prior(guess)

    def misfits(self, guess: Guess) -> Array:
        """Return the misfit (0 to 1) of each hour's sun patches, [n].

        The windows' picture is left out: it has no hours, and its reveals of one luminance are a
        rough model, which would make uncertainties too small.
        """
        return self.evidence.misfit(self.evidence.patches(guess, self.albedo_of(guess)))

    def albedo_of(self, guess: Guess) -> Array:
        """Return the albedos of west, east, south, north, floor, ceiling, solids, [6 + solids]."""
        return np.concatenate([self.albedo[:SHELL], [solid.albedo for solid in guess.solids]])

    def prior(self, guess: Guess) -> float:
        """Return the cost of deviating from the stated numbers.

        It is `prior_unit` times the sum of squared deviations in standard deviations. If sun discs
        determined a pose, north, tilt, roll and clock are compared with that pose instead: they
        count by their squared Mahalanobis distance from it.
        """
        by_disc = POSE_NAMES if self.pose is not None else ()
        z = [
            (p.read(guess) - p.read(self.start)) / p.sd
            for p in self.parameters
            if p.name not in by_disc
        ]
        pose = 0.0 if self.pose is None else self.pose.cost(guess)
        return self.prior_unit * (float(np.sum(np.square(z))) + pose)


@dataclass(frozen=True, slots=True)
class ViewCost:
    """The cost of a guess without its sun patches: the windows' picture and the prior."""

    objective: Objective

    @property
    def pose(self) -> PosePrior | None:
        """The prior of north, tilt, roll [deg] and clock [min]; None for under three sun discs."""
        return self.objective.pose

    def __call__(self, guess: Guess) -> float:
        """Return the cost of a guess."""
        return self.objective.without_patches(guess)


def pattern_search(
    objective: GuessCost,
    guess: Guess,
    parameters: Sequence[Parameter],
    *,
    coarse: float = 1.0,
    fine: float = 1.0,
) -> tuple[Guess, float]:
    """Search the guess of least cost from a start; return it and its cost.

    Each parameter is stepped up or down while the cost falls. Its step is halved when neither
    direction lowers the cost. Steps begin at `coarse` times the parameter's first step; a parameter
    is left when its step is below `fine` times the last one. Parameters that compensate for each
    other are also moved together (`compound_moves`).
    """
    moves = [(p.name, p.change, coarse * p.first_step, fine * p.last_step) for p in parameters]
    for name, change, first, last in compound_moves(guess, parameters, objective.pose):
        moves.append((name, change, coarse * first, fine * last))
    return search_moves(objective, guess, moves)


def search_moves(
    objective: Callable[[Guess], float],
    guess: Guess,
    moves: Sequence[tuple[str, Change, float, float]],
) -> tuple[Guess, float]:
    """Search the guess of least cost by some moves from a start; return it and its cost.

    A move has a unique name, a function change(guess, by), a first and a last step. A step is
    halved when neither direction lowers the cost by over 0.01 %; the search ends when all are below
    their last step.
    """
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
    """Return moves of several numbers along which the misfit hardly changes.

    Each has a name, the change, the first and the last step. A search along single numbers stops in
    such valleys: north and clock; a window, the camera and a wall that shift together; a window's
    two edges; the wall and north; the camera's place, tilt and roll or the walls' azimuth with
    windows that stay where the camera sees them. A move is omitted if `parameters` lack its
    numbers. pose: adds the move of north, tilt, roll and clock that does not shift the sun's discs.
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
            for label, parts in (
                (f"slide {number}", slide),
                (f"lift {number}", [(low, 1.0), (high, 1.0)]),
                (f"grow {number}", [(left, -1.0), (right, 1.0)]),
                (f"shell {number}", [*slide, *free]),
            ):
                moves.append((label, _with_bars(together(*parts)), 0.04, 0.004))
    for name in (name for name in _AIMED if name in by_name):
        step, last = _AIMED[name]
        moves.append((f"aimed {name}", aimed(by_name[name]), step, last))
    return moves


# Numbers that move the windows in the picture, with the first and the last step of moves in which
# the windows follow: those of the number alone. Chosen.
_AIMED = {
    "wall_azimuth_deg": (0.5, 0.03),
    "camera_x_m": (0.04, 0.004),
    "camera_y_m": (0.04, 0.004),
    "tilt_deg": (0.25, 0.03),
    "roll_deg": (0.25, 0.03),
}


def aimed(change: Change) -> Change:
    """Return `change` extended so that the camera sees windows, bars and furniture where it did.

    change(guess, by) returns a changed guess. Furniture is shifted in plan only, by its middle;
    solids outside the room stay.
    """

    def follow(guess: Guess, by: float) -> Guess:
        moved = change(guess, by)
        turn = moved.camera_turn @ guess.camera_turn.T  # from the old room axes to the new ones
        windows = tuple(_followed(guess, moved, rect, turn) for rect in guess.windows)
        solids = tuple(_solid_followed(guess, moved, solid, turn) for solid in guess.solids)
        return replace(moved, windows=windows, solids=solids)

    return _with_bars(follow)


def _with_bars(change: Change) -> Change:
    """Return a change of windows that their bars follow, with their own widths."""

    def follow(bar: Bar, before: WindowRect, after: WindowRect) -> Bar:
        old, new = (before.u_m, after.u_m) if bar.upright else (before.z_m, after.z_m)
        middle = sum(bar.span_m) / 2.0
        share = (middle - old[0]) / (old[1] - old[0])
        shift = new[0] + share * (new[1] - new[0]) - middle
        return replace(bar, span_m=(bar.span_m[0] + shift, bar.span_m[1] + shift))

    def apply(guess: Guess, by: float) -> Guess:
        moved = change(guess, by)
        bars = [follow(b, guess.windows[b.window], moved.windows[b.window]) for b in moved.bars]
        return replace(moved, bars=tuple(bars))

    return apply


def _solid_followed(guess: Guess, moved: Guess, solid: Solid, turn: Array) -> Solid:
    """Return a solid shifted in plan, so that both cameras see its middle in the same direction.

    Its size and height stay. A solid outside the room is not shifted. turn: rotation from the old
    axes of the room to the new ones [3, 3].
    """
    middle = (np.array(solid.low_m) + solid.high_m) / 2.0
    if not all(0.0 <= middle[k] <= guess.size_m[k] for k in (0, 1)):
        return solid
    dx, dy, _ = np.array(moved.camera_m) + turn @ (middle - guess.camera_m) - middle
    (x0, y0, z0), (x1, y1, z1) = solid.low_m, solid.high_m
    low, high = (x0 + float(dx), y0 + float(dy), z0), (x1 + float(dx), y1 + float(dy), z1)
    return replace(solid, low_m=low, high_m=high)


def _followed(guess: Guess, moved: Guess, rect: WindowRect, turn: Array) -> WindowRect:
    """Return a window whose edges are where the moved camera looks at those of the guess."""
    axis, side = WALLS[rect.wall]
    along = 1 - axis
    inner = guess.size_m[axis] if side else 0.0
    moved_inner = moved.size_m[axis] if side else 0.0
    eye, moved_eye = np.array(guess.camera_m), np.array(moved.camera_m)
    points = np.zeros((4, 3))  # the middles of the left, right, lower and upper edge
    points[:, axis] = inner
    points[:, along] = [*rect.u_m, *2 * [sum(rect.u_m) / 2.0]]
    points[:, 2] = [*2 * [sum(rect.z_m) / 2.0], *rect.z_m]
    toward = (points - eye) @ turn.T
    reach = (moved_inner - moved_eye[axis]) / toward[:, axis]
    points = moved_eye + reach[:, None] * toward
    u, z = points[:2, along], points[2:, 2]
    return replace(rect, u_m=(float(u[0]), float(u[1])), z_m=(float(z[0]), float(z[1])))


def _along_discs(pose: PosePrior) -> Change:
    """Return a change to a later clock, with the pose that does not move the sun's discs."""
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
    """Return the guess at a clock `by_min` later, with north turned so that noon patches stay.

    North decreases by 0.25 degrees a minute; the clock stays within -19 and 19 min.
    """
    clock = float(np.clip(guess.clock_min + by_min, -19.0, 19.0))
    moved = clock - guess.clock_min
    north = guess.north_deg - SUN_DEG_PER_MIN * moved
    return replace(guess, clock_min=clock, north_deg=north)
