"""Merge the frames of one heading on the sensor, step by step: noise, bad pixels, filters."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import cv2
import numpy as np
from scipy.optimize import nnls

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask, UInts8
from fieldlum.core.progress import part_of_progress, quiet, shown_by
from fieldlum.core.records import Flag
from fieldlum.core.statistics import robust_sigma
from fieldlum.merge.estimator import FramePixels, Merged, merge_signals
from fieldlum.merge.linear_frames import Crop, RawSignal, Saturation, Signal, lens_crop, read_frames
from fieldlum.merge.ratios import Exposures, RatioCurve, exposures_of, pair_ratios, take_samples
from fieldlum.merge.shift import turns_between
from fieldlum.merge.shots import Shot, sorted_shots
from fieldlum.optics.exposure import stated_law
from fieldlum.optics.linear_light import lens_geometry, nd_factors
from fieldlum.optics.profiles import CameraProfile, Lens
from fieldlum.optics.projection import LensGeometry
from fieldlum.session.files.sidecar import ShiftQuality

# ----------------------------------------------------------------------------------------------
# noise of raw frames, from neighbouring frames
#
# A profile's gain and read noise are often those of another body. If they give too little noise,
# noise is mistaken for motion and u is too small. Two frames of one scene differ by their noise:
# the part that grows with the signal gives the gain, the constant part gives the read noise (photon
# transfer; Janesick, SPIE 2007). The fit is robust against motion.


NOISE_OF_PROFILE = (1.0, 1.0)  # factors on the variances of its shot and read noise


def _with_noise(signal: Signal, noise: tuple[float, float]) -> Signal:
    """Return a raw frame with the noise of the profile changed; a JPEG frame unchanged.

    noise: factors on the variances of shot and read noise. A gain in electrons per count that is
    lower by a factor makes the variance of shot noise higher by that factor.
    """
    if not isinstance(signal, RawSignal):
        return signal
    shot_factor, read_factor = noise
    gain, read_dn2 = signal.gain_e_per_dn / shot_factor, signal.noise_dn2 * read_factor
    return replace(signal, gain_e_per_dn=gain, noise_dn2=read_dn2)


def noise_factors(samples: Sequence[FramePixels], correction: Floats) -> tuple[float, float]:
    """Return measured over stated variance of shot noise and of read noise, of raw frames.

    samples: one for each frame, most exposed first; correction: fitted over assumed exposure,
    [frames]. The profile states the variances. A factor is 1 unless it is over 1.44 (1.2 on the
    noise) and exceeds 1 by three standard errors, because read noise is uncertain where shot noise
    dominates. Both are 1 for JPEG frames, and if too few pixels can be compared.
    """
    ratios = correction[1:] / correction[:-1]
    steps = [
        step
        for (long, short), ratio in zip(pairwise(samples), ratios, strict=True)
        for step in _steps(long, short, float(ratio))
    ]
    if len(steps) < 4:
        return NOISE_OF_PROFILE
    shot, read, measured = np.array(steps).T  # variances [steps] each
    # divide by the measured variance, so that all steps have equal weight
    table = np.stack([shot / measured, read / measured], axis=1)
    factors = nnls(table, np.ones(len(table)))[0]  # of shot and read noise, not negative
    scatter = np.mean((table @ factors - 1.0) ** 2)
    u = np.sqrt(np.diag(np.linalg.pinv(table.T @ table)) * scatter)
    sure = factors > np.maximum(1.44, 1.0 + 3.0 * u)
    shot_factor, read_factor = np.where(sure, factors, 1.0).tolist()
    return shot_factor, read_factor


def _steps(
    long: FramePixels, short: FramePixels, correction: float
) -> list[tuple[float, float, float]]:
    """Return variances [DN^2] of the difference of two frames, one row for each step of brightness.

    long, short: the same pixels of two raw frames; correction: fitted over nominal exposure ratio.
    The list is empty for JPEG frames. A row has the shot variance and the read variance by the
    profile, and the measured variance. The pixels, sorted by brightness, are divided into at most
    twelve steps of at least 200 pixels each.
    """
    of_long, of_short = long.signal, short.signal
    if not (isinstance(of_long, RawSignal) and isinstance(of_short, RawSignal)):
        return []
    at = np.flatnonzero(long.usable() & short.usable())
    at = at[:: max(1, len(at) // 12_000)]
    y_long, y_short = long.counts.ravel()[at], short.counts.ravel()[at]
    nominal = np.broadcast_to(of_short.per_cdm2 / of_long.per_cdm2, long.counts.shape)
    ratio = correction * nominal.ravel()[at]  # of the short to the long exposure
    light = np.maximum(y_long, 0.0)
    shot = ratio * light / of_short.gain_e_per_dn + ratio**2 * light / of_long.gain_e_per_dn
    read = of_short.noise_dn2 + ratio**2 * of_long.noise_dn2
    # Where noise is about one count, a median of integers would jump between counts: spread the
    # counts evenly over their width first, which adds the variance of a uniform distribution.
    rounded_dn2 = 1 / 12
    spread = np.random.default_rng(0).uniform(-0.5, 0.5, len(at))
    difference = y_short - ratio * y_long + spread
    steps = np.array_split(np.argsort(y_long), int(np.clip(len(at) // 200, 1, 12)))

    def variances(step: Indices) -> tuple[float, float, float]:
        """Return the row of a step; step: indices of its pixels in the arrays above."""
        measured = max(robust_sigma(difference[step]) ** 2 - rounded_dn2, rounded_dn2)
        return float(np.median(shot[step])), float(np.median(read[step])), measured

    return [variances(step) for step in steps if len(step) >= 200]


# ----------------------------------------------------------------------------------------------
# pixels to ignore


def good_pixels(profile: CameraProfile, crop: Crop, flags: UInts8) -> Mask | None:
    """Return a mask [height, width] of the crop that is False at pixels to ignore.

    These are the profile's bad pixels and, for a raw camera, those of `isolated_pixels`. Return
    None if every pixel is good. flags: of the merged pixels of the crop, in the frames' shape.
    """
    # [n, 2]: row and column in the crop; a profile states column and row
    bad = np.array(profile.sensor.bad_px, np.intp).reshape(-1, 2)[:, ::-1] - (crop.top, crop.left)
    bad = bad[((bad >= 0) & (bad < (crop.height, crop.width))).all(axis=1)]
    if profile.camera.kind == "raw":
        bad = np.concatenate((bad, isolated_pixels(flags.reshape(crop.height, crop.width))))
    if not len(bad):
        return None
    good = np.ones((crop.height, crop.width), bool)
    good[bad[:, 0], bad[:, 1]] = False
    return good


def isolated_pixels(flags: UInts8) -> Indices:
    """Return row and column [n, 2] of isolated mosaic pixels at which the frames disagree.

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

    merged: pixels of the crop; profile: of the camera; crop: the part of the sensor that was read.
    turn_deg: heading of the camera minus that of the target, clockwise. f_number: of the frames.
    u_curve: relative uncertainty due to the exposures, over luminance. good: mask [height, width]
    of the crop, False at bad pixels; None if every pixel is good.
    """

    merged: Merged
    profile: CameraProfile
    crop: Crop
    turn_deg: float
    f_number: float
    u_curve: RatioCurve
    good: Mask | None = None

    def geometry(self, lens: Lens) -> LensGeometry:
        """Return the geometry of one of the profile's lenses, in pixels of the crop."""
        return lens_geometry(lens, self.turn_deg, (self.crop.left, self.crop.top))

    def luminance_and_clipped(self) -> tuple[Floats32, Mask]:
        """Return the luminance of the crop's pixels [cd/m2], and a mask of the clipped ones.

        Both are [height, width]. The luminance is not corrected for vignetting; in a mosaic, each
        pixel has the value of its own colour.
        """
        value, flags, shape = self.merged.value_cdm2, self.merged.flags, (self.crop.height, -1)
        if self.profile.camera.kind == "jpeg":
            value = value @ np.asarray(self.profile.colour.y_from_rgb, np.float32)
            flags = np.bitwise_or.reduce(flags, axis=-1)
        return value.reshape(shape), (flags.reshape(shape) & Flag.CLIPPED_HIGH) > 0


