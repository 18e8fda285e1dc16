"""Read the exposures that a user states for frames without EXIF, in exposures.csv."""

from __future__ import annotations

import csv
from functools import lru_cache
from pathlib import Path

from fieldlum.core.errors import InputError, input_errors

EXPOSURES_CSV = "exposures.csv"
COLUMNS = ("file", "shutter_s", "f_number", "iso")
NO_EXPOSURE = (0.0, 0.0, 0.0)


def stated_exposure(path: Path) -> tuple[float, float, float]:
    """Return the shutter time [s], f-number and ISO that exposures.csv states for a frame.

    The file is in the frame's folder. All are 0 without it, or if it does not name the frame.
    Raises InputError for an invalid one.
    """
    table = path.parent / EXPOSURES_CSV
    try:
        modified_ns = table.stat().st_mtime_ns
    except OSError:
        return NO_EXPOSURE
    return _rows(table, modified_ns).get(path.name, NO_EXPOSURE)


@lru_cache(maxsize=16)  # each frame of a bracket asks for it
def _rows(table: Path, modified_ns: int) -> dict[str, tuple[float, float, float]]:
    """Return the exposures by file name. modified_ns: only a key of the cache."""
    remedy = f"write the columns {','.join(COLUMNS)}, with one frame on each line"
    with (
        input_errors(table, "a csv in UTF-8", remedy, OSError, UnicodeDecodeError, csv.Error),
        table.open(encoding="utf-8-sig", newline="") as file,
    ):
        rows = [[cell.strip() for cell in row] for row in csv.reader(file, strict=True)]
    if not rows or tuple(rows[0]) != COLUMNS:
        shown = ",".join(rows[0])[:80] if rows else "nothing"
        raise InputError(table, f"a first line {shown}", ",".join(COLUMNS), remedy)
    exposures: dict[str, tuple[float, float, float]] = {}
    for number, row in enumerate(rows[1:], start=2):
        if not any(row):
            continue
        place = f"{table}:{number}"
        if len(row) != len(COLUMNS):
            raise InputError(
                place, f"{len(row)} cells", f"{len(COLUMNS)} cells: {','.join(COLUMNS)}", remedy
            )
        if row[0] in exposures:
            raise InputError(place, f"{row[0]} for the second time", "each frame once", remedy)
        shutter_s, f_number, iso = (_positive(cell, place) for cell in row[1:])
        exposures[row[0]] = shutter_s, f_number, iso
    return exposures


def _positive(cell: str, place: str) -> float:
    """Return a number above 0, which may be a fraction such as 1/60."""
    numerator, _, denominator = cell.partition("/")
    try:
        value = float(numerator) / float(denominator or 1)
    except (ValueError, ZeroDivisionError):
        value = 0.0
    if not 0 < value < float("inf"):
        raise InputError(
            place,
            repr(cell),
            "a number above 0, such as 0.5 or 1/60",
            "write decimals with a point",
        )
    return value
