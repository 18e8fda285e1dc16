"""fieldlum calibrate response|vignette|scale|lens|colour|shutter|pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from fieldlum.cli import terminal

if TYPE_CHECKING:
    from fieldlum.profiles import CameraProfile

PATH = click.Path(path_type=Path, exists=True)


@click.group("calibrate")
def command() -> None:
    """Fit a camera's profile from ordinary captures.

    Each fit starts from a profile (--camera) and writes a new one (--out). In this order:

    \b
    fieldlum calibrate lens     flat.dng --circle --full-angle 186 --camera mine.toml --out
    mine.toml
    fieldlum calibrate response bracket-1 bracket-2 --camera mine.toml --out mine.toml      (JPEG
    only)
    fieldlum calibrate vignette patches.csv --camera mine.toml --out mine.toml
    fieldlum calibrate colour   spots.csv --camera mine.toml --out mine.toml
    fieldlum calibrate scale    readings.csv --camera mine.toml --out mine.toml

    Raw cameras also, once some sessions are merged:

    \b
    fieldlum calibrate shutter  SESSION --camera mine.toml --out mine.toml
    fieldlum calibrate pixels   cap-on-*.dng --dark --camera mine.toml --out mine.toml
    """


def _shared(function: Callable[..., None]) -> Callable[..., None]:
    for option in (
        click.option(
            "--json", "as_json", is_flag=True, help="Print the figures as one JSON object."
        ),
        click.option(
            "--picture",
            type=click.Path(path_type=Path),
            help="Draw readings, fit and what is left (PNG, SVG).",
        ),
        click.option(
            "--out", required=True, type=click.Path(path_type=Path), help="The profile to write."
        ),
        click.option(
            "--camera", required=True, help="The profile to start from: a file, or a shipped name."
        ),
    ):
        function = option(function)
    return function


def _write(
    out: Path,
    profile: CameraProfile,
    frames: Iterable[Path],
    lines: list[str],
    figures: dict[str, Any],
    as_json: bool,
    **changed: Any,
) -> None:
    from fieldlum.calibrate import save_calibration

    save_calibration(out, profile, frames, lines, datetime.now(UTC).date(), **changed)
    if as_json:
        terminal.emit_json({**figures, "why": lines, "profile": str(out)})
    else:
        click.echo(
            "\n".join(
                [*lines, *(f"{name}: {value}" for name, value in figures.items()), f"wrote {out}"]
            )
        )


def _profile(camera: str) -> CameraProfile:
    from fieldlum.profiles import load_camera_profile

    return load_camera_profile(camera)


@command.command("response")
@click.argument("brackets", nargs=-1, required=True, type=PATH)
@_shared
def _response(
    brackets: tuple[Path, ...], camera: str, out: Path, picture: Path | None, as_json: bool
) -> None:
    """JPEG codes to linear light, from brackets of a still scene.

    BRACKETS are folders, one bracket each, or the JPEG files of one.

    \b
    fieldlum calibrate response bracket-1 bracket-2 --camera mine.toml --out mine.toml
    """
    import numpy as np

    from fieldlum.calibrate import pictures, response

    profile = _profile(camera)
    places = response.sample(response.brackets_in(brackets), profile, np.random.default_rng(1))
    found = response.fit(places)
    if picture:
        pictures.save(pictures.of_response(places, found), picture)
    figures = {
        "kind": found.response.kind,
        "u_rel": found.response.u_rel,
        "residual_rgb": list(found.residual),
    }
    _write(
        out, profile, places.frames, [found.choice.line], figures, as_json, response=found.response
    )


@command.command("vignette")
@click.argument("sources", metavar="READINGS.csv|FRAME...", nargs=-1, required=True, type=PATH)
@click.option(
    "--lens",
    "lens_number",
    type=click.IntRange(min=1),
    default=1,
    help="Of several lenses, for FRAMEs.",
)
@_shared
def _vignette(
    sources: tuple[Path, ...],
    lens_number: int,
    camera: str,
    out: Path,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Loss of light towards the edge, for one aperture.

    READINGS.csv: file, x_px, y_px (and radius_px, reference) of one patch seen at many angles; or
    angle_deg, value. FRAMEs: an evenly lit field.

    \b
    fieldlum calibrate vignette patches.csv --camera mine.toml --out mine.toml
    """
    from fieldlum.calibrate import pictures, vignette

    profile = _profile(camera)
    if lens_number > len(profile.lens):
        raise click.UsageError(
            f"--lens {lens_number}: {profile.camera.name} has {len(profile.lens)}"
        )
    table = len(sources) == 1 and sources[0].suffix.lower() == ".csv"
    samples = (
        vignette.from_table(sources[0], profile)
        if table
        else vignette.from_uniform(sources, profile, lens_number - 1)
    )
    found = vignette.fit(samples)
    if picture:
        half = profile.lens[samples.lens].full_angle_deg / 2
        pictures.save(pictures.of_vignette(samples, found, half), picture)
    lenses = list(profile.lens)
    lenses[samples.lens] = vignette.with_curve(lenses[samples.lens], samples.f_number, found)
    figures = {
        "f_number": samples.f_number,
        "coefficients": list(found.coefficients),
        "u_rel": found.u_rel,
    }
    _write(out, profile, samples.frames, [found.choice.line], figures, as_json, lens=tuple(lenses))


