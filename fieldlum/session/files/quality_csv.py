"""panoramas/quality.csv: one row for each merged bracket, to read or to open in a spreadsheet."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path

from fieldlum.core.strict_csv import read_table
from fieldlum.session.codec import write_rows


@dataclass(frozen=True, slots=True)
class QualityRow:
    """Figures of one merged bracket; the fields are the columns.

    None, an empty cell, means that a figure could not be determined. The figures are those of
    `MergeReport`, and: verdict: "good", or what to check; sun_lx: on a plane normal to the sun.
    """

    slot: str
    t_utc: str
    verdict: str
    frames: int
    residual_percent: float | None = None
    exposure_span_percent: float | None = None
    shift_px: float | None = None
    shift_u_px: float | None = None
    motion_percent: float | None = None
    clipped_percent: float | None = None
    bloom_percent: float | None = None
    below_noise_percent: float | None = None
    outside_percent: float | None = None
    u_ratio_percent: float | None = None
    sun_lx: float | None = None
    sun_origin: str = ""
    vertical_illuminance_lx: float | None = None


QUALITY_COLUMNS = tuple(field.name for field in fields(QualityRow))


def write_quality(path: Path, rows: Iterable[QualityRow]) -> None:
    """Write quality.csv: a header and all rows, numbers with four digits."""
    write_rows(path, rows, QUALITY_COLUMNS, dict.fromkeys(QUALITY_COLUMNS, ".4g"))


def read_quality(path: Path) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Return the columns and the rows of a quality.csv as text; both empty for a missing file.

    Raises InputError, with the line, for a damaged file.
    """
    if not path.is_file():
        return (), ()
    table = read_table(path, "a quality.csv that merge wrote", "run fieldlum merge again")
    return table.names, tuple(cells for _, cells in table.rows)
