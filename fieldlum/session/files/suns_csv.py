"""suns.csv: the sun of each merged panorama, completed by `pair`; panoramas are not rewritten."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

from fieldlum.core.records import SunSource
from fieldlum.session.codec import check_format, read_rows, write_rows

FORMAT = 1  # of the file; docs/file-formats.md


@dataclass(frozen=True, slots=True)
class SunRow:
    """The sun of one panorama.

    panorama: path relative to the csv. altitude_deg: apparent; normal_illuminance_lx: on a plane
    normal to the sun; visible_fraction: of the disc; origin: how the illuminance is known.
    bound_lx: illuminance that the picture itself records; the row counts only while the two agree.
    """

    panorama: str
    altitude_deg: float
    azimuth_deg: float
    normal_illuminance_lx: float
    visible_fraction: float
    origin: str
    bound_lx: float
    format: int = FORMAT

    @property
    def source(self) -> SunSource:
        """The sun as a `SunSource`."""
        lx, share = self.normal_illuminance_lx, self.visible_fraction
        return SunSource(self.altitude_deg, self.azimuth_deg, lx, share, self.origin)


def write_suns(path: Path, rows: list[SunRow]) -> None:
    """Write suns.csv: a header and all rows."""
    write_rows(path, rows, [field.name for field in fields(SunRow)], {})


def read_suns(path: Path) -> dict[str, SunRow]:
    """Return the rows by panorama; empty for a missing file.

    Raises InputError, with the line, for other content.
    """
    if not path.is_file():
        return {}
    rows = read_rows(SunRow, path, "a suns.csv written by pair", "run fieldlum pair again")
    check_format(path, max((row.format for row in rows), default=FORMAT), FORMAT)
    return {row.panorama: row for row in rows}
