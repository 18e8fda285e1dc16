"""Follow rays to solids, and lines from there through a window to the sun: compiled loops.

A search follows some 10^10 pairs of hour and ray. `fieldlum.scene_fit.renderer` calls these loops;
its docstrings describe the arrays. Lengths are in m, in room axes; numbers are float32.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.arrays import Floats32, Indices
from fieldlum.compiled import compiled

_AHEAD_M = np.float32(1e-3)  # chosen: a surface does not shade itself, and no object is as thin
_GRAZING = np.float32(1e-4)  # chosen: cosine of a sun 0.006 degrees above the glass
_SMALLEST = np.float32(1e-9)  # of a direction along an axis: avoids a division by zero; chosen
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_INFINITE = np.float32(np.inf)
# Neighbouring rays that are left out together if no line of them passes the window; chosen.
_BLOCK = 32


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
def _is_shaded(
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
    return bool(leaves > enters and leaves > _AHEAD_M and enters > -_AHEAD_M)


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
    inverse = _inverse(suns)
    for k in range(len(hour)):
        hidden[k] = _is_shaded(solids, 0, position, ray[k], inverse, hour[k])
    return hidden


@compiled
def _inverse(suns: Floats32) -> Floats32:
    """Return one over each component, at most 10^9."""
    inverse = np.empty_like(suns)
    for hour in range(len(suns)):
        for axis in range(3):
            toward = suns[hour, axis]
            inverse[hour, axis] = _ONE / (toward if abs(toward) >= _SMALLEST else _SMALLEST)
    return inverse


@compiled
def _passed(beyond: np.float32, spread: np.float32) -> np.float32:
    """Return the share of a ray's spread beyond an edge that its middle passes by so much."""
    reach = _HALF * spread
    if beyond >= reach:
        return _ONE
    if beyond <= -reach:
        return _ZERO
    return beyond / spread + _HALF


@compiled
def _top(window: Floats32, u: np.float32) -> np.float32:
    """Return the height of a window's upper edge; see `guess.WindowRect.top_m`."""
    u0, u1, z1, arch, slant = window[3], window[4], window[6], window[7], window[8]
    x = min(max((u + u - u0 - u1) / (u1 - u0), -_ONE), _ONE)
    fallen = arch * (_ONE - np.sqrt(_ONE - x * x))
    return z1 - fallen - abs(slant) * (_ONE + np.sign(slant) * x) * _HALF


@compiled
def _blocks(
    position: Floats32, axis: int, window: Floats32, spread: Floats32
) -> tuple[Floats32, Floats32]:
    """Return the least and the largest u, z, distance to the wall, and spread of blocks, [b, 4]."""
    inner, outward = window[0], window[1]
    count = (len(position) + _BLOCK - 1) // _BLOCK
    least, most = np.full((count, 4), _INFINITE), np.full((count, 4), -_INFINITE)
    for ray in range(len(position)):
        block = ray // _BLOCK
        across = (inner - position[ray, axis]) * outward
        bounds = position[ray, 1 - axis], position[ray, 2], across, spread[ray]
        for k in range(4):
            least[block, k] = min(least[block, k], bounds[k])
            most[block, k] = max(most[block, k], bounds[k])
    return least, most


