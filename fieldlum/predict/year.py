"""One run of `predict`: model and weather in, a year of metrics out."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import NotEnoughDataError
from fieldlum.glare.contrast import ViewRegions, melanopic_edi_lx
from fieldlum.glare.geometry import Views, panorama_views, view_azimuths_deg
from fieldlum.glare.metrics import dgp_with_disc, glare_directions, sun_per_lx
from fieldlum.glare.sources import SOURCE_CDM2
from fieldlum.glare.standards import GlareDoubt, dgp_uncertainty
from fieldlum.glare.unseen import (
    ViewCoverage,
    brightest_cdm2,
    unseen_dgp_bounds,
    view_coverage,
)
from fieldlum.models import trusted_hours
from fieldlum.models.disc_in_view import (
    DRAWN_ROOMS,
    EDGE_SD_DEG,
    drawn_discs_lx,
    guessed_disc_lx,
)
from fieldlum.predict.annual import (
    HOUR_COLUMNS,
    VIEW_COLUMNS,
    Annual,
    write_about,
    write_hourly,
    write_pictures,
)
from fieldlum.predict.blocks import HourBlock, ModelRoom, blocks, room_of
from fieldlum.predict.checks import (
    already,
    begin_anew,
    check_session,
    default_folder,
    fitted_uncertainty,
    inputs_of,
)
from fieldlum.predict.glare_summary import about_year, judge, poor
from fieldlum.predict.maps import MapStore
from fieldlum.predict.occupancy import default_occupancy, occupied_hours, read_occupancy
from fieldlum.predict.pictures import telling_pictures
from fieldlum.records import Progress, quiet
from fieldlum.room_states import OFF

NORMAL_95 = 1.96  # standard deviations of a 95 % interval
U_DISC = (
    0.05  # relative standard uncertainty of the disc's illuminance: luminous efficacy and glass
)

if TYPE_CHECKING:
    from fieldlum.light import Light
    from fieldlum.models import Fitted
    from fieldlum.scene import RoomUncertainty
    from fieldlum.weather import Weather


class PredictedYear(NamedTuple):
    """What `run` did: the year, and whether it was computed now or read from its folder."""

    annual: Annual
    new: bool


def run(
    model_folder: Path,
    weather_path: Path,
    *,
    out: Path | None = None,
    maps: bool = False,
    views: int = 10,
    occupancy_path: Path | None = None,
    lamps: str = "",
    force: bool = False,
    seed: int = 0,
    label_shift_min: float = 0.0,
    progress: Progress = quiet,
) -> PredictedYear:
    """Predict all daylight hours of a weather file with a trained model; returns the year and
    whether it is new.

    lamps: "" as in the captures, "off", or a csv as for occupancy that says when lamps marked in
    the captures are on. Raises InputError for a broken model or weather, and for weather or a
    session of another place or camera than the model's; NotEnoughDataError for weather without
    daylight.
    """
    from fieldlum.models import load, read_config
    from fieldlum.weather import read_weather

    config = read_config(model_folder)
    room = room_of(config, model_folder)
    check_session(model_folder, room, config.state.get("scene"))
    folder = out or default_folder(model_folder)
    occupancy = default_occupancy() if occupancy_path is None else read_occupancy(occupancy_path)
    inputs = inputs_of(model_folder, weather_path, views, occupancy, maps, seed, label_shift_min)
    inputs |= {"lamps": lamps_text(lamps)} if lamps else {}
    if not force and (done := already(folder, inputs)) is not None:
        return PredictedYear(done, new=False)
    weather = read_weather(weather_path, room.setup.site, label_shift_min=label_shift_min)
    hours = weather.daylight()
    if len(hours) == 0:
        raise NotEnoughDataError(f"{weather_path}: no hour with the sun up and any irradiance")
    light = with_lamps(light_of(hours), lamps, room.setup.site.timezone)
    azimuths = view_azimuths_deg(room.heading_deg, views)
    fitted = load(model_folder)
    begin_anew(folder)
    annual, doubt, u_of_maps = measure(
        fitted,
        room,
        light,
        azimuths,
        folder,
        uncertainty=fitted_uncertainty(config, room),
        maps=maps,
        seed=seed,
        progress=progress,
    )
    zone = room.setup.site.timezone
    annual.hours["occupied"][:] = occupancy.at(annual.t_utc, zone)
    if poor(config):
        annual.hours["trusted"][:] = 0.0
    hours_used, days = occupied_hours(occupancy, weather.t_utc, weather.site)
    found = judge(annual, doubt, u_of_maps, hours_used, seed)
    annual.about.update(about_year(room, config, weather, inputs, occupancy, annual, found, days))
    # predict.json comes last: a folder that has it is whole.
    write_hourly(folder / "hourly.csv", annual, zone)
    write_pictures(folder / "pictures.npz", telling_pictures(fitted, room, light, annual))
    write_about(folder / "predict.json", annual.about)
    return PredictedYear(annual, new=True)


def light_of(weather: Weather) -> Light:
    from fieldlum.light import light_at

    return light_at(weather.t_utc, weather.site, weather.dni_wm2, weather.dhi_wm2)


def with_lamps(light: Light, lamps: str, timezone: str) -> Light:
    """Return `light` with the state of the lamps in each hour; see `run`."""
    if not lamps:
        return light
    if lamps == "off":
        return replace(light, states=(OFF,) * len(light))
    on = read_occupancy(Path(lamps)).at(light.t_utc, timezone)  # [n]
    return replace(light, states=tuple("lamp=on" if lit else OFF for lit in on))


def lamps_text(lamps: str) -> str:
    """Return what predict.json records of the lamps: "off", or the schedule in words."""
    return lamps if lamps in ("", "off") else read_occupancy(Path(lamps)).text


# ----------------------------------------------------------------------------------------------
# measuring


def measure(
    fitted: Fitted,
    room: ModelRoom,
    light: Light,
    azimuths_deg: NDArray[np.float64],
    folder: Path,
    *,
    uncertainty: RoomUncertainty | None = None,
    maps: bool = False,
    seed: int = 0,
    progress: Progress = quiet,
) -> tuple[Annual, GlareDoubt, NDArray[np.float64]]:
    """Predict every hour in blocks and keep its figures; with `maps`, the maps too.

    Figures of directions that no lens saw are NaN. The doubt is of all hours; last comes the
    standard uncertainty of DGP by the maps alone, [n, d].
    """
    count, d = len(light), len(azimuths_deg)
    views = panorama_views(room.height, room.width, room.heading_deg, azimuths_deg)
    coverage = view_coverage(room.seen, views)
    regions = ViewRegions(room.height, room.width, room.heading_deg, azimuths_deg, room.seen)
    hours = {name: np.full(count, np.nan) for name in HOUR_COLUMNS}
    figures = {name: np.full((count, d), np.nan) for name in VIEW_COLUMNS}
    rng = np.random.default_rng([seed, 2])
    discs_lx = drawn_discs_lx(room.setup, light, rng, uncertainty=uncertainty)  # [k, n]
    turns_deg = rng.normal(0.0, EDGE_SD_DEG, (DRAWN_ROOMS, 2))
    drawn = np.empty((DRAWN_ROOMS, count, d), np.float32)
    least, most = np.full((count, d), np.nan), np.full((count, d), np.nan)
    folder.mkdir(parents=True, exist_ok=True)
    about = {"site": room.setup.site.name}
    store = (
        MapStore(folder / "maps.zarr", room.height, room.width, room.heading_deg, about)
        if maps
        else nullcontext()
    )
    with store as kept:
        for block in blocks(fitted, room, light, progress=progress):
            for name, values in _hour_figures(block).items():
                hours[name][block.rows] = values
            found = view_figures(block, room, views, regions)
            least[block.rows], most[block.rows] = _unseen_bounds(block, room, coverage, found)
            some = (
                guessed_disc_lx(
                    block.prediction.luminance_cdm2, block.light, room.heading_deg, turns_deg
                )
                if discs_lx is None
                else discs_lx[:, block.rows]
            )
            per_lx = sun_per_lx(block.light.sun_direction, views)
            drawn[:, block.rows] = dgp_with_disc(found, per_lx, some)
            for name in VIEW_COLUMNS.keys() & found.keys():
                figures[name][block.rows] = found[name]
            if kept is not None:
                kept.append(block)
    u_of_maps = figures["u_dgp"]
    off = drawn - figures["dgp"].astype(np.float32)  # [k, n, d]
    reach = NORMAL_95 * np.nan_to_num(u_of_maps)
    low, high = np.percentile(off, (2.5, 97.5), axis=0)
    figures["dgp_low"] = np.clip(least + np.minimum(low, 0.0) - reach, 0.0, 1.0)
    figures["dgp_high"] = np.clip(most + np.maximum(high, 0.0) + reach, 0.0, 1.0)
    figures["u_dgp"] = np.hypot(u_of_maps, np.sqrt((off**2).mean(axis=0)))
    for values in figures.values():
        values[:, ~coverage.judged] = np.nan
    annual = Annual(folder, {}, light.t_utc, np.asarray(azimuths_deg, float), hours, figures)
    return annual, GlareDoubt(coverage.words, least, most, drawn), u_of_maps


def _unseen_bounds(
    block: HourBlock,
    room: ModelRoom,
    coverage: ViewCoverage,
    found: dict[str, NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """DGP with the least and the most light in the unseen part of each view, [k, d] each.

    The most is the mean luminance of the sky, as a window there would show it, or the brightest
    hundredth of what was seen.
    """
    most = block.light.diffuse_lx / np.pi
    if room.seen is not None and coverage.partly.any():
        most = np.maximum(most, brightest_cdm2(block.prediction.luminance_cdm2, room.seen))
    return unseen_dgp_bounds(coverage, found["ev_lx"], found["contrast"], most)


def _hour_figures(block: HourBlock) -> dict[str, NDArray[Any]]:
    light, told = block.light, block.prediction
    return {
        "dni_wm2": light.dni_wm2,
        "dhi_wm2": light.dhi_wm2,
        "sun_altitude_deg": light.sun_altitude_deg,
        "sun_azimuth_deg": light.sun_azimuth_deg,
        "disc_lx": block.disc_lx,
        "occupied": np.zeros(len(light)),
        "trusted": trusted_hours(told).astype(float),
        "expected_log10_mse": told.expected_mse,
    }


def view_figures(
    block: HourBlock, room: ModelRoom, views: Views, regions: ViewRegions
) -> dict[str, NDArray[np.float64]]:
    """`VIEW_COLUMNS` of a block and the contrast sums behind DGP, [k, d] each."""
    maps = block.prediction.luminance_cdm2
    found = glare_directions(
        maps,
        room.heading_deg,
        views.azimuths_deg,
        block.light.sun_direction,
        block.disc_lx,
        views=views,
    )
    found["u_dgp"] = dgp_uncertainty(
        found["ev_lx"], found["contrast"], *_relative(block, views, found)
    )
    found["melanopic_edi_lx_estimate"] = melanopic_edi_lx(found["ev_lx"])
    return found | regions.ratios(maps)


def _relative(
    block: HourBlock, views: Views, found: dict[str, NDArray[np.float64]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Relative standard uncertainty of Ev and of the sources' luminance, [k, d]; NaN where the
    model says nothing.

    Pixels of one picture are taken to err together: a model is too bright or too dark in all of a
    wall. The disc has an uncertainty of its own.
    """
    map_ev, map_source = _relative_of_map(block, views)
    share_ev = found["sun_ev_lx"] / np.maximum(found["ev_lx"], 1e-6)
    share = np.divide(
        found["sun_contrast"],
        found["contrast"],
        out=np.zeros_like(share_ev),
        where=found["contrast"] > 0,
    )
    return (
        np.hypot((1.0 - share_ev) * map_ev, share_ev * U_DISC),
        np.hypot((1.0 - share) * map_source, share * U_DISC),
    )


def _relative_of_map(
    block: HourBlock, views: Views
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    told = block.prediction
    shape = (len(told.trusted), len(views.azimuths_deg))
    if told.log10_sd is None:
        same = np.log(10.0) * np.sqrt(np.asarray(told.expected_mse, float))[:, None]
        return np.broadcast_to(same, shape), np.broadcast_to(same, shape)
    flat = told.luminance_cdm2.reshape(shape[0], -1)
    spread = np.float32(np.log(10.0)) * told.log10_sd.reshape(shape[0], -1)
    ev = flat @ views.illuminance
    ev_off = (flat * spread) @ views.illuminance
    power = np.where(flat > SOURCE_CDM2, flat, np.float32(0.0)) ** 2
    source, source_off = power @ views.illuminance, (power * spread) @ views.illuminance
    return (
        (ev_off / np.maximum(ev, 1e-6)).astype(float),
        np.divide(source_off, source, out=np.zeros_like(source), where=source > 0).astype(float),
    )
