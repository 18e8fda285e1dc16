"""Solve weighted Bayesian ridge for all pixels at once, and predict held-out days.

Each pixel minimises  sum_t w_t (y_t - F_t b - C_t g)^2 / noise + |b|^2 + sum_k (g_k - mean_k)^2 /
variance_k, with features F that all pixels share and columns C of its own. Everything is in closed
form.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fieldlum.core.arrays import Array, Floats, Indices

# Pixels per core at a time, which limits the memory of the normal matrices to some 100 MB each.
# Chosen.
CHUNK = 1024
HELD_OUT_CHUNK = 128  # smaller, because each pixel has a hat matrix; chosen
MOST_THREADS = 8  # limits the memory; chosen


@dataclass(frozen=True, slots=True)
class Columns:
    """The k covariates of each pixel (such as its sun patch), and the prior of their gains.

    values: [k, n, P]; mean, variance: of the Gaussian prior of each gain [k]; surface: how many
    covariates, counted from the first, are light of the surface itself (0, or 1 for the computed
    light); the others are sun patch and window sky.
    """

    values: Floats
    mean: Array
    variance: Array
    surface: int = 0

    def __getitem__(self, pixels: slice | Indices) -> Columns:
        """Return the covariates of the selected pixels."""
        return Columns(self.values[:, :, pixels], self.mean, self.variance, self.surface)


def chunks(count: int, size: int = CHUNK) -> Iterator[slice]:
    """Yield slices of at most `size` pixels that together cover `count` pixels."""
    for start in range(0, count, size):
        yield slice(start, min(start + size, count))


def each_chunk(work: Callable[[slice], None], count: int, size: int = CHUNK) -> Iterator[int]:
    """Call `work` for every chunk, on up to eight cores; yield the number of finished pixels.

    Meanwhile BLAS uses one thread, because on systems of a hundred unknowns its threads wait for
    each other.
    """
    parts = list(chunks(count, size))
    workers = min(os.cpu_count() or 1, MOST_THREADS)
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(workers) as pool:
        for part, _ in zip(parts, pool.map(work, parts), strict=True):
            yield part.stop


def pair_products(features: Array) -> tuple[Array, Indices, Indices]:
    """Return the products of all pairs of features of each hour, and which features they pair.

    features: F [n, r]. The result is F_a F_b for a <= b, [n, r (r + 1) / 2], then the indices a and
    b of its columns.
    """
    a, b = np.triu_indices(features.shape[1])
    return features[:, a] * features[:, b], a, b


def normal_matrices(
    features: Array,
    columns: Columns,
    target: Array,
    weights: Array,
    noise: float,
    products: tuple | None = None,
) -> tuple[Array, Array]:
    """Return A [P, r + k, r + k] and b [P, r + k] of the normal equations A x = b.

    x is the deviation of coefficients and gains from their prior mean, and A includes the prior.
    features: shared by all pixels [n, r]; target, weights: [n, P]; noise: variance of a target of
    weight 1; products: result of `pair_products(features)`, None to compute it here.
    """
    count, r, k = target.shape[1], features.shape[1], len(columns.mean)
    both, i, j = products or pair_products(features)
    w = np.ascontiguousarray(weights.T) / noise
    matrix = np.empty((count, r + k, r + k))
    packed = w @ both
    matrix[:, i, j] = packed
    matrix[:, j, i] = packed
    rest = (target - np.einsum("knp,k->np", columns.values, columns.mean)).T * w
    right = np.empty((count, r + k))
    right[:, :r] = rest @ features
    for a in range(k):
        weighted = columns.values[a].T * w
        matrix[:, r + a, :r] = matrix[:, :r, r + a] = weighted @ features
        right[:, r + a] = (columns.values[a].T * rest).sum(axis=1)
        for b in range(a, k):
            cross = (weighted * columns.values[b].T).sum(axis=1)
            matrix[:, r + a, r + b] = matrix[:, r + b, r + a] = cross
    prior = np.concatenate((np.ones(r), 1.0 / columns.variance))
    matrix[:, np.arange(r + k), np.arange(r + k)] += prior
    return matrix, right


def solve(
    features: Array,
    columns: Columns,
    target: Array,
    weights: Array,
    noise: float,
    products: tuple | None = None,
) -> tuple[Array, Array]:
    """Return the coefficients b [P, r] and the gains [P, k] of every pixel.

    They minimise the sum at the top of this module. features: [n, r]; target, weights: [n, P];
    noise: variance of a target of weight 1; products: result of `pair_products`, None to compute.
    """
    r = features.shape[1]
    matrix, right = normal_matrices(features, columns, target, weights, noise, products)
    solution = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
    return solution[:, :r], solution[:, r:] + columns.mean


def held_out_days(
    features: Array,
    columns: Columns,
    target: Array,
    weights: Array,
    noise: float,
    days: NDArray,
    assumed: Array | None = None,
    assumed_columns: Columns | None = None,
    products: tuple | None = None,
) -> Array:
    """Return the target of each hour as predicted by a fit to the hours of other days, [n, P].

    days [n]: hours of equal values are held out together. assumed [n, r], assumed_columns: features
    and covariates with which hours are predicted, if they differ from those that are fitted; None
    for `features`, `columns`. Other arguments: see `solve`. Each pixel needs memory for n (r + k)
    values several times: pass at most some hundred.

    The fit is not repeated. With hat matrix H = X A^-1 X' W of the full fit, residuals e and a
    day's rows D, the residuals without the day are d = (1 - H_DD)^-1 e_D (block form of the
    leave-one-out identity), and the fit without the day is the full fit minus A^-1 X_D' W_D d.
    Features and weights are those of the full fit.
    """
    asked = features if assumed is None else assumed
    covariates = columns if assumed_columns is None else assumed_columns
    count = target.shape[1]
    matrix, right = normal_matrices(features, columns, target, weights, noise, products)
    shared = np.broadcast_to(features, (count, *features.shape))
    design = np.concatenate((shared, columns.values.transpose(2, 1, 0)), axis=2)  # [P, n, r + k]
    solved = np.linalg.solve(
        matrix, np.concatenate((right[:, :, None], design.transpose(0, 2, 1)), axis=2)
    )
    offset = np.einsum("knp,k->pn", columns.values, columns.mean)
    residual = target.T - offset - np.einsum("pna,pa->pn", design, solved[:, :, 0])
    w = weights.T / noise
    shared = np.broadcast_to(asked - features, (count, *features.shape))
    own = (covariates.values - columns.values).transpose(2, 1, 0)  # [P, n, k]
    other = np.concatenate((shared, own), axis=2)  # [P, n, r + k]
    mean = np.concatenate((np.zeros(features.shape[1]), columns.mean))
    out = np.empty((count, len(days)))
    for day in np.unique(days):
        rows = np.flatnonzero(days == day)
        hat = design[:, rows] @ solved[:, :, 1 + rows] * w[:, None, rows]
        errors = np.linalg.solve(np.eye(len(rows)) - hat, residual[:, rows, None])  # [P, d, 1]
        out[:, rows] = target.T[:, rows] - errors[:, :, 0]
        if other[:, rows].any():
            change = (solved[:, :, 1 + rows] @ (w[:, rows, None] * errors))[:, :, 0]  # [P, r + k]
            coefficients = solved[:, :, 0] - change + mean
            out[:, rows] += np.einsum("pda,pa->pd", other[:, rows], coefficients)
    return out.T


def held_out_days_shared(covariance: Array, noise: float, target: Array, days: NDArray) -> Array:
    """Return the target of each hour as a Gaussian process predicts it from other days, [n, P].

    All pixels share the process. covariance: between hours, without noise [n, n]; noise: variance
    of each value; target: [n, P]; days [n]: hours of equal values are held out together.
    """
    inverse = np.linalg.inv(covariance + noise * np.eye(len(covariance)))
    solved = inverse @ target
    out = np.empty(target.shape)
    for day in np.unique(days):
        rows = np.flatnonzero(days == day)
        out[rows] = target[rows] - np.linalg.solve(inverse[np.ix_(rows, rows)], solved[rows])
    return out
