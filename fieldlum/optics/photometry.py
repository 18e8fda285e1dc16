"""Compute with exposures and luminances: times, laws of a shutter, curves of a camera, illuminance.

L = k 87 N^2 / (t S) z: luminance [cd/m2], scale k, f-number N, true time t [s], ISO S, and linear
light z, which is 1 at full scale. JPEG codes become z by tables of 256 values. A sensor's deviation
from linearity is a polynomial over the full scale. Vignetting is V(r) = sum c_k r^k, V(0) = 1, with
r the angle from the axis over half of the full angle.

A mechanical shutter runs in thirds or halves of a stop, and its labels are rounded: 1/60 is 1/64 s.
An electronic shutter exposes for its labelled time: 1/60 is 0.016667 s (measured on a phone's
bracket, MercuryYen/HDR-Imaging data/101; Ricoh states the same for the Theta). The two differ by up
to 6.7 %.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, TypeVar

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import ArrayLike, NDArray

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Exposure, SunSource
from fieldlum.optics.projection import direction

T = TypeVar("T", bound=np.floating)

# ----------------------------------------------------------------------------------------------
# exposures and saturation


# The empirical constant of hdrgen (Ward, panlib). A wrong value scales all luminances without a
# scale calibration.
STONITS = 87.0
# Settings of cameras are a third of a stop apart: two values within the half of it are the same
# setting, rounded differently.
SAME_SETTING_EV = 1 / 6


def same_exposure(a: Exposure, b: Exposure) -> bool:
    """Return whether shutter, aperture and ISO each differ by at most 1/6 EV.

    Filters are not compared, because cameras do not record them.
    """
    ratios = (a.shutter_s / b.shutter_s, (a.f_number / b.f_number) ** 2, a.iso / b.iso)
    return all(abs(math.log2(ratio)) <= SAME_SETTING_EV for ratio in ratios)


def z_per_cdm2(shutter_s: float, f_number: float, iso: float, k: float = 1.0) -> float:
    """Return the linear signal z (1 at full scale) per cd/m2, by L = k 87 N^2 / (t S) z.

    shutter_s : t; f_number : N; iso : S; k : factor of the scale calibration.
    """
    return shutter_s * iso / (STONITS * f_number**2 * k)


def prior_u_log(shutter_s: ArrayLike) -> Floats:
    """Return the relative standard uncertainty of shutter times that were not measured, [n].

    0.003 from 1/1000 s on, 0.03 for shorter times, at which mechanical shutters are less accurate:
    errors of up to 3.9 % are found (docs/validation.md). shutter_s : [n], s.
    """
    return np.where(np.asarray(shutter_s) < 1 / 1000, 0.03, 0.003)


def saturation_plateau(counts: NDArray[np.integer], white_dn: float) -> float | None:
    """Return the count at which a sensor saturates [DN]; None if the histogram has no such spike.

    counts : raw counts of any shape; white_dn : the white level in the file. Many sensors saturate
    below that white level. The spike is the run of counts up to the highest count (without a few
    hot pixels), if that is at least half of white_dn, and the run has at least 8 pixels, 0.02 % of
    all pixels and ten times the average of equal runs below it, which a bright smooth scene has
    not. The result is its mean count.
    """
    flat = np.maximum(counts.ravel(), 0)
    of_count = np.bincount(flat, minlength=1)
    above = flat.size - np.cumsum(of_count)  # pixels above each count
    top = int(np.argmax(above <= max(8, 2e-5 * flat.size)))
    width = max(1, round(0.002 * white_dn))
    histogram = of_count[max(top + 1 - 12 * width, 0) : top + 1][::-1]  # from the highest count
    spike, below = histogram[:width].sum(), histogram[2 * width :].sum() / 10
    if top < 0.5 * white_dn or spike < max(2e-4 * flat.size, 8, 10 * below):
        return None
    return float(top - np.average(np.arange(width), weights=histogram[:width]))


# ----------------------------------------------------------------------------------------------
# the law of a shutter


THIRD_STOPS, HALF_STOPS, EXACT, AUTO = "third-stops", "half-stops", "exact", "auto"
LAWS = (THIRD_STOPS, HALF_STOPS, EXACT)
# Settings in a stop, and how far a label may be from the nearest one: a time further away is used
# unchanged. Labels are rounded by up to 6.3 % (13 s) in thirds of a stop, and by 11.6 % (1/20 s is
# 2^-4.5 s) in halves. Sources: linearhdr (Wasilewski), hdrmerge (Jakob).
_GRIDS = {THIRD_STOPS: ((3,), 0.07), HALF_STOPS: ((2,), 0.12), AUTO: ((3, 2), 0.07)}


@dataclass(frozen=True, slots=True, kw_only=True)
class PairRatio:
    """The measured exposure ratio of two frames.

    long, short: indices of the frames, from 0. log_ratio: ln(true / assumed exposure) of frame
    `short` minus that of frame `long`; u_log: standard uncertainty of log_ratio; pixels: number of
    pixels used.
    """

    long: int
    short: int
    log_ratio: float
    u_log: float
    pixels: int


@dataclass(frozen=True, slots=True)
class ShutterLaw:
    """The law of a bracket's shutter times.

    law : "third-stops", "half-stops" or "exact"; decided_by : "profile", "labels" or "frames"
    ("": not stated); misfit_percent : for each law, the rms difference of the measured exposure
    ratios from it, in %; empty without measured ratios.
    """

    law: str
    decided_by: str = ""
    misfit_percent: dict[str, float] = field(default_factory=dict)


def true_times_s(nominal_s: ArrayLike, law: str = AUTO) -> Floats:
    """Return the true times [...] in s of nominal times [...] in s.

    law : "exact" changes nothing; "third-stops" and "half-stops" round to powers of 2^(1/3) and
    2^(1/2) s, but a time over 7 % or 12 % away from them is returned unchanged; "auto" rounds to
    the nearer of the two, unless that is over 7 % away.
    """
    nominal = np.asarray(nominal_s, np.float64)
    if law == EXACT:
        return nominal.copy()
    settings, reach = _GRIDS[law]
    stops = np.log2(nominal)
    grids = np.stack([np.round(stops * n) / n for n in settings])  # [grids, ...]
    nearest = np.abs(grids - stops).argmin(axis=0)[None]
    on_grid = 2.0 ** np.take_along_axis(grids, nearest, axis=0)[0]
    return np.where(np.abs(on_grid / nominal - 1.0) <= reach, on_grid, nominal)


def law_of_labels(nominal_s: ArrayLike, model: str = "") -> ShutterLaw:
    """Return the law, half or third stops, that fits a bracket's nominal times [n] in s best.

    If both fit equally, it is third stops. model : name of the camera; if it contains "theta" the
    law is "exact" (theta-web-api-v2.1, shutterSpeed).
    """
    if "theta" in model.casefold():
        return ShutterLaw(EXACT, "labels")
    stops = np.log2(np.asarray(nominal_s, np.float64))
    thirds, halves = (float(((np.round(stops * n) / n - stops) ** 2).sum()) for n in (3, 2))
    return ShutterLaw(HALF_STOPS if halves < 0.999 * thirds else THIRD_STOPS, "labels")


def law_of_frames(
    times_s: Mapping[str, Floats], of_labels: ShutterLaw, pairs: Sequence[PairRatio]
) -> ShutterLaw:
    """Return the law that measured ratios support; the law of `of_labels` if they cannot decide.

    times_s : for each law, the times [frames] in s; pairs : ratios measured relative to the times
    under the law of `of_labels`; without pairs `of_labels` is returned. Only under the correct law
    do equal nominal steps change codes equally. A wrong response, or changing light, stretches all
    steps by one factor, which is estimated for each law. The frames decide if the ratios scatter
    about every other law, of those that differ by over 2 %, at least twice as much.
    """
    if not pairs:
        return of_labels
    long, short = np.array([(pair.long, pair.short) for pair in pairs]).T
    measured = np.array([pair.log_ratio for pair in pairs])
    assumed = np.log(times_s[of_labels.law])
    step = {law: np.log(times_s[law][short] / times_s[law][long]) for law in LAWS}
    off = {law: measured - step[law] + (assumed[short] - assumed[long]) for law in LAWS}
    slope = {law: off[law] @ step[law] / max(step[law] @ step[law], 1e-12) for law in LAWS}
    scatter = {law: float(np.std(off[law] - step[law] * slope[law])) for law in LAWS}
    best = min(LAWS, key=lambda law: (scatter[law], law != of_labels.law))
    others = [law for law in LAWS if np.abs(step[law] - step[best]).max() > 0.02]
    decided = bool(others) and all(scatter[law] > 2.0 * scatter[best] for law in others)
    misfit = {law: round(100.0 * float(np.sqrt(np.mean(off[law] ** 2))), 2) for law in LAWS}
    if not decided:
        return ShutterLaw(of_labels.law, of_labels.decided_by, misfit)
    # of laws that agree for these frames, that of the labels
    law = best if of_labels.law in others else of_labels.law
    return ShutterLaw(law, "frames", misfit)


# ----------------------------------------------------------------------------------------------
# curves: linearity, vignetting, response


def linearity_factor(share: NDArray[T], coefficients: Sequence[float]) -> NDArray[T]:
    """Return the factor that makes counts proportional to light: 1 + a1 x + a2 x^2 + ..., [...].

    coefficients: a1 first; empty gives 1. share: x, counts above black over those of the full scale
    [...], limited to 0 to 1. The factor at x = 0 and below is 1.
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
    """Return the vignetting V = sum c_k radius^k, [...].

    coefficients : c_0 first; none give 1. radius : angle from the axis over half of the full angle
    [...], limited to 0 to 1.
    """
    r = np.clip(np.asarray(radius, float), 0.0, 1.0)
    return np.asarray(polyval(r, coefficients or (1.0,)), np.float64)


