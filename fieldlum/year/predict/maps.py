"""Store all maps of a year in one Zarr v3 store; each unit of work writes one shard."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.records import JsonTable
from fieldlum.optics.projection import column_azimuths_deg, row_altitudes_deg
from fieldlum.session.bucket import BucketStore
from fieldlum.session.provenance import digest
from fieldlum.year.predict.annual import rounded, time_coordinate
from fieldlum.year.predict.blocks import BLOCK, ModelRoom

_NAME = "maps.zarr"


class BucketMapStore:
    """A store `maps.zarr` of predicted maps below a URL; it can be opened when it is complete.

    inputs: what the year depends on; the store records its digest. draft: local folder for the
    coordinates and descriptions before their upload.
    """

    def __init__(self, url: str, inputs: Mapping[str, object], draft: Path) -> None:
        self._digest = digest(inputs)
        self._store = BucketStore(f"{url.rstrip('/')}/{_NAME}")
        self._draft = draft

    @property
    def target(self) -> str:
        """Return the URL where units write."""
        return self._store.target

    def create(self, t_utc: Sequence[datetime], room: ModelRoom, site_name: str) -> None:
        """Delete an earlier store, and upload the coordinates and an array of maps without values.

        t_utc: middle of each hour. Raises InputError for a URL that cannot be written to.
        """
        describe(self._draft, t_utc, room, {"site": site_name})
        self._store.begin(self._draft)

    def finish(self, disc_lx: Floats, trusted: Floats) -> None:
        """Upload `disc_lx` [lx] and `trusted` (0 or 1) of the n hours, then the root's zarr.json.

        This completes the store; the local draft is deleted.
        """
        add_hours(self._draft, disc_lx, trusted)
        for name in ("disc_lx", "trusted"):
            self._store.upload(self._draft, name)
        self._store.finish(self._draft, self._digest)
        shutil.rmtree(self._draft, ignore_errors=True)


def is_complete(url: str, inputs: Mapping[str, object]) -> bool:
    """Return whether a complete maps.zarr, computed from these inputs, is below `url`."""
    return BucketStore(f"{url.rstrip('/')}/{_NAME}").is_made_from(digest(inputs))


CHUNK = 8  # hours that must be decompressed to read one hour; not measured
MAPS = "luminance_cdm2"


class MapStore(Protocol):
    """A Zarr store of predicted maps: luminance_cdm2 (time, y, x), and disc_lx and trusted (time).

    Units of work write maps in parallel into `target`, with `write_maps`. The store is complete
    after `finish`. disc_lx: illuminance of the visible sun disc on a plane normal to it; trusted: 1
    if the map of the hour is trusted, else 0.
    """

    @property
    def target(self) -> str:
        """Return the path or URL into which units write."""
        ...

    def create(self, t_utc: Sequence[datetime], room: ModelRoom, site_name: str) -> None:
        """Begin a new store in `target`: write coordinates, and an array of maps without values.

        t_utc: middle of each hour. What `target` already holds is deleted.
        """
        ...

    def finish(self, disc_lx: Floats, trusted: Floats) -> None:
        """Write `disc_lx` [lx] and `trusted` (0 or 1) of the n hours, which completes the store."""
        ...


class FolderMapStore:
    """A store of maps in a local folder, which is renamed to `path` when it is complete."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._work = path.with_name(f".{path.name}.tmp")

    @property
    def target(self) -> str:
        """Return the temporary folder, `.NAME.tmp` for a store NAME, where units of work write."""
        return str(self._work)

    def create(self, t_utc: Sequence[datetime], room: ModelRoom, site_name: str) -> None:
        """Begin a new store in `target`: write coordinates, and an array of maps without values.

        t_utc: middle of each hour. An earlier complete store remains until `finish`.
        """
        shutil.rmtree(self._work, ignore_errors=True)
        describe(self._work, t_utc, room, {"site": site_name})

    def finish(self, disc_lx: Floats, trusted: Floats) -> None:
        """Write `disc_lx` [lx] and `trusted` (0 or 1) of the n hours, and rename the store.

        An earlier store of the final name is deleted.
        """
        add_hours(self._work, disc_lx, trusted)
        shutil.rmtree(self._path, ignore_errors=True)
        self._work.rename(self._path)


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


def describe(folder: Path, t_utc: Sequence[datetime], room: ModelRoom, about: JsonTable) -> None:
    """Write a store in `folder`: time, altitude and azimuth, and an array of maps without values.

    The maps are NaN until `write_maps`. t_utc: middle of each hour; about: further attributes.
    """
    import xarray as xr
    import zarr

    height, width = room.height, room.width
    coordinates = map_coordinates(t_utc, height, room.heading_deg)
    frame = xr.Dataset(coords=coordinates, attrs={"heading_deg": room.heading_deg, **about})
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

    disc = {
        "units": "lx",
        "long_name": "illuminance of the visible disc on a plane normal to it",
    }
    flag = {"long_name": "similar light was captured, and the expected error is not large"}
    hours = xr.Dataset(
        {
            "disc_lx": (("time",), disc_lx, disc),
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
