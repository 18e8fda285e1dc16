"""`fieldlum calibrate vignette`."""

from __future__ import annotations

from pathlib import Path

import click

from fieldlum.cli.calibrate_shared import Refit, calibration_options, say_time
from fieldlum.cli.options import EXISTING_PATH


@click.command()
@click.argument(
    "sources", metavar="READINGS.csv|FRAME...", nargs=-1, required=True, type=EXISTING_PATH
)
@click.option(
    "--lens",
    "lens_number",
    type=click.IntRange(min=1),
    default=1,
    help="Number of the lens that the FRAMEs show, if the camera has several.",
)
@calibration_options
def command(
    sources: tuple[Path, ...],
    lens_number: int,
    refit: Refit,
) -> None:
    """Fit the loss of light towards the edge, for one aperture.

    READINGS.csv has the columns file, x_px, y_px (optional: radius_px, reference) of one patch seen
    at many angles; or the columns angle_deg and value. FRAMEs are pictures of an evenly lit field.

    \b
    Example:
      fieldlum calibrate vignette patches.csv --camera mine.toml --out mine.toml
    """
    from fieldlum.calibrate import pictures, vignette

    profile = refit.profile()
    if lens_number > len(profile.lens):
        raise click.UsageError(
            f"--lens {lens_number}: {profile.camera.name} has {len(profile.lens)} lens(es), "
            "counted from 1"
        )
    table = len(sources) == 1 and sources[0].suffix.lower() == ".csv"
    if not table:
        say_time(sources, profile)
    samples = (
        vignette.from_table(sources[0], profile)
        if table
        else vignette.from_uniform(sources, profile, lens_number - 1)
    )
    found = vignette.fit(samples)
    half_deg = profile.lens[samples.lens].full_angle_deg / 2
    refit.draw(lambda: pictures.of_vignette(samples, found, half_deg))
    lenses = list(profile.lens)
    lenses[samples.lens] = vignette.with_curve(lenses[samples.lens], samples.f_number, found)
    figures = {
        "f_number": samples.f_number,
        "coefficients": list(found.coefficients),
        "u_rel": found.u_rel,
    }
    refit.write(profile, samples.frames, [found.choice.line], figures, lens=tuple(lenses))
