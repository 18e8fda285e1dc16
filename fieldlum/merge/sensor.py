"""Merge the frames of one heading on the sensor, step by step: exposures, noise, bad pixels."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from fieldlum.core.arrays import Floats, Indices, Mask
from fieldlum.core.records import Flag, Progress, quiet
from fieldlum.core.statistics import robust_sigma
from fieldlum.merge.estimator import Merged, Rows, merge_signals
from fieldlum.merge.frames import (
    FRAMES_BYTES,
    Crop,
    Plateau,
    RawSignal,
    Signal,
    lens_crop,
    read_frames,
    saturation_and_black,
    scaled,
)
from fieldlum.merge.jpeg_noise import footprint_px, with_seen_noise
from fieldlum.merge.motion import leave_out_moved
from fieldlum.merge.options import MergeOptions
from fieldlum.merge.ratios import (
    RatioCurve,
    RatioFit,
    beyond,
    bracket_pairs,
    fit_ratios,
    free_fit,
    light_ratio,
    neighbours,
    ratio_curve,
    take_samples,
    unexplained,
)
from fieldlum.merge.shift import shifts
from fieldlum.merge.shots import Shot, exposure_covariance, sorted_shots, stated_law, times_by_law
from fieldlum.optics.linear_light import lens_geometry, nd_factors
from fieldlum.optics.photometry import PairRatio, ShutterLaw, law_of_frames
from fieldlum.optics.profiles import CameraProfile
from fieldlum.session.files.merge_report import NeighbourQuality, ShiftQuality

# ----------------------------------------------------------------------------------------------
# exposures: shutter law, fitted corrections, uncertainty


# Smaller relative differences between frames never count as motion. The value equals the prior
# uncertainty of a mechanical shutter time (photometry/exposure.py, PRIOR_LONG). Chosen.
_MIN_TOLERANCE = 0.003
_TOLERANCE_SIGMA = 3.0  # standard deviations of the frames' typical disagreement; chosen
# The verdict reports an exposure's deviation if it exceeds both: 2 %, and three times its prior u.
# Chosen.
_REPORTED_DEVIATION, _REPORTED_SIGMA = 0.02, 3.0


@dataclass(frozen=True, slots=True)
class Exposures:
    """The exposures of a bracket and their uncertainty.

    law: how nominal shutter times were read. fit: corrections of the exposures. neighbours:
    disagreement of frames that are neighbours in exposure. log_deviation [frames]: ln of exposures
    fitted to the frames over the profile's; u_prior [frames]: standard uncertainty that shutter,
    filter, ISO and response explain before any fit. u_rel: relative uncertainty of a typical
    frame's exposure. u_curve: relative uncertainty of a merged value due to exposures, by
    luminance. tolerance: relative difference of two frames that does not count as motion.
    """

    law: ShutterLaw
    fit: RatioFit
    neighbours: tuple[NeighbourQuality, ...]
    log_deviation: Floats
    u_prior: Floats
    u_rel: float
    u_curve: RatioCurve
    tolerance: float


def any_beyond_prior(log_deviation: Floats, u_prior: Floats) -> bool:
    """Return whether any exposure deviates by more than 2 % and by more than three u_prior."""
    limit = np.maximum(_REPORTED_DEVIATION, _REPORTED_SIGMA * u_prior)
    return bool((np.abs(log_deviation) > limit).any())


def exposures_of(
    frames: list[Signal], shots: Sequence[Shot], profile: CameraProfile, law: ShutterLaw, fits: bool
) -> tuple[list[Signal], Exposures, SeenNoise]:
    """Return frames with corrected exposures, the exposures, and the noise of raw frames.

    law: that with which the frames were read. One that is derived from nominal times is tested with
    the frames' ratios first. If `fits` is False, no exposure is corrected. Disagreement of frames
    beyond the uncertainties of shutter and response increases the uncertainty: the light changed,
    or the profile is wrong. Exposures that are not fitted are compared with a fit that serves only
    this purpose.
    """
    samples = take_samples(frames)
    pairs = bracket_pairs(samples)
    if law.decided_by == "labels":
        times_s = times_by_law(shots, profile)
        assumed, law = law.law, law_of_frames(times_s, law, pairs)
        if law.law != assumed:
            frames = scaled(frames, times_s[law.law] / times_s[assumed])
            samples = take_samples(frames)
            pairs = bracket_pairs(samples)
    prior = exposure_covariance([s.exposure for s in shots], replace(profile, shutter_law=law.law))
    fit = fit_ratios(pairs if fits else [], prior)
    frames, noise = scaled(frames, fit.correction), SeenNoise()
    if fits:
        noise = seen_noise(samples, pairs, fit.correction)
        frames = [_with_noise(signal, noise) for signal in frames]
    return frames, _trust(law, fit, prior, samples, pairs, profile, fits), noise


def _trust(
    law: ShutterLaw,
    fit: RatioFit,
    prior: Floats,
    samples: Sequence[Rows],
    pairs: list[PairRatio],
    profile: CameraProfile,
    fits: bool,
) -> Exposures:
    residuals = neighbours(pairs, fit.correction)
    u_typical = float(np.median(fit.u_log))
    u_response = 0.0 if profile.camera.kind == "raw" else profile.response.u_rel
    if fits:
        compared, disagreement = fit, u_typical
        u_extra = unexplained(residuals, u_response)
    else:
        compared = free_fit(pairs, len(prior))
        u_explained = float(np.hypot(u_response, u_typical))
        percents = [abs(n.residual_percent) for n in residuals]
        disagreement = float(np.median(percents)) / 100 if percents else u_typical
        u_extra = max(unexplained(residuals, u_explained), beyond(compared, u_explained))
    return Exposures(
        law,
        fit,
        tuple(residuals),
        np.log(compared.correction),
        np.hypot(np.sqrt(np.diag(prior)), u_response),
        float(np.hypot(u_typical, u_extra)),
        ratio_curve(samples, fit.covariance, u_extra),
        # The tolerance includes the error of a JPEG's response, because that error makes frames
        # differ without any motion.
        max(_MIN_TOLERANCE, _TOLERANCE_SIGMA * disagreement, u_response),
    )


# ----------------------------------------------------------------------------------------------
# noise of raw frames, from neighbouring frames
#
# A profile's gain and read noise are often those of another body. If they give too little noise,
# noise is mistaken for motion and u is too small. Two frames of one scene differ by their noise:
# the part that grows with the signal gives the gain, the constant part gives the read noise (photon
# transfer; Janesick, SPIE 2007). The fit is robust against motion.


_STEPS = 12  # levels of the signal at which a pair is evaluated; chosen
# minimum number of pixels in a step, and maximum of a pair; chosen
_IN_A_STEP, _MAX_PAIR_PIXELS = 200, 12_000
_ROUNDED_DN2 = 1 / 12  # variance of rounding to integers, a uniform distribution (GUM 4.3.7)
# Smaller factors on a variance (1.2 on the noise) are not reliably different from the profile's.
# Chosen.
_TOLD = 1.44
# The factor must also exceed 1 by this many standard errors, because read noise is uncertain where
# shot noise dominates. Chosen.
_SURE_SIGMA = 3.0


@dataclass(frozen=True, slots=True)
class SeenNoise:
    """Factors on the variances of shot noise and read noise that the profile gives.

    shot, read: measured variance over the profile's; 1 unless the frames clearly show more noise.
    """

    shot: float = 1.0
    read: float = 1.0


def _with_noise(signal: Signal, noise: SeenNoise) -> Signal:
    if noise == SeenNoise() or not isinstance(signal, RawSignal):
        return signal
    gain, read_dn2 = signal.gain_e_per_dn / noise.shot, signal.noise_dn2 * noise.read
    return replace(signal, gain_e_per_dn=gain, noise_dn2=read_dn2)


def seen_noise(
    samples: Sequence[Rows], pairs: Sequence[PairRatio], correction: Floats
) -> SeenNoise:
    """Return factors on the variances of the profile's shot and read noise, from raw frames.

    samples: one for each frame, most exposed first; pairs: measured exposure ratios, of which only
    those of neighbours are used. correction: fitted over assumed exposure, [frames]. Both factors
    are 1 for JPEG frames, and if too few pixels can be compared.
    """
    rows = [
        # divide by the measured variance, so that all steps have equal weight
        (shot / measured, read / measured)
        for pair in pairs
        if pair.short == pair.long + 1
        for shot, read, measured in _steps(
            samples[pair.long],
            samples[pair.short],
            float(np.exp(np.log(correction[pair.short]) - np.log(correction[pair.long]))),
        )
    ]
    if len(rows) < 4:
        return SeenNoise()
    table = np.array(rows)
    factors = nnls(table, np.ones(len(table)))[0]  # of shot and read noise, not negative
    scatter = np.mean((table @ factors - 1.0) ** 2)
    u = np.sqrt(np.diag(np.linalg.pinv(table.T @ table)) * scatter)
    sure = factors > np.maximum(_TOLD, 1 + _SURE_SIGMA * u)
    return SeenNoise(*(float(value) for value in np.where(sure, factors, 1.0)))


def _steps(long: Rows, short: Rows, correction: float) -> list[tuple[float, float, float]]:
    """Return variances of the difference of two frames [DN2], one row for each step of the signal.

    A row has the shot variance and the read variance by the profile, and the measured variance.
    """
    a, b = long.signal, short.signal
    if not (isinstance(a, RawSignal) and isinstance(b, RawSignal)):
        return []
    at = np.flatnonzero(long.usable() & short.usable())
    at = at[:: max(1, len(at) // _MAX_PAIR_PIXELS)]
    y_long, y_short = long.counts.ravel()[at], short.counts.ravel()[at]
    ratio = correction * np.broadcast_to(b.per_cdm2 / a.per_cdm2, long.counts.shape).ravel()[at]
    order = np.argsort(y_long)
    # Where noise is about one count, a median of integers would jump between counts: spread the
    # counts evenly over their width first.
    dither = np.random.default_rng(0).uniform(-0.5, 0.5, len(at))
    steps = []
    for step in np.array_split(order, int(np.clip(len(order) // _IN_A_STEP, 1, _STEPS))):
        if len(step) < _IN_A_STEP:
            continue
        r = ratio[step]
        light = np.maximum(y_long[step], 0.0)
        off = y_short[step] - r * y_long[step] + dither[step]
        shot = float(np.median(r * light / b.gain_e_per_dn + r**2 * light / a.gain_e_per_dn))
        read = float(np.median(b.noise_dn2 + r**2 * a.noise_dn2))
        steps.append((shot, read, max(robust_sigma(off) ** 2 - _ROUNDED_DN2, _ROUNDED_DN2)))
    return steps


# ----------------------------------------------------------------------------------------------
# pixels to ignore
#
# These are the profile's bad pixels and, for raw cameras, isolated pixels whose frames contradict
# each other while all neighbours of the same colour agree. Pixels of moving objects are kept.


def good_pixels(profile: CameraProfile, crop: Crop, flags: NDArray[np.uint8]) -> Mask | None:
    """Return a mask [height, width] of the crop that is False at pixels to ignore.

    These are the profile's bad pixels and, for a raw camera, the pixels of `odd_pixels`. Return
    None if every pixel is good. flags: of the merged pixels of the crop, in the frames' shape.
    """
    places = [(y - crop.top, x - crop.left) for x, y in profile.sensor.bad_px]
    inside = [(y, x) for y, x in places if 0 <= x < crop.width and 0 <= y < crop.height]
    bad = np.array(inside, np.intp).reshape(-1, 2)
    if profile.camera.kind == "raw":
        bad = np.concatenate((bad, odd_pixels(flags.reshape(crop.height, crop.width))))
    if not len(bad):
        return None
    good = np.ones((crop.height, crop.width), bool)
    good[bad[:, 0], bad[:, 1]] = False
    return good


def odd_pixels(flags: NDArray[np.uint8]) -> Indices:
    """Return row and column [n, 2] of mosaic pixels at which alone the frames disagree.

    flags: [h, w] of the mosaic. At such a pixel the frames disagree (it has the flag MOTION), but
    at all eight neighbours of the same colour they agree. This happens at stuck pixels and through
    noise. A moving object covers more than one pixel.
    """
    moved = ((flags & Flag.MOTION) > 0).view(np.uint8)
    same_colour = np.zeros((5, 5), np.uint8)
    same_colour[::2, ::2] = 1
    around = cv2.filter2D(moved, -1, same_colour, borderType=cv2.BORDER_CONSTANT)
    return np.argwhere((moved > 0) & (np.asarray(around) == 1))


# ----------------------------------------------------------------------------------------------
# the steps of a merge


@dataclass(frozen=True, slots=True)
class SensorImage:
    """Merged pixels of the sensor in the camera's own colours, and the direction of the camera.

    merged: pixels of the crop; crop: the part of the sensor that was read. turn_deg: heading of the
    camera minus that of the target, clockwise. f_number: of the frames. u_curve: relative
    uncertainty due to the exposures, over luminance. good: mask [height, width] of the crop, False
    at bad pixels; None if every pixel is good.
    """

    merged: Merged
    crop: Crop
    turn_deg: float
    f_number: float
    u_curve: RatioCurve
    good: Mask | None = None


@dataclass(frozen=True, slots=True)
class Findings:
    """What the frames of one heading showed about exposures, noise, saturation and motion.

    plateau_dn: counts at which R, G1, G2 and B saturate, by ISO; black_off_dn: black level of the
    files minus the profile's; noise: noise over the profile's. turns: of the camera between frames,
    only for pairs of frames with enough common edges. dropped: share (0 to 1) of its pixels that
    each frame lost to motion, empty without `drop_moved`. absent: names of frames that were taken
    without the filter of their label.
    """

    shots: tuple[Shot, ...]
    exposures: Exposures
    plateau_dn: dict[float, Plateau]
    black_off_dn: float
    noise: SeenNoise
    turns: tuple[ShiftQuality, ...]
    dropped: tuple[float, ...]
    absent: tuple[str, ...] = ()


def merge_sensor(
    shots: Sequence[Shot],
    profile: CameraProfile,
    options: MergeOptions | None = None,
    *,
    turn_deg: float = 0.0,
    budget_bytes: int = FRAMES_BYTES,
    progress: Progress = quiet,
) -> tuple[SensorImage, Findings]:
    """Merge the frames of one heading.

    shots: sorted by exposure, longest first. turn_deg: heading of the camera minus that of the
    resulting picture, clockwise. budget_bytes: memory for frames; others wait in temporary files.
    Return the merged pixels, and what the frames showed. Raises InputError for a frame that cannot
    be read or is of another camera.
    """
    options, crop = options or MergeOptions(), lens_crop(profile)
    shots, absent = _without_absent_filters(shots, profile, crop)
    law = stated_law(shots, profile)
    plateau_dn, black_off_dn = saturation_and_black(shots, profile)
    read_with = replace(profile, shutter_law=law.law)
    frames = read_frames(shots, read_with, crop, plateau_dn, budget_bytes, progress)
    lenses = [lens_geometry(lens, corner_px=(crop.left, crop.top)) for lens in profile.lens]
    turns = shifts([f.small() for f in frames], lenses, [s.path.name for s in shots])
    frames, exposures, noise = exposures_of(frames, shots, profile, law, options.fits(profile))
    height, width = crop.height, crop.width
    shape = (height // 2, 2, width) if profile.camera.kind == "raw" else (height, width, 3)
    merged = merge_signals(frames, shape, u_ratio=exposures.tolerance)
    dropped: tuple[float, ...] = ()
    if options.drop_moved:
        merged, dropped = leave_out_moved(frames, merged, exposures.tolerance)
    if profile.camera.kind == "jpeg":
        target = options.target(profile)
        edge_px = float(np.mean([footprint_px(lens, target) for lens in lenses]))
        merged = with_seen_noise(merged, frames, profile.colour.y_from_rgb, edge_px)
    good, f_number = good_pixels(profile, crop, merged.flags), shots[0].exposure.f_number
    image = SensorImage(merged, crop, turn_deg, f_number, exposures.u_curve, good)
    return image, Findings(
        tuple(shots), exposures, plateau_dn, black_off_dn, noise, tuple(turns), dropped, absent
    )


def _without_absent_filters(
    shots: Sequence[Shot], profile: CameraProfile, crop: Crop
) -> tuple[Sequence[Shot], tuple[str, ...]]:
    """Return the frames in order of exposure, and the names of those taken without their filter.

    Each frame with a filter in its label is compared with the frame without one whose exposure is
    nearest. Beyond the middle between the light with and without the filter, on a logarithmic
    scale, the filter was absent: the frame then counts as one without it.
    """
    bare = [shot for shot in shots if not shot.exposure.nd]
    right, absent = list(shots), []
    for number, shot in enumerate(shots):
        asked = shot.exposure
        if not asked.nd or not bare:
            continue
        like = min(bare, key=lambda s: abs(np.log(s.exposure.shutter_s / asked.shutter_s)))
        pair = [like, replace(shot, exposure=replace(asked, nd=""))]
        frames = read_frames(pair, profile, crop, saturation_and_black(pair, profile)[0])
        factor = float(np.mean(nd_factors(asked.nd, profile)))
        if light_ratio(*take_samples(frames)) > factor**-0.5:
            right[number] = pair[1]
            absent.append(shot.path.name)
    return (sorted_shots(right, profile), tuple(sorted(absent))) if absent else (shots, ())
