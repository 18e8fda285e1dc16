"""Fit all pixels by weighted Bayesian ridge, and predict each hour from the other days.

Each pixel minimises  sum_t w_t (y_t - F_t b - C_t g)^2 / noise + |b|^2 + sum_k (g_k - 1)^2 /
variance_k, with features F that all pixels share and columns C of its own: computed light, sun
patch and window sky. Robust rounds move the solution to the least squared error of the logarithm.
A second stage predicts the log residual by a Gaussian process that all pixels share. Everything is
in closed form.

n: captured hours, P: pixels, r: features, k: columns of each pixel.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from threadpoolctl import threadpool_limits

from fieldlum.core.arrays import Array, Floats, Floats32, Indices
from fieldlum.core.statistics import cauchy_weights, nan_percentiles
from fieldlum.learn.models.held_out_choice import beam_variance, weight_of_variance
from fieldlum.learn.transport.training_arrays import MIN_CDM2, TrainingArrays, pixel_scale
from fieldlum.sky.light_similarity import Features

RANK = 100  # number of features; chosen, limits memory and time
# Prior variances of the gains of computed light (next to its level in the captures), sun patch and
# window sky. Errors with 1e-6 for computed light differ by 4 % or less, except 30 % less and 12 %
# more in two of twelve fits; the others are not measured.
COMPUTED_VARIANCE, PATCH_VARIANCE, SKY_VARIANCE = 0.04, 0.0625, 0.04
ROUNDS = 1  # of robust solves; a second changes DGP and maps by under 1.5 %; measured
ROBUST_WIDTH = 0.15  # log residual at which a capture has half weight; not measured
# Of a pixel's usual light: surfaces are never predicted darker. With a thousandth, the log10 MSE of
# greensboro is 1.16 times as large.
MIN_SHARE = 0.1
# Chord between two sun directions over which the second stage corrects the log residual. Without
# the second stage, the error of a Radiance room with a fitted scene is 1.2 times as large.
SECOND_WIDTH = 0.15
SECOND_NOISE = 0.06  # noise of the second stage's log residuals; not measured

Tick = Callable[[int, int], None]
"""A function that shows progress: it gets the number of completed items, and of all."""


@dataclass(frozen=True)
class Basis:
    """The r features of the n captured hours, from the kernel's eigenvectors.

    values: features of the captured hours [n, r]; projector [n, r]: the features of a new hour are
    kernel(new, captured) @ projector; assumed: features of the captured hours under Perez's skies
    [n, r], with which held-out hours are predicted; equal to `values` unless the fit has other
    skies.
    """

    values: Array
    projector: Array
    assumed: Array

    @cached_property
    def pairs(self) -> tuple[Array, Indices, Indices]:
        """Products F_a F_b of an hour's features for all pairs a <= b, with the indices a and b.

        Shapes: products [n, r (r + 1) / 2], a and b [r (r + 1) / 2].
        """
        a, b = np.triu_indices(self.values.shape[1])
        return self.values[:, a] * self.values[:, b], a, b


def basis_of(covariance: Array, assumed: Array | None = None) -> Basis:
    """Return the features that belong to the largest eigenvalues of the kernel, at most RANK.

    covariance: kernel between the captured hours [n, n]; assumed: kernel between these hours under
    Perez's skies and the captured hours [n, n], None if `covariance` is that. `values` are the
    eigenvectors times the roots of their eigenvalues, `projector` is the eigenvectors divided by
    these roots. Eigenvalues below a millionth of the largest are omitted.
    """
    eigenvalues, vectors = np.linalg.eigh(covariance)
    used = np.argsort(eigenvalues)[::-1][:RANK]
    used = used[eigenvalues[used] > 1e-6 * eigenvalues[used[0]]]
    root = np.sqrt(eigenvalues[used])
    values, projector = vectors[:, used] * root, vectors[:, used] / root
    return Basis(values, projector, values if assumed is None else assumed @ projector)


@dataclass(frozen=True, slots=True)
class Columns:
    """The k columns of each pixel: known light, of which the fit finds the gains.

    values: computed light, sun patch and window sky over total light and pixel scale, the first two
    only if they are used [k, n, P]; variance: prior variance of the gains, whose prior mean is 1
    [k]; surface: number of columns, from the first, that are light of the surface itself: 1 with
    computed light, else 0.
    """

    values: Floats
    variance: Array
    surface: int

    @classmethod
    def of(cls, arrays: TrainingArrays, unit: Array, computed: Floats32 | None) -> Columns:
        """Return the columns of the pixels of `arrays`.

        unit: total light times pixel scale [n, P] cd/m2; computed: luminance by the coarse model of
        the room [n, P] cd/m2, None without a room.
        """
        parts = [(arrays.sky, SKY_VARIANCE)]
        if arrays.patch is not None:
            parts.insert(0, (arrays.patch, PATCH_VARIANCE))
        if computed is not None:
            parts.insert(0, (computed, COMPUTED_VARIANCE))
        values = np.stack([part / unit for part, _ in parts])
        return cls(values, np.array([v for _, v in parts]), int(computed is not None))

    def design(self, features: Array) -> Array:
        """Return each pixel's design matrix: features [n, r], then its columns, [P, n, r + k]."""
        shared = np.broadcast_to(features, (self.values.shape[2], *features.shape))
        return np.concatenate((shared, self.values.transpose(2, 1, 0)), axis=2)

    def direct(self, gains: Array) -> Array:
        """Return the light of sun patch and window sky, in the unit of `values`, [n, P].

        gains: of the columns [P, k]; negative ones count as 0.
        """
        direct = slice(self.surface, None)
        return np.einsum("knp,pk->np", self.values[direct], np.maximum(gains[:, direct], 0.0))


