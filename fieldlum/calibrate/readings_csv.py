"""Read tables of readings, and write profiles."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

from fieldlum.core.errors import InputError
from fieldlum.core.strict_csv import (
    CsvTable,
    Line,
    lines_of,
    numbered,
    read_text,
    split_header,
    table_of,
)
from fieldlum.optics.profiles import CameraProfile, Provenance, save_profile
from fieldlum.session import sha256
from fieldlum.version import __version__

CsvRow = dict[str, Any]
"""The cells of a line by column: a number, a path, or None if empty."""


def read_table(path: Path, needed: Sequence[str], also: Sequence[str] = ()) -> list[CsvRow]:
    """Return the rows of a csv as dicts: numbers, and paths in the columns `file` and `panorama`.

    needed, also : required and optional columns. Paths are relative to the csv. Separators are
    commas, semicolons or tabs; with the last two, decimals may have a comma. An empty cell is None.
    Empty lines and lines that begin with # are skipped. Raises InputError for a missing or unknown
    column, an invalid cell, or a csv without readings.
    """
    lines = _lines(path)
    mark = _separator(lines)
    table = table_of(path, lines, mark) if lines else CsvTable(path, (), ())
    names = table.names
    columns = (*needed, *also)
    expected = f"columns {', '.join(columns)}"
    if missing := [name for name in needed if name not in names]:
        raise InputError(
            path, f"no column {missing[0]}", expected, "name the columns in the first line"
        )
    if unknown := [name for name in names if name not in columns]:
        raise InputError(path, f"unknown column {unknown[0]}", expected, "remove or rename it")
    readings = [
        {n: _cell(path, number, n, text, mark) for n, text in cells.items()}
        for number, cells in table.dicts()
    ]
    if not readings:
        raise InputError(
            path, "no readings", "one reading on each line", "add at least one reading"
        )
    return readings


def _lines(path: Path) -> list[Line]:
    """Return the lines of a csv with their numbers, without empty lines and comments."""
    return numbered(lines_of(read_text(path, "a csv of readings")))


def columns_of(path: Path) -> list[str]:
    """Return the column names in the header of a csv, without spaces around them.

    The list is empty for an empty file. Raises InputError if the file cannot be read.
    """
    lines = _lines(path)
    return split_header(path, lines[0], _separator(lines)) if lines else []


def _separator(lines: Sequence[Line]) -> str:
    """Return the separator of the header; many spreadsheets write semicolons."""
    return next((mark for mark in (",", ";", "\t") if lines and mark in lines[0][1]), ",")


def _cell(path: Path, number: int, name: str, text: str, mark: str) -> Any:
    if not text:
        return None
    if name in ("file", "panorama"):
        return path.parent / text
    try:
        return float(text if mark == "," else text.replace(",", "."))
    except ValueError:
        raise InputError(
            f"{path}:{number}",
            f"{name} is '{text}'",
            "a number",
            "write a number with a decimal point",
        ) from None


def needed(row: CsvRow, name: str, path: Path) -> Any:
    """Return the cell `name` of a row of `read_table`; raise InputError if it is empty.

    path : the csv, for the error.
    """
    if row.get(name) is None:
        raise InputError(
            path,
            f"an empty cell in the column {name}",
            "a value in every line",
            "fill in the missing value",
        )
    return row[name]


def save_calibration(
    out: Path,
    profile: CameraProfile,
    frames: Iterable[Path],
    lines: Sequence[str],
    today: date,
    **changed: Any,
) -> CameraProfile:
    """Write the profile with its fields in `changed` replaced, to the file `out`, and return it.

    The profile's provenance gets the sha256 of `frames`, and `lines` (one about each fit), dated
    `today`; the camera's date becomes `today`.
    """
    hashes = tuple(sorted({sha256(path) for path in frames}))
    before = profile.provenance
    provenance = Provenance(
        before.source,
        f"fieldlum {__version__} calibrate",
        tuple(dict.fromkeys((*before.frames_sha256, *hashes))),
        (*before.log, *(f"{today.isoformat()} {line}" for line in lines)),
    )
    new = replace(
        profile,
        camera=replace(profile.camera, date=today.isoformat()),
        provenance=provenance,
        **changed,
    )
    save_profile(out, new)
    return new
