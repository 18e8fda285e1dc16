"""Options of all `fieldlum calibrate` commands, and the output of their profile."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import PATH, json_option, out_option

if TYPE_CHECKING:
    from fieldlum.profiles import CameraProfile


def calibration_options(function: Callable[..., None]) -> Callable[..., None]:
    """Add --camera, --out, --picture and --json."""
    for option in (
        json_option,
        click.option("--picture", type=PATH, help="Draw readings, fit and residuals (PNG, SVG)."),
        out_option("The profile", required=True),
        click.option(
            "--camera", required=True, help="The profile to start from: a file, or a shipped name."
        ),
    ):
        function = option(function)
    return function


def write_profile(
    out: Path,
    profile: CameraProfile,
    frames: Iterable[Path],
    lines: list[str],
    figures: dict[str, Any],
    as_json: bool,
    **changed: Any,
) -> None:
    """Write the profile with its changed parts, and print the choice and the figures."""
    from fieldlum.calibrate import save_calibration

    save_calibration(out, profile, frames, lines, datetime.now(UTC).date(), **changed)
    if as_json:
        terminal.emit_json({**figures, "why": lines, "profile": str(out)})
        return
    shown = [f"{name}: {value}" for name, value in figures.items()]
    click.echo("\n".join([*lines, *shown, f"wrote {out}"]))
