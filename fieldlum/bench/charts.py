"""Charts of the benchmark: speed against accuracy, and stress."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.bench.stress import StressRow
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


def _figure(width: float, height: float, panels: int = 1) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", dpi=150)
    axes = figure.subplots(1, panels)
    for axis in np.atleast_1d(axes):
        axis.grid(True, which="major", color=GRID, linewidth=0.7)
        axis.set_axisbelow(True)
        open_axes(axis)
    return figure, axes


def _colour(name: str) -> str:
    return next((colour for key, colour in COLOURS.items() if name.startswith(key)), "#111827")


def _known(value: float | None) -> bool:
    return value is not None and bool(np.isfinite(value))


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
    figure, axes = _figure(11.0, 4.8, 2)
    for axis, key, label in zip(
        axes,
        ("fit_cpu_s", "predict_cpu_s_per_map"),
        ("training [s of one core]", "one map [s of one core]"),
        strict=True,
    ):
        usable = [row for row in rows if _known(row.get(key)) and _known(row["paper_log10_mse"])]
        points = [(row[key], row["paper_log10_mse"]) for row in usable]
        front = [points[k] for k in pareto(points)]
        if front:
            axis.step(
                *zip(*front, strict=True),
                where="post",
                color="#0b6e99",
                linewidth=1.2,
                alpha=0.6,
                label="Pareto front of the measured",
            )
        for row, point in zip(usable, points, strict=True):
            hollow = ":none" in row["name"]
            axis.plot(
                *point,
                "o",
                markersize=8,
                color=_colour(row["name"]),
                markerfacecolor="white" if hollow else _colour(row["name"]),
            )
            below = row["name"].startswith("dense")  # so that it does not cover the published point
            axis.annotate(
                row["name"],
                point,
                xytext=(-8, -14) if below else (7, 5),
                textcoords="offset points",
                fontsize=8,
            )
        axis.plot(
            PAPER[key],
            PAPER["error"],
            "*",
            linestyle="none",
            markersize=14,
            color="#c2410c",
            markerfacecolor="white",
            label=PAPER_LABEL,
        )
        for row in rows:
            if row["name"].startswith("Radiance") and key == "predict_cpu_s_per_map":
                axis.axvline(
                    row[key],
                    color=COLOURS["Radiance"],
                    linestyle="--",
                    linewidth=1.2,
                    label=f"Radiance, one map, measured: {row[key]:.3g} s",
                )
        axis.set(xscale="log", yscale="log", xlabel=label, ylabel="log10 MSE, paper mode")
        axis.legend(fontsize=7, frameon=False, loc="best")
    figure.suptitle(f"Speed and accuracy on {machine}", fontsize=11)
    figure.savefig(path)


def stress(path: Path, rows: Sequence[StressRow]) -> None:
    """Draw each condition's error over the normal error; blue if the tool itself reported it."""
    figure, axis = _figure(9.0, 0.32 * len(rows) + 1.2)
    for k, row in enumerate(reversed(rows)):
        colour = "#0b6e99" if row.told else "#c2410c"
        axis.plot([1.0, row.times_normal], [k, k], color=colour, linewidth=1.5)
        axis.plot(row.times_normal, k, "o", color=colour, markersize=7)
    axis.axvline(1.0, color="#6b7280", linewidth=1)
    axis.set_yticks(range(len(rows)), [row.regime for row in reversed(rows)], fontsize=8)
    axis.set(
        xscale="log",
        xlabel="error over the normal case (blue: the tool reported it; red: it did not)",
    )
    figure.savefig(path)
