"""Choose and predict the maps of typical and extreme hours for the report."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fieldlum.learn.models import Fitted
from fieldlum.sky.light import Light
from fieldlum.sky.sun import standard_date
from fieldlum.year.predict.annual import Annual, Pictures
from fieldlum.year.predict.blocks import ModelRoom, blocks
from fieldlum.year.predict.glare_summary import best_and_worst


def telling_hours(annual: Annual, zone: str) -> Iterator[tuple[str, int]]:
    """Yield the name of each hour to show in the report, and its index in the year, from 0.

    These are the hours with the median, the 95th percentile and the highest DGP of the occupied
    hours (all hours if none is occupied), first for the direction with the most glare, then for
    that with the least; and the hours of one clear day. An hour can occur twice.
    """
    used = np.flatnonzero(annual.occupied) if annual.occupied.any() else np.arange(len(annual))
    dgp = annual.views["dgp"][used]
    ends = best_and_worst(annual.summary.protection)
    for name, row in () if ends is None else (("worst", ends[1]), ("best", ends[0])):
        direction = int(np.argmin(np.abs(annual.azimuths_deg - row.azimuth_deg)))
        order = used[np.argsort(dgp[:, direction], kind="stable")]
        for share, kind in ((0.5, "typical"), (0.95, "p95"), (1.0, "highest")):
            hour = order[min(int(share * len(order)), len(order) - 1)]
            yield f"{kind} of {name} view {annual.azimuths_deg[direction]:g}", int(hour)
    for row in clear_day(annual, zone):
        yield "clear day", int(row)


def clear_day(annual: Annual, zone: str) -> NDArray[np.int64]:
    """Return the indices, from 0, of the daylight hours of one sunny day, [k].

    It is the day with the most direct normal irradiation among 28 February to 11 April, or among
    all days if the year has no hours then. zone: time zone, whose standard time separates the days.
    """
    days = np.array([standard_date(t, zone).timetuple().tm_yday for t in annual.t_utc])
    near = np.abs(days - 80) <= 21
    pool = np.unique(days[near]) if near.any() else np.unique(days)
    sunniest = max(pool, key=lambda day: float(annual.hours["dni_wm2"][days == day].sum()))
    return np.flatnonzero(days == sunniest)


def telling_pictures(fitted: Fitted, room: ModelRoom, light: Light, annual: Annual) -> Pictures:
    """Return the maps of `telling_hours`, in that order, predicted again.

    The maps are not stored before, because all maps of a year would need a gigabyte of memory.
    """
    chosen = list(telling_hours(annual, room.setup.site.timezone))
    rows = np.array(sorted({row for _, row in chosen}), np.int64)
    parts = list(blocks(fitted, room, light[rows]))
    maps = np.concatenate([block.pictures_cdm2(room.heading_deg) for block in parts])
    disc = np.concatenate([block.disc_lx for block in parts])
    at = [int(np.searchsorted(rows, row)) for _, row in chosen]
    return Pictures(
        tuple(kind for kind, _ in chosen), rows[at], maps[at], disc[at], room.heading_deg
    )
