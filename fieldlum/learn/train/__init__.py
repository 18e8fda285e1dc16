"""Fit a room's model, test models on held-out days, choose one, and record why.

`run` is what the `train` command calls; `evaluate_folds` and `fit_timed` serve the benchmarks too.
"""

import json
import math
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from time import monotonic, process_time
from typing import Any, NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.progress import part_of_progress
from fieldlum.core.records import counted
from fieldlum.core.statistics import held_out_masks
from fieldlum.learn import models
from fieldlum.learn.model_kinds import MODELS
from fieldlum.learn.models import TRUSTED_FACTOR, TRUSTED_MSE, Fitted, Patch
from fieldlum.learn.models import scores as scoring
from fieldlum.learn.models.held_out_choice import CRITERIA, choice_weights, choose, trimmed_mean
from fieldlum.learn.models.mirrors import Mirror, split_images
from fieldlum.learn.models.training_data import Dataset, in_usual_room, with_sky_view
from fieldlum.learn.train.outliers import without_changes
from fieldlum.room.fit.misplaced_patches import misplacement_of, warnings_of
from fieldlum.session import check_writable, sha256
from fieldlum.session.codec import current_note, data_digest, digest
from fieldlum.session.files.model_files import ScoreRow, ScoresFile, TrainAnswer
from fieldlum.sky.light_similarity import light_features
from fieldlum.version import __version__

POOR_MSE = 0.02  # log10, a factor of 1.4: a steady room with correct irradiance stays below
MODEL_FILES = ("config.json", "weights.npz")


# ----------------------------------------------------------------------------------------------
# held-out days


def day_folds(data: Dataset) -> list[Mask]:
    """Distribute the days over at most five tests; return a mask [n] of each test's captures.

    A test holds out the captures of its mask and trains with all others. If there is only one day,
    its hours are distributed instead. Neighbouring days are held out in different tests, so that
    these are about days between captured ones, not seasons without captures. Five: Hastie et al.,
    The Elements of Statistical Learning, 7.10. Raises NotEnoughDataError for under two hours.
    """
    if len(data) < 2:
        found = f"{counted(len(data), 'usable hour')}; at least 2 are needed to train and to test"
        raise NotEnoughDataError(f"{data.source}: {found}; capture more hours")
    days = len(np.unique(data.days))
    groups, count = (data.days, days) if days > 1 else (np.arange(len(data)), len(data))
    return list(held_out_masks(groups, min(count, 5)))


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """The test of one model on held-out days.

    name: of the model; scores: of the held-out captures of all folds; fit_s, fit_cpu_s: mean time
    of a fold's fit, by the wall clock and of computing [s]; n_train: mean number of training
    captures of a fold; folds: number of folds, 0 if tested on separate hours.
    """

    name: str
    scores: scoring.Scores
    fit_s: float
    fit_cpu_s: float
    n_train: int
    folds: int


class Spent(NamedTuple):
    """The time of a task: by the wall clock, and processor time of all threads [s].

    On a busy computer only `cpu_s` is meaningful.
    """

    wall_s: float
    cpu_s: float


def fit_timed(
    name: str,
    data: Dataset,
    *,
    patch: Patch,
    seed: int,
    budget_s: float | None,
    checkpoint: Path | None = None,
) -> tuple[Fitted, Spent]:
    """Fit the model `name` of `MODELS` to `data`; return the model and the time of the fit.

    patch: with "none" sun patches are not an input. seed: of all random numbers. budget_s: time
    limit [s], None for no limit; checkpoint: file that stores an interrupted fit and from which it
    continues, None for none. Only slow models use these two. Raises what the model's fit raises,
    such as NotEnoughDataError for too few captures or too little time.
    """
    wall, cpu = monotonic(), process_time()
    slow = {"budget_s": budget_s, "checkpoint": checkpoint} if MODELS[name].slow else {}
    fitted = models.fit(name, data, patch=patch, seed=seed, **slow)
    return fitted, Spent(monotonic() - wall, process_time() - cpu)


