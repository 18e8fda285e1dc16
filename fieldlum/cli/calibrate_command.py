"""The command group `fieldlum calibrate`: each part is fitted, drawn, printed and stored alike."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import click

from fieldlum.cli import terminal
from fieldlum.cli.command_parameters import EXISTING_PATH, InOrder, declare, numbers
from fieldlum.cli.options import SHARED

if TYPE_CHECKING:
    from fieldlum.calibrate.fit_charts import Chart
    from fieldlum.optics.profiles import CameraProfile, Lens

LensNumber = Annotated[int, click.IntRange(min=1)]
Paths = tuple[Path, ...]


def _every(camera: str, out: Path, picture: Path | None = None, as_json: bool = False) -> None:
    """Declare the options that all parts of a profile have.

    Options:
      --camera PROFILE: The profile to start from: a file, or a shipped name.
      --out PATH: The profile to write.
      --picture PATH: Draw readings, fit and residuals (PNG, SVG).
    """


@dataclass(frozen=True, slots=True)
class FittedPart:
    """What a fit changes in the profile, and what is printed about it.

    changed: new values of the profile, by field. lines: sentences about the fit, printed and stored
    in the profile. frames: files whose sha256 is stored. chart: of the fit. notes: for the user, on
    stderr. figures: printed after the lines, by name; `points` is a table.
    """

    changed: dict[str, Any]
    lines: list[str]
    frames: Iterable[Path]
    chart: Chart
    notes: Sequence[str] = ()
    figures: dict[str, Any] = field(default_factory=dict)


@click.group("calibrate", cls=InOrder)
def command() -> None:
    """Fit a camera's profile from ordinary captures.

    Each fit starts from a profile (--camera) and writes a new one (--out); both may be one file.
    Raw cameras also have pixels and linearity.

    \b
    Example, in this order:
      fieldlum calibrate lens flat.dng --circle --camera mine.toml --out mine.toml
      fieldlum calibrate response bracket-1 bracket-2 --camera mine.toml --out mine.toml
      fieldlum calibrate vignette patches.csv --camera mine.toml --out mine.toml
      fieldlum calibrate colour spots.csv --camera mine.toml --out mine.toml
      fieldlum calibrate scale readings.csv --camera mine.toml --out mine.toml
      fieldlum calibrate pixels cap-on-*.dng --camera mine.toml --out mine.toml
    """


def _run(
    fit: Callable[..., FittedPart],
    camera: str,
    out: Path,
    picture: Path | None,
    as_json: bool,
    **own: Any,
) -> None:
    """Fit one part of a profile, draw the fit, print its result, and write the profile.

    fit: the part's function; camera: the profile to start from; out: the profile to write; picture:
    file of the chart; own: the part's own options.
    """
    from fieldlum.calibrate import save_calibration
    from fieldlum.calibrate.fit_charts import draw
    from fieldlum.core.strict_toml import plain
    from fieldlum.optics.profiles import load_camera_profile

    profile = load_camera_profile(camera)
    with terminal.progress("calibrate"):
        new = fit(profile, **own)
    terminal.notes(new.notes)
    if picture:
        draw(new.chart, picture)
    save_calibration(out, profile, new.frames, new.lines, datetime.now(UTC).date(), **new.changed)
    answer = {**plain(new.changed), **new.figures, "why": new.lines, "profile": str(out)}
    lines = [*new.lines]
    for name, value in new.figures.items():
        if name == "points":
            lines += terminal.table_lines(value, indent="  ")
            continue
        text = ", ".join(value) or "none" if isinstance(value, list | tuple) else value
        lines.append(f"{name}: {text}")
    terminal.print_answer(as_json, answer, [*lines, f"wrote {out}"])


def _part(fit: Callable[..., FittedPart]) -> click.Command:
    """Add the command of a part of the profile, named as its function, and return it.

    The function's first parameter is the profile; the others are options of the command.
    """
    signature = inspect.signature(fit)
    own = list(signature.parameters.values())[1:]
    fit.__signature__ = signature.replace(parameters=own)  # type: ignore[attr-defined]
    part = declare(fit, fit.__name__, SHARED)
    part.callback = partial(_run, fit)
    part.params += declare(_every, "", SHARED).params
    command.add_command(part)
    return part


def _lens_index(profile: CameraProfile, lens_number: int) -> int:
    """Return the index, from 0, of the lens that --lens counts from 1.

    Raises click.UsageError if the profile has fewer lenses.
    """
    if lens_number > len(profile.lens):
        has = f"{profile.camera.name} has {len(profile.lens)} lens(es), counted from 1"
        raise click.UsageError(f"--lens {lens_number}: {has}")
    return lens_number - 1


def _with_lens(profile: CameraProfile, index: int, new: Lens) -> dict[str, Any]:
    """Return the changed field of a profile whose lens at `index` is replaced by `new`."""
    return {"lens": (*profile.lens[:index], new, *profile.lens[index + 1 :])}


# The parts, in the order in which a profile is fitted.


@_part
def lens(
    profile: Any,
    sources: Annotated[Paths, "TARGETS.csv|FRAME...", EXISTING_PATH],
    lens_number: LensNumber = 1,
    circle: bool = False,
    chessboard: Annotated[Any, numbers(2, "x")] = None,
) -> FittedPart:
    """Fit centre, circle, mapping and pose of a lens.

    TARGETS.csv has the columns x_px, y_px, azimuth_deg, altitude_deg; azimuths are clockwise
    from the camera's heading, altitudes upwards from the horizon.

    \b
    Example:
      fieldlum calibrate lens targets.csv --camera mine.toml --out mine.toml
      fieldlum calibrate lens board-*.jpg --chessboard 9x6 --camera mine.toml --out mine.toml
      fieldlum calibrate lens flat.jpg --circle --camera mine.toml --out mine.toml

    Options:
      --lens: Number of the lens in the profile.
      --circle: Centre and radius from the edge of one bright FRAME.
      --chessboard CxR: Inner corners across x down of a board in the FRAMEs, like 9x6.
    """
    if circle and (chessboard is not None or len(sources) != 1):
        raise click.UsageError("--circle works on one FRAME, and without --chessboard")
    if chessboard is not None and min(chessboard) < 3:
        raise click.UsageError("--chessboard: a board has 3 x 3 inner corners or more, like 9x6")
    if not circle and chessboard is None and sources[0].suffix.lower() != ".csv":
        raise click.UsageError(f"{sources[0]}: name TARGETS.csv, or --circle or --chessboard CxR")
    index = _lens_index(profile, lens_number)
    if circle:
        return _by_circle(sources[0], profile, index)
    return _by_targets(sources, profile, index, chessboard)


def _by_circle(frame: Path, profile: CameraProfile, index: int) -> FittedPart:
    """Fit centre and radius of lens `index` to the edge of the image circle in one frame."""
    from fieldlum.calibrate import lens as lenses

    start, grey = profile.lens[index], lenses.frame_picture(frame, profile)
    edge = lenses.circle(grey, start, frame, guessed=not profile.camera.date)
    (x, y), radius_px = edge.centre_px, edge.radius_px
    new = replace(start, centre_px=(round(x, 2), round(y, 2)), radius_px=round(radius_px, 2))
    changed, chart = _with_lens(profile, index, new), lenses.circle_chart(edge, frame)
    line = f"lens: circle of radius {radius_px:.1f} px, uncertainty {edge.u_px:.1f} px"
    return FittedPart(changed, [line], [frame], chart)


def _by_targets(
    sources: Paths, profile: CameraProfile, index: int, chessboard: tuple[float, ...] | None
) -> FittedPart:
    """Fit centre, mapping and pose of lens `index` to targets.

    sources: a csv of targets, or frames of a chessboard with inner corners `chessboard`: columns,
    rows.
    """
    from fieldlum.calibrate import lens as lenses

    start, notes = profile.lens[index], []
    if chessboard:
        columns, rows = map(int, chessboard)
        pictures = ((path, lenses.frame_picture(path, profile)) for path in sources)
        boards = {p: lenses.chessboard_corners(grey, columns, rows) for p, grey in pictures}
        corners = [corners_px for corners_px in boards.values() if corners_px is not None]
        notes = [f"no {columns} x {rows} board found in {p}" for p in sources if boards[p] is None]
        fit, targets = lenses.fit_boards(corners, columns, rows, start)
    else:
        targets = lenses.from_table(sources[0], profile)
        fit = lenses.fit(targets, start)
    half_deg = start.full_angle_deg / 2
    if fit.widest_deg < 0.9 * half_deg:
        widest = f"no target beyond {fit.widest_deg:.0f} deg from the axis"
        notes.append(f"{widest}: the mapping from there to {half_deg:g} deg is extrapolated")
    line, notes = "; CAUTION: ".join([fit.choice.line, *fit.warnings]), [*notes, *fit.warnings]
    changed, chart = _with_lens(profile, index, fit.lens), lenses.chart(targets, fit)
    return FittedPart(changed, [line], sources, chart, notes)


@_part
def response(profile: Any, sources: Annotated[Paths, "BRACKETS...", EXISTING_PATH]) -> FittedPart:
    """Fit JPEG codes to linear light, from brackets of a still scene.

    BRACKETS are folders with one bracket each, or the JPEG files of one bracket. A bracket has
    three or more exposures, by EXIF, in steps of at most 2 EV. Camera, light, aperture and white
    balance must not change. The fit is that of Debevec and Malik (1997); held-out places choose
    among standard curves and tables.

    \b
    Example:
      fieldlum calibrate response bracket-1 bracket-2 --camera mine.toml --out mine.toml
    """
    import numpy as np

    from fieldlum.calibrate import response as responses

    places = responses.sample(responses.brackets_in(sources), profile, np.random.default_rng(1))
    fit = responses.fit(places)
    lines = [text for text in (fit.choice.line, places.steps.text) if text]
    changed, chart = {"response": fit.response}, responses.chart(places, fit)
    return FittedPart(changed, lines, places.frames, chart)


@_part
def vignette(
    profile: Any,
    sources: Annotated[Paths, "READINGS.csv|FRAME...", EXISTING_PATH],
    lens_number: LensNumber = 1,
) -> FittedPart:
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
    from fieldlum.calibrate import vignette as vignettes

    index = _lens_index(profile, lens_number)
    if len(sources) == 1 and sources[0].suffix.lower() == ".csv":
        samples = vignettes.from_table(sources[0], profile, index)
    else:
        samples = vignettes.from_uniform(sources, profile, index)
    fit, old = vignettes.fit(samples), profile.lens[samples.lens]
    changed = _with_lens(profile, samples.lens, vignettes.with_curve(old, samples.f_number, fit))
    chart = vignettes.chart(samples, fit, old.full_angle_deg / 2)
    return FittedPart(changed, [fit.choice.line], samples.frames, chart)


@_part
def colour(
    profile: Any,
    sources: Annotated[Path, "SPOTS.csv|FRAME", EXISTING_PATH],
    corners: Annotated[Any, numbers(8, ",")] = None,
    cct_k: Annotated[float | None, click.FloatRange(4000, 25_000)] = None,
    clear_glass: bool = False,
) -> FittedPart:
    """Fit luminance and melanopic light by spot readings or a chart.

    SPOTS.csv has the columns file, x_px, y_px, luminance_cdm2, for surfaces of many colours, and
    optionally melanopic_cdm2; or spectrum in place of both, with files of a JETI spectrometer.
    FRAME shows a 24-patch chart in even light.

    \b
    Example:
      fieldlum calibrate colour spots.csv --camera mine.toml --out mine.toml

    Options:
      --corners X,Y,...: Chart corners in FRAME, from the dark skin patch clockwise: 8 numbers.
      --cct K: Correlated colour temperature of the daylight on the chart, or on the grey surface of
          the first row, for melanopic light.
      --clear-glass: Rooms have clear, low-e or solar-control glass, not grey, bronze or film.
    """
    from fieldlum.calibrate import colour as calibration

    is_table, notes = sources.suffix.lower() == ".csv", []
    if is_table:
        colours = calibration.from_table(sources, profile)
    else:
        colours = calibration.from_chart(sources, profile, corners or (), cct_k or 6500.0)
    fit = calibration.fit(colours, profile)
    if is_table and abs(fit.scale - 1) > 0.03:
        notes.append(f"the readings multiply k by {fit.scale:.3f}: run fieldlum calibrate scale")
    new = replace(profile.colour, y_from_rgb=fit.y_from_rgb, u_rel=round(fit.u_rel, 5))
    new, line = calibration.with_melanopic(new, colours, profile, fit.scale, cct_k, clear_glass)
    files = dict.fromkeys([sources, *(place.path for place in colours.places)])
    chart, lines = calibration.chart(colours, fit), [fit.choice.line, line]
    return FittedPart({"colour": new}, lines, files, chart, notes)


@_part
def scale(
    profile: Any,
    sources: Annotated[Path, "READINGS.csv", EXISTING_PATH],
    meter_u: Annotated[float, click.FloatRange(0, 1)] = 0.02,
) -> FittedPart:
    """Fit the absolute factor k from spot and illuminance readings.

    READINGS.csv has the columns panorama, azimuth_deg (clockwise from true north), altitude_deg,
    and luminance_cdm2 or illuminance_lx. The panoramas must be merged with the profile of --camera;
    its k may have changed since.

    \b
    Example:
      fieldlum calibrate scale readings.csv --camera mine.toml --out mine.toml

    Options:
      --meter-u: The meter's own relative uncertainty.
    """
    from fieldlum.calibrate import scale as scales
    from fieldlum.optics.illuminance import illuminance_verdict

    readings, frames, notes = scales.from_table(sources, profile)
    fit = scales.fit(readings, meter_u, sources)
    warning = scales.check_level(fit, profile, sources)
    points = [
        {"reading": r.label, "meter": r.meter, "picture": r.image * fit.factor, "off_percent": off}
        for r, off in zip(readings, (100 * fit.residual).round(2).tolist(), strict=True)
    ]
    # readings of an illuminance meter, which are compared with the picture's illuminance
    planes = [reading for reading in readings if reading.kind != "spot"]
    verdicts = [illuminance_verdict(p.image * fit.factor, p.meter) for p in planes]
    k, u = round(profile.scale.k * fit.factor, 5), round(fit.u_rel, 4)
    figures = {"points": points, "k": k, "u_rel": u, "factor": fit.factor, "far": fit.far}
    figures["illuminance"] = verdicts
    line = f"{fit.line}; k = {k:g}, uncertainty {100 * u:.1f} % from {len(readings)} readings"
    line += "".join(f"; illuminance: {verdict}" for verdict in verdicts)
    line += f"; CAUTION: {warning}" if warning else ""
    notes = [*notes, *scales.outlier_texts(readings, fit), *filter(None, [warning])]
    changed, chart = {"scale": replace(profile.scale, k=k, u_rel=u)}, scales.chart(readings, fit)
    return FittedPart(changed, [line], [sources, *frames], chart, notes, figures)


@_part
def pixels(profile: Any, sources: Annotated[Paths, "FRAME|FOLDER...", EXISTING_PATH]) -> FittedPart:
    """List hot and stuck pixels in the profile (raw cameras).

    Take two or more long frames with the cap on. Pixels that the profile already lists remain
    listed.

    \b
    Example:
      fieldlum calibrate pixels dark-*.dng --camera mine.toml --out mine.toml
    """
    from fieldlum.calibrate import sensor as calibration

    defects, sensor = calibration.find(sources, profile), profile.sensor
    bad_px = tuple(sorted({*sensor.bad_px, *defects.bad_px}))
    changed, chart = {"sensor": replace(sensor, bad_px=bad_px)}, calibration.pixel_chart(defects)
    return FittedPart(changed, [defects.line], defects.frames, chart)


@_part
def linearity(profile: Any, sources: Annotated[Paths, "FRAMES...", EXISTING_PATH]) -> FittedPart:
    """Fit how far raw counts are from proportional to light.

    FRAMES are raw frames of one steady light (a lit wall, or a lamp after half an hour), or
    their folder. Take two frames at each of six or more shutter times, from dark to nearly
    saturated. The light must be steady to 0.1 %. The profile gets the smallest order that
    predicts held-out times well.

    \b
    Example:
      fieldlum calibrate linearity steady/ --camera mine.toml --out mine.toml
    """
    from fieldlum.calibrate import sensor as calibration
    from fieldlum.optics.raw import frame_files

    # frames are read without the correction that is fitted here
    plain = replace(profile, sensor=replace(profile.sensor, linearity=(), exposure_offset_s=0.0))
    levels = calibration.read_levels(frame_files(*sources), plain)
    fit = calibration.fit(levels)
    own = {"linearity": fit.coefficients, "linearity_u_rel": fit.u_rel}
    sensor = replace(profile.sensor, **own, exposure_offset_s=fit.offset_s)
    chart, figures = calibration.chart(levels, fit), {"u_exposure_offset_s": fit.u_offset_s}
    return FittedPart({"sensor": sensor}, [fit.choice.line], levels.frames, chart, figures=figures)


@_part
def stray(profile: Any, sources: Annotated[Path, "READINGS.csv", EXISTING_PATH]) -> FittedPart:
    """Fit the lens's stray light from black traps in bright fields.

    READINGS.csv has panorama, azimuth_deg (clockwise from true north) and altitude_deg of places
    that emit no light: the hole of a deep dark box, or dark places around a lamp in a dark room.
    Add luminance_cdm2 for a place that is not black. Eight or more places at different angles from
    the light are needed, in pictures of one heading. `merge` then subtracts the stray light, and
    adds what the kernel does not explain to u.

    \b
    Example:
      fieldlum calibrate stray traps.csv --camera mine.toml --out mine.toml --picture stray.png
    """
    from fieldlum.calibrate import stray as calibration

    readings = calibration.from_table(sources, profile)
    fit = calibration.fit(readings, sources)
    changed = {"stray": fit.kernel, "glare_floor_rel": 0.0}  # the kernel's u_rel replaces the floor
    frames = [sources, *dict.fromkeys(reading.place.path for reading in readings)]
    chart = calibration.chart(readings, fit)
    figures = {"total_share": round(fit.total_share, 5)}
    return FittedPart(changed, [fit.choice.line], frames, chart, figures=figures)
