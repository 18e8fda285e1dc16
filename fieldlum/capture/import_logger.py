"""Add a logger's file to the day files.

A repeated import with another clock or other columns replaces the earlier rows. Rows of other
quantities at the same times are added to them.
"""

import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing, suppress
from datetime import datetime, timedelta
from itertools import groupby, pairwise
from pathlib import Path
from typing import cast
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.capture.match_card import Report
from fieldlum.core.arrays import evenly_spread
from fieldlum.core.errors import InputError
from fieldlum.core.records import IrradianceSample, Site, counted, utc_text
from fieldlum.devices.logger_files import LoggerFile, read_logger_file
from fieldlum.session import Session, replacing, replacing_path, sole_user, update_session
from fieldlum.session.day_files import DAY_COLUMNS, DayFiles, day_files, encode_sample, read_day
from fieldlum.session.folder import LoggerFileTable
from fieldlum.sky import sun

# Of the irradiance above the atmosphere. The darkest storm transmits 5 % (`sun.too_weak`). Of 1
# W/m2, a thermopile gives 0.005 to 0.02 mV (ISO 9060 instruments), which a clear sky scales by 0.8.
# The share holds for a sun above 10 degrees; of fewer rows, one dark hour could be all. Chosen.
_DARKEST_SHARE, _HIGH_SUN_SINE, _HIGH_SUN_ROWS = 0.02, 0.17, 20


def import_rows(
    session: Session,
    path: Path,
    utc_offset_s: float | None,
    columns: Mapping[str, str] | None = None,
    sensitivities: Mapping[str, float] | None = None,
) -> Report:
    """Add the rows of a logger's file to the day files; return how many were added and removed.

    `add_samples` states which rows are added. Rows that an earlier import of this file read with
    another clock or other columns are removed. utc_offset_s: the logger's clock minus UTC [s], if
    the file does not state it. columns: name of the column for each
    quantity, if it is unusual. sensitivities: of pyranometers whose column is a voltage, uV per
    W/m2. session.toml records how the file was read. Raises InputError for a file that cannot be
    read or follows summer time, or if another process logs into the session.
    """
    settings = {"utc_offset_s": utc_offset_s, "columns": columns, "sensitivities": sensitivities}
    stated = {name: value for name, value in settings.items() if value is not None}
    table = cast("LoggerFileTable", {"file": path.name, **stated})
    logger_file = _read_as(path, table)
    if utc_offset_s is not None:
        times = [s.t_utc + timedelta(seconds=utc_offset_s) for s in logger_file.samples]
        _check_civil_time(path, times, ZoneInfo(session.site_file().site.timezone))
    for quantity in sorted({"ghi_wm2", "dhi_wm2"} - set(sensitivities or ())):
        if rows := [s for s in logger_file.samples if getattr(s, quantity) is not None]:
            _refuse_voltage(path, rows, quantity, session.site_file().site)
    before = session.table().get("logger_files", [])
    withdrawn = 0
    with sole_user(session, "log"):
        for other in before:
            if other != table and other["file"] == table["file"]:
                with suppress(InputError):  # the file cannot be read in the earlier way any more
                    withdrawn += remove_rows(session, _read_as(path, other).samples)
        added, contradicted = add_samples(session, logger_file.samples)
    if table not in before:
        update_session(session, {"logger_files": [*before, table]})
    left_out = tuple(f"{path}: {text}" for text in logger_file.left_out)
    notes = tuple(f"{path}: {text}" for text in logger_file.notes)
    if contradicted:
        found = f"{counted(contradicted, 'row')} have times that are stored with other values"
        remedy = "if this file is right, move irradiance/DATE.csv of its days away and import again"
        notes += (f"{path}: {found}, which remain; {remedy}",)
    return Report(rows=added, withdrawn=withdrawn, left_out=left_out, notes=notes)


def _refuse_voltage(path: Path, rows: Sequence[IrradianceSample], name: str, site: Site) -> None:
    """Raise InputError if an irradiance is too small for any sky, as a voltage is.

    rows: those of the file that have the quantity; name: ghi_wm2 or dhi_wm2; site: of the session.
    Of up to 1000 rows, at least 20 must have the sun over 10 degrees, and 95 % of these must have
    less than the darkest sky. Values that are 0 or below, as of a dead instrument, pass.
    """
    some = [rows[k] for k in evenly_spread(len(rows), 1000)]
    times = [row.t_utc for row in some]
    sine = np.sin(np.radians(sun.position(times, site).altitude_deg))
    largest = sun.extraterrestrial_wm2(times) * np.maximum(sine, _HIGH_SUN_SINE)
    share = (np.array([getattr(row, name) for row in some]) / largest)[sine > _HIGH_SUN_SINE]
    if len(share) < _HIGH_SUN_ROWS:
        return
    if 0.0 < (usual := float(np.quantile(share, 0.95))) < _DARKEST_SHARE:
        found = f"{name} is {usual:.2%} of the sun's irradiance above the atmosphere by day"
        expected = f"over {_DARKEST_SHARE:.0%}, as under the darkest cloud"
        remedy = "if it is a voltage, name its unit in the column, such as ghi_mV, and state "
        remedy += "--sensitivity; if the instrument was covered or dead, remove the column"
        raise InputError(path, found, expected, remedy)


