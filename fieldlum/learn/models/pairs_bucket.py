"""Training data in a bucket: the panoramas of a session with their light, as one Zarr store.

The store holds what `models.data.load_pairs` returns, and the digest of it. `read_pairs` refuses
data with another digest, so a model of the store is the model of the session. A bucket has no
rename: the zarr.json of the store's root is deleted first and written last, so that an interrupted
upload cannot be opened.
"""

from __future__ import annotations

import json
import shutil
from contextlib import AbstractContextManager
from datetime import UTC
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from fieldlum.core.errors import InputError, input_errors, install_text
from fieldlum.core.records import JsonTable, slot_id
from fieldlum.learn.models.data import Dataset
from fieldlum.optics.projection import column_azimuths_deg, row_altitudes_deg
from fieldlum.session.site_toml import site_from_table, site_table
from fieldlum.sky.light import Light

NAME = "pairs.zarr"
FORMAT = 1
_WRITE_AGAIN = "write it again with: fieldlum pair SESSION --pairs-to URL"
_SHARD = 16  # captures in an object: 7 MB of luminance at 460 x 230; not measured
_LIGHT = ("dni_wm2", "dhi_wm2", "sun_altitude_deg", "sun_azimuth_deg")  # fields of `Light`
_HOURS = ("disc_lx", "steadiness")  # fields of `Dataset`, as the others
_PICTURES = ("luminance_cdm2", "patch_cdm2", "counts")
_ROOT = "zarr.json"  # of the store; without it nothing opens the store (Zarr v3)
_MADE_FROM = "made_from_sha256"
_URL = "a URL such as s3://BUCKET/FOLDER"
_CONTAINER_SCHEMES = ("abfs", "abfss")  # CONTAINER@ACCOUNT is no user (adlfs, hadoop-azure)


class BucketStore:
    """One Zarr store at a URL.

    Raises InputError for a malformed URL or one whose client library is not installed. Its methods
    raise InputError if the bucket does not answer.
    """

    def __init__(self, url: str) -> None:
        self.target = url.rstrip("/")
        self._fs, self._path = _file_system(self.target)

    def attributes(self) -> JsonTable | None:
        """Return the attributes of a complete store; None if there is none at the URL."""
        with self._reached():
            if not self._fs.exists(f"{self._path}/{_ROOT}"):
                return None
            table = json.loads(self._fs.cat_file(f"{self._path}/{_ROOT}"))
        return table.get("attributes", {})

    def is_made_from(self, digest: str) -> bool:
        """Return whether a complete store with this digest of its inputs is at the URL."""
        attributes = self.attributes()
        return attributes is not None and attributes.get(_MADE_FROM) == digest

    def begin(self, draft: Path) -> None:
        """Delete what is at the URL, then upload a folder's files without zarr.json of its root."""
        with self._reached():
            if self._fs.exists(f"{self._path}/{_ROOT}"):
                self._fs.rm(f"{self._path}/{_ROOT}")
            if self._fs.exists(self._path):
                self._fs.rm(self._path, recursive=True)
            for path in sorted(draft.rglob("*")):
                name = path.relative_to(draft).as_posix()
                if path.is_file() and name != _ROOT:
                    self._fs.pipe_file(f"{self._path}/{name}", path.read_bytes())

    def finish(self, draft: Path, digest: str) -> None:
        """Upload the root's zarr.json with the digest of the inputs: the store is complete."""
        table = json.loads((draft / _ROOT).read_text(encoding="utf-8"))
        table.setdefault("attributes", {})[_MADE_FROM] = digest
        with self._reached():
            self._fs.pipe_file(f"{self._path}/{_ROOT}", json.dumps(table, indent=2).encode())

    def _reached(self) -> AbstractContextManager[None]:
        """Turn what a client library raises into one line; each has exceptions of its own."""
        remedy = "check address, bucket and credentials, then run the command again"
        return input_errors(self.target, "a bucket that answers", remedy, Exception)


def check_url(url: str, option: str, instead: str) -> None:
    """Raise InputError for a text that is no URL of a bucket, or for one with a user or password.

    URLs of local files (file:, local:) and chained ones (with ::) count as no bucket. In an Azure
    URL (abfs, abfss) the name before the @ is the container, which is allowed. option, instead: the
    option's name and the remedy, for the error.
    """
    parts = urlsplit(url)
    if parts.scheme in ("", "file", "local") or "::" in url:
        raise InputError(option, url, _URL, instead)
    if parts.password or (parts.username and parts.scheme not in _CONTAINER_SCHEMES):
        remedy = "give them to the client library, for S3 by AWS_ACCESS_KEY_ID or ~/.aws"
        raise InputError(option, "a URL with a user or password", "a URL without these", remedy)


def _file_system(url: str) -> tuple[Any, str]:
    try:
        from fsspec.core import url_to_fs

        with input_errors(url, _URL, "correct the URL", ValueError):
            return url_to_fs(url)
    except ImportError as error:
        found = f"the library for this kind of URL is not installed ({error})"
        remedy = f"for s3:// {install_text('cloud')}; else install that library"
        raise InputError(url, found, remedy=remedy) from None


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
