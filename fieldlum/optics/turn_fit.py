"""Fit the turn of a camera to the differences of two pictures (Lucas and Kanade 1981).

Both kinds of turn use it: within a bracket (`merge.shift`) and between captures
(`learn.models.camera_turns`). They differ in what they compare, and in what else may change.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats, Indices
from fieldlum.core.statistics import MAD_TO_SIGMA, cauchy_weights

_ROUNDS = 4  # of robust weights; not measured
_MAX_CONDITION = 1e6  # of the scaled normal matrix: beyond, edges do not determine the unknowns


@dataclass(frozen=True, slots=True)
class Contrasts:
    """A factor on some values that is free in each group, and is therefore removed from a fit.

    values [m] : to which the factor belongs; group [m] : number of the group, from 0.
    """

    values: Floats
    group: Indices

    def removed(self, column: Floats, weights: Floats) -> Floats:
        """Return a column [m] without its weighted regression on the values of each group."""
        along = np.bincount(self.group, weights * self.values * column)
        norm = np.bincount(self.group, weights * self.values**2)
        return column - self.values * (along / np.maximum(norm, 1e-12))[self.group]


def fit_turn(
    design: Floats,
    target: Floats,
    block: Indices,
    *,
    weights: Floats | None = None,
    contrasts: Contrasts | None = None,
) -> tuple[Floats, Floats] | None:
    """Return the unknowns [k] of robust least squares, and their covariance [k, k].

    design [m, k] : changes of the values by one unit of each unknown, the turn about three axes
    first; target [m] : differences of the values; block [m] : numbers, from 0, of the parts of the
    picture whose errors are independent of each other, for the covariance (sandwich estimate).
    weights [m] : of the values, before the robust ones. Residuals beyond two standard deviations
    lose weight, because shadows and people move. None if the edges do not determine the unknowns.
    """
    scale = np.sqrt((design**2).mean(axis=0)) + 1e-30
    base = np.ones(len(target)) if weights is None else weights
    robust, solved = base, None
    for _ in range(_ROUNDS):
        solved = _solve(design / scale, target, robust, contrasts)
        if solved is None:
            return None
        size = np.abs(solved.rest) * np.sqrt(base)
        sigma = MAD_TO_SIGMA * float(np.median(size)) + 1e-30
        robust = base * cauchy_weights(size, 2.0 * sigma)
    assert solved is not None
    scores = np.stack([np.bincount(block, solved.pull * c) for c in solved.columns.T])
    half = solved.inverse @ scores / scale[:, None]  # [k, blocks]
    return solved.unknowns / scale, half @ half.T


class _Solved(NamedTuple):
    """A solution: unknowns [k], residuals [m], and these times their weights (pull) [m].

    columns [m, k] : of the design, without contrasts; inverse [k, k] : of the normal matrix.
    """

    unknowns: Floats
    rest: Floats
    pull: Floats
    columns: Floats
    inverse: Floats


def _solve(
    columns: Floats, values: Floats, weights: Floats, contrasts: Contrasts | None
) -> _Solved | None:
    if contrasts is not None:
        columns = np.stack([contrasts.removed(c, weights) for c in columns.T], axis=1)
        values = contrasts.removed(values, weights)
    normal = columns.T @ (weights[:, None] * columns)
    if np.linalg.cond(normal) > _MAX_CONDITION:
        return None
    inverse = np.linalg.inv(normal)
    unknowns = inverse @ (columns.T @ (weights * values))
    rest = values - columns @ unknowns
    return _Solved(unknowns, rest, weights * rest, columns, inverse)
