"""Compute where light would go in the stated room: a coarse prior that captures correct.

A room file is rough: furniture is missing, reflectances are guesses. The computed light therefore
serves in two ways that captures correct. It decides which hours are alike: two hours that light the
room's surfaces in the same way are informative about each other, even if the sun has just appeared
above the house across the street. And each pixel's computed light, at the level of its captures, is
the prior mean of the fit, if held-out days do not contradict it.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats32, Mask
from fieldlum.core.records import Room, Site, SiteFile
from fieldlum.learn.transport.patch_descriptor import FAINT_SUN_LX
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.room.scene import build
from fieldlum.room.scene.points import SunPoints, sun_points
from fieldlum.room.simulate.gather import FIRST_PIECE
from fieldlum.room.simulate.truth import ground_truth
from fieldlum.sky.light import Light, light_at

HEIGHT = 16  # rows of the coarse panorama from which the modes are computed; not measured
# Rows of the panorama of computed light. With 16 rows the error of two days is 1.4 to 1.8 times
# that of 60 rows, with 40 rows 1.05 to 1.15 times.
LIGHT_HEIGHT = 40
QUALITY = "draft"
MODES = 48  # number of singular modes that compare hours; not measured
# Numbers of modes of computed light from the sun and from the sky. With 200 sun modes two days have
# 6 to 14 % more error than with 500; the basis of 64 skies costs nothing.
SUN_MODES, SKY_MODES = 300, 64
_SKY_STEP_H = 41.0  # all hours of the day in all seasons; chosen
# Suns whose light on the pieces is stored: more than the captures of a campaign; limits the memory
# to some 10 MB. Chosen.
_STORED_SUNS = 1024
_EMPTY = np.zeros((0, 0), np.float32)


class UnitSunlight:
    """Direct sun on the p surface pieces of a room, per lx on the sun's normal.

    The results of the last suns are stored: the fits of one training have the same captures.
    points: of the pieces; `of(x, y, z)` returns the pieces' illuminance [p] for a sun in this
    direction in room axes.
    """

    def __init__(self, points: SunPoints) -> None:
        self.points = points
        self.of = lru_cache(maxsize=_STORED_SUNS)(self._of)

    def _of(self, x: float, y: float, z: float) -> NDArray[np.float32]:
        return self.points.direct(np.array((x, y, z)))


@dataclass(frozen=True)
class Physics:
    """A coarse model of the sun's light in the room, after all bounces.

    modes [k, p]: singular modes of the camera's light due to sun on the room's p surface pieces;
    norm: divisor of `sunlight`, so that its values are about one with the sun in the room.
    position [m, 3], axis, sign, share, piece [m]: points of the pieces that are tested for sun, in
    room coordinates. Computed light on a panorama of 2 h^2 pixels, cd/m2: sun_light [k, 2 h^2] per
    unit of a mode; sky_modes [s, 2306] of the luminance of sky and ground; sky_light [s, 2 h^2] per
    unit of these. The three are empty in models of earlier versions. on_pieces: the points as
    `UnitSunlight`, None to prepare them when they are first needed.
    """

    room: Room
    modes: Floats32
    position: Floats32
    axis: NDArray[np.int8]
    sign: NDArray[np.int8]
    share: Floats32
    piece: NDArray[np.int32]
    norm: float = 1.0
    sun_light: Floats32 = field(default_factory=lambda: _EMPTY)
    sky_modes: Floats32 = field(default_factory=lambda: _EMPTY)
    sky_light: Floats32 = field(default_factory=lambda: _EMPTY)
    on_pieces: UnitSunlight | None = field(default=None, compare=False, repr=False)

    @cached_property
    def _unit(self) -> UnitSunlight:
        """Return `on_pieces`, prepared now if necessary."""
        if self.on_pieces is not None:
            return self.on_pieces
        place, pieces = self.position.astype(float), self.modes.shape[1]
        share = self.share.astype(float)
        return UnitSunlight(
            sun_points(build(self.room), place, self.axis, self.sign, share, self.piece, pieces)
        )

    def features(self, sunlight: Floats32) -> Floats32:
        """Return the first 48 columns of `sunlight` [n, k] (all, if fewer), which compare hours."""
        return sunlight[:, :MODES]

    def sunlight(self, light: Light) -> Floats32:
        """Return the reflected sunlight of n hours as coefficients of the k modes, [n, k].

        They are divided by the hour's total light and by `norm`; 0 in hours without direct sun.
        """
        unit = self._unit
        toward = unit.points.scene.to_room(light.shown_sun_direction)
        beam = light.direct_lx / light.total_lx / self.norm
        out = np.zeros((len(light), len(self.modes)), np.float32)

        def one(k: int) -> None:
            out[k] = self.modes @ (unit.of(*toward[k].tolist()) * np.float32(beam[k]))

        with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
            list(pool.map(one, np.flatnonzero(light.direct_lx > 0.0)))
        return out

    def luminance(
        self, light: Light, sunlight: Floats32, seen_mask: Mask, sky_cdm2: Floats32 | None = None
    ) -> Floats32:
        """Return the computed light of surfaces, without direct sun on them, [n, P] cd/m2.

        sunlight: result of `sunlight` for `light` [n, k]; seen [H, W]: mask of the P pixels;
        sky_cdm2: of the Reinhart patches [n, 2305], None for the Perez skies of `light`.
        """
        unit = (light.total_lx * self.norm).astype(np.float32)[:, None]
        sky_cdm2 = light.sky_cdm2 if sky_cdm2 is None else sky_cdm2
        sky = _outdoors(light, sky_cdm2) @ self.sky_modes.T  # [n, s]
        maps = (sunlight * unit) @ self.sun_light + sky @ self.sky_light  # [n, 2 h^2]
        return _at_pixels(np.maximum(maps, np.float32(0.0)), seen_mask)


def _at_pixels(maps: Floats32, seen_mask: Mask) -> Floats32:
    """Interpolate panoramas [n, 2 h^2] at the pixels `seen_mask` [H, W] of a larger one, [n, P]."""
    height, (rows, columns) = round(np.sqrt(maps.shape[1] / 2)), seen_mask.shape
    wide, scale = 2 * height, height / rows
    row = np.clip((np.arange(rows) + 0.5) * scale - 0.5, 0.0, height - 1.0)
    column = (np.arange(columns) + 0.5) * scale - 0.5
    top, left = np.minimum(row.astype(int), height - 2), np.floor(column).astype(int)
    down, right = (row - top).astype(np.float32)[:, None], (column - left).astype(np.float32)
    index = np.flatnonzero(seen_mask)
    out = np.empty((len(maps), len(index)), np.float32)
    for k, coarse in enumerate(maps.reshape(-1, height, wide)):  # arrays that stay in the cache
        across = coarse[:, left % wide] * (1 - right) + coarse[:, (left + 1) % wide] * right
        full = np.diff(across, axis=0)[top]  # [H, W]
        full *= down
        full += across[top]
        np.take(full.ravel(), index, out=out[k])
    return out


def physics_of(setup: SiteFile, light: Light, heading_deg: float) -> Physics | None:
    """Return a coarse model of light in the room of SITE.toml, with its norm from captured hours.

    light: of the captures; heading_deg: azimuth of the middle of their maps. Return None without a
    box room with windows, or if no hour of `light` has direct sun in the room.
    """
    room = setup.room
    if room is None or room.kind != "box" or not room.window:
        return None
    camera = replace(setup.camera, heading_deg=heading_deg)
    rough = _modes_of(replace(setup, camera=camera))
    rough = replace(rough, on_pieces=rough._unit)
    size = np.linalg.norm(rough.features(rough.sunlight(light)), axis=1)  # [n]
    sunny = (light.direct_lx > FAINT_SUN_LX) & (size > 0.0)
    if not sunny.any():
        return None
    share = size[sunny] * light.total_lx[sunny] / light.direct_lx[sunny]
    return replace(rough, norm=float(np.percentile(share, 75)))


def _outdoors(light: Light, sky_cdm2: Floats32) -> Floats32:
    """Return the luminance of the sky patches [n, 2305] and the ground, [n, 2306] cd/m2."""
    ground = light.sky.ground_cdm2.astype(np.float32)[:, None]
    return np.concatenate((sky_cdm2, ground), axis=1)


def _sky_modes(site: Site) -> Floats32:
    """Return an orthonormal basis of the Perez skies of a site's year, [s, 2306].

    The skies are those of three kinds of weather at suns over the year.
    """
    start = datetime(2027, 1, 1, tzinfo=UTC)
    times = [start + timedelta(hours=_SKY_STEP_H * k) for k in range(int(8760 / _SKY_STEP_H))]
    skies = []
    for dni_wm2, dhi_wm2 in ((0.0, 150.0), (300.0, 250.0), (800.0, 100.0)):
        light = light_at(times, site, np.array(dni_wm2), np.array(dhi_wm2))
        light = light[light.sun_altitude_deg > 0.0]
        skies.append(_outdoors(light, light.sky_cdm2) / light.diffuse_lx[:, None])
    return np.linalg.svd(np.concatenate(skies), full_matrices=False)[2][:SKY_MODES].astype(
        np.float32
    )


@lru_cache(maxsize=4)
def _modes_of(setup: SiteFile) -> Physics:
    """Compute the modes of a room; stored, because training fits the same room some 20 times."""
    assert setup.room is not None
    truth = ground_truth(setup, height=HEIGHT, quality=QUALITY)
    reflect = (truth.pieces.reflectance / np.pi).astype(np.float32)
    direct = (truth.to_pixels @ truth.from_points[:, FIRST_PIECE:]).toarray()
    bounce = truth.from_pieces[:, FIRST_PIECE:].multiply(reflect[:, None]).T.tocsr()
    whole = direct
    # each bounce leaves less than half of the light, so the rest is below a millionth
    for _ in range(20):
        whole = direct + (bounce @ whole.T).T
    whole = whole * reflect
    root = np.sqrt(equirect_solid_angles(HEIGHT, 2 * HEIGHT)).ravel()[:, None]
    _, values, modes = np.linalg.svd(whole * root, full_matrices=False)
    sky_modes = _sky_modes(setup.site)
    larger = ground_truth(setup, height=LIGHT_HEIGHT, quality=QUALITY, of_pieces=truth.from_pieces)
    dark = np.zeros((FIRST_PIECE, len(values[:SUN_MODES])), np.float32)
    size = np.maximum(values[:SUN_MODES], 1e-6 * values[0])
    on_pieces = (modes[:SUN_MODES] / size[:, None]).T.astype(np.float32)  # [p, k]
    pieces = truth.pieces
    return Physics(
        setup.room,
        np.asarray(values[:SUN_MODES, None] * modes[:SUN_MODES], np.float32),
        pieces.position.astype(np.float32),
        pieces.axis[pieces.piece],
        pieces.sign[pieces.piece],
        pieces.share.astype(np.float32),
        pieces.piece.astype(np.int32),
        sun_light=larger.pixels_cdm2(larger.columns(dark, on_pieces)).T.astype(np.float32),
        sky_modes=sky_modes,
        sky_light=larger.pixels_cdm2(larger.columns(sky_modes.T)).T.astype(np.float32),
    )
