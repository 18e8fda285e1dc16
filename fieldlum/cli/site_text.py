"""Write a SITE.toml, with comments, from the answers of `fieldlum new`."""

from __future__ import annotations

import json
from collections.abc import Sequence

from fieldlum.core.records import Room, SiteFile, Window
from fieldlum.room.scene.drawing import compass_walls


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
