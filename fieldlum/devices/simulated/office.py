"""Simulate an office: a box lit by sky, ground and sun through its windows.

The simulation is fast, but not physically accurate: window form factors, split-flux
interreflection, direct sun. `fieldlum simulate` renders an accurate truth with Radiance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import lru_cache

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import CameraSetup, Panorama, Room, Site, SiteFile, SunSource, Window
from fieldlum.devices.simulated.world import SimulatedLight, TruthWorld, World
from fieldlum.optics import projection
from fieldlum.room.scene import look
from fieldlum.room.scene.patches import disc_visibility
from fieldlum.room.scene.points import SunPoints
from fieldlum.room.scene.view import SceneView
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


def _window_factors(view: SceneView) -> tuple[Floats, Floats]:
    """Return form factor times transmittance of the windows to sky and to ground, [m] each.

    They are those of the surface samples of a view.
    """
    sky, ground = np.zeros(len(view.box)), np.zeros(len(view.box))
    row, columns, rows = np.arange(len(view.box)), 6, 4
    for o in view.scene.openings:
        (left, right), (bottom, top) = o.u_m, o.z_m
        cell = (right - left) * (top - bottom) / (columns * rows)
        for i, j in np.ndindex(columns, rows):
            at = np.empty(3)
            at[o.axis], at[o.along] = o.inner_m, left + (i + 0.5) / columns * (right - left)
            at[2] = bottom + (j + 0.5) / rows * (top - bottom)
            way = at - view.position
            far2 = np.maximum((way**2).sum(axis=1), cell / 4)
            unit = way / np.sqrt(far2)[:, None]
            cosines = np.maximum(unit[row, view.axis] * view.sign, 0.0)
            cosines *= np.maximum(unit[:, o.axis] * o.outward, 0.0)
            factor = cosines * cell / (np.pi * far2) * o.transmittance
            sky += np.where(unit[:, 2] > 0, factor, 0)
            ground += np.where(unit[:, 2] <= 0, factor, 0)
    return np.minimum(sky, 1.0), np.minimum(ground, 1.0)


@dataclass(frozen=True, slots=True)
class _Fixed:
    """What does not change with time: the view, its sunlit points and form factors of windows."""

    view: SceneView
    points: SunPoints
    sky_factor: Floats
    ground_factor: Floats


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
        self._fixed: _Fixed | None = None
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
        if self._fixed is None:
            view = look(self._room, _HEIGHT, self.setup.camera.heading_deg, 1)
            self._fixed = _Fixed(view, view.sun_points(), *_window_factors(view))
        fixed, view, light = self._fixed, self._fixed.view, self.irradiance(t_utc)
        position = sun.position([t_utc], self.setup.site)
        altitude = float(position.apparent_altitude_deg[0])
        azimuth = float(position.azimuth_deg[0])
        toward = view.scene.to_room(projection.direction(altitude, azimuth))
        beam_lx = light.dni_wm2 * _LM_PER_W_SUN * (altitude > 0)
        diffuse_lx = light.dhi_wm2 * _LM_PER_W_SKY
        zenith = 9.0 / (7.0 * np.pi) * diffuse_lx + 1e-3  # CIE overcast sky
        ground = self._room.reflectance_ground / np.pi * light.ghi_wm2 * 110.0 + 1e-3
        sunlit = fixed.points.direct(toward) * beam_lx  # [H * W] cd/m2
        window_lx = np.pi * (fixed.sky_factor * 0.6 * zenith + fixed.ground_factor * ground)
        inside = ~np.isin(view.box, view.scene.of_kind("ground"))
        indirect_lx = self._interreflected_lx(view, inside, window_lx, sunlit)
        level_lx = np.where(inside, window_lx + indirect_lx, diffuse_lx)
        shown = view.weight * view.scene.reflectance[view.box] * level_lx / np.pi
        luminance = np.bincount(view.pixel, shown, len(sunlit)) + sunlit
        rows = projection.equirect_rays(_HEIGHT, 2 * _HEIGHT, 0.0)[..., 2].ravel()
        luminance += view.sky.ravel() * zenith * (1.0 + 2.0 * np.abs(rows)) / 3.0
        luminance += view.plain.ravel() * ground
        visible, through = (part[0] for part in disc_visibility(view.scene, toward[None]))
        disc_lx = beam_lx * float(visible * through)
        disc = SunSource(altitude, azimuth, disc_lx, float(visible), "rendering")
        return Panorama(
            luminance.reshape(_HEIGHT, -1).astype(np.float32),
            self.setup.camera.heading_deg,
            t_utc=t_utc,
            sun=disc if disc_lx > 0 else None,
        )

    def _interreflected_lx(
        self, view: SceneView, inside: Mask, window_lx: Floats, sunlit: Floats
    ) -> float:
        """Return the interreflected illuminance [lx] from the first flux and mean reflectance."""
        room = self._room
        floor = room.width_m * room.depth_m
        walls = 2 * (room.width_m + room.depth_m) * room.height_m
        area = 2 * floor + walls
        seen = np.flatnonzero(inside[: view.first_mirrored])
        ways = view.position[seen] - np.array(view.scene.camera_m)
        sight = np.linalg.norm(ways, axis=1)
        cosines = np.abs(ways[np.arange(len(seen)), view.axis[seen]]) / sight
        # The area of a pixel is solid angle x distance^2 / cosine of its ray with the surface.
        omega = np.repeat(projection.row_solid_angles(_HEIGHT, 2 * _HEIGHT), 2 * _HEIGHT)
        patch = omega[view.pixel[seen]] * sight**2 / np.maximum(cosines, 1e-3)
        first = view.scene.reflectance[view.box[seen]] * window_lx[seen]
        reflected = float(((first + np.pi * sunlit[view.pixel[seen]]) * patch).sum())
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
