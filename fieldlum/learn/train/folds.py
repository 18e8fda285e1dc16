"""Split training data into held-out days, so that a score describes hours outside the fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.learn.models.data import Dataset

MOST_FOLDS = 5  # Hastie et al., The Elements of Statistical Learning, 7.10: 5 or 10


@dataclass(frozen=True, slots=True)
class Fold:
    """Row indices of the captures with which one fold trains and tests.

    teach: to train [k]; check: to test [n - k]. No day is in both (with one day only: no hour).
    """

    teach: NDArray[np.int64]
    check: NDArray[np.int64]


def day_folds(data: Dataset, count: int = MOST_FOLDS) -> tuple[Fold, ...]:
    """Distribute the days of the captures over at most `count` folds in turn.

    Each fold tests its days and trains with all others. If there is only one day, its hours are
    distributed instead; a single hour gives no fold (an empty tuple). Neighbouring days are tested
    in different folds, so a fold tests days between captured ones, not seasons without captures.
    """
    unique, which = np.unique(data.days, return_inverse=True)
    groups, members = (which, len(unique)) if len(unique) > 1 else (np.arange(len(data)), len(data))
    count = min(count, members)
    if count < 2:
        return ()
    rows = np.arange(len(data))
    return tuple(Fold(rows[groups % count != k], rows[groups % count == k]) for k in range(count))


def one_day_only(data: Dataset) -> bool:
    """Return whether all hours are of one day."""
    return len(np.unique(data.days)) == 1
