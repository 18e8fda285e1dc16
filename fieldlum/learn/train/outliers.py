"""Find captures in which the room was not as usual, by comparing them with those of other days.

The captures are a Gaussian process over the light outside, which all pixels share. A change of some
captures is one more term of their covariance: a lamp of unknown light, a factor on the light of a
day or a part of it, as by a blind, or a factor on a single capture. The likelihood of a change is
in closed form (Tipping and Faul, AISTATS 2003), so that all changes are compared with one inverse.
Clouds make some captures brighter and others darker; a change makes all of its captures deviate
alike.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from fieldlum.core.arrays import Array, Floats, Indices, Mask, evenly_spread
from fieldlum.learn.models.camera_turns import LOW_SUN_DEG
from fieldlum.learn.models.held_out_choice import UNSURE, is_badly_measured
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.transport import seasons, training_arrays
from fieldlum.sky import sun
from fieldlum.sky.light_similarity import LAMP_LX, Kernel

MIN_DAYS = 4  # with fewer days it is unclear which day is the exception
_HEIGHT, _PIXELS = 20, 200  # rows of the maps that are compared, and number of drawn pixels
_NOISES = (1e-3, 3e-3, 1e-2, 3e-2, 1e-1)  # relative variances of a capture
# Least gain in log likelihood of a change, above a price for each day and capture in it. Clean
# captures of the demo and of 24 rooms by other programs gain up to 9, and 15 as a lamp in captures
# of a low sun only, which a lamp must gain twice; the tests' lamps and blinds gain 15 to 108, lamps
# in those rooms 33 to 105.
_MIN_GAIN, _DAY_PRICE, _CAPTURE_PRICE = 8.0, 2.0, 0.5
# A brighter day must gain this more than darkness of other captures, because blinds take light, and
# lamps are searched apart; between the two values it is unclear which of them changed. Chosen in 14
# rooms by other programs (bench/outside_rooms/faults.py).
_UNCLEAR, _BRIGHTER = 10.0, 20.0
_MAX_SHARE = 0.5  # of the captures: a larger set is the usual state, and the rest the exception
# Hours of local standard time: a lamp is on from an evening hour or until a morning hour, and a
# blind is moved at one of the others. Chosen.
_EVENINGS_H, _MORNINGS_H, _BLIND_MOVES_H = range(14, 19), range(8, 11), range(11, 15)
_NO_ROWS = np.empty(0, np.intp)


@dataclass(frozen=True, slots=True)
class Process:
    """n captures at P pixels as a Gaussian process over the light outside.

    y [n, P]: luminance over the total light and over the pixel's usual luminance, so about 1;
    covariance [n, n]: of the captures, without noise; spread [n]: factor on a capture's noise
    variance; judged [n]: True for captures that can be compared, with enough light and, without
    computed sun patches, hardly any sun; days [n]: dates; hours [n]: local standard time [h]; lamp
    [n]: 1 000 lx over the total light outside, to which the light of a lamp in `y` is proportional;
    low_sun [n]: True with a beam from below `LOW_SUN_DEG`.
    """

    y: Array
    covariance: Array
    spread: Array
    judged: Mask
    days: Array
    hours: Floats
    lamp: Floats
    low_sun: Mask


def process_of(data: Dataset, *, with_patch: bool, seen_skies: bool = False) -> Process:
    """Return the captures as a Gaussian process, at 200 pixels at most, drawn by solid angle.

    with_patch: use the sun patches of `data`. seen_skies: assume for each capture the sky that its
    windows show, not Perez's.
    """
    small = data.thin(_HEIGHT)
    arrays = training_arrays.training_arrays_of(small, with_patch=with_patch)
    if seen_skies and (sky := training_arrays.seen_sky(arrays)) is not None:
        arrays = arrays.under(sky)
    luminance = np.maximum(arrays.luminance, training_arrays.MIN_CDM2).astype(float)
    judged, valid = _compared(small, arrays, luminance)
    pixels = np.flatnonzero(valid.mean(axis=0) > 0.5)
    share = arrays.weights[pixels] / arrays.weights[pixels].sum()
    count = min(_PIXELS, len(pixels))
    pixels = np.sort(np.random.default_rng(0).choice(pixels, count, replace=False, p=share))
    unit = arrays.light.total_lx[:, None] * training_arrays.pixel_scale(arrays)
    y, valid = (luminance / unit)[:, pixels], valid[:, pixels]
    levels = [np.median(v[ok]) if ok.any() else 1.0 for v, ok in zip(y, valid, strict=True)]
    level = np.array(levels)
    lamp = LAMP_LX / arrays.light.total_lx
    covariance = Kernel(arrays.facades)(arrays.features, arrays.features)
    covariance += 100.0 * np.outer(lamp, lamp)  # a lamp that is on in all captures is no change
    spread = level**2 * (1.0 + arrays.unsure / UNSURE)
    y = np.where(valid, y, level[:, None])
    rows = np.flatnonzero(judged)
    inverse = np.linalg.inv((covariance + np.diag(1e-2 * spread))[np.ix_(rows, rows)])
    for _ in range(2):  # values that are not compared become as the other captures predict them
        predicted = y.copy()
        predicted[rows] -= inverse @ y[rows] / np.diagonal(inverse)[:, None]
        y = np.where(valid, y, predicted)
    times = [sun.standard_time(t, data.setup.site.timezone) for t in data.light.t_utc]
    hours = np.array([t.hour + t.minute / 60.0 for t in times])
    low_sun = (arrays.features.beam > 0.05) & (data.light.sun_altitude_deg < LOW_SUN_DEG)
    return Process(y, covariance, spread, judged, small.days, hours, lamp, low_sun)


def _compared(
    data: Dataset, arrays: training_arrays.TrainingArrays, luminance: Floats
) -> tuple[Mask, Mask]:
    """Return masks of n captures [n] and of values at P pixels [n, P] that can show a change.

    Captures need enough light. Window pixels, sun patches and pixels next to them are not compared.
    arrays: those of `data`; luminance: captured [n, P] cd/m2.
    """
    from scipy.ndimage import maximum_filter

    judged = np.median(luminance, axis=1) > 1.0  # the floor of the scores, cd/m2
    valid = ~arrays.filled
    if arrays.patch is None:  # without a computed sun patch, direct sun looks like a change
        # With less sun than this share of the light, an hour shows no sun patches.
        judged &= arrays.features.beam < 0.05
    elif data.patch_cdm2 is not None:
        modes = ("nearest", "nearest", "wrap")
        wide = maximum_filter(data.patch_cdm2, (1, 3, 3), mode=modes)  # pyright: ignore[reportArgumentType]
        valid &= np.asarray(wide)[:, data.seen] <= 0.05 * luminance
    valid[:, arrays.open_sky.index] = False
    return judged, valid


class Evidence:
    """The likelihood of changes of the captures `rows` of a process.

    Each pixel has a variance of its own, at its likeliest value, and the noise is the likeliest of
    `_NOISES` for each change, so that the deviation of changed captures does not count as noise.
    The likelihood is the mean over pixels, because a cloud changes all of them alike. usual: log
    likelihood without a change; level [n]: median of `Process.y` over the pixels.
    """

    def __init__(self, process: Process, rows: Indices) -> None:
        """Prepare the captures `rows` [k] of a process, for each variance of `_NOISES`."""
        self.process, self.rows = process, rows
        self.level = np.median(process.y, axis=1)  # what a factor on the light multiplies, [n]
        covariance = process.covariance[np.ix_(rows, rows)]
        spread = process.spread[rows]
        self.inverses = [np.linalg.inv(covariance + np.diag(noise * spread)) for noise in _NOISES]
        self.weights = [inverse @ process.y[rows] for inverse in self.inverses]  # [k, P] each
        # y' C^-1 y of each pixel, [P] each
        self.squares = [(w * process.y[rows]).sum(axis=0) for w in self.weights]
        self.log_determinants = [np.linalg.slogdet(inverse)[1] for inverse in self.inverses]
        self.usual = float(self._likelihood(self.squares).max())

    def _likelihood(self, squares: Sequence[Array]) -> Floats:
        """Return the log likelihood for each of `_NOISES`, the mean over the P pixels, [5].

        squares: y' C^-1 y of each pixel for each noise [5, P], with covariance C.
        """
        logs = np.log(np.maximum(squares, 1e-9)).mean(axis=1)
        return 0.5 * (np.array(self.log_determinants) - len(self.rows) * logs)

    def change(self, captures: Indices, shape: Floats) -> tuple[float, float]:
        """Return the gain in log likelihood of a change of some captures, and its likeliest size.

        captures: their indices in the process [k]; those not in `rows` do not count. shape: light
        that the change adds to each of the n captures of the process, up to a factor [n]. This
        factor, the size, is free in each pixel; the returned one is the median.
        """
        column = np.where(np.isin(self.rows, captures), shape[self.rows], 0.0)
        along = [column @ weights for weights in self.weights]
        norms = [float(column @ inverse @ column) for inverse in self.inverses]
        rest = [s - a**2 / n for s, a, n in zip(self.squares, along, norms, strict=True)]
        # The prior variance of a size is 1.
        likelihoods = self._likelihood(rest) - 0.5 * np.log1p(norms)
        k = int(np.argmax(likelihoods))
        return float(likelihoods[k]) - self.usual, float(np.median(along[k])) / norms[k]

    def level_change(self, captures: Indices) -> tuple[float, float]:
        """Return the gain in log likelihood of one factor on the light of captures, and the factor.

        captures: as for `change`. The gain is -inf for a factor that weather can explain: up to 1.2
        brighter or darker, or 1.5 for a single capture (chosen). Where Perez's classes of sky meet,
        2 W/m2 of DNI change the light in a room by a factor of 1.3.
        """
        gain, size = self.change(captures, self.level)
        factor = 1.0 / max(1.0 - size, 1e-3)
        weather = 1.2 if len(captures) > 1 else 1.5
        return gain if abs(np.log(factor)) > np.log(weather) else -np.inf, factor


def _best_set(
    steps: Sequence[Indices] | Indices, gain: Callable[[Indices], float], start: Indices = _NO_ROWS
) -> Indices:
    """Return a set of captures whose gain no step can raise, by always taking the best step.

    steps: sets of indices; a step adds its captures to the set, or removes those that the set has.
    gain: returns the gain of a set in log likelihood; start: the set to begin with.
    """
    best, best_gain = start, gain(start)
    while len(steps):
        tries = [np.setxor1d(best, step).astype(np.intp) for step in steps]
        gains = [gain(chosen) for chosen in tries]
        if max(gains) <= best_gain:
            break
        best, best_gain = tries[int(np.argmax(gains))], max(gains)
    return best


def _price(process: Process, rows: Indices) -> float:
    """Return the log likelihood that a change of captures must gain for its days and captures."""
    return _DAY_PRICE * len(np.unique(process.days[rows])) + _CAPTURE_PRICE * len(rows)


def _days_and_pairs(process: Process, rows: Indices) -> list[Indices]:
    """Return the captures of each day and of each pair of days, as sets of indices.

    A change of two days can gain too little if only one of them is in the set. Pairs of more than
    12 days take too long.
    """
    days = [rows[process.days[rows] == day] for day in np.unique(process.days[rows])]
    pairs = combinations(days, 2) if len(days) <= 12 else ()
    return [*days, *(np.union1d(a, b) for a, b in pairs)]


def find_lamp(process: Process, rows: Indices) -> Indices:
    """Return those of the captures `rows` [k] in which a lamp was on, as indices; empty if none.

    A lamp is searched in mornings or evenings, and needs at least three captures.
    """
    evidence = Evidence(process, rows)

    def gain(lit: Indices) -> float:
        """Return the gain in log likelihood, less its `_price`, of a lamp in the captures `lit`.

        It is 0 without captures, and -inf if the lamp would have to take light away.
        """
        if not len(lit):
            return 0.0
        gained, light = evidence.change(lit, process.lamp)
        if light <= 0.0:
            return -np.inf  # as if a lamp was on in the other captures instead
        return gained - _price(process, lit)

    hours = process.hours[rows]
    blocks = [rows[hours >= h] for h in _EVENINGS_H] + [rows[hours < h] for h in _MORNINGS_H]
    best = max((_best_set(_days_and_pairs(process, b), gain) for b in blocks), key=gain)
    if gain(best) <= _MIN_GAIN * (1 + process.low_sun[best].all()):
        return _NO_ROWS
    best = _best_set(rows[:, None], gain, best)
    # Computed sun patches that are slightly wrong look like a lamp in one or two captures.
    return best if len(best) > 2 else _NO_ROWS


def _group_of_other_level(evidence: Evidence) -> tuple[Indices, Indices]:
    """Return the days or parts of days that are brighter or darker than the others by one factor.

    The results are indices of captures: of the group, empty without one, and of a day if it is
    unclear whether that is brighter or others are darker, else empty. Darker days make the others
    of their season look brighter. Therefore darker and brighter sets are searched separately; a
    brighter one is of one day, and compared with darkness of the season's other days.
    """
    process, rows = evidence.process, evidence.rows
    days_and_pairs = [group for group in _days_and_pairs(process, rows) if len(group) >= 2]
    hours, days = process.hours[rows], process.days[rows]
    halves = [half for h in _BLIND_MOVES_H for half in (hours < h, hours >= h)]
    parts = [rows[(days == day) & half] for day in np.unique(days) for half in halves]
    # One or two captures of a day do not show a common factor.
    parts = [part for part in parts if len(part) >= 3]

    def gain(chosen: Indices, darker: bool) -> float:
        """Return the gain in log likelihood, less its `_price`, of a factor on captures.

        chosen: indices of the captures; the gain is 0 without any, and -inf for over half of all.
        darker: whether the factor must be below 1, or above with one day; it is -inf otherwise.
        """
        if not len(chosen):
            return 0.0
        gained, factor = evidence.level_change(chosen)
        several = not darker and len(np.unique(process.days[chosen])) > 1
        if (factor < 1.0) != darker or len(chosen) > _MAX_SHARE * len(rows) or several:
            return -np.inf
        return gained - _price(process, chosen)

    def best(darker: bool) -> Indices:
        """Return the set with the largest `gain`, indices of captures; empty if none is clear."""
        gain_of = partial(gain, darker=darker)
        chosen = _best_set(parts, gain_of, start=_best_set(days_and_pairs, gain_of))
        return chosen if gain_of(chosen) > _MIN_GAIN else _NO_ROWS

    dark, bright = best(darker=True), best(darker=False)
    season = seasons(days)
    others = np.setdiff1d(rows[np.isin(season, season[np.isin(rows, bright)])], bright)
    if not len(others):  # also without a brighter day; the last day of a season stays
        return dark, _NO_ROWS
    rival = max(gain(dark, darker=True), gain(others, darker=True))
    lead = gain(bright, darker=False) - rival if rival > 0.0 else np.inf
    if _UNCLEAR < lead <= _BRIGHTER:
        return _NO_ROWS, bright
    return (bright if lead > _BRIGHTER else dark), _NO_ROWS


def find_unexplained(process: Process) -> tuple[Indices, Indices]:
    """Return the indices [k] of captures whose light contradicts the others; empty if none.

    These are days, parts of days and single captures that are brighter or darker than the others.
    Contradicting captures are removed one after the other, at most half of all, as long as four
    days remain. The second result is the captures of a doubtful day (`RoomChanges`).
    """
    doubtful = _NO_ROWS
    judged = rows = np.flatnonzero(process.judged)
    while len(np.unique(process.days[rows])) >= MIN_DAYS:
        evidence = Evidence(process, rows)
        group, doubtful = _group_of_other_level(evidence)
        if not len(group):
            gains = [evidence.level_change(single)[0] for single in rows[:, None]]
            if max(gains) > _MIN_GAIN + _price(process, rows[:1]):
                group = rows[[int(np.argmax(gains))]]
        rest = np.setdiff1d(rows, group)
        if not len(group) or len(rest) < (1.0 - _MAX_SHARE) * len(judged):
            break
        rows = rest
    return np.setdiff1d(judged, rows), doubtful


@dataclass(frozen=True, slots=True)
class RoomChanges:
    """The captures in which the room was not as usual, although they are not marked.

    lamp: indices of captures in which a lamp was on; unexplained: indices of k captures that
    contradict the others for another reason; factor: measured light of each of these k over that
    predicted from the other captures, median over the picture [k]; doubtful: indices of captures of
    a day that is brighter than the others of its season, unless these are darker.
    """

    lamp: Indices
    unexplained: Indices
    factor: Floats
    doubtful: Indices


def find_changes(data: Dataset, *, with_patch: bool) -> RoomChanges | None:
    """Return the captures of a changed room; None if there are none, or under four days.

    with_patch: use the sun patches of `data`. At most 250 captures are compared; each of the others
    counts as the compared one that is nearest to it in their order.
    """
    # The time grows with the third power of the number of captures.
    compared = evenly_spread(len(data), 250)
    sample = data.take(compared)
    process = process_of(sample, with_patch=with_patch)
    judged = np.flatnonzero(process.judged)
    if len(np.unique(process.days[judged])) < MIN_DAYS:
        return None
    # Clouds hide a lamp, so it is searched for under the skies that the windows showed. A blind
    # looks like a dark sky there: captures that contradict the rest are found under Perez's.
    clouded = process_of(sample, with_patch=with_patch, seen_skies=True)
    lamp = find_lamp(clouded, judged)
    lit = np.isin(np.arange(len(compared)), lamp) * process.lamp
    shaded = replace(process, covariance=process.covariance + 100.0 * np.outer(lit, lit))
    unexplained, doubtful = find_unexplained(shaded)
    if len(unexplained):  # changed captures can hide a lamp, and make other captures look lit
        lamp = find_lamp(clouded, np.setdiff1d(judged, unexplained))
    if not len(lamp) + len(unexplained) + len(doubtful):
        return None
    # Captures that were not compared are as the nearest one of the compared, in the order of time.
    nearest = np.abs(np.arange(len(data))[:, None] - compared).argmin(axis=1)
    rest = np.setdiff1d(judged, unexplained)
    factors = np.ones(len(compared))
    for k in unexplained:
        factors[k] = Evidence(shaded, np.append(rest, k)).level_change(np.array([k]))[1]
    lamp, unexplained, doubtful = (
        np.flatnonzero(np.isin(nearest, some)) for some in (lamp, unexplained, doubtful)
    )
    return RoomChanges(lamp, unexplained, factors[nearest[unexplained]], doubtful)


def step_warnings(data: Dataset) -> list[str]:
    """Return a warning if pictures are brighter or darker from a day on, in the same light outside.

    The list is empty without such a day. At least two days are before and after it. Hours with
    hardly any sun, which need no sun patches, and without a marked state are compared. A factor of
    1.08 is found in the demo; under skies that differ much from Perez's, a factor of 1.12 is not.
    """
    marked = np.array([bool(state) for state in data.light.states or [""] * len(data)])
    usual = np.flatnonzero(~marked | marked.all())
    process = process_of(data.take(usual[evenly_spread(len(usual), 250)]), with_patch=False)
    rows = np.flatnonzero(process.judged)
    starts = np.unique(process.days[rows])[2:-1]
    if not len(starts):
        return []
    evidence = Evidence(process, rows)
    changes = [evidence.change(rows[process.days[rows] >= day], evidence.level) for day in starts]
    k = int(np.argmax([gain for gain, _ in changes]))
    gain, size = changes[k]
    if gain <= _MIN_GAIN:
        return []
    return [
        f"WARNING: from {starts[k]} on, pictures are {1.0 / max(1.0 - size, 1e-3):.2f} times as "
        "bright as before in the same irradiance. Possible causes are a cleaned window, another "
        "pyranometer or its calibration, another camera profile: correct the irradiance or the "
        "profile; if the room changed for good, mark the captures before with use=no (fieldlum "
        "status --mark; in a csv ok = 0), and train again"
    ]


def without_changes(data: Dataset, *, with_patch: bool) -> tuple[Dataset, list[str]]:
    """Return the captures without those of a changed room, and a warning for each change.

    Captures with an unmarked lamp and captures that contradict the others are omitted; single ones
    only if their irradiance was measured well. with_patch: use the sun patches of `data`.
    """
    changes = find_changes(data, with_patch=with_patch)
    if changes is None:
        return data, step_warnings(data)
    rows, days = changes.unexplained, data.days[changes.unexplained]
    # Whether all captures of the day, and more than one, contradict the other days.
    full = np.array([(days == day).sum() == (data.days == day).sum() > 1 for day in days], bool)
    used = full | ~is_badly_measured(data)[rows]  # single captures of faint light stay in use
    rows, days, factor, full = rows[used], days[used], changes.factor[used], full[used]
    warnings = [_lamp_warning(data, changes.lamp)] if len(changes.lamp) else []
    for day in np.unique(days[full]):
        named = full & (days == day)
        subject = f"the {named.sum()} captures of {day}"
        warnings.append(_contradiction(data, rows[named], factor[named], subject))
    if not full.all():
        subject = f"{(~full).sum()} of {len(data)} captures"
        warnings.append(_contradiction(data, rows[~full], factor[~full], subject))
    if len(changes.doubtful):
        warnings.append(
            f"WARNING: {data.days[changes.doubtful[0]]} is brighter than its season's other days, "
            "or these are darker; it is unclear which changed, and all are used: look at the "
            "pictures, and leave out or mark captures with a moved blind or wrong irradiance"
        )
    changed = np.union1d(changes.lamp, rows)
    data = data.take(np.setdiff1d(np.arange(len(data)), changed))
    return data, [*warnings, *step_warnings(data)]


def _lamp_warning(data: Dataset, lit: Indices) -> str:
    """Return the warning that an unmarked lamp was on in the captures `lit`."""
    days = ", ".join(sorted({str(data.days[row]) for row in lit}))
    return (
        f"WARNING: {len(lit)} of {len(data)} captures ({days}) have the same additional light: a "
        "lamp was on, but not marked. These captures are not used; to learn the lamp, mark them "
        "(fieldlum status SESSION --mark SLOT lamp=on) and train again: "
        f"{', '.join(data.slots[row] for row in lit)}"
    )


def _contradiction(data: Dataset, rows: Indices, factor: Floats, subject: str) -> str:
    """Return the warning that the captures `rows` [k] contradict the other days.

    factor: measured over predicted light of each [k]; subject: words for these captures.
    """
    verbs = ("contradicts", "is") if len(rows) == 1 else ("contradict", "are")
    return (
        f"WARNING: {subject} {verbs[0]} the other days and {verbs[1]} not used: the median light "
        f"is {np.median(factor):.2f} times the predicted light. Possible causes are a moved blind, "
        "a lamp, snow or wrong irradiance, here or on the season's other days; look at the "
        "pictures, mark what was different (fieldlum status SESSION --mark SLOT blind=half), and "
        "train again: "
        f"{', '.join(data.slots[row] for row in rows)}"
    )
