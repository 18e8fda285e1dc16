"""Warn about captures that the fitted model cannot explain."""

from __future__ import annotations

import numpy as np

from fieldlum.learn.models import POOR_WORDS, TRUSTED_FACTOR, TRUSTED_MSE, Fitted
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.held_out_choice import trimmed_mean
from fieldlum.learn.models.hour_weights import choice_weights

# log10 MSE, an error factor of 1.4, which a steady room with correct irradiance does not reach;
# chosen
POOR_MSE = 0.02
ODD_TIMES = 4.0  # a day this many times worse than the median day is reported; not measured


# share of the captures; clean sets have under 2 %, with a lamp or a moved camera 20 to 60 %; chosen
# between the two
HARD_SHARE = 0.1


def hard_captures(fitted: Fitted, data: Dataset) -> list[str]:
    """Return a list with one warning if other days predict over 10 % of the captures wrongly.

    Otherwise, and for a model without held-out errors, the list is empty. Wrongly means by more
    than the factor up to which hours are trusted (`TRUSTED_FACTOR`).
    """
    if fitted.held_out_mse is None or len(fitted.held_out_mse) != len(data):
        return []
    wrong = np.nan_to_num(fitted.held_out_mse, nan=np.inf) > TRUSTED_MSE
    share = float(np.average(wrong, weights=choice_weights(data)))
    if share <= HARD_SHARE:
        return []
    return [
        f"WARNING: for {share:.0%} of the captures, a prediction from the other days is wrong by a "
        f"factor of over {TRUSTED_FACTOR:g}: the room, the camera or the light changed in a way "
        f"that the model does not know; hours with similar light are not trusted"
    ]


def doubts(fitted: Fitted, data: Dataset) -> list[str]:
    """Return warnings about large errors of the model on captures with their day held out.

    One warning names days that are much worse than the median day; one is about large errors on
    all days. The list is empty if there are none, and for a model without held-out errors.
    """
    if fitted.held_out_mse is None or len(fitted.held_out_mse) != len(data):
        return []
    weight = choice_weights(data)
    errors = np.nan_to_num(fitted.held_out_mse, nan=np.inf)[weight > 0.0]
    weight, day = weight[weight > 0.0], data.days[weight > 0.0]
    days = np.unique(day)
    means = np.array([trimmed_mean(errors[day == d], weight[day == d]) for d in days])
    mean = trimmed_mean(errors, weight)
    texts = []
    odd = days[(means > POOR_MSE) & (means > ODD_TIMES * np.median(means))]
    if len(odd):
        shown = ", ".join(str(day) for day in odd[:5]) + (" ..." if len(odd) > 5 else "")
        texts.append(
            f"WARNING: the held-out error of {shown} is over {ODD_TIMES:g} times that of the "
            "median day: a blind was probably moved, a lamp was on, or the irradiance is wrong; "
            "these captures are used in the training: mark what was different (fieldlum status "
            "SESSION --mark SLOT blind=half), or set ok = 0 in pairs.csv, and train again"
        )
    if np.median(errors) > POOR_MSE / 4 or mean > POOR_MSE:
        factor = 10.0 ** np.sqrt(mean)
        texts.append(
            f"WARNING: predictions of held-out days are wrong by a factor of {factor:.2f} (rms); "
            "likely causes are "
            f"broken cloud, wrong irradiance, or a room that changed (a wrong north or clock has "
            f"its own warning); {POOR_WORDS}"
        )
    return texts
