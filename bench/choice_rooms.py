"""Does `train` choose the model that is best over a year? Twenty random rooms, sites and headings.

    python bench/choice_rooms.py render OUT [--rooms 20] [--first 0] [--hours 500] [--height 23]
    python bench/choice_rooms.py judge OUT [--rooms 20] [--first 0]

`render` writes a simulated session for each room: nine days of captures and random hours of the
year. `judge` trains on the captures with a box as a tape measures it and with irradiance from two
horizontal readings, as `pair` computes it; then it compares the chosen model with the best by the
mean absolute DGP error over the hours of the year (ten directions, the true disc for all).
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum import plan
from fieldlum.core.records import CameraSetup, Obstruction, Room, Site, SiteFile, Window
from fieldlum.learn import models
from fieldlum.learn.models.held_out_choice import CRITERIA, beam_is_uncertain
from fieldlum.learn.models.training_data import Dataset, load_pairs
from fieldlum.learn.train import choose_model, day_folds, evaluate_folds, notes_of
from fieldlum.room import simulate
from fieldlum.room.fit.apply_scene import with_patches
from fieldlum.session import open_session
from fieldlum.sky import sun
from fieldlum.year.glare.metrics import glare_directions
from fieldlum.year.glare.sources import panorama_views, view_azimuths_deg

Array = NDArray[Any]
YEAR = 2027
TRIED = ("mean", "nearest", "transport")  # without the dense network, which would take hours
BEST_WITHIN = 1.1  # largest error of the chosen model over that of the best
READING_SD_WM2, READING_SD = 3.0, 0.01  # of each horizontal irradiance


def random_setup(seed: int) -> SiteFile:
    """Return a site between 60 degrees south and 66 north with a room of one or two windows."""
    rng = np.random.default_rng([48, seed])
    site = Site(f"room {seed}", float(rng.uniform(-60.0, 66.0)), float(rng.uniform(-7, 7)), "UTC")
    wide, deep, tall = rng.uniform(4.0, 8.0), rng.uniform(4.0, 8.0), rng.uniform(2.6, 3.6)

    def window(wall: Any, length: float) -> Window:
        width = float(rng.uniform(0.35, 0.7) * length)
        left = float(rng.uniform(0.3, length - width - 0.3))
        sill = float(rng.uniform(0.3, 1.0))
        high = float(rng.uniform(1.2, tall - sill - 0.2))
        return Window(wall, left, width, sill, high, panes=int(rng.integers(1, 4)))

    windows = [window("south", wide)]
    if rng.random() < 0.5:
        windows.append(window(rng.choice(["west", "east"]), deep))
    far, high = float(rng.uniform(8.0, 25.0)), float(rng.uniform(3.0, 15.0))
    house = Obstruction(float(rng.uniform(-15, 5)), -far - 8.0, -1.0, 15.0, 8.0, high)
    room = Room(
        width_m=wide,
        depth_m=deep,
        height_m=tall,
        camera_x_m=float(rng.uniform(0.25, 0.75) * wide),
        camera_y_m=float(rng.uniform(0.25, 0.75) * deep),
        camera_z_m=1.2,
        wall_azimuth_deg=float(rng.uniform(0.0, 360.0)),
        reflectance_walls=float(rng.uniform(0.35, 0.75)),
        window=tuple(windows),
        obstruction=(house,) if rng.random() < 0.5 else (),
    )
    return SiteFile(site, CameraSetup(heading_deg=room.wall_azimuth_deg), room)


def render(out: Path, seed: int, hours: int, height: int) -> None:
    """Write the sessions OUT/SEED/days and OUT/SEED/year."""
    setup, begin = random_setup(seed), time.process_time()
    weather = simulate.weather_for(setup, seed=seed)
    days = plan.make_plan(setup, plan.Request("9-day", date(YEAR, 1, 1), None, YEAR)).slots
    year = simulate.sample_slots(setup, weather, hours, seed, [slot.t_utc for slot in days])
    for name, slots in (("days", days), ("year", year)):
        folder = out / str(seed) / name
        if (folder / "session.toml").is_file():
            session = open_session(folder)
        else:
            session = simulate.make_session(folder, setup, slots, {"set": name})
        simulate.run(session, weather, height=height, quality="draft")
    print(f"room {seed}: {time.process_time() - begin:.0f} CPU s", flush=True)


def as_paired(data: Dataset, seed: int) -> Dataset:
    """Return captures with DNI by closure of two horizontal readings, which have errors."""
    rng = np.random.default_rng([49, seed])
    light = data.light
    sine = np.sin(np.radians(np.maximum(light.sun_altitude_deg, 0.0)))

    def read(value: Array) -> Array:
        noise = rng.standard_normal((2, len(value)))
        return np.maximum(value * (1.0 + READING_SD * noise[0]) + READING_SD_WM2 * noise[1], 0.0)

    dhi = read(light.dhi_wm2)
    ghi = read(light.dhi_wm2 + light.dni_wm2 * sine)
    dni = np.maximum(sun.dni_by_closure(ghi, dhi, light.sun_altitude_deg), 0.0)
    dni = np.minimum(dni, 1100.0)  # as a quality check would
    usable = dni + dhi > 0.0
    return replace(data, light=replace(light, dni_wm2=dni, dhi_wm2=dhi)).take(usable)


def measured(room: Room, rng: np.random.Generator) -> Room:
    """The box as a user states it: no bars, no furniture, every length a little off."""

    def off(sd: float) -> float:
        return float(sd * rng.standard_normal())

    def edges_off(w: Window) -> Window:
        return replace(
            w,
            left_m=w.left_m + off(0.04),
            width_m=w.width_m + off(0.04),
            sill_m=w.sill_m + off(0.04),
            height_m=w.height_m + off(0.04),
        )

    return replace(
        room,
        width_m=room.width_m * (1.0 + off(0.015)),
        depth_m=room.depth_m * (1.0 + off(0.015)),
        camera_x_m=room.camera_x_m + off(0.05),
        camera_y_m=room.camera_y_m + off(0.05),
        wall_thickness_m=room.wall_thickness_m + off(0.03),
        window=tuple(edges_off(w) for w in room.window),
    )


def dgp_of(maps: Array, year: Dataset) -> Array:
    """Return DGP in ten directions with the true disc, [n, 10]."""
    azimuths = view_azimuths_deg(year.heading_deg)
    light = year.light.apparent_sun_direction, year.disc_lx
    views = panorama_views(*maps.shape[1:], year.heading_deg, azimuths)
    return glare_directions(maps, views, *light)["dgp"]


def judge(out: Path, seed: int) -> dict[str, Any]:
    """Train on the nine days of a room; return the choice and every model's true error."""
    begin = time.process_time()
    parts = {}
    for name in ("days", "year"):
        data = load_pairs(out / str(seed) / name / "truth" / "pairs.csv")
        assert data.setup.room is not None
        tape = measured(data.setup.room, np.random.default_rng([50, seed]))
        room = replace(tape, obstruction=())
        parts[name] = with_patches(replace(data, setup=replace(data.setup, room=room)))
    days, year = as_paired(parts["days"], seed), parts["year"]
    trials = [
        evaluate_folds(name, days, day_folds(days), patch="absolute", seed=0) for name in TRIED
    ]
    choice = choose_model(trials)
    true, dgp = {}, dgp_of(year.luminance_cdm2, year)
    for name in TRIED:
        maps = models.fit(name, days).predict(year.light, year.patch_cdm2).luminance_cdm2
        true[name] = float(np.abs(dgp_of(maps, year) - dgp).mean())
    notes = notes_of(days, "absolute", "transport", trials)
    return {
        "room": seed,
        "latitude_deg": round(days.setup.site.latitude_deg, 1),
        "doubted": int(beam_is_uncertain(days).sum()),
        "captures": len(days),
        "hours": len(year),
        "chosen": choice.name,
        "reason": choice.reason,
        "true": true,
        "over_best": true[choice.name] / min(true.values()),
        "refused": any("do not use" in note for note in notes),
        "errors": {t.name: [t.scores.errors.figure(name) for name in CRITERIA] for t in trials},
        "cpu_s": time.process_time() - begin,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("step", choices=["render", "judge"])
    parser.add_argument("out", type=Path)
    parser.add_argument("--rooms", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="number of the first room")
    parser.add_argument("--hours", type=int, default=500)
    parser.add_argument("--height", type=int, default=23)
    asked = parser.parse_args()
    if asked.step == "render":
        for seed in range(asked.first, asked.first + asked.rooms):
            render(asked.out, seed, asked.hours, asked.height)
        return
    rows = []
    for seed in range(asked.first, asked.first + asked.rooms):
        rows.append(judge(asked.out, seed))
        print(json.dumps(rows[-1]), flush=True)
    good = sum(row["over_best"] <= BEST_WITHIN for row in rows)
    false = sum(row["refused"] for row in rows)
    print(f"# {good} of {len(rows)} within 10 % of the best; 'do not use it' of transport: {false}")


if __name__ == "__main__":
    main()
