"""Estimate the exposure ratios of a bracket's frames by a robust fit in the log domain.

For a pair, y_short / y_long is averaged over pixels that are well exposed in both frames. The long
frame alone selects the pixels: its noise is small, so that noise of the short frame does not bias
the selection. Weighted least squares with priors then give one correction for each frame. Pictures
determine only ratios; the priors determine the common level.
"""

from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.statistics import robust_sigma

# Fewer usable pixels give no ratio. Chosen so that one object does not decide it; not measured.
MIN_PIXELS = 50
# Floor of a pair's relative uncertainty: linearity of the sensor, change of light within a second.
# Chosen well below the shutter priors; not measured.
_SYSTEMATIC = 5e-4
# Relative standard uncertainty of a snapped shutter time, from SHORT_S on and below it: mechanical
# shutters are less accurate at short times. Chosen so that measured ratios outweigh them: errors of
# up to 3.9 % are found (docs/validation.md). Not measured on real cameras.
PRIOR_LONG = 0.003
PRIOR_SHORT = 0.03
SHORT_S = 1 / 1000
# Residuals over this many sigma lose weight (Huber 1964; 2.5 keeps 99 % of normal residuals).
_HUBER_SIGMA = 2.5


@dataclass(frozen=True, slots=True)
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
class RatioFit:
    """Corrections of the exposures of a bracket, and their covariance.

    correction [frames]: factors on the assumed exposures; covariance [frames, frames]: of their
    natural logarithms; pairs: the measured ratios that were fitted.
    """

    correction: Floats
    covariance: Floats
    pairs: tuple[PairRatio, ...]

    @property
    def u_log(self) -> Floats:
        """Return the relative standard uncertainty of each correction, [frames]."""
        return np.sqrt(np.diag(self.covariance))


def pair_ratio(
    long_signal: Floats,
    short_signal: Floats,
    usable: Mask,
    long_variance: Floats,
    short_variance: Floats,
    assumed_ratio: float | Floats,
    long: int = 0,
    short: int = 1,
) -> PairRatio | None:
    """Return the measured exposure ratio of two frames over the assumed ratio, as a logarithm.

    None with under 50 usable pixels, or if the measured ratio is not positive. Arrays are [n];
    usable: True for pixels to use; assumed_ratio: short over long exposure, a number or [n].
    short_variance must be the variance of the signal predicted from the long frame (long_signal *
    assumed_ratio), not of the noisy value. Huber weights at 2.5 sigma reduce the weight of motion
    and hot pixels. long, short: indices of the frames, only copied to the result.
    """
    y_long, y_short = (np.asarray(s, np.float64)[usable] for s in (long_signal, short_signal))
    ratio = np.broadcast_to(np.asarray(assumed_ratio, np.float64), np.shape(long_signal))[usable]
    if y_long.size < MIN_PIXELS:
        return None
    r = y_short / (y_long * ratio)
    variance = short_variance[usable] / (y_long * ratio) ** 2 + long_variance[usable] / y_long**2
    weight = 1.0 / (variance + 1e-6)
    centre, spread, robust = _weighted_median(r, weight), 1.0, weight
    for _ in range(8):
        pull = np.abs(r - centre) * np.sqrt(weight)
        spread = max(1.0, robust_sigma(pull, 0.0))
        robust = weight * np.minimum(1.0, _HUBER_SIGMA * spread / np.maximum(pull, 1e-12))
        centre = float((robust * r).sum() / robust.sum())
    if not centre > 0:
        return None
    u = spread / np.sqrt(robust.sum()) / centre
    return PairRatio(
        long, short, float(np.log(centre)), float(np.hypot(u, _SYSTEMATIC)), y_long.size
    )


def _weighted_median(values: Floats, weights: Floats) -> float:
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, 0.5 * cumulative[-1])])


def prior_u_log(shutter_s: Floats) -> Floats:
    """Return the relative standard uncertainty of shutter times that were not measured, [n].

    0.003 from 1/1000 s on, 0.03 for shorter times. shutter_s : [n], s.
    """
    return np.where(np.asarray(shutter_s) < SHORT_S, PRIOR_SHORT, PRIOR_LONG)


def fit_ratios(pairs: list[PairRatio], prior_covariance: Floats) -> RatioFit:
    """Return the corrections of all frames that fit the pairs and the priors best.

    With delta the ln correction of a frame, the sum over pairs of (log_ratio - delta_short +
    delta_long)^2 / u_log^2 plus the priors (delta = 0) is minimised. prior_covariance [frames,
    frames] is that of ln exposure: two frames with one shutter time have a common error.
    Pairs that contradict the rest (because a cloud passed) lose weight by Huber's rule. If the
    corrections contradict the priors (because the light changed, or the shutter deviates from its
    nominal times), the common level is less certain: the priors of the covariance are then widened
    by Birge's ratio (Phys. Rev. 40, 1932).
    """
    frames = len(prior_covariance)
    prior = np.asarray(np.linalg.inv(prior_covariance), np.float64)
    design = np.zeros((len(pairs), frames))
    for row, pair in enumerate(pairs):
        design[row, pair.short], design[row, pair.long] = 1.0, -1.0
    observed = np.array([p.log_ratio for p in pairs])
    sigma = np.array([p.u_log for p in pairs])
    weight = 1.0 / sigma**2
    delta = np.zeros(frames)
    for _ in range(10):
        normal = design.T @ (weight[:, None] * design) + prior
        delta = np.linalg.solve(normal, design.T @ (weight * observed))
        pull = np.abs(observed - design @ delta) / sigma if pairs else np.zeros(0)
        huber = np.minimum(1.0, _HUBER_SIGMA / np.maximum(pull, 1e-12))
        weight = 1.0 / sigma**2 * huber
    # The noise of a short frame is in all pairs with that frame, so these pairs together count as
    # one.
    shared = np.array([sum(q.short == p.short for q in pairs) for p in pairs])
    information = design.T @ ((weight / shared)[:, None] * design) if pairs else 0.0
    wider = prior_covariance + np.eye(frames) * _surplus(delta, prior, prior_covariance, design)
    covariance = np.asarray(np.linalg.inv(information + np.linalg.inv(wider)), np.float64)
    return RatioFit(np.exp(delta), covariance, tuple(pairs))


def _surplus(delta: Floats, prior: Floats, prior_covariance: Floats, design: Floats) -> float:
    """Return the variance to add to each prior: the smallest prior variance times (chi2 - 1)."""
    freedom = np.linalg.matrix_rank(design) if len(design) else 0
    if not freedom:
        return 0.0
    birge2 = float(delta @ prior @ delta) / freedom
    return max(birge2 - 1.0, 0.0) * float(np.diag(prior_covariance).min())
