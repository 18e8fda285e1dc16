"""Compute direct sun on the surfaces of a guessed scene, at sampled pixels, in milliseconds.

`fieldlum.room.scene` renders a complete panorama of one room exactly. A search needs thousands of
scenes at a few thousand pixels, so this renderer knows only boxes: a ray from the
camera ends on the shell of the room or on a solid; from there the sun is seen if the line towards
it passes the inner and the outer rectangle of a window, misses its bars and misses all solids.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Indices
from fieldlum.room.fit.guess import Guess
from fieldlum.room.scene.box_room import WALLS, glass_optics
from fieldlum.room.scene.trace import EPSILON_M, HARD_M, add_through, nearest_box

# Surfaces of the shell, west, east, south and north wall, floor and ceiling, are numbered by twice
# the axis of the normal, plus one at the high end.
FLOOR = 4
SHELL = 6  # number of the shell's surfaces; solids have the numbers from here on
OUTSIDE = -1  # a ray that leaves through a window
_THICK_M = 1.0  # thickness of the boxes around the room; chosen, no ray passes them


class Surfaces(NamedTuple):
    """Where r camera rays end, in room axes.

    position_m [r, 3]; axis (0 x, 1 y, 2 z) and sign (1.0 or -1.0) of the normal of the surface that
    is hit, towards the camera [r]; surface [r]: 0 to 5 for west, east, south and north wall, floor
    and ceiling, 6 + k for solid k, -1 for a ray through a window; spread_m [r]: angle between
    neighbouring rays, of which a pixel has several, times the ray's length.
    """

    position_m: Floats
    axis: NDArray[np.int8]
    sign: NDArray[np.int8]
    surface: NDArray[np.int16]
    spread_m: Floats32


def surfaces(guess: Guess, rays_world: Floats32, spread: float = 0.0) -> Surfaces:
    """Return where camera rays end in the guess.

    rays_world: unit vectors [r, 3] in stated world axes: x east, y north, z up by the stated
    heading. spread: angle between neighbouring rays [rad]; 0 gives patches with hard edges. A ray
    through a window ends at the wall's inner face.
    """
    rays = np.ascontiguousarray(rays_world @ guess.camera_turn.T)
    eye = np.ascontiguousarray(np.broadcast_to(np.array(guess.camera_m), rays.shape))
    boxes, axes = SHELL + len(guess.solids), np.arange(3)
    low = np.full((boxes, 3), -_THICK_M)
    high = np.tile(np.array(guess.size_m) + _THICK_M, (boxes, 1))
    # shell: the box at the low end of each axis ends at 0, that at the high end begins at the size
    high[2 * axes, axes], low[2 * axes + 1, axes] = 0.0, guess.size_m
    for k, solid in enumerate(guess.solids, start=SHELL):
        low[k], high[k] = solid.low_m, solid.high_m
    distance, box, axis, sign = nearest_box(low, high, eye, rays)
    position = eye + rays * distance[:, None]
    surface = box.astype(np.int16)
    for rect in guess.windows:
        across, side = WALLS[rect.wall]
        along, height = position[:, 1 - across], position[:, 2]
        inside = (along > rect.u_m[0]) & (along < rect.u_m[1])
        inside &= (height > rect.z_m[0]) & (height < rect.z_m[1])
        surface[inside & (box == 2 * across + side)] = OUTSIDE
    softness = np.maximum(spread * distance, HARD_M).astype(np.float32)
    return Surfaces(position, axis, sign, surface, softness)


def unit_patches(
    guess: Guess, ends: Surfaces, suns_room: Floats, pixel: Indices, sub: int, tone: Floats
) -> Floats:
    """Return the sun patches of n suns in m pixels, per lx on the sun's normal, [n, m].

    A pixel has the mean, over its rays, of tone x cosine x glass x visible share of the sun. Times
    the sun's illuminance / pi it is the luminance of the sun patch. ends: of r rays; suns_room:
    unit vectors in room axes [n, 3]; pixel: index of each ray's pixel [r]; sub x sub rays make a
    pixel; tone: a factor of each ray, such as albedo [r].
    """
    total = np.zeros((len(suns_room), len(pixel) // sub**2))
    # 0 to 2: normal towards larger x, y, z; 3 to 5: towards smaller; -1: never lit (a ceiling)
    face = np.where(ends.sign > 0, ends.axis, ends.axis + 3).astype(np.int8)
    face[(face == 5) | (ends.surface == OUTSIDE)] = -1
    above_face = ends.position_m.astype(np.float32)  # so that a face does not shade itself
    above_face[np.arange(len(above_face)), ends.axis] += ends.sign * np.float32(2.0 * EPSILON_M)
    suns = suns_room.astype(float)
    for number, rect in enumerate(guess.windows):
        glass = glass_optics(rect.transmittance, suns[:, WALLS[rect.wall][0]])[0]
        _add_through_window(
            guess, number, above_face, face, ends.spread_m, tone / float(sub**2), pixel, suns,
            glass, total,
        )  # fmt: skip
    return total.astype(np.float32)


def sky_openness(guess: Guess, rays_world: Floats32, spread: float) -> Floats32:
    """Return the share of the sky that a guess leaves to camera rays above the horizon, 0 to 1 [s].

    rays_world: unit vectors [s, 3], as in `surfaces`; spread: angle over which edges are soft, rad.
    """
    rays = (rays_world @ guess.camera_turn.T).astype(float)
    total = np.zeros((len(rays), 1))
    camera, column = np.array([guess.camera_m], np.float32), np.zeros(1, np.intp)
    for number, rect in enumerate(guess.windows):
        axis, side = WALLS[rect.wall]
        face = np.array([axis if side else axis + 3], np.int8)
        away = abs(guess.size_m[axis] * side - guess.camera_m[axis])
        soft = np.array([max(spread * away, HARD_M)], np.float32)
        cosine = np.maximum(np.abs(rays[:, axis]), 1e-3)  # a camera is no surface
        _add_through_window(
            guess, number, camera, face, soft, np.ones(1), column, rays, 1.0 / cosine, total
        )
    return np.minimum(total[:, 0], 1.0).astype(np.float32)


def _add_through_window(
    guess: Guess, number: int, position: Floats32, face: NDArray[np.int8], softness: Floats32,
    weight: Floats, target: Indices, suns: Floats, glass: Floats, totals: Floats,
) -> None:  # fmt: skip
    """Add to `totals` the light of n suns through window `number` of the guess, past all solids.

    The other arguments are those of `add_through`.
    """
    rect = guess.windows[number]
    axis, side = WALLS[rect.wall]
    inner, outward = (guess.size_m[axis], 1.0) if side else (0.0, -1.0)
    outer = inner + outward * guess.thickness_m
    opening = np.array([axis, outward, inner, outer, *rect.u_m, *rect.z_m])
    bars = [(b.upright, *b.span_m, *b.depth_m) for b in guess.bars if b.window == number]
    low = np.array([solid.low_m for solid in guess.solids]).reshape(-1, 3)
    high = np.array([solid.high_m for solid in guess.solids]).reshape(-1, 3)
    add_through(
        opening, np.array(bars, float).reshape(-1, 5), low, high, position, face,
        softness, weight, target, suns, glass, totals,
    )  # fmt: skip
