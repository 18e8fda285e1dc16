"""`fieldlum capture`: take the planned brackets and log irradiance."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal
from zoneinfo import ZoneInfo

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import OpenSession, command_of, device_uris
from fieldlum.core.errors import DeviceError

if TYPE_CHECKING:
    from rich.console import RenderableType

    from fieldlum.capture.runner import Live, Watch
    from fieldlum.core.records import Site
    from fieldlum.session.slot_states import SlotState


@command_of("capture")
def command(
    session: OpenSession,
    camera: str | None = None,
    pyranometer: str | None = None,
    meter: str | None = None,
    clock: Literal["real", "fast"] = "real",
    grace_s: Annotated[float | None, click.FloatRange(min=0)] = None,
    every_s: Annotated[float, click.FloatRange(min=0.1)] = 5.0,
    notify: str = "",
    notify_picture: bool = False,
    heartbeat: str = "",
) -> None:
    """Take the planned brackets and log irradiance.

    You can stop and start it again at any time: at most one frame is then taken again, or the
    frames of one bracket if its last frame is over a minute old.

    \b
    Example:
      fieldlum capture office-2027 --camera gphoto: --pyranometer "serial:/dev/ttyUSB0?kind=spn1"

    Options:
      --clock: fast: simulated time.
      --grace S: How late a bracket may start, after which its slot is missed; stored in the
          session. [default: 300]
      --every S: Seconds between irradiance rows.
      --notify @FILE: Send faults and a daily summary to the apprise addresses in FILE, one
          per line (mailto://, ntfy://, tgram:// ...).
      --notify-picture: Attach the latest contact sheet to the daily summary; it may show
          people.
      --heartbeat @FILE: Fetch the address in FILE after each slot and every 10 minutes, for
          an external monitor.
    """
    from fieldlum import capture
    from fieldlum.capture.bracket import FrameChecks
    from fieldlum.capture.frame_checks import clipping_text, compare_exif
    from fieldlum.capture.notify import apprise_post, open_alerts, read_address, read_targets
    from fieldlum.capture.steady_clock import wait_for_clock
    from fieldlum.optics.raw import unreadable

    camera_uri, pyranometer_uri, meter_uri = device_uris(session, camera, pyranometer, meter)
    if not camera_uri:
        example = "--camera gphoto: (or --camera sim:office?seed=1 to try it)"
        raise click.UsageError(f"name a camera, for example {example}")
    if notify_picture and not notify:
        raise click.UsageError("--notify-picture is sent to the addresses of --notify: state them")
    if pyranometer is None and not pyranometer_uri:
        terminal.say("note: no --pyranometer: irradiance is not logged")
    used = [uri for uri in (camera_uri, pyranometer_uri, meter_uri) if uri]
    real = [uri for uri in used if not uri.startswith("sim:")]
    if clock == "fast" and real:
        raise click.UsageError(f"--clock fast is for sim: devices, not {real[0]}")
    ticking, options = capture.prepare(session, fast=clock == "fast")
    grace = options.grace_s if grace_s is None else grace_s
    options = replace(options, grace_s=grace, log_every_s=every_s)
    awake = nullcontext() if clock == "fast" else terminal.awake()
    post = apprise_post(read_targets(notify), notify.removeprefix("@")) if notify else None
    address = read_address(heartbeat) if heartbeat else ""
    if clock == "real":
        wait_for_clock(session, ticking, terminal.say)
    with (
        terminal.unattended(),
        awake,
        simulated() if clock == "fast" else shown(session.site_file().site) as display,
        open_alerts(session, post, address, terminal.say, with_picture=notify_picture) as remote,
    ):

        def watch(live: Live) -> None:
            """Show a new state of the capture here, and send faults to the addresses.

            live: the state. Sending returns at once.
            """
            remote.check(live)
            display(live)

        states = capture.run(
            session,
            camera_uri,
            pyranometer_uri,
            clock=ticking,
            options=options,
            checks=FrameChecks(compare_exif, unreadable, clipping_text),
            meter_uri=meter_uri,
            watch=watch,
            listen=remote.listen,
        )
    _show_end(session.root, list(states.slots.values()))


def _show_end(root: Path, slots: list[SlotState]) -> None:
    """Print the counts of brackets; raise DeviceError if more were aborted than done.

    root: the session's folder; slots: with their outcomes.
    """
    outcomes = Counter(slot.outcome for slot in slots)
    done, missed, aborted = outcomes["done"], outcomes["missed"], outcomes["aborted"]
    with suppress(OSError):  # the terminal may be closed by now
        click.echo(f"{root}: brackets: {done} done, {missed} missed, {aborted} aborted")
    if aborted:
        why = [slot.why for slot in slots if slot.outcome == "aborted"][-1]
        terminal.say(f"the last aborted bracket: {why}")
    if aborted > done:
        raise DeviceError(
            f"brackets: {aborted} aborted, only {done} completed; find the cause with fieldlum "
            f"doctor {root}, then plan the lost hours again with fieldlum plan {root} --replan"
        )


# ----------------------------------------------------------------------------------------------
# the state of a running capture: all lines on a terminal, the counts of slots in a pipe


def panel(live: Live, site: Site) -> RenderableType:
    """Return the state of a capture as a panel that rich can print.

    site: whose name is the title, and in whose local time times are.
    """
    from rich.panel import Panel
    from rich.text import Text

    lines = [f"{name:8} {value}" for name, value in _rows(live, ZoneInfo(site.timezone)).items()]
    text = Text("\n".join(lines), no_wrap=True, overflow="ellipsis")
    return Panel(text, title=Text(f"fieldlum capture: {site.name}"), width=64)


def _rows(live: Live, zone: ZoneInfo) -> dict[str, str]:
    """Return the texts of the panel, by name of the row; zone: of the times."""
    from fieldlum.core.records import parse_utc

    upcoming = "none"
    if live.next_slot:
        seconds = timedelta(seconds=max(0, round(live.next_in_s or 0.0)))
        when = "is being taken" if live.state == "capturing" else f"in {seconds}"
        upcoming = f"{parse_utc(live.next_slot).astimezone(zone):%a %H:%M}, {live.next_slot} {when}"
    age = f" ({live.ghi_age_s:.0f} s ago)" if live.ghi_age_s is not None else ""
    ghi = f"{live.ghi_wm2:.0f} W/m²{age}" if live.ghi_wm2 is not None else "-"
    days = f", {live.disk_days:.0f} days of captures" if live.disk_days is not None else ""
    return {
        "slots": _counts(live),
        "now": f"{live.state}, {live.t_utc.astimezone(zone):%Y-%m-%d %H:%M:%S %Z}",
        "next": upcoming,
        "camera": f"{live.camera} {live.last_frame}",
        "global": f"{live.pyranometer} {ghi}" if live.pyranometer else "not logged",
        "disk": f"{live.bytes_free / 1e9:.1f} GB free{days}",
        "last": live.last_event or "-",
    }


def _counts(live: Live) -> str:
    """Return how many slots are done, missed, aborted and left, as a text."""
    return f"{live.done} done, {live.missed} missed, {live.aborted} aborted, {live.left} left"


@contextmanager
def simulated() -> Iterator[Watch]:
    """Yield a function that shows in the `with` block how many slots of a capture are over.

    It is for simulated time. On a terminal it shows a bar, see `terminal.progress`.
    """
    with terminal.progress("capture") as show:
        yield lambda live: show(live.planned - live.left, live.planned, _counts(live))


@contextmanager
def shown(site: Site) -> Iterator[Watch]:
    """Yield a function that shows the state of a capture on stderr.

    On a terminal it shows a panel. Otherwise it prints the counts of slots, about 20 times in a
    plan. site: for name and local time.
    """
    if not terminal.is_terminal():
        slots_over = -1

        def show(live: Live) -> None:
            """Print the counts after every twentieth of the planned slots; live: state of now."""
            nonlocal slots_over
            before, slots_over = slots_over, live.planned - live.left
            if slots_over != before and slots_over % max(1, live.planned // 20) == 0:
                terminal.say(f"{live.t_utc:%Y-%m-%dT%H:%M:%SZ}  {_counts(live)}")

        yield show
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
