"""Compute how much of a year's light a plan covers: suns, and direct with diffuse irradiance."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.plot_style import AMBER, INK, RED, SAND, open_axes
from fieldlum.core.records import Site
from fieldlum.plan.days import DaylightHours
from fieldlum.sky import sun
from fieldlum.weather import Weather

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# A sun position is covered if a planned one is at most this far away. Chosen: hourly suns are 15
# deg apart.
NEAR_DEG = 10.0
# Size of the cells in which direct and diffuse irradiance count as equal. Chosen, not measured.
DNI_CELL_WM2 = 100.0
DHI_CELL_WM2 = 50.0
OBLIQUITY_DEG = 23.44  # of the ecliptic, in this century (IAU)
LINE = "#8a96a3"


@dataclass(frozen=True, slots=True)
class Coverage:
    """Shares of a year that a plan covers, in percent; None for shares that need a weather file.

    sun_band_percent: of the sky area that the sun crosses in a year, within 10 deg of a planned
    sun; irradiance_percent: of the weather's daylight hours that are in the same cell of 100 W/m2
    direct by 50 W/m2 diffuse irradiance as a planned hour; both_percent: of those also within 10
    deg of a planned sun.
    """

    # area of the band of sun positions that are within NEAR_DEG of a planned one
    sun_band_percent: float
    # weather hours in a cell of DNI and DHI with a planned hour
    irradiance_percent: float | None = None
    both_percent: float | None = None  # weather hours covered in both ways


# ----------------------------------------------------------------------------------------------
# sun band


def band_directions(site: Site) -> Floats:
    """Return directions spread evenly over the sky band of the sun, [n, 3].

    They are unit vectors (x east, y north, z up) with declinations from -23.44 to 23.44 deg, above
    the horizon.
    """
    sine = np.sin(np.radians(OBLIQUITY_DEG)) * (2 * (np.arange(41) + 0.5) / 41 - 1)
    turn = 2 * np.pi * np.arange(360) / 360
    declination, hour = (grid.ravel() for grid in np.meshgrid(np.arcsin(sine), turn, indexing="ij"))
    latitude = np.radians(site.latitude_deg)
    up = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(
        hour
    )
    north = np.cos(latitude) * np.sin(declination) - np.sin(latitude) * np.cos(
        declination
    ) * np.cos(hour)
    east = -np.cos(declination) * np.sin(hour)
    return np.stack([east, north, up], axis=-1)[up > 0]


def sun_band_percent(hours: DaylightHours, site: Site) -> float:
    """Return the percentage of the sky band of the sun that is within 10 deg of an hour's sun.

    The band is that of `band_directions`, weighted by area. Without hours the result is 0.
    """
    band = band_directions(site)
    if not len(hours) or not len(band):
        return 0.0
    return 100.0 * float(_near(band, sun.direction(hours.altitude_deg, hours.azimuth_deg)).mean())


def _near(directions: Floats, planned: Floats) -> Mask:
    return (directions @ planned.T).max(axis=1) >= np.cos(np.radians(NEAR_DEG))


# ----------------------------------------------------------------------------------------------
# irradiance


def _cells(dni_wm2: ArrayLike, dhi_wm2: ArrayLike) -> NDArray[np.int64]:
    dni = np.floor(np.nan_to_num(np.asarray(dni_wm2, float)) / DNI_CELL_WM2).astype(np.int64)
    dhi = np.floor(np.nan_to_num(np.asarray(dhi_wm2, float)) / DHI_CELL_WM2).astype(np.int64)
    return dni * 1000 + dhi


def coverage(hours: DaylightHours, site: Site, weather: Weather | None = None) -> Coverage:
    """Return how much of the year's sun band some hours cover; with weather, also of its daylight.

    The shares by weather are None without hours, too.
    """
    band = sun_band_percent(hours, site)
    if weather is None or not len(hours):
        return Coverage(band)
    at = sun.position(weather.t_utc, site)
    lit = (at.altitude_deg > 0) & (weather.dhi_wm2 > 0)
    _, planned_dni, planned_dhi = weather.at(hours.t_utc)
    has_weather = np.isfinite(planned_dni)
    captured = np.isin(
        _cells(weather.dni_wm2[lit], weather.dhi_wm2[lit]),
        _cells(planned_dni[has_weather], planned_dhi[has_weather]),
    )
    suns = sun.direction(at.altitude_deg[lit], at.azimuth_deg[lit])
    near = _near(suns, sun.direction(hours.altitude_deg, hours.azimuth_deg))
    return Coverage(band, 100.0 * float(captured.mean()), 100.0 * float((captured & near).mean()))


# ----------------------------------------------------------------------------------------------
# plots


def sun_figure(hours: DaylightHours, site: Site) -> Figure:
    """Draw the band of sun positions on a sky chart, north up and east right, with planned suns.

    Parts of the band within 10 deg of a planned sun have another colour. As Figure 15 of Liu,
    Colburn and Inanici (2020). A chart of azimuth against altitude would fail in the tropics, where
    the sun passes the zenith on either side.
    """
    from matplotlib.figure import Figure

    year = hours.t_utc[0].year if len(hours) else datetime.now(UTC).year
    figure = Figure(figsize=(7.2, 4.0), layout="constrained")
    axes: Any = figure.add_subplot(projection="polar")
    axes.set_theta_zero_location("N")
    axes.set_theta_direction(-1)
    band = band_directions(site)
    altitude, azimuth = np.degrees(np.arcsin(band[:, 2])), np.arctan2(band[:, 0], band[:, 1])
    reached = (
        _near(band, sun.direction(hours.altitude_deg, hours.azimuth_deg))
        if len(hours)
        else altitude < 0
    )
    for part, colour, label in (
        (~reached, SAND, "not reached"),
        (reached, AMBER, f"within {NEAR_DEG:g} deg"),
    ):
        axes.scatter(
            azimuth[part],
            90 - altitude[part],
            s=7,
            c=colour,
            linewidths=0,
            label=label,
            rasterized=True,
        )
    for which, label in ((1, "June solstice"), (0, "equinoxes"), (3, "December solstice")):
        arc_azimuth, arc_altitude = day_arc(
            sun.standard_date(sun.season(year, which), site.timezone), site
        )
        axes.plot(np.radians(arc_azimuth), 90 - arc_altitude, color=INK, linewidth=0.6)
        if np.isfinite(arc_altitude).any():
            top = int(np.nanargmax(arc_altitude))
            at = float(np.radians(arc_azimuth[top])), float(90 - arc_altitude[top])
            axes.annotate(
                label,
                at,
                (0, 3),
                textcoords="offset points",
                ha="center",
                va="bottom",
                color=INK,
                fontsize=7,
            )
    axes.scatter(
        np.radians(hours.azimuth_deg),
        90 - hours.altitude_deg,
        s=9,
        color=RED,
        linewidths=0,
        label="planned",
    )
    axes.set_ylim(0, 90)
    axes.set_yticks((30, 60), ("60", "30"), fontsize=7, color=LINE)
    axes.set_xticks(np.radians(range(0, 360, 45)), ("N", "", "E", "", "S", "", "W", ""))
    axes.tick_params(colors=INK, labelsize=8)
    axes.tick_params(axis="y", colors=LINE)
    axes.grid(color=LINE, linewidth=0.4)
    axes.spines["polar"].set_color(LINE)
    reach = f"{len(hours)} captures reach {100 * reached.mean():.0f} % of the year's sun band"
    figure.suptitle(f"{site.name}: {reach}", fontsize=10, x=0.01, ha="left")
    figure.legend(frameon=False, fontsize=8, markerscale=2, loc="outside right upper")
    return figure


def day_arc(day: date, site: Site) -> tuple[Floats, Floats]:
    """Return azimuth and altitude [deg] of the sun every ten minutes of a day, [145] each.

    The day begins and ends at midnight of local standard time. NaN while the sun is down.
    """
    start = sun.standard_midnight(day, site.timezone)
    at = sun.position([start + timedelta(minutes=10 * k) for k in range(145)], site)
    up = at.altitude_deg > 0
    return np.where(up, at.azimuth_deg, np.nan), np.where(up, at.altitude_deg, np.nan)


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
    bins = (
        np.arange(0, 1150, DNI_CELL_WM2 / 2),
        np.arange(0, max(float(dhi.max()), 500) + 25, DHI_CELL_WM2 / 2),
    )
    *_, picture = axes.hist2d(dni, dhi, bins=bins, norm=LogNorm(), cmap="YlOrBr", rasterized=True)
    bar = figure.colorbar(picture, ax=axes)
    bar.set_label("hours per year in a cell", fontsize=8)
    bar.ax.tick_params(labelsize=8)
    planned = weather.at(hours.t_utc)
    axes.scatter(
        planned.dni_wm2,
        planned.dhi_wm2,
        s=9,
        color=INK,
        linewidths=0,
        label="planned, with the weather year's light",
    )
    axes.set_xlabel("direct normal [W/m2]", fontsize=8)
    axes.set_ylabel("diffuse horizontal [W/m2]", fontsize=8)
    covered = coverage(hours, site, weather)
    title = (
        f"{site.name}: {covered.irradiance_percent:.0f} % of the year's daylight hours have skies "
        f"like those of the plan"
    )
    axes.set_title(title, fontsize=10, loc="left")
    axes.legend(frameon=False, fontsize=8, loc="upper right")
    open_axes(axes)
    return figure
