"""Uncertainty of each predicted pixel, calibrated on held-out days."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats, Floats32, Mask
from fieldlum.learn.transport.features import LEAST_CDM2, TrainingArrays
from fieldlum.learn.transport.held_out import FLOOR_CDM2, HeldOutFit
from fieldlum.learn.transport.patch_edges import slip_variance
from fieldlum.learn.transport.pixel_fit import SECOND_NOISE, SECOND_SEASON, Recipe, second_own
from fieldlum.learn.transport.seasons import one_season, seasons
from fieldlum.learn.transport.selection import SelectedRecipe
from fieldlum.sky.light import Light

LOG10_E = float(np.log10(np.e))
NORMAL_90 = 1.6449  # standard deviations around the mean with 90 % of a normal distribution
# limits of the sun's share of the light between overcast, intermediate and clear hours; not
# measured
CLASSES = (0.05, 0.5)
# middles of the classes
MIDDLES = (CLASSES[0] / 2, (CLASSES[0] + CLASSES[1]) / 2, CLASSES[1] + 0.2)
LEAST_SD = 1e-4  # avoids division by zero; chosen
LEAST_VARIANCE = 1e-9  # avoids division by zero; chosen
# Largest standard deviation of ln L: with more than a factor of ten, one pixel would dominate the
# hour's mean. Chosen: ln 10.
MOST_SD = 2.3
# Hours are alike within this chord of the sun's direction and within this difference of its share.
# FEW is the weight of the general estimate next to similar hours. Not measured.
NEAR_SUN, NEAR_BEAM, FEW = 0.2, 0.1, 0.1
# log10 MSE: an hour that a shift of its sun patch would change by over a quarter is not trusted;
# chosen
SLIP_MSE = 0.01
# An hour may be this many times further from the captures than a held-out day and still be trusted.
# Chosen.
NOVEL = 1.5


def held_out_variance(covariance: Array, noise: Array, days: NDArray) -> Array:
    """Return the variance of each captured hour, predicted from other days, in kernel units, [n].

    covariance: kernel between the captures [n, n]; noise: variance of each capture's value [n],
    which the result does not include; days [n]: hours of equal values are held out together.
    """
    inverse = np.linalg.inv(covariance + np.diag(noise))
    out = np.empty(len(days))
    for day in np.unique(days):
        rows = np.flatnonzero(days == day)
        out[rows] = np.diagonal(np.linalg.inv(inverse[np.ix_(rows, rows)])) - noise[rows]
    return np.maximum(out, 0.0)


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Calibrated uncertainty of predictions: n captures, P pixels, L luminance.

    inverse: of the captures' covariance plus noise [n, n]; novelty: largest predictive variance of
    a capture with its day held out; factors: on the standard deviation in overcast, intermediate
    and clear hours (columns), from held-out days (first row) and, if there are several seasons,
    from held-out seasons (second row) [1 or 2, 3]; variances: typical predictive variance in the
    same cases [1 or 2, 3]; patch: relative standard deviation of a sun patch; mse: held-out squared
    error over its estimate; second: `inverse` of the second stage [n, n], [0, 0] without one;
    noise_dull: residual standard deviation of ln L in overcast hours [P]; noise_sun: its increase
    with the sun's share of the light [P]; slip_deg: displacement of computed from captured sun
    patches [deg], 0 if `setting_scan` detects none.
    """

    inverse: Array
    novelty: float
    factors: Array
    variances: Array
    patch: float
    mse: float
    second: Array
    noise_dull: Floats
    noise_sun: Floats
    slip_deg: float = 0.0

    def variance(self, cross: Array, own: Array) -> Array:
        """Return the variance of m hours that remains after the captures, in kernel units, [m].

        cross: covariance between the hours and the captures [m, n]; own: prior variance of the
        hours [m].
        """
        return np.maximum(own - np.einsum("ij,ij->i", cross @ self.inverse, cross), 0.0)

    def log10_sd(
        self,
        surface_share: Floats,
        patch_share: Floats | float,
        variance: Array,
        beam: Array,
        cross_second: Array,
    ) -> Floats:
        """Return the standard deviation of log10 L, [m, P]; at most that of a factor of ten, 1.0.

        surface_share: luminance of a usual surface (total light times pixel scale) over L [m, P];
        patch_share: luminance of the sun patch over L [m, P], or 0; variance: result of `variance`
        [m]; beam: the sun's share of the light, 0 to 1 [m]; cross_second: covariance of the second
        stage between hours and captures [m, n], [m, 0] without one.
        """
        kind = surface_share.dtype
        noise = self.noise_dull.astype(kind), self.noise_sun.astype(kind)
        doubt = self._sun_doubt(beam, cross_second)
        sd = log_sd(surface_share, patch_share, variance, doubt, noise, self.patch)
        sd = np.minimum(sd * self.factor(beam, variance).astype(kind)[:, None], MOST_SD)
        return (sd * LOG10_E).astype(kind)

    def _sun_doubt(self, beam: Array, cross: Array) -> Array:
        """Return the factor on a pixel's sun noise, [m].

        It is the sun's share of the light; with a second stage, it also depends on the sun's
        distance from captured directions.
        """
        if not len(self.second):
            return beam
        explained = np.einsum("ij,ij->i", cross @ self.second, cross)
        return np.sqrt(np.maximum(beam**2 + SECOND_SEASON - explained, LEAST_SD))

    def slip_log10_variance(
        self, patch: Floats32, seen_mask: Mask, gain: Floats32, dark: Floats
    ) -> Floats:
        """Return the variance of log10 L due to displaced sun patches, [m, P].

        patch: luminance of sun patches [m, H, W] cd/m2; seen_mask: the P pixels [H, W]; gain:
        factor on the patch [P]; dark: luminance without the patch [m, P] cd/m2.
        """
        slip_px = self.slip_deg * patch.shape[1] / 180.0
        return np.float32(LOG10_E**2) * slip_variance(patch, seen_mask, gain, dark, slip_px)

    def slip_trusted(self, off: Array) -> Mask:
        """Return a mask [m], True where the log10 MSE `off` [m] by displaced patches is < 0.01."""
        return off < SLIP_MSE

    def trusted(self, variance: Array) -> Mask:
        """Return a mask [m], True for hours whose light is similar enough to that of captures.

        Their `variance` [m] is at most 1.5 times `novelty`.
        """
        return variance <= NOVEL * self.novelty

    def factor(self, beam: Array, variance: Array) -> Array:
        """Return the calibration factor on the standard deviation of each hour, [m].

        It is continuous between overcast, intermediate and clear hours, by `beam` [m], the sun's
        share of the light. variance [m]: of the model, which grows with the distance from captures.
        Hours as near to captures as held-out days have the days' factor; hours as far as held-out
        seasons have the seasons' factor.
        """
        factors, variances = (
            [np.interp(beam, MIDDLES, row) for row in np.log(a)]
            for a in (self.factors, self.variances)
        )
        if len(factors) == 1:
            return np.exp(factors[0])
        new = (np.log(np.maximum(variance, LEAST_VARIANCE)) - variances[0]) / np.maximum(
            variances[1] - variances[0], 1e-3
        )
        return np.exp(factors[0] + np.clip(new, 0.0, 1.0) * (factors[1] - factors[0]))


