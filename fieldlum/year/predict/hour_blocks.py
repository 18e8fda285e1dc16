"""Predict the maps of a year and their glare in blocks of hours, which limits memory.

With --maps the maps are stored in one Zarr v3 store; each unit of work writes one shard.
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Mask
from fieldlum.core.errors import InputError
from fieldlum.core.records import SiteFile
from fieldlum.core.scheduler import LOCAL, Scheduler, WorkUnit, run_each
from fieldlum.learn.models import Fitted, Prediction, load, read_config, seen_of, trusted_hours
from fieldlum.learn.models.mirrors import Mirror, MirroredSun, read_mirrors
from fieldlum.optics.projection import altitude_azimuth_deg, column_azimuths_deg, row_altitudes_deg
from fieldlum.room.scene import sun_patches
from fieldlum.session import sha256, site_toml
from fieldlum.session.files.hourly_csv import HOUR_COLUMNS
from fieldlum.session.files.model_files import ModelConfig
from fieldlum.sky.daylight import Light
from fieldlum.sky.sky_view.pose import CameraPose
from fieldlum.sky.sky_view.view import SKY_VIEW, SkyView
from fieldlum.sky.sky_view.visible_disc import disc_lx, disc_source, drawn_discs_lx
from fieldlum.sky.sun_disc import add_source
from fieldlum.year.glare import metrics
from fieldlum.year.glare.sources import SOURCE_CDM2, Views, panorama_views
from fieldlum.year.glare.standards import DgpUncertainty, dgp_uncertainty, disturbed_share
from fieldlum.year.glare.uncertainty_budget import U_DISC
from fieldlum.year.predict.annual import Annual, rounded, time_coordinate
from fieldlum.year.predict.melanopic import MelanopicYear

BLOCK = 64  # hours; about 30 MB for each map layer at 460 x 230; chosen


@dataclass(frozen=True, slots=True)
class HourBlock:
    """The k consecutive hours of a block: their light, predicted maps, and sun.

    rows: places of the hours among all hours of the year, or of the `Light` that `blocks` got;
    prediction: its maps [k, H, W] cd/m2 have no sun disc; disc_lx: illuminance by the part of the
    disc that the lens sees, on a plane normal to the sun [k] lx; images: the sun's image in each
    mirror of the room.
    """

    rows: slice
    light: Light
    prediction: Prediction
    disc_lx: Floats
    images: tuple[MirroredSun, ...] = ()

    def pictures_cdm2(self, heading_deg: float) -> Floats32:
        """Return the maps with the predicted mirror images of the sun, [k, H, W] cd/m2.

        Each image is one pixel; the sun's disc is not in the maps. heading_deg: azimuth of the
        centre column, clockwise from true north.
        """
        maps = self.prediction.luminance_cdm2
        for image in self.images:
            at = altitude_azimuth_deg(image.towards)
            maps = add_source(maps, at, image.shown_lx, heading_deg)
        return maps

    @property
    def trusted(self) -> Mask:
        """Mask [k]: True for hours whose maps are trusted.

        These are the hours that the model trusts (`trusted_hours`), without those in which the
        captures do not decide whether a mirror shows the sun. An expected error factor over 1.2 is
        not trusted; an unknown one does not decide.
        """
        trusted = trusted_hours(self.prediction)
        for image in self.images:
            trusted &= ~image.uncertain
        return trusted


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelRoom:
    """Site and room for which a model was trained, the size of its maps, and mirrors of the sun.

    setup: the SITE.toml of the model, with site and room; height, width: of the maps, H and W [px];
    heading_deg: azimuth of the maps' centre column, clockwise from true north; needs_patch: whether
    the model needs maps of sun patches; seen [H, W]: True for pixels that a lens saw, None if all
    were seen; mirrors: plane mirrors in the room that show the sun; sky_view: that of the model's
    captures, None for a model of an earlier version; sky_view_file: name of the file if another sky
    view replaces it, else ""; untrusted: whether no hour of the model is trusted; pose: that of the
    sky view, from which the sun's place in the maps follows.
    """

    setup: SiteFile
    height: int
    width: int
    heading_deg: float
    needs_patch: bool
    seen: Mask | None = None
    mirrors: tuple[Mirror, ...] = ()
    sky_view: SkyView | None = None
    sky_view_file: str = ""
    untrusted: bool = False
    pose: CameraPose = field(default_factory=CameraPose)

    @property
    def disc_from(self) -> str:
        """Text on how the disc's visibility is known: by sky view, room or not (`disc_source`)."""
        return disc_source(self.sky_view, self.setup, self.sky_view_file)


