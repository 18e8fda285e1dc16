"""Find captures in which the room was not as usual, by comparing them with those of other days.

The captures are a Gaussian process over the light outside. All pixels share the process, so that
predicting captures without themselves costs one small inverse. Three kinds are searched: a lamp
that was on in the mornings or evenings of some days; days or parts of days of another level of
light, as with a blind down; and captures, days or a season that contradict the rest for another
reason. Clouds and a distant instrument make each capture deviate, so that captures with a blind are
not conspicuous by the size of their deviations, but all deviate to the same side.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np

from fieldlum.core.arrays import Array, Floats, Indices, Mask
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.hour_weights import UNSURE, is_badly_measured
from fieldlum.learn.transport.arrays import MIN_CDM2, pixel_scale, training_arrays_of
from fieldlum.learn.transport.window_sky import seen_sky
from fieldlum.sky import sun
from fieldlum.sky.light import LAMP_LX, Kernel

Rows = Indices

MIN_DAYS = 4  # with fewer days it is unclear which day is the exception; chosen
_THIN_HEIGHT = 20  # least number of rows of the maps that are compared; chosen
_PIXELS = 200  # number of pixels, drawn by solid angle; chosen
# least median luminance of a picture that can be judged: the floor of the scores; chosen
_MIN_LEVEL_CDM2 = 1.0
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
_MIN_TYPICAL = 0.01
# Squared deviation over that of the median capture or day, in nine simulated rooms at 46 x 23
# pixels. Largest without a change: 185 and 6. With lamps of 10 cd/m2 at dusk: 140 and more. With a
# blind half down for a day: 20 and more. A larger value only starts a search; the gain decides what
# is omitted. Chosen between these (docs/validation.md, troubles).
CAPTURE_LIMIT, DAY_LIMIT = 100.0, 10.0
_SOFT = 0.1  # of the limits: smaller deviations cost little; chosen
# Cost of omitting a capture (that of a capture at the limit), and of a capture with a lamp: less,
# because its light is explained.
_PRICE, _LAMP_PRICE = float(np.log1p(1.0 / _SOFT)), 1.0
# Least gain of a lamp or of omitting captures (difference of log costs). Nine rooms without a
# change reach 10; lamps of 10 cd/m2 reach 93 to 285; a blind half down on one day 87 to 106
# (docs/validation.md, troubles).
_MIN_GAIN = 25.0
# Price of a day of another level and least factor; chosen between what these sets have: nine days
# of the office and of nine rooms with a blind half down for a day and twelve other troubles gain 12
# to 55 by it, with factors of 0.64 to 0.8; other days gain up to 9, and 12 beside such a day.
_DAY_PRICE, _MIN_FACTOR = 10.0, 1.2
# Difference in cost between the best darker and the best brighter set, with which one is clear.
# With five days the wrong one can win by less. Chosen.
_MARGIN = 5.0
# Largest shares of captures that may be omitted, with and without a common factor: a larger set is
# the usual state, and the rest is the exception. Chosen.
_MAX_LEVEL_SHARE, _MAX_SHARE = 0.5, 1.0 / 3.0
# Local standard times from which, or until which, lamps may be on; of a blind's move. Chosen.
_EVENINGS_H, _MORNINGS_H = (14.0, 15.0, 16.0, 17.0, 18.0), (8.0, 9.0, 10.0)
_PARTS_H = (11.0, 12.0, 13.0, 14.0)
_MIN_BLOCK = 3  # least number of captures of a day that show a common factor; chosen
_MIN_LEVEL_DAYS = 5  # with four, it is unclear which days are the exception; chosen
# With more days, pairs of days are not tried, and lamps not searched, for time. Chosen.
_MAX_DAYS_IN_PAIRS, _MAX_DAYS = 12, 40
# Most captures, evenly spaced, that are compared: the time grows with their third power. Chosen.
_MAX_CAPTURES = 250
_NOISE = 1e-2  # relative variance with which other days predict what is reported; chosen
_SUSPECT = 0.1  # of the limits: deviations that a change elsewhere may hide; chosen
_NO_ROWS = np.empty(0, np.intp)


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
    on the noise of a capture; days [n]: dates; hours [n]: local standard time; judged [n]: whether
    the picture has enough light and, without computed sun patches, hardly any sun; total_lx [n]:
    horizontal illuminance of the sky plus normal illuminance of the sun.
    """

    y: Array
    valid: Mask
    covariance: Array
    spread: Array
    days: Array
    hours: Floats
    judged: Mask
    total_lx: Array

    def filled(self) -> Process:
        """Return the process with predictions from the other captures where not `valid`."""
        process, rows = self, np.flatnonzero(self.judged)
        for _ in range(2):
            y = process.y.copy()
            y[rows] -= process.left_out(rows, _NOISES[1]).error
            process = replace(process, y=np.where(self.valid, self.y, y))
        return process

    def with_lamp(self, rows: Rows) -> Process:
        """Return the process that expects one lamp, of unknown brightness, in captures `rows`."""
        lit = self._lamp(rows)
        return replace(self, covariance=self.covariance + _LAMP_VARIANCE * np.outer(lit, lit))

    def _lamp(self, rows: Rows) -> Array:
        lit = np.zeros(len(self.days))
        lit[rows] = LAMP_LX / self.total_lx[rows]
        return lit

    def with_level(self, rows: Rows) -> Process:
        """Return the process that expects one unknown factor on the light of the captures `rows`.

        Each pixel has its own factor, the same in all these captures.
        """
        level = self._level(rows)
        return replace(self, covariance=self.covariance + _LEVEL_VARIANCE * np.outer(level, level))

    def _level(self, rows: Rows) -> Array:
        level = np.zeros(len(self.days))
        level[rows] = np.median(self.y[rows], axis=1)
        return level

    def level_factor(self, out: LeftOut, rows: Rows) -> float:
        """Return the factor on the light of captures, median over the pixels.

        It is 1 if the other captures of `out` predict them.
        """
        level = self._level(rows)[out.rows]  # it has the factor in it
        excess = float(np.median(level @ out.weights)) / float(level @ out.inverse @ level)
        return 1.0 / max(1.0 - excess, 1e-3)

    def lamp_light(self, rows: Rows, noise: float) -> float:
        """Return the fitted light of a lamp in the captures `rows`, median over the pixels.

        1 is a pixel's usual light under 1 000 lx outside. It is negative if these captures are
        darker than the others. noise: relative variance.
        """
        judged = np.flatnonzero(self.judged)
        noisy = self.noisy(noise)[np.ix_(judged, judged)]
        weights = np.linalg.solve(noisy, _LAMP_VARIANCE * self._lamp(rows)[judged])
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

    def factor(self, rows: Rows) -> Floats:
        """Return measured over predicted light of each capture, median over pixels, [n].

        Each capture is predicted from those of the captures `rows` that are from other days.
        """
        factor, noisy = np.ones(len(self.days)), self.noisy(_NOISE)
        for day in np.unique(self.days):
            block, others = np.flatnonzero(self.days == day), rows[self.days[rows] != day]
            cross = self.covariance[np.ix_(others, block)]
            weights = np.linalg.solve(noisy[np.ix_(others, others)], cross)
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

        All captures of a day count jointly, over their covariance. With the inverse Q of the
        covariance and the rows D of a day, the deviation is e = Q_DD^-1 (Q y)_D and its covariance
        is Q_DD^-1 (the block form of the leave-one-out identity).
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
    """Return the mean without the tenth of the values that are largest."""
    count = max(1, round((1.0 - _TRIM) * len(values)))
    return float(np.partition(values, count - 1)[:count].mean())


