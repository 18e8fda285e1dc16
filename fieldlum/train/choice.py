"""Which model, by held-out days: the smallest one that is within one standard error of the best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldlum.models import MODELS
from fieldlum.models.data import Dataset
from fieldlum.models.scores import Scores, by_day, standard_error


@dataclass(frozen=True, slots=True)
class Trial:
    """What a candidate did on held-out days."""

    name: str
    scores: Scores
    fit_s: float  # mean of its folds, by the clock
    fit_cpu_s: float
    n_train: int  # mean of its folds
    folds: int


@dataclass(frozen=True, slots=True)
class Choice:
    name: str
    reason: str


def _size(label: str) -> int:
    """Of ``NAME``, ``NAME:PATCH`` or ``NAME (folder)``."""
    return MODELS[label.replace(":", " ").split()[0]].size


def choose(trials: list[Trial], data: Dataset) -> Choice:
    """One-standard-error rule, smallest first, over the days that all candidates were asked about.

    The standard error is that of the best candidate's mean over days; with a single common day it counts as nothing.
    """
    common = set.intersection(*(set(trial.scores.slots) for trial in trials))
    day_of = dict(zip(data.slots, data.days, strict=True))
    means: dict[str, float] = {}
    errors: dict[str, float] = {}
    days = 0
    for trial in trials:
        rows = [k for k, slot in enumerate(trial.scores.slots) if slot in common]
        slots = [trial.scores.slots[k] for k in rows]
        unique, daily = by_day(trial.scores.mse_weighted[rows], np.array([day_of[slot] for slot in slots]))
        means[trial.name], errors[trial.name], days = float(daily.mean()), standard_error(daily), len(unique)
    best = min(means, key=lambda name: means[name])
    allowed = means[best] + float(np.nan_to_num(errors[best]))
    chosen = next(name for name in sorted(means, key=_size) if means[name] <= allowed)
    spread = f"{means[best]:.2e} +- {np.nan_to_num(errors[best]):.1e} over {days} held-out days"
    if chosen == best:
        return Choice(chosen, f"{best} is best ({spread}) and nothing smaller is within one standard error")
    return Choice(
        chosen, f"{chosen} ({means[chosen]:.2e}) is the smallest within one standard error of {best} ({spread})"
    )
