"""Choose days and hours of the capture sets, and compute what they cover of the year.

Slots are at hh:30 of local standard time while the sun is up.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta

import numpy as np

from fieldlum.core.arrays import Floats, Indices, Ints64, Mask
from fieldlum.core.errors import require_name
from fieldlum.core.records import Site, Slot
from fieldlum.sky import sun
from fieldlum.weather import Weather

# Sets of docs/planning.md: by name of sets of days their seasons (indices of `SEASON_TAGS`), and
# the number of days before and after each. `month` and `even` have none.
EVENT_SETS = {"9-day": ((0, 1, 3), 1), "12-day": ((0, 1, 2, 3), 1), "4-day": ((0, 1, 2, 3), 0)}
SEASON_TAGS = ("march-equinox", "june-solstice", "september-equinox", "december-solstice")


@dataclass(frozen=True, slots=True)
class DaylightHours:
    """Times with the sun above the horizon [n], and the sun's altitude and azimuth [n].

    t_utc: aware times. Angles are true, without refraction; the azimuth is clockwise from true
    north. A sequence of indices selects hours, as with an array.
    """

    t_utc: tuple[datetime, ...]
    altitude_deg: Floats
    azimuth_deg: Floats

    def __len__(self) -> int:
        return len(self.t_utc)

    def __getitem__(self, chosen: Iterable[int]) -> DaylightHours:
        index = [int(i) for i in chosen]
        times = tuple(self.t_utc[i] for i in index)
        return DaylightHours(times, self.altitude_deg[index], self.azimuth_deg[index])


def hours_of(slots: Sequence[Slot]) -> DaylightHours:
    """Return the times of slots, in their order, with the sun's angles that the plan states."""
    altitude = np.array([s.sun_altitude_deg for s in slots], float)
    azimuth = np.array([s.sun_azimuth_deg for s in slots], float)
    return DaylightHours(tuple(slot.t_utc for slot in slots), altitude, azimuth)


def daylight_hours(days: Iterable[date], site: Site) -> DaylightHours:
    """Return the hours of some days with the sun's centre above the horizon, in order of time.

    An hour is represented by its middle, hh:30 of local standard time. days: local standard dates;
    a repeated one counts once.
    """
    midnights = [sun.standard_midnight(day, site.timezone) for day in sorted(set(days))]
    times = tuple(t + timedelta(hours=hour + 0.5) for t in midnights for hour in range(24))
    at = sun.position(times, site)
    hours = DaylightHours(times, at.altitude_deg, at.azimuth_deg)
    return hours[np.flatnonzero(at.altitude_deg > 0)]


def span(first: date, count: int) -> list[date]:
    """Return the dates of `count` consecutive days, beginning with `first`."""
    return [first + timedelta(days=i) for i in range(count)]


def season_date(year: int, which: int, site: Site) -> date:
    """Return the local standard date of an equinox or solstice of the calendar `year`.

    which: 0 March equinox, 1 June solstice, 2 September equinox, 3 December solstice.
    """
    return sun.standard_date(sun.season(year, which), site.timezone)


def _event_dates(
    seasons: Sequence[int], margin: int, earliest: date, year: int | None, site: Site
) -> list[date]:
    """Return the local standard date of each equinox or solstice, in order of time.

    seasons: 0 March equinox, 1 June solstice, 2 September equinox, 3 December solstice. The dates
    are those of `year`; if it is None, the first that are at least `margin` days after `earliest`.
    """
    years = range(earliest.year, earliest.year + 3) if year is None else (year,)
    first = earliest + timedelta(days=margin) if year is None else date.min
    dates = ((season_date(k, which, site) for k in years) for which in seasons)
    # of each season, one of the three years, or the only date of `year`, is not before `first`
    return sorted(next(day for day in of_season if day >= first) for of_season in dates)


