"""The models that `train` can fit, one entry each; without heavy imports for the command line.

A model is a module with ``fit(data, *, patch, seed, budget_s, progress) -> Fitted`` and
``from_state(state) -> Fitted`` (`fieldlum/models/__init__.py`). To add one, write the
module and its entry here; docs and command line, `auto`, `bench`, `predict` and `report` follow.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ModelKind:
    """Where a model is and how it is tried.

    module: its import path. size: order from small to large for the one-standard-error rule.
    fit: the fitting function's name. baseline: always tried, next to any model that is named;
    its fit has nothing random. slow: no closed form; it is trained again for each fold within a
    share of the budget (its fit takes budget_s and least_passes), continues from a checkpoint, and
    is never refitted for a report.
    """

    module: str
    size: int
    fit: str = "fit"
    baseline: bool = False
    slow: bool = False


MODELS: dict[str, ModelKind] = {
    "mean": ModelKind("fieldlum.models.baselines", 0, "fit_mean", baseline=True),
    "nearest": ModelKind("fieldlum.models.baselines", 1, "fit_nearest", baseline=True),
    "transport": ModelKind("fieldlum.models.transport", 2),
    "dense": ModelKind("fieldlum.models.dense", 3, slow=True),
}


def baselines() -> tuple[str, ...]:
    """Return the names of the models that `train` always tries next to the requested ones."""
    return tuple(name for name, kind in MODELS.items() if kind.baseline)
