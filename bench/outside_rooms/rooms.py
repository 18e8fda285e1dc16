"""The rooms: places, geometry, materials. `room(NAME)` builds one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from geometry import (
    FAR_M,
    Group,
    Pane,
    Window,
    box,
    cylinder,
    folds,
    leaves,
    pane_of,
    slats,
    sphere,
    wall_with_windows,
    window_bars,
)


@dataclass
class Place:
    """Where a room stands and how a camera stands in it. ground_m: height of the ground.

    glazing: glass that is not in a window; north_error_deg: of the stated heading, either way.
    """

    about: str
    latitude: float
    longitude: float
    hours_east: float
    timezone: str
    wall_azimuth_deg: float
    heading_deg: float
    size: tuple[float, float, float]
    camera: tuple[float, float, float]
    windows: list[Window]
    thickness: float = 0.3
    ground_m: float = -0.3
    altitude_m: float = 50.0
    seed: int = 0
    groups: dict[str, Group] = field(default_factory=dict)
    glazing: list[Pane] = field(default_factory=list)
    north_error_deg: float = 0.9

    @property
    def panes(self) -> list[Pane]:
        return [pane_of(w, self.size, self.thickness) for w in self.windows] + self.glazing


def shell(
    place: Place,
    *,
    walls: float = 0.6,
    ceiling: float = 0.8,
    floor: float = 0.25,
    frame: float = 0.55,
    ground: float = 0.18,
    floor_gloss: float = 0.0,
    floor_texture: tuple[float, float] | tuple[()] = (),
    wall_texture: tuple[float, float] | tuple[()] = (),
) -> Place:
    """Add walls, ceiling, floor, frames and ground to a place."""
    (w, d, h), t = place.size, place.thickness
    inside = Group(walls, texture=wall_texture)
    for wall in ("south", "west", "north", "east"):
        inside.quads += wall_with_windows(wall, place.size, t, place.windows)
    bars = Group(frame)
    for window in place.windows:
        bars.quads += window_bars(window, place.size, t)
    far, low = FAR_M, place.ground_m
    place.groups |= {
        "walls": inside,
        "ceiling": Group(ceiling, quads=[box((-t, -t, h), (w + t, d + t, h + t))]),
        "floor": Group(
            floor,
            gloss=floor_gloss,
            texture=floor_texture,
            quads=[box((-t, -t, -t), (w + t, d + t, 0))],
        ),
        "frame": bars,
        "ground": Group(
            ground,
            quads=[
                np.array([(-far, -far, low), (far, -far, low), (far, far, low), (-far, far, low)])
            ],
        ),
    }
    return place


def table(
    place: Place, x: float, y: float, width: float, depth: float, height: float = 0.74
) -> None:
    """Add a table with four legs."""
    wood = place.groups.setdefault("wood", Group(0.35))
    wood.quads.append(box((x, y, height - 0.04), (x + width, y + depth, height)))
    for a in (x + 0.05, x + width - 0.1):
        for b in (y + 0.05, y + depth - 0.1):
            wood.quads.append(box((a, b, 0.0), (a + 0.05, b + 0.05, height - 0.04)))


def tree(
    place: Place, x: float, y: float, crown_m: float, radius: float, count: int, seed: int
) -> None:
    """Add a tree with its crown's centre `crown_m` above the floor."""
    low = place.ground_m
    bark = place.groups.setdefault("bark", Group(0.15))
    leaf = place.groups.setdefault("leaf", Group(0.14, transmittance=0.10))
    bark.round.append(cylinder((x, y, low), (x, y, crown_m + 0.4 * radius), 0.05 * radius + 0.05))
    rng = np.random.default_rng(seed)
    for _ in range(9):
        tip = rng.normal(size=3) * radius * 0.45
        bark.round.append(
            cylinder(
                (x, y, crown_m - 0.4 * radius), (x + tip[0], y + tip[1], crown_m + tip[2]), 0.025
            )
        )
    leaf.quads += leaves((x, y, crown_m), (radius, radius, 0.85 * radius), count, 0.11, seed)


def building(
    place: Place,
    low: tuple[float, float],
    high: tuple[float, float],
    height: float,
    reflectance: float,
    *,
    name: str = "building",
    turn_deg: float = 0.0,
) -> None:
    """Add a building without windows, `height` above the floor of the room."""
    stone = place.groups.setdefault(name, Group(reflectance))
    stone.quads.append(box((*low, place.ground_m), (*high, height), turn_deg))


