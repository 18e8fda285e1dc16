"""Provide the scenes of simulated devices: a session's truth/ folder, or an office.

`fieldlum simulate` writes truth/: ``<slot>.exr``, a panorama with its sun, ``<slot>.sky.npz``, the
same around the windows as finely as the sensor, and ``irradiance.csv`` with the columns t_utc,
ghi_wm2, dhi_wm2, dni_wm2, sorted by time. Irradiance between its rows is interpolated; before and
after them it is 0. Without truth/ an office is simulated: a box with one level of light, with sky
and ground behind its windows, for rehearsals.

"""

from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta
from functools import cached_property, lru_cache
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
    """Irradiance at one time [W/m2]: global and diffuse horizontal, and direct normal."""

    ghi_wm2: float
    dhi_wm2: float
    dni_wm2: float


@dataclass(frozen=True, slots=True)
class DetailedPanorama(Panorama):
    """A panorama with a finer picture of the directions around the windows.

    detail: its luminance in cd/m2, [h, w]; where that is NaN, the panorama counts.
    """

    detail: SkyPicture | None = None


def detail_of(panorama: Panorama) -> SkyPicture | None:
    """Return the finer picture of a part of a panorama; None if it has none."""
    return panorama.detail if isinstance(panorama, DetailedPanorama) else None


