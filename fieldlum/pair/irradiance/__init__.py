"""Check the irradiance that a session logged, and write it as one series, irradiance/clean.csv."""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from enum import IntFlag
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
from scipy.ndimage import rank_filter

from fieldlum.core.arrays import Floats, Integers, Ints64, Mask
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.progress import progress
from fieldlum.core.records import IrradianceSample, Site, counted
from fieldlum.pair.irradiance import consistency
from fieldlum.session import Session, codec, day_files, read_day, remove_scraps, sha256
from fieldlum.session.files.irradiance_csv import DERIVED, MEASURED, CleanIrradiance
from fieldlum.sky import log_clock_offset, sun

# DIRINT uses neighbouring minutes, but not across a longer gap than this; chosen
_SEGMENT_GAP_S = 1800.0
_SPIKE_ROWS = 120  # rows on each side for the usual step: ten minutes at 5 s
# rank of the usual step, so that four other spikes in the window do not hide one; chosen
_SPIKE_RANK = 9
_RECIPE = 13  # version of the arithmetic: increase it, and clean.csv is computed again


# ----------------------------------------------------------------------------------------------
# rows as arrays

_BLOCK = 64  # rows over which the usual time between rows is computed; not measured


class Mark(IntFlag):
    """Possible faults of a row. Rows with IMPOSSIBLE, STATUS or STUCK get NaN values."""

    IMPOSSIBLE = 1  # outside BSRN's physically possible limits
    EXTREME = 2  # outside BSRN's extremely rare limits
    CLOSURE = 4  # for half an hour global differs from diffuse + direct, if all three are measured
    DIFFUSE = 8  # diffuse above global
    STUCK = 16  # the same value for over ten minutes of daylight, or the end of the range
    STATUS = 32  # the instrument reported an error
    LOW_SUN = 64  # sun under 5 degrees, where DNI from horizontal readings is inaccurate
    GAP = 128  # the first row after a gap
    DISORDER = 256  # the row is later in the file than its time requires
    DERIVED = 512  # DNI and DHI are from a model, not from an instrument
    # one reading deviates from both neighbours: a damaged line, a bird, a very small cloud
    SPIKE = 1024
    DOUBLE = 2048  # another row of the same time has other values; the first ones are used
    # clearness, diffuse share or beam transmittance that is impossible for that long
    K_INDEX = 4096
    HORIZON = 16384  # a part of the low sky where the sun is always hidden


UNUSABLE = Mark.IMPOSSIBLE | Mark.STATUS | Mark.STUCK


@dataclass(frozen=True, slots=True)
class Series:
    """Irradiance rows as arrays [n] in order of time, in W/m2 (NaN: unknown).

    marks: the `Mark` bits of each row.
    """

    t_unix_s: Floats
    ghi_wm2: Floats
    dhi_wm2: Floats
    dni_wm2: Floats
    marks: Ints64

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.t_unix_s)


def poll_period_s(t_unix_s: Floats) -> float:
    """Return the median time between two rows [s], 60 with fewer than two; t_unix_s: [n]."""
    return float(np.median(np.diff(t_unix_s))) if len(t_unix_s) > 1 else 60.0


def local_period_s(t_unix_s: Floats) -> Floats:
    """Return the usual time [s] between two rows near each row, [n]: the median of 64 rows.

    This time varies because one session can have several loggers. t_unix_s: of the rows [n],
    ascending.
    """
    step = np.diff(t_unix_s, prepend=t_unix_s[:1] - poll_period_s(t_unix_s))
    blocks = [step[first : first + _BLOCK] for first in range(0, len(step), _BLOCK)]
    usual = [float(np.median(block)) for block in blocks]
    if len(blocks) > 1 and len(blocks[-1]) < _BLOCK // 2:
        usual[-1] = usual[-2]
    return np.repeat(usual, [len(block) for block in blocks])


