"""Group bright pixels into glare sources.

A pixel brighter than 2 000 cd/m2 belongs to a source. Pixels closer than 0.1 rad (5.7 degrees) to
each other belong to the same source, so that the panes of a window are one source. The position of
a source is its luminance-weighted centre. Pixels from 50 000 cd/m2 on are removed from their source
and form sources of their own. These are evalglare's defaults (-b 2000, -r 0.2 with its own
definition of the search angle, -Y 50000). An additive sum over pixels, which needs no grouping, is
higher for windows with bright and dark panes (docs/validation.md, "Glare").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Mask
from fieldlum.optics.projection import altitude_azimuth_deg, equirect_pixel
from fieldlum.year.glare.geometry import Views, position_index

# evalglare's defaults: -b 2000, -Y 50000, -r 0.2 (its search angle is twice this distance).
SOURCE_CDM2 = 2000.0
PEAK_CDM2 = 50_000.0
REACH_RAD = 0.1


def widen(mask: Mask, radius_rad: float) -> Mask:
    """Return a mask [H, W], True for panorama pixels within `radius_rad` of a True pixel of `mask`.

    mask : [H, W = 2H]. Distances are angles on the sphere, also across the panorama's seam.
    """
    height, width = mask.shape
    rows = np.flatnonzero(mask.any(axis=1))
    out = np.zeros_like(mask)
    if len(rows) == 0:
        return out
    reach = max(1, round(radius_rad / np.pi * height))
    first, last = max(0, rows[0] - reach), min(height, rows[-1] + reach + 1)
    altitude = np.pi / 2 - (np.arange(height) + 0.5) / height * np.pi
    tiled = np.concatenate([mask, mask, mask], axis=1)[rows[0] : rows[-1] + 1]
    counts = np.zeros((height, 3 * width + 1), np.int32)
    counts[rows[0] : rows[-1] + 1, 1:] = np.cumsum(tiled, axis=1)
    columns = np.arange(width, 2 * width)
    for row in range(first, last):
        near = np.arange(max(rows[0], row - reach), min(rows[-1], row + reach) + 1)
        # Haversine formula: half the width, in columns, of the small circle where it meets the
        # other row.
        rest = np.sin(radius_rad / 2) ** 2 - np.sin((altitude[near] - altitude[row]) / 2) ** 2
        near, rest = near[rest >= 0], rest[rest >= 0]
        share = rest / (np.cos(altitude[near]) * np.cos(altitude[row]))
        half = np.floor(np.arcsin(np.sqrt(np.minimum(share, 1.0))) / np.pi * width).astype(int)
        for other, reach_columns in zip(near, np.minimum(half, width // 2), strict=True):
            line = counts[other]
            out[row] |= line[columns + reach_columns + 1] > line[columns - reach_columns]
    return out


def group_pixels(mask: Mask) -> NDArray[np.int32]:
    """Return the number of the glare source of each pixel, from 1, [H, W]; 0 outside `mask`.

    mask : [H, W = 2H] of a panorama, True for bright pixels. Pixels closer than 0.1 rad belong to
    one source.
    """
    from scipy.ndimage import label

    labels = np.zeros(mask.shape, np.int32)
    label(widen(mask, REACH_RAD / 2), structure=np.ones((3, 3)), output=labels)
    if labels.max() > 1:
        labels = _join_seam(labels, int(labels.max()))
    return np.where(mask, labels, 0).astype(np.int32)


def _join_seam(labels: NDArray[np.int32], count: int) -> NDArray[np.int32]:
    """Join sources that meet across the panorama's seam, or at the zenith or nadir."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    left, right = labels[:, 0], labels[:, -1]
    pairs = [(left, right), (left[1:], right[:-1]), (left[:-1], right[1:])]
    pairs += [(row, np.full_like(row, row.max())) for row in (labels[0], labels[-1])]
    a, b = (np.concatenate([pair[k] for pair in pairs]) for k in (0, 1))
    both = (a > 0) & (b > 0)
    graph = coo_array((np.ones(int(both.sum())), (a[both], b[both])), shape=(count + 1, count + 1))
    joined = connected_components(graph, directed=False)[1]
    return np.where(labels > 0, joined[labels] + 1, 0).astype(np.int32)


