"""All maps of a year as one Zarr v3 store, written a block at a time through xarray."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.predict.annual import rounded
from fieldlum.predict.blocks import HourBlock
from fieldlum.projection import column_azimuths_deg, row_altitudes_deg


class MapStore:
    """`maps.zarr` with luminance_cdm2 (time, y, x) and disc_lx (time); it gets its name when it is
    whole.

    Use as a context manager; on an error what was written goes away, and an older store stays.
    """

    def __init__(
        self, path: Path, height: int, width: int, heading_deg: float, about: dict[str, Any]
    ) -> None:
        self._path, self._work = path, path.with_name(f".{path.name}.tmp")
        self._heading, self._about = heading_deg, about
        self._size = (height, width)
        self._started = False

    def __enter__(self) -> MapStore:
        shutil.rmtree(self._work, ignore_errors=True)
        return self

    def append(self, block: HourBlock) -> None:
        dataset = self._dataset(block)
        options: dict[str, Any] = {"append_dim": "time"}
        if not self._started:
            height, width = self._size
            chunk = {"luminance_cdm2": {"chunks": (8, height, width)}}
            time = {"time": {"units": "seconds since 1970-01-01", "dtype": "int64"}}
            options = {"mode": "w", "encoding": {**chunk, **time}}
        dataset.to_zarr(self._work, zarr_format=3, consolidated=False, **options)
        self._started = True

    def _dataset(self, block: HourBlock) -> Any:
        import xarray as xr

        height, width = self._size
        times = np.array([t.replace(tzinfo=None) for t in block.light.t_utc], "datetime64[ns]")
        maps: NDArray[np.float32] = rounded(block.prediction.luminance_cdm2)
        return xr.Dataset(
            {
                "luminance_cdm2": (
                    ("time", "y", "x"),
                    maps,
                    {"units": "cd m-2", "long_name": "luminance without the sun's disc"},
                ),
                "disc_lx": (
                    ("time",),
                    block.disc_lx,
                    {
                        "units": "lx",
                        "long_name": "illuminance of the visible disc on a plane normal to it",
                    },
                ),
                "trusted": (
                    ("time",),
                    block.prediction.trusted.astype(np.int8),
                    {"long_name": "such light was seen"},
                ),
            },
            coords={
                "time": ("time", times, {"long_name": "UTC, middle of the hour"}),
                "y": ("y", row_altitudes_deg(height), {"units": "degree", "long_name": "altitude"}),
                "x": (
                    "x",
                    column_azimuths_deg(width, self._heading),
                    {"units": "degree", "long_name": "azimuth"},
                ),
            },
            attrs={"heading_deg": self._heading, **self._about},
        )

    def __exit__(
        self, kind: type[BaseException] | None, error: object, trace: TracebackType | None
    ) -> None:
        if kind is None and self._started:
            shutil.rmtree(self._path, ignore_errors=True)
            self._work.rename(self._path)
        else:
            shutil.rmtree(self._work, ignore_errors=True)
