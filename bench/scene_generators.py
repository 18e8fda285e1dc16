"""Rooms as Radiance text, and the box that a user would measure in each: for `scene_rooms.py`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from fieldlum.core.records import Room, Window
from fieldlum.room.fit.guess import Bar, Guess, Solid, guess_of
from fieldlum.room.scene.geometry import transmissivity

GLASS = 0.88


def material(name: str, reflectance: float) -> str:
    return f"void plastic {name} 0 0 5 {reflectance} {reflectance} {reflectance} 0 0\n"


def quad(mat: str, corners: Sequence[Sequence[float]]) -> str:
    quad.count += 1  # type: ignore[attr-defined]
    numbers = " ".join(f"{v:.5f}" for corner in corners for v in corner)
    return f"{mat} polygon q{quad.count} 0 0 {3 * len(corners)} {numbers}\n"  # type: ignore[attr-defined]


quad.count = 0  # type: ignore[attr-defined]


def solid_line(mat: str, low: Sequence[float], high: Sequence[float]) -> str:
    """A comment that states a box for `exact_guess`; Radiance skips it."""
    return f"# solid {mat} " + " ".join(f"{v:.4f}" for v in (*low, *high)) + "\n"


def block(mat: str, low: Sequence[float], high: Sequence[float]) -> str:
    (x0, y0, z0), (x1, y1, z1) = low, high
    ends = [
        [(x0, y0, z0), (x0, y1, z0), (x0, y1, z1), (x0, y0, z1)],
        [(x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1)],
        [(x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1)],
        [(x0, y1, z0), (x1, y1, z0), (x1, y1, z1), (x0, y1, z1)],
        [(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)],
        [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)],
    ]
    return "".join(quad(mat, corners) for corners in ends) + solid_line(mat, low, high)


def disc(mat: str, centre: tuple[float, float, float], radius: float) -> str:
    angles = np.linspace(0, 2 * np.pi, 33)[:-1]
    x, y, z = centre
    return quad(mat, [(x + radius * np.cos(a), y + radius * np.sin(a), z) for a in angles])


def side_wall(room: Room, wall: str) -> str:
    """The west or east wall, around its window if it has one; glass in mid-wall."""
    t, deep, tall = room.wall_thickness_m, room.depth_m, room.height_m
    x0 = -t if wall == "west" else room.width_m
    for rect in guess_of(room).windows:
        if rect.wall != wall:
            continue
        (y0, y1), (z0, z1), x = rect.u_m, rect.z_m, x0 + t / 2
        text = block("wall", (x0, -t, 0.0), (x0 + t, y0, tall))
        text += block("wall", (x0, y1, 0.0), (x0 + t, deep + t, tall))
        text += block("wall", (x0, y0, 0.0), (x0 + t, y1, z0))
        text += block("wall", (x0, y0, z1), (x0 + t, y1, tall))
        return text + quad("pane", [(x, y0, z0), (x, y1, z0), (x, y1, z1), (x, y0, z1)])
    return block("wall", (x0, -t, 0.0), (x0 + t, deep + t, tall))


def shell(room: Room) -> str:
    """Walls with their windows' holes (the first is in the south wall), reveals, floor, ceiling."""
    t, wide, deep, tall = room.wall_thickness_m, room.width_m, room.depth_m, room.height_m
    w = room.window[0]
    u0, u1 = wide - w.left_m - w.width_m, wide - w.left_m
    z0, z1 = w.sill_m, w.sill_m + w.height_m
    text = material("wall", room.reflectance_walls) + material("floor", room.reflectance_floor)
    text += material("ceiling", room.reflectance_ceiling) + material("wood", 0.35)
    text += material("frame", room.reflectance_frame) + material("ground", 0.2)
    text += material("facade", 0.5)
    n = transmissivity(GLASS)
    text += f"void glass pane 0 0 3 {n:.5f} {n:.5f} {n:.5f}\n"
    text += block("floor", (-t, -t, -0.1), (wide + t, deep + t, 0.0))
    text += block("ceiling", (-t, -t, tall), (wide + t, deep + t, tall + 0.3))
    text += side_wall(room, "west") + side_wall(room, "east")
    text += block("wall", (0.0, deep, 0.0), (wide, deep + t, tall))
    text += block("wall", (0.0, -t, 0.0), (u0, 0.0, tall)) + block(
        "wall", (u1, -t, 0.0), (wide, 0.0, tall)
    )
    text += block("wall", (u0, -t, 0.0), (u1, 0.0, z0)) + block(
        "wall", (u0, -t, z1), (u1, 0.0, tall)
    )
    y = -t / 2
    text = "".join(line for line in text.splitlines(True) if not line.startswith("# solid"))
    return text + quad("pane", [(u0, y, z0), (u1, y, z0), (u1, y, z1), (u0, y, z1)])


