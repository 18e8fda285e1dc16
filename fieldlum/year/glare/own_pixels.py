"""Compute the glare of a single fisheye or perspective picture on its own pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.records import SunSource
from fieldlum.optics.projection import direction
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR
from fieldlum.year.glare.contrast import BAND_DEG, TASK_RADIUS_DEG, WINDOW_CDM2
from fieldlum.year.glare.fisheye import SUN_RADIUS_RAD
from fieldlum.year.glare.geometry import angles_from_view, position_index
from fieldlum.year.glare.metrics import combine, sums_of_sources
from fieldlum.year.glare.picture_view import (
    PictureGrid,
    PictureView,
    centres,
    picture_rays,
    row_blocks,
)
from fieldlum.year.glare.sources import PEAK_CDM2, SOURCE_CDM2, group_pixels

# Rows of a panorama of directions on which bright pixels are grouped: 0.25 degrees, a twentieth of
# the distance within which they form one source. Chosen.
_DIRECTION_ROWS = 720
# share of task cone and band that must be covered; with less the figure is NaN. Chosen, not
# measured.
_LEAST_COVERED_SHARE = 0.95
BAND_SR = 2.0 * np.pi * float(np.sin(np.radians(BAND_DEG)))  # front half of the band, sr
TASK_SR = 2.0 * np.pi * float(1.0 - np.cos(np.radians(TASK_RADIUS_DEG)))  # task cone, sr


@dataclass(frozen=True, slots=True)
class GlareSources:
    """The s glare sources of one view, [s] each, the largest contrast first.

    mean_cdm2 : mean luminance; solid_angle_sr : solid angle; right_rad, up_rad : coordinates of the
    centre by `angles_from_view`; ev_lx : vertical illuminance from the source; contrast : L^2 omega
    / P^2. label : [H, W] number of the source that a pixel belongs to, from 1 in this order; 0 for
    a pixel of no source.
    """

    mean_cdm2: Floats
    solid_angle_sr: Floats
    right_rad: Floats
    up_rad: Floats
    ev_lx: Floats
    contrast: Floats
    label: NDArray[np.int32]

    def __len__(self) -> int:
        return len(self.mean_cdm2)


def glare_of_pixels(
    luminance_cdm2: Floats32, grid: PictureGrid, sun: SunSource | None = None
) -> tuple[dict[str, float], GlareSources]:
    """Return the figures of `glare_directions` in the picture's view direction, and its sources.

    luminance_cdm2 : [H, W] without negative or missing values; grid : its weights by
    `picture_grid`. sun : a disc that is not in the pixels; it counts in the figures, but is not
    among the sources. None without one.
    """
    ev = weighted_sum(luminance_cdm2, grid.illuminance)
    sources = glare_sources(luminance_cdm2, grid)
    sums = np.zeros((4, 1))
    if len(sources):
        sums = sums_of_sources(
            sources.mean_cdm2[:, None],
            sources.solid_angle_sr[:, None],
            sources.right_rad[:, None],
            sources.up_rad[:, None],
            sources.ev_lx[:, None],
            np.array([ev]),
        )
    right, up, cosine, sun_lx = _sun_in_view(grid.view, sun)
    unit = np.ones((1, 1))
    figures = combine(
        ev * unit,
        sun_lx * max(cosine, 0.0) * unit,
        sums[None],
        sun_lx / SUN_SOLID_ANGLE_SR * (cosine > 0) * unit,
        right * unit,
        up * unit,
    )
    return {name: float(value[0, 0]) for name, value in figures.items()}, sources


def weighted_sum(values: Floats, weights: Floats) -> float:
    """Return the sum over all pixels of values times weights, [H, W] each, in double precision."""
    height, width = values.shape
    return float(
        sum(
            np.dot(values[rows].ravel().astype(float), weights[rows].ravel().astype(float))
            for rows in row_blocks(height, width)
        )
    )


def _sun_in_view(view: PictureView, sun: SunSource | None) -> tuple[float, float, float, float]:
    """Return right and up [rad], cosine, and normal illuminance [lx] of a separate sun.

    The sun is separate if it is a source of its own and not in the pixels.
    """
    if sun is None:
        return 0.0, 0.0, 1.0, 0.0
    ray = direction(sun.altitude_deg, sun.azimuth_deg)
    right, up, cosine = (float(part) for part in angles_from_view(ray, view.frame))
    return right, up, cosine, sun.normal_illuminance_lx


def disc_pixels(grid: PictureGrid, sun: SunSource) -> Floats32:
    """Return the luminance [H, W] that the sun's disc adds to the pixels of a picture, in cd/m2.

    All pixels with a centre in the disc get the same luminance, so that they have the disc's
    energy. Without such a pixel the nearest one gets the energy. A sun behind the observer or
    outside the picture, over a pixel's diagonal from the nearest one, adds nothing.
    """
    height, width = grid.solid_angle.shape
    out = np.zeros((height, width), np.float32)
    towards = grid.view.frame @ direction(sun.altitude_deg, sun.azimuth_deg)
    cosine = np.full((height, width), -1.0, np.float32)
    for rows in row_blocks(height, width):
        y, x = centres(rows, height, width)
        rays = picture_rays(grid.view, x, y)
        cosine[rows] = rays.right * towards[0] + rays.up * towards[1] + rays.forward * towards[2]
    disc = (cosine >= np.cos(SUN_RADIUS_RAD)) & (grid.solid_angle > 0)
    if not disc.any() and towards[2] > 0:
        nearest = int(np.argmax(np.where(grid.solid_angle > 0, cosine, -1.0)))
        diagonal_rad = np.sqrt(2.0 * grid.solid_angle.flat[nearest])
        disc.flat[nearest] = cosine.flat[nearest] >= np.cos(SUN_RADIUS_RAD + diagonal_rad)
    if disc.any():
        solid_angle = float(grid.solid_angle[disc].sum())
        out[disc] = sun.normal_illuminance_lx / solid_angle
    return out


def glare_sources(luminance_cdm2: Floats32, grid: PictureGrid) -> GlareSources:
    """Return the glare sources of a picture [H, W] with the weights `grid`.

    Pixels above 2000 cd/m2 that are closer than 0.1 rad form one source; pixels from 50 000 cd/m2
    on form sources of their own, as in `sources_of`.
    """
    label = np.zeros(luminance_cdm2.shape, np.int32)
    row, column = np.nonzero((luminance_cdm2 > SOURCE_CDM2) & (grid.solid_angle > 0.0))
    if len(row) == 0:
        none = np.zeros(0)
        return GlareSources(none, none, none, none, none, none, label)
    height, width = luminance_cdm2.shape
    rays = picture_rays(grid.view, (column + 0.5) / width - 0.5, 0.5 - (row + 0.5) / height)
    bright = luminance_cdm2[row, column].astype(float)
    number = _numbered(rays.right, rays.up, rays.forward, bright >= PEAK_CDM2)
    count = int(number.max()) + 1
    omega = grid.solid_angle[row, column].astype(float)
    right, up, _ = angles_from_view(
        np.stack([rays.right, rays.up, rays.forward], axis=-1), np.eye(3)
    )

    def total(values: Floats) -> Floats:
        return np.bincount(number, values, count).astype(float)

    power = total(bright * omega)
    solid_angle = total(omega)
    mean = power / solid_angle
    centre = total(bright * omega * right) / power, total(bright * omega * up) / power
    ev = total(bright * grid.illuminance[row, column])
    contrast = mean**2 * solid_angle / position_index(*centre) ** 2
    order = np.argsort(contrast)[::-1]
    place = np.empty(count, np.int32)
    place[order] = np.arange(1, count + 1)
    label[row, column] = place[number]
    return GlareSources(
        mean[order],
        solid_angle[order],
        centre[0][order],
        centre[1][order],
        ev[order],
        contrast[order],
        label,
    )


def _numbered(right: Floats, up: Floats, forward: Floats, peak: Mask) -> NDArray[np.int64]:
    """Return the source index of each bright pixel, from 0, [k]; peaks are separate sources."""
    rows, columns = _DIRECTION_ROWS, 2 * _DIRECTION_ROWS
    altitude = np.arcsin(np.clip(up, -1.0, 1.0))
    row = np.clip(((0.5 - altitude / np.pi) * rows).astype(int), 0, rows - 1)
    turn = np.arctan2(right, forward) / (2.0 * np.pi) + 0.5
    column = (turn * columns).astype(int) % columns

    def groups(chosen: Mask) -> NDArray[np.int32]:
        mask = np.zeros((rows, columns), bool)
        mask[row[chosen], column[chosen]] = True
        return group_pixels(mask)

    number = groups(np.ones(len(row), bool))[row, column]
    if peak.any():
        number = np.where(peak, groups(peak)[row, column] + number.max(), number)
    return np.unique(number, return_inverse=True)[1].reshape(-1)


def region_ratios(luminance_cdm2: Floats, grid: PictureGrid) -> dict[str, float]:
    """Return task_cdm2, window_to_task and uniformity of a picture, as `ViewRegions.ratios` does.

    luminance_cdm2 : [H, W]; grid : its weights by `picture_grid`. task_cdm2 and window_to_task are
    NaN if the picture covers less than 95 % of the task cone, uniformity if it covers less than 95
    % of the band; window_to_task also without a pixel above 2000 cd/m2.
    """
    totals = np.zeros(7)
    height, width = luminance_cdm2.shape
    for rows in row_blocks(height, width):
        values = luminance_cdm2[rows].astype(float)
        omega = grid.solid_angle[rows].astype(float)
        task, band = omega * grid.task[rows], omega * grid.band[rows]
        bright = omega * (values > WINDOW_CDM2)
        inverse = 1.0 / np.maximum(values, 0.1)
        sums = (task, task * values, band, band * values, band * inverse, bright, bright * values)
        totals += [part.sum() for part in sums]
    task_sr, task_power, band_sr, band_power, band_inverse, bright_sr, bright_power = totals
    task = task_power / task_sr if task_sr > _LEAST_COVERED_SHARE * TASK_SR else np.nan
    window = bright_power / bright_sr if bright_sr > 0 else np.nan
    uniformity = np.nan
    if band_sr > _LEAST_COVERED_SHARE * BAND_SR and band_power > 0:
        uniformity = band_sr**2 / (band_inverse * band_power)
    return {
        "task_cdm2": float(task),
        "window_to_task": float(window / max(task, 1e-6)) if task == task else np.nan,
        "uniformity": float(uniformity),
    }
