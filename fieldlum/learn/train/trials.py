"""Test models on held-out days, choose one by its glare."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Progress, counted, quiet
from fieldlum.learn import models
from fieldlum.learn.model_registry import MODELS
from fieldlum.learn.models import Fitted, Patch
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.held_out_choice import (
    CRITERIA,
    HeldOutChoice,
    HeldOutErrors,
    choose,
)
from fieldlum.learn.models.scores import Scores, evaluate, join, truth

MIN_FOLD_S = 120.0  # for a fold of the dense network: shorter ones are no measure of it
MAX_FOLDS = 5  # Hastie et al., The Elements of Statistical Learning, 7.10: 5 or 10
# Shares of the budget. The quick models' held-out days come first. A slow model (the dense network)
# gets half of the rest for its held-out days and half for the stored model. The reserve is for the
# scan of north and clock and for the learning curve: together about a fifth of the time of a
# training with the default budget (108 captures at 230 x 115).
QUICK_SHARE, KEPT_BACK_SHARE = 0.4, 0.2


class OutOfTime(Exception):
    """The budget was used up within a step, which therefore has no result."""


@dataclass(frozen=True, slots=True)
class TimeBudget:
    """The time that all parts of one training together may take.

    total_s: the complete budget; clock: function that returns seconds since any start, so that
    tests can simulate time; started_s: value of the clock when the budget began.
    """

    total_s: float
    clock: Callable[[], float]
    started_s: float

    @classmethod
    def starting(cls, total_s: float, clock: Callable[[], float] = time.monotonic) -> TimeBudget:
        """Return a budget of `total_s` seconds that starts now."""
        return cls(total_s, clock, clock())

    @property
    def left_s(self) -> float:
        """Seconds that remain; negative once the budget is used up."""
        return self.total_s - (self.clock() - self.started_s)

    @property
    def quick_s(self) -> float:
        """Seconds that remain for held-out days of quick models: at the start 40 % of the total.

        It is 0 once they are used.
        """
        return max(self.left_s - (1.0 - QUICK_SHARE) * self.total_s, 0.0)

    @property
    def slow_s(self) -> float:
        """Seconds that remain for a slow model: `left_s` less a reserve of 20 % of the total.

        It is never below 0.001 s: a slow model then takes one step, and is not judged.
        """
        return max(self.left_s - KEPT_BACK_SHARE * self.total_s, 1e-3)

    def watched(self, progress: Progress) -> Progress:
        """Return `progress` such that it raises OutOfTime once the budget is used up.

        Every long step reports its progress, so that it ends within a part of itself.
        """

        def report(finished: int, total: int, text: str) -> None:
            if self.left_s <= 0.0:
                raise OutOfTime
            progress(finished, total, text)

        return report

    def of_model(self, name: str, progress: Progress) -> Progress:
        """Return the progress of a model's fit, which ends with the budget.

        A baseline takes a second and is always fitted; a slow model divides its own time.
        """
        kind = MODELS[name]
        return progress if kind.slow or kind.baseline else self.watched(progress)


# ----------------------------------------------------------------------------------------------
# held-out days


@dataclass(frozen=True, slots=True)
class Fold:
    """Row indices of the captures with which one fold trains and tests.

    teach: to train [k]; check: to test [n - k]. No day is in both (with one day only: no hour).
    """

    teach: NDArray[np.int64]
    check: NDArray[np.int64]


def day_folds(data: Dataset, count: int = MAX_FOLDS) -> tuple[Fold, ...]:
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


@dataclass(frozen=True, slots=True)
class Trial:
    """The test of one model on held-out days.

    name: of the model; scores: of the held-out captures of all folds; fit_s, fit_cpu_s: mean time
    of a fold's fit, by the wall clock and of computing [s]; n_train: mean number of training
    captures of a fold; folds: number of folds, 0 if tested on separate hours.
    """

    name: str
    scores: Scores
    fit_s: float
    fit_cpu_s: float
    n_train: int
    folds: int


class Spent(NamedTuple):
    """The time a task took: by the wall clock, and processor time of all threads [s].

    On a busy computer only `cpu_s` is meaningful.
    """

    wall_s: float
    cpu_s: float


def fit_timed(
    name: str,
    data: Dataset,
    *,
    patch: Patch,
    seed: int,
    budget_s: float | None,
    clock: Callable[[], float] = time.monotonic,
    progress: Progress = quiet,
    **more: Any,
) -> tuple[Fitted, Spent]:
    """Fit the model `name` of `MODELS` to `data`; return the model and the time of the fit.

    budget_s: time limit of a slow model [s], ignored for others; more: options of its `fit`.
    """
    wall, cpu = clock(), time.process_time()
    limit = {"budget_s": budget_s} if MODELS[name].slow else {}
    fitted = models.fit(name, data, patch=patch, seed=seed, progress=progress, **limit, **more)
    return fitted, Spent(clock() - wall, time.process_time() - cpu)


def evaluate_folds(
    name: str,
    data: Dataset,
    folds: Sequence[Fold],
    *,
    budget_s: float | None = None,
    glare: bool = True,
    keep_maps: bool = False,
    progress: Progress = quiet,
    **how: Any,
) -> Trial:
    """Fit to each fold's training rows and compare with its held-out rows.

    The scores of all folds are joined. budget_s: for all folds together [s], None for no limit. A
    slow model divides it among the folds. A quick model runs two folds, and skips the others if the
    next one would exceed it. glare, keep_maps: as in `truth` and `evaluate`; how: patch, seed and
    further arguments of `fit_timed`.
    """
    parts: list[Scores] = []
    times: list[Spent] = []
    limit = math.inf if budget_s is None or MODELS[name].slow else budget_s
    share = None if budget_s is None else budget_s / len(folds)
    clock = how.get("clock", time.monotonic)
    started = clock()
    for fold in folds:
        # one fold has few days for a standard error
        if len(parts) >= 2 and (clock() - started) * (1 + 1 / len(parts)) > limit:
            break
        taught = data.take(fold.teach)
        fitted, spent = fit_timed(name, taught, budget_s=share, progress=progress, **how)
        test = truth(data.take(fold.check), glare=glare)
        scores = evaluate(fitted, test, keep_maps=keep_maps, progress=progress)
        if scores.maps is not None:
            scores.maps = replace(scores.maps, season_deg=_season_deg(scores, data, fold))
        parts.append(scores)
        times.append(spent)
    count = round(np.mean([len(fold.teach) for fold in folds[: len(parts)]]))
    wall_s, cpu_s = np.mean(times, axis=0).tolist()
    return Trial(name, join(parts), wall_s, cpu_s, count, len(parts))


def _season_deg(scores: Scores, data: Dataset, fold: Fold) -> Floats:
    """Return the angle between the sun of each stored map and the nearest training sun [n] deg."""
    assert scores.maps is not None
    row = {data.slots[k]: k for k in fold.check}
    suns = data.light.sun_direction
    cosine = suns[[row[slot] for slot in scores.maps.slots.tolist()]] @ suns[fold.teach].T
    return np.degrees(np.arccos(np.clip(cosine.max(axis=1), -1.0, 1.0)))


# ----------------------------------------------------------------------------------------------
# choice


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
        if len(np.unique(pair[0].day)) < 2:  # one day is no proof
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
