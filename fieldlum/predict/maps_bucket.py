"""Store all maps of a year in a bucket, or any other store that fsspec writes to by URL."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import InputError
from fieldlum.predict.blocks import ModelRoom
from fieldlum.predict.maps import add_hours, describe
from fieldlum.session.provenance import digest

_ROOT = "zarr.json"  # of the store; without it nothing opens the store (Zarr v3)
_NAME = "maps.zarr"
_MADE_FROM = "made_from_sha256"


class BucketMapStore:
    """`maps.zarr` below a URL.

    A bucket has no rename. The root's zarr.json is deleted first and written last, so that an
    interrupted upload cannot be opened.

    inputs: what the year depends on; the store records its digest. draft: local folder in which
    the description of the store is written.
    """

    def __init__(self, url: str, inputs: Mapping[str, object], draft: Path) -> None:
        self._digest = digest(inputs)
        self.target = f"{url.rstrip('/')}/{_NAME}"
        self._fs, self._root = _file_system(self.target)
        self._draft = draft

    def create(self, t_utc: Sequence[datetime], room: ModelRoom, site_name: str) -> None:
        """Upload the coordinates and the description of the maps; delete earlier remains.

        Raises InputError for a URL that cannot be written to.
        """
        describe(self._draft, t_utc, room, {"site": site_name, _MADE_FROM: self._digest})
        with _reached(self.target):
            if self._fs.exists(f"{self._root}/{_ROOT}"):
                self._fs.rm(f"{self._root}/{_ROOT}")
            if self._fs.exists(self._root):
                self._fs.rm(self._root, recursive=True)
            self._upload(_ROOT)

    def finish(self, disc_lx: NDArray[np.float64], trusted: NDArray[np.float64]) -> None:
        """Upload the discs [n] lx and the trust [n], then the root's zarr.json."""
        add_hours(self._draft, disc_lx, trusted)
        with _reached(self.target):
            for name in ("disc_lx", "trusted"):
                self._upload(_ROOT, name)
            root = (self._draft / _ROOT).read_bytes()
            self._fs.pipe_file(f"{self._root}/{_ROOT}", root)
        shutil.rmtree(self._draft, ignore_errors=True)

    def _upload(self, without: str, below: str = "") -> None:
        for path in sorted((self._draft / below).rglob("*")):
            name = path.relative_to(self._draft).as_posix()
            if path.is_file() and name != without:
                self._fs.pipe_file(f"{self._root}/{name}", path.read_bytes())


def is_complete(url: str, inputs: Mapping[str, object]) -> bool:
    """Return whether a finished maps.zarr of these inputs is below the URL."""
    target = f"{url.rstrip('/')}/{_NAME}"
    fs, root = _file_system(target)
    with _reached(target):
        if not fs.exists(f"{root}/{_ROOT}"):
            return False
        table = json.loads(fs.cat_file(f"{root}/{_ROOT}"))
    return table.get("attributes", {}).get(_MADE_FROM) == digest(inputs)


def check_url(url: str) -> None:
    """Raise InputError for a text that is no URL of a bucket, or one with a password in it."""
    parts = urlsplit(url)
    if parts.scheme in ("", "file", "local") or "::" in url:
        raise InputError("--maps-to", url, "a URL such as s3://BUCKET/FOLDER", "use --maps")
    if parts.password or parts.username:
        remedy = "give it to the client library, for S3 by AWS_ACCESS_KEY_ID or ~/.aws"
        raise InputError("--maps-to", "a URL with a user or password", "a URL without", remedy)


def _file_system(url: str) -> tuple[Any, str]:
    try:
        from fsspec.core import url_to_fs

        return url_to_fs(url)
    except ImportError:
        remedy = "install it with: pip install 'fieldlum[cloud]'"
        raise InputError(url, "no client for this kind of URL", remedy=remedy) from None
    except ValueError as error:
        raise InputError(url, str(error)[:120], "a URL such as s3://BUCKET/FOLDER") from None


@contextmanager
def _reached(url: str) -> Iterator[None]:
    """Turn what a client library raises into one line; each has exceptions of its own."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        found = f"{type(error).__name__}: {str(error)[:160]}"
        remedy = "check address, bucket and credentials, then run the command again"
        raise InputError(url, found, "a bucket that can be written to", remedy) from error
