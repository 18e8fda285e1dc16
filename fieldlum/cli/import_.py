"""`fieldlum import`: import the frames of a card's folder and a logger's file."""

from __future__ import annotations

import re
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import command_of

if TYPE_CHECKING:
    from fieldlum.capture.import_card import Report
    from fieldlum.capture.match_card import Offset

_SHOWN = 20  # lines of each kind; fits a terminal; chosen


_MAX_OFFSET = timedelta(hours=14)  # of the islands of Kiribati, the largest in use


class _UtcOffset(click.ParamType):
    """A UTC offset such as -08:00, or +05:30:12 with seconds, in seconds."""

    name = "offset"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        offset = None
        with suppress(ValueError):
            offset = datetime.strptime(str(value).strip(), "%z").utcoffset()
        if offset is None or abs(offset) > _MAX_OFFSET:
            self.fail(f"{value} is no UTC offset; write, for example, -08:00", param, ctx)
        return offset.total_seconds()


def _columns(texts: tuple[str, ...]) -> dict[str, str]:
    from fieldlum.devices.logger_files import QUANTITIES

    named = {text.partition("=")[0]: text.partition("=")[2] for text in texts}
    for quantity, name in named.items():
        if quantity not in QUANTITIES or not name:
            raise click.UsageError(
                f"--column: {quantity}={name} is not QUANTITY=COLUMN: write, for example, "
                f"ghi_wm2=SlrW_Avg; quantities are {', '.join(QUANTITIES)}"
            )
    return named


def _sensitivities(texts: tuple[str, ...]) -> dict[str, float]:
    stated: dict[str, float] = {}
    for text in texts:
        match = re.fullmatch(r"([gd]hi_wm2|dni_wm2)=([0-9.eE+-]+)", text)
        with suppress(ValueError):
            stated |= {match[1]: float(match[2])} if match else {}
        if match is None or not 0.1 <= stated.get(match[1], 0.0) <= 1e4:
            example = "write, for example, ghi_wm2=8.63"
            raise click.UsageError(f"--sensitivity: {text} is not QUANTITY=UV_PER_WM2: {example}")
    return stated


@command_of("import")
def command(
    session_folder: Path,
    folder: Annotated[Path | None, "[FOLDER]"] = None,
    irradiance_file: Path | None = None,
    utc_offset_s: Annotated[float | None, _UtcOffset()] = None,
    logger_utc_offset_s: Annotated[float | None, _UtcOffset()] = None,
    columns: tuple[str, ...] = (),
    sensitivity_texts: tuple[str, ...] = (),
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
      --column QUANTITY=NAME: Column of the logger for ghi_wm2, dhi_wm2 or dni_wm2, if its
          name is unusual; the other columns are found by their names. A number counts
          columns of a file without names.
      --sensitivity QUANTITY=UV_PER_WM2: Sensitivity of the pyranometer, uV per W/m2, if the
          logger's column is a voltage.
    """
    if folder is None and irradiance_file is None:
        raise click.UsageError("name a card's folder, or a logger's file with --irradiance")
    if irradiance_file is None and (columns or sensitivity_texts):
        raise click.UsageError("--column and --sensitivity need a logger's file: --irradiance FILE")
    named, sensitivities = _columns(columns), _sensitivities(sensitivity_texts)
    from fieldlum.capture import import_card
    from fieldlum.core.records import counted
    from fieldlum.session import open_session

    session = open_session(session_folder)
    with terminal.progress("import") as progress:
        report = import_card.run(
            session,
            folder,
            logger=irradiance_file,
            utc_offset_s=utc_offset_s,
            logger_utc_offset_s=logger_utc_offset_s,
            columns=named or None,
            sensitivities=sensitivities or None,
            progress=progress,
        )
    for line in _summary(report):
        terminal.say(line)
    line = (
        f"{session.root}: {counted(report.brackets, 'bracket')} with "
        f"{counted(report.frames, 'frame')}, {counted(report.rows, 'row')} of irradiance"
    )
    if report.withdrawn:
        line += f"; rows of an earlier import of this file that were removed: {report.withdrawn}"
    if report.known:
        line += f"; {report.known} brackets were already imported"
    click.echo(line)


def _summary(report: Report) -> list[str]:
    from statistics import median

    # one line for campaigns with the same clock
    clocks = [f"camera clock: UTC {_clock(offset)}, {offset.how}" for offset in report.offsets]
    lines = list(dict.fromkeys(clocks))
    if report.late_s:
        lines.append(f"brackets start {median(report.late_s):+.0f} s from their slots (median)")
    if report.moved:
        lines.append(
            f"brackets of slots {', '.join(report.moved)} were moved to raw/withdrawn, because "
            "their frames now have other slots or times: merge and pair again"
        )
    for what, texts in (("note", report.notes), ("not imported", report.left_out)):
        lines += [f"{what}: {text}" for text in texts[:_SHOWN]]
        if len(texts) > _SHOWN:
            lines.append(f"{what}: {len(texts) - _SHOWN} more, not shown")
    return lines


def _clock(offset: Offset) -> str:
    from fieldlum.capture.match_card import hms, hms_list

    return hms_list(offset.exif_s) if offset.exif_s else hms(offset.seconds)
