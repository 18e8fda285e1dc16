"""Daylight coefficients of the office: cells of its surfaces, and what rays from them see.

Surfaces are cut into cells of 0.15 m. Rays gathered at the cells give one sparse matrix for the sky
(2 305 Reinhart patches, open ground) and one for interreflection.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from annual_truth_office import (
    FABRIC,
    FAR_M,
    MIRROR,
    Array,
    Points,
    Scene,
    fabric_through,
    first_hit,
    glass,
    pane_share,
    rectangle,
)
from numpy.typing import NDArray

from fieldlum.sky.perez import reinhart_patches

CELL_M = 0.15
GATHER_RAYS = 400
FABRIC_REFLECTS, FABRIC_SCATTERS = 0.1, 0.02
BEHIND_MIRROR = 0.03  # reflectance of the wall behind the glass facade
DIFFUSE_TN = 0.62  # hemispherical transmittance of the glass facade, to 5 %: its share is small


def _plane_cells(plane: tuple[float, float, float, float], step: float, sides: Array) -> Points:
    y, half, low, high = plane
    x = np.arange(-half + step / 2, half, step)
    z = np.arange(low + step / 2, high, step)
    grid = np.stack(np.meshgrid(x, [y], z, indexing="ij"), axis=-1).reshape(-1, 3)
    position = np.concatenate([grid] * len(sides))
    normal = np.repeat(np.stack([0 * sides, sides, 0 * sides], axis=1), len(grid), axis=0)
    return Points(position + 1e-3 * normal, normal, np.zeros(len(position)))


@dataclass(frozen=True)
class Cells:
    """Points of all cells: first the office's, then the fabric's two sides (towards +y, then -y),
    or the facade's; and a tree of the office's.
    """

    points: Points
    office: int
    tree: Any

    def at(self, found: Points) -> NDArray[np.intp]:
        return self.tree.query(np.concatenate((found.position, 0.5 * found.normal), axis=1))[1]

    def plane_at(self, at: Array) -> NDArray[np.intp]:
        """Index within one side of the plane's cells."""
        side = self.points.position[self.office :]
        from scipy.spatial import cKDTree

        n = len(side) // 2 if (self.points.normal[self.office :, 1] > 0).any() else len(side)
        return cKDTree(side[:n][:, ::2]).query(at[:, ::2])[1]


