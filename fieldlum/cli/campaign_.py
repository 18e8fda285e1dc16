"""`fieldlum campaign`: run a stage for many sessions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from fieldlum.cli.declared import PATH
from fieldlum.cli.options import SHARED, command_of, scheduler_of
from fieldlum.cli.terminal import emit_json, progress, say
from fieldlum.core.errors import InputError

if TYPE_CHECKING:
    from fieldlum.report.campaign.stages import Stage

_CAMPAIGN_FILE = click.Argument(["campaign_file"], metavar="CAMPAIGN.toml", type=PATH)


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


def _add_stage(stage: Stage, text: str, example: str = "", *options: str) -> None:
    """Add the command of a stage, with --json and the shared options that the stage has."""

    def run_rooms(
        campaign_file: Path, as_json: bool, scheduler_text: str = "local", force: bool = False
    ) -> None:
        _run(campaign_file, stage, scheduler_text, force, as_json)

    line = f"fieldlum campaign {stage} rooms/CAMPAIGN.toml {example}".rstrip()
    parameters = [_CAMPAIGN_FILE, *(SHARED[name] for name in (*options, "as_json"))]
    help_text = f"{text}\n\n\b\nExample:\n  {line}\n"
    command.add_command(click.Command(stage, None, run_rooms, parameters, help_text))


_add_stage("plan", "Plan the rooms that have no session yet.")
_add_stage("status", "Show what each room has done and what is still to do.")
_MERGED = "--scheduler processes:8"
_add_stage("merge", "Merge and pair every room.", _MERGED, "scheduler_text", "force")
_TRAINED = "Train a model for every room; each room is one unit of work."
_add_stage("train", _TRAINED, "--scheduler processes:4", "scheduler_text")
_CLUSTER = "--scheduler cluster.json"
_add_stage("predict", "Predict a year for every room.", _CLUSTER, "scheduler_text", "force")


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
