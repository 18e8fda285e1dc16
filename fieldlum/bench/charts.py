"""The chart of the benchmark: speed against accuracy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.plot_style import GRID, open_axes

# Liu et al. 2020, Table 1 and section 5: training 30 min, 0.1 s for a map, log10 MSE 9.54e-3.
PAPER_LABEL = "published: dense, even 200, own rendering, GTX 1080 Ti"
PAPER = {"fit_cpu_s": 1800.0, "predict_cpu_s_per_map": 0.1, "error": 9.54e-3}
COLOURS = {
    "mean": "#9aa0a6",
    "nearest": "#6b7280",
    "transport": "#0b6e99",
    "dense": "#c2410c",
    "Radiance": "#4d7c0f",
}


def _colour(name: str) -> str:
    return next((colour for key, colour in COLOURS.items() if name.startswith(key)), "#111827")


def pareto(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of the points (x, y) on the Pareto front, by rising x and falling y."""
    order = sorted(range(len(points)), key=lambda k: points[k])
    front: list[int] = []
    for k in order:
        if not front or points[k][1] < points[front[-1]][1]:
            front.append(k)
    return front


def speed_accuracy(path: Path, rows: Sequence[Mapping[str, Any]], machine: str) -> None:
    """Draw each model's log10 MSE (paper mode) over its CPU seconds of training and of one map."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11.0, 4.8), layout="constrained", dpi=150)
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
    figure.suptitle(f"Speed and accuracy on {machine}", fontsize=11)
    figure.savefig(path)


def _is_finite(row: Mapping[str, Any], *keys: str) -> bool:
    return all(row.get(key) is not None and np.isfinite(row[key]) for key in keys)


def _points(axis: Any, rows: Sequence[Mapping[str, Any]], key: str) -> None:
    """Draw the models and their Pareto front; models without sun patches are hollow."""
    points = [(row[key], row["paper_log10_mse"]) for row in rows]
    if front := [points[k] for k in pareto(points)]:
        label = "Pareto front of the measured"
        axis.step(*zip(*front, strict=True), where="post", color="#0b6e99", alpha=0.6, label=label)
    for row, point in zip(rows, points, strict=True):
        name, colour = row["name"], _colour(row["name"])
        face = "white" if ":none" in name else colour
        axis.plot(*point, "o", markersize=8, color=colour, markerfacecolor=face)
        # below the dense network's point, so that it does not cover the published one
        place = (-8, -14) if name.startswith("dense") else (7, 5)
        axis.annotate(name, point, xytext=place, textcoords="offset points", fontsize=8)
