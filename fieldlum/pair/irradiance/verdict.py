"""Report how an instrument and its logger worked, and how to correct faults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site, counted
from fieldlum.pair.irradiance.series import Mark, Series, local_period_s, poll_period_s
from fieldlum.sky import sun
from fieldlum.sky.light_clock import CLOCK_WARN_S, clock_off_s, clock_set_s

NIGHT_SUN_DEG = -6.0  # end of civil twilight, by definition
NIGHT_OFFSET_WARN_WM2 = 4.0  # BSRN's limit: beyond it, night values are marked as impossible
NIGHT_LIGHT_WM2 = 20.0  # W/m2, larger than any instrument's offset; not measured
MOST_BY_DAY = 0.05  # a mark on a larger share of the day's rows is reported; not measured


@dataclass(frozen=True, slots=True)
class Health:
    """What health.json reports about an instrument and its logger.

    rows: of the log; broken_lines: lines that could not be read; usable: rows that pass the
    checks. every_s: median time between rows; gaps, longest_gap_s: number and longest of the
    interruptions. night_offset_wm2: median of the global while the sun is under -6 degrees; it
    is never subtracted. closure_pass: share of testable rows with global = diffuse + direct.
    clock_off_s: middle of the logged daylight minus solar noon, from the light itself; it needs
    a complete day between two nights. marks: number of rows with each mark. None: not determined,
    for example for too few days.
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
    raw: Series, clean: Series, altitude: Floats, top: Floats, broken: int, site: Site
) -> Health:
    """Return figures and warnings about an instrument and its logger, from its rows.

    raw, clean: the same rows before and after the checks. altitude, top [n]: from `sky_geometry`.
    broken: number of damaged lines.
    """
    night = raw.ghi_wm2[(altitude < NIGHT_SUN_DEG) & np.isfinite(raw.ghi_wm2)]
    offset = float(np.median(night)) if len(night) >= 10 else None
    ratio = sun.closure_ratio(raw.ghi_wm2, raw.dhi_wm2, raw.dni_wm2, altitude)
    testable = np.isfinite(ratio) & (altitude > 0)
    passed = float(np.mean((clean.marks[testable] & Mark.CLOSURE) == 0)) if testable.any() else None
    seconds = np.diff(clean.t_unix_s)
    gaps = seconds[seconds > 2.5 * local_period_s(clean.t_unix_s)[1:]]
    clock_off = clock_off_s(raw.t_unix_s, raw.ghi_wm2, site)
    counts = {mark: int(np.sum((clean.marks & mark) != 0)) for mark in Mark}
    return Health(
        rows=len(clean),
        broken_lines=broken,
        usable=int(np.isfinite(clean.dni_wm2 + clean.dhi_wm2).sum()),
        every_s=poll_period_s(clean.t_unix_s),
        gaps=len(gaps),
        longest_gap_s=float(gaps.max(initial=0.0)),
        night_offset_wm2=offset,
        closure_pass=passed,
        clock_off_s=clock_off,
        marks={(mark.name or "").lower(): count for mark, count in counts.items() if count},
        warnings=(
            *_of_log(raw, offset, passed, clock_off, broken, site),
            *_by_day(clean, altitude, top),
        ),
    )


# ----------------------------------------------------------------------------------------------
# warnings, each with what the user can do


def _of_log(
    raw: Series,
    night_wm2: float | None,
    closure: float | None,
    off_s: float | None,
    broken: int,
    site: Site,
) -> Iterator[str]:
    """Yield warnings about zero, closure, clock and damaged lines of a log."""
    if night_wm2 is not None and night_wm2 > NIGHT_LIGHT_WM2:
        yield (
            f"global irradiance of {night_wm2:.0f} W/m2 at night (median): check for a lamp, the "
            "logger's clock, --utc-offset of fieldlum import, and longitude_deg; then import again"
        )
    elif night_wm2 is not None and abs(night_wm2) >= NIGHT_OFFSET_WARN_WM2:
        yield (
            f"global irradiance of {night_wm2:+.1f} W/m2 at night instead of 0: clean and "
            "ventilate the instrument, and check its zero in the dark"
        )
    if closure is not None and closure < 0.8:
        yield (
            f"global = diffuse + direct is true in only {100 * closure:.0f} % of the rows: check "
            "the clock and the tilt of the instruments"
        )
    if off_s is not None and abs(off_s) > CLOCK_WARN_S:
        yield (
            f"the middle of the logged daylight is {off_s / 60:+.0f} min from solar noon: check "
            "the logger's clock, its --utc-offset (daylight saving?) and longitude_deg, and import "
            "the file again"
        )
    if (was_set := clock_set_s(raw.t_unix_s, raw.ghi_wm2, site)) is not None:
        yield (
            f"from {was_set[0].astimezone(ZoneInfo(site.timezone)):%Y-%m-%d} on, the middle of the "
            f"logged daylight is {was_set[1] / 60:+.0f} min from that of the days before: the "
            "logger's clock was probably set (daylight saving?); split the file there, and import "
            "each part with its own --utc-offset"
        )
    if broken:
        yield (
            f"skipped in irradiance/YYYY-MM-DD.csv: {counted(broken, 'damaged line')}; check the "
            "disk, and do not edit these files"
        )


_FAULTS = {
    Mark.IMPOSSIBLE: "an impossible irradiance: check units, columns and clock",
    Mark.EXTREME: "an extremely rare irradiance: check units, columns and clock",
    Mark.DIFFUSE: "more diffuse than global irradiance: check whether the columns are exchanged",
    Mark.K_INDEX: "an impossible ratio of global, diffuse and direct: check instruments, tracker",
    Mark.HORIZON: "the sun in a low part of the sky where it was never measured: check for shade",
    Mark.STUCK: "one value for over ten minutes: check the instrument and its cable",
    Mark.STATUS: "an error reported by the instrument: see its manual",
    Mark.SPIKE: "isolated spikes: check the cable",
    Mark.DOUBLE: "another row of the same time with other values: check the clock",
}


def _by_day(clean: Series, altitude: Floats, top: Floats) -> Iterator[str]:
    """Yield a sentence for each fault that too many rows have while the sun is well up."""
    up = altitude > sun.CLEAR_SUN_DEG
    if not up.any():
        return
    with np.errstate(invalid="ignore"):
        weak = sun.too_weak(clean.ghi_wm2, altitude, top)
    faults = {text: (clean.marks & mark) != 0 for mark, text in _FAULTS.items()}
    faults["less light than the darkest overcast sky: check whether the values are in kW/m2"] = weak
    faults[
        "global but no direct irradiance: direct cannot be derived from global without another row "
        "within half an hour; log at least every minute"
    ] = np.isfinite(clean.ghi_wm2) & np.isnan(clean.dni_wm2)
    for text, rows in faults.items():
        if (share := float(np.mean(rows[up]))) > MOST_BY_DAY:
            yield f"{100 * share:.0f} % of the rows by day have {text}"
