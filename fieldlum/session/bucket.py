"""Zarr stores below the URL of a bucket, or of any other store that fsspec writes to.

A bucket has no rename. The zarr.json of a store's root is deleted first and written last, so that
an interrupted upload cannot be opened.
"""

from __future__ import annotations

import json
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from fieldlum.core.errors import InputError, input_errors, install_text
from fieldlum.core.records import JsonTable

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
        self.upload(draft)

    def upload(self, draft: Path, below: str = "") -> None:
        """Upload the files of folder `draft`, without zarr.json of its root.

        below : name of a folder in it; then only that folder's files are uploaded.
        """
        with self._reached():
            for path in sorted((draft / below).rglob("*")):
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
