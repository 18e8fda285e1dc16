"""Fit and choose: gross errors are left out, and held-out data choose the size of a model.

The chosen model is the smallest within one standard error of the best.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.statistics import is_no_worse, robust_sigma

Model = TypeVar("Model")
Parameters = TypeVar("Parameters")

# up to this number of groups each group is held out separately; chosen, limits the time
LEAVE_ONE_OUT = 24


@dataclass(frozen=True, slots=True)
class Candidate:
    """One model among those to choose from.

    name : for the line of text; size : number of free parameters, or a rank in their order; errors
    [n] : squared errors of n held-out data, which are the same for every candidate.
    """

    name: str
    size: int
    errors: Floats


@dataclass(frozen=True, slots=True)
class OrderSelection:
    """The index of the chosen candidate, from 0, and a line for the profile with the reason.

    index: of the candidate; rms: its held-out rms; line: lists all candidates, and states why
    this one was chosen.
    """

    index: int
    rms: float
    line: str


def choose(
    what: str,
    candidates: Sequence[Candidate],
    unit: str = "%",
    scale: float = 100.0,
    negligible: float = 0.0,
) -> OrderSelection:
    """Return the smallest candidate within one standard error of the best, with a line of text.

    The best has the smallest mean of `errors`; the smallest has the lowest `size`. what : name of
    the fit, for the line of text; unit, scale : unit of the rms in that line, and the factor that
    converts it to that unit. negligible : a candidate whose rms is larger by at most this (in the
    unit of the errors' root) counts as equal to the best.
    """
    means = np.array([candidate.errors.mean() for candidate in candidates])
    best = int(np.argmin(means))
    allowed = []
    for i, candidate in enumerate(candidates):
        small = np.sqrt(means[i]) - np.sqrt(means[best]) <= negligible
        if small or is_no_worse(candidate.errors, candidates[best].errors):
            allowed.append(i)
    chosen = min(allowed, key=lambda i: (candidates[i].size, means[i]))
    tried = ", ".join(
        f"{c.name} {scale * np.sqrt(m):.3g} {unit}" for c, m in zip(candidates, means, strict=True)
    )
    why = (
        "the best"
        if chosen == best
        else f"smaller than the best, {candidates[best].name}, and not significantly worse"
    )
    line = f"{what}: {candidates[chosen].name} ({why}); held-out rms: {tried}"
    return OrderSelection(chosen, float(np.sqrt(means[chosen])), line)


def fit_and_choose(
    what: str,
    models: Sequence[tuple[str, int, Model]],
    groups: NDArray[np.integer],
    solve: Callable[[Model, Mask], Parameters],
    errors: Callable[[Model, Parameters, Mask], Floats],
    *,
    unit: str = "%",
    scale: float = 100.0,
    negligible: float = 0.0,
) -> tuple[Model, Parameters, OrderSelection]:
    """Return the model that held-out data choose, its parameters by all data, and the choice.

    models : each with its name and size, as in `Candidate`. groups [n] : of the data, see `folds`.
    solve : fits a model to the data of a mask. errors : squared errors of the data of a mask by a
    model's parameters, NaN for a datum that cannot be predicted. what, unit, scale, negligible : as
    in `choose`.
    """
    candidates = [
        Candidate(name, size, held_out_errors(model, groups, solve, errors))
        for name, size, model in models
    ]
    choice = choose(what, candidates, unit, scale, negligible)
    chosen = models[choice.index][2]
    return chosen, solve(chosen, np.ones(len(groups), bool)), choice


def held_out_errors(
    model: Model,
    groups: NDArray[np.integer],
    solve: Callable[[Model, Mask], Parameters],
    errors: Callable[[Model, Parameters, Mask], Floats],
) -> Floats:
    """Return the squared errors of held-out data [m], without NaN; see `fit_and_choose`."""
    out = np.full(len(groups), np.nan)
    for held in folds(groups):
        out[held] = errors(model, solve(model, ~held), held)
    return out[np.isfinite(out)]


def folds(groups: NDArray[np.integer], count: int = 8) -> Iterator[Mask]:
    """Yield masks [n], one for each fit of a cross-validation, True for the data to hold out.

    groups [n] : number of each datum's group; a group is never divided. With up to 24 groups each
    is held out alone; with more, they are divided into `count` sets. Each datum is held out once.
    """
    names = np.unique(groups)
    parts = len(names) if len(names) <= LEAVE_ONE_OUT else count
    for part in range(parts):
        yield np.isin(groups, names[part::parts])


def gross_errors(off: Floats, *, sigmas: float, minimum: float, max_share: float = 0.25) -> Mask:
    """Return a mask [n] of the residuals that are gross errors of single readings.

    off [n] : residuals about 0. A gross error exceeds `minimum` and `sigmas` times their robust
    standard deviation. All are False if more than `max_share` of them would be True, because the
    model is then wrong and not the readings.
    """
    far = np.abs(off) > max(sigmas * robust_sigma(off, 0.0), minimum)
    return far if far.mean() <= max_share else np.zeros(len(off), bool)
