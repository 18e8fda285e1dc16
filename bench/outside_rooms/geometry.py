"""Build the surfaces of a room from boxes, leaves and round things.

Axes of a room: x right and y away from the wall named south, z up, metres; that wall's outer face
looks along -y. A `Group` is all surfaces of one material.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]

PANE_INDEX = 1.52  # refractive index of float glass
REVEAL_PANE_M = 0.12  # of a pane behind the outer face of the wall; chosen
FAR_M = 4000.0  # half side of the ground; chosen


@dataclass
class Group:
    """Surfaces of one material: quads [n, 4, 3] or triangles [n, 3, 3], spheres, cylinders.

    reflectance: diffuse; transmittance: diffuse, to the other side; gloss: roughness of a
    dielectric coat, 0 for none; texture: another reflectance and the size [m] of its squares, ()
    for none.
    """

    reflectance: float
    transmittance: float = 0.0
    gloss: float = 0.0
    texture: tuple[float, float] | tuple[()] = ()
    quads: list[Array] = field(default_factory=list)
    triangles: list[Array] = field(default_factory=list)
    round: list[dict[str, Any]] = field(default_factory=list)


@dataclass(frozen=True)
class Window:
    """A rectangular opening. start_m: along the wall from its end at low x (south, north) or low y.

    transmittance: of the glass at normal incidence before interface losses; panes: one or two;
    mullions, transoms: distances [m] of bars from the opening's left (low) end and its sill.
    """

    wall: str
    start_m: float
    width_m: float
    sill_m: float
    height_m: float
    transmittance: float = 0.97
    panes: int = 1
    frame_m: float = 0.06
    mullions: Sequence[float] = ()
    transoms: Sequence[float] = ()


@dataclass(frozen=True)
class Pane:
    """A pane of glass in the plane where `axis` (0 x, 1 y) has the value `at`.

    low, high: limits along the other horizontal axis and z.
    """

    axis: int
    at: float
    low: tuple[float, float]
    high: tuple[float, float]
    transmittance: float
    panes: int


def box(low: Sequence[float], high: Sequence[float], turn_deg: float = 0.0) -> Array:
    """Return the six faces [6, 4, 3] of a box, turned about its vertical axis."""
    x, y, z = zip(low, high, strict=True)
    faces = [
        [(x[a], y[b], z[c]) for a, b, c in corners]
        for corners in (
            ((0, 0, 0), (1, 0, 0), (1, 0, 1), (0, 0, 1)),
            ((0, 1, 0), (0, 1, 1), (1, 1, 1), (1, 1, 0)),
            ((0, 0, 0), (0, 0, 1), (0, 1, 1), (0, 1, 0)),
            ((1, 0, 0), (1, 1, 0), (1, 1, 1), (1, 0, 1)),
            ((0, 0, 0), (0, 1, 0), (1, 1, 0), (1, 0, 0)),
            ((0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)),
        )
    ]
    return turned(np.array(faces, float), turn_deg, (np.mean(x), np.mean(y)))


def turned(points: Array, degrees: float, centre: Sequence[float]) -> Array:
    """Return points [..., 3] turned counterclockwise about a vertical axis."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    x, y = points[..., 0] - centre[0], points[..., 1] - centre[1]
    return np.stack(
        [centre[0] + cos * x - sin * y, centre[1] + sin * x + cos * y, points[..., 2]], -1
    )


def wall_box(
    wall: str,
    size: Sequence[float],
    thickness: float,
    along: tuple[float, float],
    z: tuple[float, float],
    depth: tuple[float, float] = (0.0, 1.0),
) -> Array:
    """Return a box in a wall. depth: of its faces, in wall thicknesses from the outer face."""
    outer, inner = (thickness * (1 - d) for d in depth)
    if wall in ("south", "west"):
        across = (-outer, -inner)
    else:
        across = ((size[1] if wall == "north" else size[0]) + np.array([inner, outer])).tolist()
    if wall in ("south", "north"):
        return box((along[0], across[0], z[0]), (along[1], across[1], z[1]))
    return box((across[0], along[0], z[0]), (across[1], along[1], z[1]))


