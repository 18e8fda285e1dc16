"""Determine the exposures of a bracket: shutter law, fitted corrections, uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.merge.frame_cache import FrameStore
from fieldlum.merge.ratios import (
    RatioCurve,
    Sample,
    beyond,
    bracket_pairs,
    free_fit,
    neighbours,
    ratio_curve,
    take_samples,
    unexplained,
)
from fieldlum.merge.shots import Shot, exposure_covariance, times_by_law
from fieldlum.optics.linear_light import true_shutter_s
from fieldlum.optics.photometry import PairRatio, RatioFit, ShutterLaw, fit_ratios, law_of_frames
from fieldlum.optics.profiles import CameraProfile
from fieldlum.session.files.merge_report import NeighbourQuality

# Smaller relative differences between frames never count as motion. The value equals the prior
# uncertainty of a mechanical shutter time (photometry/ratios.py, PRIOR_LONG). Chosen.
_LEAST_TOLERANCE = 0.003
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
        max(_LEAST_TOLERANCE, _TOLERANCE_SIGMA * disagreement, u_response),
    )
