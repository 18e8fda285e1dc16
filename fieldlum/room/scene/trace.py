"""Cast rays among boxes and panes exactly, vectorised over rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats, Mask
from fieldlum.room.scene.geometry import BoxScene, Opening, glass_optics

EPSILON_M = 1e-4  # points are lifted by multiples of this above their surface, to miss it; chosen
# rays in work at a time; limits memory only; chosen; any value gives the same result
_CHUNK = 150_000


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
    n = len(directions)
    distance, box = np.full(n, np.inf), np.full(n, -1, np.int32)
    axis, sign = np.zeros(n, np.int8), np.zeros(n, np.int8)
    for start in range(0, n, _CHUNK):
        rows = slice(start, start + _CHUNK)
        distance[rows], box[rows], axis[rows], sign[rows] = _first(
            scene, origins[rows], directions[rows]
        )
    return Hits(distance, box, axis, sign)


def _first(scene: BoxScene, origins: Floats, directions: Floats) -> tuple[Array, ...]:
    d = np.where(np.abs(directions) < 1e-12, 1e-12, directions).T  # [3, n]
    inverse = np.ascontiguousarray(1.0 / d)
    start = np.ascontiguousarray(origins.T)  # [3, n]; a reduction over a last axis of 3 is slow
    best = np.full(d.shape[1], np.inf)
    box, axis = np.full(d.shape[1], -1, np.int32), np.zeros(d.shape[1], np.int8)
    for k in range(len(scene.boxes)):
        a = (scene.low[k][:, None] - start) * inverse
        b = (scene.high[k][:, None] - start) * inverse
        enter, leave = np.minimum(a, b), np.maximum(a, b)
        near = np.maximum(np.maximum(enter[0], enter[1]), enter[2])  # [n]
        far = np.minimum(np.minimum(leave[0], leave[1]), leave[2])  # [n]
        hit = np.flatnonzero((near < far) & (near > EPSILON_M / 10) & (near < best))
        best[hit], box[hit] = near[hit], k
        axis[hit] = enter[:, hit].argmax(axis=0)
    sign = -np.sign(d[axis, np.arange(d.shape[1])]).astype(np.int8)
    return best, box, axis, sign


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


def hides(
    low: Array, high: Array, box: NDArray[np.intp], points: NDArray[np.floating], toward: Array
) -> NDArray[np.bool_]:
    """Return whether one box hides a far light from each point, as a mask [k].

    low, high : corners of the boxes [b, 3] m; box : index of each point's box [k]; points : [k, 3]
    m; toward : direction of the light [3].
    """
    kind = points.dtype
    d = np.where(np.abs(toward) < 1e-9, 1e-9, toward)
    near, far = np.where(d > 0, low, high), np.where(d > 0, high, low)
    enter, leave = (near / d).astype(kind), (far / d).astype(kind)  # [b, 3]
    inverse = (1.0 / d).astype(kind)
    first, last = np.full(len(points), -np.inf, kind), np.full(len(points), np.inf, kind)
    for axis in range(3):
        scaled = points[:, axis] * inverse[axis]
        np.maximum(first, enter[box, axis] - scaled, out=first)
        np.minimum(last, leave[box, axis] - scaled, out=last)
    return (first < last) & (last > EPSILON_M)


def blocked_rays(low: Array, high: Array, eye: Array, rays: Array) -> NDArray[np.bool_]:
    """Return the rays [k, 3] from the point `eye` [3] that meet any of the boxes, as a mask [k].

    low, high : corners of the boxes [b, 3] m.
    """
    d = np.where(np.abs(rays) < 1e-9, 1e-9, rays)[:, None]  # [k, 1, 3]
    start = eye * (1.0 / d)
    first = (np.where(d > 0, low, high) / d - start).max(axis=2)  # [k, b]
    last = (np.where(d > 0, high, low) / d - start).min(axis=2)
    return ((first < last) & (last > EPSILON_M)).any(axis=1)


def may_block(
    low: Floats, high: Floats, tile_low: Floats, tile_high: Floats, toward: Floats
) -> Mask:
    """Return which boxes [b, 3] (m) may be between a point of a tile [t, 3] and the light, [t, b].

    toward : [3] direction of the light. The result may contain too many boxes, never too few.
    """
    d = np.where(np.abs(toward) < 1e-9, 1e-9, toward)
    near, far = np.where(d > 0, low, high) / d, np.where(d > 0, high, low) / d
    first, last = tile_low / d, tile_high / d
    least, most = np.minimum(first, last), np.maximum(first, last)  # [t, 3]
    enters = [near[:, k] - most[:, k, None] for k in range(3)]  # [t, b] each
    leaves = [far[:, k] - least[:, k, None] for k in range(3)]
    enter = np.maximum(np.maximum(enters[0], enters[1]), enters[2])
    leave = np.minimum(np.minimum(leaves[0], leaves[1]), leaves[2])
    return (enter < leave) & (leave > 0)
