"""Luminance of a room of polygons without sampling noise between hours: what `scene_rooms.py` uses.

Radiance's `rtrace` follows the rays; the light is computed here. Interior and ground are divided
into cells; from each cell 256 fixed rays find what it sees, which gives its light by radiosity in
any hour. The sun reaches cells and pixels by shadow rays. All hours use the same rays, so the error
of sampling is a constant property of the room (its surfaces are a little uneven) and no noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyradiance
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from fieldlum.room.scene.geometry import glass_optics
from fieldlum.sky.daylight import Light

Array = NDArray[Any]

GATHER = 256  # rays from each cell
SUN_POINTS = 6  # points of a cell that shadow rays start from
BOUNCES = 12
SKY_PATCHES = 4096
_AHEAD_M = 1e-4
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Hits:
    """Where rays end: point and normal towards the ray [r, 3], albedo [r], 0 where none [r]."""

    point: Array
    normal: Array
    albedo: Array

    @property
    def any(self) -> Array:
        return self.albedo > 0.0


def cast(octree: Path, origin: Array, direction: Array) -> Hits:
    """Follow rays [r, 3] to the first surface; plastic at an ambient of one shows its albedo."""
    parts = []
    for at in range(0, len(direction), _CHUNK):
        rows = slice(at, at + _CHUNK)
        start = np.broadcast_to(origin, direction.shape)[rows]
        rays = np.concatenate((start, direction[rows]), axis=1).astype("<f4").tobytes()
        answer = pyradiance.rtrace(
            rays,
            octree,
            header=False,
            inform="f",
            outform="f",
            outspec="pNv",
            params=["-ab", "0", "-av", "1", "1", "1", "-lr", "0", "-w-", "-dv-"],
        )
        parts.append(np.frombuffer(answer, "<f4").reshape(-1, 9))
    table = np.concatenate(parts)
    normal = table[:, 3:6].copy()
    normal[(normal * direction).sum(axis=1) > 0.0] *= -1.0
    return Hits(table[:, :3].astype(float), normal.astype(float), table[:, 8].astype(float))


@dataclass(frozen=True)
class Truth:
    """Operators of a room: cells [c] and camera rays [r].

    inside: the box whose surfaces are behind glass; pane_axis: of its normal.
    """

    octree: Path
    eye: Array
    inside_low: Array
    inside_high: Array
    glass: float
    sky: Array  # [k, 3] directions
    tree: cKDTree
    cell_point: Array
    cell_normal: Array
    cell_albedo: Array
    sun_start: Array  # [c, s, 3]
    form: csr_matrix  # [c, c] share of a cell's rays that end on another
    to_sky: csr_matrix  # [c, k] share times glass


def fibonacci(count: int) -> Array:
    """Directions of equal solid angle above the horizon, [count, 3]."""
    k = np.arange(count) + 0.5
    z = k / count
    angle = np.pi * (1.0 + np.sqrt(5.0)) * k
    side = np.sqrt(1.0 - z**2)
    return np.stack((side * np.cos(angle), side * np.sin(angle), z), axis=1)


def cell_key(point: Array, normal: Array, low: Array, high: Array) -> Array:
    """Keys of the cells that points [r, 3] are in, [r, 7]: 0.2 m in the room, coarser outside."""
    middle = (low + high) / 2.0
    away = np.maximum(np.abs(point - middle) - (high - low) / 2.0, 0.0).max(axis=1)
    size = np.select([away < 0.05, away < 8.0, away < 60.0], [0.2, 1.0, 8.0], 1e9)[:, None]
    facing = np.round(4.0 * normal)
    # Along its own normal a surface has one place, to a centimetre; across it, cells.
    across = np.floor(point / size)
    offset = np.round((point * normal).sum(axis=1, keepdims=True) / 0.02)
    flat = np.abs(normal) > 0.9
    across[flat] = 0.0
    return np.concatenate((across, facing, np.where(size > 1e8, 0.0, offset)), axis=1).astype(int)


def tangents(normal: Array) -> tuple[Array, Array]:
    helper = np.where(np.abs(normal[:, 2:3]) > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]])
    one = np.cross(helper, normal)
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    return one, np.cross(normal, one)


def cosine_rays(normal: Array, count: int, rng: np.random.Generator) -> Array:
    """Stratified directions by cosine about normals [c, 3], [c, count, 3]."""
    side = round(np.sqrt(count))
    u, v = np.meshgrid(np.arange(side), np.arange(side))
    jitter = rng.random((2, len(normal), side * side))
    radius = np.sqrt((u.ravel() + jitter[0]) / side)
    angle = 2.0 * np.pi * (v.ravel() + jitter[1]) / side
    one, two = tangents(normal)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    z = np.sqrt(np.maximum(1.0 - radius**2, 0.0))
    return (
        x[..., None] * one[:, None] + y[..., None] * two[:, None] + z[..., None] * normal[:, None]
    )


def build_truth(
    octree: Path, eye: Array, rays: Array, low: Array, high: Array, glass: float, seed: int = 0
) -> Truth:
    """Find the cells that camera rays and their reflections reach, and what each cell sees."""
    rng = np.random.default_rng(seed)
    seen = cast(octree, eye, rays)
    use = np.flatnonzero(seen.any)
    some = rng.choice(use, min(3000, len(use)), replace=False)
    start = seen.point[some] + _AHEAD_M * seen.normal[some]
    out = cosine_rays(seen.normal[some], 144, rng).reshape(-1, 3)
    more = cast(octree, np.repeat(start, 144, axis=0), out)
    far = np.flatnonzero(more.any)
    points = np.concatenate((seen.point[use], more.point[far]))
    normals = np.concatenate((seen.normal[use], more.normal[far]))
    albedos = np.concatenate((seen.albedo[use], more.albedo[far]))
    keys = cell_key(points, normals, low, high)
    _, first, of, count = np.unique(
        keys, axis=0, return_index=True, return_inverse=True, return_counts=True
    )
    of = of.ravel()
    cells = len(first)
    order = np.argsort(of, kind="stable")
    begin = np.concatenate(([0], np.cumsum(count)[:-1]))
    pick = order[begin[:, None] + (rng.random((cells, SUN_POINTS)) * count[:, None]).astype(int)]
    sun_start = points[pick] + _AHEAD_M * normals[pick]  # [c, s, 3]
    middle = points[pick[:, 0]]
    normal = normals[first]
    gather = cosine_rays(normal, GATHER, rng)
    # Each cell's rays start from its sampled points in turn.
    starts = sun_start[:, np.arange(GATHER) % SUN_POINTS]
    hits = cast(octree, starts.reshape(-1, 3), gather.reshape(-1, 3))
    tree = cKDTree(np.concatenate((middle, 2.0 * normal), axis=1))
    sky = fibonacci(SKY_PATCHES)
    form, to_sky = operators(
        tree, sky, starts.reshape(-1, 3), gather.reshape(-1, 3), hits, GATHER, low, high, glass
    )
    return Truth(
        octree,
        eye,
        low,
        high,
        glass,
        sky,
        tree,
        middle,
        normal,
        albedos[first],
        sun_start,
        form,
        to_sky,
    )


def within(point: Array, low: Array, high: Array) -> Array:
    return ((point > low) & (point < high)).all(axis=-1)


def glass_between(origin: Array, end: Array, direction: Array, low: Array, high: Array, t: float):
    """Transmittance of the pane that rays cross from the room outwards, else 1, [r].

    The pane is in the face of the inside through which a ray leaves.
    """
    crosses = within(origin, low, high) & ~within(end, low, high)
    face = np.where(direction > 0.0, high, low)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(direction != 0.0, (face - origin) / direction, np.inf)
    axis = np.argmin(np.where(np.isnan(distance), np.inf, distance), axis=1)
    cosine = np.take_along_axis(direction, axis[:, None], axis=1)[:, 0]
    return np.where(crosses, glass_optics(t, cosine)[0], 1.0)


def operators(
    tree: cKDTree,
    sky: Array,
    origin: Array,
    direction: Array,
    hits: Hits,
    per: int,
    low: Array,
    high: Array,
    glass: float,
) -> tuple[csr_matrix, csr_matrix]:
    """Sparse weights of cells and sky patches for groups of `per` rays."""
    groups = np.arange(len(direction)) // per
    end = np.where(hits.any[:, None], hits.point, origin + 1e4 * direction)
    weight = glass_between(origin, end, direction, low, high, glass) / per
    hit = np.flatnonzero(hits.any)
    _, cell = tree.query(np.concatenate((hits.point[hit], 2.0 * hits.normal[hit]), axis=1))
    count = groups[-1] + 1
    form = csr_matrix((weight[hit], (groups[hit], cell)), (count, tree.n))
    open_ = np.flatnonzero(~hits.any & (direction[:, 2] > 0.0))
    _, patch = cKDTree(sky).query(direction[open_])
    to_sky = csr_matrix((weight[open_], (groups[open_], patch)), (count, len(sky)))
    return form, to_sky


def sun_on(truth: Truth, start: Array, normal: Array, sun: Array) -> Array:
    """Cosine of incidence times visibility and glass of points [p, 3] towards one sun, [p]."""
    cosine = normal @ sun
    rows = np.flatnonzero(cosine > 1e-4)
    out = np.zeros(len(start))
    if not len(rows) or sun[2] <= 0.0:
        return out
    toward = np.broadcast_to(sun, (len(rows), 3))
    blocked = cast(truth.octree, start[rows], np.ascontiguousarray(toward)).any
    end = start[rows] + 1e4 * sun
    t = glass_between(start[rows], end, toward, truth.inside_low, truth.inside_high, truth.glass)
    out[rows] = np.where(blocked, 0.0, cosine[rows] * t)
    return out


def cell_light(truth: Truth, light: Light, suns: Array) -> tuple[Array, Array]:
    """Exitance over pi of the cells [n, c], and the sky's luminance [n, k].

    light: in room axes, like suns.
    """
    sky = np.asarray(light.sky_at(truth.sky), float)
    direct = np.zeros((len(light), len(truth.cell_albedo)))
    shape = truth.sun_start.shape[:2]
    normals = np.repeat(truth.cell_normal, shape[1], axis=0)
    for k in np.flatnonzero((light.direct_lx > 50.0) & (suns[:, 2] > 0.0)):
        share = sun_on(truth, truth.sun_start.reshape(-1, 3), normals, suns[k])
        direct[k] = light.direct_lx[k] * share.reshape(shape).mean(axis=1)
    from_sky = sky @ truth.to_sky.T  # [n, c], mean luminance seen
    first = truth.cell_albedo * (from_sky + direct / np.pi)
    total = first
    for _ in range(BOUNCES):
        total = first + truth.cell_albedo * (total @ truth.form.T)
    return total, sky


@dataclass(frozen=True)
class CameraRays:
    """Rays from the camera [r, 3], sorted by pixel [r], in panoramas of `height` rows."""

    rays: Array
    pixel: Array
    height: int

    @property
    def count(self) -> int:
        """Number of pixels."""
        return 2 * self.height**2


def pictures(
    truth: Truth, light: Light, suns: Array, camera: CameraRays, fine: CameraRays, gather: int = 64
) -> tuple[Array, Array]:
    """Luminance and sun patches of the pixels in each hour, [n, count] cd/m2.

    camera: rays of all light but direct sun; fine: rays of direct sun, whose edges show most.
    light: in room axes, like suns and rays.
    """
    rays, pixel, count = camera.rays, camera.pixel, camera.count
    rng = np.random.default_rng(1)
    low, high = truth.inside_low, truth.inside_high
    hits = cast(truth.octree, truth.eye, rays)
    number = np.bincount(pixel, minlength=count)
    cells, sky = cell_light(truth, light, suns)
    origin = np.broadcast_to(truth.eye, rays.shape)
    straight_cells, straight_sky = operators(
        truth.tree, truth.sky, origin, rays, hits, 1, low, high, truth.glass
    )
    inside = hits.any & within(hits.point, low, high)
    rows = np.flatnonzero(inside)
    start = hits.point[rows] + _AHEAD_M * hits.normal[rows]
    form, to_sky = [], []
    for at in range(0, len(rows), 16384):
        part = slice(at, at + 16384)
        out = cosine_rays(hits.normal[rows[part]], gather, rng).reshape(-1, 3)
        begin = np.repeat(start[part], gather, axis=0)
        found = cast(truth.octree, begin, out)
        a, b = operators(truth.tree, truth.sky, begin, out, found, gather, low, high, truth.glass)
        place = csr_matrix(
            (hits.albedo[rows[part]], (pixel[rows[part]], np.arange(a.shape[0]))),
            (count, a.shape[0]),
        )
        form.append(place @ a)
        to_sky.append(place @ b)
    outside = np.where(inside, 0.0, 1.0)
    place = csr_matrix((outside, (pixel, np.arange(len(rays)))), (count, len(rays)))
    form.append(place @ straight_cells)
    to_sky.append(place @ straight_sky)
    base = (sum(form) @ cells.T + sum(to_sky) @ sky.T).T / number  # [n, count]
    patch = np.zeros_like(base)
    sunlit = sunlit_rays(truth, fine)
    for k in np.flatnonzero((light.direct_lx > 50.0) & (suns[:, 2] > 0.0)):
        shine = light.direct_lx[k] * sunlit.shine(suns[k])
        patch[k] = sunlit.mean(shine)
        # Surfaces outside are cells, whose light has the sun in it already.
        base[k] += sunlit.mean(shine * sunlit.inside)
    return base.astype(np.float32), patch.astype(np.float32)


@dataclass(frozen=True)
class SunlitRays:
    """Direct sun on what camera rays [r] show, per lx on the sun's normal.

    inside: behind glass [r]; scale: albedo times glass over pi [r]; start, normal: [r, 3].
    """

    truth: Truth
    camera: CameraRays
    inside: Array
    scale: Array
    start: Array
    normal: Array

    def shine(self, sun: Array) -> Array:
        """Luminance of each ray's end by the sun, [r]."""
        out = np.zeros(len(self.scale))
        rows = np.flatnonzero(self.scale > 0.0)
        out[rows] = sun_on(self.truth, self.start[rows], self.normal[rows], sun) * self.scale[rows]
        return out

    def mean(self, shine: Array) -> Array:
        """Mean over the rays of each pixel, 0 without a ray, [count]."""
        camera = self.camera
        number = np.bincount(camera.pixel, minlength=camera.count)
        return np.bincount(camera.pixel, shine, camera.count) / np.maximum(number, 1)


def sunlit_rays(truth: Truth, camera: CameraRays) -> SunlitRays:
    """Direct sun on what camera rays hit."""
    hits = cast(truth.octree, truth.eye, camera.rays)
    low, high = truth.inside_low, truth.inside_high
    inside = hits.any & within(hits.point, low, high)
    origin = np.broadcast_to(truth.eye, camera.rays.shape)
    through = glass_between(origin, hits.point, camera.rays, low, high, truth.glass)
    scale = np.where(hits.any, hits.albedo * through / np.pi, 0.0)
    start = hits.point + _AHEAD_M * hits.normal
    return SunlitRays(truth, camera, inside, scale, start, hits.normal)
