"""Predict each hour by a fit without its day, the measure by which recipes are chosen."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Array, Floats
from fieldlum.learn.models.held_out_choice import HeldOutErrors
from fieldlum.learn.transport.features import TrainingArrays, pixel_scale
from fieldlum.learn.transport.pixel_fit import (
    SECOND_NOISE,
    Basis,
    Recipe,
    columns_of,
    compose,
    fit_chunk,
    least_surface,
    light_arrays,
    second_own,
    with_patches,
)
from fieldlum.learn.transport.ridge import (
    HELD_OUT_CHUNK,
    each_chunk,
    held_out_days,
    held_out_days_shared,
    pair_products,
)
from fieldlum.learn.transport.seasons import seasons

FLOOR_CDM2 = 1.0  # for scores, lower values are raised to it (floor of the paper)


@dataclass(frozen=True, slots=True)
class HeldOutFit:
    """Each of n captured hours, predicted by a fit to the captures of all other days.

    luminance: predicted [n, P] cd/m2; error: log10 of predicted over captured luminance, where
    values below 1 cd/m2 count as 1, and 0 at values without truth [n, P]; scale: each pixel's mean
    luminance per lx of total light [P]; errors: by which recipes are compared:
    of log10 luminance alone, of all hours. Ranked by DGP, or without the hours of the largest
    errors, recipes of a rendered room had up to three times the log10 MSE over a year.
    """

    luminance: Array
    error: Array
    scale: Array
    errors: HeldOutErrors

    @property
    def per_hour(self) -> Array:
        """Mean squared log10 error of each hour, [n]."""
        return (self.error**2).mean(axis=1)


def score(predicted: Floats, captured: Floats) -> Array:
    """Return log10 of predicted over captured (`captured`) luminance; below 1 cd/m2 counts as 1."""
    return np.log10(np.maximum(predicted, FLOOR_CDM2)) - np.log10(np.maximum(captured, FLOOR_CDM2))


@dataclass(frozen=True, slots=True)
class FirstStage:
    """Each of n captured hours, predicted from other days by the first stage of the fit.

    found: predicted luminance, target: captured luminance, both divided by the total light and by
    `scale`, so about 1 [n, P]; scale: each pixel's mean luminance per lx of total light [P]. The
    first stage does not include the second stage's correction of the log residual.
    """

    found: Array
    target: Array
    scale: Array


def hold_out_first(arrays: TrainingArrays, basis: Basis, recipe: Recipe) -> FirstStage:
    """Predict each hour from the other days by the first stage of the fit, in closed form.

    No fit is repeated: features, robust weights and pixel scales are those of the fit to all days.
    """
    taught = light_arrays(arrays, recipe)
    scale, products = pixel_scale(taught), pair_products(basis.values)
    found, target = np.empty(arrays.luminance.shape), np.empty(arrays.luminance.shape)

    def one(part: slice) -> None:
        found[:, part], target[:, part] = _hold_out_some(
            arrays[part], taught[part], scale[part], basis, recipe, products
        )

    for _ in each_chunk(one, len(scale), HELD_OUT_CHUNK):
        pass
    return FirstStage(found, target, scale)


def _hold_out_some(
    arrays: TrainingArrays,
    taught: TrainingArrays,
    scale: Array,
    basis: Basis,
    recipe: Recipe,
    products: tuple,
) -> tuple[Array, Array]:
    """Return `found` and `target` of `FirstStage` for some pixels, [n, P] each.

    taught: result of `light_arrays` for `arrays`; products: result of `pair_products`.
    """
    unit = arrays.light.total_lx[:, None] * scale
    fit = fit_chunk(taught, scale, basis, recipe, products)
    columns = fit.columns
    if basis.assumed is not None and taught.computed is not None:
        perez = replace(taught, computed=taught.computed.under_perez())
        columns = columns_of(perez, unit, recipe)
    whole = held_out_days(
        basis.values,
        fit.columns,
        fit.response,
        fit.weights,
        recipe.noise,
        arrays.days,
        basis.assumed,
        columns,
        products,
    )
    direct = np.einsum("knp,pk->np", columns.values, fit.gains)
    least = least_surface(taught, fit, basis, scale)
    predicted = compose(whole - direct, least, fit.gains, columns)
    return with_patches(predicted, arrays, unit, recipe), fit.target


def hold_out(
    arrays: TrainingArrays, basis: Basis, recipe: Recipe, first: FirstStage | None = None
) -> HeldOutFit:
    """Predict each captured hour from the captures of all other days (`arrays.days`).

    first: result of `hold_out_first` for the same arrays, basis and recipe; None to compute it.
    """
    first = first or hold_out_first(arrays, basis, recipe)
    predicted = first.found
    if recipe.second:
        residual = arrays.taught(np.log(first.target / predicted))
        own = second_own(arrays, recipe)
        predicted = predicted * np.exp(
            held_out_days_shared(own, SECOND_NOISE, residual, arrays.days)
        )
    luminance = predicted * arrays.light.total_lx[:, None] * first.scale
    error = arrays.without_flagged(score(luminance, arrays.luminance))
    unknown = np.full(len(luminance), np.nan)
    log10 = (error**2).mean(axis=1)
    errors = HeldOutErrors(unknown, unknown, log10, arrays.days, arrays.sureness, trim=0.0)
    return HeldOutFit(luminance, error, first.scale, errors)


def hold_out_seasons(arrays: TrainingArrays, basis: Basis, recipe: Recipe) -> HeldOutFit | None:
    """Predict each hour from the captures of all other seasons.

    Return None if all captures are from one season (`seasons` finds no gap).
    """
    groups = seasons(arrays.days)
    return hold_out(replace(arrays, days=groups), basis, recipe) if groups.max() > 0 else None
