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
    candidates: Sequence[tuple[str, int, Floats]],
    unit: str = "%",
    scale: float = 100.0,
    negligible: float = 0.0,
) -> OrderSelection:
    """Return the smallest candidate within one standard error of the best, with a line of text.

    A candidate has a name, a size (number of free parameters, or a rank in their order), and the
    squared errors [n] of held-out data, which are the same for every candidate. The best has the
    smallest mean of them; the smallest has the lowest size. what : name of the fit; unit, scale :
    unit of the rms in that line, and the factor that converts it to that unit. negligible : a
    candidate whose rms is larger by at most this (in the unit of the errors' root) counts as equal
    to the best.
    """
    names, sizes, errors = zip(*candidates, strict=True)
    rms = np.sqrt([e.mean() for e in errors])
    best = int(np.argmin(rms))
    allowed = [
        i
        for i, e in enumerate(errors)
        if rms[i] - rms[best] <= negligible or is_no_worse(e, errors[best])
    ]
    chosen = min(allowed, key=lambda i: (sizes[i], rms[i]))
    tried = ", ".join(f"{n} {scale * r:.3g} {unit}" for n, r in zip(names, rms, strict=True))
    smaller = f"smaller than the best, {names[best]}, and not significantly worse"
    why = "the best" if chosen == best else smaller
    line = f"{what}: {names[chosen]} ({why}); held-out rms: {tried}"
    return OrderSelection(chosen, float(rms[chosen]), line)


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

    models : each with its name and size, as in `choose`. groups [n] : of the data, see `folds`.
    solve : fits a model to the data of a mask. errors : squared errors of the data of a mask by a
    model's parameters, NaN for a datum that cannot be predicted. what, unit, scale, negligible : as
    in `choose`.
    """
    candidates = [
        (name, size, held_out_errors(model, groups, solve, errors)) for name, size, model in models
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
    parts = len(names) if len(names) <= 24 else count  # limits the time
    for part in range(parts):
        yield np.isin(groups, names[part::parts])


def gross_errors(off: Floats, minimum: float) -> Mask:
    """Return a mask [n] of the residuals that are gross errors of single readings.

    off [n] : residuals about 0. A gross error exceeds `minimum` and five robust standard
    deviations. All are False if more than a quarter would be True, because the model is then wrong
    and not the readings.
    """
    far = np.abs(off) > max(5.0 * robust_sigma(off, 0.0), minimum)
    return far if far.mean() <= 0.25 else np.zeros(len(off), bool)
