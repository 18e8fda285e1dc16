"""`fieldlum calibrate colour`: fit luminance from camera R, G, B."""

from __future__ import annotations

from pathlib import Path

import click

from fieldlum.cli import terminal
from fieldlum.cli.calibrate_shared import Refit, calibration_options
from fieldlum.cli.options import EXISTING_PATH


@click.command()
@click.argument("source", metavar="SPOTS.csv|FRAME", type=EXISTING_PATH)
@click.option(
    "--corners",
    metavar="X,Y,...",
    help="Chart corners in FRAME, from the dark skin patch clockwise: 8 numbers.",
)
@calibration_options
def command(source: Path, corners: str | None, refit: Refit) -> None:
    """Fit luminance from camera R, G, B, by spot readings or a chart.

    SPOTS.csv has the columns file, x_px, y_px, luminance_cdm2, for surfaces of many colours. FRAME
    shows a 24-patch chart in even light.

    \b
    Example:
      fieldlum calibrate colour spots.csv --camera mine.toml --out mine.toml
    """
    from dataclasses import replace

    from fieldlum.calibrate import colour, pictures

    profile = refit.profile()
    if source.suffix.lower() == ".csv":
        colours = colour.from_table(source, profile)
    else:
        colours = colour.from_chart(source, profile, _numbers(corners, 8) if corners else ())
    fitted = colour.fit(colours, profile)
    refit.draw(lambda: pictures.of_colour(colours, fitted))
    if source.suffix.lower() == ".csv" and abs(fitted.scale - 1) > 0.03:
        terminal.say(
            f"note: the readings would multiply k by {fitted.scale:.3f}: run "
            "fieldlum calibrate scale next"
        )
    figures = {
        "y_from_rgb": list(fitted.y_from_rgb),
        "u_rel": fitted.u_rel,
        "readings": len(colours.y),
    }
    new = replace(profile.colour, y_from_rgb=fitted.y_from_rgb, u_rel=round(fitted.u_rel, 5))
    refit.write(profile, [source, *colours.frames], [fitted.choice.line], figures, colour=new)


def _numbers(text: str, count: int) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise click.UsageError(f"--corners needs {count} numbers, separated by commas")
    return numbers
