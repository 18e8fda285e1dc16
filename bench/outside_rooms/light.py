"""Light of every hour on what a panorama shows, by paths that all hours share.

A `Record` is the part of one coarse pixel that shows one material from one side. Paths give its
mean light; the fine picture is reflectance times the records' light, plus the sky seen directly
through glass and open air, plus direct sun with exact shadows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rooms import Place
from scipy import sparse
from skies import SUN_RADIUS_RAD, Hour, directions, patch_directions, patch_index, sky_cdm2
from tracer import World, lifted

Array = NDArray[Any]

COARSE = 58  # rows of the coarse picture
FINE = 8  # fine pixels along each side of a coarse one
GRID = 2  # rays along each side of a fine pixel, in each round
PATCH_ROWS = 16
DEPTH = 10  # surfaces of a path
_CELL_POINTS = 12
_LEAST_REFLECTANCE = 0.02
_DISC_RAYS = 2048
_SIDES = 7


def to_room(rays: Array, place: Place) -> Array:
    """Turn directions [..., 3] of the world into the room's axes."""
    turn = np.radians(place.wall_azimuth_deg - 180.0)
    x, y, z = rays[..., 0], rays[..., 1], rays[..., 2]
    return np.stack(
        [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), z], -1
    )


def to_world(rays: Array, place: Place) -> Array:
    """Turn directions [..., 3] of the room into the world's axes."""
    turn = np.radians(180.0 - place.wall_azimuth_deg)
    x, y, z = rays[..., 0], rays[..., 1], rays[..., 2]
    return np.stack(
        [x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn), z], -1
    )


def solid_angles(rows: int) -> Array:
    """Return the solid angle [rows] of one pixel of an equirectangular picture."""
    edge = np.sin(np.radians(np.linspace(90, -90, rows + 1)))
    return (edge[:-1] - edge[1:]) * np.pi / rows


@dataclass
class View:
    """The rays of one round, and what they meet first. Arrays [n], in order of fine pixels."""

    place: Place
    rays: Array
    pixel: Array  # fine pixel
    u: Array  # coarse column and row, in pixels
    v: Array

    @property
    def coarse(self) -> Array:
        return (self.v.astype(int)) * 2 * COARSE + self.u.astype(int)


