"""Merge the frames of one heading on the sensor, step by step: exposures, noise, bad pixels."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Indices, Mask
from fieldlum.core.records import Flag, Progress, quiet
from fieldlum.core.statistics import robust_sigma
from fieldlum.merge.estimator import Merged, Signal, merge_signals
from fieldlum.merge.frame_cache import FRAMES_BYTES, FrameStore
from fieldlum.merge.frame_checks import FirstLook, first_look
from fieldlum.merge.frames import Crop, RawSignal, lens_crop, load_raw, over_colours, over_mosaic
from fieldlum.merge.jpeg_noise import footprint_px, with_seen_noise
from fieldlum.merge.jpeg_signal import load_jpeg
from fieldlum.merge.motion import leave_out_moved
from fieldlum.merge.options import MergeOptions
from fieldlum.merge.ratios import (
    RatioCurve,
    Sample,
    beyond,
    bracket_pairs,
    free_fit,
    light_ratio,
    neighbours,
    ratio_curve,
    take_samples,
    unexplained,
)
from fieldlum.merge.shift import Moved, shifts
from fieldlum.merge.shots import Shot, exposure_covariance, sorted_shots, stated_law, times_by_law
from fieldlum.optics.linear_light import lens_geometry, nd_factors, true_shutter_s
from fieldlum.optics.photometry import PairRatio, RatioFit, ShutterLaw, fit_ratios, law_of_frames
from fieldlum.optics.profiles import CameraProfile
from fieldlum.optics.projection import LensGeometry
from fieldlum.optics.projection.grids import Target
from fieldlum.session.files.merge_report import NeighbourQuality

# ----------------------------------------------------------------------------------------------
# exposures: shutter law, fitted corrections, uncertainty


# Smaller relative differences between frames never count as motion. The value equals the prior
# uncertainty of a mechanical shutter time (photometry/ratios.py, PRIOR_LONG). Chosen.
_MIN_TOLERANCE = 0.003
_TOLERANCE_SIGMA = 3.0  # standard deviations of the frames' typical disagreement; chosen
# The verdict reports an exposure's deviation if it exceeds both: 2 %, and three times its prior u.
# Chosen.
_REPORTED_DEVIATION, _REPORTED_SIGMA = 0.02, 3.0


@dataclass(frozen=True, slots=True)
class SampledFrames:
    """Pixels sampled at the same places of every frame, and the measured ratios of frame pairs.

    samples: one for each frame; pairs: measured over assumed exposure ratio of two frames.
    """

    samples: list[Sample]
    pairs: list[PairRatio]


@dataclass(frozen=True, slots=True)
class Deviations:
    """Deviations of the fitted exposures from the profile's.

    log_ratio: ln of the fitted exposure over the profile's, [frames]. u_prior: standard uncertainty
    of log_ratio that shutter, filter, ISO and response explain before any fit, [frames].
    """

    log_ratio: Floats
    u_prior: Floats

    @property
    def span_percent(self) -> float:
        """The largest log_ratio minus the smallest of the bracket, times 100 [%]."""
        return float(100 * np.ptp(self.log_ratio))

    @property
    def beyond_prior(self) -> bool:
        """Whether any exposure deviates by more than 2 % and by more than three u_prior."""
        limit = np.maximum(_REPORTED_DEVIATION, _REPORTED_SIGMA * self.u_prior)
        return bool((np.abs(self.log_ratio) > limit).any())

    @property
    def text(self) -> str:
        """The smallest and the largest deviation in percent, such as "-1.2 to +0.4"."""
        low, high = 100 * np.expm1(self.log_ratio.min()), 100 * np.expm1(self.log_ratio.max())
        return f"{low:+.1f} to {high:+.1f}"


@dataclass(frozen=True, slots=True)
class ExposureTrust:
    """Uncertainty of a bracket's exposures.

    neighbours: disagreement of frames that are neighbours in exposure. deviations: of the fitted
    exposures from the profile's. u_rel: relative uncertainty of a typical frame's exposure.
    u_curve: relative uncertainty of a merged value due to exposures, by luminance. tolerance:
    relative difference of two frames that does not count as motion.
    """

    neighbours: tuple[NeighbourQuality, ...]
    deviations: Deviations
    u_rel: float
    u_curve: RatioCurve
    tolerance: float


def sample_frames(store: FrameStore) -> SampledFrames:
    """Return sampled pixels of every frame, and the measured exposure ratios of pairs.

    The frames of a pair are at most three apart in the order of exposure, and have common
    well-exposed pixels.
    """
    samples = take_samples(store)
    return SampledFrames(samples, bracket_pairs(samples))


def decide_shutter_law(
    store: FrameStore,
    sampled: SampledFrames,
    law: ShutterLaw,
    shots: Sequence[Shot],
    profile: CameraProfile,
) -> tuple[SampledFrames, ShutterLaw]:
    """Return the sampled frames and the shutter law, after a test of a law that is only likely.

    law: only if its `decided_by` is "labels" (it was derived from nominal times) is it tested with
    the measured ratios in `sampled`; otherwise both are returned unchanged. profile: has the law
    with which `store` read the frames. If another law fits the ratios better, the exposures in
    `store` are changed to that law's, and the frames are sampled again.
    """
    if law.decided_by != "labels":
        return sampled, law
    times_s = times_by_law(shots, profile)
    law = law_of_frames(times_s, law, sampled.pairs)
    if law.law == profile.shutter_law:
        return sampled, law
    assumed_s = [true_shutter_s(shot.exposure.shutter_s, profile)[0] for shot in shots]
    store.correct(times_s[law.law] / np.asarray(assumed_s))
    return sample_frames(store), law


def fit_exposures(
    sampled: SampledFrames, shots: Sequence[Shot], profile: CameraProfile, fits: bool
) -> tuple[RatioFit, Floats]:
    """Return the fitted corrections of the exposures, and their prior covariance.

    The prior covariance [frames, frames] is that of the log exposures before the fit. If `fits` is
    False, the measured pairs are ignored: every correction is 1 and the fit's covariance is the
    prior.
    """
    prior = exposure_covariance([s.exposure for s in shots], profile)
    return fit_ratios(sampled.pairs if fits else [], prior), prior


def trust_in(
    fit: RatioFit, prior: Floats, sampled: SampledFrames, profile: CameraProfile, fits: bool
) -> ExposureTrust:
    """Return the uncertainty of the exposures, estimated from the frames' disagreement.

    fit, prior: results of `fit_exposures` with the same `fits`. Disagreement beyond the
    uncertainties of shutter and response increases the uncertainty: the light changed, or the
    profile is wrong. If the exposures were not fitted (`fits` is False), they are compared with a
    fit that serves only this purpose.
    """
    residuals = neighbours(sampled.pairs, fit.correction)
    u_typical = float(np.median(fit.u_log))
    u_response = 0.0 if profile.camera.kind == "raw" else profile.response.u_rel
    if fits:
        compared, u_explained, disagreement = fit, u_response, u_typical
        u_extra = unexplained(residuals, u_explained)
    else:
        compared = free_fit(sampled.pairs, len(prior))
        u_explained = float(np.hypot(u_response, u_typical))
        percents = [abs(n.residual_percent) for n in residuals]
        disagreement = float(np.median(percents)) / 100 if percents else u_typical
        u_extra = max(unexplained(residuals, u_explained), beyond(compared, u_explained))
    deviations = Deviations(
        np.log(compared.correction), np.hypot(np.sqrt(np.diag(prior)), u_response)
    )
    return ExposureTrust(
        tuple(residuals),
        deviations,
        float(np.hypot(u_typical, u_extra)),
        ratio_curve(sampled.samples, fit.covariance, u_extra),
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

    @property
    def larger(self) -> float:
        """The square root of the larger factor: a factor on the noise's standard deviation."""
        return float(np.sqrt(max(self.shot, self.read)))


