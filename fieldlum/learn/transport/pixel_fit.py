"""Fit all pixels: features from the kernel, ridge for each pixel, robust rounds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Array, Floats
from fieldlum.learn.transport.features import LEAST_CDM2, TrainingArrays, pixel_scale
from fieldlum.learn.transport.ridge import (
    Columns,
    each_chunk,
    pair_products,
    solve,
)
from fieldlum.sky.light import Kernel, Light

RANK = 100  # number of features; chosen, limits memory and time
# variance of log residuals while the gain of the patches is fitted; not measured
_GAIN_NOISE = 1e-2
_OFTEN_SHARE = 0.75  # of hours with any sun patch; ground before a window is lit in more; chosen
SKY_GAIN_VARIANCE = 0.04  # prior variance of a window pixel's sky gain; not measured
# Prior variance of a pixel's gain of computed light, next to its level in the captures. Errors with
# 1e-6 differ by 4 % or less, except 30 % less and 12 % more in two of twelve fits.
COMPUTED_VARIANCE = 0.04
LOG_STEPS = 2  # number of unbiased solves after the first fit; chosen
LOG_STEP_FROM = 0.03  # rms log error below which the bias (1.5 of its square) is under 0.2 %
ROBUST_WIDTH = 0.15  # log residual at which a capture has half weight; not measured
SECOND_NOISE = 0.06  # noise of the second stage's log residuals; not measured
SECOND_SEASON = 0.02  # variance of changes with the season, with or without sun; not measured
# of a pixel's usual light: darker values (a hand in front of the lens) get no more weight than this
# one; chosen
DARK_SHARE = 0.03
LEAST_SHARE = 0.3  # of a pixel's darkest value: predictions are never lower; not measured


@dataclass(frozen=True, slots=True)
class Recipe:
    """Settings of a fit, which held-out days choose.

    noise: relative variance of a captured value; patch_variance: prior variance of each pixel's
    gain of the sun patch; rounds: number of robust rounds (0: none); second: chord of the sun's
    direction over which the second stage corrects the log residual (0: no second stage); rank:
    greatest number of features; below: True to fit the light without the sun patches and then add
    them unchanged, because doubtful patches would teach wrong light.
    """

    noise: float
    patch_variance: float = 0.0025
    rounds: int = 0
    second: float = 0.0
    rank: int = RANK
    below: bool = False


@dataclass(frozen=True, slots=True)
class Basis:
    """The r features of the n captured hours, from the kernel's eigenvectors.

    values: features of the captured hours [n, r]; projector [n, r]: the features of a new hour are
    kernel(new, captured) @ projector; assumed: features of the captured hours under Perez's skies
    [n, r], with which held-out hours are predicted, None to predict them with `values`.
    """

    values: Array
    projector: Array
    assumed: Array | None = None


def basis_of(covariance: Array, rank: int) -> Basis:
    """Return the features given by the `rank` largest eigenvalues of a covariance [n, n].

    `values` are the eigenvectors times, `projector` divided by, the roots of the eigenvalues.
    Eigenvalues below a millionth of the largest are omitted, so there can be fewer features.
    """
    value, vector = np.linalg.eigh(covariance)
    keep = np.argsort(value)[::-1][:rank]
    keep = keep[value[keep] > 1e-6 * value[keep[0]]]
    root = np.sqrt(value[keep])
    values, projector = vector[:, keep] * root, vector[:, keep] / root
    return Basis(values, projector)


def leading(basis: Basis, rank: int) -> Basis:
    """Return a basis with the first `rank` features only."""
    assumed = None if basis.assumed is None else basis.assumed[:, :rank]
    return Basis(basis.values[:, :rank], basis.projector[:, :rank], assumed)


@dataclass(frozen=True, slots=True)
class PixelFit:
    """Fitted values of P pixels.

    scale: usual luminance per lx of total light [P]; b: coefficients of the r features, in units of
    the scale [P, r]; patch_gain, sky_gain: factors on the sun patch and on the sky behind windows
    [P]; least: lower bound of the surface's light, in units of the scale [P]; second: weights of
    the n captures in the second stage [n, P], [0, P] without one; computed: factor on the computed
    light, 0 if it is not used [P].
    """

    scale: Array
    b: Floats
    patch_gain: Array
    sky_gain: Array
    least: Array
    second: Floats
    computed: Array


def light_arrays(arrays: TrainingArrays, recipe: Recipe) -> TrainingArrays:
    """Return the arrays to which light is fitted: without sun patches if `recipe.below` is True."""
    return replace(arrays, patch=None) if recipe.below else arrays


def with_patches(surface: Array, arrays: TrainingArrays, unit: Array, recipe: Recipe) -> Array:
    """Return fitted light, plus the sun patches if `recipe.below` excluded them from the fit.

    surface: fitted light over `unit` [n, P]; unit: total light times pixel scale [n, P] cd/m2.
    Otherwise return `surface` unchanged.
    """
    return surface + arrays.patch / unit if recipe.below and arrays.patch is not None else surface


def columns_of(arrays: TrainingArrays, unit: Array, recipe: Recipe) -> Columns:
    """Return the covariates of each pixel: computed light, sun patch, window sky, in this order.

    The first two are omitted if `arrays` has None for them. Values are divided by `unit`, the total
    light times the pixel scale [n, P] cd/m2.
    """
    values, variance = [arrays.sky / unit], [SKY_GAIN_VARIANCE]
    if arrays.patch is not None:
        values, variance = [arrays.patch / unit, *values], [recipe.patch_variance, *variance]
    if arrays.computed is not None:
        values = [arrays.computed.luminance * arrays.computed.gain / unit, *values]
        variance = [COMPUTED_VARIANCE, *variance]
    mean, surface = np.ones(len(values)), int(arrays.computed is not None)
    return Columns(np.stack(values), mean, np.array(variance), surface)


@dataclass(frozen=True, slots=True)
class ChunkFit:
    """The fit of P pixels to n hours.

    columns: covariates; target: captured luminance over total light and pixel scale [n, P];
    response, weights: values that the last solve fitted, and their weights [n, P]; b: coefficients
    of the features [P, r]; gains: of the k covariates [P, k].
    """

    columns: Columns
    target: Array
    response: Array
    weights: Array
    b: Array
    gains: Array


def fit_chunk(
    arrays: TrainingArrays, scale: Array, basis: Basis, recipe: Recipe, products: tuple
) -> ChunkFit:
    """Fit some pixels: least relative errors, then robust rounds, then two unbiased solves.

    scale: usual luminance of each pixel per lx of total light [P]; products: result of
    `pair_products(basis.values)`.
    """
    unit = arrays.light.total_lx[:, None] * scale  # [n, P]
    target = np.maximum(arrays.luminance, LEAST_CDM2) / unit
    columns = columns_of(arrays, unit, recipe)
    trust = arrays.trust
    usual = np.exp(np.mean(np.log(target), axis=0))
    weights = trust / np.maximum(target, DARK_SHARE * usual) ** 2
    b, gains = solve(basis.values, columns, target, weights, recipe.noise, products)
    for _ in range(recipe.rounds):
        fitted = basis.values @ b.T + np.einsum("knp,pk->np", columns.values, gains)
        near = np.clip(fitted, 0.2 * target, 5.0 * target)
        weights = trust / (target * near) / (1.0 + (np.log(near / target) / ROBUST_WIDTH) ** 2)
        b, gains = solve(basis.values, columns, target, weights, recipe.noise, products)
    fit = ChunkFit(columns, target, target.copy(), weights, b, gains)
    for _ in range(LOG_STEPS):
        _log_step(fit, trust, basis, recipe, products)
    return fit


def _log_step(fit: ChunkFit, trust: Array, basis: Basis, recipe: Recipe, products: tuple) -> None:
    """Take one Gauss-Newton step, in place, towards the least squared error of the logarithm.

    Weights 1 / y^2 favour hours in which noise makes y too small: at a noise of 20 % the fit is 6 %
    too dark. Squared log errors, linearised about the fit f, are a ridge problem again, with
    response f (1 + ln(y / f)) and weights 1 / f^2. The prior also shrinks the level, so a last
    factor makes the mean signed log error zero. Pixels that already fit within LOG_STEP_FROM do not
    change.
    """
    fitted = basis.values @ fit.b.T + np.einsum("knp,pk->np", fit.columns.values, fit.gains)
    near = np.clip(fitted, 0.2 * fit.target, 5.0 * fit.target)  # [n, P]
    error = np.log(fit.target / near)
    count = np.maximum(trust.sum(axis=0), 1e-9)
    rows = np.flatnonzero(np.sqrt((trust * error**2).sum(axis=0) / count) > LOG_STEP_FROM)
    if not len(rows):
        return
    near, error, trust = near[:, rows], error[:, rows], trust[:, rows]
    usual = np.exp(np.mean(np.log(fit.target[:, rows]), axis=0))
    weights = trust / np.maximum(near, DARK_SHARE * usual) ** 2
    if recipe.rounds:
        weights /= 1.0 + (error / ROBUST_WIDTH) ** 2
    response = near * (1.0 + error)
    columns = fit.columns[rows]
    b, gains = solve(basis.values, columns, response, weights, recipe.noise, products)
    fitted = basis.values @ b.T + np.einsum("knp,pk->np", columns.values, gains)
    residual = np.log(fit.target[:, rows] / np.clip(fitted, 0.2 * near, 5.0 * near))
    counts = weights * near**2  # trust times robust weights
    factor = np.exp(
        (counts * residual).sum(axis=0) / np.maximum(counts.sum(axis=0), 1e-9)
    )  # [rows]
    fit.response[:, rows], fit.weights[:, rows] = response, weights
    fit.b[rows], fit.gains[rows] = b * factor[:, None], gains * factor[:, None]


def least_surface(arrays: TrainingArrays, fit: ChunkFit, basis: Basis, scale: Array) -> Array:
    """Return the lower bound of each pixel's light without patch and sky, in units of `scale`, [P].

    It is 0.3 times the least captured or fitted value, and at least 0.3 times 0.03.
    """
    unit = arrays.light.total_lx[:, None] * scale
    direct = arrays.sky if arrays.patch is None else arrays.sky + arrays.patch
    captured = np.maximum(arrays.luminance - direct, 0.02 * arrays.luminance) / unit
    darkest = np.where(arrays.filled, np.inf, captured).min(axis=0)
    fitted = with_computed(basis.values @ fit.b.T, fit.gains, fit.columns)
    return LEAST_SHARE * np.maximum(np.minimum(fitted.min(axis=0), darkest), 0.03)


def with_computed(surface: Array, gains: Array, columns: Columns) -> Array:
    """Return the light of surfaces: F b (`surface`, [n, P]) plus computed light times its gain.

    gains: of all covariates [P, k]; sun patch and window sky are not added.
    """
    count = columns.surface
    return surface + np.einsum("knp,pk->np", columns.values[:count], gains[:, :count])


def compose(surface: Array, least: Array, gains: Array, columns: Columns) -> Array:
    """Return the fitted light of surfaces, sun patches and window sky together, [n, P].

    The light of surfaces is F b (`surface`, [n, P]) plus the computed light times its gain, raised
    to `least` [P] where it is lower. gains: of all covariates [P, k]; negative gains of patches and
    sky count as 0.
    """
    surfaces = np.maximum(with_computed(surface, gains, columns), least)
    other = slice(columns.surface, None)
    return surfaces + np.einsum(
        "knp,pk->np", columns.values[other], np.maximum(gains[:, other], 0.0)
    )


def second_covariance(a: Light, b: Light, share_a: Array, share_b: Array, width: float) -> Array:
    """Return the covariance of the second stage between hours, [len(a), len(b)].

    It has two parts: effects of the sun from nearly the same direction, and the season. share_a,
    share_b: the sun's share of the total light, [len(a)] and [len(b)]; width: chord between two sun
    directions within which the first part is correlated.
    """
    cosine = np.clip(a.sun_direction @ b.sun_direction.T, -1.0, 1.0)
    sharp = np.outer(share_a, share_b) * np.exp((cosine - 1.0) / width**2)
    return sharp + SECOND_SEASON * np.exp((cosine - 1.0) / 0.25)


def fit_pixels(
    arrays: TrainingArrays,
    basis: Basis,
    recipe: Recipe,
    tick: Callable[[int, int], None] = lambda finished, total: None,
) -> PixelFit:
    """Fit all pixels of `arrays`, in chunks that limit the memory.

    tick: called after each chunk with the number of finished pixels and the number of all pixels.
    """
    count, r = arrays.luminance.shape[1], basis.values.shape[1]
    products = pair_products(basis.values)
    taught = light_arrays(arrays, recipe)
    out = PixelFit(
        pixel_scale(taught),
        np.empty((count, r), np.float32),
        np.ones(count),
        np.ones(count),
        np.empty(count),
        np.empty((len(arrays.light) if recipe.second else 0, count), np.float32),
        np.zeros(count),
    )
    inverse = second_inverse(arrays, recipe)

    def one(part: slice) -> None:
        some, scale = taught[part], out.scale[part]
        fit = fit_chunk(some, scale, basis, recipe, products)
        out.b[part], out.sky_gain[part] = fit.b, np.maximum(fit.gains[:, -1], 0.0)
        if taught.patch is not None:
            out.patch_gain[part] = np.maximum(fit.gains[:, -2], 0.0)
        if some.computed is not None:
            out.computed[part] = fit.gains[:, 0] * some.computed.gain
        out.least[part] = least_surface(some, fit, basis, scale)
        if recipe.second:
            fitted = compose(basis.values @ fit.b.T, out.least[part], fit.gains, fit.columns)
            fitted = with_patches(
                fitted, arrays[part], arrays.light.total_lx[:, None] * scale, recipe
            )
            out.second[:, part] = inverse @ some.taught(np.log(fit.target / fitted))

    for stop in each_chunk(one, count):
        tick(stop, count)
    if arrays.refuted is not None:
        out.patch_gain[arrays.refuted] = 0.0
    return out


def second_inverse(arrays: TrainingArrays, recipe: Recipe) -> Array:
    """Return the inverse of the second stage's covariance plus noise, between captures, [n, n].

    It has the shape [0, 0] if the recipe has no second stage.
    """
    if not recipe.second:
        return np.empty((0, 0))
    own = second_own(arrays, recipe)
    return np.linalg.inv(own + SECOND_NOISE * np.eye(len(own)))


def second_own(arrays: TrainingArrays, recipe: Recipe) -> Array:
    """Return the second stage's covariance between captured hours, without noise, [n, n]."""
    share = arrays.features.beam
    return second_covariance(arrays.light, arrays.light, share, share, recipe.second)


