"""Find captures in which the room was not as usual, by comparing them with those of other days.

The captures are a Gaussian process over the light outside, which all pixels share. A change of some
captures is one more term of their covariance: a lamp of unknown light, a factor on the light of a
day or a part of it, as by a blind, or one capture that is free. Its likelihood is in closed form
(Tipping and Faul, AISTATS 2003), so that all changes are compared with one inverse. Clouds make
single captures deviate, each to its own side; a change makes all of its captures deviate alike.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from fieldlum.core.arrays import Array, Floats, Indices, Mask, evenly_spread
from fieldlum.learn.models.held_out_choice import UNSURE, is_badly_measured
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.transport.training_arrays import (
    MIN_CDM2,
    pixel_scale,
    seen_sky,
    training_arrays_of,
)
from fieldlum.sky import sun
from fieldlum.sky.daylight_kernel import LAMP_LX, Kernel

MIN_DAYS = 4  # with fewer days it is unclear which day is the exception
_HEIGHT, _PIXELS = 20, 200  # rows and pixels of the maps that are compared
_NOISES = (1e-3, 3e-3, 1e-2, 3e-2, 1e-1)  # relative variances of a capture
# Log likelihood that a change must gain, and its price for a day and for a capture. Clean captures
# of the demo, of two rooms by other programs and of the tests' room under clouds gain up to 9; the
# tests' lamps and blinds 19 to 108.
_MIN_GAIN, _DAY_PRICE, _CAPTURE_PRICE = 8.0, 2.0, 0.5
_MAX_SHARE = 0.5  # of the captures: a larger set is the usual state, and the rest the exception
_EVENINGS_H, _MORNINGS_H = range(14, 19), range(8, 11)  # lamps are on from, or until, these
_PARTS_H = range(11, 15)  # of a blind's move
_NO_ROWS = np.empty(0, np.intp)


@dataclass(frozen=True, slots=True)
class Process:
    """n captures at P pixels as a Gaussian process over the light outside.

    y [n, P]: luminance over the total light and over the pixel's usual luminance, so about 1;
    covariance [n, n]: without noise; spread [n]: factor on a capture's noise; judged [n]: whether a
    picture has enough light and, without computed sun patches, hardly any sun; days [n]: dates;
    hours [n]: local standard time [h]; lamp [n]: 1 000 lx over the total light outside, to
    which the light of a lamp is proportional.
    """

    y: Array
    covariance: Array
    spread: Array
    judged: Mask
    days: Array
    hours: Floats
    lamp: Floats


def process_of(data: Dataset, *, with_patch: bool, seen_skies: bool = False) -> Process:
    """Return the captures as a process at 200 pixels at most, drawn by solid angle.

    Window pixels, sun patches and pixels next to them are not compared. with_patch: use the sun
    patches of `data`. seen_skies: assume for each capture the sky that its windows show, not
    Perez's.
    """
    from scipy.ndimage import maximum_filter

    small = data.thin(_HEIGHT)
    arrays = training_arrays_of(small, with_patch=with_patch)
    if seen_skies and (sky := seen_sky(arrays)) is not None:
        arrays = arrays.under(sky)
    luminance = np.maximum(arrays.luminance, MIN_CDM2).astype(float)
    total = arrays.light.total_lx
    judged = np.median(luminance, axis=1) > 1.0  # the floor of the scores, cd/m2
    valid = ~arrays.filled
    if arrays.patch is None:  # without a computed sun patch, direct sun looks like a change
        # With less sun than this share of the light, an hour shows no sun patches.
        judged &= arrays.features.beam < 0.05
    elif small.patch_cdm2 is not None:
        modes = ("nearest", "nearest", "wrap")
        wide = maximum_filter(small.patch_cdm2, (1, 3, 3), mode=modes)  # pyright: ignore[reportArgumentType]
        valid &= np.asarray(wide)[:, small.seen] <= 0.05 * luminance
    valid[:, arrays.open_sky.index] = False
    pixels = np.flatnonzero(valid.mean(axis=0) > 0.5)
    share = arrays.weights[pixels] / arrays.weights[pixels].sum()
    count = min(_PIXELS, len(pixels))
    pixels = np.sort(np.random.default_rng(0).choice(pixels, count, replace=False, p=share))
    y, valid = (luminance / (total[:, None] * pixel_scale(arrays)))[:, pixels], valid[:, pixels]
    rows = zip(y, valid, strict=True)
    level = np.array([np.median(v[ok]) if ok.any() else 1.0 for v, ok in rows])
    lamp = LAMP_LX / total
    # a lamp that is on in all captures is part of the room
    covariance = Kernel(arrays.facades)(arrays.features, arrays.features)
    covariance += 100.0 * np.outer(lamp, lamp)
    spread = level**2 * (1.0 + arrays.unsure / UNSURE)
    y = np.where(valid, y, level[:, None])
    rows = np.flatnonzero(judged)
    inverse = np.linalg.inv((covariance + np.diag(1e-2 * spread))[np.ix_(rows, rows)])
    for _ in range(2):  # what is not compared is as the other captures predict it
        predicted = y.copy()
        predicted[rows] -= inverse @ y[rows] / np.diagonal(inverse)[:, None]
        y = np.where(valid, y, predicted)
    times = [sun.standard_time(t, data.setup.site.timezone) for t in data.light.t_utc]
    hours = np.array([t.hour + t.minute / 60.0 for t in times])
    return Process(y, covariance, spread, judged, small.days, hours, lamp)


class Evidence:
    """How likely changes of the captures `rows` of a process are.

    Each pixel has a variance of its own, at its likeliest value, and the noise is the likeliest of
    `_NOISES` for each change: captures that deviate only because others were changed do not hide
    these. The likelihood is the mean over pixels, because a cloud moves all of them alike.
    """

    def __init__(self, process: Process, rows: Indices) -> None:
        """Prepare the captures `rows` [k] of a process, for each variance of `_NOISES`."""
        self.process, self.rows = process, rows
        self.level = np.median(process.y, axis=1)  # the shape of a factor on the light
        covariance = process.covariance[np.ix_(rows, rows)]
        spread = process.spread[rows]
        self.inverses = [np.linalg.inv(covariance + np.diag(noise * spread)) for noise in _NOISES]
        self.weights = [inverse @ process.y[rows] for inverse in self.inverses]  # [k, P] each
        self.squares = [(w * process.y[rows]).sum(axis=0) for w in self.weights]  # [P] each
        self.volumes = [np.linalg.slogdet(inverse)[1] for inverse in self.inverses]
        self.usual = float(self._likelihood(self.squares).max())

    def _likelihood(self, squares: Sequence[Array]) -> Floats:
        """Return the mean log likelihood of a pixel by noise; squares: y' C^-1 y, [P] each."""
        logs = np.log(np.maximum(squares, 1e-9)).mean(axis=1)
        return 0.5 * (np.array(self.volumes) - len(self.rows) * logs)

    def change(self, captures: Indices, shape: Floats) -> tuple[float, float]:
        """Return by how much a change of `captures` along a shape [n] raises the log likelihood.

        Its size is free in each pixel. The second value is the likeliest size in units of the
        shape, the median over pixels.
        """
        column = np.where(np.isin(self.rows, captures), shape[self.rows], 0.0)
        along = [column @ weights for weights in self.weights]
        norms = [float(column @ inverse @ column) for inverse in self.inverses]
        rest = [s - a**2 / n for s, a, n in zip(self.squares, along, norms, strict=True)]
        # the prior variance of a factor is 1; a lamp's is no less
        likelihoods = self._likelihood(rest) - 0.5 * np.log1p(norms)
        k = int(np.argmax(likelihoods))
        return float(likelihoods[k]) - self.usual, float(np.median(along[k])) / norms[k]

    def level_change(self, captures: Indices) -> tuple[float, float]:
        """Return the gain in log likelihood of one factor on the light of captures, and the factor.

        captures: indices [k]. A factor under 1.2 either way, or 1.5 of a single capture, is
        weather, and gains nothing: where Perez's classes of sky meet, 2 W/m2 of DNI change the
        light in a room by 1.3.
        """
        gain, size = self.change(captures, self.level)
        factor = 1.0 / max(1.0 - size, 1e-3)
        weather = 1.2 if len(captures) > 1 else 1.5
        return gain if abs(np.log(factor)) > np.log(weather) else -np.inf, factor


