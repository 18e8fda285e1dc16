"""The report's section on melanopic light: shares of hours and days with enough of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.report.page import Section, Table, named
from fieldlum.sky.sun import standard_time
from fieldlum.year.predict import Annual

BROWN_EDI_LX, BROWN_HOURS = 250.0, (6, 19)  # Brown et al., PLOS Biology 20 (2022)
WELL_EDI_LX, WELL_HOURS = (109.0, 136.0, 163.0, 250.0), (9, 13)  # WELL v2, L03
_NORMAL_95 = 1.96
NOT_MEASURED = "cannot tell: no melanopic colour was measured"
_ESTIMATE = (
    "An estimate, because no melanopic colour was measured: vertical illuminance times 1.0, as if "
    "the light had the spectrum of D65. For 58 spectra of daylight behind electrochromic glass it "
    "is 11 to 17 % too high. Calibrate the camera's colour (fieldlum calibrate colour), then merge "
    "and predict again."
)
_MEASURED = "By the colour of the captures, with 95 % intervals."
_MEANING = (
    " Daylight alone, at the camera's place and height; hours of local standard time. 250 lx from "
    "06:00 to 19:00 is the advice of Brown et al. 2022. WELL v2 L03 asks for 136 or 250 lx in the "
    "four hours from 09:00 to 13:00, with enhanced daylight for 109 or 163 lx."
)


@dataclass(frozen=True, slots=True)
class Share:
    """A share in percent: its best value, and the ends of its 95 % interval."""

    value: float
    low: float
    high: float

    def text(self) -> str:
        """Return the share with its interval, if it has one."""
        interval = "" if self.low == self.high else f" ({self.low:.0f} to {self.high:.0f})"
        return f"{self.value:.0f} %{interval}"

    def above(self, limit: float) -> str:
        """Return whether the share exceeds a limit [%]: yes, no, or cannot tell."""
        return "yes" if self.low > limit else "no" if self.high <= limit else "cannot tell"


def is_measured(annual: Annual) -> bool:
    """Return whether melanopic EDI of the year is by measured colour."""
    return bool(np.isfinite(annual.views["melanopic_edi_lx"]).any())


def melanopic_shares(annual: Annual, zone: str) -> list[tuple[Share, list[Share]]]:
    """Return shares of the year with enough melanopic light, for each direction.

    The first is of the hours from 06:00 to 19:00 with 250 lx or more; the others are of the days
    with each of `WELL_EDI_LX` in all four hours from 09:00 to 13:00. Hours in the dark count as
    without light. Hours are those of local standard time; zone : its IANA name. Without measured
    colour they are estimates, without intervals.
    """
    local = [standard_time(t, zone) for t in annual.t_utc]
    hour, day = np.array([t.hour for t in local]), np.array([t.toordinal() for t in local])
    if is_measured(annual):
        edi, u = annual.views["melanopic_edi_lx"], annual.views["u_melanopic_edi_lx"]
    else:
        edi, u = annual.views["melanopic_edi_lx_estimate"], 0.0
    ends = np.stack([edi, edi - _NORMAL_95 * u, edi + _NORMAL_95 * u])  # [3, n, d]
    brown = (hour >= BROWN_HOURS[0]) & (hour < BROWN_HOURS[1])
    days = max(annual.summary.days, 1)
    hours = days * (BROWN_HOURS[1] - BROWN_HOURS[0])
    every = 100.0 * (ends[:, brown] >= BROWN_EDI_LX).sum(axis=1) / hours  # [3, d]
    well = [
        100.0 * np.stack([_days_with(end >= limit, hour, day) for end in ends]) / days
        for limit in WELL_EDI_LX
    ]
    return [
        (Share(*map(float, every[:, k])), [Share(*map(float, share[:, k])) for share in well])
        for k in range(edi.shape[1])
    ]


def _days_with(bright: Mask, hour: Floats, day: Floats) -> Floats:
    """Return the number of days that are bright in all of the hours of WELL, [d]."""
    first, last = WELL_HOURS
    rows = (hour >= first) & (hour < last)
    days, index = np.unique(day[rows], return_inverse=True)
    counts = np.zeros((len(days), bright.shape[1]))
    np.add.at(counts, index, bright[rows])
    return (counts >= last - first).sum(axis=0)


def section(annual: Annual, zone: str) -> Section:
    """Return the section with the shares of hours and days by view direction."""
    rows = tuple(
        (named(azimuth), hours.text(), *(share.text() for share in days))
        for azimuth, good, (hours, days) in zip(
            annual.azimuths_deg, annual.judged, melanopic_shares(annual, zone), strict=True
        )
        if good
    )
    limits = (f"days ≥ {limit:.0f} lx, 09–13 h" for limit in WELL_EDI_LX)
    head = ("view direction", "hours ≥ 250 lx, 06–19 h", *limits)
    text = (_MEASURED if is_measured(annual) else _ESTIMATE) + _MEANING
    return Section("melanopic", "Melanopic light of day", text, tables=(Table(head, rows),))
