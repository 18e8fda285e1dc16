"""The fit: features from the kernel, per-pixel ridge, robust rounds, and what held-out days say
about it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.light import Kernel, Light
from fieldlum.models.transport.solve import (
    Columns,
    each_chunk,
    held_out_days,
    held_out_days_shared,
    pair_products,
    solve,
)
from fieldlum.models.transport.training_arrays import LEAST_CDM2, Material, pixel_scale

Array = NDArray[Any]

RANK = 100
FLOOR_CDM2 = 1.0  # scores look no deeper (the paper's floor)
SKY_GAIN_VARIANCE = 0.04
ROBUST_WIDTH = 0.15  # log residual at which a capture counts half
SECOND_NOISE = 0.06
SECOND_SEASON = 0.02  # variance of what changes with the season whether the sun shines or not
# of its usual light: a pixel darker than that (a hand before the lens) gets no more weight
DARK_SHARE = 0.03
ONE_SEASON_DEG = 20.0  # range of the sun's declination below which captures are of one season
SEASONS_APART_DEG = 10.0  # gap in the declinations of the captures' days that parts two seasons
LEAST_SHARE = 0.3  # of the darkest a pixel was ever seen: predictions go no lower


@dataclass(frozen=True, slots=True)
class Recipe:
    """What is left to choose. noise is relative variance; patch_variance the prior variance of
    each pixel's patch gain; rounds of robust reweighting; second: width of the second stage on
    the log residual (0: none); below: doubtful patches do not teach the light, it is found below
    them as if there were none, and they are added as they are.
    """

    noise: float
    patch_variance: float = 0.0025
    rounds: int = 0
    second: float = 0.0
    rank: int = RANK
    below: bool = False


@dataclass(frozen=True, slots=True)
class Basis:
    """Eigenfeatures of the kernel on the training hours: values [n, r]; a new hour's are k(hour,
    train) @ projector.
    """

    values: Array
    projector: Array  # [n, r]


def basis_of(covariance: Array, rank: int) -> Basis:
    """The `rank` largest eigenfeatures, those of a millionth of the largest left out."""
    value, vector = np.linalg.eigh(covariance)
    keep = np.argsort(value)[::-1][:rank]
    keep = keep[value[keep] > 1e-6 * value[keep[0]]]
    root = np.sqrt(value[keep])
    return Basis(vector[:, keep] * root, vector[:, keep] / root)


def leading(basis: Basis, rank: int) -> Basis:
    """The first `rank` of its features."""
    return Basis(basis.values[:, :rank], basis.projector[:, :rank])


@dataclass(frozen=True, slots=True)
class PixelFit:
    """What is known of each pixel: scale [P] light per unit of total light; b [P, r]; gains of
    patch and sky [P]; least [P] of the surface part, in units of the scale; second [m, P]
    weights of the second stage (m may be 0).
    """

    scale: Array
    b: NDArray[np.floating]
    patch_gain: Array
    sky_gain: Array
    least: Array
    second: NDArray[np.floating]


def _teaching(material: Material, recipe: Recipe) -> Material:
    """What the light is learnt from."""
    return replace(material, patch=None) if recipe.below else material


def _with_patches(surface: Array, material: Material, unit: Array, recipe: Recipe) -> Array:
    """A fit and the patches that it was not taught, [n, P]."""
    return (
        surface + material.patch / unit if recipe.below and material.patch is not None else surface
    )


def _columns(material: Material, unit: Array, recipe: Recipe) -> Columns:
    """Patch (where there is one) and window sky in units of total light and pixel scale."""
    sky = material.sky / unit
    if material.patch is None:
        return Columns(sky[None], np.ones(1), np.array([SKY_GAIN_VARIANCE]))
    values = np.stack((material.patch / unit, sky))
    return Columns(values, np.ones(2), np.array([recipe.patch_variance, SKY_GAIN_VARIANCE]))


@dataclass(frozen=True, slots=True)
class _Fitted:
    columns: Columns
    target: Array
    weights: Array
    b: Array
    gains: Array


def _fit_chunk(
    material: Material, scale: Array, basis: Basis, recipe: Recipe, products: tuple
) -> _Fitted:
    unit = material.light.total_lx[:, None] * scale
    seen = np.maximum(material.luminance, LEAST_CDM2)
    target = seen / unit
    columns = _columns(material, unit, recipe)
    trust = np.where(material.filled, 0.0, material.sureness[:, None])
    usual = np.exp(np.mean(np.log(target), axis=0))
    weights = trust / np.maximum(target, DARK_SHARE * usual) ** 2
    b, gains = solve(basis.values, columns, target, weights, recipe.noise, products)
    for _ in range(recipe.rounds):
        found = basis.values @ b.T + np.einsum("knp,pk->np", columns.values, gains)
        near = np.clip(found, 0.2 * target, 5.0 * target)
        weights = trust / (target * near) / (1.0 + (np.log(near / target) / ROBUST_WIDTH) ** 2)
        b, gains = solve(basis.values, columns, target, weights, recipe.noise, products)
    return _Fitted(columns, target, weights, b, gains)


def _least(material: Material, fit: _Fitted, basis: Basis, scale: Array) -> Array:
    """The surface part may not fall under a share of the least that was seen or fitted."""
    unit = material.light.total_lx[:, None] * scale
    direct = material.sky if material.patch is None else material.sky + material.patch
    seen = np.maximum(material.luminance - direct, 0.02 * material.luminance) / unit
    darkest = np.where(material.filled, np.inf, seen).min(axis=0)
    fitted = basis.values @ fit.b.T
    return LEAST_SHARE * np.maximum(np.minimum(fitted.min(axis=0), darkest), 0.03)


def compose(surface: Array, least: Array, gains: Array, columns: NDArray[np.floating]) -> Array:
    """Surface part (kept above `least`) plus the columns with gains that are never negative; [n,
    P].
    """
    return np.maximum(surface, least) + np.einsum("knp,pk->np", columns, np.maximum(gains, 0.0))


def second_covariance(a: Light, b: Light, share_a: Array, share_b: Array, width: float) -> Array:
    """Covariance of the second stage between hours: what the sun does from nearly the same
    direction, and the season.

    share: the sun's share of the total light.
    """
    cosine = np.clip(a.sun_direction @ b.sun_direction.T, -1.0, 1.0)
    sharp = np.outer(share_a, share_b) * np.exp((cosine - 1.0) / width**2)
    return sharp + SECOND_SEASON * np.exp((cosine - 1.0) / 0.25)


def fit_pixels(
    material: Material,
    basis: Basis,
    recipe: Recipe,
    tick: Callable[[int, int], None] = lambda done, total: None,
) -> PixelFit:
    """Fit all pixels in chunks of bounded memory."""
    count, r = material.luminance.shape[1], basis.values.shape[1]
    products = pair_products(basis.values)
    taught = _teaching(material, recipe)
    out = PixelFit(
        pixel_scale(taught),
        np.empty((count, r), np.float32),
        np.ones(count),
        np.ones(count),
        np.empty(count),
        np.empty((len(material.light) if recipe.second else 0, count), np.float32),
    )
    inverse = second_inverse(material, recipe)

    def one(part: slice) -> None:
        some, scale = taught[part], out.scale[part]
        fit = _fit_chunk(some, scale, basis, recipe, products)
        out.b[part], out.sky_gain[part] = fit.b, np.maximum(fit.gains[:, -1], 0.0)
        if taught.patch is not None:
            out.patch_gain[part] = np.maximum(fit.gains[:, 0], 0.0)
        out.least[part] = _least(some, fit, basis, scale)
        if recipe.second:
            found = compose(basis.values @ fit.b.T, out.least[part], fit.gains, fit.columns.values)
            found = _with_patches(
                found, material[part], material.light.total_lx[:, None] * scale, recipe
            )
            out.second[:, part] = inverse @ np.log(fit.target / found)

    for done in each_chunk(one, count):
        tick(done, count)
    return out


def second_inverse(material: Material, recipe: Recipe) -> Array:
    if not recipe.second:
        return np.empty((0, 0))
    own = second_own(material, recipe)
    return np.linalg.inv(own + SECOND_NOISE * np.eye(len(own)))


def second_own(material: Material, recipe: Recipe) -> Array:
    share = material.features.beam
    return second_covariance(material.light, material.light, share, share, recipe.second)


# ----------------------------------------------------------------------------------------------
# held-out days


def _declination_deg(days: NDArray) -> Array:
    """The sun's declination at the beginning of each day, [n]."""
    names, inverse = np.unique(days.astype("datetime64[D]"), return_inverse=True)
    return sun.declination_deg(
        [day.replace(tzinfo=UTC) for day in names.astype("datetime64[s]").tolist()]
    )[inverse]


