"""Predict the maps of a year in blocks of hours, so that memory does not grow with the year.

With --maps they are stored in one Zarr v3 store; each unit of work writes one shard.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.errors import InputError
from fieldlum.core.records import Progress, SiteFile, quiet
from fieldlum.learn.models import Fitted, Prediction, seen_of, trusted_hours
from fieldlum.learn.models.mirrors import Mirror, MirroredSun, read_mirrors
from fieldlum.optics.projection import column_azimuths_deg, row_altitudes_deg
from fieldlum.room.scene import sun_patches
from fieldlum.session.files.model_config import ModelConfig
from fieldlum.session.site_toml import site_from_table
from fieldlum.sky.light import Light
from fieldlum.sky.sky_view import SkyView
from fieldlum.sky.sky_view.disc_in_view import disc_lx, disc_source
from fieldlum.sky.sky_view.view import NAME as SKY_VIEW
from fieldlum.sky.sun_disc import add_source
from fieldlum.year.predict.annual import rounded, time_coordinate

BLOCK = 64  # hours; about 30 MB for each map layer at 460 x 230; chosen


@dataclass(frozen=True, slots=True)
class HourBlock:
    """Consecutive hours of a year: the model's prediction with its uncertainty, and the sun.

    rows: the k hours in the light given to `blocks`; prediction: its maps [k, H, W] cd/m2 have no
    sun disc; disc_lx: illuminance of the disc as visible at the lens, on a plane normal to the sun
    [k] lx; images: of the sun, for each mirror of the room.
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
            maps = add_source(maps, image.place_deg, image.shown_lx, heading_deg)
        return maps

    @property
    def trusted(self) -> Mask:
        """Mask [k]: True for hours whose maps are trusted.

        These are hours for which the model vouches, with an expected error factor of at most 1.2
        (or an unknown one), unless the captures do not decide whether a mirror shows the sun.
        """
        trusted = trusted_hours(self.prediction)
        for image in self.images:
            trusted &= ~image.doubtful
        return trusted


@dataclass(frozen=True, slots=True)
class ModelRoom:
    """Site and room for which a model was trained, the size of its maps, and mirrors of the sun.

    heading_deg: azimuth of the maps' centre column, clockwise from true north; needs_patch: whether
    the model needs maps of sun patches; seen [H, W]: True for pixels that a lens saw; sky_view: of
    the model's captures.
    """

    setup: SiteFile
    height: int
    width: int
    heading_deg: float
    needs_patch: bool
    # [H, W]; None if all pixels were seen, or for a model of 0.1.0
    seen: Mask | None = None
    mirrors: tuple[Mirror, ...] = ()
    sky_view: SkyView | None = None  # None for a model of an earlier version
    sky_view_file: str = ""  # name of a sky view in place of the model's

    @property
    def disc_from(self) -> str:
        """Text on how the disc's visibility is known."""
        return disc_source(self.sky_view, self.setup, self.sky_view_file)


def wants_patch(config: ModelConfig) -> bool:
    """Return whether the model in a config.json needs maps of sun patches.

    Without the key `with_patch`: a transport model (of 0.1.0) needs them if it has a patchwork,
    another model unless its `patch` is absent or "none".
    """
    state = config.state
    if "with_patch" in state:
        return bool(state["with_patch"])
    if "transport" in state:
        return state["transport"].get("patchwork") is not None
    return state.get("patch", "none") != "none"


def room_of(config: ModelConfig, folder: Path) -> ModelRoom:
    """Return the room of the model in `folder`.

    Raises InputError if the config lacks the site, size or heading, if the site or the mirrors are
    damaged, or if the model needs sun patches and the site has no room.
    """
    height, width, heading = config.height, config.width, config.heading_deg
    if height <= 0 or width <= 0 or heading is None or not config.setup:
        expected = "the site, size and heading of the model's pictures"
        raise InputError(folder / "config.json", "no such keys", expected, "train the model again")
    setup = site_from_table(config.setup, str(folder / "config.json"))
    if wants_patch(config) and setup.room is None:
        found = "the model needs sun patches, but its site has no [room]"
        remedy = "add [room] to the site and train again, or train with --patch none"
        raise InputError(folder, found, "a site with [room], or a model without patches", remedy)
    seen_mask = seen_of(folder)
    if seen_mask is not None and seen_mask.shape != (height, width):
        seen_mask = None  # `blocks` rejects the maps of such a model
    mirrors = read_mirrors(folder, config)
    view = SkyView.find(folder / SKY_VIEW)
    return ModelRoom(setup, height, width, heading, wants_patch(config), seen_mask, mirrors, view)


