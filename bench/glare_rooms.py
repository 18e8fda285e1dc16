"""Agreement with evalglare in simulated rooms that are not the paper's office.

Usage: python bench/glare_rooms.py [--per-stratum 25] [--height 115] [--hours 40] [--quality draft]

Four rooms by `fieldlum simulate`'s own renderer: a corner room with windows on two facades, a deep
plan, a small room close to a large pane, a high room near the equator. Skies: the synthetic weather
of each place. Output as glare_agreement.py, all rooms together and each by itself.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from glare_agreement import compare, report, strata

from fieldlum.core.records import CameraSetup, Room, Site, SiteFile, Window
from fieldlum.room.scene.radiosity import lit_room
from fieldlum.sky.daylight import light_at
from fieldlum.weather import synthetic_weather
from fieldlum.year.glare.metrics import glare_directions
from fieldlum.year.glare.pictures import reference_version
from fieldlum.year.glare.sources import panorama_views, view_azimuths_deg

ROOMS = {
    "corner, Madrid": SiteFile(
        Site("Madrid", 40.4, -3.7, "Europe/Madrid"),
        CameraSetup(heading_deg=205.0),
        Room(
            width_m=7.0,
            depth_m=6.0,
            height_m=3.0,
            camera_x_m=3.5,
            camera_y_m=2.5,
            camera_z_m=1.2,
            wall_azimuth_deg=205.0,
            window=(
                Window("south", 0.8, 2.0, 0.9, 1.6, panes=2),
                Window("south", 4.0, 2.2, 0.9, 1.6, panes=2),
                Window("west", 1.5, 3.0, 0.3, 2.4, panes=3),
            ),
        ),
    ),
    "deep plan, Seattle": SiteFile(
        Site("Seattle", 47.6, -122.3, "America/Los_Angeles"),
        CameraSetup(heading_deg=180.0),
        Room(
            width_m=8.0,
            depth_m=16.0,
            height_m=3.2,
            camera_x_m=4.0,
            camera_y_m=9.0,
            camera_z_m=1.2,
            window=(Window("south", 0.3, 7.4, 0.6, 2.4, panes=6),),
        ),
    ),
    "near a pane, Oslo": SiteFile(
        Site("Oslo", 59.9, 10.7, "Europe/Oslo"),
        CameraSetup(heading_deg=250.0),
        Room(
            width_m=4.0,
            depth_m=4.0,
            height_m=2.7,
            camera_x_m=2.0,
            camera_y_m=0.9,
            camera_z_m=1.2,
            wall_azimuth_deg=250.0,
            reflectance_walls=0.7,
            window=(Window("south", 0.2, 3.6, 0.2, 2.3, 0.7),),
        ),
    ),
    "high room, Quito": SiteFile(
        Site("Quito", -0.2, -78.5, "America/Guayaquil"),
        CameraSetup(heading_deg=90.0),
        Room(
            width_m=6.0,
            depth_m=8.0,
            height_m=5.0,
            camera_x_m=3.0,
            camera_y_m=3.0,
            camera_z_m=1.6,
            wall_azimuth_deg=90.0,
            window=(
                Window("south", 0.5, 5.0, 1.0, 3.5, panes=4, transom_m=3.0),
                Window("north", 1.0, 4.0, 2.5, 1.5),
            ),
        ),
    ),
}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--per-stratum", type=int, default=25, help="of each room")
    parser.add_argument("--height", type=int, default=115)
    parser.add_argument("--hours", type=int, default=40)
    parser.add_argument("--quality", default="draft")
    args = parser.parse_args()
    rng = np.random.default_rng(0)
    everything = []
    for name, setup in ROOMS.items():
        weather = synthetic_weather(setup.site).daylight()
        rows = np.sort(rng.choice(len(weather), args.hours, replace=False))
        part = weather[rows]
        truth = lit_room(setup, height=args.height, quality=args.quality, workers=1)
        light = light_at(part.t_utc, setup.site, part.dni_wm2, part.dhi_wm2)
        made = [truth.render(light[slice(k, k + 32)]) for k in range(0, len(light), 32)]
        data = {
            "luminance": np.concatenate([m.luminance_cdm2 for m in made]),
            "disc_lx": np.concatenate([m.disc_lx for m in made]),
            "sun": np.concatenate([m.light.apparent_sun_direction for m in made]),
        }
        heading = setup.camera.heading_deg
        azimuths = view_azimuths_deg(heading)
        views = panorama_views(*data["luminance"].shape[1:], heading, azimuths)
        ours = glare_directions(data["luminance"], views, data["sun"], data["disc_lx"])
        label = strata(ours, data["luminance"], data["sun"], data["disc_lx"], azimuths)
        found = compare(data, ours, label, azimuths, heading, rng, args.per_stratum, 800)
        print(f"\n### {name}\n")
        report(found, reference_version())
        everything += found
    print("\n### all rooms\n")
    report(everything, reference_version())


if __name__ == "__main__":
    main()
