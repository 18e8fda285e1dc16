"""Write a rendered room as a folder that fieldlum reads.

    python bench/outside_rooms/make_case.py ROOM.toml OUT [NPZ]

OUT/tape/ has 9d.csv and test.csv without sun patches, and site.toml as a tape measure gives it;
OUT/exact/ has the renderer's own patches and the true heading, without a [room]; OUT/free/ is like
tape without the [room]. The npz is next to ROOM.toml.
"""

from __future__ import annotations

import csv
import datetime as dt
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from coding import decoded, write_hdr

YEAR = 2027
HEAD = [
    *("t_utc", "panorama", "dni_wm2", "dhi_wm2", "ghi_wm2", "source", "sun_altitude_deg"),
    *("sun_azimuth_deg", "steadiness", "sunpatch", "sun_in_map", "ok", "why"),
]


def without_room(site: str) -> str:
    """Return a site file without its [room], which is the last part."""
    return site.split("[room]")[0]


def write_case(room: Mapping[str, Any], npz: Path, out: Path) -> None:
    """Write pictures, csvs and sites of one room."""
    with np.load(npz) as file:
        data = {key: file[key] for key in file.files}
    (out / "panoramas").mkdir(parents=True, exist_ok=True)
    sites = {
        "tape": room["tape"],
        "exact": room["exact"],
        "free": without_room(room["tape"]),
    }
    for kind, site in sites.items():
        (out / kind).mkdir(exist_ok=True)
        (out / kind / "site.toml").write_text(site)
        for name in ("9d", "test"):
            with (out / kind / f"{name}.csv").open("w", newline="") as file:
                table = csv.writer(file)
                table.writerow(HEAD)
                for k in data["set_" + name]:
                    table.writerow(_row(room, data, int(k), out, kind))


def _row(room: Mapping[str, Any], data: dict[str, Any], k: int, out: Path, kind: str) -> list[Any]:
    month, day, hour, dni, dhi, altitude, azimuth = data["conditions"][k, :7]
    local = dt.datetime(YEAR, int(month), int(day), tzinfo=dt.UTC) + dt.timedelta(hours=hour)
    t = local - dt.timedelta(hours=room["hours_east"])
    stem = t.strftime("%Y%m%dT%H%M%SZ")
    for part in ("lum", "sunpatch"):
        path = out / "panoramas" / f"{stem}_{part}.hdr"
        if not path.exists():
            write_hdr(path, decoded(data[part][k]))
    ghi = round(dhi + dni * np.sin(np.radians(altitude)), 1)
    sun = (altitude, (azimuth + 180) % 360) if room.get("own_sun", True) else ("", "")
    patch = f"../panoramas/{stem}_sunpatch.hdr" if kind == "exact" else ""
    picture = f"../panoramas/{stem}_lum.hdr"
    light = (dni, dhi, ghi, "measured")
    return [t.strftime("%Y-%m-%dT%H:%M:%SZ"), picture, *light, *sun, 0, patch, 1, 1, ""]


def main() -> None:
    path, out = Path(sys.argv[1]), Path(sys.argv[2])
    room = tomllib.loads(path.read_text())
    write_case(room, Path(sys.argv[3]) if len(sys.argv) > 3 else path.parent / room["npz"], out)


if __name__ == "__main__":
    main()