def ground(z: float) -> str:
    far = 2000.0
    return quad("ground", [(-far, -far, z), (far, -far, z), (far, far, z), (-far, far, z)])


def bars(room: Room, places: Sequence[tuple[float, float]], levels: Sequence[float]) -> str:
    """Mullions (middle, width) and transoms of 6 cm, around the glass."""
    t, w = room.wall_thickness_m, room.window[0]
    u0, u1 = room.width_m - w.left_m - w.width_m, room.width_m - w.left_m
    z0, z1 = w.sill_m, w.sill_m + w.height_m
    near, far = -t / 2 - 0.04, -t / 2 + 0.05
    text = "".join(block("frame", (u - b / 2, near, z0), (u + b / 2, far, z1)) for u, b in places)
    return text + "".join(block("frame", (u0, near, z - 0.03), (u1, far, z + 0.03)) for z in levels)


def _room(azimuth: float, window: Window, **more: Any) -> Room:
    return replace(Room(wall_azimuth_deg=azimuth, window=(window,)), **more)


def round_table() -> tuple[Room, str]:
    """Round table, odd mullions, wall azimuth 203."""
    room = _room(
        203.0,
        Window("south", 0.6, 3.2, 0.85, 1.9, GLASS, 1, 0.0),
        width_m=4.6,
        depth_m=6.2,
        height_m=3.0,
        camera_x_m=2.4,
        camera_y_m=3.4,
        camera_z_m=1.4,
        wall_thickness_m=0.3,
        reflectance_floor=0.3,
    )
    things = disc("wood", (1.7, 1.9, 0.74), 0.65) + disc("wood", (1.7, 1.9, 0.70), 0.65)
    for k in range(8):  # the round top as eight slabs
        y0 = -0.65 + 0.1625 * k
        x = np.sqrt(0.65**2 - (y0 + 0.08125) ** 2)
        low, high = (1.7 - x, 1.9 + y0, 0.70), (1.7 + x, 1.9 + y0 + 0.1625, 0.74)
        things += solid_line("wood", low, high)
    things += block("wood", (1.62, 1.82, 0.0), (1.78, 1.98, 0.7))
    things += block("wood", (3.9, 0.6, 0.0), (4.5, 2.2, 1.1))
    text = shell(room) + things + ground(-0.1)
    return room, text + bars(room, [(1.35, 0.07), (2.1, 0.12), (3.5, 0.07)], [2.1])


def canopy() -> tuple[Room, str]:
    """Deep reveals and a canopy, wall azimuth 156."""
    room = _room(
        156.0,
        Window("south", 0.9, 2.4, 0.5, 2.0, GLASS, 1, 0.0),
        width_m=4.2,
        depth_m=5.4,
        height_m=2.9,
        camera_x_m=2.0,
        camera_y_m=2.9,
        camera_z_m=1.5,
        wall_thickness_m=0.5,
        reflectance_floor=0.35,
        reflectance_walls=0.6,
    )
    things = block("facade", (0.2, -1.5, 2.62), (4.0, -0.5, 2.75))
    things += block("wood", (0.4, 1.2, 0.0), (1.2, 2.6, 0.75)) + block(
        "wood", (3.3, 3.6, 0.0), (4.2, 5.2, 1.9)
    )
    return room, shell(room) + things + ground(-0.1) + bars(room, [(2.1, 0.08)], [])


def upstairs() -> tuple[Room, str]:
    """Second floor with a neighbour across the street, wall azimuth 187."""
    room = _room(
        187.0,
        Window("south", 0.5, 4.0, 0.8, 1.8, GLASS, 1, 0.0),
        width_m=5.0,
        depth_m=7.0,
        height_m=2.8,
        camera_x_m=2.6,
        camera_y_m=2.6,
        camera_z_m=1.5,
        wall_thickness_m=0.3,
    )
    things = block("facade", (-14.0, -22.0, -7.0), (20.0, -14.0, 3.4))
    things += block("wood", (0.5, 1.2, 0.68), (2.0, 2.0, 0.74)) + block(
        "wall", (3.6, 1.6, 0.0), (3.9, 1.9, 2.8)
    )
    return room, shell(room) + things + ground(-7.0) + bars(room, [(1.8, 0.06), (3.2, 0.06)], [1.2])