@dataclass(frozen=True, slots=True)
class PixelFit:
    """Fitted values of P pixels.

    scale: usual luminance per lx of total light [P] cd/m2/lx; b: coefficients of the r features, in
    units of the scale [P, r]; patch_gain, sky_gain: factors on the sun patch and on the sky behind
    windows [P]; second: weights of the n captures in the second stage [n, P]; computed_gain: factor
    on the computed light, 0 if it is not used [P]; noise: likeliest standard deviation of the log
    residual, in units of the second stage's covariance [P].
    """

    scale: Floats32
    b: Floats32
    patch_gain: Floats32
    sky_gain: Floats32
    second: Floats32
    computed_gain: Floats32
    noise: Floats32


def for_each_chunk(work: Callable[[slice], None], count: int, tick: Tick | None = None) -> None:
    """Call `work` with slices that divide `count` pixels, on up to eight cores.

    tick: called after each slice with the number of completed pixels and `count`. BLAS uses one
    thread here, because on systems of a hundred unknowns its threads wait for each other.
    """
    # The normal matrices of 128 pixels stay in the cache: chunks of 1024 pixels take 1.5 times as
    # long.
    parts = [slice(start, min(start + 128, count)) for start in range(0, count, 128)]
    workers = min(os.cpu_count() or 1, 8)  # limits the memory
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(workers) as pool:
        for part, _ in zip(parts, pool.map(work, parts), strict=True):
            if tick is not None:
                tick(part.stop, count)


# ----------------------------------------------------------------------------------------------
# ridge


def normal_equations(
    basis: Basis, columns: Columns, target: Array, weights: Array, noise: float
) -> tuple[Array, Array]:
    """Return matrix [P, r + k, r + k] and right side [P, r + k] of each pixel's normal equations.

    The unknowns are the deviations of r coefficients and k gains from their prior means, and the
    matrix includes the prior. basis: features that all pixels share; columns: of each pixel;
    target: captured luminance over total light and pixel scale [n, P]; weights: of the targets
    [n, P]; noise: variance of a target of weight 1.
    """
    features, (products, first, second) = basis.values, basis.pairs
    count, r, k = target.shape[1], features.shape[1], len(columns.variance)
    precision = np.ascontiguousarray(weights.T) / noise  # [P, n]
    matrix = np.empty((count, r + k, r + k))
    matrix[:, first, second] = matrix[:, second, first] = precision @ products
    rest = (target - columns.values.sum(axis=0)).T * precision
    right = np.empty((count, r + k))
    right[:, :r] = rest @ features
    for a in range(k):
        weighted = columns.values[a].T * precision
        matrix[:, r + a, :r] = matrix[:, :r, r + a] = weighted @ features
        right[:, r + a] = (columns.values[a].T * rest).sum(axis=1)
        for b in range(a, k):
            cross = (weighted * columns.values[b].T).sum(axis=1)
            matrix[:, r + a, r + b] = matrix[:, r + b, r + a] = cross
    prior = np.concatenate((np.ones(r), 1.0 / columns.variance))
    matrix[:, np.arange(r + k), np.arange(r + k)] += prior
    return matrix, right


