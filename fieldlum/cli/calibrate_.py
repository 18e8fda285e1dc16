"""The command group `fieldlum calibrate`: its parts, and how each of them is run."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import click

from fieldlum.cli import terminal
from fieldlum.cli.declared import EXISTING_PATH, PATH, declare
from fieldlum.cli.options import SHARED

LensNumber = Annotated[int, click.IntRange(min=1)]
_EVERY = (
    click.Option(
        ["--camera"], required=True, help="The profile to start from: a file, or a shipped name."
    ),
    click.Option(["--out"], type=PATH, required=True, help="The profile to write."),
    click.Option(["--picture"], type=PATH, help="Draw readings, fit and residuals (PNG, SVG)."),
    SHARED["as_json"],
)


class _InOrder(click.Group):
    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names in the order in which a profile is fitted."""
        return list(self.commands)


@click.group("calibrate", cls=_InOrder)
def command() -> None:
    """Fit a camera's profile from ordinary captures.

    Each fit starts from a profile (--camera) and writes a new one (--out); both may be one file.
    Raw cameras also have pixels and linearity and, once some sessions are merged, shutter.

    \b
    Example, in this order:
      fieldlum calibrate lens flat.dng --circle --full-angle 186 --camera mine.toml --out mine.toml
      fieldlum calibrate response bracket-1 bracket-2 --camera mine.toml --out mine.toml
      fieldlum calibrate vignette patches.csv --camera mine.toml --out mine.toml
      fieldlum calibrate colour spots.csv --camera mine.toml --out mine.toml
      fieldlum calibrate scale readings.csv --camera mine.toml --out mine.toml
      fieldlum calibrate shutter SESSION --camera mine.toml --out mine.toml
      fieldlum calibrate pixels cap-on-*.dng --dark --camera mine.toml --out mine.toml
    """


def _run(
    name: str, camera: str, out: Path, picture: Path | None, as_json: bool, **own: Any
) -> None:
    """Fit one part, draw it, print what it found, and write the profile."""
    from fieldlum.calibrate import pictures, save_calibration
    from fieldlum.cli import calibrate_fits
    from fieldlum.optics.profiles import load_camera_profile

    profile = load_camera_profile(camera)
    own |= {"camera": camera} if name == "shutter" else {}
    new = getattr(calibrate_fits, f"fit_{name}")(profile, **own)
    for note in new.notes:
        terminal.say(f"note: {note}")
    if picture and new.figure:
        pictures.save(new.figure(), picture)
    save_calibration(
        out, new.profile or profile, new.frames, new.lines, datetime.now(UTC).date(), **new.changed
    )
    if as_json:
        terminal.emit_json({**new.figures, **new.only_json, "why": new.lines, "profile": str(out)})
        return
    figures = {n: list(v) if isinstance(v, tuple) else v for n, v in new.figures.items()}
    shown = [f"{name}: {value}" for name, value in figures.items()]
    if new.rows:
        terminal.print_table(new.rows, new.columns, "  ")
    click.echo("\n".join([*new.lines, *shown, f"wrote {out}"]))


def _part(function: Callable[..., None]) -> click.Command:
    """Add the command of a part; its parameters are those of `calibrate_fits.fit_NAME`."""
    name = function.__name__
    made = declare(function, name, SHARED)
    made.callback, made.params = partial(_run, name), [*made.params, *_EVERY]
    command.add_command(made)
    return made


# The parts, in the order in which a profile is fitted.


@_part
def lens(
    sources: Annotated[tuple[Path, ...], "TARGETS.csv|FRAME...", EXISTING_PATH] = (),
    lens_number: LensNumber = 1,
    full_angle_deg: Annotated[float | None, click.FloatRange(10, 330)] = None,
    circle: bool = False,
    chessboard: str | None = None,
    trim_deg: Annotated[float | None, click.FloatRange(0.1, 30)] = None,
) -> None:
    """Fit centre, circle, mapping and pose of a lens.

    TARGETS.csv has the columns x_px, y_px, azimuth_deg, altitude_deg; angles are relative to
    the camera's heading and the horizon. --trim needs no source.

    \b
    Example:
      fieldlum calibrate lens targets.csv --full-angle 186 --camera mine.toml --out mine.toml
      fieldlum calibrate lens board-*.jpg --chessboard 9x6 --camera mine.toml --out mine.toml
      fieldlum calibrate lens flat.jpg --circle --full-angle 186 --camera mine.toml --out mine.toml
      fieldlum calibrate lens --trim 2.5 --camera mine.toml --out mine.toml

    Options:
      --lens: Number of the lens in the profile.
      --full-angle: Full angle of the image circle.
      --circle: Centre and radius from the edge of one bright FRAME.
      --chessboard CxR: Inner corners across x down of a board in the FRAMEs, like 9x6.
      --trim: Leave out this many degrees at the edge of the image, where the lens is dark.
    """


