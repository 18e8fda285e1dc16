"""panoramas/SLOT.json: how a panorama was merged, its quality, and its inputs."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from fieldlum.errors import InputError
from fieldlum.records import parse_utc, utc_text
from fieldlum.session.files.json_file import check_format, read_object, write_object
from fieldlum.session.files.merge_report import MergeReport
from fieldlum.session.folder import Session

FORMAT = 1
_EXPECTED, _REMEDY = "the sidecar of a merged panorama", "merge the bracket again"


@dataclass(frozen=True, slots=True)
class Sidecar:
    """One sidecar. report: how well the bracket was merged, the key `quality` of the file."""

    slot: str
    t_utc: datetime | None = None
    verdict: str = ""
    report: MergeReport = field(default_factory=MergeReport)
    sun: dict[str, Any] | None = None
    factors: dict[str, Any] = field(default_factory=dict)
    profile_name: str = ""
    profile_sha256: str = ""
    inputs: dict[str, Any] = field(default_factory=dict)
    size_bytes: int = -1
    fieldlum: str = ""

    @property
    def command_options(self) -> tuple[str, ...]:
        """Options of `fieldlum merge` that merge another bracket in the same way."""
        height, fit = self.inputs.get("height"), self.inputs.get("fit")
        size = ("--size", f"{2 * height}x{height}") if isinstance(height, int) else ()
        fitted = () if fit is None else ("--fit" if fit else "--no-fit",)
        return (*size, *fitted, *(("--drop-moved",) if self.inputs.get("drop_moved") else ()))

    @property
    def sun_u_percent(self) -> float:
        """Uncertainty of the sun's illuminance from few usable pixels on the disc [%]."""
        return float((self.sun or {}).get("u_mosaic_percent") or 0.0)

    @classmethod
    def read(cls, path: Path) -> Sidecar:
        """Read the file. Raises InputError for a missing file or other content."""
        return cls.from_table(read_object(path, _EXPECTED, _REMEDY), path)

    @classmethod
    def from_table(cls, table: dict[str, Any], path: Path) -> Sidecar:
        """Build from the JSON object of `path`. Raises InputError for other content."""
        check_format(table, FORMAT, path)
        try:
            profile = table.get("profile") or {}
            return cls(
                str(table.get("slot") or path.stem),
                parse_utc(table["t_utc"]) if table.get("t_utc") else None,
                str(table.get("verdict", "")),
                MergeReport.from_table(table.get("quality") or {}),
                table.get("sun"),
                dict(table.get("factors") or {}),
                str(profile.get("name", "")),
                str(profile.get("sha256", "")),
                dict(table.get("inputs") or {}),
                int(table.get("size_bytes", -1)),
                str((table.get("software") or {}).get("fieldlum", "")),
            )
        except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            found = f"{type(error).__name__}: {error}"
            raise InputError(path, found, _EXPECTED, _REMEDY) from None

    @classmethod
    def find(cls, path: Path) -> Sidecar | None:
        """Read the file; return None if it is missing, for a panorama copied here."""
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
                "sun": self.sun,
                "factors": self.factors,
                "profile": {"name": self.profile_name, "sha256": self.profile_sha256},
                "inputs": self.inputs,
                "size_bytes": self.size_bytes,
                "software": {"fieldlum": self.fieldlum},
            },
        )


def newest_sidecar(session: Session) -> Sidecar | None:
    """Return the sidecar of the latest panorama that has a readable one; None without any."""
    for path in reversed(session.sidecar_files()):
        try:
            return Sidecar.read(path)
        except InputError:
            continue
    return None
