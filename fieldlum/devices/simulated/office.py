"""Simulate an office: a box lit by sky, ground and sun through its windows.

The simulation is in closed form and fast, but not physically accurate: window form factors,
split-flux interreflection, one sun patch. `fieldlum simulate` renders an accurate truth with
Radiance.
"""

from __future__ import annotations

import math
from datetime import UTC, datetime
from functools import lru_cache

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import CameraSetup, Panorama, Room, Site, SiteFile, SunSource, Window
from fieldlum.devices.simulated.world import SimulatedLight, TruthWorld, World
from fieldlum.optics import projection
from fieldlum.session import Session
from fieldlum.sky import sun

SEATTLE = Site("office", 47.6, -122.3, "America/Los_Angeles", 50.0)
# The office of Liu, Colburn and Inanici (2020): 6 x 14 x 4.5 m, one glazed south wall.
OFFICE = Room(window=(Window("south", left_m=0.5, width_m=5.0, sill_m=0.9, height_m=3.2, panes=3),))
_HEIGHT = 230  # rows of the panorama; chosen for speed
_LIGHT_STEP_S = 600  # seconds between computed skies; chosen for speed
# Luminous efficacies of sun and sky, typical of clear skies; chosen, not computed for each sky.
_LM_PER_W_SUN = 93.0
_LM_PER_W_SKY = 120.0


def _wall_frames(room: Room) -> dict[str, tuple[Floats, Floats, Floats]]:
    """Return lower left corner, right vector and inward normal of each wall, in room axes.

    Left and right are as seen from inside.
    """
    w, d = room.width_m, room.depth_m
    x, y = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    return {
        "south": (np.array([w, 0, 0]), -x, y),  # seen from inside, east is on the left
        "north": (np.array([0, d, 0]), x, -y),
        "east": (np.array([w, d, 0]), -y, -x),
        "west": (np.array([0, 0, 0]), y, x),
    }


class _Geometry:
    """The part of the office that does not change: view of each pixel, form factors of windows."""

    def __init__(self, room: Room, heading_deg: float) -> None:
        self.room = room
        rays = projection.equirect_rays(_HEIGHT, 2 * _HEIGHT, heading_deg).reshape(-1, 3)
        self.to_room = _turn(room.wall_azimuth_deg)
        self.rays = rays @ self.to_room.T
        self.eye = np.array([room.camera_x_m, room.camera_y_m, room.camera_z_m])
        size = np.array([room.width_m, room.depth_m, room.height_m])
        with np.errstate(divide="ignore"):
            reach = np.where(self.rays > 0, (size - self.eye) / self.rays, -self.eye / self.rays)
        reach[self.rays == 0] = np.inf
        axis = reach.argmin(axis=1)
        self.points = self.eye + self.rays * reach.min(axis=1)[:, None]
        self.normals = np.zeros_like(self.points)
        row = np.arange(len(axis))
        self.normals[row, axis] = -np.sign(self.rays[row, axis])
        self.glass = self.through_glass(self.eye, self.rays)
        level = (room.reflectance_walls, room.reflectance_ceiling, room.reflectance_floor)
        upright = self.normals[:, 2]
        self.reflectance = np.select(
            [upright < -0.5, upright > 0.5], [level[1], level[2]], level[0]
        )
        self.sky_factor, self.ground_factor = self._window_factors()

    def through_glass(self, start: Floats, rays: Floats) -> Floats:
        """Return the transmittance [n] of rays [n, 3] to the outside; `start` is [3] or [n, 3].

        It is 0 where a wall blocks the ray.
        """
        transmittance = np.zeros(len(rays))
        for window in self.room.window:
            corner, right, inward = _wall_frames(self.room)[window.wall]
            towards = rays @ -inward
            with np.errstate(divide="ignore", invalid="ignore"):
                hit = start + rays * (((corner - start) @ -inward) / towards)[:, None]
            across, up = (hit - corner) @ right - window.left_m, hit[:, 2] - window.sill_m
            inside = (
                (towards > 1e-9)
                & (across > 0)
                & (across < window.width_m)
                & (up > 0)
                & (up < window.height_m)
            )
            pane = np.mod(across, window.width_m / max(window.panes, 1))
            clear = (pane > window.frame_m / 2) & (
                pane < window.width_m / max(window.panes, 1) - window.frame_m / 2
            )
            transmittance[inside & clear] = window.transmittance
        return transmittance

    def _window_factors(self) -> tuple[Floats, Floats]:
        """Return form factor times transmittance of the windows to sky and to ground, [n] each."""
        sky, ground = np.zeros(len(self.points)), np.zeros(len(self.points))
        for window in self.room.window:
            corner, right, inward = _wall_frames(self.room)[window.wall]
            columns, rows = 6, 4
            cell = window.width_m * window.height_m / (columns * rows)
            for i in range(columns):
                for j in range(rows):
                    at = corner + right * (window.left_m + (i + 0.5) / columns * window.width_m)
                    at = at + np.array([0, 0, window.sill_m + (j + 0.5) / rows * window.height_m])
                    way = at - self.points
                    far2 = np.maximum((way**2).sum(axis=1), cell / 4)
                    unit = way / np.sqrt(far2)[:, None]
                    factor = np.maximum((unit * self.normals).sum(axis=1), 0) * np.maximum(
                        unit @ -inward, 0
                    )
                    factor = factor * cell / (np.pi * far2) * window.transmittance
                    sky += np.where(unit[:, 2] > 0, factor, 0)
                    ground += np.where(unit[:, 2] <= 0, factor, 0)
        return np.minimum(sky, 1.0), np.minimum(ground, 1.0)


