"""Compute the stray light of a lens: light from one direction, recorded at other directions.

A lens records L(x) + S(x) instead of L(x), with S(x) = integral of K(angle between x and y) L(y)
over all directions y that it sees (a point spread that depends only on the angle, as in CIE 146 for
the eye). K includes scatter and the common haze of many reflections. Ghosts (images of a lamp
mirrored at the axis) do not depend only on the angle: they remain, and the kernel's `u_rel`,
measured on held-out readings, must cover them.
"""

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.optics.projection import altitude_azimuth_deg, equirect_pixel, equirect_rays, wrapped

# Rows of source cells of 3 degrees. K is constant below half of a cell, because nearer light is the
# lens's blur, not haze.
_ROWS = 60
_TABLE = 4096  # steps of sin(angle / 2); 0.03 degrees near 0


def kernel_per_sr(angle_rad: Floats, nodes_deg: Floats, values_per_sr: Floats) -> Floats:
    """Return the stray-light kernel K [1/sr]: linear in ln(angle) between nodes, constant outside.

    nodes_deg, values_per_sr: k ascending angles above 0 and K there, [k] each. The result has the
    shape of angle_rad.
    """
    place = np.log(np.maximum(angle_rad, np.radians(nodes_deg[0])))
    return np.interp(place, np.log(np.radians(nodes_deg)), values_per_sr)


def stray_cdm2(
    luminance_cdm2: Floats,
    solid_angle_sr: Floats,
    rays: Floats,
    nodes_deg: Floats,
    values_per_sr: Floats,
) -> Floats:
    """Return the stray light at each pixel [n], in cd/m2, from the recorded luminances.

    luminance_cdm2, solid_angle_sr: [n], 0 where the lens sees nothing; rays: [n, 3], unit;
    nodes_deg, values_per_sr: [k], ascending angles above 0 and the kernel K there. The recorded
    light is used in place of the true light: an error of second order in K, which the fit of K
    makes in the same way.
    """
    from scipy.ndimage import map_coordinates

    flux = luminance_cdm2 * solid_angle_sr
    row, column = equirect_pixel(*altitude_azimuth_deg(rays), _ROWS, 2 * _ROWS, 0.0)
    cells = np.minimum(row.astype(np.intp), _ROWS - 1) * 2 * _ROWS + column.astype(np.intp)
    # light of each cell, and the mean direction of that light
    sums = [np.bincount(cells, flux * v, 2 * _ROWS**2) for v in (np.ones(len(rays)), *rays.T)]
    light, centre = np.asarray(sums[0], np.float64), np.stack(sums[1:], axis=1, dtype=np.float64)
    lit = light > 0
    centre[lit] /= np.linalg.norm(centre[lit], axis=1)[:, None]
    # A cell with at least 1 % of all light acts on each pixel and not on the coarse grid, because
    # near a window or lamp the stray light changes faster than the grid.
    bright = light >= 0.01 * max(float(light.sum()), 1e-30)
    half_angle = np.arcsin(np.linspace(0.0, 1.0, _TABLE + 1))
    table = kernel_per_sr(2 * half_angle, nodes_deg, values_per_sr)
    middles = equirect_rays(_ROWS, 2 * _ROWS, 0.0).reshape(-1, 3)
    grid = _field(middles, centre[lit & ~bright], light[lit & ~bright], table)
    # 0.5 from edges to centres of cells, 1 for the column that `wrapped` adds
    places = [row - 0.5, column - 0.5 + 1.0]
    dim = map_coordinates(wrapped(grid.reshape(_ROWS, -1)), places, order=1, mode="nearest")
    return dim + _field(rays, centre[bright], light[bright], table)


def _field(at: Floats, sources: Floats, light: Floats, table: Floats) -> Floats:
    """Return the stray light of sources at directions `at` [n, 3]: the sum of K times light, [n].

    sources: unit vectors of m sources [m, 3]; light [m]: luminance times solid angle [cd/m2 sr];
    table: K [1/sr] at equal steps of sin(angle / 2).
    """
    out, block = np.zeros(len(at)), 512  # directions at a time, to limit memory
    for start in range(0, len(at), block):
        part = at[start : start + block]
        # Three products and not a matrix product, to get the same bits on every processor.
        cosine = sum(part[:, axis : axis + 1] * sources[:, axis] for axis in range(3))
        sine_half = np.sqrt(np.clip(0.5 - 0.5 * cosine, 0.0, 1.0))
        step = (sine_half * _TABLE + 0.5).astype(np.int32)  # [block, m]
        out[start : start + block] = (table[step] * light).sum(axis=1)
    return out
