"""pairs.csv: one row for each panorama with its light; only the first four columns are required."""

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.core.records import parse_utc, utc_text
from fieldlum.core.strict_csv import CsvTable, read_table
from fieldlum.session.digests import change_of, sealed
from fieldlum.session.folder import session_around
from fieldlum.session.inside import inside, refuse_link
from fieldlum.session.writing import write_table

FORMAT = 1  # of the file; docs/file-formats.md
PAIR_COLUMNS = (
    "t_utc",
    "panorama",
    "dni_wm2",
    "dhi_wm2",
    "ghi_wm2",
    "source",
    "sun_altitude_deg",
    "sun_azimuth_deg",
    "steadiness",
    "sunpatch",
    "sun_in_map",
    "ok",
    "why",
    "format",
)
NEEDED = PAIR_COLUMNS[:4]
OPTIONAL = (*PAIR_COLUMNS, "state", "refraction")
MAX_IRRADIANCE_WM2 = 1600.0  # above the solar constant (1361), with cloud enhancement; chosen
MIN_IRRADIANCE_WM2 = -10.0  # night offset of a thermopile; chosen
NO_TIME = datetime(1, 1, 1, tzinfo=UTC)  # time of a row with ok = 0 whose own time is unreadable
_YES, _NO = ("", "1", "1.0", "true", "yes"), ("0", "0.0", "false", "no")


@dataclass(frozen=True, slots=True)
class PairRow:
    """One panorama and its light: the mean irradiances during its bracket.

    panorama, sunpatch: paths relative to the csv. An empty text means that there is none; NaN means
    unknown. sun_altitude_deg: true, without refraction; steadiness: range of the global irradiance
    over its mean; sun_in_map: whether the pictures contain the disc; refraction: False for a
    rendering that shows the sun at its true altitude; ok: whether the row may be
    used; why: the reason if not; state: of the room, such as lamp=on; line: number of the line in
    the csv, from 1, 0 if not read.
    """

    t_utc: datetime
    panorama: str
    dni_wm2: float
    dhi_wm2: float
    ghi_wm2: float = math.nan
    source: str = ""
    sun_altitude_deg: float = math.nan
    sun_azimuth_deg: float = math.nan
    steadiness: float = 0.0
    sunpatch: str = ""
    sun_in_map: bool = False
    ok: bool = True
    why: str = ""
    state: str = ""
    refraction: bool = True
    line: int = 0


@dataclass(frozen=True, slots=True)
class PairsFile:
    """A pairs.csv: rows in the file's order, its version, and warnings about its content."""

    path: Path
    rows: tuple[PairRow, ...]
    format: int = FORMAT
    warnings: tuple[str, ...] = ()

    @property
    def usable(self) -> tuple[PairRow, ...]:
        """Rows with ok = 1, which training uses."""
        return tuple(row for row in self.rows if row.ok)

    @property
    def refused(self) -> tuple[PairRow, ...]:
        """Rows with ok = 0, which training ignores; `why` has the reason."""
        return tuple(row for row in self.rows if not row.ok)

    @classmethod
    def read(cls, path: Path) -> PairsFile:
        """Read the file; numbers in rows with ok = 0 are not read.

        Raises InputError for a missing file, a missing required column, a newer format, or a wrong
        cell, with its line. Warns of a file that changed after `write`.
        """
        table = _table(path)
        rows = [_row(path, line, cells) for line, cells in table.dicts()]
        _refuse_foreign_pictures(path, rows)
        unknown = [name for name in table.names if name and name not in OPTIONAL]
        warnings = [f"{path.name}: unknown column {name} is ignored" for name in unknown]
        if change := change_of(path):
            warnings.append(f"WARNING: {change}")
        return cls(path, tuple(rows), _format(table), tuple(warnings))

    @classmethod
    def find(cls, path: Path) -> PairsFile:
        """Read the file as `read` does; a missing file has no rows."""
        return cls.read(path) if path.is_file() else cls(path, ())

    def write(self) -> None:
        """Write all rows without their state and refraction; NaN becomes an empty cell."""
        with sealed(self.path):
            write_table(self.path, PAIR_COLUMNS, map(_cells, self.rows))


def _refuse_foreign_pictures(path: Path, rows: Iterable[PairRow]) -> None:
    """Raise InputError for a picture outside the session that contains the csv.

    A csv that is in no session may name pictures anywhere: its user named it on the command line.
    """
    root = session_around(path)
    if root is None:
        return
    folder = path.parent.resolve()
    refuse_link(root, folder / path.name)
    for row in rows:
        for name in (row.panorama, row.sunpatch):
            if name:
                where = f"{path}: line {row.line}"
                inside(root, name, where, folder.relative_to(root).as_posix())