def solve(
    basis: Basis, columns: Columns, target: Array, weights: Array, noise: float
) -> tuple[Array, Array]:
    """Return the coefficients b [P, r] and the gains [P, k] of every pixel.

    They minimise the weighted sum of squared errors plus the prior's term that the top of this
    module states. basis: r features that all pixels share; columns: k of each pixel; target [n, P]:
    captured luminance over total light and pixel scale; weights [n, P]: of the targets; noise:
    variance of a target of weight 1.
    """
    r = basis.values.shape[1]
    matrix, right = normal_equations(basis, columns, target, weights, noise)
    solution = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
    return solution[:, :r], solution[:, r:] + 1.0


@dataclass(frozen=True, slots=True)
class ChunkFit:
    """The fit of P pixels to n hours.

    columns: of the pixels; target: captured luminance over total light and pixel scale [n, P];
    response, weights: values that the last solve fitted, and their weights [n, P]; b: coefficients
    of the features [P, r]; gains: of the columns [P, k].
    """

    columns: Columns
    target: Array
    response: Array
    weights: Array
    b: Array
    gains: Array

    def light(self, basis: Basis) -> Array:
        """Return the fitted luminance over total light and pixel scale, [n, P].

        basis: the features with which the pixels were fitted.
        """
        count = self.columns.surface
        computed = np.einsum("knp,pk->np", self.columns.values[:count], self.gains[:, :count])
        surfaces = np.maximum(basis.values @ self.b.T + computed, MIN_SHARE)
        return surfaces + self.columns.direct(self.gains)


def fit_chunk(arrays: TrainingArrays, scale: Array, basis: Basis, noise: float) -> ChunkFit:
    """Fit the P pixels of `arrays`: least relative errors, then robust rounds by Gauss and Newton.

    Weights 1 / y^2 favour hours in which noise makes y too small: at a noise of 20 % the fit is 6 %
    too dark. Squared log errors, linearised about the fit f, are a ridge problem again, with
    response f (1 + ln(y / f)) and weights 1 / f^2, which robust weights of the log errors multiply.
    The prior also shrinks the level, so a last factor makes the mean signed log error zero. scale:
    usual luminance of each pixel per lx of total light [P]; basis: features that all pixels share;
    noise: variance of a target of weight 1.
    """
    unit = arrays.light.total_lx[:, None] * scale  # [n, P]
    target = np.maximum(arrays.luminance, MIN_CDM2) / unit
    computed = None if arrays.computed is None else arrays.computed.luminance
    columns = Columns.of(arrays, unit, computed)
    # A value under 3 % of the pixel's usual light has the weight of one of 3 %. In the first solve
    # no value has more weight than the usual one. Otherwise a person, whose clothes are a tenth as
    # bright as the wall behind, has the weight of a hundred hours, and the robust round, which
    # starts at that solution, keeps the person.
    usual = np.exp(np.mean(np.log(target), axis=0))
    dark, response = 0.03 * usual, target
    weights = arrays.trust / np.maximum(target, usual) ** 2
    b, gains = solve(basis, columns, response, weights, noise)
    for _ in range(ROUNDS):
        fitted = _fitted(target, basis, b, columns, gains)
        error = np.log(target / fitted)
        weights = arrays.trust * cauchy_weights(error, ROBUST_WIDTH) / np.maximum(fitted, dark) ** 2
        response = fitted * (1.0 + error)
        b, gains = solve(basis, columns, response, weights, noise)
    error = np.log(target / _fitted(target, basis, b, columns, gains))
    error = arrays.trust * np.clip(error, -2.0 * ROBUST_WIDTH, 2.0 * ROBUST_WIDTH)
    level = np.exp(error.sum(axis=0) / np.maximum(arrays.trust.sum(axis=0), 1e-9))[:, None]
    return ChunkFit(columns, target, response, weights, b * level, gains * level)


def _fitted(target: Array, basis: Basis, b: Array, columns: Columns, gains: Array) -> Array:
    """Return the fitted target [n, P], limited to a factor of five above or below `target` [n, P].

    b [P, r], gains [P, k]: of the features and of the columns. Unlike `ChunkFit.light`, negative
    gains and dark surfaces remain, because the next round is linearised about this fit.
    """
    fitted = basis.values @ b.T + np.einsum("knp,pk->np", columns.values, gains)
    return np.clip(fitted, 0.2 * target, 5.0 * target)


