"""Minimise sums of squares: by Levenberg and Marquardt, and along principal axes of the curvature.

Numbers that compensate for each other, such as a wall's azimuth, a window and the camera, form
valleys that steps of single numbers do not follow. The axes are eigenvectors of the Gauss-Newton
matrix, from numeric differences; flat directions have the longest steps. Steps along them also get
past the kinks of a cost at edges of solids, where a Levenberg-Marquardt step only goes up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from fieldlum.arrays import Array, Floats
from fieldlum.scene_fit.guess import Guess
from fieldlum.scene_fit.parameters import POSE_NAMES, Change, Parameter
from fieldlum.scene_fit.search import Objective, search_moves

# Chosen, not varied. The first step along a principal axis changes the cost by `_PRINCIPAL_GAIN`,
# but is at most `_LONGEST_STEPS` first steps of the parameters.
_LONGEST_STEPS = 3.0
_PRINCIPAL_GAIN = 0.02
# Of Levenberg-Marquardt; chosen, as usual for it.
_STEPS, _TRIES = 4, 6
_DAMPING, _LEAST_DAMPING, _MORE, _LESS = 1e-2, 1e-4, 4.0, 6.0
_LONGEST = 2.0  # first steps of a parameter in one step
_SMALL_GAIN = 1e-3


class LeastSquares(Protocol):
    """A cost that is a sum of squared residuals plus the prior of `objective`."""

    @property
    def objective(self) -> Objective:
        """Prior, albedos and evidence."""
        ...

    def __call__(self, guess: Guess) -> float:
        """Return the cost of a guess."""
        ...

    def residuals(self, guess: Guess) -> Array:
        """Return numbers whose squares add up to the cost without prior, [k]."""
        ...

    def move_base(self, guess: Guess) -> None:
        """Prepare for guesses near this one."""
        ...


def damped_search(
    cost: LeastSquares,
    guess: Guess,
    parameters: Sequence[Parameter],
    share: float,
    *,
    steps: int = _STEPS,
    small_gain: float = _SMALL_GAIN,
) -> Guess:
    """Return a guess of lower cost, by at most `steps` steps of Levenberg and Marquardt.

    share: step of the slopes, which are central differences, in first steps of the parameters;
    small_gain: the search ends after a step that lowers the cost by a smaller share.
    """
    least = cost(guess)
    damping = _DAMPING
    for _ in range(steps):
        cost.move_base(guess)
        curvature, slope = normal_equations(cost, guess, parameters, share)
        for _ in range(_TRIES):
            damped = curvature + damping * np.diag(np.diag(curvature))
            damped += 1e-9 * np.trace(curvature) * np.eye(len(parameters))
            moves = np.clip(-np.linalg.solve(damped, slope), -_LONGEST, _LONGEST)
            found = guess
            for p, step in zip(parameters, moves, strict=True):
                found = p.change(found, float(step * p.first_step))
            now = cost(found)
            if now < least:
                break
            damping *= _MORE
        else:
            return guess
        gain = 1.0 - now / least
        guess, least, damping = found, now, max(damping / _LESS, _LEAST_DAMPING)
        if gain < small_gain:
            return guess
    return guess


def normal_equations(
    cost: LeastSquares, guess: Guess, parameters: Sequence[Parameter], share: float
) -> tuple[Array, Array]:
    """Return half of the cost's curvature [p, p] and slope [p], by first steps of parameters."""
    objective = cost.objective
    base = cost.residuals(guess).astype(np.float32)
    slopes = np.empty((len(parameters), len(base)), np.float32)
    prior_slope = np.empty(len(parameters))
    for k, p in enumerate(parameters):
        step = share * p.first_step
        ahead, behind = p.change(guess, step), p.change(guess, -step)
        slopes[k] = (cost.residuals(ahead) - cost.residuals(behind)) / (2.0 * share)
        prior_slope[k] = (objective.prior(ahead) - objective.prior(behind)) / (4.0 * share)
    curvature = (slopes @ slopes.T).astype(float) + prior_curvature(objective, parameters)
    return curvature, (slopes @ base).astype(float) + prior_slope


def principal_search(
    cost: LeastSquares,
    guess: Guess,
    parameters: Sequence[Parameter],
    share: float = 0.5,
    *,
    gain: float = _PRINCIPAL_GAIN,
) -> tuple[Guess, float]:
    """Return the best guess along the principal axes of the cost's curvature, and its cost.

    The axes are searched one after the other. share: step of the slopes, in first steps of the
    parameters; gain: share of the cost that the first step along an axis changes.
    """
    curvature, _ = normal_equations(cost, guess, parameters, share)
    values, vectors = np.linalg.eigh(curvature)
    lengths = np.sqrt(gain * cost(guess) / np.maximum(values, 1e-12))
    moves: list[tuple[str, Change, float, float]] = []
    for k, first in enumerate(np.minimum(lengths, _LONGEST_STEPS)):
        change = _along(parameters, vectors[:, k])
        moves.append((f"axis {k}", change, float(first), float(first) / 8.0))
    return search_moves(cost, guess, moves)


def prior_curvature(objective: Objective, parameters: Sequence[Parameter]) -> Floats:
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


def _along(parameters: Sequence[Parameter], direction: Floats) -> Change:
    """Return a change of all parameters by `direction` [p] times their first steps."""
    return lambda guess, by: _moved(guess, parameters, by * direction)


def _moved(guess: Guess, parameters: Sequence[Parameter], steps: Floats) -> Guess:
    """Return the guess with each parameter changed by a number of first steps, [p]."""
    for p, step in zip(parameters, steps, strict=True):
        guess = p.change(guess, float(step * p.first_step))
    return guess
