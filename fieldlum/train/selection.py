"""Choose a model by held-out days: the smallest within one standard error of the best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldlum.arrays import Floats
from fieldlum.model_registry import MODELS
from fieldlum.models.data import Dataset
from fieldlum.models.scores import Scores, by_day
from fieldlum.records import counted
from fieldlum.statistics import is_no_worse, standard_error


@dataclass(frozen=True, slots=True)
class Trial:
    """The test of one model on held-out days.

    name: of the model; scores: of the held-out captures of all folds; fit_s, fit_cpu_s: mean time
    of a fold's fit, by the wall clock and of computing [s]; n_train: mean number of training
    captures of a fold; folds: number of folds, 0 if tested on separate hours; passes: how often
    training saw each pixel, least of the folds, None for a model in closed form.
    """

    name: str
    scores: Scores
    fit_s: float
    fit_cpu_s: float
    n_train: int
    folds: int
    passes: float | None = None


@dataclass(frozen=True, slots=True)
class ModelSelection:
    """The name of the chosen model, and the reason for it."""

    name: str
    reason: str


def _size(label: str) -> int:
    """Return the rank by size of ``NAME``, ``NAME:PATCH`` or ``NAME (folder)``."""
    return MODELS[label.replace(":", " ").split()[0]].size


def _daily(trial: Trial, data: Dataset, slots: set[str]) -> Floats:
    """Return the mean error of each held-out day, over the hours in `slots`."""
    day_of = dict(zip(data.slots, data.days, strict=True))
    rows = [k for k, slot in enumerate(trial.scores.slots) if slot in slots]
    days = np.array([day_of[trial.scores.slots[k]] for k in rows])
    return by_day(trial.scores.mse_weighted[rows], days)[1]


def choose(trials: list[Trial], data: Dataset) -> ModelSelection:
    """Choose the smallest model whose held-out error is within one standard error of the best.

    Only models that were tested on the most hours take part. A model tested on fewer hours (the
    dense network) replaces the winner only if, on the days that both were tested on (at least two),
    its error is lower by more than the standard error of the paired differences. A few days of a
    slow model must not outweigh quick models that were tested on all days.
    """
    widest = max(len(trial.scores.slots) for trial in trials)
    thorough = [trial for trial in trials if len(trial.scores.slots) == widest]
    winner, choice = _smallest_good(thorough, data)
    for trial in sorted(
        (t for t in trials if len(t.scores.slots) < widest), key=lambda t: _size(t.name)
    ):
        shared = set(trial.scores.slots) & set(winner.scores.slots)
        if not shared:
            continue
        gain = _daily(winner, data, shared) - _daily(trial, data, shared)
        if len(gain) > 1 and gain.mean() > standard_error(gain):
            reason = (
                f"on the {len(gain)} held-out days of both models, the log10 MSE of {trial.name} "
                "is lower "
                f"than that of {winner.name} by {gain.mean():.2e}"
            )
            winner, choice = trial, ModelSelection(trial.name, reason)
    return choice


def _smallest_good(trials: list[Trial], data: Dataset) -> tuple[Trial, ModelSelection]:
    """Return the smallest trial within one standard error of the best, by paired held-out days."""
    shared = set.intersection(*(set(trial.scores.slots) for trial in trials))
    daily = {trial.name: _daily(trial, data, shared) for trial in trials}
    means = {name: float(values.mean()) for name, values in daily.items()}
    best = min(means, key=lambda name: means[name])
    chosen = next(
        trial
        for trial in sorted(trials, key=lambda t: _size(t.name))
        if is_no_worse(daily[trial.name], daily[best])
    )
    spread = f"{means[best]:.2e} over {counted(len(daily[best]), 'held-out day')}"
    if chosen.name == best:
        return chosen, ModelSelection(
            best,
            f"{best} has the lowest log10 MSE ({spread}), and no smaller model is within one "
            f"standard error of it",
        )
    reason = (
        f"{chosen.name} (log10 MSE {means[chosen.name]:.2e}) is the smallest model within one "
        f"standard error of {best} ({spread})"
    )
    return chosen, ModelSelection(chosen.name, reason)
