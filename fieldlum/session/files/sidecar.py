"""panoramas/SLOT.json: how a panorama was merged, its quality, and its inputs."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from msgspec import Struct, field

from fieldlum.core.errors import ChangedFileWarning, InputError
from fieldlum.core.records import JsonTable
from fieldlum.session.codec import JsonFile, Utc, to_json
from fieldlum.session.files.merge_report import MergeReport
from fieldlum.session.folder import Session
from fieldlum.session.writing import sha256


class MeasuredSun(Struct, frozen=True):
    """The sun's centre in the pictures, by the profile's lens and the camera's heading.

    altitude_deg, azimuth_deg: apparent, clockwise from north. sigma_deg: standard uncertainty of
    the centre along each axis, without that of lens and pose. t_utc: mean time of the frames that
    show it; None where their times are unknown.
    """

    altitude_deg: float
    azimuth_deg: float
    sigma_deg: float
    t_utc: Utc | None = None


class SidecarSun(Struct, frozen=True):
    """The sun's disc that was removed from a panorama.

    Angles are apparent ones, by the ephemeris. normal_illuminance_lx: at the lens, on a plane
    normal to the sun; u_mosaic_percent: its standard uncertainty because few pixels are under the
    disc. origin: how it was measured; lower_bound: every frame is clipped at the disc; measured:
    where the pictures show it, or None.
    """

    altitude_deg: float | None = None
    azimuth_deg: float | None = None
    normal_illuminance_lx: float | None = None
    u_mosaic_percent: float = 0.0
    origin: str = ""
    lower_bound: bool = False
    measured: MeasuredSun | None = None


class ProfileNote(Struct, frozen=True):
    """The camera profile of a merge: its name, and the sha256 of its file."""

    name: str = ""
    sha256: str = ""


class Sidecar(JsonFile, frozen=True):
    """The content of panoramas/SLOT.json, the sidecar of a merged panorama.

    t_utc: middle of the bracket; verdict: "good", or what to check; report: the key `quality`; sun:
    None without a disc; factors: of the merge, by name; inputs: what the result depends on;
    sha256: of the panorama, "" in a file of 0.1.0; software: versions.
    """

    EXPECTED = "the sidecar of a merged panorama"
    REMEDY = "merge the bracket again (fieldlum merge)"

    slot: str
    t_utc: Utc | None = None
    verdict: str = ""
    report: MergeReport = field(default=MergeReport(), name="quality")
    sun: SidecarSun | None = None
    factors: JsonTable = field(default_factory=dict)
    profile: ProfileNote = ProfileNote()
    inputs: JsonTable = field(default_factory=dict)
    sha256: str = ""
    software: Mapping[str, Any] = {}

    def fits(self, panorama: Path) -> bool:
        """Return whether a panorama has the recorded content, or none is recorded."""
        return self.sha256 in ("", sha256(panorama))

    @property
    def command_options(self) -> tuple[str, ...]:
        """Options of `fieldlum merge` that merge another bracket in the same way as this one.

        They are --size, and --fit or --no-fit, as far as the file records them.
        """
        height, fit = self.inputs.get("height"), self.inputs.get("fit")
        size = ("--size", f"{2 * height}x{height}") if isinstance(height, int) else ()
        fitted = () if fit is None else ("--fit" if fit else "--no-fit",)
        return (*size, *fitted)

    @classmethod
    def upgraded(cls, table: JsonTable, path: Path) -> JsonTable:
        """Return the table with its slot (in its file's name) and with the report built."""
        report = MergeReport.from_table(table.get("quality") or {})
        return {"slot": path.stem, **table, "quality": report}

    def table(self) -> JsonTable:
        """Return the JSON object, without optional keys of the report that have no value."""
        return {**to_json(self), "quality": self.report.table()}


def warn_if_changed(panorama: Path) -> None:
    """Warn with ChangedFileWarning if a panorama changed after merge wrote it."""
    with suppress(InputError):
        sidecar = Sidecar.find(panorama.with_suffix(".json"))
        if sidecar is not None and not sidecar.fits(panorama):
            text = (
                f"{panorama}: the content changed after merge wrote it; expected the sha256 in "
                f"{panorama.stem}.json; merge it again: fieldlum merge"
            )
            warnings.warn(text, ChangedFileWarning, stacklevel=2)


def readable_sidecars(paths: Iterable[Path]) -> Iterator[Sidecar]:
    """Yield the sidecars that can be read, in the order of `paths`.

    Others are damaged, or were not written by a merge.
    """
    for path in paths:
        with suppress(InputError):
            yield Sidecar.read(path)


def newest_sidecar(session: Session) -> Sidecar | None:
    """Return the sidecar of the latest panorama with a readable sidecar; None if there is none."""
    return next(readable_sidecars(reversed(session.sidecar_files())), None)
