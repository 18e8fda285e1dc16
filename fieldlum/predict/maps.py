"""Store all maps of a year in one Zarr v3 store. Each unit of work writes one shard of it."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.predict.annual import rounded
from fieldlum.predict.blocks import BLOCK, ModelRoom
from fieldlum.projection import column_azimuths_deg, row_altitudes_deg

CHUNK = 8  # hours that a reader of one hour decompresses; not measured
MAPS = "luminance_cdm2"


class MapStore:
    """`maps.zarr` with luminance_cdm2 (time, y, x), disc_lx and trusted (time).

    Units write into `work`; the store gets its name when all of them have finished.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.work = path.with_name(f".{path.name}.tmp")

    def create(self, t_utc: Sequence[datetime], room: ModelRoom, site_name: str) -> None:
        """Write the coordinates and the description of the maps; delete earlier remains."""
        import xarray as xr
        import zarr

        shutil.rmtree(self.work, ignore_errors=True)
        times = np.array([t.replace(tzinfo=None) for t in t_utc], "datetime64[ns]")
        height, width = room.height, room.width
        altitudes, azimuths = (
            row_altitudes_deg(height),
            column_azimuths_deg(width, room.heading_deg),
        )
        frame = xr.Dataset(
            coords={
                "time": ("time", times, {"long_name": "UTC, middle of the hour"}),
                "y": ("y", altitudes, {"units": "degree", "long_name": "altitude"}),
                "x": ("x", azimuths, {"units": "degree", "long_name": "azimuth"}),
            },
            attrs={"heading_deg": room.heading_deg, "site": site_name},
        )
        time = {"time": {"units": "seconds since 1970-01-01", "dtype": "int64"}}
        frame.to_zarr(self.work, mode="w", zarr_format=3, consolidated=False, encoding=time)
        group: Any = zarr.open_group(self.work, mode="r+", zarr_format=3)
        group.create_array(
            MAPS,
            shape=(len(times), height, width),
            dtype="float32",
            chunks=(CHUNK, height, width),
            shards=(BLOCK, height, width),  # one file, or one object of a bucket, for each unit
            fill_value=float("nan"),
            dimension_names=("time", "y", "x"),
            attributes={"units": "cd m-2", "long_name": "luminance without the sun's disc"},
        )

    def finish(self, disc_lx: NDArray[np.float64], trusted: NDArray[np.float64]) -> None:
        """Write the discs [n] lx and the trust [n], and give the store its name."""
        import xarray as xr

        disc = {
            "units": "lx",
            "long_name": "illuminance of the visible disc on a plane normal to it",
        }
        flag = {"long_name": "such light was seen"}
        hours = xr.Dataset(
            {
                "disc_lx": (("time",), disc_lx, disc),
                "trusted": (("time",), trusted.astype(np.int8), flag),
            }
        )
        hours.to_zarr(self.work, mode="a", zarr_format=3, consolidated=False)
        shutil.rmtree(self._path, ignore_errors=True)
        self.work.rename(self._path)


def write_maps(store: Path, start: int, maps: NDArray[np.float32]) -> None:
    """Write the maps [n, H, W] of the hours from `start`: a complete shard, visible at once."""
    import zarr

    array: Any = zarr.open_array(store / MAPS, mode="r+", zarr_format=3)
    array[start : start + len(maps)] = rounded(maps)
