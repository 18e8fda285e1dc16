"""`fieldlum campaign`: run a command for many sessions, and one page of all rooms."""

from __future__ import annotations

import io
from collections.abc import Sequence
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from fieldlum.cli.declared import PATH
from fieldlum.cli.options import SHARED, command_of
from fieldlum.cli.terminal import emit_json, progress, say
from fieldlum.core.errors import FieldlumError, InputError

if TYPE_CHECKING:
    from fieldlum.report.campaign import CampaignFile, CampaignRoom

_CAMPAIGN_FILE = click.Argument(["campaign_file"], metavar="CAMPAIGN.toml", type=PATH)
STAGES = {
    "plan": "Plan the rooms that have no session yet.",
    "status": "Show what each room has done and what is still to do.",
    "merge": "Merge and pair every room.",
    "train": "Train a model for every room.",
    "predict": "Predict a year for every room.",
}


@click.group("campaign")
def command() -> None:
    """Run a stage for all sessions of a campaign.

    CAMPAIGN.toml names the sessions; plan writes those that are missing. The other stages report
    and skip a room whose session is missing or broken.

    \b
    Example:
      fieldlum campaign merge rooms/CAMPAIGN.toml --scheduler processes:8
      fieldlum campaign train rooms/CAMPAIGN.toml
      fieldlum campaign predict rooms/CAMPAIGN.toml
      fieldlum campaign report rooms/CAMPAIGN.toml
    """


def _run(
    stage: str, campaign_file: Path, as_json: bool, scheduler_text: str = "", force: bool = False
) -> None:
    """Run a stage and print what it prints for each room; exit with 3 if any room failed."""
    from fieldlum.report.campaign import read_campaign

    campaign = read_campaign(campaign_file)
    options = ["--scheduler", scheduler_text] if scheduler_text else []
    options += ["--force"] if force else []
    rooms = []
    for room in campaign.rooms:
        is_done, text = _run_room(campaign, room, stage, options)
        rooms.append({"session": room.session, "state": "done" if is_done else "failed"})
        rooms[-1]["text"] = text
        if not as_json:
            click.echo("{session} {state}: {text}".format(**rooms[-1]))
    if as_json:
        emit_json({"campaign": campaign.name, "rooms": rooms})
    failed = sum(room["state"] == "failed" for room in rooms)
    if failed:
        say(f"{failed} of {len(rooms)} rooms failed")
        raise SystemExit(InputError.exit_code)


def _run_room(
    campaign: CampaignFile, room: CampaignRoom, stage: str, options: Sequence[str]
) -> tuple[bool, str]:
    """Run the commands of a stage for one room; return whether all succeeded, and their output."""
    from fieldlum.cli import main

    is_done, shown = True, io.StringIO()
    try:
        for words in _commands(campaign, room, stage, options):
            made = main.get_command(click.Context(main), words[0])
            assert made is not None
            try:
                with redirect_stdout(shown):
                    made.main(words[1:], standalone_mode=False)
            except SystemExit as end:  # for example a bracket that cannot be merged
                is_done &= not end.code
    except (FieldlumError, OSError, click.ClickException) as error:
        return False, " ".join(str(error).split())
    except Exception as error:
        return False, f"defect: {type(error).__name__}: {error}"
    return is_done, shown.getvalue().strip() or "already done"


def _commands(
    campaign: CampaignFile, room: CampaignRoom, stage: str, options: Sequence[str]
) -> list[list[str]]:
    """Return the commands of a stage for one room; none if the room is already planned."""
    folder = campaign.session_folder(room)
    if stage == "plan":
        if (folder / "session.toml").is_file():
            return []
        if not room.site:
            raise InputError(
                folder,
                "the room has neither a session nor a site file",
                "a planned session, or a site file to plan one",
                "add site = SITE.toml to the room in CAMPAIGN.toml",
            )
        return [["plan", str(campaign.file(room.site)), "--set", room.set, "--out", str(folder)]]
    if stage == "merge":
        merge = ["merge", str(folder), "--size", room.size, *options]
        return [merge, ["pair", str(folder), *options]]
    if stage == "train":
        budget = ["--budget", f"{room.budget_min:g}", "--seed", str(room.seed)]
        return [["train", str(folder), "--model", room.model, *budget, *options]]
    if stage == "predict":
        weather = room.weather
        weather = weather if weather == "synthetic" else str(campaign.file(weather))
        settings = ["--weather", weather, "--views", str(room.views)]
        return [["predict", str(folder / "models" / room.model), *settings, *options]]
    return [["status", str(folder)]]


for _stage, _text in STAGES.items():
    _names = {"merge": ("scheduler_text", "force"), "predict": ("scheduler_text", "force")}
    _parameters = [SHARED[name] for name in (*_names.get(_stage, ()), "as_json")]
    _help = f"{_text}\n\n\b\nExample:\n  fieldlum campaign {_stage} rooms/CAMPAIGN.toml\n"
    command.add_command(
        click.Command(
            _stage, None, partial(_run, _stage), [_CAMPAIGN_FILE, *_parameters], help=_help
        )
    )


@command_of("report", command)
def report_command(
    campaign_file: Annotated[Path, "CAMPAIGN.toml"],
    out: Path | None = None,
    table: Path | None = None,
    as_json: bool = False,
) -> None:
    """Write the overview: glare, failed slots, next steps.

    \b
    Example:
      fieldlum campaign report rooms/CAMPAIGN.toml --table hours.csv

    Options:
      --out: Folder of the overview to write. [default: campaign/ next to CAMPAIGN.toml]
      --table: Also write all hourly figures of all rooms, as FILE.csv.
    """
    from fieldlum.core.records import counted
    from fieldlum.report.campaign import read_campaign
    from fieldlum.report.campaign.overview import write_hours, write_overview

    if table is not None and table.suffix.lower() != ".csv":
        raise click.UsageError(f"--table {table}: suffix '{table.suffix}'; name a .csv file")
    campaign = read_campaign(campaign_file)
    with progress("campaign report") as show:
        page, rooms = write_overview(
            campaign, out or campaign_file.parent / "campaign", progress=show
        )
    broken = [room for room in rooms if room.broken]
    for room in broken:
        say(f"skipped: {room.session}: {room.broken}")
    rows = None
    if table is not None:
        rows = write_hours(campaign, table)
        say(f"{table}: {counted(rows, 'row')}")
    if as_json:
        names = [room.session for room in broken]
        emit_json({"page": str(page), "passed_over": names, "table_rows": rows})
    else:
        click.echo(str(page))
