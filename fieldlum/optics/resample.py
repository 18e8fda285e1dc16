"""Resampling from a sensor to a grid of directions by one sparse matrix that conserves flux.

Each target pixel is sampled finely. A sample is distributed over the four nearest sensor pixels of
its colour (bilinear on the lattice of that colour, so that every sensor pixel gives its own solid
angle); the solid angles of the samples are the weights. A uniform field therefore stays uniform, a
point source keeps its energy (within 0.35 %), and each colour comes from its own pixels of the
mosaic, without demosaicking. The same matrix carries values, variances (by its square) and flags.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Indices
from fieldlum.optics.projection import Equirect, LensGeometry, Target, lens_pixels

# Samples in work at a time: a block fits the cache of a core. Decides speed only.
_BLOCK_SAMPLES = 250_000
_MIN_SAMPLES = 3  # along an edge of a target pixel
# Samples along an edge are a multiple of the edge's cells, which are at most half a degree wide, so
# that large pixels have enough samples. [rad]
_CELL_RAD = 0.009


@dataclass(frozen=True, slots=True)
class Resampler:
    """Matrices [target pixels, sensor pixels] by colour; rows sum to 1, or 0 where nothing is seen.

    coverage : share of a target pixel's solid angle that is on the sensor inside the lens,
    [pixels]. angle_rad : mean angle from the optical axis of that part, [pixels]. matrices :
    scipy.sparse.csr_array of float32 for each colour.
    """

    matrices: dict[str, Any]
    coverage: Floats32
    angle_rad: Floats32


class _Lattice(NamedTuple):
    """The lattice of one colour's pixels: sensor pixel = origin + p right + q down.

    p and q are integers; right, down: rows and columns of one step.
    """

    row: int
    column: int
    right: tuple[int, int]
    down: tuple[int, int]


def _lattice(cfa: str, colour: str) -> _Lattice:
    """Return the lattice of a colour; without a cfa all colours are at every pixel."""
    places = [divmod(i, 2) for i, letter in enumerate(cfa) if letter == colour]
    if len(places) == 2:  # green: at 45 degrees
        return _Lattice(*places[0], (1, 1), (-1, 1))
    step = 2 if cfa else 1
    return _Lattice(*(places or [(0, 0)])[0], (0, step), (step, 0))


class _Samples(NamedTuple):
    """The samples of some target pixels that the sensor sees inside the lens, [n] each.

    pixel : of the target, from the block's first; x, y : sensor coordinates; share : of their
    pixel's weight that is seen. coverage, angle_rad : of each target pixel [pixels].
    """

    pixel: Indices
    x: Floats
    y: Floats
    share: Floats
    coverage: Floats
    angle_rad: Floats


def _samples(
    target: Target,
    lens: LensGeometry,
    sensor_shape: tuple[int, int],
    rows: tuple[int, int],
    sub: int,
    margin_px: float,
) -> _Samples:
    """Return the samples of the target's rows from the first to before the last.

    sub : samples down a pixel; near the poles meridians converge, and fewer across suffice.
    margin_px : distance from the circle and from the sensor's edge that keeps all four neighbours
    of a sample inside.
    """
    (first, last), width, across = rows, target.shape[1], sub
    cells = max(1, int(np.ceil(target.pixel_rad / _CELL_RAD)))
    if isinstance(target, Equirect):
        top, bottom = target.zenith_angle_rad(np.array(rows, float))
        widest = np.sin(np.clip(np.pi / 2.0, top, bottom))
        across = max(_MIN_SAMPLES, int(np.ceil(sub * widest)))
    sub, across = (-(-count // cells) * cells for count in (sub, across))
    down = first + (np.arange((last - first) * sub) + 0.5) / sub
    along = (np.arange(width * across) + 0.5) / across
    x, y, angle = lens_pixels(lens, target.rays(down, along))
    weight = target.weight(down, along)
    high, wide = sensor_shape
    reach = np.hypot(x - lens.centre_px[0], y - lens.centre_px[1])
    # Some polynomials fall again beyond the edge: the angle leaves their mirror image out.
    seen = (weight > 0) & (reach <= lens.radius_px - margin_px) & (angle <= lens.half_angle_rad)
    seen &= (x >= margin_px) & (y >= margin_px) & (x < wide - margin_px) & (y < high - margin_px)
    at = np.flatnonzero(seen)
    i, j = np.divmod(at, width * across)
    pixel, pixels = np.asarray(i // sub * width + j // across), (last - first) * width
    own = weight.ravel()[at]
    total = np.bincount(pixel, own, pixels)
    full = weight.reshape(last - first, sub, width, across).sum(axis=(1, 3)).ravel()
    share = own / total[pixel]
    mean_angle = np.asarray(np.bincount(pixel, share * angle.ravel()[at], pixels), float)
    coverage = total / np.maximum(full, 1e-30)
    return _Samples(pixel, x.ravel()[at], y.ravel()[at], share, coverage, mean_angle)


def _matrix(samples: _Samples, lattice: _Lattice, sensor_shape: tuple[int, int]) -> Any:
    """Return the matrix of one colour: samples distributed bilinearly over four pixels."""
    from scipy import sparse

    x, y = samples.x - (lattice.column + 0.5), samples.y - (lattice.row + 0.5)
    if lattice.right[0]:
        p, q = (x + y) / 2.0, (x - y) / 2.0
    else:
        p, q = x / lattice.right[1], y / lattice.down[0]
    i, j = np.floor(p).astype(np.int32), np.floor(q).astype(np.int32)
    p, q = p - i, q - j
    values, columns = [], []
    for a, of_p in ((0, 1.0 - p), (1, p)):
        for b, of_q in ((0, 1.0 - q), (1, q)):
            row = lattice.row + (i + a) * lattice.right[0] + (j + b) * lattice.down[0]
            column = lattice.column + (i + a) * lattice.right[1] + (j + b) * lattice.down[1]
            values.append((samples.share * of_p * of_q).astype(np.float32))
            columns.append(row * sensor_shape[1] + column)
    shape = len(samples.coverage), sensor_shape[0] * sensor_shape[1]
    places = np.tile(samples.pixel.astype(np.int32), 4), np.concatenate(columns)
    return sparse.coo_array((np.concatenate(values), places), shape).tocsr()


def _samples_per_pixel(target: Target, lens: LensGeometry, spacing_px: float) -> int:
    """Return the samples along one edge of a target pixel, 3 to 24.

    spacing_px: distance of sensor pixels of one colour. If 24 samples are enough for it, none of
    these pixels is between two samples; energy is then kept within 0.35 % (docs/validation.md).
    """
    half = lens.half_angle_rad
    densest = lens.radius_px * max(1.0 / np.sin(min(half, np.pi / 2)), 1.0 / half)
    needed = np.ceil(densest * target.pixel_rad / (1.1 * spacing_px))
    return int(np.clip(needed, _MIN_SAMPLES, 24))


# A raw camera needs 1 MB for each block of 36 square degrees of its sky cut. Chosen for 200 blocks.
@lru_cache(maxsize=224)
def resampler(
    target: Target, lens: LensGeometry, sensor_shape: tuple[int, int], cfa: str = ""
) -> Resampler:
    """Return the matrices from a sensor [h, w] behind `lens` to `target`; computed once, cached.

    cfa : four letters row by row, or "" for a sensor with all colours at every pixel (one matrix,
    named "").
    """
    from scipy import sparse

    sub = _samples_per_pixel(target, lens, 2.0**0.5 if cfa else 1.0)  # green pixels are densest
    height, width = target.shape
    step = max(1, _BLOCK_SAMPLES // (width * sub * sub))
    parts: dict[str, list[Any]] = {colour: [] for colour in sorted(set(cfa)) or [""]}
    seen = []
    for first in range(0, height, step):
        rows = first, min(first + step, height)
        samples = _samples(target, lens, sensor_shape, rows, sub, 1.5 if cfa else 0.75)
        seen.append((samples.coverage, samples.angle_rad))
        for colour, blocks in parts.items():
            blocks.append(_matrix(samples, _lattice(cfa, colour), sensor_shape))
    coverage, angle_rad = np.concatenate(seen, axis=1).astype(np.float32)
    return Resampler(
        {colour: sparse.vstack(blocks, format="csr") for colour, blocks in parts.items()},
        coverage,
        angle_rad,
    )
