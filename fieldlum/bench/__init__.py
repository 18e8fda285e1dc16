"""Benchmark models on any pairs: speed, accuracy, disturbances."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from fieldlum.bench import charts, stress
from fieldlum.bench.rows import BenchData, radiance_row, score_row
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import JsonTable, Progress, counted, quiet
from fieldlum.learn.model_registry import MODELS
from fieldlum.learn.models.scores import truth
from fieldlum.learn.train.trials import Trial, choose_model, day_folds
from fieldlum.session import replacing, replacing_path
from fieldlum.session.codec import write_csv


def machine() -> str:
    """Return the computer's cores and architecture, as text for tables."""
    return f"{os.cpu_count()} cores, {platform.machine()}"


# ----------------------------------------------------------------------------------------------
# writing


def shown(value: object) -> str:
    """Return a value as text for a table: "-" for None, yes or no, floats with three digits."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        is_usual = value != value or 1e-3 <= abs(value) < 1e5 or value == 0
        return f"{value:.3g}" if is_usual else f"{value:.2e}"
    return "-" if value is None else str(value)


def markdown(rows: Sequence[Mapping[str, object]], columns: Mapping[str, str] | None = None) -> str:
    """Return rows as a Markdown table; columns without a value in any row are omitted.

    columns: heading of each key, in the order of the table; None: the keys themselves.
    """
    heads = columns or {key: key.replace("_", " ") for row in rows for key in row}
    used = [key for key in heads if any(row.get(key) is not None for row in rows)]
    lines = ["| " + " | ".join(heads[key] for key in used) + " |", "|" + "---|" * len(used)]
    lines += ["| " + " | ".join(shown(row.get(key)) for key in used) + " |" for row in rows]
    return "\n".join(lines) + "\n"


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
) -> JsonTable:
    """Score all models, write tables and a chart into `out`; return what `bench --json` prints.

    Files: bench.md and scores; with `with_stress` stress.csv too. budget_min: minutes of training
    for the dense network; render_hours: hours for which Radiance is timed.
    """
    data, test = loaded.data, loaded.test
    rows: list[Mapping[str, object]] = []
    trials: dict[str, Trial] = {}
    measured = None if test is None else truth(test)
    for spec in loaded.specs:
        row, trial = score_row(spec, data, measured, budget_s=60.0 * budget_min, progress=progress)
        rows.append(row)
        trials.setdefault(trial.name, trial)
    chosen = choose_model(list(trials.values()))
    rendering = radiance_row(data if test is None else test, render_hours, progress=progress)
    rows += [] if rendering is None else [rendering]
    store(out, "scores", rows, lambda path: charts.speed_accuracy(path, rows, machine()))
    parts = [f"## Scores\n\n{markdown(rows)}\nChosen: {chosen.name}. {chosen.reason}.\n"]
    if with_stress and loaded.specs:
        cells = _stress(loaded, progress)
        write_csv(out / "stress.csv", cells)
        parts.append(f"## Stress\n\n{markdown(cells)}")
    hours = f"{len(test)} hours of {test.source}" if test else "held-out days"
    head = f"# Benchmark of {data.source}\n\nMachine: {machine()}. {len(data)} captures"
    with replacing(out / "bench.md", "w", encoding="utf-8") as file:
        file.write(f"{head}; test: {hours}.\n\n" + "\n".join(parts))
    return {"models": rows, "chosen": chosen.name, "reason": chosen.reason}


def _stress(loaded: BenchData, progress: Progress) -> list[JsonTable]:
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
    return stress.run(spec, data, test, progress=progress)
