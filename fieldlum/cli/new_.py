"""`fieldlum new`: ask questions about a site and write its SITE.toml, or an own camera profile."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

import click

from fieldlum.cli.options import command_of
from fieldlum.core.errors import InputError
from fieldlum.core.records import CameraSetup, Room, Site, SiteFile, Window

T = TypeVar("T")
# Smallest width and height of a window; chosen. The left edge and the sill stay twice this length
# from the end of the wall and the ceiling, so that a width and a height remain possible.
_MIN_WINDOW_M = 0.05
_ANGLE = re.compile(r"([+-]?\d+(?:\.\d+)?)\s*°?\s*([NSEWnsew]?)")


@command_of("new")
def command(
    site_file: Annotated[Path, "SITE.toml|CAMERA.toml"],
    camera: str | None = None,
    photo: Path | None = None,
) -> None:
    """Ask about a site and write its SITE.toml, or write a camera profile.

    Place, camera and heading give the full answer; a room is an option. Each answer is checked
    and stored at once: after an interruption, the same command continues. A described room is
    drawn as SITE.svg: check the windows and azimuths there. An existing file is not overwritten.

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
        from fieldlum.cli.new_camera import write_own_camera

        write_own_camera(site_file, camera, photo)
        return
    if photo is not None:
        raise click.UsageError("--photo describes an own camera: name a profile with --camera")
    answers = _Answers.read(site_file.with_name(f"{site_file.name}.answers"))
    click.get_current_context().meta[_ANSWERS] = answers
    site = _site()
    setup = SiteFile(site, _camera(site_file.parent))
    profile = load_camera_profile(setup.camera.profile)
    blind = coverage_text(profile, setup.camera)
    for note in (*assumed_texts(setup.camera), uncalibrated_text(profile), blind):
        if note:
            click.echo(f"note: {note}")
    question = "Describe the room by tape measure? Not needed; it can sharpen the maps (y, n)"
    if _ask(question, _yes, default="n"):
        setup = _checked_room(site, setup.camera)
    site_file.write_text(site_text(setup), encoding="utf-8")
    load_site(site_file)
    answers.path.unlink(missing_ok=True)
    click.echo(f"written: {site_file}")
    if drawing := room_svg(setup):
        picture = site_file.with_suffix(".svg")
        picture.write_text(drawing.replace("currentColor", "black"), encoding="utf-8")
        click.echo(f"written: {picture}: check windows, camera and north in it")
    name = site_file.stem
    click.echo(f"next: fieldlum plan {site_file} --set 9-day --out {name}-session --ics --html")


# ----------------------------------------------------------------------------------------------
# parts


def _site() -> Site:
    from fieldlum.session.site_toml import wrong_sign_text
    from fieldlum.sky.sun import zone_off_sun_h

    name = _ask("Name of the site", _name)
    latitude = _ask("Latitude in degrees (like 47.61, 47.61 N)", _angle(90.0, "NS"))
    longitude = _ask("Longitude in degrees (like -122.33, 122.33 W)", _angle(180.0, "EW"))

    def zone(text: str) -> Site:
        site = Site(name, latitude, longitude, _known_zone(text))
        off = zone_off_sun_h(site)
        if wrong := wrong_sign_text(site):
            raise ValueError(f"{wrong}; north and east are positive")
        if abs(off) > 4.0:
            raise ValueError(
                f"the clock of this zone differs from the sun at longitude {longitude:g} by "
                f"{off:+.1f} h; check the sign of the longitude: east is positive, west "
                "negative"
            )
        return site

    site = _ask("Time zone, IANA name (like Europe/Rome)", zone, default=_own_zone(longitude))
    altitude = _ask("Altitude above the sea in m", _number(-500.0, 9000.0), default="0")
    return Site(name, latitude, longitude, site.timezone, altitude)


