"""Learning curve and collection periods on a simulated year (the paper's Figures 18 to 22 and Table
2).

    fieldlum simulate capture_plans/seattle-office.toml --count 4379 --size 92x46 --quality
    draft --out YEAR python bench/year_periods.py YEAR/pairs.csv OUT [--model transport]

Writes periods and learning_curve, each as csv and png, and prints them.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.bench import _colour, machine, markdown, store
from fieldlum.bench.score_rows import ERRORS, Spec, parse_specs
from fieldlum.core.arrays import Mask
from fieldlum.core.plot_style import GRID, open_axes
from fieldlum.core.progress import progress
from fieldlum.learn.models.scores import evaluate, summary, truth
from fieldlum.learn.models.training_data import Dataset, load_pairs
from fieldlum.learn.train import fit_timed, patch_mode
from fieldlum.session.files.model_files import ScoreFigures

CURVE = {
    "name": "model",
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
    "rammg_mse": "RAMMG MSE",
    "worst": "worst",
    "trusted_share": "trusted",
}
COUNTS = (25, 50, 100, 200, 500, 1000)  # captures of the learning curve; chosen
TEST_HOURS = 300  # held-out hours of a year; chosen
MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")
FEWEST_HOURS = 20  # of a collection period; chosen
# Data with this many hours in this many months count as a year; not measured.
YEAR_HOURS = 1000
YEAR_MONTHS = 10


def is_year(data: Dataset) -> bool:
    """Return whether `data` have at least 1 000 hours in at least 10 calendar months."""
    months = data.days.astype("datetime64[M]").astype(int) % 12
    return len(data) >= YEAR_HOURS and len(np.unique(months)) >= YEAR_MONTHS


def learning_curve(
    spec: Spec,
    data: Dataset,
    test: Dataset,
) -> list[dict[str, object]]:
    """Return rows with the error on `test` of models trained on 25, 50 ... captures of `data`."""
    patch, asked = patch_mode(data, spec.patch), truth(test, glare=False)
    counts = curve_counts(len(data))
    order = np.random.default_rng(0).permutation(len(data))
    rows: list[dict[str, object]] = []
    for k, count in enumerate(counts):
        progress(k, len(counts), f"{count} captures")
        fitted, spent = fit_timed(
            spec.name, data.take(np.sort(order[:count])), patch=patch, seed=0, budget_s=None
        )
        scores = summary(evaluate(fitted, asked))
        rows.append(
            {"name": spec.label, "captures": count, "fit_cpu_s": spent.cpu_s} | _figures(scores)
        )
    return rows


def curve_counts(captures: int) -> list[int]:
    """Return the numbers of captures at which a learning curve is computed.

    They are 25, 50, 100, 200, 500 and 1 000 as far as they are below `captures`, and `captures`
    itself if it is at most 1 000.
    """
    counts = [n for n in COUNTS if n < captures]
    return counts + [captures] * (captures <= COUNTS[-1])


def _figures(scores: ScoreFigures) -> dict[str, object]:
    return {key: scores[key] for key in (*ERRORS, "worst", "n_test", "trusted_share")}


# ----------------------------------------------------------------------------------------------
# periods


def _dates(data: Dataset) -> list[date]:
    return [day.astype(object) for day in data.days]


def _around(data: Dataset, events: Sequence[tuple[int, int]], days: int) -> Mask:
    """Return a mask of hours within `days` days of a (month, day) of any year."""
    inside = np.zeros(len(data), bool)
    for k, day in enumerate(_dates(data)):
        inside[k] = any(abs((day - date(day.year, month, d)).days) <= days for month, d in events)
    return inside


def periods(data: Dataset) -> dict[str, Mask]:
    """Return the collection periods of Liu et al. (2020) with 20 or more hours: masks [n] by name.

    They are months; one and two weeks in March; 9, 12 and 4 days at equinoxes and solstices.
    """
    march, june, september, december = (3, 20), (6, 21), (9, 22), (12, 21)
    months = np.array([day.month for day in _dates(data)])
    named: dict[str, Mask] = {name: months == k for k, name in enumerate(MONTHS, start=1)}
    named["1 week"] = _around(data, [march], 3)
    named["2 weeks"] = _around(data, [march], 6)
    named["9 days"] = _around(data, [march, june, december], 1)
    named["12 days"] = _around(data, [march, june, september, december], 1)
    named["4 days"] = _around(data, [march, june, september, december], 0)
    return {name: rows for name, rows in named.items() if rows.sum() >= FEWEST_HOURS}


def compare_periods(spec: Spec, data: Dataset) -> list[dict[str, object]]:
    """Train on each collection period of `periods`; return a row of errors for each period.

    All periods are tested on the same hours: a random quarter of `data`, at most 300, which no
    period trains on.
    """
    order = np.random.default_rng(0).permutation(len(data))
    in_test = np.zeros(len(data), bool)
    in_test[order[: min(TEST_HOURS, len(data) // 4)]] = True
    asked = truth(data.take(in_test))
    patch = patch_mode(data, spec.patch)
    rows: list[dict[str, object]] = []
    chosen = periods(data)
    for k, (name, inside) in enumerate(chosen.items()):
        progress(k, len(chosen), name)
        train = data.take(inside & ~in_test)
        fitted, spent = fit_timed(spec.name, train, patch=patch, seed=0, budget_s=None)
        scores = summary(evaluate(fitted, asked))
        rows.append(
            {
                "period": name,
                "name": spec.label,
                "captures": len(train),
                "fit_cpu_s": spent.cpu_s,
            }
            | _figures(scores)
        )
    return rows


# ----------------------------------------------------------------------------------------------
# charts


def _figure(width: float, height: float) -> tuple[Any, Any]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", dpi=150)
    axis = figure.subplots()
    axis.grid(True, which="major", color=GRID, linewidth=0.7)
    axis.set_axisbelow(True)
    open_axes(axis)
    return figure, axis


def learning_curves(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw the error over the number of captures, for each model."""
    figure, axis = _figure(6.5, 4.5)
    for name in dict.fromkeys(row["name"] for row in rows):
        mine = [row for row in rows if row["name"] == name]
        axis.plot(
            [r["captures"] for r in mine],
            [r["log10_mse_weighted"] for r in mine],
            "o-",
            color=_colour(name),
            markersize=5,
            label=name,
        )
    axis.set(
        xscale="log", yscale="log", xlabel="captures", ylabel="log10 MSE, solid-angle weighted"
    )
    axis.legend(fontsize=8, frameon=False)
    figure.savefig(path)


