"""Check whether logged irradiances agree: with each other, with a clear sky, and with other days.

pvlib has none of these checks. pvanalytics has QCRad's limits and closure, but without the average
that broken clouds require. Limits of k-indices: Forstinger et al. 2021, Expert quality control of
solar radiation ground data sets (ISES SWC 2021; IEA PVPS Task 16).
"""

from datetime import UTC, datetime

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import Site
from fieldlum.sky import sun

_MIN_WM2 = 50.0  # irradiance from which k-indices and shares of a clear sky are tested


def persistent(t_unix_s: Floats, marked: Mask, window_s: float, tested: Mask) -> Mask:
    """Return a mask [n] of marked rows around which at least half of the tested rows are marked.

    t_unix_s: ascending times [n]; marked, tested: masks [n]; window_s: length of the window around
    a row.
    """
    first = np.searchsorted(t_unix_s, t_unix_s - window_s / 2)
    last = np.searchsorted(t_unix_s, t_unix_s + window_s / 2, "right")
    sums = (np.r_[0, np.cumsum(mask)] for mask in (marked, tested))
    marked_count, tested_count = (total[last] - total[first] for total in sums)
    return marked & (2 * marked_count >= tested_count)


def closure_fails(
    t_unix_s: Floats, ghi: Floats, dhi: Floats, dni: Floats, altitude: Floats
) -> Mask:
    """Return a mask [n] of the rows that contradict global = diffuse + direct, by QCRad's test.

    The ratio of global to diffuse + direct may differ from 1 by 8 % if the sun is higher than 15
    degrees, and by 15 % if it is lower. A row is in the mask only if at least half of the testable
    rows in the half hour around it differ by more: under broken clouds, instruments some distance
    apart differ by over 8 % in 4 % of the sunny minutes of a good station. Rows below 50 W/m2, or
    with only two components, are not testable. t_unix_s [n], ascending; ghi, dhi, dni [n] W/m2;
    altitude: of the sun, true [n] deg.
    """
    ratio = sun.closure_ratio(ghi, dhi, dni, altitude)
    testable = np.isfinite(ratio) & (altitude > -3.0)  # QCRad's limit of the zenith angle, 93
    fails = testable & (np.abs(ratio - 1.0) > np.where(altitude > 15.0, 0.08, 0.15))
    return persistent(t_unix_s, fails, 1800.0, testable)


def k_index_fails(
    t_unix_s: Floats, ghi: Floats, dhi: Floats, dni: Floats, altitude: Floats, top: Floats
) -> Mask:
    """Return a mask [n] of rows with impossible k-indices for at least half of 15 minutes.

    The k-indices are clearness, diffuse share and beam transmittance. A fault lasts, while a
    cloud's edge passes two instruments one after the other. The test cannot decide which component
    is wrong. t_unix_s [n], ascending; ghi, dhi, dni [n] W/m2; altitude: of the sun, true [n] deg;
    top: irradiance above the atmosphere on a plane normal to the sun [n] W/m2.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        kt = ghi / (top * np.maximum(np.sin(np.radians(altitude)), 1e-3))
        kn, kd = dni / top, dhi / ghi  # kt: clearness, kn: transmittance, kd: diffuse share
        clear = (kt > 0.6) & (ghi > 150.0) & (altitude > 5.0)
        fails = ((kn > kt) & (kn > 0) & (kt > 0)) | (dni > 1100.0) | (kt > 1.35)
        fails |= (kd > np.where(altitude > 15.0, 1.05, 1.10)) | (clear & (kd > 0.96))
        tested = (ghi > _MIN_WM2) & (altitude > 0.0)
    return persistent(t_unix_s, np.asarray(tested & fails), 900.0, np.ones(len(ghi), bool))


def shaded_horizon(
    t_unix_s: Floats, dni: Floats, altitude: Floats, azimuth: Floats, clear_dni: Floats
) -> Mask:
    """Return a mask [n] of rows with the sun in a part of the low sky where it is always hidden.

    A part has 4 degrees of azimuth and 1 of altitude, below 20 degrees. On at least four days the
    sun must be hidden there and shine within 45 minutes of it: clouds at one place of the horizon
    on four such days are rare. t_unix_s [n]; dni, and clear_dni of a cloudless sky [n] W/m2;
    altitude (true), azimuth of the sun (clockwise from north) [n] deg. Limits were chosen.
    """
    out = np.zeros(len(t_unix_s), bool)
    with np.errstate(invalid="ignore", divide="ignore"):
        share = np.where(clear_dni > _MIN_WM2, dni / clear_dni, np.nan)
    rows = np.flatnonzero(np.isfinite(share) & (altitude > 1.0) & (altitude < 20.0))
    sunny_s = t_unix_s[np.nan_to_num(share) > 0.5]
    if not len(rows) or not len(sunny_s):
        return out
    after = np.searchsorted(sunny_s, t_unix_s[rows])
    nearest = np.stack([sunny_s[np.clip(after - k, 0, len(sunny_s) - 1)] for k in (0, 1)])
    is_near = np.abs(nearest - t_unix_s[rows]).min(axis=0) <= 2700.0
    part = 1000 * (azimuth[rows] // 4.0) + altitude[rows] // 1.0  # one number for each part
    days = t_unix_s[rows] // 86400.0
    for number in np.unique(part):
        inside = part == number
        if share[rows[inside]].max() < 0.05 and len(np.unique(days[inside & is_near])) >= 4:
            out[rows[inside]] = True
    return out


def clear_sky(t_unix_s: Floats, site: Site) -> tuple[Floats, Floats]:
    """Return the sun's azimuth [deg] and the DNI of a cloudless sky [W/m2], [n] each.

    t_unix_s: the times [n]. Both are interpolated between full five minutes.
    """
    step = np.floor(t_unix_s / 300.0)
    grid_s = 300.0 * np.unique(np.r_[step, step + 1.0])
    times = [datetime.fromtimestamp(t, UTC) for t in grid_s]
    azimuth = np.radians(sun.position(times, site).azimuth_deg)
    north, east = (np.interp(t_unix_s, grid_s, part(azimuth)) for part in (np.cos, np.sin))
    clear_dni = np.interp(t_unix_s, grid_s, sun.clearsky(times, site).dni_wm2)
    return np.degrees(np.arctan2(east, north)) % 360.0, clear_dni