@command.command("scale")
@click.argument("readings_csv", metavar="READINGS.csv", type=PATH)
@click.option(
    "--meter-u",
    type=click.FloatRange(0, 1),
    default=0.02,
    show_default=True,
    help="The meter's own u, relative.",
)
@_shared
def _scale(
    readings_csv: Path, meter_u: float, camera: str, out: Path, picture: Path | None, as_json: bool
) -> None:
    """The absolute factor k, from spot and illuminance readings.

    READINGS.csv: panorama, azimuth_deg, altitude_deg, luminance_cdm2 or illuminance_lx; the
    panoramas merged with the profile that --camera names (only its k may have changed since).

    \b
    fieldlum calibrate scale readings.csv --camera mine.toml --out mine.toml
    """
    from dataclasses import replace

    from fieldlum.calibrate import pictures, scale
    from fieldlum.photometry import illuminance_verdict

    profile = _profile(camera)
    readings, frames, notes = scale.from_table(readings_csv, profile)
    found = scale.fit(readings, meter_u, readings_csv)
    doubt = scale.check_level(found, profile, readings_csv)
    for note in [*notes, *scale.slips(readings, found), *([doubt] if doubt else [])]:
        terminal.say(f"note: {note}")
    if picture:
        pictures.save(pictures.of_scale(readings, found), picture)
    points = [
        {
            "reading": r.label,
            "meter": r.meter,
            "picture": r.image * found.factor,
            "off_percent": round(100 * float(off), 2),
        }
        for r, off in zip(readings, found.residual, strict=True)
    ]
    for point in [] if as_json else points:
        click.echo(
            f"  {point['reading']:32} meter {point['meter']:9.4g}  picture "
            f"{point['picture']:9.4g}  "
            f"{point['off_percent']:+6.2f} %"
        )
    gates = [
        illuminance_verdict(r.image * found.factor, r.meter)
        for r in readings
        if r.kind == "illuminance"
    ]
    k, u = round(profile.scale.k * found.factor, 5), round(found.u_rel, 4)
    figures: dict[str, Any] = {
        "k": k,
        "u_rel": u,
        "factor": found.factor,
        "far": list(found.far),
        "illuminance": gates,
    }
    if as_json:
        figures["points"] = points
    line = f"{found.choice.line}; k = {k:g}, u {100 * u:.1f} % from {len(readings)} readings"
    line += "".join(f"; vertical illuminance: {gate}" for gate in gates) + (
        f"; CAUTION: {doubt}" if doubt else ""
    )
    new = replace(profile.scale, k=k, u_rel=u)
    _write(out, profile, [readings_csv, *frames], [line], figures, as_json, scale=new)


