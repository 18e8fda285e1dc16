"""`fieldlum calibrate vignette`: fit the loss of light towards the edge of a lens."""

from __future__ import annotations

from pathlib import Path

import click

from fieldlum.cli.calibrate_shared import (
    Refit,
    calibration_options,
    lens_index,
    lens_option,
    say_time,
    with_lens,
)
from fieldlum.cli.options import EXISTING_PATH


@click.command()
@click.argument(
    "sources", metavar="READINGS.csv|FRAME...", nargs=-1, required=True, type=EXISTING_PATH
)
@lens_option
@calibration_options
def command(
    sources: tuple[Path, ...],
    lens_number: int,
    refit: Refit,
) -> None:
    """Fit the loss of light towards the edge, for one aperture.

    READINGS.csv has the columns file, x_px, y_px (optional: radius_px, reference) of one patch seen
    at many angles; the fit is then for the lens that shows the patch. Or it has the columns
    angle_deg and value. FRAMEs are pictures of an evenly lit field.

    \b
    Example:
      fieldlum calibrate vignette patches.csv --camera mine.toml --out mine.toml
    """
    from fieldlum.calibrate import pictures, vignette

    profile = refit.profile()
    index = lens_index(profile, lens_number)
    if len(sources) == 1 and sources[0].suffix.lower() == ".csv":
        samples = vignette.from_table(sources[0], profile, index)
    else:
        say_time(sources, profile)
        samples = vignette.from_uniform(sources, profile, index)
    fitted, lens = vignette.fit(samples), profile.lens[samples.lens]
    refit.draw(lambda: pictures.of_vignette(samples, fitted, lens.full_angle_deg / 2))
    new = vignette.with_curve(lens, samples.f_number, fitted)
    figures = {
        "f_number": samples.f_number,
        "coefficients": list(fitted.coefficients),
        "u_rel": fitted.u_rel,
    }
    lenses = with_lens(profile, samples.lens, new)
    refit.write(profile, samples.frames, [fitted.choice.line], figures, lens=lenses)