# ----------------------------------------------------------------------------------------------
# rooms of the sky view


def _blind() -> Place:
    place = Place(
        "Office, south-west; venetian blind half down with tilted slats.",
        48.2, 11.6, 1, "Europe/Berlin", 215.0, 213.0, (4.2, 5.6, 2.9), (2.2, 1.9, 1.25),
        [Window("south", 0.6, 3.0, 0.8, 1.9, mullions=(1.5,))], seed=11,
    )  # fmt: skip
    shell(place)
    table(place, 0.3, 1.2, 1.4, 0.7)
    blind = place.groups.setdefault("slat", Group(0.55))
    blind.quads += slats((0.62, 3.58), (1.72, 2.68), -0.06, 0.05, 0.043, 28.0)
    building(place, (-30, -45), (-4, -32), 9.0, 0.4)
    return place


def _tinted() -> Place:
    place = Place(
        "Corner room at 33.9 S; a tinted double pane to the north-east, a clear one beside it.",
        -33.9, 151.2, 10, "Australia/Sydney", 32.0, 20.0, (5.2, 4.4, 2.8), (2.4, 1.6, 1.2),
        [Window("south", 0.7, 2.6, 0.5, 2.0, transmittance=0.42, panes=2, transoms=(1.4,)),
         Window("west", 0.6, 1.6, 0.9, 1.5)], seed=12,
    )  # fmt: skip
    shell(place, floor=0.35)
    table(place, 3.2, 2.2, 1.5, 0.8)
    building(place, (6, -40), (22, -22), 7.0, 0.3)
    return place


def _leaves() -> Place:
    place = Place(
        "Ground floor, south-east; a tree with leaves close to a wide window.",
        51.5, -0.1, 0, "Europe/London", 140.0, 141.0, (5.0, 5.0, 2.7), (2.4, 2.0, 1.2),
        [Window("south", 0.5, 4.0, 0.4, 2.1, panes=2, mullions=(1.33, 2.67))], seed=13,
    )  # fmt: skip
    shell(place, ground=0.12)
    tree(place, 1.2, -4.5, 3.1, 1.9, 2600, 3)
    tree(place, 6.2, -9.0, 4.0, 2.6, 3200, 4)
    return place


def _white_facade() -> Place:
    place = Place(
        "West room; a white facade opposite that is sunlit in the morning, sun above it later.",
        41.9, 12.5, 1, "Europe/Rome", 262.0, 258.0, (3.8, 4.6, 3.0), (1.8, 1.5, 1.3),
        [Window("south", 0.5, 1.2, 0.3, 2.5, panes=2), Window("south", 2.2, 1.2, 0.3, 2.5)],
        ground_m=-4.0, seed=14,
    )  # fmt: skip
    shell(place, ground=0.25)
    building(place, (-14, -22), (3.2, -13), 3.6, 0.82, name="white")
    building(place, (3.2, -21), (18, -12), 2.2, 0.55, name="plaster")
    return place


def _office() -> Place:
    place = Place(
        "Plain office, south; frame, mullions and a transom; a far skyline.",
        40.4, -3.7, 1, "Europe/Madrid", 184.0, 180.0, (6.0, 5.0, 3.0), (2.6, 1.7, 1.2),
        [Window("south", 0.6, 4.8, 0.85, 1.85, mullions=(1.2, 2.4, 3.6), transoms=(1.2,))],
        ground_m=-7.0, seed=15,
    )  # fmt: skip
    shell(place)
    table(place, 3.4, 0.8, 1.6, 0.8)
    for k, height in enumerate((3.0, 8.0, 5.0, 1.0, 10.0)):
        building(place, (-60 + 25 * k, -80), (-42 + 25 * k, -66), height, 0.35)
    return place


