"""Test one model on held-out days: measure the time of a fit; fit and score it over folds."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Progress, quiet
from fieldlum.learn import models
from fieldlum.learn.model_registry import MODELS
from fieldlum.learn.models import Fitted, Patch
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.scores import Scores, evaluate, join, truth
from fieldlum.learn.train.folds import MOST_FOLDS, Fold
from fieldlum.learn.train.selection import Trial

LEAST_FOLDS = 2  # one fold has few days for a standard error; chosen
_STORED_FIT = 1.5  # time of the fit to all captures over that of a fold; chosen with a margin
LEAST_FOLD_S = 60.0  # a shorter training of a dense fold is no measure of the network; not measured


def passes_over_data(fitted: Fitted) -> float | None:
    """Return how often, on average, training saw each pixel; None for a model in closed form."""
    return getattr(fitted, "training", {}).get("pixels_seen_per_pixel")


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
    patch: Patch,
    seed: int,
    budget_s: float | None = None,
    glare: bool = True,
    keep_maps: bool = False,
    least_passes: float = 0.0,
    clock: Callable[[], float] = time.monotonic,
    left_s: Callable[[], float] | None = None,
    progress: Progress = quiet,
    **more: Any,
) -> Trial:
    """Fit to each fold's training rows and compare with its held-out rows.

    The scores of all folds are joined. budget_s: for all folds together [s], None for no limit. A
    slow model divides it among the folds. A quick model skips the remaining folds if the next one
    would exceed it, but runs two, or one if `left_s()` [s] is too short for another one and for the
    fit of the stored model. glare, keep_maps: as in `truth` and `evaluate`.
    least_passes: a network that saw each training pixel less often than this is compared with one
    hour of each fold only, because its scores will not count; a slow model gets it as an option, so
    that its training can end at once.
    """
    parts: list[Scores] = []
    passes: list[float] = []
    wall_s, cpu_s, taught = 0.0, 0.0, 0
    share = budget_s / len(folds) if budget_s else None
    if MODELS[name].slow:
        more["least_passes"] = least_passes
    started = clock()
    for fold in folds:
        if budget_s is not None and not MODELS[name].slow and parts:
            used = clock() - started
            each_s = used / len(parts)
            if len(parts) >= LEAST_FOLDS and used + each_s > budget_s:  # with the next fold
                break
            if left_s is not None and left_s() < (1.0 + _STORED_FIT) * each_s:
                break
        fitted, spent = fit_timed(
            name,
            data.take(fold.teach),
            patch=patch,
            seed=seed,
            budget_s=share,
            clock=clock,
            progress=progress,
            **more,
        )
        count = passes_over_data(fitted)
        judged = count is None or count >= least_passes
        test = truth(data.take(fold.check if judged else fold.check[:1]), glare=glare)
        scores = evaluate(fitted, test, keep_maps=keep_maps, progress=progress)
        if scores.maps is not None:
            scores.maps = replace(scores.maps, season_deg=_season_deg(scores, data, fold))
        parts.append(scores)
        if count is not None:
            passes.append(count)
        wall_s, cpu_s, taught = wall_s + spent.wall_s, cpu_s + spent.cpu_s, taught + len(fold.teach)
    n = len(parts)
    least = min(passes, default=None)
    return Trial(name, join(parts), wall_s / n, cpu_s / n, round(taught / n), n, least)


def _season_deg(scores: Scores, data: Dataset, fold: Fold) -> Floats:
    """Return the angle between the sun of each stored map and the nearest training sun [n] deg."""
    assert scores.maps is not None
    row = {data.slots[k]: k for k in fold.check}
    suns = data.light.sun_direction
    cosine = suns[[row[slot] for slot in scores.maps.slots.tolist()]] @ suns[fold.teach].T
    return np.degrees(np.arccos(np.clip(cosine.max(axis=1), -1.0, 1.0)))


def dense_folds(folds: Sequence[Fold], budget_s: float) -> tuple[Fold, ...]:
    """Return the first folds, as many as fit into `budget_s` at two minutes each: one to five."""
    return tuple(folds[: max(1, min(MOST_FOLDS, int(budget_s / LEAST_FOLD_S / 2)))])
