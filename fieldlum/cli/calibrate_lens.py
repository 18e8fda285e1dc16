"""`fieldlum calibrate lens`: fit centre, circle, mapping and pose of a lens."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from fieldlum.cli import terminal
from fieldlum.cli.calibrate_shared import (
    Refit,
    calibration_options,
    lens_index,
    lens_option,
    say_time,
    with_lens,
)
from fieldlum.cli.options import EXISTING_PATH
from fieldlum.records import JsonTable

if TYPE_CHECKING:
    from fieldlum.calibrate.boards import Boards
    from fieldlum.profiles import CameraProfile, Lens


@click.command()
@click.argument("sources", metavar="TARGETS.csv|FRAME...", nargs=-1, type=EXISTING_PATH)
@lens_option
@click.option(
    "--full-angle",
    "full_angle_deg",
    type=click.FloatRange(10, 330),
    help="Full angle of the image circle.",
)
@click.option("--circle", is_flag=True, help="Centre and radius from the edge of one bright FRAME.")
@click.option(
    "--chessboard",
    metavar="CxR",
    help="Inner corners across x down of a board in the FRAMEs, like 9x6.",
)
@click.option(
    "--against",
    type=EXISTING_PATH,
    help="An older frame; the centre is moved by the shift from it to FRAME.",
)
@click.option(
    "--trim",
    "trim_deg",
    type=click.FloatRange(0.1, 30),
    help="Leave out this many degrees at the edge of the image, where the lens is dark.",
)
@calibration_options
def command(
    sources: tuple[Path, ...],
    lens_number: int,
    full_angle_deg: float | None,
    circle: bool,
    chessboard: str | None,
    against: Path | None,
    trim_deg: float | None,
    refit: Refit,
) -> None:
    """Fit centre, circle, mapping and pose of a lens.

    TARGETS.csv has the columns x_px, y_px, azimuth_deg, altitude_deg; angles are relative to the
    camera's heading and the horizon. --trim needs no source.

    \b
    Example:
      fieldlum calibrate lens targets.csv --full-angle 186 --camera mine.toml --out mine.toml
      fieldlum calibrate lens board-*.jpg --chessboard 9x6 --camera mine.toml --out mine.toml
      fieldlum calibrate lens flat.jpg --circle --full-angle 186 --camera mine.toml --out mine.toml
      fieldlum calibrate lens --trim 2.5 --camera mine.toml --out mine.toml
    """
    from dataclasses import replace

    profile = refit.profile()
    ways = (circle, chessboard is not None, against is not None, trim_deg is not None)
    if sum(ways) > 1:
        raise click.UsageError(
            "--circle, --chessboard, --against and --trim exclude each other: use one of them"
        )
    if bool(sources) == (trim_deg is not None):
        raise click.UsageError("name TARGETS.csv or FRAMEs; with --trim, name none")
    index = lens_index(profile, lens_number)
    start = profile.lens[index]
    if full_angle_deg is not None:
        start = replace(start, full_angle_deg=full_angle_deg)
    if trim_deg is not None:
        new, line, figures = _trim(start, trim_deg)
    elif circle or against is not None:
        new, line, figures = _edge(sources, start, against, refit)
    else:
        new, line, figures = _mapping(sources, start, chessboard, profile, refit)
    frames = [*sources, *([against] if against else [])]
    refit.write(profile, frames, [line], figures, lens=with_lens(profile, index, new))


def _trim(start: Lens, trim_deg: float) -> tuple[Lens, str, JsonTable]:
    from fieldlum.calibrate.lens_circle import trimmed

    half_deg = start.full_angle_deg / 2
    if trim_deg >= half_deg:
        raise click.UsageError(
            f"--trim {trim_deg:g}: the lens has a half angle of {half_deg:g} degrees; state a "
            "smaller width"
        )
    new = trimmed(start, trim_deg)
    line = (
        f"lens: image circle of {new.full_angle_deg:g} degrees, radius {new.radius_px:.2f} px "
        f"(before: {start.full_angle_deg:g} degrees, {start.radius_px:.2f} px)"
    )
    return new, line, {"full_angle_deg": new.full_angle_deg, "radius_px": new.radius_px}


def _edge(
    sources: tuple[Path, ...], start: Lens, against: Path | None, refit: Refit
) -> tuple[Lens, str, JsonTable]:
    from dataclasses import replace

    from fieldlum.calibrate import lens_circle, pictures

    if len(sources) != 1:
        raise click.UsageError(
            f"--circle and --against work on one FRAME; {len(sources)} files were named"
        )
    grey = lens_circle.grey_picture(sources[0])
    if against is not None:
        right, down = lens_circle.shift_px(lens_circle.grey_picture(against), grey)
        moved = (round(start.centre_px[0] + right, 2), round(start.centre_px[1] + down, 2))
        return (
            replace(start, centre_px=moved),
            f"lens: shifted by {right:+.2f}, {down:+.2f} px",
            {"shift_px": [right, down]},
        )
    image_circle = lens_circle.circle(grey, sources[0])
    refit.draw(lambda: pictures.of_circle(grey, image_circle))
    radius_px, u_px = image_circle.radius_px, image_circle.u_px
    line = f"lens: circle of radius {radius_px:.2f} px, uncertainty {u_px:.2f} px"
    figures = {
        "centre_px": list(image_circle.centre_px),
        "radius_px": image_circle.radius_px,
        "u_px": image_circle.u_px,
    }
    return lens_circle.circle_lens(start, image_circle, sources[0]), line, figures


def _mapping(
    sources: tuple[Path, ...],
    start: Lens,
    chessboard: str | None,
    profile: CameraProfile,
    refit: Refit,
) -> tuple[Lens, str, JsonTable]:
    from fieldlum.calibrate import boards, lens, pictures

    board_corners = _boards(sources, chessboard, profile) if chessboard else None
    targets = board_corners.targets if board_corners else lens.from_table(sources[0])
    fitted = boards.fit(board_corners, start) if board_corners else lens.fit(targets, start)
    refit.draw(lambda: pictures.of_lens(targets, fitted))
    if fitted.widest_deg < 0.9 * start.full_angle_deg / 2:
        terminal.say(
            f"note: no target beyond {fitted.widest_deg:.0f} deg from the axis: the mapping from "
            f"there to {start.full_angle_deg / 2:g} deg is extrapolated"
        )
    for doubt in fitted.doubts:
        terminal.say(f"note: {doubt}")
    line = "; CAUTION: ".join([fitted.choice.line, *fitted.doubts])
    figures = {
        "mapping": fitted.lens.mapping,
        "centre_px": list(fitted.lens.centre_px),
        "radius_px": fitted.lens.radius_px,
        "coefficients": list(fitted.lens.coefficients),
        "azimuth_deg": fitted.lens.azimuth_deg,
        "tilt_deg": fitted.lens.tilt_deg,
        "roll_deg": fitted.lens.roll_deg,
        "rms_px": fitted.rms_px,
        "rms_deg": fitted.rms_deg,
        "widest_deg": fitted.widest_deg,
    }
    return fitted.lens, line, figures


def _boards(sources: tuple[Path, ...], chessboard: str, profile: CameraProfile) -> Boards:
    from fieldlum.calibrate import boards

    try:
        columns, rows = (int(part) for part in chessboard.lower().split("x"))
    except ValueError:
        raise click.UsageError(
            "--chessboard needs the numbers of inner corners, across x down, like 9x6"
        ) from None
    say_time(sources, profile, boards=True)
    corners_by_path = {path: boards.chessboard_corners(path, columns, rows) for path in sources}
    with_board = {path: corners for path, corners in corners_by_path.items() if corners is not None}
    for path in sources:
        if path not in with_board:
            terminal.say(f"note: no {columns} x {rows} board found in {path}")
    size = (profile.camera.width_px, profile.camera.height_px)
    return boards.from_boards(list(with_board.values()), columns, rows, size, tuple(with_board))
