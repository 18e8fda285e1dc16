"""How many captures are enough: chosen greedily from weather alone against chosen at random, on the
office's hours.

    python bench/transport_captures.py office_seattle.npz [--counts 12,25,50,100,200] [--draws 2]
    [--pixels 3000]

Both choose from the 200 hours of the even set. Greedy knows the weather of all 1 378 hours and the
window's azimuth; it sees no picture. Patches known; scores on the 500 test hours over random pixels
drawn by solid angle.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from transport_office import draw, errors, read

from fieldlum.learn.transport import fit
from fieldlum.sky.daylight_kernel import Facades, Kernel, greedy_hours, light_features


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("archive", type=Path)
    parser.add_argument("--counts", default="12,25,50,100,200")
    parser.add_argument("--draws", type=int, default=2)
    parser.add_argument("--pixels", type=int, default=3000)
    options = parser.parse_args()
    with np.load(options.archive, allow_pickle=False) as stored:
        archive = {name: stored[name] for name in stored.files}
    test, truth = read(archive, archive["set_test"])
    pool, _ = read(archive, archive["set_k200"])
    every, _ = read(archive, np.arange(0, len(archive["conditions"]), 3))
    rng = np.random.default_rng(0)
    seen = draw(test.shape, options.pixels, rng)
    # Without [room], so that the figures are those of the kernel that chose the hours.
    pool = replace(pool, seen=seen, setup=replace(pool.setup, room=None))
    features = light_features(pool.light)
    order = greedy_hours(
        Kernel(Facades(np.array([180.0]), np.ones(1))),
        light_features(every.light),
        features,
        len(pool),
    ).rows

    def score(rows: np.ndarray) -> float:
        model = fit(pool.take(np.sort(rows)))
        e = errors(
            truth,
            model.predict(test.light, test.patch_cdm2).luminance_cdm2,
            test.light,
            test.disc_lx,
        )
        return float((e[:, seen] ** 2).mean())

    print("| captures | greedy | random |\n|---|---|---|")
    for count in (int(c) for c in options.counts.split(",")):
        greedy = score(order[:count])
        drawn = (
            []
            if count >= len(pool)
            else [score(rng.permutation(len(pool))[:count]) for _ in range(options.draws)]
        )
        print(
            f"| {count} | {greedy:.2e} | {', '.join(f'{value:.2e}' for value in drawn)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
