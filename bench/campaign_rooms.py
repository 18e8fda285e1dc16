"""A campaign of twelve simulated rooms: simulate, train, predict, report.

    python bench/campaign_rooms.py FOLDER [--rooms 12] [--hours 40] [--height 12]

Rooms differ in orientation and window. One camera loses a quarter of its sensitivity over the
year, one session is missing and one has a broken session.toml: the overview must name all three.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from click.testing import CliRunner

from fieldlum import simulate
from fieldlum.cli import main as fieldlum
from fieldlum.images import read_panorama, write_panorama
from fieldlum.profiles import load_site, shipped
from fieldlum.records import SiteFile
from fieldlum.session import Session, create_session

DRIFTING, BROKEN = 4, 7
LOSS = 0.25  # of the sensitivity, from the first to the last capture


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--rooms", type=int, default=12)
    parser.add_argument("--hours", type=int, default=40)
    parser.add_argument("--height", type=int, default=12)
    asked = parser.parse_args()
    asked.folder.mkdir(parents=True, exist_ok=True)
    names = [f"room-{k:02d}" for k in range(1, asked.rooms + 1)]
    for k, name in enumerate(names, start=1):
        if not (asked.folder / name).is_dir():
            session = room(asked.folder / name, k, asked.hours, asked.height)
            if k == DRIFTING:
                fade(session)
    text = 'name = "Twelve rooms"\n[common]\nmodel = "transport"\nviews = 8\n'
    text += "".join(f'[[room]]\nsession = "{name}"\n' for name in [*names, "room-13"])
    path = asked.folder / "CAMPAIGN.toml"
    path.write_text(text, encoding="utf-8")
    (asked.folder / names[BROKEN - 1] / "session.toml").write_text("broken [", encoding="utf-8")
    for stage, *options in (
        ("status",),
        ("train",),
        ("predict",),
        ("report", "--table", str(asked.folder / "hours.csv")),
    ):
        result = CliRunner().invoke(fieldlum, ["campaign", stage, str(path), *options])
        print(f"campaign {stage}: exit {result.exit_code}\n{result.output}", flush=True)


def room(root: Path, number: int, hours: int, height: int) -> Session:
    """Simulate random hours of a year in a room turned by 30 degrees more than the one before."""
    office = load_site(shipped("capture_plans") / "seattle-office.toml")
    assert office.room is not None
    turned = (180.0 + 30.0 * number) % 360.0
    windows = tuple(
        replace(window, width_m=window.width_m * (0.6 + 0.1 * (number % 5)))
        for window in office.room.window
    )
    setup = SiteFile(
        replace(office.site, name=f"Room {number}"),
        replace(office.camera, heading_deg=turned),
        replace(office.room, wall_azimuth_deg=turned, window=windows),
        office.pyranometer,
    )
    weather = simulate.weather_for(setup)
    slots = simulate.sample_slots(setup, weather, hours, number)
    session = create_session(root, setup, slots, {"set": "year-sample", "count": hours})
    simulate.run(session, weather, height=height, quality="draft", workers=1)
    return session


def fade(session: Session) -> None:
    """Darken the pictures more and more, as a camera would that loses sensitivity."""
    paths = sorted(session.truth.glob("[0-9]*.exr"))
    for k, path in enumerate(paths):
        picture = read_panorama(path)
        share = 1.0 - LOSS * k / (len(paths) - 1)
        write_panorama(path, replace(picture, luminance_cdm2=picture.luminance_cdm2 * share))


if __name__ == "__main__":
    main()
