"""Light transport over rooms it was not made for: weighted log10 MSE on test hours, worst room
included.

    python bench/transport_rooms.py FOLDER... [--sets even,9-day] [--rooms given,rough,none]
    [--modes absolute]

Each FOLDER is a session of rendered hours with pairs.csv and sets.json ({set: rows of pairs.csv};
made by `fieldlum simulate` and bench/rooms). --rooms says what the model knows about the room:
the file that the rendering was made from (given), a rough one as a tape measure gives it (no
furniture, window edges 3 to 5 cm off and without bars, reflectances off by 20 to 50 %, those
outside by 30 %), or nothing. The sun patches are the rendering's own.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldlum.core.records import Obstruction, Room, slot_id
from fieldlum.learn.models.training_data import Dataset, load_pairs
from fieldlum.learn.transport import fit
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.sky.sun_disc import add_disc


def rough(room: Room) -> Room:
    """The room as somebody with a tape measure and a guess would write it down."""

    def inside(o: Obstruction) -> bool:
        return 0 <= o.x_m <= room.width_m and 0 <= o.y_m <= room.depth_m

    return replace(
        room,
        reflectance_walls=min(1.2 * room.reflectance_walls, 0.85),
        reflectance_ceiling=0.88 * room.reflectance_ceiling,
        reflectance_floor=1.5 * room.reflectance_floor,
        obstruction=tuple(
            replace(o, reflectance=0.7 * o.reflectance) for o in room.obstruction if not inside(o)
        ),
        window=tuple(
            replace(
                w,
                left_m=w.left_m + 0.05,
                width_m=w.width_m - 0.1,
                sill_m=w.sill_m + 0.03,
                height_m=w.height_m - 0.06,
                panes=1,
                frame_m=0.0,
                transom_m=0.0,
            )
            for w in room.window
        ),
    )


def told(data: Dataset, what: str) -> Dataset:
    room = data.setup.room
    known = {"given": room, "rough": rough(room) if room else None, "none": None}[what]
    return replace(data, setup=replace(data.setup, room=known))


def run(folder: Path, sets: list[str], rooms: list[str], modes: list[str]) -> None:
    data = load_pairs(folder / "pairs.csv")
    rows = json.loads((folder / "sets.json").read_text(encoding="utf-8"))
    slots = [slot_id(row.t_utc) for row in PairsFile.read(folder / "pairs.csv").rows]
    place = {slot: k for k, slot in enumerate(data.slots)}  # without captures that were left out
    index = {name: [place[slots[k]] for k in of if slots[k] in place] for name, of in rows.items()}
    test = data.take(index["test"])
    w = equirect_solid_angles(*data.shape)
    w = w / w.mean()
    truth = add_disc(test.luminance_cdm2, test.light, test.disc_lx, data.heading_deg)
    beam = test.light.direct_lx / test.light.total_lx
    for name in sets:
        for mode in modes:
            for what in rooms:
                start = time.process_time()
                model = fit(told(data.take(index[name]), what), patch=mode)
                seconds = time.process_time() - start
                found = model.predict(test.light, None if mode == "none" else test.patch_cdm2)
                assert found.log10_sd is not None
                maps = add_disc(found.luminance_cdm2, test.light, test.disc_lx, data.heading_deg)
                e = np.log10(np.maximum(maps, 1.0)) - np.log10(np.maximum(truth, 1.0))
                each = (e**2 * w).mean(axis=(1, 2))
                inside = ((np.abs(e) <= 1.645 * found.log10_sd) * w).mean(axis=(1, 2))
                kinds = (beam < 0.05, (beam >= 0.05) & (beam < 0.5), beam >= 0.5)
                held = ", ".join(f"{inside[k].mean():.2f}" if k.any() else "-" for k in kinds)
                tenth = max(1, len(each) // 10)
                hit = (
                    len(
                        np.intersect1d(
                            np.argsort(each)[-tenth:], np.argsort(found.expected_mse)[-tenth:]
                        )
                    )
                    / tenth
                )
                physics = "used" if model.pixels.computed_gain.any() else "dropped"
                print(
                    f"| {folder.name} | {name} | {mode} | {what} | {each.mean():.2e} | "
                    f"{np.median(each):.1e} | "
                    f"{np.percentile(each, 90):.1e} | {each.max():.1e} | {held} | {hit:.0%} | "
                    f"{seconds:.0f} | "
                    f"{physics if what != 'none' else '-'} "
                    f"|",
                    flush=True,
                )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--sets", default="even,9-day")
    parser.add_argument("--rooms", default="given,rough,none")
    parser.add_argument("--modes", default="absolute")
    options = parser.parse_args()
    print(
        "| room | set | patch | room known | weighted log10 MSE | median | p90 | worst | in 90 % "
        "interval: overcast, "
        "intermediate, clear | worst tenth flagged | fit CPU s | physics |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|---|---|")
    for folder in options.folders:
        run(folder, options.sets.split(","), options.rooms.split(","), options.modes.split(","))


if __name__ == "__main__":
    main()
