"""Draw the irradiance of all days as one picture, which shows gaps, shade and a wrong clock."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.plot_style import INK, RED, new_figure, open_axes
from fieldlum.core.records import Site, parse_utc
from fieldlum.session import Session, replacing_path
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.sky import sun

_BINS = 288  # of five minutes in a day


def draw_days(session: Session, *, force: bool = False) -> Path | None:
    """Draw irradiance/days.png unless it is newer than clean.csv; return its path.

    force: draw it in any case. A column is a day and a row five minutes of local standard time.
    Return None if clean.csv has no row.
    """
    path, source = session.irradiance / "days.png", session.clean_irradiance
    if not force and path.is_file() and path.stat().st_mtime >= source.stat().st_mtime:
        return path
    clean, site = CleanIrradiance.read(source), session.site_file().site
    if not len(clean.t_unix_s):
        return None
    offset = sun.standard_offset(site.timezone, datetime.fromtimestamp(clean.t_unix_s[0], UTC).year)
    local_days = (clean.t_unix_s + offset.total_seconds()) / 86400.0
    days, column = np.unique(np.floor(local_days), return_inverse=True)
    hour = 24.0 * (local_days % 1.0)
    captured = [parse_utc(folder.name).timestamp() for folder in session.captured_folders()]
    taken = (np.array(captured) + offset.total_seconds()) / 86400.0
    taken = taken[np.isin(np.floor(taken), days)]
    bad = [bool(set(text.split()) - {"low-sun", "gap"}) for text in clean.flags]
    figure = new_figure(min(6.0 + 0.15 * len(days), 20.0), 10.0)
    for axes, name in zip(figure.subplots(3, sharex=True), ("ghi", "dni", "dhi"), strict=True):
        cell = column * _BINS + (hour / 24.0 * _BINS).astype(int)
        picture = _draw(axes, cell, getattr(clean, f"{name}_wm2"), len(days))
        figure.colorbar(picture, ax=axes, label=f"{name.upper()} [W/m²]")
        _mark_sunrise(axes, 86400.0 * days - offset.total_seconds(), site)
        axes.plot(column[bad], hour[bad], ".", ms=2, color=RED)
        axes.plot(np.searchsorted(days, np.floor(taken)), 24.0 * (taken % 1.0), "_", color=INK)
        axes.set(ylim=(0, 24), yticks=[0, 6, 12, 18, 24], ylabel="hour of standard time")
        shown = np.arange(0, len(days), -(-len(days) // 12))
        axes.set_xticks(shown, [f"{np.datetime64(int(days[k]), 'D')}" for k in shown], rotation=45)
        open_axes(axes)
    figure.suptitle(f"{site.name}: red is flagged, dashes are brackets, lines sunrise and sunset")
    with replacing_path(path) as temporary:
        figure.savefig(temporary, dpi=80)
    return path


def _draw(axes: Any, cell: np.ndarray, value: Floats, days: int) -> Any:
    """Draw the mean of each cell, white without a value; return the picture."""
    good, size = np.isfinite(value), days * _BINS
    total, count = np.bincount(cell[good], value[good], size), np.bincount(cell[good], None, size)
    means = np.where(count > 0, total / np.maximum(count, 1), np.nan).reshape(days, _BINS).T
    look = {"origin": "lower", "aspect": "auto", "interpolation": "nearest", "cmap": "YlOrBr"}
    return axes.imshow(means, extent=(-0.5, days - 0.5, 0.0, 24.0), vmin=0.0, **look)


def _mark_sunrise(axes: Any, midnights_unix_s: Floats, site: Site) -> None:
    """Draw sunrise and sunset of each column; the line of a single day fills its column."""
    edges = np.r_[midnights_unix_s, midnights_unix_s[-1]]
    hours = np.arange(0.0, 24.1, 0.25)
    times = [datetime.fromtimestamp(t + 3600.0 * h, UTC) for h in hours for t in edges]
    altitude = sun.position(times, site).altitude_deg.reshape(len(hours), len(edges))
    if altitude.min() < 0.0 < altitude.max():
        axes.contour(np.arange(len(edges)) - 0.5, hours, altitude, [0.0], colors=INK)
