"""`fieldlum plan`: choose the hours to capture and write the session."""

from __future__ import annotations

from dataclasses import asdict, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import click

from fieldlum.cli import terminal
from fieldlum.cli.declared import EXISTING_PATH
from fieldlum.cli.options import DAY, CaptureSet, Year, command_of

if TYPE_CHECKING:
    from fieldlum.core.records import Site, SiteFile
    from fieldlum.weather import Weather

WeatherFile = tuple[Path | None, float]
"""A weather file, and the minutes to add to its times."""


@command_of("plan")
def command(
    target: Annotated[Path, "SITE.toml|SESSION", EXISTING_PATH],
    set_: CaptureSet | None = None,
    start: Annotated[datetime | None, DAY] = None,
    year: Year = None,
    days: Annotated[int | None, click.IntRange(1, 366)] = None,
    count: Annotated[int | None, click.IntRange(min=1)] = None,
    weather_file: Path | None = None,
    label_shift_min: float = 0.0,
    filter_: str | None = None,
    out: Path | None = None,
    ics: bool = False,
    html: bool = False,
    next_: bool = False,
    replan: bool = False,
    as_json: bool = False,
) -> None:
    """Choose the hours to capture and write the session.

    With a session, --next lists what to capture next, and --replan adds make-up slots for missed
    hours.

    \b
    Example:
      fieldlum plan office.toml --set 9-day --out office-2027 --ics --html
      fieldlum plan office-2027 --next --weather seattle.epw
      fieldlum plan office-2027 --replan

    Options:
      --set: Which hours of the year to capture.
      --start YYYY-MM-DD: First day, local date. [default: the next possible one]
      --year: Plan the events of this year.
      --days: Number of days of a month (31), or of the period for even and best (365).
      --count: Number of hours, for even (200) and best (50).
      --weather: Weather year (EPW, TMY3 or CSV), for skies and coverage.
      --filter NAME: Add frames of the sun through this neutral-density filter of the profile,
        which a person puts on for them. [default: filter under [camera] in SITE.toml, or none]
      --out: The session folder to write.
      --ics: Also write plan.ics, one event per day.
      --html: Also write plan.html, one printable sheet per day.
      --next: Rank the hours of the next two weeks by how much they would improve the model.
      --replan: Add make-up slots for the missed ones.
    """
    if next_ and replan:
        raise click.UsageError("--next and --replan exclude each other: use one of them")
    if (next_ or replan) and (set_ or out):
        raise click.UsageError("--next and --replan work on a session: omit --set and --out")
    if next_ and (ics or html):
        raise click.UsageError("--next writes no files: omit --ics and --html")
    if (next_ or replan) and (start or year or days or count or filter_ is not None):
        raise click.UsageError(
            "--next and --replan keep the session's dates and exposures: omit --start, --year, "
            "--days, --count and --filter"
        )
    if label_shift_min and weather_file is None:
        raise click.UsageError("--label-shift is for a weather file: name one with --weather")
    sky = (weather_file, label_shift_min)
    if next_:
        answer, sentences = _coming(target, sky)
    elif replan:
        answer, sentences = _replanned(target, ics, html, sky)
    elif set_ is None or out is None:
        raise click.UsageError(
            "name --set and --out, for example: fieldlum plan SITE.toml --set 9-day --out "
            "my-session"
        )
    else:
        _check(set_, start, year, days, count, weather_file)
        asked = (set_, start.date() if start else None, year, days, count)
        answer, sentences = _planned(target, asked, sky, filter_, out, ics, html)
    if as_json:
        terminal.emit_json(answer)
    else:
        click.echo("\n".join(sentences))


