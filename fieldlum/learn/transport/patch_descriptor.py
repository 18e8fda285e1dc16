"""Describe sun patches for the kernel: their light in cells of the picture, and all of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.sky.light import Features, Light

# cells of the patch descriptor, about 8 x 16 degrees each; not measured
CELL_ROWS = CELL_COLUMNS = 23
# Upper limit for the descriptor only: the luminance of a sunlit white wall. Brighter pixels show a
# window or a disc. Chosen.
MOST_PATCH_CDM2 = 3e4
FAINT_SUN_LX = 20.0  # less direct light is not visible in a room; not measured


@dataclass(frozen=True, slots=True)
class PatchDescriptor:
    """How maps of sun patches become features: their light in each cell, and all of it.

    The picture is divided into at most 23 x 23 cells. cells_norm, flux_norm: divisors, from the
    captured hours, so that the features are about one when the sun is in the room. flux_norm is
    None for models of fieldlum 0.2.0, which do not use the flux.
    """

    cells_norm: float
    flux_norm: float | None = None

    def add(self, features: Features, patch: Floats, light: Light, open_sky: NDArray) -> Features:
        """Return `features` with `cells` and `flux`, divided by total light and by their norms.

        patch: luminance of sun patches [n, H, W] cd/m2; open_sky: mask [H, W], True at window
        pixels, which do not count.
        """
        cells = patch_cells(patch, open_sky)  # [n, c]
        flux = None
        if self.flux_norm is not None:
            flux = flux_lx(cells, patch.shape[1:]) / (light.total_lx * self.flux_norm)  # [n]
            flux[light.direct_lx == 0.0] = 0.0  # of a sun that no instrument measured
        unit = light.total_lx[:, None] * self.cells_norm  # [n, 1]
        return replace(features, cells=(cells / unit).astype(np.float32), flux=flux)


def _edges(size: int, count: int) -> Indices:
    return np.unique(np.linspace(0, size, min(count, size) + 1).astype(int))[:-1]


def _summed(picture: Floats) -> Floats:
    """Return the sums of a picture [H, W] over its cells, [rows, columns]."""
    rows, columns = _edges(picture.shape[0], CELL_ROWS), _edges(picture.shape[1], CELL_COLUMNS)
    return np.add.reduceat(np.add.reduceat(picture, rows, axis=0), columns, axis=1)


def cell_areas_sr(height: int, width: int) -> Floats:
    """Return the solid angle of each cell into which a map is divided, [c] sr."""
    return _summed(equirect_solid_angles(height, width).astype(np.float32)).ravel()


def patch_cells(patch: Floats, open_sky: Mask) -> Floats32:
    """Return the light of the sun patches in each of c cells of the picture, [n, c].

    It is the luminance of the patches (patch [n, H, W] cd/m2, clipped at 3e4) integrated over the
    solid angle of the cell [lx], divided by the root of that solid angle. open_sky: mask [H, W],
    True at window pixels, which do not count.
    """
    height, width = patch.shape[1:]
    omega = equirect_solid_angles(height, width).astype(np.float32)
    weights = np.where(open_sky, np.float32(0.0), omega)  # [H, W]
    root = np.sqrt(cell_areas_sr(height, width))  # [c]
    out = np.empty((len(patch), root.size), np.float32)
    for t, picture in enumerate(patch):
        lit = np.minimum(picture, np.float32(MOST_PATCH_CDM2)) * weights
        out[t] = _summed(lit).ravel() / root
    return out


def direct_flux_lx(patch: Floats, open_sky: Mask) -> Array:
    """Return the luminance of sun patches, integrated over the solid angle of the picture, [n] lx.

    patch: [n, H, W] cd/m2, clipped at 3e4; open_sky: mask [H, W], True at window pixels, which do
    not count.
    """
    return flux_lx(patch_cells(patch, open_sky), patch.shape[1:])


def flux_lx(cells: Floats, shape: tuple[int, ...]) -> Array:
    """Return `direct_flux_lx` from the result of `patch_cells` [n, c]; shape: of the picture."""
    return np.asarray(cells @ np.sqrt(cell_areas_sr(shape[0], shape[1])), float)


def describe_patches(patch: Floats, light: Light, open_sky: Mask) -> PatchDescriptor:
    """Return the descriptor whose features are about one in a typical sunny hour.

    Each norm is the 75th percentile over sunny hours of the size per direct illuminance, at least a
    tenth of the largest; 1 if there is no sunny hour. patch: [n, H, W] cd/m2; open_sky: [H, W]
    marks windows.
    """
    cells = patch_cells(patch, open_sky)
    sunny = light.direct_lx > FAINT_SUN_LX
    if not sunny.any() or not cells[sunny].any():
        return PatchDescriptor(1.0, 1.0)

    def norm(size: Array) -> float:
        share = size[sunny] / light.direct_lx[sunny]
        return max(float(np.percentile(share, 75)), 0.1 * float(share.max()))

    flux = flux_lx(cells, patch.shape[1:])
    return PatchDescriptor(norm(np.linalg.norm(cells, axis=1)), norm(flux))
