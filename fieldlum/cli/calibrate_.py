"""The command group `fieldlum calibrate`; each PART is a command in a module calibrate_PART."""

from __future__ import annotations

import click

from fieldlum.cli.options import LazyGroup

# In the order in which a profile is fitted. Each name is a module calibrate_NAME with a click
# command `command`.
PARTS = (
    "lens",
    "response",
    "vignette",
    "colour",
    "scale",
    "shutter",
    "pixels",
    "linearity",
    "stray",
)


@click.group("calibrate", cls=LazyGroup, names=PARTS, module="calibrate_{}")
def command() -> None:
    """Fit a camera's profile from ordinary captures.

    Each fit starts from a profile (--camera) and writes a new one (--out); both may be one file.
    Raw cameras also have pixels and linearity and, once some sessions are merged, shutter.

    \b
    Example, in this order:
      fieldlum calibrate lens flat.dng --circle --full-angle 186 --camera mine.toml --out mine.toml
      fieldlum calibrate response bracket-1 bracket-2 --camera mine.toml --out mine.toml
      fieldlum calibrate vignette patches.csv --camera mine.toml --out mine.toml
      fieldlum calibrate colour spots.csv --camera mine.toml --out mine.toml
      fieldlum calibrate scale readings.csv --camera mine.toml --out mine.toml
      fieldlum calibrate shutter SESSION --camera mine.toml --out mine.toml
      fieldlum calibrate pixels cap-on-*.dng --dark --camera mine.toml --out mine.toml
    """
