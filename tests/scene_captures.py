"""Captures of a box room on three days, with its exact sun patches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np

from fieldlum.core.records import CameraSetup, Room, Site, SiteFile, Window, slot_id
from fieldlum.learn.models.training_data import Dataset
from fieldlum.room.fit.guess import Guess, guess_of
from fieldlum.room.scene import sun_patches
from fieldlum.room.scene.view import traced_view
from fieldlum.sky import sun
from fieldlum.sky.daylight import Light

DAYS = ("2027-03-20", "2027-06-21", "2027-12-21")
SEATTLE = Site("test room", 47.6, -122.3, "America/Los_Angeles")
ROOM = Room(
    width_m=5.0,
    depth_m=6.0,
    height_m=3.0,
    camera_x_m=2.4,
    camera_y_m=3.0,
    camera_z_m=1.3,
    window=(Window("south", 0.6, 3.6, 0.8, 1.9, 0.85, 1, 0.0, 0.0),),
)


def room_captures(
    site: Site,
    room: Room,
    height: int,
    rest_cdm2: Callable[[Light], np.ndarray],
    days: tuple[str, ...] = DAYS,
) -> Dataset:
    """Return clear hours, every fourth one overcast.

    rest_cdm2: what the room shows besides its sun patches, broadcastable to [n, H, 2H].
    """
    times = [
        datetime.fromisoformat(day).replace(tzinfo=UTC) + timedelta(hours=hour)
        for day in days
        for hour in np.arange(15.5, 26.0, 1.0)
    ]
    at = sun.position(times, site)
    up = at.altitude_deg > 4.0
    times = [t for t, u in zip(times, up, strict=True) if u]
    count = len(times)
    light = Light(
        t_utc=tuple(times),
        dni_wm2=np.where(np.arange(count) % 4 == 3, 0.0, 700.0),
        dhi_wm2=np.full(count, 90.0),
        sun_altitude_deg=at.altitude_deg[up],
        sun_azimuth_deg=at.azimuth_deg[up],
    )
    setup = SiteFile(site, CameraSetup(heading_deg=180.0), room)
    patch = sun_patches(
        room, light.apparent_sun_direction, light.direct_lx, height=height, heading_deg=180.0
    )
    return Dataset(
        light,
        (rest_cdm2(light) + patch).astype(np.float32),
        None,
        np.zeros(count),
        180.0,
        np.array([sun.standard_date(t, site.timezone) for t in times], "datetime64[D]"),
        tuple(slot_id(t) for t in times),
        setup,
        np.ones((height, 2 * height), bool),
        np.zeros(count),
    )


def window_captures(site: Site, height: int) -> Dataset:
    """Return `room_captures` of `ROOM`: skylight, a bright window, light of the sun's direction."""

    def rest_cdm2(light: Light) -> np.ndarray:
        facing = np.maximum(light.sun_direction @ np.array([0.0, -1.0, 0.0]), 0.0)
        base = 0.004 * light.diffuse_lx + 0.002 * facing * light.direct_lx
        glass = traced_view(ROOM, height, 180.0).sky
        return base[:, None, None] + 0.3 * light.diffuse_lx[:, None, None] * glass

    return room_captures(site, ROOM, height, rest_cdm2)


def shifted(by_m: float) -> Guess:
    """Return `ROOM` as a guess with its window moved to the east."""
    guess = guess_of(ROOM)
    (rect,) = guess.windows
    u_m = (rect.u_m[0] + by_m, rect.u_m[1] + by_m)
    return replace(guess, windows=(replace(rect, u_m=u_m),))