def experience(
    light: Light, beam: Array, train: Light, train_beam: Array, held_out_mse: Array, guess: Array
) -> Array:
    """Return the log10 MSE to expect in m hours, from held-out errors of similar captures, [m].

    It is a mean over the n captures `train`, where captures with nearly the same sun direction and
    share of sun count most. Where few captures are similar it approaches `guess` [m], the estimate
    without experience; it is never below `guess`. beam [m], train_beam [n]: the sun's share of the
    light in hours and captures; held_out_mse [n]: log10 MSE of each capture, predicted from others.
    """
    cosine = np.clip(light.sun_direction @ train.sun_direction.T, -1.0, 1.0)
    near = np.exp(
        (cosine - 1.0) / NEAR_SUN**2 - (beam[:, None] - train_beam) ** 2 / (2.0 * NEAR_BEAM**2)
    )
    return np.maximum((near @ held_out_mse + FEW * guess) / (near.sum(axis=1) + FEW), guess)


def seen_mse(
    beam: Array, unmeasured: Mask, train_beam: Array, train_unmeasured: Mask, held_out_mse: Array
) -> Array:
    """Return the mean held-out error of captures of a similar kind of sky, log10 MSE for m hours.

    Kinds are overcast, intermediate and clear, interpolated by the sun's share of the light.
    Captures whose sun was not measured (`sun_is_unmeasured`) may show direct sun that the model
    does not get. They count only for hours of which the same is true. beam [m], train_beam [n]: the
    sun's share of the light; unmeasured [m], train_unmeasured [n]: masks; held_out_mse [n].
    """

    def mean_of(captures: Mask) -> Array:
        errors = held_out_mse[captures]
        classes = _of_classes(train_beam[captures], lambda rows: errors[rows].mean())
        return np.interp(beam, MIDDLES, classes)

    every = mean_of(np.ones(len(train_beam), bool))
    measured = every if train_unmeasured.all() else mean_of(~train_unmeasured)
    return np.where(unmeasured, np.maximum(every, measured), measured)