def process_of(data: Dataset, *, with_patch: bool, seen_skies: bool = False) -> Process:
    """Return the captures as a process at 200 pixels at most, drawn by solid angle.

    Window pixels, sun patches and pixels next to them are not compared. with_patch: use the sun
    patches of `data`. seen_skies: assume for each capture the sky that its windows show, not
    Perez's.
    """
    from scipy.ndimage import maximum_filter

    small = data.thin(_THIN_HEIGHT)
    arrays = training_arrays_of(small, with_patch=with_patch)
    if seen_skies and (sky := seen_sky(arrays)) is not None:
        arrays = replace(arrays, features=sky.features(arrays))
    luminance = np.maximum(arrays.luminance, MIN_CDM2).astype(float)
    beam, total = arrays.features.beam, arrays.light.total_lx
    judged = np.median(luminance, axis=1) > _MIN_LEVEL_CDM2
    valid = ~arrays.filled
    if arrays.patch is None:  # without a computed sun patch, direct sun looks like a change
        judged &= beam < OVERCAST
    elif small.patch_cdm2 is not None:
        modes = ("nearest", "nearest", "wrap")
        wide = maximum_filter(small.patch_cdm2, (1, 3, 3), mode=modes)  # pyright: ignore[reportArgumentType]
        near = np.asarray(wide)[:, small.seen]
        valid &= near <= _PATCH_SHARE * luminance
    valid[:, arrays.open_sky.index] = False
    pixels = np.flatnonzero(valid.mean(axis=0) > 0.5)
    share = arrays.weights[pixels] / arrays.weights[pixels].sum()
    count = min(_PIXELS, len(pixels))
    pixels = np.sort(np.random.default_rng(0).choice(pixels, count, replace=False, p=share))
    y, valid = (luminance / (total[:, None] * pixel_scale(arrays)))[:, pixels], valid[:, pixels]
    level = np.array(
        [np.median(v[ok]) if ok.any() else 1.0 for v, ok in zip(y, valid, strict=True)]
    )
    covariance = Kernel(arrays.facades)(arrays.features, arrays.features)
    spread = level**2 * (1.0 + arrays.unsure / UNSURE)
    y = np.where(valid, y, level[:, None])
    times = [sun.standard_time(t, data.setup.site.timezone) for t in data.light.t_utc]
    hours = np.array([t.hour + t.minute / 60.0 for t in times])
    return Process(y, valid, covariance, spread, small.days, hours, judged, total).filled()