def room_of(config: ModelConfig, folder: Path) -> ModelRoom:
    """Return the room of the model in `folder`; config: the content of its config.json.

    Raises InputError if the config lacks the site, size or heading, if the site, the mirrors or the
    sky view is damaged, or if the model needs sun patches and the site has no room.
    """
    height, width, heading = config.height, config.width, config.heading_deg
    if height <= 0 or width <= 0 or heading is None or not config.setup:
        expected = "the site, size and heading of the model's pictures"
        raise InputError(folder / "config.json", "no such keys", expected, "train the model again")
    setup = site_toml.site_from_table(config.setup, str(folder / "config.json"))
    state = config.state
    needs_patch = bool(state.get("with_patch", state.get("patch", "none") != "none"))
    if needs_patch and setup.room is None:
        found = "the model needs sun patches, but its site has no [room]"
        remedy = "add [room] to the site and train again, or train with --patch none"
        raise InputError(folder, found, "a site with [room], or a model without patches", remedy)
    seen_mask = seen_of(folder)
    if seen_mask is not None and seen_mask.shape != (height, width):
        seen_mask = None  # `blocks` rejects the maps of such a model
    view = SkyView.find(folder / SKY_VIEW)
    return ModelRoom(
        setup=setup,
        height=height,
        width=width,
        heading_deg=heading,
        needs_patch=needs_patch,
        seen=seen_mask,
        mirrors=read_mirrors(folder, config),
        sky_view=view,
        untrusted=config.untrusted,
        pose=view.pose if view else CameraPose(axis_deg=heading),
    )


def blocks(
    fitted: Fitted, room: ModelRoom, light: Light, disc: Floats | None = None
) -> Iterator[HourBlock]:
    """Predict all n hours of `light`, and yield them in blocks of 64; the last may be shorter.

    fitted, room: the model and its room. disc: illuminance of the sun's disc, on a plane normal to
    it [n] lx; None to compute it for the room (`disc_lx`). Each block is predicted when it is
    requested. Raises InputError if the size of the maps differs from that in config.json or for an
    impossible room, FloatingPointError for luminances that are not finite.
    """
    count, space = len(light), room.setup.room
    disc = disc_lx(room.sky_view, room.setup, light) if disc is None else disc  # [n]
    for start in range(0, count, BLOCK):
        rows = slice(start, min(start + BLOCK, count))
        part, patch = light[rows], None
        if room.needs_patch and space is not None:
            suns, lx = part.apparent_sun_direction, part.direct_lx
            patch = sun_patches(space, suns, lx, height=room.height, heading_deg=room.heading_deg)
        prediction = fitted.predict(part, patch)
        maps = prediction.luminance_cdm2
        if maps.shape[1:] != (room.height, room.width):
            expected = f"{room.width} x {room.height} pixels, as in its config.json"
            found = f"predicted maps of {maps.shape[2]} x {maps.shape[1]} pixels"
            raise InputError("the model", found, expected, "train the model again")
        if not np.isfinite(maps).all():
            hours = f"hours {rows.start} to {rows.stop - 1}"
            raise FloatingPointError(f"{hours}: predicted values that are not finite")
        prediction = replace(prediction, trusted=prediction.trusted & (not room.untrusted))
        images = tuple(mirror.images(part, room.heading_deg) for mirror in room.mirrors)
        yield HourBlock(rows, part, prediction, disc[rows], images)


# ----------------------------------------------------------------------------------------------
# stored maps

MAPS_FOLDER, DRAFT_FOLDER = "maps.zarr", ".maps.zarr.tmp"
_MAPS_ARRAY = "luminance_cdm2"


def map_coordinates(
    t_utc: Sequence[datetime], height: int, heading_deg: float
) -> dict[str, tuple[str, Any, dict[str, str]]]:
    """Return xarray coordinates of maps [n, height, 2 height].

    Keys: time (UTC), y (altitude of each row, deg), x (azimuth of each column, deg clockwise from
    true north, above 360 beyond it, so that they ascend as xarray's plots need); values:
    (dimension, array, attributes). t_utc: aware times [n]; heading_deg: azimuth of the centre
    column.
    """
    azimuths = np.unwrap(column_azimuths_deg(2 * height, heading_deg), period=360.0)
    return {
        "time": time_coordinate(t_utc),
        "y": ("y", row_altitudes_deg(height), {"units": "degree", "long_name": "altitude"}),
        "x": ("x", azimuths, {"units": "degree", "long_name": "azimuth"}),
    }


