"""Curves of a camera: response of JPEG codes, linearity of a sensor, vignetting of a lens.

Codes become linear z in [0, 1] by tables of 256 values, which are fitted to a bracket. A sensor's
deviation from linearity is a polynomial over the full scale. Vignetting is V(r) = sum c_k r^k with
r = angle / half of the full angle, and V(0) = 1.
"""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.core.arrays import Floats

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


def srgb_table() -> Floats:
    """Return linear z in [0, 1] of the codes 0 to 255 by sRGB (IEC 61966-2-1), [256]."""
    c = np.arange(256) / 255.0
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def polynomial_table(coefficients: Sequence[float]) -> Floats:
    """Return z = sum c_k (code / 255)^k of codes 0 to 255, made non-decreasing and >= 0, [256].

    coefficients : c_0 first; the .rsp file of hdrgen has c_0 last.
    """
    z = np.polynomial.polynomial.polyval(np.arange(256) / 255.0, np.asarray(coefficients, float))
    return monotone(np.asarray(z, np.float64))


def response_table(kind: str, curve: Sequence[float] = ()) -> Floats:
    """Return the linear signal z of the JPEG codes 0 to 255, [256].

    kind : linear, srgb, polynomial (curve: coefficients, c_0 first) or table (curve: 256 values).
    Raises ValueError for a table that has another length, is not finite, decreases or does not end
    above 0, and for a polynomial with under two coefficients or one that is not finite.
    """
    if kind == "table":
        z = np.asarray(curve, float)
        if z.shape != (256,) or not np.isfinite(z).all() or np.any(np.diff(z) < 0) or z[-1] <= 0:
            raise ValueError("a response table needs 256 increasing values")
        return z
    if kind == "polynomial":
        if len(curve) < 2 or not np.isfinite(curve).all():
            raise ValueError("a response polynomial needs at least two finite coefficients")
        return polynomial_table(curve)
    return srgb_table() if kind == "srgb" else np.arange(256) / 255.0


def monotone(z: Floats) -> Floats:
    """Return the non-decreasing curve [n], at least 0, that is nearest to z by least squares."""
    from scipy.optimize import isotonic_regression

    return np.maximum(isotonic_regression(np.asarray(z, float)).x, 0.0)


# A response is fitted to codes in this range; a black level (`dark_floor`) raises the lower end.
# Chosen to leave out clipped codes and JPEG ringing next to them; not measured.
LOWEST = 3
HIGHEST = 252
_FOLLOWS = 1.5  # codes that a code must fall by if the exposure halves; chosen, not measured
_FLOOR_SEEN = 10  # samples that decide about one code; chosen, not measured
_FLOOR_SEARCHED = 64  # a black level above this code is not searched; chosen, not measured


def dark_floor(codes: NDArray[np.uint8], log_exposure: Floats) -> int:
    """Return the lowest code that follows the light, 3 to 63; lower codes are black level or haze.

    codes : [places, frames], one scene point a row, 0 where a frame has no code; log_exposure :
    [frames], natural log. A code is compared with the code of the same place in the longest frame
    of at most half the exposure: above a black level the latter is clearly lower.
    """
    order = np.argsort(-np.asarray(log_exposure, float))
    log_e = np.asarray(log_exposure, float)[order]
    sorted_codes = codes[:, order].astype(int)
    held, fallen = [], []
    for j in range(len(order) - 1):
        half = np.flatnonzero(log_e[j] - log_e >= 0.95 * np.log(2.0))
        if half.size:
            a, b = sorted_codes[:, j], sorted_codes[:, half[0]]
            both = (a > 0) & (b > 0) & (a < _FLOOR_SEARCHED)
            held.append(a[both])
            fallen.append((a - b)[both])
    if not held:
        return LOWEST
    longer, fall = np.concatenate(held), np.concatenate(fallen)
    for code in range(_FLOOR_SEARCHED - 2, LOWEST - 1, -1):
        near = np.abs(longer - code) <= 1
        if near.sum() >= _FLOOR_SEEN and np.median(fall[near]) < _FOLLOWS:
            return code + 1
    return LOWEST


def fit_response(
    codes: NDArray[np.uint8], log_exposure: Floats, *, smooth: float = 30.0, low: int | None = None
) -> tuple[Floats, float]:
    """Fit a monotone response to codes of the same places in all frames, with known exposures.

    codes : [places, frames]; log_exposure : [frames], natural log; smooth : weight of smoothness.
    Codes below `low` (default: the `dark_floor` of these codes) are omitted, because a black level
    that counts as light would bend the complete curve.

    The fit is least squares in the log domain (Debevec and Malik, SIGGRAPH 1997, eq. 3) with hat
    weights and a second-difference prior; the result is then made monotone. Response and exposure
    ratios cannot both be free (Grossberg and Nayar 2003): estimate the ratios elsewhere.

    Return z [256] with z(255) = 1, and the rms residual of ln z over the codes 27 to 228. Raises
    ValueError for fewer than two frames or 20 places.
    """
    from scipy import sparse
    from scipy.sparse.linalg import spsolve

    places, frames = codes.shape
    if frames < 2 or places < 20:
        raise ValueError(f"{places} places in {frames} frames are too few for a response")
    low = dark_floor(codes, log_exposure) if low is None else low
    ok = (codes >= low) & (codes <= HIGHEST)
    place, frame = np.nonzero(ok)
    value = codes[place, frame].astype(int)
    weight = np.minimum(value - low + 1, HIGHEST - value + 1) / ((HIGHEST - low) / 2)
    n = value.size
    rows = np.arange(n)
    data = sparse.csr_matrix(
        (np.r_[weight, -weight], (np.r_[rows, rows], np.r_[value, 256 + place])),
        shape=(n, 256 + places),
    )
    curve = np.arange(1, 255)
    hat = np.minimum(curve, 255 - curve) / 127.0 + 0.05
    bend = sparse.csr_matrix(
        (
            np.r_[hat, -2 * hat, hat] * np.sqrt(smooth * n / 256 / 100),
            (np.tile(curve - 1, 3), np.r_[curve - 1, curve, curve + 1]),
        ),
        shape=(254, 256 + places),
    )
    pin = sparse.csr_matrix(([1e3], ([0], [128])), shape=(1, 256 + places))
    system = sparse.vstack([data, bend, pin, 1e-6 * sparse.eye(256 + places)]).tocsr()
    target = np.r_[weight * log_exposure[frame], np.zeros(254 + 1 + 256 + places)]
    solution = np.asarray(spsolve((system.T @ system).tocsc(), system.T @ target))
    g, light = solution[:256], solution[256:]
    middle = (value >= 27) & (value <= 228)
    residual = (g[value] - light[place] - log_exposure[frame])[middle]
    z = monotone(np.exp(g - g[255]))
    return z / z[255], float(np.sqrt(np.mean(residual**2)))
