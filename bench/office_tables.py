"""The office's score table: every set against the same test hours, one machine, one run.

    python bench/office_tables.py FOLDER OUT.csv [--sets k200,9d,...] [--models ...] [--dense ROOT]
    [--test NAME]

FOLDER is what office_seattle.py wrote. --dense ROOT adds the networks trained before in ROOT/<set>.
Rows are added to OUT.csv as they come, so that a run that was cut off has what it had; each set's
chart is drawn next to it at the end (--sets "" only draws).
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import Any

from fieldlum.bench import markdown, speed_accuracy
from fieldlum.bench.score_rows import parse_specs, score_row, without_training_hours
from fieldlum.learn.models.scores import truth
from fieldlum.learn.models.training_data import load_pairs

COLUMNS = (
    "set",
    "name",
    "judged_dgp_error",
    "judged_ev_error",
    "judged_log10_mse",
    "n_judged",
    "log10_mse_weighted",
    "rer_weighted",
    "median",
    "p90",
    "worst",
    "paper_log10_mse",
    "paper_rer",
    "dgp_mse_own_disc",
    "dgp_mse",
    "bias_log10",
    "rammg_mse",
    "n_train",
    "n_test",
    "fit_s",
    "fit_cpu_s",
    "predict_s_per_map",
    "predict_cpu_s_per_map",
    "expected_log10_mse",
    "trusted_share",
    "in_90_band",
)
HEADS = {key: key for key in COLUMNS}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--sets", default="k200,9d,12d,4d,mar")
    parser.add_argument("--models", default="mean,nearest,transport,transport:none")
    parser.add_argument("--dense", type=Path)
    parser.add_argument("--test", default="test", help="name of the test set's csv")
    asked = parser.parse_args()
    test = load_pairs(asked.folder / f"{asked.test}.csv")
    rows: list[dict[str, Any]] = []
    for name in filter(None, asked.sets.split(",")):
        data = load_pairs(asked.folder / f"{name}.csv")
        known = truth(without_training_hours(test, data))
        trained = (
            [str(asked.dense / name)]
            if asked.dense and (asked.dense / name / "config.json").is_file()
            else []
        )
        for spec in parse_specs([*filter(None, asked.models.split(",")), *trained]):
            row = {"set": name} | score_row(spec, data, known, seed=0, budget_s=60.0)[0]
            rows.append(row)
            _add(asked.out, row)
            print(markdown([row], HEADS).splitlines()[-1], flush=True)
    print(markdown(rows, HEADS))
    _draw(asked.out)


def _draw(path: Path) -> None:
    """The speed-accuracy chart of each set in the table, earlier runs' rows too."""
    with path.open(newline="", encoding="utf-8") as file:
        stored = list(csv.DictReader(file))
    figures = ("fit_cpu_s", "predict_cpu_s_per_map", "paper_log10_mse")
    rows = [row | {key: float(row[key] or "nan") for key in figures} for row in stored]
    for name in dict.fromkeys(row["set"] for row in rows):
        speed_accuracy(
            path.with_name(f"{path.stem}_{name}.png"), [r for r in rows if r["set"] == name]
        )


def _add(path: Path, row: dict[str, Any]) -> None:
    new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=COLUMNS, extrasaction="ignore")
        if new:
            writer.writeheader()
        writer.writerow(row)


if __name__ == "__main__":
    main()
