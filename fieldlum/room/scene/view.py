"""Trace what each panorama pixel of a box room shows: surfaces, sky through glass, reflections."""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Ints8, Ints32, Mask
from fieldlum.core.records import Room
from fieldlum.optics.projection import direction, rotation
from fieldlum.room.scene.box_room import BoxScene, build
from fieldlum.room.scene.trace import SUN_RADIUS_DEG, SunPoints, ray_ends, sun_points

# Rays in each direction of a pixel: with 3, sun patches had an error of 1.0e-4 to 1.6e-4 (log10
# MSE) at 60 rows, with 8 of 1.1e-5 to 1.5e-5.
MIN_RAYS, MAX_RAYS = 3, 8


class SurfaceSamples(NamedTuple):
    """Points of surfaces that pixels show, [m] each.

    position [m, 3] m, in room axes; axis (0 to 2) and sign (-1 or 1) of the face's normal; box:
    index of the box in the scene; pixel: flat index of the pixel; weight: share of the pixel, times
    the transmittance of the glass in between (or the reflectance of a pane that mirrors it), so
    that luminance = sum of weight x reflectance x illuminance / pi; mirrored: whether it is seen by
    a reflection in a pane.
    """

    position: Floats
    axis: Ints8
    sign: Ints8
    box: Ints32
    pixel: Ints32
    weight: Floats
    mirrored: Mask


@dataclass(frozen=True)
class SceneView:
    """What the pixels of a room's panorama show, traced once.

    sky [H, W] : share of the pixel that sees the sky, times the transmittance of the glass. plain
    [H, W] : the same for the open plain beyond the modelled ground. height: rows of the panorama;
    heading_deg: azimuth of its centre column, clockwise from north. samples: surfaces that all its
    pixels show.
    """

    scene: BoxScene
    height: int
    heading_deg: float
    samples: SurfaceSamples
    sky: Floats32
    plain: Floats32

    def sun_points(self) -> SunPoints:
        """Return the surface points of all pixels; their targets are the pixels' flat indices."""
        return surface_points(self.scene, self.samples, self.plain.size)


def surface_points(scene: BoxScene, s: SurfaceSamples, pixels: int) -> SunPoints:
    """Return samples as points whose sum in a pixel is its luminance per lx on the sun's normal.

    s: samples in `scene`; pixels: number of pixels, above all indices `s.pixel`.
    """
    weight = s.weight * scene.reflectance[s.box] / np.pi
    return sun_points(scene, s.position, s.axis, s.sign, weight, s.pixel, pixels)


def pixel_rays(height: int, heading_deg: float, sub: int) -> tuple[Ints32, Floats]:
    """Return flat pixel index [m] and direction [m, 3] of the m rays, sub x sub in each pixel.

    Directions are unit vectors, x east, y north, z up. The panorama has `height` rows, twice as
    many columns, and the azimuth `heading_deg`, clockwise from north, at its centre column. The
    rays of a pixel have equal solid angles.
    """
    width = 2 * height
    fine_row = (np.arange(height * sub) + 0.5) / sub
    top, bottom = np.floor(fine_row), np.floor(fine_row) + 1
    share = fine_row - top
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
def traced_view(room: Room, height: int, heading_deg: float, sub: int = 3) -> SceneView:
    """Trace the panorama of a box room from its camera, with sub x sub rays for each pixel.

    height : rows of the panorama; heading_deg : azimuth of its centre column, clockwise from north.
    The last four views are kept in memory. Raises InputError for an impossible room.
    """
    scene = build(room)
    pixel, world = pixel_rays(height, heading_deg, sub)
    rays = camera_rays(scene, room, world, heading_deg)
    samples, sky, plain = trace_pixels(scene, pixel, rays, 2 * height**2)
    shape = (height, 2 * height)
    return SceneView(scene, height, heading_deg, samples, sky.reshape(shape), plain.reshape(shape))


def camera_rays(scene: BoxScene, room: Room, world: Floats, heading_deg: float) -> Floats:
    """Return the directions of a panorama's pixels in room axes, [n, 3], by the camera's true pose.

    scene: of the room; world [n, 3]: the directions if the camera were level, x east, y north, z
    up; heading_deg: azimuth of the panorama's centre column, clockwise from north. The tilt and the
    roll are those of `room`.
    """
    from_level = rotation(0.0, room.camera_tilt_deg, room.camera_roll_deg, heading_deg)
    return scene.to_room(world @ from_level.T)


def trace_pixels(
    scene: BoxScene, pixel: Ints32, rays: Floats, count: int
) -> tuple[SurfaceSamples, Floats32, Floats32]:
    """Return what rays from the camera show: surface samples, and the shares of sky and plain.

    The shares are of each of `count` pixels, times the transmittance of the glass, [count] each.
    pixel: of each ray [n], 0 to count - 1, each as often; rays: in room axes [n, 3]. One mirror
    image in the panes counts.
    """
    share = count / len(rays)
    straight, mirrored = ray_ends(scene, np.broadcast_to(scene.camera_m, rays.shape), rays)
    parts = []
    for ends in (straight, mirrored):
        on = np.flatnonzero(ends.box >= 0)
        faces = (ends.axis[on], ends.sign[on], ends.box[on], pixel[ends.row[on]])
        is_mirrored = np.full(len(on), ends is mirrored)
        parts.append((ends.position[on], *faces, ends.weight[on] * share, is_mirrored))
    samples = SurfaceSamples._make(np.concatenate(values) for values in zip(*parts, strict=True))
    outdoors, up = straight.box < 0, rays[:, 2] > 0
    weight = (straight.weight * share).astype(np.float32)
    sky, plain = (
        np.bincount(pixel[rows], weight[rows], count).astype(np.float32)
        for rows in (outdoors & up, outdoors & ~up)
    )
    return samples, sky, plain
