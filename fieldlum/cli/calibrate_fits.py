"""What each part of `fieldlum calibrate` fits: the changed fields of the profile, and figures.

`fit_NAME` has the arguments of the command NAME. This module is imported when a command runs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from fieldlum.calibrate import (
    boards,
    colour,
    lens_circle,
    linearity,
    pictures,
    pixels,
    response,
    scale,
    shutter,
    stray,
    vignette,
)
from fieldlum.calibrate import lens as lenses
from fieldlum.cli import terminal
from fieldlum.cli.estimates import estimate_text, frames_s
from fieldlum.core.records import JsonTable
from fieldlum.optics.photometry import illuminance_verdict
from fieldlum.optics.profiles import CameraProfile, Lens, find_camera_profile
from fieldlum.session import open_session, sha256

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Paths = tuple[Path, ...]
_READINGS = {
    "reading": ("reading", "<"),
    "meter": ("meter", ".4g"),
    "picture": ("picture", ".4g"),
    "off_percent": ("meter less picture [%]", "+.2f"),
}
_TIMES = {
    "nominal_s": ("nominal [s]", ".6g"),
    "true_s": ("true [s]", ".6g"),
    "off_percent": ("from the profile [%]", "+.2f"),
    "u_rel": ("u (relative)", ".2g"),
    "brackets": ("brackets", "d"),
}


@dataclass(frozen=True, slots=True)
class FittedPart:
    """What a fit changes in the profile, and what is printed about it.

    changed : fields of the profile. lines : one about each fit, stored in the profile. frames :
    files whose sha256 is stored. figures : printed, in the order; only_json : printed only with
    --json. figure : draws the fit. notes : for the user, on stderr. rows, columns : a table that is
    printed first. profile : to start from, if it is not the one of --camera.
    """

    changed: dict[str, Any]
    lines: list[str]
    frames: Iterable[Path]
    figures: JsonTable
    figure: Callable[[], Figure] | None = None
    notes: Sequence[str] = ()
    rows: Sequence[JsonTable] = ()
    columns: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    only_json: JsonTable = field(default_factory=dict)
    profile: CameraProfile | None = None


def say_time(frames: Paths, profile: CameraProfile, *, boards: bool = False) -> None:
    """Print the estimated time to read frames, or folders of them, if it is 20 s or more."""
    folders = [sum(p.is_file() for p in path.iterdir()) if path.is_dir() else 1 for path in frames]
    needed_s = frames_s(sum(folders), profile.camera.pixels, boards=boards)
    terminal.say_if(estimate_text(needed_s))


def _figures(source: Any, *names: str) -> JsonTable:
    """Return attributes of a result by their names, to print."""
    return {name: getattr(source, name) for name in names}


def lens_index(profile: CameraProfile, lens_number: int) -> int:
    """Return the index, from 0, of the lens that --lens counts from 1."""
    if lens_number > len(profile.lens):
        has = f"{profile.camera.name} has {len(profile.lens)} lens(es), counted from 1"
        raise click.UsageError(f"--lens {lens_number}: {has}")
    return lens_number - 1


def with_lens(profile: CameraProfile, index: int, new: Lens) -> tuple[Lens, ...]:
    """Return the profile's lenses with the one at `index` replaced."""
    return (*profile.lens[:index], new, *profile.lens[index + 1 :])


# ----------------------------------------------------------------------------------------------
# lens


def fit_lens(
    profile: CameraProfile,
    sources: Paths,
    lens_number: int,
    full_angle_deg: float | None,
    circle: bool,
    chessboard: str | None,
    trim_deg: float | None,
) -> FittedPart:
    """Fit the lens by targets, boards or its circle, or move or trim it."""
    if circle + (chessboard is not None) + (trim_deg is not None) > 1:
        raise click.UsageError("--circle, --chessboard and --trim exclude each other")
    if bool(sources) == (trim_deg is not None):
        raise click.UsageError("name TARGETS.csv or FRAMEs; with --trim, name none")
    index = lens_index(profile, lens_number)
    start = profile.lens[index]
    if full_angle_deg is not None:
        start = replace(start, full_angle_deg=full_angle_deg)
    if circle and len(sources) != 1:
        raise click.UsageError(f"--circle works on one FRAME; {len(sources)} files were named")
    if trim_deg is not None:
        new, fitted = _trimmed(start, trim_deg)
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
    return new, FittedPart({}, [line], [], _figures(new, "full_angle_deg", "radius_px"))