def days_of_set(
    name: str, site: Site, today: date, start: date | None, year: int | None, days: int | None
) -> list[date]:
    """Return the local standard dates of a capture set, in order of time.

    name: 4-day, 9-day, 12-day, month or even, as of `--set`; start, year, days: None if the
    user states none; today: the local standard date at the site.

    - 4-day: equinoxes and solstices; 12-day: with the days before and after; 9-day: the 12-day set
      without September. The days are of `year`; without a year they are the next that are not
      before `start`, or not before `today` without `start`.
    - month: a number of `days` (default 31) from `start`; without it, centred on the March equinox
      of `year`, or on the next March or September equinox with all days from `today` on.
    - even: a number of `days` (default 365) from `start`, else from 1 January of `year`, else from
      `today`.

    Raises InputError for another name.
    """
    require_name("capture_set", name, (*EVENT_SETS, "month", "even"))
    if name in EVENT_SETS:
        seasons, margin = EVENT_SETS[name]
        events = _event_dates(seasons, margin, start or today, year, site)
        return [day for e in events for day in span(e - timedelta(days=margin), 2 * margin + 1)]
    if name == "month":
        count = days or 31
        if start is not None:
            return span(start, count)
        equinoxes, half = (0,) if year is not None else (0, 2), count // 2
        middle = _event_dates(equinoxes, half, today, year, site)[0]
        return span(middle - timedelta(days=half), count)
    first = start or (date(year, 1, 1) if year is not None else today)
    return span(first, days or 365)


def season_tag(day: date, site: Site) -> str:
    """Return the tag of the equinox or solstice that is at most a day from `day`; "" without one.

    It is one of `SEASON_TAGS`. day: a local standard date.
    """
    for which, tag in enumerate(SEASON_TAGS):
        if abs((day - season_date(day.year, which, site)).days) <= 1:
            return tag
    return ""


def today_at(site: Site, now_utc: datetime) -> date:
    """Return the local standard date of `site` at the moment `now_utc`, an aware time."""
    return sun.standard_date(now_utc.astimezone(UTC), site.timezone)


# ----------------------------------------------------------------------------------------------
# what a plan covers

# A sun position is covered if a planned one is at most this far away. Chosen: hourly suns are 15
# deg apart.
NEAR_DEG = 10.0
# Size of the cells in which direct and diffuse irradiance (DNI, DHI) count as equal. Chosen, not
# measured.
CELL_WM2 = (100.0, 50.0)


@dataclass(frozen=True, slots=True)
class Coverage:
    """Shares of a year that a plan covers, in percent; None for shares that need a weather file.

    sun_band_percent: of the sky area that the sun crosses in a year, within 10 deg of a planned
    sun; irradiance_percent: of the weather's daylight hours that are in the same cell of 100 W/m2
    direct by 50 W/m2 diffuse irradiance as a planned hour; both_percent: of those also within 10
    deg of a planned sun.
    """

    sun_band_percent: float
    irradiance_percent: float | None = None
    both_percent: float | None = None


# ----------------------------------------------------------------------------------------------
# sun band


def band_directions(site: Site, declinations: int = 41) -> Floats:
    """Return directions spread evenly over the part of the sky that the sun crosses in a year.

    They are unit vectors (x east, y north, z up) [n, 3] above the horizon, at declinations from
    -23.44 to 23.44 deg, of which equal numbers stand for equal areas of the sky. declinations:
    number of different ones; each occurs at nine times as many hour angles.
    """
    steps = 2 * (np.arange(declinations) + 0.5) / declinations - 1
    sines = steps * np.sin(np.radians(sun.OBLIQUITY_DEG))  # equal steps have equal areas
    hour_angles = np.linspace(0, 2 * np.pi, 9 * declinations, endpoint=False)
    sine, hour = (grid.ravel() for grid in np.meshgrid(sines, hour_angles))
    cosine = np.sqrt(1.0 - sine**2)  # of the declination
    latitude = np.radians(site.latitude_deg)
    up = np.sin(latitude) * sine + np.cos(latitude) * cosine * np.cos(hour)
    north = np.cos(latitude) * sine - np.sin(latitude) * cosine * np.cos(hour)
    return np.stack([-cosine * np.sin(hour), north, up], axis=-1)[up > 0]


def sun_band_percent(hours: DaylightHours, site: Site) -> float:
    """Return the share [%] of the sun band that is within 10 deg (chosen) of the sun in any hour.

    The sun band is the part of the sky that the sun crosses in a year at the site; the share is of
    its area. hours: such as those of a plan; without hours the result is 0.
    """
    band = band_directions(site)
    return 100.0 * float(near_planned(band, hours).mean()) if len(band) else 0.0


def near_planned(directions: Floats, hours: DaylightHours) -> Mask:
    """Return a mask [n]: True for directions within 10 deg (chosen) of the sun in any hour.

    directions: unit vectors (x east, y north, z up), [n, 3]; hours: such as those of a plan.
    """
    planned = sun.direction(hours.altitude_deg, hours.azimuth_deg)
    return (directions @ planned.T).max(axis=1, initial=-1.0) >= np.cos(np.radians(NEAR_DEG))


