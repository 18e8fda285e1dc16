"""Provide the scenes of simulated devices from a session's truth/ folder.

`fieldlum simulate` writes truth/: ``<slot>.exr``, a panorama with its sun, ``<slot>.sky.npz``, the
same around the windows as finely as the sensor, and ``irradiance.csv`` with the columns t_utc,
ghi_wm2, dhi_wm2, dni_wm2, sorted by time. Irradiance between its rows is interpolated; before and
after them it is 0.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Panorama
from fieldlum.session.files.truth_csv import TruthIrradiance
from fieldlum.sky.sky_view import SUFFIX, SkyPicture, read_sky_picture

# A panorama of the truth is used for times up to this far away, because slots are an hour apart.
# Chosen.
NEAREST_TRUTH = timedelta(minutes=45)


class SimulatedLight(NamedTuple):
    """Horizontal global and diffuse, and direct normal irradiance, in W/m2."""

    ghi_wm2: float
    dhi_wm2: float
    dni_wm2: float


@dataclass(frozen=True, slots=True)
class DetailedPanorama(Panorama):
    """A panorama with a finer picture of a part of it; where that is NaN, the panorama counts."""

    detail: SkyPicture | None = None


def detail_of(panorama: Panorama) -> SkyPicture | None:
    """Return the finer part of a panorama, None without one."""
    return panorama.detail if isinstance(panorama, DetailedPanorama) else None


class World(Protocol):
    """A simulated place: its picture and its irradiance at any time."""

    def scene(self, t_utc: datetime) -> Panorama:
        """Return the luminance panorama at a time."""
        ...

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        """Return the irradiance at a time."""
        ...


class TruthWorld:
    """A `World` from a session's truth/ folder: rendered panoramas and simulated irradiance.

    Raises InputError if its irradiance.csv cannot be used.
    """

    def __init__(self, folder: Path) -> None:
        self._panoramas = {
            datetime.strptime(path.stem, "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC): path
            for path in sorted(folder.glob("[0-9]*Z.exr"))
        }
        self._light = TruthIrradiance.read(folder / "irradiance.csv")
        self._read = lru_cache(maxsize=2)(_read_panorama)

    def scene(self, t_utc: datetime) -> Panorama:
        """Return the panorama nearest in time. Raises DeviceError without one within 45 minutes.

        Raises InputError for a file that is no panorama.
        """
        nearest = min(self._panoramas, key=lambda t: abs(t - t_utc), default=None)
        if nearest is None or abs(nearest - t_utc) > NEAREST_TRUTH:
            raise DeviceError(
                f"simulated camera: no simulated panorama within 45 min of {t_utc:%Y-%m-%d %H:%M} "
                "UTC; "
                "simulate that hour with fieldlum simulate"
            )
        return self._read(self._panoramas[nearest])

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        """Return the irradiance at a time, linear between rows.

        It is 0 before the first and after the last row.
        """
        now = t_utc.timestamp()
        times = self._light.t_unix_s
        if not times[0] <= now <= times[-1]:
            return SimulatedLight(0.0, 0.0, 0.0)
        columns = self._light.ghi_wm2, self._light.dhi_wm2, self._light.dni_wm2
        return SimulatedLight(*(float(np.interp(now, times, column)) for column in columns))


def _read_panorama(path: Path) -> Panorama:
    from fieldlum.optics.images import read_panorama

    panorama, fine = read_panorama(path), path.with_suffix(SUFFIX)
    if not fine.is_file():
        return panorama
    values = {f.name: getattr(panorama, f.name) for f in fields(Panorama)}
    return DetailedPanorama(**values, detail=read_sky_picture(fine))
