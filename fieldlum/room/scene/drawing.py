"""Draw a box room from above, as SVG: walls, windows, camera and north.

A drawing reveals a wrong `left_m` or azimuth, which a table does not.
"""

from __future__ import annotations

from html import escape
from itertools import pairwise
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Room, SiteFile
from fieldlum.optics.projection import compass_name
from fieldlum.room.scene.clicked import ClickGrid
from fieldlum.room.scene.geometry import WALL_TURN_DEG, build
from fieldlum.session import replacing

# Of the plan; the margin has room for the lengths written around it. Not measured.
_SIZE_PX, _MARGIN_PX = 460.0, 78.0
_EDGE_POINTS = 24  # of a drawn edge: smooth at the width of a page; not measured


def wind(azimuth_deg: float) -> str:
    """Return a compass direction with its angle, such as "SSW 203°"."""
    return f"{compass_name(azimuth_deg)} {round(azimuth_deg) % 360}°"


def compass_walls(wall_azimuth_deg: float) -> dict[str, str]:
    """Return the room's word of each wall by the compass direction it faces, the main wall first.

    wall_azimuth_deg: that the "south" wall faces.
    """
    return {compass_name(wall_azimuth_deg + turn): w for w, turn in WALL_TURN_DEG.items()}


def write_room(setup: SiteFile, path: Path) -> bool:
    """Write the plan of a box room as SVG; return whether there is one. Raises as `room_svg`."""
    if drawing := room_svg(setup):
        with replacing(path, "w", encoding="utf-8") as file:
            file.write(drawing.replace("currentColor", "black"))
    return bool(drawing)


def room_svg(setup: SiteFile) -> str:
    """Return a plan of the room as SVG text, seen from above with the "south" wall at the bottom.

    Return an empty text without a room of kind "box". Raises InputError for an impossible room.
    """
    room = setup.room
    if room is None or room.kind != "box":
        return ""
    scene = build(room)
    scale = (_SIZE_PX - 2 * _MARGIN_PX) / max(room.width_m, room.depth_m)
    width, height = room.width_m * scale, room.depth_m * scale

    def at(x_m: float, y_m: float) -> tuple[float, float]:
        return _MARGIN_PX + x_m * scale, _MARGIN_PX + height - y_m * scale

    left, top = at(0.0, room.depth_m)
    parts = [
        f'<rect x="{left:.1f}" y="{top:.1f}" width="{width:.1f}" height="{height:.1f}" '
        f'fill="none" stroke="currentColor" stroke-width="3"/>'
    ]
    for number, (opening, window) in enumerate(
        zip(scene.openings, room.window, strict=True), start=1
    ):
        ends = [
            (opening.inner_m, u) if opening.axis == 0 else (u, opening.inner_m) for u in opening.u_m
        ]
        (x1, y1), (x2, y2) = (at(*end) for end in ends)
        parts.append(
            f'<line x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}" stroke="#3b9ae1" '
            f'stroke-width="8"/>'
        )
        inwards = 16.0 * opening.outward
        dx, dy = (-inwards, 4.0) if opening.axis == 0 else (0.0, inwards + 4.0)
        label = f"window {number}, {window.width_m:g} m"
        parts.append(_text((x1 + x2) / 2 + dx, (y1 + y2) / 2 + dy, label, _anchor(opening)))
    for wall, turn in WALL_TURN_DEG.items():
        parts.append(
            _wall_label(wall, wind(room.wall_azimuth_deg + turn), left, top, width, height)
        )
    place = at(room.camera_x_m, room.camera_y_m)
    share = room.camera_x_m / room.width_m
    parts += _camera(room, setup.camera.heading_deg, place, share)
    parts.append(_north(room.wall_azimuth_deg))
    total = height + 2 * _MARGIN_PX, width + 2 * _MARGIN_PX
    about = f"Plan of {setup.site.name}: {room.width_m:g} x {room.depth_m:g} m, from above"
    return (
        f'<svg viewBox="0 0 {total[1]:.0f} {total[0]:.0f}" role="img" '
        f'aria-label="{escape(about, quote=True)}" xmlns="http://www.w3.org/2000/svg" '
        f'font-family="sans-serif" font-size="12" fill="currentColor">{"".join(parts)}</svg>'
    )


def _anchor(opening: object) -> str:
    axis, outward = getattr(opening, "axis", 1), getattr(opening, "outward", 1)
    return "middle" if axis == 1 else ("end" if outward > 0 else "start")


