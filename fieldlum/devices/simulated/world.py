"""Provide the scenes of simulated devices: a session's truth/ folder, or an office.

`fieldlum simulate` writes truth/: ``<slot>.exr``, a panorama with its sun, ``<slot>.sky.npz``, the
same around the windows as finely as the sensor, and ``irradiance.csv`` with the columns t_utc,
ghi_wm2, dhi_wm2, dni_wm2, sorted by time. Irradiance between its rows is interpolated; before and
after them it is 0. Without truth/ an office is simulated: a box with one level of light, with sky
and ground behind its windows, for rehearsals.

"""

from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import DeviceError
from fieldlum.core.records import CameraSetup, Panorama, Room, Site, SiteFile, Window
from fieldlum.room.scene import traced_view
from fieldlum.session import Session
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.sky import sun
from fieldlum.sky.sky_view.picture import SUFFIX, SkyPicture, read_sky_picture


class SimulatedLight(NamedTuple):
    """Horizontal global and diffuse, and direct normal irradiance, in W/m2."""

    ghi_wm2: float
    dhi_wm2: float
    dni_wm2: float


@dataclass(frozen=True, slots=True)
class DetailedPanorama(Panorama):
    """A panorama with a finer picture of a part of it.

    detail: luminance in cd/m2 [h, w]; where it is NaN, the panorama counts. None for no detail.
    """

    detail: SkyPicture | None = None


def detail_of(panorama: Panorama) -> SkyPicture | None:
    """Return the finer part of a panorama, None without one."""
    return panorama.detail if isinstance(panorama, DetailedPanorama) else None


