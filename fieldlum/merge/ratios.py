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
from fieldlum.merge.estimator import FramePixels
from fieldlum.merge.linear_frames import RawSignal, Signal, scale_exposures
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
    not positive. y_long, y_short: linear signals [n] of the same pixels in counts, with their
    variances [counts^2]; assumed_ratio: short over long exposure. short_variance must be the
    variance of the signal predicted from the long frame (y_long * assumed_ratio), not of the noisy
    value; long_variance that of y_long. Huber weights reduce the weight of motion and hot pixels:
    those over 2.5 standard deviations from the mean ratio, as the pixels scatter. frames: numbers
    of the long and of the short frame, only copied to the result.
    """
    if y_long.size < 50:
        return None
    predicted = y_long * assumed_ratio
    ratio = y_short / predicted
    weight = 1.0 / (short_variance / predicted**2 + long_variance / y_long**2 + 1e-6)
    robust, root, spread, mean = weight, np.sqrt(weight), 1.0, float(np.median(ratio))
    for _ in range(8):
        residual = np.abs(ratio - mean) * root  # in standard deviations
        spread = max(1.0, MAD_TO_SIGMA * np.median(residual))
        robust = weight * np.minimum(1.0, _HUBER_SIGMA * spread / np.maximum(residual, 1e-12))
        before, mean = mean, float((robust * ratio).sum() / robust.sum())
        if abs(mean - before) < 1e-7 * mean:  # a millionth of what a frame's ratio can show
            break
    if not mean > 0:
        return None
    u_log = float(np.hypot(spread / np.sqrt(robust.sum()) / mean, U_FRAME_RATIO))
    long, short = frames
    log_ratio = float(np.log(mean))
    return PairRatio(long=long, short=short, log_ratio=log_ratio, u_log=u_log, pixels=y_long.size)


RatioCurve = Callable[[Floats], Floats]
"""Gives the relative standard uncertainty of merged values [...] in cd/m2 due to the exposures."""


def take_samples(frames: Sequence[Signal]) -> list[FramePixels]:
    """Return samples of each frame: 60 000 to 250 000 pixels, at the same places in all."""
    sampled = [signal.sampled(96, 640) for signal in frames]  # rows (raw: pairs of them), columns
    return [FramePixels(signal, signal.strip(0, len(full))[0], full) for signal, full in sampled]


def _mean_cdm2(long: FramePixels, short: FramePixels) -> Floats32:
    """Return the mean luminance of two frames, weighted by the inverse variance, [...].

    The noise of this mean is uncorrelated with that of the frames' ratio. Pixels chosen by the
    light of the long frame alone are those with positive noise there: at dusk frames then differed
    by 4 %.
    """
    per_long, per_short = long.signal.per_cdm2, short.signal.per_cdm2
    unweighted = np.maximum((long.counts + short.counts) / (per_long + per_short), 0.0)
    weight_long, weight_short = long.signal.weight(unweighted), short.signal.weight(unweighted)
    information = np.maximum(weight_long * per_long + weight_short * per_short, 1e-30)
    total = weight_long * long.counts + weight_short * short.counts
    return np.maximum(total / information, 0.0)


def _well_exposed(long: FramePixels, short: FramePixels) -> Floats32:
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
    at &= long.counts != 0.0  # where light came only in the short frame there is no ratio
    per_long = np.broadcast_to(long.signal.per_cdm2, at.shape)[at]
    per_short = np.broadcast_to(short.signal.per_cdm2, at.shape)[at]
    variances = (per_long / weight_long[at], per_short / weight_short[at])
    counts = (long.counts[at], short.counts[at])
    return np.array((*counts, *variances, per_short / per_long, snr_short[at]), np.float32)


def pair_ratios(samples: Sequence[FramePixels]) -> list[PairRatio]:
    """Return the measured exposure ratios of pairs of frames over the assumed ones.

    samples: one for each frame, most exposed first, at the same pixels. Frames of a pair are at
    most three apart in that order; pairs with too few pixels that are well exposed in both are
    omitted.
    """
    pairs = []
    for i, long in enumerate(samples):
        minima = _SNR_SHORT if isinstance(long.signal, RawSignal) else _SNR_SHORT[-1:]
        for j, short in enumerate(samples[i + 1 : i + 4], start=i + 1):
            *values, snr_short = _well_exposed(long, short)
            bright = [snr_short > minimum for minimum in minima]
            at = next((mask for mask in bright if mask.sum() >= _ENOUGH), bright[-1])
            pair = pair_ratio(*(v[at].astype(np.float64) for v in values), frames=(i, j))
            if pair is not None:
                pairs.append(pair)
    return pairs


def neighbour_residuals(pairs: list[PairRatio], correction: Floats) -> list[NeighbourQuality]:
    """Return by how much neighbouring frames still disagree after `correction`, in %.

    pairs: measured exposure ratios; correction: factors on the assumed exposures, [frames]. A
    residual is positive if the less exposed frame is still brighter than expected. Pairs of frames
    that are not neighbours are omitted.
    """
    delta = np.log(correction)
    residuals = [float(100 * (p.log_ratio - delta[p.short] + delta[p.long])) for p in pairs]
    return [
        NeighbourQuality(
            p.long, p.short, residual_percent=percent, u_percent=100 * p.u_log, pixels=p.pixels
        )
        for p, percent in zip(pairs, residuals, strict=True)
        if p.short == p.long + 1
    ]


def unexplained_by_neighbours(disagreements: Sequence[NeighbourQuality], u_known: float) -> float:
    """Return the relative uncertainty of a frame's exposure that its known causes do not explain.

    disagreements: of neighbouring frames; u_known: relative uncertainty of one frame by its known
    causes. The variance of the disagreement, less that of the measured ratios' noise, is halved for
    one of the two frames; less the square of u_known, it is the square of the result. Return 0 if
    nothing remains, or if `disagreements` is empty.
    """
    if not disagreements:
        return 0.0
    spread = robust_sigma([n.residual_percent for n in disagreements], 0.0) / 100
    noise = float(np.median([n.u_percent for n in disagreements])) / 100
    return float(np.sqrt(max((spread**2 - noise**2) / 2 - u_known**2, 0.0)))


def unexplained_by_fit(free: RatioFit, u_known: float) -> float:
    """Return the relative uncertainty of exposures that their known causes do not explain.

    free: exposures fitted to the pairs with a weak prior. The square of the result is the variance
    of the logarithms of the corrections, less that of the measured pairs' noise and the square of
    u_known, the relative uncertainty of a frame by known causes. Return 0 if nothing remains, or
    without pairs.
    """
    frames = sorted({i for p in free.pairs for i in (p.long, p.short)})
    if not frames:
        return 0.0
    centred = np.eye(len(frames)) - 1.0 / len(frames)  # subtracts the mean: no common level
    noise2 = float(np.mean(np.diag(centred @ free.covariance[np.ix_(frames, frames)] @ centred)))
    return float(np.sqrt(max(np.var(np.log(free.correction[frames])) - noise2 - u_known**2, 0.0)))


def ratio_curve(
    samples: Sequence[FramePixels], covariance: Floats, extra: float = 0.0
) -> RatioCurve:
    """Return the relative uncertainty of a merged value due to uncertain exposures, by luminance.

    samples: one for each frame. The square of the uncertainty is s C s + extra^2, with C the
    `covariance` of the log exposures [frames, frames], s the share (0 to 1) of the weight that each
    frame has in a merged value of that luminance, and `extra` the relative uncertainty that
    disagreement of the frames adds. Between the luminances of the curve it is interpolated, beyond
    them it is that of the nearest end. Errors of frames are correlated, because pictures contain
    only ratios of exposures. A single value for the bracket would be too small at luminances that
    only an uncertain frame can read.
    """
    # a few pixels of each frame suffice, because all of one colour have the same weight
    cells = [sample.signal.sampled(1, 2)[0] for sample in samples]
    largest_cdm2 = [float(np.max(cell.max_cdm2)) for cell in cells]
    levels_cdm2 = np.geomspace(1e-6 * min(largest_cdm2), max(largest_cdm2), 193)
    information = []  # of each frame, [levels]
    for cell in cells:
        shape = (len(levels_cdm2), *cell.strip(0, 1)[0].shape[1:])
        weight = cell.weight(np.broadcast_to(levels_cdm2[:, None, None], shape).astype(np.float32))
        information.append((weight * cell.per_cdm2).astype(np.float64).sum(axis=(1, 2)))
    total = np.sum(information, axis=0)
    populated = total > 0
    if not populated.any():
        largest = np.diag(covariance).max(keepdims=True)
        return partial(np.interp, xp=np.ones(1), fp=np.sqrt(largest + extra**2))
    share = np.stack(information, axis=1)[populated] / total[populated, None]  # [levels, frames]
    variance = np.einsum("li,ij,lj->l", share, covariance, share)
    return partial(np.interp, xp=levels_cdm2[populated], fp=np.sqrt(variance + extra**2))


def fit_ratios(pairs: list[PairRatio], prior_covariance: Floats) -> RatioFit:
    """Return the corrections of all frames' exposures that fit the pairs and the priors best.

    With delta the ln of the correction factor on a frame's exposure, the sum over pairs of
    (log_ratio - delta_short + delta_long)^2 / u_log^2 plus the priors (delta = 0) is minimised.
    prior_covariance [frames, frames] is that of ln exposure: two frames with one shutter time have
    a common error. Pairs that contradict the rest (because a cloud passed) lose weight by Huber's
    rule (Annals of Mathematical Statistics 35, 1964) from 2.5 u_log on. If the corrections
    contradict the priors (because the light changed, or the shutter deviates from its nominal
    times), the common level is less certain: the priors of the covariance are then widened by
    Birge's ratio (Phys. Rev. 40, 1932).
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
        residual = np.abs(observed - design @ delta) / sigma
        huber = np.minimum(1.0, _HUBER_SIGMA / np.maximum(residual, 1e-12))
        weight = 1.0 / sigma**2 * huber
    # The noise of a short frame is in all pairs with that frame, so these pairs together count as
    # one.
    shared = np.array([sum(q.short == p.short for q in pairs) for p in pairs])
    information = design.T @ ((weight / shared)[:, None] * design)
    wider = prior_covariance + np.eye(frames) * _surplus(delta, prior, prior_covariance, design)
    covariance = np.asarray(np.linalg.inv(information + np.linalg.inv(wider)), np.float64)
    return RatioFit(np.exp(delta), covariance, tuple(pairs))


