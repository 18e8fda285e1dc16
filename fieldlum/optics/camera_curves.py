"""Compute the curves of a camera: linearity of a sensor, vignetting of a lens, response of JPEG.

A sensor's deviation from linearity is a polynomial in the share of the full scale. Vignetting is
V(r) = sum c_k r^k, V(0) = 1, with r the angle from the axis over half of the full angle. A response
is a table of the linear light z (1 at full scale) of the 256 codes.
"""

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike, NDArray

from fieldlum.core.arrays import Floats, UInts8

T = TypeVar("T", bound=np.floating)


def linearity_factor(share: NDArray[T], coefficients: Sequence[float]) -> NDArray[T]:
    """Return the factor by which counts become proportional to light: 1 + a1 x + a2 x^2 + ...

    share: x, counts above black over those of the full scale [...], limited to 0 to 1; the result
    has its shape.
    coefficients: a1 first; without any, the factor is 1.
    """
    x = np.clip(share, 0.0, 1.0)
    factor: NDArray[T] = np.zeros_like(x)
    for a in reversed(coefficients):
        factor = np.asarray((factor + a) * x, x.dtype)
    return np.asarray(factor + 1.0, x.dtype)


def corrected_counts_rise(coefficients: Sequence[float]) -> bool:
    """Return whether counts corrected by `linearity_factor` increase strictly with raw counts.

    coefficients: a1 first. 201 points from 0 to full scale are tested.
    """
    x = np.linspace(0.0, 1.0, 201)
    return bool((np.diff(x * linearity_factor(x, coefficients)) > 0).all())


def vignetting_at(coefficients: tuple[float, ...], radius: ArrayLike) -> Floats:
    """Return the vignetting V = sum c_k radius^k: the lens's transmission over that on axis, [...].

    coefficients: c_0 first; none give 1. radius: angle from the axis over half of the full angle
    [...], limited to 0 to 1.
    """
    r = np.clip(np.asarray(radius, float), 0.0, 1.0)
    return np.asarray(polyval(r, coefficients or (1.0,)), np.float64)


def check_vignetting(coefficients: tuple[float, ...]) -> str:
    """Return what is wrong with a vignetting curve V(r), as part of a sentence; "" for nothing.

    coefficients: of V, c_0 first. V must be finite, V(0) within 0.01 of 1, 0 < V <= 1.05, and V at
    most 1 at the edge. A curve that rises towards the edge is a common error of sign: it darkens
    where it should brighten.
    """
    v = vignetting_at(coefficients, np.linspace(0, 1, 201))
    if not np.isfinite(v).all() or abs(v[0] - 1) > 0.01:
        return f"the vignetting V on the axis is {v[0]:.3g}, not 1"
    if v.min() <= 0 or v.max() > 1.05:
        return f"the vignetting V runs from {v.min():.3g} to {v.max():.3g}, not within 0 to 1.05"
    if v[-1] > 1.0:
        return f"the vignetting V rises to {v[-1]:.3g} at the edge: a sign is wrong"
    return ""


def response_table(kind: str, curve: Sequence[float] = ()) -> Floats:
    """Return the linear light z (1 at full scale) of the JPEG codes 0 to 255, [256].

    kind: linear, srgb (IEC 61966-2-1), table (curve: 256 values) or polynomial: sum c_k (code /
    255)^k, made non-decreasing and >= 0 (curve: c_0 first; the .rsp file of hdrgen has c_0 last).
    Raises ValueError for a table that has another length, is not finite, decreases or does not end
    above 0, and for a polynomial with under two coefficients or one that is not finite.
    """
    if kind == "table":
        z = np.asarray(curve, float)
        if z.shape != (256,) or not np.isfinite(z).all() or np.any(np.diff(z) < 0) or z[-1] <= 0:
            raise ValueError("a response table needs 256 increasing values")
        return z
    code = np.arange(256) / 255.0
    if kind == "polynomial":
        if len(curve) < 2 or not np.isfinite(curve).all():
            raise ValueError("a response polynomial needs at least two finite coefficients")
        return monotone(polyval(code, curve))
    if kind == "srgb":
        return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)
    return code