def _check_civil_time(path: Path, times: Sequence[datetime], zone: ZoneInfo) -> None:
    """Raise InputError if the logger's clock skips the hour that begins summer time in `zone`.

    times: the rows' times by the logger's clock, without a zone. The end of summer time, when a
    clock goes back, is detected in any zone by `read_logger_file`.
    """
    steps = [later - earlier for earlier, later in pairwise(times)]
    usual = sorted(steps)[len(steps) // 2] if steps else timedelta()  # median
    for t, step in zip(times, steps, strict=False):
        if step <= usual:
            continue
        moments = (moment.replace(tzinfo=zone) for moment in (t, t + step))
        before, after = (moment.utcoffset() or timedelta() for moment in moments)
        leap = after - before
        if leap > timedelta() and abs(step - usual - leap) < usual / 2:
            found = f"the clock leaps from {t:%Y-%m-%d %H:%M} to {t + step:%H:%M}"
            found += f", as at the beginning of summer time in {zone.key}"
            raise InputError(path, found, "one clock in all rows", "write standard time")


def _read_as(path: Path, table: LoggerFileTable) -> LoggerFile:
    """Return the samples of a logger's file, read with the clock and columns that `table` states.

    Raises InputError for a file that cannot be read.
    """
    offset_s = table.get("utc_offset_s")
    offset = None if offset_s is None else timedelta(seconds=offset_s)
    return read_logger_file(path, offset, table.get("columns"), table.get("sensitivities"))


def add_samples(session: Session, samples: Iterable[IrradianceSample]) -> tuple[int, int]:
    """Append the readings that add to the day files; return their number, and of contradictions.

    A reading adds to them if its time is not stored, or if it has a quantity that no row of its
    time has, and no other value; `series_of` joins rows of one time. It is a contradiction if it
    has another value of a stored quantity. With more contradictions than such readings none is
    appended, as for a file of another clock. Of equal readings in sequence, one is appended;
    different readings of the same time in `samples` all are. Raises OSError if a day file cannot be
    read or written, InputError as `DayFiles` does.
    """
    paths, contradicted = {path.stem: path for path in day_files(session)}, 0
    added: list[IrradianceSample] = []
    # Equal readings in sequence come from a table that contains a copy of itself.
    ordered = [sample for sample, _ in groupby(sorted(samples, key=lambda s: s.t_utc))]
    for day, of_day in groupby(ordered, key=lambda s: s.t_utc.strftime("%Y-%m-%d")):
        stored: dict[datetime, set[tuple[str, float]]] = {}
        for row in read_day(paths[day])[0] if day in paths else ():
            stored.setdefault(row.t_utc, set()).update(_numbers(row))
        for sample in of_day:
            known = stored.get(sample.t_utc)
            new = {name for name, _ in _numbers(sample) - (known or set())}
            if new & {name for name, _ in known or ()}:
                contradicted += 1
            elif new or known is None:
                added.append(sample)
    if contradicted > len(added):
        return 0, contradicted
    with closing(DayFiles(session, flush=False)) as log:
        for sample in added:
            log.append(sample)
    return len(added), contradicted


def _numbers(sample: IrradianceSample) -> set[tuple[str, float]]:
    """Return name and value [W/m2] of a reading's irradiances, as a day file stores them."""
    values = ((n, getattr(sample, n)) for n in ("ghi_wm2", "dhi_wm2", "dni_wm2"))
    return {(n, float(f"{value:.7g}")) for n, value in values if value is not None}


def remove_rows(session: Session, samples: Iterable[IrradianceSample]) -> int:
    """Remove the rows with times, raw texts and irradiances of `samples` from the day files.

    Return the number of removed rows; samples without such a row are ignored. A changed day file's
    earlier version remains in irradiance/withdrawn/. If a row was removed, clean.csv, which was
    computed from it, is deleted too; `pair` writes it again. Raises OSError if a file cannot be
    read or written.
    """
    removed, count = {_key(sample) for sample in samples}, 0
    for path in day_files(session) if removed else []:
        rows, _ = read_day(path)
        remaining = [row for row in rows if _key(row) not in removed]
        if len(remaining) == len(rows):
            continue
        count += len(rows) - len(remaining)
        aside = session.irradiance / "withdrawn"
        number = len(list(aside.glob(f"{path.stem}.*.csv")))
        with replacing_path(aside / f"{path.stem}.{number}.csv") as copy:
            shutil.copyfile(path, copy)
        with replacing(path) as file:
            file.write((",".join(DAY_COLUMNS) + "\n").encode())
            file.writelines(encode_sample(row) for row in remaining)
    if count:
        session.clean_irradiance.unlink(missing_ok=True)
    return count


def _key(sample: IrradianceSample) -> tuple[str, str, frozenset[tuple[str, float]]]:
    """Return the time, the raw text and the irradiances of a reading, which identify its row."""
    return utc_text(sample.t_utc), sample.raw, frozenset(_numbers(sample))