def _by_circle(frame: Path, start: Lens) -> tuple[Lens, FittedPart]:
    grey = lens_circle.grey_picture(frame)
    image_circle = lens_circle.circle(grey, frame)
    new = lens_circle.circle_lens(start, image_circle, frame)
    radius_px, u_px = image_circle.radius_px, image_circle.u_px
    line = f"lens: circle of radius {radius_px:.2f} px, uncertainty {u_px:.2f} px"
    figures = _figures(image_circle, "centre_px", "radius_px", "u_px")
    drawn = partial(pictures.of_circle, grey, image_circle)
    return new, FittedPart({}, [line], [frame], figures, drawn)


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
    figures = _figures(fit.lens, "mapping", "centre_px", "radius_px", "coefficients")
    figures |= _figures(fit.lens, "azimuth_deg", "tilt_deg", "roll_deg")
    figures |= _figures(fit, "rms_px", "rms_deg", "widest_deg")
    lines, notes = ["; CAUTION: ".join([fit.choice.line, *fit.doubts])], [*notes, *fit.doubts]
    drawn = partial(pictures.of_lens, targets, fit)
    return fit.lens, FittedPart({}, lines, sources, figures, drawn, notes)


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
    places = list(boards_px.values())
    return boards.from_boards(places, columns, rows, size, tuple(boards_px)), notes


# ----------------------------------------------------------------------------------------------
# light


def fit_response(profile: CameraProfile, sources: Paths) -> FittedPart:
    """Fit the response of a JPEG camera, and its shutter law if the frames show it."""
    say_time(sources, profile)
    brackets = response.brackets_in(sources)
    places = response.sample(brackets, profile, np.random.default_rng(1))
    fit = response.fit(places)
    figures = _figures(fit.response, "kind", "u_rel") | {
        "residual_rgb": fit.residual,
        "shutter_law": places.law.law,
        "shutter_law_by": places.law.decided_by,
        "shutter_law_misfit_percent": places.law.misfit_percent,
        "iso_seconds": [round(float(e), 6) for e in np.exp(places.log_exposure)],
        "step_deviation_percent": [round(100.0 * float(d), 2) for d in places.steps.deviation],
    }
    changed: dict[str, Any] = {"response": fit.response}
    if places.law.decided_by == "frames" or profile.shutter_law != "auto":
        changed["shutter_law"] = places.law.law
    lines = [text for text in (fit.choice.line, places.steps.text) if text]
    drawn = partial(pictures.of_response, places, fit)
    return FittedPart(changed, lines, places.frames, figures, drawn)


def fit_vignette(profile: CameraProfile, sources: Paths, lens_number: int) -> FittedPart:
    """Fit the loss of light towards the edge of a lens, for one aperture."""
    index = lens_index(profile, lens_number)
    if len(sources) == 1 and sources[0].suffix.lower() == ".csv":
        samples = vignette.from_table(sources[0], profile, index)
    else:
        say_time(sources, profile)
        samples = vignette.from_uniform(sources, profile, index)
    fit, old = vignette.fit(samples), profile.lens[samples.lens]
    new = vignette.with_curve(old, samples.f_number, fit)
    figures = _figures(samples, "f_number") | _figures(fit, "coefficients", "u_rel")
    changed = {"lens": with_lens(profile, samples.lens, new)}
    drawn = partial(pictures.of_vignette, samples, fit, old.full_angle_deg / 2)
    return FittedPart(changed, [fit.choice.line], samples.frames, figures, drawn)


def fit_colour(
    profile: CameraProfile, sources: Path, corners: str | None, cct_k: float | None
) -> FittedPart:
    """Fit luminance, X, Y, Z and melanopic luminance from camera R, G, B."""
    is_table = sources.suffix.lower() == ".csv"
    if is_table and cct_k is not None:
        raise click.UsageError("--cct needs a frame of a chart instead of a table")
    if is_table:
        colours = colour.from_table(sources, profile)
    else:
        colours = colour.from_chart(sources, profile, _numbers(corners, 8) if corners else ())
    fit = colour.fit(colours, profile)
    notes = []
    if is_table and abs(fit.scale - 1) > 0.03:
        notes.append(
            f"the readings would multiply k by {fit.scale:.3f}: run fieldlum calibrate scale next"
        )
    figures = _figures(fit, "y_from_rgb", "u_rel") | {"readings": len(colours.y)}
    new = replace(profile.colour, y_from_rgb=fit.y_from_rgb, u_rel=round(fit.u_rel, 5))
    new, line = colour.with_melanopic(new, colours, profile, fit.scale, cct_k)
    figures["melanopic_from_rgb"] = list(new.melanopic_from_rgb)
    figures["melanopic_u_rel"] = new.melanopic_u_rel
    lines = [fit.choice.line, line]
    frames, drawn = [sources, *colours.frames], partial(pictures.of_colour, colours, fit)
    return FittedPart({"colour": new}, lines, frames, figures, drawn, notes)


def _numbers(text: str, count: int) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise click.UsageError(f"--corners needs {count} numbers, separated by commas")
    return numbers