def begin_maps(folder: Path, hours: int, room: ModelRoom) -> Path:
    """Create a draft store of maps in `folder`, all NaN, [hours, H, W], and return its path.

    hours: number of the year's hours; room: has the size H, W of the maps. An earlier draft is
    replaced. Units of work write maps in parallel into the draft with `write_maps`; `finish_maps`
    renames it to maps.zarr.
    """
    import zarr

    height, width, draft = room.height, room.width, folder / DRAFT_FOLDER
    group: Any = zarr.open_group(draft, mode="w", zarr_format=3)
    group.create_array(
        _MAPS_ARRAY,
        shape=(hours, height, width),
        dtype="float32",
        chunks=(8, height, width),  # hours that are decompressed to read one
        shards=(BLOCK, height, width),  # one file for each unit
        fill_value=float("nan"),
        dimension_names=("time", "y", "x"),
        attributes={"units": "cd m-2", "long_name": "luminance without the sun's disc"},
    )
    return draft


def write_maps(store: Path, start: int, maps: Floats32) -> None:
    """Write maps [n, H, W] cd/m2 into a store of `begin_maps`, rounded to 0.01 %.

    start: index of the first of these n hours in the year, from 0. `start` must be a multiple of
    64, and n at most 64, so that no other process writes into the same shard, which has 64 hours.
    """
    import zarr

    array: Any = zarr.open_array(store / _MAPS_ARRAY, mode="r+", zarr_format=3)
    array[start : start + len(maps)] = rounded(maps)


def finish_maps(folder: Path, annual: Annual, room: ModelRoom) -> None:
    """Complete the draft store of `begin_maps` in `folder`, and rename it to maps.zarr.

    Adds the coordinates, and for each hour `disc_lx` [lx] and `trusted`. An earlier maps.zarr is
    replaced.
    """
    import xarray as xr

    text = "illuminance of the visible disc on a plane normal to it"
    flag = {"long_name": "similar light was captured, and the expected error is not large"}
    hours = xr.Dataset(
        {
            "disc_lx": ("time", annual.hours["disc_lx"], {"units": "lx", "long_name": text}),
            "trusted": ("time", annual.hours["trusted"].astype(np.int8), flag),
        },
        coords=map_coordinates(annual.t_utc, room.height, room.heading_deg),
        attrs={"heading_deg": room.heading_deg, "site": room.setup.site.name},
    )
    time = {"time": {"units": "seconds since 1970-01-01", "dtype": "int64"}}
    draft = folder / DRAFT_FOLDER
    hours.to_zarr(draft, mode="a", zarr_format=3, consolidated=False, encoding=time)
    shutil.rmtree(folder / MAPS_FOLDER, ignore_errors=True)
    draft.rename(folder / MAPS_FOLDER)


# ----------------------------------------------------------------------------------------------
# glare of the hours


class HourFigures(NamedTuple):
    """Figures of n consecutive hours of a year, in d view directions.

    hours: columns of hourly.csv without a direction, by name, [n] each, with `occupied` 0; views:
    those for each direction, by name, [n, d] each, NaN in directions of which lenses saw less than
    half, and the further keys of `glare_directions`; with colours also those of
    `MelanopicYear.figures`. uncertainty: what is uncertain about DGP.
    """

    hours: dict[str, Array]
    views: dict[str, Floats]
    uncertainty: DgpUncertainty


def joined(parts: Sequence[HourFigures]) -> HourFigures:
    """Return the figures of the hours of all parts, in the order of the parts.

    parts: at least one; all with the same keys and view directions.
    """

    def together(tables: Sequence[dict[str, Array]], axis: int = 0) -> dict[str, Array]:
        """Return the arrays of the same name in all tables as one array, by name.

        axis: of the hours, along which they are joined.
        """
        return {k: np.concatenate([table[k] for table in tables], axis) for k in tables[0]}

    hours, views, doubts = zip(*parts, strict=True)
    arrays = [{k: getattr(doubt, k) for k in DgpUncertainty._fields[1:]} for doubt in doubts]
    doubt = doubts[0]._replace(**together(arrays, -2))
    return HourFigures(together(hours), together(views), doubt)


