"""Estimate the exposures of a bracket's frames by a robust fit of their ratios in the log domain.

For a pair, y_short / y_long is averaged over pixels that are well exposed in both frames. The light
of both frames together selects the pixels, so that noise does not bias the selection. Weighted
least squares with priors then give one correction for each frame. Pictures determine only ratios;
the priors determine the common level.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.statistics import MAD_TO_SIGMA, robust_sigma
from fieldlum.merge.estimator import Rows
from fieldlum.merge.linear_frames import RawSignal, Signal, scaled
from fieldlum.merge.shots import Shot, exposure_covariance, times_by_law
from fieldlum.optics.exposure import PairRatio, ShutterLaw, law_of_frames
from fieldlum.optics.linear_light import U_FRAME_RATIO
from fieldlum.optics.profiles import CameraProfile
from fieldlum.session.files.sidecar import NeighbourQuality

# Least signal-to-noise ratios in the shorter frame, tried from the highest, and number of pixels
# that suffices. Bright pixels are preferred because a black level that is wrong by one count
# affects dim pixels.
_SNR_SHORT, _ENOUGH = (60.0, 15.0, 3.0), 2000
# Residuals over this many sigma lose weight (Huber 1964; 2.5 keeps 99 % of normal residuals).
_HUBER_SIGMA = 2.5


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
    y_long: Floats,
    y_short: Floats,
    long_variance: Floats,
    short_variance: Floats,
    assumed_ratio: Floats | float,
    frames: tuple[int, int] = (0, 1),
) -> PairRatio | None:
    """Return the measured exposure ratio of two frames over the assumed ratio, as a logarithm.

    None with under 50 pixels, so that one object does not decide it, or if the measured ratio is
    not positive. y_long, y_short: linear signals [n], with their variances; assumed_ratio: short
    over long exposure. short_variance must be the variance of the signal predicted from the long
    frame (y_long * assumed_ratio), not of the noisy value; long_variance that of y_long. Huber
    weights at 2.5 sigma reduce the weight of motion and hot pixels. frames: numbers of the long and
    of the short frame, only copied to the result.
    """
    if y_long.size < 50:
        return None
    predicted = y_long * assumed_ratio
    r = y_short / predicted
    weight = 1.0 / (short_variance / predicted**2 + long_variance / y_long**2 + 1e-6)
    root, centre, before, robust = np.sqrt(weight), np.median(r), np.inf, weight
    spread = 1.0
    for _ in range(8):
        pull = np.abs(r - centre) * root
        spread = max(1.0, MAD_TO_SIGMA * np.median(pull))
        robust = weight * np.minimum(1.0, _HUBER_SIGMA * spread / np.maximum(pull, 1e-12))
        before, centre = centre, float((robust * r).sum() / robust.sum())
        if abs(centre - before) < 1e-7 * centre:  # a millionth of what a frame's ratio can show
            break
    if not centre > 0:
        return None
    u = float(np.hypot(spread / np.sqrt(robust.sum()) / centre, U_FRAME_RATIO))
    long, short = frames
    log_ratio = float(np.log(centre))
    return PairRatio(long=long, short=short, log_ratio=log_ratio, u_log=u, pixels=y_long.size)


RatioCurve = Callable[[Floats], Floats]
"""Gives the relative standard uncertainty of merged values [...] in cd/m2 due to the exposures."""


def take_samples(frames: Sequence[Signal]) -> list[Rows]:
    """Return samples of each frame: 60 000 to 250 000 pixels, at the same places in all."""
    small = [signal.sampled(96, 640) for signal in frames]  # rows (raw: pairs of them), columns
    return [Rows(signal, signal.strip(0, len(full))[0], full) for signal, full in small]


def _mean_cdm2(long: Rows, short: Rows) -> Floats32:
    """Return the mean luminance of two frames, weighted by the inverse variance, [...].

    Its noise is uncorrelated with that of the frames' ratio. Pixels chosen by the light of the long
    frame alone are those with positive noise there: at dusk frames then differed by 4 %.
    """
    per_long, per_short = long.signal.per_cdm2, short.signal.per_cdm2
    first = np.maximum((long.counts + short.counts) / (per_long + per_short), 0.0)
    w_long, w_short = long.signal.weight(first), short.signal.weight(first)
    total = np.maximum(w_long * per_long + w_short * per_short, 1e-30)
    return np.maximum((w_long * long.counts + w_short * short.counts) / total, 0.0)


def _well_exposed(long: Rows, short: Rows) -> Floats32:
    """Return the n pixels that are well exposed in two frames, in columns, [6, n].

    long, short: the same pixels of a longer and of a shorter exposure. Rows: counts in the long and
    in the short frame, variances of both [counts^2], short over long exposure, and signal-to-noise
    ratio in the short frame.
    """
    assert long.full is not None and short.full is not None  # samples state it
    mean_cdm2 = _mean_cdm2(long, short)
    weight_long, weight_short = long.signal.weight(mean_cdm2), short.signal.weight(mean_cdm2)
    snr_long = mean_cdm2 * np.sqrt(weight_long * long.signal.per_cdm2)
    snr_short = mean_cdm2 * np.sqrt(weight_short * short.signal.per_cdm2)
    at = (snr_long > 30.0) & (snr_short > _SNR_SHORT[-1]) & ~(long.full | short.full)
    per_long = np.broadcast_to(long.signal.per_cdm2, at.shape)[at]
    per_short = np.broadcast_to(short.signal.per_cdm2, at.shape)[at]
    variances = (per_long / weight_long[at], per_short / weight_short[at])
    counts = (long.counts[at], short.counts[at])
    return np.array((*counts, *variances, per_short / per_long, snr_short[at]), np.float32)


def bracket_pairs(samples: Sequence[Rows]) -> list[PairRatio]:
    """Return the measured exposure ratios of pairs of frames over the assumed ones.

    samples: one for each frame, most exposed first, at the same pixels. Frames of a pair are at
    most three apart in that order; pairs with too few pixels that are well exposed in both are
    omitted.
    """
    found = []
    for i, long in enumerate(samples):
        minima = _SNR_SHORT if isinstance(long.signal, RawSignal) else _SNR_SHORT[-1:]
        for j, short in enumerate(samples[i + 1 : i + 4], start=i + 1):
            *values, snr_short = _well_exposed(long, short)
            bright = [snr_short > minimum for minimum in minima]
            at = next((mask for mask in bright if mask.sum() >= _ENOUGH), bright[-1])
            found.append(pair_ratio(*(v[at].astype(np.float64) for v in values), frames=(i, j)))
    return [pair for pair in found if pair is not None]


def neighbours(pairs: list[PairRatio], correction: Floats) -> list[NeighbourQuality]:
    """Return the disagreement [%] that neighbouring frames still have after `correction`.

    pairs: measured exposure ratios; correction: factors on the assumed exposures, [frames]. A
    disagreement is positive if the less exposed frame is still brighter than expected. Pairs that
    are no neighbours are omitted.
    """
    delta = np.log(correction)
    off = [float(100 * (p.log_ratio - delta[p.short] + delta[p.long])) for p in pairs]
    return [
        NeighbourQuality(
            p.long, p.short, residual_percent=percent, u_percent=100 * p.u_log, pixels=p.pixels
        )
        for p, percent in zip(pairs, off, strict=True)
        if p.short == p.long + 1
    ]


def unexplained(disagreements: Sequence[NeighbourQuality], explained: float) -> float:
    """Return the relative uncertainty of a frame's exposure that its known causes do not explain.

    disagreements: of neighbouring frames. explained: the known relative uncertainty of one
    frame. The variance of the disagreement, less that of the measured ratios' noise, is halved for
    one of the two frames; less the square of `explained`, it is the square of the result. Return 0
    if nothing remains, or if `disagreements` is empty.
    """
    if not disagreements:
        return 0.0
    apart = robust_sigma([n.residual_percent for n in disagreements], 0.0) / 100
    noise = float(np.median([n.u_percent for n in disagreements])) / 100
    return float(np.sqrt(max((apart**2 - noise**2) / 2 - explained**2, 0.0)))


def unexplained_u(free: RatioFit, explained: float) -> float:
    """Return the relative uncertainty of exposures that their known causes do not explain.

    free: by the pairs and a weak prior. The uncertainty is the standard deviation of the logarithms
    of its corrections, reduced by `explained` (the known relative uncertainty) and by the noise of
    the measured pairs. Return 0 if nothing remains, or without pairs.
    """
    frames = sorted({i for p in free.pairs for i in (p.long, p.short)})
    if not frames:
        return 0.0
    centred = np.eye(len(frames)) - 1.0 / len(frames)
    noise2 = float(np.mean(np.diag(centred @ free.covariance[np.ix_(frames, frames)] @ centred)))
    return float(np.sqrt(max(np.var(np.log(free.correction[frames])) - noise2 - explained**2, 0.0)))


def ratio_curve(samples: Sequence[Rows], covariance: Floats, extra: float = 0.0) -> RatioCurve:
    """Return the relative uncertainty of a merged value due to uncertain exposures, by luminance.

    samples: one for each frame. The square of the uncertainty is s C s + extra^2, with C the
    `covariance` of the log exposures [frames, frames], s the share (0 to 1) of the weight that each
    frame has in a merged value of that luminance, and `extra` the relative uncertainty that
    disagreement of the frames adds. Between the luminances of the curve it is interpolated, beyond
    them it is that of the nearest end. Errors of frames are correlated, because
    pictures contain only ratios of exposures. A single value for the bracket would be too small at
    luminances that only an uncertain frame can read.
    """
    small = [s.signal.sampled(1, 2)[0] for s in samples]
    largest = [float(np.max(s.max_cdm2)) for s in small]
    levels = np.geomspace(1e-6 * min(largest), max(largest), 193)
    information = []
    for s in small:
        cell = s.strip(0, 1)[0].shape[1:]
        at = np.broadcast_to(levels[:, None, None], (len(levels), *cell))
        w = s.weight(at.astype(np.float32))
        information.append((w * s.per_cdm2).astype(np.float64).sum(axis=(1, 2)))
    total = np.sum(information, axis=0)
    populated = total > 0
    if not populated.any():
        largest = np.diag(covariance).max(keepdims=True)
        return partial(np.interp, xp=np.ones(1), fp=np.sqrt(largest + extra**2))
    share = np.stack(information, axis=1)[populated] / total[populated, None]
    variance = np.einsum("li,ij,lj->l", share, covariance, share)
    return partial(np.interp, xp=levels[populated], fp=np.sqrt(variance + extra**2))


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


# ----------------------------------------------------------------------------------------------
# the exposures of a bracket


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
    """Return whether a log exposure deviates by over 2 % and by over three u_prior.

    log_deviation, u_prior: [frames], natural logarithms.
    """
    return bool((np.abs(log_deviation) > np.maximum(0.02, 3.0 * u_prior)).any())


def exposures_of(
    frames: list[Signal], shots: Sequence[Shot], profile: CameraProfile, law: ShutterLaw, fits: bool
) -> tuple[list[Signal], Exposures, list[Rows]]:
    """Return frames with corrected exposures, the exposures, and samples without the corrections.

    law: that with which the frames were read. One that is derived from nominal times is tested with
    the frames' ratios first. If `fits` is False, no exposure is corrected. Disagreement of frames
    beyond the uncertainties of shutter and response increases the uncertainty: the light changed,
    or the profile is wrong. Exposures that are not fitted are compared with a fit that serves only
    this purpose. shots: of the frames, most exposed first.
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
    residuals = neighbours(pairs, fit.correction)
    u_typical = float(np.median(fit.u_log))
    u_response = 0.0 if profile.camera.kind == "raw" else profile.response.u_rel
    if fits:
        compared, disagreement = fit, u_typical
        u_extra = unexplained(residuals, u_response)
    else:
        # Differences of 2 % between neighbours can add up over a bracket: a weak prior of 30 %.
        compared = fit_ratios(pairs, np.eye(len(prior)) * 0.3**2)
        u_explained = float(np.hypot(u_response, u_typical))
        percents = [abs(n.residual_percent) for n in residuals]
        disagreement = float(np.median(percents)) / 100 if percents else u_typical
        u_extra = max(unexplained(residuals, u_explained), unexplained_u(compared, u_explained))
    exposures = Exposures(
        law=law,
        fit=fit,
        neighbours=tuple(residuals),
        log_deviation=np.log(compared.correction),
        u_prior=np.hypot(np.sqrt(np.diag(prior)), u_response),
        u_rel=float(np.hypot(u_typical, u_extra)),
        u_curve=ratio_curve(samples, fit.covariance, u_extra),
        # At least the prior uncertainty of a mechanical shutter time. The error of a JPEG's
        # response makes frames differ without any motion.
        tolerance=max(0.003, 3.0 * disagreement, u_response),
    )
    return scaled(frames, fit.correction), exposures, samples