def _best_set(
    steps: Sequence[Indices] | Indices, gain: Callable[[Indices], float], start: Indices = _NO_ROWS
) -> Indices:
    """Return the set of captures at which no step raises the gain any more.

    A step (indices of captures) adds its captures to the set, or removes those that the set has.
    gain: of a set, in log likelihood; start: the set to begin with.
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
    return _DAY_PRICE * len(np.unique(process.days[rows])) + _CAPTURE_PRICE * len(rows)


def _days_and_pairs(process: Process, rows: Indices) -> list[Indices]:
    """Return the captures of each day, and of each pair of days, because one may explain little."""
    days = [rows[process.days[rows] == day] for day in np.unique(process.days[rows])]
    pairs = combinations(days, 2) if len(days) <= 12 else ()
    return [*days, *(np.union1d(a, b) for a, b in pairs)]


def find_lamp(process: Process, rows: Indices) -> Indices:
    """Return those of the captures `rows` [k] in which a lamp was on, as indices; empty if none.

    A lamp is searched in mornings or evenings, and needs at least three captures.
    """
    found = Evidence(process, rows)

    def gain(lit: Indices) -> float:
        if not len(lit):
            return 0.0
        gained, light = found.change(lit, process.lamp)
        if light <= 0.0:
            return -np.inf  # the lamp was on in the other captures
        return gained - _price(process, lit)

    hours = process.hours[rows]
    blocks = [rows[hours >= h] for h in _EVENINGS_H] + [rows[hours < h] for h in _MORNINGS_H]
    best = max((_best_set(_days_and_pairs(process, b), gain) for b in blocks), key=gain)
    if gain(best) <= _MIN_GAIN:
        return _NO_ROWS
    best = _best_set(rows[:, None], gain, best)
    # computed patches that are a little off look like a lamp in one or two captures
    return best if len(best) > 2 else _NO_ROWS


def _other_level(found: Evidence) -> Indices:
    """Return the captures, days or parts of days, that one factor for each pixel explains best.

    Three darker days make the others look brighter: darker and brighter sets are searched
    separately, and there is no result if it is unclear which of them are the exception. found:
    evidence on the captures that are compared.
    """
    process, rows = found.process, found.rows
    steps = [b for b in _days_and_pairs(process, rows) if len(b) >= 2]
    at, days = process.hours[rows], process.days[rows]
    halves = [part for h in _PARTS_H for part in (at < h, at >= h)]
    parts = [rows[(days == day) & half] for day in np.unique(days) for half in halves]
    # One or two captures of a day do not show a common factor.
    parts = [part for part in parts if len(part) >= 3]

    def gain(chosen: Indices, darker: bool) -> float:
        if not len(chosen):
            return 0.0
        gained, factor = found.level_change(chosen)
        if (factor < 1.0) != darker or len(chosen) > _MAX_SHARE * len(rows):
            return -np.inf
        return gained - _price(process, chosen)

    sets = []
    for darker in (True, False):
        first = _best_set(steps, lambda c, d=darker: gain(c, d))
        chosen = _best_set(parts, lambda c, d=darker: gain(c, d), first)
        sets.append((gain(chosen, darker), chosen))
    (second, _), (best_gain, best) = sorted(sets, key=lambda s: s[0])
    return best if best_gain > _MIN_GAIN and best_gain - second > 1.0 else _NO_ROWS


def find_unexplained(process: Process) -> Indices:
    """Return the indices [k] of captures whose light contradicts the others; empty if none.

    These are groups with another level, and single captures. They are removed one after the other,
    at most half of all, as long as four days remain.
    """
    judged = rows = np.flatnonzero(process.judged)
    while len(np.unique(process.days[rows])) >= MIN_DAYS:
        found = Evidence(process, rows)
        unit = _other_level(found)
        if not len(unit):
            gains = [found.level_change(single)[0] for single in rows[:, None]]
            if max(gains) > _MIN_GAIN + _price(process, rows[:1]):
                unit = rows[[int(np.argmax(gains))]]
        rest = np.setdiff1d(rows, unit)
        if not len(unit) or len(rest) < (1.0 - _MAX_SHARE) * len(judged):
            break
        rows = rest
    return np.setdiff1d(judged, rows)


@dataclass(frozen=True, slots=True)
class RoomChanges:
    """The captures in which the room was not as usual, although they are not marked.

    lamp: indices of captures in which a lamp was on; unexplained: of captures that contradict the
    others for another reason; factor: measured light over that predicted from the other captures,
    median over the picture, for each of the unexplained.
    """

    lamp: Indices
    unexplained: Indices
    factor: Floats


def find_changes(data: Dataset, *, with_patch: bool) -> RoomChanges | None:
    """Return the captures of a changed room; None if there are none, or under four days.

    with_patch: use the sun patches of `data`.
    """
    count = len(data)
    # The time grows with the third power of the number of captures.
    compared = evenly_spread(count, 250)
    few = data.take(compared)
    process = process_of(few, with_patch=with_patch)
    judged = np.flatnonzero(process.judged)
    if len(np.unique(process.days[judged])) < MIN_DAYS:
        return None
    # Clouds hide a lamp, so it is searched for under the skies that the windows showed. A blind
    # looks like a dark sky there: captures that contradict the rest are found under Perez's.
    clouded = process_of(few, with_patch=with_patch, seen_skies=True)
    lamp = find_lamp(clouded, judged)
    lit = np.isin(np.arange(len(compared)), lamp) * process.lamp
    shaded = replace(process, covariance=process.covariance + 100.0 * np.outer(lit, lit))
    unexplained = find_unexplained(shaded)
    if len(unexplained):  # changed captures can hide a lamp, and make other captures look lit
        lamp = find_lamp(clouded, np.setdiff1d(judged, unexplained))
    if len(lamp) <= 2 and is_badly_measured(few)[lamp].all():  # a low sun that was not measured
        lamp = _NO_ROWS
    if not len(lamp) and not len(unexplained):
        return None
    # the others are as the nearest of these, in the order of time
    nearest = np.abs(np.arange(count)[:, None] - compared).argmin(axis=1)
    rest = np.setdiff1d(judged, unexplained)
    factors = np.ones(len(compared))
    for k in unexplained:
        factors[k] = Evidence(shaded, np.append(rest, k)).level_change(np.array([k]))[1]
    lamp, unexplained = (np.flatnonzero(np.isin(nearest, r)) for r in (lamp, unexplained))
    return RoomChanges(lamp, unexplained, factors[nearest[unexplained]])


def step_note(data: Dataset) -> list[str]:
    """Return a warning if pictures are brighter or darker from a day on, in the same light outside.

    At least two days are before and after it. Hours with hardly any sun are compared, which need no
    sun patches. A factor of 1.08 is found in the demo; under skies that are far from Perez's, none
    of 1.12 is.
    """
    process = process_of(data.take(evenly_spread(len(data), 250)), with_patch=False)
    rows = np.flatnonzero(process.judged)
    starts = np.unique(process.days[rows])[2:-1]
    if not len(starts):
        return []
    found = Evidence(process, rows)
    changes = [found.change(rows[process.days[rows] >= day], found.level) for day in starts]
    k = int(np.argmax([gain for gain, _ in changes]))
    gain, size = changes[k]
    if gain <= _MIN_GAIN:
        return []
    return [
        f"WARNING: from {starts[k]} on, pictures are {1.0 / max(1.0 - size, 1e-3):.2f} times as "
        "bright as before in the same irradiance. Possible causes are a cleaned window, another "
        "pyranometer or its calibration, another camera profile: correct the irradiance or the "
        "profile; if the room changed for good, set ok = 0 in pairs.csv for the captures before, "
        "and train again"
    ]


def without_changes(data: Dataset, *, with_patch: bool) -> tuple[Dataset, list[str]]:
    """Return the captures without those of a changed room, and a warning for each change.

    Captures with an unmarked lamp and captures that contradict the others are omitted; single ones
    only if their irradiance was measured well. with_patch: use the sun patches of `data`.
    """
    changes = find_changes(data, with_patch=with_patch)
    if changes is None:
        return data, step_note(data)
    rows, days = changes.unexplained, data.days[changes.unexplained]
    full = np.array([(days == day).sum() == (data.days == day).sum() > 1 for day in days], bool)
    clear = full | ~is_badly_measured(data)[rows]  # single captures of faint light stay in use
    rows, days, factor, full = rows[clear], days[clear], changes.factor[clear], full[clear]
    notes = []
    if len(changes.lamp):
        lit = ", ".join(sorted({str(data.days[row]) for row in changes.lamp}))
        notes.append(
            f"WARNING: {len(changes.lamp)} of {len(data)} captures ({lit}) have the same "
            "additional light: a lamp was on, but not marked. These captures are not used; to "
            "learn the lamp, mark them (fieldlum status SESSION --mark SLOT lamp=on) and train "
            f"again: {', '.join(data.slots[row] for row in changes.lamp)}"
        )
    for day in (*np.unique(days[full]), None):
        named = ~full if day is None else full & (days == day)
        if not named.any():
            continue
        subject = f"{named.sum()} of {len(data)} captures"
        subject = subject if day is None else f"the {named.sum()} captures of {day}"
        verbs = ("contradicts", "is") if named.sum() == 1 else ("contradict", "are")
        notes.append(
            f"WARNING: {subject} {verbs[0]} the other days and {verbs[1]} not used: the median "
            f"light is {np.median(factor[named]):.2f} times the predicted light. "
            "Possible causes are a moved blind, a lamp, snow or wrong irradiance; look at "
            "the pictures, mark what was different (fieldlum status SESSION --mark SLOT "
            f"blind=half), and train again: {', '.join(data.slots[row] for row in rows[named])}"
        )
    changed = np.union1d(changes.lamp, rows)
    data = data.take(np.setdiff1d(np.arange(len(data)), changed))
    return data, [*notes, *step_note(data)]
