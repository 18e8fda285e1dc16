"""Vignetting: V(r) = sum c_k r^k with r = angle / half of the full angle, and V(0) = 1."""

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats


def vignetting_at(coefficients: tuple[float, ...], radius: ArrayLike) -> Floats:
    """Return the vignetting V = sum c_k radius^k, in the shape of `radius`.

    coefficients : c_0 first; none give 1. radius : angle from the axis over half of the full angle,
    limited to 0 to 1.
    """
    r = np.clip(np.asarray(radius, float), 0.0, 1.0)
    return np.asarray(
        np.polynomial.polynomial.polyval(r, np.asarray(coefficients or (1.0,), float)), np.float64
    )


def check_vignetting(coefficients: tuple[float, ...]) -> str:
    """Return what is wrong with a vignetting curve V(r), or "".

    V must be finite, V(0) within 0.01 of 1, 0 < V <= 1.05, and V at most 1 at the edge. A curve
    that rises towards the edge is a common error of sign: it darkens where it should brighten.
    """
    v = vignetting_at(coefficients, np.linspace(0, 1, 201))
    if not np.isfinite(v).all() or abs(v[0] - 1) > 0.01:
        return f"the vignetting V on the axis is {v[0]:.3g}, not 1"
    if v.min() <= 0 or v.max() > 1.05:
        return f"the vignetting V runs from {v.min():.3g} to {v.max():.3g}, not within 0 to 1.05"
    if v[-1] > 1.0:
        return (
            f"the vignetting V rises to {v[-1]:.3g} at the edge: a sign is wrong, or V is the "
            "correction instead of the loss"
        )
    return ""
