"""Compute the luminance of RGB values from the chromaticities of a file's primaries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fieldlum.core.arrays import Floats

# Radiance's primaries, red, green, blue and white, as CIE xy (Ward Larson and Shakespeare 1998;
# src/common/color.h). Every picture of rpict 6 states them.
RADIANCE_CHROMATICITIES = (0.640, 0.330, 0.290, 0.600, 0.150, 0.060, 1.0 / 3.0, 1.0 / 3.0)
# ITU-R BT.709, which OpenEXR assumes where a file has no attribute `chromaticities`.
BT709_CHROMATICITIES = (0.640, 0.330, 0.300, 0.600, 0.150, 0.060, 0.3127, 0.3290)
# Twice the area of a triangle of primaries, in xy; BT.709 has 0.22. Chosen.
_ON_A_LINE = 1e-4
_SAME_XY = 5e-4  # half a unit of the third decimal, to which programs write chromaticities


def same_chromaticities(a: Sequence[float], b: Sequence[float]) -> bool:
    """Return whether the chromaticities of two sets of primaries [8] agree to three decimals."""
    return bool(np.max(np.abs(np.subtract(a, b))) < _SAME_XY)


def rgb_to_xyz(chromaticities: Sequence[float]) -> Floats:
    """Return the matrix from RGB to XYZ with Y = 1 for R = G = B = 1, [3, 3].

    chromaticities : x, y of red, green, blue and white, [8]. A primary need not be a real colour:
    blue of ACES AP0 has y = -0.077 (SMPTE ST 2065-1). Raises ValueError for values that are not
    finite, a y of 0, and a white that is not between the primaries.
    """
    xy = np.asarray(chromaticities, float).reshape(4, 2)
    if not np.isfinite(xy).all() or (xy[:, 1] == 0).any():
        raise ValueError("chromaticities must be finite numbers with y other than 0")
    corners = np.vstack([xy[:3].T, np.ones(3)])  # [3, 3]
    if abs(float(np.linalg.det(corners))) < _ON_A_LINE:
        raise ValueError("the three primaries are on one line")
    if (np.linalg.solve(corners, [*xy[3], 1.0]) <= 0).any():
        raise ValueError("white is not between the three primaries")
    xyz = np.stack([xy[:, 0], xy[:, 1], 1.0 - xy.sum(axis=1)], axis=1) / xy[:, 1:]  # [4, 3]
    columns = xyz[:3].T  # [3, 3]
    return columns * np.linalg.solve(columns, xyz[3])


def luminance_weights(chromaticities: Sequence[float]) -> Floats:
    """Return the shares of R, G and B in luminance, with sum 1, [3].

    The share of a primary that is no real colour may be negative. Raises the errors of
    `rgb_to_xyz`.
    """
    return rgb_to_xyz(chromaticities)[1]
