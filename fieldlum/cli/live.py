"""Show a running capture: a panel on a terminal, lines in a pipe."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo

from fieldlum.capture.live import Live, Watch
from fieldlum.cli import terminal
from fieldlum.core.records import Site, parse_utc, utc_text

if TYPE_CHECKING:
    from rich.console import RenderableType


def panel(live: Live, site: Site) -> RenderableType:
    """Return the state of a capture as a panel that rich can print."""
    from rich.markup import escape
    from rich.panel import Panel
    from rich.progress_bar import ProgressBar
    from rich.table import Table

    rows = Table.grid(padding=(0, 2))
    rows.add_column(style="bold", no_wrap=True, min_width=6)
    rows.add_column(no_wrap=True)
    for name, text in _lines(live, ZoneInfo(site.timezone)).items():
        rows.add_row(name, text)
    bar = ProgressBar(total=max(1, live.planned), completed=live.planned - live.left, width=58)
    both = Table.grid()
    both.add_row(bar)
    both.add_row(rows)
    return Panel(both, title=f"fieldlum capture: {escape(site.name)}", width=64)


def _lines(live: Live, zone: ZoneInfo) -> dict[str, str]:
    from rich.markup import escape

    def state(text: str) -> str:
        return f"[{'green' if text == 'ok' else 'red'}]{text}[/]"

    trouble = "yellow" if live.missed or live.aborted else "green"
    lost = f"[{trouble}]{live.missed} missed, {live.aborted} aborted[/]"
    upcoming = "none"
    if live.next_slot:
        at = f"{parse_utc(live.next_slot).astimezone(zone):%a %H:%M}, {live.next_slot}"
        seconds = timedelta(seconds=max(0, round(live.next_in_s or 0.0)))
        is_now = live.state == "capturing"
        upcoming = f"{at} is being taken" if is_now else f"{at} in [bold]{seconds}[/]"
    age = f" ({live.ghi_age_s:.0f} s ago)" if live.ghi_age_s is not None else ""
    ghi = f"{live.ghi_wm2:.0f} W/m²{age}" if live.ghi_wm2 is not None else "-"
    days = f", {live.disk_days:.0f} days of captures" if live.disk_days is not None else ""
    return {
        "slots": f"[green]{live.done} done[/], {lost}, {live.left} left",
        "now": f"{live.state}, {live.t_utc.astimezone(zone):%Y-%m-%d %H:%M:%S %Z}",
        "next": upcoming,
        "camera": f"{state(live.camera)} {escape(live.last_frame)}",
        "global": f"{state(live.pyranometer)} {ghi}" if live.pyranometer else "not logged",
        "disk": f"{live.bytes_free / 1e9:.1f} GB free{days}",
        "last": escape(live.last_event) or "-",
    }


@contextmanager
def shown(site: Site) -> Iterator[Watch]:
    """Yield a function that shows the state of a capture.

    On a terminal it shows a panel. Otherwise it prints the counts of slots on stderr, at most 40
    times in a plan.
    """
    if not terminal.seen():
        yield _plain_lines()
        return
    from rich.console import Console
    from rich.live import Live as Screen

    screen = Screen(console=Console(stderr=True), refresh_per_second=4)
    screen.start()
    try:
        yield lambda live: screen.update(panel(live, site))
    finally:
        with suppress(OSError, ValueError):  # the terminal was closed
            screen.stop()


def _plain_lines() -> Watch:
    before = -1

    def show(live: Live) -> None:
        nonlocal before
        settled = live.planned - live.left
        if settled != before and settled % max(1, live.planned // 20) == 0:
            before = settled
            lost = f"{live.missed} missed, {live.aborted} aborted"
            terminal.say(f"{utc_text(live.t_utc)}  {live.done} done, {lost}, {live.left} left")

    return show
