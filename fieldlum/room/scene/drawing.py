"""Draw a box room from above, as SVG: walls, windows, furniture, camera and north.

A drawing reveals a wrong `left_m` or azimuth, which a table does not.
"""

from __future__ import annotations

from itertools import combinations, product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldlum.core.plot_style import BLUE, GRID, INK, PALE, RED, styled, svg_of
from fieldlum.core.records import Room, SiteFile
from fieldlum.optics.projection import compass_name
from fieldlum.room.scene.box_room import WALL_TURN_DEG, WALLS, build, upright
from fieldlum.room.scene.clicked import ClickGrid
from fieldlum.session import write_file

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_EDGE_POINTS = 24  # points of a drawn edge: smooth at the width of a page; not measured


def compass_text(azimuth_deg: float) -> str:
    """Return an azimuth, clockwise from north, as a compass direction and angle: "SSW 203°"."""
    return f"{compass_name(azimuth_deg)} {round(azimuth_deg) % 360}°"


def write_room(setup: SiteFile, path: Path) -> bool:
    """Write the plan of a site's box room as SVG; return whether the site has such a room.

    Nothing is written without one. An existing file is replaced. Raises InputError for an
    impossible room.
    """
    if drawing := room_svg(setup):
        write_file(path, drawing)
    return bool(drawing)


def room_svg(setup: SiteFile) -> str:
    """Return a plan of a site's room as SVG text: from above, with the "south" wall at the bottom.

    Return an empty text without a room of kind "box". Raises InputError for an impossible room.
    """
    from matplotlib.figure import Figure

    if setup.room is None or setup.room.kind != "box":
        return ""
    with styled():
        figure = Figure(figsize=(5.0, 5.0))
        axes = figure.add_axes((0.14, 0.14, 0.72, 0.72))
        _draw_plan(axes, setup.room)
        _draw_arrows(axes, setup.room, setup.camera.heading_deg)
    return svg_of(figure)


def _draw_plan(axes: Axes, room: Room) -> None:
    """Draw walls, boxes and windows from above, and the compass direction that each wall faces."""
    from matplotlib.patches import Rectangle

    axes.set_axis_off()
    axes.set(aspect="equal", xlim=(0.0, room.width_m), ylim=(0.0, room.depth_m))
    for o in room.obstruction:  # cut off at the walls
        axes.add_patch(Rectangle((o.x_m, o.y_m), o.width_m, o.depth_m, fc=GRID, ec=PALE, gid="box"))
    wall = Rectangle((0.0, 0.0), room.width_m, room.depth_m, fill=False, ec=INK, lw=3, gid="walls")
    axes.add_patch(wall).set_clip_on(False)
    centred: dict[str, Any] = {"ha": "center", "va": "center", "textcoords": "offset points"}
    for number, (o, window) in enumerate(zip(build(room).openings, room.window, strict=True), 1):
        across = (o.inner_m, o.inner_m)
        x, y = (across, o.u_m) if o.axis == 0 else (o.u_m, across)
        line = {"color": BLUE, "lw": 7, "solid_capstyle": "butt", "gid": f"window{number}"}
        axes.plot(x, y, clip_on=False, **line)
        label = f"window {number}, {window.width_m:.3g} m"
        middle = (float(np.mean(x)), float(np.mean(y)))
        inwards = (-14 * o.outward, 0) if o.axis == 0 else (0, -14 * o.outward)
        axes.annotate(label, middle, inwards, **centred, rotation=0 if o.axis else 90)
    for name, turn_deg in WALL_TURN_DEG.items():
        axis, side = WALLS[name]
        label = f'"{name}" faces {compass_text(room.wall_azimuth_deg + turn_deg)}'
        outwards = 32 * side - 16  # points
        place, away = ((0.5, side), (0, outwards)) if axis else ((side, 0.5), (outwards, 0))
        axes.annotate(label, place, away, "axes fraction", **centred, rotation=0 if axis else 90)


def _draw_arrows(axes: Axes, room: Room, heading_deg: float) -> None:
    """Draw the camera with its heading, and true north in the upper left corner.

    heading_deg: clockwise from true north.
    """
    # The drawing's downwards direction is the "south" wall's azimuth; angles run clockwise.
    camera = (room.camera_x_m, room.camera_y_m)
    style = {"scale": 12.0, "width": 0.01, "clip_on": False}
    for name, azimuth_deg, place, colour, coordinates in (
        ("camera", heading_deg, camera, RED, axes.transData),
        ("north", 0.0, (-0.05, 1.05), INK, axes.transAxes),
    ):
        turn = np.radians(azimuth_deg - room.wall_azimuth_deg - 180.0)
        right, up = np.sin(turn), np.cos(turn)
        axes.quiver(*place, right, up, color=colour, transform=coordinates, gid=name, **style)
    tip = (0.12 * right - 0.05, 0.12 * up + 1.05)  # of the last arrow, which shows north
    axes.text(*tip, "N", ha="center", va="center", transform=coordinates)
    axes.plot(*camera, "o", color=RED, ms=9)
    label = f"camera to {compass_text(heading_deg)}, {room.camera_z_m:.3g} m high"
    axes.text(0.5, -0.16, label, ha="center", color=RED, transform=axes.transAxes)


def outline_pixels(room: Room, grid: ClickGrid) -> dict[str, list[list[float]]]:
    """Return the edges of a box room and of its windows as lines on a panorama; keys: box, window.

    Each line is a list of pixel positions x, y, x, y ... [px]. It is split where it leaves the
    picture at one side and continues at the other. grid: of the panorama, of which the camera
    counts as level. Raises InputError for a room that is not a box or is impossible.
    """
    scene, lines = build(room), {"box": [], "window": []}
    size = (room.width_m, room.depth_m, room.height_m)
    parts = [("box", tuple((0.0, end) for end in size))]
    for o in scene.openings:
        pane = upright(o.axis, (o.inner_m, o.inner_m), o.u_m, o.z_m, 0.0, "pane")
        parts.append(("window", tuple(zip(pane.low, pane.high, strict=True))))
    share = np.linspace(0.0, 1.0, _EDGE_POINTS)[:, None]
    for name, spans in parts:  # spans: from and to along x, y and z
        corners = np.unique(list(product(*spans)), axis=0)
        for start, end in combinations(corners, 2):
            if np.count_nonzero(start != end) > 1:
                continue  # a diagonal
            xy = grid.pixels((start * (1 - share) + end * share - scene.camera_m) @ scene.turn)
            cuts = np.flatnonzero(np.abs(np.diff(xy[:, 0])) > grid.width_px / 2) + 1
            lines[name] += [np.round(part, 2).ravel().tolist() for part in np.split(xy, cuts)]
    return lines
