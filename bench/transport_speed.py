"""Time and memory of light transport at 460 x 230: the office's hours with every pixel doubled in
both directions.

    python bench/transport_speed.py office_seattle.npz [--sets 9d,k200] [--hours 4379]

CPU seconds of the process (all threads) and wall seconds; memory is the process's peak. The year is
predicted in blocks of 64 hours with sun patches given, and each map is dropped after it was made.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from transport_office import read

from fieldlum.learn.transport import fit

BLOCK = 64


def doubled(maps: np.ndarray) -> np.ndarray:
    return np.repeat(np.repeat(maps, 2, axis=1), 2, axis=2)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("archive", type=Path)
    parser.add_argument("--sets", default="9d,k200")
    parser.add_argument("--hours", type=int, default=4379)
    options = parser.parse_args()
    with np.load(options.archive, allow_pickle=False) as stored:
        archive = {name: stored[name] for name in stored.files}
    year, _ = read(archive, archive["set_test"])
    assert year.patch_cdm2 is not None
    print(
        "| set | captures | patch | fit CPU s | fit wall s | year CPU s | year wall s | peak GB |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in options.sets.split(","):
        small, _ = read(archive, archive[f"set_{name}"])
        assert small.patch_cdm2 is not None
        train = replace(
            small,
            luminance_cdm2=doubled(small.luminance_cdm2),
            patch_cdm2=doubled(small.patch_cdm2),
            seen=np.ones((230, 460), bool),
        )
        marks = [(time.process_time(), time.perf_counter())]
        model = fit(train)
        marks.append((time.process_time(), time.perf_counter()))
        print(
            f"{name}: fitted in {marks[1][0] - marks[0][0]:.1f} CPU s", file=sys.stderr, flush=True
        )
        for start in range(0, options.hours, BLOCK):
            rows = np.arange(start, min(start + BLOCK, options.hours)) % len(year)
            model.predict(year.light[rows], doubled(year.patch_cdm2[rows]))
        marks.append((time.process_time(), time.perf_counter()))
        spent = [f"{b[k] - a[k]:.0f}" for a, b in pairwise(marks) for k in (0, 1)]
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
        print(f"| {name} | {len(train)} | known | {' | '.join(spent)} | {peak:.1f} |", flush=True)


if __name__ == "__main__":
    main()