@dataclass(frozen=True, slots=True)
class Sources:
    """The s glare sources of a picture in d view directions, [s, d] each.

    mean_cdm2 : mean luminance; solid_angle_sr; right_rad, up_rad : coordinates of the centre by
    `angles_from_view`; ev_lx : vertical illuminance from the source. pixels : flat indices of the
    pixels of each.
    """

    mean_cdm2: Floats
    solid_angle_sr: Floats
    right_rad: Floats
    up_rad: Floats
    ev_lx: Floats
    pixels: list[NDArray[np.int64]]

    @property
    def contrast(self) -> Floats:
        """L^2 omega / P^2 of each source, [s, d]: its part of the contrast term of DGP."""
        index = position_index(self.right_rad, self.up_rad)
        return self.mean_cdm2**2 * self.solid_angle_sr / index**2


def glare_sources(luminance_cdm2: Floats, views: Views) -> Sources:
    """Return the glare sources of a picture [H, W] with the weights `views`."""
    pixels = sources_of(luminance_cdm2, None if views.is_panorama else views)
    chosen = np.concatenate([np.zeros(0, np.int64), *pixels])
    starts = np.cumsum([0, *map(len, pixels)])[:-1]
    bright = luminance_cdm2.ravel()[chosen].astype(float)[:, None]

    def total(values: Floats) -> Floats:
        return np.add.reduceat(values, starts, axis=0, dtype=float)

    omega, right, up = np.moveaxis(views.moments[chosen], 1, 0)  # [n, d] each
    power, area = np.maximum(total(bright * omega), 1e-30), total(omega)
    return Sources(
        power / np.maximum(area, 1e-30),
        area,
        total(bright * right) / power,
        total(bright * up) / power,
        total(bright * views.illuminance[chosen]),
        pixels,
    )


def sources_of(luminance_cdm2: Floats, views: Views | None = None) -> list[NDArray[np.int64]]:
    """Return an array of flat pixel indices for each glare source of a picture [H, W] in cd/m2.

    views : weights of a picture that is no panorama; pixels without a weight are no source. Pixels
    above 2000 cd/m2 that are closer than 0.1 rad form one source. Pixels from 50 000 cd/m2 on
    (peaks) form sources of their own, which come last. The list is empty without bright pixels.
    """
    bright, shape = luminance_cdm2 > SOURCE_CDM2, luminance_cdm2.shape
    if views is not None:
        bright &= views.moments[:, 0, 0].reshape(shape) > 0.0
    pixels = np.flatnonzero(bright)
    if len(pixels) == 0:
        return []
    row, column = np.unravel_index(pixels, shape)
    if views is not None:  # grouped on a panorama of the directions
        # Rows of a panorama of directions on which bright pixels of other pictures are grouped:
        # 0.25 degrees, a twentieth of the distance within which they form one source. Chosen.
        shape = (720, 2 * 720)
        right, up, forward = np.moveaxis(views.rays(pixels)[0][:, :, 0], 1, 0)
        altitude_deg, azimuth_deg = altitude_azimuth_deg(np.stack([right, forward, up], axis=-1))
        row, column = (
            np.clip(place.astype(int), 0, size - 1)
            for place, size in zip(
                equirect_pixel(altitude_deg, azimuth_deg, *shape, 0.0), shape, strict=True
            )
        )

    def groups(chosen: Mask) -> NDArray[np.int32]:
        mask = np.zeros(shape, bool)
        mask[row[chosen], column[chosen]] = True
        return group_pixels(mask)[row, column]

    number = groups(np.ones(len(pixels), bool))
    peaks = luminance_cdm2.ravel()[pixels] >= PEAK_CDM2
    if peaks.any():
        number = np.where(peaks, groups(peaks) + number.max(), number)
    order = np.argsort(number, kind="stable")
    return np.split(pixels[order], np.flatnonzero(np.diff(number[order])) + 1)
