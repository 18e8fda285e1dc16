"""Do still cameras seem turned in rooms of other renderers, and what does a small turn cost?

    python bench/outside_rooms/turns.py CASE [CASE ...]

CASE is a folder that `judge.py` or `make_case.py` wrote. A line of text for each series: captures,
how many are turned back (none should be), and their turns in pixels of heading, tilt and roll; then
the error of maps (log10 MSE, without patches) after the last third of the nine days' captures was
turned in heading, over that of the still camera.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from draws import drawn

from fieldlum.core.arrays import Floats32
from fieldlum.learn.models import camera_turns, training_data
from fieldlum.learn.models.training_data import Dataset, load_pairs
from fieldlum.learn.transport import fit

KNOCKS_PX = (0.17, 0.33, 0.6)


def series(case: Path, name: str) -> Dataset:
    """Return a series of a case, and print which of its captures seem turned."""
    shown: list[camera_turns.CameraTurns] = []
    found = camera_turns.camera_turns

    def keep(*given: Any) -> camera_turns.CameraTurns:
        shown.append(found(*given))
        return shown[-1]

    training_data.camera_turns = keep
    data = load_pairs(case / "tape" / f"{name}.csv")
    training_data.camera_turns = found
    angles_px = shown[0].angles_deg[shown[0].turned] * data.shape[0] / 180.0
    turns = np.unique(angles_px.round(2), axis=0).tolist()
    print(f"{case.name} {name}: {len(data)} captures, {len(angles_px)} turned: {turns}", flush=True)
    return data


def knocked(data: Dataset, turn_px: float) -> Floats32:
    """Return the maps with the last third turned in heading."""
    maps, angle = data.luminance_cdm2.copy(), turn_px * 180.0 / data.shape[0]
    for k in range(2 * len(maps) // 3, len(maps)):
        logs = np.log(np.maximum(maps[k], 1e-3))
        maps[k] = np.exp(camera_turns.turned_back(logs, data.heading_deg, (-angle, 0.0, 0.0)))
    return maps


def error(data: Dataset, test: Dataset, maps: Floats32) -> float:
    """Return the log10 MSE of the test hours at some pixels."""
    seen = drawn(data)
    learnt = replace(data, luminance_cdm2=maps, patch_cdm2=None, seen=seen)
    made = fit(learnt, patch="none").predict(test.light).luminance_cdm2[:, seen]
    logs = (np.log10(np.maximum(m, 1.0)) for m in (made, test.luminance_cdm2[:, seen]))
    return float((np.subtract(*logs) ** 2).mean())


def main() -> None:
    for case in map(Path, sys.argv[1:]):
        data, test = series(case, "9d"), series(case, "test")
        still = error(data, test, data.luminance_cdm2)
        for turn_px in KNOCKS_PX:
            maps = knocked(data, turn_px)
            turned = camera_turns.camera_turns(maps, data.seen, data.heading_deg).turned
            cost = error(data, test, maps) / still
            print(f"  {turn_px} px: {turned.sum()} found, error {cost:.2f} times", flush=True)


if __name__ == "__main__":
    main()
