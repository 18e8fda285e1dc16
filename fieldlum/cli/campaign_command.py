"""`fieldlum campaign`: one page of all rooms."""

from pathlib import Path
from typing import Annotated

import click

from fieldlum.cli.options import command_of
from fieldlum.cli.terminal import print_answer, progress, say


@click.group("campaign")
def command() -> None:
    """Show all rooms of a campaign on one page.

    \b
    Example:
      fieldlum campaign report rooms/CAMPAIGN.toml
    """


@command_of("report", command)
def report_command(
    campaign_file: Annotated[Path, "CAMPAIGN.toml"], out: Path | None = None, as_json: bool = False
) -> None:
    """Write the overview: glare, failed slots, next steps.

    CAMPAIGN.toml names the sessions. One that is missing or broken is named on the page.

    \b
    Example:
      fieldlum campaign report rooms/CAMPAIGN.toml

    Options:
      --out: Folder of the overview to write. [default: campaign/ next to CAMPAIGN.toml]
    """
    from fieldlum.report.campaign import read_campaign, write_overview

    campaign, folder = read_campaign(campaign_file), out or campaign_file.parent / "campaign"
    with progress("campaign report"):
        page, rooms = write_overview(campaign, folder)
    broken = [room for room in rooms if room.broken]
    for room in broken:
        say(f"skipped: {room.session}: {room.broken}")
    passed_over = [room.session for room in broken]
    print_answer(as_json, {"page": str(page), "passed_over": passed_over}, [str(page)])