class HourJudge:
    """The view directions of a room, for which figures of predicted hours are computed.

    views: weights of the pixels of the room's maps for each direction.
    """

    def __init__(self, room: ModelRoom, azimuths_deg: Floats) -> None:
        """Compute weights and coverage of horizontal view directions.

        azimuths_deg: the directions [d], clockwise from north.
        """
        size, self._pose = (room.height, room.width, room.heading_deg), room.pose
        self.views = panorama_views(*size, azimuths_deg, room.seen)
        self._coverage = metrics.view_coverage(self.views)
        self._regions = metrics.region_weights(self.views)

    def glare(self, block: HourBlock) -> dict[str, Floats]:
        """Return the glare of k hours in d view directions, by column of hourly.csv, [k, d] each.

        The result also has the further keys of `glare_directions`. It has no uncertainties, and
        nothing of measured colour: melanopic_edi_lx_estimate is the vertical illuminance, as if the
        light had the spectrum of D65.
        """
        maps, light, images = block.prediction.luminance_cdm2, block.light, block.images
        sun = self._pose.in_pictures(light.apparent_sun_direction)
        suns = np.stack([sun, *(image.towards for image in images)])
        suns_lx = np.stack([block.disc_lx, *(image.shown_lx for image in images)])
        figures = metrics.glare_directions(maps, self.views, suns, suns_lx)
        # The ratio of melanopic to photopic light is assumed to be 1, as for D65. A copy, so that
        # no two columns share an array: `figures` sets parts of them to NaN in place.
        figures["melanopic_edi_lx_estimate"] = figures["ev_lx"].copy()
        return figures | metrics.region_ratios(maps, self._regions)

    def figures(
        self, block: HourBlock, discs_lx: Floats, melanopic: MelanopicYear | None = None
    ) -> HourFigures:
        """Return all figures of the k hours of a block, with their uncertainty.

        discs_lx: illuminance of the sun's disc [m, k] in m random draws of its visibility, the
        second result of `discs_of` for these hours; melanopic: colours by the captures, None
        without any. dgp_low and dgp_high are the ends of the 95 % interval of DGP: the limit by
        what no lens saw, plus the quantile of the draws, plus 1.96 u of the maps. The three are
        added, not their squares as in u_dgp, so that the interval is wide enough also if they are
        not independent. "occupied" is 0 here; `year.run` sets it.
        """
        views, light, coverage, figures = self.views, block.light, self._coverage, self.glare(block)
        u_map_rel, u_ev_rel, u_source_rel = relative_uncertainty(block, views, figures)
        ev_lx, contrast = figures["ev_lx"], figures["contrast"]
        u_maps = dgp_uncertainty(ev_lx, contrast, u_ev_rel, u_source_rel)
        # The unseen part is at most as bright as the mean sky, or the brightest hundredth seen.
        brightest = light.diffuse_lx / np.pi
        if coverage.unseen_illuminance.any():
            seen_cdm2 = metrics.brightest_cdm2(block.prediction.luminance_cdm2, views)
            brightest = np.maximum(brightest, seen_cdm2)
        # lowest and highest DGP over possible luminances of the unseen part [k, d]
        minimum, maximum = metrics.unseen_dgp_bounds(coverage, ev_lx, contrast, brightest)
        # Ev and contrast in m draws [m, k, d] of the sun's visibility and place: in the poses that
        # `discs_of` draws
        poses = self._pose.drawn(np.random.default_rng([0, 2]), len(discs_lx))
        ray = light.apparent_sun_direction
        suns = np.stack([self._pose.in_pictures(ray, values) for values in poses])
        disc = (metrics.sun_per_lx(suns, views), discs_lx)
        of_images = _images(block, views, len(discs_lx))
        drawn_ev_lx, drawn_contrast = metrics.with_disc(figures, disc, *of_images)
        if melanopic is not None:
            unseen_lx = brightest[:, None] * coverage.unseen_illuminance
            figures |= melanopic.figures(light, figures, u_map_rel, drawn_ev_lx, unseen_lx)
        drawn = metrics.dgp(drawn_ev_lx, drawn_contrast).astype(np.float32)
        off = drawn - figures["dgp"].astype(np.float32)  # [m, k, d]
        reach = 1.96 * np.nan_to_num(u_maps)  # 95 %
        low, high = np.percentile(off, (2.5, 97.5), axis=0)
        figures["dgp_low"] = np.clip(minimum + np.minimum(low, 0.0) - reach, 0.0, 1.0)
        figures["dgp_high"] = np.clip(maximum + np.maximum(high, 0.0) + reach, 0.0, 1.0)
        figures["u_dgp"] = np.hypot(u_maps, np.sqrt((off**2).mean(axis=0)))
        for values in figures.values():
            values[:, ~coverage.judged] = np.nan
        hours = {
            **{name: getattr(light, name) for name in HOUR_COLUMNS[:4]},  # irradiance, sun
            "disc_lx": block.disc_lx,
            "occupied": np.zeros(len(light)),
            "trusted": block.trusted.astype(float),
            "expected_log10_mse": block.prediction.expected_mse,
            "disturbed_share": disturbed_share(figures["dgp"]),
        }
        doubt = DgpUncertainty(coverage.words, minimum, maximum, drawn, u_maps)
        return HourFigures(hours, figures, doubt)