def series_of(samples: Sequence[IrradianceSample]) -> Series:
    """Return samples as arrays in order of time, one row for each time.

    Samples of one time are joined: each quantity is the first value without an instrument's error,
    else the first. Rows get the marks STATUS and DIFFUSE (by the instrument's status), of samples
    whose values are used, DISORDER and DOUBLE.
    """
    t = np.array([s.t_utc.timestamp() for s in samples])
    light = np.array([(s.ghi_wm2, s.dhi_wm2, s.dni_wm2) for s in samples], float).reshape(-1, 3).T
    # An error makes a reading unusable; more diffuse than global only makes it doubtful.
    status = {"": Mark(0), "total below diffuse": Mark.DIFFUSE}
    marks = np.array([status.get(s.status, Mark.STATUS) for s in samples], np.int64)
    marks[1:][t[1:] < np.maximum.accumulate(t)[:-1]] |= Mark.DISORDER
    _, keep, which = np.unique(t, return_index=True, return_inverse=True)
    # The first value of each time: sorted, rows without a value or with an error are last.
    faulty = marks & Mark.STATUS != 0
    orders = [np.lexsort((np.isnan(values) | faulty, t)) for values in light]
    firsts = [order[np.unique(t[order], return_index=True)[1]] for order in orders]
    joined = np.stack([values[rows] for values, rows in zip(light, firsts, strict=True)])
    has_value = np.isfinite(joined)  # [3, times]
    of_used = np.bitwise_or.reduce(np.where(has_value, marks[np.stack(firsts)], 0), axis=0)
    joined_marks = np.where(has_value.any(axis=0), of_used, marks[keep])
    joined_marks |= marks[keep] & Mark.DISORDER
    differs = np.isfinite(light) & (light != joined[:, which]) & ~faulty
    joined_marks[which[differs.any(axis=0)]] |= Mark.DOUBLE
    ghi, dhi, dni = joined
    return Series(t[keep], ghi_wm2=ghi, dhi_wm2=dhi, dni_wm2=dni, marks=joined_marks)


# ----------------------------------------------------------------------------------------------
# checks


def sky_geometry(t_unix_s: Floats, site: Site) -> tuple[Floats, Floats]:
    """Return the sun's true altitude [deg] and the extraterrestrial normal irradiance [W/m2].

    Both are [n], at the times t_unix_s [n], interpolated between full minutes.
    """
    minute = np.floor(t_unix_s / 60.0)
    grid_s = 60.0 * np.unique(np.r_[minute, minute + 1.0])
    times = [datetime.fromtimestamp(t, UTC) for t in grid_s]
    altitude, top = sun.position(times, site).altitude_deg, sun.extraterrestrial_wm2(times)
    return np.interp(t_unix_s, grid_s, altitude), np.interp(t_unix_s, grid_s, top)


def check(series: Series, altitude: Floats, top: Floats) -> Series:
    """Return the series with doubtful rows marked, and missing components computed.

    Rows with a mark of `UNUSABLE` become NaN. If two of GHI, DHI and DNI are measured, the third
    follows by closure: GHI = DHI + DNI sin h. altitude [n]: the sun's true altitude h in degrees;
    top [n]: normal irradiance above the atmosphere in W/m2; both from `sky_geometry`.
    """
    marks = series.marks.copy()
    ghi, dhi, dni = series.ghi_wm2, series.dhi_wm2, series.dni_wm2
    for extreme, mark in ((False, Mark.IMPOSSIBLE), (True, Mark.EXTREME)):
        limits = sun.bsrn_limits(altitude, top, extreme=extreme)
        for value, (low, high) in zip((ghi, dhi, dni), limits, strict=True):
            marks[(value < low) | (value > high)] |= mark
    marks[dhi > 1.05 * ghi + 10.0] |= Mark.DIFFUSE
    marks[consistency.closure_fails(series.t_unix_s, ghi, dhi, dni, altitude)] |= Mark.CLOSURE
    marks[_stuck(series.t_unix_s, ghi, altitude) | _saturated(ghi)] |= Mark.STUCK
    for value in (ghi, dhi, dni):
        marks[spikes(series.t_unix_s, np.where(marks & UNUSABLE, np.nan, value))] |= Mark.SPIKE
    step = np.diff(series.t_unix_s, prepend=series.t_unix_s[:1])
    marks[step > 2.5 * local_period_s(series.t_unix_s)] |= Mark.GAP
    ghi, dhi, dni = (np.where(marks & UNUSABLE, np.nan, value) for value in (ghi, dhi, dni))
    # closure: the missing one of DNI, DHI and GHI
    without_dni = np.isfinite(ghi) & np.isfinite(dhi) & np.isnan(dni)
    marks[without_dni & (altitude > 0) & (altitude < sun.LOW_SUN_DEG)] |= Mark.LOW_SUN
    computed = np.minimum(sun.dni_by_closure(ghi, dhi, altitude), top)
    computed[_is_faint(series.t_unix_s, ghi - dhi) & (altitude >= sun.LOW_SUN_DEG)] = 0.0
    dni = np.where(without_dni, computed, dni)
    without_dhi = np.isfinite(ghi) & np.isfinite(dni) & np.isnan(dhi)
    dhi = np.where(without_dhi, sun.dhi_by_closure(ghi, dni, altitude), dhi)
    beam = sun.horizontal_beam(dni, altitude)
    ghi = np.where(np.isfinite(dhi) & np.isfinite(dni) & np.isnan(ghi), dhi + beam, ghi)
    return Series(series.t_unix_s, ghi_wm2=ghi, dhi_wm2=dhi, dni_wm2=dni, marks=marks)


