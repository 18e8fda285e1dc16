"""Compute direct sun on a room's surfaces, hour by hour.

The camera's rays are traced once; each hour only needs shadow rays.
"""

from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

import cv2
import numpy as np

from fieldlum.core.arrays import ArrayLike, Floats32, Indices
from fieldlum.core.progress import progress
from fieldlum.core.records import Room
from fieldlum.room.scene.trace import SunPoints
from fieldlum.room.scene.view import patch_rays, traced_view

_HOURS = 64  # computed at a time; limits the memory


def sun_patches(
    room: Room,
    sun_direction: ArrayLike,
    normal_illuminance_lx: ArrayLike,
    *,
    height: int,
    heading_deg: float,
    sub: int | None = None,
) -> Floats32:
    """Return the luminance of surfaces due to direct sun only (Radiance's -ab 0), [n, H, W] cd/m2.

    sun_direction : [n, 3] unit vectors in world axes (x east, y north, z up); normal_illuminance_lx
    : [n] of the sun outside, on a plane normal to it, or one value for all. height : rows H; W =
    2H. heading_deg : azimuth of the centre column, clockwise from north. A box room is traced
    exactly: hard shadows, sub x sub rays for each pixel (by default as many as `patch_rays` gives),
    one mirror image in the panes. A room of kind "radiance" is traced by rtrace; `sub` does not
    count. Raises InputError for an impossible room, and as `traced` for the file of such a room.
    """
    suns = np.atleast_2d(np.asarray(sun_direction, float))
    normal = np.broadcast_to(np.asarray(normal_illuminance_lx, float), len(suns))
    if room.kind != "box":
        from fieldlum.room.scene.radiance import traced

        return traced(room, suns, normal, height, heading_deg)
    points = _sun_points(room, height, heading_deg, sub or patch_rays(height))
    toward = points.scene.to_room(suns)
    maps = np.zeros((len(suns), height, 2 * height), np.float32)

    def fill(hours: Indices) -> None:
        per_lx = points.direct(toward[hours]).reshape(len(hours), height, 2 * height)
        maps[hours] = per_lx * normal[hours, None, None].astype(np.float32)

    threads = max(cv2.getNumThreads(), 1)  # 1 in a process of the scheduler
    lit = np.flatnonzero(normal > 0)
    with ThreadPoolExecutor(threads) as pool:
        for start in range(0, len(lit), _HOURS):
            progress(start, len(lit), "sun patches")
            list(pool.map(fill, np.array_split(lit[start : start + _HOURS], threads)))
    progress(len(suns), len(suns), "")
    return maps


@lru_cache(maxsize=2)  # the work units of one year use the same points
def _sun_points(room: Room, height: int, heading_deg: float, sub: int) -> SunPoints:
    """Return the surface points of all pixels of a panorama, with sub x sub rays in each."""
    return traced_view(room, height, heading_deg, sub).sun_points()
