"""Classify glare protection by EN 17037, with the confidence that the uncertainty allows.

A class is reached if DGP exceeds its limit in at most 5 % of the occupied hours (EN 17037:2018,
annex A.5 and table A.7): 0.45 minimum, 0.40 medium, 0.35 high. Dark occupied hours count as hours
without glare.
"""

from typing import NamedTuple, Self

import numpy as np
from msgspec import structs
from numpy.random import Generator

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.optics.projection import NOT_SEEN, SEEN
from fieldlum.session.files.predict_json import DirectionYear
from fieldlum.year.glare.metrics import DGP_BASE, DGP_CONTRAST, DGP_EV

CLASSES = (("high", 0.35), ("medium", 0.40), ("minimum", 0.45))  # EN 17037:2018, strictest first
# From here on glare is "disturbing" (Wienold 2009, Building Simulation, table 2).
DISTURBING_DGP = 0.40
NO_CLASS = "none"
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


def dgp_per_scale(dgp: Floats, ev_lx: Floats) -> Floats:
    """Return the derivative of DGP with respect to a common factor on all luminances, [...].

    It is dDGP / dln(factor), at the factor 1. dgp, ev_lx : [...] each. In DGP's formula (`dgp`)
    the factor multiplies Ev; it multiplies the quotient in the logarithm, sum L^2 omega / P^2 over
    Ev^1.87, by its power 2 - 1.87 = 0.13.
    """
    power = np.clip((dgp - DGP_EV * ev_lx - DGP_BASE) / DGP_CONTRAST, 0.0, None)
    share = 1.0 - 10.0**-power  # x / (1 + x), as the contrast term is log10(1 + x)
    return DGP_EV * ev_lx + 0.13 * DGP_CONTRAST / np.log(10.0) * share


class DgpUncertainty(NamedTuple):
    """How uncertain the DGP of n hours in d directions is.

    words [d] : "seen", "partly seen" or "not seen"; minimum, maximum [n, d] : lowest and highest
    DGP over possible light in the unseen part of a view; drawn [k, n, d] : DGP in k random draws
    of the sun's place and visibility; u_maps [n, d] : standard uncertainty of DGP by the model's
    maps, NaN if unknown.
    """

    words: tuple[str, ...]
    minimum: Floats
    maximum: Floats
    drawn: Floats32
    u_maps: Floats

    def hours(self, rows: Mask) -> Self:
        """Return the uncertainty of the hours for which the mask `rows` [n] is True."""
        arrays = {name: getattr(self, name)[..., rows, :] for name in DgpUncertainty._fields[1:]}
        return self._replace(**arrays)


def class_of(dgp_exceeded: float) -> str:
    """Return the EN 17037 class of a DGP, 0 to 1, that is exceeded in 5 % of the occupied hours.

    At most 0.35 is "high" protection, at most 0.40 "medium", at most 0.45 "minimum" (EN 17037:2018,
    table A.7), otherwise "none"; "none" for NaN.
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

    ev_lx : vertical illuminance of n hours in d view directions [n, d]; contrast : [n, d] sum of
    L^2 omega / P^2 over sources; ev_relative, source_relative : [n, d] relative standard
    uncertainties of Ev and of the luminance of sources. The error of Ev has opposite signs in the
    Ev term and in the contrast term, but both are added: the result is larger than the true
    uncertainty. The sources' error is assumed to be independent.
    """
    ratio = contrast / np.maximum(ev_lx, 1e-6) ** 1.87
    slope = DGP_CONTRAST / np.log(10.0) * ratio / (1.0 + ratio)
    return np.hypot((DGP_EV * ev_lx + 1.87 * slope) * ev_relative, 2.0 * slope * source_relative)