# ----------------------------------------------------------------------------------------------
# disagreement


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
    """Return the median deviations of the captures `rows`, each predicted from the others.

    The noise is the one that minimises the median of -2 ln likelihood over captures, with a common
    factor on the variance fitted. Pixels have at least a fifth of the median pixel's deviation.
    """
    costs = []
    for noise in _NOISES:
        out = process.left_out(rows, noise)
        ratio = np.median(process.squares(out), axis=1)
        size = float(np.median(ratio))
        costs.append(float(np.median(np.log(out.variance * size) + ratio / size)))
    noise = _NOISES[int(np.argmin(costs))]
    out = process.left_out(rows, noise)
    squares = process.squares(out)
    pixel = np.median(squares, axis=0)
    pixel = np.maximum(pixel, max(0.2 * float(np.median(pixel)), _MIN_TYPICAL))
    capture = float(np.median([_trimmed(row / pixel) for row in squares]))
    day = float(np.median(list(process.day_squares(out).values())))
    return Typical(noise, pixel, capture, max(day, _MIN_TYPICAL))


def deviations(process: Process, rows: Rows, usual: Typical) -> tuple[Array, dict[Any, float]]:
    """Return how far each capture of `rows`, and each of their days, deviates from the prediction.

    The first result is [k], a capture predicted from the other captures; the second has a value
    for each day, predicted from other days. Values are squared deviations over 100 (captures) or 10
    (days) times the usual ones: a value above 1 starts the search for a change.
    """
    out = process.left_out(rows, usual.noise)
    squares = process.squares(out) / usual.pixel
    captures = np.array([_trimmed(row) for row in squares])
    days = {day: v / (usual.day * DAY_LIMIT) for day, v in process.day_squares(out).items()}
    return captures / (usual.capture * CAPTURE_LIMIT), days


def disagreement(process: Process, rows: Rows, usual: Typical) -> float:
    """Return how much the captures `rows` contradict each other: a cost, 0 without deviations.

    It is a sum over captures and days of log(1 + 10 d), with the deviations d of `deviations`; by
    the logarithm, a single large deviation does not decide.
    """
    captures, days = deviations(process, rows, usual)
    live, counts = np.unique(process.days[rows], return_counts=True)
    of_days = np.log1p(np.array([days[day] for day in live]) / _SOFT)
    return float(np.log1p(captures / _SOFT).sum() + counts @ of_days)


