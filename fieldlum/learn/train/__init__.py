"""Fit a room's model, score it on held-out days, and record why it was chosen.

`run` is what the `train` command calls; `evaluate_folds` and `fit_timed` serve the benchmarks too.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Progress, counted, quiet
from fieldlum.learn import models
from fieldlum.learn.model_registry import MODELS, baselines
from fieldlum.learn.models import POOR_WORDS, TRUSTED_FACTOR, TRUSTED_MSE, Fitted, Patch
from fieldlum.learn.models.data import Dataset, with_sky_view
from fieldlum.learn.models.held_out_choice import (
    LOW_SUN_DEG,
    beam_is_doubted,
    choice_weights,
    trimmed_mean,
)
from fieldlum.learn.models.mirrors import Mirror, split_images
from fieldlum.learn.models.scores import YearExpectation, expect, light_of_year, summary
from fieldlum.learn.train.outliers import without_changes
from fieldlum.learn.train.trials import (
    MIN_FOLD_S,
    ModelSelection,
    OutOfTime,
    Spent,
    TimeBudget,
    Trial,
    choose_model,
    day_folds,
    evaluate_folds,
    fit_timed,
    is_clearly_worse,
    one_day_only,
)
from fieldlum.learn.transport import MeanTransport, Transport
from fieldlum.room.fit.setting import Setting, scan, settle, with_right_clock
from fieldlum.session import check_writable, sha256
from fieldlum.session.files.scores_json import ScoreRow, ScoresFile, TrainAnswer
from fieldlum.session.provenance import data_digest, digest, made_from
from fieldlum.version import __version__

SCORES, MODEL_FILES = "scores.json", ("config.json", "weights.npz")
# log10 MSE, an error factor of 1.4, which a steady room with correct irradiance does not reach
POOR_MSE = 0.02
EXCEPTION_TIMES = 4.0  # a day this many times worse than the median day is reported


@dataclass(frozen=True, slots=True)
class Result:
    """A trained model, and how it was chosen.

    fitted: the model, fitted to all of `data`; trials: tests on held-out days; choice: name of the
    model and the reason; fit_s: time of the final fit, by the wall clock [s]; data: the captures of
    the training, without those of a changed room; notes: texts for the user, warnings included;
    year: error to expect over a year, None if unknown (`year_of`); mirrors: plane mirrors that show
    the sun in captures.
    """

    fitted: Fitted
    trials: tuple[Trial, ...]
    choice: ModelSelection
    fit_s: float
    data: Dataset
    notes: tuple[str, ...]
    year: YearExpectation | None
    mirrors: tuple[Mirror, ...]

    def table(self, seed: int) -> list[ScoreRow]:
        """Return a row for each trial, as in `train --json` (docs/design.md, Command line)."""
        own = ("name", "fit_s", "fit_cpu_s", "n_train", "folds")
        more = {"seed": seed, "not_judged_because": None}
        return [
            {name: getattr(trial, name) for name in own} | summary(trial.scores) | more
            for trial in self.trials
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
    budget: TimeBudget | None = None,
    seed: int = 0,
    checkpoint: Path | None = None,
    progress: Progress = quiet,
) -> Result:
    """Run trials on held-out days, choose a model, and fit it to all data.

    model: a name of `MODELS`, or "auto" for all of them. budget: a budget that other steps share;
    else `budget_s` from now on. Steps that the budget does not permit are left out and listed in
    the notes; with "auto" the best model so far is stored. Raises NotEnoughDataError for too few
    hours to hold any out, or to fit `model`, and if the budget ends before `model` is fitted.
    """
    budget = budget or TimeBudget.starting(budget_s)
    patch = patch_mode(data, patch)
    captures = len(data)
    data, mirrors = split_images(with_sky_view(data, progress=progress))
    data, setting, changed = usable_captures(data, patch, progress)
    if not day_folds(data):
        raise NotEnoughDataError(
            f"{data.source}: {counted(len(data), 'usable hour')}; at least 2 are needed to train "
            "and to test; capture more hours"
        )
    more: dict[str, Any] = {"patch": patch, "seed": seed}
    trials, left_out = _trials(data, model, budget, progress, **more)
    choice = choose_model(trials) if model == "auto" else ModelSelection(model, "requested")
    try:
        fitted, spent = _stored_fit(choice.name, data, budget, checkpoint, progress, **more)
    except (OutOfTime, NotEnoughDataError):  # the network refuses a time without one pass
        late = f"{choice.name} was not fitted within the time of --budget"
        if model != "auto":
            raise NotEnoughDataError(f"{data.source}: {late}; raise --budget") from None
        choice = choose_model([trial for trial in trials if trial.name in baselines()])
        left_out.append(
            f"WARNING: {late}, although it is better on held-out days: the model is {choice.name}, "
            "the best that was; raise --budget and train again"
        )
        fitted, spent = _stored_fit(choice.name, data, budget, checkpoint, progress, **more)
    fitted, doubted = findings(fitted, data, setting)
    mirror = [f"WARNING: {m.captures} of {captures} captures {m.warning}" for m in mirrors]
    notes = [*notes_of(data, patch, model, trials), *left_out, *seen_skies(fitted), *mirror]
    notes += [*changed, *doubted]
    try:
        year = year_of(fitted, data, patch, seed, budget.watched(progress))
    except OutOfTime:
        year = None
        notes.append("the error of a year was not computed: the budget was used up")
    return Result(fitted, tuple(trials), choice, spent.wall_s, data, tuple(notes), year, mirrors)


def _trials(
    data: Dataset, model: str, budget: TimeBudget, progress: Progress, **more: Any
) -> tuple[list[Trial], list[str]]:
    """Test the models on held-out days; return the trials, and notes on those without time."""
    names = tuple(MODELS) if model == "auto" else tuple(dict.fromkeys((*baselines(), model)))
    trials, left_out = [], []
    for name in names:
        slow = MODELS[name].slow
        # a slow model's held-out days get half of its time, the stored model the rest
        limit = 0.5 * budget.slow_s if slow else budget.quick_s
        folds = day_folds(data)
        some = folds[: max(1, int(limit / MIN_FOLD_S))] if slow else folds
        show = budget.of_model(name, progress)
        more |= {"budget_s": limit, "keep_maps": True, "clock": budget.clock, "progress": show}
        try:
            trials.append(evaluate_folds(name, data, some, **more))
        except OutOfTime:
            left_out.append(f"{name}: not judged: the budget was used up; raise --budget")
        except NotEnoughDataError as error:
            if model == name:
                raise
            left_out.append(f"{name} was not tried: {error}")
    return trials, left_out


def _stored_fit(
    name: str,
    data: Dataset,
    budget: TimeBudget,
    checkpoint: Path | None,
    progress: Progress,
    **more: Any,
) -> tuple[Fitted, Spent]:
    if checkpoint is not None and MODELS[name].slow:
        more["checkpoint"] = checkpoint
    show = budget.of_model(name, progress)
    return fit_timed(name, data, budget_s=budget.slow_s, progress=show, **more)


def year_of(
    fitted: Fitted, data: Dataset, patch: Patch, seed: int, progress: Progress
) -> YearExpectation | None:
    """Return the error that the model itself expects over a year, for skies drawn from captures.

    seed: of the draw of 150 hours and their skies. Return None if the model does not estimate its
    error, or if patches are used but SITE.toml has no [room] to compute those of other hours.
    """
    if patch == "none":
        data = replace(data, patch_cdm2=None)
    if data.patch_cdm2 is not None and data.setup.room is None:
        return None
    light = light_of_year(data, np.random.default_rng(seed))
    year = expect(fitted, data, light, progress)
    return year if math.isfinite(year.expected_log10_mse) else None


def usable_captures(
    data: Dataset, patch: Patch, progress: Progress = quiet
) -> tuple[Dataset, Setting | None, list[str]]:
    """Return the captures to train with, the result of `setting.scan`, and warnings.

    Captures of a changed room are omitted, and a camera clock that differs between days is
    corrected. The warnings are about both.
    """
    data, changed = without_changes(data, with_patch=patch != "none")
    setting = scan(data, patch, progress)
    data, clock = with_right_clock(data, setting)
    return data, setting, [*changed, *clock]


def findings(fitted: Fitted, data: Dataset, setting: Setting | None) -> tuple[Fitted, list[str]]:
    """Return the model, and warnings about days, captures and sun patches it cannot explain.

    If the captures contradict the computed sun patches, the returned model has a larger uncertainty
    near patches; otherwise it is `fitted`. setting: result of `scan`.
    """
    fitted, warned = settle(fitted, data, setting)
    return fitted, [*doubts(fitted, data), *warned]


def default_folder(pairs: Path, model: str) -> Path:
    """Return the path models/MODEL in the folder `pairs` (a session), or next to a pairs.csv."""
    return (pairs if pairs.is_dir() else pairs.parent) / "models" / model


def run(
    data: Dataset,
    model: str = "auto",
    *,
    budget_min: float = 10.0,
    spent_s: float = 0.0,
    patch: Patch = "absolute",
    seed: int = 0,
    out: Path,
    force: bool = False,
    clock: Callable[[], float] = time.monotonic,
    progress: Progress = quiet,
) -> TrainAnswer:
    """Train, write the model and its scores to `out`, and return what `train --json` prints.

    If captures and options have not changed since the same version trained the model, nothing is
    trained (unless `force`) and the answer's `kept` is True. An interrupted dense training
    continues from its checkpoint in `out`. spent_s: part of the budget that is used already [s].
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
    if not force and (table := trained_before(out, inputs)) is not None:
        return {**table, "kept": True}
    check_writable(out)
    checkpoint = out / f"checkpoint-{digest([seed, mode, inputs['data']])[:12]}.pt"
    budget = TimeBudget.starting(60.0 * budget_min - spent_s, clock)
    result = fit_and_score(
        data,
        model,
        patch=patch,
        budget=budget,
        seed=seed,
        checkpoint=checkpoint,
        progress=progress,
    )
    answer = {
        "models": result.table(seed),
        "chosen": result.choice.name,
        "reason": result.choice.reason,
        "parameters": result.fitted.parameters,
        "final_fit_s": result.fit_s,
        "year": None if result.year is None else asdict(result.year),
        "notes": result.notes,
        "inputs": inputs,
    }
    text = json.dumps(answer, default=lambda value: value.tolist())
    # JSON has no NaN
    answer = json.loads(text, parse_constant=lambda _: None)
    if int(os.environ.get("RANK", "0")) == 0:  # of the processes of torchrun
        # this file is written last: it shows that the model is complete
        (out / SCORES).unlink(missing_ok=True)
        models.save(
            out,
            result.fitted,
            result.data,
            patch=mode,
            seed=seed,
            mirrors=result.mirrors,
            chosen_because=result.choice.reason,
            warnings=[note for note in result.notes if note.startswith("WARNING")],
        )
        (out / "held_out.npz").unlink(missing_ok=True)
        chosen = (trial for trial in result.trials if trial.name == result.choice.name)
        if (trial := next(chosen, None)) and trial.scores.maps is not None:
            trial.scores.maps.write(out)
        answer["model_sha256"] = _model_sha256(out)
        ScoresFile.from_table({**answer}, out / SCORES).write(out)
        checkpoint.unlink(missing_ok=True)
    return {**answer, "kept": False}


