"""Sample the sun disc by rays, for shadow rays and for Radiance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats, Floats32

SUN_RADIUS_DEG = 0.2665  # mean angular radius seen from the Earth: 959.6 arc seconds (IAU)
# Attribute of a rendered panorama with a partly hidden disc: for each of `disc_rays` 1 if the
# camera sees it, else 0.
DISC_RAYS = "disc_rays"


@dataclass(frozen=True, slots=True)
class SunPatches:
    """Results of direct sun at n times.

    luminance_cdm2 : [n, H, W] of sunlit surfaces, without the disc; visible_fraction : [n] of the
    disc, from the camera; disc_transmittance : [n] of the glass in front of it (0 if the disc is
    not visible); disc_lx : [n] illuminance from the disc at the camera, on a plane normal to the
    sun.
    """

    luminance_cdm2: Floats32
    visible_fraction: Floats
    disc_transmittance: Floats
    disc_lx: Floats

    def __len__(self) -> int:
        return len(self.luminance_cdm2)


def disc_rays(toward: Floats, rings: int = 4) -> Floats:
    """Return unit vectors to equal areas of the sun disc, [1 + 3 rings (rings + 1), 3].

    toward : unit vector to the disc's centre [3]. The disc has the radius SUN_RADIUS_DEG; 4 rings
    give 61 vectors.
    """
    radius, angle = [0.0], [0.0]
    for ring in range(1, rings + 1):
        count = 6 * ring
        radius += [(ring - 0.25) / (rings + 0.25)] * count
        angle += list((np.arange(count) + 0.5 * (ring % 2)) * 2 * np.pi / count)
    r = np.array(radius) * np.tan(np.radians(SUN_RADIUS_DEG))
    side = np.cross(toward, (0.0, 0.0, 1.0) if abs(toward[2]) < 0.9 else (1.0, 0.0, 0.0))
    side /= np.linalg.norm(side)
    other = np.cross(toward, side)
    rays = toward + r[:, None] * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)