def _own_profiles(folder: Path) -> list[str]:
    """Return the paths of the camera profiles in a folder."""
    from fieldlum.optics.profiles import load_camera_profile

    own = []
    for path in sorted(folder.glob("*.toml")):
        try:
            load_camera_profile(path)
        except InputError:  # a site, or a profile that cannot be used
            continue
        own.append(str(path))
    return own


def _camera(folder: Path) -> CameraSetup:
    """Ask for the camera; folder: where own profiles are listed from."""
    from fieldlum.optics.profiles import camera_names, find_camera_profile, load_camera_profile

    names = [*_own_profiles(folder), *camera_names()]
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

    def azimuth(text: str) -> float | None:
        return None if text == "-" else _number(0.0, 360.0)(text)

    chosen = _ask("Camera: a number, a name, the path of your own profile, or none", profile)
    facing = _ask("Azimuth that the camera faces, clockwise from true north (- unknown)", azimuth)
    missing = {"heading_deg": facing is None, "profile": not chosen}
    unknown = [name for name, is_missing in missing.items() if is_missing]
    heading = CameraSetup().heading_deg if facing is None else facing
    height = _ask("Height of the lens above the floor in m", _number(0.05, 50.0), default="1.2")

    def turned(text: str) -> tuple[float, ...]:
        if not text.strip() or text.strip() == "-":
            return ()
        return tuple(_number(0.0, 360.0)(part) for part in text.split(","))

    headings = _ask(
        "Headings of a turned head, separated by commas (- for a fixed camera)", turned, default="-"
    )
    return CameraSetup(chosen, heading, headings, height, tuple(unknown))


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


@dataclass
class _Answers:
    """Answers of an interrupted dialogue, stored as pairs of question and text."""

    path: Path
    before: list[list[str]] = field(default_factory=list)
    stored: list[list[str]] = field(default_factory=list)

    @classmethod
    def read(cls, path: Path) -> _Answers:
        """Return the stored answers; none if the file is missing or damaged."""
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return cls(path)
        pairs = isinstance(before, list) and all(
            isinstance(p, list) and len(p) == 2 and all(isinstance(x, str) for x in p)
            for p in before
        )
        if not pairs:
            return cls(path)
        click.echo(f"continuing with the answers in {path}; remove it to begin again")
        return cls(path, before)

    def next_text(self, question: str) -> str | None:
        """Return the stored answer to the next question; None, from now on, without one."""
        if self.before and self.before[0][0] == question:
            return self.before.pop(0)[1]
        self.before.clear()
        return None

    def store(self, question: str, text: str) -> None:
        """Add an answer to the file; a folder that cannot be written ends the command."""
        self.stored.append([question, text])
        content = json.dumps([*self.stored, *self.before], ensure_ascii=False, indent=0)
        self.path.write_text(content, encoding="utf-8")


def _ask(question: str, reader: Callable[[str], T], default: str | None = None) -> T:
    """Ask a question until `reader` accepts the answer; return what `reader` returns."""
    answers: _Answers | None = click.get_current_context().meta.get(_ANSWERS)

    def checked(text: str) -> T:
        try:
            value = reader(text.strip())
        except (InputError, ValueError) as error:
            raise click.UsageError(str(error)) from None
        if answers is not None:
            answers.store(question, text)
        return value

    if answers is not None and (text := answers.next_text(question)) is not None:
        try:
            value = checked(text)
        except click.UsageError:
            answers.before.clear()
        else:
            click.echo(f"{question}: {text}")
            return value
    return click.prompt(question, default=default, value_proc=checked)


def _yes(text: str) -> bool:
    if text.lower() not in ("y", "yes", "n", "no"):
        raise ValueError(f"'{text}': expected y or n")
    return text.lower().startswith("y")


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
            raise ValueError(
                f"'{text}': expected decimal degrees, also with {winds[0]} or {winds[1]}"
            )
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


