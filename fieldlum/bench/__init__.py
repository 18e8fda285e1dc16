"""Benchmark models on any pairs: speed, accuracy, captures, choice of days, disturbances."""

from __future__ import annotations

import csv
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, TypedDict

from fieldlum.bench import charts
from fieldlum.bench.pieces import BenchData, BenchFiles, local_unit_of, pieces_of, unit_of
from fieldlum.bench.rows import over_seeds
from fieldlum.core.records import Progress, quiet
from fieldlum.core.scheduler import LOCAL, Scheduler, run_each
from fieldlum.learn.model_registry import MODELS
from fieldlum.learn.train.selection import Trial, choose_model
from fieldlum.session import replacing, replacing_path

TABLE = {
    "name": "model",
    "judged_dgp_error": "DGP error*",
    "judged_ev_error": "ln Ev error*",
    "judged_log10_mse": "log10 MSE*",
    "n_judged": "hours*",
    "log10_mse_weighted": "log10 MSE",
    "log10_mse_weighted_sd": "sd",
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
    "seeds": "seeds",
    "fit_s": "fit [s]",
    "fit_cpu_s": "fit [CPU s]",
    "predict_s_per_map": "map [s]",
    "predict_cpu_s_per_map": "map [CPU s]",
    "expected_log10_mse": "expected log10 MSE",
    "trusted_share": "trusted",
    "in_90_band": "in 90 %",
    "worst_decile_found": "worst tenth found",
}
CURVE = {
    "name": "model",
    "way": "chosen",
    "captures": "captures",
    "log10_mse_weighted": "log10 MSE",
    "rer_weighted": "RER",
    "worst": "worst",
    "fit_cpu_s": "fit [CPU s]",
}
PERIODS = {
    "period": "period",
    "name": "model",
    "captures": "captures",
    "log10_mse_weighted": "log10 MSE",
    "paper_log10_mse": "paper log10 MSE",
    "paper_rer": "paper RER",
    "dgp_mse_own_disc": "DGP MSE, own disc",
    "dgp_mse": "DGP MSE, true disc",
    "dgp_r2": "DGP R2, true disc",
    "rammg_mse": "RAMMG MSE",
    "worst": "worst",
    "untrusted_share": "not trusted",
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

# seconds; a learning curve of 1000 captures may take this long; not measured
_SHORTEST_LIMIT_S = 7200.0
# multiple of the budget that a unit may take to read, train and predict; not measured
_BUDGETS = 4.0


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


def patient(scheduler: Scheduler, budget_min: float) -> Scheduler:
    """Return the scheduler with a time limit per unit that even a dense training never reaches.

    A limit that the scheduler has already stays; otherwise it is two hours plus four times the
    budget.
    """
    limit_s = scheduler.unit_limit_s or _SHORTEST_LIMIT_S + _BUDGETS * 60.0 * budget_min
    return replace(scheduler, unit_limit_s=limit_s)


def run(
    loaded: BenchData,
    models: Sequence[str] = tuple(MODELS),
    *,
    seeds: int = 1,
    budget_min: float = 5.0,
    with_curve: bool = False,
    with_stress: bool = False,
    render_hours: int = 1,
    out: Path,
    scheduler: Scheduler = LOCAL,
    files: BenchFiles | None = None,
    progress: Progress = quiet,
) -> BenchAnswer:
    """Run all pieces of a benchmark, write tables and charts into `out`, and return the scores.

    Files: bench.md, scores and, with a year of data, collection periods; the learning curve with
    `with_curve`, stress tests with `with_stress`. loaded: hours to train on, hours to test on (by
    default held-out days), and hours from which seasons are drawn. files: where other processes
    read these hours; needed for a scheduler other than this process. render_hours: hours for which
    Radiance is timed.
    """
    pieces = pieces_of(
        loaded,
        models,
        seeds=seeds,
        budget_s=60.0 * budget_min,
        with_curve=with_curve,
        with_stress=with_stress,
        render_hours=render_hours,
    )
    if scheduler.kind == "local" or files is None:
        units, scheduler = [local_unit_of(piece, loaded, progress) for piece in pieces], LOCAL
    else:
        units = [unit_of(piece, files) for piece in pieces]
        scheduler = patient(scheduler, budget_min)
    answers: dict[str, Any] = {}
    run_each(units, scheduler, lambda o: answers.update({o.unit.name: o.result()}), progress)

    def of(*kinds: str) -> list[Any]:
        return [answers[piece.name] for piece in pieces if piece.kind in kinds]

    rows = [row for row, _ in of("score")]
    trials: dict[str, Trial] = {}
    for _, trial in of("score"):
        trials.setdefault(trial.name, trial)
    chosen = choose_model(list(trials.values()))
    table = [*over_seeds(rows), *of("rendering")]
    rows += of("rendering")
    store(out, "scores", table, lambda path: charts.speed_accuracy(path, table, machine()))
    write_csv(out / "scores_by_seed.csv", rows)
    parts = [f"## Scores\n\n{markdown(table, TABLE)}\nChosen: {chosen.name}. {chosen.reason}.\n"]
    curve = list(chain(*of("random", "greedy")))
    if curve:
        store(out, "learning_curve", curve, partial(charts.learning_curves, rows=curve))
        parts.append(f"## Captures\n\n{markdown(curve, CURVE)}")
    periods = list(chain(*of("periods")))
    if periods:
        store(out, "periods", periods, partial(charts.collection_periods, rows=periods))
        parts.append(f"## Collection periods\n\n{markdown(periods, PERIODS)}")
    for regimes in of("stress"):
        cells = [asdict(regime) for regime in regimes]
        store(out, "stress", cells, partial(charts.stress, rows=regimes))
        parts.append(f"## Stress\n\n{markdown(cells, STRESS)}")
    data, test = loaded.data, loaded.test
    head = f"# Benchmark of {data.source}\n\nMachine: {machine()}. {len(data)} captures"
    head += (
        f"; test {len(test)} hours of {test.source}.\n\n" if test else "; test: held-out days.\n\n"
    )
    with replacing(out / "bench.md", "w", encoding="utf-8") as file:
        file.write(head + "\n".join(parts))
    return {"models": rows, "chosen": chosen.name, "reason": chosen.reason}
