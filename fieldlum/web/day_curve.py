"""The irradiance of one local day, as the page draws it."""

from __future__ import annotations

from datetime import UTC, date, datetime, timedelta
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import JsonTable, Site
from fieldlum.sky import sun
from fieldlum.web.follow import BIN_S, IrradianceFollower


def day_curve(day: date, site: Site, followed: IrradianceFollower) -> JsonTable:
    """Return the irradiance of a local day in bins of 2 min [W/m2], and which bins are flagged.

    Flagged are values that are impossible for the sun's altitude, and bins with an error that the
    instrument reported. Bins at night without a reading are omitted; a missing value is None.
    followed: the session's day files.
    """
    zone = ZoneInfo(site.timezone)
    start = datetime(day.year, day.month, day.day, tzinfo=zone).astimezone(UTC)
    # 25 hours on the day when clocks go back: bins belong to a day by their local date
    times = [start + timedelta(seconds=BIN_S * (k + 0.5)) for k in range(25 * 3600 // BIN_S)]
    times = [t for t in times if t.astimezone(zone).date() == day]
    index = {d: followed.day(d) for d in sorted({t.date() for t in times})}
    means = {d: bins.means for d, bins in index.items()}
    of = [(t.date(), (t.hour * 3600 + t.minute * 60 + t.second) // BIN_S) for t in times]
    values = np.array([means[d][k] for d, k in of])  # [bins, 3]
    flagged = np.array([index[d].flagged[k] for d, k in of])
    present = np.isfinite(values).any(axis=1)
    impossible = np.zeros(len(times), bool)
    clear = np.full(len(times), np.nan)
    if present.any():
        altitude = sun.position(times, site).altitude_deg
        limits = sun.bsrn_limits(altitude, sun.extraterrestrial_wm2(times))
        for i, (low, high) in enumerate((limits.ghi_wm2, limits.dni_wm2, limits.dhi_wm2)):
            with np.errstate(invalid="ignore"):
                impossible |= (values[:, i] < low) | (values[:, i] > high)
        clear = sun.clearsky(times, site).ghi_wm2
    keep = present | (np.nan_to_num(clear) > 1.0)
    words: dict[str, int] = {}
    for bins in index.values():
        for text, count in bins.status.items():
            words[text] = words.get(text, 0) + count
    ghi, dni, dhi = (_numbers(values[keep, i]) for i in range(3))
    return {
        "ghi": ghi,
        "dni": dni,
        "dhi": dhi,
        "minutes": [round((t - start).total_seconds() / 60, 1) for t in np.array(times)[keep]],
        "clear_ghi": _numbers(clear[keep]),
        "flagged": (flagged | impossible)[keep].tolist(),
        "flagged_bins": int(flagged.sum()),
        "impossible_bins": int(impossible.sum()),
        "status": words,
        "first_local": f"{start.astimezone(zone):%H:%M}",
    }


def _numbers(values: Floats) -> list[float | None]:
    return [None if not np.isfinite(value) else round(float(value), 1) for value in values]
