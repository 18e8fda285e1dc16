"""fieldlum plan."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import click

from fieldlum.cli import terminal

SETS = ("month", "9-day", "12-day", "4-day", "even")


@click.command("plan")
@click.argument("target", metavar="SITE.toml|SESSION", type=click.Path(path_type=Path, exists=True))
@click.option("--set", "set_", type=click.Choice(SETS), help="Which hours of the year to capture.")
@click.option("--start", type=click.DateTime(["%Y-%m-%d"]), help="First day, local date; else the next that fits.")
@click.option("--year", type=click.IntRange(1950, 2100), help="Plan the events of this year.")
@click.option("--count", type=click.IntRange(min=1), help="Number of hours, for even (200).")
@click.option("--out", type=click.Path(path_type=Path), help="The session folder to make.")
@click.option("--json", "as_json", is_flag=True, help="Print the plan's summary as one JSON object.")
def command(
    target: Path, set_: str | None, start: datetime | None, year: int | None, count: int | None,
    out: Path | None, as_json: bool,
) -> None:  # fmt: skip
    """Choose the hours to capture and make the session.

    \b
    fieldlum plan office.toml --set 9-day --out office-2027
    """
    if set_ is None or out is None:
        raise click.UsageError("give --set and --out, like: fieldlum plan SITE.toml --set 9-day --out my-session")
    from fieldlum import plan
    from fieldlum.profiles import load_site

    setup = load_site(target)
    request = plan.Request(
        set_, plan.today_at(setup.site, datetime.now(UTC)), start.date() if start else None, year, None, count
    )
    session, made = plan.run(setup, request, out)
    for warning in made.warnings:
        terminal.say(f"note: {warning}")
    summary = plan.summary(session, made)
    terminal.emit_json(summary) if as_json else click.echo(plan.sentence(summary))
