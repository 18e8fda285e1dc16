"""Uncertainty of each predicted pixel, calibrated on held-out days."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask
from fieldlum.learn.transport.arrays import MIN_CDM2, TrainingArrays
from fieldlum.learn.transport.solve import (
    SECOND_NOISE,
    SECOND_SEASON,
    Basis,
    HeldOutFit,
    hold_out,
    second_covariance,
    second_inverse,
)
from fieldlum.sky import sun
from fieldlum.sky.light import Features

LOG10_E = float(np.log10(np.e))
NORMAL_90 = 1.6449  # standard deviations around the mean with 90 % of a normal distribution
MIN_SD = 1e-4  # avoids division by zero; chosen
# Largest standard deviation of ln L: with more than a factor of ten, one pixel would dominate the
# hour's mean. Chosen: ln 10.
MAX_SD = 2.3
# Hours are alike within this chord of the sun's direction, this difference of its share, and this
# ratio (ln) of predictive variances. FEW is the weight of all tests with this
# share of sun next to similar ones. Not
# measured.
NEAR_SUN, NEAR_BEAM, NEAR_LOG, FEW = 0.2, 0.1, 1.0, 0.1
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

    inverse, second: of the captures' covariance plus noise, in the first and in the second stage
    [n, n]; novelty: largest predictive variance of a capture with its day held out; patch: relative
    standard deviation of a sun patch; band: standard deviation whose 1.645 times contain 90 % of
    the held-out errors, over their root mean square; slip_deg: displacement of computed from
    captured sun patches [deg], 0 if none is known. Of k tests, in which a captured hour was
    predicted from other days or, if there are several, from other seasons: tested, index of the
    capture; variance_of, error_of, guess_of: predictive variance, log10 MSE, and its estimate
    without experience [k].
    """

    inverse: Array
    second: Array
    novelty: float
    patch: float
    band: float
    tested: Indices
    variance_of: Array
    error_of: Array
    guess_of: Array
    slip_deg: float = 0.0

    @property
    def held_out_mse(self) -> Array:
        """Log10 MSE of each capture, predicted from other days, [n]; these tests come first."""
        return self.error_of[: len(self.inverse)]

    def variance(self, cross: Array, own: Array) -> Array:
        """Return the variance of m hours that remains after the captures, in kernel units, [m].

        cross: covariance between the hours and the captures [m, n]; own: prior variance of the
        hours [m].
        """
        return np.maximum(own - np.einsum("ij,ij->i", cross @ self.inverse, cross), 0.0)

    def second_variance(self, hours: Features, captured: Features) -> Array:
        """Return the variance that remains after the second stage, with its noise, [m]."""
        cross = second_covariance(hours, captured)
        known = np.einsum("ij,ij->i", cross @ self.second, cross)
        return np.maximum(hours.beam**2 + SECOND_SEASON - known, 0.0) + SECOND_NOISE

    def trusted(self, variance: Array) -> Mask:
        """Return a mask [m], True for hours whose light is similar enough to that of captures.

        Their `variance` [m] is at most 1.5 times `novelty`.
        """
        return variance <= NOVEL * self.novelty

    def experience(
        self, hours: Features, captured: Features, variance: Array, guess: Array, careful: bool
    ) -> Array:
        """Return the log10 MSE to expect in m hours, [m].

        It is `guess` [m] times found over guessed errors, both summed over the tests. Tests with
        nearly the same sun direction, share of sun and predictive variance count most; where few
        are similar, those with this share of sun. careful: without sun patches, or with light
        computed for the room, `variance` does not say how errors grow away from captures. They are
        then at least those of tests with this share of sun, the geometric mean of held-out days
        and seasons.
        """
        beam, n = captured.beam[self.tested], len(captured)
        cosine = np.clip(hours.direction @ captured.direction[self.tested].T, -1.0, 1.0)
        sky = np.exp(-((hours.beam[:, None] - beam) ** 2) / (2.0 * NEAR_BEAM**2)) + 1e-9
        ratio = np.log(np.maximum(variance, MIN_VARIANCE))[:, None] - np.log(self.variance_of)
        near = sky * np.exp((cosine - 1.0) / NEAR_SUN**2 - 0.5 * (ratio / NEAR_LOG) ** 2)
        near += FEW * sky / sky.sum(axis=1)[:, None]
        expected = guess * (near @ self.error_of) / (near @ self.guess_of)
        if not careful:
            return expected
        groups = [slice(start, start + n) for start in range(0, len(beam), n)]
        means = [sky[:, g] @ self.error_of[g] / sky[:, g].sum(axis=1) for g in groups]
        return np.maximum(expected, np.exp(np.log(means).mean(axis=0)))


