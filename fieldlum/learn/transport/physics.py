"""Compute where light would go in the stated room: a coarse prior that captures correct.

A room file is rough: furniture is missing, reflectances are guesses. Each pixel's computed light,
at the level of its captures, is the prior mean of the fit, if held-out days do not contradict it.
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
from fieldlum.room.scene import build
from fieldlum.room.scene.box_room import is_box_with_window
from fieldlum.room.scene.radiosity import FIRST_PIECE, lit_room
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

    position [m, 3], axis, sign, share, piece [m]: points of the p surface pieces that are tested
    for sun, in room coordinates; modes [k, p]: orthonormal patterns of sunlight on the pieces that
    explain the camera's light; comparison [k, j]: turns their coefficients into features of an
    hour, which are alike for hours that light the room alike. Computed light on a panorama of 2 h^2
    pixels, cd/m2: sun_light [k, 2 h^2] per unit of a mode; sky_modes [s, 2306] of the luminance of
    sky and ground; sky_light [s, 2 h^2] per unit of these.
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
        place, share = self.position.astype(float), self.share.astype(float)
        surfaces, pieces = (self.axis, self.sign), self.modes.shape[1]
        return sun_points(build(self.room), place, *surfaces, share, self.piece, pieces)

    def sunlight(self, light: Light) -> Floats32:
        """Return the sun on the pieces in n hours as coefficients of the k modes [n, k] lx."""
        toward = self._points.scene.to_room(light.apparent_sun_direction)
        out = np.zeros((len(light), len(self.modes)), np.float32)
        lit = np.flatnonzero(light.direct_lx > 0.0)
        for k, lx in zip(lit, self._points.direct(toward[lit]), strict=True):
            out[k] = self.modes @ lx * light.direct_lx[k]
        return out

    def features(self, light: Light, sunlight: Floats32) -> Floats32:
        """Return what a kernel compares, about 1 with the sun in the room, [n, j].

        light: of n hours; sunlight: result of `sunlight` for them [n, k]. Inner products of rows
        are those of the pictures of reflected sunlight, per total light.
        """
        return sunlight @ self.comparison / light.total_lx.astype(np.float32)[:, None]

    def luminance(
        self, light: Light, sunlight: Floats32, seen_mask: Mask, sky_cdm2: Floats32 | None = None
    ) -> Floats32:
        """Return the computed light of surfaces, without direct sun on them, [n, P] cd/m2.

        sunlight: result of `sunlight` for `light` [n, k]; seen_mask [H, W]: mask of the P pixels;
        sky_cdm2: of the Reinhart patches [n, 2305], None for the Perez skies of `light`.
        """
        sky = _outdoors(light, light.sky_cdm2 if sky_cdm2 is None else sky_cdm2)
        maps = sunlight @ self.sun_light + (sky @ self.sky_modes.T) @ self.sky_light
        return _at_pixels(np.maximum(maps, np.float32(0.0)), seen_mask)


def _at_pixels(maps: Floats32, seen_mask: Mask) -> Floats32:
    """Interpolate panoramas [n, 2 h^2] at the pixels `seen_mask` [H, W] of a larger one, [n, P]."""
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
    """Return hours with the sun in all places of a year, under one weather."""
    start = datetime(2027, 1, 1, tzinfo=UTC)
    # steps of 41 h reach all hours of the day in all seasons
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
    """Return a coarse model of light in the room of SITE.toml; None without a box with windows.

    heading_deg: azimuth of the middle of the maps.
    """
    if not is_box_with_window(setup.room):
        return None
    return _physics_of(replace(setup, camera=replace(setup.camera, heading_deg=heading_deg)))


@lru_cache(maxsize=4)
def _physics_of(setup: SiteFile) -> Physics:
    """Compute the modes of a room; stored, because training fits the same room some 20 times.

    The modes span the range of the light of random pictures (Halko, Martinsson and Tropp, SIAM
    Review 53, 2011), so that no singular values of the complete matrix are needed.
    """
    assert setup.room is not None
    lit = lit_room(setup, height=HEIGHT, quality=QUALITY)
    pieces = lit.pieces
    reflect = (pieces.reflectance / np.pi).astype(np.float32)[:, None]
    root = np.sqrt(equirect_solid_angles(HEIGHT, 2 * HEIGHT)).reshape(-1, 1)
    count = min(SUN_MODES, len(reflect))
    pictures = np.random.default_rng(0).standard_normal((len(root), count)) * root
    points = lit.smooth.T @ (lit.to_pixels.T @ pictures)
    first = lit.point_coefficients[:, FIRST_PIECE:].T @ points  # [p, k]
    bounces = lit.bounce_coefficients.T.tocsr()
    total = first
    # each leaves less than half of the light, so the rest is below a millionth
    for _ in range(20):
        total = first + bounces @ (reflect * total)
    modes = np.linalg.qr(reflect * total)[0].astype(np.float32)  # [p, k]
    sky_modes = _sky_modes(setup.site)
    dark = np.zeros((FIRST_PIECE, count), np.float32)
    sun_light = lit.pixels_cdm2(lit.columns(dark, modes)).T.astype(np.float32)  # [k, 2 h^2]
    weighted = sun_light * root.ravel()
    values, vectors = np.linalg.eigh(weighted @ weighted.T)
    # number of patterns of reflected sunlight that compare hours
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
    clear = _light_of_year(setup.site, 800.0, 100.0)
    size = np.linalg.norm(physics.features(clear, physics.sunlight(clear)), axis=1)
    size = size * clear.total_lx / np.maximum(clear.direct_lx, 1.0)
    norm = np.percentile(size[size > 0.0], 75) if (size > 0.0).any() else 1.0
    return replace(physics, comparison=physics.comparison / np.float32(norm))