def _table(path: Path) -> CsvTable:
    """Return the table. Raises InputError for an unreadable file or missing required columns."""
    if not path.is_file():
        raise InputError(
            path, "no such file", "a pairs.csv", "write one with: fieldlum pair SESSION"
        )
    expected = f"a csv with the columns {', '.join(NEEDED)}"
    return read_table(path, expected, "name the columns in the first line", needed=NEEDED)


def _format(table: CsvTable) -> int:
    """Return the largest version in the column `format`; 1 if there is no such column."""
    texts = {cells.get("format") or "1" for _, cells in table.dicts()}
    newest = max((int(text) if text.isdigit() else 1 for text in texts), default=FORMAT)
    if newest > FORMAT:
        raise InputError(
            table.path,
            f"a csv of format {newest}",
            f"format 1 to {FORMAT}",
            "read the file with a newer fieldlum",
        )
    return newest


def _row(path: Path, line: int, cells: dict[str, str]) -> PairRow:
    def number(name: str, default: float = math.nan) -> float:
        return _number(path, line, name, cells.get(name) or "", default)

    text = {name: (cells.get(name) or "").strip() for name in OPTIONAL}
    if not _is_ok(path, line, text["ok"]):
        moment = NO_TIME
        with suppress(ValueError):
            moment = parse_utc(cells["t_utc"])
        nan, panorama, why = math.nan, text["panorama"], text["why"]
        return PairRow(moment, panorama, nan, nan, ok=False, why=why, line=line)
    if not text["panorama"]:
        raise InputError(
            path,
            f"line {line}: the cell of column panorama is empty",
            "a picture's path",
            "write the picture's path, or set ok = 0",
        )
    return PairRow(
        _time(path, line, cells["t_utc"]),
        text["panorama"],
        _irradiance(path, line, "dni_wm2", cells["dni_wm2"]),
        _irradiance(path, line, "dhi_wm2", cells["dhi_wm2"]),
        number("ghi_wm2"),
        text["source"],
        number("sun_altitude_deg"),
        number("sun_azimuth_deg"),
        number("steadiness", 0.0),
        text["sunpatch"],
        number("sun_in_map", 0.0) != 0.0,
        why=text["why"],
        state=text["state"],
        refraction=number("refraction", 1.0) != 0.0,
        line=line,
    )


def _time(path: Path, line: int, text: str) -> datetime:
    try:
        return parse_utc(text)
    except ValueError as error:
        raise InputError(
            path,
            f"line {line}: {error}",
            "a UTC time such as 2027-03-20T15:30:00Z",
            "correct the time",
        ) from None


def _is_ok(path: Path, line: int, text: str) -> bool:
    """Return whether a row is usable; an empty cell means yes, as in a csv of renderings.

    Raises InputError for a value other than 0 and 1.
    """
    word = text.strip().lower()
    if word in _YES or word in _NO:
        return word in _YES
    return _number(path, line, "ok", text, 1.0) != 0.0


def _number(path: Path, line: int, name: str, text: str, default: float) -> float:
    if not text.strip():
        return default
    try:
        value = float(text)
    except ValueError:
        raise InputError(
            path, f"line {line}: {name} is '{text}'", "a number", "correct that row"
        ) from None
    if not math.isfinite(value):
        raise InputError(
            path,
            f"line {line}: {name} is {text}",
            "a finite number",
            "correct that row or set ok = 0",
        )
    return value


def _irradiance(path: Path, line: int, name: str, text: str) -> float:
    value = _number(path, line, name, text, math.nan)
    if not MIN_IRRADIANCE_WM2 <= value <= MAX_IRRADIANCE_WM2:
        raise InputError(
            path,
            f"line {line}: {name} is '{text}'",
            f"{MIN_IRRADIANCE_WM2:g} to {MAX_IRRADIANCE_WM2:g} W/m2",
            "correct that cell, or set ok = 0",
        )
    return max(value, 0.0)


def _cells(row: PairRow) -> Iterable[str]:
    return (
        utc_text(row.t_utc),
        row.panorama,
        *(_text(v, 3) for v in (row.dni_wm2, row.dhi_wm2, row.ghi_wm2)),
        row.source,
        *(_text(v, 5) for v in (row.sun_altitude_deg, row.sun_azimuth_deg)),
        _text(row.steadiness, 4),
        row.sunpatch,
        str(int(row.sun_in_map)),
        str(int(row.ok)),
        row.why,
        str(FORMAT),
    )


def _text(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"
