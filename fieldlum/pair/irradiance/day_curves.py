"""Draw a small chart of irradiance for each day, which shows gaps, shade and a wrong clock."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.core.plot_style import AMBER, BLUE, GREEN, PALE, RED, open_axes
from fieldlum.core.records import Site, parse_utc
from fieldlum.session import Session, replacing_path
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.sky import sun

COLUMNS = 4  # charts in a row; chosen for a page in portrait
# most days on a sheet of 16 rows; of a longer log, days with captures are preferred; chosen
MAX_DAYS = 64
BIN_S = 120.0  # seconds of a bin; 720 points a day are more than a small chart shows
_CURVES = (("ghi", AMBER), ("dni", BLUE), ("dhi", GREEN))


def draw_days(session: Session, *, force: bool = False) -> Path | None:
    """Draw irradiance/days.png unless it is newer than clean.csv; return its path.

    Return None if clean.csv has no row.
    """
    from matplotlib.figure import Figure

    path, source = session.irradiance / "days.png", session.clean_irradiance
    if not force and path.is_file() and path.stat().st_mtime >= source.stat().st_mtime:
        return path
    clean, site = CleanIrradiance.read(source), session.site_file().site
    zone = ZoneInfo(site.timezone)
    if len(clean.t_unix_s) == 0:
        return None
    bins = np.unique(np.floor(clean.t_unix_s / BIN_S)) * BIN_S
    days = np.unique([datetime.fromtimestamp(t, zone).date().toordinal() for t in bins])
    captured = {parse_utc(folder.name).astimezone(zone) for folder in session.captured_folders()}
    shown = chosen_days(days, {t.date().toordinal() for t in captured})
    rows = -(-len(shown) // COLUMNS)
    figure = Figure(figsize=(3.6 * COLUMNS, 1.9 * rows + 0.5), layout="constrained")
    grid = figure.subplots(rows, COLUMNS, squeeze=False, sharex=True, sharey=True).ravel()
    for axes, day in zip(grid, shown, strict=False):
        _draw_day(axes, day, clean, site, [t for t in captured if t.date().toordinal() == day])
    for axes in grid[len(shown) :]:
        axes.set_axis_off()
    more = f"; {len(days) - len(shown)} more days are not shown" if len(days) > len(shown) else ""
    figure.suptitle(
        f"{site.name}: GHI (orange), DNI (blue), DHI (green), clear-sky GHI (dashed) in W/m²; red: "
        f"flagged; lines: brackets; hours of {site.timezone}{more}",
        fontsize=9,
    )
    with replacing_path(path) as temporary:
        figure.savefig(temporary, dpi=80)
    return path


def chosen_days(days: NDArray[np.int64], captured: set[int]) -> list[int]:
    """Return the days to draw, at most 64, in order of time.

    Days with captures are preferred; days and captured are day numbers.
    """
    wanted = sorted(map(int, days), key=lambda day: (day not in captured, day))
    return sorted(wanted[:MAX_DAYS])


def _draw_day(
    axes: Any, day: int, clean: CleanIrradiance, site: Site, captured: list[datetime]
) -> None:
    """Draw one local day."""
    date = datetime.fromordinal(day)
    start = date.replace(tzinfo=ZoneInfo(site.timezone)).timestamp()
    rows = slice(*np.searchsorted(clean.t_unix_s, [start, start + 25 * 3600]).tolist())
    bins = np.floor((clean.t_unix_s[rows] - start) / BIN_S).astype(np.int64)
    for name, colour in _CURVES:
        x, y = _means(bins, getattr(clean, f"{name}_wm2")[rows])
        axes.plot(x, y, color=colour, lw=0.9, marker=".", ms=2)
    hours = np.arange(0.0, 24.01, 0.25)
    times = [datetime.fromtimestamp(start + 3600.0 * h, UTC) for h in hours]
    axes.plot(hours, sun.clearsky(times, site).ghi_wm2, color=PALE, lw=0.8, ls="--")
    bad = [bool(set(flags.split()) - {"low-sun", "gap"}) for flags in clean.flags[rows]]
    marked = np.unique(bins[np.array(bad, bool)]) * BIN_S / 3600.0
    axes.plot(marked, np.zeros(len(marked)), "|", color=RED)
    for t in captured:
        axes.axvline((t.timestamp() - start) / 3600.0, color=PALE, lw=0.6, zorder=0)
    axes.set_title(f"{date:%a %Y-%m-%d}", fontsize=8, pad=2)
    axes.set(xlim=(0, 24), xticks=[0, 6, 12, 18, 24])
    open_axes(axes)


def _means(bins: NDArray[np.int64], values: Floats) -> tuple[Floats, Floats]:
    """Return hours and means of bins; a gap of more than ten minutes is not bridged."""
    good = np.isfinite(values)
    numbers, index = np.unique(bins[good], return_inverse=True)
    means = np.bincount(index, values[good]) / np.maximum(np.bincount(index), 1)
    x = (numbers + 0.5) * BIN_S / 3600.0
    gaps = np.flatnonzero(np.diff(x) > 10.0 / 60.0) + 1
    return np.insert(x, gaps, np.nan), np.insert(means, gaps, np.nan)
