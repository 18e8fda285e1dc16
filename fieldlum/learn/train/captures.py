"""Estimate how many captures would have been enough, and which added nothing."""

from __future__ import annotations

import numpy as np

from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models import Patch
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.held_out_choice import HeldOutErrors, difference
from fieldlum.learn.train.trials import TimeBudget, day_folds, evaluate_folds
from fieldlum.session.files.scores_json import CaptureCurve, CurvePoint
from fieldlum.sky.light import Kernel, facades_of, greedy_hours, light_features

SHARES = (0.125, 0.25, 0.5, 0.75, 1.0)  # points of the learning curve; chosen
FOLDS = 3  # enough for a curve, and faster than `folds.MAX_FOLDS`; chosen
MIN_CAPTURES = 12  # least number of captures; fewer give too few points for a curve; chosen
THIN_HEIGHT = 20  # number of rows; the mean errors are the same, and fits take seconds; chosen
# largest time of the next point over that of the last one, as captures at most double; chosen
_NEXT_POINT = 2.0


def order_of_use(data: Dataset) -> np.ndarray:
    """Return the row indices of all captures [n], the most informative capture first.

    Each next capture is the one that, with those before it, most lowers the predictive variance of
    all captures. Only their light is compared, not the pictures.
    """
    kernel = Kernel(facades_of(data.setup.room))
    features = light_features(data.light)
    return greedy_hours(kernel, features, features, len(data)).index


def how_many(
    data: Dataset,
    patch: Patch,
    *,
    seed: int = 0,
    budget: TimeBudget | None = None,
    fit_s: float = 0.0,
    progress: Progress = quiet,
) -> CaptureCurve | None:
    """Return the transport model's error on held-out days by the number of captures.

    Captures are added in the order of `order_of_use`. Keys of the result: curve: number of
    captures, log10 MSE, standard error over days; enough: the fewest captures whose error is within
    one standard error of the smallest; added_nothing: slots of the captures that come later in the
    order of use. fit_s: time of one fit [s], to decide whether the first point fits into the
    budget. Return an empty dict for under 12 captures or three days, None if the budget ends before
    the last point.
    """
    if len(data) < MIN_CAPTURES or len(np.unique(data.days)) < 3:
        return {}
    small = data.thin(THIN_HEIGHT)
    folds = day_folds(small, FOLDS)
    next_s = FOLDS * fit_s
    curve: list[CurvePoint] = []
    tested: list[HeldOutErrors] = []
    for k, share in enumerate(SHARES):
        left_s = np.inf if budget is None else budget.left_s
        if left_s <= next_s:
            return None
        progress(k, len(SHARES), "learning curve")
        some = [
            type(fold)(_most_informative(small, fold.teach, share), fold.check) for fold in folds
        ]
        trial = evaluate_folds("transport", small, some, patch=patch, seed=seed, glare=False)
        errors = trial.scores.errors
        tested.append(errors)
        mse = errors.figure("log10")
        curve.append({"captures": trial.n_train, "mse": mse, "se": errors.standard_error("log10")})
        if budget is not None:
            next_s = _NEXT_POINT * (left_s - budget.left_s)
    best = tested[int(np.argmin([point["mse"] for point in curve]))]
    gaps = [difference(errors, best, "log10") for errors in tested]
    enough = next(p["captures"] for p, (gap, se) in zip(curve, gaps, strict=True) if gap <= se)
    behind = sorted(order_of_use(data)[enough:])
    return {"curve": curve, "enough": enough, "added_nothing": [data.slots[i] for i in behind]}


def _most_informative(data: Dataset, training: np.ndarray, share: float) -> np.ndarray:
    """Return the most informative part of the training rows."""
    count = max(4, round(share * len(training)))
    return np.sort(training[order_of_use(data.take(training))[:count]])
