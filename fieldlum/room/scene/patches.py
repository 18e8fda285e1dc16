"""Compute direct sun on a box room's surfaces, hour by hour.

The primary rays are traced once; each hour only needs shadow rays.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.core.arrays import Floats32
from fieldlum.core.records import Progress, Room, quiet
from fieldlum.room.scene.trace import SunPoints, disc_visibility
from fieldlum.room.scene.view import SunPatches, look, patch_rays


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
    threads = max(cv2.getNumThreads(), 1)  # 1 in a process of the scheduler
    with ThreadPoolExecutor(threads) as pool:
        for start in range(0, len(suns), chunk):
            progress(start, len(suns), "sun patches")
            rows = range(start, min(start + chunk, len(suns)))
            maps = np.zeros((len(rows), height, 2 * height), np.float32)

            def fill(some: NDArray[np.intp], maps: Floats32 = maps, start: int = start) -> None:
                units = points.direct(toward[some]).reshape(len(some), height, 2 * height)
                maps[some - start] = units * normal[some, None, None].astype(np.float32)

            lit = np.array(rows)[normal[start : rows.stop] > 0]
            list(pool.map(fill, np.array_split(lit, threads)))
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
