"""Do the 95 % intervals of DGP hold in rooms of other renderers?

    python bench/outside_rooms/dgp_intervals.py OUT ROOM.toml [ROOM.toml ...] [--months 3]

ROOM.toml as for `judge.py`. Each tape-measure room is learnt from its nine days, or those of some
months; the intervals of ten views in hours of the year, with the tool's own sun disc, are compared
with DGP of the true maps. A line a room, then all: hours that are like captured ones, and others.
"""

from __future__ import annotations

import argparse
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from make_case import write_case

import fieldlum
from fieldlum.bench.score_rows import load
from fieldlum.learn import models
from fieldlum.learn.models.scores import truth
from fieldlum.optics.projection import signed_angle_deg
from fieldlum.year.glare.sources import view_azimuths_deg

ROUNDING = 0.005  # of DGP as it is reported


def judged(case: Path, months: set[str]) -> Iterator[tuple[str, float, float, float, float]]:
    """Yield, for like and unlike hours: views, share inside, rms error, mean interval width."""
    site, test, table = case / "site.toml", case / "test.csv", case / "9d.csv"
    head, *rows = table.read_text().splitlines()
    table.write_text("\n".join([head, *(row for row in rows if row[5:7] in months), ""]))
    fieldlum.fit(fieldlum.load_pairs(table), "transport", out=case / "model")
    hours = load(table, ["transport"], site=site, scene="none", test=test).test
    assert hours is not None
    glare = fieldlum.load_model(case / "model").glare(hours.light)
    azimuths = view_azimuths_deg(hours.heading_deg)
    order = [
        int(np.argmin(np.abs(signed_angle_deg(azimuths - azimuth))))
        for azimuth in glare.azimuth.values
    ]
    true = truth(hours).dgp[:, order]
    low, high, dgp = (glare[name].values for name in ("dgp_low", "dgp_high", "dgp"))
    inside = (true >= low - ROUNDING) & (true <= high + ROUNDING)
    like = models.load(case / "model").predict(hours.light, hours.patch_cdm2).trusted
    for name, some in (("like", like), ("unlike", ~like)):
        used = np.isfinite(true + dgp) & some[:, None]
        if used.any():
            rms = float(np.sqrt(((dgp - true)[used] ** 2).mean()))
            yield name, int(used.sum()), inside[used].mean(), rms, (high - low)[used].mean()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("rooms", type=Path, nargs="+")
    parser.add_argument("--months", default="3,6,12")
    wanted = parser.parse_args()
    months = {f"{int(month):02d}" for month in wanted.months.split(",")}
    rows = []
    for file in wanted.rooms:
        case, room = wanted.out / file.stem, tomllib.loads(file.read_text())
        write_case(room, file.parent / room["npz"], case)
        for name, *figures in judged(case / "tape", months):
            rows.append((name, *figures))
            print(f"{file.stem}, {name}: {line(*figures)}", flush=True)
    for name in ("like", "unlike"):
        some = np.array([row[1:] for row in rows if row[0] == name])
        if len(some):
            views, weights = some[:, 0].sum(), some[:, 0] / some[:, 0].sum()
            inside, width = weights @ some[:, 1], weights @ some[:, 3]
            print(f"# {name}: {line(views, inside, np.sqrt(weights @ some[:, 2] ** 2), width)}")


def line(views: float, inside: float, rms: float, width: float) -> str:
    """Return the figures as text."""
    return f"{views:.0f} views, inside {inside:.3f}, rms error {rms:.3f}, mean width {width:.3f}"


if __name__ == "__main__":
    main()
