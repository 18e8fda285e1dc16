"""`fieldlum calibrate scale`: fit the absolute factor k to meter readings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fieldlum.cli import terminal
from fieldlum.cli.calibrate_shared import Refit, calibration_options
from fieldlum.cli.options import EXISTING_PATH


@click.command()
@click.argument("readings_csv", metavar="READINGS.csv", type=EXISTING_PATH)
@click.option(
    "--meter-u",
    type=click.FloatRange(0, 1),
    default=0.02,
    show_default=True,
    help="The meter's own relative uncertainty.",
)
@calibration_options
def command(readings_csv: Path, meter_u: float, refit: Refit) -> None:
    """Fit the absolute factor k from spot and illuminance readings.

    READINGS.csv has the columns panorama, azimuth_deg, altitude_deg, and luminance_cdm2 or
    illuminance_lx. The panoramas must be merged with the profile of --camera; its k may have
    changed since.

    \b
    Example:
      fieldlum calibrate scale readings.csv --camera mine.toml --out mine.toml
    """
    from dataclasses import replace

    from fieldlum.calibrate import pictures, scale
    from fieldlum.photometry import illuminance_verdict

    profile = refit.profile()
    readings, frames, notes = scale.from_table(readings_csv, profile)
    fitted = scale.fit(readings, meter_u, readings_csv)
    doubt = scale.check_level(fitted, profile, readings_csv)
    for note in [*notes, *scale.slips(readings, fitted), *([doubt] if doubt else [])]:
        terminal.say(f"note: {note}")
    refit.draw(lambda: pictures.of_scale(readings, fitted))
    points = [
        {
            "reading": r.label,
            "meter": r.meter,
            "picture": r.image * fitted.factor,
            "off_percent": round(100 * float(off), 2),
        }
        for r, off in zip(readings, fitted.residual, strict=True)
    ]
    for point in [] if refit.as_json else points:
        click.echo(
            f"  {point['reading']:32} meter {point['meter']:9.4g}  picture "
            f"{point['picture']:9.4g}  {point['off_percent']:+6.2f} %"
        )
    gates = [
        illuminance_verdict(r.image * fitted.factor, r.meter)
        for r in readings
        if r.kind == "illuminance"
    ]
    k, u = round(profile.scale.k * fitted.factor, 5), round(fitted.u_rel, 4)
    figures: dict[str, Any] = {
        "k": k,
        "u_rel": u,
        "factor": fitted.factor,
        "far": list(fitted.far),
        "illuminance": gates,
    }
    if refit.as_json:
        figures["points"] = points
    line = f"{fitted.line}; k = {k:g}, uncertainty {100 * u:.1f} % from {len(readings)} readings"
    line += "".join(f"; illuminance: {gate}" for gate in gates)
    line += f"; CAUTION: {doubt}" if doubt else ""
    new = replace(profile.scale, k=k, u_rel=u)
    refit.write(profile, [readings_csv, *frames], [line], figures, scale=new)
