"""Fit the turn of a camera to the differences of two pictures (Lucas and Kanade 1981).

Both kinds of turn use it: within a bracket (`merge.shift`) and between captures
(`learn.models.camera_turns`). The two uses differ in what they compare, and in what else may
change.
"""

from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats, Indices
from fieldlum.core.statistics import MAD_TO_SIGMA, cauchy_weights


@dataclass(frozen=True, slots=True)
class Contrasts:
    """Values with a free factor in each group, such as the contrast of edges in parts of a room.

    A fit removes the part of its equations that such factors explain. values [m]: what the factors
    multiply in each of m equations; group [m]: number of the equation's group, from 0.
    """

    values: Floats
    group: Indices

    def residual_of(self, columns: Floats, weights: Floats) -> Floats:
        """Return columns [m, k] minus each group's multiple of `values`, by weighted least squares.

        weights: [m], at least 0.
        """
        weighted = weights * self.values
        norm = np.maximum(np.bincount(self.group, weighted * self.values), 1e-12)
        along = np.stack([np.bincount(self.group, weighted * c) / norm for c in columns.T])
        return columns - (self.values * along[:, self.group]).T


def fit_turn(
    design: Floats,
    target: Floats,
    block: Indices,
    *,
    weights: Floats | None = None,
    contrasts: Contrasts | None = None,
) -> tuple[Floats, Floats] | None:
    """Return the unknowns [k] of robust least squares, and their covariance [k, k].

    design [m, k]: changes of m values by one unit of each of k unknowns, the turn about three axes
    first; target [m]: differences of the values; block [m]: numbers, from 0, of the parts of the
    picture whose errors are independent of each other, for the covariance (sandwich estimate).
    weights [m]: of the values, before the robust ones. contrasts: factors that are removed from the
    values; None for none. Residuals beyond two standard deviations lose weight, because shadows and
    people move. None if the edges do not determine the unknowns.
    """
    scale = np.sqrt((design**2).mean(axis=0)) + 1e-30
    base = np.ones(len(target)) if weights is None else weights
    robust = used = base
    columns, values, inverse = design / scale, target, np.eye(len(scale))
    unknowns, rest, given = np.zeros(len(scale)), target, np.column_stack((columns, target))
    for _ in range(4):
        used = robust
        if contrasts is not None:
            explained = contrasts.residual_of(given, used)
            columns, values = explained[:, :-1], explained[:, -1]
        normal = columns.T @ (used[:, None] * columns)
        if np.linalg.cond(normal) > 1e6:  # edges do not determine the unknowns
            return None
        inverse = np.linalg.inv(normal)
        unknowns = inverse @ (columns.T @ (used * values))
        rest = values - columns @ unknowns
        size = np.abs(rest) * np.sqrt(base)
        sigma = MAD_TO_SIGMA * np.median(size) + 1e-30
        robust = base * cauchy_weights(size, 2.0 * sigma)
    scores = np.stack([np.bincount(block, used * rest * c) for c in columns.T])
    half = inverse @ scores / scale[:, None]  # [k, blocks]
    return unknowns / scale, half @ half.T
