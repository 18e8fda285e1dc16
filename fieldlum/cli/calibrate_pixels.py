"""`fieldlum calibrate pixels`: list hot, dead and stuck pixels in the profile."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fieldlum.cli.calibrate_shared import Refit, calibration_options, say_time
from fieldlum.cli.options import EXISTING_PATH


@click.command()
@click.argument("sources", metavar="FRAME|FOLDER...", nargs=-1, required=True, type=EXISTING_PATH)
@click.option("--dark", is_flag=True, help="The frames were taken with the cap on.")
@calibration_options
def command(
    sources: tuple[Path, ...],
    dark: bool,
    refit: Refit,
) -> None:
    """List hot, dead and stuck pixels in the profile (raw cameras).

    SOURCES are folders with the frames of three or more views; turn the camera between them, so
    that only defects of the sensor stay in place. Or take two or more long frames with the cap on
    (--dark); these do not show dead pixels. Pixels that the profile already lists remain listed.

    \b
    Example:
      fieldlum calibrate pixels north south west --camera mine.toml --out mine.toml
    """
    from dataclasses import replace

    from fieldlum.calibrate import pictures, pixels

    profile = refit.profile()
    say_time(sources, profile)
    defects = pixels.find(sources, profile, dark=dark)
    refit.draw(
        lambda: pictures.of_pixels(defects, profile.camera.width_px, profile.camera.height_px)
    )
    bad_px = tuple(sorted({*profile.sensor.bad_px, *defects.bad_px}))
    figures: dict[str, Any] = {
        "found": len(defects.bad_px),
        "new": len(bad_px) - len(profile.sensor.bad_px),
        "views": defects.views,
        "by_chance": defects.by_chance,
    }
    if refit.as_json:
        figures["bad_px"] = [list(place) for place in defects.bad_px]
    sensor = replace(profile.sensor, bad_px=bad_px)
    refit.write(profile, defects.frames, [defects.line], figures, sensor=sensor)
