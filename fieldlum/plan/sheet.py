"""Write printable sheets, one page per day.

A page has boxes to tick, the sun's path and the shutter list.
"""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from html import escape
from io import StringIO
from itertools import groupby
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats
from fieldlum.core.plot_style import AMBER, INK, PALE, RED, SAND, open_axes
from fieldlum.core.records import CameraSetup, Site, SiteFile, Slot, utc_text
from fieldlum.optics.profiles import assumed_texts
from fieldlum.optics.projection import altitude_azimuth_deg
from fieldlum.plan.days import (
    DHI_CELL_WM2,
    DNI_CELL_WM2,
    NEAR_DEG,
    SEASON_TAGS,
    DaylightHours,
    band_directions,
    coverage,
    hours_of,
    near_planned,
    season_date,
    sun_band_percent,
)
from fieldlum.room.scene.drawing import room_svg
from fieldlum.session import exposure_text
from fieldlum.sky import sun
from fieldlum.weather import Weather

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
    from icalendar import Alarm, Calendar, Event

    where = f"{site.name}|{site.latitude_deg:.4f}|{site.longitude_deg:.4f}"
    place, zone = hashlib.sha256(where.encode()).hexdigest()[:12], ZoneInfo(site.timezone)
    last_s = timedelta(seconds=max(round(seconds_per_slot), 60))
    calendar = Calendar()
    for name, value in (
        ("prodid", "-//fieldlum//capture plan//EN"),
        ("version", "2.0"),
        ("x-wr-calname", f"fieldlum {site.name}"),
    ):
        calendar.add(name, value)
    for day, group in by_day(slots, site):
        event, alarm = Event(), Alarm()
        for name, value in (
            ("uid", f"{day:%Y%m%d}-{place}@fieldlum"),
            ("dtstamp", made_utc),
            ("sequence", sequence),
            ("dtstart", group[0].t_utc),
            ("dtend", group[-1].t_utc + last_s),
            ("summary", f"Capture {site.name}: {len(group)} brackets"),
            ("description", "\n".join(_event_line(slot, zone) for slot in group)),
            ("location", f"{site.name} ({site.latitude_deg:g}, {site.longitude_deg:g})"),
        ):
            event.add(name, value)
        alarm.add("action", "DISPLAY")
        alarm.add("description", f"First bracket at {group[0].t_utc.astimezone(zone):%H:%M}")
        alarm.add("trigger", -ALARM_BEFORE)
        event.add_component(alarm)
        calendar.add_component(event)
    return calendar.to_ical()


def _event_line(slot: Slot, zone: ZoneInfo) -> str:
    tags = f"; {' '.join(slot.tags)}" if slot.tags else ""
    return (
        f"{slot.t_utc.astimezone(zone):%H:%M %Z} ({utc_text(slot.t_utc)}) sun "
        f"{slot.sun_altitude_deg:.0f} deg high, azimuth {slot.sun_azimuth_deg:.0f}{tags}"
    )


_BAND_DECLINATIONS = 16  # of the drawn sun band: dots that touch; chosen
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
    hours, site = hours_of(slots), setup.site
    title = (
        f"{site.name}: {len(hours)} captures reach {sun_band_percent(hours, site):.0f} % of the "
        f"year's sun band (dark: within {NEAR_DEG:g} deg of a captured sun)"
    )
    year = hours.t_utc[0].year if len(hours) else datetime.now(UTC).year
    texts = [room_svg(setup), f"<p>{escape(title)}</p>{sky_chart(year, hours, site, band=True)}"]
    if weather is not None:
        buffer = StringIO()
        figure = irradiance_figure(hours, site, weather)
        with warnings.catch_warnings():
            # The site's name may have letters that the font lacks.
            warnings.filterwarnings("ignore", message="Glyph .* missing from font")
            figure.savefig(buffer, format="svg", dpi=110, metadata={"Date": None})
        texts.append(buffer.getvalue()[buffer.getvalue().index("<svg") :])
    return [text for text in texts if text]


