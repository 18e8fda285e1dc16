"""Predict and judge some hours of a year in one process, as a unit of work."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32
from fieldlum.core.scheduler import WorkUnit
from fieldlum.learn.models import Fitted, load, read_config
from fieldlum.session import sha256
from fieldlum.sky.light import Light
from fieldlum.year.glare.contrast import ViewRegions
from fieldlum.year.glare.geometry import Views, panorama_views
from fieldlum.year.glare.metrics import DiscLight, dgp_with_disc, glare_directions, sun_per_lx
from fieldlum.year.glare.sources import SOURCE_CDM2
from fieldlum.year.glare.standards import dgp_uncertainty
from fieldlum.year.glare.unseen import (
    ViewCoverage,
    brightest_cdm2,
    unseen_dgp_bounds,
    view_coverage,
)
from fieldlum.year.predict.blocks import BLOCK, HourBlock, ModelRoom, blocks, room_of
from fieldlum.year.predict.maps import write_maps
from fieldlum.year.predict.melanopic import MelanopicYear, sun_shares

# Relative standard uncertainty of the disc's illuminance, for luminous efficacy and glass together.
# Not measured.
U_DISC = 0.05


def unseen_bounds(
    block: HourBlock, room: ModelRoom, coverage: ViewCoverage, figures: dict[str, Floats]
) -> tuple[Floats, Floats]:
    """Return the least and the largest DGP that unseen parts of the views allow, [k, d] each.

    An unseen part gets one luminance between 0 and the larger of the sky's mean luminance and the
    luminance exceeded in the brightest hundredth of the seen solid angle. For views without unseen
    pixels both results are the DGP itself. figures: the result of `view_figures`.
    """
    most = block.light.diffuse_lx / np.pi
    if room.seen is not None and coverage.partly.any():
        most = np.maximum(most, brightest_cdm2(block.prediction.luminance_cdm2, room.seen))
    return unseen_dgp_bounds(coverage, figures["ev_lx"], figures["contrast"], most)


def hour_figures(block: HourBlock) -> dict[str, Array]:
    """Return the figures of k hours that have no direction, by column of hourly.csv, [k] each.

    `disturbed_share` is missing, and `occupied` is 0, because they need more than the block.
    """
    light, predicted = block.light, block.prediction
    return {
        "dni_wm2": light.dni_wm2,
        "dhi_wm2": light.dhi_wm2,
        "sun_altitude_deg": light.sun_altitude_deg,
        "sun_azimuth_deg": light.sun_azimuth_deg,
        "disc_lx": block.disc_lx,
        "occupied": np.zeros(len(light)),
        "trusted": block.trusted.astype(float),
        "expected_log10_mse": predicted.expected_mse,
    }


def view_figures(
    block: HourBlock, room: ModelRoom, views: Views, regions: ViewRegions
) -> dict[str, Floats]:
    """Return the figures of k hours in d view directions, by column of hourly.csv, [k, d] each.

    `dgp_low` and `dgp_high` are missing; `u_dgp` has only the errors of the maps and of the visible
    disc's illuminance. All further keys of `glare_directions` are included.
    """
    maps = block.prediction.luminance_cdm2
    figures = glare_directions(
        maps,
        room.heading_deg,
        views.azimuths_deg,
        np.stack([block.light.shown_sun_direction, *(image.towards for image in block.images)]),
        np.stack([block.disc_lx, *(image.shown_lx for image in block.images)]),
        views=views,
    )
    figures["u_dgp"] = dgp_uncertainty(
        figures["ev_lx"], figures["contrast"], *relative_uncertainty(block, views, figures)
    )
    figures["melanopic_edi_lx_estimate"] = figures["ev_lx"]
    return figures | regions.ratios(maps)


def relative_uncertainty(
    block: HourBlock, views: Views, figures: dict[str, Floats]
) -> tuple[Floats, Floats]:
    """Return the relative standard uncertainty of Ev and of the sources' luminance, [k, d] each.

    They are NaN where the model does not state its error. Errors of the pixels of one picture count
    as fully correlated, because a model is often too bright or too dark on a complete wall. The
    disc has 5 %. figures: the result of `glare_directions`.
    """
    map_ev, map_source = _relative_of_map(block, views)
    share_ev = figures["sun_ev_lx"] / np.maximum(figures["ev_lx"], 1e-6)
    share = np.divide(
        figures["sun_contrast"],
        figures["contrast"],
        out=np.zeros_like(share_ev),
        where=figures["contrast"] > 0,
    )
    return (
        np.hypot((1.0 - share_ev) * map_ev, share_ev * U_DISC),
        np.hypot((1.0 - share) * map_source, share * U_DISC),
    )


def _relative_of_map(block: HourBlock, views: Views) -> tuple[Floats, Floats]:
    predicted = block.prediction
    shape = (len(predicted.trusted), len(views.azimuths_deg))
    if predicted.log10_sd is None:
        same = np.log(10.0) * np.sqrt(np.asarray(predicted.expected_mse, float))[:, None]
        return np.broadcast_to(same, shape), np.broadcast_to(same, shape)
    flat = predicted.luminance_cdm2.reshape(shape[0], -1)
    spread = np.float32(np.log(10.0)) * predicted.log10_sd.reshape(shape[0], -1)
    ev = flat @ views.illuminance
    ev_off = (flat * spread) @ views.illuminance
    power = np.where(flat > SOURCE_CDM2, flat, np.float32(0.0)) ** 2
    source, source_off = power @ views.illuminance, (power * spread) @ views.illuminance
    return (
        (ev_off / np.maximum(ev, 1e-6)).astype(float),
        np.divide(source_off, source, out=np.zeros_like(source), where=source > 0).astype(float),
    )


@dataclass(frozen=True, slots=True)
class _HoursJob:
    """The input of a worker, with folders relative to the unit's.

    `maps` is "", a folder or a URL.
    """

    model: str
    digest: str  # of the model's files
    start: int
    light: Light  # of the block
    azimuths_deg: tuple[float, ...]
    disc_lx: Floats  # [n]
    discs_lx: Floats  # [k, n]
    maps: str
    melanopic: MelanopicYear | None


@dataclass(frozen=True, slots=True)
class HourFigures:
    """Figures of n consecutive hours of a year, in d view directions.

    rows: index in the year of the first hour, from 0, and of the hour after the last; hours: as
    `hour_figures` returns them, [n] each; views: as `view_figures`, [n, d] each; least, most:
    bounds of DGP by unseen parts of the view [n, d]; drawn: DGP with the sun's disc as k random
    draws of its visibility show it [k, n, d].
    """

    rows: tuple[int, int]
    hours: dict[str, Array]
    views: dict[str, Floats]
    least: Floats
    most: Floats
    drawn: Floats32


@dataclass(frozen=True, slots=True)
class _Prepared:
    fitted: Fitted
    room: ModelRoom
    views: Views
    coverage: ViewCoverage
    regions: ViewRegions


def hour_units(
    model_folder: Path,
    light: Light,
    azimuths_deg: Sequence[float] | Floats,
    disc_lx: Floats,
    discs_lx: Floats,
    maps: str,
    melanopic: MelanopicYear | None = None,
) -> list[WorkUnit]:
    """Return the units of work of a year's n hours, with 64 hours each; the last may be shorter.

    azimuths_deg: view directions, clockwise from true north; disc_lx: illuminance of the sun's
    disc [n]; discs_lx: in k random draws of its visibility [k, n]; maps: folder or URL of the Zarr
    store of maps, "" to write none; melanopic: colours by the captures, None without any.
    """
    model = model_folder.resolve()
    local = Path(maps).resolve() if maps and "://" not in maps else None
    folder = model if local is None else Path(os.path.commonpath([model, local]))
    name = model.relative_to(folder).as_posix()
    files = tuple(
        f"{name}/{file}" for file in ("config.json", "weights.npz") if (model / file).is_file()
    )
    digest = " ".join(sha256(folder / file) for file in files)
    where = maps if local is None else local.relative_to(folder).as_posix()
    azimuths = tuple(float(a) for a in azimuths_deg)
    units = []
    for start in range(0, len(light), BLOCK):
        rows = slice(start, min(start + BLOCK, len(light)))
        discs = disc_lx[rows], discs_lx[:, rows]
        job = _HoursJob(name, digest, start, light[rows], azimuths, *discs, where, melanopic)
        text = f"hours-{rows.start}-{rows.stop}"
        units.append(WorkUnit(text, predict_hours, folder, job, files=files))
    return units


def predict_hours(folder: Path, job: _HoursJob) -> HourFigures:
    """Predict the hours of a unit and compute their glare; write the maps if `job.maps` is set.

    folder: that of the unit, to which the paths in `job` are relative.
    """
    ready = _prepared(folder / job.model, job.digest, job.azimuths_deg)
    room = ready.room
    (block,) = blocks(ready.fitted, room, job.light, job.disc_lx)
    figures = view_figures(block, room, ready.views, ready.regions)
    if job.melanopic is not None:
        ev_lx = figures["ev_lx"] - figures["sun_ev_lx"]
        shares = sun_shares(ready.fitted, room, block.light, ready.views, ev_lx)
        u_ev_rel, _ = relative_uncertainty(block, ready.views, figures)
        figures |= job.melanopic.figures(block.light, shares, figures, u_ev_rel)
    least, most = unseen_bounds(block, room, ready.coverage, figures)
    discs = job.discs_lx
    per_lx = sun_per_lx(block.light.shown_sun_direction, ready.views)
    drawn = dgp_with_disc(figures, per_lx, discs, drawn_images(block, ready.views, len(discs)))
    if job.maps:
        pictures = block.pictures_cdm2(room.heading_deg)
        write_maps(job.maps if "://" in job.maps else str(folder / job.maps), job.start, pictures)
    rows = (job.start, job.start + len(job.light))
    return HourFigures(rows, hour_figures(block), figures, least, most, drawn.astype(np.float32))


def drawn_images(block: HourBlock, views: Views, count: int) -> list[DiscLight]:
    """Return what 1 lx of each mirror's image adds to Ev and contrast, and `count` random draws.

    The draws are the image's illuminance in lx [count, n], or 0 where it is hidden. Draw i (from 0)
    shows it in the hours whose chance of a visible image exceeds (i + 0.5) / count.
    """
    draws = (np.arange(count)[:, None] + 0.5) / count
    return [
        (sun_per_lx(image.towards, views), np.where(draws < image.chance, image.normal_lx, 0.0))
        for image in block.images
    ]


@lru_cache(maxsize=1)
def _prepared(model_folder: Path, digest: str, azimuths_deg: tuple[float, ...]) -> _Prepared:
    """Load a model and its views once per process.

    `digest` identifies the content of the folder.
    """
    room = room_of(read_config(model_folder), model_folder)
    azimuths = np.array(azimuths_deg)
    views = panorama_views(room.height, room.width, room.heading_deg, azimuths)
    return _Prepared(
        load(model_folder),
        room,
        views,
        view_coverage(room.seen, views),
        ViewRegions(room.height, room.width, room.heading_deg, azimuths, room.seen),
    )
