"""Compute whether the sun enters a box room's windows, past reveals and obstructions."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import Room
from fieldlum.room.scene.geometry import BoxScene, Opening, build
from fieldlum.room.scene.patches import disc_visibility
from fieldlum.room.scene.trace import blocked
from fieldlum.sky import sun

Points = Floats
GRID = 6  # test points across and up a window; chosen, not measured


def sun_enters(room: Room, altitude_deg: ArrayLike, azimuth_deg: ArrayLike) -> Mask:
    """Return a mask [n]: True where the sun at these angles [deg] shines through a window.

    It shines through if one of 6 x 6 points of the window is lit past reveals and obstructions;
    window bars are ignored. azimuth_deg: clockwise from true north. Raises InputError for an
    impossible room.
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


def sun_in_view(room: Room, altitude_deg: ArrayLike, azimuth_deg: ArrayLike) -> Mask:
    """Return a mask [n]: True where the camera sees at least a part of the sun disc.

    altitude_deg, azimuth_deg: of the sun [n], clockwise from true north. Raises InputError for an
    impossible room.
    """
    scene = build(room)
    return disc_visibility(scene, scene.to_room(sun.direction(altitude_deg, azimuth_deg)))[0] > 0


def _points(opening: Opening) -> Points:
    """Return a grid of points over the inner end of the window, [GRID * GRID, 3]."""
    steps = (np.arange(GRID) + 0.5) / GRID
    (u0, u1), (z0, z1) = opening.u_m, opening.z_m
    along, up = np.meshgrid(u0 + (u1 - u0) * steps, z0 + (z1 - z0) * steps)
    points = np.empty((along.size, 3))
    points[:, opening.axis] = opening.inner_m
    points[:, opening.along] = along.ravel()
    points[:, 2] = up.ravel()
    return points


def _passes(scene: BoxScene, opening: Opening, points: Points, toward: Points) -> bool:
    """Return whether the sun is visible from any point past reveal and obstructions."""
    outer = points + toward * abs((opening.outer_m - opening.inner_m) / toward[opening.axis])
    u, z = outer[:, opening.along], outer[:, 2]
    (u0, u1), (z0, z1) = opening.u_m, opening.z_m
    free = outer[(u > u0) & (u < u1) & (z > z0) & (z < z1)]
    which = scene.of_kind("obstruction")
    return bool((~blocked(scene.low[which], scene.high[which], free, toward)).any())
