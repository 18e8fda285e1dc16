"""Cast rays among boxes and panes exactly."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats, Mask
from fieldlum.core.compiled import compiled
from fieldlum.room.scene.geometry import BoxScene, Opening, glass_optics

EPSILON_M = 1e-4  # points are lifted by multiples of this above their surface, to miss it; chosen


@dataclass(frozen=True, slots=True)
class Hits:
    """The first box on each of n rays.

    distance_m [n] : inf without a box; box [n] : its index, -1 without a box; axis [n], sign [n] :
    axis 0..2 and sign of the face's normal.
    """

    distance_m: Floats
    box: NDArray[np.int32]
    axis: NDArray[np.int8]
    sign: NDArray[np.int8]


def first_hits(scene: BoxScene, origins: Floats, directions: Floats) -> Hits:
    """Return the nearest box that each of n rays hits, and the distance.

    origins, directions: [n, 3]. A box that contains the ray's origin is ignored. A ray without a
    box has box -1 and an infinite distance.
    """
    origins = np.ascontiguousarray(np.broadcast_to(origins, directions.shape))
    return Hits(*nearest_box(scene.low, scene.high, origins, np.ascontiguousarray(directions)))


@compiled
def nearest_box(
    low: Floats, high: Floats, origins: Floats, directions: Floats
) -> tuple[Floats, NDArray[np.int32], NDArray[np.int8], NDArray[np.int8]]:
    """Return distance, box, and axis and sign of the face, as `Hits`, of n rays [n, 3] each.

    low, high: corners of the boxes [b, 3] m.
    """
    count = len(directions)
    distance, box = np.full(count, np.inf), np.full(count, -1, np.int32)
    axis, sign = np.zeros(count, np.int8), np.zeros(count, np.int8)
    for ray in range(count):
        d = directions[ray]
        by_x = 1.0 / (d[0] if abs(d[0]) >= 1e-12 else 1e-12)
        by_y = 1.0 / (d[1] if abs(d[1]) >= 1e-12 else 1e-12)
        by_z = 1.0 / (d[2] if abs(d[2]) >= 1e-12 else 1e-12)
        x, y, z = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        for k in range(len(low)):
            x0, x1 = (low[k, 0] - x) * by_x, (high[k, 0] - x) * by_x
            y0, y1 = (low[k, 1] - y) * by_y, (high[k, 1] - y) * by_y
            z0, z1 = (low[k, 2] - z) * by_z, (high[k, 2] - z) * by_z
            in_x, in_y, in_z = min(x0, x1), min(y0, y1), min(z0, z1)
            near = max(in_x, in_y, in_z)
            far = min(max(x0, x1), max(y0, y1), max(z0, z1))
            if near < far and EPSILON_M / 10 < near < distance[ray]:
                distance[ray], box[ray] = near, k
                axis[ray] = 0 if near == in_x else (1 if near == in_y else 2)
        if box[ray] >= 0:
            sign[ray] = -1 if d[axis[ray]] > 0.0 else 1
    return distance, box, axis, sign


@dataclass(frozen=True, slots=True)
class Panes:
    """The first pane on each of n rays.

    opening [n] : its index, -1 without a pane; distance_m [n] : inf without a pane; through, back
    [n] : transmittance and reflectance at the ray's angle, 1 and 0 without a pane.
    """

    opening: NDArray[np.int32]
    distance_m: Floats
    through: Floats
    back: Floats


def pane_crossings(scene: BoxScene, origins: Floats, directions: Floats, limit_m: Floats) -> Panes:
    """Return the first pane that each ray crosses within `limit_m` [n]."""
    n = len(directions)
    index, best = np.full(n, -1, np.int32), np.array(limit_m, float)
    through, back = np.ones(n), np.zeros(n)
    for k, o in enumerate(scene.openings):
        at, inside = _cross(o, origins, directions, o.pane_m)
        hit = inside & (at > EPSILON_M / 10) & (at < best)
        best[hit], index[hit] = at[hit], k
        through[hit], back[hit] = glass_optics(o.transmittance, directions[hit, o.axis])
    return Panes(index, np.where(index >= 0, best, np.inf), through, back)


def _cross(o: Opening, origins: Floats, directions: Floats, plane_m: float) -> tuple[Floats, Mask]:
    """Return the distance to a plane across the opening, and whether a ray passes inside it."""
    d = directions[:, o.axis]
    at = (plane_m - origins[:, o.axis]) / np.where(np.abs(d) < 1e-12, 1e-12, d)
    u = origins[:, o.along] + at * directions[:, o.along]
    z = origins[:, 2] + at * directions[:, 2]
    return at, o.contains(u, z)


def blocked(low: Floats, high: Floats, points: Floats, toward: Floats) -> Mask:
    """Return the points from which any of the boxes hides a far light, as a mask [k].

    low, high : corners of the boxes [b, 3] m; points : [k, 3] m; toward : direction of the light
    [3].
    """
    kind = points.dtype
    d = np.where(np.abs(toward) < 1e-9, 1e-9, toward)
    near, far = np.where(d > 0, low, high), np.where(d > 0, high, low)
    scaled = np.ascontiguousarray((points * (1.0 / d).astype(kind)).T)  # [3, m]
    enter, leave = (near / d).astype(kind), (far / d).astype(kind)  # [b, 3]
    first, last = enter[:, :1] - scaled[0], leave[:, :1] - scaled[0]  # [b, m]
    for axis in (1, 2):
        np.maximum(first, enter[:, axis, None] - scaled[axis], out=first)
        np.minimum(last, leave[:, axis, None] - scaled[axis], out=last)
    return ((first < last) & (last > EPSILON_M)).any(axis=0)


def blocked_rays(low: Array, high: Array, eye: Array, rays: Array) -> NDArray[np.bool_]:
    """Return the rays [k, 3] from the point `eye` [3] that meet any of the boxes, as a mask [k].

    low, high : corners of the boxes [b, 3] m.
    """
    d = np.where(np.abs(rays) < 1e-9, 1e-9, rays)[:, None]  # [k, 1, 3]
    start = eye * (1.0 / d)
    first = (np.where(d > 0, low, high) / d - start).max(axis=2)  # [k, b]
    last = (np.where(d > 0, high, low) / d - start).min(axis=2)
    return ((first < last) & (last > EPSILON_M)).any(axis=1)