def relative_uncertainty(
    block: HourBlock, views: Views, figures: dict[str, Floats]
) -> tuple[Floats, Floats, Floats]:
    """Return the relative standard uncertainties of the map's Ev, of Ev, and of the sources.

    The map's Ev is Ev without the sun and its images. The third uncertainty is of the luminance of
    the glare sources in the contrast of DGP. All are [k, d], of k hours in d directions, and NaN
    where the model does not state its error. Errors of the pixels of one picture count as fully
    correlated, because a model is often too bright or too dark on a complete wall. The sun's disc
    has 5 % (`U_DISC`). views: weights of the pixels; figures: the result of `glare_directions` for
    the block.
    """
    predicted, maps = block.prediction, block.prediction.luminance_cdm2
    if predicted.log10_sd is None:
        rms = np.log(10.0) * np.sqrt(np.asarray(predicted.expected_mse))[:, None]
        of_map_ev = of_sources = np.broadcast_to(rms, figures["ev_lx"].shape)
    else:
        u_rel = np.float32(np.log(10.0)) * predicted.log10_sd
        map_ev_lx = figures["ev_lx"] - figures["sun_ev_lx"]
        of_map_ev = metrics.map_ev_lx(maps * u_rel, views) / np.maximum(map_ev_lx, 1e-6)
        # u of the sources is the mean over their pixels, weighted by L^2 as in DGP's contrast
        weight = np.where(maps > SOURCE_CDM2, maps, np.float32(0.0)) ** 2
        sums = metrics.map_ev_lx(weight, views)
        of_sources = metrics.map_ev_lx(weight * u_rel, views) / np.maximum(sums, 1e-6)
    # shares of the sun and its images in Ev and in the contrast of DGP
    sun_ev = figures["sun_ev_lx"] / np.maximum(figures["ev_lx"], 1e-6)
    sun_contrast = figures["sun_contrast"] / np.maximum(figures["contrast"], 1e-30)
    of_ev = np.hypot((1.0 - sun_ev) * of_map_ev, sun_ev * U_DISC)
    of_contrast = np.hypot((1.0 - sun_contrast) * of_sources, sun_contrast * U_DISC)
    return of_map_ev, of_ev, of_contrast


def _images(block: HourBlock, views: Views, count: int) -> Iterator[metrics.DiscLight]:
    """Yield the light of the sun's image in each mirror, in `count` draws of its visibility.

    The draws are illuminances in k hours [count, k] lx, 0 where the image is hidden. Draw i (from
    0) shows it in the hours whose chance of a visible image exceeds (i + 0.5) / count.
    """
    draws = (np.arange(count)[:, None] + 0.5) / count
    for image in block.images:
        shown_lx = np.where(draws < image.chance, image.normal_lx, 0.0)
        yield metrics.sun_per_lx(image.towards, views), shown_lx


def room_figures(
    fitted: Fitted, room: ModelRoom, light: Light, azimuths_deg: Floats
) -> HourFigures:
    """Predict the n hours of `light` in this process, and return their figures in d directions.

    azimuths_deg: the directions [d], clockwise from north. Nothing is written.
    Raises InputError for maps of a size other than in config.json or an
    impossible room, FloatingPointError for luminances that are not finite.
    """
    best_lx, discs_lx = discs_of(room, light)
    judge, hours = HourJudge(room, azimuths_deg), blocks(fitted, room, light, best_lx)
    return joined([judge.figures(block, discs_lx[:, block.rows]) for block in hours])


def discs_of(room: ModelRoom, light: Light) -> tuple[Floats, Floats]:
    """Return the sun disc's illuminance in n hours [n] lx, and m = 64 random draws of it [m, n] lx.

    It is caused by the part of the disc that the lens sees, on a plane normal to the sun; 0 where
    the disc is hidden. The first result is the most likely illuminance (`disc_lx`). Each draw
    varies the sky view, the camera's pose and the beam's luminous efficacy within their
    uncertainties (`drawn_discs_lx`), always by the same random numbers. Raises InputError for an
    impossible room.
    """
    rng = np.random.default_rng([0, 2])
    view, setup = room.sky_view, room.setup
    return disc_lx(view, setup, light), drawn_discs_lx(view, setup, light, rng)