@command.command("lens")
@click.argument("sources", metavar="TARGETS.csv|FRAME...", nargs=-1, required=True, type=PATH)
@click.option(
    "--lens",
    "lens_number",
    type=click.IntRange(min=1),
    default=1,
    help="Which lens of the profile.",
)
@click.option(
    "--full-angle",
    "full_angle_deg",
    type=click.FloatRange(10, 330),
    help="Angle of the whole image circle.",
)
@click.option("--circle", is_flag=True, help="Centre and radius from the edge of one bright FRAME.")
@click.option(
    "--chessboard",
    metavar="CxR",
    help="Inner corners across x down of a board in the FRAMEs, like 9x6.",
)
@click.option("--against", type=PATH, help="An older frame: move the centre by the shift to FRAME.")
@_shared
def _lens(
    sources: tuple[Path, ...],
    lens_number: int,
    full_angle_deg: float | None,
    circle: bool,
    chessboard: str | None,
    against: Path | None,
    camera: str,
    out: Path,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Centre, circle, mapping and pose of a lens.

    TARGETS.csv: x_px, y_px, azimuth_deg, altitude_deg, relative to the camera's heading and the
    horizon.

    \b
    fieldlum calibrate lens targets.csv --full-angle 186 --camera mine.toml --out mine.toml
    fieldlum calibrate lens board-*.jpg --chessboard 9x6 --camera mine.toml --out mine.toml
    fieldlum calibrate lens flat.jpg --circle --full-angle 186 --camera mine.toml --out mine.toml
    """
    from dataclasses import replace

    profile = _profile(camera)
    if sum((circle, chessboard is not None, against is not None)) > 1:
        raise click.UsageError(
            "--circle, --chessboard and --against are three ways: give one of them"
        )
    if lens_number > len(profile.lens):
        raise click.UsageError(
            f"--lens {lens_number}: {profile.camera.name} has {len(profile.lens)}"
        )
    start = profile.lens[lens_number - 1]
    if full_angle_deg is not None:
        start = replace(start, full_angle_deg=full_angle_deg)
    if circle or against is not None:
        new, line, figures = _edge(sources, start, against, picture)
    else:
        new, line, figures = _mapping(sources, start, chessboard, profile, picture)
    lenses = list(profile.lens)
    lenses[lens_number - 1] = new
    frames = [*sources, *([against] if against else [])]
    _write(out, profile, frames, [line], figures, as_json, lens=tuple(lenses))


def _edge(
    sources: tuple[Path, ...], start: Any, against: Path | None, picture: Path | None
) -> tuple[Any, str, dict]:
    from dataclasses import replace

    from fieldlum.calibrate import lens, pictures

    if len(sources) != 1:
        raise click.UsageError("--circle and --against take one FRAME")
    grey = lens.grey_picture(sources[0])
    if against is not None:
        right, down = lens.shift_px(lens.grey_picture(against), grey)
        moved = (round(start.centre_px[0] + right, 2), round(start.centre_px[1] + down, 2))
        return (
            replace(start, centre_px=moved),
            f"lens: shifted by {right:+.2f}, {down:+.2f} px",
            {"shift_px": [right, down]},
        )
    found = lens.circle(grey)
    if picture:
        pictures.save(pictures.of_circle(grey, found), picture)
    line = f"lens: circle of radius {found.radius_px:.2f} px, its edge within {found.u_px:.2f} px"
    figures = {"centre_px": list(found.centre_px), "radius_px": found.radius_px, "u_px": found.u_px}
    return lens.circle_lens(start, found, start.full_angle_deg), line, figures


def _mapping(
    sources: tuple[Path, ...],
    start: Any,
    chessboard: str | None,
    profile: CameraProfile,
    picture: Path | None,
) -> tuple[Any, str, dict]:
    from fieldlum.calibrate import boards, lens, pictures

    seen = _boards(sources, chessboard, profile) if chessboard else None
    targets = seen.targets if seen else lens.from_table(sources[0])
    found = boards.fit(seen, start) if seen else lens.fit(targets, start)
    if picture:
        pictures.save(pictures.of_lens(targets, found), picture)
    if found.widest_deg < 0.9 * start.full_angle_deg / 2:
        terminal.say(
            f"note: no target beyond {found.widest_deg:.0f} deg from the axis: the rest, up to "
            f"{start.full_angle_deg / 2:g} deg, is extrapolated"
        )
    for doubt in found.doubts:
        terminal.say(f"note: {doubt}")
    line = "; CAUTION: ".join([found.choice.line, *found.doubts])
    figures = {
        "mapping": found.lens.mapping,
        "centre_px": list(found.lens.centre_px),
        "radius_px": found.lens.radius_px,
        "coefficients": list(found.lens.coefficients),
        "azimuth_deg": found.lens.azimuth_deg,
        "tilt_deg": found.lens.tilt_deg,
        "roll_deg": found.lens.roll_deg,
        "rms_px": found.rms_px,
        "rms_deg": found.rms_deg,
        "widest_deg": found.widest_deg,
    }
    return found.lens, line, figures


def _boards(sources: tuple[Path, ...], chessboard: str, profile: CameraProfile) -> Any:
    from fieldlum.calibrate import boards

    try:
        columns, rows = (int(part) for part in chessboard.lower().split("x"))
    except ValueError:
        raise click.UsageError("--chessboard wants inner corners across x down, like 9x6") from None
    found = {path: boards.chessboard_corners(path, columns, rows) for path in sources}
    seen = {path: corners for path, corners in found.items() if corners is not None}
    for path in sources:
        if path not in seen:
            terminal.say(f"note: no {columns} x {rows} board found in {path}")
    size = (profile.camera.width_px, profile.camera.height_px)
    return boards.from_boards(list(seen.values()), columns, rows, size, tuple(seen))


@command.command("colour")
@click.argument("source", metavar="SPOTS.csv|FRAME", type=PATH)
@click.option(
    "--corners",
    metavar="X,Y,...",
    help="Chart corners in FRAME: dark skin, then clockwise: 8 numbers.",
)
@_shared
def _colour(
    source: Path, corners: str | None, camera: str, out: Path, picture: Path | None, as_json: bool
) -> None:
    """Luminance from camera R, G, B, from spot readings or a chart.

    SPOTS.csv: file, x_px, y_px, luminance_cdm2 of surfaces of many colours. FRAME: a 24-patch chart
    in even light.

    \b
    fieldlum calibrate colour spots.csv --camera mine.toml --out mine.toml
    """
    from dataclasses import replace

    from fieldlum.calibrate import colour, pictures

    profile = _profile(camera)
    if source.suffix.lower() == ".csv":
        colours = colour.from_table(source, profile)
    else:
        colours = colour.from_chart(source, profile, _numbers(corners, 8) if corners else ())
    found = colour.fit(colours, profile)
    if picture:
        pictures.save(pictures.of_colour(colours, found), picture)
    if source.suffix.lower() == ".csv" and abs(found.scale - 1) > 0.03:
        terminal.say(f"note: the readings want k times {found.scale:.3f}: run calibrate scale next")
    figures = {
        "y_from_rgb": list(found.y_from_rgb),
        "u_rel": found.u_rel,
        "readings": len(colours.y),
    }
    new = replace(profile.colour, y_from_rgb=found.y_from_rgb, u_rel=round(found.u_rel, 5))
    _write(
        out, profile, [source, *colours.frames], [found.choice.line], figures, as_json, colour=new
    )


def _numbers(text: str, count: int) -> tuple[float, ...]:
    try:
        found = tuple(float(part) for part in text.split(","))
    except ValueError:
        found = ()
    if len(found) != count:
        raise click.UsageError(f"--corners wants {count} numbers with commas between")
    return found


@command.command("shutter")
@click.argument("sessions", metavar="SESSION...", nargs=-1, required=True, type=PATH)
@_shared
def _shutter(
    sessions: tuple[Path, ...], camera: str, out: Path, picture: Path | None, as_json: bool
) -> None:
    """The shutter's true times, from the brackets that SESSIONs have merged with this very profile
    (raw cameras).

    Five brackets or more must show two times alike. A merge with the new profile starts from these
    times.

    \b
    fieldlum calibrate shutter my-session --camera mine.toml --out mine.toml
    """
    from fieldlum.calibrate import pictures, shutter
    from fieldlum.profiles import find_camera_profile
    from fieldlum.session import open_session, sha256

    profile, digest = _profile(camera), sha256(find_camera_profile(camera))
    read = [shutter.from_session(open_session(path), digest) for path in sessions]
    found = shutter.fit([bracket for brackets, _ in read for bracket in brackets], profile)
    if picture:
        pictures.save(pictures.of_shutter(found), picture)
    for why in found.left_out:
        terminal.say(f"note: left out: {why}")
    rows = [
        {
            "nominal_s": t.nominal_s,
            "true_s": t.true_s,
            "u_rel": t.u_rel,
            "assumed_s": known,
            "brackets": n,
        }
        for t, known, n in zip(found.times, found.assumed_s, found.brackets, strict=True)
    ]
    for row in [] if as_json else rows:
        off, u = 100 * (row["true_s"] / row["assumed_s"] - 1), 100 * row["u_rel"]
        click.echo(
            f"  {row['nominal_s']:<10.6g} s is {row['true_s']:<10.6g} s: {off:+6.2f} % on what "
            f"was assumed, "
            f"u {u:.2f} %, {row['brackets']} brackets"
        )
    figures: dict[str, Any] = {"times": rows} if as_json else {"times": len(rows)}
    files = [file for _, sidecars in read for file in sidecars]
    _write(
        out,
        profile,
        files,
        [found.line],
        figures,
        as_json,
        shutter=shutter.with_times(profile, found),
    )


@command.command("pixels")
@click.argument("sources", metavar="FRAME|FOLDER...", nargs=-1, required=True, type=PATH)
@click.option("--dark", is_flag=True, help="The frames were taken with the cap on.")
@_shared
def _pixels(
    sources: tuple[Path, ...],
    dark: bool,
    camera: str,
    out: Path,
    picture: Path | None,
    as_json: bool,
) -> None:
    """Hot, dead and stuck pixels, into the profile's list (raw cameras).

    Frames of three different views or more, a FOLDER for each (turn the camera: what stays is the
    sensor's); or two or more long frames with the cap on (--dark), which show no dead pixels.
    Pixels listed before stay listed.

    \b
    fieldlum calibrate pixels north south west --camera mine.toml --out mine.toml
    """
    from dataclasses import replace

    from fieldlum.calibrate import pictures, pixels

    profile = _profile(camera)
    found = pixels.find(sources, profile, dark=dark)
    if picture:
        pictures.save(
            pictures.of_pixels(found, profile.camera.width_px, profile.camera.height_px), picture
        )
    known = tuple(sorted({*profile.sensor.bad_px, *found.bad_px}))
    figures: dict[str, Any] = {
        "found": len(found.bad_px),
        "new": len(known) - len(profile.sensor.bad_px),
        "views": found.views,
        "by_chance": found.by_chance,
    }
    if as_json:
        figures["bad_px"] = [list(place) for place in found.bad_px]
    sensor = replace(profile.sensor, bad_px=known)
    _write(out, profile, found.frames, [found.line], figures, as_json, sensor=sensor)
