"""Check whether three components, a clear sky and earlier days agree.

The checks are closure, k-indices and a shaded horizon. pvlib has none of these. pvanalytics has
QCRad's limits and closure, but without the average that broken clouds require. Limits of k-indices:
Forstinger et al. 2021, Expert quality control of solar radiation ground data sets (ISES SWC 2021;
IEA PVPS Task 16).
"""

from __future__ import annotations

from datetime import UTC, datetime

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
_K_MIN_WM2 = 50.0  # GHI from which indices are tested
_KT_MAX = 1.35
_KD_MAX, _KD_MAX_LOW_SUN, _KD_ALTITUDE_DEG = 1.05, 1.10, 15.0
_KD_CLEAR, _KT_CLEAR, _CLEAR_MIN_WM2, _CLEAR_ALTITUDE_DEG = 0.96, 0.6, 150.0, 5.0
_KN_TOP_WM2, _KN_PER_M = 1100.0, 0.03
# Seconds. A cloud's edge passes two instruments one after the other, but a fault lasts longer. Not
# measured.
_K_LASTS_S = 900.0

_HORIZON_DEG = 20.0  # higher obstructions are visible in the scene; not measured
_BIN_AZIMUTH_DEG, _BIN_ALTITUDE_DEG = 4.0, 1.0  # chosen
_BLOCKED, _FREE = 0.05, 0.5  # of the clear sky's DNI; not measured
_FREE_WITHIN_S = 2700.0  # seconds before or after within which the sun must be free; chosen
# number of days that must agree; clouds at one place of the horizon on four such days are rare;
# chosen
_BLOCKED_DAYS = 4


def persistent(t_unix_s: Floats, marked: Rows, window_s: float, tested: Rows | None = None) -> Rows:
    """Return a mask [n] of the marked rows in whose window at least half of the rows are marked.

    window_s : around each row; tested [n] : the rows that count, None for all. t_unix_s
    must ascend.
    """
    counts = np.ones(len(marked), bool) if tested is None else tested
    first = np.searchsorted(t_unix_s, t_unix_s - window_s / 2, side="left")
    last = np.searchsorted(t_unix_s, t_unix_s + window_s / 2, side="right")
    total, rows = np.r_[0, np.cumsum(marked)], np.r_[0, np.cumsum(counts)]
    return marked & (2 * (total[last] - total[first]) >= rows[last] - rows[first])


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
    return persistent(t_unix_s, fails, CLOSURE_WINDOW_S, testable)


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
        tested = (ghi > _K_MIN_WM2) & (altitude > 0.0)
        max_kd = np.where(altitude > _KD_ALTITUDE_DEG, _KD_MAX, _KD_MAX_LOW_SUN)
        clear = (kt > _KT_CLEAR) & (ghi > _CLEAR_MIN_WM2) & (altitude > _CLEAR_ALTITUDE_DEG)
        fails = (kn > kt) & (kn > 0) & (kt > 0)
        fails |= kn > (_KN_TOP_WM2 + _KN_PER_M * altitude_m) / top
        fails |= (kt > _KT_MAX) | (kd > max_kd) | (clear & (kd > _KD_CLEAR))
    return persistent(t_unix_s, np.asarray(tested & fails), _K_LASTS_S)


def shaded_horizon(
    t_unix_s: Floats, dni: Floats, altitude: Floats, azimuth: Floats, clear_dni: Floats
) -> Rows:
    """Return a mask [n] of rows in sectors of the low sky where the sun is always hidden.

    A sector is 4 x 1 degrees, below 20 degrees of altitude. The sun must be hidden there on at
    least four days on which it is free shortly before or after. clear_dni: of a clear sky, [n].
    """
    out = np.zeros(len(t_unix_s), bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(clear_dni > _K_MIN_WM2, dni / clear_dni, np.nan)
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


def doubts(series: Series, altitude: Floats, top: Floats, site: Site) -> NDArray[np.int64]:
    """Return marks [n] of rows with impossible k-indices or a shaded horizon.

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
    azimuth, clear_dni = _clear_sky(t, site)
    dni = np.where(complete, dni, np.nan)
    marks[shaded_horizon(t, dni, altitude, azimuth, clear_dni)] |= Mark.HORIZON
    return marks


def _clear_sky(t_unix_s: Floats, site: Site) -> tuple[Floats, Floats]:
    """Return azimuth [n] deg and DNI of a clear sky [n] W/m2, from a five-minute grid."""
    step = np.floor(t_unix_s / _CLEAR_GRID_S)
    grid = _CLEAR_GRID_S * np.unique(np.r_[step, step + 1.0])
    times = [datetime.fromtimestamp(t, UTC) for t in grid]
    turn = np.radians(sun.position(times, site).azimuth_deg)
    north, east = (np.interp(t_unix_s, grid, f(turn)) for f in (np.cos, np.sin))
    clear_dni = np.interp(t_unix_s, grid, sun.clearsky(times, site).dni_wm2)
    return np.degrees(np.arctan2(east, north)) % 360.0, clear_dni