def cheapest_set(
    steps: Sequence[Rows], cost: Callable[[Rows], float], start: Rows = _NO_ROWS
) -> Rows:
    """Return the set of captures at which no step lowers the cost any more.

    A step adds its captures to the set, or removes those that the set has. The search begins at
    `start` and takes the cheapest step each time.
    """
    best, minimum = start, cost(start)
    while steps:
        tries = [np.setxor1d(best, step).astype(np.intp) for step in steps]
        costs = [cost(chosen) for chosen in tries]
        if min(costs) >= minimum:
            break
        best, minimum = tries[int(np.argmin(costs))], min(costs)
    return best


def _days_and_pairs(days: Sequence[Rows]) -> list[Rows]:
    """Return steps of a search: each day's captures, and those of two days if there are few days.

    Of two days that differ from the rest, the first alone explains little.
    """
    if len(days) > _MAX_DAYS_IN_PAIRS:
        return list(days)
    return [*days, *(np.union1d(a, b) for a, b in combinations(days, 2))]


# ----------------------------------------------------------------------------------------------
# searches


@dataclass(frozen=True, slots=True)
class RoomChanges:
    """The captures in which the room was not as usual, although they are not marked.

    lamp: indices of captures in which a lamp was on; unexplained: indices of captures that
    contradict the others for another reason; complete_days: days that are in `unexplained` with all
    their captures; factor: measured light over that predicted from the other days, median over the
    picture, of each of all n captures [n].
    """

    lamp: Rows
    unexplained: Rows
    complete_days: tuple[Any, ...]
    factor: Floats


def find_changes(data: Dataset, *, with_patch: bool) -> RoomChanges | None:
    """Return the captures of a changed room; None if there is no change, or under four days.

    with_patch: use the sun patches of `data`.
    """
    if len(np.unique(data.days)) < MIN_DAYS:
        return None
    count = len(data)
    some = np.unique(np.linspace(0, count - 1, min(count, _MAX_CAPTURES)).round().astype(int))
    found = _changes_of(data.take(some), with_patch)
    if found is None or len(some) == count:
        return found
    # the others are as the nearest of these, in the order of time
    nearest = np.abs(np.arange(count)[:, None] - some).argmin(axis=1)
    lamp, unexplained = (
        np.flatnonzero(np.isin(nearest, rows)) for rows in (found.lamp, found.unexplained)
    )
    return RoomChanges(lamp, unexplained, found.complete_days, found.factor[nearest])


def _changes_of(data: Dataset, with_patch: bool) -> RoomChanges | None:
    """Return the result of `find_changes` for captures that are few enough to compare all."""
    process = process_of(data, with_patch=with_patch)
    judged = np.flatnonzero(process.judged)
    if len(np.unique(process.days[judged])) < MIN_DAYS:
        return None
    # Clouds hide a lamp, so it is searched for under the skies that the windows showed. A blind
    # looks like a dark sky there: captures that contradict the rest are found under Perez's.
    clouded = process_of(data, with_patch=with_patch, seen_skies=True)
    lamp, lit = find_lamp(clouded, judged)
    unexplained, complete_days = find_unexplained(process.with_lamp(lit))
    rest = np.setdiff1d(judged, unexplained)
    if len(unexplained) and len(lit) == len(lamp):
        # Changed captures can hide a lamp, and make other captures look lit.
        lamp, lit = find_lamp(clouded, rest)
    if not len(lamp) and not len(unexplained):
        return None
    return RoomChanges(lamp, unexplained, complete_days, process.with_lamp(lit).factor(rest))


