"""Whether the sun can come in: through a box room's windows, past its reveals and its
neighbours.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum import sun
from fieldlum.records import Room
from fieldlum.scene.geometry import BoxScene, Opening, build
from fieldlum.scene.patches import disc_visibility
from fieldlum.scene.trace import blocked

Points = NDArray[np.float64]
GRID = 6  # points across and up a window


def sun_enters(room: Room, altitude_deg: ArrayLike, azimuth_deg: ArrayLike) -> NDArray[np.bool_]:
    """[n]: some ray of the sun passes some window. Frame bars are left out.

    Raises InputError for an impossible room.
    """
    scene = build(room)
    suns = scene.to_room(sun.direction(altitude_deg, azimuth_deg))
    enters = np.zeros(len(suns), bool)
    for opening in scene.openings:
        points = _points(opening)
        for i in np.flatnonzero(
            ~enters & (suns[:, 2] > 0) & (opening.outward * suns[:, opening.axis] > 1e-6)
        ):
            enters[i] = _passes(scene, opening, points, suns[i])
    return enters


def sun_in_view(room: Room, altitude_deg: ArrayLike, azimuth_deg: ArrayLike) -> NDArray[np.bool_]:
    """[n]: the camera sees the disc, or a part of it, through a window. Raises InputError for an
    impossible room.
    """
    scene = build(room)
    return disc_visibility(scene, scene.to_room(sun.direction(altitude_deg, azimuth_deg)))[0] > 0


def _points(opening: Opening) -> Points:
    """A grid [GRID * GRID, 3] over the window's inner end."""
    steps = (np.arange(GRID) + 0.5) / GRID
    (u0, u1), (z0, z1) = opening.u_m, opening.z_m
    along, up = np.meshgrid(u0 + (u1 - u0) * steps, z0 + (z1 - z0) * steps)
    points = np.empty((along.size, 3))
    points[:, opening.axis], points[:, opening.along], points[:, 2] = (
        opening.inner_m,
        along.ravel(),
        up.ravel(),
    )
    return points


def _passes(scene: BoxScene, opening: Opening, points: Points, toward: Points) -> bool:
    """Whether any point sees the sun: out through the outer end of the reveal, past all
    obstructions outside.
    """
    outer = points + toward * abs((opening.outer_m - opening.inner_m) / toward[opening.axis])
    u, z = outer[:, opening.along], outer[:, 2]
    (u0, u1), (z0, z1) = opening.u_m, opening.z_m
    free = outer[(u > u0) & (u < u1) & (z > z0) & (z < z1)]
    which = scene.of_kind("obstruction")
    return bool((~blocked(scene.low[which], scene.high[which], free, toward)).any())
