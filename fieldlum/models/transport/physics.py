"""Compute where the sun's light would go in the stated room: a coarse prior that captures correct.

A room file is rough: furniture is missing, reflectances are guesses. Therefore the computed light
is not added to anything. It only decides which hours are alike: two hours that light the room's
surfaces in the same way are informative about each other, even if the sun has just appeared above
the house across the street.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.light import Light
from fieldlum.projection import equirect_solid_angles
from fieldlum.records import Room, SiteFile

if TYPE_CHECKING:
    from fieldlum.scene.points import SunPoints

Array = NDArray[Any]

HEIGHT = 16  # rows of the coarse panorama from which the modes are computed; not measured
QUALITY = "draft"
MODES = 48  # number of singular modes; not measured
FAINT_SUN_LX = 20.0  # as `features.FAINT_SUN_LX`; chosen


@dataclass(frozen=True)
class Physics:
    """A coarse model of the sun's light in the room, after all bounces.

    modes [k, p]: singular modes of the camera's light due to sun on the room's p surface pieces,
    divided by `norm`, so that their features are about one with the sun in the room. position [m,
    3], axis, sign, share, piece [m]: points of the pieces that are tested for sun, in room
    coordinates.
    """

    room: Room
    modes: NDArray[np.float32]
    position: NDArray[np.float32]
    axis: NDArray[np.int8]
    sign: NDArray[np.int8]
    share: NDArray[np.float32]
    piece: NDArray[np.int32]
    norm: float = 1.0

    @cached_property
    def _points(self) -> SunPoints:
        from fieldlum.scene import build
        from fieldlum.scene.points import sun_points

        place = self.position.astype(float)
        pieces = self.modes.shape[1]
        return sun_points(
            build(self.room),
            place,
            self.axis,
            self.sign,
            self.share.astype(float),
            self.piece,
            pieces,
        )

    def features(self, light: Light) -> NDArray[np.float32]:
        """Return the coarse bounced sunlight of each hour, per unit of total light, [n, k]."""
        points = self._points
        toward = points.scene.to_room(light.shown_sun_direction)
        beam = light.direct_lx / light.total_lx / self.norm
        out = np.zeros((len(light), len(self.modes)), np.float32)

        def one(k: int) -> None:
            out[k] = self.modes @ (points.direct(toward[k]) * np.float32(beam[k]))

        with ThreadPoolExecutor(min(os.cpu_count() or 1, 8)) as pool:
            list(pool.map(one, np.flatnonzero(light.direct_lx > 0.0)))
        return out


def physics_of(setup: SiteFile, light: Light) -> Physics | None:
    """Return the room's coarse model, with its norm from the captured hours.

    Return None without a box room, or if no hour has sun.
    """
    room = setup.room
    if room is None or room.kind != "box" or not room.window:
        return None
    rough = _modes_of(setup)
    size = np.linalg.norm(rough.features(light), axis=1)  # [n]
    sunny = (light.direct_lx > FAINT_SUN_LX) & (size > 0.0)
    if not sunny.any():
        return None
    share = size[sunny] * light.total_lx[sunny] / light.direct_lx[sunny]
    return replace(rough, norm=float(np.percentile(share, 75)))


@lru_cache(maxsize=4)
def _modes_of(setup: SiteFile) -> Physics:
    """Compute the modes of a room; stored, because training fits the same room some 20 times."""
    from fieldlum.simulate.gather import FIRST_PIECE
    from fieldlum.simulate.truth import ground_truth

    assert setup.room is not None
    truth = ground_truth(setup, height=HEIGHT, quality=QUALITY)
    reflect = (truth.pieces.reflectance / np.pi).astype(np.float32)
    seen = (truth.to_pixels @ truth.from_points[:, FIRST_PIECE:]).toarray()
    bounce = truth.from_pieces[:, FIRST_PIECE:].multiply(reflect[:, None]).T.tocsr()
    whole = seen
    # each bounce leaves less than half of the light, so the rest is below a millionth
    for _ in range(20):
        whole = seen + (bounce @ whole.T).T
    whole = whole * reflect * np.sqrt(equirect_solid_angles(HEIGHT, 2 * HEIGHT)).ravel()[:, None]
    _, values, modes = np.linalg.svd(whole, full_matrices=False)
    pieces = truth.pieces
    return Physics(
        setup.room,
        np.asarray(values[:MODES, None] * modes[:MODES], np.float32),
        pieces.position.astype(np.float32),
        pieces.axis[pieces.piece],
        pieces.sign[pieces.piece],
        pieces.share.astype(np.float32),
        pieces.piece.astype(np.int32),
    )
