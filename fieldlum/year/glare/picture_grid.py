"""Weight a single picture's own pixels, so that it is judged without resampling."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.year.glare.contrast import BAND_DEG, TASK_ALTITUDE_DEG, TASK_RADIUS_DEG
from fieldlum.year.glare.picture_view import PictureView, picture_rays

_BLOCK_PIXELS = 250_000  # pixels processed at a time: about 40 MB of temporary arrays; chosen
# Samples along an edge of the picture, which make solid angles exact to 1e-4. Chosen.
_FINE_SAMPLES = 400
# Samples along an edge of a pixel that the hemisphere's edge crosses; chosen, not measured.
_RIM_SAMPLES = 8
# below this cosine, the solid angle of a -vth pixel varies within the pixel; chosen
_GRAZING_COSINE = 0.1


@dataclass(frozen=True, slots=True)
class PictureGrid:
    """The weights of each pixel of a picture with the view `view`, [H, W] each.

    solid_angle : of the pixel's part in front of the observer, sr; illuminance : this times the
    cosine to the view direction, sr. Both are 0 behind the observer. task, band : masks, True for
    pixels in the task cone and in the horizontal band (see `contrast.ViewRegions`).
    """

    view: PictureView
    solid_angle: Floats32
    illuminance: Floats32
    task: Mask
    band: Mask

    @property
    def covered_share(self) -> float:
        """Share (0 to 1) of the front hemisphere's solid angle that the picture covers."""
        return min(1.0, float(self.solid_angle.sum(dtype=float)) / (2.0 * np.pi))


def picture_grid(view: PictureView, height: int, width: int) -> PictureGrid:
    """Return the weights of each pixel of a picture of height x width pixels with a Radiance view.

    They need 10 bytes of memory for each pixel.
    """
    solid_angle = np.zeros((height, width), np.float32)
    illuminance = np.zeros((height, width), np.float32)
    task, band = np.zeros((height, width), bool), np.zeros((height, width), bool)
    samples = int(np.clip(np.ceil(_FINE_SAMPLES / min(height, width)), 1, _RIM_SAMPLES))
    for rows in row_blocks(height, width):
        y, x = centres(rows, height, width)
        rays = picture_rays(view, x, y)
        task[rows], band[rows] = _regions(rays.up, rays.forward)
        solid_angle[rows], illuminance[rows] = _weights(view, x, y, (height, width), samples)
        rim = _rim(view, x, y, (height, width))
        if samples < _RIM_SAMPLES and rim.any():
            row, column = np.nonzero(rim)
            fine = _weights(view, x[0, column], y[row, 0], (height, width), _RIM_SAMPLES)
            solid_angle[rows][rim], illuminance[rows][rim] = fine
    return PictureGrid(view, solid_angle, illuminance, task, band)


def row_blocks(height: int, width: int) -> Iterator[slice]:
    """Yield slices of rows, from the top, that divide a picture of height x width pixels.

    A slice has at most 250 000 pixels, but at least one row.
    """
    step = max(1, _BLOCK_PIXELS // width)
    for first in range(0, height, step):
        yield slice(first, min(first + step, height))


def centres(rows: slice, height: int, width: int) -> tuple[Floats, Floats]:
    """Return y [k, 1] and x [1, W] of the centres of pixels in the k rows of the slice `rows`.

    Both run from -1/2 to 1/2 over the picture of height x width pixels, x to the right, y upwards;
    row 0 is at the top.
    """
    y = 0.5 - (np.arange(rows.start, rows.stop) + 0.5) / height
    x = (np.arange(width) + 0.5) / width - 0.5
    return y[:, None], x[None, :]


def _weights(
    view: PictureView, x: Floats, y: Floats, shape: tuple[int, int], samples: int
) -> tuple[Floats, Floats]:
    """Return solid angle, and solid angle times cosine, of each pixel's part in front, in sr."""
    height, width = shape
    steps = (np.arange(samples) + 0.5) / samples - 0.5
    solid_angle, illuminance = np.zeros(1), np.zeros(1)
    for dy in steps / height:
        for dx in steps / width:
            rays = picture_rays(view, x + dx, y + dy)
            part = np.where(rays.forward > 0.0, rays.density, 0.0)
            solid_angle = solid_angle + part
            illuminance = illuminance + part * np.maximum(rays.forward, 0.0)
    pixel = 1.0 / (height * width * samples**2)
    return solid_angle * pixel, illuminance * pixel


def _rim(view: PictureView, x: Floats, y: Floats, shape: tuple[int, int]) -> Mask:
    """Return a mask [k, W] of pixels on the edge of the hemisphere, and of grazing -vth ones."""
    height, width = shape
    corner_y = np.append(y[:, 0] + 0.5 / height, y[-1, 0] - 0.5 / height)[:, None]  # [k + 1, 1]
    corner_x = np.append(x[0] - 0.5 / width, x[0, -1] + 0.5 / width)[None, :]  # [1, W + 1]
    rays = picture_rays(view, corner_x, corner_y)
    ahead = (rays.forward > 0.0) & (rays.density > 0.0)
    grazing = (rays.forward < _GRAZING_COSINE) & (view.kind == "h")
    count = sum(
        part.astype(np.int8)
        for part in (ahead[:-1, :-1], ahead[1:, :-1], ahead[:-1, 1:], ahead[1:, 1:])
    )
    return (count > 0) & ((count < 4) | grazing[:-1, :-1])


def _regions(up: Floats, forward: Floats) -> tuple[Mask, Mask]:
    """Return two masks: pixels in the task cone, and pixels in the 40-degree horizontal band.

    The task cone is 30 degrees below the line of sight. up, forward : components of each pixel's
    direction along the axes of the view.
    """
    below = np.radians(TASK_ALTITUDE_DEG)
    to_task = up * np.sin(below) + forward * np.cos(below)
    task = to_task > np.cos(np.radians(TASK_RADIUS_DEG))
    return task, (forward > 0.0) & (np.abs(up) < np.sin(np.radians(BAND_DEG)))
