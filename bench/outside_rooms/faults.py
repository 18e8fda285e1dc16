"""Are faults found in rooms of other renderers, and is nothing found where there is none?

    python bench/outside_rooms/faults.py OUT ROOM.toml [ROOM.toml ...]

ROOM.toml as for `judge.py`; its nine days are captures by the tape-measure site. Lines of text:

- camera: captures that are left out, and turned back, of the still camera; after the last third was
  turned by some pixels, how many of it are turned back or left out; of single turned captures, how
  many are left out.
- day: what `fieldlum train` leaves out of clean captures and after one day was changed: irradiance
  times 0.6, a lamp, a blind that takes 55 % of the light; each as captures of that day, of others.
- notes: what `train` would print of clean captures.
"""

from __future__ import annotations

import sys
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
from make_case import write_case
from numpy.typing import NDArray

from fieldlum.bench.score_rows import load
from fieldlum.core.arrays import Floats32
from fieldlum.learn.models.camera_turns import camera_turns, turned_back
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.train import fit_timed, held_out_warnings, patch_mode
from fieldlum.learn.train.outliers import without_changes
from fieldlum.room.fit.misplaced_patches import misplacement_of, warnings_of
from fieldlum.sky.daylight import light_at

TURNS_PX = (3.0, 12.0, 29.0, 58.0)  # for maps of 58 rows
LAMP_CDM2 = (200.0, 30.0)  # added to the lowest and highest row of pixels
LOG_FACTOR, BLIND_FACTOR = 0.6, 0.45


def turned(data: Dataset, rows: NDArray[np.intp], turn_px: float) -> Floats32:
    """Return the maps of which those of `rows` [k] were taken by a camera turned in heading."""
    maps, angle = data.luminance_cdm2.copy(), turn_px * 180.0 / 58.0
    for k in rows:
        logs = np.log(np.maximum(maps[k], 1e-3))
        maps[k] = np.exp(turned_back(logs, data.heading_deg, (-angle, 0.0, 0.0)))
    return maps


def camera(data: Dataset) -> str:
    """Return what is found of a still and of a turned camera."""
    light, seen, heading = data.light, data.seen, data.heading_deg
    low = np.where(light.direct_lx > 1000.0, light.sun_altitude_deg, np.nan)
    still = camera_turns(data.luminance_cdm2, seen, heading, low)
    last = np.arange(2 * len(data) // 3, len(data))
    texts = [f"still: {(~still.aligned).sum()} left out, {still.turned.sum()} turned back"]
    for turn_px in TURNS_PX:
        found = camera_turns(turned(data, last, turn_px), seen, heading, low)
        out, back = (~found.aligned)[last].sum(), found.turned[last].sum()
        texts.append(f"{turn_px:g} px: {back} back, {out} out of {len(last)}")
    some = np.arange(4, len(data), 9)
    found = camera_turns(turned(data, some, 20.0), seen, heading, low)
    left = ~found.aligned
    texts.append(
        f"single 20 px: {left[some].sum()} of {len(some)}, others {left.sum() - left[some].sum()}"
    )
    capped = data.luminance_cdm2.copy()
    capped[some] = 0.0
    found = camera_turns(capped, seen, heading, low)
    texts.append(f"lens cap: {(~found.aligned)[some].sum()} of {len(some)}")
    return "; ".join(texts)


def faults(data: Dataset, day: np.datetime64) -> dict[str, Dataset]:
    """Return the captures clean and with one changed day, by the name of the fault."""
    of_day, light = data.days == day, data.light
    log = np.where(of_day, LOG_FACTOR, 1.0)
    lit, dark = data.luminance_cdm2.copy(), data.luminance_cdm2.copy()
    lit[of_day] += np.linspace(LAMP_CDM2[1], LAMP_CDM2[0], lit.shape[1])[:, None]
    dark[of_day] *= BLIND_FACTOR
    other = light_at(list(light.t_utc), data.setup.site, log * light.dni_wm2, log * light.dhi_wm2)
    return {
        "clean": data,
        "irradiance": replace(data, light=other),
        "lamp": replace(data, luminance_cdm2=lit),
        "blind": replace(data, luminance_cdm2=dark),
    }


def day(data: Dataset, seed: int) -> str:
    """Return which captures are left out for each fault of one random day."""
    chosen = np.random.default_rng(seed).choice(np.unique(data.days))
    texts = [str(chosen)]
    for name, some in faults(data, chosen).items():
        kept, _ = without_changes(some, with_patch=data.patch_cdm2 is not None)
        lost = ~np.isin(some.slots, kept.slots)
        own = lost & (some.days == chosen)
        texts.append(
            f"{name} {own.sum()} of {(some.days == chosen).sum()}, others {(lost & ~own).sum()}"
        )
    return "; ".join(texts)


def main() -> None:
    """Print the lines of each room."""
    for number, file in enumerate(map(Path, sys.argv[2:])):
        case, room = Path(sys.argv[1]) / file.stem, tomllib.loads(file.read_text())
        write_case(room, file.parent / room["npz"], case)
        tape, site = case / "tape" / "9d.csv", case / "tape" / "site.toml"
        data = load(tape, ["transport"], site=site, scene="none").data
        print(f"{file.stem} camera: {camera(data)}", flush=True)
        print(f"{file.stem} day: {day(data, number)}", flush=True)
        patch = patch_mode(data, "absolute")
        fitted, _ = fit_timed("transport", data, patch=patch, seed=0, budget_s=None)
        notes = held_out_warnings(fitted, data) + warnings_of(misplacement_of(data, patch))
        print(*(f"{file.stem} note: {note}" for note in notes), sep="\n", flush=True)


if __name__ == "__main__":
    main()
