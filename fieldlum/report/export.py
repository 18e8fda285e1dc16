"""Write what was measured in the files of other programs: Radiance, honeybee, netCDF, csv."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import Progress, Room, quiet
from fieldlum.optics.images import write_radiance_hdr
from fieldlum.optics.projection import direction
from fieldlum.room.fit.scene_file import SCENE_TOML, read_scene
from fieldlum.room.scene.geometry import build
from fieldlum.room.scene.radiance import rad_text
from fieldlum.session import Session, replacing, replacing_path
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.session.panorama_sun import read_panorama_with_sun
from fieldlum.sky.sky_view import SkyView
from fieldlum.year.glare.fisheye import FISHEYE_VIEW, panorama_to_fisheye
from fieldlum.year.glare.single import valid_pixels
from fieldlum.year.predict import read_annual
from fieldlum.year.predict.annual import time_coordinate

if TYPE_CHECKING:
    import xarray as xr

_FISHEYE_PX = 800  # evalglare's documentation recommends at least this; its -vta pictures
_NORTH = "# y points to azimuth"  # begins a room.rad of `export`
_PAIR_COLUMNS = ("dni_wm2", "dhi_wm2", "sun_altitude_deg", "sun_azimuth_deg")


def export(
    session: Session, out: Path, azimuths_deg: Sequence[float] = (), progress: Progress = quiet
) -> list[Path]:
    """Write everything that a session has, and return the files.

    maps/SLOT-AZ.hdr: Radiance fisheyes with VIEW and the sun, facing `azimuths_deg` (clockwise from
    true north; the camera's heading if empty). sky_view.csv: the share of the sun's beam that
    arrives from each direction, with its 95 % bounds, empty where no lens saw. room.rad: the fitted
    room, else the stated one, in room axes. pairs.nc, year.nc: netCDF 3 with units. Raises
    InputError for a damaged file.
    """
    panoramas = session.panorama_files()
    if not panoramas and not session.annual_folders():
        raise InputError(session.root, "no merged map and no year", "results", "run fieldlum merge")
    out.mkdir(parents=True, exist_ok=True)
    files = [
        *_sky(session, out),
        *_room(session, out),
        *_pairs(session, out),
        *_year(session, out),
    ]
    (out / "maps").mkdir(exist_ok=True)
    for number, path in enumerate(panoramas):
        progress(number, len(panoramas), "maps")
        panorama = read_panorama_with_sun(path)
        light, _ = valid_pixels(panorama, path)
        asked = azimuths_deg or (panorama.heading_deg,)
        for azimuth in dict.fromkeys(round(a % 360.0, 1) % 360.0 for a in asked):
            picture = panorama_to_fisheye(
                light, panorama.heading_deg, azimuth, size=_FISHEYE_PX, sun=panorama.sun
            )
            toward = " ".join(f"{value:.6f}" for value in direction(0.0, azimuth))
            view = f"{FISHEYE_VIEW} -vp 0 0 0 -vd {toward} -vu 0 0 1"
            target = out / "maps" / f"{path.stem}-{azimuth:g}.hdr"
            with replacing_path(target) as temporary:
                write_radiance_hdr(temporary, picture, view=view)
            files.append(target)
    return files


def _sky(session: Session, out: Path) -> list[Path]:
    """Write the sky view as a csv of its directions, one for each degree above the horizon."""
    view = SkyView.find(session.root / "sky_view.exr")
    if view is None:
        return []
    altitude, azimuth = (part.ravel() for part in np.mgrid[0:91, 0:360].astype(float))
    through = view.sharp.at(direction(altitude, azimuth))
    table = out / "sky_view.csv"
    with replacing(table, "w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(("altitude_deg", "azimuth_deg", "beam_share", "low", "high"))
        for place in zip(altitude, azimuth, *through, strict=True):
            rows.writerow("" if np.isnan(value) else f"{value:.4g}" for value in place)
    return [table]


def _room(session: Session, out: Path) -> list[Path]:
    scene = session.root / "scene"
    room: Room | None = session.site_file().room
    if (scene / SCENE_TOML).is_file():
        found = read_scene(scene)
        room = found.room if found.chosen == "fitted" else room
    if room is None or room.kind != "box":
        return []
    path = out / "room.rad"
    if path.is_file() and not path.read_bytes().startswith(_NORTH.encode()):
        raise InputError(
            path, "a file that export did not write", "another folder", "choose another --out"
        )
    north = f"{_NORTH} {(room.wall_azimuth_deg + 180) % 360:g} deg from true north\n"
    with replacing(path, "w", encoding="utf-8") as file:
        file.write(north + rad_text(build(room)))
    return [path]


def _pairs(session: Session, out: Path) -> list[Path]:
    pairs = PairsFile.find(session.pairs).usable
    if not pairs:
        return []
    import xarray as xr

    units = ("W m-2", "W m-2", "degree", "degree")
    columns = {
        name: ("time", [getattr(row, name) for row in pairs], {"units": unit})
        for name, unit in zip(_PAIR_COLUMNS, units, strict=True)
    }
    columns["panorama"] = ("time", [row.panorama for row in pairs], {})
    coordinates = {"time": time_coordinate([row.t_utc for row in pairs])}
    return [_netcdf(xr.Dataset(columns, coordinates), out / "pairs.nc")]


def _year(session: Session, out: Path) -> list[Path]:
    years = sorted(session.annual_folders(), key=lambda f: (f / "predict.json").stat().st_mtime)
    return [_netcdf(read_annual(years[-1]).to_xarray(), out / "year.nc")] if years else []


def _netcdf(data: xr.Dataset, path: Path) -> Path:
    with replacing_path(path) as temporary:
        data.to_netcdf(temporary, engine="scipy", format="NETCDF3_64BIT")
    return path
