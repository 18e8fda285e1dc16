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
from fieldlum.cli.terminal import emit_json, print_answer, progress, say
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
        state = "done" if is_done else "failed"
        rooms.append({"session": room.session, "state": state, "text": text})
        if not as_json:
            click.echo(f"{room.session} {state}: {text}")
    if as_json:
        emit_json({"campaign": campaign.name, "rooms": rooms})
    if failed := sum(room["state"] == "failed" for room in rooms):
        say(f"{failed} of {len(rooms)} rooms failed")
        raise SystemExit(InputError.exit_code)


def _run_room(
    campaign: CampaignFile, room: CampaignRoom, stage: str, options: Sequence[str]
) -> tuple[bool, str]:
    """Run the commands of a stage for one room; return whether all succeeded, and their output."""
    from fieldlum.cli import main

    is_done, shown = True, io.StringIO()
    try:
        for name, *words in _commands(campaign, room, stage, options):
            made = main.get_command(click.Context(main), name)
            assert made is not None
            try:
                with redirect_stdout(shown):
                    made.main(words, standalone_mode=False)
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
    if stage == "plan" and (campaign.file(room.session) / "session.toml").is_file():
        return []
    folder = str(campaign.file(room.session))
    if stage == "plan" and not room.site:
        remedy = "add site = SITE.toml to the room in CAMPAIGN.toml"
        raise InputError(folder, "neither a session nor a site file", "one of these", remedy)
    weather = room.weather
    weather = weather if weather == "synthetic" else str(campaign.file(weather))
    training = ["--budget", f"{room.budget_min:g}", "--seed", str(room.seed)]
    year = ["--weather", weather, "--views", str(room.views)]
    return {
        "plan": [["plan", str(campaign.file(room.site)), "--set", room.set, "--out", folder]],
        "status": [["status", folder]],
        "merge": [["merge", folder, "--size", room.size, *options], ["pair", folder, *options]],
        "train": [["train", folder, "--model", room.model, *training]],
        "predict": [["predict", str(Path(folder, "models", room.model)), *year, *options]],
    }[stage]


for _stage, _text in STAGES.items():
    _names = ("scheduler_text", "force") if _stage in ("merge", "predict") else ()
    _parameters = [_CAMPAIGN_FILE, *(SHARED[name] for name in (*_names, "as_json"))]
    _help = f"{_text}\n\n\b\nExample:\n  fieldlum campaign {_stage} rooms/CAMPAIGN.toml\n"
    _callback = partial(_run, _stage)
    command.add_command(click.Command(_stage, None, _callback, _parameters, help=_help))


@command_of("report", command)
def report_command(
    campaign_file: Annotated[Path, "CAMPAIGN.toml"], out: Path | None = None, as_json: bool = False
) -> None:
    """Write the overview: glare, failed slots, next steps.

    \b
    Example:
      fieldlum campaign report rooms/CAMPAIGN.toml

    Options:
      --out: Folder of the overview to write. [default: campaign/ next to CAMPAIGN.toml]
    """
    from fieldlum.report.campaign import read_campaign, write_overview

    campaign, folder = read_campaign(campaign_file), out or campaign_file.parent / "campaign"
    with progress("campaign report") as show:
        page, rooms = write_overview(campaign, folder, progress=show)
    broken = [room for room in rooms if room.broken]
    for room in broken:
        say(f"skipped: {room.session}: {room.broken}")
    passed_over = [room.session for room in broken]
    print_answer(as_json, {"page": str(page), "passed_over": passed_over}, [str(page)])