def irradiance_figure(hours: DaylightHours, site: Site, weather: Weather) -> Figure:
    """Draw how often the weather year has each direct and diffuse irradiance, with planned hours.

    As Figures 16 and 17 of Liu, Colburn and Inanici (2020). The planned hours have the irradiance
    that the weather year has then.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 3.8), layout="constrained")
    axes = figure.add_subplot()
    lit = (sun.position(weather.t_utc, site).altitude_deg > 0) & (weather.dhi_wm2 > 0)
    dni, dhi = weather.dni_wm2[lit], weather.dhi_wm2[lit]
    top = max(float(dhi.max()), 500) + 25
    bins = np.arange(0, 1150, DNI_CELL_WM2 / 2), np.arange(0, top, DHI_CELL_WM2 / 2)
    *_, picture = axes.hist2d(dni, dhi, bins=bins, norm=LogNorm(), cmap="YlOrBr", rasterized=True)
    figure.colorbar(picture, ax=axes, label="hours per year in a cell")
    planned = weather.at(hours.t_utc)
    label = "planned, with the weather year's light"
    axes.scatter(planned.dni_wm2, planned.dhi_wm2, s=9, color=INK, linewidths=0, label=label)
    axes.set(xlabel="direct normal [W/m2]", ylabel="diffuse horizontal [W/m2]")
    share = coverage(hours, site, weather).irradiance_percent
    title = f"{site.name}: {share:.0f} % of the year's daylight hours have skies like the plan's"
    axes.set_title(title, fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=8, loc="upper right")
    open_axes(axes)
    return figure


def _sheet(
    number: int, day: date, slots: list[Slot], setup: SiteFile, cost: Cost, so_far: int
) -> dict[str, object]:
    zone = ZoneInfo(setup.site.timezone)
    tags = sorted({tag for slot in slots for tag in slot.tags if tag in SEASON_TAGS})
    exposures, each_s = slots[0].exposures, cost.seconds_per_slot
    known_size = "profile" not in setup.camera.assumed
    gigabytes = [count * cost.megabytes_per_slot / 1000 for count in (len(slots), so_far)]
    return {
        "number": number,
        "date": f"{day:%A %d %B %Y}".replace(" 0", " "),
        "season": " ".join(tags).replace("-", " ").capitalize(),
        "rise_and_set": _rise_and_set(sun.rise_transit_set([day], setup.site)[0], zone),
        "clock_change": [
            f"{change.total_seconds() / 3600:+g} h at {t.astimezone(zone):%H:%M %Z}"
            for t, change in sun.clock_changes(day, day, setup.site.timezone)
        ],
        "rows": [_row(slot, slot.t_utc.astimezone(zone), day) for slot in slots],
        "exposures": [exposure_text(exposure).replace(" ", " s ", 1) for exposure in exposures],
        "same_exposures": all(slot.exposures == exposures for slot in slots),
        "each": f"{each_s:.0f} s" if each_s < 90 else f"{each_s / 60:.1f} min",
        "size_is_known": known_size,
        "gigabytes": f"{gigabytes[0]:.1f}",
        "gigabytes_so_far": f"{gigabytes[1]:.1f}",
        "sun_path": sky_chart(day.year, hours_of(slots), setup.site, day=day, camera=setup.camera),
    }


def _row(slot: Slot, local: datetime, day: date) -> dict[str, object]:
    return {
        "local": f"{local:%H:%M}",
        "zone": f"{local:%Z}",
        "weekday": "" if local.date() == day else f"{local:%a %d}",
        "utc": f"{slot.t_utc:%H:%M}",
        "altitude": f"{slot.sun_altitude_deg:.0f}",
        "azimuth": f"{slot.sun_azimuth_deg:.0f}",
        "tags": [tag.replace("-", " ") for tag in slot.tags if tag not in SEASON_TAGS],
    }


def _rise_and_set(today: sun.DayOfSun, zone: ZoneInfo) -> str:
    times = {"Sunrise": today.rise, "sunset": today.set}
    shown = [f"{name} {t.astimezone(zone):%H:%M}" for name, t in times.items() if t]
    return ", ".join(shown) or "The sun neither rises nor sets today"


# ----------------------------------------------------------------------------------------------
# sky chart


def _xy(altitude_deg: ArrayLike, azimuth_deg: ArrayLike) -> Floats:
    """Return pixels [n, 2] on a sky chart: north up, east right, zenith in the middle."""
    r = RADIUS_PX * (1.0 - np.asarray(altitude_deg, float) / 90.0)
    azimuth = np.radians(azimuth_deg)
    return SIZE_PX / 2 + np.stack([r * np.sin(azimuth), -r * np.cos(azimuth)], axis=-1)


def _circle(at: Floats, radius: float, style: str) -> str:
    return f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="{radius:.1f}" {style}/>'


def _text(at: Floats, text: str, colour: str, size: int = 9) -> str:
    return (
        f'<text x="{at[0]:.1f}" y="{at[1]:.1f}" font-size="{size}" fill="{colour}" '
        f'text-anchor="middle" font-family="sans-serif">{text}</text>'
    )


def _day_path(day: date, site: Site, style: str) -> str:
    """Return an SVG line of the sun on a day of local standard time; "" if it does not rise."""
    start = sun.standard_midnight(day, site.timezone)
    at = sun.position([start + timedelta(minutes=10 * k) for k in range(145)], site)
    up = at.altitude_deg > 0
    begins = up & ~np.concatenate(([False], up[:-1]))
    points = zip(_xy(at.altitude_deg, at.azimuth_deg)[up], begins[up], strict=True)
    line = "".join(f"{'M' if first else 'L'}{x:.1f} {y:.1f}" for (x, y), first in points)
    return f'<path d="{line}" fill="none" {style}/>' if line else ""


def _view_directions(camera: CameraSetup) -> list[str]:
    """Return thin wedges in the directions of the camera's headings, as SVG."""
    wedges = []
    headings = camera.headings or (camera.heading_deg,)
    for heading in () if "heading_deg" in camera.assumed else headings:
        corners = _xy([1, 9, 9], [heading, heading - 3, heading + 3])
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in corners)
        title = "<title>view direction</title>"
        wedges.append(f'<polygon points="{points}" fill="#1f5fa8">{title}</polygon>')
    return wedges


