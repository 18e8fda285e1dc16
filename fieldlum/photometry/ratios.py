"""How long did each frame of a bracket really expose? A robust fit in the log domain over all pairs
that overlap.

For a pair, y_short / y_long is averaged over pixels that both see well; the choice of pixels rests
on the long frame alone, whose noise is small, so that noise in the short frame selects nothing. The
pair's answers then give one correction a frame by weighted least squares with priors. Only ratios
are known from pictures: the priors fix the gauge.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.statistics import robust_sigma

MIN_PIXELS = 50
_SYSTEMATIC = 5e-4  # floor of a pair's uncertainty: linearity of the sensor, light within a second
PRIOR_LONG, PRIOR_SHORT, SHORT_S = (
    0.003,
    0.03,
    1 / 1000,
)  # how well a snapped time is known, below SHORT_S worse


@dataclass(frozen=True, slots=True)
class PairRatio:
    """log_ratio: ln of (true over assumed) exposure of frame `short` minus that of frame `long`;
    u_log its u.
    """

    long: int
    short: int
    log_ratio: float
    u_log: float
    pixels: int


@dataclass(frozen=True, slots=True)
class RatioFit:
    """correction[i] multiplies the assumed exposure of frame i; covariance [frames, frames] is
    of its logarithm.
    """

    correction: NDArray[np.float64]
    covariance: NDArray[np.float64]
    pairs: tuple[PairRatio, ...]

    @property
    def u_log(self) -> NDArray[np.float64]:
        """Relative standard uncertainty of each correction."""
        return np.sqrt(np.diag(self.covariance))


def pair_ratio(
    long_signal: NDArray[np.floating],
    short_signal: NDArray[np.floating],
    usable: NDArray[np.bool_],
    long_variance: NDArray[np.floating],
    short_variance: NDArray[np.floating],
    assumed_ratio: float | NDArray[np.floating],
    long: int = 0,
    short: int = 1,
) -> PairRatio | None:
    """One pair from its sampled pixels, all arrays [n]; None where fewer than 50 pixels are left.

    short_variance is that of the signal predicted from the long frame (long_signal *
    assumed_ratio), never of the noisy value. Huber weights at 2.5 sigma hold off motion and hot
    pixels.
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
        robust = weight * np.minimum(1.0, 2.5 * spread / np.maximum(pull, 1e-12))
        centre = float((robust * r).sum() / robust.sum())
    if not centre > 0:
        return None
    u = spread / np.sqrt(robust.sum()) / centre
    return PairRatio(
        long, short, float(np.log(centre)), float(np.hypot(u, _SYSTEMATIC)), y_long.size
    )


def _weighted_median(values: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(cumulative, 0.5 * cumulative[-1])])


def prior_u_log(shutter_s: NDArray[np.floating]) -> NDArray[np.float64]:
    """How well a snapped shutter time is known before any picture: 0.3 %, and 3 % below 1/1000
    s.
    """
    return np.where(np.asarray(shutter_s) < SHORT_S, PRIOR_SHORT, PRIOR_LONG)


def fit_ratios(pairs: list[PairRatio], prior_covariance: NDArray[np.floating]) -> RatioFit:
    """Corrections of all frames from the pairs and the priors: minimise sum (d - delta_s +
    delta_l)^2 / u^2 + priors.

    prior_covariance [frames, frames] of the log exposures: two frames of one shutter time err
    together. Pairs that contradict the rest (a cloud passed) lose weight by Huber's rule. Where the
    corrections contradict the priors (light that changed meanwhile, a shutter unlike its dial), the
    level that the priors fix is less sure by as much: the covariance then rests on priors that are
    wider by Birge's ratio (Phys. Rev. 40, 1932).
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
        weight = 1.0 / sigma**2 * np.minimum(1.0, 2.5 / np.maximum(pull, 1e-12))
    shared = np.array(
        [sum(q.short == p.short for q in pairs) for p in pairs]
    )  # one short frame's noise is in them all
    known = design.T @ ((weight / shared)[:, None] * design) if pairs else 0.0
    wider = prior_covariance + np.eye(frames) * _surplus(delta, prior, prior_covariance, design)
    covariance = np.asarray(np.linalg.inv(known + np.linalg.inv(wider)), np.float64)
    return RatioFit(np.exp(delta), covariance, tuple(pairs))


def _surplus(
    delta: NDArray[np.floating],
    prior: NDArray[np.floating],
    prior_covariance: NDArray[np.floating],
    design: NDArray[np.floating],
) -> float:
    """Variance that each exposure needs beside its prior's: the surest prior's, times how far
    chi2 is beyond 1.
    """
    freedom = np.linalg.matrix_rank(design) if len(design) else 0
    if not freedom:
        return 0.0
    birge2 = float(delta @ prior @ delta) / freedom
    return max(birge2 - 1.0, 0.0) * float(np.diag(prior_covariance).min())
