"""`fieldlum demo`: all stages on simulated captures."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import click

from fieldlum.cli.options import command_of
from fieldlum.cli.terminal import progress, say


@contextmanager
def _shown(name: str) -> Iterator[None]:
    """Print the name of a stage, and show its progress in a `with` block."""
    say(f"-- {name}")
    with progress(name):
        yield


@command_of("demo")
def command(
    folder: Path = Path("fieldlum-demo"), preset: Literal["quick", "paper"] = "quick"
) -> None:
    """Run all stages on simulated captures.

    Plans nine days in the paper's office and renders their hours with Radiance. Then runs capture,
    with a simulated camera, merge, pair, train, predict and report. Run it again after an
    interruption: finished work is not repeated.

    \b
    Example:
      fieldlum demo my-demo

    Options:
      --preset: quick: 230 x 115, a short training. paper: 460 x 230, half an hour of training.
    """
    from fieldlum.demo import run

    outcome = run(folder, preset=preset, show=_shown)
    for name, value, remark in outcome.figures:
        click.echo(f"{name:18} {value:>16}  {remark}")
    durations = [f"{name} {seconds:.0f} s" for name, seconds in outcome.seconds.items()]
    say("; ".join([*durations, f"in all {sum(outcome.seconds.values()):.0f} s"]))
    click.echo(f"report: {outcome.report}")
