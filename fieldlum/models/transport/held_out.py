"""Predict each hour by a fit without its day, the measure by which recipes are chosen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.models.transport.features import TrainingArrays, pixel_scale
from fieldlum.models.transport.pixel_fit import (
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
from fieldlum.models.transport.ridge import held_out_days, held_out_days_shared, pair_products
from fieldlum.models.transport.seasons import seasons

Array = NDArray[Any]

FLOOR_CDM2 = 1.0  # for scores, lower values are raised to it (floor of the paper)


@dataclass(frozen=True, slots=True)
class HeldOutFit:
    """Each hour as predicted by a fit without its day.

    luminance: [n, P] cd/m2; error: log10 of predicted over captured luminance, both at least 1
    cd/m2 [n, P]; scale: mean luminance per lx of total light [P]; sureness: weight of each hour's
    irradiance, 0 to 1 [n].
    """

    luminance: Array
    error: Array
    scale: Array
    sureness: Array

    @property
    def per_hour(self) -> Array:
        """Mean squared log10 error of each hour, [n]."""
        return (self.error**2).mean(axis=1)

    @property
    def judged(self) -> Array:
        """Mean squared log10 error of each hour times its weight, [n].

        Unsteady light has less weight; the mean weight is 1.
        """
        return self.per_hour * self.sureness / self.sureness.mean()


def score(predicted: NDArray[np.floating], seen: NDArray[np.floating]) -> Array:
    """Return log10 of predicted over seen luminance [cd/m2]; values below 1 count as 1."""
    return np.log10(np.maximum(predicted, FLOOR_CDM2)) - np.log10(np.maximum(seen, FLOOR_CDM2))


@dataclass(frozen=True, slots=True)
class FirstStage:
    """The first stage's prediction of each hour without captures of its day, and what was captured.

    found (predicted), target (captured) [n, P]: luminance divided by the total light and by
    `scale`. scale [P]: each pixel's mean luminance per lx of total light.
    """

    found: Array
    target: Array
    scale: Array


def hold_out_first(arrays: TrainingArrays, basis: Basis, recipe: Recipe) -> FirstStage:
    """Predict each hour without its day by the first stage of the fit, in closed form.

    Features, robust weights and pixel scales are those of the full fit.
    """
    taught = light_arrays(arrays, recipe)
    scale = pixel_scale(taught)
    fit = fit_chunk(taught, scale, basis, recipe, pair_products(basis.values))
    least = least_surface(taught, fit, basis, scale)
    columns = fit.columns
    if basis.assumed is not None and taught.computed is not None:
        perez = replace(taught, computed=taught.computed.under_perez())
        columns = columns_of(perez, arrays.light.total_lx[:, None] * scale, recipe)
    whole = held_out_days(
        basis.values,
        fit.columns,
        fit.response,
        fit.weights,
        recipe.noise,
        arrays.days,
        basis.assumed,
        columns,
    )
    direct = np.einsum("knp,pk->np", columns.values, fit.gains)
    found = compose(whole - direct, least, fit.gains, columns)
    found = with_patches(found, arrays, arrays.light.total_lx[:, None] * scale, recipe)
    return FirstStage(found, fit.target, scale)


def hold_out(
    arrays: TrainingArrays, basis: Basis, recipe: Recipe, first: FirstStage | None = None
) -> HeldOutFit:
    """Return each hour as predicted by the hours of other days.

    first: the result of the first stage, if it was already computed.
    """
    first = first or hold_out_first(arrays, basis, recipe)
    found = first.found
    if recipe.second:
        residual = np.log(first.target / found)
        own = second_own(arrays, recipe)
        found = found * np.exp(held_out_days_shared(own, SECOND_NOISE, residual, arrays.days))
    luminance = found * arrays.light.total_lx[:, None] * first.scale
    error = arrays.without_flagged(score(luminance, arrays.luminance))
    return HeldOutFit(luminance, error, first.scale, arrays.sureness)


def hold_out_seasons(arrays: TrainingArrays, basis: Basis, recipe: Recipe) -> HeldOutFit | None:
    """Return `hold_out` with complete seasons held out; None if no gap separates seasons."""
    groups = seasons(arrays.days)
    return hold_out(replace(arrays, days=groups), basis, recipe) if groups.max() > 0 else None
