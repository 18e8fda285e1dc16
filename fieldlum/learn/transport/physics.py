"""Compute where light goes in the stated room: a coarse prior, which the captures correct.

A [room] of SITE.toml is rough: furniture is missing, reflectances are guesses. Each pixel's
computed light, at the level of its captures, is the prior mean of the fit, if held-out days do not
contradict it.
"""

from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cached_property, lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats32, Mask
from fieldlum.core.records import Room, Site, SiteFile
from fieldlum.optics.projection import equirect_solid_angles, wrapped
from fieldlum.room.scene import box_room, build, radiosity
from fieldlum.room.scene.trace import SunPoints, sun_points
from fieldlum.sky.daylight import Light, light_at

# Rows of the panorama of computed light. With 16 rows the error of two days is 1.4 to 1.8 times
# that of 60 rows, with 40 rows 1.05 to 1.15 times.
HEIGHT = 40
QUALITY = "draft"
# Numbers of modes of computed light from the sun and from the sky. With 200 sun modes two days have
# 6 to 14 % more error than with 500; the basis of 64 skies costs nothing.
SUN_MODES, SKY_MODES = 300, 64


@dataclass(frozen=True, eq=False)
class Physics:
    """A coarse model of the light in a room, after all bounces.

    The room's surfaces are cut into p pieces, and m points of these are tested for sun. Of each
    point: position in room coordinates [m, 3] m; axis and sign of its surface's normal (0 to 2, -1
    or 1) [m]; share of its piece [m]; index of its piece [m]. modes [k, p]: orthonormal patterns of
    sunlight on the pieces that explain the camera's light; comparison [k, j]: turns coefficients of
    the modes into features of an hour, which are similar for hours that light the room similarly.
    Panoramas of computed light have h rows, so 2 h^2 pixels: sun_light [k, 2 h^2] cd/m2 for a
    coefficient of 1 of each mode; sky_modes [s, 2306]: orthonormal patterns of the luminance of sky
    patches and ground; sky_light [s, 2 h^2] cd/m2 for a coefficient of 1 of each of these. k is at
    most 300, j 48 and s 64.
    """

    room: Room
    modes: Floats32
    comparison: Floats32
    position: Floats32
    axis: NDArray[np.int8]
    sign: NDArray[np.int8]
    share: Floats32
    piece: NDArray[np.int32]
    sun_light: Floats32
    sky_modes: Floats32
    sky_light: Floats32

    @cached_property
    def _points(self) -> SunPoints:
        """The points of the pieces, prepared for tracing the sun."""
        position, share = self.position.astype(float), self.share.astype(float)
        surfaces, pieces = (self.axis, self.sign), self.modes.shape[1]
        return sun_points(build(self.room), position, *surfaces, share, self.piece, pieces)

    def sunlight(self, light: Light) -> Floats32:
        """Return the sun on the pieces in n hours as coefficients of the modes, [n, k] lx."""
        towards = self._points.scene.to_room(light.apparent_sun_direction)
        out = np.zeros((len(light), len(self.modes)), np.float32)
        sunny = np.flatnonzero(light.direct_lx > 0.0)
        for hour, shares in zip(sunny, self._points.direct(towards[sunny]), strict=True):
            out[hour] = self.modes @ shares * light.direct_lx[hour]  # shares of the beam [p]
        return out

    def features(self, light: Light, sunlight: Floats32) -> Floats32:
        """Return features by which the kernel compares hours, [n, j]; about 1 with sun in the room.

        light: of n hours; sunlight: result of `sunlight` for them [n, k]. The inner product of two
        hours is that of their pictures of reflected sunlight, per total light.
        """
        return sunlight @ self.comparison / light.total_lx.astype(np.float32)[:, None]

    def luminance(
        self, light: Light, sunlight: Floats32, seen_mask: Mask, sky_cdm2: Floats32 | None = None
    ) -> Floats32:
        """Return the computed luminance of surfaces, without direct sun on them, [n, P] cd/m2.

        sunlight: result of `sunlight` for `light` [n, k]; seen_mask [H, W]: mask of the P pixels;
        sky_cdm2: of the Reinhart patches [n, 2305], None for the Perez skies of `light`.
        """
        sky = _outdoors(light, light.sky_cdm2 if sky_cdm2 is None else sky_cdm2)
        maps = sunlight @ self.sun_light + (sky @ self.sky_modes.T) @ self.sky_light
        return _at_pixels(np.maximum(maps, np.float32(0.0)), seen_mask)


def _at_pixels(maps: Floats32, seen_mask: Mask) -> Floats32:
    """Return small panoramas interpolated at the P seen pixels of larger ones, [n, P].

    maps: of h rows and 2 h columns, flattened [n, 2 h^2]; seen_mask: of the larger ones [H, W].
    """
    height = round(np.sqrt(maps.shape[1] / 2))
    places = (np.indices(seen_mask.shape) + 0.5) * (height / len(seen_mask)) + [[[-0.5]], [[0.5]]]
    row, column = places.astype(np.float32)  # of a map with a column more on either side
    at = (column, row, cv2.INTER_LINEAR)
    coarse = (wrapped(m) for m in maps.reshape(-1, height, 2 * height))
    shown = [cv2.remap(m, *at, borderMode=cv2.BORDER_REPLICATE)[seen_mask] for m in coarse]
    return np.array(shown, np.float32).reshape(len(maps), -1)


