"""`fieldlum simulate`: render a room at the hours of a plan."""

from __future__ import annotations

from datetime import UTC, datetime
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import click

from fieldlum.cli import terminal
from fieldlum.cli.command_parameters import EXISTING_PATH
from fieldlum.cli.options import DEFAULT_SIZE, CaptureSet, Seed, Year, command_of, picture_height

if TYPE_CHECKING:
    from fieldlum.core.records import SiteFile
    from fieldlum.session import Session
    from fieldlum.session.folder import PlanTable
    from fieldlum.weather import Weather


@command_of("simulate")
def command(
    site: Annotated[Path, "SITE.toml|SESSION", EXISTING_PATH],
    out: Path | None = None,
    set_: CaptureSet | None = None,
    year: Year = None,
    count: Annotated[int | None, click.IntRange(min=1)] = None,
    weather_file: Path | None = None,
    size: str = DEFAULT_SIZE,
    quality: Literal["draft", "quick", "paper"] | None = None,
    colour: bool = False,
    seed: Seed = 1,
    scheduler: Any = "local",
    force: bool = False,
    as_json: bool = False,
) -> None:
    """Render a box room at the hours of a plan.

    Writes a session with sun patches, and truth/, which simulated devices photograph.
    truth/pairs.csv lists the true panoramas, for training; pairs.csv is a copy of it until `pair`
    writes that of the captures. Without --weather the weather is the paper's year near Seattle;
    elsewhere it is a synthetic year, and a note is printed. With a SESSION, that session's plan is
    rendered.

    \b
    Example:
      fieldlum simulate office.toml --set 9-day --size 230x115 --out office-sim

    Options:
      --out: The session folder to write.
      --set: Hours to render. [default: 9-day]
      --year: Year of the events. [default: 2027]
      --count: Use this many random daylight hours of the weather year instead of a set.
      --weather: EPW, TMY3 or CSV of the place.
      --size WxH: Size of the panoramas.
      --quality: Quality of the rendering. [default: quick up to 230x115, paper above]
      --colour: Give sky, sun and surfaces their colours, for melanopic light.
      --seed: Seed of random hours and synthetic weather.
    """
    height = picture_height(size)
    import_module("numba")  # so that a missing package is reported before any file is written
    from fieldlum.room import simulate
    from fieldlum.room.scene.radiosity import box_room
    from fieldlum.session import open_session
    from fieldlum.session.site_toml import load_site

    session = open_session(site) if site.is_dir() else None
    of_plan = {"--out": out, "--set": set_, "--year": year, "--count": count}
    if session is not None and any(of_plan.values()):
        named = ", ".join(name for name, value in of_plan.items() if value)
        raise click.UsageError(f"a SESSION is rendered in its folder, with its plan: omit {named}")
    if session is None and out is None:
        raise click.UsageError("name --out, like: fieldlum simulate office.toml --out office-sim")
    setup = session.site_file() if session is not None else load_site(site)
    box_room(setup)  # before a session is written
    weather = simulate.weather_for(setup, weather_file, seed)
    for repair in weather.repairs:
        terminal.say(f"weather: {repair}")
    chosen = quality or ("quick" if height <= 115 else "paper")
    if session is None and out is not None:
        with terminal.progress("planning"):
            session = _planned(out, setup, weather, set_ or "9-day", year or 2027, count, seed)
    assert session is not None
    picture: dict[str, Any] = {"height": height, "quality": chosen, "coloured": colour}
    with terminal.progress("simulating"):
        result = simulate.run(session, weather, **picture, scheduler=scheduler, force=force)
    answer = {"session": str(session.root), "rendered": result.rendered, "kept": result.kept}
    answer |= {"dark": result.dark, "weather": result.weather, "size": size, "quality": chosen}
    dark = f", {result.dark} without light" if result.dark else ""
    hours = f"hours: {result.rendered} rendered, {result.kept} unchanged{dark}"
    terminal.print_answer(as_json, answer, [f"{session.root}: {hours}; weather: {result.weather}"])


def _planned(
    out: Path, setup: SiteFile, weather: Weather, set_: str, year: int, count: int | None, seed: int
) -> Session:
    """Write a new session to `out`, and return it.

    Its slots are those of the capture set in the year; with `count` they are that number of random
    daylight hours of the weather. seed: of the random choice.
    """
    from fieldlum import plan
    from fieldlum.room import simulate

    if count is not None:
        slots = simulate.sample_slots(setup, weather, count, seed)
        about: PlanTable = {"set": "year-sample", "count": count, "seed": seed}
        return simulate.make_session(out, setup, slots, about)
    today = plan.today_at(setup.site, datetime.now(UTC))
    return plan.run(setup, plan.Request(set_, today, None, year, seed=seed), out, weather)[0]
