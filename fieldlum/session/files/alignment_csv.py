"""NAME.alignment.csv next to NAME.csv of pairs: how far the camera of each picture was turned."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

from fieldlum.session.writing import write_table


@dataclass(frozen=True, slots=True)
class AlignmentRow:
    """The pose of one picture; the fields are the columns.

    digest: of its pixels, so that another picture of the same name is compared again. Turns are
    relative to the pose of most pictures [deg]: heading clockwise, tilt up, roll clockwise; u_...:
    their standard uncertainties [deg]. aligned: False (0 in the file) for a picture that is not
    used.
    """

    panorama: str
    digest: str
    heading_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    u_heading_deg: float = 0.0
    u_tilt_deg: float = 0.0
    u_roll_deg: float = 0.0
    aligned: bool = True


_COLUMNS = tuple(field.name for field in fields(AlignmentRow))


def alignment_path(pairs: Path) -> Path:
    """Return the path of the table of camera turns (NAME.alignment.csv) of a csv of pairs."""
    return pairs.with_name(f"{pairs.stem}.alignment.csv")


def find_alignment(path: Path) -> tuple[AlignmentRow, ...]:
    """Return the rows of an alignment table; empty if the file is missing or has other content."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return tuple(_row(cells) for cells in csv.DictReader(file))
    except (OSError, UnicodeDecodeError, KeyError, ValueError, TypeError, csv.Error):
        return ()


def _row(cells: dict[str, str]) -> AlignmentRow:
    """Return the row of some cells. Raises KeyError, TypeError or ValueError for a wrong cell."""
    numbers = [float(cells[name]) for name in _COLUMNS[2:8]]
    if not all(math.isfinite(number) for number in numbers):
        raise ValueError("a number that is not finite")
    return AlignmentRow(
        cells["panorama"], cells["digest"], *numbers, aligned=bool(int(cells["aligned"]))
    )


def write_alignment(path: Path, rows: Sequence[AlignmentRow]) -> None:
    """Write all rows, with 4 decimals. Raises OSError if the folder is not writable."""
    cells = []
    for row in rows:
        name, digest, *numbers, aligned = astuple(row)
        cells.append((name, digest, *(f"{v:.4f}" for v in numbers), int(aligned)))
    write_table(path, _COLUMNS, cells)