def _surplus(delta: Floats, prior: Floats, prior_covariance: Floats, design: Floats) -> float:
    """Return the variance to add to each prior, because the corrections contradict the priors.

    It is the smallest prior variance times (chi2 - 1), with chi2 of the corrections over their
    degrees of freedom; 0 if the priors explain the corrections. delta [frames]: ln of the
    corrections; prior [frames, frames]: inverse of prior_covariance; design [pairs, frames].
    """
    if not len(design):
        return 0.0
    birge2 = float(delta @ prior @ delta) / np.linalg.matrix_rank(design)
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
) -> tuple[list[Signal], Exposures, list[FramePixels]]:
    """Return frames with corrected exposures, the exposures, and samples without the corrections.

    frames, shots: most exposed first. law: the shutter law with which the frames were read; a law
    derived from nominal times is tested with the frames' ratios first. fits: whether exposures are
    corrected by a fit; if not, they are only compared with one. Frames that disagree by more than
    the uncertainties of shutter and response increase the uncertainty, because the light changed or
    the profile is wrong.
    """
    samples = take_samples(frames)
    pairs = pair_ratios(samples)
    if law.decided_by == "labels":
        times_s = times_by_law(shots, profile)
        assumed, law = law.law, law_of_frames(times_s, law, pairs)
        if law.law != assumed:
            frames = scale_exposures(frames, times_s[law.law] / times_s[assumed])
            samples = take_samples(frames)
            pairs = pair_ratios(samples)
    prior = exposure_covariance([s.exposure for s in shots], replace(profile, shutter_law=law.law))
    fit = fit_ratios(pairs if fits else [], prior)
    residuals = neighbour_residuals(pairs, fit.correction)
    u_typical = float(np.median(fit.u_log))
    u_response = 0.0 if profile.camera.kind == "raw" else profile.response.u_rel
    if fits:
        compared, disagreement = fit, u_typical
        u_extra = unexplained_by_neighbours(residuals, u_response)
    else:
        # Differences of 2 % between neighbours can add up over a bracket: a weak prior of 30 %.
        compared = fit_ratios(pairs, np.eye(len(prior)) * 0.3**2)
        u_known = float(np.hypot(u_response, u_typical))
        percents = [abs(n.residual_percent) for n in residuals]
        disagreement = float(np.median(percents)) / 100 if percents else u_typical
        of_neighbours = unexplained_by_neighbours(residuals, u_known)
        u_extra = max(of_neighbours, unexplained_by_fit(compared, u_known))
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
    return scale_exposures(frames, fit.correction), exposures, samples
