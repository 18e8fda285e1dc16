"""Measure how well each capture agrees with the others.

The captures are a Gaussian process over the light outside. All pixels share the process, so that
predicting captures without themselves costs one small inverse.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fieldlum.core.arrays import Array, Floats, Indices, Mask
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.hour_weights import UNSURE
from fieldlum.learn.transport.features import (
    LEAST_CDM2,
    TrainingArrays,
    pixel_scale,
    training_arrays_of,
)
from fieldlum.learn.transport.window_sky import seen_sky
from fieldlum.sky.light import LAMP_LX, Kernel

Rows = Indices

FEWEST_DAYS = 4  # with fewer days it is unclear which day is the exception; chosen
_THIN_HEIGHT = 20  # least number of rows of the maps that are compared; chosen
_PIXELS = 200  # number of pixels, drawn by solid angle; chosen
# least median luminance of a picture that can be judged: the floor of the scores; chosen
_LEAST_LEVEL_CDM2 = 1.0
OVERCAST = 0.05  # largest share of the sun in the light of an hour without sun patches; chosen
# share of a pixel's luminance above which a sun patch hides the rest, also next to the patch;
# chosen
_PATCH_SHARE = 0.05
_NOISES = (1e-3, 3e-3, 1e-2, 3e-2, 1e-1)  # relative variances; smaller ones are not resolved
_LAMP_VARIANCE = 100.0  # prior variance of a lamp's light, as in fieldlum.sky.light.Kernel
# Prior variance of the relative change by a factor on the light of some captures. It refers to
# their measured level: 0.3 of the light is a change of 2.3. With 0.1, the wrong days are found for
# a factor of 0.3.
_LEVEL_VARIANCE = 1.0
# share of the pixels with the largest deviations that are omitted, because they are edges of sun
# patches; chosen
_TRIM = 0.1
# share of the process's own variance; smaller typical deviations count as this; chosen
_LEAST_TYPICAL = 0.01
# Squared deviation over that of the median capture or day, in nine simulated rooms at 46 x 23
# pixels. Largest without a change: 185 and 6. With lamps of 10 cd/m2 at dusk: 140 and more. With a
# blind half down for a day: 20 and more. A larger value only starts a search; the gain decides what
# is omitted. Chosen between these (docs/validation.md, nine simulated rooms).
CAPTURE_LIMIT = 100.0
DAY_LIMIT = 10.0
_SOFT = 0.1  # of the limits: smaller deviations cost little; chosen
PRICE = float(np.log1p(1.0 / _SOFT))  # cost of omitting a capture: that of a capture at the limit


@dataclass(frozen=True, slots=True)
class LeftOut:
    """k captures, each predicted from the other k - 1, at P pixels.

    rows: indices of the captures [k]; inverse: of their covariance with noise [k, k]; weights:
    `inverse` times measured values [k, P]; error: measured minus predicted values, in units of
    `Process.y` [k, P]; variance: expected variance of the error [k].
    """

    rows: Rows
    inverse: Array
    weights: Array
    error: Array
    variance: Array


@dataclass(frozen=True, slots=True)
class Process:
    """n captures at P pixels as a Gaussian process over the light outside.

    y [n, P]: a pixel's luminance over `total_lx` and over its geometric mean of luminance per lx,
    so about 1, with predictions where `valid` is False; valid [n, P]: whether the pixel shows a
    surface without direct sun; covariance [n, n]: between hours, without noise; spread [n]: factor
    on the noise of a capture; days [n]: dates; judged [n]: whether the picture has enough light
    and, without computed sun patches, hardly any sun; total_lx [n]:
    horizontal illuminance of the sky plus normal illuminance of the sun; beam [n]: the sun's share
    of it; measured, direct [n, P]: the picture including values that
    `valid` excludes (infinite where none was measured), and the computed sun patch, in units of y.
    """

    y: Array
    valid: Mask
    covariance: Array
    spread: Array
    days: Array
    judged: Mask
    total_lx: Array
    beam: Array
    measured: Array
    direct: Array

    @property
    def shows_exceptions(self) -> bool:
        """Whether at least four days have pictures that can be judged."""
        return len(np.unique(self.days[self.judged])) >= FEWEST_DAYS

    def without(self, hidden: Mask) -> Process:
        """Return the process without the values where `hidden` [n, P] is True.

        Predictions from the other captures replace them in `y`, and `valid` becomes False there.
        """
        valid, rows = self.valid & ~hidden, np.flatnonzero(self.judged)
        process = self
        for _ in range(2):
            filled = process.y.copy()
            filled[rows] -= process.left_out(rows, _NOISES[1]).error
            process = replace(process, y=np.where(valid, self.y, filled), valid=valid)
        return process

    def with_lamp(self, rows: Rows) -> Process:
        """Return the process that expects one lamp, of unknown brightness, in captures `rows`."""
        lit = np.zeros(len(self.days))
        lit[rows] = LAMP_LX / self.total_lx[rows]
        return replace(self, covariance=self.covariance + _LAMP_VARIANCE * np.outer(lit, lit))

    def with_level(self, rows: Rows) -> Process:
        """Return the process that expects one unknown factor on the light of the captures `rows`.

        Each pixel has its own factor, the same in all these captures.
        """
        level = self.level_of(rows)
        return replace(self, covariance=self.covariance + _LEVEL_VARIANCE * np.outer(level, level))

    def level_of(self, rows: Rows) -> Array:
        """Return the median of `y` over the pixels in the captures `rows`, 0 in others, [n]."""
        level = np.zeros(len(self.days))
        level[rows] = np.median(self.y[rows], axis=1)
        return level

    def lamp_light(self, rows: Rows, noise: float) -> float:
        """Return the fitted light of a lamp in the captures `rows`, median over the pixels.

        1 is a pixel's usual light under 1 000 lx outside. It is negative if these captures are
        darker than the others. noise: relative variance.
        """
        judged = np.flatnonzero(self.judged)
        lit = np.zeros(len(self.days))
        lit[rows] = LAMP_LX / self.total_lx[rows]
        noisy = self.noisy(noise)[np.ix_(judged, judged)]
        weights = np.linalg.solve(noisy, _LAMP_VARIANCE * lit[judged])
        return float(np.median(weights @ self.y[judged]))

    def noisy(self, noise: float) -> Array:
        """Return the covariance of measured values with the relative variance `noise`, [n, n]."""
        return self.covariance + np.diag(noise * self.spread)

    def left_out(self, rows: Rows, noise: float) -> LeftOut:
        """Return the captures `rows`, each predicted by the other captures among `rows`.

        noise: relative variance of a measured value.
        """
        inverse = np.linalg.inv(self.noisy(noise)[np.ix_(rows, rows)])
        weights = inverse @ self.y[rows]  # [k, P]
        variance = 1.0 / np.diagonal(inverse)
        return LeftOut(rows, inverse, weights, weights * variance[:, None], variance)

    def factor(self, rows: Rows, noise: float) -> Floats:
        """Return measured over predicted light of each capture, median over pixels, [n].

        Each capture is predicted from those of the captures `rows` that are from other days. noise:
        relative variance of a measured value.
        """
        factor = np.ones(len(self.days))
        for day in np.unique(self.days):
            block, others = np.flatnonzero(self.days == day), rows[self.days[rows] != day]
            noisy = self.noisy(noise)[np.ix_(others, others)]
            weights = np.linalg.solve(noisy, self.covariance[np.ix_(others, block)])
            # at least 5 % of the usual light
            predicted = np.maximum(weights.T @ self.y[others], 0.05)
            factor[block] = np.median(self.y[block] / predicted, axis=1)
        return factor

    def squares(self, out: LeftOut) -> Array:
        """Return squared errors of left-out captures over their expected variance, [k, P].

        The value is 0 where `valid` is False.
        """
        return np.where(self.valid[out.rows], out.error, 0.0) ** 2 / out.variance[:, None]

    def day_squares(self, out: LeftOut) -> dict[Any, float]:
        """Return the mean squared deviation of each day from what the other days predict.

        The tenth of the pixels with the largest deviations does not count. All captures of a day
        count jointly, over their covariance. With the inverse Q of the covariance and the rows D of
        a day, the deviation is e = Q_DD^-1 (Q y)_D and its covariance is Q_DD^-1 (the block form of
        the leave-one-out identity).
        """
        days, squares = self.days[out.rows], {}
        for day in np.unique(days):
            block = np.flatnonzero(days == day)
            inner = out.inverse[np.ix_(block, block)]
            error = np.linalg.solve(inner, out.weights[block])
            error = np.where(self.valid[out.rows[block]], error, 0.0)
            squares[day] = _trimmed((error * (inner @ error)).mean(axis=0))
        return squares


def _trimmed(values: Array) -> float:
    count = max(1, round((1.0 - _TRIM) * len(values)))
    return float(np.partition(values, count - 1)[:count].mean())


def thinned(data: Dataset) -> Dataset:
    """Return the captures with smaller maps (at least 20 rows), for comparisons among captures."""
    return data.thin(_THIN_HEIGHT)


def process_of(
    data: Dataset,
    *,
    with_patch: bool,
    complete: bool = False,
    windows: bool = False,
    seen_skies: bool = False,
) -> Process:
    """Return the captures as a process; values with a sun patch or flags are predicted ones.

    They are predicted from the other captures. with_patch: use the sun patches of `data`. The
    process has at most 200 pixels, drawn by solid angle; with `complete`, all pixels of
    `thinned(data)` that the lens saw. Window pixels count as not valid unless `windows` is True.
    seen_skies: assume for each capture the sky that its windows show, not Perez's.
    """
    small = thinned(data)
    arrays = training_arrays_of(small, with_patch=with_patch)
    sky = seen_sky(arrays) if seen_skies else None
    if sky is not None:
        arrays = replace(arrays, features=sky.features(arrays))
    luminance = np.maximum(arrays.luminance, LEAST_CDM2).astype(float)
    judged = np.median(luminance, axis=1) > _LEAST_LEVEL_CDM2
    if arrays.patch is None:  # without a computed sun patch, direct sun looks like a change
        judged &= arrays.features.beam < OVERCAST
    usual = arrays.light.total_lx[:, None] * pixel_scale(arrays)
    y = luminance / usual
    valid = _valid(arrays, small, usual if complete else luminance)
    direct = np.zeros_like(y) if arrays.patch is None else arrays.patch / usual
    if not windows:
        valid[:, arrays.open_sky.index] = False
    pixels = np.arange(y.shape[1]) if complete else _draw(arrays, valid)
    y, valid, direct = y[:, pixels], valid[:, pixels], direct[:, pixels]  # [n, P]
    level = [np.median(v[ok]) if ok.any() else 1.0 for v, ok in zip(y, valid, strict=True)]
    level = np.array(level)
    covariance = Kernel(arrays.facades)(arrays.features, arrays.features)
    spread = level**2 * (1.0 + arrays.unsure / UNSURE)
    with_level = np.where(valid, y, level[:, None])
    total, beam = arrays.light.total_lx, arrays.features.beam
    y = np.where(arrays.filled[:, pixels], np.inf, y)
    process = Process(
        with_level, valid, covariance, spread, small.days, judged, total, beam, y, direct
    )
    return process.without(~valid)


def _draw(arrays: TrainingArrays, valid: Mask) -> Rows:
    """Return pixels that are valid in most captures, drawn by solid angle."""
    pixels = np.flatnonzero(valid.mean(axis=0) > 0.5)
    share = arrays.weights[pixels] / arrays.weights[pixels].sum()
    count = min(_PIXELS, len(pixels))
    return np.sort(np.random.default_rng(0).choice(pixels, count, replace=False, p=share))


def _valid(arrays: TrainingArrays, data: Dataset, luminance: Array) -> Mask:
    """Return a mask [n, P] of pixels without direct sun in or next to them; luminance: [n, P]."""
    from scipy.ndimage import maximum_filter

    valid = ~arrays.filled
    if arrays.patch is not None and data.patch_cdm2 is not None:
        wide = np.pad(data.patch_cdm2, ((0, 0), (0, 0), (1, 1)), mode="wrap")
        near = maximum_filter(wide, (1, 3, 3), mode="nearest")[:, :, 1:-1][:, data.seen]
        valid &= near <= _PATCH_SHARE * luminance
    return valid


@dataclass(frozen=True, slots=True)
class Typical:
    """The usual deviations of captures from what the others predict; larger ones are suspect.

    noise: most likely relative variance of a capture; pixel [P]: median over captures of each
    pixel's squared error over its expected variance; capture: median over captures of the mean of
    these squares over `pixel`; day: median over days of `Process.day_squares`.
    """

    noise: float
    pixel: Array
    capture: float
    day: float


def typical(process: Process, rows: Rows) -> Typical:
    """Return the median deviations of the captures `rows`, each predicted from the others."""
    noise = _likely_noise(process, rows)
    out = process.left_out(rows, noise)
    squares = process.squares(out)
    pixel = np.median(squares, axis=0)
    pixel = np.maximum(pixel, max(0.2 * float(np.median(pixel)), _LEAST_TYPICAL))
    capture = float(np.median([_trimmed(row / pixel) for row in squares]))
    day = float(np.median(list(process.day_squares(out).values())))
    return Typical(noise, pixel, capture, max(day, _LEAST_TYPICAL))


def _likely_noise(process: Process, rows: Rows) -> float:
    """Return the noise under which half of the captures are most likely."""
    costs = []
    for noise in _NOISES:
        out = process.left_out(rows, noise)
        ratio = np.median(process.squares(out), axis=1)
        size = float(np.median(ratio))
        costs.append(float(np.median(np.log(out.variance * size) + ratio / size)))
    return _NOISES[int(np.argmin(costs))]


def deviations(process: Process, rows: Rows, usual: Typical) -> tuple[Array, dict[Any, float]]:
    """Return how far each capture of `rows`, and each of their days, deviates from the prediction.

    The first result is [k], a capture predicted from the other captures; the second has a value
    for each day, predicted from other days. Values are squared deviations over 100 (captures) or 10
    (days) times the usual ones: a value above 1 starts the search for a change.
    """
    out = process.left_out(rows, usual.noise)
    squares = process.squares(out) / usual.pixel
    count = max(1, round((1.0 - _TRIM) * squares.shape[1]))
    captures = np.partition(squares, count - 1, axis=1)[:, :count].mean(axis=1)
    days = {day: v / (usual.day * DAY_LIMIT) for day, v in process.day_squares(out).items()}
    return captures / (usual.capture * CAPTURE_LIMIT), days


def disagreement(process: Process, rows: Rows, usual: Typical) -> float:
    """Return how much the captures `rows` contradict each other: a cost, 0 without deviations.

    It is a sum over captures and days of log(1 + 10 d), with the deviations d of `deviations`; by
    the logarithm, a single large deviation does not decide.
    """
    captures, days = deviations(process, rows, usual)
    live, counts = np.unique(process.days[rows], return_counts=True)
    of_days = sum(
        count * np.log1p(days[day] / _SOFT)
        for day, count in zip(live, counts.tolist(), strict=True)
    )
    return float(np.log1p(captures / _SOFT).sum() + of_days)
