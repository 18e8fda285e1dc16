"""Store all maps of a year in one Zarr v3 store; each unit of work writes one shard."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.optics.projection import column_azimuths_deg, row_altitudes_deg
from fieldlum.year.predict.annual import rounded, time_coordinate
from fieldlum.year.predict.blocks import BLOCK, ModelRoom

NAME, DRAFT = "maps.zarr", ".maps.zarr.tmp"
CHUNK = 8  # hours that must be decompressed to read one hour; not measured
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
        chunks=(CHUNK, height, width),
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
