"""Define the options of a plan, and its content."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date

from fieldlum.core.records import Slot
from fieldlum.plan.coverage import Coverage
from fieldlum.plan.days import DaylightHours, hours_of
from fieldlum.session.tables import PlanTable


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

    best: str  # name of the best month
    times_best: float  # error of the planned month over that of the best
    by_month: tuple[float, ...]  # January first, each relative to the best


@dataclass(frozen=True, slots=True)
class Plan:
    """The slots of a set, their cost and coverage, and the warnings.

    days: all days of the set, also those without slots; variance_left: share of the prior variance
    over the year that the captures leave, None without weather; months: only for the set `month`
    with weather.
    """

    slots: tuple[Slot, ...]
    days: tuple[date, ...]  # all days of the set, including days without daylight
    seconds_per_slot: float
    megabytes_per_slot: float
    coverage: Coverage
    # Share of the model's prior variance over the year that the captures leave; None without
    # weather.
    variance_left: float | None
    months: Months | None  # for a month with weather
    warnings: tuple[str, ...]

    @property
    def hours(self) -> DaylightHours:
        """Times of the slots, and the sun's angles at these times."""
        return hours_of(self.slots)

    def about(self, request: Request) -> PlanTable:
        """Return the table [plan] of session.toml, with the options that are set and revision 0."""
        asked: PlanTable = {"set": request.set}
        if request.start is not None:
            asked["start"] = request.start
        if request.year is not None:
            asked["year"] = request.year
        if request.count is not None:
            asked["count"] = request.count
        return {
            **asked,
            "revision": 0,
            "slots": len(self.slots),
            "first": self.days[0],
            "last": self.days[-1],
            "seconds_per_slot": self.seconds_per_slot,
            "megabytes_per_slot": self.megabytes_per_slot,
            "sun_band_percent": round(self.coverage.sun_band_percent, 1),
        }