def blind() -> tuple[Room, str]:
    """Venetian blind half down, wall azimuth 171. The room that is looked at last."""
    room = _room(
        171.0,
        Window("south", 0.4, 2.8, 0.9, 1.7, GLASS, 1, 0.0),
        width_m=3.8,
        depth_m=5.0,
        height_m=2.8,
        camera_x_m=1.9,
        camera_y_m=2.7,
        camera_z_m=1.4,
        wall_thickness_m=0.25,
        reflectance_floor=0.25,
    )
    slats = ""
    for z in np.arange(1.8, 2.59, 0.07):
        slats += quad(
            "frame",
            [(0.6, -0.05, z), (3.4, -0.05, z), (3.4, -0.01, z + 0.03), (0.6, -0.01, z + 0.03)],
        )
    things = block("wood", (0.3, 0.9, 0.0), (1.5, 1.7, 0.74)) + slats
    return room, shell(room) + things + ground(-0.1) + bars(room, [(2.0, 0.06)], [])


def sloping() -> tuple[Room, str]:
    """Sloping ceiling from 3.4 m at the window to 2.2 m, wall azimuth 214."""
    room = _room(
        214.0,
        Window("south", 0.7, 2.9, 0.7, 2.2, GLASS, 1, 0.0),
        width_m=4.4,
        depth_m=5.8,
        height_m=3.4,
        camera_x_m=2.1,
        camera_y_m=3.1,
        camera_z_m=1.4,
        wall_thickness_m=0.35,
        reflectance_floor=0.28,
    )
    roof = quad("ceiling", [(0, 0, 3.39), (0, 5.8, 2.2), (4.4, 5.8, 2.2), (4.4, 0, 3.39)])
    things = roof + block("wood", (2.9, 1.0, 0.0), (3.9, 2.4, 0.45))
    things += block("wood", (0.0, 2.2, 0.0), (0.4, 4.6, 2.0))
    return room, shell(room) + things + ground(-0.1) + bars(room, [(1.75, 0.07)], [1.9])


def arch() -> tuple[Room, str]:
    """Window with a round arch above 1.9 m, wall azimuth 149."""
    room = _room(
        149.0,
        Window("south", 1.1, 2.0, 0.6, 2.3, GLASS, 1, 0.0),
        width_m=4.2,
        depth_m=6.0,
        height_m=3.2,
        camera_x_m=1.9,
        camera_y_m=3.2,
        camera_z_m=1.4,
        wall_thickness_m=0.4,
        reflectance_floor=0.3,
    )
    spandrels = ""
    for k in range(20):  # steps of the two spandrels: what of a square the half circle leaves
        x = -1.0 + 0.1 * k
        top = 1.9 + np.sqrt(max(1.0 - min(abs(x), abs(x + 0.1)) ** 2, 0.0))
        if top < 2.899:
            spandrels += block("wall", (2.1 + x, -0.4, top), (2.2 + x, 0.0, 2.9))
    things = spandrels + block("wood", (0.5, 1.0, 0.0), (1.9, 1.8, 0.74))
    return room, shell(room) + things + ground(-0.1) + bars(room, [(2.1, 0.07)], [1.9])


