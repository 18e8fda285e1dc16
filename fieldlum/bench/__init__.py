"""Benchmark models on any pairs: speed, accuracy, disturbances."""

import os
import platform
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.bench import stress
from fieldlum.bench.score_rows import BenchData, radiance_row, score_row
from fieldlum.core.plot_style import GRID, new_figure, open_axes
from fieldlum.core.records import JsonTable
from fieldlum.learn.models.scores import truth
from fieldlum.learn.train import Trial, choose_model, day_folds
from fieldlum.session import codec, replacing_path, write_file


def machine() -> str:
    """Return the computer's number of cores and its architecture, such as "2 cores, x86_64"."""
    return f"{os.cpu_count()} cores, {platform.machine()}"


# ----------------------------------------------------------------------------------------------
# writing


def shown(value: object) -> str:
    """Return a value as text for a table: floats with three digits, yes or no, "-" for None.

    Floats outside 1e-3 to 1e5 have an exponent.
    """
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
    """Write rows to NAME.csv in the folder `out`, and a chart to NAME.png.

    rows: with the same keys; draw: called with the path of the chart, which it writes.
    """
    codec.write_csv(out / f"{name}.csv", rows)
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
) -> JsonTable:
    """Score all models, write tables and a chart into `out`; return what `bench --json` prints.

    loaded: the pairs and the models. with_stress: also test conditions in which methods fail, with
    one model (the first transport model, else the first). budget_min: minutes of training for the
    dense network; render_hours: number of hours for which Radiance is timed. Keys: models: rows of
    `score_row` and `radiance_row`; chosen, reason: label of the model that `choose_model` chose,
    and why. Files: bench.md, scores.csv and scores.png; with stress stress.csv too. Raises the
    errors of `score_row`.
    """
    data, test = loaded.data, loaded.test
    rows: list[Mapping[str, object]] = []
    trials: dict[str, Trial] = {}
    true_maps = None if test is None else truth(test)
    for spec in loaded.specs:
        row, trial = score_row(spec, data, true_maps, budget_s=60.0 * budget_min)
        rows.append(row)
        trials.setdefault(trial.name, trial)
    chosen = choose_model(list(trials.values()))
    rendering = radiance_row(data if test is None else test, render_hours)
    rows += [] if rendering is None else [rendering]
    store(out, "scores", rows, lambda path: speed_accuracy(path, rows))
    parts = [f"## Scores\n\n{markdown(rows)}\nChosen: {chosen.name}. {chosen.reason}.\n"]
    if with_stress:
        stress_rows = _stress(loaded)
        codec.write_csv(out / "stress.csv", stress_rows)
        parts.append(f"## Stress\n\n{markdown(stress_rows)}")
    hours = f"{len(test)} hours of {test.source}" if test else "held-out days"
    head = f"# Benchmark of {data.source}\n\nMachine: {machine()}. {len(data)} captures"
    write_file(out / "bench.md", f"{head}; test: {hours}.\n\n" + "\n".join(parts))
    return {"models": rows, "chosen": chosen.name, "reason": chosen.reason}


def _stress(loaded: BenchData) -> list[JsonTable]:
    """Return rows of the stress tests of one model: the first transport model, else the first.

    Without test hours the first fold of held-out days is tested.
    """
    specs, data, test = loaded.specs, loaded.data, loaded.test
    spec = next((spec for spec in specs if spec.name == "transport"), specs[0])
    if test is None:
        held = day_folds(data)[0]
        data, test = data.take(~held), data.take(held)
    return stress.run(spec, data, test)


# ----------------------------------------------------------------------------------------------
# chart

# Liu et al. 2020, Table 1 and section 5: training 30 min, 0.1 s for a map, log10 MSE 9.54e-3.
PAPER_LABEL = "published: dense, even 200, own rendering, GTX 1080 Ti"
PAPER = {"fit_cpu_s": 1800.0, "predict_cpu_s_per_map": 0.1, "error": 9.54e-3}
COLOURS = {"mean": "#9aa0a6", "nearest": "#6b7280", "transport": "#0b6e99"}
COLOURS |= {"dense": "#c2410c", "Radiance": "#4d7c0f"}


def _colour(name: str) -> str:
    """Return the colour of a model by the beginning of its name."""
    return next((colour for key, colour in COLOURS.items() if name.startswith(key)), "#111827")


def pareto(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points (x, y) on the Pareto front, by rising x and falling y.

    A point is on it if no other point has a smaller or equal x and y; of equal points, the first.
    """
    order = sorted(range(len(points)), key=lambda k: points[k])
    lowest = np.minimum.accumulate([np.inf, *(points[k][1] for k in order)])
    return [k for k, low in zip(order, lowest, strict=False) if points[k][1] < low]


def speed_accuracy(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw each model's `paper_log10_mse` over its CPU seconds of training and of one map.

    path: of the picture to write; rows: results of `score_row` and `radiance_row`. Rows without a
    number for an axis are not drawn.
    """
    figure = new_figure(11.0, 4.8, dpi=150)
    labels = {"fit_cpu_s": "training", "predict_cpu_s_per_map": "one map"}
    for axis, (key, label) in zip(figure.subplots(1, 2), labels.items(), strict=True):
        axis.grid(True, which="major", color=GRID, linewidth=0.7)
        axis.set_axisbelow(True)
        open_axes(axis)
        _points(axis, [row for row in rows if _is_finite(row, key, "paper_log10_mse")], key)
        star = {"marker": "*", "linestyle": "none", "markersize": 14, "color": COLOURS["dense"]}
        axis.plot(PAPER[key], PAPER["error"], markerfacecolor="white", label=PAPER_LABEL, **star)
        for row in rows:
            if row["name"].startswith("Radiance") and _is_finite(row, key):
                text = f"Radiance, measured: {row[key]:.3g} s"
                axis.axvline(row[key], color=COLOURS["Radiance"], linestyle="--", label=text)
        axis.set(xscale="log", yscale="log", xlabel=f"{label} [s of one core]")
        axis.set_ylabel("log10 MSE, paper mode")
        axis.legend(fontsize=7, frameon=False, loc="best")
    figure.suptitle(f"Speed and accuracy on {machine()}", fontsize=11)
    figure.savefig(path)


def _is_finite(row: Mapping[str, Any], *keys: str) -> bool:
    """Return whether a row has a finite number under each of the keys."""
    return all(row.get(key) is not None and np.isfinite(row[key]) for key in keys)


def _points(axis: Any, rows: Sequence[Mapping[str, Any]], key: str) -> None:
    """Draw the models and their Pareto front; models without sun patches are hollow.

    rows: of the score table; key: column of the x axis, such as fit_cpu_s [s]. The y axis is
    paper_log10_mse.
    """
    points = [(row[key], row["paper_log10_mse"]) for row in rows]
    if front := [points[k] for k in pareto(points)]:
        label = "Pareto front of the measured"
        x, y = zip(*front, strict=True)
        axis.step(x, y, where="post", color="#0b6e99", alpha=0.6, label=label)
    for row, point in zip(rows, points, strict=True):
        name, colour = row["name"], _colour(row["name"])
        face_colour = "white" if ":none" in name else colour
        axis.plot(*point, "o", markersize=8, color=colour, markerfacecolor=face_colour)
        # below the dense network's point, so that it does not cover the published one
        offset_pt = (-8, -14) if name.startswith("dense") else (7, 5)
        axis.annotate(name, point, xytext=offset_pt, textcoords="offset points", fontsize=8)
