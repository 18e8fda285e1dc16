"""How an instrument and its logger did: what the person responsible wants to know, and what to
do about it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fieldlum import sun
from fieldlum.irradiance.consistency import sensitivity_steps
from fieldlum.irradiance.series import Array, Mark, Series, local_period_s, poll_period_s
from fieldlum.light_clock import CLOCK_WARN_S, clock_off_s, clock_set_s
from fieldlum.records import Site

NIGHT_SUN_DEG = -6.0
NIGHT_OFFSET_WARN_WM2 = 4.0  # BSRN's limit: from here on nights are blanked as impossible
NIGHT_LIGHT_WM2 = 20.0  # no instrument's offset
MOST_BY_DAY = 0.05  # share of the rows by day with one mark, from which the person hears of it


@dataclass(frozen=True, slots=True)
class Health:
    """What the person responsible wants to know about the instrument."""

    rows: int
    broken_lines: int
    usable: int
    every_s: float
    gaps: int
    longest_gap_s: float
    night_offset_wm2: (
        float | None
    )  # median of the global with the sun under -6 degrees; never subtracted
    closure_pass: float | None  # share of testable rows, where direct is measured too
    clock_off_s: (
        float | None
    )  # by the light itself (`light_clock`); None without a whole day, dark on either side
    marks: dict[str, int] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()
    sensitivity_steps: tuple[tuple[str, float], ...] = ()  # from that day on, relative change
    smallest_step: float | None = None  # that would be found; None: too few days to tell

    @classmethod
    def from_json(cls, known: dict[str, Any]) -> Health:
        steps = tuple((str(day), float(change)) for day, change in known["sensitivity_steps"])
        return cls(**{**known, "warnings": tuple(known["warnings"]), "sensitivity_steps": steps})


def health(
    raw: Series, clean: Series, altitude: Array, top: Array, broken: int, site: Site
) -> Health:
    """raw and clean: the same rows before and after the checks. altitude, top [n]: of
    `sky_geometry`.
    """
    night = raw.ghi_wm2[(altitude < NIGHT_SUN_DEG) & np.isfinite(raw.ghi_wm2)]
    offset = float(np.median(night)) if len(night) >= 10 else None
    ratio = sun.closure_ratio(raw.ghi_wm2, raw.dhi_wm2, raw.dni_wm2, altitude)
    testable = np.isfinite(ratio) & (altitude > 0)
    passed = float(np.mean((clean.marks[testable] & Mark.CLOSURE) == 0)) if testable.any() else None
    period = poll_period_s(clean.t_unix_s)
    steps = np.diff(clean.t_unix_s)
    gaps = steps[steps > 2.5 * local_period_s(clean.t_unix_s)[1:]]
    counts = {
        mark.name.lower(): int(np.sum((clean.marks & mark) != 0)) for mark in Mark if mark.name
    }
    warnings: list[str] = []
    if offset is not None and offset > NIGHT_LIGHT_WM2:
        warnings.append(
            f"{offset:.0f} W/m2 in the middle of the night: a lamp, or a wrong clock, offset or "
            f"longitude"
        )
    elif offset is not None and abs(offset) >= NIGHT_OFFSET_WARN_WM2:
        warnings.append(
            f"night offset {offset:+.1f} W/m2: level, clean and ventilate the instrument"
        )
    warnings += _by_day(clean, altitude, top)
    if passed is not None and passed < 0.8:
        warnings.append(
            f"global = diffuse + direct holds in {100 * passed:.0f} % of the rows only: check "
            f"clock and tilt"
        )
    clock_off = clock_off_s(raw.t_unix_s, raw.ghi_wm2, site)
    if clock_off is not None and abs(clock_off) > CLOCK_WARN_S:
        warnings.append(
            f"the days' light is centred {clock_off / 60:+.0f} min from solar noon: check the "
            f"logger's clock, its "
            "--utc-offset (daylight saving?) and longitude_deg, and import it anew"
        )
    if (was_set := clock_set_s(raw.t_unix_s, raw.ghi_wm2, site)) is not None:
        day, step_s = was_set
        warnings.append(
            f"from {day:%Y-%m-%d} on the days' light is centred {step_s / 60:+.0f} min from that "
            f"of the days before: "
            "was the logger's clock set (daylight saving)? import the two parts as files of their "
            "own, by --utc-offset"
        )
    steps = sensitivity_steps(raw.t_unix_s, raw.ghi_wm2, raw.dhi_wm2, raw.dni_wm2, altitude)
    warnings += [
        f"from {day:%Y-%m-%d} on global over diffuse + direct differs by {100 * change:+.1f} % "
        f"from the days before: the sensitivity of an instrument changed, or an instrument; check "
        f"the logger's sensitivities and calibration dates"
        for day, change in steps.steps
    ]
    if broken:
        warnings.append(f"{broken} broken lines in the day files were skipped")
    usable = int(np.isfinite(clean.dni_wm2 + clean.dhi_wm2).sum())
    longest = float(gaps.max()) if len(gaps) else 0.0
    return Health(
        len(clean),
        broken,
        usable,
        period,
        len(gaps),
        longest,
        offset,
        passed,
        clock_off,
        {name: count for name, count in counts.items() if count},
        tuple(warnings),
        tuple((f"{day:%Y-%m-%d}", round(change, 4)) for day, change in steps.steps),
        None if steps.smallest is None else round(steps.smallest, 4),
    )


_ASKED = {
    Mark.IMPOSSIBLE: "outside what is physically possible: units, columns, clock?",
    Mark.EXTREME: "outside what is extremely rare: units, columns, clock?",
    Mark.DIFFUSE: "with more diffuse than global: are the two exchanged?",
    Mark.K_INDEX: "in a ratio of global, diffuse and direct that no sky has: is one of them wrong?",
    Mark.TRACKER: "a clear sky's global without direct sun: does the tracker follow the sun?",
    Mark.HORIZON: "where the sun never shows: something on the horizon shades the instrument",
    Mark.STUCK: "the same for over ten minutes: is the instrument dead?",
    Mark.STATUS: "with an error of the instrument",
    Mark.SPIKE: "lone spikes: is the line disturbed?",
    Mark.DOUBLE: "there twice with other figures, and the first counts: a clock put back, or two "
    "instruments?",
}


def _by_day(clean: Series, altitude: Array, top: Array) -> list[str]:
    """What too many rows have in common while the sun is well up."""
    up = altitude > sun.CLEAR_SUN_DEG
    if not up.any():
        return []
    said = [
        f"{100 * share:.0f} % of the rows by day are {asked}"
        for mark, asked in _ASKED.items()
        if (share := float(np.mean((clean.marks[up] & mark) != 0))) > MOST_BY_DAY
    ]
    with np.errstate(invalid="ignore"):
        weak = float(np.mean(sun.too_weak(clean.ghi_wm2, altitude, top)[up]))
    if weak > MOST_BY_DAY:
        said.append(
            f"{100 * weak:.0f} % of the rows by day hold less light than any sky lets through: is "
            f"it kW/m2?"
        )
    lone = float(np.mean(np.isfinite(clean.ghi_wm2[up]) & np.isnan(clean.dni_wm2[up])))
    if lone > MOST_BY_DAY:
        said.append(
            f"{100 * lone:.0f} % of the rows by day are global alone without neighbours within "
            f"half an hour: "
            "no direct can be derived from them"
        )
    return said
