"""Describe a plan: its warnings, and its summary as sentences and for --json."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date
from zoneinfo import ZoneInfo

from fieldlum.core.records import Site, Slot, counted
from fieldlum.plan.coverage import Coverage
from fieldlum.plan.days import DaylightHours, hours_of
from fieldlum.session import Session
from fieldlum.session.folder import PlanTable
from fieldlum.sky import sun


@dataclass(frozen=True, slots=True)
class Request:
    """The options of the command `plan`.

    set: 4-day, 9-day, 12-day, month, even or best; today: the local date; start: first date; year:
    of the equinoxes and solstices, or of a first date on 1 January; days: number for month, even
    and best; count: of hours, for even and best; seed: for even.
    """

    set: str
    today: date
    start: date | None = None
    year: int | None = None
    days: int | None = None
    count: int | None = None
    seed: int = 1


@dataclass(frozen=True, slots=True)
class Months:
    """Expected squared error of a capture month, relative to the best month.

    The error is the variance that the month's captures leave, by the kernel. best: name of the
    calendar month with the least; times_best: error of the planned month over the least, 1 or more;
    by_month: that of each calendar month over the least, January first.
    """

    best: str
    times_best: float
    by_month: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Plan:
    """The slots of a set, their cost and coverage, and the warnings.

    days: all days of the set, also those without slots; variance_left: share of the prior variance
    over the year that the captures leave, None without weather; months: only for the set `month`
    with weather.
    """

    slots: tuple[Slot, ...]
    days: tuple[date, ...]
    seconds_per_slot: float
    megabytes_per_slot: float
    coverage: Coverage
    variance_left: float | None
    months: Months | None
    warnings: tuple[str, ...]

    @property
    def hours(self) -> DaylightHours:
        """Times of the slots, and the sun's angles at these times."""
        return hours_of(self.slots)

    def about(self, request: Request) -> PlanTable:
        """Return the table [plan] of session.toml, with the options that are set and revision 0."""
        table: PlanTable = {
            "set": request.set,
            "revision": 0,
            "slots": len(self.slots),
            "first": self.days[0],
            "last": self.days[-1],
            "seconds_per_slot": self.seconds_per_slot,
            "megabytes_per_slot": self.megabytes_per_slot,
            "sun_band_percent": round(self.coverage.sun_band_percent, 1),
        }
        for name in ("start", "year", "count"):
            if (value := getattr(request, name)) is not None:
                table[name] = value
        return table


@dataclass(frozen=True, slots=True)
class PlanSummary:
    """The object that `plan --json` prints; its keys are a contract.

    session: path of its folder; slots, days: numbers of slots, and of days with slots; first, last:
    ids of slots; solar_noon: local time on the first day, "" if unknown; frames: of all slots, at
    every heading; megabytes: of all slots, only if size_is_known; tags: number of slots with each
    tag; variance_left_percent: of the prior variance over the year, None without weather; month:
    comparison with other months, only for `--set month` with weather, else None.
    """

    session: str
    slots: int
    days: int
    first: str
    last: str
    solar_noon: str
    frames: int
    seconds_per_slot: float
    megabytes: float
    size_is_known: bool
    tags: dict[str, int]
    coverage: Coverage
    variance_left_percent: float | None
    month: Months | None
    warnings: tuple[str, ...]


def plan_warnings(
    days: Sequence[date], hours: DaylightHours, site: Site, request: Request
) -> list[str]:
    """Return warnings about the days and hours of a plan, one sentence each; none is an empty list.

    They are about polar night, midnight sun, fewer hours than `count`, clock changes, UTC as the
    time zone of a distant site, and a plan that begins in the past.
    """
    texts: list[str] = []
    count, zone = Counter(sun.standard_date(t, site.timezone) for t in hours.t_utc), site.timezone
    if request.set not in ("even", "best"):
        dark, midnight = ([d for d in days if count[d] == n] for n in (0, 24))
        if dark:
            texts.append(f"polar night: no slot on {len(dark)} of {len(days)} days{_runs(dark)}")
        if midnight:
            of_all = f"{len(midnight)} of {len(days)} days{_runs(midnight)}"
            texts.append(f"midnight sun: a slot in every hour of {of_all}")
    if request.count and len(hours) < request.count:
        texts.append(
            f"--count {request.count}: the plan has only {len(hours)} slots, because no more hours "
            "of its days are suitable"
        )
    for moment, change in sun.clock_changes(days[0], days[-1], zone):
        if sun.standard_date(moment, zone) in set(days):
            change_h = change.total_seconds() / 3600
            way = f"{'forward' if change_h > 0 else 'back'} by {abs(change_h):g} h"
            day = f"{moment.astimezone(ZoneInfo(zone)):%Y-%m-%d}"
            texts.append(f"clocks go {way} on {day}; slots stay at hh:30 of standard time")
    if zone == "UTC" and abs(site.longitude_deg) > 30:
        texts.append(
            f"timezone is UTC at longitude {site.longitude_deg:g}: days and hours of the plan are "
            "those of UTC, not of the site"
        )
    if days[0] < request.today:
        texts.append(
            f"the plan starts on {days[0]}, which is in the past: slots in the past count as missed"
        )
    return texts


