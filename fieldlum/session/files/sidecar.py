"""panoramas/SLOT.json: how a panorama was merged, how well, and from what."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from fieldlum.errors import InputError
from fieldlum.records import Exposure, parse_utc, utc_text
from fieldlum.session.files.json_file import check_format, read_object, write_object
from fieldlum.session.plan_file import parse_exposure

FORMAT = 1
_EXPECTED, _REMEDY = "the sidecar of a merged panorama", "merge the bracket again"


@dataclass(frozen=True, slots=True)
class FrameQuality:
    """One frame of `quality.frames`. correction: fitted over assumed exposure; u_percent: its u."""

    file: str
    exposure: Exposure
    correction: float
    u_percent: float
    heading_deg: float | None = None
    t_utc: datetime | None = None


@dataclass(frozen=True, slots=True)
class NeighbourQuality:
    """One pair of `quality.neighbours`: numbers of the frames within their heading."""

    long: int
    short: int
    residual_percent: float
    u_percent: float
    pixels: int = 0


@dataclass(frozen=True, slots=True)
class Sidecar:
    """One sidecar. quality: the table that `merge --json` prints; its typed parts are below."""

    slot: str
    t_utc: datetime | None = None
    verdict: str = ""
    quality: dict[str, Any] = field(default_factory=dict)
    sun: dict[str, Any] | None = None
    factors: dict[str, Any] = field(default_factory=dict)
    profile_name: str = ""
    profile_sha256: str = ""
    inputs: dict[str, Any] = field(default_factory=dict)
    size_bytes: int = -1
    fieldlum: str = ""
    frames: tuple[FrameQuality, ...] = ()
    neighbours: tuple[NeighbourQuality, ...] = ()

    @property
    def lost(self) -> tuple[str, ...]:
        """Frames that could not be read: the bracket was merged without them."""
        return tuple(self.quality.get("lost") or ())

    @property
    def sun_u_percent(self) -> float:
        """What too few pixels under the sun's disc may cost its illuminance."""
        return float((self.sun or {}).get("u_mosaic_percent") or 0.0)

    @classmethod
    def read(cls, path: Path) -> Sidecar:
        """Raises InputError for a missing file or other content."""
        return cls.from_table(read_object(path, _EXPECTED, _REMEDY), path)

    @classmethod
    def from_table(cls, table: dict[str, Any], path: Path) -> Sidecar:
        """Build from the JSON object of `path`. Raises InputError for other content."""
        check_format(table, FORMAT, path)
        try:
            quality = dict(table.get("quality") or {})
            profile = table.get("profile") or {}
            return cls(
                str(table.get("slot") or path.stem),
                parse_utc(table["t_utc"]) if table.get("t_utc") else None,
                str(table.get("verdict", "")),
                quality,
                table.get("sun"),
                dict(table.get("factors") or {}),
                str(profile.get("name", "")),
                str(profile.get("sha256", "")),
                dict(table.get("inputs") or {}),
                int(table.get("size_bytes", -1)),
                str((table.get("software") or {}).get("fieldlum", "")),
                tuple(_frame(row) for row in quality.get("frames", ())),
                tuple(_neighbour(row) for row in quality.get("neighbours", ())),
            )
        except (KeyError, TypeError, ValueError, AttributeError, ArithmeticError) as error:
            found = f"{type(error).__name__}: {error}"
            raise InputError(path, found, _EXPECTED, _REMEDY) from None

    @classmethod
    def find(cls, path: Path) -> Sidecar | None:
        """Return None where there is no file: a panorama that somebody copied here."""
        return cls.read(path) if path.is_file() else None

    def write(self, path: Path) -> None:
        write_object(
            path,
            {
                "format": FORMAT,
                "slot": self.slot,
                "t_utc": utc_text(self.t_utc) if self.t_utc else "",
                "verdict": self.verdict,
                "quality": self.quality,
                "sun": self.sun,
                "factors": self.factors,
                "profile": {"name": self.profile_name, "sha256": self.profile_sha256},
                "inputs": self.inputs,
                "size_bytes": self.size_bytes,
                "software": {"fieldlum": self.fieldlum},
            },
        )


def exposure_keys(exposure: Exposure) -> dict[str, Any]:
    """Return an exposure as numbers, next to its text, for a row of `quality.frames`."""
    return {
        "shutter_s": exposure.shutter_s,
        "f_number": exposure.f_number,
        "iso": exposure.iso,
        "nd": exposure.nd,
    }


def _frame(row: dict[str, Any]) -> FrameQuality:
    """Version 0.1.0 wrote the exposure as text alone, with six digits of the shutter time."""
    exposure = parse_exposure(row["exposure"])
    if float(row["correction"]) <= 0.0:
        raise ValueError(f"correction {row['correction']}")
    if "shutter_s" in row:
        shutter_s, f_number, iso = (float(row[name]) for name in ("shutter_s", "f_number", "iso"))
        exposure = Exposure(shutter_s, f_number, iso, str(row.get("nd", "")))
    heading = row.get("heading_deg")
    return FrameQuality(
        str(row.get("file", "")),
        exposure,
        float(row["correction"]),
        float(row.get("u_percent", "nan")),
        None if heading is None else float(heading),
        parse_utc(row["t_utc"]) if row.get("t_utc") else None,
    )


def _neighbour(row: dict[str, Any]) -> NeighbourQuality:
    return NeighbourQuality(
        int(row["long"]),
        int(row["short"]),
        float(row["residual_percent"]),
        float(row["u_percent"]),
        int(row.get("pixels", 0)),
    )
