"""`fieldlum campaign`: run a stage for many sessions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldlum.cli.options import (
    PATH,
    Decorator,
    force_option,
    json_option,
    out_option,
    scheduler_of,
    scheduler_option,
)
from fieldlum.cli.terminal import emit_json, progress, say
from fieldlum.core.errors import InputError

if TYPE_CHECKING:
    from fieldlum.report.campaign.stages import Stage

campaign_argument = click.argument("campaign_file", metavar="CAMPAIGN.toml", type=PATH)


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


def _run(campaign_file: Path, stage: Stage, scheduler: str, force: bool, as_json: bool) -> None:
    """Run a stage and print one line for each room; exit with 3 if any room failed."""
    from fieldlum.report.campaign import read_campaign, run_stage

    campaign = read_campaign(campaign_file)
    where = scheduler_of(scheduler)
    results = []
    with progress(f"campaign {stage}") as show:
        for result in run_stage(campaign, stage, scheduler=where, force=force, progress=show):
            results.append(result)
            if not as_json:
                click.echo(f"{result.session} {result.state}: {result.text}")
    if as_json:
        rooms = [{"session": r.session, "state": r.state, "text": r.text} for r in results]
        emit_json({"campaign": campaign.name, "rooms": rooms})
    failed = sum(result.state == "failed" for result in results)
    if failed:
        say(f"{failed} of {len(results)} rooms failed")
        raise SystemExit(InputError.exit_code)


def _add_stage(stage: Stage, text: str, example: str = "", *options: Decorator) -> None:
    """Add the command of a stage, with --json and the options that the stage has."""

    def run_rooms(
        campaign_file: Path, as_json: bool, scheduler_text: str = "local", force: bool = False
    ) -> None:
        _run(campaign_file, stage, scheduler_text, force, as_json)

    line = f"fieldlum campaign {stage} rooms/CAMPAIGN.toml {example}".rstrip()
    run_rooms.__doc__ = f"{text}\n\n\b\nExample:\n  {line}\n"
    for option in (json_option, *reversed(options), campaign_argument):
        run_rooms = option(run_rooms)
    command.command(stage)(run_rooms)


_add_stage("plan", "Plan the rooms that have no session yet.")
_add_stage("status", "Show what each room has done and what is still to do.")
_add_stage(
    "merge", "Merge and pair every room.", "--scheduler processes:8", scheduler_option, force_option
)
_add_stage(
    "train",
    "Train a model for every room; each room is one unit of work.",
    "--scheduler processes:4",
    scheduler_option,
)
_add_stage(
    "predict",
    "Predict a year for every room.",
    "--scheduler cluster.json",
    scheduler_option,
    force_option,
)


@command.command("report")
@campaign_argument
@out_option("Folder of the overview", default="campaign/ next to CAMPAIGN.toml")
@click.option(
    "--table",
    type=PATH,
    help="Also write all hourly figures of all rooms, as FILE.csv.",
)
@json_option
def report_command(
    campaign_file: Path, out: Path | None, table: Path | None, as_json: bool
) -> None:
    """Write the overview: glare, failed slots, next steps.

    \b
    Example:
      fieldlum campaign report rooms/CAMPAIGN.toml --table hours.csv
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