def blocks(
    fitted: Fitted,
    room: ModelRoom,
    light: Light,
    disc: Floats | None = None,
    *,
    progress: Progress = quiet,
) -> Iterator[HourBlock]:
    """Predict all hours of `light`, and yield them in blocks of 64; the last may be shorter.

    disc: illuminance of the sun's disc, normal to it [n] lx; None to compute it for the room.
    Raises InputError if the size of the maps differs from that in config.json, FloatingPointError
    for luminances that are not finite.
    """
    count, space = len(light), room.setup.room
    disc = disc_lx(room.sky_view, room.setup, light) if disc is None else disc  # [n]
    for start in range(0, count, BLOCK):
        rows = slice(start, min(start + BLOCK, count))
        part, patch = light[rows], None
        if room.needs_patch and space is not None:
            patch = sun_patches(
                space,
                part.shown_sun_direction,
                part.direct_lx,
                height=room.height,
                heading_deg=room.heading_deg,
            ).luminance_cdm2
        prediction = fitted.predict(part, patch)
        maps = prediction.luminance_cdm2
        if maps.shape[1:] != (room.height, room.width):
            expected = f"{room.width} x {room.height} pixels, as in its config.json"
            found = f"predicted maps of {maps.shape[2]} x {maps.shape[1]} pixels"
            raise InputError("the model", found, expected, "train the model again")
        if not np.isfinite(maps).all():
            raise FloatingPointError(
                f"hours {rows.start} to {rows.stop - 1}: predicted values that are not finite"
            )
        progress(rows.stop, count, "hours predicted")
        images = tuple(mirror.images(part, room.heading_deg) for mirror in room.mirrors)
        yield HourBlock(rows, part, prediction, disc[rows], images)


# ----------------------------------------------------------------------------------------------
# stored maps

NAME, DRAFT = "maps.zarr", ".maps.zarr.tmp"
MAPS = "luminance_cdm2"


def map_coordinates(
    t_utc: Sequence[datetime], height: int, heading_deg: float
) -> dict[str, tuple[str, Any, dict[str, str]]]:
    """Return the coordinates time, y (altitude) and x (azimuth) of maps [n, height, 2 height]."""
    azimuths = column_azimuths_deg(2 * height, heading_deg)
    return {
        "time": time_coordinate(t_utc),
        "y": ("y", row_altitudes_deg(height), {"units": "degree", "long_name": "altitude"}),
        "x": ("x", azimuths, {"units": "degree", "long_name": "azimuth"}),
    }


def begin_maps(folder: Path, t_utc: Sequence[datetime], room: ModelRoom) -> Path:
    """Return a new store in `folder`: time, altitude and azimuth, and an array of maps of NaN.

    Units of work write maps in parallel into it with `write_maps`; `finish_maps` renames it to
    maps.zarr. t_utc: middle of each hour.
    """
    import xarray as xr
    import zarr

    height, width, draft = room.height, room.width, folder / DRAFT
    shutil.rmtree(draft, ignore_errors=True)
    about = {"heading_deg": room.heading_deg, "site": room.setup.site.name}
    frame = xr.Dataset(coords=map_coordinates(t_utc, height, room.heading_deg), attrs=about)
    time = {"time": {"units": "seconds since 1970-01-01", "dtype": "int64"}}
    frame.to_zarr(draft, mode="w", zarr_format=3, consolidated=False, encoding=time)
    group: Any = zarr.open_group(draft, mode="r+", zarr_format=3)
    group.create_array(
        MAPS,
        shape=(len(t_utc), height, width),
        dtype="float32",
        chunks=(8, height, width),  # hours that are decompressed to read one
        shards=(BLOCK, height, width),  # one file for each unit
        fill_value=float("nan"),
        dimension_names=("time", "y", "x"),
        attributes={"units": "cd m-2", "long_name": "luminance without the sun's disc"},
    )
    return draft


def write_maps(store: Path, start: int, maps: Floats32) -> None:
    """Write maps [n, H, W] cd/m2 into the store, rounded to 0.01 %.

    start: index of the first of these hours in the year, from 0; a multiple of 64, because each
    shard has 64 hours.
    """
    import zarr

    array: Any = zarr.open_array(store / MAPS, mode="r+", zarr_format=3)
    array[start : start + len(maps)] = rounded(maps)


def finish_maps(folder: Path, disc_lx: Floats, trusted: Floats) -> None:
    """Write `disc_lx` [lx] and `trusted` (0 or 1) of the n hours, and give the store its name."""
    import xarray as xr
    import zarr

    text = "illuminance of the visible disc on a plane normal to it"
    flag = {"long_name": "similar light was captured, and the expected error is not large"}
    hours = xr.Dataset(
        {
            "disc_lx": (("time",), disc_lx, {"units": "lx", "long_name": text}),
            "trusted": (("time",), trusted.astype(np.int8), flag),
        },
        attrs=dict(zarr.open_group(folder / DRAFT, mode="r").attrs),  # to_zarr replaces them
    )
    hours.to_zarr(folder / DRAFT, mode="a", zarr_format=3, consolidated=False)
    shutil.rmtree(folder / NAME, ignore_errors=True)
    (folder / DRAFT).rename(folder / NAME)