@_part
def response(sources: Annotated[tuple[Path, ...], "BRACKETS...", EXISTING_PATH]) -> None:
    """Fit JPEG codes to linear light, from brackets of a still scene.

    BRACKETS are folders with one bracket each, or the JPEG files of one bracket.

    \b
    Example:
      fieldlum calibrate response bracket-1 bracket-2 --camera mine.toml --out mine.toml
    """


@_part
def vignette(
    sources: Annotated[tuple[Path, ...], "READINGS.csv|FRAME...", EXISTING_PATH],
    lens_number: LensNumber = 1,
) -> None:
    """Fit the loss of light towards the edge, for one aperture.

    READINGS.csv has the columns file, x_px, y_px (optional: radius_px, reference) of one patch
    seen at many angles; the fit is then for the lens that shows the patch. Or it has the
    columns angle_deg and value. FRAMEs are pictures of an evenly lit field.

    \b
    Example:
      fieldlum calibrate vignette patches.csv --camera mine.toml --out mine.toml

    Options:
      --lens: Number of the lens in the profile.
    """


@_part
def colour(
    sources: Annotated[Path, "SPOTS.csv|FRAME", EXISTING_PATH],
    corners: str | None = None,
    cct_k: Annotated[float | None, click.FloatRange(4000, 25_000)] = None,
) -> None:
    """Fit luminance and melanopic light by spot readings or a chart.

    SPOTS.csv has the columns file, x_px, y_px, luminance_cdm2, for surfaces of many colours, and
    optionally melanopic_cdm2 of a spectrometer. FRAME shows a 24-patch chart in even light.

    \b
    Example:
      fieldlum calibrate colour spots.csv --camera mine.toml --out mine.toml

    Options:
      --corners X,Y,...: Chart corners in FRAME, from the dark skin patch clockwise: 8 numbers.
      --cct K: Correlated colour temperature of the daylight on the chart, for melanopic
          light.
    """


@_part
def scale(
    sources: Annotated[Path, "READINGS.csv", EXISTING_PATH],
    meter_u: Annotated[float, click.FloatRange(0, 1)] = 0.02,
) -> None:
    """Fit the absolute factor k from spot and illuminance readings.

    READINGS.csv has the columns panorama, azimuth_deg, altitude_deg, and luminance_cdm2 or
    illuminance_lx. The panoramas must be merged with the profile of --camera; its k may have
    changed since.

    \b
    Example:
      fieldlum calibrate scale readings.csv --camera mine.toml --out mine.toml

    Options:
      --meter-u: The meter's own relative uncertainty.
    """


@_part
def shutter(sources: Annotated[tuple[Path, ...], "SESSION...", EXISTING_PATH]) -> None:
    """Fit the shutter's true times from merged sessions (raw cameras).

    The SESSIONs must be merged with this profile. Two neighbouring times are used if five or
    more brackets agree on their ratio within 2 %. A merge with the new profile starts from the
    fitted times.

    \b
    Example:
      fieldlum calibrate shutter my-session --camera mine.toml --out mine.toml
    """


@_part
def pixels(
    sources: Annotated[tuple[Path, ...], "FRAME|FOLDER...", EXISTING_PATH], dark: bool = False
) -> None:
    """List hot, dead and stuck pixels in the profile (raw cameras).

    SOURCES are folders with the frames of three or more views; turn the camera between them, so
    that only defects of the sensor stay in place. Or take two or more long frames with the cap
    on (--dark); these do not show dead pixels. Pixels that the profile already lists remain
    listed.

    \b
    Example:
      fieldlum calibrate pixels north south west --camera mine.toml --out mine.toml

    Options:
      --dark: The frames were taken with the cap on.
    """


@_part
def linearity(sources: Annotated[tuple[Path, ...], "FRAMES...", EXISTING_PATH]) -> None:
    """Fit how far raw counts are from proportional to light.

    FRAMES are raw frames of one steady light (a lit wall, or a lamp after half an hour), or
    their folder. Take two frames at each of six or more shutter times, from dark to nearly
    saturated. The light must be steady to 0.1 %. The profile gets the smallest order that
    predicts held-out times well.

    \b
    Example:
      fieldlum calibrate linearity steady/ --camera mine.toml --out mine.toml
    """


@_part
def stray(sources: Annotated[Path, "READINGS.csv", EXISTING_PATH]) -> None:
    """Fit the lens's stray light from black traps in bright fields.

    READINGS.csv has panorama, azimuth_deg and altitude_deg of places that emit no light: the
    hole of a deep dark box, or dark places around a lamp in a dark room. Add luminance_cdm2 for
    a place that is not black. Eight or more places at different angles from the light are
    needed, in pictures of one heading. `merge` then subtracts the stray light, and adds what
    the kernel does not explain to u.

    \b
    Example:
      fieldlum calibrate stray traps.csv --camera mine.toml --out mine.toml --picture stray.png
    """
