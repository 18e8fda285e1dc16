"""Make capture plans: hours, exposures, time, storage, and coverage of the year's light."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import date, datetime
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import ArrayLike, Mask
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Exposure, JsonTable, Room, Site, SiteFile, Slot, counted
from fieldlum.optics import profiles
from fieldlum.plan import capture_days
from fieldlum.plan.capture_days import Coverage, DaylightHours, today_at
from fieldlum.plan.sheet import html, ics
from fieldlum.room.scene.box_room import build
from fieldlum.room.scene.trace import disc_visibility, sun_points
from fieldlum.session import Session, create_session, write_file
from fieldlum.session.folder import PlanTable
from fieldlum.sky import sun
from fieldlum.weather import Weather


@dataclass(frozen=True, slots=True)
class Request:
    """The options of the command `plan`; None where the user states none.

    set: 4-day, 9-day, 12-day, month or even (see `capture_days.days_of_set`); today: the
    local standard date; start: first date, or the earliest for 4-day, 9-day and 12-day; year: of
    the equinoxes and solstices, or of a first date on 1 January; days: number of days, for month
    (None: 31) and even (None: 365); count: number of hours, for even (None: 200, as Liu, Colburn
    and Inanici 2020); seed: of the clusters of even.
    """

    set: str
    today: date
    start: date | None = None
    year: int | None = None
    days: int | None = None
    count: int | None = None
    seed: int = 1


@dataclass(frozen=True, slots=True)
class Plan:
    """The slots of a set, with their cost, coverage and warnings.

    slots: in order of time; days: all local standard dates of the set, also those without slots, in
    order; seconds_per_slot, megabytes_per_slot: time and disk space of one bracket at all headings;
    coverage: what the slots cover of a year; warnings: sentences for the user.
    """

    slots: tuple[Slot, ...]
    days: tuple[date, ...]
    seconds_per_slot: float
    megabytes_per_slot: float
    coverage: Coverage
    warnings: tuple[str, ...]

    def about(self, request: Request) -> PlanTable:
        """Return the table [plan] of session.toml, of revision 0.

        request: that of this plan, of which the stated options are recorded, and the seed of even.
        """
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
        stated = {name: getattr(request, name) for name in ("start", "year", "days", "count")}
        stated["seed"] = request.seed if request.set == "even" else None
        return table | {name: v for name, v in stated.items() if v is not None}  # type: ignore


def sun_enters(room: Room, altitude_deg: ArrayLike, azimuth_deg: ArrayLike) -> Mask:
    """Return a mask [n]: True where a sun at these angles shines through a window of a box room.

    altitude_deg, azimuth_deg: [n] of the sun as the room receives it, azimuth clockwise from true
    north. The sun shines through if one of 6 x 6 points (chosen) of the window is lit past reveals,
    bars and obstructions. Raises InputError for a room of another kind, or an impossible one.
    """
    scene = build(room)
    suns = scene.to_room(sun.direction(altitude_deg, azimuth_deg))  # [n, 3]
    enters = np.zeros(len(suns), bool)
    steps = (np.arange(6) + 0.5) / 6
    for opening in scene.openings:
        (left_m, right_m), (low_m, high_m) = opening.u_m, opening.z_m
        along_m, height_m = left_m + (right_m - left_m) * steps, low_m + (high_m - low_m) * steps
        position = np.full((36, 3), opening.inner_m)
        position[:, opening.along], position[:, 2] = map(np.ravel, np.meshgrid(along_m, height_m))
        axis, sign, target = np.full(36, opening.axis), np.full(36, opening.outward), np.full(36, 0)
        points = sun_points(scene, position, axis, sign, np.ones(36), target, 1)
        enters |= points.direct(suns)[:, 0] > 0.0
    return enters


def sun_in_view(room: Room, altitude_deg: ArrayLike, azimuth_deg: ArrayLike) -> Mask:
    """Return a mask [n]: True where the camera in a box room sees at least a part of the sun disc.

    altitude_deg, azimuth_deg: of the sun [n], azimuth clockwise from true north. Raises InputError
    for a room of another kind, or an impossible one.
    """
    scene = build(room)
    return disc_visibility(scene, scene.to_room(sun.direction(altitude_deg, azimuth_deg)))[0] > 0


_NO_WINDOW = (
    "the [room] has no [[room.window]]: no daylight enters, a simulation is black and glare is 0; "
    "state its windows, or leave [room] out"
)


def make_plan(setup: SiteFile, request: Request, weather: Weather | None = None) -> Plan:
    """Return the plan of a set: slots, cost, coverage and warnings; write nothing.

    setup: of the site; request: names the set. weather: a weather year of the site, for the
    coverage of its daylight and the hours of the set even. Raises NotEnoughDataError if no hour of
    the set has the sun above the horizon, or if even has weather without daylight on the days of
    the set; InputError for an unknown set, and for a profile, filter or room that cannot be used.
    """
    site, room = setup.site, setup.room
    dates = (request.start, request.year, request.days)
    days = capture_days.days_of_set(request.set, site, request.today, *dates)
    from_to = f"from {days[0]} to {days[-1]}"
    night = f"polar night: the sun does not rise at {site.name} ({site.latitude_deg:g} deg)"
    hours = capture_days.daylight_hours(days, site)
    _refuse_empty(hours, f"{night} {from_to}", "choose another --start or --set")
    if request.set == "even":
        rng = np.random.default_rng(request.seed)
        hours = hours[capture_days.even_hours(hours, weather, request.count or 200, rng)]
    remedy = "choose its dates with --start or --year, or another weather file"
    _refuse_empty(hours, f"the weather file has no daylight {from_to}", remedy)
    profile = profiles.load_camera_profile(setup.camera.profile)
    exposures = profiles.planned_exposures(profile, setup.camera)
    slots = make_slots(hours, setup, exposures)
    warnings = (
        *profiles.assumed_texts(setup.camera),
        profiles.uncalibrated_text(profile),
        profiles.coverage_text(profile, setup.camera),
        profiles.turning_text(setup.camera),
        profiles.sun_text(slots),
        *plan_warnings(days, hours, site, request),
        _NO_WINDOW if room and room.kind == "box" and not room.window else "",
        *(weather.repairs if weather else ()),
    )
    # of one slot, by the profile's estimates for one frame
    headings = max(len(setup.camera.headings), 1)
    seconds = sum(profile.bracket.seconds_per_frame + e.shutter_s for e in exposures)
    megabytes = headings * len(exposures) * profile.bracket.megabytes_per_frame
    return Plan(
        slots,
        days=tuple(days),
        seconds_per_slot=round(headings * seconds, 1),
        megabytes_per_slot=round(megabytes, 1),
        coverage=capture_days.coverage(hours, site, weather),
        warnings=tuple(text for text in warnings if text),
    )


def _refuse_empty(hours: DaylightHours, finding: str, remedy: str) -> None:
    """Raise NotEnoughDataError if there are no hours; finding, remedy: why, and what to do."""
    if not len(hours):
        raise NotEnoughDataError(f"{finding}, so the plan would be empty; {remedy}")


# ----------------------------------------------------------------------------------------------
# slots


def make_slots(
    hours: DaylightHours, setup: SiteFile, exposures: Sequence[Exposure]
) -> tuple[Slot, ...]:
    """Return the slots of a plan: one for each hour, in order of time, with tags.

    exposures: of each slot. Tags: the equinox or solstice if it is at most a day away, such as
    "march-equinox"; "low-sun" below 5 deg of altitude; in a box room also "sun-enters" (through a
    window) and "sun-in-view" (of the camera). Raises InputError for an impossible box room.
    """
    days = [sun.standard_date(t, setup.site.timezone) for t in hours.t_utc]
    seasons = {day: capture_days.season_tag(day, setup.site) for day in set(days)}
    angles = (hours.altitude_deg, hours.azimuth_deg)
    masks = {"low-sun": hours.altitude_deg < sun.LOW_SUN_DEG}  # hours with a tag, [n]
    if setup.room is not None and setup.room.kind == "box":
        masks["sun-enters"] = sun_enters(setup.room, *angles)
        masks["sun-in-view"] = sun_in_view(setup.room, *angles)
    slots = []
    for i, (t_utc, altitude, azimuth) in enumerate(zip(hours.t_utc, *angles, strict=True)):
        tags = (seasons[days[i]], *(tag for tag, mask in masks.items() if mask[i]))
        slot = Slot(
            t_utc,
            sun_altitude_deg=float(altitude),
            sun_azimuth_deg=float(azimuth),
            exposures=tuple(exposures),
            tags=tuple(tag for tag in tags if tag),
        )
        slots.append(slot)
    return tuple(sorted(slots, key=lambda slot: slot.t_utc))


# ----------------------------------------------------------------------------------------------
# writing


def run(
    setup: SiteFile, request: Request, out: Path, weather: Weather | None = None
) -> tuple[Session, Plan]:
    """Write the plan that `request` describes into a new session folder; return session and plan.

    out: the folder, which gets plan.csv and session.toml; weather: a weather year of the site, as
    `make_plan` uses it. Raises the errors of `make_plan` and `create_session`.
    """
    plan = make_plan(setup, request, weather)
    return create_session(out, setup, plan.slots, plan.about(request)), plan


def write_calendar(session: Session, made_utc: datetime) -> None:
    """Write the calendar plan.ics into a session's folder, from the slots in plan.csv.

    made_utc: time of writing, for the calendar. Raises InputError if session.toml has no complete
    table [plan], or for a damaged plan.csv.
    """
    seconds, _, revision = _planned_cost(session)
    data = ics(session.slots(), session.site_file().site, seconds, made_utc, revision)
    write_file(session.root / "plan.ics", data)


def write_sheets(
    session: Session, weather: Weather | None = None, notes: Sequence[str] = ()
) -> Path:
    """Write plan.html into a session's folder and return its path: plots, then a sheet per day.

    weather: a year, for a plot of the skies that the plan covers; notes: sentences to print on the
    first page. Raises InputError if session.toml has no complete table [plan], for a damaged
    plan.csv, and for an impossible room.
    """
    cost = _planned_cost(session)[:2]
    page = html(session.slots(), session.site_file(), cost, weather, notes)
    return write_file(session.root / "plan.html", page)


def _planned_cost(session: Session) -> tuple[float, float, int]:
    """Return the time [s] and disk space [MB] of one slot, and the plan's revision.

    Raises InputError if session.toml does not state them.
    """
    plan = session.table().get("plan", {})
    if "seconds_per_slot" in plan and "megabytes_per_slot" in plan and "revision" in plan:
        return plan["seconds_per_slot"], plan["megabytes_per_slot"], plan["revision"]
    expected = "the session.toml of a planned session"
    remedy = "plan again with: fieldlum plan SITE.toml"
    raise InputError(session.toml, "[plan] is missing or incomplete", expected, remedy)


# ----------------------------------------------------------------------------------------------
# warnings and summary as text


def plan_warnings(
    days: Sequence[date], hours: DaylightHours, site: Site, request: Request
) -> Iterator[str]:
    """Yield warnings about the days and hours of a plan, each a sentence.

    They are about polar night, midnight sun, fewer hours than requested, clock changes, UTC as the
    time zone of a site over 30 degrees from Greenwich (two hours of solar time), and a plan that
    begins in the past. days: local standard dates of the set, in order; hours: of the plan;
    request: names set, count and today.
    """
    zone = site.timezone
    hours_by_day = Counter(sun.standard_date(t, zone) for t in hours.t_utc)
    if request.set != "even":
        dark, light = (sum(hours_by_day[day] == count for day in days) for count in (0, 24))
        if dark:
            yield f"polar night: no slot on {dark} of {len(days)} days: capture on the others"
        if light:
            yield f"midnight sun: a slot in every hour of {light} of {len(days)} days"
    if request.count and len(hours) < request.count:
        found = f"--count {request.count}: the plan has only {len(hours)} slots"
        yield f"{found}, because no more hours of its days are suitable"
    for moment, change in sun.clock_changes(days[0], days[-1], zone):
        if sun.standard_date(moment, zone) in days:
            change_h = change.total_seconds() / 3600
            way = f"{'forward' if change_h > 0 else 'back'} by {abs(change_h):g} h"
            day = f"{moment.astimezone(ZoneInfo(zone)):%Y-%m-%d}"
            yield f"clocks go {way} on {day}; slots stay at hh:30 of standard time"
    if zone == "UTC" and abs(site.longitude_deg) > 30:  # two hours of solar time
        found = f"timezone is UTC at longitude {site.longitude_deg:g}"
        yield f"{found}: days and hours of the plan are those of UTC, not of the site"
    if days[0] < request.today:
        found = f"the plan starts on {days[0]}, which is in the past"
        yield f"{found}: capture will skip past slots as missed; a card of then can be imported"


def summary(session: Session, plan: Plan) -> JsonTable:
    """Return counts, dates, cost, coverage and warnings of a plan, with the keys of `plan --json`.

    session: of the plan. Keys: session: its folder; slots, days: numbers of slots, and of days with
    slots; first, last: ids of slots; solar_noon: clock time on the first day, which reveals a
    longitude with a wrong sign, "" if unknown; frames, megabytes: of all slots, at every heading;
    seconds_per_slot: as `Plan`; size_is_known: whether SITE.toml names the camera profile; tags:
    number of slots with each tag; coverage: fields of `Coverage`; warnings: sentences for the user.
    """
    slots, setup = plan.slots, session.site_file()
    site, headings = setup.site, max(len(setup.camera.headings), 1)
    days = sorted({sun.standard_date(slot.t_utc, site.timezone) for slot in slots})
    noon = sun.rise_transit_set(days[0], site).transit
    return {
        "session": str(session.root),
        "slots": len(slots),
        "days": len(days),
        "first": slots[0].id,
        "last": slots[-1].id,
        "solar_noon": f"{noon.astimezone(ZoneInfo(site.timezone)):%H:%M %Z}" if noon else "",
        "frames": headings * sum(len(slot.exposures) for slot in slots),
        "seconds_per_slot": plan.seconds_per_slot,
        "megabytes": round(plan.megabytes_per_slot * len(slots), 1),
        "size_is_known": "profile" not in setup.camera.assumed,
        "tags": dict(sorted(Counter(tag for slot in slots for tag in slot.tags).items())),
        "coverage": asdict(plan.coverage),
        "warnings": plan.warnings,
    }


def sentences(summary: JsonTable) -> list[str]:
    """Return sentences to print on a plan; its warnings are not among them.

    summary: the result of `summary`.
    """
    slots, days, tags = summary["slots"], summary["days"], summary["tags"]
    cost = f"{counted(summary['frames'], 'frame')}, {summary['seconds_per_slot']:g} s"
    sizes = " per slot; the size of the files is unknown, because no camera is stated"
    if summary["size_is_known"]:
        megabytes = summary["megabytes"]
        sizes = f" and {megabytes / slots:.0f} MB per slot, {megabytes / 1000:.1f} GB in total"
    share = summary["coverage"]
    covered = f"the plan covers {share['sun_band_percent']:.0f} % of the year's sun band"
    if share["irradiance_percent"] is not None:
        covered += (
            f" and the skies of {share['irradiance_percent']:.0f} % of the weather year's daylight "
            f"hours; {share['both_percent']:.0f} % of these hours are covered in both"
        )
    texts = [
        f"{counted(slots, 'slot')} on {counted(days, 'day')}, {summary['first']} to "
        f"{summary['last']}, in {summary['session']}",
        f"{cost}{sizes}",
        covered,
    ]
    if summary["solar_noon"]:
        texts.append(f"solar noon on the first day is at {summary['solar_noon']}")
    if "sun-enters" in tags:
        texts.append(
            f"if the sky is clear, the sun shines through a window in {tags['sun-enters']} slots, "
            f"and the camera sees the sun itself in {tags.get('sun-in-view', 0)} slots"
        )
    return texts