def evaluate_folds(
    name: str,
    data: Dataset,
    folds: Sequence[Mask],
    *,
    patch: Patch,
    seed: int,
    budget_s: float | None = None,
) -> Trial:
    """Test a model on held-out days: fit it without the captures of each fold, then predict these.

    name: of the model; folds: masks [n] of held-out captures, by `day_folds`, at least one; patch,
    seed: as for `fit_and_score`; budget_s: for all folds of a slow model together [s], None for no
    limit. Raises the errors of `fit_timed`, and FloatingPointError for a predicted value that is
    not finite.
    """
    parts: list[scoring.Scores] = []
    times: list[Spent] = []
    budget_s = budget_s and budget_s / len(folds)
    fit = partial(fit_timed, name, patch=patch, seed=seed, budget_s=budget_s)
    for k, held in enumerate(folds):
        with part_of_progress(2 * k, 2 * len(folds), f"{name} without some days, "):
            fitted, spent = fit(data.take(~held))
        with part_of_progress(2 * k + 1, 2 * len(folds), f"{name} without some days, "):
            parts.append(scoring.evaluate(fitted, scoring.truth(data.take(held))))
        times.append(spent)
    wall_s, cpu_s = np.mean(times, axis=0).tolist()
    return Trial(
        name=name,
        scores=scoring.join(parts),
        fit_s=wall_s,
        fit_cpu_s=cpu_s,
        n_train=round(len(data) - np.mean([held.sum() for held in folds])),
        folds=len(parts),
    )


# ----------------------------------------------------------------------------------------------
# choice


class ModelSelection(NamedTuple):
    """The name of the chosen model, and the reason for it."""

    name: str
    reason: str


def choose_model(trials: Sequence[Trial]) -> ModelSelection:
    """Choose the model with the smallest held-out error, as `held_out_choice.choose` compares it.

    trials: one or more, all of the same hours. A baseline repeats captured suns, and held-out days
    have nearly the same suns as the other days: it loses to another model unless it is better by
    over a standard error.
    """
    errors = [trial.scores.errors for trial in trials]
    best = choose(errors).best
    learnt = [k for k, trial in enumerate(trials) if not is_baseline(trial)]
    if best not in learnt and learnt:
        rival = learnt[choose([errors[k] for k in learnt]).best]
        if choose([errors[best], errors[rival]]).by is None:
            best = rival
    others = [trial for k, trial in enumerate(trials) if k != best]
    return ModelSelection(trials[best].name, _reason(trials[best], others))


def is_baseline(trial: Trial) -> bool:
    """Return whether a trial is of a baseline, the model mean or nearest.

    The trial's name is that of the model, also with an addition: NAME:PATCH or NAME (folder).
    """
    return MODELS[trial.name.replace(":", " ").split()[0]].baseline


def _reason(trial: Trial, others: Sequence[Trial]) -> str:
    """Return why a trial was chosen: its error next to those of the others, and what decided."""
    own = trial.scores.errors
    hours = f"{counted(own.judged, 'held-out hour')} of {counted(len(np.unique(own.day)), 'day')}"
    if not others:
        return f"the only model that was tested ({hours})"
    choice = choose([own, *(other.scores.errors for other in others)])
    clear = choice.by if choice.best == 0 else None
    by = clear or next(name for name in CRITERIA if np.isfinite(own.figure(name)))
    figures = ", ".join(f"{t.name} {t.scores.errors.figure(by):.2g}" for t in others)
    text = f"error of {CRITERIA[by]} over {hours}: {own.figure(by):.2g} ({figures})"
    return text if clear else f"{text}; no model is better by over a standard error"


# ----------------------------------------------------------------------------------------------
# training


@dataclass(frozen=True, slots=True)
class Result:
    """A trained model, and how it was chosen.

    fitted: the model, fitted to all of `data`; trials: tests on held-out days; choice: name of the
    model and the reason; fit_s: time of the final fit, by the wall clock [s]; data: the captures of
    the training, without those of a changed room; notes: texts for the user, warnings included;
    year: error to expect over a year, None if unknown (`year_of`); mirrors: plane mirrors that show
    the sun in captures; untrusted: whether no hour of the model is trusted (`is_untrusted`).
    """

    fitted: Fitted
    trials: tuple[Trial, ...]
    choice: ModelSelection
    fit_s: float
    data: Dataset
    notes: tuple[str, ...]
    year: scoring.YearExpectation | None
    mirrors: tuple[Mirror, ...]
    untrusted: bool

    def table(self, seed: int) -> list[ScoreRow]:
        """Return a row for each trial with the keys of `ScoreRow`, as `train --json` prints it.

        seed: of the training, which each row repeats.
        """
        names, seeds = ("name", "fit_s", "fit_cpu_s", "n_train", "folds"), {"seed": seed}
        return [
            {k: getattr(t, k) for k in names} | scoring.summary(t.scores) | seeds
            for t in self.trials
        ]