def _check(
    set_: str,
    start: datetime | None,
    year: int | None,
    days: int | None,
    count: int | None,
    weather_file: Path | None,
) -> None:
    """Raise click.UsageError for an option that is missing, impossible or without effect."""
    if set_ == "best" and weather_file is None:
        raise click.UsageError(
            "the best hours depend on the climate: name a weather year with --weather FILE"
        )
    if start and not 1950 <= start.year <= 2100:
        raise click.UsageError(f"--start {start:%Y-%m-%d}: expected a year from 1950 to 2100")
    if start and year:
        raise click.UsageError("--start and --year exclude each other: use one of them")
    if count and set_ not in ("even", "best"):
        raise click.UsageError(
            f"--count needs --set even or best; the number of hours of {set_} follows from its days"
        )
    if days and set_ in ("9-day", "12-day", "4-day"):
        raise click.UsageError(f"--days needs --set month, even or best; {set_} has fixed days")


def _planned(
    target: Path,
    asked: tuple,
    sky: WeatherFile,
    filter_: str | None,
    out: Path,
    ics: bool,
    html: bool,
) -> tuple[dict, list[str]]:
    from fieldlum import plan
    from fieldlum.session.site_toml import load_site

    setup = load_site(target)
    if filter_ is not None:
        setup = replace(setup, camera=replace(setup.camera, filter=filter_))
    set_, start, year, days, count = asked
    request = plan.Request(
        set_, plan.today_at(setup.site, datetime.now(UTC)), start, year, days, count
    )
    weather = _weather(sky, setup.site)
    _permit_room(setup)
    with terminal.progress("choosing hours") as progress:
        session, made = plan.run(setup, request, out, weather, progress)
    answer = plan.summary(session, made)
    for note in made.warnings:
        terminal.say(f"note: {note}")
    sentences = plan.sentences(answer)
    if ics:
        plan.write_calendar(session, datetime.now(UTC))
    if html:
        plan.write_sheets(session, weather, [*sentences[1:], *made.warnings])
    return asdict(answer), sentences


def _permit_room(setup: SiteFile) -> None:
    """Permit the room file of a SITE.toml that the user named, with a note of what it could run."""
    from fieldlum.room.scene.room_commands import described, what_runs
    from fieldlum.session.permits import permit

    if setup.room is None or setup.room.kind == "box":
        return
    path = Path(setup.room.file)
    wanted = what_runs(path)
    if wanted is None:
        return
    terminal.say(f"note: {path} is {described(path)}; permitted, as you plan with it")
    try:
        permit(wanted)
    except OSError as error:
        terminal.say(f"note: could not store the permission ({error}): fieldlum permit {path}")


def _coming(target: Path, sky: WeatherFile) -> tuple[dict, list[str]]:
    from fieldlum.plan import coming
    from fieldlum.session import open_session

    session = open_session(target)
    weather = _weather(sky, session.site_file().site)
    if weather is None:
        from fieldlum.weather import synthetic_weather

        weather = synthetic_weather(session.site_file().site)
        terminal.say(
            "note: no --weather: skies of this place are replaced by clear skies with random clouds"
        )
    with terminal.progress("ranking hours") as progress:
        answer = coming.run(session, weather, datetime.now(UTC), progress)
    return coming.as_table(answer), coming.sentences(answer, session.site_file().site)


def _replanned(target: Path, ics: bool, html: bool, sky: WeatherFile) -> tuple[dict, list[str]]:
    from fieldlum import plan
    from fieldlum.plan import makeup
    from fieldlum.session import open_session

    session = open_session(target)
    answer = makeup.run(session, datetime.now(UTC))
    if ics or (session.root / "plan.ics").exists():
        plan.write_calendar(session, datetime.now(UTC))
    if html or (session.root / "plan.html").exists():
        plan.write_sheets(session, _weather(sky, session.site_file().site))
    return asdict(answer), makeup.sentences(answer)


def _weather(sky: WeatherFile, site: Site) -> Weather | None:
    path, label_shift_min = sky
    if path is None:
        return None
    from fieldlum.weather import read_weather

    return read_weather(path, site, label_shift_min=label_shift_min)
