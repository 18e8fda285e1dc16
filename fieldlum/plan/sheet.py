"""Write a plan for people: printable sheets, one page per day, and a calendar.

A sheet has boxes to tick, the sun's path and the shutter list.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from datetime import UTC, date, datetime, timedelta
from html import escape
from itertools import accumulate, groupby
from typing import TYPE_CHECKING, Any
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core import plot_style
from fieldlum.core.plot_style import AMBER, BLUE, GRID, INK, PALE, RED, SAND
from fieldlum.core.records import Site, SiteFile, Slot, utc_text
from fieldlum.optics import profiles, projection
from fieldlum.plan import capture_days as days
from fieldlum.room.scene.drawing import room_svg
from fieldlum.session import exposure_text
from fieldlum.sky import sun
from fieldlum.weather import Weather

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def by_day(slots: Sequence[Slot], site: Site) -> list[tuple[date, list[Slot]]]:
    """Return each local standard date that has slots, with its slots; both in order of time."""
    ordered = sorted(slots, key=lambda slot: slot.t_utc)
    groups = groupby(ordered, key=lambda slot: sun.standard_date(slot.t_utc, site.timezone))
    return [(day, list(group)) for day, group in groups]


def ics(
    slots: Sequence[Slot], site: Site, seconds_per_slot: float, made_utc: datetime, revision: int
) -> bytes:
    """Return the content of an iCalendar file (RFC 5545) with an event for each day with slots.

    An event begins with the day's first slot. It ends `seconds_per_slot` (at least a minute) after
    the last slot of the day begins; its alarm is 20 minutes before the first, to set up the camera.
    made_utc: time of writing; revision: of the plan, 0 for the first. Events of later revisions
    replace those of the same day, because they have the same UID.
    """
    from icalendar import Alarm, Calendar, Event

    where = f"{site.name}|{site.latitude_deg:.4f}|{site.longitude_deg:.4f}"
    place_id, zone = hashlib.sha256(where.encode()).hexdigest()[:12], ZoneInfo(site.timezone)
    duration = timedelta(seconds=max(round(seconds_per_slot), 60))  # of the last slot
    calendar = Calendar()
    calendar.add("prodid", "-//fieldlum//capture plan//EN")
    calendar.add("version", "2.0")
    calendar.add("x-wr-calname", f"fieldlum {site.name}")
    for day, group in by_day(slots, site):
        event, alarm = Event(), Alarm()
        for name, value in (
            ("uid", f"{day:%Y%m%d}-{place_id}@fieldlum"),
            ("dtstamp", made_utc),
            ("sequence", revision),
            ("dtstart", group[0].t_utc),
            ("dtend", group[-1].t_utc + duration),
            ("summary", f"Capture {site.name}: {len(group)} brackets"),
            ("description", "\n".join(_event_line(slot, zone) for slot in group)),
            ("location", f"{site.name} ({site.latitude_deg:g}, {site.longitude_deg:g})"),
        ):
            event.add(name, value)
        alarm.add("action", "DISPLAY")
        alarm.add("description", f"First bracket at {group[0].t_utc.astimezone(zone):%H:%M}")
        alarm.add("trigger", timedelta(minutes=-20))
        event.add_component(alarm)
        calendar.add_component(event)
    return calendar.to_ical()


def _event_line(slot: Slot, zone: ZoneInfo) -> str:
    """Return a slot as a line of text: its time in a zone and in UTC, its sun and its tags."""
    tags = f"; {' '.join(slot.tags)}" if slot.tags else ""
    place = f"{slot.sun_altitude_deg:.0f} deg high, azimuth {slot.sun_azimuth_deg:.0f}"
    return f"{slot.t_utc.astimezone(zone):%H:%M %Z} ({utc_text(slot.t_utc)}) sun {place}{tags}"


def html(
    slots: Sequence[Slot],
    setup: SiteFile,
    cost: tuple[float, float],
    weather: Weather | None = None,
    notes: Sequence[str] = (),
) -> str:
    """Return a plan as one page of HTML without other files: plots, then a sheet for each day.

    cost: seconds and megabytes of one slot; weather: a year, for a second coverage plot, by
    irradiance; notes: sentences to print above the plots. Raises InputError for an impossible room.
    """
    from jinja2 import Environment, PackageLoader, select_autoescape

    dated = by_day(slots, setup.site)
    loader, escape_all = PackageLoader("fieldlum.plan", ""), select_autoescape(default=True)
    environment = Environment(loader=loader, autoescape=escape_all)
    counts = accumulate(len(group) for _, group in dated)
    assumed = profiles.assumed_texts(setup.camera)
    return environment.get_template("sheet.html.j2").render(
        site=setup.site,
        headings=[f"{heading:g}" for heading in setup.camera.headings],
        sheets=[_sheet(*day, setup, cost, n) for day, n in zip(dated, counts, strict=True)],
        days=len(dated),
        late=5,  # minutes; the default of `fieldlum capture --grace` (docs/capture.md)
        notes=[note for note in notes if note not in assumed],
        assumed=assumed,
        figures=_figures(slots, setup, weather),
    )


def _figures(slots: Sequence[Slot], setup: SiteFile, weather: Weather | None) -> list[str]:
    """Return the drawing of the room, if it has one, and the coverage plots, as inline SVG.

    weather: a year, for a plot of its irradiance; None for no such plot.
    """
    hours, site = days.hours_of(slots), setup.site
    share = days.sun_band_percent(hours, site)
    title = f"{site.name}: {len(hours)} captures reach {share:.0f} % of the year's sun band "
    title += f"(dark: within {days.NEAR_DEG:g} deg of a captured sun)"
    chart = plot_style.svg_of(sky_chart(hours, setup))
    figures = [room_svg(setup), f"<p>{escape(title)}</p>{chart}"]
    if weather is not None:
        figures.append(plot_style.svg_of(irradiance_figure(hours, site, weather)))
    return [figure for figure in figures if figure]


def irradiance_figure(hours: days.DaylightHours, site: Site, weather: Weather) -> Figure:
    """Return a plot of how often a weather year has each direct and diffuse irradiance.

    The plot has direct normal irradiance to the right, diffuse horizontal upwards. hours: planned
    ones, which are points at the irradiance that the weather year has then. weather: with at least
    one hour of daylight. As Figures 16 and 17 of Liu, Colburn and Inanici (2020).
    """
    from matplotlib.colors import LogNorm

    figure = plot_style.new_figure(7.2, 3.8)
    axes = figure.add_subplot()
    lit = (sun.position(weather.t_utc, site).altitude_deg > 0) & (weather.dhi_wm2 > 0)
    dni, dhi = weather.dni_wm2[lit], weather.dhi_wm2[lit]
    largest_wm2 = (1150, max(float(dhi.max()), 500) + 25)  # of the axes: DNI, DHI
    sizes = zip(largest_wm2, days.CELL_WM2, strict=True)
    bins = [np.arange(0, largest, size / 2) for largest, size in sizes]
    *_, picture = axes.hist2d(dni, dhi, bins=bins, norm=LogNorm(), cmap="YlOrBr", rasterized=True)
    figure.colorbar(picture, ax=axes, label="hours per year in a cell")
    planned = weather.at(hours.t_utc)
    label = "planned, with the weather year's light"
    axes.scatter(planned.dni_wm2, planned.dhi_wm2, s=9, color=INK, linewidths=0, label=label)
    axes.set(xlabel="direct normal [W/m2]", ylabel="diffuse horizontal [W/m2]")
    share = days.coverage(hours, site, weather).irradiance_percent
    title = f"{site.name}: {share:.0f} % of the year's daylight hours have skies like the plan's"
    axes.set_title(title, fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=8, loc="upper right")
    plot_style.open_axes(axes)
    return figure


def _sheet(
    day: date, slots: list[Slot], setup: SiteFile, cost: tuple[float, float], so_far: int
) -> dict[str, object]:
    """Return the texts of a day's sheet, by the names of the template sheet.html.j2.

    slots: of the day; cost: seconds and megabytes of one slot; so_far: number of slots up to the
    day's end.
    """
    zone = ZoneInfo(setup.site.timezone)
    tags = sorted({tag for slot in slots for tag in slot.tags if tag in days.SEASON_TAGS})
    exposures, (each_s, megabytes) = slots[0].exposures, cost
    today = sun.rise_transit_set(day, setup.site)
    times = {"Sunrise": today.rise, "sunset": today.set}
    shown = [f"{name} {t.astimezone(zone):%H:%M}" for name, t in times.items() if t]
    return {
        "date": f"{day:%A %d %B %Y}".replace(" 0", " "),
        "season": " ".join(tags).replace("-", " ").capitalize(),
        "rise_and_set": ", ".join(shown) or "The sun neither rises nor sets today",
        "clock_change": [
            f"{change.total_seconds() / 3600:+g} h at {t.astimezone(zone):%H:%M %Z}"
            for t, change in sun.clock_changes(day, day, setup.site.timezone)
        ],
        "rows": [_row(slot, slot.t_utc.astimezone(zone), day) for slot in slots],
        "exposures": [exposure_text(exposure).replace(" ", " s ", 1) for exposure in exposures],
        "same_exposures": all(slot.exposures == exposures for slot in slots),
        "each": f"{each_s:.0f} s" if each_s < 90 else f"{each_s / 60:.1f} min",
        "size_is_known": "profile" not in setup.camera.assumed,
        "gigabytes": f"{len(slots) * megabytes / 1000:.1f}",
        "gigabytes_so_far": f"{so_far * megabytes / 1000:.1f}",
        "sun_path": plot_style.svg_of(sky_chart(days.hours_of(slots), setup, day)),
    }


def _row(slot: Slot, local: datetime, day: date) -> dict[str, object]:
    """Return the texts of a slot's row in a sheet, by the names of the template sheet.html.j2.

    local: the slot's time in the site's zone; day: local standard date of the sheet.
    """
    return {
        "local": f"{local:%H:%M}",
        "zone": f"{local:%Z}",
        "weekday": "" if local.date() == day else f"{local:%a %d}",
        "utc": f"{slot.t_utc:%H:%M}",
        "altitude": f"{slot.sun_altitude_deg:.0f}",
        "azimuth": f"{slot.sun_azimuth_deg:.0f}",
        "tags": [tag.replace("-", " ") for tag in slot.tags if tag not in days.SEASON_TAGS],
    }


def sky_chart(hours: days.DaylightHours, setup: SiteFile, day: date | None = None) -> Figure:
    """Return a sky chart (north up, east right) of planned suns and the sun's paths by season.

    hours: the planned ones. day: adds the path of that day, the wall clock at every second planned
    sun, and marks in the directions of the camera's headings; None: adds the year's sun band, in
    another colour where a planned sun is near (Figure 15 of Liu, Colburn and Inanici 2020). A chart
    of azimuth against altitude would fail in the tropics, where the sun passes the zenith on either
    side.
    """
    site, camera = setup.site, setup.camera
    year = (day or (hours.t_utc[0] if len(hours) else datetime.now(UTC))).year
    figure = plot_style.new_figure(3.6, 3.6)
    axes: Any = figure.add_subplot(projection="polar")
    axes.set(theta_offset=np.pi / 2, theta_direction=-1, rlim=(0, 90), facecolor="#fdf8ec")
    axes.set_xticks(np.radians([0, 90, 180, 270]), ["N", "E", "S", "W"])
    axes.set_yticks([30, 60], ["60", "30"], size=7, color=PALE)
    axes.grid(color=GRID)
    if day is None:
        directions = days.band_directions(site, 16)
        altitude, azimuth = projection.altitude_azimuth_deg(directions)
        near = days.near_planned(directions, hours)
        for part, colour in ((~near, SAND), (near, AMBER)):
            angle, zenith_deg = np.radians(azimuth[part]), 90 - altitude[part]
            axes.plot(angle, zenith_deg, "o", ms=3.5, mew=0, color=colour)
    elif "heading_deg" not in camera.assumed:
        for heading in camera.headings or (camera.heading_deg,):
            axes.plot(np.radians(heading), 85, marker=(3, 0, -heading), color=BLUE, gid="view")
    # March equinox, and both solstices
    paths = [(days.season_date(year, which, site), AMBER, 1.0) for which in (0, 1, 3)]
    for path_day, colour, width in [*paths, *([(day, RED, 2.0)] if day else [])]:
        midnight = sun.standard_midnight(path_day, site.timezone)
        at = sun.position([midnight + timedelta(minutes=10 * k) for k in range(145)], site)
        zenith_deg = np.where(at.altitude_deg > 0, 90 - at.altitude_deg, np.nan)
        axes.plot(np.radians(at.azimuth_deg), zenith_deg, color=colour, lw=width)
    points = (np.radians(hours.azimuth_deg), 90 - hours.altitude_deg)
    axes.plot(*points, "o", ms=5 if day else 2, color=RED)
    for t_utc, *point in [*zip(hours.t_utc, *points, strict=True)][::2] if day else ():
        label = f"{t_utc.astimezone(ZoneInfo(site.timezone)):%H:%M}"
        axes.annotate(label, point, (0, 5), textcoords="offset points", ha="center", size=7)
    return figure
