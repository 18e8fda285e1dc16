"""Table 1 and Figure 8 of the paper, rerun at a size that two cores allow.

    python bench/dense_ablations.py TRAIN.csv TEST.csv OUT [--height 23] [--steps 6000]
    [--figure-steps 1600]

Within the table, and within the figure, every network makes the same number of updates and is asked
about the same test hours. Writes table1.csv, figure8.csv, ablations.md and figure8.png; rows that
OUT already holds at this size are not made again. The paper's order of rows: final, no sky map,
CNN, gamma 10.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.bench import machine, markdown
from fieldlum.bench.charts import _figure
from fieldlum.bench.rows import without_training_hours
from fieldlum.learn import models
from fieldlum.learn.models.data import Dataset, load_pairs
from fieldlum.learn.models.dense_training import TrainingPlan
from fieldlum.learn.models.scores import Truth, evaluate, summary, truth

PAPER = {
    "final": (9.54e-3, 4.85e-2),
    "no sky map": (9.78e-3, 4.91e-2),
    "CNN": (1.78e-2, 5.61e-2),
    "gamma 10": (2.81e-2, 8.31e-2),
}
TABLE_1: dict[str, dict[str, Any]] = {
    "final": {},
    "no sky map": {"sky_map": False},
    "CNN": {"form": "cnn"},
    "gamma 10": {"curve": "gamma"},
}
DEPTHS, WIDTHS = (2, 3, 4, 5), (150, 300, 600, 1200)


def coarse(data: Dataset, height: int) -> Dataset:
    """The same hours on smaller maps: means of blocks. The height must divide the maps'."""
    factor = data.shape[0] // height

    def means(maps: np.ndarray) -> np.ndarray:
        return maps.reshape(len(maps), height, factor, 2 * height, factor).mean(axis=(2, 4))

    assert data.patch_cdm2 is not None and data.shape[0] % height == 0
    seen = means(data.seen[None].astype(np.float32))[0] > 0.5
    return replace(
        data,
        luminance_cdm2=means(data.luminance_cdm2),
        patch_cdm2=means(data.patch_cdm2),
        seen=seen,
    )


def one(data: Any, test: Truth, plan: TrainingPlan, **shape: Any) -> dict[str, Any]:
    start = time.monotonic()
    fitted = models.fit("dense", data, plan=plan, seed=0, **shape)
    seconds = time.monotonic() - start
    found = summary(evaluate(fitted, test))
    keys = (
        "log10_mse_weighted",
        "rer_weighted",
        "paper_log10_mse",
        "paper_rer",
        "dgp_mse",
        "rammg_mse",
    )
    epochs = fitted.training["pixels_seen_per_pixel"]
    return {"parameters": fitted.parameters, "epochs": epochs, "fit_s": seconds} | {
        key: found[key] for key in keys
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("train", type=Path)
    parser.add_argument("test", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--height", type=int, default=23)
    parser.add_argument("--steps", type=int, default=6000)
    parser.add_argument("--figure-steps", type=int, default=1600)
    parser.add_argument("--batch", type=int, default=512)
    parser.add_argument("--test-hours", type=int, default=200)
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    data = coarse(load_pairs(asked.train), asked.height)
    fresh = without_training_hours(coarse(load_pairs(asked.test), asked.height), data)
    some = np.unique(
        np.linspace(0, len(fresh) - 1, min(asked.test_hours, len(fresh))).round().astype(int)
    )
    test = truth(fresh.take(some))
    maps = f"{data.shape[1]}x{data.shape[0]} maps, {len(data)} captures, {len(some)} test hours"
    plan = TrainingPlan("short", steps=asked.steps, batch_pixels=asked.batch)
    rows = [
        {"network": name}
        | dict(zip(("published_log10_mse", "published_rer"), PAPER[name], strict=True))
        for name in TABLE_1
    ]
    size = f"{maps}, {asked.steps} updates of {asked.batch} pixels"
    table = run(
        asked.out / "table1.csv",
        rows,
        size,
        lambda row: one(data, test, plan, **TABLE_1[row["network"]]),
    )
    rows = [{"depth": d, "width": 600} for d in DEPTHS] + [
        {"depth": 4, "width": w} for w in WIDTHS if w != 600
    ]
    short = TrainingPlan("short", steps=asked.figure_steps, batch_pixels=asked.batch)
    size = f"{maps}, {asked.figure_steps} updates of {asked.batch} pixels"
    grid = run(asked.out / "figure8.csv", rows, size, lambda row: one(data, test, short, **row))
    _write(asked.out, table, grid, f"{grid[0]['size']} ({grid[0]['epochs']} epochs); {machine()}")


def run(
    path: Path,
    rows: list[dict[str, Any]],
    size: str,
    measured: Callable[[dict[str, Any]], dict[str, Any]],
) -> list[dict[str, Any]]:
    """The rows with what was measured; those that the file holds at this size are taken from it."""
    known = _kept(path)
    done = []
    for row in rows:
        found = next((k for k in known if k.items() >= (row | {"size": size}).items()), None)
        done.append(found or row | {"size": size} | measured(row))
        print(done[-1], flush=True)
        _keep(path, [*done, *(k for k in known if k not in done)])
    return done


def _kept(path: Path) -> list[dict[str, Any]]:
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return [
            {k: v if k in ("network", "size") else _number(v) for k, v in r.items()}
            for r in csv.DictReader(file)
        ]


def _number(text: str) -> float | int:
    return int(text) if text.isdigit() else float(text)


def _keep(path: Path, rows: list[dict[str, Any]]) -> None:
    names = list(dict.fromkeys(key for row in rows for key in row))
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=names)
        writer.writeheader()
        writer.writerows(rows)


def _write(out: Path, table: list[dict[str, Any]], grid: list[dict[str, Any]], size: str) -> None:
    columns = {key: key.replace("_", " ") for row in table for key in row}
    text = f"{markdown(table, columns)}\n{markdown(grid, {key: key for key in grid[0]})}"
    (out / "ablations.md").write_text(text, encoding="utf-8")
    figure, axes = _figure(9.0, 3.8, 2)
    for axis, key, fixed, at in zip(
        axes, ("depth", "width"), ("width", "depth"), (600, 4), strict=True
    ):
        mine = sorted((row for row in grid if row[fixed] == at), key=lambda row: row[key])
        axis.plot(
            [r[key] for r in mine], [r["paper_log10_mse"] for r in mine], "o-", color="#c2410c"
        )
        axis.set(xlabel=f"{key} of branch one ({fixed} {at})", ylabel="log10 MSE, paper mode")
        axis.set_xticks([r[key] for r in mine])
    figure.suptitle(size, fontsize=8)
    figure.savefig(out / "figure8.png")


if __name__ == "__main__":
    main()
