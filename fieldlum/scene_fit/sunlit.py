"""Follow rays to solids, and lines from there to the sun: compiled loops.

`fieldlum.scene_fit.renderer` calls these loops; its docstrings describe the arrays. Lengths are in
m, in room axes; numbers are float32.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldlum.arrays import Floats32, Indices
from fieldlum.compiled import compiled

AHEAD_M = np.float32(1e-3)  # chosen: a surface does not shade itself, and no object is as thin
_SMALLEST = np.float32(1e-9)  # of a direction along an axis: avoids a division by zero; chosen
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
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
def _round_crossing(
    solid: Floats32, x: np.float32, y: np.float32, dx: np.float32, dy: np.float32
) -> tuple[np.float32, np.float32]:
    """Return where a line enters and leaves an upright cylinder, in lengths of its direction.

    The plan is the ellipse that touches the sides of a box. Without a crossing it leaves first.
    """
    half_x = _HALF * (solid[1, 0] - solid[0, 0])
    half_y = _HALF * (solid[1, 1] - solid[0, 1])
    px, py = (x - solid[0, 0]) / half_x - _ONE, (y - solid[0, 1]) / half_y - _ONE
    ex, ey = dx / half_x, dy / half_y
    a, b, c = ex * ex + ey * ey, px * ex + py * ey, px * px + py * py - _ONE
    root = b * b - a * c
    if root <= _ZERO or a <= _ZERO:
        return _INFINITE, -_INFINITE
    root = np.sqrt(root)
    return (-b - root) / a, (-b + root) / a


@compiled
def entered(
    solid: Floats32, eye: Floats32, inverse: Floats32, nearest: Floats32
) -> tuple[Indices, Floats32, NDArray[np.int8]]:
    """Return rays that enter a solid before they are `nearest` [r] m long: index, length, face [k].

    solid: low corner, high corner, and 1 in the third row's first number if it is round [3, 3]. A
    ray that starts within the solid does not count. The face of a round side is the nearer axis.
    """
    low, high, is_round = solid[0], solid[1], solid[2, 0] > _ZERO
    count = len(nearest)
    rows = np.empty(count, np.intp)
    lengths = np.empty(count, np.float32)
    faces = np.empty(count, np.int8)
    entered = 0
    for ray in range(count):
        near, far, face = _ZERO, nearest[ray], -1
        if is_round:
            dx, dy = _ONE / inverse[0, ray], _ONE / inverse[1, ray]
            first, last = _round_crossing(solid, eye[0], eye[1], dx, dy)
            if first > near:
                near = first
                across = (eye[0] + first * dx - _HALF * (low[0] + high[0])) / (
                    high[0] - low[0]
                ) ** 2
                along = (eye[1] + first * dy - _HALF * (low[1] + high[1])) / (high[1] - low[1]) ** 2
                face = 0 if abs(across) > abs(along) else 1
            far = min(far, last)
        for axis in range(2 if is_round else 0, 3):
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

    solids: as in `entered` [s, 3, 3], of which solid `number` counts; inverse: of suns [n, 3].
    Numbers are read one by one: views of rows take three times as long.
    """
    enters, leaves = -_INFINITE, _INFINITE
    if solids[number, 2, 0] > _ZERO:
        x, y = position[ray, 0], position[ray, 1]
        dx, dy = _ONE / inverse[hour, 0], _ONE / inverse[hour, 1]
        enters, leaves = _round_crossing(solids[number], x, y, dx, dy)
    else:
        for axis in range(2):
            first, last = _slab(solids, number, position, ray, inverse, hour, axis)
            enters, leaves = max(enters, first), min(leaves, last)
    first, last = _slab(solids, number, position, ray, inverse, hour, 2)
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

    solid: as in `entered` [3, 3]; position [r, 3]; suns: unit vectors [n, 3]; hour, ray: indices
    into these [k].
    """
    hidden = np.empty(len(hour), np.bool_)
    solids = solid.reshape(1, 3, 3)
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
