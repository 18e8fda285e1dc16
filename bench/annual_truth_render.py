"""Render the office of raytraverse's validation set (base1compdv) at every hour of its reference.

    python bench/annual_truth_render.py FOLDER OUT [--height 90] [--scenes 01_glz,03_shd,05_ngl]

FOLDER is `validations/base1compdv` of github.com/stephanwaz/raytraverse (MPL-2.0), with the files
RAD/, options/, POINTS/, refs/ and refrt/. OUT/SCENE_vK.npz gets, for each view, panoramas without
the sun's disc, their direct-sun part and the discs (see `View`); bench/annual_truth.py reads them.

Radiance's rtrace finds what each ray hits, and who casts shadows. Glass, the fabric and the glass
facade opposite are planes whose formulas (m_glass.c, the fabric's .cal) are evaluated here, so that
their specular parts are exact. Surfaces are cut into cells of 0.15 m; rays gathered at the cells
give one sparse matrix of daylight coefficients for sky (2 305 Reinhart patches, open ground) and
for interreflection, which is iterated to convergence. The sun's direct light is exact at every
pixel and cell, with the sun's vector of each hour.
"""

from __future__ import annotations

import argparse
import csv
import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.light import Light
from fieldlum.scene.sun_disc import disc_rays
from fieldlum.scene.view import pixel_rays
from fieldlum.sky import reinhart_patches

Array = NDArray[np.float64]
CELL_M = 0.15
GATHER_RAYS = 400
FAR_M = 1e6
YEAR = 2027  # of the labels only; the sun's vectors are the reference's own
UTC_OFFSET_H = 1.0  # of the weather file
TN = 0.763  # transmissivity of the panes (options/*.rad), transmittance 0.7
PANES_X = ((-1.345, -0.03), (0.03, 1.345))
PANES_Z = ((0.0, 0.94), (1.0, 1.94), (2.0, 3.2))
FABRIC = (0.05, 1.3, 0.95, 3.2)  # y, half width, lower and upper edge (options/fabric.rad) [m]
FABRIC_TAU, FABRIC_REFLECTS, FABRIC_SCATTERS, FABRIC_CUT_DEG = 0.03, 0.1, 0.02, 75.0
MIRROR = (6.0, 6.0, -0.05, 20.0)  # the same for the glass facade (options/north_glass.rad)
BEHIND_MIRROR = 0.03  # reflectance of the wall behind the glass facade
DIFFUSE_TN = 0.62  # hemispherical transmittance of the glass facade, to 5 %: its share is small


@dataclass(frozen=True)
class Scene:
    """Name, sign of y towards the window's outside, and which of the two planes it has."""

    name: str
    outward: int
    fabric: bool
    mirror: bool
    octree: Path

    @property
    def glass_y(self) -> float:
        return 0.1 * self.outward


@dataclass(frozen=True)
class Points:
    """Surface points: position, normal towards the viewer, reflectance, [n, ...]."""

    position: Array
    normal: Array
    reflectance: Array


SCENES = {
    "01_glz": ("office", -1, False, False),
    "03_shd": ("office", -1, True, False),
    "05_ngl": ("office_n", 1, False, True),
}


# ----------------------------------------------------------------------------------------------
# optics of the planes


def glass(cosine: Array) -> tuple[Array, Array]:
    """Transmittance and reflectance of a pane, as Radiance's m_glass.c computes them (n = 1.52)."""
    c1 = np.clip(np.abs(cosine), 1e-6, 1.0)
    c2 = np.sqrt(1.0 - (1.0 - c1**2) / 1.52**2)
    inside = TN ** (1.0 / c2)
    through, back = np.zeros_like(c1), np.zeros_like(c1)
    for r in (
        ((c1 - 1.52 * c2) / (c1 + 1.52 * c2)) ** 2,
        ((c2 - 1.52 * c1) / (c2 + 1.52 * c1)) ** 2,
    ):
        through += 0.5 * (1 - r) ** 2 * inside / (1 - r**2 * inside**2)
        back += 0.5 * r * (1 + (1 - 2 * r) * inside**2) / (1 - r**2 * inside**2)
    return through, back