def log10_variance(
    surface_share: Floats,
    patch_share: Floats | float,
    variance: Array,
    second: Array,
    noise: Floats32,
) -> Floats:
    """Return the variance of log10 L before experience, [m, P]; at most that of a factor of ten.

    surface_share: luminance of a usual surface (total light times pixel scale) over L [m, P];
    patch_share: luminance of the sun patch over L [m, P] times its relative standard deviation, or
    0; variance, second: results of `Uncertainty.variance` and `second_variance` [m]; noise:
    `PixelFit.noise` [P].
    """
    kind = surface_share.dtype
    total = surface_share**2 * variance.astype(kind)[:, None]
    total += second.astype(kind)[:, None] * noise**2 + patch_share**2
    return np.minimum(total, kind.type(MAX_SD**2)) * kind.type(LOG10_E**2)


def calibrate(
    arrays: TrainingArrays,
    basis: Basis,
    covariance: Array,
    noise: float,
    residual: Floats32,
) -> Uncertainty:
    """Test the estimated uncertainty on held-out days and, if there are several, held-out seasons.

    arrays, residual: of some pixels; covariance: kernel between captures [n, n], basis: its
    features; noise: of the fit.
    """
    unsure = noise / arrays.sureness  # hours of unsteady light have less weight
    inverse, second = np.linalg.inv(covariance + np.diag(unsure)), second_inverse(arrays)
    groups = [arrays.days, seasons(arrays.days)]
    tests = [
        _Test(
            hold_out(replace(arrays, days=days), basis, noise),
            _held_out(inverse, unsure, days),
            _held_out(second, np.zeros(len(days)), days),
        )
        for days in (groups if groups[1].max() > 0 else groups[:1])
    ]
    patch = max(_patch_sd(arrays, test.held) for test in tests)
    squares = [test.log10_variance(arrays, patch, residual) for test in tests]
    share = arrays.trust + 1e-9
    share /= share.sum(axis=1)[:, None]
    guess = np.concatenate([(share * square).sum(axis=1) for square in squares])
    error = np.concatenate([(test.held.error**2).mean(axis=1) for test in tests])
    out = Uncertainty(
        inverse,
        second,
        float(tests[0].variance.max()),
        patch,
        1.0,
        np.tile(np.arange(len(covariance)), len(tests)),
        np.maximum(np.concatenate([test.variance for test in tests]), MIN_VARIANCE),
        error,
        guess,
    )
    features, some = arrays.features, slice(len(covariance))
    careful = arrays.patch is None or arrays.computed is not None
    expected = out.experience(features, features, out.variance_of[some], guess[some], careful)
    square = squares[0] * (expected / guess[some])[:, None]
    sd = np.sqrt(square + LOG10_E**2 * arrays.unsure[:, None])
    ratio = np.abs(tests[0].held.error) / np.maximum(sd, MIN_SD)
    return replace(out, band=float(np.quantile(ratio[~arrays.filled], 0.9)) / NORMAL_90)


class _Test(NamedTuple):
    """Captured hours as predicted from others, and their variances in both stages [n]."""

    held: HeldOutFit
    variance: Array
    second: Array

    def log10_variance(self, arrays: TrainingArrays, patch: float, residual: Floats32) -> Floats:
        """Return the estimated variance of log10 L, [n, P]."""
        luminance = np.maximum(self.held.luminance, MIN_CDM2)
        unit = arrays.light.total_lx[:, None] * self.held.scale
        share = 0.0 if arrays.patch is None else patch * arrays.patch / luminance
        return log10_variance(unit / luminance, share, self.variance, self.second, residual)


def _held_out(inverse: Array, unsure: Array, days: NDArray) -> Array:
    """Return the variance of each captured hour, predicted from other days, in kernel units, [n].

    inverse: of the covariance between captures plus their noise, of which `unsure` [n] does not
    count; hours of equal `days` are held out together.
    """
    variance = np.empty(len(days))
    for day in np.unique(days):
        rows = np.flatnonzero(days == day)
        variance[rows] = np.diagonal(np.linalg.inv(inverse[np.ix_(rows, rows)])) - unsure[rows]
    return np.maximum(variance, 0.0)


def _patch_sd(arrays: TrainingArrays, held: HeldOutFit) -> float:
    """Return the relative sd of a sun patch, from held-out pixels with mostly direct sun."""
    if arrays.patch is None:
        return 0.0
    lit = (arrays.patch > 0.3 * np.maximum(held.luminance, MIN_CDM2)) & ~arrays.filled
    error = np.abs(held.error[lit]) / LOG10_E
    return float(np.quantile(error, 0.9) / NORMAL_90) if lit.sum() > 20 else 0.05
