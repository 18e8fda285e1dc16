"""Check whether three components, a clear sky and earlier days agree.

The checks are closure, k-indices, a tracker that points elsewhere, a shaded horizon, and a changed
sensitivity. pvlib has none of these. pvanalytics has QCRad's limits and closure, but without the
average that broken clouds require. Limits of k-indices and the tracker test: Forstinger et al.
2021, Expert quality control of solar radiation ground data sets (ISES SWC 2021; IEA PVPS Task 16).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from datetime import UTC, date, datetime

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import Site
from fieldlum.pair.irradiance.series import Mark, Series
from fieldlum.sky import sun

Rows = Mask
DAY_S = 86400.0  # by definition
# seconds; a clear sky changes by at most 2 % in five minutes, near sunrise; chosen
_CLEAR_GRID_S = 300.0
# Seconds. Under broken clouds, instruments with some distance or different time constants differ by
# over 8 % in 4 % of the sunny minutes of a good station (bench/station_qc.py), but a fault lasts.
CLOSURE_WINDOW_S = 1800.0

# Limits of the k-indices, all from Forstinger et al. 2021.
_K_LEAST_WM2 = 50.0  # GHI from which indices are tested
_KT_MOST = 1.35
_KD_MOST, _KD_MOST_LOW_SUN, _KD_ALTITUDE_DEG = 1.05, 1.10, 15.0
_KD_CLEAR, _KT_CLEAR, _CLEAR_LEAST_WM2, _CLEAR_ALTITUDE_DEG = 0.96, 0.6, 150.0, 5.0
_KN_TOP_WM2, _KN_PER_M = 1100.0, 0.03
# Seconds. A cloud's edge passes two instruments one after the other, but a fault lasts longer. Not
# measured.
_K_LASTS_S = 900.0

# With Forstinger's 0.2 for global and 5 degrees, bright overcast hours would be marked; the monthly
# turbidity gives a clear sky's global within 18 %. Chosen.
_TRACKER_GHI, _TRACKER_DNI, _TRACKER_ALTITUDE_DEG = 0.1, 0.95, 10.0

_HORIZON_DEG = 20.0  # higher obstructions are visible in the scene; not measured
_BIN_AZIMUTH_DEG, _BIN_ALTITUDE_DEG = 4.0, 1.0  # chosen
_BLOCKED, _FREE = 0.05, 0.5  # of the clear sky's DNI; not measured
_FREE_WITHIN_S = 2700.0  # seconds before or after within which the sun must be free; chosen
# number of days that must agree; clouds at one place of the horizon on four such days are rare;
# chosen
_BLOCKED_DAYS = 4

_STEP_ALTITUDE_DEG, _STEP_DNI_WM2 = 20.0, 300.0  # chosen
# relative deviation of DNI from its mean, and seconds of that mean; chosen
_STEADY, _STEADY_WINDOW_S = 0.05, 600.0
_DAY_STEADY_S = 1800.0  # least seconds of steady sun on a day whose median is used; not measured
# A day's scatter is (1 + this / steady seconds)^0.5 times that of an endless clear day: an hour of
# steady sun between clouds scatters by 1.3 %, seven hours scatter by 0.5 % (three months at
# Lyngby). Measured with the data of docs/validation.md.
_FULL_DAY_S = 28800.0
# Least step, in multiples of the day-to-day scatter; without a step, 2 % of 20-day records reach
# it. Chosen.
_STEP_SIGMA = 4.0
_STEP_DAYS = 3  # least number of days on each side; chosen, not measured
# least scatter of daily medians: no instrument repeats better from day to day; chosen
_LEAST_SCATTER = 0.001


def window_mean(
    t_unix_s: Floats, value: Floats, window_s: float
) -> tuple[Floats, NDArray[np.int64]]:
    """Return the mean of the finite values within window_s / 2 of each row, and their number, [n].

    t_unix_s must ascend. The mean is NaN without a finite value.
    """
    good = np.isfinite(value)
    total = np.r_[0.0, np.cumsum(np.where(good, value, 0.0))]
    count = np.r_[0, np.cumsum(good)]
    first = np.searchsorted(t_unix_s, t_unix_s - window_s / 2, side="left")
    last = np.searchsorted(t_unix_s, t_unix_s + window_s / 2, side="right")
    rows = count[last] - count[first]
    mean = np.divide(
        total[last] - total[first], rows, out=np.full(len(rows), np.nan), where=rows > 0
    )
    return mean, rows.astype(np.int64)


def lasting(t_unix_s: Floats, marked: Rows, window_s: float) -> Rows:
    """Return a mask [n] of the marked rows in whose window at least half of the rows are marked."""
    share, _ = window_mean(t_unix_s, marked.astype(float), window_s)
    return marked & (share >= 0.5)


def closure_fails(
    t_unix_s: Floats, ghi: Floats, dhi: Floats, dni: Floats, altitude: Floats
) -> Rows:
    """Return a mask [n] of the rows that contradict global = diffuse + direct, by QCRad's test.

    The ratio of global to diffuse + direct may differ from 1 by 8 % if the sun is higher than 15
    degrees, and by 15 % if it is lower. A row is only in the mask if at least half of the testable
    rows in the half hour around it differ by more. Rows below 50 W/m2, or with only two components,
    are not testable. altitude: of the sun [n] deg.
    """
    ratio = sun.closure_ratio(ghi, dhi, dni, altitude)
    allowed = np.where(altitude > 15.0, 0.08, 0.15)
    testable = np.isfinite(ratio) & (altitude > -3.0)
    with np.errstate(invalid="ignore"):
        fails = testable & (np.abs(ratio - 1.0) > allowed)
    share, _ = window_mean(
        t_unix_s, np.where(testable, fails.astype(float), np.nan), CLOSURE_WINDOW_S
    )
    with np.errstate(invalid="ignore"):
        return fails & (share >= 0.5)


def k_index_fails(
    t_unix_s: Floats,
    ghi: Floats,
    dhi: Floats,
    dni: Floats,
    altitude: Floats,
    top: Floats,
    altitude_m: float = 0.0,
) -> Rows:
    """Return a mask [n] of rows with impossible k-indices for at least half of 15 minutes.

    The k-indices are clearness, diffuse share and beam transmittance. top: irradiance above the
    atmosphere on a plane normal to the sun [n] W/m2. The test cannot decide which of two
    contradicting components is wrong.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        kt = ghi / (top * np.maximum(np.sin(np.radians(altitude)), 1e-3))
        kn, kd = dni / top, dhi / ghi
        tested = (ghi > _K_LEAST_WM2) & (altitude > 0.0)
        most_kd = np.where(altitude > _KD_ALTITUDE_DEG, _KD_MOST, _KD_MOST_LOW_SUN)
        clear = (kt > _KT_CLEAR) & (ghi > _CLEAR_LEAST_WM2) & (altitude > _CLEAR_ALTITUDE_DEG)
        fails = (kn > kt) & (kn > 0) & (kt > 0)
        fails |= kn > (_KN_TOP_WM2 + _KN_PER_M * altitude_m) / top
        fails |= (kt > _KT_MOST) | (kd > most_kd) | (clear & (kd > _KD_CLEAR))
    return lasting(t_unix_s, np.asarray(tested & fails), _K_LASTS_S)