def view_of(place: Place, rng: np.random.Generator) -> View:
    """Return jittered rays of the camera in the room's axes."""
    rows = COARSE * FINE * GRID
    j, i = np.meshgrid(np.arange(2 * rows), np.arange(rows))
    i, j = i.ravel(), j.ravel()
    v = (i + rng.random(len(i))) / (FINE * GRID)
    u = (j + rng.random(len(i))) / (FINE * GRID)
    azimuth = place.heading_deg + (u / (2 * COARSE) - 0.5) * 360
    rays = to_room(directions(90 - v / COARSE * 180, azimuth), place)
    pixel = (i // GRID) * (2 * COARSE * FINE) + j // GRID
    return View(place, rays, pixel, u, v)


def side_of(normal: Array) -> Array:
    """Return 0 to 5 for the axis and the sign that a normal [n, 3] is nearest to."""
    axis = np.abs(normal).argmax(1)
    return axis * 2 + (np.take_along_axis(normal, axis[:, None], 1)[:, 0] > 0)


class Cells:
    """Sunlight on pieces of surface, for every hour. lux: [cells, hours].

    Pieces are 0.25 m indoors, and outdoors from 1 m on, larger with distance.
    """

    def __init__(self, world: World, place: Place, hours: Sequence[Hour]) -> None:
        self.world, self.place = world, place
        self.keys = np.zeros(0, np.int64)
        self.suns = suns_of(place, hours)  # [hours, 3]
        self.lux = np.zeros((0, len(hours)), np.float32)
        self.normal_lx = np.array([h.normal_lx for h in hours])
        self.rng = np.random.default_rng(1)

    def index(self, point: Array, normal: Array) -> Array:
        """Return the cell of each point on the side of its normal; unknown cells are computed."""
        inside = indoors(point, self.place)
        away = np.abs(point - self.place.camera).max(1)
        level = np.where(inside, 0, 2 + np.floor(np.log2(np.maximum(away / 6, 1)))).astype(np.int64)
        grid = np.floor(point / (0.25 * 2.0**level)[:, None]).astype(np.int64)
        grid = np.clip(grid, -250, 250) + 256
        key = ((grid[:, 0] * 512 + grid[:, 1]) * 512 + grid[:, 2]) * 256
        key += side_of(normal) * 32 + level * 2 + inside
        new = ~np.isin(key, self.keys)
        if new.any():
            self._add(key[new], point[new], normal[new])
        return np.searchsorted(self.keys, key)

    def _add(self, key: Array, point: Array, normal: Array) -> None:
        keys, which = np.unique(key, return_inverse=True)
        order = np.lexsort((self.rng.random(len(which)), which))
        first = np.searchsorted(which[order], np.arange(len(keys)))
        rank = np.arange(len(which)) - first[which[order]]
        chosen = order[rank < _CELL_POINTS]
        count = np.bincount(which[chosen], minlength=len(keys))
        lux = np.zeros((len(keys), len(self.suns)), np.float32)
        start = lifted(point[chosen], normal[chosen])
        for h in np.flatnonzero(self.normal_lx > 0):
            sun = jittered(self.suns[h], len(start), self.rng)
            cos = np.maximum((sun * normal[chosen]).sum(1), 0)
            light = np.zeros(len(start))
            lit = np.flatnonzero(cos > 0)
            light[lit] = sunlight(self.world, self.place, start[lit], sun[lit]) * cos[lit]
            lux[:, h] = np.bincount(which[chosen], light, len(keys)) / count * self.normal_lx[h]
        merged = np.concatenate([self.keys, keys])
        order = merged.argsort()
        self.keys, self.lux = merged[order], np.concatenate([self.lux, lux])[order]


def suns_of(place: Place, hours: Sequence[Hour]) -> Array:
    """Return the sun's direction [hours, 3] in the room's axes, as a camera sees it."""
    altitude = np.array([h.apparent_deg for h in hours])
    azimuth = np.array([h.azimuth_deg for h in hours])
    return to_room(directions(altitude, azimuth), place)


def indoors(point: Array, place: Place) -> Array:
    w, d, h = place.size
    return ((point > -0.02) & (point < np.array([w, d, h]) + 0.02)).all(1)


def jittered(sun: Array, count: int, rng: np.random.Generator) -> Array:
    """Return directions [count, 3] that are uniform over the sun's disc."""
    a = np.cross(sun, [0.0, 0.0, 1.0])
    a /= np.linalg.norm(a)
    b = np.cross(sun, a)
    radius = np.sqrt(rng.random(count)) * np.tan(SUN_RADIUS_RAD)
    angle = rng.random(count) * 2 * np.pi
    rays = sun + (radius * np.cos(angle))[:, None] * a + (radius * np.sin(angle))[:, None] * b
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def sunlight(world: World, place: Place, start: Array, sun: Array) -> Array:
    """Return the share [n] of the sun's light that reaches points through air and glass."""
    share, crossed = world.glass(start, sun, np.inf)
    asked = np.flatnonzero(crossed | ~indoors(start, place))
    out = np.zeros(len(start))
    if len(asked):
        out[asked] = share[asked] * world.clear(start[asked], sun[asked])
    return out


@dataclass
class First:
    """What the camera's rays meet first, summed over rounds.

    openness, sky: share of each fine pixel that shows the sky, and the same times the glass.
    sunlit [hours]: direct sunlight on surfaces [fine pixels], cd/m2, sparse.
    """

    openness: Array
    sky: Array
    keys: list[Array] = field(default_factory=list)
    weight: list[Array] = field(default_factory=list)


class Renderer:
    """Renders the hours of a place.

    rounds: of 256 camera rays for each coarse pixel; paths: likewise of paths; smoothing: weight of
    the light in the next coarse pixel.
    """

    def __init__(
        self, place: Place, hours: Sequence[Hour], rounds: int, paths: int, smoothing: float = 0.5
    ) -> None:
        self.place, self.hours, self.smoothing = place, hours, smoothing
        self.rounds, self.paths = rounds, paths
        self.world = World(place.groups, place.panes)
        self.pixels = 2 * (COARSE * FINE) ** 2
        self.eye = np.asarray(place.camera, float)
        self.cells = Cells(self.world, place, hours)
        patches, self.bands = patch_directions(PATCH_ROWS)
        self.patch_cdm2 = np.stack([sky_cdm2(h, patches) for h in hours], 1)  # [patches, hours]

    # ---- what the camera sees

    def first(self) -> First:
        """Trace the camera's rays of all rounds."""
        first = First(np.zeros(self.pixels), np.zeros(self.pixels))
        share = 1 / (self.rounds * GRID**2)
        for k in range(self.rounds):
            view = view_of(self.place, np.random.default_rng(100 + k))
            origin = np.broadcast_to(self.eye, view.rays.shape)
            hits = self.world.hit(origin, view.rays, np.random.default_rng(200 + k))
            glass, _ = self.world.glass(
                origin, view.rays, np.where(hits.valid, hits.distance, np.inf)
            )
            up = ~hits.valid & (view.rays[:, 2] > 0)
            first.openness += np.bincount(view.pixel[up], minlength=self.pixels) * share
            first.sky += np.bincount(view.pixel[up], glass[up], self.pixels) * share
            key = np.where(hits.valid, self._key(view.coarse, hits.group, hits.normal), -1)
            first.keys.append(key)
            albedo = np.maximum(hits.reflectance, _LEAST_REFLECTANCE)
            first.weight.append(np.where(hits.valid, glass * albedo * share, 0.0))
        return first

    def _key(self, coarse: Array, group: Array, normal: Array) -> Array:
        return (coarse.astype(np.int64) * len(self.world.groups) + group) * _SIDES + side_of(normal)

    def records(self, first: First) -> Array:
        """Return the sorted keys of all records."""
        keys = np.unique(np.concatenate([np.unique(k) for k in first.keys]))
        return keys[keys >= 0]

    def spread(self, first: First, keys: Array, *, smooth: bool) -> sparse.csr_matrix:
        """Return the matrix [fine pixels, records] of reflectance times share.

        smooth: interpolate between the records of four coarse pixels with the same surface.
        """
        total = sparse.csr_matrix((self.pixels, len(keys)), dtype=np.float32)
        codes = len(self.world.groups) * _SIDES
        for k in range(self.rounds):
            view = view_of(self.place, np.random.default_rng(100 + k))
            valid = np.flatnonzero(first.keys[k] >= 0)
            code = first.keys[k][valid] % codes
            nearest = [(view.coarse[valid], 1.0)]
            places = _corners(view.u[valid], view.v[valid]) if smooth else nearest
            column, share = [], []
            for coarse, part in places:
                key = coarse.astype(np.int64) * codes + code
                at = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
                column.append(at)
                share.append(np.where(keys[at] == key, part, 0.0))
            scale = first.weight[k][valid] / np.maximum(sum(share), 1e-12)
            for at, part in zip(column, share, strict=True):
                total += sparse.csr_matrix(
                    ((part * scale).astype(np.float32), (view.pixel[valid], at)), total.shape
                )
        return total

    # ---- light of the records

    def light(self, keys: Array) -> Array:
        """Return light over reflectance [records, hours] by paths, without direct sun."""
        total = np.zeros((len(keys), len(self.hours)))
        count = np.zeros(len(keys))
        for k in range(self.paths):
            view = view_of(self.place, np.random.default_rng(500 + k))
            self._paths(view, keys, total, count, np.random.default_rng(900 + k))
        return self._smoothed(keys, total, count)

    def _smoothed(self, keys: Array, total: Array, count: Array) -> Array:
        """Return the mean over paths of each record and of the same surface in pixels around it."""
        codes = len(self.world.groups) * _SIDES
        coarse, code = np.divmod(keys, codes)
        row, column = np.divmod(coarse, 2 * COARSE)
        near = sparse.identity(len(keys), format="csr")
        for di, dj in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1)):
            inside = (row + di >= 0) & (row + di < COARSE)
            other = ((row + di) * 2 * COARSE + (column + dj) % (2 * COARSE)) * codes + code
            at = np.minimum(np.searchsorted(keys, other), len(keys) - 1)
            k = np.flatnonzero(inside & (keys[at] == other))
            part = np.full(len(k), self.smoothing ** (di * di + dj * dj))
            near = near + sparse.csr_matrix((part, (k, at[k])), near.shape)
        return (near @ total) / np.maximum(near @ count, 1)[:, None]

    def _paths(
        self, view: View, keys: Array, total: Array, count: Array, rng: np.random.Generator
    ) -> None:
        hits = self.world.hit(np.broadcast_to(self.eye, view.rays.shape), view.rays, rng)
        on = np.flatnonzero(hits.valid)
        key = self._key(view.coarse[on], hits.group[on], hits.normal[on])
        record = np.minimum(np.searchsorted(keys, key), len(keys) - 1)
        known = keys[record] == key
        on, record = on[known], record[known]
        count += np.bincount(record, minlength=len(keys))
        weight = hits.weight[on] / np.maximum(hits.reflectance[on], _LEAST_REFLECTANCE)
        self._add_sun_through(hits, on, record, total)
        for depth in range(1, DEPTH + 1):
            alive = weight > 0
            on, record, weight = on[alive], record[alive], weight[alive]
            if not len(on):
                return
            ray = hits.out[on]
            side = np.sign((ray * hits.normal[on]).sum(1))[:, None]
            start = lifted(hits.point[on], hits.normal[on] * side)
            hits = self.world.hit(start, ray, rng)
            glass, _ = self.world.glass(start, ray, np.where(hits.valid, hits.distance, np.inf))
            weight = weight * glass
            sky = np.flatnonzero(~hits.valid & (ray[:, 2] > 0))
            patch = patch_index(to_world(ray[sky], self.place), self.bands)
            self._gain(total, record[sky], patch, weight[sky], self.patch_cdm2)
            on = np.flatnonzero(hits.valid)
            record, weight = record[on], weight[on]
            self._add_sun(hits, on, record, weight, total)
            weight = weight * hits.weight[on]
            if depth >= 3:
                survive = np.clip(weight / 0.3, 0.05, 1.0)
                weight = np.where(rng.random(len(on)) < survive, weight / survive, 0.0)

    def _add_sun(self, hits: Any, on: Array, record: Array, weight: Array, total: Array) -> None:
        """Add sunlight that surfaces met by paths send back."""
        cell = self.cells.index(hits.point[on], hits.normal[on])
        self._gain(total, record, cell, weight * hits.reflectance[on] / np.pi, self.cells.lux)
        tau = self.world.transmittance[hits.group[on]]
        thin = np.flatnonzero(tau > 0)
        if len(thin):
            k = on[thin]
            cell = self.cells.index(hits.point[k], -hits.normal[k])
            self._gain(total, record[thin], cell, weight[thin] * tau[thin] / np.pi, self.cells.lux)

    def _add_sun_through(self, hits: Any, on: Array, record: Array, total: Array) -> None:
        """Add sunlight that the surfaces seen first let through."""
        tau = self.world.transmittance[hits.group[on]]
        thin = np.flatnonzero(tau > 0)
        if len(thin):
            k = on[thin]
            weight = tau[thin] / np.maximum(hits.reflectance[k], _LEAST_REFLECTANCE) / np.pi
            cell = self.cells.index(hits.point[k], -hits.normal[k])
            self._gain(total, record[thin], cell, weight, self.cells.lux)

    def _gain(
        self, total: Array, record: Array, source: Array, weight: Array, light: Array
    ) -> None:
        if len(record):
            shape = (len(total), len(light))
            total += sparse.csr_matrix((weight, (record, source)), shape) @ light

    # ---- direct sun

    def sun_on_surfaces(self) -> list[Array]:
        """Return direct sunlight of every hour on what is seen [hours][fine pixels], cd/m2."""
        view = view_of(self.place, np.random.default_rng(100))
        rng = np.random.default_rng(300)
        origin = np.broadcast_to(self.eye, view.rays.shape)
        hits = self.world.hit(origin, view.rays, rng)
        on = np.flatnonzero(hits.valid)
        inside = indoors(lifted(hits.point[on], hits.normal[on]), self.place)
        first_row = (view.v[on] * FINE * GRID).astype(int) % GRID == 0
        # Indoors one point of each fine pixel is enough; outdoors each ray's point counts.
        kept = ~inside | (np.diff(view.pixel[on], prepend=-1) != 0) & first_row
        on, inside = on[kept], inside[kept]
        start = lifted(hits.point[on], hits.normal[on])
        glass, _ = self.world.glass(origin[on], view.rays[on], hits.distance[on])
        glass = glass / np.where(inside, 1, GRID**2)
        out = []
        for hour, sun in zip(self.hours, self.cells.suns, strict=True):
            light = np.zeros(self.pixels, np.float32)
            facing = self._reachable(start, inside, hits.normal[on] @ sun > 0, sun)
            if hour.normal_lx > 0 and len(facing):
                suns = jittered(sun, len(facing), rng)
                share = sunlight(self.world, self.place, start[facing], suns)
                lit = facing[share > 0]
                k = on[lit]
                if len(k):  # Dr.Jit stops the program at an empty array
                    value = self.world.reflected(origin[k], view.rays[k], suns[share > 0])
                    value *= share[share > 0] * glass[lit] * hour.normal_lx
                    light = np.bincount(view.pixel[k], value, self.pixels).astype(np.float32)
            out.append(light)
        return out

    def _reachable(self, start: Array, inside: Array, facing: Array, sun: Array) -> Array:
        """Return the indices of points that face the sun outdoors or through a pane."""
        k = np.flatnonzero(facing)
        _, crossed = self.world.glass(start[k], np.broadcast_to(sun, (len(k), 3)), np.inf)
        return k[crossed | ~inside[k]]

    def disc(self, hour: Hour, sun: Array) -> tuple[float, float, Array]:
        """Return the visible share of the disc, the mean glass over that share, and its picture.

        The picture [fine pixels] is luminance.
        """
        rays = jittered(sun, _DISC_RAYS, np.random.default_rng(7))
        origin = np.broadcast_to(self.eye, rays.shape)
        glass, _ = self.world.glass(origin, rays, np.inf)
        visible = self.world.clear(origin, rays)
        world = to_world(rays, self.place)
        rows = COARSE * FINE
        altitude = np.degrees(np.arcsin(world[:, 2]))
        azimuth = np.degrees(np.arctan2(world[:, 0], world[:, 1]))
        i = np.minimum(((90 - altitude) / 180 * rows).astype(int), rows - 1)
        turn = (azimuth - self.place.heading_deg + 180) % 360
        j = (turn / 360 * 2 * rows).astype(int) % (2 * rows)
        value = hour.normal_lx * glass * visible / _DISC_RAYS / solid_angles(rows)[i]
        picture = np.bincount(i * 2 * rows + j, value, self.pixels)
        share = float(visible.mean())
        return share, float(glass[visible].mean()) if share else 0.0, picture


def _corners(u: Array, v: Array) -> list[tuple[Array, Array]]:
    """Return the four coarse pixels around places and their bilinear shares."""
    a, b = np.floor(u - 0.5), np.floor(v - 0.5)
    x, y = u - 0.5 - a, v - 0.5 - b
    out = []
    for di, wi in ((0, 1 - y), (1, y)):
        row = np.clip(b + di, 0, COARSE - 1).astype(int)
        for dj, wj in ((0, 1 - x), (1, x)):
            column = ((a + dj) % (2 * COARSE)).astype(int)
            out.append((row * 2 * COARSE + column, wi * wj))
    return out


def coarse_mean(picture: Array) -> Array:
    """Return the mean over solid angle of a fine picture [fine pixels] in coarse pixels."""
    rows = COARSE * FINE
    weight = solid_angles(rows)[:, None]
    cut = (COARSE, FINE, 2 * COARSE, FINE)
    summed = (picture.reshape(rows, 2 * rows) * weight).reshape(cut).sum((1, 3))
    return summed / (weight * np.ones((1, 2 * rows))).reshape(cut).sum((1, 3))
