"""Troubles of a real campaign in a simulated one: each has a size and a seed, as in troubles.toml.

A trouble changes the pictures or the instrument's readings. The stated session is unchanged: the
site, the room, the times of the slots and the sun patches computed from them.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Mask
from fieldlum.core.records import Site
from fieldlum.core.strict_toml import build, read_toml
from fieldlum.optics.projection import altitude_azimuth_deg, equirect_rays, signed_angle_deg
from fieldlum.sky import sun
from fieldlum.sky.daylight import Light
from fieldlum.sky.perez import reinhart_patches

# Sizes of the disturbances. Where no source is stated they are chosen to look like a campaign, not
# measured.
_CLOUD_WAVES = 12  # plane waves of the cloud field: their sum is nearly normal
_CLOUD_SCALE_RAD = 0.5  # correlation length, about 30 degrees
# DNI under broken clouds decorrelates within some hundred metres, with this sd of its logarithm.
_FAR_M = 500.0
_FAR_SD = 0.3
_KNOCKED_DAYS = (3, 6)  # first day of the knock and first day after it, counted from 0
_EVENING_H = 15.0  # local standard time from which lamps may be on
_LAMP_SPOTS = 20.0  # luminance of a luminaire over that of the wall that it lights
_PERSON_DEG = (12.0, 50.0)  # width and height of a person 2 m away, from the feet
_CHAIR_DEG = (18.0, 14.0)  # width and height of a chair's shadow on the floor
_CLIP_CDM2 = 1500.0  # largest luminance of a bracket without its shortest frames


@dataclass(frozen=True, slots=True)
class Trouble:
    """The size of a trouble, in its own unit, and the seed of its random part."""

    size: float
    seed: int = 1


@dataclass(frozen=True, slots=True)
class Troubles:
    """The troubles of a campaign; None: not present.

    clouds : sd of ln luminance of a smooth field over the sky, another in each hour; DHI is kept.
    distant_instrument : distance of the instrument, m; its DNI is that of other clouds.
    instrument_drift : relative change of its readings from the first to the last slot.
    horizon : altitude below which the instrument is in shade, deg.
    north : turn of room and camera, clockwise from the stated one, deg.
    clock_drift : delay of the stated times after a week, min; then the clock is set.
    knock : turn of the camera from the 4th to the 6th day, deg.
    lamps : luminance that lamps add to walls in some evenings, cd/m2.
    blind : share of light that a half-lowered blind removes on one day.
    people : share of the pictures with a person in them.
    chair : share of light that a moved chair removes from a part of the floor, from the middle day.
    exposures : relative sd of a picture's level by wrong exposure times.
    clipped : count of pictures without their shortest exposures.
    """

    clouds: Trouble | None = None
    distant_instrument: Trouble | None = None
    instrument_drift: Trouble | None = None
    horizon: Trouble | None = None
    north: Trouble | None = None
    clock_drift: Trouble | None = None
    knock: Trouble | None = None
    lamps: Trouble | None = None
    blind: Trouble | None = None
    people: Trouble | None = None
    chair: Trouble | None = None
    exposures: Trouble | None = None
    clipped: Trouble | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the troubles that are present, in the order of the fields."""
        return tuple(f.name for f in fields(self) if getattr(self, f.name) is not None)


def load_troubles(path: Path) -> Troubles:
    """Read troubles from TOML: a table for each, with `size` and, if not 1, `seed`.

    Raises InputError for a file that cannot be read, and for an unknown trouble or key.
    """
    return build(Troubles, read_toml(path), str(path))


# ----------------------------------------------------------------------------------------------
# light


@dataclass(frozen=True)
class CloudyLight(Light):
    """Light whose sky is Perez's times a smooth log-normal field, another one at each moment.

    cloud_sd, cloud_seed: sd of ln luminance and seed of the field.
    """

    cloud_sd: float = 0.0
    cloud_seed: int = 0

    def sky_at(self, directions: Floats) -> Floats32:
        """Return the luminance of the clouded sky, [n, m], cd/m2.

        The diffuse illuminance is that of the sky without the field; the ground below the horizon
        is unchanged.
        """
        out = super().sky_at(directions).copy()
        patches = reinhart_patches()
        weights = patches.solid_angles_sr * np.maximum(patches.directions[:, 2], 0.0)
        base = super().sky_at(patches.directions)  # [n, 2305]
        up = np.asarray(directions)[:, 2] > 0.0
        for k, t in enumerate(self.t_utc):
            rng = np.random.default_rng([self.cloud_seed, int(t.timestamp())])
            field, everywhere = _cloud_field(rng, self.cloud_sd, directions, patches.directions)
            unclouded = float(base[k] @ weights)
            factor = unclouded / max(float((base[k] * everywhere) @ weights), 1e-9)
            out[k, up] *= (factor * field[up]).astype(np.float32)
        return out


