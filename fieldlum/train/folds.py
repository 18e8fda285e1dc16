"""Held-out days: how training data are parted so that a score says something about hours never
seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.models.data import Dataset

MOST_FOLDS = 5


@dataclass(frozen=True, slots=True)
class Fold:
    """Row numbers; no day (no hour, where there is one day only) is on both sides."""

    teach: NDArray[np.int64]
    check: NDArray[np.int64]


def day_folds(data: Dataset, count: int = MOST_FOLDS) -> tuple[Fold, ...]:
    """Whole days dealt out in turn, so that each fold has some of every season; hours when there is
    one day only.

    Neighbouring days of one season fall into different folds: a fold asks about a day between
    captured ones, and says nothing about seasons that nobody captured.
    """
    unique, which = np.unique(data.days, return_inverse=True)
    groups, members = (which, len(unique)) if len(unique) > 1 else (np.arange(len(data)), len(data))
    count = min(count, members)
    if count < 2:
        return ()
    rows = np.arange(len(data))
    return tuple(Fold(rows[groups % count != k], rows[groups % count == k]) for k in range(count))


def one_day_only(data: Dataset) -> bool:
    return len(np.unique(data.days)) == 1