def log_sd(
    surface_share: Floats,
    patch_share: Floats | float,
    variance: Array,
    doubt: Array,
    noise: tuple[Floats, Floats],
    patch_sd: float,
) -> Floats:
    """Return the uncalibrated standard deviation of ln L, [m, P].

    surface_share, patch_share: luminance of a usual surface and of the sun patch, over L [m, P];
    variance: predictive variance [m]; doubt: factor on the noise due to the sun [m]; noise: each
    pixel's residual sd in overcast hours, and its increase per unit of doubt [P] each; patch_sd:
    relative sd of a sun patch.
    """
    kind = surface_share.dtype
    total = surface_share**2 * variance.astype(kind)[:, None]
    total += noise[0] ** 2 + (doubt.astype(kind)[:, None] * noise[1]) ** 2
    total += (kind.type(patch_sd) * patch_share) ** 2
    return np.minimum(np.sqrt(total), kind.type(MOST_SD))


def residual_noise(arrays: TrainingArrays, fitted: Floats, doubt: Array) -> tuple[Array, Array]:
    """Return the sd of each pixel's ln residual in overcast hours, and its increase with doubt.

    Both are [P]; variances add: sd^2 + (doubt * increase)^2. fitted: luminance [n, P] cd/m2; doubt:
    result of `sun_doubt` [n]. Without sunny hours the increase is 0.
    """
    error = np.log(np.maximum(fitted, FLOOR_CDM2) / np.maximum(arrays.luminance, FLOOR_CDM2))
    error = np.where(arrays.filled, 0.0, error) ** 2
    beam = arrays.features.beam
    dull = beam < 0.3
    base = error[dull].mean(axis=0) if dull.any() else error.min(axis=0)
    if dull.all():
        return np.sqrt(base), np.zeros(error.shape[1])
    extra = np.maximum(error[~dull] - base, 0.0).mean(axis=0) / max(
        (doubt[~dull] ** 2).mean(), LEAST_SD
    )
    return np.sqrt(base), np.sqrt(extra)


def sun_doubt(arrays: TrainingArrays, recipe: Recipe) -> Array:
    """Return the factor on the noise that direct sun adds, for each captured hour, [n].

    Without a second stage it is the sun's share of the light, 0 to 1. With one it is smaller where
    captures of other days have nearly the same sun direction.
    """
    if not recipe.second:
        return arrays.features.beam
    noise = np.full(len(arrays.light), SECOND_NOISE)
    return np.sqrt(held_out_variance(second_own(arrays, recipe), noise, arrays.days))


