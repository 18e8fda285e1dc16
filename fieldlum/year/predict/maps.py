"""Store all maps of a year in one Zarr v3 store; each unit of work writes one shard."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.optics.projection import column_azimuths_deg, row_altitudes_deg
from fieldlum.session.bucket import BucketStore
from fieldlum.session.provenance import digest
from fieldlum.year.predict.annual import rounded, time_coordinate
from fieldlum.year.predict.blocks import BLOCK, ModelRoom

_NAME = "maps.zarr"
CHUNK = 8  # hours that must be decompressed to read one hour; not measured
MAPS = "luminance_cdm2"


class MapStore:
    """A Zarr store of predicted maps: luminance_cdm2 (time, y, x), and disc_lx and trusted (time).

    It is `maps.zarr` in a year's folder, or below the URL of a bucket, which records a digest of
    `inputs` (what the year depends on). Units of work write maps in parallel into `target`, with
    `write_maps`. The store can be opened, and replaces an earlier one, after `finish`. disc_lx:
    illuminance of the visible sun disc on a plane normal to it; trusted: 1 if the map of the hour
    is trusted, else 0.
    """

    def __init__(self, folder: Path, url: str, inputs: Mapping[str, object]) -> None:
        """url: of a bucket, "" for the folder. Raises InputError for an unusable URL."""
        self._path, self._draft = folder / _NAME, folder / f".{_NAME}.tmp"
        self._bucket = BucketStore(f"{url.rstrip('/')}/{_NAME}") if url else None
        self._inputs = inputs
        self.target = self._bucket.target if self._bucket else str(self._draft)

    def create(self, t_utc: Sequence[datetime], room: ModelRoom) -> None:
        """Begin a new store: write coordinates, and an array of maps without values.

        t_utc: middle of each hour. Raises InputError for a bucket that cannot be written to.
        """
        shutil.rmtree(self._draft, ignore_errors=True)
        describe(self._draft, t_utc, room)
        if self._bucket:
            self._bucket.begin(self._draft)

    def finish(self, disc_lx: Floats, trusted: Floats) -> None:
        """Write `disc_lx` [lx] and `trusted` (0 or 1) of the n hours, which completes the store."""
        add_hours(self._draft, disc_lx, trusted)
        if self._bucket is None:
            shutil.rmtree(self._path, ignore_errors=True)
            self._draft.rename(self._path)
            return
        for name in ("disc_lx", "trusted"):
            self._bucket.upload(self._draft, name)
        self._bucket.finish(self._draft, digest(self._inputs))
        shutil.rmtree(self._draft, ignore_errors=True)


def is_complete(url: str, inputs: Mapping[str, object]) -> bool:
    """Return whether a complete maps.zarr, computed from these inputs, is below `url`."""
    return BucketStore(f"{url.rstrip('/')}/{_NAME}").is_made_from(digest(inputs))


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


def describe(folder: Path, t_utc: Sequence[datetime], room: ModelRoom) -> None:
    """Write a store in `folder`: time, altitude and azimuth, and an array of maps without values.

    The maps are NaN until `write_maps`. t_utc: middle of each hour.
    """
    import xarray as xr
    import zarr

    height, width = room.height, room.width
    about = {"heading_deg": room.heading_deg, "site": room.setup.site.name}
    frame = xr.Dataset(coords=map_coordinates(t_utc, height, room.heading_deg), attrs=about)
    time = {"time": {"units": "seconds since 1970-01-01", "dtype": "int64"}}
    frame.to_zarr(folder, mode="w", zarr_format=3, consolidated=False, encoding=time)
    group: Any = zarr.open_group(folder, mode="r+", zarr_format=3)
    group.create_array(
        MAPS,
        shape=(len(t_utc), height, width),
        dtype="float32",
        chunks=(CHUNK, height, width),
        shards=(BLOCK, height, width),  # one file, or one object in a bucket, for each unit
        fill_value=float("nan"),
        dimension_names=("time", "y", "x"),
        attributes={"units": "cd m-2", "long_name": "luminance without the sun's disc"},
    )


def add_hours(folder: Path, disc_lx: Floats, trusted: Floats) -> None:
    """Write `disc_lx` [lx] and `trusted` (0 or 1) of the n hours into a store."""
    import xarray as xr
    import zarr

    text = "illuminance of the visible disc on a plane normal to it"
    flag = {"long_name": "similar light was captured, and the expected error is not large"}
    hours = xr.Dataset(
        {
            "disc_lx": (("time",), disc_lx, {"units": "lx", "long_name": text}),
            "trusted": (("time",), trusted.astype(np.int8), flag),
        },
        attrs=dict(zarr.open_group(folder, mode="r").attrs),  # to_zarr replaces them
    )
    hours.to_zarr(folder, mode="a", zarr_format=3, consolidated=False)


def write_maps(target: str, start: int, maps: Floats32) -> None:
    """Write maps [n, H, W] cd/m2 into the store at a path or URL, rounded to 0.01 %.

    start: index of the first of these hours in the year, from 0; a multiple of 64, because each
    shard has 64 hours.
    """
    import zarr

    array: Any = zarr.open_array(f"{target}/{MAPS}", mode="r+", zarr_format=3)
    array[start : start + len(maps)] = rounded(maps)
