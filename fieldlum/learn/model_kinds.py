"""The models that `train` can fit, one entry each; without heavy imports for the command line.

A model is a module with ``fit(data, *, patch, seed, budget_s) -> Fitted`` and
``from_state(state) -> Fitted`` (`fieldlum/learn/models/__init__.py`). CONTRIBUTING.md states how
to add one; command line, `auto`, `bench`, `predict` and `report` follow from its entry here.
"""

from typing import NamedTuple


class ModelKind(NamedTuple):
    """Where the code of a kind of model is, and how `train` tries it.

    module: import path. fit: name of the fitting function in the module. baseline: True if `train`
    always tries it, also if the user names another model; its fit has nothing random. slow: True if
    it is trained step by step, within a time budget: its fit takes budget_s and checkpoint, from
    which it can continue, and is never repeated for a report.
    """

    module: str
    fit: str = "fit"
    baseline: bool = False
    slow: bool = False


MODELS: dict[str, ModelKind] = {
    "mean": ModelKind("fieldlum.learn.models.baselines", "fit_mean", baseline=True),
    "nearest": ModelKind("fieldlum.learn.models.baselines", "fit_nearest", baseline=True),
    "transport": ModelKind("fieldlum.learn.transport"),
    "dense": ModelKind("fieldlum.learn.models.dense", slow=True),
}
