"""From a sensor to a grid of directions by one sparse matrix that conserves flux.

Each target pixel is sampled finely; a sample is shared among the four nearest sensor pixels of its colour (bilinear on
that colour's own lattice, so that every sensor pixel gives away its own solid angle), and the samples' solid angles are
the weights. So a uniform field stays uniform exactly, a point source keeps its energy, and a colour is taken from its
own pixels of the mosaic: nothing is demosaicked. The same matrix carries values, variances (its square) and flags.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.projection.lens import LensGeometry, angle_of_radius, lens_pixels, lens_rays
from fieldlum.projection.panorama import direction, equirect_solid_angles

_BLOCK_SAMPLES = 2_000_000
_EDGE_RAD = 0.12  # target pixels further outside the lens than this are not even looked at
_SPACING = {"": 1.0, "R": 2.0, "G": 2.0**0.5, "B": 2.0}  # of a colour's pixels [px]
_STEP = 1.1  # of that spacing, between samples


@dataclass(frozen=True, slots=True)
class Equirect:
    """A panorama grid; its frame has the heading in the north."""

    height: int

    @property
    def shape(self) -> tuple[int, int]:
        return self.height, 2 * self.height

    @property
    def pixel_rad(self) -> float:
        return float(np.pi / self.height)

    def rays(self, rows: NDArray[np.floating], columns: NDArray[np.floating]) -> NDArray[np.float64]:
        """Directions of continuous (row, column) coordinates, [rows, columns, 3]."""
        altitude = 90.0 - rows / self.height * 180.0
        azimuth = (columns / (2 * self.height) - 0.5) * 360.0
        return direction(altitude[:, None], azimuth[None, :])

    def weight(self, rows: NDArray[np.floating], columns: NDArray[np.floating]) -> NDArray[np.float64]:
        """Relative solid angle of samples, [rows, columns]."""
        return np.broadcast_to(np.sin(rows / self.height * np.pi)[:, None], (rows.size, columns.size))

    def solid_angles(self) -> NDArray[np.float64]:
        return equirect_solid_angles(*self.shape)


@dataclass(frozen=True, slots=True)
class Fisheye:
    """A square equidistant picture (Radiance -vta) of `full_angle_deg` along the axis of `pose`."""

    size: int
    full_angle_deg: float
    pose: LensGeometry

    @property
    def shape(self) -> tuple[int, int]:
        return self.size, self.size

    @property
    def pixel_rad(self) -> float:
        return float(np.radians(self.full_angle_deg) / self.size)

    @property
    def geometry(self) -> LensGeometry:
        half = self.size / 2
        p = self.pose
        return LensGeometry(
            (half, half), half, self.full_angle_deg, "equidistant", (), p.azimuth_deg, p.tilt_deg, p.roll_deg
        )

    @property
    def view(self) -> str:
        return f"-vta -vv {self.full_angle_deg:g} -vh {self.full_angle_deg:g}"

    def rays(self, rows: NDArray[np.floating], columns: NDArray[np.floating]) -> NDArray[np.float64]:
        return lens_rays(self.geometry, columns[None, :], rows[:, None])

    def angles(self, rows: NDArray[np.floating], columns: NDArray[np.floating]) -> NDArray[np.float64]:
        """From the axis, [rows, columns]. [rad]"""
        half = self.size / 2
        return np.hypot(columns[None, :] - half, rows[:, None] - half) * self.pixel_rad

    def weight(self, rows: NDArray[np.floating], columns: NDArray[np.floating]) -> NDArray[np.float64]:
        angle = self.angles(rows, columns)
        return np.where(angle <= np.radians(self.full_angle_deg) / 2, np.abs(np.sinc(angle / np.pi)), 0.0)

    def solid_angles(self) -> NDArray[np.float64]:
        centre = np.arange(self.size) + 0.5
        return self.weight(centre, centre) * self.pixel_rad**2


Target = Equirect | Fisheye


@dataclass(frozen=True, slots=True)
class Resampler:
    """Matrices by colour [target pixels, sensor pixels], rows that sum to 1 (or 0 where the lens sees nothing).

    coverage: share of a target pixel's solid angle that falls on the sensor inside the lens, [pixels]
    angle_rad: mean angle from the optical axis of what falls there, [pixels]
    """

    matrices: dict[str, Any]  # scipy.sparse.csr_array, float32
    coverage: NDArray[np.float32]
    angle_rad: NDArray[np.float32]
    shape: tuple[int, int]


def _shared(
    cfa: str, colour: str, x: NDArray[np.float32], y: NDArray[np.float32]
) -> Iterator[tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float32]]]:
    """Column, row and share of the four pixels of a colour around each place. cfa "": all colours everywhere."""
    places = [divmod(i, 2) for i, letter in enumerate(cfa) if letter == colour] or [(0, 0)]
    row0, column0 = places[0]
    across, down = x - np.float32(0.5), y - np.float32(0.5)  # whole numbers at pixel centres
    diagonal = len(places) == 2  # green: a lattice at 45 degrees
    parity, step = (row0 + column0) & 1, 2 if cfa else 1
    if diagonal:
        u, v = (across + down - parity) / 2, (across - down - parity) / 2
    else:
        u, v = (across - column0) / step, (down - row0) / step
    i, j = np.floor(u).astype(np.int32), np.floor(v).astype(np.int32)
    du, dv = (u - i).astype(np.float32), (v - j).astype(np.float32)
    for a in (0, 1):
        for b in (0, 1):
            share = (du if a else 1 - du) * (dv if b else 1 - dv)
            p, q = i + np.int32(a), j + np.int32(b)
            if diagonal:
                yield p + q + np.int32(parity), p - q, share
            else:
                yield p * np.int32(step) + np.int32(column0), q * np.int32(step) + np.int32(row0), share


def _blocks(target: Target, sub: int) -> Iterator[tuple[int, int]]:
    height, width = target.shape
    step = max(1, _BLOCK_SAMPLES // (width * sub * sub))
    for first in range(0, height, step):
        yield first, min(first + step, height)


def _samples(target: Target, lens: LensGeometry, first: int, last: int, sub: int) -> tuple[Any, ...]:
    """Sensor x, y, weight of the samples of target rows first..last that may meet the lens, and their pixel's number.

    Sensor coordinates are worked out exactly on a grid of nodes and interpolated between them: they are smooth where
    the lens sees, and a node stands at every pixel corner or at least every half degree.
    """
    width = target.shape[1]
    fine = max(1, int(np.ceil(target.pixel_rad / 0.009)))
    step = -(-sub // fine)  # samples between nodes
    sub = step * fine
    rows = first + np.arange((last - first) * fine + 1) / fine
    columns = np.arange(width * fine + 1) / fine
    x, y, angle = lens_pixels(lens, target.rays(rows, columns))
    near = angle < lens.half_angle_rad + _EDGE_RAD
    cells = near[:-1, :-1] | near[1:, :-1] | near[:-1, 1:] | near[1:, 1:]
    i, j = np.nonzero(cells)
    offset = ((np.arange(step) + 0.5) / step).astype(np.float32)
    xs, ys = (_between(v.astype(np.float32), i, j, offset) for v in (x, y))
    at_rows, at_columns = (rows[i][:, None] + offset / fine), (columns[j][:, None] + offset / fine)
    if isinstance(target, Equirect):
        weight = np.broadcast_to(np.sin(at_rows / target.height * np.pi)[:, :, None], xs.shape)
    else:
        half = target.size / 2
        distance = np.hypot((at_columns - half)[:, None, :], (at_rows - half)[:, :, None]) * target.pixel_rad
        weight = np.where(distance <= np.radians(target.full_angle_deg) / 2, np.sinc(distance / np.pi), 0.0)
    pixel = (i // fine) * width + j // fine
    return xs, ys, weight.astype(np.float32), np.broadcast_to(pixel.astype(np.int32)[:, None, None], xs.shape)


def _between(
    nodes: NDArray[np.float32], i: NDArray[np.intp], j: NDArray[np.intp], offset: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Bilinear values at the sub-samples of cells (i, j), [cells, sub rows, sub columns]."""
    a, b, c, d = nodes[i, j], nodes[i, j + 1], nodes[i + 1, j], nodes[i + 1, j + 1]
    left = a[:, None] + (c - a)[:, None] * offset
    right = b[:, None] + (d - b)[:, None] * offset
    return np.asarray(left[:, :, None] + (right - left)[:, :, None] * offset, np.float32)