def fit_scale(profile: CameraProfile, sources: Path, meter_u: float) -> FittedPart:
    """Fit the absolute factor k to meter readings."""
    readings, frames, notes = scale.from_table(sources, profile)
    fit = scale.fit(readings, meter_u, sources)
    doubt = scale.check_level(fit, profile, sources)
    points: list[JsonTable] = []
    gates = []
    for r, off in zip(readings, fit.residual, strict=True):
        shown = r.image * fit.factor
        points.append({"reading": r.label, "meter": r.meter, "picture": shown})
        points[-1]["off_percent"] = round(100 * float(off), 2)
        gates += [illuminance_verdict(shown, r.meter)] if r.kind == "illuminance" else []
    k, u = round(profile.scale.k * fit.factor, 5), round(fit.u_rel, 4)
    figures = {"k": k, "u_rel": u, **_figures(fit, "factor", "far"), "illuminance": gates}
    line = f"{fit.line}; k = {k:g}, uncertainty {100 * u:.1f} % from {len(readings)} readings"
    line += "".join(f"; illuminance: {gate}" for gate in gates)
    line += f"; CAUTION: {doubt}" if doubt else ""
    changed = {"scale": replace(profile.scale, k=k, u_rel=u)}
    frames, drawn = [sources, *frames], partial(pictures.of_scale, readings, fit)
    notes = [*notes, *scale.slips(readings, fit), *([doubt] if doubt else [])]
    part = FittedPart(changed, [line], frames, figures, drawn, notes, points, _READINGS)
    return replace(part, only_json={"points": points})


def fit_stray(profile: CameraProfile, sources: Path) -> FittedPart:
    """Fit the lens's stray light to readings of dark places."""
    readings = stray.from_table(sources, profile)
    fit = stray.fit(readings, sources)
    figures = _figures(fit.kernel, "angle_deg", "per_sr", "u_rel")
    figures["total_share"] = round(fit.total_share, 5)
    changed = {"stray": fit.kernel, "glare_floor_rel": 0.0}  # the kernel's u_rel replaces the floor
    frames = [sources, *dict.fromkeys(r.picture for r in readings)]
    drawn = partial(pictures.of_stray, readings, fit)
    return FittedPart(changed, [fit.choice.line], frames, figures, drawn)


# ----------------------------------------------------------------------------------------------
# raw cameras


def fit_shutter(profile: CameraProfile, sources: Paths, camera: str) -> FittedPart:
    """Fit the shutter's true times; camera : the text of --camera."""
    digest = sha256(find_camera_profile(camera))
    read = [shutter.from_session(open_session(path), digest) for path in sources]
    files = [file for _, sidecars in read for file in sidecars]
    profile = shutter.with_law_of(profile, files)
    fit = shutter.fit([bracket for brackets, _ in read for bracket in brackets], profile)
    notes = [f"not used: {why}; capture more brackets in steady light" for why in fit.left_out]
    times: list[JsonTable] = []
    for t, assumed_s, n in zip(fit.times, fit.assumed_s, fit.brackets, strict=True):
        times.append(_figures(t, "nominal_s", "true_s", "u_rel"))
        off_percent = round(100 * (t.true_s / assumed_s - 1), 3)
        times[-1] |= {"assumed_s": assumed_s, "brackets": n, "off_percent": off_percent}
    changed: dict[str, Any] = {"shutter": shutter.with_times(profile, fit)}
    figures, drawn = {"times": len(times)}, partial(pictures.of_shutter, fit)
    part = FittedPart(changed, [fit.line], files, figures, drawn, notes, times, _TIMES)
    return replace(part, only_json={"times": times}, profile=profile)


def fit_pixels(profile: CameraProfile, sources: Paths, dark: bool) -> FittedPart:
    """List bad pixels; those that the profile already lists remain."""
    say_time(sources, profile)
    defects = pixels.find(sources, profile, dark=dark)
    bad_px = tuple(sorted({*profile.sensor.bad_px, *defects.bad_px}))
    new = len(bad_px) - len(profile.sensor.bad_px)
    figures: JsonTable = {"found": len(defects.bad_px), "new": new}
    figures |= _figures(defects, "views", "by_chance")
    changed = {"sensor": replace(profile.sensor, bad_px=bad_px)}
    size = profile.camera.width_px, profile.camera.height_px
    drawn, places = partial(pictures.of_pixels, defects, *size), _figures(defects, "bad_px")
    part = FittedPart(changed, [defects.line], defects.frames, figures, drawn)
    return replace(part, only_json=places)


def fit_linearity(profile: CameraProfile, sources: Paths) -> FittedPart:
    """Fit how far raw counts are from proportional to light, and the shutter's offset."""
    say_time(sources, profile)
    folders = {path: sorted(p for p in path.glob("*") if p.is_file()) for path in sources}
    files = [file for path in sources for file in (folders[path] if path.is_dir() else [path])]
    plain = replace(profile, sensor=replace(profile.sensor, linearity=(), exposure_offset_s=0.0))
    levels = linearity.read_levels(files, plain)
    fit = linearity.fit(levels)
    own = {"linearity": fit.coefficients, "linearity_u_rel": fit.u_rel}
    sensor = replace(profile.sensor, **own, exposure_offset_s=fit.offset_s)
    figures: JsonTable = {"linearity": fit.coefficients, "u_rel": fit.u_rel}
    figures |= {"exposure_offset_s": fit.offset_s, "u_exposure_offset_s": fit.u_offset_s}
    drawn = partial(pictures.of_linearity, levels, fit)
    return FittedPart({"sensor": sensor}, [fit.choice.line], levels.frames, figures, drawn)
