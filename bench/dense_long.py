"""The dense network trained for as long as one cares to wait, kept as a model folder for
`office_tables.py --dense`.

    python bench/dense_long.py PAIRS.csv OUT [--minutes 70 | --full]

--minutes fits the training into that time; --full runs 90 passes over the pixels.
OUT/checkpoint.pt is written as it goes, and the same command takes it up again.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

from fieldlum.core.progress import shown_by
from fieldlum.learn import models
from fieldlum.learn.models.training_data import load_pairs


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("pairs", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--minutes", type=float, default=70.0)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    told = [time.monotonic()]

    def progress(done: int, total: int, message: str) -> None:
        if time.monotonic() - told[0] > 60.0:
            told[0] = time.monotonic()
            print(f"{100 * done / total:.1f} %  {message}", flush=True)

    data = load_pairs(asked.pairs)
    budget_s = None if asked.full else 60.0 * asked.minutes
    checkpoint = asked.out / "checkpoint.pt"
    with shown_by(progress):
        fitted = models.fit(
            "dense", data, seed=asked.seed, budget_s=budget_s, checkpoint=checkpoint
        )
    models.save(asked.out, fitted, data)
    print(fitted.state().config["dense_training"])


if __name__ == "__main__":
    main()