def _outdoors(light: Light, sky_cdm2: Floats32) -> Floats32:
    """Return the luminance of the sky patches [n, 2305] and the ground, [n, 2306] cd/m2."""
    ground = light.sky.ground_cdm2.astype(np.float32)[:, None]
    return np.concatenate((sky_cdm2, ground), axis=1)


def _light_of_year(site: Site, dni_wm2: float, dhi_wm2: float) -> Light:
    """Return hours with all positions of the sun in a year, each with the same irradiance."""
    start = datetime(2027, 1, 1, tzinfo=UTC)
    # Steps of 41 h reach all hours of the day in all seasons.
    times = [start + timedelta(hours=41.0 * k) for k in range(8760 // 41)]
    light = light_at(times, site, np.array(dni_wm2), np.array(dhi_wm2))
    return light[light.sun_altitude_deg > 0.0]


def _sky_modes(site: Site) -> Floats32:
    """Return an orthonormal basis of the Perez skies of a site's year, [s, 2306].

    The skies are those of three kinds of weather at suns over the year.
    """
    skies = []
    for dni_wm2, dhi_wm2 in ((0.0, 150.0), (300.0, 250.0), (800.0, 100.0)):
        light = _light_of_year(site, dni_wm2, dhi_wm2)
        skies.append(_outdoors(light, light.sky_cdm2) / light.diffuse_lx[:, None])
    basis = np.linalg.svd(np.concatenate(skies), full_matrices=False)[2]
    return basis[:SKY_MODES].astype(np.float32)


def physics_of(setup: SiteFile, heading_deg: float) -> Physics | None:
    """Return the coarse model of light in the room of SITE.toml; None without a box with windows.

    heading_deg: azimuth of the maps' centre column, clockwise from north. The last four models are
    kept in memory. Raises InputError for an impossible room.
    """
    if not box_room.is_box_with_window(setup.room):
        return None
    return _physics_of(replace(setup, camera=replace(setup.camera, heading_deg=heading_deg)))


@lru_cache(maxsize=4)
def _physics_of(setup: SiteFile) -> Physics:
    """Return the coarse model of light in a box room; cached for the some 20 fits of a training.

    The modes span the range of the light of random pictures (Halko, Martinsson and Tropp, SIAM
    Review 53, 2011), so that no singular values of the complete matrix are needed.
    """
    assert setup.room is not None
    lit = radiosity.lit_room(setup, height=HEIGHT, quality=QUALITY)
    pieces = lit.pieces
    reflect = (pieces.reflectance / np.pi).astype(np.float32)[:, None]  # lx to cd/m2 [p, 1]
    root = np.sqrt(equirect_solid_angles(HEIGHT, 2 * HEIGHT)).reshape(-1, 1)  # [2 h^2, 1]
    count = min(SUN_MODES, len(reflect))
    # The transposed light transport carries random pictures back to the pieces.
    pictures = np.random.default_rng(0).standard_normal((len(root), count)) * root
    points = lit.smooth.T @ (lit.to_pixels.T @ pictures)
    first = lit.point_coefficients[:, radiosity.FIRST_PIECE :].T @ points  # without bounces [p, k]
    bounces = lit.bounce_coefficients.T.tocsr()
    total = first
    # Each bounce leaves less than half of the light, so that the rest is below a millionth.
    for _ in range(20):
        total = first + bounces @ (reflect * total)
    modes = np.linalg.qr(reflect * total)[0].astype(np.float32)  # [p, k]
    sky_modes = _sky_modes(setup.site)
    dark = np.zeros((radiosity.FIRST_PIECE, count), np.float32)  # sky and ground, without light
    sun_light = lit.pixels_cdm2(lit.columns(dark, modes)).T.astype(np.float32)  # [k, 2 h^2]
    weighted = sun_light * root.ravel()
    values, vectors = np.linalg.eigh(weighted @ weighted.T)
    # The 48 strongest patterns of reflected sunlight compare hours.
    comparison = (vectors * np.sqrt(np.maximum(values, 0.0)))[:, ::-1][:, :48]
    physics = Physics(
        room=setup.room,
        modes=modes.T.copy(),
        comparison=comparison.astype(np.float32),
        position=pieces.position.astype(np.float32),
        axis=pieces.axis[pieces.piece],
        sign=pieces.sign[pieces.piece],
        share=pieces.share.astype(np.float32),
        piece=pieces.piece.astype(np.int32),
        sun_light=sun_light,
        sky_modes=sky_modes,
        sky_light=lit.pixels_cdm2(lit.columns(sky_modes.T)).T.astype(np.float32),
    )
    # Norm of the features per share of direct sun when the sun is in the room: third quartile over
    # the clear hours of a year with such sun, 1 without any.
    clear = _light_of_year(setup.site, 800.0, 100.0)
    size = np.linalg.norm(physics.features(clear, physics.sunlight(clear)), axis=1)
    size = size * clear.total_lx / np.maximum(clear.direct_lx, 1.0)
    norm = np.float32(np.percentile(size[size > 0.0], 75) if (size > 0.0).any() else 1.0)
    return replace(physics, comparison=physics.comparison / norm)
