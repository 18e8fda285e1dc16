"""`fieldlum calibrate stray`: fit the lens's stray light to readings of dark places."""

from __future__ import annotations

from pathlib import Path

import click

from fieldlum.cli.calibrate_shared import Refit, calibration_options
from fieldlum.cli.options import EXISTING_PATH


@click.command()
@click.argument("readings_csv", metavar="READINGS.csv", type=EXISTING_PATH)
@calibration_options
def command(readings_csv: Path, refit: Refit) -> None:
    """Fit the lens's stray light from black traps in bright fields.

    READINGS.csv has panorama, azimuth_deg and altitude_deg of places that emit no light: the hole
    of a deep dark box, or dark places around a lamp in a dark room. Add luminance_cdm2 for a place
    that is not black. Eight or more places at different angles from the light are needed, in
    pictures of one heading. `merge` then subtracts the stray light, and adds what the kernel does
    not explain to u.

    \b
    Example:
      fieldlum calibrate stray traps.csv --camera mine.toml --out mine.toml --picture stray.png
    """
    from fieldlum.calibrate import pictures, stray

    profile = refit.profile()
    readings = stray.from_table(readings_csv, profile)
    fitted = stray.fit(readings, readings_csv)
    refit.draw(lambda: pictures.of_stray(readings, fitted))
    files = list(dict.fromkeys(r.picture for r in readings))
    figures = {
        "angle_deg": list(fitted.kernel.angle_deg),
        "per_sr": list(fitted.kernel.per_sr),
        "u_rel": fitted.kernel.u_rel,
        "total_share": round(fitted.total_share, 5),
    }
    refit.write(
        profile,
        [readings_csv, *files],
        [fitted.choice.line],
        figures,
        stray=fitted.kernel,
        glare_floor_rel=0.0,  # the kernel's u_rel replaces it
    )
