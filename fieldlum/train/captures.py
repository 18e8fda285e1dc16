"""How many captures would have been enough, and which added nothing."""

from __future__ import annotations

from typing import Any

import numpy as np

from fieldlum.light import Kernel, facades_of, greedy_hours, light_features
from fieldlum.models import Patch
from fieldlum.models.data import Dataset
from fieldlum.models.scores import by_day, standard_error
from fieldlum.records import Progress, quiet
from fieldlum.train.folds import day_folds
from fieldlum.train.trials import evaluate_folds

SHARES = (0.125, 0.25, 0.5, 0.75, 1.0)
FOLDS = 3
FEWEST = 12  # captures; under it there is no curve to draw
THIN_HEIGHT = (
    20  # the curve is drawn on every few pixels: errors are the same on average, fits take a moment
)


def order_of_use(data: Dataset) -> np.ndarray:
    """Row numbers, the most telling capture first: each next one lowers the variance over all of
    them the most.
    """
    kernel = Kernel(facades_of(data.setup.room))
    known = light_features(data.light)
    return greedy_hours(kernel, known, known, len(data)).index


def how_many(
    data: Dataset,
    patch: Patch,
    *,
    seed: int = 0,
    model: str = "transport",
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Error on held-out days against the number of captures, taken in the order of use.

    Returns curve (captures, error, standard error over days), enough (the fewest within one
    standard error of all of them) and added_nothing (slots that the order of use puts behind
    those); empty for too few captures.
    """
    if len(data) < FEWEST or len(np.unique(data.days)) < 3:
        return {}
    small = data.thin(THIN_HEIGHT)
    folds = day_folds(small, FOLDS)
    curve = []
    for k, share in enumerate(SHARES):
        progress(k, len(SHARES), "learning curve")
        some = [type(fold)(_first(small, fold.teach, share), fold.check) for fold in folds]
        trial = evaluate_folds(model, small, some, patch=patch, seed=seed, glare=False)
        days = np.concatenate([small.days[fold.check] for fold in folds])
        daily = by_day(trial.scores.mse_weighted, days)[1]
        curve.append(
            {
                "captures": round(share * len(data)),
                "mse": float(daily.mean()),
                "se": standard_error(daily),
            }
        )
    best = min(curve, key=lambda point: point["mse"])
    enough = next(
        p["captures"] for p in curve if p["mse"] <= best["mse"] + np.nan_to_num(best["se"])
    )
    behind = sorted(order_of_use(data)[enough:])
    return {"curve": curve, "enough": enough, "added_nothing": [data.slots[i] for i in behind]}


def _first(data: Dataset, teach: np.ndarray, share: float) -> np.ndarray:
    """The most telling part of the teaching rows."""
    count = max(4, round(share * len(teach)))
    return np.sort(teach[order_of_use(data.take(teach))[:count]])