def check_vignetting(coefficients: tuple[float, ...]) -> str:
    """Return what is wrong with a vignetting curve V(r), or "".

    coefficients : of V, c_0 first. V must be finite, V(0) within 0.01 of 1, 0 < V <= 1.05, and V at
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
    """Return the linear signal z of the JPEG codes 0 to 255, [256].

    kind : linear, srgb (IEC 61966-2-1), table (curve: 256 values) or polynomial: sum c_k (code /
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


def dark_floor(codes: NDArray[np.uint8], log_exposure: Floats) -> int:
    """Return the lowest code that follows the light, 3 to 63; lower codes are black level or haze.

    codes : [places, frames], one scene point a row, 0 where a frame has no code; log_exposure :
    [frames], natural log. A code is compared with the code of the same place in the longest frame
    of at most half the exposure: above a black level the latter is clearly lower.
    """
    order = np.argsort(-np.asarray(log_exposure, float))
    log_e = np.asarray(log_exposure, float)[order]
    of_frame = codes[:, order].astype(int).T  # [frames, places]
    falls = [np.empty((2, 0), int)]  # codes, and by how much they fall
    for longer, log_longer in zip(of_frame, log_e, strict=True):
        half = np.flatnonzero(log_longer - log_e >= 0.95 * np.log(2.0))
        if half.size:
            both = (longer > 0) & (of_frame[half[0]] > 0) & (longer < 64)
            falls.append(np.stack([longer, longer - of_frame[half[0]]])[:, both])
    held, fall = np.hstack(falls)
    for code in range(62, _LOWEST - 1, -1):
        near = np.abs(held - code) <= 1
        if near.sum() >= 10 and np.median(fall[near]) < 1.5:
            return code + 1
    return _LOWEST


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
    ok = (codes >= low) & (codes <= _HIGHEST)
    place, frame = np.nonzero(ok)
    value = codes[place, frame].astype(int)
    weight = np.minimum(value - low + 1, _HIGHEST - value + 1) / ((_HIGHEST - low) / 2)
    n = value.size
    rows = np.arange(n)
    columns = np.r_[value, 256 + place]
    at = (np.tile(rows, 2), columns)
    data = sparse.csr_matrix((np.r_[weight, -weight], at), (n, 256 + places))
    curve = np.arange(1, 255)
    hat = np.minimum(curve, 255 - curve) / 127.0 + 0.05
    bends = np.r_[hat, -2 * hat, hat] * np.sqrt(smooth * n / 256 / 100)
    columns = np.r_[curve - 1, curve, curve + 1]
    bend = sparse.csr_matrix((bends, (np.tile(curve - 1, 3), columns)), (254, 256 + places))
    pin = sparse.csr_matrix(([1e3], ([0], [128])), (1, 256 + places))
    system = sparse.vstack([data, bend, pin, 1e-6 * sparse.eye(256 + places)]).tocsr()
    target = np.r_[weight * log_exposure[frame], np.zeros(254 + 1 + 256 + places)]
    solution = np.asarray(spsolve((system.T @ system).tocsc(), system.T @ target))
    log_z, light = solution[:256], solution[256:]
    middle = (value >= 27) & (value <= 228)
    residual = (log_z[value] - light[place] - log_exposure[frame])[middle]
    z = monotone(np.exp(log_z - log_z[255]))
    return z / z[255], float(np.sqrt(np.mean(residual**2)))


# ----------------------------------------------------------------------------------------------
# illuminance


def _ray_integrals(height: int, width: int, heading_deg: float) -> Floats:
    """Return the integral of the unit vector over each pixel's solid angle, [H, W, 3], sr.

    The pixels are those of an equirectangular panorama; heading_deg: azimuth of its centre. The
    vector is (east, north, up).
    """
    edges = np.linspace(0.0, np.pi, height + 1)
    level = np.diff(edges / 2 - np.sin(2 * edges) / 4)  # of sin^2
    upward = np.diff(np.sin(edges) ** 2 / 2)  # of sin cos
    turn = np.radians(heading_deg) + (np.linspace(0.0, 1.0, width + 1) - 0.5) * 2 * np.pi
    east, north, step = np.diff(-np.cos(turn)), np.diff(np.sin(turn)), 2 * np.pi / width
    up = np.repeat(upward[:, None] * step, width, axis=1)
    return np.stack((level[:, None] * east, level[:, None] * north, up), axis=-1)


def _cosine_weights(height: int, width: int, heading_deg: float, normal: Floats) -> Floats:
    """Return the integral of cos(angle to the normal) over each pixel, [H, W], in sr.

    It is 0 behind the plane. It is exact except in sub-pixels that the plane cuts: these count as
    their mean, or not at all. height, width, heading_deg: of a panorama.
    """
    # At least 128 rows, because pixels that the plane cuts count as their mean: a hemisphere
    # is then exact to 0.05 % (tests/test_projection.py).
    fine = max(2, -(-128 // height))
    inside = np.maximum(_ray_integrals(height * fine, width * fine, heading_deg) @ normal, 0.0)
    return inside.reshape(height, fine, width, fine).sum(axis=(1, 3))


def illuminance_lx(
    luminance_cdm2: Floats,
    heading_deg: float,
    normal_altitude_deg: float,
    normal_azimuth_deg: float,
    sun: SunSource | None = None,
) -> float:
    """Return the illuminance [lx] of a plane whose normal has the stated altitude and azimuth.

    luminance_cdm2: panorama [H, W], row 0 at the zenith, with its middle at azimuth heading_deg;
    pixels that are not finite count as 0. Azimuths are clockwise from north. sun: a sun that is not
    in the panorama; None adds nothing. E = sum L cos(angle) solid angle over the hemisphere in
    front of the plane.
    """
    values = np.nan_to_num(np.asarray(luminance_cdm2, np.float64), posinf=0.0, neginf=0.0)
    height, width = values.shape
    normal = direction(normal_altitude_deg, normal_azimuth_deg)
    total = float((values * _cosine_weights(height, width, heading_deg, normal)).sum())
    if sun is not None:
        cosine = float(direction(sun.altitude_deg, sun.azimuth_deg) @ normal)
        total += sun.normal_illuminance_lx * max(cosine, 0.0)
    return total


def vertical_illuminance_lx(
    luminance_cdm2: Floats, heading_deg: float, azimuth_deg: float, sun: SunSource | None = None
) -> float:
    """Return the illuminance [lx] of a vertical plane that faces `azimuth_deg`, as at an eye.

    luminance_cdm2 : panorama [H, W] in cd/m2, row 0 at the zenith, with its middle at azimuth
    `heading_deg`; azimuths clockwise from north. sun : a sun that is not in the panorama, or None.
    """
    return illuminance_lx(luminance_cdm2, heading_deg, 0.0, azimuth_deg, sun)


def illuminance_verdict(image_lx: float, meter_lx: float) -> Literal["pass", "warn", "reject"]:
    """Return the verdict on a picture's illuminance, compared with a meter's.

    The difference is relative to the meter: up to 10 % is "pass", up to 25 % "warn", more, or a
    meter at 0 or below, "reject" (Pierson et al., LEUKOS 2021, step 11).
    """
    difference = abs(image_lx / meter_lx - 1.0) if meter_lx > 0 else np.inf
    return "pass" if difference <= 0.10 else "warn" if difference <= 0.25 else "reject"
