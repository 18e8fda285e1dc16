"""Benchmarks of any pairs.csv: speed, accuracy, count of captures, choice of days, disturbances."""

from __future__ import annotations

import csv
import os
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fieldlum.model_registry import MODELS
from fieldlum.records import Progress, quiet
from fieldlum.session import replacing, replacing_path

if TYPE_CHECKING:
    from fieldlum.models.data import Dataset

TABLE = {
    "name": "model",
    "log10_mse_weighted": "log10 MSE",
    "log10_mse_weighted_sd": "sd",
    "rer_weighted": "RER",
    "median": "median",
    "p90": "p90",
    "worst": "worst",
    "paper_log10_mse": "paper log10 MSE",
    "paper_rer": "paper RER",
    "dgp_mse_own_disc": "DGP MSE, disc of the room",
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
    "dgp_mse_own_disc": "DGP MSE, disc of the room",
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


def machine() -> str:
    """Return the machine's cores and architecture, as tables state them."""
    return f"{os.cpu_count()} cores, {platform.machine()}"


# ----------------------------------------------------------------------------------------------
# writing


def shown(value: object) -> str:
    """Return a value as a cell of a Markdown table."""
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
    """Return a Markdown table of the columns that have a value in some row."""
    used = [key for key in columns if any(row.get(key) is not None for row in rows)]
    lines = ["| " + " | ".join(columns[key] for key in used) + " |", "|" + "---|" * len(used)]
    lines += ["| " + " | ".join(shown(row.get(key)) for key in used) + " |" for row in rows]
    return "\n".join(lines) + "\n"


def _write_csv(path: Path, rows: Sequence[Mapping[str, object]]) -> None:
    names = list(dict.fromkeys(key for row in rows for key in row))
    with replacing(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=names)
        writer.writeheader()
        writer.writerows(rows)


def store(
    out: Path, name: str, rows: Sequence[Mapping[str, object]], draw: Callable[[Path], None]
) -> None:
    """Write NAME.csv, and NAME.png by `draw`."""
    _write_csv(out / f"{name}.csv", rows)
    with replacing_path(out / f"{name}.png") as path:
        draw(path)


# ----------------------------------------------------------------------------------------------
# run


def run(
    data: Dataset,
    *,
    test: Dataset | None = None,
    pool: Dataset | None = None,
    models: Sequence[str] = tuple(MODELS),
    seeds: int = 1,
    budget_min: float = 5.0,
    with_stress: bool = False,
    render_hours: int = 1,
    out: Path,
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Write score table, chart, learning curves, collection periods and stress tests into `out`.

    Collection periods need a year of data. test : hours to predict, by default held-out days of
    `data`; hours that any model was trained on are never used. pool : all available hours, from
    which seasons are drawn.
    """
    from fieldlum.bench import charts, stress
    from fieldlum.bench.cost import radiance_row
    from fieldlum.bench.rows import over_seeds, parse_specs, score_table, without_training_hours
    from fieldlum.train.selection import choose

    specs = parse_specs(models)
    if test is not None:
        test = without_training_hours(
            test, data, *(spec.folder for spec in specs if spec.folder is not None)
        )
    rows, trials = score_table(
        specs, data, test, seeds=seeds, budget_s=60.0 * budget_min, progress=progress
    )
    asked = data if test is None else test
    chosen = choose(list(trials.values()), asked)
    table = over_seeds(rows)
    rendering = radiance_row(asked, render_hours, progress=progress)
    if rendering:
        table.append(rendering)
        rows.append(rendering)
    store(out, "scores", table, lambda path: charts.speed_accuracy(path, table, machine()))
    _write_csv(out / "scores_by_seed.csv", rows)
    parts = [f"## Scores\n\n{markdown(table, TABLE)}\nChosen: {chosen.name}. {chosen.reason}.\n"]
    parts += _curves(data, test, specs, out, progress)
    if with_stress:
        spec = next((s for s in specs if s.name == "transport"), specs[0])
        teach, check = (data, test) if test is not None else _split(data)
        regimes = stress.run(
            spec, teach, check, _without_test(pool, data, check), progress=progress
        )
        cells = [asdict(regime) for regime in regimes]
        store(out, "stress", cells, lambda path: charts.stress(path, regimes))
        parts.append(f"## Stress\n\n{markdown(cells, STRESS)}")
    head = f"# Benchmark of {data.source}\n\nMachine: {machine()}. {len(data)} captures"
    head += (
        f"; test {len(test)} hours of {test.source}.\n\n" if test else "; test: held-out days.\n\n"
    )
    with replacing(out / "bench.md", "w", encoding="utf-8") as file:
        file.write(head + "\n".join(parts))
    return {"models": rows, "chosen": chosen.name, "reason": chosen.reason}


def _split(data: Dataset) -> tuple[Dataset, Dataset]:
    """Return training data and held-out days, a fifth of all (hours, if there is only one day)."""
    from fieldlum.errors import NotEnoughDataError
    from fieldlum.train.folds import day_folds

    folds = day_folds(data)
    if not folds:
        raise NotEnoughDataError(
            f"{data.source}: {len(data)} usable hour; expected at least 2, to train and to test"
        )
    return data.take(folds[0].teach), data.take(folds[0].check)


def _without_test(pool: Dataset | None, data: Dataset, test: Dataset) -> Dataset:
    """Return all available hours except those of the test."""
    import numpy as np

    everything, asked = data if pool is None else pool, set(test.slots)
    return everything.take(np.array([slot not in asked for slot in everything.slots]))


def _curves(
    data: Dataset, test: Dataset | None, specs: Sequence[Any], out: Path, progress: Progress
) -> list[str]:
    """Return learning curve and collection periods of the quick models, as Markdown."""
    import numpy as np

    from fieldlum.bench import charts, year

    quick = [spec for spec in specs if spec.name == "transport" and spec.folder is None]
    parts: list[str] = []
    if not quick:
        return parts
    if test is None and year.is_year(data):
        order = np.random.default_rng(0).permutation(len(data))
        held = data.take(np.sort(order[: year.TEST_HOURS]))
        pool = data.take(np.sort(order[year.TEST_HOURS :]))
    else:
        held, pool = test, data
    if held is not None and len(pool) >= 2 * year.COUNTS[0]:
        rows = [
            row
            for spec in quick
            for row in year.learning_curve(spec, pool, held, progress=progress)
        ]
        store(out, "learning_curve", rows, partial(charts.learning_curves, rows=rows))
        parts.append(f"## Captures\n\n{markdown(rows, CURVE)}")
    if year.is_year(data):
        rows = [
            row for spec in quick for row in year.compare_periods(spec, data, progress=progress)
        ]
        store(out, "periods", rows, partial(charts.collection_periods, rows=rows))
        parts.append(f"## Collection periods\n\n{markdown(rows, PERIODS)}")
    return parts
