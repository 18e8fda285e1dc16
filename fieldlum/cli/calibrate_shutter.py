"""`fieldlum calibrate shutter`: fit the shutter's true times from merged sessions."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from fieldlum.cli import terminal
from fieldlum.cli.calibrate_shared import Refit, calibration_options
from fieldlum.cli.options import EXISTING_PATH


@click.command()
@click.argument("sessions", metavar="SESSION...", nargs=-1, required=True, type=EXISTING_PATH)
@calibration_options
def command(sessions: tuple[Path, ...], refit: Refit) -> None:
    """Fit the shutter's true times from merged sessions (raw cameras).

    The SESSIONs must be merged with this profile. Two neighbouring times are used if five or more
    brackets agree on their ratio within 2 %. A merge with the new profile starts from the fitted
    times.

    \b
    Example:
      fieldlum calibrate shutter my-session --camera mine.toml --out mine.toml
    """
    from fieldlum.calibrate import pictures, shutter
    from fieldlum.profiles import find_camera_profile
    from fieldlum.session import open_session, sha256

    profile, digest = refit.profile(), sha256(find_camera_profile(refit.camera))
    read = [shutter.from_session(open_session(path), digest) for path in sessions]
    files = [file for _, sidecars in read for file in sidecars]
    profile = shutter.with_law_of(profile, files)
    fitted = shutter.fit([bracket for brackets, _ in read for bracket in brackets], profile)
    refit.draw(lambda: pictures.of_shutter(fitted))
    for why in fitted.left_out:
        terminal.say(f"note: not used: {why}; capture more brackets in steady light")
    rows = [
        {
            "nominal_s": t.nominal_s,
            "true_s": t.true_s,
            "u_rel": t.u_rel,
            "assumed_s": assumed_s,
            "brackets": n,
        }
        for t, assumed_s, n in zip(fitted.times, fitted.assumed_s, fitted.brackets, strict=True)
    ]
    for row in [] if refit.as_json else rows:
        off, u = 100 * (row["true_s"] / row["assumed_s"] - 1), 100 * row["u_rel"]
        click.echo(
            f"  {row['nominal_s']:<10.6g} s is {row['true_s']:<10.6g} s: {off:+6.2f} % from the "
            f"profile, u {u:.2f} %, {row['brackets']} brackets"
        )
    figures: dict[str, Any] = {"times": rows} if refit.as_json else {"times": len(rows)}
    times = shutter.with_times(profile, fitted)
    refit.write(profile, files, [fitted.line], figures, shutter=times)