class TruthWorld:
    """A `World` from a session's truth/ folder: rendered panoramas and simulated irradiance.

    Raises InputError if its irradiance.csv cannot be used.
    """

    def __init__(self, folder: Path) -> None:
        self._panoramas = {
            datetime.strptime(path.stem, "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC): path
            for path in sorted(folder.glob("[0-9]*Z.exr"))
        }
        self._light = CleanIrradiance.read_truth(folder / "irradiance.csv")
        self._read = lru_cache(maxsize=2)(_read_panorama)

    def scene(self, t_utc: datetime) -> Panorama:
        """Return the panorama nearest in time. Raises DeviceError without one within 45 minutes.

        Raises InputError for a file that is no panorama.
        """
        nearest = min(self._panoramas, key=lambda t: abs(t - t_utc), default=None)
        if nearest is None or abs(nearest - t_utc) > timedelta(minutes=45):
            found = f"no simulated panorama within 45 min of {t_utc:%Y-%m-%d %H:%M} UTC"
            raise DeviceError(f"simulated camera: {found}; run fieldlum simulate for that hour")
        return self._read(self._panoramas[nearest])

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        """Return the irradiance at a time, linear between rows.

        It is 0 before the first and after the last row.
        """
        now = t_utc.timestamp()
        times = self._light.t_unix_s
        if not times[0] <= now <= times[-1]:
            return SimulatedLight(ghi_wm2=0.0, dhi_wm2=0.0, dni_wm2=0.0)
        columns = {name: getattr(self._light, name) for name in SimulatedLight._fields}
        return SimulatedLight(**{n: float(np.interp(now, times, v)) for n, v in columns.items()})


def _read_panorama(path: Path) -> Panorama:
    from fieldlum.optics.images import read_panorama

    panorama, fine = read_panorama(path), path.with_suffix(SUFFIX)
    if not fine.is_file():
        return panorama
    values = {f.name: getattr(panorama, f.name) for f in fields(Panorama)}
    return DetailedPanorama(**values, detail=read_sky_picture(fine))


# ----------------------------------------------------------------------------------------------
# the office

SEATTLE = Site("office", 47.6, -122.3, "America/Los_Angeles", 50.0)
# The office of Liu, Colburn and Inanici (2020): 6 x 14 x 4.5 m, one glazed south wall.
OFFICE = Room(window=(Window("south", left_m=0.5, width_m=5.0, sill_m=0.9, height_m=3.2, panes=3),))
_HEIGHT = 230  # rows of the panorama, for speed
_LM_PER_W = 115.0  # luminous efficacy of daylight, typical
_DAYLIGHT_FACTOR = 0.05  # of a room with large windows: 5 % or more (CIBSE LG10)


class Office:
    """A `World`: an office under a sky with random clouds, by `seed`; no sun shines into it.

    It is the room of `setup` if that is a box with windows, else a built-in office; the sun is that
    of the site of `setup` (default: Seattle).
    """

    def __init__(self, setup: SiteFile | None = None, seed: int = 1) -> None:
        """Use the room of `setup`, or `OFFICE` if that is no box with windows; seed: of clouds."""
        self.setup = setup or SiteFile(SEATTLE, CameraSetup(), OFFICE)
        room = self.setup.room
        self._room = room if room is not None and room.kind == "box" and room.window else OFFICE
        self._seed = seed
        self._scene_of = lru_cache(maxsize=2)(self._scene)
        self._fixed = cache(self._shares)
        self._light_of = lru_cache(maxsize=16)(self._light_at)

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        """Return Ineichen's clear sky changed by the day's clouds [W/m2], for each minute."""
        return self._light_of(t_utc.replace(second=0, microsecond=0))

    def _light_at(self, t_utc: datetime) -> SimulatedLight:
        """Return a clear sky changed by the day's clouds [W/m2]; factors chosen to look plausible.

        Clouds remove the beam and scatter a part of it, most under a broken sky.
        """
        day = np.random.default_rng([self._seed, t_utc.toordinal()])
        clouds = day.choice([0.02, 0.1, 0.35, 0.6, 0.95])  # clear, mixed or overcast
        clear = sun.clearsky([t_utc], self.setup.site)
        altitude = np.radians(sun.position([t_utc], self.setup.site).altitude_deg[0])
        dni = float(clear.dni_wm2[0]) * max(1.0 - 1.4 * clouds, 0.0)
        scattered = float(clear.dhi_wm2[0]) * (1.0 + 1.6 * clouds * (1.0 - clouds))
        dhi = scattered + 0.25 * clouds * float(clear.ghi_wm2[0])
        ghi = dhi + dni * max(float(np.sin(altitude)), 0.0)
        return SimulatedLight(ghi_wm2=ghi, dhi_wm2=dhi, dni_wm2=dni)

    def scene(self, t_utc: datetime) -> Panorama:
        """Return the panorama at a time; it is computed for the start of the minute."""
        return self._scene_of(t_utc.replace(second=0, microsecond=0))

    def _shares(self) -> tuple[Floats, Floats]:
        """Return each pixel's luminance per illuminance of the ground outside, and of the sky.

        All surfaces indoors have one illuminance, by a daylight factor that is typical of a room
        with large windows.
        """
        view, room = traced_view(self._room, _HEIGHT, self.setup.camera.heading_deg, 1), self._room
        s = view.samples
        outside = np.isin(s.box, view.scene.of_kind("ground"))
        factor = np.where(outside, 1.0, _DAYLIGHT_FACTOR)
        shown = s.weight * view.scene.reflectance[s.box] * factor
        ground = room.reflectance_ground * view.plain.ravel()
        return (np.bincount(s.pixel, shown, len(ground)) + ground) / np.pi, view.sky.ravel() / np.pi

    def _scene(self, t_utc: datetime) -> Panorama:
        light, (lit, sky) = self.irradiance(t_utc), self._fixed()
        luminance = _LM_PER_W * (lit * light.ghi_wm2 + sky * light.dhi_wm2) + 1e-3
        heading_deg = self.setup.camera.heading_deg
        return Panorama(luminance.reshape(_HEIGHT, -1).astype(np.float32), heading_deg, t_utc=t_utc)


World = TruthWorld | Office
"""A simulated place: its picture and its irradiance at any time."""


def open_world(session: Session | None, seed: int) -> World:
    """Return the session's truth/ if it has irradiance.csv, or else a simulated office.

    `fieldlum simulate` writes truth/. The office is the session's room if that is a box with
    windows, else a built-in one; it is at the session's site, or in Seattle without a session. seed
    : of its clouds. Raises InputError for a bad SITE.toml or irradiance.csv.
    """
    if session is not None and session.truth_irradiance.is_file():
        return TruthWorld(session.truth)
    return Office(session.site_file() if session is not None else None, seed)