def protection(
    dgp: Floats,
    uncertainty: DgpUncertainty,
    occupied_hours: int,
    azimuths_deg: Floats,
    rng: Generator,
    u_common: Floats | None = None,
) -> tuple[DirectionYear, ...]:
    """Return the EN 17037 glare protection in d view directions, with 95 % intervals.

    dgp [n, d], uncertainty : those of the n lit occupied hours. occupied_hours : number of lit and
    dark occupied hours. azimuths_deg : [d], clockwise from north. A direction that was not seen has
    no figures; without u_maps in all others there are no intervals. u_common : [n, d] standard
    uncertainty of DGP by an error that all hours and directions share, such as the camera's scale;
    None for none.

    The interval comes from 400 years drawn with `rng`, with normal errors around the model's DGP;
    half of their variance is common to all hours. Each drawn year takes the sun's disc from one
    draw of `uncertainty.drawn`. The lower end uses `uncertainty.minimum`, the upper end
    `uncertainty.maximum`.
    """
    exceeded = exceeded_in_share(dgp, occupied_hours)
    judged = np.array([word != NOT_SEEN for word in uncertainty.words])
    ends = None
    if judged.any() and np.isfinite(uncertainty.u_maps[:, judged]).all():
        shared = np.zeros_like(dgp) if u_common is None else u_common
        low, high = _interval(dgp, shared, occupied_hours, rng, uncertainty)
        ends = np.stack([np.minimum(low, exceeded), np.maximum(high, exceeded)], axis=1)
    rows = []
    for i, (azimuth, word) in enumerate(zip(azimuths_deg, uncertainty.words, strict=True)):
        over = {f"{limit:.2f}": int((dgp[:, i] > limit).sum()) for _, limit in CLASSES}
        row = DirectionYear(float(azimuth), NOT_SEEN, seen=word, hours_over=dict.fromkeys(over))
        if judged[i]:
            figures = {"glare_class": class_of(exceeded[i]), "dgp_exceeded": float(exceeded[i])}
            if ends is not None:
                low, high = map(float, ends[i])
                figures |= {"low": low, "high": high, "certain": class_of(low) == class_of(high)}
            row = structs.replace(row, hours_over=over, **figures)
        rows.append(structs.replace(row, sentence=_sentence(row)))
    return tuple(rows)


def _sentence(row: DirectionYear) -> str:
    """Return a text with the class of a direction, its exceeded DGP, and how certain both are."""
    if row.dgp_exceeded is None:
        return "not seen: no lens saw enough of this direction"
    text = "below minimum" if row.glare_class == NO_CLASS else f"class {row.glare_class}"
    if row.seen != SEEN:
        text = f"{text}, from the seen part of the view"
    if not row.certain:
        text = f"cannot tell yet: {text} is the most likely class"
    figure = f"{text} (DGP exceeded in 5 % of occupied hours: {row.dgp_exceeded:.3f}"
    if row.low is None:
        return f"{figure}); the model states no uncertainty"
    return f"{figure}, 95 % interval {row.low:.3f} to {row.high:.3f})"


def _interval(
    dgp: Floats, u_common: Floats, occupied_hours: int, rng: Generator, uncertainty: DgpUncertainty
) -> tuple[Floats, Floats]:
    """Return the ends of the 95 % interval of dgp_exceeded for each direction, [d] each.

    dgp [n, d]: that of the n lit occupied hours in d view directions; u_common [n, d]: standard
    uncertainty by an error that all hours share; occupied_hours: number of lit and dark ones;
    uncertainty: that of `dgp`.
    """
    ends = []
    bounds = np.stack([uncertainty.minimum, uncertainty.maximum])  # [2, n, d]
    for k in range(DRAWS):
        deviation = uncertainty.drawn[k % len(uncertainty.drawn)] - dgp  # of a drawn year
        deviation += uncertainty.u_maps * year_errors(dgp.shape, rng)
        deviation += u_common * rng.standard_normal()
        ends.append(exceeded_in_share(np.clip(bounds + deviation, 0.0, 1.0), occupied_hours))
    lows, highs = np.stack(ends, axis=1)
    return np.percentile(lows, 2.5, axis=0), np.percentile(highs, 97.5, axis=0)


def year_errors(shape: tuple[int, ...], rng: Generator) -> Floats:
    """Return random errors of one drawn year, [n hours, d directions], each of variance 1.

    shape: (n, d). Errors are normal with mean 0. The share `COMMON_ERROR` (half) of the variance is
    one error of a direction in all hours; the rest is one error of an hour in all directions.
    """
    common = rng.standard_normal((1, shape[1])) * np.sqrt(COMMON_ERROR)
    return common + rng.standard_normal((shape[0], 1)) * np.sqrt(1.0 - COMMON_ERROR)
