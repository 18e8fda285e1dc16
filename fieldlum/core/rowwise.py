"""Multiply direction vectors so that a row does not depend on the other rows.

A BLAS library chooses its algorithm by the shape of a product, and algorithms add in different
orders: a row computed alone then differs in the last bit from the same row among twelve. Files that
a resumed run must write again, bit by bit, are computed with these functions instead: three
products, added in the order x, y, z.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Array, Floats


def cosines(a: Array, b: Array) -> Array:
    """Return the scalar products [n, m] of vectors a [n, 3] and b [m, 3], in their own dtype.

    For unit vectors these are the cosines of the angles between them.
    """
    out = a[:, None, 0] * b[:, 0]  # [n, m]
    out += a[:, None, 1] * b[:, 1]
    out += a[:, None, 2] * b[:, 2]
    return out


def turned(matrix: ArrayLike, vectors: ArrayLike) -> Floats:
    """Return matrix [3, 3] times each of the direction vectors [..., 3]."""
    rows = np.asarray(matrix, np.float64)
    x, y, z = np.moveaxis(np.asarray(vectors, np.float64), -1, 0)
    return np.stack([r[0] * x + r[1] * y + r[2] * z for r in rows], axis=-1)
