"""EN 17037's protection from glare, with the confidence that the model's own uncertainty leaves.

A class is met when DGP exceeds its limit in at most 5 % of the occupied hours (EN 17037:2018, annex
A.5 and table A.7):
0.45 minimum, 0.40 medium, 0.35 high. Dark occupied hours count as hours without glare.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.glare.metrics import DGP_CONTRAST, DGP_EV
from fieldlum.records import Float

CLASSES = (("high", 0.35), ("medium", 0.40), ("minimum", 0.45))  # from the strictest
NO_CLASS = "none"
EXCEEDED_SHARE = 0.05
# share of the error's variance that all hours have in common: a model is wrong in the same way
# often
COMMON_ERROR = 0.5
DRAWS = 400


@dataclass(frozen=True, slots=True)
class Protection:
    """Glare protection in d directions; low and high bound the 95 % interval of dgp_exceeded.

    dgp_exceeded [d] the DGP that 5 % of the occupied hours exceed; hours_over [d, 3] hours above
    .35, .40, .45; low, high [d] or None where the model gives no uncertainty; classes [d]; certain
    [d].
    """

    azimuths_deg: NDArray[np.float64]
    occupied_hours: int
    dgp_exceeded: NDArray[np.float64]
    hours_over: NDArray[np.int64]
    low: NDArray[np.float64] | None
    high: NDArray[np.float64] | None
    classes: tuple[str, ...]
    certain: NDArray[np.bool_]

    def sentence(self, i: int) -> str:
        """What can be said about one direction, in words."""
        value, name = self.dgp_exceeded[i], self.classes[i]
        said = "no class" if name == NO_CLASS else f"class {name}"
        if self.low is None or self.high is None:
            return (
                f"{said} (DGP {value:.3f} exceeded in 5 % of occupied hours); the model gives "
                f"no uncertainty"
            )
        between = (
            f"DGP exceeded in 5 % of occupied hours: {value:.3f}, between {self.low[i]:.3f} "
            f"and {self.high[i]:.3f}"
        )
        return (
            f"{said} ({between})"
            if self.certain[i]
            else f"cannot tell yet: {said} is likeliest ({between})"
        )


def class_of(dgp_exceeded: float) -> str:
    """The strictest class whose limit is not exceeded."""
    return next((name for name, limit in CLASSES if dgp_exceeded <= limit), NO_CLASS)


def exceeded_in_share(
    dgp: Float, occupied_hours: int, share: float = EXCEEDED_SHARE
) -> NDArray[np.float64]:
    """The DGP that a share of the occupied hours exceed; dgp [..., n, d] of the lit ones; the rest
    are dark and count.

    The (k + 1)th largest value, k = floor(share * hours): just that many hours may lie above the
    limit.
    """
    lit = dgp.shape[-2]
    rank = int(np.floor(share * occupied_hours + 1e-9))
    if rank >= lit:
        return np.zeros((*dgp.shape[:-2], dgp.shape[-1]))
    return np.partition(np.asarray(dgp, float), lit - 1 - rank, axis=-2)[..., lit - 1 - rank, :]


def dgp_uncertainty(
    ev_lx: Float, contrast: Float, ev_relative: Float, source_relative: Float
) -> NDArray[np.float64]:
    """Standard uncertainty of DGP from the relative ones of Ev and of the sources' luminance, [n,
    d].

    First order; Ev's part in the Ev term and in the contrast term is one error, the sources' is
    taken as another, so that the sum is not helped by errors that would cancel.
    """
    ratio = contrast / np.maximum(ev_lx, 1e-6) ** 1.87
    slope = DGP_CONTRAST / np.log(10.0) * ratio / (1.0 + ratio)
    from_ev = (DGP_EV * ev_lx + 1.87 * slope) * ev_relative
    return np.hypot(from_ev, 2.0 * slope * source_relative)


def protection(
    dgp: Float,
    u_dgp: Float | None,
    occupied_hours: int,
    azimuths_deg: Float,
    rng: np.random.Generator,
) -> Protection:
    """Classes of d directions from the lit occupied hours' dgp [n, d] and its standard uncertainty
    u_dgp [n, d].

    The interval comes from `DRAWS` years with normal errors that share `COMMON_ERROR` of their
    variance: a model's answer is its mean belief, and the truth lies around it.
    """
    point = exceeded_in_share(dgp, occupied_hours)
    over = np.stack([(dgp > limit).sum(axis=0) for _, limit in CLASSES], axis=1)
    classes = tuple(class_of(float(value)) for value in point)
    azimuths = np.asarray(azimuths_deg, float)
    if u_dgp is None or not np.isfinite(u_dgp).all():
        nobody = np.zeros(len(azimuths), bool)
        return Protection(azimuths, occupied_hours, point, over, None, None, classes, nobody)
    drawn = np.stack([_drawn_year(dgp, u_dgp, occupied_hours, rng) for _ in range(DRAWS)])
    low, high = np.percentile(drawn, (2.5, 97.5), axis=0)
    low, high = np.minimum(low, point), np.maximum(high, point)
    certain = np.array(
        [class_of(float(a)) == class_of(float(b)) for a, b in zip(low, high, strict=True)]
    )
    return Protection(azimuths, occupied_hours, point, over, low, high, classes, certain)


def _drawn_year(
    dgp: Float, u_dgp: Float, occupied_hours: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    common = rng.standard_normal((1, dgp.shape[1])) * np.sqrt(COMMON_ERROR)
    own = rng.standard_normal((len(dgp), 1)) * np.sqrt(1.0 - COMMON_ERROR)
    return exceeded_in_share(np.clip(dgp + u_dgp * (common + own), 0.0, 1.0), occupied_hours)


def hours_to_capture(
    dgp: Float, u_dgp: Float, undecided: NDArray[np.bool_], limits: Float
) -> NDArray[np.float64]:
    """How much each hour's own uncertainty keeps the undecided directions open, [n]; the largest
    are worth capturing.

    For each undecided direction the variance of "this hour is above the limit", p (1 - p) with
    normal p.
    """
    from scipy.special import ndtr

    if not undecided.any():
        return np.zeros(len(dgp))
    above = ndtr((dgp[:, undecided] - limits[undecided]) / np.maximum(u_dgp[:, undecided], 1e-6))
    return (above * (1.0 - above)).sum(axis=1)


def nearest_limits(protection: Protection) -> NDArray[np.float64]:
    """The class limit that each direction's interval lies closest to, [d]."""
    limits = np.array([limit for _, limit in CLASSES])
    return limits[np.abs(limits[None, :] - protection.dgp_exceeded[:, None]).argmin(axis=1)]
