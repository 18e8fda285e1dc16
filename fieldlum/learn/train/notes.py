"""Write notes for the reader of a training's scores."""

from __future__ import annotations

import math
from collections.abc import Sequence

from fieldlum.core.records import counted
from fieldlum.learn.model_registry import MODELS
from fieldlum.learn.models import Fitted, Patch
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.hour_weights import LOW_SUN_DEG, beam_is_doubted, choice_weights
from fieldlum.learn.train.folds import one_day_only
from fieldlum.learn.train.selection import Trial, is_clearly_worse
from fieldlum.learn.transport import Transport
from fieldlum.learn.transport.features import training_arrays_of
from fieldlum.learn.transport.uncertainty import hours_by_class
from fieldlum.learn.transport.window_sky import scatter_of_skies

# Of a sky's luminance in the windows over Perez's. Nineteen sets under Perez's skies have up to
# 0.05, eight with clouds 0.15 and more (docs/validation.md). Chosen between these.
_LEAST_SCATTER = 0.1


def seen_skies(fitted: Fitted, data: Dataset) -> list[str]:
    """Return one note if the skies in the windows differ from Perez's, else an empty list.

    The note states how far they differ, and whether the model learnt each capture under its own
    sky. Models other than light transport get none.
    """
    if not isinstance(fitted, Transport):
        return []
    with_patch = fitted.response.basis.patches is not None
    arrays = training_arrays_of(data, with_patch=with_patch)
    groups = hours_by_class(arrays.features.beam)
    kinds = ("overcast", "partly sunny", "sunny")
    scatter = {
        kind: math.expm1(sd)
        for kind, sd in zip(kinds, scatter_of_skies(arrays, groups), strict=True)
        if sd is not None
    }
    if fitted.sky_field is None and max(scatter.values(), default=0.0) < _LEAST_SCATTER:
        return []
    sizes = ", ".join(f"{size:.0%} in {kind} hours" for kind, size in scatter.items())
    typical = f" (one standard deviation: {sizes})" if sizes else ""
    learnt = (
        "Captures were learnt under the Perez model all the same, because held-out days do not "
        "show that their own skies are better"
        if fitted.sky_field is None
        else "Each capture was learnt under its own sky. Predicted hours use the Perez model, and "
        "their uncertainty includes the difference"
    )
    return [
        f"the skies in the windows differ from the Perez model for the measured "
        f"irradiance{typical}. The cause is clouds, or an instrument that sees other light than "
        f"the room, mostly in the diffuse irradiance of sunny hours. {learnt}"
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
