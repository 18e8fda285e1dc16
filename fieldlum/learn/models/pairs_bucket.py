"""Training data in a bucket: the panoramas of a session with their light, as one Zarr store.

The store holds what `models.data.load_pairs` returns, and the digest of it. `read_pairs` refuses
data with another digest, so a model of the store is the model of the session.
"""

from __future__ import annotations

import shutil
from datetime import UTC
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import JsonTable, slot_id
from fieldlum.learn.models.data import Dataset
from fieldlum.optics.projection import column_azimuths_deg, row_altitudes_deg
from fieldlum.session.bucket import BucketStore
from fieldlum.session.site_toml import site_from_table, site_table
from fieldlum.sky.light import Light

NAME = "pairs.zarr"
FORMAT = 1
_WRITE_AGAIN = "write it again with: fieldlum pair SESSION --pairs-to URL"
_SHARD = 16  # captures in an object: 7 MB of luminance at 460 x 230; not measured
_LIGHT = ("dni_wm2", "dhi_wm2", "sun_altitude_deg", "sun_azimuth_deg")  # fields of `Light`
_HOURS = ("disc_lx", "steadiness")  # fields of `Dataset`, as the others
_PICTURES = ("luminance_cdm2", "patch_cdm2", "counts")


def store_of(url: str) -> BucketStore:
    """Return the store pairs.zarr below a URL."""
    return BucketStore(f"{url.rstrip('/')}/{NAME}")


def write_pairs(data: Dataset, url: str, draft: Path) -> bool:
    """Write the captures to pairs.zarr below a URL; return False if they are there already.

    draft: local folder in which the store is written first.
    """
    store, digest = store_of(url), data.digest()
    if store.is_made_from(digest):
        return False
    shutil.rmtree(draft, ignore_errors=True)
    _write_store(data, draft)
    store.begin(draft)
    store.finish(draft, digest)
    shutil.rmtree(draft, ignore_errors=True)
    return True


def read_pairs(url: str) -> Dataset:
    """Return the captures of a pairs.zarr; url: of the store or of the folder that contains it.

    Raises InputError if there is no complete store, if its format is unknown, or if its content is
    not what was written.
    """
    store = store_of(url.rstrip("/").removesuffix(f"/{NAME}"))
    about = store.attributes()
    if about is None:
        raise InputError(
            store.target,
            "no complete pairs.zarr",
            "training data",
            "write it with: fieldlum pair SESSION --pairs-to URL, with the URL of its folder",
        )
    written = about.get("format")
    if written != FORMAT:
        is_newer = isinstance(written, int) and written > FORMAT
        raise InputError(
            store.target,
            f"format {written}",
            f"format {FORMAT}",
            "read it with a newer fieldlum" if is_newer else _WRITE_AGAIN,
        )
    data = _read_store(store.target, about)
    if not store.is_made_from(data.digest()):
        raise InputError(
            store.target,
            "content that was changed or damaged",
            "the content that fieldlum pair wrote",
            _WRITE_AGAIN,
        )
    return data


def _write_store(data: Dataset, folder: Path) -> None:
    import xarray as xr

    light, dims = data.light, ("time", "y", "x")
    arrays = {name: getattr(light, name) for name in _LIGHT}
    arrays |= {name: getattr(data, name) for name in (*_HOURS, *_PICTURES)}
    arrays["day"] = data.days.astype("datetime64[D]").astype(np.int64)  # since 1970
    arrays["doubted"] = None if data.doubted is None else data.doubted.astype(np.int8)
    frame = xr.Dataset(
        {name: (dims[: v.ndim], v) for name, v in arrays.items() if v is not None},
        coords={
            "time": ("time", np.array([t.replace(tzinfo=None) for t in light.t_utc], "M8[us]")),
            "y": ("y", row_altitudes_deg(data.shape[0]), {"long_name": "altitude, degrees"}),
            "x": (
                "x",
                column_azimuths_deg(data.shape[1], data.heading_deg),
                {"long_name": "azimuth, degrees"},
            ),
        },
        attrs={
            "format": FORMAT,
            "heading_deg": data.heading_deg,
            "setup": site_table(data.setup),
            "notes": list(data.notes),
            "states": None if light.states is None else list(light.states),
            "refraction": light.refraction,
        },
    )
    frame["seen"] = dims[1:], data.seen.astype(np.int8)
    pictures: dict[str, dict[str, Any]] = {
        name: {"chunks": (1, *data.shape), "shards": (_SHARD, *data.shape)}
        for name in _PICTURES
        if name in frame
    }
    time = {"time": {"units": "microseconds since 1970-01-01", "dtype": "int64"}}
    frame.to_zarr(
        folder, mode="w", zarr_format=3, consolidated=False, encoding={**time, **pictures}
    )


def _read_store(url: str, about: JsonTable) -> Dataset:
    import xarray as xr

    with xr.open_zarr(url, consolidated=False, zarr_format=3) as opened:
        frame = opened.load()
    arrays: dict[str, Any] = {str(name): frame[name].to_numpy() for name in frame.variables}
    times = tuple(t.replace(tzinfo=UTC) for t in arrays["time"].astype("M8[us]").tolist())
    states = None if about["states"] is None else tuple(about["states"])
    light = {name: arrays[name] for name in _LIGHT}
    doubted = arrays.get("doubted")
    same: dict[str, Any] = {name: arrays.get(name) for name in (*_HOURS, *_PICTURES)}
    return Dataset(
        Light(times, **light, states=states, refraction=about["refraction"]),
        **same,
        heading_deg=about["heading_deg"],
        days=arrays["day"].astype("M8[D]"),
        slots=tuple(slot_id(t) for t in times),
        setup=site_from_table(about["setup"], url),
        seen=arrays["seen"].astype(bool),
        source=url,
        notes=tuple(about["notes"]),
        doubted=None if doubted is None else doubted.astype(bool),
    )
