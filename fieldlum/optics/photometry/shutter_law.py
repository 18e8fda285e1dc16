"""Determine the law of a camera's shutter times, from the labels and the frames of a bracket.

A mechanical shutter runs in thirds or halves of a stop, and its labels are rounded: 1/60 is 1/64 s.
An electronic shutter exposes for its labelled time: 1/60 is 0.016667 s (measured on a phone's
bracket, MercuryYen/HDR-Imaging data/101; Ricoh states the same for the Theta). The two differ by up
to 6.7 %.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats, Mask
from fieldlum.optics.photometry.exposure import snap_shutter_s

THIRD_STOPS, HALF_STOPS, EXACT, AUTO = "third-stops", "half-stops", "exact", "auto"
LAWS = (THIRD_STOPS, HALF_STOPS, EXACT)
_STEPS_A_STOP = {THIRD_STOPS: 3, HALF_STOPS: 2}
# A time further from the grid than this share is used unchanged. Labels are rounded by up to 6.3 %
# (13 s) in thirds of a stop, and by 11.6 % (1/20 s is 2^-4.5 s) in halves. Chosen just above.
_OFF_GRID = {THIRD_STOPS: 0.07, HALF_STOPS: 0.12}
# Minimum difference of the expected ln ratio between two laws, for a pair to decide between them.
# Chosen above the uncertainty of a pair; not measured.
_TELLS_APART = 0.02
# A law is chosen if the measured ratios are nearer to its expectation than to that of the other
# law.
_NEAR = 0.5


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
class ShutterLaw:
    """The law of a bracket's shutter times.

    law : "third-stops", "half-stops" or "exact"; decided_by : "profile", "labels" or "frames"
    ("": not stated); misfit_percent : for each law, the rms difference of the measured exposure
    ratios from it, in %; empty without measured ratios.
    """

    law: str
    decided_by: str = ""
    misfit_percent: dict[str, float] = field(default_factory=dict)


def times_under(law: str, nominal_s: ArrayLike) -> Floats:
    """Return the true times [n] in s of nominal times [n] in s.

    law : "exact" changes nothing; "third-stops" and "half-stops" round to powers of 2^(1/3) and
    2^(1/2) s, but a time over 7 % or 12 % away from them is returned unchanged.
    """
    nominal = np.asarray(nominal_s, np.float64)
    if law == EXACT:
        return nominal.copy()
    steps = _STEPS_A_STOP[law]
    on_grid = 2.0 ** (np.round(np.log2(nominal) * steps) / steps)
    return np.where(np.abs(on_grid / nominal - 1.0) <= _OFF_GRID[law], on_grid, nominal)


def time_under(law: str, nominal_s: float) -> float:
    """Return the true time [s] of a nominal time [s].

    law : "exact", "third-stops" or "half-stops" as in `times_under`; "auto" rounds to the nearer of
    the third and half stops, unless that is over 7 % away.
    """
    return snap_shutter_s(nominal_s) if law == AUTO else float(times_under(law, nominal_s))


def law_of_labels(nominal_s: ArrayLike, model: str = "") -> ShutterLaw:
    """Return the law, half or third stops, that fits a bracket's nominal times [n] in s best.

    If both fit equally, it is third stops. model : name of the camera; if it contains "theta" the
    law is "exact" (theta-web-api-v2.1, shutterSpeed).
    """
    if "theta" in model.casefold():
        return ShutterLaw(EXACT, "labels")
    stops = np.log2(np.asarray(nominal_s, np.float64))
    off = {
        law: float(np.sum((np.round(stops * steps) / steps - stops) ** 2))
        for law, steps in _STEPS_A_STOP.items()
    }
    law = HALF_STOPS if off[HALF_STOPS] < 0.999 * off[THIRD_STOPS] else THIRD_STOPS
    return ShutterLaw(law, "labels")


def law_of_frames(
    times_s: Mapping[str, Floats], of_labels: ShutterLaw, pairs: Sequence[PairRatio]
) -> ShutterLaw:
    """Return the law that measured ratios support; the law of `of_labels` if they cannot decide.

    times_s : for each law, the times [frames] in s; pairs : ratios measured relative to the times
    under the law of `of_labels`; without pairs `of_labels` is returned. Only under the correct law
    do equal nominal steps change codes equally. A wrong response, or changing light, stretches all
    steps by one factor; that factor is estimated from pairs for which the laws agree.
    """
    if not pairs:
        return of_labels
    assumed = np.log(times_s[of_labels.law])
    expected = {law: _differences(np.log(times_s[law]) - assumed, pairs) for law in LAWS}
    measured = np.array([pair.log_ratio for pair in pairs])
    clear = np.maximum(_TELLS_APART, 3.0 * np.array([pair.u_log for pair in pairs]))
    step = _differences(assumed, pairs)
    best, decided = of_labels.law, False
    for law in LAWS:
        apart = expected[law] - expected[best]
        tells = np.abs(apart) > clear
        if not tells.any():
            continue
        residual = measured - expected[best] - step * _stretch(measured, step, tells)
        if (~tells).sum() > 1 and np.std(residual[~tells]) > _NEAR * np.abs(apart[tells]).mean():
            continue  # pairs for which the laws agree scatter as much, so the response is wrong
        decided = True
        if abs(float(np.median(residual[tells] / apart[tells])) - 1.0) < _NEAR:
            best = law
    misfit = {
        law: round(100.0 * float(np.sqrt(np.mean((measured - values) ** 2))), 2)
        for law, values in expected.items()
    }
    return ShutterLaw(best, "frames" if decided else of_labels.decided_by, misfit)


def _differences(values: Floats, pairs: Sequence[PairRatio]) -> Floats:
    """Return the value of each pair's short frame minus that of its long one, [pairs]."""
    return np.array([values[pair.short] - values[pair.long] for pair in pairs], np.float64)


def _stretch(measured: Floats, step: Floats, tells: Mask) -> float:
    """Return the factor by which ln ratios are stretched, from pairs with equal laws."""
    others = ~tells & (np.abs(step) > 0.1)
    return 0.0 if not others.any() else float(np.median(measured[others] / step[others]))
