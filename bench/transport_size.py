"""How large light transport must be: numbers of features forced on it, and what held-out days let
it take.

    python bench/transport_size.py office_seattle.npz [--sets k200,9d] [--pixels 3000]

The office's captures as they are, with 5 % noise on every pixel, and with each complete picture off
by 10 % (an irradiance that is not the room's). Patches known; scores on the 500 test hours over
random pixels drawn by solid angle.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
from transport_office import draw, errors, read

from fieldlum.learn.models.data import Dataset
from fieldlum.learn.transport import fit, selection

SIZES = (5, 10, 20, 40, 60, 100)
KINDS = {"clean": (0.0, 0.0), "pixels 5 %": (0.05, 0.0), "levels 10 %": (0.0, 0.1)}


def disturbed(data: Dataset, pixels: float, levels: float) -> Dataset:
    rng = np.random.default_rng(0)
    factor = 1.0 + pixels * rng.standard_normal(data.luminance_cdm2.shape)
    factor *= np.exp(levels * rng.standard_normal((len(data), 1, 1)))
    maps = np.maximum(data.luminance_cdm2 * factor, 1e-3).astype(np.float32)
    patch = None if data.patch_cdm2 is None else (data.patch_cdm2 * factor).astype(np.float32)
    return replace(data, luminance_cdm2=maps, patch_cdm2=patch if levels else data.patch_cdm2)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("archive", type=Path)
    parser.add_argument("--sets", default="k200,9d")
    parser.add_argument("--pixels", type=int, default=3000)
    options = parser.parse_args()
    with np.load(options.archive, allow_pickle=False) as stored:
        archive = {name: stored[name] for name in stored.files}
    test, truth = read(archive, archive["set_test"])
    seen = draw(test.shape, options.pixels, np.random.default_rng(0))
    print(
        "| set | captures | features | held-out days | test hours | numbers held | fit [CPU s] | "
        "500 maps [CPU s] |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for name in options.sets.split(","):
        clean = replace(read(archive, archive[f"set_{name}"])[0], seen=seen)
        for kind, noise in KINDS.items():
            train = disturbed(clean, *noise)
            for size in (*SIZES, None):
                free = selection.FEWER, selection.FEWER_COST
                fewer, cost = free if size is None else ((size,), np.inf)
                start = time.process_time()
                with mock.patch.multiple(selection, FEWER=fewer, FEWER_COST=cost):
                    model = fit(train)
                fitted = time.process_time()
                maps = model.predict(test.light, test.patch_cdm2).luminance_cdm2
                done = time.process_time()
                e = errors(truth, maps, test.light, test.disc_lx)[:, seen]
                assert model.held_out_mse is not None
                said = (
                    f"**{model.response.pixels.b.shape[1]} (chosen)**"
                    if size is None
                    else str(model.response.pixels.b.shape[1])
                )
                print(
                    f"| {name} | {kind} | {said} | {model.held_out_mse.mean():.2e} | "
                    f"{(e**2).mean():.2e} "
                    f"| {model.parameters / 1e3:.0f} k | {fitted - start:.1f} | "
                    f"{done - fitted:.1f} |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