def patch_mode(data: Dataset, patch: Patch) -> Patch:
    """Return "none" for data without pictures of the sun patches, else `patch`."""
    return "none" if data.patch_cdm2 is None else patch


def fit_and_score(
    data: Dataset,
    model: str,
    *,
    patch: Patch = "absolute",
    budget_s: float = 600.0,
    seed: int = 0,
    checkpoint: Path | None = None,
) -> Result:
    """Run trials on held-out days, choose a model, and fit it to all data.

    model: a name of `MODELS`, or "auto" for all of them. patch: with "none" sun patches are not an
    input. budget_s: time in which the network is trained [s], half of it without held-out days.
    seed: of all random numbers. checkpoint: file that stores the network's last training, which
    continues from it if it exists; None for none. Raises NotEnoughDataError for too few hours to
    hold any out, or to fit `model`, and if the network has no time; InputError for an impossible
    room or a checkpoint that cannot be used.
    """
    patch = patch_mode(data, patch)
    captures = len(data)
    data, mirrors = split_images(in_usual_room(with_sky_view(data)))
    data, changed = without_changes(data, with_patch=patch != "none")
    misplacement = misplacement_of(data, patch)
    options: dict[str, Any] = {"patch": patch, "seed": seed, "budget_s": 0.5 * budget_s}
    trials, left_out = _trials(data, model, options)
    choice = choose_model(trials) if model == "auto" else ModelSelection(model, "requested")
    fitted, spent = fit_timed(choice.name, data, checkpoint=checkpoint, **options)
    notes = [*notes_of(data, patch, model, trials), *left_out, *model_notes(fitted, data, patch)]
    notes += [f"WARNING: {m.captures} of {captures} captures {m.warning}" for m in mirrors]
    notes += [*changed, *held_out_warnings(fitted, data), *warnings_of(misplacement)]
    year, untrusted = year_of(fitted, data, patch, seed), is_untrusted(fitted, data)
    return Result(
        fitted=fitted,
        trials=tuple(trials),
        choice=choice,
        fit_s=spent.wall_s,
        data=data,
        notes=tuple(notes),
        year=year if year is None or not untrusted else year._replace(trusted_share=0.0),
        mirrors=mirrors,
        untrusted=untrusted,
    )


def _trials(data: Dataset, model: str, options: dict[str, Any]) -> tuple[list[Trial], list[str]]:
    """Test the models on held-out days; return the trials, and notes on models without a trial.

    model: a name of `MODELS`, or "auto" for all of them; options: patch, seed and budget_s [s] of
    each trial. Raises NotEnoughDataError if there are too few hours for `model`.
    """
    names = [name for name, kind in MODELS.items() if kind.baseline or model in (name, "auto")]
    trials, left_out, folds = [], [], day_folds(data)
    for name in names:
        if MODELS[name].slow and not options["budget_s"]:  # loading PyTorch takes seconds
            left_out.append(f"{name} was not tried: --budget is 0")
            continue
        try:
            trials.append(evaluate_folds(name, data, folds, **options))
        except NotEnoughDataError as error:
            if model == name:
                raise
            left_out.append(f"{name} was not tried: {error}")
    return trials, left_out


def year_of(
    fitted: Fitted, data: Dataset, patch: Patch, seed: int
) -> scoring.YearExpectation | None:
    """Return the error that the model itself expects over a year, under skies like the captures'.

    data: the captures; seed: of the draw of hours and their skies. The result is None if the model
    does not estimate its error, or if patches are used but SITE.toml has no [room] to compute those
    of other hours.
    """
    if patch == "none":
        data = replace(data, patch_cdm2=None)
    if data.patch_cdm2 is not None and data.setup.room is None:
        return None
    year = scoring.expect_year(fitted, data, np.random.default_rng(seed))
    return year if math.isfinite(year.expected_log10_mse) else None


