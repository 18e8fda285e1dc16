"""`fieldlum campaign`: many sessions as one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldlum.cli.options import (
    force_option,
    json_option,
    out_option,
    scheduler_of,
    scheduler_option,
)
from fieldlum.cli.terminal import emit_json, progress, say

if TYPE_CHECKING:
    from fieldlum.campaign.stages import Stage

SKIPPED_EXIT_CODE = 3  # exit code when a room was skipped
campaign_argument = click.argument(
    "campaign_file", metavar="CAMPAIGN.toml", type=click.Path(path_type=Path)
)


@click.group("campaign")
def command() -> None:
    """Treat many sessions as one campaign.

    CAMPAIGN.toml names the sessions. A room that is missing or broken is reported and skipped.

    \b
    Example:
      fieldlum campaign merge rooms/CAMPAIGN.toml --scheduler processes:8
      fieldlum campaign train rooms/CAMPAIGN.toml
      fieldlum campaign predict rooms/CAMPAIGN.toml
      fieldlum campaign report rooms/CAMPAIGN.toml
    """


def _run(
    campaign_file: Path, stage: Stage, scheduler_text: str, force: bool, as_json: bool
) -> None:
    """Run a stage, print one line a room, exit with 3 if any room was skipped."""
    from fieldlum.campaign import read_campaign, run_stage

    campaign = read_campaign(campaign_file)
    scheduler = scheduler_of(scheduler_text)
    results = []
    with progress(f"campaign {stage}") as show:
        for result in run_stage(campaign, stage, scheduler=scheduler, force=force, progress=show):
            results.append(result)
            if not as_json:
                click.echo(f"{result.session} {result.state}: {result.text}")
    if as_json:
        rooms = [{"session": r.session, "state": r.state, "text": r.text} for r in results]
        emit_json({"campaign": campaign.name, "rooms": rooms})
    failed = sum(result.state == "failed" for result in results)
    if failed:
        say(f"{failed} of {len(results)} rooms skipped")
        raise SystemExit(SKIPPED_EXIT_CODE)


@command.command("plan")
@campaign_argument
@json_option
def plan_command(campaign_file: Path, as_json: bool) -> None:
    """Plan the rooms that have no session yet.

    \b
    Example:
      fieldlum campaign plan rooms/CAMPAIGN.toml
    """
    _run(campaign_file, "plan", "local", False, as_json)


@command.command("status")
@campaign_argument
@json_option
def status_command(campaign_file: Path, as_json: bool) -> None:
    """Show what each room has done and what is still to do.

    \b
    Example:
      fieldlum campaign status rooms/CAMPAIGN.toml
    """
    _run(campaign_file, "status", "local", False, as_json)


@command.command("merge")
@campaign_argument
@scheduler_option
@force_option
@json_option
def merge_command(campaign_file: Path, scheduler_text: str, force: bool, as_json: bool) -> None:
    """Merge and pair every room.

    \b
    Example:
      fieldlum campaign merge rooms/CAMPAIGN.toml --scheduler processes:8
    """
    _run(campaign_file, "merge", scheduler_text, force, as_json)


@command.command("train")
@campaign_argument
@scheduler_option
@json_option
def train_command(campaign_file: Path, scheduler_text: str, as_json: bool) -> None:
    """Train a model for every room; each room is one unit of work.

    \b
    Example:
      fieldlum campaign train rooms/CAMPAIGN.toml --scheduler processes:4
    """
    _run(campaign_file, "train", scheduler_text, False, as_json)


@command.command("predict")
@campaign_argument
@scheduler_option
@force_option
@json_option
def predict_command(campaign_file: Path, scheduler_text: str, force: bool, as_json: bool) -> None:
    """Predict a year for every room.

    \b
    Example:
      fieldlum campaign predict rooms/CAMPAIGN.toml --scheduler cluster.json
    """
    _run(campaign_file, "predict", scheduler_text, force, as_json)


@command.command("report")
@campaign_argument
@out_option("Folder of the overview", default="campaign/ next to CAMPAIGN.toml")
@click.option(
    "--table",
    type=click.Path(path_type=Path),
    help="Also write all hourly figures: FILE.csv, or FILE.parquet (fieldlum[parquet]).",
)
@json_option
def report_command(
    campaign_file: Path, out: Path | None, table: Path | None, as_json: bool
) -> None:
    """Write the overview: glare, drift, failed slots, next steps.

    \b
    Example:
      fieldlum campaign report rooms/CAMPAIGN.toml --table hours.csv
    """
    from fieldlum.campaign import read_campaign
    from fieldlum.campaign.hour_table import write_csv, write_parquet
    from fieldlum.campaign.overview import write_overview

    if table is not None and table.suffix not in (".csv", ".parquet"):
        raise click.UsageError(f"--table {table}: write a .csv or a .parquet file")
    campaign = read_campaign(campaign_file)
    with progress("campaign report") as show:
        page, rooms = write_overview(
            campaign, out or campaign_file.parent / "campaign", progress=show
        )
    rows = None
    if table is not None:
        rows = (write_parquet if table.suffix == ".parquet" else write_csv)(campaign, table)
        say(f"{table}: {rows} rows")
    broken = [room.session for room in rooms if room.broken]
    if as_json:
        emit_json({"page": str(page), "passed_over": broken, "table_rows": rows})
    else:
        click.echo(str(page))
    for name in broken:
        say(f"skipped: {name}")
