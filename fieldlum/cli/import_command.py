"""`fieldlum import`: import the frames of a card's folder and a logger's file."""

from __future__ import annotations

import re
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import OpenSession, command_of

if TYPE_CHECKING:
    from fieldlum.capture.match_card import Report

_MAX_UTC_OFFSET = timedelta(hours=14)  # of the islands of Kiribati, the largest in use


def _utc_offset(text: str) -> float:
    """Return a UTC offset such as -08:00, or +05:30:12 with seconds, in seconds.

    Raises ValueError for another text, and for more than 14 hours.
    """
    offset = None
    with suppress(ValueError):
        offset = datetime.strptime(text.strip(), "%z").utcoffset()
    if offset is None or abs(offset) > _MAX_UTC_OFFSET:
        raise ValueError(f"{text} is no UTC offset; write, for example, -08:00")
    return offset.total_seconds()


def _column(text: str) -> tuple[str, str]:
    """Return quantity, or time, and column name of a text such as "ghi_wm2=SlrW_Avg".

    Raises ValueError for another text.
    """
    from fieldlum.session.day_files import QUANTITIES

    quantity, _, name = text.partition("=")
    if quantity not in ("time", *QUANTITIES) or not name:
        remedy = "write, for example, ghi_wm2=SlrW_Avg; quantities are"
        raise ValueError(f"{text} is not QUANTITY=COLUMN: {remedy} {', '.join(QUANTITIES)}")
    return quantity, name


def _sensitivity(text: str) -> tuple[str, float]:
    """Return quantity and sensitivity [uV per W/m2] of a text such as "ghi_wm2=8.63".

    Raises ValueError for another text, and for a sensitivity that no pyranometer has.
    """
    match = re.fullmatch(r"([gd]hi_wm2|dni_wm2)=(\d+\.?\d*)", text)
    if match is None or not 0.1 <= float(match[2]) <= 1e4:
        raise ValueError(f"{text} is not QUANTITY=UV_PER_WM2: write, for example, ghi_wm2=8.63")
    return match[1], float(match[2])


@command_of("import")
def command(
    session: OpenSession,
    folder: Annotated[Path | None, "[FOLDER]"] = None,
    irradiance_file: Path | None = None,
    utc_offset_s: Annotated[Any, _utc_offset] = None,
    logger_utc_offset_s: Annotated[Any, _utc_offset] = None,
    columns: Annotated[tuple[Any, ...], _column] = (),
    sensitivity: Annotated[tuple[Any, ...], _sensitivity] = (),
) -> None:
    """Import a card's folder and a logger's file.

    Frames are grouped into brackets by their exposures and times, and matched to the plan; frames
    without a match are reported. The card is not changed, so that it can be imported again.

    \b
    Example:
      fieldlum import office-2027 /media/card/DCIM --irradiance CR1000_sky.dat --utc-offset -08:00

    Options:
      --irradiance: A logger's file: Campbell TOA5 or CSV.
      --utc-offset +HH:MM: Camera's and logger's clock minus UTC. [default: from EXIF, or
          fitted to the plan]
      --logger-utc-offset +HH:MM: Logger's clock minus UTC, if it differs from the camera's.
          [default: --utc-offset]
      --column QUANTITY=NAME: Column of the logger for time, ghi_wm2, dhi_wm2 or dni_wm2, if
          its name is unusual; the other columns are found by their names. A number counts
          columns of a file without names.
      --sensitivity QUANTITY=UV_PER_WM2: Sensitivity of the pyranometer, uV per W/m2, if the
          logger's column is a voltage.
    """
    if folder is None and irradiance_file is None:
        raise click.UsageError("name a card's folder, or a logger's file with --irradiance")
    if irradiance_file is None and (columns or sensitivity):
        raise click.UsageError("--column and --sensitivity need a logger's file: --irradiance FILE")
    from fieldlum.capture import import_card
    from fieldlum.core.records import counted
    from fieldlum.session.files.pairs_csv import PairsFile

    clocks = {"utc_offset_s": utc_offset_s, "logger_utc_offset_s": logger_utc_offset_s}
    of_logger: dict[str, Any] = {"logger": irradiance_file, "columns": dict(columns) or None}
    of_logger["sensitivities"] = dict(sensitivity) or None
    with terminal.progress("import"):
        report = import_card.run(session, folder, **clocks, **of_logger)
    for line in _summary(report):
        terminal.say(line)
    frames, rows = counted(report.frames, "frame"), counted(report.rows, "row")
    line = f"{counted(report.brackets, 'bracket')} with {frames}, {rows} of irradiance"
    if report.withdrawn:
        line += f"; rows of an earlier import that were removed: {report.withdrawn}"
    if report.known:
        line += f"; already imported: {counted(report.known, 'bracket')}"
    click.echo(f"{session.root}: {line}")
    for line in PairsFile.find(session.pairs).pair_again:
        terminal.say(line)


def _summary(report: Report) -> list[str]:
    """Return the lines that the terminal shows about an import: clocks, starts, notes.

    At most 20 notes and 20 frames that were not imported are listed.
    """
    from statistics import median

    from fieldlum.capture.match_card import offsets_text

    clocks = [(offsets_text(o.exif_s or (o.seconds,)), o.how) for o in report.offsets]
    lines = [f"camera clock: UTC {clock}, {how}" for clock, how in clocks]
    lines = list(dict.fromkeys(lines))  # one line for campaigns with the same clock
    if report.late_s:
        lines.append(f"brackets start {median(report.late_s):+.0f} s from their slots (median)")
    if report.moved:
        lines.append(
            f"brackets of slots {', '.join(report.moved)} were moved to raw/withdrawn, because "
            "their frames now have other slots or times: merge and pair again"
        )
    for what, texts in (("note", report.notes), ("not imported", report.left_out)):
        lines += [f"{what}: {text}" for text in texts[:20]]
        lines += [f"{what}: {len(texts) - 20} more, not shown"] if len(texts) > 20 else []
    return lines
