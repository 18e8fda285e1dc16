"""Uncertainty of each predicted pixel, calibrated on held-out days."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask
from fieldlum.learn.transport.arrays import MIN_CDM2, TrainingArrays
from fieldlum.learn.transport.solve import Basis, HeldOutFit, hold_out
from fieldlum.sky import sun
from fieldlum.sky.light import Features

LOG10_E = float(np.log10(np.e))
NORMAL_90 = 1.6449  # standard deviations around the mean with 90 % of a normal distribution
# limits of the sun's share of the light between overcast, intermediate and clear hours; not
# measured
CLASSES = (0.05, 0.5)
# middles of the classes
MIDDLES = (CLASSES[0] / 2, (CLASSES[0] + CLASSES[1]) / 2, CLASSES[1] + 0.2)
MIN_SD = 1e-4  # avoids division by zero; chosen
# Largest standard deviation of ln L: with more than a factor of ten, one pixel would dominate the
# hour's mean. Chosen: ln 10.
MAX_SD = 2.3
# Hours are alike within this chord of the sun's direction and within this difference of its share.
# FEW is the weight of the general estimate next to similar hours. Not measured.
NEAR_SUN, NEAR_BEAM, FEW = 0.2, 0.1, 0.1
# An hour may be this many times further from the captures than a held-out day and still be trusted.
# Chosen.
NOVEL = 1.5
# captures with a smaller range of the sun's declination are from one season; chosen
ONE_SEASON_DEG = 20.0
SEASONS_APART_DEG = 10.0  # least gap between the declinations of two seasons' days; chosen
MIN_VARIANCE = 1e-9  # avoids division by zero; chosen
# log10 MSE: an hour that a shift of its sun patch would change by over a quarter is not trusted;
# chosen
SLIP_MSE = 0.01


def _declination_deg(days: NDArray) -> Array:
    """Return the sun's declination at the beginning of each day, [n]; days: dates [n]."""
    names, inverse = np.unique(days.astype("datetime64[s]"), return_inverse=True)
    return sun.declination_deg([day.replace(tzinfo=UTC) for day in names.tolist()])[inverse]


def one_season(days: NDArray) -> bool:
    """Return whether all days are from one season: a range of solar declination below 20 degrees.

    days: dates [n] (datetime64). If True, held-out days do not test other seasons.
    """
    return float(np.ptp(_declination_deg(days))) < ONE_SEASON_DEG


def seasons(days: NDArray) -> Indices:
    """Return the index of the season of each day, from 0, [n].

    Seasons are ordered by the sun's declination, lowest (northern winter) first. A gap of over 10
    degrees between the days' declinations separates two seasons. days: dates [n] (datetime64).
    """
    declination = _declination_deg(days)
    values = np.unique(declination)
    starts = values[1:][np.diff(values) > SEASONS_APART_DEG]
    return np.searchsorted(starts, declination, side="right")


@dataclass(frozen=True, slots=True)
class Uncertainty:
    """Calibrated uncertainty of predictions: n captures, P pixels, L luminance.

    inverse: of the captures' covariance plus noise [n, n]; novelty: largest predictive variance of
    a capture with its day held out; factors: on the standard deviation in overcast, intermediate
    and clear hours (columns), from held-out days (first row) and, if there are several seasons,
    from held-out seasons (second row) [1 or 2, 3]; variances: typical predictive variance in the
    same cases [1 or 2, 3]; patch: relative standard deviation of a sun patch; mse: held-out squared
    error over its estimate; held_out_mse: log10 MSE of each capture, predicted from other days [n];
    usual_mse: its mean over overcast, intermediate and clear hours, by sureness [3]; slip_deg:
    displacement of computed from captured sun patches [deg], 0 if none is known.
    """

    inverse: Array
    novelty: float
    factors: Array
    variances: Array
    patch: float
    mse: float
    held_out_mse: Array
    usual_mse: Array
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
        noise: tuple[Floats32, Floats32],
    ) -> Floats:
        """Return the standard deviation of log10 L, [m, P]; at most that of a factor of ten, 1.0.

        surface_share: luminance of a usual surface (total light times pixel scale) over L [m, P];
        patch_share: luminance of the sun patch over L [m, P], or 0; variance: result of `variance`
        [m]; beam: the sun's share of the light, 0 to 1 [m]; noise: `PixelFit.noise`.
        """
        factor = self._factor(beam, variance)
        total = surface_share**2 * variance[:, None] + noise[0] ** 2
        total += (beam[:, None] * noise[1]) ** 2 + (self.patch * patch_share) ** 2
        sd = np.minimum(np.sqrt(total) * factor[:, None], MAX_SD) * LOG10_E
        return sd.astype(surface_share.dtype)

    def _factor(self, beam: Array, variance: Array) -> Array:
        """Return the calibration factor on the standard deviation of each hour, [m].

        It is continuous between overcast, intermediate and clear hours. Hours as near to captures
        as held-out days, by their variance, have the days' factor; hours as far as held-out seasons
        have the seasons' factor.
        """
        days, far = (
            [np.interp(beam, MIDDLES, row) for row in np.log(rows)]
            for rows in (self.factors, self.variances)
        )
        if len(days) == 1:
            return np.exp(days[0])
        new = (np.log(np.maximum(variance, MIN_VARIANCE)) - far[0]) / np.maximum(
            far[1] - far[0], 1e-3
        )
        return np.exp(days[0] + np.clip(new, 0.0, 1.0) * (days[1] - days[0]))

    def trusted(self, variance: Array) -> Mask:
        """Return a mask [m], True for hours whose light is similar enough to that of captures.

        Their `variance` [m] is at most 1.5 times `novelty`.
        """
        return variance <= NOVEL * self.novelty

    def experience(self, hours: Features, captured: Features, guess: Array) -> Array:
        """Return the log10 MSE to expect in m hours, from held-out errors of similar captures, [m].

        It is a mean over captures, where those with nearly the same sun direction and share of sun
        count most. Where few captures are similar it approaches the mean of all captures under
        such a sky, or `guess` [m], the estimate without experience, if that is larger; it is never
        below `guess`.
        """
        usual = np.maximum(np.interp(hours.beam, MIDDLES, self.usual_mse), guess)
        cosine = np.clip(hours.direction @ captured.direction.T, -1.0, 1.0)
        apart = (hours.beam[:, None] - captured.beam) ** 2 / (2.0 * NEAR_BEAM**2)
        near = np.exp((cosine - 1.0) / NEAR_SUN**2 - apart)
        mean = (near @ self.held_out_mse + FEW * usual) / (near.sum(axis=1) + FEW)
        return np.maximum(mean, guess)