def wall_with_windows(
    wall: str, size: Sequence[float], thickness: float, windows: Sequence[Window]
) -> list[Array]:
    """Return the boxes of a wall around its windows; the wall reaches over its corners."""
    length = size[0] if wall in ("south", "north") else size[1]
    reach = thickness if wall in ("south", "north") else 0.0
    mine = [w for w in windows if w.wall == wall]
    along = sorted(
        {-reach, length + reach, *(e for w in mine for e in (w.start_m, w.start_m + w.width_m))}
    )
    boxes = []
    for a, b in pairwise(along):
        hole = next((w for w in mine if w.start_m <= (a + b) / 2 <= w.start_m + w.width_m), None)
        spans = [(-thickness, size[2] + thickness)]
        if hole is not None:
            spans = [
                (-thickness, hole.sill_m),
                (hole.sill_m + hole.height_m, size[2] + thickness),
            ]
        boxes += [wall_box(wall, size, thickness, (a, b), z) for z in spans]
    return boxes


def window_bars(window: Window, size: Sequence[float], thickness: float) -> list[Array]:
    """Return the boxes of a window's frame, mullions and transoms."""
    a, b = window.start_m, window.start_m + window.width_m
    low, high, f = window.sill_m, window.sill_m + window.height_m, window.frame_m
    depth = tuple((REVEAL_PANE_M + d) / thickness for d in (-0.03, 0.03))
    spans = [((a, b), (low, low + f)), ((a, b), (high - f, high))]
    spans += [((a, a + f), (low, high)), ((b - f, b), (low, high))]
    spans += [((a + m - f / 2, a + m + f / 2), (low, high)) for m in window.mullions]
    spans += [((a, b), (low + t - f / 2, low + t + f / 2)) for t in window.transoms]
    return [wall_box(window.wall, size, thickness, x, z, depth) for x, z in spans]


def pane_of(window: Window, size: Sequence[float], thickness: float) -> Pane:
    """Return the glass of a window."""
    axis = 1 if window.wall in ("south", "north") else 0
    far = size[1] if window.wall == "north" else size[0]
    outside = thickness - REVEAL_PANE_M
    at = -outside if window.wall in ("south", "west") else far + outside
    return Pane(
        axis,
        at,
        (window.start_m, window.sill_m),
        (window.start_m + window.width_m, window.sill_m + window.height_m),
        window.transmittance,
        window.panes,
    )


def slats(
    x: tuple[float, float],
    z: tuple[float, float],
    y: float,
    width_m: float,
    spacing_m: float,
    tilt_deg: float,
) -> list[Array]:
    """Return the quads of a venetian blind in a south wall; tilt: of the outer edges, downwards."""
    half = width_m / 2 * np.array([np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))])
    out = []
    for height in np.arange(z[0], z[1], spacing_m):
        near, far = (y + half[0], height + half[1]), (y - half[0], height - half[1])
        out.append(
            np.array(
                [
                    (x[0], far[0], far[1]),
                    (x[1], far[0], far[1]),
                    (x[1], near[0], near[1]),
                    (x[0], near[0], near[1]),
                ]
            )
        )
    return out


def leaves(
    centre: Sequence[float], radii: Sequence[float], count: int, size_m: float, seed: int
) -> list[Array]:
    """Return triangles of leaves with random places in an ellipsoid and random directions."""
    rng = np.random.default_rng(seed)
    place = rng.normal(size=(count, 3))
    place /= np.linalg.norm(place, axis=1, keepdims=True)
    place *= rng.uniform(0.1, 1.0, (count, 1)) ** (1 / 2.2)
    place = np.asarray(centre) + place * np.asarray(radii)
    u = rng.normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(u, rng.normal(size=(count, 3)))
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    scale = size_m * rng.uniform(0.7, 1.3, (count, 1))
    return list(
        np.stack(
            [
                place - 0.5 * scale * u,
                place + 0.3 * scale * v,
                place + 0.5 * scale * u,
                place - 0.3 * scale * v,
            ],
            1,
        )
    )


def folds(
    x: tuple[float, float], z: tuple[float, float], y: float, depth_m: float, waves: int
) -> list[Array]:
    """Return the quads of a curtain that hangs in folds."""
    along = np.linspace(*x, 12 * waves + 1)
    depth = y + depth_m * np.sin(np.linspace(0, 2 * np.pi * waves, len(along)))
    return [
        np.array([(a, p, z[0]), (b, q, z[0]), (b, q, z[1]), (a, p, z[1])])
        for a, b, p, q in zip(along[:-1], along[1:], depth[:-1], depth[1:], strict=True)
    ]


def sphere(centre: Sequence[float], radius: float) -> dict[str, Any]:
    return {"type": "sphere", "center": list(centre), "radius": radius}


def cylinder(low: Sequence[float], high: Sequence[float], radius: float) -> dict[str, Any]:
    return {"type": "cylinder", "p0": list(low), "p1": list(high), "radius": radius}