def _curtain() -> Place:
    place = Place(
        "Two windows to the south-west; a light curtain that scatters hangs before one half.",
        60.2, 24.9, 2, "Europe/Helsinki", 205.0, 208.0, (5.6, 4.2, 2.8), (2.7, 1.7, 1.2),
        [Window("south", 0.5, 1.9, 0.6, 1.9, panes=2),
         Window("south", 3.1, 1.9, 0.6, 1.9, panes=2)],
        ground_m=-3.0, seed=16,
    )  # fmt: skip
    shell(place)
    cloth = place.groups.setdefault("curtain", Group(0.45, transmittance=0.38))
    cloth.quads += folds((2.9, 4.3), (0.05, 2.6), 0.12, 0.04, 12)
    building(place, (-30, -38), (0, -28), 3.0, 0.3)
    return place


def _snow() -> Place:
    place = Place(
        "South-facing room above snow; a white barn, tinted single glass.",
        62.0, 10.0, 1, "Europe/Oslo", 172.0, 176.0, (4.6, 5.2, 2.6), (2.2, 1.6, 1.2),
        [Window("south", 0.7, 3.2, 0.5, 1.8, transmittance=0.7, mullions=(1.6,))],
        ground_m=-0.6, seed=17,
    )  # fmt: skip
    shell(place, ground=0.8)
    building(place, (4, -26), (14, -18), 3.2, 0.8, name="barn")
    tree(place, -1.5, -7.0, 2.6, 1.5, 1500, 9)
    return place


# ----------------------------------------------------------------------------------------------
# rooms of full light


def _round(place: Place, x: float, y: float, radius: float) -> None:
    """Add a round sofa: a low cylinder with a back of spheres."""
    cloth = place.groups.setdefault("cloth", Group(0.3))
    cloth.round += [
        cylinder((x, y, 0.0), (x, y, 0.42), radius),
        *(
            sphere((x + radius * np.cos(a), y + radius * np.sin(a), 0.55), 0.22)
            for a in np.linspace(0.3, 2.8, 6)
        ),
    ]
    angle = np.linspace(0, 2 * np.pi, 33)
    rim = np.full((33, 3), 0.42)
    rim[:, :2] = np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle)], 1)
    top = np.array([x, y, 0.42])
    cloth.triangles += [np.array([top, a, b]) for a, b in pairwise(rim)]


def _plant(place: Place, x: float, y: float, height: float, seed: int) -> None:
    """Add a pot with leaves."""
    place.groups.setdefault("pot", Group(0.25)).round.append(
        cylinder((x, y, 0.0), (x, y, 0.4), 0.18)
    )
    leaf = place.groups.setdefault("leaf", Group(0.14, transmittance=0.10))
    leaf.quads += leaves((x, y, 0.4 + height / 2), (0.4, 0.4, height / 2), 260, 0.16, seed)


def _loft() -> Place:
    place = Place(
        "Loft: glossy floor, round sofa, plant; neighbour and tree.",
        45.5, 9.2, 1, "Europe/Rome", 157.0, 170.0, (7.2, 5.4, 3.2), (3.0, 2.6, 1.5),
        [Window("south", 0.8, 2.2, 0.8, 1.9, panes=2, mullions=(1.1,)),
         Window("south", 4.3, 2.0, 0.8, 1.9, panes=2, mullions=(1.0,))],
        seed=21,
    )  # fmt: skip
    shell(place, floor=0.3, floor_gloss=0.12)
    _round(place, 5.4, 3.6, 0.9)
    _plant(place, 0.8, 0.7, 1.2, 5)
    building(place, (-16, -26), (0, -15), 7.0, 0.35, turn_deg=12)
    tree(place, 6.5, -7.0, 3.4, 2.2, 2200, 6)
    return place


def _upstairs() -> Place:
    place = Place(
        "Upstairs, at an odd azimuth; tiles on the floor, wallpaper, a tree top outside.",
        52.4, 4.9, 1, "Europe/Amsterdam", 233.0, 230.0, (4.4, 4.8, 2.6), (2.0, 2.6, 1.3),
        [Window("south", 0.9, 2.4, 0.7, 1.6, panes=2, mullions=(1.2,), transoms=(1.15,))],
        ground_m=-6.5, seed=22,
    )  # fmt: skip
    shell(place, walls=0.55, wall_texture=(0.68, 0.18), floor=0.18, floor_texture=(0.42, 0.4))
    table(place, 0.4, 0.9, 1.3, 0.7)
    place.groups["wood"].quads.append(box((3.3, 2.4, 0.0), (4.35, 4.4, 0.5)))
    tree(place, 5.0, -6.0, 0.6, 2.2, 2400, 7)
    building(place, (-25, -40), (-2, -28), 4.0, 0.45)
    return place


