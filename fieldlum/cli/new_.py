"""`fieldlum new`: ask questions about a site and write its SITE.toml, or an own camera profile."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

import click

from fieldlum.cli.options import command_of
from fieldlum.core.errors import InputError
from fieldlum.core.records import CameraSetup, Room, Site, SiteFile, Window

if TYPE_CHECKING:
    from fieldlum.optics.profiles import CameraProfile, Lens
    from fieldlum.optics.raw import FrameInfo, Mosaic

T = TypeVar("T")
# Smallest width and height of a window; chosen. The left edge and the sill stay twice this length
# from the end of the wall and the ceiling, so that a width and a height remain possible.
_MIN_WINDOW_M = 0.05
_ANGLE = re.compile(r"([+-]?\d+(?:\.\d+)?)\s*°?\s*([NSEWnsew]?)")
# Relative standard uncertainties of a profile that nobody calibrated; chosen, as in the shipped
# uncalibrated profiles.
_GUESS_U_VIGNETTING, _GUESS_U_COLOUR, _GUESS_U_SCALE = 0.15, 0.2, 0.5
_NOTES = {  # comments in SITE.toml, by key
    "latitude_deg": "north positive",
    "longitude_deg": "east positive",
    "timezone": "IANA name",
    "profile": "a shipped name (fieldlum info NAME), or a path",
    "heading_deg": "the panorama's middle, clockwise from true north",
    "headings": "one fisheye, turned between brackets",
    "camera_x_m": "from the main window wall's RIGHT end, seen from inside",
    "camera_y_m": "from the inside of that wall, which the room calls south",
    "wall_azimuth_deg": "where that wall faces",
    "left_m": "from the wall's LEFT end, seen from inside",
    "sill_m": "above the floor",
}


@command_of("new")
def command(
    site_file: Annotated[Path, "SITE.toml|CAMERA.toml"],
    camera: str | None = None,
    photo: Path | None = None,
) -> None:
    """Ask about a site and write its SITE.toml, or write a camera profile.

    Place, camera and heading give the full answer; a room is an option. A described room is drawn
    as SITE.svg: check the windows and azimuths there. An existing file is not overwritten. After an
    interruption the same command offers the answers so far.

    \b
    Example:
      fieldlum new office.toml
      fieldlum new my-z1.toml --camera ricoh-theta-z1-uncalibrated --photo R0010001.DNG

    Options:
      --camera PROFILE: Write an own camera profile instead, which starts from this one.
      --photo FRAME: With --camera: frame with size and camera.
    """
    from fieldlum.optics.profiles import (
        assumed_texts,
        coverage_text,
        load_camera_profile,
        uncalibrated_text,
    )
    from fieldlum.room.scene.drawing import room_svg
    from fieldlum.session.site_toml import load_site

    if site_file.exists():
        raise InputError(site_file, "the file exists already", "a new file", "choose another name")
    if camera is not None:
        _write_own_camera(site_file, camera, photo)
        return
    if photo is not None:
        raise click.UsageError("--photo describes an own camera: name a profile with --camera")
    answers = _Answers(site_file.with_name(f"{site_file.name}.answers"))
    click.get_current_context().meta[_ANSWERS] = answers
    setup = SiteFile(_site(), _camera())
    profile = load_camera_profile(setup.camera.profile)
    blind = coverage_text(profile, setup.camera)
    for note in filter(None, (*assumed_texts(setup.camera), uncalibrated_text(profile), blind)):
        click.echo(f"note: {note}")
    question = "Describe the room by tape measure? Not needed; it can sharpen the maps"
    if click.confirm(question, default=False):
        setup = _checked_room(setup.site, setup.camera)
    site_file.write_text(site_text(setup), encoding="utf-8")
    load_site(site_file)
    answers.path.unlink(missing_ok=True)
    click.echo(f"written: {site_file}")
    if drawing := room_svg(setup):
        picture = site_file.with_suffix(".svg")
        picture.write_text(drawing.replace("currentColor", "black"), encoding="utf-8")
        click.echo(f"written: {picture}: check windows, camera and north in it")
    click.echo(f"next: fieldlum plan {site_file} --set 9-day --out {site_file.stem}-session")


# ----------------------------------------------------------------------------------------------
# parts


def _site() -> Site:
    from fieldlum.session.site_toml import site_from_table, wrong_sign_text

    name = _ask("Name of the site", _name)
    latitude = _ask("Latitude in degrees (like 47.61, 47.61 N)", _angle(90.0, "NS"))
    longitude = _ask("Longitude in degrees (like -122.33, 122.33 W)", _angle(180.0, "EW"))

    def zone(text: str) -> Site:
        place = {"name": name, "latitude_deg": latitude, "longitude_deg": longitude}
        table = {"site": {**place, "timezone": _known_zone(text)}}
        site = site_from_table(table, "this place").site
        if wrong := wrong_sign_text(site):
            raise ValueError(f"{wrong}; north and east are positive")
        return site

    site = _ask("Time zone, IANA name (like Europe/Rome)", zone)
    altitude = _ask("Altitude above the sea in m", _number(-500.0, 9000.0), default="0")
    return Site(name, latitude, longitude, site.timezone, altitude)


def _camera() -> CameraSetup:
    from fieldlum.optics.profiles import camera_names, find_camera_profile, load_camera_profile

    names = camera_names()
    click.echo("Cameras with a profile:")
    for k, name in enumerate(names, start=1):
        click.echo(f"  {k}  {name}")
    click.echo("Another camera: fieldlum new CAMERA.toml --camera SIMILAR --photo FRAME")

    def profile(text: str) -> str:
        if text.lower() in ("none", "none yet"):
            return ""
        words = text.lower().split()
        similar = [name for name in names if all(word in name.lower() for word in words)]
        chosen = names[int(text) - 1] if text.isdigit() and 0 < int(text) <= len(names) else text
        if chosen not in names and len(similar) == 1:
            chosen = similar[0]
        if not Path(chosen).is_file() and chosen not in names:
            which = f"; is it {' or '.join(similar)}?" if similar and words else ""
            raise ValueError(
                f"'{text}' is no number, name or path of a profile{which}; without one answer none"
            )
        load_camera_profile(find_camera_profile(chosen))
        return chosen

    def azimuths(text: str) -> tuple[float, ...]:
        parts = [] if text == "-" else text.split(",")
        return tuple(_number(0.0, 360.0)(part) for part in parts)

    chosen = _ask("Camera: a number, a name, the path of your own profile, or none", profile)
    facing = _ask("Azimuth that the camera faces, clockwise from true north (- unknown)", azimuths)
    height = _ask("Height of the lens above the floor in m", _number(0.05, 50.0), default="1.2")
    question = "Headings of a turned head, separated by commas (- for a fixed camera)"
    headings = _ask(question, azimuths, default="-")
    missing = {"heading_deg": not facing, "profile": not chosen}
    unknown = tuple(name for name, is_missing in missing.items() if is_missing)
    heading = facing[0] if facing else CameraSetup().heading_deg
    return CameraSetup(chosen, heading, headings, height, unknown)


def _checked_room(site: Site, camera: CameraSetup) -> SiteFile:
    """Ask about the room until a room is possible; return the site with it."""
    from fieldlum.room.scene.geometry import build

    while True:
        setup = SiteFile(site, camera, _room(camera))
        assert setup.room is not None
        try:
            build(setup.room)
            return setup
        except InputError as error:
            click.echo(f"This room is not possible: {error}. Please answer again.")


def _room(camera: CameraSetup) -> Room:
    click.echo("All lengths in m. The first wall is the one with the main windows.")
    length = _number(0.3, 200.0)
    width = _ask("Width along that wall", length)
    depth = _ask("Depth away from it", length)
    height = _ask("Height", _number(1.0, 100.0))
    azimuth = _ask("Azimuth that this wall faces (0: north, 180: south)", _number(0.0, 360.0))
    from_left = _ask("Camera: from the wall's left end, seen from inside", _number(0.0, width))
    from_wall = _ask("Camera: distance from that wall", _number(0.0, depth))
    count = int(_ask("How many windows", _number(0, 20), default="1"))
    windows = tuple(_window(k + 1, width, depth, height, azimuth) for k in range(count))
    # camera_x_m counts from the other end, because x grows to the right as seen from outside
    return Room(
        width_m=width,
        depth_m=depth,
        height_m=height,
        camera_x_m=round(width - from_left, 4),
        camera_y_m=from_wall,
        camera_z_m=camera.height_m,
        wall_azimuth_deg=azimuth,
        window=windows,
    )


def _window(number: int, width: float, depth: float, height: float, azimuth: float) -> Window:
    """Ask for a window; azimuth: that the main wall faces, by which walls get compass names."""
    from fieldlum.room.scene.drawing import compass_walls

    walls = compass_walls(azimuth)

    def wall(text: str) -> Any:
        if text.upper() not in walls:
            raise ValueError(f"expected {', '.join(walls)}: the direction that the wall faces")
        return walls[text.upper()]

    main = next(iter(walls))
    name = _ask(f"Window {number}: wall that faces ({', '.join(walls)})", wall, default=main)
    length = width if name in ("south", "north") else depth
    left_m = _ask(
        "  left edge from the wall's left end, seen from inside",
        _number(0.0, length - 2 * _MIN_WINDOW_M),
    )
    wide = _ask("  width", _number(_MIN_WINDOW_M, round(length - left_m, 6)))
    sill = _ask("  sill above the floor", _number(0.0, height - 2 * _MIN_WINDOW_M), default="0.9")
    high = _ask("  height", _number(_MIN_WINDOW_M, round(height - sill, 6)))
    glass = _ask("  transmittance of the glass", _number(0.01, 0.92), default="0.8")
    panes = int(_ask("  panes side by side", _number(1, 50), default="1"))
    return Window(name, left_m, wide, sill, high, glass, panes)


# ----------------------------------------------------------------------------------------------
# asking


_ANSWERS = "fieldlum.cli.new_.answers"  # key in click's context


class _Answers:
    """The (question, answer) pairs of a dialogue in a file, offered again after an interruption."""

    def __init__(self, path: Path) -> None:
        self.path, self._given = path, list[tuple[str, str]]()
        self._before: list[Any] = []
        with suppress(OSError, ValueError):
            self._before = list(json.loads(path.read_text(encoding="utf-8")))
            click.echo(f"{path} has your answers so far: press Enter to keep one")

    def offered(self, question: str) -> str | None:
        """Return the earlier answer to the next question; None without one."""
        match self._before[len(self._given) : len(self._given) + 1]:
            case [[str(asked), str(text)]] if asked == question:
                return text
        return None

    def store(self, question: str, text: str) -> None:
        """Add an answer to the file; later answers of the interrupted dialogue stay in it."""
        self._given.append((question, text))
        content = [*self._given, *self._before[len(self._given) :]]
        self.path.write_text(json.dumps(content, ensure_ascii=False), encoding="utf-8")


def _ask(question: str, reader: Callable[[str], T], default: str | None = None) -> T:
    """Ask a question until `reader` accepts the answer; return what `reader` returns."""
    answers: _Answers | None = click.get_current_context().meta.get(_ANSWERS)

    def checked(text: str) -> T:
        try:
            value = reader(text.strip())
        except (InputError, ValueError) as error:
            raise click.UsageError(str(error)) from None
        if answers:
            answers.store(question, text)
        return value

    offered = answers.offered(question) if answers else None
    return click.prompt(question, default=offered or default, value_proc=checked)


def _name(text: str) -> str:
    if not text or not text.isprintable():
        raise ValueError("a name of printable characters")
    return text


def _number(low: float, high: float) -> Callable[[str], float]:
    def reader(text: str) -> float:
        try:
            value = float(text.replace(",", "."))
        except ValueError:
            raise ValueError(f"'{text}' is not a number") from None
        if not low <= value <= high:
            raise ValueError(f"{value:g}: expected {low:g} to {high:g}")
        return value

    return reader


def _angle(limit: float, winds: str) -> Callable[[str], float]:
    def reader(text: str) -> float:
        match = _ANGLE.fullmatch(text)
        if match is None or (match[2] and match[2].upper() not in winds):
            raise ValueError(f"'{text}': expected decimal degrees, also with {' or '.join(winds)}")
        value = float(match[1]) * (-1.0 if match[2].upper() == winds[1] else 1.0)
        return _number(-limit, limit)(str(value))

    return reader


def _known_zone(text: str) -> str:
    from difflib import get_close_matches
    from zoneinfo import available_timezones

    zones = available_timezones()
    if text not in zones:
        near = get_close_matches(text, zones, n=1)
        raise ValueError(f"unknown time zone '{text}'" + (f"; is it {near[0]}?" if near else ""))
    return text


def site_text(setup: SiteFile) -> str:
    """Return the text of a SITE.toml with site, camera and, if there is one, the room.

    `load_site` reads it.
    """
    import tomli_w

    from fieldlum.session.site_toml import site_table

    table = site_table(setup)
    lines = ["# Written by fieldlum new. You can edit it; fieldlum plan checks every key."]
    for name in table["camera"].pop("assumed"):
        del table["camera"][name]
        lines.append(f"# [camera] {name} = ... # not known yet: state it")
    del table["pyranometer"]
    text = "\n".join([*lines, tomli_w.dumps(table)])
    for key, note in _NOTES.items():
        text = re.sub(rf"^{key} = .*$", rf"\g<0> # {note}", text, flags=re.MULTILINE)
    return text


# ----------------------------------------------------------------------------------------------
# an own camera profile


def _write_own_camera(path: Path, start: str, photo: Path | None) -> None:
    """Write an own profile that starts from another one, with size and camera of a photo."""
    from fieldlum.optics.profiles import load_camera_profile, save_profile, uncalibrated_text

    profile = started_profile(load_camera_profile(start), start)
    if photo is not None:
        profile = _of_photo(profile, photo)
    save_profile(path, profile)
    load_camera_profile(path)
    body = profile.camera
    click.echo(f"written: {path}: {body.name}, {body.width_px} x {body.height_px} pixels")
    click.echo(f"note: {uncalibrated_text(profile)}")
    if photo is None:
        click.echo("note: size and camera are those of the start: state a frame with --photo")
    click.echo(f"next: fieldlum calibrate lens -h, then state profile = {path} in SITE.toml")


def _of_photo(profile: CameraProfile, photo: Path) -> CameraProfile:
    """Return a profile with size, camera and aperture of a frame; print its levels if it is raw."""
    from fieldlum.optics.raw import is_jpeg, jpeg_size, read_exif, read_mosaic

    fixed = profile.camera.fixed_f_number
    info = read_exif(photo, lens_f_number=fixed)
    if is_jpeg(photo):
        return with_frame(profile, jpeg_size(photo), info)
    mosaic = read_mosaic(photo, lens_f_number=fixed)
    click.echo(f"black level {mosaic.black_dn[0]:g} DN, white level {mosaic.white_dn:g} DN")
    height, width = mosaic.counts.shape
    return with_frame(profile, (width, height), info, mosaic)


def started_profile(profile: CameraProfile, start: str) -> CameraProfile:
    """Return a profile without a date of calibration; start: the name of the given profile.

    Uncertainties become those of a guess: a value that another camera calibrated is not measured.
    """
    from fieldlum.optics.profiles import Provenance

    def guessed(lens: Lens) -> Lens:
        vague = tuple(replace(v, u_rel=_GUESS_U_VIGNETTING) for v in lens.vignetting)
        return replace(lens, vignetting=vague)

    log = f"not measured: started from {start}; replace every part by fieldlum calibrate"
    return replace(
        profile,
        camera=replace(profile.camera, date="", note=f"uncalibrated; started from {start}"),
        lens=tuple(map(guessed, profile.lens)),
        colour=replace(profile.colour, u_rel=max(profile.colour.u_rel, _GUESS_U_COLOUR)),
        scale=replace(profile.scale, u_rel=max(profile.scale.u_rel, _GUESS_U_SCALE)),
        provenance=Provenance(f"started from {start}", log=(log,)),
    )


def with_frame(
    profile: CameraProfile,
    size_px: tuple[int, int],
    info: FrameInfo,
    mosaic: Mosaic | None = None,
) -> CameraProfile:
    """Return a profile with the size, model and aperture of a frame.

    size_px : width and height of the frame; image circles are scaled with the height. info : of
    its EXIF. mosaic : of a raw frame, for its colours and white level; None for a JPEG.
    """
    from fieldlum.optics.profiles import Sensor

    (width, height), exposure = size_px, info.exposure
    name = f"{info.model or 'unnamed camera'}, started from {profile.camera.name}"
    frame = {"width_px": width, "height_px": height, "make": info.make, "model": info.model}
    kind = "jpeg" if mosaic is None else "raw"
    by, across = height / profile.camera.height_px, width / profile.camera.width_px

    def scaled(lens: Lens) -> Lens:
        centre_px = (lens.centre_px[0] * across, lens.centre_px[1] * by)
        rings = tuple(replace(v, f_number=exposure.f_number) for v in lens.vignetting)
        return replace(lens, centre_px=centre_px, radius_px=lens.radius_px * by, vignetting=rings)

    sensor = profile.sensor
    if mosaic is not None:
        sensor = Sensor(cfa=mosaic.cfa, white_dn=mosaic.white_dn, iso=exposure.iso)
    return replace(
        profile,
        camera=replace(profile.camera, kind=kind, name=name, **frame),
        lens=tuple(map(scaled, profile.lens)),
        sensor=sensor,
        bracket=replace(profile.bracket, f_number=exposure.f_number, iso=exposure.iso),
        scale=replace(profile.scale, f_numbers=(exposure.f_number,)),
    )