def find_lamp(process: Process, rows: Rows) -> tuple[Rows, Rows]:
    """Return the captures to omit because of a lamp, and all captures with a lamp, as indices.

    Both are the same for a lamp that is on in some mornings or evenings only. A lamp that is on in
    all captures is part of the room: the first result is then empty, the second has all `rows`,
    among which is searched. Both are empty without a lamp, and with over 40 days.
    """
    if len(np.unique(process.days[rows])) > _MAX_DAYS:
        return _NO_ROWS, _NO_ROWS
    usual = typical(process, rows)
    without = disagreement(process, rows, usual)

    def cost(lit: Rows) -> float:
        if not len(lit):
            return without
        if process.lamp_light(lit, usual.noise) <= 0.0:
            return np.inf  # the lamp was on in the other captures
        price = _LAMP_PRICE * len(lit)
        return disagreement(process.with_lamp(lit), rows, usual) + price

    hours = process.hours[rows]
    blocks = [rows[hours >= h] for h in _EVENINGS_H] + [rows[hours < h] for h in _MORNINGS_H]
    sets = [
        cheapest_set(
            _days_and_pairs([b[process.days[b] == day] for day in np.unique(process.days[b])]), cost
        )
        for b in blocks
    ]
    best = min(sets, key=cost)
    always = without - disagreement(process.with_lamp(rows), rows, usual)
    if always > max(_MIN_GAIN, without - cost(best)):
        return _NO_ROWS, rows
    if without - cost(best) < _MIN_GAIN:
        return _NO_ROWS, _NO_ROWS
    for row in rows:
        other = np.setxor1d(best, [row])
        price = 2.0 * _PRICE if len(other) > len(best) else 0.0
        best = other if cost(other) + price < cost(best) else best
    return best, best


def find_unexplained(process: Process) -> tuple[Rows, tuple[Any, ...]]:
    """Return the indices of captures that contradict the others, and the complete days among them.

    Captures of another level (at most half of all), and captures, days or parts of days that
    contradict the rest (at most a third) are removed one after the other, as long as at least four
    days remain.
    """
    judged = np.flatnonzero(process.judged)
    rows, complete = judged, []
    while len(np.unique(process.days[rows])) >= MIN_DAYS:
        usual, gone = typical(process, rows), len(judged) - len(rows)
        blocks = _blocks(process, rows)
        unit = captures_of_other_level(process, rows, usual, blocks)
        if unit is None or gone + len(unit) > _MAX_LEVEL_SHARE * len(judged):
            unit = _worst_unit(process, rows, usual, blocks)
            if unit is None or gone + len(unit) > _MAX_SHARE * len(judged):
                break
        for day in np.unique(process.days[unit]):
            of_day = rows[process.days[rows] == day]
            if len(of_day) > 1 and np.isin(of_day, unit).all():
                complete.append(day)
        rows = np.setdiff1d(rows, unit)
    of_days = np.flatnonzero(np.isin(process.days, np.array(complete, process.days.dtype)))
    return np.union1d(np.setdiff1d(judged, rows), of_days).astype(np.intp), tuple(complete)


def _blocks(process: Process, rows: Rows) -> list[Rows]:
    """Return each day's captures among `rows`, and its parts before and after some hours.

    Blocks of fewer than three captures are left out.
    """
    at, days = process.hours[rows], process.days[rows]
    parts = [at >= 0.0, *(at < h for h in _PARTS_H), *(at >= h for h in _PARTS_H)]
    blocks = [rows[(days == day) & part] for day, part in product(np.unique(days), parts)]
    return [block for block in blocks if len(block) >= _MIN_BLOCK]


def captures_of_other_level(
    process: Process, rows: Rows, usual: Typical, blocks: Sequence[Rows]
) -> Rows | None:
    """Return the captures, complete days or parts of days, that a common factor explains best.

    The factor is one for each pixel, the same in all these captures. Return None with under five
    days, if it explains too little, or if it is unclear whether these captures are darker or the
    others brighter. rows: captures to search among, as indices [k].
    """
    out, days = process.left_out(rows, usual.noise), process.days[rows]
    complete = [rows[days == day] for day in np.unique(days)]
    if len(complete) < _MIN_LEVEL_DAYS:
        return None
    large = [day for day in complete if len(day) >= _MIN_BLOCK]
    steps = _days_and_pairs(large if len(large) >= _MIN_LEVEL_DAYS else complete)
    without = disagreement(process, rows, usual)

    def cost(chosen: Rows, is_darker: bool) -> float:
        if not len(chosen):
            return without
        factor = process.level_factor(out, chosen)
        near_one = abs(np.log(factor)) < np.log(_MIN_FACTOR)
        if near_one or len(chosen) > _MAX_LEVEL_SHARE * len(rows) or (factor < 1.0) != is_darker:
            return np.inf
        price = _DAY_PRICE * len(np.unique(process.days[chosen]))
        return disagreement(process.with_level(chosen), rows, usual) + price

    # Three darker days make the others look brighter: separate searches find both sets.
    found = []
    for is_darker in (True, False):
        first = cheapest_set(steps, lambda c, d=is_darker: cost(c, d))
        chosen = cheapest_set(blocks, lambda c, d=is_darker: cost(c, d), first)
        found.append((cost(chosen, is_darker), chosen))
    (lowest, best), (second, other) = sorted(found, key=lambda pair: pair[0])
    is_clear = not len(other) or second - lowest > _MARGIN
    return best if len(best) and is_clear else None


