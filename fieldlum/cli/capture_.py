"""`fieldlum capture`: take the planned brackets and log irradiance."""

from __future__ import annotations

import os
from contextlib import nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import command_of, device_uris
from fieldlum.core.errors import DeviceError

if TYPE_CHECKING:
    from fieldlum.capture.notify import Post


@command_of("capture")
def command(
    session_folder: Path,
    camera: str | None = None,
    pyranometer: str | None = None,
    meter: str | None = None,
    clock: Literal["real", "fast"] = "real",
    grace_s: Annotated[float | None, click.FloatRange(min=0)] = None,
    every_s: Annotated[float, click.FloatRange(min=0.1)] = 5.0,
    on_misses: str = "",
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
      --on-misses COMMAND: Run this command when two slots in a row gave no bracket. Its
          environment has FIELDLUM_SLOT, FIELDLUM_OUTCOME, FIELDLUM_REASON and
          FIELDLUM_SESSION.
      --notify @FILE: Send faults and a daily summary to the apprise addresses in FILE, one
          per line (mailto://, ntfy://, tgram:// ...). The variable FIELDLUM_NOTIFY can
          state them instead.
      --notify-picture: Attach the latest contact sheet to the daily summary; it may show
          people.
      --heartbeat @FILE: Fetch the address in FILE after each slot and every 10 minutes, for
          an external monitor.
    """
    from fieldlum import capture
    from fieldlum.capture.alerts import informed
    from fieldlum.capture.bracket import FrameChecks
    from fieldlum.capture.live import Live
    from fieldlum.capture.notify import read_address
    from fieldlum.capture.utc_clock import wait_for_clock
    from fieldlum.capture.verify import bracket_doubts, doubts
    from fieldlum.cli.live import shown
    from fieldlum.core.records import counted
    from fieldlum.optics.raw import unreadable
    from fieldlum.session import open_session, sha256

    session = open_session(session_folder)
    if session.table().get("plan", {}).get("sha256") != sha256(session.plan):
        terminal.say(
            "note: plan.csv was changed after session.toml was written: run fieldlum doctor"
        )
    camera_uri, pyranometer_uri, meter_uri = device_uris(session, camera, pyranometer, meter)
    if not camera_uri:
        raise click.UsageError(
            "name a camera, for example --camera gphoto: (or --camera sim:office?seed=1 to try it)"
        )
    if pyranometer is None and not pyranometer_uri:
        terminal.say("note: no --pyranometer: irradiance is not logged")
    if clock == "fast" and (real := _real(camera_uri, pyranometer_uri, meter_uri)):
        raise click.UsageError(
            f"--clock fast simulates the time: it works with sim: and replay: devices, not {real}"
        )
    ticking, options = capture.prepare(session, fast=clock == "fast")
    options = replace(
        options,
        grace_s=options.grace_s if grace_s is None else grace_s,
        log_every_s=every_s,
        on_misses=on_misses,
    )
    awake = nullcontext() if clock == "fast" else terminal.awake()
    post, address = _post(notify), read_address(heartbeat) if heartbeat else ""
    if clock == "real":
        wait_for_clock(session, ticking, terminal.say)
    with (
        terminal.unattended(),
        awake,
        shown(session.site_file().site) as display,
        informed(session, post, address, terminal.say, with_picture=notify_picture) as remote,
    ):

        def watch(live: Live) -> None:
            remote.look(live)
            display(live)

        ledger = capture.run(
            session,
            camera_uri,
            pyranometer_uri,
            clock=ticking,
            options=options,
            watch=watch,
            listen=remote.listen,
            checks=FrameChecks(doubts, unreadable, bracket_doubts),
            meter_uri=meter_uri,
        )
    outcomes = [state.outcome for state in ledger.slots.values()]
    with suppress(OSError):  # the terminal may be closed by now
        click.echo(
            f"{session.root}: {counted(outcomes.count('done'), 'bracket')}, "
            f"{outcomes.count('missed')} missed, {outcomes.count('aborted')} aborted"
        )
    aborted = [state.why for state in ledger.slots.values() if state.outcome == "aborted"]
    if aborted:
        terminal.say(f"the last aborted bracket: {aborted[-1]}")
    if len(aborted) > outcomes.count("done"):
        raise DeviceError(
            f"{counted(len(aborted), 'bracket')} aborted, but only {outcomes.count('done')} "
            f"completed; find the cause with fieldlum doctor {session.root}, then plan the lost "
            f"hours again with fieldlum plan {session.root} --replan"
        )


def _post(option: str) -> Post | None:
    """Return the function that sends a message to the targets of --notify; None without targets."""
    from fieldlum.capture.notify import VARIABLE, apprise_post, read_targets

    targets, note = read_targets(option, os.environ.get(VARIABLE, ""))
    if note:
        terminal.say(f"note: {note}")
    return apprise_post(targets, option.removeprefix("@") or VARIABLE) if targets else None


def _real(*uris: str) -> str:
    """Return the first device that is neither simulated nor a replay; "" if there is none."""
    return next((uri for uri in uris if uri and not uri.startswith(("sim:", "replay:"))), "")
