"""Choose a model by held-out days: the one whose glare is nearest to the measured glare."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldlum.core.records import counted
from fieldlum.learn.model_registry import MODELS
from fieldlum.learn.models.held_out_choice import CRITERIA, HeldOutChoice, HeldOutErrors, choose
from fieldlum.learn.models.scores import Scores

_FEWEST_DAYS = 2  # on which a model that was tested on fewer hours must be better; chosen


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


def choose_model(trials: list[Trial]) -> ModelSelection:
    """Choose the model with the smallest held-out error, as `held_out_choice.choose` compares it.

    A baseline repeats captured suns, and held-out days have nearly the same suns as the other days:
    it is chosen only if it is clearly better than the best other model.

    Only models that were tested on the most hours take part. A model tested on fewer hours (the
    dense network) replaces the winner only if it is clearly better on the hours of both, of two
    days at least: a few days of a slow model must not outweigh models that were tested on all days.
    """
    widest = max(len(trial.scores) for trial in trials)
    thorough = [trial for trial in trials if len(trial.scores) == widest]
    shared = set.intersection(*(set(trial.scores.slots) for trial in thorough))
    errors = [errors_of(trial, shared) for trial in thorough]
    choice = choose(errors)
    others = [k for k, trial in enumerate(thorough) if not _is_baseline(trial)]
    if _is_baseline(thorough[choice.best]) and others:
        other = others[choose([errors[k] for k in others]).best]
        if choose([errors[choice.best], errors[other]]).by is None:
            choice = HeldOutChoice(other, None)
    winner = thorough[choice.best]
    reason = _reason(thorough, errors, choice)
    for trial in (t for t in trials if len(t.scores) < widest):
        shared = set(trial.scores.slots) & set(winner.scores.slots)
        pair = [errors_of(t, shared) for t in (winner, trial)]
        if len(np.unique(pair[0].day)) < _FEWEST_DAYS:
            continue
        choice = choose(pair)
        if choice.best == 1 and choice.by:
            reason = _reason([winner, trial], pair, choice)
            winner = trial
    return ModelSelection(winner.name, reason)


def _is_baseline(trial: Trial) -> bool:
    """Return whether a trial, named NAME, NAME:PATCH or NAME (folder), is of a baseline."""
    return MODELS[trial.name.replace(":", " ").split()[0]].baseline


def is_clearly_worse(trial: Trial, other: Trial) -> bool:
    """Return whether a model is worse than another on the hours of both, by a standard error."""
    shared = set(trial.scores.slots) & set(other.scores.slots)
    choice = choose([errors_of(t, shared) for t in (trial, other)])
    return choice.best == 1 and choice.by is not None


def errors_of(trial: Trial, slots: set[str]) -> HeldOutErrors:
    """Return the errors of a trial in the hours `slots`, in the order of their names."""
    rows = [k for k, slot in enumerate(trial.scores.slots) if slot in slots]
    names = [trial.scores.slots[k] for k in rows]
    return trial.scores.errors.take(np.array(rows, np.intp)[np.argsort(names)])


def _reason(trials: list[Trial], errors: list[HeldOutErrors], choice: HeldOutChoice) -> str:
    """Return the chosen model's figures next to those of the others, and what decided."""
    own = errors[choice.best]
    hours = f"{counted(own.judged, 'held-out hour')} of {counted(len(np.unique(own.day)), 'day')}"
    if len(trials) == 1:
        return f"the only model that was tested ({hours})"
    known = [name for name in CRITERIA if np.isfinite(own.figure(name))]
    by = choice.by or known[0]
    others = ", ".join(
        f"{t.name} {e.figure(by):.2g}"
        for k, (t, e) in enumerate(zip(trials, errors, strict=True))
        if k != choice.best
    )
    text = f"error of {CRITERIA[by]} over {hours}: {own.figure(by):.2g} ({others})"
    alike = known if choice.by is None else known[: known.index(by)]
    names = ", ".join(CRITERIA[name] for name in alike)
    return f"{text}; no model is better by over a standard error: {names}" if alike else text
