"""Classify glare protection by EN 17037, with the confidence that the uncertainty allows.

A class is reached if DGP exceeds its limit in at most 5 % of the occupied hours (EN 17037:2018,
annex A.5 and table A.7): 0.45 minimum, 0.40 medium, 0.35 high. Dark occupied hours count as hours
without glare.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Mask
from fieldlum.optics.projection import NOT_SEEN, SEEN
from fieldlum.year.glare.metrics import DGP_BASE, DGP_CONTRAST, DGP_EV

CLASSES = (("high", 0.35), ("medium", 0.40), ("minimum", 0.45))  # EN 17037:2018, strictest first
# From here on glare is "disturbing" (Wienold 2009, Building Simulation, table 2).
DISTURBING_DGP = 0.40
NO_CLASS = "none"
NOT_SEEN_CLASS = NOT_SEEN  # the class of a direction of which no lens saw enough
EXCEEDED_SHARE = 0.05  # EN 17037:2018, annex A.5
# Share of the error's variance that all hours have in common, because a model is often wrong in the
# same way. Chosen, not measured; the intervals covered 99.8 % of drawn rooms (docs/accuracy.md).
COMMON_ERROR = 0.5
DRAWS = 400  # years drawn for an interval, whose ends are the 10th and the 390th value; chosen


def disturbed_share(dgp: Floats) -> Floats:
    """Return, for each hour, the share of its view directions with disturbing glare, 0 to 1, [n].

    Disturbing means a DGP above 0.40. dgp : [n, d] of n hours in d directions, NaN for directions
    that no lens saw; these do not count. The result is NaN for an hour in which no direction
    counts.
    """
    has_dgp = np.isfinite(dgp)
    over = (np.where(has_dgp, dgp, 0.0) > DISTURBING_DGP).sum(axis=1)
    count = has_dgp.sum(axis=1)
    return np.divide(over, count, out=np.full(len(over), np.nan), where=count > 0)


@dataclass(frozen=True, slots=True)
class Protection:
    """Glare protection by EN 17037 in d view directions.

    azimuths_deg [d] : clockwise from north; occupied_hours : hours of the year in which the room is
    used; dgp_exceeded [d] : the DGP that is exceeded in 5 % of them; hours_over [d, 3] : number of
    them with a DGP above .35, .40, .45; low, high [d] : ends of the 95 % interval of dgp_exceeded,
    None if the model has no uncertainty; classes [d] : "high", "medium", "minimum" or "none" (by
    `class_of`); certain [d] : True if the interval is within one class, False without an interval;
    seen [d] : "seen", "partly seen" or "not seen"; empty: not recorded. A direction that was not
    seen has NaN in dgp_exceeded, low and high, and the class "not seen".
    """

    azimuths_deg: Floats
    occupied_hours: int
    dgp_exceeded: Floats
    hours_over: NDArray[np.int64]
    low: Floats | None
    high: Floats | None
    classes: tuple[str, ...]
    certain: Mask
    seen: tuple[str, ...] = ()

    @property
    def judged(self) -> Mask:
        """Mask [d], True for directions that have a class ("none" is one), False for "not seen"."""
        return np.array([name != NOT_SEEN_CLASS for name in self.classes])

    def sentence(self, i: int) -> str:
        """Return class, DGP and certainty of direction number `i` (from 0) as a sentence."""
        value, name = self.dgp_exceeded[i], self.classes[i]
        if name == NOT_SEEN_CLASS:
            return "not seen: no lens saw enough of this direction"
        text = "no class" if name == NO_CLASS else f"class {name}"
        if self.seen and self.seen[i] != SEEN:
            text = f"{text}, from the seen part of the view"
        if self.low is None or self.high is None:
            return (
                f"{text} (DGP {value:.3f} exceeded in 5 % of occupied hours); the model states no "
                f"uncertainty"
            )
        interval = (
            f"DGP exceeded in 5 % of occupied hours: {value:.3f}, 95 % interval "
            f"{self.low[i]:.3f} to {self.high[i]:.3f}"
        )
        if self.certain[i]:
            return f"{text} ({interval})"
        return f"cannot tell yet: {text} is the most likely class ({interval})"


def class_of(dgp_exceeded: float) -> str:
    """Return the EN 17037 class of a DGP that is exceeded in 5 % of the occupied hours.

    At most 0.35 is "high" protection, at most 0.40 "medium", at most 0.45 "minimum", otherwise
    "none".
    """
    return next((name for name, limit in CLASSES if dgp_exceeded <= limit), NO_CLASS)


def exceeded_in_share(dgp: Floats, occupied_hours: int) -> Floats:
    """Return the DGP of each direction that is exceeded in 5 % of the occupied hours, [..., d].

    dgp : [..., n, d] of the n lit occupied hours in d directions; the other occupied hours are dark
    and count too, as hours without glare. The result is the (k + 1)th largest value, with k =
    floor(0.05 * occupied_hours), or 0 if n <= k.
    """
    lit = dgp.shape[-2]
    rank = int(np.floor(EXCEEDED_SHARE * occupied_hours + 1e-9))
    if rank >= lit:
        return np.zeros((*dgp.shape[:-2], dgp.shape[-1]))
    return np.partition(np.asarray(dgp, float), lit - 1 - rank, axis=-2)[..., lit - 1 - rank, :]


def dgp_uncertainty(
    ev_lx: Floats, contrast: Floats, ev_relative: Floats, source_relative: Floats
) -> Floats:
    """Return the standard uncertainty of DGP, [n, d], by first-order propagation.

    ev_lx : [n, d] vertical illuminance; contrast : [n, d] sum of L^2 omega / P^2 over sources;
    ev_relative, source_relative : [n, d] relative standard uncertainties of Ev and of the luminance
    of sources. The error of Ev has opposite signs in the Ev term and in the contrast term, but both
    are added: the result is larger than the true uncertainty. The sources' error is assumed to be
    independent.
    """
    ratio = contrast / np.maximum(ev_lx, 1e-6) ** 1.87
    slope = DGP_CONTRAST / np.log(10.0) * ratio / (1.0 + ratio)
    from_ev = (DGP_EV * ev_lx + 1.87 * slope) * ev_relative
    return np.hypot(from_ev, 2.0 * slope * source_relative)


def dgp_per_scale(dgp: Floats, ev_lx: Floats) -> Floats:
    """Return the change of DGP for a relative change of all luminances, of the shape of `dgp`.

    By DGP's own formula: Ev times (1 + e), and the contrast term's argument times (1 + e)^0.13.
    """
    power = np.clip((dgp - DGP_EV * ev_lx - DGP_BASE) / DGP_CONTRAST, 0.0, None)
    share = 1.0 - 10.0**-power  # x / (1 + x) of log10(1 + x)
    return DGP_EV * ev_lx + 0.13 * DGP_CONTRAST / np.log(10.0) * share


@dataclass(frozen=True, slots=True)
class GlareDoubt:
    """Further uncertainty of the DGP of n hours in d directions, besides the model's own error.

    seen [d] : "seen", "partly seen" or "not seen"; least, most [n, d] : least and largest DGP over
    possible light in the unseen part of a view; drawn [k, n, d] : DGP with the sun's disc as
    visible in each of k possible rooms, None if the room is certain.
    """

    seen: tuple[str, ...]
    least: Floats
    most: Floats
    drawn: Floats | None = None

    def hours(self, rows: Mask) -> GlareDoubt:
        """Return the uncertainty of the hours for which the mask `rows` [n] is True."""
        drawn = None if self.drawn is None else self.drawn[:, rows]
        return GlareDoubt(self.seen, self.least[rows], self.most[rows], drawn)


def protection(
    dgp: Floats,
    u_dgp: Floats | None,
    occupied_hours: int,
    azimuths_deg: Floats,
    rng: np.random.Generator,
    doubt: GlareDoubt | None = None,
    u_common: Floats | None = None,
) -> Protection:
    """Return the EN 17037 glare protection in d view directions, with 95 % intervals.

    dgp : [n, d] of the n lit occupied hours. u_dgp : [n, d] its standard uncertainty by the model.
    Without it (None, or not finite in a direction that was seen) there are no intervals: low and
    high are None. occupied_hours : number of lit and dark occupied hours. azimuths_deg : [d],
    clockwise from north. doubt : uncertainty of unseen parts and of the room; None if everything is
    seen and the room is certain. u_common : [n, d] standard uncertainty of DGP by an error that all
    hours and directions share, such as the camera's scale; None for none.

    The interval comes from 400 years drawn with `rng`, with normal errors around the model's DGP;
    half of their variance is common to all hours. Each drawn year takes the sun's disc from one of
    the drawn rooms. The lower end uses `doubt.least`, the upper end `doubt.most`.
    """
    azimuths = np.asarray(azimuths_deg, float)
    doubt = doubt or GlareDoubt((SEEN,) * len(azimuths), dgp, dgp)
    judged = np.array([word != NOT_SEEN for word in doubt.seen])
    point = exceeded_in_share(dgp, occupied_hours)
    point[~judged] = np.nan
    over = np.stack([(dgp > limit).sum(axis=0) for _, limit in CLASSES], axis=1)
    classes = tuple(
        class_of(float(value)) if good else NOT_SEEN_CLASS
        for value, good in zip(point, judged, strict=True)
    )
    none_certain = np.zeros(len(azimuths), bool)
    if u_dgp is None or not np.isfinite(u_dgp[:, judged]).all() or not judged.any():
        return Protection(
            azimuths, occupied_hours, point, over, None, None, classes, none_certain, doubt.seen
        )
    shared = np.zeros_like(dgp) if u_common is None else u_common
    low, high = _interval(dgp, u_dgp, shared, occupied_hours, rng, doubt)
    low, high = np.minimum(low, point), np.maximum(high, point)
    certain = judged & np.array(
        [class_of(float(a)) == class_of(float(b)) for a, b in zip(low, high, strict=True)]
    )
    return Protection(
        azimuths, occupied_hours, point, over, low, high, classes, certain, doubt.seen
    )


def _interval(
    dgp: Floats,
    u_dgp: Floats,
    u_common: Floats,
    occupied_hours: int,
    rng: np.random.Generator,
    doubt: GlareDoubt,
) -> tuple[Floats, Floats]:
    """Return the ends of the 95 % interval of dgp_exceeded for each direction, [d] each."""
    lows, highs = [], []
    all_seen = bool(np.array_equal(doubt.least, doubt.most, equal_nan=True))
    for k in range(DRAWS):
        year = dgp if doubt.drawn is None else doubt.drawn[k % len(doubt.drawn)]
        error = u_dgp * year_errors(dgp.shape, rng) + u_common * rng.standard_normal()
        darkest = np.clip(year + (doubt.least - dgp) + error, 0.0, 1.0)
        lows.append(exceeded_in_share(darkest, occupied_hours))
        brightest = np.clip(year + (doubt.most - dgp) + error, 0.0, 1.0)
        highs.append(lows[-1] if all_seen else exceeded_in_share(brightest, occupied_hours))
    return np.percentile(lows, 2.5, axis=0), np.percentile(highs, 97.5, axis=0)


def year_errors(shape: tuple[int, ...], rng: np.random.Generator) -> Floats:
    """Return standard normal errors [n, d] of one drawn year, partly common to its hours."""
    common = rng.standard_normal((1, shape[1])) * np.sqrt(COMMON_ERROR)
    own = rng.standard_normal((shape[0], 1)) * np.sqrt(1.0 - COMMON_ERROR)
    return common + own


def hours_to_capture(dgp: Floats, u_dgp: Floats, undecided: Mask, limits: Floats) -> Floats:
    """Return how much each hour's uncertainty keeps classes of directions undecided, [n].

    dgp, u_dgp : [n, d] DGP and its standard uncertainty; undecided : mask [d], True for directions
    that count; limits : [d] DGP limit of each direction. The value is the sum over the undecided
    directions of p (1 - p), with p the probability that the hour's DGP is above the limit (normal
    error). Capture the hours with the largest values.
    """
    from scipy.special import ndtr

    if not undecided.any():
        return np.zeros(len(dgp))
    above = ndtr((dgp[:, undecided] - limits[undecided]) / np.maximum(u_dgp[:, undecided], 1e-6))
    return (above * (1.0 - above)).sum(axis=1)


def nearest_limits(protection: Protection) -> Floats:
    """Return for each direction the class limit that is nearest to its dgp_exceeded, [d].

    It is 0.35, 0.40 or 0.45; 0.35 for a direction that was not seen.
    """
    limits = np.array([limit for _, limit in CLASSES])
    return limits[np.abs(limits[None, :] - protection.dgp_exceeded[:, None]).argmin(axis=1)]