def find_patch_gain(arrays: TrainingArrays, kernel: Kernel) -> float:
    """Return the factor by which all sun patches must be multiplied to match the captures.

    Only pixels that are lit in at least three hours count, and in at most 75 % of the hours with
    any patch: ground before a window is lit in most of them. Without any, return 1.0. The start is
    the median of (L - median(L / E) E) / s over lit values, with luminance L, total light E and
    patch s; with patches of a fitted scene, whose albedos the captures determined, it is 1.0. Three
    robust fits follow.
    """
    patch = arrays.patch
    assert patch is not None
    total = arrays.light.total_lx[:, None]
    lit = patch > 0.02 * np.percentile(patch[patch > 0], 95) if (patch > 0).any() else patch > 0
    lit_hours = lit.sum(axis=0)
    often = np.flatnonzero((lit_hours >= 3) & (lit_hours <= _OFTEN_SHARE * lit.any(axis=1).sum()))
    if not len(often):
        return 1.0
    often = often[:: max(1, len(often) // 600)]
    some = arrays[often]
    shown = np.maximum(patch[:, often], 1e-9)
    plain = np.median(some.luminance / total, axis=0) * total
    gain = float(np.median(((some.luminance - plain) / shown)[lit[:, often]]))
    gain = 1.0 if gain <= 0.0 or arrays.fitted_patches else gain
    recipe = Recipe(_GAIN_NOISE, patch_variance=1.0, rounds=3, rank=30)
    basis = basis_of(kernel(arrays.features, arrays.features), recipe.rank)
    products = pair_products(basis.values)
    for _ in range(3):
        scaled = some.with_patch_scaled(gain)
        fit = fit_chunk(scaled, pixel_scale(scaled), basis, recipe, products)
        positive = fit.gains[fit.gains[:, 0] > 0, 0]
        gain *= float(np.median(positive)) if len(positive) else 1.0
    return gain