@dataclass(frozen=True, slots=True)
class Findings:
    """What the frames of one heading showed about exposures, noise, saturation and motion.

    shots: the frames, most exposed first, without a filter that was absent; exposures: of these
    frames. saturation: counts at which the colours saturate, and the black level; noise: factors of
    `noise_factors`. turns: of the camera between frames, only for pairs of frames with enough
    common points. absent: names of frames that were taken without the filter of their label.
    """

    shots: tuple[Shot, ...]
    exposures: Exposures
    saturation: Saturation
    noise: tuple[float, float]
    turns: tuple[ShiftQuality, ...]
    absent: tuple[str, ...] = ()


def merge_sensor(
    shots: Sequence[Shot], profile: CameraProfile, *, fit: bool | None = None, turn_deg: float = 0.0
) -> tuple[SensorImage, Findings]:
    """Merge the frames of one heading; return the merged pixels, and what the frames showed.

    shots: sorted by exposure, longest first. fit: whether exposure ratios are estimated from the
    frames; None: for raw frames only. turn_deg: heading of the camera minus that of the resulting
    picture, clockwise. Raises InputError for a frame that cannot be read or is of another camera,
    and for a filter that the profile does not have.
    """
    crop, is_raw = lens_crop(profile), profile.camera.kind == "raw"
    with shown_by(quiet):  # it reads a few frames
        shots, absent = _without_absent_filters(shots, profile, crop)
    nominal_s = [shot.exposure.shutter_s for shot in shots]
    law = stated_law(nominal_s, profile.shutter_law, profile.camera.model)
    with part_of_progress(0, 2):
        frames, saturation = read_frames(shots, replace(profile, shutter_law=law.law), crop)
    lenses = [lens_geometry(lens, corner_px=(crop.left, crop.top)) for lens in profile.lens]
    names = [shot.path.name for shot in shots]
    turns = turns_between([frame.reduced_frame() for frame in frames], lenses, names)
    fits = is_raw if fit is None else fit
    frames, exposures, samples = exposures_of(frames, shots, profile, law, fits)
    noise = noise_factors(samples, exposures.fit.correction) if fits else NOISE_OF_PROFILE
    frames = [_with_noise(signal, noise) for signal in frames]
    shape = (crop.height // 2, 2, crop.width) if is_raw else (crop.height, crop.width, 3)
    with part_of_progress(1, 2):
        merged = merge_signals(frames, shape, u_ratio=exposures.tolerance)
    good, f_number = good_pixels(profile, crop, merged.flags), shots[0].exposure.f_number
    image = SensorImage(merged, profile, crop, turn_deg, f_number, exposures.u_curve, good)
    return image, Findings(tuple(shots), exposures, saturation, noise, tuple(turns), absent)


def _without_absent_filters(
    shots: Sequence[Shot], profile: CameraProfile, crop: Crop
) -> tuple[Sequence[Shot], tuple[str, ...]]:
    """Return the frames in order of exposure, and the names of those taken without their filter.

    Each frame with a filter in its label is compared with the frame without a filter whose shutter
    time is nearest. If it is brighter than the middle between the light with and without the
    filter, on a logarithmic scale, the filter was absent, and the frame is returned without it.
    shots: of one heading; crop: the part of the sensor that is read.
    """
    bare = [shot for shot in shots if not shot.exposure.nd]
    corrected, absent = list(shots), []
    for number, shot in enumerate(shots):
        stated = shot.exposure
        if not stated.nd or not bare:
            continue
        nearest = min(bare, key=lambda s: abs(np.log(s.exposure.shutter_s / stated.shutter_s)))
        pair = [nearest, replace(shot, exposure=replace(stated, nd=""))]
        ratios = pair_ratios(take_samples(read_frames(pair, profile, crop)[0]))
        factor = float(np.mean(nd_factors(stated.nd, profile)))
        if ratios and ratios[0].log_ratio > -0.5 * np.log(factor):
            corrected[number] = pair[1]
            absent.append(shot.path.name)
    return (sorted_shots(corrected, profile), tuple(sorted(absent))) if absent else (shots, ())