def run(
    data: Dataset,
    model: str = "auto",
    *,
    budget_min: float = 10.0,
    patch: Patch = "absolute",
    seed: int = 0,
    out: Path,
    force: bool = False,
) -> TrainAnswer:
    """Train, write the model and its scores to `out`, and return what `train --json` prints.

    If captures and options have not changed since the same version trained the model, nothing is
    trained (unless `force`) and the answer's `kept` is True. An interrupted dense training
    continues from its checkpoint in `out`. budget_min: minutes for the network. Other arguments and
    errors: `fit_and_score`; InputError also for an `out` that cannot be written.
    """
    mode = patch_mode(data, patch)
    inputs = {
        "data": data.digest(),
        "sky_view": "" if data.sky_view is None else data_digest(data.sky_view),
        "model": model,
        "patch": mode,
        "budget_min": budget_min,
        "seed": seed,
        "fieldlum": __version__,
    }
    existing = current_note(out / ScoresFile.NAME, inputs, [out / name for name in MODEL_FILES])
    same = existing is not None and existing.get("model_sha256") == _model_sha256(out)
    if same and not force and models.is_usable(out):
        return {**ScoresFile.read(out).table(), "kept": True}
    check_writable(out)
    checkpoint = out / f"checkpoint-{digest([seed, mode, inputs['data']])[:12]}.pt"
    result = fit_and_score(
        data, model, patch=patch, budget_s=60.0 * budget_min, seed=seed, checkpoint=checkpoint
    )
    answer = {
        "models": result.table(seed),
        "chosen": result.choice.name,
        "reason": result.choice.reason,
        "parameters": result.fitted.parameters,
        "final_fit_s": result.fit_s,
        "year": None if result.year is None else result.year._asdict(),
        "notes": result.notes,
        "inputs": inputs,
    }
    text = json.dumps(answer, default=lambda value: value.tolist())
    # JSON has no NaN
    answer = json.loads(text, parse_constant=lambda _: None)
    if int(os.environ.get("RANK", "0")) == 0:  # only the first process of torchrun writes
        # The scores are written last: the file shows that the model is complete.
        (out / ScoresFile.NAME).unlink(missing_ok=True)
        _write_model(out, result, mode, seed)
        answer["model_sha256"] = _model_sha256(out)
        ScoresFile.from_table({**answer}, out / ScoresFile.NAME).write(out)
        checkpoint.unlink(missing_ok=True)
    return {**answer, "kept": False}


def _write_model(out: Path, result: Result, patch: Patch, seed: int) -> None:
    """Write the trained model and, if computed, its maps of held-out hours to the folder `out`.

    patch, seed: with which it was trained.
    """
    about = {
        "patch": patch,
        "seed": seed,
        "chosen_because": result.choice.reason,
        "warnings": [note for note in result.notes if note.startswith("WARNING")],
        "untrusted": result.untrusted,
    }
    models.save(out, result.fitted, result.data, mirrors=result.mirrors, **about)
    (out / "held_out.npz").unlink(missing_ok=True)
    for trial in result.trials:
        if trial.name == result.choice.name and trial.scores.maps is not None:
            trial.scores.maps.write(out)


def _model_sha256(folder: Path) -> str:
    """Return one digest of the files of the model in a folder."""
    return digest([sha256(folder / name) for name in MODEL_FILES])


# ----------------------------------------------------------------------------------------------
# notes and warnings for the reader of the scores


def model_notes(fitted: Fitted, data: Dataset, patch: Patch) -> list[str]:
    """Return at most two notes on a light transport model, and none on other models.

    The first states how far the sky in the windows was from the expected one; the second warns that
    the stated room was not used. data: the captures of the fit. patch: with "none" no room is
    needed.
    """
    # A `MeanTransport` has the captures in its model `fitted`; other models have none.
    notes, captured = [], getattr(getattr(fitted, "fitted", fitted), "captured", None)
    if captured is not None:
        in_windows = np.log(np.maximum(captured.sky, 1e-9))  # [n, 2305]
        expected = np.log(np.maximum(light_features(data.light).sky, 1e-9))
        sd = float((in_windows - expected).std(axis=0).max())
        if sd > 0.0:
            notes.append(
                f"the sky in the windows was up to {math.expm1(sd):.0%} (one standard deviation) "
                "brighter or darker than expected from the irradiance: usual under clouds and part "
                "of the stated uncertainty; if most days were clear, check that the pyranometer is "
                "level and unshaded"
            )
    stated = data.setup.room is not None and patch != "none"
    if stated and getattr(fitted, "patch_scale", 1.0) is None:
        notes.append(
            "WARNING: the stated [room] is not used: without it, captures are predicted from other "
            "days and seasons with less than half of the error. It may lack a building opposite or "
            "furniture, or have a wrong size: correct it, or run fieldlum scene fit"
        )
    return notes