def fit_pixels(
    arrays: TrainingArrays, basis: Basis, noise: float, tick: Tick | None = None
) -> PixelFit:
    """Fit all P pixels of `arrays`, in chunks that limit the memory.

    noise: variance of a target of weight 1. tick: called after each chunk with the number of
    completed pixels and P.
    """
    (hours, features), count = basis.values.shape, arrays.luminance.shape[1]
    scale, zeros = pixel_scale(arrays), partial(np.zeros, dtype=np.float32)
    out = PixelFit(
        scale=scale.astype(np.float32),
        b=zeros((count, features)),
        patch_gain=zeros(count),
        sky_gain=zeros(count),
        second=zeros((hours, count)),
        computed_gain=zeros(count),
        noise=zeros(count),
    )
    inverse = second_inverse(arrays)

    def fit_part(part: slice) -> None:
        """Fit the pixels of the slice `part`, and store their fitted values in `out`."""
        chunk = arrays[part]
        fit = fit_chunk(chunk, scale[part], basis, noise)
        out.b[part] = fit.b
        # Gains are in the order of `Columns`: computed light, sun patch, window sky last.
        out.sky_gain[part] = np.maximum(fit.gains[:, -1], 0.0)
        if chunk.patch is not None:
            out.patch_gain[part] = np.maximum(fit.gains[:, -2], 0.0)
        if chunk.computed is not None:
            out.computed_gain[part] = fit.gains[:, 0] * chunk.computed.gain
        residual = ~chunk.filled * np.log(fit.target / fit.light(basis))
        out.second[:, part] = inverse @ residual
        out.noise[part] = np.sqrt(np.maximum((residual * out.second[:, part]).mean(axis=0), 0.0))

    for_each_chunk(fit_part, count, tick)
    return out


def patch_scale(arrays: TrainingArrays) -> float:
    """Return the factor by which all sun patches must be multiplied to match the captures.

    arrays: with sun patches. The factor is the median of (L - q E) / s over all hours and pixels
    with a clear patch: luminance L, total light E, patch s, and q the median of L / E in the
    pixel's hours without a patch. Compared are pixels with a patch in three hours or more, and in
    half of the hours at most. The factor is 1 without such pixels.
    """
    assert arrays.patch is not None
    if not (arrays.patch > 0.0).any():
        return 1.0
    lit = arrays.patch > 0.02 * np.percentile(arrays.patch[arrays.patch > 0.0], 95)
    compared = (lit.sum(axis=0) >= 3) & (lit.mean(axis=0) <= 0.5)
    total = arrays.light.total_lx[:, None]
    ratio = np.where(lit, np.nan, arrays.luminance / total)[:, compared]
    plain = nan_percentiles(ratio, (50.0,))[0] * total  # q E, [n, compared]
    factors = (arrays.luminance[:, compared] - plain) / np.maximum(arrays.patch[:, compared], 1e-9)
    factors = factors[lit[:, compared]]
    factor = float(np.median(factors)) if len(factors) else 1.0
    return factor if factor > 0.0 else 1.0


# ----------------------------------------------------------------------------------------------
# second stage


def second_covariance(a: Features, b: Features) -> Array:
    """Return the second stage's covariance between the hours of `a` and of `b`, [len(a), len(b)].

    It is the product of the sun's shares of the total light, times a factor that falls from 1 to 0
    as the two directions of the sun differ, because the second stage corrects the sun's light. It
    has no unit.
    """
    cosine = np.clip(a.direction @ b.direction.T, -1.0, 1.0)
    return np.outer(a.beam, b.beam) * np.exp((cosine - 1.0) / SECOND_WIDTH**2)


def second_inverse(arrays: TrainingArrays) -> Array:
    """Return the inverse of the second stage's covariance between the captures plus noise, [n, n].

    Hours of unsteady or unmeasured light, and of a faint beam, have more noise.
    """
    covariance = second_covariance(arrays.features, arrays.features)
    weights = weight_of_variance(arrays.unsure + beam_variance(arrays.light))
    return np.linalg.inv(covariance + np.diag(SECOND_NOISE / weights))


# ----------------------------------------------------------------------------------------------
# held-out days


@dataclass(frozen=True, slots=True)
class HeldOutFit:
    """Each of n captured hours, predicted by a fit to the captures of all other days.

    luminance: predicted [n, P] cd/m2; error: log10 of predicted over captured luminance, where
    values below 1 cd/m2 count as 1, and 0 where the captured value has no weight [n, P]; scale:
    each pixel's mean luminance per lx of total light [P].
    """

    luminance: Array
    error: Array
    scale: Array