def one_season(days: NDArray) -> bool:
    """Whether the sun's declination hardly moved between the captures' days: what they say of
    others is little.
    """
    return float(np.ptp(_declination_deg(days))) < ONE_SEASON_DEG


def seasons(days: NDArray) -> NDArray[np.intp]:
    """Number of the season that each day belongs to: declinations with a gap between them are of
    two, [n].
    """
    declination = _declination_deg(days)
    known = np.unique(declination)
    starts = known[1:][np.diff(known) > SEASONS_APART_DEG]
    return np.searchsorted(starts, declination, side="right")


@dataclass(frozen=True, slots=True)
class HeldOutFit:
    """Predictions [n, P] cd/m2 of each hour without its day, and log10 errors above the floor of
    1 cd/m2; sureness [n] of the hours.
    """

    luminance: Array
    error: Array
    scale: Array
    sureness: Array

    @property
    def per_hour(self) -> Array:
        """Mean squared error [n]."""
        return (self.error**2).mean(axis=1)

    @property
    def judged(self) -> Array:
        """What choices are made by, [n]: as `per_hour`, but an hour of unsteady light counts
        less.
        """
        return self.per_hour * self.sureness / self.sureness.mean()


def score(predicted: NDArray[np.floating], seen: NDArray[np.floating]) -> Array:
    """log10 error with both sides floored."""
    return np.log10(np.maximum(predicted, FLOOR_CDM2)) - np.log10(np.maximum(seen, FLOOR_CDM2))


