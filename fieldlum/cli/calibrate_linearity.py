"""`fieldlum calibrate linearity`: fit how far raw counts are from proportional to light."""

from __future__ import annotations

from pathlib import Path

import click

from fieldlum.cli.calibrate_shared import Refit, calibration_options, say_time
from fieldlum.cli.options import EXISTING_PATH


@click.command()
@click.argument("frames", nargs=-1, required=True, type=EXISTING_PATH)
@calibration_options
def command(frames: tuple[Path, ...], refit: Refit) -> None:
    """Fit how far raw counts are from proportional to light.

    FRAMES are raw frames of one steady light (a lit wall, or a lamp after half an hour), or their
    folder. Take two frames at each of six or more shutter times, from dark to nearly saturated. The
    light must be steady to 0.1 %. The profile gets the smallest order that predicts held-out times
    well.

    \b
    Example:
      fieldlum calibrate linearity steady/ --camera mine.toml --out mine.toml
    """
    from dataclasses import replace

    from fieldlum.calibrate import linearity, pictures

    profile = refit.profile()
    say_time(frames, profile)
    folders = {path: sorted(p for p in path.glob("*") if p.is_file()) for path in frames}
    files = [file for path in frames for file in (folders[path] if path.is_dir() else [path])]
    plain = replace(profile, sensor=replace(profile.sensor, linearity=(), exposure_offset_s=0.0))
    levels = linearity.read_levels(files, plain)
    fitted = linearity.fit(levels)
    refit.draw(lambda: pictures.of_linearity(levels, fitted))
    sensor = replace(
        profile.sensor,
        linearity=fitted.coefficients,
        linearity_u_rel=fitted.u_rel,
        exposure_offset_s=fitted.offset_s,
    )
    figures = {
        "linearity": list(fitted.coefficients),
        "u_rel": fitted.u_rel,
        "exposure_offset_s": fitted.offset_s,
        "u_exposure_offset_s": fitted.u_offset_s,
    }
    refit.write(profile, levels.frames, [fitted.choice.line], figures, sensor=sensor)
