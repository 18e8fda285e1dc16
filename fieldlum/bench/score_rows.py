"""Read the pairs of a benchmark; compute the rows of its score table."""

import math
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, cast, get_args

import numpy as np

from fieldlum.core.errors import InputError, NotEnoughDataError, did_you_mean
from fieldlum.core.progress import progress
from fieldlum.core.records import JsonTable
from fieldlum.learn import model_kinds, models
from fieldlum.learn.models import Patch
from fieldlum.learn.models.scores import Truth, evaluate, summary
from fieldlum.learn.models.training_data import Dataset, in_usual_room, load_pairs, with_sky_view
from fieldlum.learn.train import Spent, Trial, day_folds, evaluate_folds, fit_timed, patch_mode
from fieldlum.optics.projection import equirect_rays
from fieldlum.room.fit.apply_scene import apply_scene
from fieldlum.room.scene.box_room import build
from fieldlum.room.scene.radiance import octree, rad_text, sun_text, trace

# The errors that every table of the benchmarks has, as named by `models.scores.summary`.
ERRORS = (
    *("log10_mse_weighted", "rer_weighted", "paper_log10_mse", "paper_rer"),
    *("dgp_mse", "dgp_mse_own_disc", "rammg_mse"),
)


class Spec(NamedTuple):
    """A model to compare, parsed from ``NAME``, ``NAME:PATCH`` or the folder of a trained model.

    label: its name in tables; name: key of `MODELS`; patch: how sun patches are used; folder: of
    the trained model, None to train a new one.
    """

    label: str
    name: str
    patch: Patch
    folder: Path | None = None


def parse_specs(texts: Sequence[str]) -> tuple[Spec, ...]:
    """Return the models to compare, one for each text: NAME, NAME:PATCH, or a model's folder.

    NAME: a key of `MODELS`; PATCH: absolute (the default), gain or none; a folder: its path, with a
    config.json. Raises InputError for a text that is neither a model nor a model folder, and for a
    damaged config.json.
    """
    return tuple(_parse_spec(text.strip()) for text in texts)


def _parse_spec(text: str) -> Spec:
    """Return the model that a text such as transport:none, or the path of a folder, names."""
    name, _, patch = text.partition(":")
    if name in model_kinds.MODELS and patch in ("", *get_args(Patch)):
        return Spec(text, name, cast(Patch, patch or "absolute"))
    folder = Path(text)
    if (folder / "config.json").is_file():
        config = models.read_config(folder)
        of_patch = "" if config.patch == "absolute" else f":{config.patch}"
        label = f"{config.model}{of_patch} ({folder.name})"
        return Spec(label, config.model, cast(Patch, config.patch), folder)
    names = f"{', '.join(model_kinds.MODELS)}, alone or with :absolute (default), :gain, :none"
    found, expected = f"the unknown name '{text}'", f"{names}; or a model folder"
    remedy = f"correct the name after --models{did_you_mean(name, model_kinds.MODELS)}"
    raise InputError("--models", found, expected, remedy)


