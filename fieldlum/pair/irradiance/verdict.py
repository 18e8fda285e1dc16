"""Report how an instrument and its logger worked, and how to correct faults."""

from __future__ import annotations

from dataclasses import dataclass, field
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site, counted
from fieldlum.pair.irradiance.consistency import SensitivitySteps, sensitivity_steps
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
    a complete day between two nights. marks: number of rows with each mark. sensitivity_steps:
    first day, and relative change, of each change of sensitivity; smallest_step: the smallest
    relative change that would be detected. None: not determined, for example for too few days.
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
    sensitivity_steps: tuple[tuple[str, float], ...] = ()
    smallest_step: float | None = None


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
    sensitivity = sensitivity_steps(raw.t_unix_s, raw.ghi_wm2, raw.dhi_wm2, raw.dni_wm2, altitude)
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
            *_of_night(offset),
            *_by_day(clean, altitude, top),
            *_of_closure(passed),
            *_of_clock(raw, clock_off, site),
            *_of_sensitivity(sensitivity),
            *_of_lines(broken),
        ),
        sensitivity_steps=tuple(
            (f"{day:%Y-%m-%d}", round(change, 4)) for day, change in sensitivity.steps
        ),
        smallest_step=None if sensitivity.smallest is None else round(sensitivity.smallest, 4),
    )


# ----------------------------------------------------------------------------------------------
# warnings, each with what the user can do


def _of_night(offset_wm2: float | None) -> list[str]:
    if offset_wm2 is None or -NIGHT_OFFSET_WARN_WM2 < offset_wm2 < NIGHT_OFFSET_WARN_WM2:
        return []
    if offset_wm2 > NIGHT_LIGHT_WM2:
        return [
            f"global irradiance of {offset_wm2:.0f} W/m2 at night (median): check for a lamp, "
            "the logger's clock, --utc-offset of fieldlum import, and longitude_deg; then import "
            "the file again"
        ]
    return [
        f"global irradiance of {offset_wm2:+.1f} W/m2 at night instead of 0: clean and ventilate "
        "the instrument, and check its zero in the dark"
    ]


def _of_closure(passed: float | None) -> list[str]:
    if passed is None or passed >= 0.8:
        return []
    return [
        f"global = diffuse + direct is true in only {100 * passed:.0f} % of the rows: "
        "check the clock and the tilt of the instruments"
    ]


def _of_clock(raw: Series, off_s: float | None, site: Site) -> list[str]:
    warnings = []
    if off_s is not None and abs(off_s) > CLOCK_WARN_S:
        warnings.append(
            f"the middle of the logged daylight is {off_s / 60:+.0f} min from solar noon: check "
            "the "
            "logger's clock, its --utc-offset (daylight saving?) and longitude_deg, and import the "
            "file again"
        )
    if (was_set := clock_set_s(raw.t_unix_s, raw.ghi_wm2, site)) is not None:
        day, step_s = was_set[0].astimezone(ZoneInfo(site.timezone)), was_set[1]
        warnings.append(
            f"from {day:%Y-%m-%d} on, the middle of the logged daylight is {step_s / 60:+.0f} min "
            "from "
            "that of the days before: the logger's clock was probably set (daylight saving?); "
            "split the "
            "file there, and import each part with its own --utc-offset"
        )
    return warnings


def _of_sensitivity(steps: SensitivitySteps) -> list[str]:
    return [
        f"from {day:%Y-%m-%d} on, the ratio of global to diffuse + direct differs by "
        f"{100 * change:+.1f} % from that of the days before: an instrument or its sensitivity "
        "changed; check the logger's sensitivities and calibration dates"
        for day, change in steps.steps
    ]


def _of_lines(broken: int) -> list[str]:
    if not broken:
        return []
    return [
        f"skipped in irradiance/YYYY-MM-DD.csv: {counted(broken, 'damaged line')}; check the disk, "
        "and do not edit these files"
    ]


_FAULTS = {
    Mark.IMPOSSIBLE: "have an impossible irradiance: check units, columns and clock",
    Mark.EXTREME: "have an extremely rare irradiance: check units, columns and clock",
    Mark.DIFFUSE: (
        "have more diffuse than global irradiance: check whether the two columns are exchanged"
    ),
    Mark.K_INDEX: (
        "have an impossible ratio of global, diffuse and direct: check which instrument is wrong"
    ),
    Mark.TRACKER: (
        "have the global irradiance of a clear sky but no direct: check whether the tracker "
        "follows the sun"
    ),
    Mark.HORIZON: (
        "have the sun in a low part of the sky where it was never measured: check what shades "
        "the sensor"
    ),
    Mark.STUCK: "were constant for over ten minutes: check the instrument and its cable",
    Mark.STATUS: "have an error reported by the instrument: see its manual",
    Mark.SPIKE: "are isolated spikes: check the cable",
    Mark.DOUBLE: "repeat a time with other values (the first is used): check for a clock that "
    "was set back, or a second instrument",
}


def _by_day(clean: Series, altitude: Floats, top: Floats) -> list[str]:
    """Return a sentence for each fault that too many rows have while the sun is well up."""
    up = altitude > sun.CLEAR_SUN_DEG
    if not up.any():
        return []
    notes = [
        f"{100 * share:.0f} % of the rows by day {fault}"
        for mark, fault in _FAULTS.items()
        if (share := float(np.mean((clean.marks[up] & mark) != 0))) > MOST_BY_DAY
    ]
    with np.errstate(invalid="ignore"):
        weak = float(np.mean(sun.too_weak(clean.ghi_wm2, altitude, top)[up]))
    if weak > MOST_BY_DAY:
        notes.append(
            f"{100 * weak:.0f} % of the rows by day have less light than the darkest "
            "overcast sky: check whether the values are in kW/m2"
        )
    global_only = float(np.mean(np.isfinite(clean.ghi_wm2[up]) & np.isnan(clean.dni_wm2[up])))
    if global_only > MOST_BY_DAY:
        notes.append(
            f"{100 * global_only:.0f} % of the rows by day have global but no direct irradiance: "
            "direct cannot be derived from global without another row within half an hour; log "
            "at least every minute"
        )
    return notes
