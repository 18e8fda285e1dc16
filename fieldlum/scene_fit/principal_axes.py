"""Search scenes along the principal axes of the misfit's curvature, where single steps stop.

Numbers that compensate for each other, such as a wall's azimuth, a window and the camera, form
valleys that steps of single numbers do not follow. The axes are eigenvectors of the Gauss-Newton
matrix, from numeric differences; flat directions have the longest steps.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fieldlum.arrays import Floats
from fieldlum.scene_fit.guess import Guess
from fieldlum.scene_fit.parameters import POSE_NAMES, Change, Parameter
from fieldlum.scene_fit.search import Objective, search_moves

# Chosen, not varied. The first step along a principal axis changes the cost by `_PRINCIPAL_GAIN`,
# but is at most `_LONGEST_STEPS` first steps of the parameters.
_LONGEST_STEPS = 3.0
_PRINCIPAL_GAIN = 0.02


def principal_search(
    objective: Objective, guess: Guess, parameters: Sequence[Parameter]
) -> tuple[Guess, float]:
    """Return the best guess along the principal axes of the misfit's curvature, and its cost.

    The axes are searched one after the other.
    """
    base = objective.residuals(guess)
    columns = [
        2.0 * (objective.residuals(p.change(guess, 0.5 * p.first_step)) - base) for p in parameters
    ]
    slopes = np.stack(columns, axis=1)  # [n m + q, p] per first step
    values, vectors = np.linalg.eigh(slopes.T @ slopes + prior_curvature(objective, parameters))
    lengths = np.sqrt(_PRINCIPAL_GAIN * objective(guess) / np.maximum(values, 1e-12))
    moves: list[tuple[str, Change, float, float]] = []
    for k, first in enumerate(np.minimum(lengths, _LONGEST_STEPS)):
        change = _along(parameters, vectors[:, k])
        moves.append((f"axis {k}", change, float(first), float(first) / 8.0))
    return search_moves(objective, guess, moves)


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