def fabric_through(cosine: Array) -> Array:
    """Direct transmittance of the fabric: tau(0.03, 4, 2.9, 75) of roos_fabric.cal."""
    p, q, a = 4.0, 2.9, 8.0
    z0 = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0)) * 0.636619772368
    b = 0.25 / q
    z = z0 + 1.0 - FABRIC_CUT_DEG / 90.0
    gamma = (5.26 + 0.06 * p) + (0.73 + 0.04 * p) * q
    fall = a * z ** (5.2 + 0.7 * q) + b * z**2 + (1 - a - b) * z**gamma
    return np.where(z0 < FABRIC_CUT_DEG / 90.0, FABRIC_TAU * np.maximum(1.0 - fall, 0.0), 0.0)


def _at_plane(
    origin: Array, ray: Array, y: float, length: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Distance to the plane at y, and whether the ray crosses it before its end."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (y - origin[:, 1]) / ray[:, 1]
    ok = np.isfinite(t) & (t > 1e-6) & (t < length)
    return np.where(ok, t, 0.0), ok


def pane_share(scene: Scene, origin: Array, ray: Array, length: Array) -> Array:
    """Glass on the way, [n]: the panes' transmittance where they are crossed, else 1."""
    t, crosses = _at_plane(origin, ray, scene.glass_y, length)
    at = origin + ray * t[:, None]
    x_ok = np.zeros(len(ray), bool)
    z_ok = np.zeros(len(ray), bool)
    for low, high in PANES_X:
        x_ok |= (at[:, 0] > low) & (at[:, 0] < high)
    for low, high in PANES_Z:
        z_ok |= (at[:, 2] > low) & (at[:, 2] < high)
    return np.where(crosses & x_ok & z_ok, glass(ray[:, 1])[0], 1.0)


def _rectangle(
    plane: tuple[float, float, float, float], origin: Array, ray: Array, length: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Points where rays cross an upright rectangle, and whether they do."""
    y, half, low, high = plane
    t, crosses = _at_plane(origin, ray, y, length)
    at = origin + ray * t[:, None]
    return at, crosses & (np.abs(at[:, 0]) < half) & (at[:, 2] > low) & (at[:, 2] < high)


# ----------------------------------------------------------------------------------------------
# rtrace


def opaque_text(folder: Path, model: str) -> str:
    """The office without its panes."""
    text = (folder / "RAD" / f"{model}.rad").read_text()
    return re.sub(
        r"^wg\w+Mat polygon \S+\s+0\s+0\s+12\s+(?:[-\d.eE+]+\s+){12}", "", text, flags=re.M
    )


@contextmanager
def opened(folder: Path, name: str) -> Iterator[Scene]:
    import pyradiance

    model, outward, fabric, mirror = SCENES[name]
    with tempfile.TemporaryDirectory() as work:
        rad, octree = Path(work) / "scene.rad", Path(work) / "scene.oct"
        rad.write_text(opaque_text(folder, model))
        octree.write_bytes(pyradiance.oconv(rad, warning=False))
        yield Scene(name, outward, fabric, mirror, octree)


def first_hit(scene: Scene, origin: Array, ray: Array) -> tuple[Array, Points]:
    """Length [n] of each ray (1e10: none) and what it hits (reflectance by -av 1)."""
    import pyradiance

    rays = np.concatenate((origin, ray), axis=1).astype("<f4").tobytes()
    params = ["-ab", "0", "-av", "1", "1", "1", "-aw", "0", "-lr", "1", "-w-"]
    answer = pyradiance.rtrace(
        rays, scene.octree, header=False, inform="f", outform="f", outspec="LpNv", params=params
    )
    found = np.frombuffer(answer, "<f4").reshape(-1, 10).astype(float)
    normal = found[:, 4:7]
    normal = np.where((normal * ray).sum(axis=1, keepdims=True) > 0, -normal, normal)
    return found[:, 0], Points(found[:, 1:4], normal, found[:, 8])


def clear_way(scene: Scene, origin: Array, ray: Array) -> NDArray[np.bool_]:
    if not len(origin):
        return np.zeros(0, bool)
    return first_hit(scene, origin, ray)[0] > FAR_M


# ----------------------------------------------------------------------------------------------
# direct sun


def sun_share(scene: Scene, points: Points, suns: Array) -> Array:
    """Irradiance at points [n] per normal irradiance of each sun [h, 3], by the sky's sun and by
    its image in the glass facade: [h, n].
    """
    out = np.zeros((len(suns), len(points.position)), np.float32)
    lifted = points.position + 1e-3 * points.normal
    for image in (False, True)[: 2 if scene.mirror else 1]:
        toward = suns * np.array([1.0, -1.0 if image else 1.0, 1.0])
        jobs: list[tuple[int, NDArray[np.intp]]] = []
        for k, s in enumerate(toward):
            if s[2] <= 0 or (image and s[1] <= 0):
                continue
            rows = np.flatnonzero((points.normal @ s > 0) & _may_see(scene, lifted, s))
            if len(rows):
                jobs.append((k, rows))
        for first in range(0, len(jobs), 100):
            part = jobs[first : first + 100]
            rows = np.concatenate([r for _, r in part])
            hour = np.concatenate([np.full(len(r), k) for k, r in part])
            seen = _sun_through(scene, lifted[rows], toward[hour], image)
            cosine = (points.normal[rows] * toward[hour]).sum(axis=1)
            np.add.at(out, (hour, rows), seen * cosine)
    return out


def _may_see(scene: Scene, position: Array, s: Array) -> NDArray[np.bool_]:
    """Points outside the room, and those inside from which the way to the sun leaves by the
    window's opening."""
    inside = position[:, 1] * scene.outward < -1e-3
    if s[1] * scene.outward <= 0:
        return ~inside
    t = -position[:, 1] / s[1]
    x, z = position[:, 0] + t * s[0], position[:, 2] + t * s[2]
    return ~inside | ((np.abs(x) < 1.5) & (z > -0.1) & (z < 3.4))


def _sun_through(scene: Scene, origin: Array, ray: Array, image: bool) -> Array:
    """Share of the sun's light that arrives at each point along each way, [n]."""
    far = np.full(len(ray), FAR_M)
    share = pane_share(scene, origin, ray, far)
    if scene.fabric:
        _, crosses = _rectangle(FABRIC, origin, ray, far)
        share = np.where(crosses, share * fabric_through(ray[:, 1]), share)
    if not scene.mirror:
        return np.where(clear_way(scene, origin, ray), share, 0.0)
    at, crosses = _rectangle(MIRROR, origin, ray, far)
    if not image:  # the facade itself, black from behind, hides what is beyond
        return np.where(~crosses & clear_way(scene, origin, ray), share, 0.0)
    ok = crosses & clear_way(scene, origin, ray)
    back = ray * np.array([1.0, -1.0, 1.0])
    ok[ok] = clear_way(scene, at[ok] - np.array([0.0, 1e-3, 0.0]), back[ok])
    return np.where(ok, share * glass(ray[:, 1])[1], 0.0)


# ----------------------------------------------------------------------------------------------
# cells


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
        at, crosses = _rectangle(FABRIC, origin, ray, length)
        rows = np.flatnonzero(crosses)
        n = (len(cells.points.position) - cells.office) // 2
        near = cells.plane_at(at[rows])
        before = np.where(origin[rows, 1] < 0, weight[rows], 1.0)  # the pane is on the way there
        own = np.where(ray[rows, 1] < 0, 0, n)  # side towards +y is seen by rays that go to -y
        for offset, share in ((own, FABRIC_REFLECTS), (n - own, FABRIC_SCATTERS)):
            cell_parts.append((rows, cells.office + offset + near, before * share / np.pi))
        weight[rows] *= fabric_through(ray[rows, 1])
    if scene.mirror:
        at, crosses = _rectangle(MIRROR, origin, ray, length)
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


def _csr(triple: tuple[Array, Array, Array], shape: tuple[int, int]) -> Any:
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
            parts.append(_csr((rows // side, columns, weight * np.pi / side), (len(normal), width)))
    return vstack(skies, format="csr"), vstack(others, format="csr")


# ----------------------------------------------------------------------------------------------
# hours


@dataclass(frozen=True)
class Hours:
    """Hours of the reference, then further daylight hours of the weather file; suns [n, 3]."""

    ann_hour: NDArray[np.int64]
    reference: int
    suns: Array
    light: Light


def read_hours(folder: Path) -> Hours:
    """All daylight hours: the reference's with its own sun vectors and irradiance, the others
    from the weather file with the sun of fieldlum at the hour's middle."""
    from fieldlum import sun
    from fieldlum.records import Site

    sky = np.loadtxt(folder / "refs" / "skydata.txt")
    with (folder / "refs" / "geneva.epw").open(encoding="latin-1") as file:
        rows = list(csv.reader(file))[8:]
    dni, dhi = (np.array([float(row[k]) for row in rows]) for k in (14, 15))
    start = datetime(YEAR, 1, 1, 0, 30, tzinfo=UTC) - timedelta(hours=UTC_OFFSET_H)
    times = [start + timedelta(hours=k) for k in range(8760)]
    found = sun.position(times, Site("Geneva", 46.25, 6.13, "Europe/Zurich", 416.0))
    vectors = np.asarray(sun.direction(found.altitude_deg, found.azimuth_deg), float)
    own = sky[:, 4] > 0
    vectors[own] = sky[own, :3] / np.linalg.norm(sky[own, :3], axis=1, keepdims=True)
    dni[own], dhi[own] = sky[own, 3], sky[own, 4]
    rest = ~own & (vectors[:, 2] > np.sin(np.radians(1.0))) & (dhi > 0)
    index = np.concatenate((np.flatnonzero(own), np.flatnonzero(rest)))
    suns = vectors[index]
    light = Light(
        t_utc=tuple(times[k] for k in index),
        dni_wm2=dni[index],
        dhi_wm2=dhi[index],
        sun_altitude_deg=np.degrees(np.arcsin(suns[:, 2])),
        sun_azimuth_deg=np.degrees(np.arctan2(suns[:, 0], suns[:, 1])) % 360.0,
        refraction=False,
    )
    return Hours(index, int(own.sum()), suns, light)


def chosen_hours(hours: Hours, count: int = 200, seed: int = 0) -> dict[str, NDArray[np.intp]]:
    """Rows of the 9-day set (three days around the March equinox and each solstice) and of an even
    set (k-means over sun and sky) of daylight hours."""
    from fieldlum.plan.choose import medoids

    day = np.array([t.strftime("%m%d") for t in hours.light.t_utc])
    nine = np.isin(
        day,
        [f"{m}{d}" for m, d0 in (("03", 19), ("06", 20), ("12", 20)) for d in range(d0, d0 + 3)],
    )
    points = np.column_stack(
        (hours.suns / 2, hours.light.dni_wm2 / 1000, hours.light.dhi_wm2 / 500)
    )
    even = medoids(points, count, np.random.default_rng(seed))
    return {"9-day": np.flatnonzero(nine), "even": np.sort(even)}


# ----------------------------------------------------------------------------------------------
# pictures


def render_view(
    scene: Scene,
    cells: Cells,
    patches: Patches,
    eye: Array,
    heading_deg: float,
    height: int,
    hours: Hours,
    rows: NDArray[np.intp],
    irradiance: NDArray[np.float32],
    path: Path,
) -> None:
    """Write the maps of one view; irradiance [cells, n] of all cells without the sun's direct part
    for the office's."""
    light, suns, n = hours.light[rows], hours.suns[rows], len(rows)
    pixel, rays = pixel_rays(height, heading_deg, 2)
    sub = 4.0
    seen = follow(scene, cells, np.broadcast_to(eye, rays.shape).astype(float), rays, patches)
    shape = (2 * height**2, irradiance.shape[0])
    to_pixels = _csr((pixel[seen.cells[0].astype(int)], seen.cells[1], seen.cells[2] / sub), shape)
    maps = np.ascontiguousarray((to_pixels @ irradiance).T)
    at, points, weight = seen.hits
    share = sun_share(scene, points, suns)
    to_patch = _csr(
        (pixel[at], np.arange(len(at)), weight * points.reflectance / np.pi / sub),
        (shape[0], len(at)),
    )
    patch = np.ascontiguousarray((to_patch @ share.T).T) * light.direct_lx[:, None].astype(
        np.float32
    )
    maps += patch
    off, escaped, through = seen.escaped
    above = escaped[:, 2] > 0
    for block in range(0, n, 50):
        part = slice(block, min(block + 50, n))
        bright = np.repeat(light[part].sky.ground_cdm2[:, None], len(off), axis=1)
        bright[:, above] = light[part].sky_at(escaped[above])
        for k, row in enumerate(bright):
            maps[block + k] += np.bincount(pixel[off], row * through / sub, shape[0])
    disc, image = np.zeros(n), np.zeros(n)
    for k in range(n):
        for out, turned in ((disc, False), (image, True)):
            if suns[k, 2] <= 0 or (turned and (not scene.mirror or suns[k, 1] >= 0)):
                continue
            ways = disc_rays(suns[k] * np.array([1.0, -1.0 if turned else 1.0, 1.0]), 2)
            origin = np.broadcast_to(eye, ways.shape).astype(float)
            out[k] = _sun_through(scene, origin, ways, turned).mean() * light.direct_lx[k]
    np.savez(
        path,
        maps=maps.reshape(n, height, 2 * height).astype(np.float32),
        patch=patch.reshape(n, height, 2 * height).astype(np.float32),
        disc_lx=disc,
        image_lx=image,
        rows=rows,
    )


def render_scene(folder: Path, out: Path, name: str, height: int) -> None:
    hours, patches = read_hours(folder), sky_patches()
    sets = chosen_hours(hours)
    rows = np.unique(np.concatenate((np.arange(hours.reference), *sets.values())))
    views = np.loadtxt(folder / "POINTS" / ("sensors_n.txt" if name == "05_ngl" else "sensors.txt"))
    rng = np.random.default_rng(0)
    with opened(folder, name) as scene:
        cells = cells_of(scene, views[:, :3], rng)
        print(name, "cells", len(cells.points.position), "hours", len(rows), flush=True)
        from_sky, from_cells = coefficients(scene, cells, patches, rng)
        print(name, "coefficients", from_sky.nnz, from_cells.nnz, flush=True)
        light = hours.light[rows]
        sky = np.concatenate((light.sky_cdm2, light.sky.ground_cdm2[:, None]), axis=1).T
        by_sky = (from_sky @ sky.astype(np.float32)).astype(np.float32)
        by_sun = sun_share(scene, cells.points, hours.suns[rows]).T
        by_sun = by_sun * light.direct_lx.astype(np.float32)
        print(name, "sun on cells", flush=True)
        first = by_sky + by_sun
        total = first
        for _ in range(7):
            total = first + from_cells @ total
        indirect = total.copy()
        indirect[: cells.office] -= by_sun[: cells.office]  # exact at each pixel instead
        for k, view in enumerate(views, start=1):
            heading = float(np.degrees(np.arctan2(view[3], view[4])) % 360.0)
            path = out / f"{name}_v{k}.npz"
            render_view(
                scene, cells, patches, view[:3], heading, height, hours, rows, indirect, path
            )
            print(path, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--height", type=int, default=90)
    parser.add_argument("--scenes", default="01_glz,03_shd,05_ngl")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.scenes.split(","):
        render_scene(options.folder, options.out, name, options.height)


if __name__ == "__main__":
    main()
