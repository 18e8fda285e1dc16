"""A campaign of twelve simulated rooms end to end: plan, capture, merge, train, predict, report.

    python bench/campaign_rooms.py FOLDER [--height 24] [--budget 0.05]

Rooms differ in orientation and window. One session is missing and one has a broken session.toml:
the overview must name both.
Each stage prints its lines, its wall time and its CPU time.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import replace
from pathlib import Path

import tomli_w
from click.testing import CliRunner

from fieldlum import demo
from fieldlum.cli import main as fieldlum
from fieldlum.core.records import SiteFile, quiet
from fieldlum.optics.profiles import shipped
from fieldlum.room import simulate
from fieldlum.session import Session, open_session
from fieldlum.session.site_toml import load_site, site_table

BROKEN = 7


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--height", type=int, default=24)
    parser.add_argument("--set", default="4-day", help="days of the plan, as in fieldlum plan")
    parser.add_argument("--model", default="transport", help="as in fieldlum train --model")
    parser.add_argument("--budget", type=float, default=0.05, help="minutes of each training")
    parser.add_argument("--scheduler", default="local")
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    names = [f"room-{k:02d}" for k in range(1, asked.rooms + 1)]
    path = campaign_file(asked.folder, names, asked)
    stage(path, "plan")
    started = time.monotonic()
    for k, name in enumerate(names, start=1):
        if k != BROKEN:
            photograph(open_session(asked.folder / name), k, asked.height)
    print(f"simulate and capture: {time.monotonic() - started:.0f} s\n", flush=True)
    for name in names[BROKEN - 1 : BROKEN]:
        (asked.folder / name / "session.toml").write_text("broken [", encoding="utf-8")
    stage(path, "merge", "--scheduler", asked.scheduler)
    stage(path, "status")
    stage(path, "train")
    stage(path, "predict", "--scheduler", asked.scheduler)
    stage(path, "report")


def stage(path: Path, name: str, *options: str) -> None:
    """Run one campaign command; print what it prints, and what it costs."""
    wall, cpu = time.monotonic(), _cpu_s()
    result = CliRunner().invoke(fieldlum, ["campaign", name, str(path), *options])
    cost = f"{time.monotonic() - wall:.0f} s, CPU {_cpu_s() - cpu:.0f} s"
    print(f"campaign {name}: exit {result.exit_code}, {cost}\n{result.output}", flush=True)


def _cpu_s() -> float:
    """CPU seconds of this process and of its children that ended."""
    return sum(os.times()[:4])


def campaign_file(folder: Path, names: list[str], asked: argparse.Namespace) -> Path:
    """Write CAMPAIGN.toml and a SITE.toml for each room; the last room has neither."""
    rooms = [{"session": name, "site": f"{name}.toml"} for name in names]
    for k, name in enumerate(names, start=1):
        text = tomli_w.dumps(site_table(site_of(k)))
        (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    missing = {"session": f"room-{len(names) + 1:02d}"}
    size = f"{2 * asked.height}x{asked.height}"
    common = {"model": asked.model, "views": 8, "size": size, "set": asked.set} | {
        "budget_min": asked.budget
    }
    table = {"name": "Twelve rooms", "common": common, "room": [*rooms, missing]}
    path = folder / "CAMPAIGN.toml"
    path.write_text(tomli_w.dumps(table), encoding="utf-8")
    return path


def site_of(number: int) -> SiteFile:
    """Return the paper's office, turned by 30 degrees more than the room before, windows varied."""
    office = load_site(shipped("capture_plans") / "seattle-office.toml")
    assert office.room is not None
    turned = (180.0 + 30.0 * number) % 360.0
    windows = tuple(
        replace(window, width_m=window.width_m * (0.6 + 0.1 * (number % 5)))
        for window in office.room.window
    )
    return SiteFile(
        replace(office.site, name=f"Room {number}"),
        replace(office.camera, heading_deg=turned),
        replace(office.room, wall_azimuth_deg=turned, window=windows),
        office.pyranometer,
    )


def photograph(session: Session, number: int, height: int) -> None:
    """Render the room at each slot, then take every bracket with the simulated camera."""
    if not session.truth.is_dir():
        weather = simulate.weather_for(session.site_file())
        simulate.run(session, weather, height=height, quality="draft", workers=1)
    demo.capture(session, number, quiet)


if __name__ == "__main__":
    main()
