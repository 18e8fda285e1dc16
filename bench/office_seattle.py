"""Turn the team's 1 378 rendered hours of the paper's office into a folder that `fieldlum train`
and `bench` read.

    python bench/office_seattle.py office_seattle.npz FOLDER [--height 58]

writes FOLDER/<set>.csv for every set (k200, 9d, 12d, 4d, mar, sep, test), test100.csv (every fifth
test hour), all.csv, pictures as EXR, site.toml. --height: rows of the pictures, by area means; 115
in the archive. The archive itself is described with it; it
is not part of the project.
"""

from __future__ import annotations

import argparse
import csv
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np

from fieldlum.core.records import Panorama, utc_text
from fieldlum.optics.images import write_panorama

HEADING_DEG = 180.0
STANDARD_TIME = timedelta(hours=-8)
YEAR = 2027
SITE = """\
[site]
name = "Office of Liu, Colburn, Inanici 2020"
latitude_deg = 47.6
longitude_deg = -122.3
timezone = "America/Los_Angeles"

[camera]
heading_deg = 180.0
height_m = 1.6

[room]
kind = "box"
width_m = 6.0
depth_m = 14.0
height_m = 4.5
camera_x_m = 3.0
camera_y_m = 3.0
camera_z_m = 1.6
wall_thickness_m = 0.25

[[room.window]]
wall = "south"
left_m = 0.5
width_m = 5.0
sill_m = 0.9
height_m = 3.1
transmittance = 0.88
panes = 4
frame_m = 0.08
transom_m = 2.9
"""


def decode(codes: np.ndarray) -> np.ndarray:
    """uint16 to cd/m2."""
    return (10.0 ** (codes.astype(np.float64) / 65535.0 * 9.0 - 0.5)).astype(np.float32)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("archive", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--height", type=int, default=115)
    options = parser.parse_args()
    archive, folder = options.archive, options.folder
    with np.load(archive, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in stored.files}
    (folder / "maps").mkdir(parents=True, exist_ok=True)
    (folder / "patches").mkdir(exist_ok=True)
    (folder / "site.toml").write_text(SITE, encoding="utf-8")
    rows = [_write_hour(k, arrays, folder, options.height) for k in range(len(arrays["lum"]))]
    sets = {name.removeprefix("set_"): arrays[name] for name in arrays if name.startswith("set_")}
    for name, index in {**sets, "test100": sets["test"][::5], "all": np.arange(len(rows))}.items():
        with (folder / f"{name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]))
            writer.writeheader()
            writer.writerows(rows[k] for k in index)
        print(f"{folder / name}.csv: {len(index)} hours")


def _write_hour(
    k: int, arrays: dict[str, np.ndarray], folder: Path, height: int
) -> dict[str, object]:
    month, day, hour, dni, dhi, altitude, azimuth = arrays["conditions"][k, :7]
    local = datetime(YEAR, int(month), int(day), tzinfo=UTC) + timedelta(hours=float(hour))
    t_utc = local - STANDARD_TIME
    row: dict[str, object] = {"t_utc": utc_text(t_utc), "panorama": f"maps/{k:04d}.exr"}
    luminance, patch = decode(arrays["lum"][k]), arrays["sunpatch"][k]
    direct = np.where(patch > 0, decode(patch), np.float32(0.0))
    if height != len(luminance):
        size = (2 * height, height)
        luminance, direct = (
            cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
            for picture in (luminance, direct)
        )
    write_panorama(folder / f"maps/{k:04d}.exr", Panorama(luminance, HEADING_DEG, t_utc=t_utc))
    write_panorama(folder / f"patches/{k:04d}.exr", Panorama(direct, HEADING_DEG, t_utc=t_utc))
    return row | {
        "dni_wm2": dni,
        "dhi_wm2": dhi,
        "sun_altitude_deg": f"{altitude:.5f}",
        "sun_azimuth_deg": f"{(azimuth + 180.0) % 360.0:.5f}",
        "sunpatch": f"patches/{k:04d}.exr",
        "sun_in_map": 1,
        "refraction": 0,
        "ok": 1,
    }


if __name__ == "__main__":
    main()