def _turn(wall_azimuth_deg: float) -> Floats:
    """Return the rotation from world axes (x east, y north) to room axes, [3, 3].

    The room's -y points to the azimuth of the wall.
    """
    angle = np.radians(wall_azimuth_deg - 180.0)
    return np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]]
    )


class Office:
    """A `World`: an office under a sky with random clouds, by `seed`.

    It is the room of `setup` if that is a box with windows, else a built-in office; the sun is that
    of the site of `setup` (default: Seattle).
    """

    def __init__(self, setup: SiteFile | None = None, seed: int = 1) -> None:
        self.setup = setup or SiteFile(SEATTLE, CameraSetup(), OFFICE)
        room = self.setup.room
        self._room = room if room is not None and room.kind == "box" and room.window else OFFICE
        self._seed = seed
        self._geometry: _Geometry | None = None
        self._scene_of = lru_cache(maxsize=2)(self._scene)
        self._light_of = lru_cache(maxsize=16)(self._light_at)

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        """Return Ineichen's clear sky changed by clouds [W/m2].

        It is linear between steps of ten minutes.
        """
        part, step = math.modf(t_utc.timestamp() / _LIGHT_STEP_S)
        before, after = self._light_of(int(step)), self._light_of(int(step) + 1)
        return SimulatedLight(*(a + part * (b - a) for a, b in zip(before, after, strict=True)))

    def _light_at(self, step: int) -> SimulatedLight:
        t_utc = datetime.fromtimestamp(step * _LIGHT_STEP_S, UTC)
        clear, clouds = sun.clearsky([t_utc], self.setup.site), self._cloudiness(t_utc)
        altitude = np.radians(sun.position([t_utc], self.setup.site).altitude_deg[0])
        dni = float(clear.dni_wm2[0]) * max(1.0 - 1.4 * clouds, 0.0)
        dhi = float(clear.dhi_wm2[0]) * (
            1.0 + 1.6 * clouds * (1.0 - clouds)
        ) + 0.25 * clouds * float(clear.ghi_wm2[0])
        return SimulatedLight(dhi + dni * max(float(np.sin(altitude)), 0.0), dhi, dni)

    def _cloudiness(self, t_utc: datetime) -> float:
        """Return the cloudiness from 0 to 1.

        Days are clear, mixed or overcast; the hours of a day differ slightly.
        """
        hour = t_utc.timestamp() / 3600.0
        day = np.random.default_rng([self._seed, int(hour // 24)]).choice(
            [0.02, 0.1, 0.35, 0.6, 0.95]
        )
        marks = [
            np.random.default_rng([self._seed, int(hour) + i, 7]).normal(0.0, 0.12) for i in (0, 1)
        ]
        return float(np.clip(day + np.interp(hour % 1.0, [0, 1], marks), 0.0, 1.0))

    def scene(self, t_utc: datetime) -> Panorama:
        """Return the panorama at a time; it is computed for the start of the minute."""
        return self._scene_of(t_utc.replace(second=0, microsecond=0))

    def _scene(self, t_utc: datetime) -> Panorama:
        if self._geometry is None:
            self._geometry = _Geometry(self._room, self.setup.camera.heading_deg)
        g, room, light = self._geometry, self._room, self.irradiance(t_utc)
        position = sun.position([t_utc], self.setup.site)
        altitude = float(position.apparent_altitude_deg[0])
        azimuth = float(position.azimuth_deg[0])
        to_sun = projection.direction(altitude, azimuth) @ g.to_room.T
        beam_lx = light.dni_wm2 * _LM_PER_W_SUN * (altitude > 0)
        zenith = 9.0 / (7.0 * np.pi) * light.dhi_wm2 * _LM_PER_W_SKY + 1e-3  # CIE overcast sky
        ground = room.reflectance_ground / np.pi * light.ghi_wm2 * 110.0 + 1e-3
        beam = (
            beam_lx
            * g.through_glass(g.points, np.tile(to_sun, (len(g.points), 1)))
            * (1.0 - g.glass)
        )
        beam *= np.maximum(g.normals @ to_sun, 0.0)
        window_lx = np.pi * (g.sky_factor * 0.6 * zenith + g.ground_factor * ground)
        inside = (
            g.reflectance
            / np.pi
            * (window_lx + beam + self._interreflected_lx(g, window_lx + beam))
        )
        outside = np.where(
            g.rays[:, 2] > 0, zenith * (1.0 + 2.0 * np.abs(g.rays[:, 2])) / 3.0, ground
        )
        luminance = (
            np.where(g.glass > 0, g.glass * outside, inside).reshape(_HEIGHT, -1).astype(np.float32)
        )
        through = float(g.through_glass(g.eye, to_sun[None])[0])
        disc = (
            SunSource(altitude, azimuth, beam_lx * through, float(through > 0), "rendering")
            if beam_lx * through > 0
            else None
        )
        return Panorama(luminance, self.setup.camera.heading_deg, t_utc=t_utc, sun=disc)

    def _interreflected_lx(self, g: _Geometry, first_lx: Floats) -> float:
        """Return the interreflected illuminance [lx] from the first flux and mean reflectance."""
        room = self._room
        floor = room.width_m * room.depth_m
        walls = 2 * (room.width_m + room.depth_m) * room.height_m
        area = 2 * floor + walls
        sight = np.linalg.norm(g.points - g.eye, axis=1)
        # The area of a pixel is solid angle x distance^2 / cosine of its ray with the surface.
        omega = np.repeat(projection.row_solid_angles(_HEIGHT, 2 * _HEIGHT), 2 * _HEIGHT)
        patch = omega * sight**2 / np.maximum(-(g.rays * g.normals).sum(axis=1), 1e-3)
        reflected = float((first_lx * g.reflectance * patch).sum())
        mean = (
            floor * (room.reflectance_ceiling + room.reflectance_floor)
            + walls * room.reflectance_walls
        ) / area
        return reflected / (area * (1.0 - mean))


def open_world(session: Session | None, seed: int) -> World:
    """Return the session's truth/ if it has irradiance.csv, or else a simulated office.

    `fieldlum simulate` writes truth/. The office is the session's room if that is a box with
    windows, else a built-in one; it is at the session's site, or in Seattle without a session. seed
    : of its clouds. Raises InputError for a bad SITE.toml or irradiance.csv.
    """
    if session is not None and session.truth_irradiance.is_file():
        return TruthWorld(session.truth)
    return Office(session.site_file() if session is not None else None, seed)
