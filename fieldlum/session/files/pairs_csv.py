"""pairs.csv: one row for each panorama with its light; only the first four columns are required."""

from __future__ import annotations

import hashlib
import math
import posixpath
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.core.files import read_bytes, sha256
from fieldlum.core.records import counted, parse_utc, utc_text
from fieldlum.core.strict_csv import IRRADIANCE_LIMITS_WM2, read_table
from fieldlum.session import codec
from fieldlum.session.day_files import day_files
from fieldlum.session.files.sidecar import of_other_profile
from fieldlum.session.folder import Session
from fieldlum.session.journal import marks
from fieldlum.session.safe_paths import refuse_link, refuse_outside

FORMAT = 1  # of the file; docs/file-formats.md
NO_TIME = datetime(1, 1, 2, tzinfo=UTC)  # time of a row with ok = 0 whose own time is unreadable
_REMEDY = "correct that cell, or set ok = 0"


@dataclass(frozen=True, slots=True)
class PairRow:
    """One panorama and its light: the mean irradiances during its bracket.

    t_utc: middle of the bracket. panorama: its picture, sunpatch: a panorama of direct sun only;
    both paths relative to the csv. An empty text means that there is none; NaN means unknown.
    source: of the irradiance, measured or derived:dirint; sun_altitude_deg: true, without
    refraction; sun_azimuth_deg: clockwise from true north; steadiness: range of the global
    irradiance over its mean; sun_in_map: whether the pictures contain the disc; refraction: False
    for a rendering that shows the sun at its true altitude; ok: whether the row may be used; why:
    the reason if not, or a caution; doubtful: whether a usable row's irradiance is too uncertain to
    judge pictures by; format: version of the file; inputs: `light_digests` of when `pair` wrote
    the row, "" if another program or version did; state: of the room, such as lamp=on; line: number
    of the line in the csv, from 1, 0 if not read.
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
    doubtful: bool = False
    format: int = FORMAT
    inputs: str = ""
    state: str = ""
    refraction: bool = True
    line: int = 0


_KNOWN = tuple(field.name for field in fields(PairRow))[:-1]
PAIR_COLUMNS = _KNOWN[:-2]  # a user may add state and refraction
NEEDED = _KNOWN[:4]


@dataclass(frozen=True, slots=True)
class PairsFile:
    """A pairs.csv: rows in the file's order, and warnings about its content."""

    path: Path
    rows: tuple[PairRow, ...]
    warnings: tuple[str, ...] = ()

    @property
    def usable(self) -> tuple[PairRow, ...]:
        """Rows with ok = 1, which training uses."""
        return tuple(row for row in self.rows if row.ok)

    @property
    def refused(self) -> tuple[PairRow, ...]:
        """Rows with ok = 0, which training ignores; `why` has the reason."""
        return tuple(row for row in self.rows if not row.ok)

    @property
    def outdated(self) -> frozenset[str]:
        """Slots whose panorama, logged irradiance or mark changed since `pair` wrote the file.

        Rows without `inputs` do not count. Raises OSError if a file of the session cannot be read.
        """
        rows = {Path(row.panorama).stem: row for row in self.rows if row.inputs}
        session = Session(self.path.parent)
        if not session.toml.is_file():  # a copy of the table
            return frozenset()
        times, then = ({s: getattr(r, key) for s, r in rows.items()} for key in ("t_utc", "inputs"))
        now = light_digests(session, times, then)
        return frozenset(slot for slot, row in rows.items() if row.inputs != now[slot])

    @property
    def pair_again(self) -> list[str]:
        """Warnings if a row is `outdated`, and of panoramas of another camera profile."""
        texts, session = [], Session(self.path.parent)
        # without its frames, a panorama cannot be merged again
        frames = {file.parent.name for file in session.raw.glob("*/*.*") if file.suffix != ".json"}
        others = [sidecar for sidecar in of_other_profile(session) if sidecar.slot in frames]
        if others:
            found = f"WARNING: {counted(len(others), 'panorama')} of another camera profile"
            texts.append(f"{found} than the present one: run fieldlum merge and pair again")
        if count := len(self.outdated):
            what = "picture, irradiance or mark changed after pair"
            texts.append(f"WARNING: {counted(count, 'pair')}: {what}: run fieldlum pair again")
        return texts

    @classmethod
    def read(cls, path: Path) -> PairsFile:
        """Return the content of a pairs.csv; numbers in rows with ok = 0 are not read.

        Raises InputError for a missing file, a missing required column, a newer format, or a wrong
        cell, with its line; also, if the csv is in a session, for a picture outside the session and
        for a link that the user did not permit. Warns of a file that changed after `write`.
        """
        expected = f"a csv with the columns {', '.join(NEEDED)}, as fieldlum pair writes"
        table = read_table(path, expected, "name the columns in the first line", needed=NEEDED)
        rows = [_row(path, line, cells) for line, cells in table.dicts()]
        _refuse_foreign_pictures(path, rows)
        unknown = [name for name in table.names if name and name not in _KNOWN]
        warnings = [f"{path.name}: unknown column {name} is ignored" for name in unknown]
        if change := codec.warn_if_changed(path):
            warnings.append(f"WARNING: {change}")
        return cls(path, tuple(rows), tuple(warnings))

    @classmethod
    def find(cls, path: Path) -> PairsFile:
        """Return the content as `read` does, with the same errors; a missing file has no rows."""
        return cls.read(path) if path.is_file() else cls(path, ())

    def write(self) -> None:
        """Write `PAIR_COLUMNS` of all rows to `path`, with its SHA-256 in NAME.sha256.

        These columns lack state and refraction. NaN becomes an empty cell.
        """
        with codec.sealed(self.path):
            codec.write_csv(self.path, (asdict(row) for row in self.rows), PAIR_COLUMNS)


