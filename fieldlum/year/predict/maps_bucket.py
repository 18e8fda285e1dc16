"""Store all maps of a year in a bucket, or any other store to which fsspec writes by URL."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path

from fieldlum.core.arrays import Floats
from fieldlum.session.bucket import BucketStore
from fieldlum.session.provenance import digest
from fieldlum.year.predict.blocks import ModelRoom
from fieldlum.year.predict.maps import add_hours, describe

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