class BenchData(NamedTuple):
    """The pairs of a benchmark, and the models to compare.

    data: hours to train on. test: hours that no model was trained on; None to use held-out days.
    specs: the models.
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
) -> BenchData:
    """Read the pairs of a benchmark with their sun patches or their scene, as `train` reads them.

    pairs, test: sessions or csv files with the hours to train on and to test on; test None: use
    held-out days. site: SITE.toml, None for that of the pairs. models: names, or folders of trained
    models. scene: "" for scene/ next to the pairs, "none", or the folder of a scene. sky_view: a
    sky_view.exr, None for that of the pairs. Test hours that a model was trained on are omitted.
    Raises InputError for files that cannot be used and for test pictures of another size or
    heading, NotEnoughDataError if no test hour is left.
    """
    specs = parse_specs(models)
    data = in_usual_room(with_sky_view(load_pairs(pairs, site), sky_view))
    data, _ = apply_scene(data, pairs, scene, "absolute")
    if test is None:
        return BenchData(data, None, specs)
    test_data, _ = apply_scene(in_usual_room(load_pairs(test, site)), pairs, scene, "absolute")
    frames = [(some.shape, round(some.heading_deg, 2)) for some in (test_data, data)]
    if frames[0] != frames[1]:
        found, needed = (f"{w} x {h} pixels, heading {deg:g}" for (h, w), deg in frames)
        raise InputError(test, found, f"{needed}, as in {pairs}", "merge or render both alike")
    folders = (spec.folder for spec in specs if spec.folder is not None)
    both_seen = replace(test_data, sky_view=data.sky_view, seen=test_data.seen & data.seen)
    return BenchData(data, without_training_hours(both_seen, data, *folders), specs)


def without_training_hours(test: Dataset, train: Dataset, *folders: Path) -> Dataset:
    """Return the test hours that no model was trained on.

    train: hours that new models are trained on; folders: of models that are already trained; hours
    are compared by their slots. Raises NotEnoughDataError if no hour remains, InputError for a
    folder whose config.json is missing or damaged.
    """
    trained = (models.read_config(folder).training.slots for folder in folders)
    training_slots = set(train.slots).union(*trained)
    is_unused = np.array([slot not in training_slots for slot in test.slots])
    if not is_unused.any():
        found = "every test hour is also a training hour; use other test hours"
        raise NotEnoughDataError(f"{test.source}: {found}")
    return test.take(is_unused)


def score_row(
    spec: Spec, data: Dataset, test: Truth | None, *, seed: int = 0, budget_s: float
) -> tuple[JsonTable, Trial]:
    """Fit one model to `data` and test it; return a row of the score table, and the trial.

    spec: the model; one that is already trained is not fitted again. test: truth of the test hours;
    None: test on held-out days of `data`, which must have two hours or more. seed: of the fit;
    budget_s: time limit of the training [s]. Keys of the row: name (the model's label), fit_s,
    fit_cpu_s [s], n_train, seed, patch and those of `scores.summary`. Raises InputError for a
    trained model without test hours or one that cannot be read, NotEnoughDataError for too few
    hours or too little time for the model, FloatingPointError for a predicted value that is not
    finite.
    """
    patch = patch_mode(data, spec.patch)
    if test is None:
        if spec.folder is not None:
            found = f"the trained model {spec.label}, but no test hours"
            raise InputError("--models", found, "other hours than it knows", "add --test TEST.csv")
        folds = day_folds(data)
        trial = evaluate_folds(spec.name, data, folds, patch=patch, seed=seed, budget_s=budget_s)
    else:
        fitted, spent, count = _fitted(spec, data, patch, seed, budget_s)
        times = {"fit_s": spent.wall_s, "fit_cpu_s": spent.cpu_s}
        scores = evaluate(fitted, test)
        trial = Trial(name=spec.name, scores=scores, n_train=count, folds=0, **times)
    row = {"name": spec.label, "fit_s": trial.fit_s, "fit_cpu_s": trial.fit_cpu_s}
    row |= {"n_train": trial.n_train, "seed": seed, "patch": patch, **summary(trial.scores)}
    return row, replace(trial, name=spec.label)


def _fitted(
    spec: Spec, data: Dataset, patch: Patch, seed: int, budget_s: float
) -> tuple[models.Fitted, Spent, int]:
    """Return a fitted model, the time of its training, and the number of its training hours.

    spec: the model; if it has a folder, the model is read from there, and the other arguments are
    not used. The times of a stored model are NaN if it does not state them. data: hours to fit to;
    budget_s: time limit of the fit [s].
    """
    if spec.folder is None:
        fitted, spent = fit_timed(spec.name, data, patch=patch, seed=seed, budget_s=budget_s)
        return fitted, spent, len(data)
    config = models.read_config(spec.folder)
    about = config.state.get("dense_training", {})
    wall_s = float(about.get("seconds", math.nan))
    spent = Spent(wall_s=wall_s, cpu_s=float(about.get("cpu_seconds", math.nan)))
    return models.load(spec.folder), spent, len(config.training.slots)


# The options of the paper's rpict (Liu, Colburn and Inanici 2020).
PAPER_OPTIONS = ("-ab", "4", "-aa", ".1", "-ar", "512", "-ad", "2048", "-as", "1024")


def radiance_row(data: Dataset, hours: int) -> dict[str, object] | None:
    """Return a row of the score table with the seconds that rtrace needs for one map.

    hours: number of bright hours of `data` to render; 0: none. Keys predict_s_per_map,
    predict_cpu_s_per_map: mean of these hours [s], at the map size of `data`, on one core, with the
    paper's options; n_test: number of rendered hours; those of `ERRORS`: None. The room is the box
    of [room]. Its sky is uniform with the hour's illuminance, which costs as much as a Perez sky.
    Return None without hours or a box room. Raises InputError for an impossible room.
    """
    room = data.setup.room
    if room is None or room.kind != "box" or hours < 1:
        return None
    scene = build(room)
    height, width = data.shape
    rays = scene.to_room(equirect_rays(height, width, data.heading_deg).reshape(-1, 3))
    bright = np.argsort(data.light.total_lx)[len(data) // 2 :]  # indices of the brighter half
    chosen = bright[np.unique(np.linspace(0, len(bright) - 1, hours).round().astype(int))]
    times_s = []  # wall time and CPU time of each hour
    for k, hour in enumerate(chosen):
        progress(k, len(chosen), "Radiance rendering")
        light = data.light[[hour]]
        # W/(m2 sr); Radiance counts 179 lm/W
        radiance = max(float(light.diffuse_lx[0]), 1.0) / 179.0 / np.pi
        sky = f"void glow skyglow\n0\n0\n4 {radiance:.6g} {radiance:.6g} {radiance:.6g} 0\n"
        sky += "skyglow source sky\n0\n0\n4 0 0 1 180\n"
        sun = sun_text(scene.to_room(light.apparent_sun_direction)[0], float(light.direct_lx[0]))
        with octree(rad_text(scene), sky, sun) as tree:
            start_s, busy_s = time.monotonic(), sum(os.times()[2:4])  # CPU time of children
            trace(tree, np.array(scene.camera_m), rays, PAPER_OPTIONS)
            times_s.append((time.monotonic() - start_s, sum(os.times()[2:4]) - busy_s))
    wall_s, cpu_s = np.mean(times_s, axis=0)
    seconds = {"predict_s_per_map": wall_s, "predict_cpu_s_per_map": cpu_s}
    return {"name": "Radiance -ab 4", **dict.fromkeys(ERRORS), **seconds, "n_test": len(times_s)}
