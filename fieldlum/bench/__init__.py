"""Benchmark models on any pairs: speed, accuracy, disturbances."""

from __future__ import annotations

import csv
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TypedDict

import numpy as np

from fieldlum.bench import charts, stress
from fieldlum.bench.cost import radiance_row
from fieldlum.bench.rows import BenchData, score_row
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Progress, counted, quiet
from fieldlum.learn.model_registry import MODELS
from fieldlum.learn.models.scores import truth
from fieldlum.learn.train.trials import Trial, choose_model, day_folds
from fieldlum.session import replacing, replacing_path

TABLE = {
    "name": "model",
    "judged_dgp_error": "DGP error*",
    "judged_ev_error": "ln Ev error*",
    "judged_log10_mse": "log10 MSE*",
    "n_judged": "hours*",
    "log10_mse_weighted": "log10 MSE",
    "rer_weighted": "RER",
    "median": "median",
    "p90": "p90",
    "worst": "worst",
    "paper_log10_mse": "paper log10 MSE",
    "paper_rer": "paper RER",
    "dgp_mse_own_disc": "DGP MSE, own disc",
    "dgp_mse": "DGP MSE, true disc",
    "dgp_r2": "DGP R2, true disc",
    "bias_log10": "bias log10",
    "rammg_mse": "RAMMG MSE",
    "rammg_mse_cut": "RAMMG MSE < 500",
    "n_train": "train",
    "n_test": "test",
    "fit_s": "fit [s]",
    "fit_cpu_s": "fit [CPU s]",
    "predict_s_per_map": "map [s]",
    "predict_cpu_s_per_map": "map [CPU s]",
    "expected_log10_mse": "expected log10 MSE",
    "trusted_share": "trusted",
    "in_90_band": "in 90 %",
    "worst_decile_found": "worst tenth found",
}
STRESS = {
    "regime": "regime",
    "name": "model",
    "n_train": "train",
    "n_test": "test",
    "log10_mse_weighted": "log10 MSE",
    "times_normal": "x normal",
    "expected_mse": "expected",
    "untrusted_share": "not trusted",
    "warned": "warned",
    "told": "reported",
    "wild": "gross errors",
    "wild_unflagged": "gross errors unflagged",
}


class BenchAnswer(TypedDict):
    """The object that `bench --json` prints: rows by model and seed, the chosen model and why."""

    models: list[Mapping[str, object]]
    chosen: str
    reason: str


def machine() -> str:
    """Return the computer's cores and architecture, as text for tables."""
    return f"{os.cpu_count()} cores, {platform.machine()}"


# ----------------------------------------------------------------------------------------------
# writing


def shown(value: object) -> str:
    """Return a value as text for a table: "-" for None, yes or no, floats with three digits."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return (
            f"{value:.3g}"
            if value != value or 1e-3 <= abs(value) < 1e5 or value == 0
            else f"{value:.2e}"
        )
    return str(value)


def markdown(rows: Sequence[Mapping[str, object]], columns: dict[str, str]) -> str:
    """Return rows as a Markdown table; columns without a value in any row are omitted.

    columns: heading of each key, in the order of the table.
    """
    used = [key for key in columns if any(row.get(key) is not None for row in rows)]
    lines = ["| " + " | ".join(columns[key] for key in used) + " |", "|" + "---|" * len(used)]
    lines += ["| " + " | ".join(shown(row.get(key)) for key in used) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    """Write rows to a csv, with every key that occurs in any row as a column."""
    names = list(dict.fromkeys(key for row in rows for key in row))
    with replacing(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=names)
        writer.writeheader()
        writer.writerows(rows)


def store(
    out: Path, name: str, rows: Sequence[Mapping[str, object]], draw: Callable[[Path], None]
) -> None:
    """Write rows to out/NAME.csv, and the chart that `draw(path)` writes to out/NAME.png."""
    write_csv(out / f"{name}.csv", rows)
    with replacing_path(out / f"{name}.png") as path:
        draw(path)


# ----------------------------------------------------------------------------------------------
# run


def run(
    loaded: BenchData,
    *,
    budget_min: float = 5.0,
    with_stress: bool = False,
    render_hours: int = 1,
    out: Path,
    progress: Progress = quiet,
) -> BenchAnswer:
    """Score all models, write tables and charts into `out`, and return the scores.

    Files: bench.md and scores; with `with_stress` stress tests. budget_min: minutes of training for
    the dense network; render_hours: hours for which Radiance is timed.
    """
    data, test = loaded.data, loaded.test
    rows: list[Mapping[str, object]] = []
    trials: dict[str, Trial] = {}
    asked = None if test is None else truth(test)
    for spec in loaded.specs:
        row, trial = score_row(spec, data, asked, budget_s=60.0 * budget_min, progress=progress)
        rows.append(row)
        trials.setdefault(trial.name, trial)
    chosen = choose_model(list(trials.values()))
    rendering = radiance_row(data if test is None else test, render_hours, progress=progress)
    rows += [] if rendering is None else [rendering]
    store(out, "scores", rows, lambda path: charts.speed_accuracy(path, rows, machine()))
    parts = [f"## Scores\n\n{markdown(rows, TABLE)}\nChosen: {chosen.name}. {chosen.reason}.\n"]
    if with_stress and loaded.specs:
        regimes = _stress(loaded, progress)
        cells = [asdict(regime) for regime in regimes]
        store(out, "stress", cells, partial(charts.stress, rows=regimes))
        parts.append(f"## Stress\n\n{markdown(cells, STRESS)}")
    hours = f"{len(test)} hours of {test.source}" if test else "held-out days"
    head = f"# Benchmark of {data.source}\n\nMachine: {machine()}. {len(data)} captures"
    with replacing(out / "bench.md", "w", encoding="utf-8") as file:
        file.write(f"{head}; test: {hours}.\n\n" + "\n".join(parts))
    return {"models": rows, "chosen": chosen.name, "reason": chosen.reason}


def _stress(loaded: BenchData, progress: Progress) -> list[stress.StressRow]:
    """Run the stress tests of the first transport model, else of the first model."""
    specs, data, test = loaded.specs, loaded.data, loaded.test
    spec = next((spec for spec in specs if spec.name == "transport"), specs[0])
    if test is None:
        folds = day_folds(data)
        if not folds:
            raise NotEnoughDataError(
                f"{data.source}: {counted(len(data), 'usable hour')}; expected at least 2, to "
                "train and to test; capture more hours"
            )
        data, test = data.take(folds[0].teach), data.take(folds[0].check)
    pool = loaded.pool or loaded.data
    is_asked = np.isin(np.array(pool.slots), np.array(test.slots))
    return stress.run(spec, data, test, pool.take(~is_asked), progress=progress)