def _cloud_field(rng: np.random.Generator, sd: float, *directions: Floats) -> list[Floats]:
    """Return exp of a smooth normal field at each set of directions [m, 3], [m] each."""
    waves = rng.normal(0.0, 1.0 / _CLOUD_SCALE_RAD, (_CLOUD_WAVES, 3))
    phases = rng.uniform(0.0, 2.0 * np.pi, _CLOUD_WAVES)
    scale = sd * np.sqrt(2.0 / _CLOUD_WAVES)
    return [np.exp(scale * np.cos(d @ waves.T + phases).sum(axis=1)) for d in directions]


def true_light(light: Light, troubles: Troubles, site: Site) -> Light:
    """Return `light` as the room receives it with the troubles of clock, north and clouds.

    The result's sun azimuths are relative to the stated north; its times are still the stated ones.
    """
    altitude, azimuth = light.sun_altitude_deg, light.sun_azimuth_deg
    if troubles.clock_drift is not None:
        start = min(light.t_utc)
        late = [troubles.clock_drift.size * ((t - start) / timedelta(days=7)) for t in light.t_utc]
        # Planned days may be months apart; a clock is set again after a week.
        late = [minutes % troubles.clock_drift.size for minutes in late]
        times = [t + timedelta(minutes=m) for t, m in zip(light.t_utc, late, strict=True)]
        at = sun.position(times, site)
        altitude, azimuth = np.maximum(at.altitude_deg, 0.05), at.azimuth_deg
    if troubles.north is not None:
        azimuth = azimuth - troubles.north.size
    moved = replace(light, sun_altitude_deg=altitude, sun_azimuth_deg=azimuth)
    if troubles.clouds is None:
        return moved
    values = {f.name: getattr(moved, f.name) for f in fields(Light)}
    return CloudyLight(**values, cloud_sd=troubles.clouds.size, cloud_seed=troubles.clouds.seed)


def measured_irradiance(
    times_utc: Sequence[datetime],
    dni_wm2: Array,
    dhi_wm2: Array,
    altitude_deg: Array,
    troubles: Troubles,
) -> tuple[Array, Array]:
    """Return the DNI and DHI that the instrument reports with its troubles, [n] each, in W/m2.

    dni_wm2, dhi_wm2: the true ones, [n]; altitude_deg: of the sun, [n]. Troubles of the instrument
    are its distance, its horizon and its drift.
    """
    dni, dhi = np.array(dni_wm2, float), np.array(dhi_wm2, float)
    rise = np.maximum(np.sin(np.radians(altitude_deg)), 0.02)
    if troubles.distant_instrument is not None:
        far = troubles.distant_instrument
        sd = _FAR_SD * (1.0 - np.exp(-far.size / _FAR_M))
        total = dni * rise + dhi
        factor = [np.exp(sd * _normal(far.seed, t)) for t in times_utc]
        dni = np.minimum(dni * factor, 0.97 * total / rise)
        dhi = np.maximum(total - dni * rise, 0.0)
    if troubles.horizon is not None:
        dni = np.where(altitude_deg < troubles.horizon.size, 0.0, dni)
    if troubles.instrument_drift is not None and len(times_utc) > 1:
        seconds = np.array([t.timestamp() for t in times_utc])
        gain = 1.0 + troubles.instrument_drift.size * (seconds - seconds.min()) / np.ptp(seconds)
        dni, dhi = dni * gain, dhi * gain
    return dni, dhi


