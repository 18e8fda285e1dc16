"""Write printable sheets, one page per day.

A page has boxes to tick, the sun's path and the shutter list.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date, datetime, timedelta
from io import StringIO
from itertools import groupby
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site, SiteFile, Slot, utc_text
from fieldlum.optics.profiles import assumed_texts
from fieldlum.plan.coverage import day_arc, irradiance_figure, sun_figure
from fieldlum.plan.days import SEASON_TAGS, hours_of
from fieldlum.room.scene.drawing import room_svg
from fieldlum.session import exposure_text
from fieldlum.sky import sun
from fieldlum.weather import Weather

ALARM_BEFORE = timedelta(minutes=20)  # time to set up the camera; chosen, not measured


def by_day(slots: Sequence[Slot], site: Site) -> list[tuple[date, list[Slot]]]:
    """Return (date, slots) for each local standard date with slots, both in time order."""
    ordered = sorted(slots, key=lambda slot: slot.t_utc)
    groups = groupby(ordered, key=lambda slot: sun.standard_date(slot.t_utc, site.timezone))
    return [(day, list(group)) for day, group in groups]


def ics(
    slots: Sequence[Slot],
    site: Site,
    seconds_per_slot: float,
    made_utc: datetime,
    sequence: int = 0,
) -> bytes:
    """Return an iCalendar file (RFC 5545) with one event for each local standard day with slots.

    An event ends `seconds_per_slot` (at least a minute) after its last slot begins; its alarm is 20
    minutes before the first. made_utc: time of writing; sequence: how often the plan was changed. A
    calendar replaces an event of the same day, because it has the same UID.
    """
    from icalendar import Calendar

    calendar = Calendar()
    calendar.add("prodid", "-//fieldlum//capture plan//EN")
    calendar.add("version", "2.0")
    calendar.add("x-wr-calname", f"fieldlum {site.name}")
    place = hashlib.sha256(
        f"{site.name}|{site.latitude_deg:.4f}|{site.longitude_deg:.4f}".encode()
    ).hexdigest()[:12]
    for day, group in by_day(slots, site):
        calendar.add_component(
            _event(day, group, site, seconds_per_slot, made_utc, sequence, place)
        )
    return calendar.to_ical()


def _event(
    day: date,
    slots: list[Slot],
    site: Site,
    seconds: float,
    made_utc: datetime,
    sequence: int,
    place: str,
):
    from icalendar import Alarm, Event

    zone = ZoneInfo(site.timezone)
    event = Event()
    event.add("uid", f"{day:%Y%m%d}-{place}@fieldlum")
    event.add("dtstamp", made_utc)
    event.add("sequence", sequence)
    event.add("dtstart", slots[0].t_utc)
    event.add("dtend", slots[-1].t_utc + timedelta(seconds=max(round(seconds), 60)))
    event.add("summary", f"Capture {site.name}: {len(slots)} brackets")
    lines = [
        f"{slot.t_utc.astimezone(zone):%H:%M %Z} ({utc_text(slot.t_utc)}) sun "
        f"{slot.sun_altitude_deg:.0f} deg high, "
        f"azimuth {slot.sun_azimuth_deg:.0f}" + (f"; {' '.join(slot.tags)}" if slot.tags else "")
        for slot in slots
    ]
    event.add("description", "\n".join(lines))
    event.add("location", f"{site.name} ({site.latitude_deg:g}, {site.longitude_deg:g})")
    alarm = Alarm()
    alarm.add("action", "DISPLAY")
    alarm.add("description", f"First bracket at {slots[0].t_utc.astimezone(zone):%H:%M}")
    alarm.add("trigger", -ALARM_BEFORE)
    event.add_component(alarm)
    return event


SIZE_PX = 300.0  # of the sky chart; chosen for a third of a page
RADIUS_PX = 122.0  # of its horizon; chosen
# minutes after the planned time within which a bracket may start; the default of `fieldlum capture
# --grace` (docs/capture.md)
LATE_MINUTES = 5


@dataclass(frozen=True, slots=True)
class Cost:
    """Time and storage of one slot."""

    seconds_per_slot: float
    megabytes_per_slot: float


def html(
    slots: Sequence[Slot],
    setup: SiteFile,
    cost: Cost,
    weather: Weather | None = None,
    notes: Sequence[str] = (),
) -> str:
    """Return one self-contained page of HTML: room and coverage plots, then a sheet for every day.

    cost: time and storage of one slot; weather: for a second coverage plot, by irradiance; notes:
    texts to print.
    """
    from jinja2 import Environment, PackageLoader, select_autoescape

    days = by_day(slots, setup.site)
    environment = Environment(
        loader=PackageLoader("fieldlum.plan", ""), autoescape=select_autoescape(default=True)
    )
    sheets, before = [], 0
    for number, (day, group) in enumerate(days, start=1):
        before += len(group)
        sheets.append(_sheet(number, day, group, setup, cost, before))
    return environment.get_template("sheet.html.j2").render(
        site=setup.site,
        sheets=sheets,
        days=len(days),
        late=LATE_MINUTES,
        notes=notes,
        assumed=assumed_texts(setup.camera),
        figures=_figures(slots, setup, weather),
    )


def _figures(slots: Sequence[Slot], setup: SiteFile, weather: Weather | None) -> list[str]:
    """Return the drawing of the room and the coverage plots as inline SVG."""
    hours = hours_of(slots)
    figures = [sun_figure(hours, setup.site)]
    if weather is not None:
        figures.append(irradiance_figure(hours, setup.site, weather))
    texts = []
    for figure in figures:
        buffer = StringIO()
        with warnings.catch_warnings():
            # The site's name may have letters that the font lacks.
            warnings.filterwarnings("ignore", message="Glyph .* missing from font")
            figure.savefig(buffer, format="svg", dpi=110, metadata={"Date": None})
        texts.append(buffer.getvalue()[buffer.getvalue().index("<svg") :])
    drawing = room_svg(setup)
    return [drawing, *texts] if drawing else texts


def _sheet(
    number: int, day: date, slots: list[Slot], setup: SiteFile, cost: Cost, so_far: int
) -> dict[str, object]:
    site, zone = setup.site, ZoneInfo(setup.site.timezone)
    today = sun.rise_transit_set([day], site)[0]
    changes = sun.clock_changes(day, day, site.timezone)
    exposures = slots[0].exposures
    return {
        "number": number,
        "date": f"{day:%A %d %B %Y}".replace(" 0", " "),
        "season": " ".join(
            sorted({tag.replace("-", " ") for s in slots for tag in s.tags if tag in SEASON_TAGS})
        ).capitalize(),
        "rise_and_set": _rise_and_set(today, zone),
        "clock_change": [
            f"{change.total_seconds() / 3600:+g} h at {t.astimezone(zone):%H:%M %Z}"
            for t, change in changes
        ],
        "rows": [
            {
                "local": f"{slot.t_utc.astimezone(zone):%H:%M}",
                "zone": f"{slot.t_utc.astimezone(zone):%Z}",
                "weekday": ""
                if (local := slot.t_utc.astimezone(zone)).date() == day
                else f"{local:%a %d}",
                "utc": f"{slot.t_utc:%H:%M}",
                "altitude": f"{slot.sun_altitude_deg:.0f}",
                "azimuth": f"{slot.sun_azimuth_deg:.0f}",
                "tags": [tag.replace("-", " ") for tag in slot.tags if tag not in SEASON_TAGS],
            }
            for slot in slots
        ],
        "exposures": [exposure_text(exposure).replace(" ", " s ", 1) for exposure in exposures],
        "same_exposures": all(slot.exposures == exposures for slot in slots),
        "each": f"{cost.seconds_per_slot:.0f} s"
        if cost.seconds_per_slot < 90
        else f"{cost.seconds_per_slot / 60:.1f} min",
        "size_is_known": "profile" not in setup.camera.assumed,
        "gigabytes": f"{len(slots) * cost.megabytes_per_slot / 1000:.1f}",
        "gigabytes_so_far": f"{so_far * cost.megabytes_per_slot / 1000:.1f}",
        "sun_path": sun_path_svg(day, slots, setup),
    }


def _rise_and_set(today: sun.DayOfSun, zone: ZoneInfo) -> str:
    if not today.rise and not today.set:
        return "The sun neither rises nor sets today"
    times = (
        f"{name} {t.astimezone(zone):%H:%M}"
        for name, t in (("Sunrise", today.rise), ("sunset", today.set))
        if t
    )
    return ", ".join(times)


# ----------------------------------------------------------------------------------------------
# sun path


def _xy(altitude_deg: ArrayLike, azimuth_deg: ArrayLike) -> Floats:
    """Return pixels [n, 2] on a sky chart: north up, east right, zenith in the middle."""
    r = RADIUS_PX * (1.0 - np.asarray(altitude_deg, float) / 90.0)
    azimuth = np.radians(azimuth_deg)
    return SIZE_PX / 2 + np.stack([r * np.sin(azimuth), -r * np.cos(azimuth)], axis=-1)


def _path(altitude_deg: ArrayLike, azimuth_deg: ArrayLike, style: str) -> str:
    """Return an SVG line through the points, with a gap at each NaN; "" without points."""
    finite = np.isfinite(altitude_deg)
    begins = finite & ~np.concatenate(([False], finite[:-1]))
    words = (
        f"{'M' if first else 'L'}{x:.1f} {y:.1f}"
        for (x, y), first, is_finite in zip(
            _xy(altitude_deg, azimuth_deg), begins, finite, strict=True
        )
        if is_finite
    )
    line = "".join(words)
    return f'<path d="{line}" fill="none" {style}/>' if line else ""


def sun_path_svg(day: date, slots: Sequence[Slot], setup: SiteFile) -> str:
    """Return an SVG sky chart (north up, east right) of the sun's path on `day`.

    It also has the paths of the solstices and the equinox, the slots, and the camera's headings.
    """
    site, middle = setup.site, SIZE_PX / 2
    parts = [
        f'<circle cx="{middle}" cy="{middle}" r="{RADIUS_PX:.1f}" fill="#fdf8ec" stroke="#b9c3cd"/>'
    ]
    for altitude in (30, 60):
        radius = RADIUS_PX * (1 - altitude / 90)
        parts.append(
            f'<circle cx="{middle}" cy="{middle}" r="{radius:.1f}" fill="none" stroke="#dde3e8"/>'
        )
        parts.append(_text(middle + 3, middle - radius - 2, f"{altitude}", "#8a96a3", "start"))
    parts.append(_looking(setup))
    for which in (0, 1, 3):
        arc = day_arc(sun.standard_date(sun.season(day.year, which), site.timezone), site)
        parts.append(_path(arc[1], arc[0], 'stroke="#e0b45c" stroke-width="1"'))
    azimuth, altitude_deg = day_arc(day, site)
    parts.append(_path(altitude_deg, azimuth, 'stroke="#c4441c" stroke-width="2"'))
    for slot in slots:
        x, y = _xy(slot.sun_altitude_deg, slot.sun_azimuth_deg)
        local = slot.t_utc.astimezone(ZoneInfo(site.timezone))
        parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.4" fill="#c4441c"/>')
        parts.append(_text(x, y - 6, f"{local:%H}", "#1d2733", "middle"))
    for text, azimuth_deg in (("N", 0), ("E", 90), ("S", 180), ("W", 270)):
        x, y = _xy(-9.0, azimuth_deg)
        parts.append(_text(x, y + 4, text, "#1d2733", "middle", 12))
    label = f"Sun path of {day} with {len(slots)} planned captures"
    return (
        f'<svg viewBox="0 0 {SIZE_PX:.0f} {SIZE_PX:.0f}" role="img" aria-label="{label}" '
        f'xmlns="http://www.w3.org/2000/svg">{"".join(parts)}</svg>'
    )


def _looking(setup: SiteFile) -> str:
    """Return thin wedges in the directions of the camera's headings, as SVG."""
    parts = []
    if "heading_deg" in setup.camera.assumed:
        return ""
    for heading in setup.camera.headings or (setup.camera.heading_deg,):
        tip, left, right = _xy([1, 9, 9], [heading, heading - 3, heading + 3])
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in (tip, left, right))
        parts.append(
            f'<polygon points="{points}" fill="#1f5fa8"><title>view direction</title></polygon>'
        )
    return "".join(parts)


def _text(x: float, y: float, text: str, colour: str, anchor: str, size: int = 9) -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" fill="{colour}" text-anchor="{anchor}" '
        f'font-family="sans-serif">{text}</text>'
    )