def trees() -> tuple[Room, str]:
    """Two trees of 60 cm branches before the window, a plant inside, wall azimuth 178."""
    room = _room(
        178.0,
        Window("south", 0.5, 3.4, 0.8, 1.9, GLASS, 1, 0.0),
        width_m=4.6,
        depth_m=6.4,
        height_m=3.0,
        camera_x_m=2.5,
        camera_y_m=3.2,
        camera_z_m=1.4,
        wall_thickness_m=0.3,
    )
    rng = np.random.default_rng(3)
    leaves = ""

    def leaf(centre: Any, size: float) -> str:
        a, b = rng.standard_normal((2, 3))
        a *= size / np.linalg.norm(a)
        b -= (b @ a) * a / (a @ a)
        b *= size / np.linalg.norm(b)
        return quad("wood", [centre - a - b, centre + a - b, centre + a + b, centre - a + b])

    for middle in ((-1.0, -9.0, 3.2), (5.0, -12.0, 4.0)):
        for _ in range(90):
            offset = rng.standard_normal(3) * (1.2, 1.2, 1.3)
            leaves += leaf(np.array(middle) + offset, 0.3)
        x, y, _ = middle
        leaves += block("wood", (x - 0.12, y - 0.12, 0.0), (x + 0.12, y + 0.12, 3.0))
    for _ in range(40):
        leaves += leaf(np.array([3.9, 0.9, 1.0]) + rng.standard_normal(3) * 0.22, 0.07)
    things = leaves + block("wood", (0.6, 1.4, 0.0), (2.2, 2.2, 0.74))
    text = shell(room) + things + ground(-0.1)
    return room, text + bars(room, [(1.84, 0.06), (2.97, 0.06)], [])


def evening() -> tuple[Room, str]:
    """West window, a sofa and a shelf across the room, wall azimuth 258."""
    room = _room(
        258.0,
        Window("south", 0.6, 2.6, 0.45, 2.05, GLASS, 1, 0.0),
        width_m=4.3,
        depth_m=5.7,
        height_m=2.75,
        camera_x_m=2.3,
        camera_y_m=2.7,
        camera_z_m=1.3,
        wall_thickness_m=0.32,
        reflectance_floor=0.3,
    )
    things = block("wood", (0.5, 3.6, 0.0), (2.5, 4.5, 0.42))  # the sofa's seat and back
    things += block("wood", (0.5, 4.5, 0.0), (2.5, 4.7, 0.85))
    things += block("wood", (3.2, 3.9, 0.0), (4.3, 4.25, 1.8))
    return room, shell(room) + things + ground(-0.1) + bars(room, [(2.55, 0.09)], [0.95])


def morning() -> tuple[Room, str]:
    """East window with two mullions, a low table and a cabinet, wall azimuth 81."""
    room = _room(
        81.0,
        Window("south", 0.9, 3.3, 0.75, 1.65, GLASS, 1, 0.0),
        width_m=5.2,
        depth_m=5.1,
        height_m=2.8,
        camera_x_m=2.5,
        camera_y_m=2.4,
        camera_z_m=1.45,
        wall_thickness_m=0.28,
        reflectance_floor=0.22,
        reflectance_walls=0.55,
    )
    things = block("wood", (1.4, 3.1, 0.36), (2.6, 3.8, 0.42))
    things += block("wood", (4.7, 1.2, 0.0), (5.2, 2.4, 1.2))
    return room, shell(room) + things + ground(-0.1) + bars(room, [(2.05, 0.06), (3.15, 0.1)], [])


def mullions() -> tuple[Room, str]:
    """Odd mullions and two transoms, a column, wall azimuth 192."""
    room = _room(
        192.0,
        Window("south", 0.3, 4.4, 0.4, 2.3, GLASS, 1, 0.0),
        width_m=5.0,
        depth_m=6.6,
        height_m=3.0,
        camera_x_m=2.4,
        camera_y_m=3.0,
        camera_z_m=1.4,
        wall_thickness_m=0.25,
        reflectance_floor=0.22,
    )
    things = block("wall", (1.2, 1.3, 0.0), (1.5, 1.6, 3.0))
    things += block("wood", (3.2, 1.5, 0.0), (4.6, 2.2, 0.74))
    text = shell(room) + things + ground(-0.1)
    places = [(0.9, 0.05), (1.35, 0.14), (2.9, 0.08), (3.6, 0.05)]
    return room, text + bars(room, places, [0.95, 2.2])


def corner() -> tuple[Room, str]:
    """L-shaped room with windows in two walls at different sills, wall azimuth 163."""
    room = _room(
        163.0,
        Window("south", 0.8, 2.2, 0.9, 1.6, GLASS, 1, 0.0),
        width_m=4.8,
        depth_m=5.6,
        height_m=2.9,
        camera_x_m=2.1,
        camera_y_m=2.5,
        camera_z_m=1.4,
        wall_thickness_m=0.3,
        reflectance_floor=0.26,
    )
    second = Window("west", 1.2, 1.3, 1.25, 1.1, GLASS, 1, 0.0)
    room = replace(room, window=(*room.window, second))
    things = block("wall", (3.3, 3.6, 0.0), (4.8, 5.6, 2.9))
    things += block("wood", (0.2, 3.6, 0.0), (1.4, 4.4, 0.74))
    things += block("wood", (2.8, 0.7, 0.68), (4.2, 1.4, 0.74))
    return room, shell(room) + things + ground(-0.1) + bars(room, [(2.9, 0.07)], [])