def _runs(days: Sequence[date]) -> str:
    """Return runs of consecutive days, by their first and last day, in brackets."""
    runs: list[list[date]] = []
    for day in sorted(days):
        if not runs or (day - runs[-1][-1]).days > 1:
            runs.append([])
        runs[-1].append(day)
    return f" ({', '.join(' to '.join(map(str, dict.fromkeys((r[0], r[-1])))) for r in runs)})"


def summary(session: Session, plan: Plan) -> PlanSummary:
    """Return counts, dates, cost, coverage and warnings of a plan, as `plan --json` prints."""
    slots, setup = plan.slots, session.site_file()
    site, turns = setup.site, max(len(setup.camera.headings), 1)
    first_day = sun.standard_date(slots[0].t_utc, site.timezone)
    transit = sun.rise_transit_set([first_day], site)[0].transit
    noon = transit.astimezone(ZoneInfo(site.timezone)) if transit else None
    return PlanSummary(
        session=str(session.root),
        slots=len(slots),
        days=len({sun.standard_date(slot.t_utc, site.timezone) for slot in slots}),
        first=slots[0].id,
        last=slots[-1].id,
        # it reveals a longitude with a wrong sign
        solar_noon=f"{noon:%H:%M %Z}" if noon else "",
        frames=turns * sum(len(slot.exposures) for slot in slots),
        seconds_per_slot=plan.seconds_per_slot,
        megabytes=round(plan.megabytes_per_slot * len(slots), 1),
        size_is_known="profile" not in setup.camera.assumed,
        tags=dict(sorted(Counter(tag for slot in slots for tag in slot.tags).items())),
        coverage=plan.coverage,
        variance_left_percent=None if plan.variance_left is None else 100 * plan.variance_left,
        month=plan.months,
        warnings=plan.warnings,
    )


def sentences(summary: PlanSummary) -> list[str]:
    """Return the summary as sentences to print; the warnings are not among them."""
    slots, tags = summary.slots, summary.tags
    texts = [
        f"{counted(slots, 'slot')} on {counted(summary.days, 'day')}, {summary.first} to "
        f"{summary.last}, in {summary.session}",
        _cost_text(summary),
        _covered_text(summary.coverage),
    ]
    if summary.solar_noon:
        texts.append(f"solar noon on the first day is at {summary.solar_noon}")
    if "sun-enters" in tags:
        texts.append(
            f"if the sky is clear, the sun shines through a window in {tags['sun-enters']} slots, "
            f"and the camera sees the sun itself in {tags.get('sun-in-view', 0)} slots"
        )
    if summary.variance_left_percent is not None:
        texts.append(
            f"after these captures {summary.variance_left_percent:.2g} % of the model's variance "
            f"over the year is left ({10 * summary.variance_left_percent**0.5:.2g} % of its "
            "standard uncertainty), if skies are as in the weather file"
        )
    if summary.month is not None:
        texts.append(
            f"the expected squared error of a model from this month is "
            f"{summary.month.times_best:.2f} times that of the best month, {summary.month.best}"
        )
    return texts


def _cost_text(summary: PlanSummary) -> str:
    text = f"{counted(summary.frames, 'frame')}, {summary.seconds_per_slot:g} s"
    if not summary.size_is_known:
        return f"{text} per slot; the size of the files is unknown, because no camera is stated"
    each, total = summary.megabytes / summary.slots, summary.megabytes / 1000
    return f"{text} and {each:.0f} MB per slot, {total:.1f} GB in total"


def _covered_text(coverage: Coverage) -> str:
    text = f"the plan covers {coverage.sun_band_percent:.0f} % of the year's sun band"
    if coverage.irradiance_percent is None:
        return text
    return (
        f"{text} and the skies of {coverage.irradiance_percent:.0f} % of the weather year's "
        f"daylight hours; {coverage.both_percent:.0f} % of these hours are covered in both"
    )