def cells_of(scene: Scene, eyes: Array, rng: np.random.Generator) -> Cells:
    from scipy.spatial import cKDTree

    starts = [
        *eyes,
        *([0.0, -scene.outward * y, z] for y in (0.4, 3.0, 5.5) for z in (0.4, 1.5, 2.9)),
    ]
    starts += [[x, scene.outward * 3.0, 1.0] for x in (-2.0, 2.0)]
    rays = rng.normal(size=(12000 * len(starts), 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    length, found = first_hit(scene, np.repeat(np.array(starts, float), 12000, axis=0), rays)
    hit = length < FAR_M
    position, normal, rho = found.position[hit], found.normal[hit], found.reflectance[hit]
    key = np.concatenate((np.round(position / CELL_M), np.round(normal)), axis=1).astype(int)
    _, inverse, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    middle = (
        np.stack([np.bincount(inverse, position[:, k]) for k in range(3)], axis=1) / count[:, None]
    )
    away = ((position - middle[inverse]) ** 2).sum(axis=1)
    order = np.lexsort((away, inverse))
    pick = order[np.concatenate([[0], np.cumsum(count)[:-1]])]
    office = Points(position[pick], normal[pick], rho[pick])
    extra: list[Points] = []
    if scene.fabric:
        extra.append(_plane_cells(FABRIC, 0.25, np.array([1.0, -1.0])))
    if scene.mirror:
        extra.append(_plane_cells((6.01, *MIRROR[1:]), 1.0, np.array([-1.0])))
    merged = Points(
        np.concatenate([office.position, *(e.position for e in extra)]),
        np.concatenate([office.normal, *(e.normal for e in extra)]),
        np.concatenate([office.reflectance, *(e.reflectance for e in extra)]),
    )
    tree = cKDTree(np.concatenate((office.position, 0.5 * office.normal), axis=1))
    return Cells(merged, len(pick), tree)


# ----------------------------------------------------------------------------------------------
# daylight coefficients


@dataclass(frozen=True)
class Seen:
    """What rays see, as triples: ray, column, weight. Columns of `sky`: patches, open ground at the
    end; of `cells`: irradiance of cells, with reflectance / pi in the weight. hits: rays that end
    on the office, with the weight of the glass.
    """

    sky: tuple[Array, Array, Array]
    cells: tuple[Array, Array, Array]
    escaped: tuple[Array, Array, Array]  # ray, direction [m, 3], weight
    hits: tuple[NDArray[np.intp], Points, Array]


def follow(scene: Scene, cells: Cells, origin: Array, ray: Array, patches: Any) -> Seen:
    """Follow rays through glass and fabric, off the facade, to office, ground or sky."""
    length, found = first_hit(scene, origin, ray)
    weight = pane_share(scene, origin, ray, length)
    index = np.arange(len(ray))
    cell_parts: list[tuple[Array, Array, Array]] = []
    if scene.fabric:
        at, crosses = rectangle(FABRIC, origin, ray, length)
        rows = np.flatnonzero(crosses)
        n = (len(cells.points.position) - cells.office) // 2
        near = cells.plane_at(at[rows])
        before = np.where(origin[rows, 1] < 0, weight[rows], 1.0)  # the pane is on the way there
        own = np.where(ray[rows, 1] < 0, 0, n)  # side towards +y is seen by rays that go to -y
        for offset, share in ((own, FABRIC_REFLECTS), (n - own, FABRIC_SCATTERS)):
            cell_parts.append((rows, cells.office + offset + near, before * share / np.pi))
        weight[rows] *= fabric_through(ray[rows, 1])
    if scene.mirror:
        at, crosses = rectangle(MIRROR, origin, ray, length)
        rows = np.flatnonzero(crosses)
        through, back = glass(ray[rows, 1])
        near = cells.plane_at(at[rows])
        cell_parts.append(
            (rows, cells.office + near, weight[rows] * through * DIFFUSE_TN * BEHIND_MIRROR / np.pi)
        )
        turned = ray[rows] * np.array([1.0, -1.0, 1.0])
        start = at[rows] - np.array([0.0, 1e-3, 0.0])
        again, second = first_hit(scene, start, turned)
        length, weight, ray = length.copy(), weight.copy(), ray.copy()
        length[rows], ray[rows] = again, turned
        weight[rows] *= back * pane_share(scene, start, turned, again)
        for name in ("position", "normal", "reflectance"):
            getattr(found, name)[rows] = getattr(second, name)
    on = np.flatnonzero(length < FAR_M)
    points = Points(found.position[on], found.normal[on], found.reflectance[on])
    cell_parts.append((on, cells.at(points), weight[on] * points.reflectance / np.pi))
    off = np.flatnonzero(length >= FAR_M)
    up = ray[off, 2] > 0
    column = np.full(len(off), len(patches.directions))
    column[up] = patches.tree.query(ray[off[up]])[1]
    sky = (off, column, weight[off])
    merged = tuple(np.concatenate([part[k] for part in cell_parts]) for k in range(3))
    return Seen(sky, merged, (off, ray[off], weight[off]), (index[on], points, weight[on]))  # type: ignore[arg-type]


@dataclass(frozen=True)
class Patches:
    directions: Array
    tree: Any


def sky_patches() -> Patches:
    from scipy.spatial import cKDTree

    directions = np.asarray(reinhart_patches().directions, float)
    return Patches(directions, cKDTree(directions))


def csr(triple: tuple[Array, Array, Array], shape: tuple[int, int]) -> Any:
    from scipy.sparse import csr_matrix

    rows, columns, weight = triple
    return csr_matrix((weight.astype(np.float32), (rows, columns)), shape)


def hemispheres(normal: Array, rays: int, rng: np.random.Generator) -> Array:
    """Cosine-weighted directions on a grid turned at random for each normal, [n, rays, 3]."""
    side = int(np.sqrt(rays))
    grid = (np.stack(np.meshgrid(np.arange(side), np.arange(side)), -1).reshape(-1, 2) + 0.5) / side
    shifted = (grid[None] + rng.random((len(normal), 1, 2))) % 1.0
    radius, turn = np.sqrt(shifted[..., 0]), 2 * np.pi * shifted[..., 1]
    helper = np.where(np.abs(normal[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
    across = np.cross(helper, normal)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    up = np.cross(normal, across)
    local = np.stack(
        [radius * np.cos(turn), radius * np.sin(turn), np.sqrt(1 - shifted[..., 0])], -1
    )
    return np.einsum("nka,nax->nkx", local, np.stack([across, up, normal], axis=1))


def coefficients(scene: Scene, cells: Cells, patches: Patches, rng: np.random.Generator) -> Any:
    """Irradiance at cells per luminance of sky columns [c, 2306] and per irradiance of cells
    [c, c], in lx per cd/m2 and lx per lx."""
    from scipy.sparse import vstack

    side = int(np.sqrt(GATHER_RAYS)) ** 2
    skies, others, count = [], [], len(cells.points.position)
    for first in range(0, count, 500):
        part = slice(first, first + 500)
        normal = cells.points.normal[part]
        rays = hemispheres(normal, GATHER_RAYS, rng).reshape(-1, 3)
        origin = np.repeat(cells.points.position[part] + 2e-3 * normal, side, axis=0)
        seen = follow(scene, cells, origin, rays, patches)
        for triple, parts, width in (
            (seen.sky, skies, len(patches.directions) + 1),
            (seen.cells, others, count),
        ):
            rows, columns, weight = triple
            parts.append(csr((rows // side, columns, weight * np.pi / side), (len(normal), width)))
    return vstack(skies, format="csr"), vstack(others, format="csr")
