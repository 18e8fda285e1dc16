"""Does a scene fit end in the same room whichever pixels it compares?

    python bench/outside_rooms/draws.py OUT ROOM.toml [ROOM.toml ...] [--draws 0.1,0.3,0.5]

Each room is written as a case into OUT (`make_case.py`), fitted with each offset of the regular
choice of pixels, and learnt with the fitted patches. A line a draw: log10 MSE of maps of the test
hours (at 400 pixels), over the better of no patches and tape-measure box, expected over true error,
misfit, share of the fitted model, share of pixels within two standard deviations, overlap of the
patches of all captures with those of the first draw, and CPU seconds of the fit.
"""

from __future__ import annotations

import argparse
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
from make_case import write_case
from numpy.typing import NDArray

from fieldlum.core.arrays import Mask
from fieldlum.learn.models.training_data import Dataset, load_pairs, with_sky_view
from fieldlum.learn.transport import MeanTransport, fit
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.room.fit import evidence
from fieldlum.room.fit.apply_scene import with_patches, with_scene
from fieldlum.room.fit.fit import fit_scene

PIXELS = 400  # of the score, drawn by solid angle
DRAWS = "0.637,0.1,0.3,0.5,0.9"
PATCH_CDM2 = 1.0  # from which a pixel counts as part of a patch


def drawn(data: Dataset) -> Mask:
    """Return the pixels of the score, [H, W]."""
    chance = np.where(data.seen, equirect_solid_angles(*data.shape), 0.0).ravel()
    mask = np.zeros(chance.size, bool)
    mask[np.random.default_rng(5).choice(chance.size, PIXELS, False, chance / chance.sum())] = True
    return mask.reshape(data.shape)


def scored(data: Dataset, test: Dataset) -> tuple[float, float, float, float]:
    """Return log10 MSE, expected over true error, share of the fitted model, pixels within 2 sd."""
    model = fit(data, patch="none" if data.patch_cdm2 is None else "absolute")
    made = model.predict(test.light, test.patch_cdm2)
    logs = (np.log10(np.maximum(d.luminance_cdm2[:, data.seen], 1.0)) for d in (made, test))
    squared = np.subtract(*logs) ** 2
    assert made.log10_sd is not None
    within = float((squared < 4.0 * made.log10_sd[:, data.seen] ** 2).mean())
    error = float(squared.mean())
    share = model.share if isinstance(model, MeanTransport) else 1.0
    return error, float(made.expected_mse.mean()) / error, share, within


def overlap(one: NDArray, other: NDArray) -> float:
    """Return the common over the whole solid angle of two stacks of patches [n, H, W]."""
    omega = equirect_solid_angles(*one.shape[1:])
    a, b = one > PATCH_CDM2, other > PATCH_CDM2
    return float(((a & b) * omega).sum() / ((a | b) * omega).sum())


def judge(case: Path, draws: list[float]) -> None:
    """Print the lines of one room."""
    data, test = (load_pairs(case / "tape" / f"{name}.csv") for name in ("9d", "test"))
    room = data.setup.room
    assert room is not None
    seen = drawn(data)
    bare = [replace(d, patch_cdm2=None, seen=seen) for d in (data, test)]
    better = min(scored(*bare)[0], scored(*map(with_patches, bare))[0])
    sky, first = with_sky_view(data), None
    for draw in draws:
        evidence.DRAW = draw
        begin = time.process_time()
        scene = fit_scene(sky, room)
        cpu = time.process_time() - begin
        captures = with_scene(data, scene)
        assert captures.patch_cdm2 is not None
        first = captures.patch_cdm2 if first is None else first
        # the test hours have true times
        hours = with_scene(test, replace(scene, clock_min=0.0))
        error, ratio, share, within = scored(replace(captures, seen=seen), hours)
        print(
            f"| {case.name} | {draw:g} | {error:.2e} | {error / better:.2f} | {ratio:.2f} | "
            f"{scene.misfit['fitted']:.4f} | {share:.2f} | {within:.3f} | "
            f"{overlap(captures.patch_cdm2, first):.2f} | {cpu:.0f} |",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description="Fits of one room from several draws of pixels.")
    parser.add_argument("out", type=Path)
    parser.add_argument("rooms", type=Path, nargs="+")
    parser.add_argument("--draws", default=DRAWS)
    wanted = parser.parse_args()
    print(
        "| room | draw | log10 MSE | over the better | expected / true | misfit | share | 2 sd | ",
        end="",
    )
    print("overlap | CPU s |\n" + "|---" * 10 + "|")
    for path in wanted.rooms:
        room = tomllib.loads(path.read_text())
        case = wanted.out / path.stem
        write_case(room, path.parent / room["npz"], case)
        judge(case, [float(part) for part in wanted.draws.split(",")])


if __name__ == "__main__":
    main()