def _deep() -> Place:
    place = Place(
        "Deep room, camera far from the window; shelves, gloss on a long table.",
        35.7, 139.7, 9, "Asia/Tokyo", 193.0, 190.0, (5.0, 11.0, 2.9), (2.3, 5.8, 1.4),
        [Window("south", 0.4, 4.2, 0.5, 2.1, mullions=(1.4, 2.8))], ground_m=-10.0, seed=23,
    )  # fmt: skip
    shell(place)
    gloss = place.groups.setdefault("lacquer", Group(0.12, gloss=0.08))
    gloss.quads.append(box((1.2, 1.4, 0.68), (3.4, 4.2, 0.74)))
    shelf = place.groups.setdefault("shelf", Group(0.3, texture=(0.55, 0.12)))
    shelf.quads.append(box((4.55, 2.5, 0.0), (4.98, 8.5, 2.0)))
    building(place, (-20, -34), (10, -22), 4.0, 0.4)
    return place


def _corner() -> Place:
    place = Place(
        "Corner room with windows in two walls; round table, tree, facade.",
        37.8, -122.4, -8, "America/Los_Angeles", 148.0, 180.0, (5.6, 5.0, 2.8), (2.9, 2.5, 1.3),
        [Window("south", 1.4, 3.0, 0.6, 1.8, mullions=(1.5,)),
         Window("west", 1.0, 2.4, 0.9, 1.4, panes=2)],
        ground_m=-3.2, seed=24,
    )  # fmt: skip
    shell(place, floor=0.3, floor_texture=(0.22, 0.15))
    _round(place, 4.2, 3.7, 0.6)
    building(place, (-24, -4), (-11, 9), 5.0, 0.5, name="facade")
    tree(place, 3.4, -8.0, 1.2, 2.4, 2400, 8)
    return place


def _slatted() -> Place:
    place = Place(
        "Office with a venetian blind half down and glossy desks.",
        -37.8, 145.0, 10, "Australia/Melbourne", 341.0, 345.0, (5.0, 5.6, 2.8), (2.6, 2.8, 1.25),
        [Window("south", 0.7, 3.6, 0.8, 1.8, mullions=(1.8,))], ground_m=-3.5, seed=25,
    )  # fmt: skip
    shell(place)
    desk = place.groups.setdefault("desk", Group(0.4, gloss=0.2))
    desk.quads += [box((0.2, 1.0, 0.7), (1.0, 2.8, 0.74)), box((3.9, 1.4, 0.7), (4.8, 3.2, 0.74))]
    place.groups.setdefault("slat", Group(0.6)).quads += slats(
        (0.72, 4.28), (1.75, 2.58), -0.1, 0.05, 0.045, 35.0
    )
    building(place, (-8, -30), (3, -18), 5.0, 0.45)
    return place


def _street() -> Place:
    place = Place(
        "Ground floor on a street: a sunlit light facade opposite fills most of the view.",
        38.7, -9.1, 0, "Europe/Lisbon", 351.0, 349.0, (4.6, 5.2, 3.1), (2.2, 2.4, 1.5),
        [Window("south", 0.6, 1.3, 0.5, 2.2), Window("south", 2.7, 1.3, 0.5, 2.2)], seed=26,
    )  # fmt: skip
    shell(place, floor=0.22, floor_gloss=0.25)
    building(place, (-20, -17), (6, -9), 8.0, 0.65, name="facade")
    building(place, (6.5, -18), (20, -10), 5.0, 0.4)
    table(place, 1.4, 3.4, 1.6, 0.9)
    return place


def _tropical() -> Place:
    place = Place(
        "Living room at 1 N, west; trees, a plant, patterned floor.",
        1.3, 103.8, 8, "Asia/Singapore", 281.0, 284.0, (5.4, 4.6, 2.7), (2.5, 2.3, 1.3),
        [Window("south", 0.6, 4.0, 0.3, 2.1, transmittance=0.75, mullions=(1.0, 2.0, 3.0))],
        ground_m=-9.0, seed=27,
    )  # fmt: skip
    shell(place, floor=0.45, floor_texture=(0.25, 0.3), ground=0.1)
    _plant(place, 4.8, 0.8, 1.1, 11)
    _round(place, 1.4, 3.3, 0.7)
    tree(place, 0.5, -7.5, -1.0, 2.8, 2600, 12)
    building(place, (5, -40), (18, -26), 12.0, 0.5)
    return place


