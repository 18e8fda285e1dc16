"""Run `predict`: from a model and weather to a year of figures."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Progress, quiet
from fieldlum.core.room_states import OFF
from fieldlum.core.scheduler import LOCAL, Scheduler
from fieldlum.learn.models import Fitted, load, read_config
from fieldlum.session import Session, check_writable, sha256
from fieldlum.session.bucket import check_url
from fieldlum.session.files.hourly_csv import COLOUR_COLUMNS, VIEW_COLUMNS, HourlyFile
from fieldlum.session.files.predict_json import PredictFile
from fieldlum.session.files.sidecar import newest_sidecar
from fieldlum.sky.light import Light, light_at
from fieldlum.sky.sky_view import SkyView
from fieldlum.sky.sun import standard_date
from fieldlum.weather import Weather, read_weather
from fieldlum.year.glare.budget import BUDGET_FILE, write_budgets, year_budget
from fieldlum.year.glare.geometry import view_azimuths_deg
from fieldlum.year.glare.metrics import METRICS
from fieldlum.year.glare.standards import dgp_per_scale, protection
from fieldlum.year.predict.annual import Annual, Pictures, write_pictures
from fieldlum.year.predict.blocks import ModelRoom, blocks, room_of
from fieldlum.year.predict.checks import (
    already,
    check_session,
    default_folder,
    delete_earlier_year,
    inputs_of,
    session_folder,
)
from fieldlum.year.predict.glare_summary import best_and_worst, poor, summary_of_year
from fieldlum.year.predict.hours_unit import measure
from fieldlum.year.predict.maps import MapStore
from fieldlum.year.predict.melanopic import has_colour, year_of_captures
from fieldlum.year.predict.occupancy import default_occupancy, occupied_hours, read_occupancy


def telling_hours(annual: Annual, zone: str) -> Iterator[tuple[str, int]]:
    """Yield the name of each hour to show in the report, and its index in the year, from 0.

    These are the hours with the median, the 95th percentile and the highest DGP of the occupied
    hours (all hours if none is occupied), first for the direction with the most glare, then for
    that with the least; and the hours of one clear day. An hour can occur twice.
    """
    used = np.flatnonzero(annual.occupied) if annual.occupied.any() else np.arange(len(annual))
    dgp = annual.views["dgp"][used]
    ends = best_and_worst(annual.summary.protection)
    for name, row in () if ends is None else (("worst", ends[1]), ("best", ends[0])):
        direction = int(np.argmin(np.abs(annual.azimuths_deg - row.azimuth_deg)))
        order = used[np.argsort(dgp[:, direction], kind="stable")]
        for share, kind in ((0.5, "typical"), (0.95, "p95"), (1.0, "highest")):
            hour = order[min(int(share * len(order)), len(order) - 1)]
            yield f"{kind} of {name} view {annual.azimuths_deg[direction]:g}", int(hour)
    for row in clear_day(annual, zone):
        yield "clear day", int(row)


def clear_day(annual: Annual, zone: str) -> NDArray[np.int64]:
    """Return the indices, from 0, of the daylight hours of one sunny day, [k].

    It is the day with the most direct normal irradiation among 28 February to 11 April, or among
    all days if the year has no hours then. zone: time zone, whose standard time separates the days.
    """
    days = np.array([standard_date(t, zone).timetuple().tm_yday for t in annual.t_utc])
    near = np.abs(days - 80) <= 21
    pool = np.unique(days[near]) if near.any() else np.unique(days)
    sunniest = max(pool, key=lambda day: float(annual.hours["dni_wm2"][days == day].sum()))
    return np.flatnonzero(days == sunniest)


def telling_pictures(fitted: Fitted, room: ModelRoom, light: Light, annual: Annual) -> Pictures:
    """Return the maps of `telling_hours`, in that order, predicted again.

    The maps are not stored before, because all maps of a year would need a gigabyte of memory.
    """
    chosen = list(telling_hours(annual, room.setup.site.timezone))
    rows = np.array(sorted({row for _, row in chosen}), np.int64)
    parts = list(blocks(fitted, room, light[rows]))
    maps = np.concatenate([block.pictures_cdm2(room.heading_deg) for block in parts])
    disc = np.concatenate([block.disc_lx for block in parts])
    at = [int(np.searchsorted(rows, row)) for _, row in chosen]
    return Pictures(
        tuple(kind for kind, _ in chosen), rows[at], maps[at], disc[at], room.heading_deg
    )


class PredictedYear(NamedTuple):
    """Result of `run`: the year, and whether it was computed now or already existed."""

    annual: Annual
    new: bool


def run(
    model_folder: Path,
    weather_path: Path,
    *,
    out: Path | None = None,
    maps: bool = False,
    maps_to: str = "",
    views: int = 10,
    occupancy_path: Path | None = None,
    lamps: str = "",
    sky_view: Path | None = None,
    force: bool = False,
    seed: int = 0,
    label_shift_min: float = 0.0,
    scheduler: Scheduler = LOCAL,
    progress: Progress = quiet,
) -> PredictedYear:
    """Predict all daylight hours of a weather file with a trained model, and write the year.

    A year with the same inputs that exists in the output folder is returned instead, unless
    `force`.

    out: output folder; None: `default_folder`. views: number of view directions around the horizon.
    maps: also write all maps; maps_to: URL of a bucket for them, for example s3://BUCKET/FOLDER; ""
    for none. lamps: "" as in the captures; "off"; or a csv as for occupancy, with the hours in
    which lamps that are marked in the captures are on. sky_view: a sky_view.exr in place of the
    model's. label_shift_min: minutes added to the times of the weather file.

    Raises InputError for a file, folder, URL or model that cannot be used, or if place, camera,
    room or pictures of model and session differ; NotEnoughDataError for weather without daylight or
    without occupied hours; FloatingPointError if a map is not finite.
    """
    config = read_config(model_folder)
    room = room_of(config, model_folder)
    check_session(model_folder, room, config.scene)
    folder = out or default_folder(model_folder)
    occupancy = default_occupancy() if occupancy_path is None else read_occupancy(occupancy_path)
    inputs = inputs_of(model_folder, weather_path, views, occupancy, maps, seed, label_shift_min)
    if sky_view is not None:
        room = replace(room, sky_view=SkyView.read(sky_view), sky_view_file=sky_view.name)
        inputs["sky_view_sha256"] = sha256(sky_view)
    if maps_to:
        check_url(maps_to, "--maps-to", "use --maps")
        inputs["maps_to"] = maps_to
    inputs |= {"lamps": lamps_text(lamps)} if lamps else {}
    root = session_folder(model_folder)
    pairs = None if root is None else Session(root).pairs
    coloured = pairs if pairs is not None and has_colour(pairs) else None
    inputs |= {"melanopic": "colour"} if coloured else {}
    if not force and (existing := already(folder, inputs)) is not None:
        return PredictedYear(existing, new=False)
    check_writable(folder)
    weather = read_weather(weather_path, room.setup.site, label_shift_min=label_shift_min)
    hours = weather.daylight()
    if len(hours) == 0:
        raise NotEnoughDataError(
            f"{weather_path}: no hour with irradiance while the sun "
            "is up; check the file's irradiance and time zone"
        )
    zone = room.setup.site.timezone
    light = with_lamps(light_of(hours), lamps, zone)
    azimuths = view_azimuths_deg(room.heading_deg, views)
    hours_used, days = occupied_hours(occupancy, weather.t_utc, weather.site)
    delete_earlier_year(folder)
    folder.mkdir(parents=True, exist_ok=True)
    colours = year_of_captures(coloured, room, azimuths) if coloured else None
    store = MapStore(folder, maps_to, inputs) if maps or maps_to else None
    if store:
        store.create(light.t_utc, room)
    found = measure(
        model_folder,
        room,
        light,
        azimuths,
        maps=store.target if store else "",
        melanopic=colours,
        seed=seed,
        scheduler=scheduler,
        progress=progress,
    )
    found.hours["trusted"] *= not poor(config)
    if store:
        store.finish(found.hours["disc_lx"], found.hours["trusted"])
    used = occupancy.at(light.t_utc, zone)
    found.hours["occupied"][:] = used
    empty = {name: np.full(found.doubt.u_maps.shape, np.nan) for name in COLOUR_COLUMNS}
    columns = {*VIEW_COLUMNS, *(name for name, metric in METRICS.items() if metric.in_year)}
    figures = {name: v for name, v in (empty | found.views).items() if name in columns}
    annual = Annual(folder, PredictFile(), light.t_utc, azimuths, found.hours, figures)
    rng, doubt = np.random.default_rng(seed), found.doubt.hours(used)
    dgp, ev_lx = figures["dgp"][used], figures["ev_lx"][used]
    u_scale = 0.0 if root is None else scale_u_rel(Session(root))
    of_scale = u_scale * dgp_per_scale(dgp, ev_lx)
    rows = protection(dgp, doubt, hours_used, azimuths, rng, of_scale)
    summary = summary_of_year(
        room, config, weather, inputs, occupancy, annual, rows, hours_used, days
    )
    annual = replace(annual, summary=summary)
    table = HourlyFile(annual.t_utc, annual.azimuths_deg, annual.hours, annual.views)
    table.write(folder, zone)
    pictures = telling_pictures(load(model_folder), room, light, annual)
    write_pictures(folder / "pictures.npz", pictures)
    budgets = year_budget(dgp, ev_lx, doubt, hours_used, azimuths, u_scale)
    write_budgets(folder / BUDGET_FILE, ((folder.name, budget) for budget in budgets))
    summary.write(folder)  # the last file, so that a folder with it is complete
    return PredictedYear(annual, new=True)


def scale_u_rel(session: Session) -> float:
    """Return the relative standard uncertainty that the scale of all captures shares.

    It is that of the camera's scale and colour in the newest panorama; 0 if no panorama states it.
    """
    sidecar = newest_sidecar(session)
    percents = {} if sidecar is None else sidecar.factors.get("u_percent", {})
    return float(np.hypot(percents.get("k", 0.0), percents.get("colour", 0.0))) / 100


def light_of(weather: Weather) -> Light:
    """Return the sun's position and the light of all hours of `weather`, in their order."""
    return light_at(weather.t_utc, weather.site, weather.dni_wm2, weather.dhi_wm2)


def with_lamps(light: Light, lamps: str, timezone: str) -> Light:
    """Return `light` with lamps as captured (""), "off", or on in the hours of a csv `lamps`.

    The csv has the form that `read_occupancy` reads, which raises InputError. timezone: of the
    room.
    """
    if not lamps:
        return light
    if lamps == "off":
        return replace(light, states=(OFF,) * len(light))
    on = read_occupancy(Path(lamps)).at(light.t_utc, timezone)  # [n]
    return replace(light, states=tuple("lamp=on" if lit else OFF for lit in on))


def lamps_text(lamps: str) -> str:
    """Return the text on lamps for predict.json: `lamps` if "" or "off", else its schedule."""
    return lamps if lamps in ("", "off") else read_occupancy(Path(lamps)).text
