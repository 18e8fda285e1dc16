"""`fieldlum calibrate lens`: by targets, boards or the circle; moved, or trimmed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fieldlum.calibrate import boards, lens_circle, pictures
from fieldlum.calibrate import lens as lenses
from fieldlum.cli import terminal
from fieldlum.cli.estimates import estimate_text, frames_s
from fieldlum.core.records import JsonTable
from fieldlum.optics.profiles import CameraProfile, Lens

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Paths = tuple[Path, ...]


@dataclass(frozen=True, slots=True)
class FittedPart:
    """What a fit changes in the profile, and what is printed about it.

    changed : fields of the profile. lines : one about each fit, stored in the profile. frames :
    files whose sha256 is stored. figures : printed, in the order; only_json : printed only with
    --json. figure : draws the fit. notes : for the user, on stderr. rows : a table, printed first.
    profile : to start from, if it is not the one of --camera.
    """

    changed: dict[str, Any]
    lines: list[str]
    frames: Iterable[Path]
    figures: JsonTable
    figure: Callable[[], Figure] | None = None
    notes: Sequence[str] = ()
    rows: Sequence[str] = ()
    only_json: JsonTable = field(default_factory=dict)
    profile: CameraProfile | None = None


def say_time(frames: Paths, profile: CameraProfile, *, boards: bool = False) -> None:
    """Print the estimated time to read frames, or folders of them, if it is 20 s or more."""
    folders = [sum(p.is_file() for p in path.iterdir()) if path.is_dir() else 1 for path in frames]
    needed_s = frames_s(sum(folders), profile.camera.pixels, boards=boards)
    terminal.say_if(estimate_text(needed_s))


def lens_index(profile: CameraProfile, lens_number: int) -> int:
    """Return the index, from 0, of the lens that --lens counts from 1."""
    if lens_number > len(profile.lens):
        raise click.UsageError(
            f"--lens {lens_number}: {profile.camera.name} has {len(profile.lens)} lens(es), "
            "counted from 1"
        )
    return lens_number - 1


def with_lens(profile: CameraProfile, index: int, new: Lens) -> tuple[Lens, ...]:
    """Return the profile's lenses with the one at `index` replaced."""
    return (*profile.lens[:index], new, *profile.lens[index + 1 :])


def fit_lens(
    profile: CameraProfile,
    sources: Paths,
    lens_number: int,
    full_angle_deg: float | None,
    circle: bool,
    chessboard: str | None,
    against: Path | None,
    trim_deg: float | None,
) -> FittedPart:
    """Fit the lens by targets, boards or its circle, or move or trim it."""
    if sum((circle, chessboard is not None, against is not None, trim_deg is not None)) > 1:
        raise click.UsageError(
            "--circle, --chessboard, --against and --trim exclude each other: use one of them"
        )
    if bool(sources) == (trim_deg is not None):
        raise click.UsageError("name TARGETS.csv or FRAMEs; with --trim, name none")
    index = lens_index(profile, lens_number)
    start = profile.lens[index]
    if full_angle_deg is not None:
        start = replace(start, full_angle_deg=full_angle_deg)
    if (circle or against is not None) and len(sources) != 1:
        raise click.UsageError(
            f"--circle and --against work on one FRAME; {len(sources)} files were named"
        )
    if trim_deg is not None:
        new, fitted = _trimmed(start, trim_deg)
    elif against is not None:
        new, fitted = _moved(sources[0], start, against)
    elif circle:
        new, fitted = _by_circle(sources[0], start)
    else:
        new, fitted = _by_targets(sources, start, chessboard, profile)
    return replace(fitted, changed={"lens": with_lens(profile, index, new)})


