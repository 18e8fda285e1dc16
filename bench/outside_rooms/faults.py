"""Are faults found in rooms of other renderers, and is nothing found where there is none?

    python bench/outside_rooms/faults.py OUT ROOM.toml [ROOM.toml ...]

ROOM.toml as for `judge.py`; its nine days are captures by the tape-measure site. A line a room and
fault, then the totals: found of changed captures, rooms where at least 70 % of them are found, and
other captures that are left out. Faults:

- still, turn: the camera; its last third turned by some pixels; single turns; a covered lens.
- irradiance, lamp, blind: one day of each month with irradiance times 0.6, a lamp, or a blind that
  takes 55 % of the light; two_blinds: the blind on two of June's three days; evenings: the lamp
  from 15 h on, on four days.
"""

from __future__ import annotations

import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from make_case import write_case
from numpy.typing import NDArray

from fieldlum.bench.score_rows import load
from fieldlum.core.arrays import Floats32
from fieldlum.learn.models.camera_turns import camera_turns, turned_back
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.train.outliers import without_changes
from fieldlum.sky.daylight import light_at
from fieldlum.sky.sun import standard_time

TURNS_PX = (12.0, 29.0, 58.0)  # for maps of 58 rows
SINGLE_PX = 20.0
LAMP_CDM2 = (200.0, 30.0)  # added to the lowest and highest row of pixels
LOG_FACTOR, BLIND_FACTOR = 0.6, 0.45
FOUND = 0.7  # share of the changed captures
MONTHS = {3: "March", 6: "June", 12: "December"}

Mask = NDArray[np.bool_]
Found = tuple[str, Mask, Mask]  # name of a fault, captures it changed, captures left out or turned


def turned(data: Dataset, rows: NDArray[np.intp], turn_px: float) -> Floats32:
    """Return the maps of which those of `rows` [k] were taken by a camera turned in heading."""
    maps, angle = data.luminance_cdm2.copy(), turn_px * 180.0 / 58.0
    for k in rows:
        logs = np.log(np.maximum(maps[k], 1e-3))
        maps[k] = np.exp(turned_back(logs, data.heading_deg, (-angle, 0.0, 0.0)))
    return maps


def camera_faults(data: Dataset) -> Iterator[Found]:
    """Yield what is found of a still camera, of turned ones and of a covered lens."""
    light = data.light
    low = np.where(light.direct_lx > 1000.0, light.sun_altitude_deg, np.nan)

    def found(maps: Floats32) -> Mask:
        turns = camera_turns(maps, data.seen, data.heading_deg, low)
        return ~turns.aligned | turns.turned

    count = len(data)
    yield "still", np.zeros(count, bool), found(data.luminance_cdm2)
    last, some = np.arange(2 * count // 3, count), np.arange(4, count, 9)
    for turn_px in TURNS_PX:
        named = f"turn of {turn_px:g} px"
        yield named, np.isin(np.arange(count), last), found(turned(data, last, turn_px))
    single = np.isin(np.arange(count), some)
    yield f"single turns of {SINGLE_PX:g} px", single, found(turned(data, some, SINGLE_PX))
    covered = data.luminance_cdm2.copy()
    covered[some] = 0.0
    yield "covered lens", single, found(covered)


def with_irradiance(data: Dataset, factor: NDArray[np.float64]) -> Dataset:
    """Return captures whose irradiance is multiplied by factors [n]."""
    light = data.light
    dni_wm2, dhi_wm2 = factor * light.dni_wm2, factor * light.dhi_wm2
    return replace(data, light=light_at(list(light.t_utc), data.setup.site, dni_wm2, dhi_wm2))


def with_lamp(data: Dataset, lit: Mask) -> Dataset:
    """Return captures of which some have the light of a lamp."""
    maps = data.luminance_cdm2.copy()
    maps[lit] += np.linspace(LAMP_CDM2[1], LAMP_CDM2[0], maps.shape[1])[:, None]
    return replace(data, luminance_cdm2=maps)


def with_blind(data: Dataset, shaded: Mask) -> Dataset:
    """Return captures of which some have less light."""
    factor = np.where(shaded, np.float32(BLIND_FACTOR), np.float32(1.0))
    return replace(data, luminance_cdm2=data.luminance_cdm2 * factor[:, None, None])


def day_faults(data: Dataset, seed: int) -> Iterator[Found]:
    """Yield what is left out of clean captures, and of those with changed days."""

    def found(some: Dataset) -> Mask:
        kept, _ = without_changes(some, with_patch=data.patch_cdm2 is not None)
        return ~np.isin(data.slots, kept.slots)

    rng = np.random.default_rng(seed)
    days = np.unique(data.days)
    months = np.array([day.astype(object).month for day in days])
    yield "clean days", np.zeros(len(data), bool), found(data)
    for month, name in MONTHS.items():
        of_month = days[months == month]
        if not len(of_month):
            continue
        day = data.days == rng.choice(of_month)
        yield f"irradiance {name}", day, found(with_irradiance(data, np.where(day, LOG_FACTOR, 1)))
        yield f"lamp {name}", day, found(with_lamp(data, day))
        yield f"blind {name}", day, found(with_blind(data, day))
    june = days[months == 6]
    if len(june) == 3:
        two = np.isin(data.days, rng.choice(june, 2, replace=False))
        yield "two_blinds June", two, found(with_blind(data, two))
    hours = np.array([standard_time(t, data.setup.site.timezone).hour for t in data.light.t_utc])
    lit = np.isin(data.days, rng.choice(days, min(4, len(days)), replace=False)) & (hours >= 15)
    yield "lamp evenings", lit, found(with_lamp(data, lit))


def main() -> None:
    """Print the lines of each room, and the totals."""
    totals: dict[str, list[tuple[int, int, int]]] = defaultdict(list)
    for number, file in enumerate(map(Path, sys.argv[2:])):
        case, room = Path(sys.argv[1]) / file.stem, tomllib.loads(file.read_text())
        write_case(room, file.parent / room["npz"], case)
        tape, site = case / "tape" / "9d.csv", case / "tape" / "site.toml"
        data = load(tape, ["transport"], site=site, scene="none").data
        for faults in (camera_faults(data), day_faults(data, number)):
            for name, changed, out in faults:
                counts = int((changed & out).sum()), int(changed.sum()), int((out & ~changed).sum())
                totals[name].append(counts)
                print(f"{file.stem}: {name}: {counts[0]} of {counts[1]}, others {counts[2]}")
        sys.stdout.flush()
    for name, rows in totals.items():
        done, of, others = (sum(row[k] for row in rows) for k in range(3))
        rooms = sum(row[1] > 0 and row[0] >= FOUND * row[1] for row in rows)
        blamed = sum(row[2] > 0 for row in rows)
        print(
            f"# {name}: {done} of {of} captures, {rooms} of {len(rows)} rooms; "
            f"{others} others in {blamed} rooms"
        )


if __name__ == "__main__":
    main()