@compiled
def lit_pairs(
    axis: int, window: Floats32, bars: Floats32, solids: Floats32, position: Floats32,
    face: NDArray[np.int8], spread: Floats32, suns: Floats32, glass: Floats32,
) -> tuple[Indices, Indices, Floats32]:  # fmt: skip
    """Return the pairs of hour and ray that the sun reaches through one window, and its strength.

    axis: of the wall's normal, 0 or 1. window: inner face, outward (1 or -1), thickness of the
    wall, u from and to, z from and to, arch, slant [9]. bars: upright (1 or 0), span from and to,
    depth from and to [b, 5]. solids: as in `entered` [s, 3, 3]. face: axis of the normal, plus
    3 where it points to lower numbers, -1 for rays that the sun cannot reach [r]. glass:
    transmittance at each hour [n]. The strength is described at `renderer.LitEntries`.
    """
    inner, outward, thickness = window[0], window[1], window[2]
    level_top = window[7] == _ZERO and window[8] == _ZERO
    least, most = _blocks(position, axis, window, spread)
    inverse = _inverse(suns)
    room = 1024
    hours, rays = np.empty(room, np.intp), np.empty(room, np.intp)
    strengths = np.empty(room, np.float32)
    count = 0
    for hour in range(len(suns)):
        toward = suns[hour, axis] * outward
        if toward <= _GRAZING or suns[hour, 2] <= _ZERO:
            continue
        slope_u, slope_z = suns[hour, 1 - axis] / toward, suns[hour, 2] / toward
        shift_u, shift_z = slope_u * thickness, slope_z * thickness
        low_u, high_u = window[3] - min(shift_u, _ZERO), window[4] - max(shift_u, _ZERO)
        low_z, high_z = window[5] - min(shift_z, _ZERO), window[6] - max(shift_z, _ZERO)
        for block in range(len(least)):
            reach = _HALF * most[block, 3]
            ends_u = slope_u * least[block, 2], slope_u * most[block, 2]
            if least[block, 0] + min(ends_u[0], ends_u[1]) >= high_u + reach:
                continue
            if most[block, 0] + max(ends_u[0], ends_u[1]) <= low_u - reach:
                continue
            if least[block, 1] + slope_z * least[block, 2] >= high_z + reach:
                continue
            if most[block, 1] + slope_z * most[block, 2] <= low_z - reach:
                continue
            for ray in range(block * _BLOCK, min((block + 1) * _BLOCK, len(position))):
                across = (inner - position[ray, axis]) * outward
                u = position[ray, 1 - axis] + slope_u * across
                z = position[ray, 2] + slope_z * across
                width = spread[ray]
                reach = _HALF * width
                outside = u <= low_u - reach or u >= high_u + reach
                if outside or z <= low_z - reach or z >= high_z + reach:
                    continue
                if face[ray] < 0 or across <= _ZERO:
                    continue
                share = _passed(u - low_u, width) * _passed(high_u - u, width)
                share *= _passed(z - low_z, width) * _passed(high_z - z, width)
                if not level_top:
                    share *= _passed(_top(window, u) - z, width)
                    share *= _passed(_top(window, u + shift_u) - z - shift_z, width)
                for bar in range(len(bars)):
                    upright = bars[bar, 0] > _ZERO
                    at, slope = (u, slope_u) if upright else (z, slope_z)
                    first, last = at + slope * bars[bar, 3], at + slope * bars[bar, 4]
                    below, above = bars[bar, 1] - max(first, last), min(first, last) - bars[bar, 2]
                    share *= _ONE - _passed(-below, width) * _passed(-above, width)
                facing = face[ray]
                cosine = suns[hour, facing] if facing < 3 else -suns[hour, facing - 3]
                strength = cosine * share
                if strength <= _ZERO:
                    continue
                hidden = False
                for solid in range(len(solids)):
                    if _is_shaded(solids, solid, position, ray, inverse, hour):
                        hidden = True
                        break
                if hidden:
                    continue
                if count == room:
                    room *= 2
                    hours, rays = _longer(hours, room), _longer(rays, room)
                    strengths = _longer(strengths, room)
                hours[count], rays[count] = hour, ray
                strengths[count] = strength * glass[hour]
                count += 1
    return hours[:count].copy(), rays[:count].copy(), strengths[:count].copy()


@compiled
def _longer(values: NDArray[Any], room: int) -> NDArray[Any]:
    """Return a copy with room for more values."""
    longer = np.empty(room, values.dtype)
    longer[: len(values)] = values
    return longer