def _trimmed(start: Lens, trim_deg: float) -> tuple[Lens, FittedPart]:
    half_deg = start.full_angle_deg / 2
    if trim_deg >= half_deg:
        raise click.UsageError(
            f"--trim {trim_deg:g}: the lens has a half angle of {half_deg:g} degrees; state a "
            "smaller width"
        )
    new = lens_circle.trimmed(start, trim_deg)
    line = (
        f"lens: image circle of {new.full_angle_deg:g} degrees, radius {new.radius_px:.2f} px "
        f"(before: {start.full_angle_deg:g} degrees, {start.radius_px:.2f} px)"
    )
    figures = {"full_angle_deg": new.full_angle_deg, "radius_px": new.radius_px}
    return new, FittedPart({}, [line], [], figures)


def _moved(frame: Path, start: Lens, against: Path) -> tuple[Lens, FittedPart]:
    before, after = (lens_circle.grey_picture(path) for path in (against, frame))
    right, down = lens_circle.shift_px(before, after)
    at = (round(start.centre_px[0] + right, 2), round(start.centre_px[1] + down, 2))
    line = f"lens: shifted by {right:+.2f}, {down:+.2f} px"
    figures = {"shift_px": [right, down]}
    return replace(start, centre_px=at), FittedPart({}, [line], [frame, against], figures)


def _by_circle(frame: Path, start: Lens) -> tuple[Lens, FittedPart]:
    grey = lens_circle.grey_picture(frame)
    found = lens_circle.circle(grey, frame)
    new = lens_circle.circle_lens(start, found, frame)
    line = f"lens: circle of radius {found.radius_px:.2f} px, uncertainty {found.u_px:.2f} px"
    figures: JsonTable = {
        "centre_px": list(found.centre_px),
        "radius_px": found.radius_px,
        "u_px": found.u_px,
    }
    return new, FittedPart({}, [line], [frame], figures, lambda: pictures.of_circle(grey, found))


def _by_targets(
    sources: Paths, start: Lens, chessboard: str | None, profile: CameraProfile
) -> tuple[Lens, FittedPart]:
    if chessboard:
        corners, notes = _boards(sources, chessboard, profile)
        targets, fit = corners.targets, boards.fit(corners, start)
    else:
        targets, notes = lenses.from_table(sources[0]), []
        fit = lenses.fit(targets, start)
    if fit.widest_deg < 0.9 * start.full_angle_deg / 2:
        notes.append(
            f"no target beyond {fit.widest_deg:.0f} deg from the axis: the mapping from "
            f"there to {start.full_angle_deg / 2:g} deg is extrapolated"
        )
    names = ("mapping", "centre_px", "radius_px", "coefficients")
    pose = ("azimuth_deg", "tilt_deg", "roll_deg")
    figures = {name: getattr(fit.lens, name) for name in (*names, *pose)}
    figures = {n: list(v) if isinstance(v, tuple) else v for n, v in figures.items()}
    figures |= {name: getattr(fit, name) for name in ("rms_px", "rms_deg", "widest_deg")}
    line = "; CAUTION: ".join([fit.choice.line, *fit.doubts])
    return fit.lens, FittedPart(
        {}, [line], sources, figures, lambda: pictures.of_lens(targets, fit), [*notes, *fit.doubts]
    )


def _boards(
    sources: Paths, chessboard: str, profile: CameraProfile
) -> tuple[boards.Boards, list[str]]:
    try:
        columns, rows = (int(part) for part in chessboard.lower().split("x"))
    except ValueError:
        raise click.UsageError(
            "--chessboard needs the numbers of inner corners, across x down, like 9x6"
        ) from None
    say_time(sources, profile, boards=True)
    corners = {path: boards.chessboard_corners(path, columns, rows) for path in sources}
    boards_px = {path: at for path, at in corners.items() if at is not None}
    notes = [f"no {columns} x {rows} board found in {p}" for p in sources if p not in boards_px]
    size = (profile.camera.width_px, profile.camera.height_px)
    found = boards.from_boards(list(boards_px.values()), columns, rows, size, tuple(boards_px))
    return found, notes