# ----------------------------------------------------------------------------------------------
# irradiance


def _sky_cells(dni_wm2: Floats, dhi_wm2: Floats) -> Ints64:
    """Return the number of the cell of `CELL_WM2` in which each sky's irradiance is, [n].

    dni_wm2, dhi_wm2: direct and diffuse irradiance [n]; NaN counts as 0.
    """
    dni_cell = np.floor(np.nan_to_num(dni_wm2) / CELL_WM2[0])
    dhi_cell = np.floor(np.nan_to_num(dhi_wm2) / CELL_WM2[1])
    return (1000 * dni_cell + dhi_cell).astype(np.int64)


def coverage(hours: DaylightHours, site: Site, weather: Weather | None = None) -> Coverage:
    """Return the shares of a year that some planned hours cover.

    weather: a year of the site, with at least one hour of daylight. The shares of its daylight are
    None without weather, and without hours.
    """
    band = sun_band_percent(hours, site)
    if weather is None or not len(hours):
        return Coverage(band)
    at = sun.position(weather.t_utc, site)
    lit = (at.altitude_deg > 0) & (weather.dhi_wm2 > 0)
    planned = weather.at(hours.t_utc)
    has_weather = np.isfinite(planned.dni_wm2)
    planned_cells = _sky_cells(planned.dni_wm2[has_weather], planned.dhi_wm2[has_weather])
    same_sky = np.isin(_sky_cells(weather.dni_wm2[lit], weather.dhi_wm2[lit]), planned_cells)
    near = near_planned(sun.direction(at.altitude_deg[lit], at.azimuth_deg[lit]), hours)
    return Coverage(band, 100.0 * float(same_sky.mean()), 100.0 * float((same_sky & near).mean()))


# ----------------------------------------------------------------------------------------------
# hours that are spread evenly over suns and skies


# Irradiances that count as 1 in `even_hours`: DNI and DHI (Liu, Colburn and Inanici 2020).
_FULL_WM2 = (1100.0, 700.0)


def medoids(points: Floats, count: int, rng: np.random.Generator) -> Indices:
    """Return ascending indices of the points nearest to the centres of k-means clusters, [count].

    points : n points with k coordinates each, [n, k]; count : number of clusters; rng : of their
    first centres. For an empty cluster, the point furthest from its own centre is taken. All
    indices are returned if there are no more than `count` points.
    """
    from scipy.cluster.vq import kmeans2

    if count >= len(points):
        return np.arange(len(points))
    with warnings.catch_warnings():
        # Empty clusters are filled below.
        warnings.filterwarnings("ignore", message="One of the clusters is empty")
        centres, label = kmeans2(points, count, iter=30, minit="++", rng=rng)
    distance2 = ((points - centres[label]) ** 2).sum(axis=1)
    order = np.lexsort((distance2, label))  # by cluster, then by distance
    nearest = order[np.unique(label[order], return_index=True)[1]]
    furthest = np.argsort(-distance2)
    others = furthest[~np.isin(furthest, nearest)]
    return np.sort(np.concatenate([nearest, others[: count - len(nearest)]]))


def even_hours(
    hours: DaylightHours, weather: Weather | None, count: int, rng: np.random.Generator
) -> Indices:
    """Return ascending indices of at most `count` hours whose suns and skies are spread evenly.

    They are k-means medoids over sun direction, DNI and DHI (Liu, Colburn and Inanici 2020); hours
    without weather are not chosen. Without a `weather` year: over sun direction alone. rng : of the
    clusters.
    """
    suns = sun.direction(hours.altitude_deg, hours.azimuth_deg)  # [n, 3]
    if weather is None:
        return medoids(suns, count, rng)
    light = weather.at(hours.t_utc)
    with_weather = np.flatnonzero(np.isfinite(light.dni_wm2 + light.dhi_wm2))
    sky = np.stack([light.dni_wm2, light.dhi_wm2], axis=-1) / _FULL_WM2  # [n, 2]
    # Halve the direction, so that each of its axes has a range of one, as the irradiances have.
    points = np.concatenate([suns / 2, sky], axis=1)  # [n, 5]
    return with_weather[medoids(points[with_weather], count, rng)]
