"""Compute direct sun on a box room's surfaces, hour by hour.

The primary rays are traced once; each hour only needs shadow rays.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.records import Progress, Room, quiet
from fieldlum.room.scene.geometry import BoxScene, Opening, glass_optics
from fieldlum.room.scene.points import SunPoints
from fieldlum.room.scene.sun_disc import SunPatches, disc_rays
from fieldlum.room.scene.trace import blocked_rays
from fieldlum.room.scene.view import look, patch_rays


def iter_sun_patches(
    room: Room,
    sun_direction: ArrayLike,
    normal_illuminance_lx: ArrayLike,
    *,
    height: int,
    heading_deg: float,
    chunk: int = 64,
    sub: int | None = None,
    progress: Progress = quiet,
) -> Iterator[SunPatches]:
    """Yield `sun_patches` in chunks of hours, so that a year does not fill the memory.

    sun_direction : [n, 3] unit vectors in world axes; normal_illuminance_lx : [n], of the sun
    outside on a plane normal to it. height : rows of the maps; chunk : hours in each result; sub :
    rays of a pixel in each direction, by default as many as `patch_rays` gives.
    """
    suns = np.atleast_2d(np.asarray(sun_direction, float))
    normal = np.broadcast_to(np.asarray(normal_illuminance_lx, float), len(suns))
    if room.kind != "box":
        from fieldlum.room.scene.radiance import iter_traced

        yield from iter_traced(
            room,
            suns,
            normal,
            height=height,
            heading_deg=heading_deg,
            chunk=chunk,
            progress=progress,
        )
        return
    points = _sun_points(room, height, heading_deg, sub or patch_rays(height))
    toward = points.scene.to_room(suns)
    visible, through = disc_visibility(points.scene, toward)
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
        for start in range(0, len(suns), chunk):
            progress(start, len(suns), "sun patches")
            rows = range(start, min(start + chunk, len(suns)))
            maps = np.zeros((len(rows), height, 2 * height), np.float32)

            def fill(k: int, maps: Floats32 = maps, start: int = start) -> None:
                if normal[k] > 0:
                    unit = points.direct(toward[k]).reshape(height, 2 * height)
                    np.multiply(unit, np.float32(normal[k]), out=maps[k - start])

            list(pool.map(fill, rows))
            part = slice(start, rows.stop)
            disc = normal[part] * visible[part] * through[part]
            yield SunPatches(maps, visible[part], through[part], disc)
    progress(len(suns), len(suns), "")


@lru_cache(maxsize=2)  # units of one year ask for the same points again and again
def _sun_points(room: Room, height: int, heading_deg: float, sub: int) -> SunPoints:
    return look(room, height, heading_deg, sub).sun_points()


def sun_patches(
    room: Room,
    sun_direction: ArrayLike,
    normal_illuminance_lx: ArrayLike,
    *,
    height: int,
    heading_deg: float,
    sub: int | None = None,
    progress: Progress = quiet,
) -> SunPatches:
    """Return the luminance of surfaces due to direct sun only (Radiance's -ab 0), without the disc.

    sun_direction : [n, 3] unit vectors in world axes (x east, y north, z up); normal_illuminance_lx
    : [n] of the sun outside, on a plane normal to it. A box room is traced exactly (hard shadows,
    sub x sub rays for each pixel, by default as many as `patch_rays` gives, one mirror image in
    the panes); a room of kind "radiance" is traced by rtrace, and `sub` does not count.
    heading_deg : azimuth of the centre column. Raises InputError for an impossible room.
    """
    parts = list(
        iter_sun_patches(
            room,
            sun_direction,
            normal_illuminance_lx,
            height=height,
            heading_deg=heading_deg,
            sub=sub,
            progress=progress,
        )
    )
    if not parts:
        empty = np.zeros(0)
        return SunPatches(np.zeros((0, height, 2 * height), np.float32), empty, empty, empty)
    return SunPatches(
        *(np.concatenate([getattr(p, f) for p in parts]) for f in SunPatches.__dataclass_fields__)
    )


# ----------------------------------------------------------------------------------------------
# the disc


def disc_visibility(scene: BoxScene, toward: Floats) -> tuple[Floats, Floats]:
    """Return the share of the disc that the camera sees, and its glass's transmittance, [n] each.

    Both are 0 for a hidden disc. toward : [n, 3] directions to the sun in room axes.
    """
    visible, passed = np.zeros(len(toward)), np.zeros(len(toward))
    for k, sun in enumerate(toward):
        for opening, free in _seen_through(scene, sun):
            visible[k] += free.mean()
            glass = float(glass_optics(opening.transmittance, sun[opening.axis])[0])
            passed[k] += free.mean() * glass
    return visible, passed / np.maximum(visible, 1e-12)


def visible_disc(scene: BoxScene, sun: Floats) -> Mask:
    """Return which rays of `disc_rays` from the camera to the sun meet no box, [r].

    sun: direction in room axes [3].
    """
    seen_rays = np.zeros(len(disc_rays(sun)), bool)
    for _, free in _seen_through(scene, sun):
        seen_rays |= free
    return seen_rays


def _seen_through(scene: BoxScene, sun: Floats) -> Iterator[tuple[Opening, Mask]]:
    """Yield each opening that shows a part of the disc, with the rays that it lets through."""
    eye = np.array(scene.camera_m)
    for o in scene.openings:
        if sun[o.axis] * o.outward > 1e-6 and sun[2] > 0 and _may_see(o, eye, sun):
            free = _free(scene, o, eye, disc_rays(sun))
            if free.any():
                yield o, free


def _may_see(o: Opening, eye: Floats, sun: Floats) -> bool:
    distance_m = (o.outer_m - eye[o.axis]) / sun[o.axis]
    u, z = eye[o.along] + distance_m * sun[o.along], eye[2] + distance_m * sun[2]
    margin = 0.01 * distance_m  # the disc has a radius of 0.0047
    return o.u_m[0] - margin < u < o.u_m[1] + margin and o.z_m[0] - margin < z < o.z_m[1] + margin


def _free(scene: BoxScene, o: Opening, eye: Floats, rays: Floats) -> Mask:
    """Return a mask of rays [r, 3] from the eye that leave through `o` without hitting a box."""
    free = np.ones(len(rays), bool)
    for plane in (o.inner_m, o.outer_m):
        at = (plane - eye[o.axis]) / rays[:, o.axis]
        u, z = eye[o.along] + at * rays[:, o.along], eye[2] + at * rays[:, 2]
        free &= o.contains(u, z)
    which = scene.of_kind("frame", "obstruction")
    if which:
        free[free] = ~blocked_rays(scene.low[which], scene.high[which], eye, rays[free])
    return free
