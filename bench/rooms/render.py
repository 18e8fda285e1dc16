"""Render the benchmark rooms: python bench/rooms/render.py OUT [ROOM ...] [--height 115] [--quality
quick]

Each room becomes a session OUT/NAME with the paper's sets side by side in one pairs.csv: even
(200), 9-day, 12-day, 4-day, march, and 300 random test hours that none of them holds. sets.json
lists the rows of pairs.csv (data rows, counted from 0) of each.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from datetime import date
from pathlib import Path

from fieldlum import plan
from fieldlum.core.progress import shown_by
from fieldlum.core.records import SiteFile, Slot
from fieldlum.room import simulate
from fieldlum.room.scene.radiosity import QUALITIES
from fieldlum.session import open_session, sha256
from fieldlum.session.site_toml import load_site
from fieldlum.weather import TYPICAL_YEAR, Weather

HERE = Path(__file__).parent
TEST_HOURS = 300


def _slots(setup: SiteFile, weather: Weather) -> dict[str, list[Slot]]:
    """Slots of every set, those without light in the weather left out."""
    start = date(TYPICAL_YEAR, 1, 1)
    lit = {
        t
        for t, dni, dhi in zip(weather.t_utc, weather.dni_wm2, weather.dhi_wm2, strict=True)
        if dni + dhi > 0
    }
    asked = {
        "even": plan.Request("even", start, start, TYPICAL_YEAR, 365, 200),
        "9-day": plan.Request("9-day", start, None, TYPICAL_YEAR),
        "12-day": plan.Request("12-day", start, None, TYPICAL_YEAR),
        "4-day": plan.Request("4-day", start, None, TYPICAL_YEAR),
        "march": plan.Request("month", start, date(TYPICAL_YEAR, 3, 1), TYPICAL_YEAR),
    }
    sets = {
        name: list(plan.make_plan(setup, request, weather).slots) for name, request in asked.items()
    }
    sets = {name: [s for s in slots if s.t_utc in lit] for name, slots in sets.items()}
    taken = [s.t_utc for slots in sets.values() for s in slots]
    sets["test"] = simulate.sample_slots(setup, weather, TEST_HOURS, seed=7, without=taken)
    return sets


def render(path: Path, out: Path, height: int, quality: str) -> None:
    setup = load_site(path)
    weather = simulate.weather_for(setup, seed=sum(map(ord, path.stem)))
    sets = _slots(setup, weather)
    known = {s.id: s for slots in reversed(sets.values()) for s in slots}
    slots = sorted(known.values(), key=lambda s: s.t_utc)
    row = {s.id: k for k, s in enumerate(slots)}
    folder = out / path.stem
    session = open_session(folder) if (folder / "session.toml").is_file() else None
    if session is None:
        session = simulate.make_session(
            folder, setup, slots, {"set": "bench", "room_sha256": sha256(path)}
        )
    begin, cpu = time.perf_counter(), time.process_time()

    def say(done: int, total: int, text: str) -> None:
        if total and done % max(total // 20, 1) < 16:
            print(f"\r{path.stem}: {text} {done}/{total}   ", end="", file=sys.stderr, flush=True)

    with shown_by(say):
        made = simulate.run(session, weather, height=height, quality=quality)
    rows = {name: sorted(row[s.id] for s in chosen) for name, chosen in sets.items()}
    (folder / "sets.json").write_text(json.dumps(rows), encoding="utf-8")
    spent = time.perf_counter() - begin
    print(
        f"\n{path.stem}: {made.rendered} hours in {spent:.0f} s ({time.process_time() - cpu:.0f} "
        f"s own CPU), "
        f"weather {made.weather}, sets " + ", ".join(f"{n} {len(r)}" for n, r in rows.items()),
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("rooms", nargs="*", help="names without .toml; default: all")
    parser.add_argument("--height", type=int, default=115)
    parser.add_argument("--quality", default="quick", choices=tuple(QUALITIES))
    asked = parser.parse_args()
    for name in asked.rooms or sorted(p.stem for p in HERE.glob("*.toml")):
        render(HERE / f"{name}.toml", asked.out, asked.height, asked.quality)


if __name__ == "__main__":
    main()
