"""Choose among candidates by what users decide: the error of DGP in held-out hours.

Within its standard error the error of vertical illuminance decides, then that of log10 luminance.
`train` chooses its models with it, and light transport its recipes, by log10 luminance alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Indices
from fieldlum.core.statistics import standard_error

# Share of the weight of the hours with the largest errors that does not count: 1 hour of a day's
# 10 may have an irradiance that its picture contradicts. Chosen.
TRIM = 0.05
CRITERIA = {"dgp": "DGP", "ev": "Ev", "log10": "log10 luminance"}


@dataclass(frozen=True, slots=True)
class HeldOutErrors:
    """Errors of one candidate in n held-out hours, [n] each, NaN where not computed.

    dgp: mean absolute error of DGP over fully seen view directions, with the true disc; ev: mean
    absolute error of ln Ev over the same directions; log10: mean squared error of log10 luminance;
    day: date; weight: 0 to 1, by `hour_weights`; trim: share of the weight of the hours with the
    largest errors, which does not count.
    """

    dgp: Floats
    ev: Floats
    log10: Floats
    day: NDArray
    weight: Floats
    trim: float = TRIM

    def take(self, rows: Indices) -> HeldOutErrors:
        """Return the errors of some hours, by their indices."""
        arrays = {name: getattr(self, name)[rows] for name in (*CRITERIA, "day", "weight")}
        return replace(self, **arrays)

    def figure(self, name: str) -> float:
        """Return the trimmed weighted mean of one of `CRITERIA`; NaN if no hour has it."""
        values = getattr(self, name)
        rows = np.isfinite(values) & (self.weight > 0.0)
        return trimmed_mean(values[rows], self.weight[rows], self.trim)

    @property
    def judged(self) -> int:
        """Number of hours with weight."""
        return int((self.weight > 0.0).sum())

    def standard_error(self, name: str) -> float:
        """Return the standard error of `figure` over days; 0 with one day."""
        return difference(self, replace(self, **{name: np.zeros(len(self.day))}), name)[1]


def limit_of(values: Floats, weight: Floats, trim: float) -> float:
    """Return the value that at most a share `trim` of the weight exceeds."""
    order = np.argsort(values)
    above = 1.0 - np.cumsum(weight[order]) / weight.sum()
    return float(values[order][np.argmax(above <= trim + 1e-9)])


def trimmed_mean(values: Floats, weight: Floats, trim: float = TRIM) -> float:
    """Return the weighted mean of the values [n] without the largest, `trim` of the weight at most.

    NaN without values.
    """
    if not len(values):
        return float("nan")
    used = values <= limit_of(values, weight, trim)
    return float(np.average(values[used], weights=weight[used]))


def difference(one: HeldOutErrors, other: HeldOutErrors, name: str) -> tuple[float, float]:
    """Return how much larger an error is than that of another candidate, and its standard error.

    Both candidates have the same hours. The standard error is that of the trimmed mean, by
    winsorised differences (Tukey and McLaughlin 1963), where only days are independent; it is 0
    with one day. Both are NaN if no hour has the errors of both.
    """
    a, b = getattr(one, name), getattr(other, name)
    rows = np.isfinite(a) & np.isfinite(b) & (one.weight > 0.0)
    if not rows.any():
        return float("nan"), float("nan")
    a, b, weight, day = a[rows], b[rows], one.weight[rows], one.day[rows]
    trim = one.trim
    mean = trimmed_mean(a, weight, trim) - trimmed_mean(b, weight, trim)
    near = np.minimum(a, limit_of(a, weight, trim)) - np.minimum(b, limit_of(b, weight, trim))
    error = standard_error(near * weight / weight.mean(), day)
    return mean, float(np.nan_to_num(error)) / (1.0 - trim)


@dataclass(frozen=True, slots=True)
class HeldOutChoice:
    """The index of the best candidate, and the criterion that decided.

    by: one of `CRITERIA`, in which all others are worse by over a standard error; None if no
    criterion separates them, so that the smallest error of DGP decided.
    """

    best: int
    by: str | None


def choose(candidates: Sequence[HeldOutErrors]) -> HeldOutChoice:
    """Choose the candidate with the smallest error; all candidates have the same hours.

    Candidates whose error of DGP is within one standard error of the smallest are compared by Ev,
    those within a standard error there by log10 luminance. If several remain, the one with the
    smallest error of DGP is chosen, or of log10 luminance where DGP was not computed.
    """
    left = list(range(len(candidates)))
    order: list[float] = []
    for by in CRITERIA:
        means = [candidate.figure(by) for candidate in candidates]
        if not np.isfinite(means).all():
            continue
        order = order or means
        best = min(left, key=means.__getitem__)
        gaps = {i: difference(candidates[i], candidates[best], by) for i in left}
        left = [i for i, (gap, error) in gaps.items() if gap <= error]
        if len(left) == 1:
            return HeldOutChoice(best, by if len(gaps) > 1 else None)
    return HeldOutChoice(min(left, key=order.__getitem__), None)
