"""Solve many small symmetric systems at once, by Cholesky's factorisation: a compiled loop.

numpy.linalg.solve factorises one matrix after the other, which takes seven times as long for the
thousands of 16 x 16 systems of `light_below`.
"""

from __future__ import annotations

import numpy as np

from fieldlum.arrays import Floats32
from fieldlum.compiled import compiled

_CHUNK = 128  # systems in work at a time, so that their factors stay in the processor's cache


@compiled
def solve_packed(matrix: Floats32, right: Floats32) -> Floats32:
    """Return the solutions of m symmetric positive definite systems, [k, m].

    matrix: lower triangles, row by row [k (k + 1) / 2, m]; right: right-hand sides [k, m].
    """
    terms, count = right.shape
    solution = np.empty_like(right)
    factor = np.empty((terms, terms, _CHUNK), matrix.dtype)
    x = np.empty((terms, _CHUNK), matrix.dtype)
    for start in range(0, count, _CHUNK):
        width = min(_CHUNK, count - start)
        for row in range(terms):
            for column in range(row + 1):
                packed = row * (row + 1) // 2 + column
                for m in range(width):
                    factor[row, column, m] = matrix[packed, start + m]
                for k in range(column):
                    for m in range(width):
                        factor[row, column, m] -= factor[row, k, m] * factor[column, k, m]
                for m in range(width):
                    if row == column:
                        factor[row, row, m] = np.sqrt(factor[row, row, m])
                    else:
                        factor[row, column, m] /= factor[column, column, m]
        for row in range(terms):  # forward
            for m in range(width):
                x[row, m] = right[row, start + m]
            for k in range(row):
                for m in range(width):
                    x[row, m] -= factor[row, k, m] * x[k, m]
            for m in range(width):
                x[row, m] /= factor[row, row, m]
        for row in range(terms - 1, -1, -1):  # backward
            for k in range(row + 1, terms):
                for m in range(width):
                    x[row, m] -= factor[k, row, m] * x[k, m]
            for m in range(width):
                x[row, m] /= factor[row, row, m]
                solution[row, start + m] = x[row, m]
    return solution
