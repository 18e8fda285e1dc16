"""Resampling from a sensor to a grid of directions by one sparse matrix that conserves flux.

Each target pixel is sampled finely. A sample is distributed over the four nearest sensor pixels of
its colour (bilinear on the lattice of that colour, so that every sensor pixel gives its own solid
angle); the solid angles of the samples are the weights. A uniform field therefore stays uniform, a
point source keeps its energy (within 0.35 %), and each colour comes from its own pixels of the
mosaic, without demosaicking. The same matrix carries values, variances (by its square) and flags.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask
from fieldlum.optics.projection.grids import Equirect, Target
from fieldlum.optics.projection.lens import LensGeometry, angle_of_radius, lens_pixels

# Samples in work at a time. Chosen so that a block fits the cache of a core; speed only.
_BLOCK_SAMPLES = 250_000
_WINDOWS = 1_000_000  # window cells that are summed at a time; limits memory only
# Cells whose corners are all outside of the lens by more than this are skipped: some polynomials
# fall again beyond the edge and would show directions behind the lens as a mirror image of its rim.
# Chosen.
_EDGE_RAD = 0.002
# Distance between pixels of one colour of a Bayer mosaic, exact. [px]
_SPACING = {"": 1.0, "R": 2.0, "G": 2.0**0.5, "B": 2.0}
# Samples along an edge of a target pixel, at least, and their largest distance over `_SPACING`.
# Chosen so that no sensor pixel is skipped; energy is kept within 0.35 %
# (docs/validation.md, geometry).
_MIN_SAMPLES = 3
_STEP = 1.1
# Largest distance of the nodes at which lens coordinates are computed exactly, half a degree:
# between them the coordinates are interpolated. Chosen.
_NODE_RAD = 0.009


Float32 = Floats32


@dataclass(frozen=True, slots=True)
class Resampler:
    """Matrices [target pixels, sensor pixels] by colour; rows sum to 1, or 0 where nothing is seen.

    coverage : share of a target pixel's solid angle that is on the sensor inside the lens,
    [pixels]. angle_rad : mean angle from the optical axis of that part, [pixels]. matrices :
    scipy.sparse.csr_array of float32 for each colour. shape : of the target [rows, columns].
    """

    matrices: dict[str, Any]
    coverage: Floats32
    angle_rad: Floats32
    shape: tuple[int, int]


@dataclass(frozen=True, slots=True)
class _Lattice:
    """The lattice of one colour's pixels: sensor pixel = origin + p right + q down.

    p and q are integers.
    """

    row: int
    column: int
    right: tuple[int, int]  # rows, columns of one step p
    down: tuple[int, int]

    def places(self, x: Float32, y: Float32) -> tuple[Float32, Float32]:
        """Return continuous p, q of sensor coordinates, [...]; integers at pixel centres."""
        half = np.float32(0.5)
        across = x - np.float32(self.column + 0.5)
        down = y - np.float32(self.row + 0.5)
        if self.right[0]:  # green: a lattice at 45 degrees
            return np.multiply(across + down, half), np.multiply(across - down, half)
        return np.multiply(across, np.float32(1 / self.right[1])), np.multiply(
            down, np.float32(1 / self.down[0])
        )

    def number(
        self, p: NDArray[np.integer], q: NDArray[np.integer], width: int
    ) -> NDArray[np.int32]:
        """Return the index of sensor pixels, counted row by row, [...]."""
        rows = self.row + p * self.right[0] + q * self.down[0]
        return (rows * width + self.column + p * self.right[1] + q * self.down[1]).astype(np.int32)


def _lattice(cfa: str, colour: str) -> _Lattice:
    """Return the lattice of a colour; without a cfa all colours are at every pixel."""
    places = [divmod(i, 2) for i, letter in enumerate(cfa) if letter == colour]
    if len(places) == 2:
        return _Lattice(*places[0], (1, 1), (-1, 1))
    step = 2 if cfa else 1
    return _Lattice(*(places or [(0, 0)])[0], (0, step), (step, 0))


def _blocks(target: Target, sub: int) -> Iterator[tuple[int, int]]:
    height, width = target.shape
    step = max(1, _BLOCK_SAMPLES // (width * sub * sub))
    for first in range(0, height, step):
        yield first, min(first + step, height)


@dataclass(frozen=True, slots=True)
class _Nodes:
    """Exact sensor coordinates on a grid over some rows of the target.

    Between nodes the coordinates are interpolated: they are smooth where the lens sees, and there
    is a node at every pixel corner or at least every half degree.
    """

    first: int  # row of the target
    fine: int  # nodes for one edge of a target pixel
    x: Float32
    y: Float32
    near: Mask  # cells between nodes that the lens may see
    row: Indices  # of the target pixels with such a cell, from `first`
    column: Indices


def _nodes(target: Target, lens: LensGeometry, first: int, last: int) -> _Nodes:
    width, fine = target.shape[1], _nodes_per_pixel(target)
    rows = first + np.arange((last - first) * fine + 1) / fine
    x, y, angle = lens_pixels(lens, target.rays(rows, np.arange(width * fine + 1) / fine))
    near = angle < lens.half_angle_rad + _EDGE_RAD
    near = near[:-1, :-1] | near[1:, :-1] | near[:-1, 1:] | near[1:, 1:]
    row, column = np.nonzero(near.reshape(last - first, fine, width, fine).any(axis=(1, 3)))
    return _Nodes(first, fine, x.astype(np.float32), y.astype(np.float32), near, row, column)


def _nodes_per_pixel(target: Target) -> int:
    return max(1, int(np.ceil(target.pixel_rad / _NODE_RAD)))


def _samples(
    target: Target, nodes: _Nodes, down: int, across: int
) -> tuple[Float32, Float32, Float32]:
    """Return sensor x, y and weight of samples in each pixel of `nodes`, [down, across, n] each.

    A pixel has `down` x `across` samples. x and y are NaN where the lens cannot see.
    """
    fine = nodes.fine
    part = np.arange(fine)
    i = nodes.row * fine + part[:, None, None]
    j = nodes.column * fine + part[:, None]
    i, j = np.broadcast_arrays(i, j)
    hidden = None if (near := nodes.near[i, j]).all() else ~near
    steps = _middles(down // fine), _middles(across // fine)
    xs, ys = (
        _between(v, i, j, *steps, hidden).reshape(down, across, -1) for v in (nodes.x, nodes.y)
    )
    at_rows = nodes.first + nodes.row + _middles(down)[:, None]
    if isinstance(target, Equirect):
        weight = np.sin(target.zenith_angle_rad(at_rows))[:, None]
    else:
        half = target.size / 2
        at_columns = nodes.column + _middles(across)[:, None]
        distance = np.hypot(at_columns - half, (at_rows - half)[:, None]) * target.pixel_rad
        weight = np.where(
            distance <= np.radians(target.full_angle_deg) / 2, np.sinc(distance / np.pi), 0.0
        )
    return xs, ys, np.broadcast_to(weight.astype(np.float32), xs.shape)


def _middles(count: int) -> Floats:
    return (np.arange(count) + 0.5) / count


def _between(
    nodes: Float32, i: Indices, j: Indices, down: Floats, across: Floats, hidden: Mask | None
) -> Float32:
    """Return bilinear values at places `down` and `across` of cells (i, j) [fine, fine, n].

    The result has the shape [fine, down, fine, across, n].
    """
    a, b, c, d = nodes[i, j], nodes[i, j + 1], nodes[i + 1, j], nodes[i + 1, j + 1]
    if hidden is not None:
        a[hidden] = b[hidden] = np.nan
    along = down.astype(np.float32)[:, None, None]
    start = a[:, None] + (c - a)[:, None] * along
    right = b[:, None] + (d - b)[:, None] * along
    values = np.multiply((right - start)[..., None, :], across[:, None], dtype=np.float32)
    values += start[..., None, :]
    return values


def samples_per_pixel(target: Target, lens: LensGeometry, colour: str = "") -> int:
    """Return the samples along one edge of a target pixel, 3 to 24.

    If 24 are enough for it, no sensor pixel of the colour is between two samples.
    """
    densest = lens.radius_px * max(
        1.0 / np.sin(min(lens.half_angle_rad, np.pi / 2)), 1.0 / lens.half_angle_rad
    )
    return int(
        np.clip(np.ceil(densest * target.pixel_rad / (_STEP * _SPACING[colour])), _MIN_SAMPLES, 24)
    )


def _counts(target: Target, first: int, last: int, sub: int) -> tuple[int, int]:
    """Return the samples down and across a pixel of these rows, multiples of the nodes.

    Near the poles meridians converge, and fewer samples across suffice.
    """
    fine = _nodes_per_pixel(target)
    across = sub
    if isinstance(target, Equirect):
        top, bottom = target.zenith_angle_rad(np.array([first, last]))
        edges = np.clip((top, bottom, np.pi / 2.0), top, bottom)
        across = max(_MIN_SAMPLES, int(np.ceil(sub * np.sin(edges).max())))
    return -(-sub // fine) * fine, -(-across // fine) * fine


@lru_cache(maxsize=24)
def resampler(
    target: Target, lens: LensGeometry, sensor_shape: tuple[int, int], cfa: str = ""
) -> Resampler:
    """Return the matrices from a sensor [h, w] behind `lens` to `target`; computed once, cached.

    cfa : four letters row by row, or "" for a sensor with all colours at every pixel (one matrix,
    named "").
    """
    colours = sorted(set(cfa)) or [""]
    subs = {colour: samples_per_pixel(target, lens, colour) for colour in colours}
    width = target.shape[1]
    coverage = np.ones(target.shape[0] * width, np.float32)
    angle = np.zeros(target.shape[0] * width, np.float32)
    rows: dict[str, list[_Rows]] = {colour: [] for colour in colours}
    for first, last in _blocks(target, max(subs.values())):
        nodes = _nodes(target, lens, first, last)
        pixel = nodes.row * width + nodes.column
        for sub in sorted(set(subs.values())):
            counts = _counts(target, first, last, sub)
            samples = _seen(
                lens, sensor_shape, _samples(target, nodes, *counts), 1.5 if cfa else 0.75
            )
            for colour in (c for c in colours if subs[c] == sub):
                rows[colour].append(
                    _rows(
                        samples,
                        _lattice(cfa, colour),
                        sensor_shape[1],
                        pixel,
                        (last - first) * width,
                    )
                )
            full = _full_weight(target, first, last)[pixel] * counts[0] * counts[1]
            at = first * width + pixel
            # A pixel is covered as far as all colours see it.
            coverage[at] = np.minimum(coverage[at], samples.total / np.maximum(full, 1e-30))
            angle[at] = samples.angle_rad
        hidden = np.setdiff1d(np.arange((last - first) * width), pixel, assume_unique=True)
        coverage[first * width + hidden] = 0.0
    matrices = {colour: _csr(rows.pop(colour), sensor_shape) for colour in colours}
    return Resampler(matrices, coverage, angle, target.shape)


@dataclass(frozen=True, slots=True)
class _Seen:
    """Samples of n target pixels, arrays [down, across, n].

    x, y : sensor coordinates; share : of their pixel, 0 if not seen.
    """

    x: Float32
    y: Float32
    share: Float32
    total: Floats  # of the weights seen, [n]
    angle_rad: Floats  # mean from the axis, [n]


def _seen(
    lens: LensGeometry,
    sensor_shape: tuple[int, int],
    samples: tuple[Float32, Float32, Float32],
    margin: float,
) -> _Seen:
    """Return the samples that the sensor sees inside the lens.

    margin : distance from the circle and from the sensor's edge [px] that keeps all four neighbours
    of a sample inside.
    """
    x, y, weight = samples
    sensor_h, sensor_w = sensor_shape
    r2 = (x - np.float32(lens.centre_px[0])) ** 2 + (y - np.float32(lens.centre_px[1])) ** 2
    inside = (r2 <= (lens.radius_px - margin) ** 2) & (weight > 0)
    inside &= (x >= margin) & (y >= margin) & (x < sensor_w - margin) & (y < sensor_h - margin)
    if not inside.all():
        # Move samples that are not seen to a seen sample of their pixel, with weight 0: the window
        # of the pixel stays small.
        weight = weight * inside
        x, y = (
            np.where(inside, v, np.where(inside, v, np.float32(np.inf)).min(axis=(0, 1)))
            for v in (x, y)
        )
        r2 = np.where(inside, r2, np.float32(0))
    total = weight.sum(axis=(0, 1), dtype=np.float64)
    share = np.divide(weight, np.maximum(total, 1e-30).astype(np.float32), order="C")
    angle = angle_of_radius(lens, np.sqrt(r2) / np.float32(lens.radius_px))
    return _Seen(x, y, share, total, (share * angle).sum(axis=(0, 1), dtype=np.float64))


# Values, columns and the count of entries of each row.
_Rows = tuple[Floats32, NDArray[np.int32], Indices]


def _rows(
    samples: _Seen, lattice: _Lattice, sensor_width: int, pixel: Indices, pixels: int
) -> _Rows:
    """Return the rows of the matrix of one colour: samples distributed bilinearly over four pixels.

    The shares are summed in a small dense window of the lattice around each target pixel, which
    needs no sorting.
    """
    keep = np.flatnonzero(samples.total > 0)
    counts = np.zeros(pixels, np.intp)
    if not keep.size:
        return np.zeros(0, np.float32), np.zeros(0, np.int32), counts
    x, y, share = (
        v if keep.size == len(samples.total) else np.take(v, keep, axis=-1)
        for v in (samples.x, samples.y, samples.share)
    )
    p, q = lattice.places(x, y)
    i, j = np.floor(p), np.floor(q)
    p -= i
    q -= j
    i_min, j_min = (v.min(axis=(0, 1)) for v in (i, j))
    i -= i_min
    j -= j_min
    across, down = int(i.max()) + 2, int(j.max()) + 2
    corner = lattice.number(i_min.astype(np.int64), j_min.astype(np.int64), sensor_width)
    window = lattice.number(*np.meshgrid(np.arange(across), np.arange(down)), sensor_width).ravel()
    window = window - np.int32(lattice.row * sensor_width + lattice.column)
    values, columns = [], []
    step = max(1, _WINDOWS // window.size)
    for a in range(0, keep.size, step):
        at = slice(a, a + step)
        dense = _window_sums(
            i[..., at], j[..., at], p[..., at], q[..., at], share[..., at], across, down
        )
        filled = dense > 0
        values.append(dense[filled].astype(np.float32))
        columns.append((corner[at][:, None] + window)[filled])
        counts[pixel[keep[at]]] = filled.sum(axis=1)
    return np.concatenate(values), np.concatenate(columns), counts


def _window_sums(
    i: Float32, j: Float32, p: Float32, q: Float32, share: Float32, across: int, down: int
) -> Floats:
    """Return the sums of the shares of samples at i + p, j + q, [n, down * across].

    i, j, p, q, share : [down, across, n]; the window of each pixel has `across` x `down` cells.
    """
    size, pixels = across * down, i.shape[-1]
    at = (j * across + i).astype(np.intp)
    at += np.arange(pixels) * size
    index, part = np.empty((4, i.size), np.intp), np.empty((4, i.size))
    lower = share * q
    upper = share - lower
    for number, (row, move) in enumerate(((upper, 0), (lower, across))):
        right = row * p
        np.add(at.ravel(), move, out=index[2 * number])
        np.add(at.ravel(), move + 1, out=index[2 * number + 1])
        np.subtract(row.ravel(), right.ravel(), out=part[2 * number])
        part[2 * number + 1] = right.ravel()
    return np.asarray(np.bincount(index.ravel(), part.ravel(), pixels * size), np.float64).reshape(
        -1, size
    )


def _csr(rows: list[_Rows], sensor_shape: tuple[int, int]) -> Any:
    from scipy import sparse

    values, columns, counts = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    small = len(values) < np.iinfo(np.int32).max
    starts = np.concatenate(([0], np.cumsum(counts))).astype(np.int32 if small else np.int64)
    return sparse.csr_array(
        (values, columns, starts), shape=(len(counts), sensor_shape[0] * sensor_shape[1])
    )


def _full_weight(target: Target, first: int, last: int) -> Floats:
    """Return the mean sample weight of fully seen target pixels, [rows * W].

    Coverage is then 1 where the lens sees all of a pixel.
    """
    fine = np.arange(first * 8, last * 8) / 8 + 1 / 16
    width = target.shape[1]
    if isinstance(target, Equirect):
        rows = target.weight(fine, np.zeros(1))[:, 0].reshape(-1, 8).mean(axis=1)
        return np.repeat(rows, width)
    columns = np.arange(width * 4) / 4 + 1 / 8
    weight = target.weight(np.arange(first * 4, last * 4) / 4 + 1 / 8, columns)
    return weight.reshape(last - first, 4, width, 4).mean(axis=(1, 3)).ravel()