def _attic() -> Place:
    place = Place(
        "Small room at 64 N with a tall window and a column inside; snow outside.",
        64.1, -21.9, 0, "Atlantic/Reykjavik", 201.0, 199.0, (3.6, 4.0, 2.5), (1.7, 2.2, 1.2),
        [Window("south", 0.8, 1.9, 0.2, 2.1, panes=2, transoms=(0.9,))], ground_m=-4.0, seed=28,
    )  # fmt: skip
    shell(place, walls=0.7, ground=0.75)
    place.groups.setdefault("column", Group(0.6)).round.append(
        cylinder((2.7, 1.6, 0.0), (2.7, 1.6, 2.5), 0.15)
    )
    table(place, 0.2, 0.9, 0.9, 1.2)
    building(place, (-12, -30), (-1, -20), 3.0, 0.3)
    return place


def _chair(place: Place, x: float, y: float) -> None:
    """Add a chair that faces the wall named south."""
    seat = place.groups.setdefault("seat", Group(0.2))
    seat.quads += [
        box((x, y, 0.43), (x + 0.4, y + 0.4, 0.46)),
        box((x, y + 0.37, 0.5), (x + 0.4, y + 0.4, 0.85)),
    ]
    seat.round += [
        cylinder((x + a, y + b, 0.0), (x + a, y + b, 0.43), 0.015)
        for a in (0.04, 0.36)
        for b in (0.04, 0.36)
    ]


def _classroom() -> Place:
    place = Place(
        "Classroom: two wide windows, rows of tables and chairs, a glossy board.",
        50.9, 7.0, 1, "Europe/Berlin", 126.0, 130.0, (9.0, 7.2, 3.2), (4.2, 3.6, 1.2),
        [Window("south", 0.9, 3.0, 0.95, 1.75, panes=2, mullions=(1.0, 2.0), transoms=(1.25,)),
         Window("south", 5.1, 3.0, 0.95, 1.75, panes=2, mullions=(1.0, 2.0), transoms=(1.25,))],
        ground_m=-3.6, seed=31, north_error_deg=2.0,
    )  # fmt: skip
    shell(place, walls=0.65, floor=0.28)
    for y in (0.9, 2.4, 4.3, 5.8):
        for x in (0.8, 2.4, 4.9, 6.5):
            table(place, x, y, 1.3, 0.5, 0.72)
            _chair(place, x + 0.1, y + 0.55)
            _chair(place, x + 0.8, y + 0.55)
    place.groups["board"] = Group(0.75, gloss=0.1, quads=[box((0.0, 1.8, 0.9), (0.03, 5.4, 2.2))])
    place.groups["cupboard"] = Group(0.45, quads=[box((6.0, 6.75, 0.0), (8.6, 7.2, 1.9))])
    building(place, (-12, -48), (16, -34), 6.0, 0.42)
    tree(place, 1.8, -9.5, 0.2, 2.3, 2200, 31)
    return place


def _nordic() -> Place:
    place = Place(
        "Flat at 60 N with low sun in winter; timber floor, round sofa, lamp shade, wooded ridge.",
        60.4, 5.3, 1, "Europe/Oslo", 168.0, 176.0, (5.0, 6.2, 2.5), (2.3, 2.4, 1.2),
        [Window("south", 0.5, 2.6, 0.45, 1.75, panes=2, mullions=(1.7,)),
         Window("east", 1.4, 1.2, 0.8, 1.3, panes=2)],
        ground_m=-7.5, seed=32, north_error_deg=3.0,
    )  # fmt: skip
    shell(place, walls=0.72, floor=0.42, floor_texture=(0.3, 0.12), ground=0.2)
    _round(place, 3.6, 4.2, 0.8)
    table(place, 0.2, 1.0, 0.9, 1.4, 0.5)
    shade = place.groups.setdefault("shade", Group(0.5, transmittance=0.2))
    shade.round.append(sphere((1.2, 4.6, 1.9), 0.22))
    place.groups["bookcase"] = Group(
        0.25, texture=(0.5, 0.1), quads=[box((0.0, 3.4, 0.0), (0.32, 5.6, 2.1))]
    )
    for k, height in enumerate((2.0, 6.0, 4.0, 0.0, 5.0)):
        building(place, (-150 + 60 * k, -140), (-92 + 60 * k, -120), height, 0.12, name="ridge")
    tree(place, 4.3, -11.0, -1.0, 2.0, 2000, 32)
    return place


