"""Define the options that all `fieldlum calibrate` commands share.

Also write the fitted profile and print the results.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fieldlum.cli import terminal
from fieldlum.cli.estimates import estimate_text, frames_s
from fieldlum.cli.options import PATH, json_option, out_option
from fieldlum.records import JsonTable

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fieldlum.profiles import CameraProfile, Lens


@dataclass(frozen=True, slots=True)
class Refit:
    """Options of every `calibrate` command: start profile, output file, picture, JSON output."""

    camera: str
    out: Path
    picture: Path | None
    as_json: bool

    def profile(self) -> CameraProfile:
        """Load the profile of --camera. Raises InputError if it is missing or invalid."""
        from fieldlum.profiles import load_camera_profile

        return load_camera_profile(self.camera)

    def draw(self, figure: Callable[[], Figure]) -> None:
        """Call `figure` and save what it returns, if --picture names a file."""
        from fieldlum.calibrate import pictures

        if self.picture:
            pictures.save(figure(), self.picture)

    def write(
        self,
        profile: CameraProfile,
        frames: Iterable[Path],
        lines: list[str],
        figures: JsonTable,
        **changed: Any,
    ) -> None:
        """Write the profile with its fields in `changed` replaced, and print lines and figures.

        lines: one about each fit, stored in the profile; frames: files whose sha256 is stored.
        """
        from fieldlum.calibrate import save_calibration

        save_calibration(self.out, profile, frames, lines, datetime.now(UTC).date(), **changed)
        if self.as_json:
            terminal.emit_json({**figures, "why": lines, "profile": str(self.out)})
            return
        shown = [f"{name}: {value}" for name, value in figures.items()]
        click.echo("\n".join([*lines, *shown, f"wrote {self.out}"]))


def calibration_options(function: Callable[..., None]) -> Callable[..., None]:
    """Add --camera, --out, --picture and --json to a command, as one argument `refit`."""

    @functools.wraps(function)
    def gathered(
        *, camera: str, out: Path, picture: Path | None, as_json: bool, **own: Any
    ) -> None:
        function(**own, refit=Refit(camera, out, picture, as_json))

    for option in (
        json_option,
        click.option("--picture", type=PATH, help="Draw readings, fit and residuals (PNG, SVG)."),
        out_option("The profile", required=True),
        click.option(
            "--camera", required=True, help="The profile to start from: a file, or a shipped name."
        ),
    ):
        gathered = option(gathered)
    return gathered


lens_option = click.option(
    "--lens",
    "lens_number",
    type=click.IntRange(min=1),
    default=1,
    help="Number of the lens in the profile.",
)


def lens_index(profile: CameraProfile, lens_number: int) -> int:
    """Return the index, from 0, of the lens that --lens counts from 1.

    Raises click.UsageError if there is no such lens.
    """
    if lens_number > len(profile.lens):
        raise click.UsageError(
            f"--lens {lens_number}: {profile.camera.name} has {len(profile.lens)} lens(es), "
            "counted from 1"
        )
    return lens_number - 1


def with_lens(profile: CameraProfile, index: int, lens: Lens) -> tuple[Lens, ...]:
    """Return the profile's lenses with the one at `index` replaced by `lens`."""
    return (*profile.lens[:index], lens, *profile.lens[index + 1 :])


def say_time(frames: Iterable[Path], profile: CameraProfile, *, boards: bool = False) -> None:
    """Print the estimated time to read frames, if it is 20 s or more.

    frames: files, or folders of files; boards: estimate the time to detect chessboards instead.
    """
    files = sum(
        sum(1 for p in path.iterdir() if p.is_file()) if path.is_dir() else 1 for path in frames
    )
    camera = profile.camera
    needed_s = frames_s(files, camera.width_px * camera.height_px, boards=boards)
    terminal.say_if(estimate_text(needed_s))