def _is_faint(t_unix_s: Floats, beam: Floats) -> Mask:
    """Return a mask [n] of rows whose beam is below a pyranometer's zero offset over five minutes.

    t_unix_s, beam: times, and global less diffuse irradiance, of the rows [n]. `check` sets the DNI
    of these rows to zero if the sun is above 5 degrees. Under a lower sun DNI is marked as
    inaccurate and not changed: in three months of DTU's station its rms error is 17, 22, 7 W/m2 at
    3 to 5 degrees, that of zero is 19, 23, 11 W/m2; at 2 to 3 degrees neither is better in all
    months.
    """
    sums = np.append(0.0, np.cumsum(np.nan_to_num(beam)))
    first = np.searchsorted(t_unix_s, t_unix_s - 150.0)
    last = np.searchsorted(t_unix_s, t_unix_s + 150.0, side="right")
    return np.abs(sums[last] - sums[first]) < sun.ZERO_OFFSET_WM2 * (last - first)


def _stuck(t_unix_s: Floats, ghi: Floats, altitude: Floats) -> Mask:
    """Return a mask [n] of daylight rows in a run of equal values that is over ten minutes long.

    The sun must have moved enough in the run to change the value by the log's smallest step: in
    integers of W/m2, a clear noon is constant for up to half an hour. All are False for fewer than
    three rows. ghi [n] W/m2; altitude: of the sun [n] deg.
    """
    if len(ghi) < 3:
        return np.zeros(len(ghi), bool)
    steps = np.abs(np.diff(ghi))
    changes = np.flatnonzero(steps != 0.0) + 1
    starts, ends = np.r_[0, changes], np.r_[changes, len(ghi)]
    sine = np.sin(np.radians(np.maximum(altitude, 0.1)))
    highest, lowest = np.maximum.reduceat(sine, starts), np.minimum.reduceat(sine, starts)
    smallest_step = steps[steps > 0.0].min(initial=np.inf)  # infinite if all rows are stuck
    sun_moved = ghi[starts] * (1.0 - lowest / highest) > smallest_step
    change_due = (ghi[starts] <= 0.0) | sun_moved | np.isinf(smallest_step)
    rows, seconds = ends - starts, t_unix_s[ends - 1] - t_unix_s[starts]
    stuck = np.repeat((seconds > 600.0) & (rows > 2) & change_due, rows)
    return stuck & (altitude > 2.0) & np.isfinite(ghi)


def _saturated(ghi: Floats) -> Mask:
    """Return a mask [n] of rows at the end of an instrument's or logger's range.

    ghi [n] W/m2. The end of the range is the largest value, if the log returns to it at least three
    times, and if more rows, at least ten, have exactly this value than one up to 5 % below it. A
    clear noon is within 0.5 % of its largest value for a third of the time within 5 %.
    """
    top = np.nanmax(ghi, initial=100.0)  # a lower one is that of dark days; chosen
    full, near = ghi == top, np.count_nonzero(ghi >= 0.95 * top)
    returns = np.count_nonzero(np.diff(full.astype(int), prepend=0) > 0)
    return full & (returns >= 3) & (full.sum() >= 10) & (2 * full.sum() > near)