def monotone(z: Floats) -> Floats:
    """Return the non-decreasing curve [n], at least 0, that is nearest to z by least squares."""
    from scipy.optimize import isotonic_regression

    return np.maximum(isotonic_regression(np.asarray(z, float)).x, 0.0)


# A response is fitted to codes in this range, without clipped codes and the ringing of JPEG next to
# them; a black level (`dark_floor`) raises the lower end.
_LOWEST, _HIGHEST = 3, 252


def dark_floor(codes: UInts8, log_exposure: Floats) -> int:
    """Return the lowest code that follows the light, 3 to 63; lower codes are black level or haze.

    codes: [places, frames], one scene point a row, 0 where a frame has no code; log_exposure:
    [frames], natural log. A code is compared with the code of the same place in the longest frame
    of at most half the exposure: above a black level the latter is clearly lower.
    """
    order = np.argsort(-np.asarray(log_exposure, float))  # longest frame first
    log_e = np.asarray(log_exposure, float)[order]
    of_frame = codes[:, order].astype(int).T  # [frames, places]
    pairs = [np.empty((2, 0), int)]  # codes, and by how much they fall at half the exposure
    for longer, log_longer in zip(of_frame, log_e, strict=True):
        half = np.flatnonzero(log_longer - log_e >= 0.95 * np.log(2.0))
        if half.size:
            shorter = of_frame[half[0]]
            dark = (longer > 0) & (shorter > 0) & (longer < 64)
            pairs.append(np.stack([longer, longer - shorter])[:, dark])
    dark_codes, fall = np.hstack(pairs)
    for code in range(62, _LOWEST - 1, -1):
        near = np.abs(dark_codes - code) <= 1
        if near.sum() >= 10 and np.median(fall[near]) < 1.5:
            return code + 1
    return _LOWEST


def fit_response(
    codes: UInts8, log_exposure: Floats, *, smooth: float = 30.0, low: int | None = None
) -> tuple[Floats, float]:
    """Fit a monotone response to codes of the same places in all frames, with known exposures.

    codes: [places, frames]; log_exposure: [frames], natural log; smooth: weight of the second
    differences, larger for a stiffer curve. Codes below `low` (default: the `dark_floor` of these
    codes) are omitted, because a black level that counts as light would bend the complete curve.

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
    place, frame = np.nonzero((codes >= low) & (codes <= _HIGHEST))  # of each usable code, [n]
    code = codes[place, frame].astype(int)
    weight = np.minimum(code - low + 1, _HIGHEST - code + 1) / ((_HIGHEST - low) / 2)
    # Unknowns: ln z of the 256 codes, then ln of the light at each place. The rows of the system:
    # ln z(code) - ln light(place) = ln exposure(frame) for each code, second differences, ln z(128)
    # = 0, and a weak pull to 0 that makes codes without data solvable.
    n, unknowns = code.size, 256 + places
    at = (np.tile(np.arange(n), 2), np.r_[code, 256 + place])
    data = sparse.csr_matrix((np.r_[weight, -weight], at), (n, unknowns))
    inner = np.arange(1, 255)
    hat = np.minimum(inner, 255 - inner) / 127.0 + 0.05
    bends = np.r_[hat, -2 * hat, hat] * np.sqrt(smooth * n / 256 / 100)
    at = (np.tile(inner - 1, 3), np.r_[inner - 1, inner, inner + 1])
    bend = sparse.csr_matrix((bends, at), (254, unknowns))
    pin = sparse.csr_matrix(([1e3], ([0], [128])), (1, unknowns))
    system = sparse.vstack([data, bend, pin, 1e-6 * sparse.eye(unknowns)]).tocsr()
    target = np.r_[weight * log_exposure[frame], np.zeros(254 + 1 + unknowns)]
    solution = np.asarray(spsolve((system.T @ system).tocsc(), system.T @ target))
    log_z, log_light = solution[:256], solution[256:]
    middle = (code >= 27) & (code <= 228)
    residual = (log_z[code] - log_light[place] - log_exposure[frame])[middle]
    z = monotone(np.exp(log_z - log_z[255]))
    return z / z[255], float(np.sqrt(np.mean(residual**2)))
