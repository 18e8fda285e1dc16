"""The sky view in rooms that other programs rendered: discs shown and invented, DGP, intervals.

    python bench/sky_view_rooms.py OUT ROOM.toml ... [--csv FILE]

ROOM.toml: a room of bench/outside_rooms, with its npz. Each room is read without a [room], with the
discs in its captures and without the captures that show one. Hours are the test hours with DNI over
60 W/m2; a disc of over 2 % of the beam is shown. DGP's mean squared error is of the disc alone: the
true map with its own disc against the true map with the tool's, over all test hours and ten views;
then over the hours whose interval does not hold both a disc and none.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.learn.models.training_data import Dataset, load_pairs, with_sky_view
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.sky.sky_view.visible_disc import disc_of_hours, drawn_discs_lx
from fieldlum.year.glare.metrics import glare_directions
from fieldlum.year.glare.sources import panorama_views, view_azimuths_deg

sys.path.insert(0, str(Path(__file__).parent / "outside_rooms"))
from make_case import write_case  # pyright: ignore[reportMissingImports]

SHOWN, SUNNY_WM2 = 0.02, 60.0


def dgp_errors(test: Dataset, own_lx: np.ndarray) -> np.ndarray:
    """Return the mean squared error of DGP by the disc alone, of each hour."""
    errors = np.zeros(len(test))
    rows = np.flatnonzero(np.abs(own_lx - test.disc_lx) > 20.0)
    if not len(rows):
        return errors
    some = test.take(rows)
    azimuths = view_azimuths_deg(test.heading_deg)
    views = panorama_views(*test.shape, test.heading_deg, azimuths)
    suns, maps = some.light.apparent_sun_direction, some.luminance_cdm2
    dgp = [
        glare_directions(maps, views, suns, disc)["dgp"] for disc in (some.disc_lx, own_lx[rows])
    ]
    errors[rows] = ((dgp[1] - dgp[0]) ** 2).mean(axis=1)
    return errors


def judge(view: SkyView, test: Dataset) -> dict[str, Any]:
    """Return the row of a room."""
    beam = np.maximum(test.light.direct_lx, 1.0)
    disc = disc_of_hours(view, test.light)
    own, true = disc.best_lx / beam, test.disc_lx / beam
    drawn = drawn_discs_lx(view, test.setup, test.light, np.random.default_rng(0)) / beam
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    holds = (true >= low - SHOWN) & (true <= high + SHOWN)
    sunny = test.light.dni_wm2 > SUNNY_WM2
    open_hours = (low <= SHOWN) & (high > SHOWN)  # whether there is a disc
    errors = dgp_errors(test, disc.best_lx)
    there, none = sunny & (true > SHOWN), sunny & (true <= SHOWN)
    return {
        "hours with disc shown": f"{(there & (own > SHOWN)).sum()}/{there.sum()}",
        "phantom hours": f"{(none & (own > SHOWN)).sum()}/{none.sum()}",
        "rms of share": f"{np.sqrt(((own - true)[there] ** 2).mean()):.3f}" if there.any() else "",
        "interval holds": f"{holds[sunny].mean():.3f}",
        "with disc": f"{holds[there].mean():.3f}" if there.any() else "",
        "DGP MSE of the disc": f"{errors.mean():.1e}",
        "cannot tell": f"{open_hours.sum()}/{len(test)}",
        "DGP MSE of the others": f"{errors[~open_hours].mean():.1e}",
        "heading": f"{view.pose.heading_deg:+.2f}+-{view.pose.heading_sd_deg:.2f}",
    }


def rows(toml: Path, out: Path) -> list[dict[str, Any]]:
    """Return the two rows of a room."""
    room = tomllib.loads(toml.read_text())
    write_case(room, toml.parent / room["npz"], out / toml.stem)
    case = out / toml.stem / "free"
    captured, test = (load_pairs(case / f"{name}.csv") for name in ("9d", "test"))
    true = f"{(room['heading_deg'] - captured.heading_deg + 180.0) % 360.0 - 180.0:+.1f}"
    about = {"room": toml.stem, "pixel deg": f"{180 / captured.shape[0]:.1f}", "true heading": true}
    made = []
    for discs in (True, False):
        data = captured if discs else captured.take(captured.disc_lx <= 0.0)
        view = with_sky_view(data).sky_view
        assert view is not None
        count = int((data.disc_lx > 0.0).sum())
        made.append({**about, "captured discs": count, **judge(view, test)})
    return made


def main() -> None:
    """Print two rows for each room, and write them as csv."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("rooms", type=Path, nargs="+")
    parser.add_argument("--csv", type=Path)
    asked = parser.parse_args()
    table = []
    for room in asked.rooms:
        for row in rows(room, asked.out):
            print(", ".join(f"{key} {value}" for key, value in row.items()), flush=True)
            table.append(row)
    if asked.csv:
        with asked.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(table[0]))
            writer.writeheader()
            writer.writerows(table)


if __name__ == "__main__":
    main()
