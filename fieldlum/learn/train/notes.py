"""Write notes and warnings for the reader of a training's scores."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fieldlum.core.records import counted
from fieldlum.learn.model_registry import MODELS
from fieldlum.learn.models import POOR_WORDS, TRUSTED_FACTOR, TRUSTED_MSE, Fitted, Patch
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.held_out_choice import trimmed_mean
from fieldlum.learn.models.hour_weights import LOW_SUN_DEG, beam_is_doubted, choice_weights
from fieldlum.learn.train.trials import Trial, is_clearly_worse, one_day_only
from fieldlum.learn.transport.model import Transport

# log10 MSE, an error factor of 1.4, which a steady room with correct irradiance does not reach;
# chosen
POOR_MSE = 0.02
EXCEPTION_TIMES = 4.0  # a day this many times worse than the median day is reported; not measured


# share of the captures; clean sets have under 2 %, with a lamp or a moved camera 20 to 60 %; chosen
# between the two
HARD_SHARE = 0.1


def seen_skies(fitted: Fitted) -> list[str]:
    """Return one note if the model learnt each capture under the sky in its windows."""
    field = fitted.sky_field if isinstance(fitted, Transport) else None
    if field is None:
        return []
    return [
        f"the skies in the windows differ from the Perez model for the measured irradiance by "
        f"{math.expm1(field.sd):.0%} (one standard deviation). The cause is clouds, or an "
        "instrument that sees other light than the room. Each capture was learnt under its own "
        "sky. Predicted hours use the Perez model, and their uncertainty includes the difference"
    ]


def notes_of(data: Dataset, patch: Patch, model: str, trials: Sequence[Trial]) -> tuple[str, ...]:
    """Return the notes of `data`, then notes that a reader of the scores needs.

    They are about captures of one day only, missing sun patches, hours of doubtful direct light,
    and a model that is worse than a baseline. model: name of the requested model ("auto" gives no
    note about the baselines).
    """
    notes = list(data.notes)
    if one_day_only(data):
        notes.append(
            "all hours are from one day, so held-out hours are close to training hours and "
            "the scores are too good: capture more days"
        )
    # a scene without patches was chosen on purpose and has its own note
    if patch == "none" and data.patch_cdm2 is None and data.scene is None:
        notes.append(
            "no sun patches in the data: add a [room] to SITE.toml, if it has none, and run "
            "fieldlum pair for a better model"
        )
    notes += doubted_hours(data)
    own = next((trial for trial in trials if trial.name == model), None)
    if own is None or MODELS[model].baseline:
        return tuple(notes)
    better = [t.name for t in trials if MODELS[t.name].baseline and is_clearly_worse(own, t)]
    if better:
        notes.append(
            f"WARNING: {model} is worse than {' and '.join(better)} on held-out days by more than "
            "a standard error: do not use it before the cause is found"
        )
    return tuple(notes)


def doubted_hours(data: Dataset) -> list[str]:
    """Return a note on the hours whose direct light was not measured well, if there are any."""
    doubted = int(beam_is_doubted(data).sum())
    if not doubted:
        return []
    part = f"{doubted} of {counted(len(data), 'hour')}"
    weight = choice_weights(data)[beam_is_doubted(data)].max()
    role = (
        f"count {weight:g} in the choice of a model and in warnings, because too few others remain"
        if weight > 0.0
        else "do not count in the choice of a model or in warnings"
    )
    return [
        f"{part} {role}: their direct light was not measured well (sun under {LOW_SUN_DEG:g} "
        "degrees with a beam, or a mark of fieldlum pair)"
    ]


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
    exceptions = days[(means > POOR_MSE) & (means > EXCEPTION_TIMES * np.median(means))]
    if len(exceptions):
        shown = ", ".join(str(day) for day in exceptions[:5]) + (
            " ..." if len(exceptions) > 5 else ""
        )
        texts.append(
            f"WARNING: the held-out error of {shown} is over {EXCEPTION_TIMES:g} times that of the "
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
