"""Correct captures by a scene: north, clock and room, and the sun patches that follow."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from typing import TYPE_CHECKING

import numpy as np

from fieldlum.core.records import Progress, Room, quiet
from fieldlum.optics.projection import signed_angle_deg
from fieldlum.room.scene import sun_patches
from fieldlum.sky import sun
from fieldlum.sky.light import Light

if TYPE_CHECKING:
    from fieldlum.learn.models.data import Dataset


def corrected(data: Dataset, north_deg: float, clock_min: float, room: Room) -> Dataset:
    """Return the captures relative to true north, with the sun at the true times, and a room.

    north_deg: correction of the stated heading; clock_min: by how much the stated times are late;
    room: its azimuth is relative to true north. Sun patches do not change: see `with_patches`.
    """
    heading_deg = (data.setup.camera.heading_deg + north_deg) % 360.0
    camera = replace(data.setup.camera, heading_deg=heading_deg)
    return replace(
        data,
        light=earlier(data.light, clock_min, data),
        heading_deg=(data.heading_deg + north_deg) % 360.0,
        setup=replace(data.setup, camera=camera, room=room),
        sky_view=None if data.sky_view is None else data.sky_view.turned(north_deg),
    )


def with_patches(data: Dataset, *, sub: int | None = None, progress: Progress = quiet) -> Dataset:
    """Return the captures with sun patches computed from the room of `data.setup`, not None.

    Patches are the luminance of surfaces by direct sun only, cd/m2 [n, H, W]. sub: as in
    `scene.sun_patches`. Raises InputError for an impossible room.
    """
    assert data.setup.room is not None
    made = sun_patches(
        data.setup.room,
        data.setup,
        data.light.shown_sun_direction,
        data.light.direct_lx,
        height=data.shape[0],
        heading_deg=data.heading_deg,
        sub=sub,
        progress=progress,
    )
    return replace(data, patch_cdm2=made.luminance_cdm2)


def earlier(light: Light, minutes: float, data: Dataset) -> Light:
    """Return the light with times and sun `minutes` earlier (negative: later).

    Irradiance does not change. Recorded sun angles are not computed again, but shifted by the sun's
    motion in that time, because a rendering has its own formula of the sun. data: the captures,
    only for their site.
    """
    if minutes == 0.0:
        return light
    site = data.setup.site
    times = tuple(t - timedelta(minutes=minutes) for t in light.t_utc)
    stated, true = sun.position(light.t_utc, site), sun.position(times, site)
    altitude = light.sun_altitude_deg + true.altitude_deg - stated.altitude_deg
    turn = signed_angle_deg(np.asarray(true.azimuth_deg - stated.azimuth_deg))
    azimuth = (light.sun_azimuth_deg + turn) % 360.0
    return replace(
        light, t_utc=times, sun_altitude_deg=altitude, sun_azimuth_deg=azimuth, perez=light.perez
    )
