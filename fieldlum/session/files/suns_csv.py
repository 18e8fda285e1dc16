"""suns.csv: the sun of each merged panorama, completed by `pair`; panoramas are not rewritten."""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields
from pathlib import Path

from fieldlum.core.errors import InputError, reason_of
from fieldlum.core.records import SunSource
from fieldlum.core.strict_csv import read_table
from fieldlum.session.files.json_file import from_json
from fieldlum.session.writing import write_table

FORMAT = 1  # of the file; docs/file-formats.md
_EXPECTED, _REMEDY = "a suns.csv written by pair", "run fieldlum pair again"


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
        return SunSource(
            self.altitude_deg,
            self.azimuth_deg,
            self.normal_illuminance_lx,
            self.visible_fraction,
            self.origin,
        )


COLUMNS = tuple(field.name for field in fields(SunRow))


def write_suns(path: Path, rows: list[SunRow]) -> None:
    """Write suns.csv: a header and all rows."""
    write_table(path, COLUMNS, (astuple(row) for row in rows))


def read_suns(path: Path) -> dict[str, SunRow]:
    """Return the rows by panorama; empty for a missing file.

    Raises InputError, with the line, for other content.
    """
    if not path.is_file():
        return {}
    rows: dict[str, SunRow] = {}
    line = 1
    try:
        for number, cells in read_table(path, _EXPECTED, _REMEDY).dicts():
            line = number
            row = _row(cells)
            rows[row.panorama] = row
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(path, f"line {line}: {reason_of(error)}", _EXPECTED, _REMEDY) from None
    return rows


def _row(cells: dict[str, str]) -> SunRow:
    row = from_json(SunRow, {**cells, "format": cells.get("format") or 1})
    if row.format > FORMAT:
        raise ValueError(f"format {row.format}, this fieldlum reads 1 to {FORMAT}")
    return row
