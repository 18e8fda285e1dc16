"""The sky view in rooms that other programs rendered: discs shown and invented, DGP, intervals.

    python bench/sky_view_rooms.py OUT ROOM.toml ... [--csv FILE] [--draws 2]

ROOM.toml: a room of bench/outside_rooms, with its npz. Each room is read without a [room], with the
discs in its captures and without the captures that show one. Hours are the test hours with DNI over
60 W/m2; a disc of over 2 % of the beam is shown. DGP's mean squared error is of the disc alone: the
true map with its own disc against the true map with the tool's, over all test hours and ten views;
then over the hours whose interval does not hold both a disc and none.

--draws N: instead, the view by few captures of each room: N draws each of 6, 8, 12 and 24 captures
at any time, of two days, and with the sun behind the camera; and all captures. Prints for each kind
how many sunny hours the interval holds, and how many hours cannot tell.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tomllib
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Indices, Mask
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


def intervals(view: SkyView, test: Dataset) -> tuple[Mask, Mask]:
    """Return whether the disc's interval holds the true one, and whether it leaves it open, [n]."""
    beam = np.maximum(test.light.direct_lx, 1.0)
    drawn = drawn_discs_lx(view, test.setup, test.light, np.random.default_rng(0)) / beam
    low, high = np.quantile(drawn, [0.025, 0.975], axis=0)
    true = test.disc_lx / beam
    holds = (true >= low - SHOWN) & (true <= high + SHOWN)
    return holds, (low <= SHOWN) & (high > SHOWN)


def judge(view: SkyView, test: Dataset) -> dict[str, Any]:
    """Return the row of a room."""
    beam = np.maximum(test.light.direct_lx, 1.0)
    disc = disc_of_hours(view, test.light)
    own, true = disc.best_lx / beam, test.disc_lx / beam
    holds, open_hours = intervals(view, test)
    sunny = test.light.dni_wm2 > SUNNY_WM2
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


def case_of(toml: Path, out: Path) -> tuple[Dataset, Dataset]:
    """Return the captures and the test hours of a room, without a [room]."""
    room = tomllib.loads(toml.read_text())
    write_case(room, toml.parent / room["npz"], out / toml.stem)
    case = out / toml.stem / "free"
    return load_pairs(case / "9d.csv"), load_pairs(case / "test.csv")


def rows(toml: Path, out: Path) -> list[dict[str, Any]]:
    """Return the two rows of a room."""
    room = tomllib.loads(toml.read_text())
    captured, test = case_of(toml, out)
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


def draws(captured: Dataset, count: int, rng: np.random.Generator) -> dict[str, list[Indices]]:
    """Return the rows of random captures by kind: at any time, of two days, sun behind."""
    every = np.arange(len(captured))
    days = np.array([t.date() for t in captured.light.t_utc])
    azimuth = captured.light.sun_azimuth_deg - captured.heading_deg
    behind = np.flatnonzero(np.cos(np.radians(azimuth)) < 0.0)
    made: dict[str, list[Indices]] = {"all": [every]}
    for number, _ in product((6, 8, 12, 24), range(count)):
        two_days = np.flatnonzero(np.isin(days, rng.choice(np.unique(days), 2, replace=False)))
        for kind, rows in {"any time": every, "two days": two_days, "sun behind": behind}.items():
            if len(rows) >= number:
                drawn = np.sort(rng.choice(rows, number, replace=False))
                made.setdefault(f"{kind}, {number}", []).append(drawn)
    return made


def few_captures(tomls: list[Path], out: Path, count: int) -> None:
    """Print how well the intervals by few captures hold, by kind of draw."""
    found: dict[str, list[list[float]]] = {}
    for toml in tomls:
        captured, test = case_of(toml, out)
        sunny = test.light.dni_wm2 > SUNNY_WM2
        for kind, some in draws(captured, count, np.random.default_rng(5)).items():
            for rows in some:
                view = with_sky_view(captured.take(rows)).sky_view
                assert view is not None
                holds, is_open = intervals(view, test)
                found.setdefault(kind, []).append([holds[sunny].mean(), is_open.mean()])
        print(toml.stem, flush=True)
    for kind, figures in found.items():
        holds, cannot_tell = np.mean(figures, axis=0)
        print(f"{kind}: {len(figures)} draws, holds {holds:.3f}, cannot tell {cannot_tell:.2f}")


def main() -> None:
    """Print two rows for each room, and write them as csv."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("rooms", type=Path, nargs="+")
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--draws", type=int)
    asked = parser.parse_args()
    if asked.draws:
        return few_captures(asked.rooms, asked.out, asked.draws)
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
