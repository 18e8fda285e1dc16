"""`fieldlum pair`: match panoramas with irradiance, sun and sun patches."""

from collections import Counter
from typing import Any

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import OpenSession, command_of


@command_of("pair")
def command(session: OpenSession, scheduler: Any = "local", force: bool = False) -> None:
    """Match panoramas with irradiance and sun; write the sky view.

    \b
    Example:
      fieldlum pair office-2027
    """
    from fieldlum import pair
    from fieldlum.core.records import counted
    from fieldlum.pair import irradiance
    from fieldlum.sky.sky_view.view import SkyView

    with terminal.progress("irradiance"):
        health = irradiance.run(session, force=force)
    terminal.notes(health.warnings)
    with terminal.progress("pair"):
        pairs = pair.run(session, force=force, scheduler=scheduler)
    usable = sum(row.ok for row in pairs)
    paired = f"{usable} of {counted(len(pairs), 'panorama')} paired"
    click.echo(f"{session.pairs}: {paired}, {counted(health.rows, 'row')} of irradiance")
    if (view := SkyView.find(session.sky_view)) is not None:
        seen = f"sky view of {counted(view.captures, 'capture')}, which decides when the sun's disc"
        terminal.say(f"{seen} is seen: look at {session.sky_view.with_suffix('.png')}")
        terminal.notes(view.notes)
    refused = (row.why for row in pairs if not row.ok)
    cautions = (text for row in pairs if row.ok for text in row.why.split("; ") if text)
    for kind, texts in (("refused", refused), ("caution", cautions)):
        for text, count in Counter(texts).most_common(5):
            terminal.say(f"{kind} {count}: {text}")