def notes_of(data: Dataset, patch: Patch, model: str, trials: Sequence[Trial]) -> list[str]:
    """Return the notes of `data`, then notes that a reader of the scores needs.

    They are about captures of one day only, missing sun patches, and a model that is worse than a
    baseline. patch: "none" if sun patches are not used; model: name of the requested model ("auto"
    gives no note about the baselines); trials: tests of this model and of the baselines.
    """
    notes = list(data.notes)
    if len(np.unique(data.days)) == 1:
        notes += ["all hours are from one day, so that the scores are too good: capture more days"]
    states = data.light.states or ()
    for part in sorted({part for state in states for part in state.split(";") if part}):
        if len({*data.days[[part in state for state in states]]}) == 1 < len({*data.days}):
            notes.append(f"{part} was captured on one day only: held-out days cannot score it")
    # A scene without patches was chosen on purpose and has its own note.
    if patch == "none" and data.patch_cdm2 is None and data.scene is None:
        notes.append(
            "no sun patches: add a [room] and run fieldlum pair; a csv: its column sunpatch"
        )
    own = next((trial for trial in trials if trial.name == model), None)
    if own is None or MODELS[model].baseline:
        return notes
    others = [trial for trial in trials if is_baseline(trial)]
    # In each choice, 0 is the model and 1 the baseline; `by` is None if neither is better by over a
    # standard error.
    choices = [choose([own.scores.errors, t.scores.errors]) for t in others]
    better = [t.name for t, c in zip(others, choices, strict=True) if c.best == 1 and c.by]
    if better:
        found = f"{model} is clearly worse than {' and '.join(better)} on held-out days"
        notes.append(f"WARNING: {found}: do not use it before the cause is found")
    return notes


def held_out_warnings(fitted: Fitted, data: Dataset) -> list[str]:
    """Return notes about large errors of the model on captures with their day held out.

    Large errors are a WARNING, other ones a remark: in nine rooms of other renderers in which
    nothing changed, another day predicts 8 to 59 % of the captures worse than `TRUSTED_MSE`. The
    list is empty without large errors, and for a model without held-out errors.
    """
    errors, weight = _judged_errors(fitted, data)
    if not len(errors):
        return []
    share = float(np.average(errors > TRUSTED_MSE, weights=weight))
    if is_untrusted(fitted, data):
        rms = 10.0 ** trimmed_mean(errors, weight) ** 0.5
        return [
            f"WARNING: predictions of held-out days are wrong by a factor of {rms:.2f} (rms): do "
            "not trust single maps of this model; likely causes are broken cloud, wrong "
            "irradiance, or a room that changed"
        ]
    if share < 0.1:  # chosen
        return []
    return [
        f"for {share:.0%} of the captures, a prediction from the other days is wrong by a factor "
        f"of over {TRUSTED_FACTOR:g}: usual under clouds, whose places the irradiance does not "
        "show, and if only one day has such a sun; else the room, the camera or a lamp changed. "
        "Hours with similar light are not trusted"
    ]


def is_untrusted(fitted: Fitted, data: Dataset) -> bool:
    """Return whether held-out errors of the captures `data` are too large to trust any hour.

    They are too large with a trimmed mean log10 MSE over 0.02 (`POOR_MSE`), or a median over a
    quarter of it. False for a model without held-out errors.
    """
    errors, weight = _judged_errors(fitted, data)
    median = np.median(errors) if len(errors) else 0.0
    return bool(median > POOR_MSE / 4 or trimmed_mean(errors, weight) > POOR_MSE)


def _judged_errors(fitted: Fitted, data: Dataset) -> tuple[Floats, Floats]:
    """Return held-out log10 MSE and weight of the training captures with weight, [k] each.

    data: the captures with which `fitted` was trained; weight: by `choice_weights`. k is 0 for a
    model without held-out errors.
    """
    if fitted.held_out_mse is None:
        return np.empty(0), np.empty(0)
    weight = choice_weights(data)
    judged = weight > 0.0
    return np.nan_to_num(fitted.held_out_mse, nan=np.inf)[judged], weight[judged]
