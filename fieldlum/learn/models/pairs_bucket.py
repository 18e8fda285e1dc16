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

from fieldlum.core.arrays import Array
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
_HOURS = {
    "dni_wm2": "direct normal irradiance, W m-2",
    "dhi_wm2": "diffuse horizontal irradiance, W m-2",
    "sun_altitude_deg": "true altitude of the sun",
    "sun_azimuth_deg": "azimuth of the sun, clockwise from north",
}
_PICTURES = {
    "luminance_cdm2": "luminance without the sun's disc, cd m-2",
    "patch_cdm2": "luminance of the direct sun alone, cd m-2",
    "counts": "weights of the pixels in training",
}


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

    light = data.light
    height, width = data.shape
    pictures = {name: getattr(data, name) for name in _PICTURES}
    hours = {name: getattr(light, name) for name in _HOURS} | {
        "disc_lx": data.disc_lx,
        "steadiness": data.steadiness,
        "day": data.days.astype("datetime64[D]").astype(np.int64),
        **({} if data.doubted is None else {"doubted": data.doubted.astype(np.int8)}),
    }
    frame = xr.Dataset(
        {
            **{name: (("time",), values) for name, values in hours.items()},
            **{
                name: (("time", "y", "x"), values)
                for name, values in pictures.items()
                if values is not None
            },
            "seen": (("y", "x"), data.seen.astype(np.int8)),
        },
        coords={
            "time": ("time", np.array([t.replace(tzinfo=None) for t in light.t_utc], "M8[us]")),
            "y": ("y", row_altitudes_deg(height), {"units": "degree", "long_name": "altitude"}),
            "x": (
                "x",
                column_azimuths_deg(width, data.heading_deg),
                {"units": "degree", "long_name": "azimuth"},
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
    for name, text in {**_HOURS, **_PICTURES, "day": "local date, days since 1970-01-01"}.items():
        if name in frame:
            frame[name].attrs["long_name"] = text
    shards: dict[str, dict[str, Any]] = {
        name: {"chunks": (1, height, width), "shards": (_SHARD, height, width)}
        for name in _PICTURES
        if name in frame
    }
    time = {"time": {"units": "microseconds since 1970-01-01", "dtype": "int64"}}
    frame.to_zarr(folder, mode="w", zarr_format=3, consolidated=False, encoding={**time, **shards})


def _read_store(url: str, about: JsonTable) -> Dataset:
    import xarray as xr

    with xr.open_zarr(url, consolidated=False, zarr_format=3) as opened:
        frame = opened.load()

    def array(name: str) -> Array:
        return frame[name].to_numpy()

    times = tuple(t.replace(tzinfo=UTC) for t in frame["time"].to_numpy().astype("M8[us]").tolist())
    states = about["states"]
    light = Light(
        times,
        array("dni_wm2"),
        array("dhi_wm2"),
        array("sun_altitude_deg"),
        array("sun_azimuth_deg"),
        states=None if states is None else tuple(states),
        refraction=about["refraction"],
    )
    maps, patch, counts = (array(name) if name in frame else None for name in _PICTURES)
    assert maps is not None
    return Dataset(
        light=light,
        luminance_cdm2=maps,
        patch_cdm2=patch,
        disc_lx=array("disc_lx"),
        heading_deg=about["heading_deg"],
        days=array("day").astype("M8[D]"),
        slots=tuple(slot_id(t) for t in times),
        setup=site_from_table(about["setup"], url),
        seen=array("seen").astype(bool),
        steadiness=array("steadiness"),
        source=url,
        notes=tuple(about["notes"]),
        counts=counts,
        doubted=array("doubted").astype(bool) if "doubted" in frame else None,
    )