def _balcony() -> Place:
    place = Place(
        "Flat under a balcony; railing with bars, a light shelf at one window, glossy table.",
        43.6, 1.4, 1, "Europe/Paris", 197.0, 196.0, (6.4, 4.8, 2.7), (3.4, 2.2, 1.25),
        [Window("south", 0.6, 2.4, 0.05, 2.25, panes=2, mullions=(1.2,)),
         Window("south", 3.9, 2.0, 0.9, 1.5, panes=2, transoms=(0.95,))],
        ground_m=-6.2, seed=33, north_error_deg=1.5,
    )  # fmt: skip
    shell(place, floor=0.35, ground=0.15)
    slab = place.groups.setdefault("slab", Group(0.5))
    slab.quads += [
        box((-1.5, -1.7, 2.75), (7.9, -0.3, 2.95)),
        box((-1.5, -1.7, -0.25), (7.9, -0.3, -0.05)),
    ]
    rail = place.groups.setdefault("rail", Group(0.25))
    rail.quads.append(box((-1.5, -1.7, 0.98), (7.9, -1.64, 1.02)))
    rail.quads += [
        box((x, -1.68, -0.05), (x + 0.02, -1.66, 0.98)) for x in np.arange(-1.5, 7.9, 0.12)
    ]
    place.groups["light_shelf"] = Group(0.8, quads=[box((3.9, 0.0, 1.84), (5.9, 0.6, 1.88))])
    place.groups["lacquer"] = Group(0.15, gloss=0.1, quads=[box((4.4, 1.4, 0.7), (5.8, 2.4, 0.74))])
    place.groups["wardrobe"] = Group(0.5, quads=[box((0.0, 3.3, 0.0), (0.6, 4.8, 2.2))])
    building(place, (-26, -40), (-2, -26), 3.0, 0.5)
    return place


def _openplan() -> Place:
    place = Place(
        "L-shaped office; a glass partition across it, windows in two walls, low cabinets.",
        40.7, -74.0, -5, "America/New_York", 209.0, 205.0, (9.6, 7.4, 2.9), (3.6, 3.0, 1.25),
        [Window("south", 0.7, 4.4, 0.8, 1.8, panes=2, mullions=(1.1, 2.2, 3.3)),
         Window("south", 6.6, 2.4, 0.8, 1.8, panes=2, mullions=(1.2,)),
         Window("west", 1.2, 2.2, 0.8, 1.8, panes=2, mullions=(1.1,))],
        ground_m=-22.0, seed=34, north_error_deg=4.0,
    )  # fmt: skip
    shell(place, walls=0.62, floor=0.15)
    place.groups["core"] = Group(0.6, quads=[box((5.8, 4.4, 0.0), (9.6, 7.4, 2.9))])
    place.glazing.append(Pane(0, 6.0, (0.0, 0.0), (4.4, 2.9), 0.95, 1))
    posts = place.groups.setdefault("post", Group(0.15))
    posts.quads += [box((5.97, y, 0.0), (6.03, y + 0.05, 2.9)) for y in (0.0, 1.45, 2.9, 4.35)]
    for x, y in ((0.5, 1.0), (1.0, 4.6), (3.6, 4.8), (7.2, 1.4)):
        table(place, x, y, 1.6, 0.8)
        _chair(place, x + 0.5, y + 0.9)
    place.groups["cabinet"] = Group(0.5, quads=[box((2.6, 1.2, 0.0), (4.6, 1.6, 1.1))])
    building(place, (-22, -40), (4, -26), 14.0, 0.3)
    building(place, (8, -55), (26, -38), 30.0, 0.4)
    return place


