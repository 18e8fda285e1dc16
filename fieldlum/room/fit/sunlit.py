"""Follow rays to solids, and lines from there to the sun: compiled loops.

`fieldlum.room.fit.renderer` calls these loops; its docstrings describe the arrays. Lengths are in
m, in room axes; numbers are float32.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats32, Indices
from fieldlum.core.compiled import compiled

AHEAD_M = np.float32(1e-3)  # chosen: a surface does not shade itself, and no object is as thin
_SMALLEST = np.float32(1e-9)  # of a direction along an axis: avoids a division by zero; chosen
_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
_INFINITE = np.float32(np.inf)


@compiled
def shell_ends(
    eye: Floats32, direction: Floats32, inverse: Floats32, size: Floats32
) -> tuple[Floats32, NDArray[np.int16]]:
    """Return the length of each ray to the shell of the room, m [r], and the surface there [r].

    eye [3]; direction, inverse [3, r]; size: of the room from the origin [3]. A surface is twice
    the axis of its normal, plus one at the high end.
    """
    count = direction.shape[1]
    nearest = np.full(count, _INFINITE)
    surface = np.zeros(count, np.int16)
    for ray in range(count):
        for axis in range(3):
            high = direction[axis, ray] > _ZERO
            bound = size[axis] if high else _ZERO
            length = (bound - eye[axis]) * inverse[axis, ray]
            if length < nearest[ray]:
                nearest[ray] = length
                surface[ray] = 2 * axis + high
    return nearest, surface


@compiled
def entered(
    solid: Floats32, eye: Floats32, inverse: Floats32, nearest: Floats32
) -> tuple[Indices, Floats32, NDArray[np.int8]]:
    """Return rays that enter a solid before they are `nearest` [r] m long: index, length, face [k].

    solid: low and high corner [2, 3]. A ray that starts within the solid does not count.
    """
    low, high = solid[0], solid[1]
    count = len(nearest)
    rows = np.empty(count, np.intp)
    lengths = np.empty(count, np.float32)
    faces = np.empty(count, np.int8)
    entered = 0
    for ray in range(count):
        near, far, face = _ZERO, nearest[ray], -1
        for axis in range(3):
            a = (low[axis] - eye[axis]) * inverse[axis, ray]
            b = (high[axis] - eye[axis]) * inverse[axis, ray]
            first, last = min(a, b), max(a, b)
            if first > near:
                near, face = first, axis
            far = min(far, last)
        if near < far and face >= 0:
            rows[entered], lengths[entered], faces[entered] = ray, near, face
            entered += 1
    return rows[:entered].copy(), lengths[:entered].copy(), faces[:entered].copy()


@compiled
def end_points(
    eye: Floats32, direction: Floats32, rows: Indices, length: Floats32, face: NDArray[np.int8]
) -> tuple[Floats32, Floats32]:
    """Return where some rays end [k, 3], and the signs of the normals of their faces [k].

    rows: indices of the rays; length: to the end, m [k]; face: axis of the normal [k].
    """
    count = len(rows)
    position, sign = np.empty((count, 3), np.float32), np.empty(count, np.float32)
    for k in range(count):
        ray = rows[k]
        for axis in range(3):
            position[k, axis] = eye[axis] + direction[axis, ray] * length[k]
        sign[k] = -_ONE if direction[face[k], ray] > _ZERO else _ONE
    return position, sign


@compiled
def is_shaded(
    solids: Floats32, number: int, position: Floats32, ray: int, inverse: Floats32, hour: int
) -> bool:
    """Return whether a solid is between a position [r, 3] and the sun.

    solids: as in `entered` [s, 2, 3], of which solid `number` counts; inverse: of suns [n, 3].
    Numbers are read one by one: views of rows take three times as long.
    """
    enters, leaves = -_INFINITE, _INFINITE
    for axis in range(3):
        first, last = _slab(solids, number, position, ray, inverse, hour, axis)
        enters, leaves = max(enters, first), min(leaves, last)
    return bool(leaves > enters and leaves > AHEAD_M and enters > -AHEAD_M)


@compiled
def _slab(
    solids: Floats32, number: int, position: Floats32, ray: int, inverse: Floats32, hour: int,
    axis: int,
) -> tuple[np.float32, np.float32]:  # fmt: skip
    """Return where a line towards the sun enters and leaves a solid's extent along an axis."""
    low, high = solids[number, 0, axis], solids[number, 1, axis]
    start = (low - position[ray, axis]) * inverse[hour, axis]
    extent = (high - low) * inverse[hour, axis]
    return start + min(extent, _ZERO), start + max(extent, _ZERO)


@compiled
def shaded(
    solid: Floats32, position: Floats32, suns: Floats32, hour: Indices, ray: Indices
) -> NDArray[np.bool_]:
    """Return whether a solid is between position and sun, for k pairs of hour and ray, [k].

    solid: as in `entered` [2, 3]; position [r, 3]; suns: unit vectors [n, 3]; hour, ray: indices
    into these [k].
    """
    hidden = np.empty(len(hour), np.bool_)
    solids = solid.reshape(1, 2, 3)
    inverse = inverses_of(suns)
    for k in range(len(hour)):
        hidden[k] = is_shaded(solids, 0, position, ray[k], inverse, hour[k])
    return hidden


@compiled
def inverses_of(suns: Floats32) -> Floats32:
    """Return one over each component, at most 10^9."""
    inverse = np.empty_like(suns)
    for hour in range(len(suns)):
        for axis in range(3):
            toward = suns[hour, axis]
            inverse[hour, axis] = _ONE / (toward if abs(toward) >= _SMALLEST else _SMALLEST)
    return inverse
