"""Choose the points of a panorama's surfaces at which the truth gathers its light."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Indices
from fieldlum.room.scene.view import SceneView
from fieldlum.room.simulate.gather import representatives


@dataclass(frozen=True)
class PixelPoints:
    """One point for each face in each pixel, and for its mirror: m points.

    rows [m]: of the view's samples; normals [m, 3]; code [m]: of the point's face, other for a
    mirrored one; smooth: CSR [m, m], means over neighbours on one face; to_pixels: CSR [H W, m],
    from the points' irradiance to luminance.
    """

    rows: Indices
    normals: Floats
    code: NDArray[np.int64]
    smooth: Any
    to_pixels: Any


def sample_codes(
    box: NDArray[np.integer], axis: NDArray[np.integer], sign: NDArray[np.integer], straight: int
) -> NDArray[np.int64]:
    """Return a number for the face of each sample [n]: even if straight, odd if mirrored.

    straight: index of the first mirrored sample.
    """
    code = (box.astype(np.int64) * 6 + axis * 2 + (sign > 0)) * 2
    code[straight:] += 1
    return code


def pixel_points(view: SceneView, smooth_px: int) -> PixelPoints:
    """Choose the points to gather light at.

    smooth_px: radius within which neighbours on one face share their light.
    """
    from scipy.sparse import csr_matrix

    code = sample_codes(view.box, view.axis, view.sign, view.first_mirrored)
    weight = view.weight * view.scene.reflectance[view.box] / np.pi
    # mirrored after straight points within a pixel, by face
    rows, total = representatives((view.pixel, code // 2, code % 2), view.position, weight)
    m = len(rows)
    direct = csr_matrix(
        (total.astype(np.float32), (view.pixel[rows], np.arange(m))), (2 * view.height**2, m)
    )
    normals = np.zeros((m, 3))
    normals[np.arange(m), view.axis[rows]] = view.sign[rows]
    smooth = _neighbours(view.pixel[rows], code[rows], view.position[rows], view, smooth_px)
    return PixelPoints(rows, normals, code[rows], smooth, (direct @ smooth).tocsr())


def _neighbours(
    pixel: NDArray[np.int32],
    face: NDArray[np.int64],
    position: Floats,
    view: SceneView,
    radius: int,
) -> Any:
    """Return the averaging matrix [m, m] over points of one face in pixels within `radius`.

    Points further away in space have less weight.
    """
    from scipy.sparse import coo_matrix, diags

    width = 2 * view.height
    code = face * (2 * view.height**2) + pixel
    order = np.argsort(code)
    sorted_codes = code[order]
    row, column = np.divmod(pixel.astype(np.int64), width)
    reach = np.linalg.norm(position - np.array(view.scene.camera_m), axis=1) * np.pi / view.height
    parts = []
    for di in range(-radius, radius + 1):
        for dj in range(-radius, radius + 1):
            if di * di + dj * dj > radius * radius + 1:
                continue
            other = face * (2 * view.height**2) + (row + di) * width + (column + dj) % width
            at = np.minimum(np.searchsorted(sorted_codes, other), len(sorted_codes) - 1)
            good = (sorted_codes[at] == other) & (row + di >= 0) & (row + di < view.height)
            i, j = np.flatnonzero(good), order[at[good]]
            away = np.linalg.norm(position[i] - position[j], axis=1) / (reach[i] * max(radius, 1))
            parts.append((i, j, np.exp(-(away**2))))
    i, j, value = (np.concatenate(p) for p in zip(*parts, strict=True))
    share = coo_matrix((value, (i, j)), (len(pixel), len(pixel))).tocsr()
    return (diags(1 / np.asarray(share.sum(axis=1)).ravel()) @ share).astype(np.float32)