def suspicions(series: Series, altitude: Floats, top: Floats, site: Site) -> Ints64:
    """Return the marks K_INDEX and HORIZON of each row, or 0, [n].

    The marks show impossible ratios of the components and a hidden sun; the values remain as they
    are. Rows with derived components are not tested. altitude [n] deg, top [n] W/m2: from
    `sky_geometry`.
    """
    measured = (series.marks & Mark.DERIVED) == 0
    ghi = np.where(measured, series.ghi_wm2, np.nan)
    dni = np.where(measured, series.dni_wm2, np.nan)
    marks, t = np.zeros(len(ghi), np.int64), series.t_unix_s
    fails = consistency.k_index_fails(t, ghi, series.dhi_wm2, series.dni_wm2, altitude, top)
    marks[fails] |= Mark.K_INDEX
    if np.isfinite(dni).any():
        azimuth, clear_dni = consistency.clear_sky(t, site)
        marks[consistency.shaded_horizon(t, dni, altitude, azimuth, clear_dni)] |= Mark.HORIZON
    return marks


def spikes(t_unix_s: Floats, value: Floats) -> Mask:
    """Return a mask [n] of single rows that are far above or far below both neighbours.

    t_unix_s [n], ascending; value: one component [n] W/m2, NaN where unknown. Far is over 20 W/m2,
    over eight times the difference of the two neighbours, and over three times the usual step,
    which is the ninth largest of the other steps within 120 rows on each side. Where the light
    changes often, as under broken clouds, no row is a spike: these limits find spikes and few false
    alarms (bench/damaged_series.py). Rows next to a gap, and series of fewer than 243 rows, are not
    judged.
    """
    if len(value) < 3 + 2 * _SPIKE_ROWS:
        return np.zeros(len(value), bool)
    step = np.diff(value)
    step[np.diff(t_unix_s) > 2.5 * local_period_s(t_unix_s)[1:]] = np.nan
    before, after = step[:-1], -step[1:]
    departure = np.where(before * after > 0, np.minimum(np.abs(before), np.abs(after)), 0.0)
    # Eleventh of all steps, because the two of a spike are larger than the others.
    size = np.abs(np.nan_to_num(step))
    usual = rank_filter(size, -_SPIKE_RANK - 2, 2 * _SPIKE_ROWS + 2, mode="constant")[1:]
    minimum = np.maximum(20.0, 3.0 * usual)
    is_spike = (departure > minimum) & (departure > 8.0 * np.abs(before - after))
    return np.r_[False, is_spike, False]


# ----------------------------------------------------------------------------------------------
# global alone


def minute_means(t_unix_s: Floats, value: Floats) -> tuple[Floats, Floats, Integers]:
    """Return means of `value` over UTC minutes, and which minute each row is in.

    t_unix_s, value: [n], ascending times. The result is the minutes' centres [m] (unix s), their
    means [m] (NaN without a finite value), and the index of each row's minute [n]. Minutes without
    rows are omitted, but a gap of over half an hour gets one minute of NaN, so that values on its
    two sides are not neighbours.
    """
    present, row_minute = np.unique(np.floor(t_unix_s / 60.0).astype(np.int64), return_inverse=True)
    finite = np.isfinite(value)
    count = np.bincount(row_minute[finite], minlength=len(present))
    total = np.bincount(row_minute[finite], weights=value[finite], minlength=len(present))
    means = np.divide(total, count, out=np.full(len(present), np.nan), where=count > 0)
    breaks = np.flatnonzero(np.diff(present) * 60.0 > _SEGMENT_GAP_S)
    inserted = np.searchsorted(breaks, np.arange(len(present)), side="left")  # before each minute
    centres = np.insert(60.0 * present + 30.0, breaks + 1, 60.0 * present[breaks] + 90.0)
    index = (np.arange(len(present)) + inserted)[row_minute]
    return centres, np.insert(means, breaks + 1, np.nan), index


