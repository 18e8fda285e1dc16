"""NAME.alignment.csv next to NAME.csv of pairs: how far the camera of each picture was turned."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.session.codec import read_rows, write_rows


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
        return tuple(read_rows(AlignmentRow, path, "camera turns", "", _COLUMNS))
    except InputError:
        return ()


def write_alignment(path: Path, rows: Sequence[AlignmentRow]) -> None:
    """Write all rows, with 4 decimals. Raises OSError if the folder is not writable."""
    write_rows(path, rows, _COLUMNS, dict.fromkeys(_COLUMNS, ".4f"))
