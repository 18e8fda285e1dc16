"""The command group `fieldlum calibrate`: its parts, and how each of them is run."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import click

from fieldlum.cli import terminal
from fieldlum.cli.options import EXISTING_PATH, PATH, Decorator, json_option, out_option


def _files(metavar: str, *, many: bool = False, needed: bool = True) -> Decorator:
    nargs = -1 if many else 1
    return click.argument(
        "sources", metavar=metavar, nargs=nargs, required=needed, type=EXISTING_PATH
    )


_LENS = click.option(
    "--lens",
    "lens_number",
    type=click.IntRange(min=1),
    default=1,
    help="Number of the lens in the profile.",
)
_EVERY = (
    click.option(
        "--camera", required=True, help="The profile to start from: a file, or a shipped name."
    ),
    out_option("The profile", required=True),
    click.option("--picture", type=PATH, help="Draw readings, fit and residuals (PNG, SVG)."),
    json_option,
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
    name: str, camera: str, out: Path, picture: Path | None, as_json: bool, own: dict[str, Any]
) -> None:
    """Fit one part, draw it, print what it found, and write the profile."""
    from fieldlum.calibrate import pictures, save_calibration
    from fieldlum.cli import calibrate_fits, calibrate_lens
    from fieldlum.optics.profiles import load_camera_profile

    profile = load_camera_profile(camera)
    own |= {"camera": camera} if name == "shutter" else {}
    module = calibrate_lens if name == "lens" else calibrate_fits
    new = getattr(module, f"fit_{name}")(profile, **own)
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
    shown = [f"{figure}: {value}" for figure, value in new.figures.items()]
    click.echo("\n".join([*new.rows, *new.lines, *shown, f"wrote {out}"]))


def _part(*parameters: Decorator) -> Callable[[Callable[[], None]], click.Command]:
    """Make a command of the group from a function's name and docstring.

    parameters : click arguments and options in the order of the help, besides those of every part;
    they are the arguments of `fit_NAME` in `calibrate_fits`, or in `calibrate_lens`.
    """

    def declared(function: Callable[[], None]) -> click.Command:
        def run(camera: str, out: Path, picture: Path | None, as_json: bool, **own: Any) -> None:
            _run(function.__name__, camera, out, picture, as_json, own)

        run.__doc__ = function.__doc__
        for parameter in reversed((*parameters, *_EVERY)):
            run = parameter(run)
        return command.command(function.__name__)(run)

    return declared


# The parts, in the order in which a profile is fitted.


@_part(
    _files("TARGETS.csv|FRAME...", many=True, needed=False),
    _LENS,
    click.option(
        "--full-angle",
        "full_angle_deg",
        type=click.FloatRange(10, 330),
        help="Full angle of the image circle.",
    ),
    click.option(
        "--circle", is_flag=True, help="Centre and radius from the edge of one bright FRAME."
    ),
    click.option(
        "--chessboard",
        metavar="CxR",
        help="Inner corners across x down of a board in the FRAMEs, like 9x6.",
    ),
    click.option(
        "--against",
        type=EXISTING_PATH,
        help="An older frame; the centre is moved by the shift from it to FRAME.",
    ),
    click.option(
        "--trim",
        "trim_deg",
        type=click.FloatRange(0.1, 30),
        help="Leave out this many degrees at the edge of the image, where the lens is dark.",
    ),
)
def lens() -> None:
    """Fit centre, circle, mapping and pose of a lens.

    TARGETS.csv has the columns x_px, y_px, azimuth_deg, altitude_deg; angles are relative to
    the camera's heading and the horizon. --trim needs no source.

    \b
    Example:
      fieldlum calibrate lens targets.csv --full-angle 186 --camera mine.toml --out mine.toml
      fieldlum calibrate lens board-*.jpg --chessboard 9x6 --camera mine.toml --out mine.toml
      fieldlum calibrate lens flat.jpg --circle --full-angle 186 --camera mine.toml --out mine.toml
      fieldlum calibrate lens --trim 2.5 --camera mine.toml --out mine.toml
    """


@_part(_files("BRACKETS...", many=True))
def response() -> None:
    """Fit JPEG codes to linear light, from brackets of a still scene.

    BRACKETS are folders with one bracket each, or the JPEG files of one bracket.

    \b
    Example:
      fieldlum calibrate response bracket-1 bracket-2 --camera mine.toml --out mine.toml
    """


@_part(_files("READINGS.csv|FRAME...", many=True), _LENS)
def vignette() -> None:
    """Fit the loss of light towards the edge, for one aperture.

    READINGS.csv has the columns file, x_px, y_px (optional: radius_px, reference) of one patch
    seen at many angles; the fit is then for the lens that shows the patch. Or it has the
    columns angle_deg and value. FRAMEs are pictures of an evenly lit field.

    \b
    Example:
      fieldlum calibrate vignette patches.csv --camera mine.toml --out mine.toml
    """


@_part(
    _files("SPOTS.csv|FRAME"),
    click.option(
        "--corners",
        metavar="X,Y,...",
        help="Chart corners in FRAME, from the dark skin patch clockwise: 8 numbers.",
    ),
)
def colour() -> None:
    """Fit luminance from camera R, G, B, by spot readings or a chart.

    SPOTS.csv has the columns file, x_px, y_px, luminance_cdm2, for surfaces of many colours.
    FRAME shows a 24-patch chart in even light.

    \b
    Example:
      fieldlum calibrate colour spots.csv --camera mine.toml --out mine.toml
    """


@_part(
    _files("READINGS.csv"),
    click.option(
        "--meter-u",
        type=click.FloatRange(0, 1),
        default=0.02,
        show_default=True,
        help="The meter's own relative uncertainty.",
    ),
)
def scale() -> None:
    """Fit the absolute factor k from spot and illuminance readings.

    READINGS.csv has the columns panorama, azimuth_deg, altitude_deg, and luminance_cdm2 or
    illuminance_lx. The panoramas must be merged with the profile of --camera; its k may have
    changed since.

    \b
    Example:
      fieldlum calibrate scale readings.csv --camera mine.toml --out mine.toml
    """


@_part(_files("SESSION...", many=True))
def shutter() -> None:
    """Fit the shutter's true times from merged sessions (raw cameras).

    The SESSIONs must be merged with this profile. Two neighbouring times are used if five or
    more brackets agree on their ratio within 2 %. A merge with the new profile starts from the
    fitted times.

    \b
    Example:
      fieldlum calibrate shutter my-session --camera mine.toml --out mine.toml
    """


@_part(
    _files("FRAME|FOLDER...", many=True),
    click.option("--dark", is_flag=True, help="The frames were taken with the cap on."),
)
def pixels() -> None:
    """List hot, dead and stuck pixels in the profile (raw cameras).

    SOURCES are folders with the frames of three or more views; turn the camera between them, so
    that only defects of the sensor stay in place. Or take two or more long frames with the cap
    on (--dark); these do not show dead pixels. Pixels that the profile already lists remain
    listed.

    \b
    Example:
      fieldlum calibrate pixels north south west --camera mine.toml --out mine.toml
    """


@_part(_files("FRAMES...", many=True))
def linearity() -> None:
    """Fit how far raw counts are from proportional to light.

    FRAMES are raw frames of one steady light (a lit wall, or a lamp after half an hour), or
    their folder. Take two frames at each of six or more shutter times, from dark to nearly
    saturated. The light must be steady to 0.1 %. The profile gets the smallest order that
    predicts held-out times well.

    \b
    Example:
      fieldlum calibrate linearity steady/ --camera mine.toml --out mine.toml
    """


@_part(_files("READINGS.csv"))
def stray() -> None:
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