def sky_chart(
    year: int,
    hours: DaylightHours,
    site: Site,
    *,
    day: date | None = None,
    camera: CameraSetup | None = None,
    band: bool = False,
) -> str:
    """Return an SVG sky chart (north up, east right) of planned suns and the paths of the seasons.

    day: a path of its own, with the hour of each planned sun; camera: wedges in the directions of
    its headings; band: the year's sun band, where a planned sun is near in another colour (Figure
    15 of Liu, Colburn and Inanici 2020). A chart of azimuth against altitude would fail in the
    tropics, where the sun passes the zenith on either side.
    """
    middle, grey = np.full(2, SIZE_PX / 2), "#8a96a3"
    parts = [_circle(middle, RADIUS_PX, 'fill="#fdf8ec" stroke="#b9c3cd"')]
    directions = band_directions(site, _BAND_DECLINATIONS) if band else np.zeros((0, 3))
    altitude, azimuth = altitude_azimuth_deg(directions)
    reached = near_planned(directions, hours)
    for at, is_near in zip(_xy(altitude, azimuth), reached, strict=True):
        parts.append(_circle(at, 2.2, f'fill="{AMBER if is_near else SAND}"'))
    for level in (30, 60):
        radius = RADIUS_PX * (1 - level / 90)
        parts.append(_circle(middle, radius, f'fill="none" stroke="{PALE}" stroke-width="0.5"'))
        parts.append(_text(middle - [-9.0, radius + 2], f"{level}", grey))
    parts += _view_directions(camera) if camera else []
    seasons = [season_date(year, which, site) for which in (0, 1, 3)]
    parts += [_day_path(date, site, 'stroke="#e0b45c"') for date in seasons]
    parts.append(_day_path(day, site, f'stroke="{RED}" stroke-width="2"') if day else "")
    zone = ZoneInfo(site.timezone)
    for t_utc, at in zip(hours.t_utc, _xy(hours.altitude_deg, hours.azimuth_deg), strict=True):
        parts.append(_circle(at, 3.4 if day else 1.2, f'fill="{RED}"'))
        if day:
            parts.append(_text(at - [0.0, 6.0], f"{t_utc.astimezone(zone):%H}", INK))
    for text, azimuth_deg in (("N", 0), ("E", 90), ("S", 180), ("W", 270)):
        parts.append(_text(_xy(-9.0, azimuth_deg) - [0.0, -4.0], text, INK, 12))
    label = f"Sun path of {day or year} with {len(hours)} planned captures"
    size = f"{SIZE_PX:.0f}"
    return (
        f'<svg viewBox="0 0 {size} {size}" role="img" aria-label="{label}" '
        f'xmlns="http://www.w3.org/2000/svg">{"".join(parts)}</svg>'
    )
