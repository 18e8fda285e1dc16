"""Search scenes along the principal axes of the misfit's curvature, where single steps stop.

Numbers that compensate for each other, such as a wall's azimuth, a window and the camera, form
valleys that steps of single numbers do not follow. The axes are eigenvectors of the Gauss-Newton
matrix, from numeric differences; flat directions have the longest steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.scene_fit.guess import Guess
from fieldlum.scene_fit.parameters import POSE_NAMES, Change, Parameter
from fieldlum.scene_fit.search import Objective, search_moves

Array = NDArray[np.floating]

# Chosen, not varied. The first step along a principal axis changes the cost by `_PRINCIPAL_GAIN`,
# but is at most `_LONGEST_STEPS` first steps of the parameters.
_LONGEST_STEPS = 3.0
_PRINCIPAL_GAIN = 0.02
# First standard deviation of the drawn scenes, in first steps along the axes, and the number of
# scenes; chosen in rooms of bench/scene_rooms.py (decision 28).
_DRAWN_STEPS = 0.25
DRAWN_SCENES = 4000


@dataclass(frozen=True, slots=True)
class PrincipalAxes:
    """The principal axes of a cost's curvature at a guess.

    directions: of unit length, in first steps of the p parameters, one in each column [p, p];
    lengths: first step along each [p]; cost: of the guess.
    """

    guess: Guess
    parameters: Sequence[Parameter]
    directions: Array
    lengths: Array
    cost: float

    def moved(self, along: Array) -> Guess:
        """Return the guess moved along all axes by `along` [p], in first steps of the axes."""
        return _moved(self.guess, self.parameters, self.directions @ (self.lengths * along))


def principal_axes(
    objective: Objective, guess: Guess, parameters: Sequence[Parameter]
) -> PrincipalAxes:
    """Return the principal axes of the cost at a guess."""
    base = objective.residuals(guess)
    cost = objective(guess)
    columns = [
        2.0 * (objective.residuals(p.change(guess, 0.5 * p.first_step)) - base) for p in parameters
    ]
    slopes = np.stack(columns, axis=1)  # [n m + q, p] per first step
    values, vectors = np.linalg.eigh(slopes.T @ slopes + _prior_curvature(objective, parameters))
    lengths = np.sqrt(_PRINCIPAL_GAIN * cost / np.maximum(values, 1e-12))
    return PrincipalAxes(guess, parameters, vectors, np.minimum(lengths, _LONGEST_STEPS), cost)


def principal_search(
    objective: Objective, guess: Guess, parameters: Sequence[Parameter]
) -> tuple[Guess, float]:
    """Return the best guess along the principal axes, one after the other, and its cost."""
    axes = principal_axes(objective, guess, parameters)
    moves: list[tuple[str, Change, float, float]] = []
    for k, first in enumerate(axes.lengths):
        change = _along(parameters, axes.directions[:, k])
        moves.append((f"axis {k}", change, float(first), float(first) / 8.0))
    return search_moves(objective, guess, moves)


def drawn_search(
    objective: Objective,
    guess: Guess,
    parameters: Sequence[Parameter],
    seed: int,
    tick: Callable[[int], None] = lambda drawn: None,
) -> tuple[Guess, float]:
    """Return the best of 4 000 scenes drawn around a guess, and its cost.

    If none costs less than the guess, return the guess. tick: called with the number of scenes
    drawn so far.

    CMA-ES (Hansen, The CMA evolution strategy, arXiv:1604.00772) draws all numbers together, first
    in steps along the principal axes, and learns from the costs in which directions to draw.
    """
    import cma

    axes = principal_axes(objective, guess, parameters)
    best, least = guess, axes.cost
    rng = np.random.default_rng(seed)
    options = {
        "maxfevals": DRAWN_SCENES,
        "randn": lambda *shape: rng.standard_normal(shape),
        "seed": np.nan,  # cma must not seed numpy's global numbers
        "verbose": -9,
    }
    draws = cma.CMAEvolutionStrategy(np.zeros(len(parameters)), _DRAWN_STEPS, options)
    while not draws.stop():
        steps = draws.ask()  # each [p]
        trials = [axes.moved(step) for step in steps]
        costs = [objective(trial) for trial in trials]
        draws.tell(steps, costs)
        tick(draws.countevals)
        k = int(np.argmin(costs))
        if costs[k] < least:
            best, least = trials[k], costs[k]
    return best, least


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
    """Return a change of all parameters by `direction` [p] times their first steps."""
    return lambda guess, by: _moved(guess, parameters, by * direction)


def _moved(guess: Guess, parameters: Sequence[Parameter], steps: Array) -> Guess:
    """Return the guess with each parameter changed by a number of first steps, [p]."""
    for p, step in zip(parameters, steps, strict=True):
        guess = p.change(guess, float(step * p.first_step))
    return guess
