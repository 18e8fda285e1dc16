"""How large a model may be: the smallest within one standard error of the best on held-out data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

LEAVE_ONE_OUT = 24  # up to so many groups each is held out by itself


@dataclass(frozen=True, slots=True)
class Candidate:
    """errors [n]: squared held-out errors of the same n data for every candidate; size: free
    figures.
    """

    name: str
    size: int
    errors: NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class OrderSelection:
    index: int
    line: str  # what was tried, and why this one


def choose(
    what: str,
    candidates: Sequence[Candidate],
    unit: str = "%",
    scale: float = 100.0,
    negligible: float = 0.0,
) -> OrderSelection:
    """The smallest candidate whose mean held-out error is within one standard error of the best
    one's.

    The standard error is that of the difference to the best, datum by datum: they share their
    noise. negligible: an rms that much larger is no worse.
    """
    means = np.array([candidate.errors.mean() for candidate in candidates])
    best = int(np.argmin(means))
    allowed = []
    for i, candidate in enumerate(candidates):
        difference = candidate.errors - candidates[best].errors
        error = difference.std(ddof=1) / np.sqrt(len(difference)) if len(difference) > 1 else 0.0
        small = np.sqrt(means[i]) - np.sqrt(means[best]) <= negligible
        if difference.mean() <= error or small or i == best:
            allowed.append(i)
    chosen = min(allowed, key=lambda i: (candidates[i].size, means[i]))
    tried = ", ".join(
        f"{c.name} {scale * np.sqrt(m):.3g} {unit}" for c, m in zip(candidates, means, strict=True)
    )
    why = (
        "the best"
        if chosen == best
        else f"smaller than the best, {candidates[best].name}, and no worse that matters"
    )
    return OrderSelection(
        chosen, f"{what}: {candidates[chosen].name} ({why}); held-out rms: {tried}"
    )


def folds(groups: NDArray[np.integer], count: int = 8) -> Iterator[NDArray[np.bool_]]:
    """Masks of held-out data: group by group when they are few, else `count` interleaved sets of
    groups.
    """
    names = np.unique(groups)
    parts = len(names) if len(names) <= LEAVE_ONE_OUT else count
    for part in range(parts):
        yield np.isin(groups, names[part::parts])
