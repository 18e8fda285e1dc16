"""`fieldlum new`: ask questions about a site and write its SITE.toml."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from fieldlum.cli.options import PATH
from fieldlum.errors import InputError
from fieldlum.records import CameraSetup, Room, Site, SiteFile, Window

T = TypeVar("T")
# Smallest width and height of a window; chosen. The left edge and the sill stay twice this length
# from the end of the wall and the ceiling, so that a width and a height remain possible.
_MIN_WINDOW_M = 0.05
_ANGLE = re.compile(r"([+-]?\d+(?:\.\d+)?)\s*°?\s*([NSEWnsew]?)")


@click.command("new")
@click.argument("site_file", metavar="SITE.toml", type=PATH)
def command(site_file: Path) -> None:
    """Ask questions about a site and write its SITE.toml.

    Each answer is checked at once. If you describe the room, it is drawn as SITE.svg: check the
    windows and azimuths there. An existing SITE.toml is not overwritten.

    \b
    Example:
      fieldlum new office.toml
    """
    from fieldlum.cli.site_text import site_text
    from fieldlum.profiles import coverage_text, load_camera_profile
    from fieldlum.scene.drawing import room_svg
    from fieldlum.site_toml import load_site

    if site_file.exists():
        raise InputError(site_file, "the file exists already", "a new file", "choose another name")
    site = _site()
    camera = _camera()
    setup = SiteFile(site, camera)
    if blind := coverage_text(load_camera_profile(camera.profile), camera):
        click.echo(f"note: {blind}")
    if click.confirm("Describe the room by tape measure? It allows sun patches", default=True):
        setup = _checked_room(site, camera)
    site_file.write_text(site_text(setup), encoding="utf-8")
    load_site(site_file)
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
    from fieldlum.sun import zone_off_sun_h

    name = _ask("Name of the site", _name)
    latitude = _ask("Latitude in degrees (like 47.61, 47.61 N)", _angle(90.0, "NS"))
    longitude = _ask("Longitude in degrees (like -122.33, 122.33 W)", _angle(180.0, "EW"))

    def zone(text: str) -> Site:
        site = Site(name, latitude, longitude, _known_zone(text))
        off = zone_off_sun_h(site)
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


def _camera() -> CameraSetup:
    from fieldlum.profiles import find_camera_profile, load_camera_profile, shipped

    names = sorted(path.stem for path in shipped("calibration").glob("*.toml"))
    click.echo("Cameras with a shipped profile:")
    for k, name in enumerate(names, start=1):
        click.echo(f"  {k}  {name}")

    def profile(text: str) -> str:
        chosen = names[int(text) - 1] if text.isdigit() and 0 < int(text) <= len(names) else text
        load_camera_profile(find_camera_profile(chosen))
        return chosen

    chosen = _ask("Camera: a number, or the path of your own profile", profile)
    heading = _ask("Azimuth that the camera faces, clockwise from true north", _number(0.0, 360.0))
    height = _ask("Height of the lens above the floor in m", _number(0.05, 50.0), default="1.2")

    def turned(text: str) -> tuple[float, ...]:
        if not text.strip() or text.strip() == "-":
            return ()
        return tuple(_number(0.0, 360.0)(part) for part in text.split(","))

    headings = _ask(
        "Headings of a turned head, separated by commas (- for a fixed camera)", turned, default="-"
    )
    return CameraSetup(chosen, heading, headings, height)


def _checked_room(site: Site, camera: CameraSetup) -> SiteFile:
    """Ask about the room until a room is possible; return the site with it."""
    from fieldlum.scene.geometry import build

    while True:
        setup = SiteFile(site, camera, _room(camera))
        assert setup.room is not None
        try:
            build(setup.room)
            return setup
        except InputError as error:
            click.echo(f"This room is not possible: {error}. Please answer again.")


def _room(camera: CameraSetup) -> Room:
    click.echo('All lengths in m. The main window wall is called "south", wherever it faces.')
    length = _number(0.3, 200.0)
    width = _ask("Width along that wall", length)
    depth = _ask("Depth away from it", length)
    height = _ask("Height", _number(1.0, 100.0))
    azimuth = _ask("Azimuth that this wall faces (180: south)", _number(0.0, 360.0))
    from_left = _ask("Camera: from the wall's left end, seen from inside", _number(0.0, width))
    from_wall = _ask("Camera: distance from that wall", _number(0.0, depth))
    count = int(_ask("How many windows", _number(0, 20), default="1"))
    windows = tuple(_window(k + 1, width, depth, height) for k in range(count))
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


def _window(number: int, width: float, depth: float, height: float) -> Window:
    def wall(text: str) -> Any:
        if text not in ("south", "west", "north", "east"):
            raise ValueError(
                "expected south, west, north or east, in the room's own "
                "directions (the main window wall is south)"
            )
        return text

    name = _ask(f"Window {number}: wall (south, west, north, east)", wall, default="south")
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


def _ask(question: str, reader: Callable[[str], T], default: str | None = None) -> T:
    """Ask a question until `reader` accepts the answer; return what `reader` returns."""

    def checked(text: str) -> T:
        try:
            return reader(text.strip())
        except (InputError, ValueError) as error:
            raise click.UsageError(str(error)) from None

    return click.prompt(question, default=default, value_proc=checked)


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
    from fieldlum.sun import zone_off_sun_h

    try:
        name = str(Path("/etc/localtime").resolve()).partition("zoneinfo/")[2]
        zone = _known_zone(name)
    except (OSError, ValueError):
        return None
    plain = zone.removeprefix("Etc/") in ("UTC", "GMT", "UCT", "Zulu")
    fits = abs(zone_off_sun_h(Site("", 0.0, longitude_deg, zone))) <= 2.0
    return zone if fits and not plain else None