def seen_noise(
    samples: Sequence[Sample], pairs: Sequence[PairRatio], correction: Floats
) -> SeenNoise:
    """Return factors on the variances of the profile's shot and read noise, from raw frames.

    samples: one for each frame, most exposed first; pairs: measured exposure ratios, of which only
    those of neighbours are used. correction: fitted over assumed exposure, [frames]. Both factors
    are 1 if too few pixels can be compared.
    """
    rows = []
    for pair in pairs:
        if pair.short == pair.long + 1:
            ratio = float(np.exp(np.log(correction[pair.short]) - np.log(correction[pair.long])))
            for shot, read, measured in _steps(samples[pair.long], samples[pair.short], ratio):
                # divide by the measured variance, so that all steps have equal weight
                rows.append((shot / measured, read / measured))
    if len(rows) < 4:
        return SeenNoise()
    table = np.array(rows)
    shot, read = _factors(table)
    residuals = table @ (shot, read) - 1.0
    u_shot, u_read = np.sqrt(np.diag(np.linalg.pinv(table.T @ table)) * np.mean(residuals**2))
    sure = shot > max(_TOLD, 1 + _SURE_SIGMA * u_shot), read > max(_TOLD, 1 + _SURE_SIGMA * u_read)
    return SeenNoise(shot if sure[0] else 1.0, read if sure[1] else 1.0)


