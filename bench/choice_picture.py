"""How `auto` chooses: every candidate's error on each held-out day, and the line that the smallest
one under it wins.

python bench/choice_picture.py TRAIN.csv OUT.png [--height 40] [--budget MIN]
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fieldlum.bench.charts import COLOURS
from fieldlum.models.data import load_pairs
from fieldlum.models.scores import by_day
from fieldlum.statistics import standard_error
from fieldlum.train import fit_and_score

if TYPE_CHECKING:
    from fieldlum.models.data import Dataset
    from fieldlum.train.selection import Trial


def daily(trial: Trial, data: Dataset) -> np.ndarray:
    """Mean error of each held-out day."""
    day_of = dict(zip(data.slots, data.days, strict=True))
    return by_day(
        trial.scores.mse_weighted, np.array([day_of[slot] for slot in trial.scores.slots])
    )[1]


def main() -> None:
    from matplotlib.figure import Figure

    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("train", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--height", type=int, default=40, help="every few pixels are enough to choose by"
    )
    parser.add_argument("--budget", type=float, default=5.0, help="minutes, as of fieldlum train")
    asked = parser.parse_args()
    data = load_pairs(asked.train).thin(asked.height)
    found = fit_and_score(data, "auto", budget_s=60.0 * asked.budget)
    errors = {trial.name: daily(trial, data) for trial in found.trials}
    most = max(len(values) for values in errors.values())
    best = min((v for v in errors.values() if len(v) == most), key=lambda values: values.mean())
    figure = Figure(figsize=(7.2, 3.6), layout="constrained", dpi=130)
    axis = figure.add_subplot()
    for k, (name, values) in enumerate(errors.items()):
        axis.plot(
            np.full(len(values), k), values, "o", color=COLOURS[name], alpha=0.35, markersize=5
        )
        error = np.nan_to_num(standard_error(values))
        axis.errorbar(
            k + 0.18, values.mean(), error, fmt="D", color=COLOURS[name], capsize=4, markersize=6
        )
        said = f"{values.mean():.1e}\n{len(values)} days" + (
            ", chosen" if name == found.choice.name else ""
        )
        axis.annotate(said, (k + 0.26, values.mean()), fontsize=8, va="center")
        print(f"{name}: {values.mean():.3e} +- {error:.1e} over {len(values)} held-out days")
    axis.axhline(best.mean() + standard_error(best), color="#6b7280", linewidth=1, linestyle="--")
    axis.annotate(
        "best + one standard error",
        (-0.45, best.mean() + standard_error(best)),
        fontsize=8,
        va="bottom",
    )
    axis.set_xticks(range(len(errors)), list(errors))
    axis.set(yscale="log", xlim=(-0.5, len(errors) - 0.2), ylabel="log10 MSE, solid-angle weighted")
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(asked.out)
    print(found.choice.reason)


if __name__ == "__main__":
    main()