def samples_per_pixel(target: Target, lens: LensGeometry, colour: str = "") -> int:
    """Sub-samples along one edge of a target pixel, so that no sensor pixel of the colour falls between them."""
    densest = lens.radius_px * max(1.0 / np.sin(min(lens.half_angle_rad, np.pi / 2)), 1.0 / lens.half_angle_rad)
    return int(np.clip(np.ceil(densest * target.pixel_rad / (_STEP * _SPACING[colour])), 3, 24))


@lru_cache(maxsize=24)
def resampler(target: Target, lens: LensGeometry, sensor_shape: tuple[int, int], cfa: str = "") -> Resampler:
    """Build (once, then cached) the matrices from a sensor [h, w] seen through `lens` to `target`.

    cfa: four letters row by row, or "" for a sensor with all colours everywhere (one matrix, named "").
    """
    matrices, share, angle = {}, np.zeros(0), np.zeros(0)
    for colour in sorted(set(cfa)) or [""]:
        matrices[colour], share, angle = _matrix(target, lens, sensor_shape, cfa, colour)
    return Resampler(matrices, np.minimum(share, 1.0).astype(np.float32), angle.astype(np.float32), target.shape)


def _matrix(
    target: Target, lens: LensGeometry, sensor_shape: tuple[int, int], cfa: str, colour: str
) -> tuple[Any, NDArray[np.float64], NDArray[np.float64]]:
    """One colour's matrix, coverage and mean angle."""
    from scipy import sparse

    sub = samples_per_pixel(target, lens, colour)
    width = target.shape[1]
    sensor_h, sensor_w = sensor_shape
    margin = 1.5 if cfa else 0.75  # so that none of the four neighbours lies outside the circle
    limit = (lens.radius_px - margin) ** 2
    blocks, coverage, angles = [], [], []
    for first, last in _blocks(target, sub):
        x, y, weight, pixel = _samples(target, lens, first, last, sub)
        n = (last - first) * width
        r2 = (x - np.float32(lens.centre_px[0])) ** 2 + (y - np.float32(lens.centre_px[1])) ** 2
        seen = (r2 <= limit) & (x >= margin) & (y >= margin) & (x < sensor_w - margin) & (y < sensor_h - margin)
        seen &= weight > 0
        x, y, r2, weight, pixel = x[seen], y[seen], r2[seen], weight[seen], pixel[seen]
        inside = np.bincount(pixel, weight, n)
        total = _full_weight(target, first, last) * _samples_of(target, sub)
        coverage.append(np.divide(inside, total, out=np.zeros(n), where=total > 0))
        angle = angle_of_radius(lens, np.sqrt(r2) / lens.radius_px)
        angles.append(np.divide(np.bincount(pixel, weight * angle, n), inside, out=np.zeros(n), where=inside > 0))
        weight /= inside[pixel].astype(np.float32)
        corners = list(_shared(cfa, colour, x, y))
        index = np.concatenate([row * np.int32(sensor_w) + column for column, row, _ in corners])
        share = np.concatenate([weight * part for _, _, part in corners])
        entries = (share, (np.tile(pixel, 4), index))
        blocks.append(sparse.coo_array(entries, shape=(n, sensor_h * sensor_w)).tocsr())
    return sparse.vstack(blocks, format="csr"), np.concatenate(coverage), np.concatenate(angles)


def _samples_of(target: Target, sub: int) -> int:
    """Samples that `_samples` really makes in a target pixel."""
    fine = max(1, int(np.ceil(target.pixel_rad / 0.009)))
    return (-(-sub // fine) * fine) ** 2


def _full_weight(target: Target, first: int, last: int) -> NDArray[np.float64]:
    """Mean sample weight of whole target pixels, so that coverage is 1 where the lens sees all of a pixel."""
    fine = np.arange(first * 8, last * 8) / 8 + 1 / 16
    width = target.shape[1]
    if isinstance(target, Equirect):
        rows = target.weight(fine, np.zeros(1))[:, 0].reshape(-1, 8).mean(axis=1)
        return np.repeat(rows, width)
    columns = np.arange(width * 4) / 4 + 1 / 8
    weight = target.weight(np.arange(first * 4, last * 4) / 4 + 1 / 8, columns)
    return weight.reshape(last - first, 4, width, 4).mean(axis=(1, 3)).ravel()
