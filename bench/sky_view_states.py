"""The sky view of a room in two states: a blind that is marked or not, leaves of one season.

    python bench/sky_view_states.py OUT USUAL OTHER --state blind=half --hours 12 15
    python bench/sky_view_states.py OUT USUAL OTHER --months 5 6 7 8 9 10

USUAL, OTHER: a room of bench/outside_rooms in two states, such as blind_up and blind: a .toml with
its npz, or the folder of fine pictures by `render.py --fine`. Captures are of OTHER in the hours
(UTC) or months given, else of USUAL; without --state they have no marks. Each is judged in its own
test hours; with --months in those of its season, within 30 days of captures and between.
"""

from __future__ import annotations

import argparse
import csv
import os
import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
from sky_view_rooms import judge  # pyright: ignore[reportMissingImports]

from fieldlum.learn.models.training_data import Dataset, load_pairs, with_sky_view

sys.path.insert(0, str(Path(__file__).parent / "outside_rooms"))
from make_case import write_case  # pyright: ignore[reportMissingImports]

REACH_DAYS = 30


def captured(asked: argparse.Namespace, cases: list[Path]) -> Dataset:
    """Return the captures of both states as one set."""
    both = []
    for case in cases:
        with (case / "9d.csv").open(newline="") as file:
            both.append(list(csv.DictReader(file)))
    rows, folder = [], asked.out / "both"
    folder.mkdir(parents=True, exist_ok=True)
    for usual, other in zip(*both, strict=True):
        month, hour = int(usual["t_utc"][5:7]), int(usual["t_utc"][11:13])
        is_other = month in asked.months or asked.hours[0] <= hour < asked.hours[1]
        row = dict(other if is_other else usual)
        row["panorama"] = os.path.relpath(cases[is_other] / row["panorama"], folder)
        rows.append({**row, "state": asked.state if is_other else ""})
    (folder / "site.toml").write_text((cases[0] / "site.toml").read_text())
    with (folder / "9d.csv").open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return load_pairs(folder / "9d.csv")


def case_of(room: Path, out: Path) -> Path:
    """Return the folder with the captures and test hours of a room."""
    if room.is_dir():
        return room
    table = tomllib.loads(room.read_text())
    write_case(table, room.parent / table["npz"], out / room.stem)
    return out / room.stem / "free"


def days(data: Dataset) -> np.ndarray:
    """Return the day of the year of each hour."""
    return np.array([t.timetuple().tm_yday for t in data.light.t_utc])


def main() -> None:
    """Print the notes, and rows for each state."""
    parser = argparse.ArgumentParser()
    parser.add_argument("out", type=Path)
    parser.add_argument("rooms", type=Path, nargs=2)
    parser.add_argument("--state", default="")
    parser.add_argument("--months", type=int, nargs="*", default=[])
    parser.add_argument("--hours", type=int, nargs=2, default=[0, 0])
    asked = parser.parse_args()
    cases = [case_of(room, asked.out) for room in asked.rooms]
    data = captured(asked, cases)
    view = with_sky_view(data).sky_view
    assert view is not None
    print("\n".join(view.notes))
    for k, (room, state) in enumerate(zip(asked.rooms, ("", asked.state), strict=True)):
        test = load_pairs(cases[k] / "test.csv")
        marked = replace(test, light=replace(test.light, states=(state,) * len(test)))
        parts = {"all hours": np.full(len(test), True)}
        if asked.months:
            own = np.isin([t.month for t in test.light.t_utc], asked.months) == bool(k)
            apart = np.abs((days(test)[:, None] - np.unique(days(data)) + 183) % 366 - 183)
            near = apart.min(axis=1) <= REACH_DAYS
            parts = {"near captures": own & near, "between": own & ~near}
        for name, rows in parts.items():
            found = judge(view, marked.take(rows))
            print(f"{room.stem} {state}, {name}:", *(f"{key} {v}," for key, v in found.items()))


if __name__ == "__main__":
    main()