def _normal(seed: int, t_utc: datetime) -> float:
    """Return a normal random number of an hour, the same at all its seconds."""
    hour = int(t_utc.timestamp() // 3600)
    return float(np.random.default_rng([seed, hour]).standard_normal())


# ----------------------------------------------------------------------------------------------
# pictures


def troubled_pictures(
    luminance_cdm2: Floats32,
    window: Mask,
    slots: Sequence[datetime],
    all_slots: Sequence[datetime],
    timezone: str,
    troubles: Troubles,
) -> Floats32:
    """Return the pictures of `slots` with the troubles of room and camera, [n, H, W] cd/m2.

    luminance_cdm2: without troubles, [n, H, W]; window: pixels that see the sky, [H, W]; all_slots:
    times of the complete plan, by which days are counted; timezone: IANA name.
    """
    maps = luminance_cdm2.copy()
    for k, t in enumerate(slots):
        day, days = _day_of(t, all_slots, timezone)
        local = sun.standard_time(t, timezone)
        hour = local.hour + local.minute / 60.0
        maps[k] = _changed_room(maps[k], window, day, days, hour, troubles)
        knocked = knocked_camera(t, all_slots, timezone, troubles)
        maps[k] = _changed_picture(maps[k], t, all_slots, knocked, troubles)
    return maps


def _day_of(t_utc: datetime, all_slots: Sequence[datetime], timezone: str) -> tuple[int, int]:
    """Return the number of a slot's day in the plan, from 0, and the number of days."""
    days = sorted({sun.standard_date(t, timezone) for t in all_slots})
    return days.index(sun.standard_date(t_utc, timezone)), len(days)


def knocked_camera(
    t_utc: datetime, all_slots: Sequence[datetime], timezone: str, troubles: Troubles
) -> bool:
    """Return whether the camera is turned by a knock at a slot of the plan `all_slots`.

    timezone: IANA name, for the days of the plan.
    """
    day, _ = _day_of(t_utc, all_slots, timezone)
    return troubles.knock is not None and _KNOCKED_DAYS[0] <= day < _KNOCKED_DAYS[1]


def _changed_room(
    image: Array, window: Mask, day: int, days: int, hour: float, troubles: Troubles
) -> Array:
    """Return the picture with lamps, a blind and a chair, [H, W]."""
    out = image.copy()
    height, width = out.shape
    if troubles.lamps is not None and hour >= _EVENING_H:
        rng = np.random.default_rng([troubles.lamps.seed, day])
        if rng.random() < 0.5:
            lit = np.full_like(out, troubles.lamps.size)
            lit[height // 8 : height // 6, width // 8 :: width // 4] *= _LAMP_SPOTS
            out += np.where(window, 0.0, lit).astype(np.float32)
    blind = troubles.blind
    if blind is not None and day == int(np.random.default_rng(blind.seed).integers(days)):
        rows = np.flatnonzero(window.any(axis=1))
        upper = window & (np.arange(height)[:, None] <= np.median(rows))
        passed = 1.0 - blind.size
        out = np.where(upper, out * passed, out * (0.5 + 0.5 * passed)).astype(np.float32)
    if troubles.chair is not None and day >= days // 2:
        azimuth = float(np.random.default_rng(troubles.chair.seed).uniform(0.0, 360.0))
        where = _block(out.shape, azimuth, -35.0, _CHAIR_DEG)
        out[where] *= np.float32(1.0 - troubles.chair.size)
    return out


def _changed_picture(
    image: Array, t_utc: datetime, all_slots: Sequence[datetime], knocked: bool, troubles: Troubles
) -> Array:
    """Return the picture with a person, a turn, wrong exposure times and clipping, [H, W]."""
    out = image
    if troubles.people is not None:
        rng = np.random.default_rng([troubles.people.seed, int(t_utc.timestamp())])
        if rng.random() < troubles.people.size:
            body = _block(out.shape, rng.uniform(0.0, 360.0), -20.0, _PERSON_DEG)
            out = np.where(body, np.float32(0.3 * np.median(out)), out)
    if troubles.knock is not None and knocked:
        shift = troubles.knock.size / 360.0 * out.shape[1]
        columns = int(np.floor(shift))
        near, far = np.roll(out, -columns, axis=1), np.roll(out, -columns - 1, axis=1)
        part = shift - columns
        out = (near * (1.0 - part) + far * part).astype(np.float32)
    if troubles.exposures is not None:
        rng = np.random.default_rng([troubles.exposures.seed, int(t_utc.timestamp())])
        out = out * np.float32(np.exp(troubles.exposures.size * rng.standard_normal()))
    if (clipped := troubles.clipped) is not None:
        # a random order of the slots, the same in each process
        texts = {t: f"{clipped.seed} {t.timestamp():.0f}".encode() for t in all_slots}
        if t_utc in sorted(texts, key=lambda t: zlib.crc32(texts[t]))[: int(clipped.size)]:
            out = np.minimum(out, np.float32(_CLIP_CDM2))
    return out


def _block(
    shape: tuple[int, int], azimuth_deg: float, altitude_deg: float, size_deg: tuple[float, float]
) -> Mask:
    """Return the pixels of an upright rectangle; its azimuth counts from the heading, [H, W].

    size_deg: its width and its height.
    """
    altitude, azimuth = altitude_azimuth_deg(equirect_rays(*shape, 0.0))
    away = np.abs(signed_angle_deg(azimuth - azimuth_deg))
    return (away < size_deg[0] / 2) & (np.abs(altitude - altitude_deg) < size_deg[1] / 2)