def _gallery() -> Place:
    place = Place(
        "Museum room: a clerestory and one low window, polished floor, a free wall, statues.",
        52.5, 13.4, 1, "Europe/Berlin", 183.0, 190.0, (11.0, 8.0, 4.9), (5.2, 3.8, 1.5),
        [Window("south", 0.8, 9.4, 3.3, 1.1, panes=2, mullions=(1.88, 3.76, 5.64, 7.52)),
         Window("west", 1.0, 2.0, 0.3, 2.3, panes=2, transmittance=0.6)],
        thickness=0.45, seed=35, north_error_deg=2.0,
    )  # fmt: skip
    shell(place, walls=0.75, floor=0.3, floor_gloss=0.06)
    place.groups["free_wall"] = Group(0.75, quads=[box((6.8, 5.2, 0.0), (10.0, 5.4, 3.0))])
    stone = place.groups.setdefault("statue", Group(0.55))
    stone.quads += [box((2.0, 5.0, 0.0), (2.7, 5.7, 1.0)), box((7.2, 2.0, 0.0), (7.8, 2.6, 1.1))]
    stone.round += [
        sphere((2.35, 5.35, 1.35), 0.35),
        cylinder((7.5, 2.3, 1.1), (7.5, 2.3, 1.9), 0.18),
    ]
    place.groups["painting"] = Group(
        0.1, texture=(0.4, 0.3), quads=[box((3.5, 7.96, 1.0), (6.0, 8.0, 2.6))]
    )
    building(place, (-20, -45), (20, -30), 9.0, 0.35)
    tree(place, -6.0, 3.0, 3.0, 2.4, 2400, 35)
    return place


def _without(make: Callable[[], Place], group: str) -> Place:
    """Return a room without its slats or leaves."""
    place = make()
    del place.groups[group]
    return place


SKY_VIEW: dict[str, Callable[[], Place]] = {
    "blind_up": lambda: _without(_blind, "slat"),
    "leaves_bare": lambda: _without(_leaves, "leaf"),
    "office": _office,
    "blind": _blind,
    "tinted": _tinted,
    "leaves": _leaves,
    "white_facade": _white_facade,
    "curtain": _curtain,
    "snow": _snow,
}
FULL_LIGHT: dict[str, Callable[[], Place]] = {
    "loft": _loft,
    "upstairs": _upstairs,
    "slatted": _slatted,
    "street": _street,
    "corner": _corner,
    "deep": _deep,
    "tropical": _tropical,
    "attic": _attic,
    "classroom": _classroom,
    "nordic": _nordic,
    "balcony": _balcony,
    "openplan": _openplan,
    "gallery": _gallery,
}
UNSEEN = ("corner", "deep", "tropical", "attic")  # not looked at before the end

# ----------------------------------------------------------------------------------------------
# rooms by lot

_SITES = (
    (-43.5, 172.6, 12, "Pacific/Auckland"), (-34.6, -58.4, -3, "America/Argentina/Buenos_Aires"),
    (-26.2, 28.0, 2, "Africa/Johannesburg"), (-12.0, -77.0, -5, "America/Lima"),
    (9.9, -84.1, -6, "America/Costa_Rica"), (19.1, 72.9, 5.5, "Asia/Kolkata"),
    (25.0, 121.5, 8, "Asia/Taipei"), (33.4, -112.1, -7, "America/Phoenix"),
    (39.9, 32.9, 3, "Europe/Istanbul"), (43.7, -79.4, -5, "America/Toronto"),
    (47.4, 8.5, 1, "Europe/Zurich"), (50.1, 14.4, 1, "Europe/Prague"),
    (55.9, -3.2, 0, "Europe/London"), (57.7, 12.0, 1, "Europe/Stockholm"),
    (61.2, -149.9, -9, "America/Anchorage"),
)  # fmt: skip