def tracker_off(
    t_unix_s: Floats, ghi: Floats, dni: Floats, altitude: Floats, clear: sun.Irradiance
) -> Rows:
    """Return a mask [n] of rows with a clear sky's global but almost no direct for half an hour.

    The tracker points elsewhere, or the pyrheliometer is covered. clear: of a clear sky, [n].
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        near = np.abs(clear.ghi_wm2 - ghi) / (clear.ghi_wm2 + ghi) < _TRACKER_GHI
        none = (clear.dni_wm2 - dni) / (clear.dni_wm2 + dni) > _TRACKER_DNI
    up = altitude > _TRACKER_ALTITUDE_DEG
    off = up & near & none & (clear.ghi_wm2 > _K_LEAST_WM2)
    return lasting(t_unix_s, np.asarray(off), CLOSURE_WINDOW_S)


def shaded_horizon(
    t_unix_s: Floats, dni: Floats, altitude: Floats, azimuth: Floats, clear_dni: Floats
) -> Rows:
    """Return a mask [n] of rows in sectors of the low sky where the sun is always hidden.

    A sector is 4 x 1 degrees, below 20 degrees of altitude. The sun must be hidden there on at
    least four days on which it is free shortly before or after. clear_dni: of a clear sky, [n].
    """
    out = np.zeros(len(t_unix_s), bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(clear_dni > _K_LEAST_WM2, dni / clear_dni, np.nan)
    low = np.isfinite(share) & (altitude > 1.0) & (altitude < _HORIZON_DEG)
    free_times = t_unix_s[np.nan_to_num(share) > _FREE]
    if not low.any() or not len(free_times):
        return out
    rows = np.flatnonzero(low)
    after = np.searchsorted(free_times, t_unix_s[rows])
    gap = np.minimum(
        np.abs(free_times[np.minimum(after, len(free_times) - 1)] - t_unix_s[rows]),
        np.abs(free_times[np.maximum(after - 1, 0)] - t_unix_s[rows]),
    )
    column = np.floor(azimuth[rows] / _BIN_AZIMUTH_DEG).astype(np.int64)
    bins = 1000 * column + np.floor(altitude[rows] / _BIN_ALTITUDE_DEG).astype(np.int64)
    days = np.floor(t_unix_s[rows] / DAY_S).astype(np.int64)
    for each in np.unique(bins):
        mine = bins == each
        asked = mine & (gap <= _FREE_WITHIN_S)
        blocked = share[rows[mine]].max() < _BLOCKED
        if blocked and len(np.unique(days[asked])) >= _BLOCKED_DAYS:
            out[rows[mine]] = True
    return out


@dataclass(frozen=True, slots=True)
class SensitivitySteps:
    """Days on which the ratio of global to diffuse + direct changed.

    steps: day and relative change. smallest: the smallest change that would be detected in the
    middle of the record. days: number of days compared.
    """

    steps: tuple[tuple[date, float], ...]
    smallest: float | None
    days: int


def sensitivity_steps(
    t_unix_s: Floats, ghi: Floats, dhi: Floats, dni: Floats, altitude: Floats
) -> SensitivitySteps:
    """Find days on which one of three instruments changed its sensitivity, or was exchanged.

    t_unix_s [n] s; ghi, dhi, dni [n] W/m2; altitude of the sun [n] deg. The value of a day is the
    median closure ratio while the direct sun was steady. Closure cannot show which of the three
    instruments changed. Fewer than six such days give no result.
    """
    ratio = sun.closure_ratio(ghi, dhi, dni, altitude)
    mean, _ = window_mean(t_unix_s, dni, _STEADY_WINDOW_S)
    with np.errstate(invalid="ignore"):
        steady = (np.abs(dni - mean) < _STEADY * mean) & (dni > _STEP_DNI_WM2)
        steady &= (altitude > _STEP_ALTITUDE_DEG) & np.isfinite(ratio)
    rows = np.flatnonzero(steady)
    if not len(rows):
        return SensitivitySteps((), None, 0)
    period_s = max(float(np.median(np.diff(t_unix_s))), 1.0)
    day = np.floor(t_unix_s[rows] / DAY_S).astype(np.int64)
    present, count = np.unique(day, return_counts=True)
    enough = count * period_s >= _DAY_STEADY_S
    if not enough.any():
        return SensitivitySteps((), None, 0)
    present, steady_s = present[enough], count[enough] * period_s
    value = np.array([float(np.median(ratio[rows[day == d]])) for d in present])
    spread = np.sqrt(1.0 + _FULL_DAY_S / steady_s)
    cuts = _cuts(value, spread, 0)
    parts = list(itertools.pairwise([0, *cuts, len(value)]))
    levels = [_level(value[a:b], spread[a:b])[0] for a, b in parts]
    steps = tuple(
        (datetime.fromtimestamp(float(present[cut]) * DAY_S, UTC).date(), after / before - 1.0)
        for cut, (before, after) in zip(cuts, itertools.pairwise(levels), strict=True)
    )
    return SensitivitySteps(steps, _smallest(value, spread, parts, levels), len(value))


def _level(value: Floats, spread: Floats) -> tuple[float, float]:
    """Return the weighted mean of daily values, and its standard error in clear-day scatters."""
    weight = spread**-2
    return float(np.sum(weight * value) / np.sum(weight)), float(np.sum(weight) ** -0.5)


def _scatter(value: Floats, spread: Floats) -> float:
    """Return the scatter of a clear day's value, estimated from neighbouring differences.

    A step has little effect on it.
    """
    differences = np.abs(np.diff(value)) / np.hypot(spread[1:], spread[:-1])
    return max(float(np.median(differences)) * 1.4826, _LEAST_SCATTER)


def _cuts(value: Floats, spread: Floats, offset: int) -> list[int]:
    """Return the indices at which the level changes, largest contrast first.

    After each change, both parts are searched again.
    """
    n = len(value)
    if n < 2 * _STEP_DAYS:
        return []
    sigma = _scatter(value, spread)
    at = range(_STEP_DAYS, n - _STEP_DAYS + 1)
    score = [_contrast(value, spread, k) / sigma for k in at]
    best = int(np.argmax(score))
    if score[best] < _STEP_SIGMA:
        return []
    k = at[best]
    before = _cuts(value[:k], spread[:k], offset)
    return [*before, offset + k, *_cuts(value[k:], spread[k:], offset + k)]


def _contrast(value: Floats, spread: Floats, k: int) -> float:
    """Return the difference of the levels before index k and from k on, in unit standard errors."""
    before, u_before = _level(value[:k], spread[:k])
    after, u_after = _level(value[k:], spread[k:])
    return abs(after - before) / float(np.hypot(u_before, u_after))


def _smallest(
    value: Floats, spread: Floats, parts: list[tuple[int, int]], levels: list[float]
) -> float | None:
    """Return the smallest relative step in the middle of the record that would be detected."""
    if len(value) < 2 * _STEP_DAYS:
        return None
    middle = len(value) // 2
    _, u_before = _level(value[:middle], spread[:middle])
    _, u_after = _level(value[middle:], spread[middle:])
    rest = np.concatenate([value[a:b] - m for (a, b), m in zip(parts, levels, strict=True)])
    return float(_STEP_SIGMA * _scatter(rest, spread) * np.hypot(u_before, u_after))


def doubts(series: Series, altitude: Floats, top: Floats, site: Site) -> NDArray[np.int64]:
    """Return marks [n] of rows with impossible k-indices, a lost tracker or a shaded horizon.

    No value is deleted. altitude, top [n]: from `sky_geometry`.
    """
    t, dni = series.t_unix_s, series.dni_wm2
    marks = np.zeros(len(t), np.int64)
    complete = (series.marks & Mark.DERIVED) == 0
    ghi = np.where(complete, series.ghi_wm2, np.nan)
    impossible = k_index_fails(t, ghi, series.dhi_wm2, dni, altitude, top, site.altitude_m)
    marks[impossible] |= Mark.K_INDEX
    if not np.isfinite(dni[complete]).any():
        return marks
    azimuth, clear = _clear_sky(t, site)
    dni = np.where(complete, dni, np.nan)
    marks[tracker_off(t, ghi, dni, altitude, clear)] |= Mark.TRACKER
    marks[shaded_horizon(t, dni, altitude, azimuth, clear.dni_wm2)] |= Mark.HORIZON
    return marks


def _clear_sky(t_unix_s: Floats, site: Site) -> tuple[Floats, sun.Irradiance]:
    """Return azimuth [n] deg and clear-sky irradiance [n] W/m2, from a five-minute grid."""
    step = np.floor(t_unix_s / _CLEAR_GRID_S)
    grid = _CLEAR_GRID_S * np.unique(np.r_[step, step + 1.0])
    times = [datetime.fromtimestamp(t, UTC) for t in grid]
    turn = np.radians(sun.position(times, site).azimuth_deg)
    north, east = (np.interp(t_unix_s, grid, f(turn)) for f in (np.cos, np.sin))
    clear = sun.clearsky(times, site)
    parts = [np.interp(t_unix_s, grid, part) for part in clear]
    return np.degrees(np.arctan2(east, north)) % 360.0, sun.Irradiance(*parts)
