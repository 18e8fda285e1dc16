"""`fieldlum calibrate response`: fit JPEG codes to linear light."""

from __future__ import annotations

from pathlib import Path

import click

from fieldlum.cli.calibrate_shared import Refit, calibration_options, say_time
from fieldlum.cli.options import EXISTING_PATH


@click.command()
@click.argument("brackets", nargs=-1, required=True, type=EXISTING_PATH)
@calibration_options
def command(brackets: tuple[Path, ...], refit: Refit) -> None:
    """Fit JPEG codes to linear light, from brackets of a still scene.

    BRACKETS are folders with one bracket each, or the JPEG files of one bracket.

    \b
    Example:
      fieldlum calibrate response bracket-1 bracket-2 --camera mine.toml --out mine.toml
    """
    import numpy as np

    from fieldlum.calibrate import pictures, response

    profile = refit.profile()
    say_time(brackets, profile)
    places = response.sample(response.brackets_in(brackets), profile, np.random.default_rng(1))
    fitted = response.fit(places)
    refit.draw(lambda: pictures.of_response(places, fitted))
    figures = {
        "kind": fitted.response.kind,
        "u_rel": fitted.response.u_rel,
        "residual_rgb": list(fitted.residual),
        "shutter_law": places.law.law,
        "shutter_law_by": places.law.decided_by,
        "shutter_law_misfit_percent": places.law.misfit_percent,
        "iso_seconds": [round(float(e), 6) for e in np.exp(places.log_exposure)],
        "step_deviation_percent": [round(100.0 * float(d), 2) for d in places.steps.deviation],
    }
    law_is_known = places.law.decided_by == "frames" or profile.shutter_law != "auto"
    refit.write(
        profile,
        places.frames,
        [text for text in (fitted.choice.line, places.steps.text) if text],
        figures,
        response=fitted.response,
        shutter_law=places.law.law if law_is_known else profile.shutter_law,
    )