def _drawn_windows(rng: np.random.Generator, wall: str, length_m: float) -> list[Window]:
    """Return one or two windows in a wall."""
    count = 1 + int(length_m > 4.0 and rng.random() < 0.45)
    part_m, windows = length_m / count, []
    sill = rng.uniform(0.1, 1.0)
    for k in range(count):
        width = part_m * rng.uniform(0.45, 0.8)
        bars = int(width // rng.uniform(0.9, 1.6))
        height = min(rng.uniform(1.2, 2.2), 2.35 - sill)
        windows.append(
            Window(
                wall, part_m * k + rng.uniform(0.1, 0.9) * (part_m - width), width, sill, height,
                panes=int(rng.choice([1, 2])), transmittance=rng.choice([0.97, 0.9, 0.6]),
                mullions=tuple(width * (i + 1) / (bars + 1) for i in range(bars)),
                transoms=(height * 0.65,) if rng.random() < 0.3 else (),
            )
        )  # fmt: skip
    return windows


def drawn(seed: int) -> Place:
    """Return a room by lot, so that nobody chose it or looked at it."""
    rng = np.random.default_rng([2026, seed])
    latitude, longitude, east, zone = _SITES[rng.integers(len(_SITES))]
    size = (rng.uniform(3.4, 8.0), rng.uniform(3.8, 8.5), rng.uniform(2.5, 3.3))
    equator = 180.0 if latitude > 0 else 0.0
    azimuth = (equator + rng.uniform(-80, 80)) % 360
    windows = _drawn_windows(rng, "south", size[0])
    if rng.random() < 0.35:
        windows += _drawn_windows(rng, str(rng.choice(["west", "east"])), size[1])
    camera = (size[0] * rng.uniform(0.3, 0.7), size[1] * rng.uniform(0.25, 0.6), 1.25)
    place = Place(
        f"Room {seed} by lot.", latitude, longitude, east, zone, round(azimuth, 1),
        round((azimuth + rng.uniform(-15, 15)) % 360, 1), size, camera, windows,
        thickness=rng.uniform(0.2, 0.45), ground_m=-float(rng.choice([0.3, 3.3, 6.5, 12.0])),
        seed=1000 + seed,        north_error_deg=rng.uniform(0.5, 3.0),
    )  # fmt: skip
    textures = [
        (rng.uniform(0.15, 0.6), rng.uniform(0.1, 0.4)) if rng.random() < 0.4 else ()
        for _ in range(2)
    ]
    shell(
        place, walls=rng.uniform(0.45, 0.8), ceiling=rng.uniform(0.65, 0.85),
        floor=rng.uniform(0.12, 0.45),
        frame=rng.uniform(0.15, 0.7), ground=rng.choice([0.1, 0.2, 0.3, 0.75]),
        floor_gloss=rng.choice([0.0, 0.0, 0.1]), floor_texture=textures[0],
        wall_texture=textures[1],
    )  # fmt: skip
    for _ in range(rng.integers(0, 4)):
        x, y = rng.uniform(0.1, 0.6, 2) * size[:2]
        table(place, x, y, rng.uniform(0.8, 1.8), rng.uniform(0.6, 0.9))
    if rng.random() < 0.4:
        x, y = rng.uniform(0.6, 0.8, 2) * size[:2]
        _round(place, x, y, rng.uniform(0.4, 0.9))
    if rng.random() < 0.5:
        depth, high = rng.uniform(0.3, 0.6), rng.uniform(1.0, 2.2)
        along = rng.uniform(0.3, 0.7) * size[1]
        place.groups["cupboard"] = Group(
            rng.uniform(0.2, 0.7), quads=[box((0.0, along, 0.0), (depth, along + 1.5, high))]
        )
    if rng.random() < 0.2:
        w = windows[0]
        low, high = w.sill_m + w.height_m * rng.uniform(0.3, 0.6), w.sill_m + w.height_m - 0.03
        along = w.start_m + 0.02, w.start_m + w.width_m - 0.02
        blind = place.groups.setdefault("slat", Group(0.6))
        blind.quads += slats(along, (low, high), -0.08, 0.05, 0.045, rng.uniform(15, 45))
    for _ in range(rng.integers(0, 3)):
        x, y, wide = rng.uniform(-25, 15), -rng.uniform(9, 40), rng.uniform(6, 25)
        height = place.ground_m + rng.uniform(3, 16)
        light = rng.choice([0.2, 0.4, 0.7])
        building(place, (x, y - 8), (x + wide, y), height, light, name=f"house_{100 * light:.0f}")
    for k in range(rng.integers(0, 3)):
        x, y = rng.uniform(-2, size[0] + 2), -rng.uniform(4.5, 11)
        tree(place, x, y, rng.uniform(0.5, 3.5), rng.uniform(1.4, 2.6), 2200, 1000 * seed + k)
    return place


def room(name: str) -> Place:
    """Build a room by its name; lot-N is the N-th room by lot."""
    if name.startswith("lot-"):
        return drawn(int(name.removeprefix("lot-")))
    return (SKY_VIEW | FULL_LIGHT)[name]()