def calibrate(
    arrays: TrainingArrays,
    chosen: SelectedRecipe,
    noise_of_all: tuple[Array, Array],
    noise: tuple[Array, Array],
    doubt: Array,
    second: Array,
    seasons_out: HeldOutFit | None = None,
) -> Uncertainty:
    """Fit the factors so that 90 % of held-out errors are within 1.645 standard deviations.

    Overcast, intermediate and clear hours have a factor each. arrays, noise: of the pixels that
    calibrate; noise_of_all: of all pixels, in overcast and in sunny hours [P] each; doubt: of each
    hour [n]; second: inverse of the second stage [n, n]. Held-out errors of days in one season are
    too small: then the largest factor replaces all three. With several seasons, `seasons_out` holds
    out each season; its factors, if they are larger, are for hours as far from the captures.
    """
    groups = [(chosen.held, arrays.days)]
    groups += [] if seasons_out is None else [(seasons_out, seasons(arrays.days))]
    patch_sd = max(_patch_sd(arrays, held) for held, _ in groups)
    unsure = chosen.recipe.noise / arrays.sureness  # hours of unsteady light have less weight
    variance = [held_out_variance(chosen.covariance, unsure, days) for _, days in groups]
    sds = [
        _held_out_sd(arrays, held, v, doubt, noise, patch_sd)
        for (held, _), v in zip(groups, variance, strict=True)
    ]
    factors = np.array([_factors(arrays, h, sd) for (h, _), sd in zip(groups, sds, strict=True)])
    factors = np.maximum.accumulate(np.maximum(factors, 1e-3))
    if one_season(arrays.days):
        factors[:] = factors.max(axis=1, keepdims=True)
    inverse = np.linalg.inv(chosen.covariance + np.diag(unsure))
    beam = arrays.features.beam
    typical = np.array([_of_classes(beam, lambda rows, v=v: np.median(v[rows])) for v in variance])
    typical = np.maximum(typical, LEAST_VARIANCE)
    novelty = float(variance[0].max())
    out = Uncertainty(inverse, novelty, factors, typical, patch_sd, 1.0, second, *noise_of_all)
    # Held-out days have the factors that were fitted to them. Those of the seasons, which `factor`
    # gives to distant hours, would state too much here, and `mse` would lower every hour by it.
    of_days = replace(out, factors=factors[:1], variances=typical[:1])
    guess = (sds[0] * LOG10_E * of_days.factor(beam, variance[0])[:, None]) ** 2  # [n, P]
    trust = arrays.trust
    mse = float((trust * chosen.held.error**2).sum() / (trust * guess).sum())
    return replace(out, mse=mse)


def _patch_sd(arrays: TrainingArrays, held: HeldOutFit) -> float:
    """Return the relative sd of a sun patch, from held-out pixels with mostly direct sun."""
    if arrays.patch is None:
        return 0.0
    lit = (arrays.patch > 0.3 * np.maximum(held.luminance, LEAST_CDM2)) & ~arrays.filled
    error = np.abs(held.error[lit]) / LOG10_E
    return float(np.quantile(error, 0.9) / NORMAL_90) if lit.sum() > 20 else 0.05


def _held_out_sd(
    arrays: TrainingArrays,
    held: HeldOutFit,
    variance: Array,
    doubt: Array,
    residual: tuple[Array, Array],
    patch_sd: float,
) -> Array:
    """Return the uncalibrated standard deviation of ln L of held-out predictions, [n, P]."""
    luminance = np.maximum(held.luminance, LEAST_CDM2)
    unit = arrays.light.total_lx[:, None] * held.scale
    share = 0.0 if arrays.patch is None else arrays.patch / luminance
    sd = log_sd(unit / luminance, share, variance, doubt, residual, patch_sd)
    return np.maximum(np.sqrt(sd**2 + arrays.unsure[:, None]), LEAST_SD)


def _factors(arrays: TrainingArrays, held: HeldOutFit, sd: Array) -> Array:
    """Return the factors on sd [n, P] in overcast, intermediate and clear hours, [3]."""
    ratio = np.abs(held.error) / LOG10_E / sd
    valid = ~arrays.filled
    return _of_classes(
        arrays.features.beam, lambda rows: np.quantile(ratio[rows][valid[rows]], 0.9) / NORMAL_90
    )


def hours_by_class(beam: Array) -> tuple[Mask, ...]:
    """Return masks of the overcast, intermediate and clear hours, [n] each."""
    return beam < CLASSES[0], (beam >= CLASSES[0]) & (beam < CLASSES[1]), beam >= CLASSES[1]


def _of_classes(beam: Array, figure: Callable[[Mask], Any]) -> Array:
    """Return a figure of the overcast, intermediate and clear hours, [3].

    A class with fewer than five hours gets the figure of all hours.
    """
    every = np.ones(len(beam), bool)
    classes = hours_by_class(beam)
    return np.array([float(figure(rows if rows.sum() >= 5 else every)) for rows in classes])