def _factors(rows: Floats) -> tuple[float, float]:
    """Return the least-squares solution of rows @ (shot, read) = 1, without negative values."""
    alone = rows.sum(axis=0) / np.maximum((rows**2).sum(axis=0), 1e-30)
    shot, read = np.linalg.lstsq(rows, np.ones(len(rows)), rcond=None)[0]
    if shot < 0:
        return 0.0, float(alone[1])
    return (float(alone[0]), 0.0) if read < 0 else (float(shot), float(read))


def _steps(long: Sample, short: Sample, correction: float) -> list[tuple[float, float, float]]:
    """Return variances of the difference of two frames [DN2], one row for each step of the signal.

    A row has the shot variance and the read variance by the profile, and the measured variance.
    """
    a, b = long.signal, short.signal
    if not (isinstance(a, RawSignal) and isinstance(b, RawSignal)):
        return []
    shape = long.counts.shape
    good = a.usable(long.counts) & b.usable(short.counts) & ~long.full & ~short.full
    at = np.flatnonzero(good)
    at = at[:: max(1, len(at) // _MAX_PAIR_PIXELS)]
    y_long, y_short = long.counts.ravel()[at], short.counts.ravel()[at]
    ratio = correction * np.broadcast_to(b.per_cdm2 / a.per_cdm2, shape).ravel()[at]
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
        spread = robust_sigma(off)
        shot = float(np.median(r * light / b.gain_e_per_dn + r**2 * light / a.gain_e_per_dn))
        read = float(np.median(b.noise_dn2 + r**2 * a.noise_dn2))
        steps.append((shot, read, max(spread**2 - _ROUNDED_DN2, _ROUNDED_DN2)))
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
    import cv2

    pixels = [np.empty((0, 2), np.intp)]
    for row, column in ((0, 0), (0, 1), (1, 0), (1, 1)):
        moved = ((flags[row::2, column::2] & Flag.MOTION) > 0).view(np.uint8)
        if moved.any():
            around = cv2.boxFilter(
                moved, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT
            )
            pixels.append(2 * np.argwhere((moved > 0) & (np.asarray(around) == 1)) + (row, column))
    return np.concatenate(pixels)


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

    law: how nominal shutter times were read; fit: corrections of the exposures; trust: their
    uncertainty; look: saturation and black level; noise: noise over the profile's. moved: turns of
    the camera between frames, only for pairs of frames with enough common edges. dropped: share (0
    to 1) of its pixels that each frame lost to motion, empty without `drop_moved`. absent: names of
    frames that were taken without the filter of their label.
    """

    shots: tuple[Shot, ...]
    law: ShutterLaw
    fit: RatioFit
    trust: ExposureTrust
    look: FirstLook
    noise: SeenNoise
    moved: tuple[Moved, ...]
    dropped: tuple[float, ...]
    absent: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Frames:
    """The opened frames of one heading, with what every later step needs."""

    shots: tuple[Shot, ...]
    profile: CameraProfile  # with the shutter law that the frames are read with
    crop: Crop
    look: FirstLook
    store: FrameStore

    @property
    def raw(self) -> bool:
        return self.profile.camera.kind == "raw"

    @property
    def lenses(self) -> list[LensGeometry]:
        """Geometry of each lens, in pixels of the crop."""
        corner_px = (self.crop.left, self.crop.top)
        return [lens_geometry(lens, corner_px=corner_px) for lens in self.profile.lens]

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of a frame's array."""
        height, width = self.crop.height, self.crop.width
        return (height // 2, 2, width) if self.raw else (height, width, 3)


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
    resulting picture, clockwise. budget_bytes: memory for frames; others are read again in each
    pass. Return the merged pixels, and what the frames showed. Raises InputError for a frame that
    cannot be read or is of another camera.
    """
    options = options or MergeOptions()
    fits = options.fits(profile)
    shots, absent = _without_absent_filters(shots, profile, budget_bytes)
    law = stated_law(shots, profile)
    frames = _open_frames(shots, replace(profile, shutter_law=law.law), budget_bytes)
    moved = shifts([frames.store.small(i) for i in range(len(shots))], frames.lenses)
    sampled, law = decide_shutter_law(
        frames.store, sample_frames(frames.store), law, shots, frames.profile
    )
    fit, prior = fit_exposures(sampled, shots, replace(profile, shutter_law=law.law), fits)
    frames.store.correct(fit.correction)
    noise = _check_noise(frames, sampled, fit, fits)
    trust = trust_in(fit, prior, sampled, profile, fits)
    merged, dropped = _merge_pixels(frames, trust.tolerance, options.drop_moved, progress)
    if not frames.raw:
        merged = _with_jpeg_noise(frames, merged, options.target(profile))
    image = SensorImage(
        merged,
        frames.crop,
        turn_deg,
        shots[0].exposure.f_number,
        trust.u_curve,
        good_pixels(profile, frames.crop, merged.flags),
    )
    findings = Findings(
        tuple(shots), law, fit, trust, frames.look, noise, tuple(moved), dropped, absent
    )
    return image, findings


def _without_absent_filters(
    shots: Sequence[Shot], profile: CameraProfile, budget_bytes: int
) -> tuple[Sequence[Shot], tuple[str, ...]]:
    """Return the frames in order of exposure, and the names of those taken without their filter.

    Each frame with a filter in its label is compared with the frame without one whose exposure is
    nearest. Beyond the middle between the light with and without the filter, on a logarithmic
    scale, the filter was absent: the frame then counts as one without it.
    """
    bare = [shot for shot in shots if not shot.exposure.nd]
    absent = {}
    for shot in [shot for shot in shots if shot.exposure.nd and bare]:
        asked = shot.exposure
        like = min(bare, key=lambda s: abs(np.log(s.exposure.shutter_s / asked.shutter_s)))
        unlabelled = replace(shot, exposure=replace(asked, nd=""))
        frames = _open_frames([like, unlabelled], profile, budget_bytes)
        factor = float(np.mean(nd_factors(asked.nd, profile)))
        if light_ratio(*take_samples(frames.store)) > factor**-0.5:
            absent[shot.path.name] = unlabelled
    if not absent:
        return shots, ()
    right = [absent.get(shot.path.name, shot) for shot in shots]
    return sorted_shots(right, profile), tuple(sorted(absent))


def _open_frames(shots: Sequence[Shot], profile: CameraProfile, budget_bytes: int) -> _Frames:
    """Prepare the frames; each is read when it is first needed."""
    crop, look = lens_crop(profile), first_look(shots, profile)
    last = len(shots) - 1
    loaders: Sequence[Callable[[], Signal]]
    if profile.camera.kind == "raw":
        loaders = [partial(load_raw, s, profile, crop, look.plateau(s)) for s in shots]
    else:
        loaders = [
            partial(load_jpeg, s, profile, crop, (i == 0, i == last)) for i, s in enumerate(shots)
        ]
    return _Frames(tuple(shots), profile, crop, look, FrameStore(loaders, budget_bytes))


def _check_noise(frames: _Frames, sampled: SampledFrames, fit: RatioFit, fits: bool) -> SeenNoise:
    """Return the factors of the frames' noise over the profile's, and apply them to the frames."""
    if not (frames.raw and fits):
        return SeenNoise()
    noise = seen_noise(sampled.samples, sampled.pairs, fit.correction)
    frames.store.noisier(noise.shot, noise.read)
    return noise


def _merge_pixels(
    frames: _Frames, tolerance: float, drop_moved: bool, progress: Progress
) -> tuple[Merged, tuple[float, ...]]:
    """Return the merged pixels, and the share of its pixels that each frame lost to motion."""
    store = frames.store
    loaders = [partial(store.__getitem__, i) for i in range(len(store))]
    merged = merge_signals(
        loaders, frames.shape, u_ratio=tolerance, resident=store.resident, progress=progress
    )
    if not drop_moved:
        return merged, ()
    over = over_mosaic if frames.raw else over_colours
    return leave_out_moved(loaders, merged, u_ratio=tolerance, over_picture=over)


def _with_jpeg_noise(frames: _Frames, merged: Merged, target: Target) -> Merged:
    """Return the pixels with the measured noise of means over one target pixel."""
    edge_px = float(np.mean([footprint_px(lens, target) for lens in frames.lenses]))
    return with_seen_noise(merged, frames.store, frames.profile.colour.y_from_rgb, edge_px)