def with_dirint(series: Series, altitude: Floats, site: Site) -> Series:
    """Return the series with DNI and DHI by DIRINT in the rows that have only global irradiance.

    DIRINT computes DNI from minute means; each row of a minute gets it in proportion to its own
    global irradiance. The rows are marked DERIVED. altitude: of the sun, true [n] deg.
    """
    alone = np.isfinite(series.ghi_wm2) & np.isnan(series.dhi_wm2) & np.isnan(series.dni_wm2)
    if not alone.any():
        return series
    ghi = np.where(alone, series.ghi_wm2, np.nan)
    centres, ghi_minute, row_minute = minute_means(series.t_unix_s, ghi)
    dni_minute = sun.dirint_dni(ghi_minute, [datetime.fromtimestamp(t, UTC) for t in centres], site)
    # DIRINT uses the change of the light: no result without a value directly before or after.
    finite = np.r_[False, np.isfinite(ghi_minute), False]
    dni_minute[~finite[:-2] & ~finite[2:] & (ghi_minute > 0.0)] = np.nan
    bright, no_beam = np.nan_to_num(ghi_minute) > 1.0, np.zeros_like(ghi_minute)
    beam_share = np.divide(dni_minute, ghi_minute, out=no_beam, where=bright)
    dni = np.where(alone, beam_share[row_minute] * np.maximum(series.ghi_wm2, 0.0), series.dni_wm2)
    dhi = np.where(alone, sun.dhi_by_closure(series.ghi_wm2, dni, altitude), series.dhi_wm2)
    marks = series.marks | np.where(alone, Mark.DERIVED, 0)
    marks[alone & (altitude > 0) & (altitude < sun.LOW_SUN_DEG)] |= Mark.LOW_SUN
    return replace(series, dhi_wm2=dhi, dni_wm2=dni, marks=marks)


# ----------------------------------------------------------------------------------------------
# how the instrument and its logger worked, and how to correct faults

NIGHT_SUN_DEG = -6.0  # end of civil twilight, by definition
NIGHT_OFFSET_WARN_WM2 = 4.0  # BSRN's limit: beyond it, night values are marked as impossible


@dataclass(frozen=True, slots=True)
class Health:
    """What health.json reports about an instrument and its logger.

    rows: number of rows in the log; broken_lines: lines that could not be read; usable: rows that
    pass the checks. every_s: median time between rows; gaps, longest_gap_s: number and longest of
    the interruptions. night_offset_wm2: median of the global while the sun is under -6 degrees; it
    is never subtracted. closure_pass: share of testable rows with global = diffuse + direct.
    clock_off_s: middle of the logged daylight minus solar noon; it needs a complete day between two
    nights. marks: number of rows with each mark. warnings: sentences for the user. None: not
    determined, for example for too few days.
    """

    rows: int
    broken_lines: int
    usable: int
    every_s: float
    gaps: int
    longest_gap_s: float
    night_offset_wm2: float | None
    closure_pass: float | None
    clock_off_s: float | None
    marks: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()


def health(
    raw: Series, clean: Series, altitude: Floats, top: Floats, damaged: int, site: Site
) -> Health:
    """Return figures and warnings about an instrument and its logger, from its rows.

    raw, clean: the same rows before and after the checks. altitude [n] deg, top [n] W/m2: from
    `sky_geometry`. damaged: number of damaged lines.
    """
    night = raw.ghi_wm2[(altitude < NIGHT_SUN_DEG) & np.isfinite(raw.ghi_wm2)]
    offset = float(np.median(night)) if len(night) >= 10 else None
    ratio = sun.closure_ratio(raw.ghi_wm2, raw.dhi_wm2, raw.dni_wm2, altitude)
    testable = np.isfinite(ratio) & (altitude > 0)
    passed = float(np.mean((clean.marks[testable] & Mark.CLOSURE) == 0)) if testable.any() else None
    seconds = np.diff(clean.t_unix_s)
    gaps = seconds[seconds > 2.5 * local_period_s(clean.t_unix_s)[1:]]
    clock_off = log_clock_offset.clock_off_s(raw.t_unix_s, raw.ghi_wm2, site)
    counts = {mark: int(np.sum((clean.marks & mark) != 0)) for mark in Mark}
    of_log, zone = _of_log(offset, passed, clock_off, damaged), ZoneInfo(site.timezone)
    return Health(
        rows=len(clean),
        broken_lines=damaged,
        usable=int(np.isfinite(clean.dni_wm2 + clean.dhi_wm2).sum()),
        every_s=poll_period_s(clean.t_unix_s),
        gaps=len(gaps),
        longest_gap_s=float(gaps.max(initial=0.0)),
        night_offset_wm2=offset,
        closure_pass=passed,
        clock_off_s=clock_off,
        marks={(mark.name or "").lower(): count for mark, count in counts.items() if count},
        warnings=(*of_log, *_of_level(raw, altitude, site), *_of_day(clean, altitude, top, zone)),
    )


