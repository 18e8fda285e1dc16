"""panoramas/SLOT.json: how a panorama was merged, its quality, and its inputs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.core.records import JsonTable, utc_text
from fieldlum.session.files.json_file import (
    content_of,
    from_json,
    read_object,
    to_json,
    write_object,
)
from fieldlum.session.files.merge_report import MergeReport
from fieldlum.session.folder import Session

FORMAT = 1  # of the file; docs/file-formats.md
_EXPECTED, _REMEDY = "the sidecar of a merged panorama", "merge the bracket again (fieldlum merge)"


@dataclass(frozen=True, slots=True)
class MeasuredSun:
    """The sun's centre in the pictures, by the profile's lens and the camera's heading.

    altitude_deg, azimuth_deg: apparent, clockwise from north. sigma_deg: standard uncertainty of
    the centre along each axis, without that of lens and pose. t_utc: mean time of the frames that
    show it; None where their times are unknown.
    """

    altitude_deg: float
    azimuth_deg: float
    sigma_deg: float
    t_utc: datetime | None = None

    def table(self) -> dict[str, float | str]:
        """Return the JSON object, with 4 decimals of the angles and 3 digits of sigma."""
        return {
            "altitude_deg": round(self.altitude_deg, 4),
            "azimuth_deg": round(self.azimuth_deg, 4),
            "sigma_deg": float(f"{self.sigma_deg:.3g}"),
            "t_utc": utc_text(self.t_utc) if self.t_utc else "",
        }


@dataclass(frozen=True, slots=True)
class SidecarSun:
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


@dataclass(frozen=True, slots=True)
class Sidecar:
    """The content of panoramas/SLOT.json, the sidecar of a merged panorama.

    t_utc: middle of the bracket; verdict: "good", or what to check; report: the key `quality`; sun:
    None without a disc; factors: of the merge, by name; inputs: what the result depends on;
    size_bytes: of the panorama, -1 if unknown; fieldlum: version.
    """

    slot: str
    t_utc: datetime | None = None
    verdict: str = ""
    report: MergeReport = field(default_factory=MergeReport)
    sun: SidecarSun | None = None
    factors: JsonTable = field(default_factory=dict)
    profile_name: str = ""
    profile_sha256: str = ""
    inputs: JsonTable = field(default_factory=dict)
    size_bytes: int = -1
    fieldlum: str = ""

    @property
    def command_options(self) -> tuple[str, ...]:
        """Options of `fieldlum merge` that merge another bracket in the same way as this one.

        They are --size, --fit or --no-fit, and --drop-moved, as far as the file records them.
        """
        height, fit = self.inputs.get("height"), self.inputs.get("fit")
        size = ("--size", f"{2 * height}x{height}") if isinstance(height, int) else ()
        fitted = () if fit is None else ("--fit" if fit else "--no-fit",)
        return (*size, *fitted, *(("--drop-moved",) if self.inputs.get("drop_moved") else ()))

    @property
    def sun_u_percent(self) -> float:
        """Uncertainty of the sun's illuminance because few pixels are under the disc [%].

        It is 0 without a disc.
        """
        return self.sun.u_mosaic_percent if self.sun else 0.0

    @classmethod
    def read(cls, path: Path) -> Sidecar:
        """Read the file. Raises InputError for a missing file or other content."""
        return cls.from_table(read_object(path, _EXPECTED, _REMEDY), path)

    @classmethod
    def from_table(cls, table: JsonTable, path: Path) -> Sidecar:
        """Build from a JSON object; path: its file, for errors.

        Raises InputError for other content.
        """
        with content_of(table, FORMAT, path, _EXPECTED, _REMEDY):
            profile, software = table.get("profile") or {}, table.get("software") or {}
            stated = {
                "report": table.get("quality"),
                "profile_name": profile.get("name"),
                "profile_sha256": profile.get("sha256"),
                "fieldlum": software.get("fieldlum"),
            }
            return from_json(cls, {"slot": path.stem, **table, **stated})

    @classmethod
    def find(cls, path: Path) -> Sidecar | None:
        """Read the file; return None if it is missing. Raises InputError for other content."""
        return cls.read(path) if path.is_file() else None

    def write(self, path: Path) -> None:
        """Write the file."""
        write_object(
            path,
            {
                "format": FORMAT,
                "slot": self.slot,
                "t_utc": utc_text(self.t_utc) if self.t_utc else "",
                "verdict": self.verdict,
                "quality": self.report.table(),
                "sun": to_json(self.sun) if self.sun else None,
                "factors": self.factors,
                "profile": {"name": self.profile_name, "sha256": self.profile_sha256},
                "inputs": self.inputs,
                "size_bytes": self.size_bytes,
                "software": {"fieldlum": self.fieldlum},
            },
        )


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
