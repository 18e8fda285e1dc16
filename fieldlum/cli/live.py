"""Show a running capture: a panel on a terminal, lines in a pipe."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING
from zoneinfo import ZoneInfo

from fieldlum.capture.live import Live, Watch
from fieldlum.cli import terminal
from fieldlum.core.records import Site, parse_utc, utc_text

if TYPE_CHECKING:
    from rich.console import RenderableType


def countdown(seconds: float | None) -> str:
    """Return a time as ``mm:ss``, or ``h:mm:ss`` from one hour; "-" for None."""
    if seconds is None:
        return "-"
    whole = max(0, round(seconds))
    hours, rest = divmod(whole, 3600)
    return (f"{hours}:{rest // 60:02d}" if hours else f"{rest // 60:02d}") + f":{rest % 60:02d}"


def panel(live: Live, site: Site) -> RenderableType:
    """Return the state of a capture as a panel that rich can print."""
    from rich.markup import escape
    from rich.panel import Panel
    from rich.progress_bar import ProgressBar
    from rich.table import Table

    rows = Table.grid(padding=(0, 2))
    rows.add_column(style="bold", no_wrap=True, min_width=6)
    rows.add_column(no_wrap=True)
    for name, text in _lines(live, ZoneInfo(site.timezone)):
        rows.add_row(name, text)
    whole = Table.grid(padding=(0, 0))
    whole.add_row(
        ProgressBar(total=max(1, live.planned), completed=live.planned - live.left, width=58)
    )
    whole.add_row(rows)
    return Panel(whole, title=f"fieldlum capture: {escape(site.name)}", width=64)


def _lines(live: Live, zone: ZoneInfo) -> list[tuple[str, str]]:
    from rich.markup import escape

    trouble = "yellow" if live.missed or live.aborted else "green"
    slots = (
        f"[green]{live.done} done[/], [{trouble}]{live.missed} missed, {live.aborted} "
        f"aborted[/], {live.left} left"
    )
    at = (
        f"{parse_utc(live.next_slot).astimezone(zone):%a %H:%M}, {live.next_slot}"
        if live.next_slot
        else ""
    )
    upcoming = f"{at} in [bold]{countdown(live.next_in_s)}[/]" if at else "none"
    age = f" ({live.ghi_age_s:.0f} s ago)" if live.ghi_age_s is not None else ""
    ghi = f"{live.ghi_wm2:.0f} W/m²{age}" if live.ghi_wm2 is not None else "-"
    days = f", {live.disk_days:.0f} days of captures" if live.disk_days is not None else ""
    return [
        ("slots", slots),
        ("now", f"{live.state}, {live.t_utc.astimezone(zone):%Y-%m-%d %H:%M:%S %Z}"),
        ("next", upcoming if live.state != "capturing" else f"{at} is being taken"),
        ("camera", f"{_state(live.camera)} {escape(live.last_frame)}"),
        ("global", f"{_state(live.pyranometer)} {ghi}" if live.pyranometer else "not logged"),
        ("disk", f"{live.bytes_free / 1e9:.1f} GB free{days}"),
        ("last", escape(live.last_event) or "-"),
    ]


def _state(state: str) -> str:
    return f"[{'green' if state == 'ok' else 'red'}]{state}[/]"


@contextmanager
def shown(site: Site) -> Iterator[Watch]:
    """Yield a function that shows the state of a capture.

    On a terminal it shows a panel. Otherwise it prints the counts of slots on stderr, at most 40
    times in a plan.
    """
    if not terminal.seen():
        yield _PlainLines()
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


class _PlainLines:
    def __init__(self) -> None:
        self._settled = -1

    def __call__(self, live: Live) -> None:
        settled = live.planned - live.left
        if settled != self._settled and settled % max(1, live.planned // 20) == 0:
            self._settled = settled
            counts = (
                f"{live.done} done, {live.missed} missed, {live.aborted} aborted, {live.left} left"
            )
            terminal.say(f"{utc_text(live.t_utc)}  {counts}")