# ----------------------------------------------------------------------------------------------
# warnings, each with what the user can do


def _of_log(
    night_wm2: float | None, closure: float | None, off_s: float | None, damaged: int
) -> Iterator[str]:
    """Yield warnings about a log's zero offset, closure, clock and damaged lines.

    night_wm2, closure, off_s: `night_offset_wm2`, `closure_pass` and `clock_off_s` of `Health`;
    damaged: number of lines.
    """
    if night_wm2 is not None and abs(night_wm2) >= NIGHT_OFFSET_WARN_WM2:
        cause = "clean and ventilate the instrument, and check its zero in the dark"
        if night_wm2 > 20.0:  # larger than any instrument's offset
            cause = "check for a lamp, the logger's clock, --logger-utc-offset of fieldlum import, "
            cause += "and longitude_deg; then import again"
        yield f"global irradiance of {night_wm2:+.1f} W/m2 at night instead of 0: {cause}"
    if closure is not None and closure < 0.8:
        share = f"global = diffuse + direct is true in only {100 * closure:.0f} % of the rows"
        yield f"{share}: check the clock and the tilt of the instruments"
    if off_s is not None and abs(off_s) > log_clock_offset.CLOCK_WARN_S:
        yield (
            f"the middle of the logged daylight is {off_s / 60:+.0f} min from solar noon: check "
            "the logger's clock, --logger-utc-offset (daylight saving?) and longitude_deg, and "
            "import the file again"
        )
    if damaged:
        remedy = "check the disk, and do not edit these files"
        yield f"skipped in irradiance/YYYY-MM-DD.csv: {counted(damaged, 'damaged line')}; {remedy}"


def _of_level(raw: Series, altitude: Floats, site: Site) -> Iterator[str]:
    """Yield a warning for each month whose clear hours are not as bright as a cloudless sky.

    raw: rows before the checks; altitude [n] deg: from `sky_geometry`.
    """
    times = [datetime.fromtimestamp(t, UTC) for t in raw.t_unix_s]
    months = np.array([f"{t:%Y-%m}" for t in times])
    for month in np.unique(months).tolist():
        rows = np.flatnonzero(months == month)
        light = (raw.ghi_wm2[rows], raw.dhi_wm2[rows], altitude[rows])
        wrong = sun.wrong_level([times[row] for row in rows], *light, site)
        if wrong:
            yield f"in {month} {wrong}: check the pyranometers' sensitivity, level and unit"


_FAULTS = {
    Mark.IMPOSSIBLE: "an impossible irradiance: check units, columns and clock",
    Mark.EXTREME: "an extremely rare irradiance: check units, columns and clock",
    Mark.DIFFUSE: "more diffuse than global irradiance: check whether the columns are exchanged",
    Mark.K_INDEX: "an impossible ratio of global, diffuse and direct: check instruments, tracker",
    Mark.HORIZON: "the sun in a low part of the sky where it was never measured: check for shade",
    Mark.STUCK: "one value for over ten minutes, or a range's end: check instrument and cable",
    Mark.STATUS: "an error reported by the instrument: see its manual",
    Mark.SPIKE: "isolated spikes: check the cable",
    Mark.DOUBLE: "another row of the same time with other values: check the clock",
}


