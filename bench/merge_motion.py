"""Somebody walks through a bracket: error with all frames, and with the moved ones left out; and a
still room.

9 frames 2 EV apart (gain 4 e-/DN, read noise 6 e-) of a room from 3 to 30 000 cd/m2, 400 x 400
pixels of a mosaic; a figure with soft edges, 50 x 120 pixels, somewhere else in every draw, of a
luminance between 2 and 8000 cd/m2.

    python bench/merge_motion.py [--draws 40]
"""

from __future__ import annotations

import argparse
from time import process_time

import numpy as np

from fieldlum.core.records import Flag
from fieldlum.merge.estimator import Merged, merge_signals
from fieldlum.merge.frames import RawSignal
from fieldlum.merge.motion import leave_out_moved

GAIN, READ_E, BLACK, FULL, SIZE = 4.0, 6.0, 512.0, 14000.0, 400
STEPS = tuple(400.0 * 4.0**-i for i in range(9))
SHAPE = (SIZE // 2, 2, SIZE)
WALKS = {"nobody": 0, "one frame": 1, "two frames in a row": 2, "three frames in a row": 3}


def expose(light: np.ndarray, per_cdm2: float, rng: np.random.Generator) -> RawSignal:
    electrons = rng.poisson(np.minimum(light * per_cdm2 * GAIN, 1e9)) + rng.normal(
        0, READ_E, light.shape
    )
    counts = np.clip(np.round(electrons / GAIN + BLACK), 0, FULL).astype(np.uint16)
    constants = (np.asarray(v, np.float32) for v in (BLACK, FULL - BLACK, per_cdm2))
    return RawSignal(counts, *constants, GAIN, (READ_E / GAIN) ** 2 + 1 / 12)


def room(rng: np.random.Generator) -> np.ndarray:
    y, x = np.mgrid[:SIZE, :SIZE]
    return np.exp(np.log(3) + np.log(1e4) * x / SIZE + 0.3 * np.sin(y / 17.0 + rng.uniform(0, 6)))


def with_figure(light: np.ndarray, column: float, row: float, luminance: float) -> np.ndarray:
    y, x = np.mgrid[:SIZE, :SIZE]
    cover = 1 / (1 + np.exp((np.hypot((x - column) / 25, (y - row) / 60) - 1) * 25))
    return light * (1 - cover) + luminance * cover


def draw(frames: int, rng: np.random.Generator) -> dict[str, np.ndarray | float]:
    """Relative errors of the pixels that the figure crossed, with all frames, without the moved,
    and with nobody.
    """
    light = room(rng)
    first = int(rng.integers(0, len(STEPS) - 2 - max(frames - 1, 0)))
    column, row, pace = rng.uniform(40, 360), rng.uniform(80, 320), rng.uniform(15, 60)
    luminance = float(np.exp(rng.uniform(np.log(2), np.log(8000))))
    crossed, signals, still = np.zeros(light.shape, bool), [], []
    seeds = rng.integers(0, 2**31, len(STEPS))
    for i, e in enumerate(STEPS):
        seen = light
        if first <= i < first + frames:
            seen = with_figure(light, column + pace * (i - first), row, luminance)
            # What the frame lost to saturation it lost with or without the figure.
            crossed |= (np.abs(seen / light - 1) > 0.01) & (
                np.minimum(seen, light) * e < 0.9 * (FULL - BLACK)
            )
        signals.append(expose(seen.reshape(SHAPE), e, np.random.default_rng(seeds[i])))
        still.append(expose(light.reshape(SHAPE), e, np.random.default_rng(seeds[i])))
    kept = merge_signals(signals, SHAPE)
    started = process_time()
    copy = Merged(kept.value_cdm2.copy(), kept.variance.copy(), kept.flags.copy())
    dropped, _ = leave_out_moved(signals, copy, 0.003)
    seconds = process_time() - started
    nobody = merge_signals(still, SHAPE)
    at, truth = crossed.reshape(SHAPE), light.reshape(SHAPE)
    off = [np.abs(m.value_cdm2 / truth - 1)[at] for m in (kept, dropped, nobody)]
    pull = (np.abs(dropped.value_cdm2 - truth) / np.sqrt(dropped.variance))[at]
    changed = dropped.value_cdm2 != kept.value_cdm2
    return {
        "before": off[0],
        "after": off[1],
        "still": off[2],
        "pull": pull,
        "changed": changed[at],
        "flagged": ((dropped.flags & Flag.MOTION) > 0)[at],
        "false": float((changed & ~_wide(crossed)).mean()),
        "seconds": seconds,
    }


def _wide(mark: np.ndarray) -> np.ndarray:
    import cv2

    return (
        cv2.dilate(mark.astype(np.uint8), np.ones((17, 17), np.uint8)).astype(bool).reshape(SHAPE)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    print(
        "| who walks | rms before % | rms after % | nobody there % | > 5 % off before | after | "
        "of these flagged "
        "| within 2 u after % | left out elsewhere, share |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name, frames in WALKS.items():
        found = [
            draw(frames, np.random.default_rng([options.seed, frames, n]))
            for n in range(options.draws)
        ]
        false = np.mean([f["false"] for f in found])
        if not frames:
            print(f"| {name} | | | | | | | | {false:.1e} |")
            continue
        b, a, s, pull, flagged = (
            np.concatenate([np.atleast_1d(f[k]) for f in found])
            for k in ("before", "after", "still", "pull", "flagged")
        )
        rms = " | ".join(f"{100 * np.sqrt(np.mean(e**2)):.1f}" for e in (b, a, s))
        wrong = a > 0.05
        print(
            f"| {name} | {rms} | {100 * np.mean(b > 0.05):.1f} % | {100 * np.mean(wrong):.1f} % "
            f"| {100 * flagged[wrong].mean():.0f} % | {100 * np.mean(pull < 2):.1f} | {false:.1e} |"
        )


if __name__ == "__main__":
    main()