def collection_periods(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Draw the error of each collection period (as Figures 18 to 22 of Liu et al. 2020)."""
    figure, axis = _figure(9.0, 4.2)
    names = list(dict.fromkeys(row["period"] for row in rows))
    models = list(dict.fromkeys(row["name"] for row in rows))
    for k, model in enumerate(models):
        values = {row["period"]: row["log10_mse_weighted"] for row in rows if row["name"] == model}
        place = np.arange(len(names)) + (k - (len(models) - 1) / 2) * 0.8 / len(models)
        axis.bar(
            place,
            [values.get(n, np.nan) for n in names],
            0.8 / len(models),
            color=_colour(model),
            label=model,
        )
    axis.set_xticks(range(len(names)), names, rotation=45, ha="right")
    axis.set(yscale="log", ylabel="log10 MSE over the year")
    axis.legend(fontsize=8, frameon=False)
    figure.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pairs", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--model", default="transport")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    data = load_pairs(asked.pairs)
    (spec,) = parse_specs([asked.model])
    print(f"{len(data)} hours of {data.shape[1]}x{data.shape[0]}, {machine()}", flush=True)
    rows = compare_periods(spec, data)
    store(asked.out, "periods", rows, partial(collection_periods, rows=rows))
    print(markdown(rows, PERIODS), flush=True)
    order = np.random.default_rng(0).permutation(len(data))
    test, pool = (
        data.take(np.sort(order[:TEST_HOURS])),
        data.take(np.sort(order[TEST_HOURS:])),
    )
    rows = learning_curve(spec, pool, test)
    store(asked.out, "learning_curve", rows, partial(learning_curves, rows=rows))
    print(markdown(rows, CURVE), flush=True)


if __name__ == "__main__":
    main()