def _of_day(clean: Series, altitude: Floats, top: Floats, zone: ZoneInfo) -> Iterator[str]:
    """Yield a warning for each fault of over 5 % of the rows with the sun above 10 degrees.

    It has the times of the first and the last such row. clean: rows after the checks; altitude [n]
    deg, top [n] W/m2: from `sky_geometry`; zone: of the times.
    """
    up = altitude > sun.CLEAR_SUN_DEG
    if not up.any():
        return
    weak = sun.too_weak(clean.ghi_wm2, altitude, top)
    faults = {text: (clean.marks & mark) != 0 for mark, text in _FAULTS.items()}
    # some rows, one after another
    covered = not weak[up].all() and np.sum(np.diff(weak[up], prepend=False) & weak[up]) == 1
    cause = "for a covered instrument or a loose cable" if covered else "for values in kW/m2"
    faults[f"less light than the darkest overcast sky: check {cause}"] = weak
    faults[
        "global but no direct irradiance: direct cannot be derived from global without another row "
        "within half an hour; log at least every minute"
    ] = np.isfinite(clean.ghi_wm2) & np.isnan(clean.dni_wm2)
    for text, rows in faults.items():
        if (share := float(np.mean(rows[up]))) > 0.05:
            ends = [datetime.fromtimestamp(t, zone) for t in clean.t_unix_s[up & rows][[0, -1]]]
            when = " to ".join(f"{t:%Y-%m-%d %H:%M}" for t in ends)
            yield f"{100 * share:.0f} % of the rows by day have {text} (local time: {when})"


# ----------------------------------------------------------------------------------------------
# files


def mark_text(marks: int) -> str:
    """Return the names of a row's marks except DERIVED, such as ``low-sun gap``, or ""."""
    shown = (mark for mark in Mark if marks & mark and mark is not Mark.DERIVED)
    return " ".join((mark.name or "").lower().replace("_", "-") for mark in shown)


def clean_of(series: Series) -> CleanIrradiance:
    """Return the table of clean.csv: values, their source, and the marks of each row as text."""
    kinds, which = np.unique(series.marks, return_inverse=True)
    flags = np.array([mark_text(int(marks)) for marks in kinds], object)[which]
    source = np.where(series.marks & Mark.DERIVED, DERIVED, MEASURED).astype(object)
    names = ("t_unix_s", "ghi_wm2", "dhi_wm2", "dni_wm2")
    columns = {name: getattr(series, name) for name in names}
    return CleanIrradiance(**columns, source=source, flags=flags)


def run(session: Session, *, force: bool = False) -> Health:
    """Check the logged irradiance; write irradiance/clean.csv and irradiance/health.json.

    Return health.json's content. Existing files of the same site and the same day files are not
    computed again, unless `force`. Raises NotEnoughDataError without a readable line, InputError
    for an invalid session.toml.
    """
    remove_scraps(session.irradiance)
    files = day_files(session)
    note, clean = session.irradiance_health, session.clean_irradiance
    site = session.site_file().site
    digests = {path.name: sha256(path) for path in files}
    inputs = {"recipe": _RECIPE, "files": digests, "site": asdict(site)}
    table = None if force else codec.current_note(note, inputs, [clean])
    if table is not None:
        with suppress(ValueError):  # a user edited it: compute it again
            return codec.convert(table, Health)
    raw, damaged = _read(files)
    if len(raw) == 0:
        cause = f"all {damaged} logged lines are damaged" if damaged else "no irradiance was logged"
        raise NotEnoughDataError(
            f"{session.irradiance}: {cause}; run fieldlum log {session.root} "
            f"--pyranometer URI, or fieldlum import {session.root} --irradiance FILE"
        )
    altitude, top = sky_geometry(raw.t_unix_s, site)
    checked = check(raw, altitude, top)
    checked.marks[:] |= suspicions(checked, altitude, top, site)
    series = with_dirint(checked, altitude, site)
    quality = health(raw, series, altitude, top, damaged, site)
    clean_of(series).write(clean)
    codec.write_object(note, {**asdict(quality), "inputs": inputs})
    return quality


def _read(files: Sequence[Path]) -> tuple[Series, int]:
    """Return the rows of all day files, and the number of damaged lines.

    The samples of one day at a time are Python objects, which limits the memory.
    """
    days, damaged = [], 0
    for number, path in enumerate(files, start=1):
        samples, count = read_day(path)
        damaged += count
        if samples:
            days.append(series_of(samples))
        progress(number, len(files), path.stem)
    days = days or [series_of([])]
    names = Series.__dataclass_fields__
    return Series(**{n: np.concatenate([getattr(d, n) for d in days]) for n in names}), damaged