def trained_before(folder: Path, inputs: Mapping[str, object]) -> TrainAnswer | None:
    """Return the stored scores of the model in `folder`, if it need not be trained again.

    None if there is no complete model, if its files changed, or if it had other `inputs`.
    """
    table = made_from(folder / SCORES, inputs, [folder / name for name in MODEL_FILES])
    if table is None or table.get("model_sha256") != _model_sha256(folder):
        return None
    return ScoresFile.read(folder).table()


def _model_sha256(folder: Path) -> str:
    return digest([sha256(folder / name) for name in MODEL_FILES])


# ----------------------------------------------------------------------------------------------
# notes and warnings for the reader of the scores


def seen_skies(fitted: Fitted) -> list[str]:
    """Return one note if the model learnt each capture under the sky in its windows."""
    field = fitted.sky_field if isinstance(fitted, Transport | MeanTransport) else None
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


def doubts(fitted: Fitted, data: Dataset) -> list[str]:
    """Return warnings about large errors of the model on captures with their day held out.

    One warning names days that are much worse than the median day; one is about large errors on
    all days; one about over 10 % of the captures predicted wrongly by more than the factor up to
    which hours are trusted. The list is empty if there are none, and for a model without held-out
    errors.
    """
    if fitted.held_out_mse is None or len(fitted.held_out_mse) != len(data):
        return []
    weight = choice_weights(data)
    some = weight > 0.0
    errors, weight = np.nan_to_num(fitted.held_out_mse, nan=np.inf)[some], weight[some]
    day, texts = data.days[some], []
    days = np.unique(day)
    means = np.array([trimmed_mean(errors[day == d], weight[day == d]) for d in days])
    exceptions = days[(means > POOR_MSE) & (means > EXCEPTION_TIMES * np.median(means))]
    if len(exceptions):
        shown = ", ".join(map(str, exceptions[:5])) + (" ..." if len(exceptions) > 5 else "")
        texts.append(
            f"WARNING: the held-out error of {shown} is over {EXCEPTION_TIMES:g} times that of the "
            "median day: a blind was probably moved, a lamp was on, or the irradiance is wrong; "
            "these captures are used in the training: mark what was different (fieldlum status "
            "SESSION --mark SLOT blind=half), or set ok = 0 in pairs.csv, and train again"
        )
    mean = trimmed_mean(errors, weight)
    if np.median(errors) > POOR_MSE / 4 or mean > POOR_MSE:
        texts.append(
            f"WARNING: predictions of held-out days are wrong by a factor of {10.0**mean**0.5:.2f} "
            "(rms); likely causes are broken cloud, wrong irradiance, or a room that changed (a "
            f"wrong north or clock has its own warning); {POOR_WORDS}"
        )
    share = float(np.average(errors > TRUSTED_MSE, weights=weight))
    # share of the captures; clean sets have under 2 %, with a lamp or a moved camera 20 to 60 %
    if share > 0.1:
        texts.append(
            f"WARNING: for {share:.0%} of the captures, a prediction from the other days is wrong "
            f"by a factor of over {TRUSTED_FACTOR:g}: the room, the camera or the light changed in "
            "a way that the model does not know; hours with similar light are not trusted"
        )
    return texts
