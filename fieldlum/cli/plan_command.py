"""`fieldlum plan`: choose the hours to capture and write the session."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import click

from fieldlum.cli import terminal
from fieldlum.cli.command_parameters import EXISTING_PATH
from fieldlum.cli.options import CaptureSet, Year, calendar_day, command_of


@command_of("plan")
def command(
    target: Annotated[Path, "SITE.toml|SESSION", EXISTING_PATH],
    set_: CaptureSet | None = None,
    start: Annotated[datetime | None, calendar_day] = None,
    year: Year = None,
    days: Annotated[int | None, click.IntRange(1, 366)] = None,
    count: Annotated[int | None, click.IntRange(min=1)] = None,
    weather_file: Path | None = None,
    label_shift_min: float = 0.0,
    out: Path | None = None,
    replan: bool = False,
    add: Annotated[tuple[datetime, ...], calendar_day] = (),
    as_json: bool = False,
) -> None:
    """Choose the hours to capture and write the session.

    Writes plan.csv, a calendar (plan.ics) and one printable sheet per day (plan.html). With a
    session, --replan adds make-up slots for missed hours, and --add days of one's own.

    \b
    Example:
      fieldlum plan office.toml --set 9-day --out office-2027
      fieldlum plan office-2027 --replan

    Options:
      --set: Which hours of the year to capture.
      --start YYYY-MM-DD: First day, local date. [default: the next possible one]
      --year: Plan the events of this year, in place of --start.
      --days: Number of days of a month (31), or of the period for even (365).
      --count: Number of hours, for even (200).
      --weather: Weather year (EPW, TMY3 or CSV), for skies and coverage.
      --out: The session folder to write.
      --replan: Add make-up slots for the missed ones.
      --add YYYY-MM-DD: Add the daylight hours of a local date to a session, also of one on which
          brackets were captured without a plan.
    """
    from fieldlum import plan
    from fieldlum.core.records import listed
    from fieldlum.plan import makeup
    from fieldlum.session import open_session
    from fieldlum.session.site_toml import load_site
    from fieldlum.weather import read_weather

    day = start.date() if start else None
    dates = (out, day, year, days, count)
    example = "for example: fieldlum plan SITE.toml --set 9-day --out my-session"
    # texts of the errors of usage, each with the condition under which it is printed
    wrong = {
        "--replan and --add work on a session, with its dates: omit --set, --out, --start, "
        "--year, --days and --count": (replan or add) and (set_ or any(dates)),
        "--replan and --add exclude each other: use one after the other": replan and add,
        f"{target} is a folder: a new plan needs a SITE.toml; a session takes --replan or --add": (
            target.is_dir() and not (replan or add)
        ),
        "--label-shift needs a weather file: name one with --weather": (
            label_shift_min and not weather_file
        ),
        f"name --set and --out, {example}": not (replan or add or (set_ and out)),
        "--start, --add: expected a year from 1950 to 2100": any(
            not 1950 <= d.year <= 2100 for d in (start, *add) if d
        ),
        "--start and --year exclude each other: use one of them": day and year,
        "--count needs --set even": count and set_ != "even",
        "--days needs --set month or even": days and set_ not in ("month", "even"),
    }
    if text := next((text for text, is_wrong in wrong.items() if is_wrong), ""):
        raise click.UsageError(text)
    setup = open_session(target).site_file() if replan or add else load_site(target)
    site, now, weather = setup.site, datetime.now(UTC), None
    if weather_file:
        weather = read_weather(weather_file, site, label_shift_min=label_shift_min)
    on_sheet: list[str] = []
    if replan:
        session = open_session(target)
        answer = makeup.run(session, now)
        sentences = makeup.sentences(answer, site.timezone)
    elif add:
        session = open_session(target)
        answer = makeup.add_days(session, [day.date() for day in add])
        sentences = [f"slots added to the plan: {listed(answer['added'], 8) or 'none is missing'}"]
    else:
        assert out is not None and set_ is not None
        today = plan.today_at(site, now)
        request = plan.Request(set_, today, start=day, year=year, days=days, count=count)
        with terminal.progress("choosing hours"):
            session, planned = plan.run(setup, request, out, weather)
        terminal.notes(planned.warnings)
        answer = plan.summary(session, planned)
        sentences = plan.sentences(answer)
        on_sheet = [*sentences[1:], *planned.warnings]
        sentences = [*sentences, f"next: fieldlum doctor {out}"]
    plan.write_calendar(session, now)
    plan.write_sheets(session, weather, on_sheet)
    terminal.print_answer(as_json, answer, sentences)