def gallery() -> tuple[Room, str]:
    """High clerestory in a tall room with a beam and a gallery, wall azimuth 197."""
    room = _room(
        197.0,
        Window("south", 0.5, 4.2, 2.3, 1.3, GLASS, 1, 0.0),
        width_m=5.2,
        depth_m=7.2,
        height_m=4.2,
        camera_x_m=2.7,
        camera_y_m=3.6,
        camera_z_m=1.5,
        wall_thickness_m=0.4,
        reflectance_floor=0.32,
    )
    things = block("wood", (0.0, 1.5, 3.7), (5.2, 1.75, 4.2))
    things += block("wall", (0.0, 5.4, 2.3), (5.2, 7.2, 2.5))
    things += block("wood", (0.0, 5.4, 2.5), (5.2, 5.45, 3.4))
    things += block("wood", (1.0, 4.0, 0.0), (2.4, 4.8, 0.74))
    text = shell(room) + things + ground(-0.1)
    return room, text + bars(room, [(1.55, 0.06), (2.6, 0.06), (3.65, 0.06)], [])


def curtain() -> tuple[Room, str]:
    """A curtain in folds, half drawn inside, and a round table, wall azimuth 145."""
    room = _room(
        145.0,
        Window("south", 0.6, 3.0, 0.3, 2.2, GLASS, 1, 0.0),
        width_m=4.3,
        depth_m=5.2,
        height_m=2.8,
        camera_x_m=2.0,
        camera_y_m=2.8,
        camera_z_m=1.4,
        wall_thickness_m=0.3,
        reflectance_floor=0.3,
        reflectance_walls=0.65,
    )
    folds = ""
    for k in range(14):  # from the window's left end, as seen from outside, over 1.4 m
        x, y = 0.55 + 0.1 * k, (0.06, 0.16)
        a, b = y if k % 2 == 0 else y[::-1]
        low, high = 0.02, 2.7
        folds += quad("wall", [(x, a, low), (x + 0.1, b, low), (x + 0.1, b, high), (x, a, high)])
    things = folds + disc("wood", (2.9, 1.6, 0.74), 0.55)
    things += block("wood", (2.82, 1.52, 0.0), (2.98, 1.68, 0.7))
    things += block("wood", (0.0, 3.0, 0.0), (0.45, 4.8, 1.6))
    return room, shell(room) + things + ground(-0.1) + bars(room, [(2.2, 0.07)], [])


TONES = {"wood": 0.35, "facade": 0.5, "frame": 0.4, "ceiling": 0.8}


def exact_guess(room: Room, text: str) -> Guess:
    """The room as `fieldlum.room.fit` can state it at best: with all its boxes and bars.

    Leaves, slats, arches and slopes are no boxes and are missing.
    """
    guess = guess_of(room)
    bars: list[Bar] = []
    solids: list[Solid] = []
    rect = guess.windows[0]
    for line in text.splitlines():
        if not line.startswith("# solid"):
            continue
        _, _, mat, *numbers = line.split()
        x0, y0, z0, x1, y1, z1 = map(float, numbers)
        if mat == "frame":
            upright = z1 - z0 > 0.9 * (rect.z_m[1] - rect.z_m[0])
            bars.append(Bar(0, upright, (x0, x1) if upright else (z0, z1), (-y1, -y0)))
        else:
            tone = TONES.get(mat, room.reflectance_walls)
            solids.append(Solid((x0, y0, z0), (x1, y1, z1), tone))
    return replace(guess, bars=tuple(bars), solids=tuple(solids))


ROOMS = {
    "round-table": round_table,
    "canopy": canopy,
    "upstairs": upstairs,
    "sloping": sloping,
    "trees": trees,
    "mullions": mullions,
    # Not looked at while the fit was changed.
    "arch": arch,
    "blind": blind,
    # Rendered before, and fitted after, the last change of the verdict.
    "corner": corner,
    "gallery": gallery,
    "curtain": curtain,
    # Written, rendered and fitted after the last change of the scene fit.
    "evening": evening,
    "morning": morning,
}
