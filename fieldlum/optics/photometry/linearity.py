"""Correct a sensor's deviation from linearity, by a polynomial over the full scale."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

T = TypeVar("T", bound=np.floating)


def linearity_factor(share: NDArray[T], coefficients: Sequence[float]) -> NDArray[T]:
    """Return the factor that makes counts proportional to light: 1 + a1 x + a2 x^2 + ...

    coefficients: a1 first; empty gives 1. share: x, counts above black over those of the
    full scale, any shape, limited to 0 to 1. The factor at x = 0 and below is 1.
    """
    x = np.clip(share, 0.0, 1.0)
    factor: NDArray[T] = np.zeros_like(x)
    for a in reversed(coefficients):
        factor = np.asarray((factor + a) * x, x.dtype)
    return np.asarray(factor + 1.0, x.dtype)


def rises(coefficients: Sequence[float]) -> bool:
    """Return whether counts corrected by `linearity_factor` increase strictly with raw counts.

    coefficients: a1 first. 201 points from 0 to full scale are tested.
    """
    x = np.linspace(0.0, 1.0, 201)
    return bool((np.diff(x * linearity_factor(x, coefficients)) > 0).all())