# ----------------------------------------------------------------------------------------------
# units of work


class _HoursJob(NamedTuple):
    """The hours that a worker predicts, and all that it needs for them.

    model, store: folders of the model and of the maps (see `begin_maps`; "" for none), relative to
    the folder of the unit of work; digest: sha256 of the model's files; start: index of the first
    hour in the year; disc_lx [n], discs_lx [m, n]: results of `discs_of` for these n hours and m
    draws; pose: of the sky view by which these are computed.
    """

    model: str
    digest: str
    start: int
    light: Light
    azimuths_deg: tuple[float, ...]
    disc_lx: Floats
    discs_lx: Floats
    store: str
    melanopic: MelanopicYear | None
    pose: CameraPose

    def block(self, rows: slice) -> Self:
        """Return the job of the hours `rows`."""
        light, disc_lx, discs_lx = self.light[rows], self.disc_lx[rows], self.discs_lx[:, rows]
        return self._replace(start=rows.start, light=light, disc_lx=disc_lx, discs_lx=discs_lx)


def predict_figures(
    model_folder: Path,
    room: ModelRoom,
    light: Light,
    azimuths_deg: Floats,
    *,
    store: Path | None = None,
    melanopic: MelanopicYear | None = None,
    scheduler: Scheduler = LOCAL,
) -> HourFigures:
    """Predict every hour of `light`, and return the figures in d view directions.

    room: that of the model in model_folder; light: of the n hours of the year, at least one;
    azimuths_deg [d]: the directions, clockwise from north; store: result of `begin_maps`, into
    which the maps are written, None to write none; melanopic: colours by the captures, None without
    any; scheduler: runs the units of work, each of 64 hours, the last of
    the rest. Raises InputError for maps of a size other than in config.json or an impossible room,
    FloatingPointError for luminances that are not finite, and the errors of `run_each`.
    """
    model = model_folder.resolve()
    # the units' folder, from which workers find the model and the store of the maps
    folder = Path(os.path.commonpath([model, *([store.resolve()] if store else [])]))
    name = model.relative_to(folder).as_posix()
    files = [f for f in ("config.json", "weights.npz", SKY_VIEW) if (model / f).is_file()]
    digest = " ".join(sha256(model / file) for file in files)
    place = store.resolve().relative_to(folder).as_posix() if store else ""
    discs, azimuths = discs_of(room, light), tuple(float(a) for a in azimuths_deg)
    job = _HoursJob(name, digest, 0, light, azimuths, *discs, place, melanopic, room.pose)
    units, paths = [], tuple(f"{name}/{file}" for file in files)
    for start in range(0, len(light), BLOCK):
        part = job.block(slice(start, start + BLOCK))
        units.append(WorkUnit(f"hours-{start}", predict_hours, folder, part, files=paths))
    parts: dict[str, HourFigures] = {}

    run_each(units, scheduler, lambda ended: parts.update({ended.unit.name: ended.result()}))
    return joined([parts[unit.name] for unit in units])


def predict_hours(folder: Path, job: _HoursJob) -> HourFigures:
    """Predict the hours of a unit of work, write their maps, and return their figures.

    Without `job.store` no maps are written. folder: that of the unit, to which the paths in `job`
    are relative; job: the hours, at most 64, and what is needed for them. Raises InputError for a
    model that cannot be used, FloatingPointError for luminances that are not finite.
    """
    fitted, room, judge = _prepared(folder / job.model, job.digest, job.azimuths_deg, job.pose)
    (block,) = blocks(fitted, room, job.light, job.disc_lx)
    if job.store:
        write_maps(folder / job.store, job.start, block.pictures_cdm2(room.heading_deg))
    return judge.figures(block, job.discs_lx, job.melanopic)


@lru_cache(maxsize=1)
def _prepared(
    model_folder: Path, digest: str, azimuths_deg: tuple[float, ...], pose: CameraPose
) -> tuple[Fitted, ModelRoom, HourJudge]:
    """Return the model in a folder, its room with another `pose`, and its view directions.

    They are loaded once for each process; another `digest` of the folder's files loads them again.
    """
    room = replace(room_of(read_config(model_folder), model_folder), pose=pose)
    return load(model_folder), room, HourJudge(room, np.array(azimuths_deg))