@dataclass(frozen=True, slots=True)
class _First:
    """The first stage's prediction of each hour without its day, and what was seen, [n, P] in
    units of the scale.
    """

    found: Array
    target: Array
    scale: Array


def _hold_out_first(material: Material, basis: Basis, recipe: Recipe) -> _First:
    """Leave one day out in closed form: features, robust weights and pixel scales are those of
    the full fit.
    """
    taught = _teaching(material, recipe)
    scale = pixel_scale(taught)
    fit = _fit_chunk(taught, scale, basis, recipe, pair_products(basis.values))
    least = _least(taught, fit, basis, scale)
    whole = held_out_days(
        basis.values, fit.columns, fit.target, fit.weights, recipe.noise, material.days
    )
    direct = np.einsum("knp,pk->np", fit.columns.values, fit.gains)
    found = compose(whole - direct, least, fit.gains, fit.columns.values)
    found = _with_patches(found, material, material.light.total_lx[:, None] * scale, recipe)
    return _First(found, fit.target, scale)


def hold_out(
    material: Material, basis: Basis, recipe: Recipe, first: _First | None = None
) -> HeldOutFit:
    """What each hour would be predicted as by the others without its day; `first` where it is
    known already.
    """
    first = first or _hold_out_first(material, basis, recipe)
    found = first.found
    if recipe.second:
        residual = np.log(first.target / found)
        own = second_own(material, recipe)
        found = found * np.exp(held_out_days_shared(own, SECOND_NOISE, residual, material.days))
    luminance = found * material.light.total_lx[:, None] * first.scale
    return HeldOutFit(
        luminance, score(luminance, material.luminance), first.scale, material.sureness
    )


def hold_out_seasons(material: Material, basis: Basis, recipe: Recipe) -> HeldOutFit | None:
    """As `hold_out` with whole seasons left out; None where there are no gaps between seasons."""
    groups = seasons(material.days)
    return hold_out(replace(material, days=groups), basis, recipe) if groups.max() > 0 else None


def find_patch_gain(material: Material, kernel: Kernel, noise: float = 1e-2) -> float:
    """One factor for all patches of unknown scale.

    Starts at the median of (L - median(L / E) E) / s over lit entries, then three times a robust
    fit of pixels that are lit at least three times. 1.0 when no pixel ever is.
    """
    patch = material.patch
    assert patch is not None
    total = material.light.total_lx[:, None]
    lit = patch > 0.02 * np.percentile(patch[patch > 0], 95) if (patch > 0).any() else patch > 0
    often = np.flatnonzero(lit.sum(axis=0) >= 3)
    if not len(often):
        return 1.0
    often = often[:: max(1, len(often) // 600)]
    some = material[often]
    shown = np.maximum(patch[:, often], 1e-9)
    plain = np.median(some.luminance / total, axis=0) * total
    gain = float(np.median(((some.luminance - plain) / shown)[lit[:, often]]))
    gain = gain if gain > 0 else 1.0
    recipe = Recipe(noise, patch_variance=1.0, rounds=3, rank=30)
    basis = basis_of(kernel(material.features, material.features), recipe.rank)
    products = pair_products(basis.values)
    for _ in range(3):
        scaled = some.with_patch_scaled(gain)
        fit = _fit_chunk(scaled, pixel_scale(scaled), basis, recipe, products)
        positive = fit.gains[fit.gains[:, 0] > 0, 0]
        gain *= float(np.median(positive)) if len(positive) else 1.0
    return gain


def choose(
    material: Material, basis: Basis, recipes: list[Recipe]
) -> tuple[Recipe, list[tuple[Recipe, float, float]]]:
    """The recipe of least error on held-out days, and the table (recipe, error, its standard
    error over days).
    """
    table, firsts = [], dict[Recipe, _First]()
    for recipe in recipes:
        alone = replace(recipe, second=0.0)
        if alone not in firsts:
            firsts[alone] = _hold_out_first(material, basis, recipe)
        judged = hold_out(material, basis, recipe, firsts[alone]).judged
        table.append((recipe, float(judged.mean()), day_standard_error(judged, material.days)))
    return min(table, key=lambda row: row[1])[0], table


def day_standard_error(per_hour: Array, days: NDArray) -> float:
    """Standard error of the mean over hours, days being what is independent."""
    sums = np.array([(per_hour[days == day] - per_hour.mean()).sum() for day in np.unique(days)])
    count = len(sums)
    return float(np.sqrt((sums**2).sum() * count / max(count - 1, 1)) / len(per_hour))