def _text(x: float, y: float, text: str, anchor: str = "middle") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _wall_label(
    wall: str, azimuth: str, left: float, top: float, width: float, height: float
) -> str:
    """Return a wall's name and direction, placed outside the wall."""
    x, y = {
        "south": (left + width / 2, top + height + 22),
        "north": (left + width / 2, top - 12),
        "west": (left - 12, top + height / 2),
        "east": (left + width + 12, top + height / 2),
    }[wall]
    label = f'"{wall}" faces {azimuth}'
    if wall in ("south", "north"):
        return _text(x, y, label)
    turn = -90 if wall == "west" else 90
    return (
        f'<text text-anchor="middle" transform="translate({x:.1f} {y:.1f}) rotate({turn})">'
        f"{escape(label)}</text>"
    )


def _camera(room: Room, heading_deg: float, at: tuple[float, float], share: float) -> list[str]:
    """Return the camera as a dot with an arrow to its heading.

    The text is placed away from a wall that is near.
    """
    # The drawing's downwards direction is the "south" wall's azimuth; angles run clockwise.
    turn = np.radians(heading_deg - room.wall_azimuth_deg + 180.0)
    x, y = at
    tip = x + 34 * np.sin(turn), y - 34 * np.cos(turn)
    label = f"camera to {wind(heading_deg)}, {room.camera_z_m:g} m high"
    below = y - 12 if tip[1] > y else y + 20
    return [
        f'<line x1="{x:.1f}" y1="{y:.1f}" x2="{tip[0]:.1f}" y2="{tip[1]:.1f}" stroke="#c4441c" '
        f'stroke-width="3"/>',
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="6" fill="#c4441c"/>',
        _text(x, below, label, "start" if share < 0.35 else "end" if share > 0.65 else "middle"),
    ]


def _north(wall_azimuth_deg: float) -> str:
    """Return an arrow to true north in the upper left corner."""
    turn = 180.0 - wall_azimuth_deg
    return (
        f'<g transform="translate(36 36) rotate({turn:.1f})"><line x1="0" y1="20" x2="0" y2="-16" '
        f'stroke="currentColor" stroke-width="2"/><path d="M0 -24 L6 -10 L-6 -10 Z"/></g>'
        + _text(
            36 + 32 * float(np.sin(np.radians(turn))),
            40 - 32 * float(np.cos(np.radians(turn))),
            "N",
        )
    )


def outline_pixels(room: Room, grid: ClickGrid) -> dict[str, list[list[float]]]:
    """Return the edges of the box ("box") and of its windows ("window") as lines on a panorama.

    Each line is a list of pixel positions x, y, x, y ... It is split where it leaves the picture at
    one side and continues at the other.
    """
    camera = np.array([room.camera_x_m, room.camera_y_m, room.camera_z_m])
    low, high = np.zeros(3), np.array([room.width_m, room.depth_m, room.height_m])
    ends = [(low[k], high[k]) for k in range(3)]
    lines: dict[str, list[list[float]]] = {"box": [], "window": []}

    def add(name: str, a: Floats, b: Floats) -> None:
        share = np.linspace(0.0, 1.0, _EDGE_POINTS)[:, None]
        points = (a * (1 - share) + b * share - camera) @ build(room).turn
        xy = grid.pixels(points)
        cuts = np.flatnonzero(np.abs(np.diff(xy[:, 0])) > grid.width_px / 2) + 1
        lines[name] += [np.round(part, 2).ravel().tolist() for part in np.split(xy, cuts)]

    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for i in (0, 1):
            for j in (0, 1):
                a, b = np.zeros(3), np.zeros(3)
                a[others[0]] = b[others[0]] = ends[others[0]][i]
                a[others[1]] = b[others[1]] = ends[others[1]][j]
                a[axis], b[axis] = ends[axis]
                add("box", a, b)
    for opening in build(room).openings:
        (u0, u1), (z0, z1) = opening.u_m, opening.z_m
        corners = [(u0, z0), (u1, z0), (u1, z1), (u0, z1), (u0, z0)]
        points = []
        for along, z in corners:
            point = np.zeros(3)
            point[opening.axis], point[1 - opening.axis], point[2] = opening.inner_m, along, z
            points.append(point)
        for a, b in pairwise(points):
            add("window", a, b)
    return lines