def calibrate(
    arrays: TrainingArrays,
    basis: Basis,
    covariance: Array,
    noise: float,
    residual: tuple[Floats32, Floats32],
) -> Uncertainty:
    """Fit the factors so that 90 % of held-out errors are within 1.645 standard deviations.

    Overcast, intermediate and clear hours have a factor each. arrays, residual: of some pixels;
    covariance: kernel between captures [n, n], basis: its features; noise: of the fit. Held-out
    errors of days in one season are too small: then the largest factor replaces all three. With
    several seasons, each is held out too; its factors, if larger, are for hours as far away.
    """
    unsure = noise / arrays.sureness  # hours of unsteady light have less weight
    inverse = np.linalg.inv(covariance + np.diag(unsure))
    groups = [arrays.days, seasons(arrays.days)]
    cases = [
        (hold_out(replace(arrays, days=days), basis, noise), _held_out(inverse, unsure, days))
        for days in (groups if groups[1].max() > 0 else groups[:1])
    ]
    beam, valid = arrays.features.beam, ~arrays.filled
    errors = (cases[0][0].error ** 2).mean(axis=1)
    out = Uncertainty(
        inverse,
        float(cases[0][1].max()),
        np.ones((1, 3)),
        np.ones((1, 3)),
        max(_patch_sd(arrays, held) for held, _ in cases),
        1.0,
        errors,
        of_classes(beam, lambda r: np.average(errors[r], weights=arrays.sureness[r])),
    )
    factors, variances = [], []
    for held, variance in cases:
        sd = np.hypot(_sd(out, arrays, held, variance, residual), np.sqrt(arrays.unsure)[:, None])
        ratio = np.abs(held.error) / LOG10_E / np.maximum(sd, MIN_SD)
        factors.append(
            of_classes(beam, lambda rows, r=ratio: np.quantile(r[rows][valid[rows]], 0.9))
        )
        variances.append(of_classes(beam, lambda rows, v=variance: np.median(v[rows])))
    scale = np.maximum.accumulate(np.maximum(np.array(factors) / NORMAL_90, 1e-3))
    if one_season(arrays.days):
        scale[:] = scale.max(axis=1, keepdims=True)
    of_days = replace(out, factors=scale[:1], variances=np.maximum(variances[:1], MIN_VARIANCE))
    held, variance = cases[0]
    guess = (_sd(of_days, arrays, held, variance, residual) * LOG10_E) ** 2
    mse = float((arrays.trust * held.error**2).sum() / (arrays.trust * guess).sum())
    return replace(out, factors=scale, variances=np.maximum(variances, MIN_VARIANCE), mse=mse)


def _held_out(inverse: Array, unsure: Array, days: NDArray) -> Array:
    """Return the variance of each captured hour, predicted from other days, in kernel units, [n].

    inverse: of the covariance between captures plus their noise `unsure` [n, n]; hours of equal
    `days` are held out together.
    """
    variance = np.empty(len(days))
    for day in np.unique(days):
        rows = np.flatnonzero(days == day)
        variance[rows] = np.diagonal(np.linalg.inv(inverse[np.ix_(rows, rows)])) - unsure[rows]
    return np.maximum(variance, 0.0)


def _sd(
    unsure: Uncertainty,
    arrays: TrainingArrays,
    held: HeldOutFit,
    variance: Array,
    residual: tuple[Floats32, Floats32],
) -> Floats:
    """Return the standard deviation of ln L of held-out predictions, [n, P]."""
    luminance = np.maximum(held.luminance, MIN_CDM2)
    unit = arrays.light.total_lx[:, None] * held.scale
    share = 0.0 if arrays.patch is None else arrays.patch / luminance
    beam = arrays.features.beam
    return unsure.log10_sd(unit / luminance, share, variance, beam, residual) / LOG10_E


def _patch_sd(arrays: TrainingArrays, held: HeldOutFit) -> float:
    """Return the relative sd of a sun patch, from held-out pixels with mostly direct sun."""
    if arrays.patch is None:
        return 0.0
    lit = (arrays.patch > 0.3 * np.maximum(held.luminance, MIN_CDM2)) & ~arrays.filled
    error = np.abs(held.error[lit]) / LOG10_E
    return float(np.quantile(error, 0.9) / NORMAL_90) if lit.sum() > 20 else 0.05


def of_classes(beam: Array, figure: Callable[[Mask], Any]) -> Array:
    """Return a figure of the overcast, intermediate and clear hours, [3].

    A class with fewer than five hours gets the figure of all hours.
    """
    every = np.ones(len(beam), bool)
    classes = beam < CLASSES[0], (beam >= CLASSES[0]) & (beam < CLASSES[1]), beam >= CLASSES[1]
    return np.array([float(figure(rows if rows.sum() >= 5 else every)) for rows in classes])