def _worst_unit(
    process: Process, rows: Rows, usual: Typical, blocks: Sequence[Rows]
) -> Rows | None:
    """Return the capture or block without which the rest agrees best.

    Return None if omitting each of them gains too little.
    """
    captures, days = deviations(process, rows, usual)
    if max(captures.max(), *days.values()) <= 1.0:
        return None
    units = [np.array([row]) for row in rows[captures > _SUSPECT]]
    suspect = [day for day, size in days.items() if size > _SUSPECT]
    units += [rows[process.days[rows] == day] for day in suspect]
    units += [block for block in blocks if process.days[block[0]] in suspect]
    now = disagreement(process, rows, usual)
    gains = [
        now - disagreement(process, np.setdiff1d(rows, unit), usual) - _PRICE * len(unit)
        for unit in units
    ]
    best = int(np.argmax(gains))
    return units[best] if gains[best] > _MIN_GAIN else None


# ----------------------------------------------------------------------------------------------
# training


def without_changes(data: Dataset, *, with_patch: bool) -> tuple[Dataset, list[str]]:
    """Return the captures without those of a changed room, and a warning for each change.

    Captures with an unmarked lamp and captures that contradict the others are omitted; single ones
    only if their irradiance was measured well. with_patch: use the sun patches of `data`.
    """
    changes = find_changes(data, with_patch=with_patch)
    if changes is None:
        return data, []
    complete = np.isin(data.days, np.array(changes.complete_days, data.days.dtype))
    clear = complete | ~is_badly_measured(data)  # single captures of faint light stay in use
    rows = changes.unexplained
    changes = replace(changes, unexplained=rows[clear[rows]])
    changed = np.union1d(changes.lamp, changes.unexplained)
    notes = _warnings(data, changes)
    return data.take(np.setdiff1d(np.arange(len(data)), changed)), notes


def _warnings(data: Dataset, changes: RoomChanges) -> list[str]:
    """Return a warning about the lamp, about each complete day, and about other captures."""

    def slots(rows: Rows) -> str:
        return ", ".join(data.slots[row] for row in rows)

    notes = []
    if len(changes.lamp):
        days = ", ".join(sorted({str(data.days[row]) for row in changes.lamp}))
        notes.append(
            f"WARNING: {len(changes.lamp)} of {len(data)} captures ({days}) have the same "
            "additional light: a lamp was on, but not marked. These captures are not used; to "
            "learn the lamp, mark them (fieldlum status SESSION --mark SLOT lamp=on) and train "
            f"again: {slots(changes.lamp)}"
        )
    complete = np.isin(data.days, np.array(changes.complete_days, data.days.dtype))
    groups = [(str(day), np.flatnonzero(data.days == day)) for day in changes.complete_days]
    groups.append(("", changes.unexplained[~complete[changes.unexplained]]))
    for day, rows in groups:
        if not len(rows):
            continue
        subject = f"{len(rows)} of {len(data)} captures"
        subject = f"the {len(rows)} captures of {day}" if day else subject
        verbs = ("contradicts", "is") if len(rows) == 1 else ("contradict", "are")
        notes.append(
            f"WARNING: {subject} {verbs[0]} the other days and {verbs[1]} not used: the median "
            f"light is {np.median(changes.factor[rows]):.2f} times the predicted light. "
            "Possible causes are a moved blind, a lamp, snow or wrong irradiance; look at "
            "the pictures, mark what was different (fieldlum status SESSION --mark SLOT "
            f"blind=half), and train again: {slots(rows)}"
        )
    return notes