def _own_zone(longitude_deg: float) -> str | None:
    """Return this computer's time zone if it is plausible for the longitude, else None."""
    from fieldlum.sky.sun import zone_off_sun_h

    try:
        name = str(Path("/etc/localtime").resolve()).partition("zoneinfo/")[2]
        zone = _known_zone(name)
    except (OSError, ValueError):
        return None
    plain = zone.removeprefix("Etc/") in ("UTC", "GMT", "UCT", "Zulu")
    fits = abs(zone_off_sun_h(Site("", 0.0, longitude_deg, zone))) <= 2.0
    return zone if fits and not plain else None


# ----------------------------------------------------------------------------------------------
# the text of SITE.toml


def site_text(setup: SiteFile) -> str:
    """Return the text of a SITE.toml with site, camera and, if there is one, the box room.

    It has what `fieldlum new` asks for; `load_site` reads it.
    """
    site, camera, room = setup.site, setup.camera, setup.room
    lines = [
        "# Written by fieldlum new. You can edit it; fieldlum plan checks every key.",
        "",
        "[site]",
        f"name = {_quoted(site.name)}",
        f"latitude_deg = {site.latitude_deg:.6g} # north positive",
        f"longitude_deg = {site.longitude_deg:.7g} # east positive",
        f"altitude_m = {site.altitude_m:g}",
        f"timezone = {_quoted(site.timezone)} # IANA name",
        "",
        "[camera]",
        *_stated(
            "profile" not in camera.assumed,
            f"profile = {_quoted(camera.profile)} # a shipped name (fieldlum info NAME), or a path",
        ),
        *_stated(
            "heading_deg" not in camera.assumed,
            f"heading_deg = {camera.heading_deg:g} # the panorama's middle, clockwise from true "
            "north",
        ),
    ]
    if camera.headings:
        headings = ", ".join(f"{heading:g}" for heading in camera.headings)
        lines.append(f"headings = [{headings}] # one fisheye, turned between brackets")
    lines.append(f"height_m = {camera.height_m:g} # of the lens above the floor")
    if room is not None:
        lines += _room_lines(room)
    return "\n".join(lines) + "\n"


def _stated(is_known: bool, line: str) -> list[str]:
    """Return a line, or a comment in its place for a value that is not known yet."""
    return [line] if is_known else [f"# {line.partition(' ')[0]} = ... # not known yet: state it"]


def _room_lines(room: Room) -> Sequence[str]:
    lines = [
        "",
        "# By tape measure, along the floor. For sun patches, the sun in view, and simulation.",
        "[room]",
        'kind = "box"',
        f"width_m = {room.width_m:g} # along the main window wall, which the room calls south",
        f"depth_m = {room.depth_m:g} # perpendicular to it",
        f"height_m = {room.height_m:g}",
        f"camera_x_m = {room.camera_x_m:g} # from that wall's RIGHT end as seen from inside",
        f"camera_y_m = {room.camera_y_m:g} # from the inside of that wall",
        f"camera_z_m = {room.camera_z_m:g}",
        f"wall_azimuth_deg = {room.wall_azimuth_deg:g} # where that wall faces",
    ]
    for window in room.window:
        lines += _window_lines(window, room.wall_azimuth_deg)
    return lines


def _window_lines(window: Window, wall_azimuth_deg: float) -> Sequence[str]:
    from fieldlum.room.scene.drawing import compass_walls

    facing = {wall: name for name, wall in compass_walls(wall_azimuth_deg).items()}[window.wall]
    return [
        "",
        "[[room.window]]",
        f"wall = {_quoted(window.wall)} # the room's own word; this wall faces {facing}",
        f"left_m = {window.left_m:g} # from the wall's LEFT end as seen from inside",
        f"width_m = {window.width_m:g}",
        f"sill_m = {window.sill_m:g} # above the floor",
        f"height_m = {window.height_m:g}",
        f"transmittance = {window.transmittance:g} # 0.8: clear double glazing",
        f"panes = {window.panes} # side by side, with bars between them",
    ]


def _quoted(text: str) -> str:
    """Return a TOML basic string: JSON escapes are valid in TOML, except the delete character."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