def _refuse_foreign_pictures(path: Path, rows: Iterable[PairRow]) -> None:
    """Raise InputError for a picture outside the session that contains the csv.

    A csv that is in no session may name pictures anywhere: its user named it on the command line.
    """
    folder = path.parent.resolve()
    folders = (folder, *folder.parents)
    root = next((place for place in folders if (place / "session.toml").is_file()), None)
    if root is None:
        return
    refuse_link(root, folder / path.name)
    for row in rows:
        for name in (row.panorama, row.sunpatch):
            if name:
                where = f"{path}: line {row.line}"
                refuse_outside(root, name, where, folder.relative_to(root).as_posix())


def _row(path: Path, line: int, cells: dict[str, str]) -> PairRow:
    """Return the row of a line; cells: by column. With ok = 0 only time, panorama and reason count.

    Raises InputError for a wrong cell and for irradiance outside the limits.
    """
    where = f"{path}: line {line}"
    if cells.get("ok", "").lower() in ("0", "0.0", "false", "no"):
        t_utc = NO_TIME
        with suppress(ValueError):
            t_utc = parse_utc(cells["t_utc"])
        row = PairRow(t_utc, cells["panorama"], math.nan, math.nan, ok=False, line=line)
        return replace(row, why=cells.get("why", ""), inputs=cells.get("inputs", ""))
    all_cells = {"doubtful": _was_doubtful(cells), **cells, "line": str(line)}
    row = codec.read_row(PairRow, where, all_cells, _REMEDY)
    codec.check_format(path, row.format, FORMAT)
    if not row.panorama:
        raise InputError(where, "the cell of column panorama is empty", "a picture's path", _REMEDY)
    low, high = IRRADIANCE_LIMITS_WM2
    for name in ("dni_wm2", "dhi_wm2"):
        if not low <= getattr(row, name) <= high:
            limits = f"{low:g} to {high:g} W/m2"
            raise InputError(where, f"{name} is {cells[name]!r}", limits, _REMEDY)
    return replace(row, dni_wm2=max(row.dni_wm2, 0.0), dhi_wm2=max(row.dhi_wm2, 0.0))


def _was_doubtful(cells: dict[str, str]) -> str:
    """Return "1" if a row without the column `doubtful` has a cause of doubt in `why`, else "0".

    Earlier versions did not write that column.
    """
    words = ("light changed", "global is not", "diffuse above", "irradiance outside", "one reading")
    return str(int(any(text in cells.get("why", "") for text in words)))


def write_simulated_pairs(session: Session, rows: tuple[PairRow, ...]) -> None:
    """Write truth/pairs.csv; also write pairs.csv, unless it has pairs of merged panoramas.

    rows: with paths relative to the session's folder. Raises InputError if the present pairs.csv
    cannot be used.
    """

    def below_truth(path: str) -> str:
        """Return a path, which is relative to the session, relative to truth/; "" remains."""
        return posixpath.relpath(path, "truth") if path else ""

    in_truth = tuple(
        replace(row, panorama=below_truth(row.panorama), sunpatch=below_truth(row.sunpatch))
        for row in rows
    )
    PairsFile(session.truth_pairs, in_truth).write()
    stored = (row.panorama for row in PairsFile.find(session.pairs).rows)
    if all(name.startswith("truth/") for name in stored if name):
        PairsFile(session.pairs, rows).write()


# Of a bracket's light: rows of loggers up to 15 minutes apart are used from two intervals away.
_NEAR_MINUTES = 35


def light_digests(
    session: Session, times: Mapping[str, datetime], earlier: Mapping[str, str] | None = None
) -> dict[str, str]:
    """Return a text for each slot id: what the session now has of the slot's picture and light.

    It is the digest of its panorama, its mark and the lines that were logged within 35 minutes of
    its time, but before the last such minute, and that minute. times: by slot id; earlier: results
    of an earlier call, whose last minutes are used, so that lines which a running log added since
    do not count. Raises OSError if a file cannot be read.
    """
    span, marked = range(-_NEAR_MINUTES, _NEAR_MINUTES + 1), marks(session)
    near = {
        slot: [utc_text(t + timedelta(minutes=k))[:16].encode() for k in span]
        for slot, t in times.items()
    }
    lines = {minute: hashlib.sha256() for minutes in near.values() for minute in minutes}
    logged: set[bytes] = set()
    for path in day_files(session):
        for line in read_bytes(path).splitlines():
            if (of_minute := lines.get(line[:16])) is not None:
                of_minute.update(line)
                logged.add(line[:16])
    texts = {minute: lines[minute].hexdigest() for minute in logged}
    digests: dict[str, str] = {}
    for slot, minutes in near.items():
        until = (earlier or {}).get(slot, "").partition(" ")[2]
        until = until or max((m.decode() for m in minutes if m in texts), default="")
        used = [texts[m] for m in minutes if m in texts and m.decode() < until]
        sidecar = session.sidecar(slot)  # has the digest of the panorama
        merged = sha256(sidecar) if sidecar.is_file() else ""
        digests[slot] = f"{codec.data_digest(marked.get(slot), used, merged)[:12]} {until}"
    return digests
