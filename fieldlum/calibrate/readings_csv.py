"""Read tables of readings, and write profiles."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from types import MappingProxyType
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
"""The cells of a line by column: numbers and paths."""


def read_table(
    path: Path, required: Sequence[str], optional: Mapping[str, Any] = MappingProxyType({})
) -> list[CsvRow]:
    """Return the rows of a csv as dicts: numbers, and paths in the columns `file` and `panorama`.

    required : columns with a value in every line; optional : other columns, with the value of a
    missing column or an empty cell; a zero counts as empty unless that value is zero or None. Paths
    are relative to the csv. Separators are commas,
    semicolons or tabs; with the last two, decimals may have a comma. Empty lines and lines that
    begin with # are skipped. Raises InputError for a missing or unknown column, an invalid or
    empty cell, or a csv without readings.
    """
    lines = _lines(path)
    mark = _separator(lines)
    table = table_of(path, lines, mark) if lines else CsvTable(path, (), ())
    expected = f"columns {', '.join((*required, *optional))}"
    if missing := [name for name in required if name not in table.names]:
        remedy = "name the columns in the first line"
        raise InputError(path, f"no column {missing[0]}", expected, remedy)
    if unknown := [name for name in table.names if name not in (*required, *optional)]:
        raise InputError(path, f"unknown column {unknown[0]}", expected, "remove or rename it")
    readings = []
    for number, cells in table.dicts():
        row = {n: _cell(path, number, n, text, mark) for n, text in cells.items() if text}
        if empty := [name for name in required if name not in row]:
            finding = f"an empty cell in the column {empty[0]}"
            raise InputError(path, finding, "a value in every line", "fill in the missing value")
        stated = {n: cell for n, cell in row.items() if cell or not optional.get(n)}
        readings.append({**optional, **stated})
    if not readings:
        remedy = "add at least one reading"
        raise InputError(path, "no readings", "one reading on each line", remedy)
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
    if name in ("file", "panorama"):
        return path.parent / text
    try:
        return float(text if mark == "," else text.replace(",", "."))
    except ValueError:
        finding, remedy = f"{name} is '{text}'", "write a number with a decimal point"
        raise InputError(f"{path}:{number}", finding, "a number", remedy) from None


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
