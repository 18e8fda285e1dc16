"""Learning curve and collection periods on a simulated year (the paper's Figures 18 to 22 and Table
2).

    fieldlum simulate capture_plans/seattle-office.toml --year-sample 4379 --size 92x46 --quality
    draft --out YEAR python bench/year_periods.py YEAR/pairs.csv OUT [--model transport]

The same tables as `fieldlum bench` writes for a year, without its score table.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

import numpy as np

from fieldlum.bench import CURVE, PERIODS, charts, machine, markdown, store, year
from fieldlum.bench.rows import parse_specs
from fieldlum.learn.models.data import load_pairs


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
    rows = year.compare_periods(spec, data)
    store(asked.out, "periods", rows, partial(charts.collection_periods, rows=rows))
    print(markdown(rows, PERIODS), flush=True)
    order = np.random.default_rng(0).permutation(len(data))
    test, pool = (
        data.take(np.sort(order[: year.TEST_HOURS])),
        data.take(np.sort(order[year.TEST_HOURS :])),
    )
    rows = year.learning_curve(spec, pool, test, "random")
    rows += year.learning_curve(spec, pool, test, "greedy")
    store(asked.out, "learning_curve", rows, partial(charts.learning_curves, rows=rows))
    print(markdown(rows, CURVE), flush=True)


if __name__ == "__main__":
    main()
