"""What each part of the light transport model gains in rooms of other renderers.

    python bench/outside_rooms/ablate.py OUT ROOM.toml [ROOM.toml ...] [--days 2|4] [--only "A,B"]

ROOM.toml as for `judge.py`. Each room is learnt with the patches of the tape-measure box and with
the renderer's own, completely and with one part switched off, and tested on hours of the year.
Prints a line of JSON a room, patches and part, then a line a part: its error over that of the
complete model, geometric mean and worst room, and expected over true error.
"""

from __future__ import annotations

import argparse
import json
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from judge import kept
from make_case import write_case

from fieldlum.bench.score_rows import load
from fieldlum.learn import transport
from fieldlum.learn.models import scores
from fieldlum.learn.train import fit_timed, patch_mode
from fieldlum.learn.transport import solve, training_arrays

Change = tuple[Any, str, Any]  # object, name, value
_candidates = transport._candidate_inputs  # pyright: ignore[reportPrivateUsage]
PARTS: dict[str, tuple[Change, ...]] = {
    "complete": (),
    "skies that windows show": ((transport, "seen_sky", lambda arrays: None),),
    "computed light": (
        (
            transport,
            "_candidate_inputs",
            lambda *given: [c for c in _candidates(*given) if c.arrays.computed is None],
        ),
    ),
    "robust round": ((solve, "ROUNDS", 0),),
    "second stage": ((solve, "SECOND_NOISE", 1e6),),
    "choice of noise": ((transport, "NOISES", (1e-2, 1e-2, 1e-2)),),
    "model of the stated room": ((transport, "physics_of", lambda *given: None),),
    "patch cells": ((training_arrays, "CELL_WEIGHT", 0.0), (training_arrays, "FLUX_WEIGHT", 0.0)),
}


@contextmanager
def changed(changes: tuple[Change, ...]) -> Iterator[None]:
    """Change attributes for a while."""
    before = [(where, name, getattr(where, name)) for where, name, _ in changes]
    for where, name, value in changes:
        setattr(where, name, value)
    try:
        yield
    finally:
        for where, name, value in before:
            setattr(where, name, value)


def judge(folder: Path, parts: list[str]) -> Iterator[dict[str, Any]]:
    """Yield the figures of one room and its patches, with each part switched off."""
    site, test = folder / "site.toml", folder / "test.csv"
    data = load(folder / "9d.csv", ["transport"], site=site, scene="none", test=test)
    assert data.test is not None
    asked, patch = scores.truth(data.test), patch_mode(data.data, "absolute")
    for part in parts:
        with changed(PARTS[part]):
            fitted, spent = fit_timed("transport", data.data, patch=patch, seed=0, budget_s=None)
            row = scores.summary(scores.evaluate(fitted, asked))
        keys = ("log10_mse_weighted", "expected_log10_mse", "dgp_mse")
        yield {"part": part, **{key: row[key] for key in keys}, "cpu_s": round(spent.cpu_s, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("rooms", type=Path, nargs="+")
    parser.add_argument("--days", type=int, choices=(2, 4))
    parser.add_argument("--only", default=",".join(PARTS))
    wanted = parser.parse_args()
    parts = ["complete", *(part for part in wanted.only.split(",") if part != "complete")]
    rows: dict[tuple[str, str], list[tuple[float, ...]]] = defaultdict(list)
    for file in wanted.rooms:
        case, room = wanted.out / file.stem, tomllib.loads(file.read_text())
        write_case(room, file.parent / room["npz"], case)
        for patches in ("tape", "exact"):
            table = case / patches / "9d.csv"
            head, *lines = table.read_text().splitlines()
            table.write_text("\n".join([head, *kept(lines, wanted.days, None), ""]))
            usual: dict[str, Any] = {}
            for row in judge(case / patches, parts):
                print(json.dumps({"room": file.stem, "patches": patches, **row}), flush=True)
                usual = usual or row
                ratios = [row[k] / usual[k] for k in ("log10_mse_weighted", "dgp_mse", "cpu_s")]
                honest = row["expected_log10_mse"] / row["log10_mse_weighted"]
                rows[patches, row["part"]].append((*ratios, honest))
    for (patches, part), values in rows.items():
        ratio = np.array(values)
        mse, dgp, cpu, _ = np.exp(np.log(ratio).mean(axis=0))
        worst, low, high = ratio[:, :2].max(axis=0), ratio[:, 3].min(), ratio[:, 3].max()
        print(
            f"# {patches}, without {part}: log10 MSE {mse:.2f} ({worst[0]:.2f}), DGP MSE {dgp:.2f} "
            f"({worst[1]:.2f}), CPU {cpu:.2f}; expected over true {low:.2f} to {high:.2f}"
        )


if __name__ == "__main__":
    main()