def hold_out(arrays: TrainingArrays, basis: Basis, noise: float) -> HeldOutFit:
    """Predict each captured hour [n] from the captures of all other days (`arrays.days`).

    noise: of the fit, variance of a target of weight 1. No fit is repeated: features, robust
    weights and pixel scales are those of the fit to all days. Hours are predicted under Perez's
    skies, as a year is.
    """
    scale = pixel_scale(arrays)
    predicted, target = (np.empty(arrays.luminance.shape) for _ in range(2))

    def predict_part(part: slice) -> None:
        """Store predicted and captured light of the pixels `part`, without the second stage."""
        results = _hold_out_chunk(arrays[part], scale[part], basis, noise)
        predicted[:, part], target[:, part] = results

    for_each_chunk(predict_part, len(scale))
    residual = ~arrays.filled * np.log(target / predicted)
    inverse = second_inverse(arrays)
    solved = inverse @ residual
    for day in np.unique(arrays.days):
        rows = np.flatnonzero(arrays.days == day)
        # Log residual of the day minus its prediction by the second stage from the other days.
        unexplained = np.linalg.solve(inverse[np.ix_(rows, rows)], solved[rows])
        predicted[rows] *= np.exp(residual[rows] - unexplained)
    luminance = predicted * arrays.light.total_lx[:, None] * scale
    # Scores count values below 1 cd/m2 as 1 (floor of the paper).
    log10_predicted, log10_captured = (
        np.log10(np.maximum(values, 1.0)) for values in (luminance, arrays.luminance)
    )
    error = ~arrays.filled * (log10_predicted - log10_captured)
    return HeldOutFit(luminance=luminance, error=error, scale=scale)


def _hold_out_chunk(
    arrays: TrainingArrays, scale: Array, basis: Basis, noise: float
) -> tuple[Array, Array]:
    """Return each hour's light as predicted from other days, and as captured, at P pixels.

    The second stage is not part of the prediction. Both are [n, P], divided by the total light and
    by `scale`, so about 1. With hat matrix H = X A^-1 X' W of the full fit, residuals e and a day's
    rows D, the residuals without the day are d = (1 - H_DD)^-1 e_D (block form of the leave-one-out
    identity), and the fit without the day is the full fit minus A^-1 X_D' W_D d. Features and
    weights are those of the full fit. scale [P]: usual luminance per lx of total light; basis:
    features that all pixels share; noise: variance of a target of weight 1.
    """
    fit = fit_chunk(arrays, scale, basis, noise)
    unit = arrays.light.total_lx[:, None] * scale
    r = basis.values.shape[1]
    perez = Columns.of(arrays, unit, None if arrays.computed is None else arrays.computed.perez)
    design, wanted = fit.columns.design(basis.values), perez.design(basis.assumed)
    matrix, right = normal_equations(basis, fit.columns, fit.response, fit.weights, noise)
    rights = np.concatenate((right[:, :, None], design.transpose(0, 2, 1)), axis=2)
    solved = np.linalg.solve(matrix, rights)
    solution, precision = solved[:, :, 0], fit.weights.T / noise
    # Gains of 1 are the prior mean, from which `solution` deviates.
    rest = (fit.response - fit.columns.values.sum(axis=0)).T
    residual = rest - np.einsum("pna,pa->pn", design, solution)
    out = np.empty(residual.shape)  # [P, n]
    for day in np.unique(arrays.days):
        rows = np.flatnonzero(arrays.days == day)
        hat = design[:, rows] @ solved[:, :, 1 + rows] * precision[:, None, rows]
        errors = np.linalg.solve(np.eye(len(rows)) - hat, residual[:, rows, None])  # [P, d, 1]
        change = solved[:, :, 1 + rows] @ (precision[:, rows, None] * errors)  # [P, r + k, 1]
        deviation = solution - change[:, :, 0]
        deviation[:, r:] += 1.0  # of gains, whose prior mean is 1
        out[:, rows] = np.einsum("pda,pa->pd", wanted[:, rows], deviation)
    # Sun patch and window sky have the gains of the full fit; negative gains count as 0.
    added = slice(perez.surface, None)
    direct = np.einsum("knp,pk->np", perez.values[added], fit.gains[:, added])
    surfaces = np.maximum(out.T - direct, MIN_SHARE)
    return surfaces + perez.direct(fit.gains), fit.target
