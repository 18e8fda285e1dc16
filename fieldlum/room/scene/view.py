"""Trace what each panorama pixel of a box room shows: surfaces, sky through glass, reflections."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask
from fieldlum.core.records import Room
from fieldlum.optics.projection import direction, rotation
from fieldlum.room.scene.geometry import BoxScene, build
from fieldlum.room.scene.points import SunPoints, sun_points
from fieldlum.room.scene.sun_disc import SUN_RADIUS_DEG
from fieldlum.room.scene.trace import EPSILON_M, Hits, Panes, first_hits, pane_crossings

# In each direction of a pixel, for sun patches: with 3 they had an error of 1.0e-4 to 1.6e-4 (log10
# MSE) at 60 rows, with 8 of 1.1e-5 to 1.5e-5.
MIN_RAYS, MAX_RAYS = 3, 8

_GROUND_SHARE = 0.1  # of a pixel, times the glass; chosen


@dataclass(frozen=True)
class SceneView:
    """The panorama's rays, traced once.

    Surface samples [m]: position [m, 3], axis and sign of the face's normal, box index, pixel,
    and weight: the share of the pixel times the glass in between (or its mirror), so that
    luminance = sum of weight x reflectance x E / pi. sky [H, W] : share of the pixel that sees
    the sky, times the glass. plain [H, W] : the same for the open plain beyond the modelled
    ground. height: rows of the panorama; heading_deg: azimuth of its centre column. SurfaceSamples
    from index first_mirrored on are mirror images.
    """

    scene: BoxScene
    height: int
    heading_deg: float
    position: Floats
    axis: NDArray[np.int8]
    sign: NDArray[np.int8]
    box: NDArray[np.int32]
    pixel: NDArray[np.int32]
    weight: Floats
    first_mirrored: int
    sky: Floats32
    plain: Floats32

    @property
    def ground(self) -> Mask:
        """Pixels of which over a tenth shows the ground outside, [H, W]."""
        straight = slice(self.first_mirrored)
        is_ground = np.isin(self.box[straight], self.scene.of_kind("ground"))
        weight = np.where(is_ground, self.weight[straight], 0.0)
        share = np.bincount(self.pixel[straight], weight, self.plain.size)
        return share.reshape(self.plain.shape) + self.plain > _GROUND_SHARE

    def sun_points(self, pixels: Indices | None = None) -> SunPoints:
        """Return the surface points of all pixels, or of the flat indices `pixels` [k].

        Their targets are pixels: flat indices for all, else positions in `pixels`.
        """
        weight = self.weight * self.scene.reflectance[self.box] / np.pi
        count = 2 * self.height**2
        if pixels is None:
            return sun_points(
                self.scene, self.position, self.axis, self.sign, weight, self.pixel, count
            )
        place = np.full(count, -1)
        place[pixels] = np.arange(len(pixels))
        target = place[self.pixel]
        of = target >= 0
        parts = (self.position[of], self.axis[of], self.sign[of], weight[of], target[of])
        return sun_points(self.scene, *parts, len(pixels))


def pixel_rays(height: int, heading_deg: float, sub: int) -> tuple[NDArray[np.int32], Floats]:
    """Return pixel index [m] and world direction [m, 3] of sub x sub rays in each pixel.

    The panorama has `height` rows and `heading_deg` at its centre column. The rays of a pixel have
    equal solid angles.
    """
    width = 2 * height
    fine = (np.arange(height * sub) + 0.5) / sub
    top, bottom = np.floor(fine), np.floor(fine) + 1
    share = fine - top
    z = np.cos(top / height * np.pi) * (1 - share) + np.cos(bottom / height * np.pi) * share
    altitude = np.degrees(np.arcsin(np.clip(z, -1, 1)))
    azimuth = heading_deg + ((np.arange(width * sub) + 0.5) / (width * sub) - 0.5) * 360.0
    rays = direction(altitude[:, None], azimuth[None, :]).reshape(-1, 3)
    rows, columns = np.arange(height * sub) // sub, np.arange(width * sub) // sub
    return (rows[:, None] * width + columns[None, :]).astype(np.int32).ravel(), rays


def patch_rays(height: int) -> int:
    """Return the number of rays in each direction of a pixel that sun patches need.

    Rays are at most the sun's radius apart, but there are at least 3 and at most 8, which is too
    few for that under 85 rows. height: rows of the panorama.
    """
    return int(np.clip(np.ceil(180.0 / height / SUN_RADIUS_DEG), MIN_RAYS, MAX_RAYS))


@lru_cache(maxsize=4)  # patches, windows and searches have different numbers of rays
def look(room: Room, height: int, heading_deg: float, sub: int = 3) -> SceneView:
    """Trace the panorama of a box room from its camera, with sub x sub rays for each pixel.

    height : rows of the panorama; heading_deg : of its centre column. Raises InputError for an
    impossible room.
    """
    scene = build(room)
    pixel, world = pixel_rays(height, heading_deg, sub)
    rays = camera_rays(scene, room, world, heading_deg)
    surfaces, straight, sky, plain = trace_pixels(scene, pixel, rays, sub, 2 * height**2)
    shape = (height, 2 * height)
    return SceneView(
        scene,
        height,
        heading_deg,
        surfaces.position,
        surfaces.axis,
        surfaces.sign,
        surfaces.box,
        surfaces.pixel,
        surfaces.weight,
        straight,
        sky.reshape(shape).astype(np.float32),
        plain.reshape(shape).astype(np.float32),
    )


class SurfaceSamples(NamedTuple):
    """Surface samples as in `SceneView`, [m] each."""

    position: Floats
    axis: NDArray[np.int8]
    sign: NDArray[np.int8]
    box: NDArray[np.int32]
    pixel: NDArray[np.int32]
    weight: Floats


def camera_rays(scene: BoxScene, room: Room, world: Floats, heading_deg: float) -> Floats:
    """Return directions [n, 3] in the panorama of the stated pose in room axes, by the true pose.

    heading_deg: azimuth of the panorama's centre column.
    """
    level = rotation(0.0, room.camera_tilt_deg, room.camera_roll_deg, heading_deg)
    return scene.to_room(world @ level.T)


def trace_pixels(
    scene: BoxScene, pixel: NDArray[np.int32], rays: Floats, sub: int, count: int
) -> tuple[SurfaceSamples, int, Floats, Floats]:
    """Trace sub x sub rays from the camera in each of `count` pixels.

    pixel: of each ray [n], 0 to count - 1; rays: in room axes [n, 3]. Return the surface samples of
    a `SceneView`, the index of the first mirrored one, and the shares of the pixels that see sky
    and plain, times the glass [count] each.
    """
    eye = np.broadcast_to(np.array(scene.camera_m), rays.shape)
    hits = first_hits(scene, eye, rays)
    panes = pane_crossings(scene, eye, rays, hits.distance_m)
    share = np.full(len(rays), 1.0 / sub**2)
    surfaces = [_surfaces(pixel, eye, rays, hits, share * panes.through)]
    open_sky = (hits.box < 0) & (panes.opening >= 0)
    sky, plain = np.zeros(count), np.zeros(count)
    for target, where in ((sky, rays[:, 2] > 0), (plain, rays[:, 2] <= 0)):
        rows = open_sky & where
        target += np.bincount(pixel[rows], (share * panes.through)[rows], count)
    surfaces.append(_mirrored(scene, pixel, eye, rays, panes, share))
    samples = SurfaceSamples._make(np.concatenate(parts) for parts in zip(*surfaces, strict=True))
    return samples, len(surfaces[0][0]), sky, plain


def _surfaces(
    pixel: NDArray[np.int32], origin: Floats, rays: Floats, hits: Hits, weight: Floats
) -> SurfaceSamples:
    rows = np.flatnonzero(hits.box >= 0)
    position = origin[rows] + rays[rows] * hits.distance_m[rows, None]
    faces = hits.axis[rows], hits.sign[rows], hits.box[rows]
    return SurfaceSamples(position, *faces, pixel[rows], weight[rows])


def _mirrored(
    scene: BoxScene,
    pixel: NDArray[np.int32],
    eye: Floats,
    rays: Floats,
    panes: Panes,
    share: Floats,
) -> SurfaceSamples:
    """Return the room's reflection in the panes: one bounce off the pane that a ray crosses."""
    rows = np.flatnonzero(panes.opening >= 0)
    axis = np.array([o.axis for o in scene.openings], np.intp)[panes.opening[rows]]
    back = rays[rows].copy()
    back[np.arange(len(rows)), axis] *= -1.0
    origin = eye[rows] + rays[rows] * panes.distance_m[rows, None] + back * 2 * EPSILON_M
    hits = first_hits(scene, origin, back)
    return _surfaces(pixel[rows], origin, back, hits, (share * panes.back)[rows])
