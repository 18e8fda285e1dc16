"""Read the pairs of a benchmark; compute the rows of its score table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast, get_args

import numpy as np

from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import JsonTable, Progress, quiet
from fieldlum.learn import models
from fieldlum.learn.model_registry import MODELS
from fieldlum.learn.models import Patch
from fieldlum.learn.models.data import Dataset, load_pairs, with_sky_view
from fieldlum.learn.models.scores import Truth, evaluate, summary
from fieldlum.learn.train import patch_mode
from fieldlum.learn.train.trials import Spent, Trial, day_folds, evaluate_folds, fit_timed
from fieldlum.room.fit.apply import in_scene
from fieldlum.room.fit.stated_box import training_captures, with_same_box

# The errors that every table of the benchmarks has, as named by `models.scores.summary`.
ERRORS = (
    "log10_mse_weighted",
    "rer_weighted",
    "paper_log10_mse",
    "paper_rer",
    "dgp_mse",
    "dgp_mse_own_disc",
    "rammg_mse",
)


@dataclass(frozen=True, slots=True)
class Spec:
    """A model to compare, parsed from ``NAME``, ``NAME:PATCH`` or the folder of a trained model.

    label: its name in tables; name: key of `MODELS`; patch: how sun patches are used; folder: of
    the trained model, None to train a new one.
    """

    label: str
    name: str
    patch: Patch
    folder: Path | None = None


def parse_specs(texts: Sequence[str]) -> tuple[Spec, ...]:
    """Parse the models to compare.

    Raises InputError for a text that is neither a model nor a model folder.
    """
    return tuple(_parse_spec(text.strip()) for text in texts if text.strip())


def _parse_spec(text: str) -> Spec:
    name, _, patch = text.partition(":")
    if name in MODELS and patch in ("", *get_args(Patch)):
        return Spec(text, name, cast(Patch, patch or "absolute"))
    folder = Path(text)
    if (folder / "config.json").is_file():
        config = models.read_config(folder)
        of_patch = "" if config.patch == "absolute" else f":{config.patch}"
        label = f"{config.model}{of_patch} ({folder.name})"
        return Spec(label, config.model, cast(Patch, config.patch), folder)
    raise InputError(
        "--models",
        f"the unknown name '{text}'",
        f"{', '.join(MODELS)}, alone or with :absolute (default), :gain, :none; or a model folder",
        "correct the name after --models",
    )


@dataclass(frozen=True, slots=True)
class BenchData:
    """The pairs of a benchmark, and the models to compare.

    data: hours to train on. test: hours that no model was trained on; None to use held-out days.
    """

    data: Dataset
    test: Dataset | None
    specs: tuple[Spec, ...]


def load(
    pairs: Path,
    models: Sequence[str],
    *,
    test: Path | None = None,
    site: Path | None = None,
    scene: str = "",
    sky_view: Path | None = None,
    progress: Progress = quiet,
) -> BenchData:
    """Read the pairs with their sun patches or their scene, as `train` learns them.

    pairs, test: sessions or csv files with the hours to train on and to test on. models: names, or
    folders of trained models. scene: "", "none" or the folder of a scene. sky_view: a sky_view.exr,
    None for that of the pairs. Without a scene, pairs with few clear hours choose between the
    stated box and no patch (`training_captures`), also for `test`. Test hours that a model was
    trained on are omitted. Raises InputError for files that cannot be used, NotEnoughDataError if
    no test hour is left.
    """
    specs = parse_specs(models)
    captures = load_pairs(pairs, site, progress=progress)
    data, _ = training_captures(captures, pairs, scene, "absolute", progress=progress)
    data = with_sky_view(data, sky_view, progress=progress)

    if test is None:
        return BenchData(data, None, specs)
    others = load_pairs(test, site, progress=progress)
    others, _ = in_scene(others, pairs, scene, "absolute", progress=progress)
    others = with_same_box(others, data, progress=progress)
    folders = (spec.folder for spec in specs if spec.folder is not None)
    fresh = without_training_hours(replace(others, sky_view=data.sky_view), data, *folders)
    return BenchData(data, fresh, specs)


def without_training_hours(test: Dataset, train: Dataset, *folders: Path) -> Dataset:
    """Return the test hours that are neither in `train` nor in the training of the stored models.

    Raises NotEnoughDataError if no hour remains.
    """
    training_slots = set(train.slots).union(
        *(models.read_config(folder).training.slots for folder in folders)
    )
    fresh = np.array([slot not in training_slots for slot in test.slots])
    if not fresh.any():
        raise NotEnoughDataError(
            f"{test.source}: every test hour is also a training hour; use other test hours"
        )
    return test.take(fresh)


def score_row(
    spec: Spec,
    data: Dataset,
    test: Truth | None,
    *,
    seed: int = 0,
    budget_s: float,
    progress: Progress = quiet,
) -> tuple[JsonTable, Trial]:
    """Fit one model with one seed on `data`; return its score row and the trial.

    The test is `test`, or held-out days of `data` if None. A trained model is not fitted again.
    Raises InputError for a trained model without test hours.
    """
    patch = patch_mode(data, spec.patch)
    if test is None:
        if spec.folder is not None:
            found = f"the trained model {spec.label}, but no test hours"
            raise InputError("--models", found, "other hours than it knows", "add --test TEST.csv")
        folds = day_folds(data)
        trial = evaluate_folds(
            spec.name, data, folds, patch=patch, seed=seed, budget_s=budget_s, progress=progress
        )
    else:
        fitted, spent, count = _fitted(spec, data, patch, seed, budget_s, progress)
        trial = Trial(spec.name, evaluate(fitted, test, progress=progress), *spent, count, 0)
    row = {
        "name": spec.label,
        "fit_s": trial.fit_s,
        "fit_cpu_s": trial.fit_cpu_s,
        "n_train": trial.n_train,
        "seed": seed,
        "patch": patch,
        **summary(trial.scores),
    }
    return row, replace(trial, name=spec.label)


def _fitted(
    spec: Spec, data: Dataset, patch: Patch, seed: int, budget_s: float, progress: Progress
) -> tuple[models.Fitted, Spent, int]:
    if spec.folder is None:
        fitted, spent = fit_timed(
            spec.name, data, patch=patch, seed=seed, budget_s=budget_s, progress=progress
        )
        return fitted, spent, len(data)
    config = models.read_config(spec.folder)
    about = config.state.get("dense_training", {})
    spent = Spent(*(float(about.get(name, float("nan"))) for name in ("seconds", "cpu_seconds")))
    return models.load(spec.folder), spent, len(config.training.slots)
