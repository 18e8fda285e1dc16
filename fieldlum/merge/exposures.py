"""Exposures of one bracket: the shutter's law, the fitted corrections, and their uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.linear_light import true_shutter_s
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
from fieldlum.photometry import PairRatio, RatioFit, ShutterLaw, fit_ratios, law_of_frames
from fieldlum.profiles import CameraProfile
from fieldlum.session.files.merge_report import NeighbourQuality

# A relative difference of frames below this is never taken for motion. It equals the prior of a
# mechanical shutter time (photometry/ratios.py, PRIOR_LONG).
_LEAST_TOLERANCE = 0.003
_TOLERANCE_SIGMA = 3.0  # standard deviations of the typical disagreement of frames
# A deviation of an exposure is reported if it exceeds both, relative and in prior u.
_REPORTED_DEVIATION, _REPORTED_SIGMA = 0.02, 3.0


@dataclass(frozen=True, slots=True)
class SampledFrames:
    """The same pixels of every frame, and the exposure ratios that pairs of frames show."""

    samples: list[Sample]
    pairs: list[PairRatio]


@dataclass(frozen=True, slots=True)
class Deviations:
    """Fitted exposures compared with the profile's: ln ratio, prior uncertainty, [frames]."""

    log_ratio: NDArray[np.float64]
    u_prior: NDArray[np.float64]

    @property
    def span_percent(self) -> float:
        """Range of the fitted exposures over the profile's [%]."""
        return float(100 * np.ptp(self.log_ratio))

    @property
    def beyond_prior(self) -> bool:
        """Whether an exposure differs by more than its prior uncertainty explains."""
        limit = np.maximum(_REPORTED_DEVIATION, _REPORTED_SIGMA * self.u_prior)
        return bool((np.abs(self.log_ratio) > limit).any())

    @property
    def text(self) -> str:
        """The range in percent, for the verdict."""
        low, high = 100 * np.expm1(self.log_ratio.min()), 100 * np.expm1(self.log_ratio.max())
        return f"{low:+.1f} to {high:+.1f}"


@dataclass(frozen=True, slots=True)
class ExposureTrust:
    """Uncertainty of the exposures.

    u_rel: relative uncertainty of a typical frame; u_curve: that of a merged value over its
    luminance; tolerance: relative difference of two frames that is not motion.
    """

    neighbours: tuple[NeighbourQuality, ...]
    deviations: Deviations
    u_rel: float
    u_curve: RatioCurve
    tolerance: float


def sample_frames(store: FrameStore) -> SampledFrames:
    """Return some pixels of every frame, and the ratios of all pairs that share bright pixels."""
    samples = take_samples(store)
    return SampledFrames(samples, bracket_pairs(samples))


def decide_shutter_law(
    store: FrameStore,
    sampled: SampledFrames,
    law: ShutterLaw,
    shots: Sequence[Shot],
    profile: CameraProfile,
) -> tuple[SampledFrames, ShutterLaw]:
    """Return the law that the frames decide, if only their labels were known before.

    profile: with the law that the frames were read with. If the law changes, the frames of `store`
    get the exposures of the new law and are sampled again.
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
) -> tuple[RatioFit, NDArray[np.float64]]:
    """Return corrections of the exposures, and their prior covariance [frames, frames].

    Without `fits` the pairs are ignored: corrections are 1 and the covariance is the prior.
    """
    prior = exposure_covariance([s.exposure for s in shots], profile)
    return fit_ratios(sampled.pairs if fits else [], prior), prior


def trust_in(
    fit: RatioFit,
    prior: NDArray[np.float64],
    sampled: SampledFrames,
    profile: CameraProfile,
    fits: bool,
) -> ExposureTrust:
    """Return the uncertainty of the exposures from the frames' disagreement.

    Disagreement that neither the shutter nor the response explains widens the uncertainty: the
    light changed, or the profile is wrong. Exposures that were not fitted are compared with a fit
    for this purpose only. prior : covariance of the log exposures, [frames, frames].
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
        # An error of a JPEG's response looks like a difference between frames, not like motion.
        max(_LEAST_TOLERANCE, _TOLERANCE_SIGMA * disagreement, u_response),
    )