class TruthWorld:
    """The simulated place of a session: the panoramas and irradiance in its folder truth/.

    Raises InputError if irradiance.csv in that folder cannot be used.
    """

    def __init__(self, folder: Path) -> None:
        self._panoramas = {
            datetime.strptime(path.stem, "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC): path
            for path in sorted(folder.glob("[0-9]*Z.exr"))
        }
        self._light = CleanIrradiance.read_truth(folder / "irradiance.csv")
        self._read = lru_cache(maxsize=2)(_read_panorama)

    def scene(self, t_utc: datetime) -> Panorama:
        """Return the rendered panorama that is nearest in time.

        Raises DeviceError without one within 45 minutes, InputError for a file of another kind.
        """
        nearest = min(self._panoramas, key=lambda t: abs(t - t_utc), default=None)
        if nearest is None or abs(nearest - t_utc) > timedelta(minutes=45):
            found = f"no simulated panorama within 45 min of {t_utc:%Y-%m-%d %H:%M} UTC"
            raise DeviceError(f"simulated camera: {found}; run fieldlum simulate for that hour")
        return self._read(self._panoramas[nearest])

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        """Return the irradiance at a time, interpolated linearly between rows of irradiance.csv.

        It is 0 before the first and after the last row.
        """
        now_s, times_s = t_utc.timestamp(), self._light.t_unix_s
        columns = ((name, getattr(self._light, name)) for name in SimulatedLight._fields)
        light = {name: np.interp(now_s, times_s, wm2, left=0.0, right=0.0) for name, wm2 in columns}
        return SimulatedLight(**{name: float(wm2) for name, wm2 in light.items()})


def _read_panorama(path: Path) -> Panorama:
    """Return a panorama of truth/, with its finer picture if that file exists too."""
    from fieldlum.optics.images import read_panorama

    panorama, detail_path = read_panorama(path), path.with_suffix(SUFFIX)
    if not detail_path.is_file():
        return panorama
    values = {f.name: getattr(panorama, f.name) for f in fields(Panorama)}
    return DetailedPanorama(**values, detail=read_sky_picture(detail_path))


# ----------------------------------------------------------------------------------------------
# the office

SEATTLE = Site("office", 47.6, -122.3, "America/Los_Angeles", 50.0)  # latitude, longitude, m
# The office of Liu, Colburn and Inanici (2020): 6 x 14 x 4.5 m, one glazed south wall.
OFFICE = Room(window=(Window("south", left_m=0.5, width_m=5.0, sill_m=0.9, height_m=3.2, panes=3),))
_HEIGHT = 230  # rows of the panorama, for speed
_LM_PER_W = 115.0  # luminous efficacy of daylight, typical
_DAYLIGHT_FACTOR = 0.05  # of a room with large windows: 5 % or more (CIBSE LG10)


class Office:
    """A simulated office under a sky with random clouds; no sun shines into it.

    setup : whose room is simulated at its site if it is a box with windows, else `OFFICE` is; None:
    `OFFICE` in Seattle.
    """

    def __init__(self, setup: SiteFile | None = None, seed: int = 1) -> None:
        """Prepare the room; seed: of the clouds of each day."""
        self.setup = setup or SiteFile(SEATTLE, CameraSetup(), OFFICE)
        room = self.setup.room
        self._room = room if room is not None and room.kind == "box" and room.window else OFFICE
        self._seed = seed
        self._scene_of = lru_cache(maxsize=2)(self._scene)
        self._light_of = lru_cache(maxsize=16)(self._light_at)

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        """Return the irradiance at the start of the minute: Ineichen's clear sky, with clouds.

        One covered share, which `seed` and the UTC day choose, holds for the day.
        """
        return self._light_of(t_utc.replace(second=0, microsecond=0))

    def _light_at(self, t_utc: datetime) -> SimulatedLight:
        """Return the irradiance of a clear sky changed by the day's clouds.

        Clouds remove the beam and scatter a part of it, most under a broken sky. Factors are chosen
        to look plausible.
        """
        rng = np.random.default_rng([self._seed, t_utc.toordinal()])
        clouds = rng.choice([0.02, 0.1, 0.35, 0.6, 0.95])  # covered share: clear to overcast
        clear = sun.clearsky([t_utc], self.setup.site)
        altitude = np.radians(sun.position([t_utc], self.setup.site).altitude_deg[0])
        dni = float(clear.dni_wm2[0]) * max(1.0 - 1.4 * clouds, 0.0)
        scattered = float(clear.dhi_wm2[0]) * (1.0 + 1.6 * clouds * (1.0 - clouds))
        dhi = scattered + 0.25 * clouds * float(clear.ghi_wm2[0])
        ghi = dhi + dni * max(float(np.sin(altitude)), 0.0)
        return SimulatedLight(ghi_wm2=ghi, dhi_wm2=dhi, dni_wm2=dni)

    def scene(self, t_utc: datetime) -> Panorama:
        """Return the office's panorama at the start of the minute; it has no sun's disc."""
        return self._scene_of(t_utc.replace(second=0, microsecond=0))

    @cached_property
    def _shares(self) -> tuple[Floats, Floats]:
        """Luminance of each pixel per global and per diffuse illuminance [cd/m2 per lx], each [n].

        Surfaces outdoors receive the global illuminance, and the sky is as bright as the diffuse
        one makes it. All surfaces indoors have one illuminance, by a daylight factor that is
        typical of a room with large windows.
        """
        view = traced_view(self._room, _HEIGHT, self.setup.camera.heading_deg, 1)
        samples = view.samples  # surfaces that each pixel shows
        factor = np.where(np.isin(samples.box, view.scene.of_kind("ground")), 1.0, _DAYLIGHT_FACTOR)
        reflected = samples.weight * view.scene.reflectance[samples.box] * factor
        ground = self._room.reflectance_ground * view.plain.ravel()
        surfaces = np.bincount(samples.pixel, reflected, len(ground)) + ground
        return surfaces / np.pi, view.sky.ravel() / np.pi

    def _scene(self, t_utc: datetime) -> Panorama:
        """Return the panorama of the office at a time."""
        light, (surfaces, sky) = self.irradiance(t_utc), self._shares
        luminance = _LM_PER_W * (surfaces * light.ghi_wm2 + sky * light.dhi_wm2) + 1e-3
        heading_deg = self.setup.camera.heading_deg
        return Panorama(luminance.reshape(_HEIGHT, -1).astype(np.float32), heading_deg, t_utc=t_utc)


World = TruthWorld | Office
"""A simulated place: `scene` is its panorama, and `irradiance` its irradiance, at any time."""


def open_world(session: Session | None, seed: int) -> World:
    """Return the place that simulated devices see: a session's truth/, or a simulated office.

    `fieldlum simulate` writes truth/; without its irradiance.csv an office is simulated. That is
    the session's room if it is a box with windows, else a built-in one, at the session's site, or
    in Seattle without a session. seed : of the office's clouds. Raises InputError for a SITE.toml
    or irradiance.csv that cannot be used.
    """
    if session is not None and session.truth_irradiance.is_file():
        return TruthWorld(session.truth)
    return Office(session.site_file() if session is not None else None, seed)
