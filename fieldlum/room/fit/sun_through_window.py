"""Follow lines from rays' ends through a window to the sun: compiled loops.

A search follows some 10^10 pairs of hour and ray. `fieldlum.room.fit.renderer` calls these loops;
its docstrings describe the arrays. Rays are in blocks of 32 neighbours, which are left out together
if none of their lines passes the window; loops over a block have no branches, so that a processor
computes several rays at once. Lengths are in m, in room axes; numbers are float32.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats32, Indices
from fieldlum.core.compiled import compiled
from fieldlum.room.fit.sunlit import AHEAD_M, inverses_of

_GRAZING = np.float32(1e-4)  # chosen: cosine of a sun 0.006 degrees above the glass
_ZERO, _HALF, _ONE = np.float32(0.0), np.float32(0.5), np.float32(1.0)
_INFINITE = np.float32(np.inf)
_BLOCK = 32  # chosen


@compiled
def _passed(beyond: np.float32, inverse_spread: np.float32) -> np.float32:
    """Return the share of a ray's spread that is past an edge; beyond: how far its middle is, m."""
    return min(max(beyond * inverse_spread + _HALF, _ZERO), _ONE)


@compiled
def _blocks(
    position: Floats32, axis: int, window: Floats32, spread: Floats32
) -> tuple[Floats32, Floats32, Floats32]:
    """Return numbers of rays in blocks [b, 5, 32], and their least and largest values [b, 5].

    The numbers are u, z, distance to the wall, one over the spread, and the place along the wall's
    normal. The last block is filled up with its last ray.
    """
    inner, outward = window[0], window[1]
    count = (len(position) + _BLOCK - 1) // _BLOCK
    numbers = np.empty((count, 5, _BLOCK), np.float32)
    least, most = np.full((count, 5), _INFINITE), np.full((count, 5), -_INFINITE)
    for block in range(count):
        for k in range(_BLOCK):
            ray = min(block * _BLOCK + k, len(position) - 1)
            numbers[block, 0, k] = position[ray, 1 - axis]
            numbers[block, 1, k] = position[ray, 2]
            numbers[block, 2, k] = (inner - position[ray, axis]) * outward
            numbers[block, 3, k] = _ONE / spread[ray]
            numbers[block, 4, k] = position[ray, axis]
            for number in range(5):
                least[block, number] = min(least[block, number], numbers[block, number, k])
                most[block, number] = max(most[block, number], numbers[block, number, k])
    return numbers, least, most


@compiled
def _may_shade(solids: Floats32, number: int, box: Floats32, inverse: Floats32, hour: int) -> bool:
    """Return False if a solid shades no position in a box [2, 3] from the sun."""
    enters, leaves = -_INFINITE, _INFINITE
    for axis in range(3):
        toward = inverse[hour, axis]
        near, far = (0, 1) if toward > _ZERO else (1, 0)
        enters = max(enters, (solids[number, near, axis] - box[far, axis]) * toward)
        leaves = min(leaves, (solids[number, far, axis] - box[near, axis]) * toward)
    return bool(leaves > enters and leaves > AHEAD_M)


@compiled
def _shade(
    solids: Floats32, solid: int, axis: int, numbers: Floats32, block: int, inverses: Floats32,
    hour: int, strengths: Floats32, pair: int,
) -> None:  # fmt: skip
    """Set the strengths of a block's rays to 0 where a box hides the sun; as `sunlit.is_shaded`."""
    along = 1 - axis
    by_a, by_u, by_z = inverses[hour, axis], inverses[hour, along], inverses[hour, 2]
    low_a, low_u, low_z = solids[solid, 0, axis], solids[solid, 0, along], solids[solid, 0, 2]
    size_a = (solids[solid, 1, axis] - low_a) * by_a
    size_u = (solids[solid, 1, along] - low_u) * by_u
    size_z = (solids[solid, 1, 2] - low_z) * by_z
    near_a, near_u, near_z = min(size_a, _ZERO), min(size_u, _ZERO), min(size_z, _ZERO)
    far_a, far_u, far_z = max(size_a, _ZERO), max(size_u, _ZERO), max(size_z, _ZERO)
    for k in range(_BLOCK):
        a = (low_a - numbers[block, 4, k]) * by_a
        u = (low_u - numbers[block, 0, k]) * by_u
        z = (low_z - numbers[block, 1, k]) * by_z
        enters = max(max(a + near_a, u + near_u), z + near_z)
        leaves = min(min(a + far_a, u + far_u), z + far_z)
        hidden = (leaves > enters) & (leaves > AHEAD_M) & (enters > -AHEAD_M)
        strengths[pair, k] = _ZERO if hidden else strengths[pair, k]


@compiled
def _boxes(position: Floats32) -> Floats32:
    """Return the low and the high corner of each block of positions, [b, 2, 3]."""
    count = (len(position) + _BLOCK - 1) // _BLOCK
    boxes = np.empty((count, 2, 3), np.float32)
    boxes[:, 0], boxes[:, 1] = _INFINITE, -_INFINITE
    for ray in range(len(position)):
        for axis in range(3):
            value = position[ray, axis]
            boxes[ray // _BLOCK, 0, axis] = min(boxes[ray // _BLOCK, 0, axis], value)
            boxes[ray // _BLOCK, 1, axis] = max(boxes[ray // _BLOCK, 1, axis], value)
    return boxes


@compiled
def _opening(
    axis: int, window: Floats32, suns: Floats32, hour: int
) -> tuple[np.float32, np.float32, np.float32, np.float32, np.float32, np.float32]:
    """Return slopes of lines to the sun, and the opening that they pass.

    Slopes are along u and z; the opening is u from and to, z from and to, at the inner
    face.
    """
    toward = suns[hour, axis] * window[1]
    slope_u, slope_z = suns[hour, 1 - axis] / toward, suns[hour, 2] / toward
    shift_u, shift_z = slope_u * window[2], slope_z * window[2]
    low_u, high_u = window[3] - min(shift_u, _ZERO), window[4] - max(shift_u, _ZERO)
    low_z, high_z = window[5] - min(shift_z, _ZERO), window[6] - max(shift_z, _ZERO)
    return slope_u, slope_z, low_u, high_u, low_z, high_z


@compiled
def _range(
    least: Floats32, most: Floats32, block: int, number: int, slope: np.float32
) -> tuple[np.float32, np.float32]:
    """Return between what values a block's lines to the sun cross the wall, with half their spread.

    least, most: of `_blocks`; number: 0 for u, 1 for z; slope: of the lines, see `_opening`.
    """
    near, far = slope * least[block, 2], slope * most[block, 2]
    reach = _HALF / least[block, 3]
    low = least[block, number] + min(near, far) - reach
    return low, most[block, number] + max(near, far) + reach


@compiled
def _reached(
    axis: int, window: Floats32, least: Floats32, most: Floats32, suns: Floats32
) -> tuple[Indices, Indices]:
    """Return the pairs of hour and block of which some line to the sun passes the window, [k].

    least, most: of `_blocks`.
    """
    hours = np.empty(len(suns) * len(least), np.intp)
    blocks = np.empty(len(suns) * len(least), np.intp)
    count = 0
    for hour in range(len(suns)):
        if suns[hour, axis] * window[1] <= _GRAZING or suns[hour, 2] <= _ZERO:
            continue
        slope_u, slope_z, low_u, high_u, low_z, high_z = _opening(axis, window, suns, hour)
        for block in range(len(least)):
            least_u, most_u = _range(least, most, block, 0, slope_u)
            least_z, most_z = _range(least, most, block, 1, slope_z)
            if least_u < high_u and most_u > low_u and least_z < high_z and most_z > low_z:
                hours[count], blocks[count] = hour, block
                count += 1
    return hours[:count], blocks[:count]


@compiled
def _faces(face: NDArray[np.int8], count: int) -> NDArray[np.uint8]:
    """Return the faces of blocks of rays plus 1, [b, 32]: 0 for rays that the sun cannot reach."""
    faces = np.zeros((count, _BLOCK), np.uint8)
    for ray in range(len(face)):
        faces[ray // _BLOCK, ray % _BLOCK] = face[ray] + 1
    return faces


@compiled
def _cosines(suns: Floats32) -> Floats32:
    """Return the cosine of incidence on each face at each hour, at least 0, [n, 7].

    Place 0 is for no face; then x, y, z, and the faces towards lower numbers.
    """
    cosines = np.zeros((len(suns), 7), np.float32)
    for hour in range(len(suns)):
        for axis in range(3):
            cosines[hour, 1 + axis] = max(suns[hour, axis], _ZERO)
            cosines[hour, 4 + axis] = max(-suns[hour, axis], _ZERO)
    return cosines


@compiled
def lit_blocks(
    axis: int, window: Floats32, bars: Floats32, solids: Floats32, position: Floats32,
    face: NDArray[np.int8], spread: Floats32, suns: Floats32, glass: Floats32,
) -> tuple[Indices, Indices, Floats32]:  # fmt: skip
    """Return k pairs of hour and block of 32 rays, and the sun's strength on each ray, [k, 32].

    axis: of the wall's normal, 0 or 1. window: inner face, outward (1 or -1), thickness of the
    wall, u from and to, z from and to [7]. bars: upright (1 or 0), span from and to,
    depth from and to [b, 5]. solids: as in `entered` [s, 2, 3]. face: axis of the normal, plus
    3 where it points to lower numbers, -1 for rays that the sun cannot reach [r]. glass:
    transmittance at each hour [n]. The strength is described at `renderer.LitEntries`.
    """
    numbers, least, most = _blocks(position, axis, window, spread)
    hours, blocks = _reached(axis, window, least, most, suns)
    boxes, faces = _boxes(position), _faces(face, len(least))
    alike = np.array([(faces[block] == faces[block, 0]).all() for block in range(len(faces))])
    cosines, inverses = _cosines(suns), inverses_of(suns)
    strengths = np.empty((len(hours), _BLOCK), np.float32)
    us, zs = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    for pair in range(len(hours)):
        hour, block = hours[pair], blocks[pair]
        sun = _opening(axis, window, suns, hour)
        slope_u, slope_z, low_u, high_u, low_z, high_z = sun
        least_u, most_u = _range(least, most, block, 0, slope_u)
        least_z, most_z = _range(least, most, block, 1, slope_z)
        for k in range(_BLOCK):
            across, inverse = numbers[block, 2, k], numbers[block, 3, k]
            us[k] = numbers[block, 0, k] + slope_u * across
            zs[k] = numbers[block, 1, k] + slope_z * across
            share = _passed(us[k] - low_u, inverse) * _passed(high_u - us[k], inverse)
            share *= _passed(zs[k] - low_z, inverse) * _passed(high_z - zs[k], inverse)
            strengths[pair, k] = share if across > _ZERO else _ZERO
        if alike[block]:
            cosine = cosines[hour, faces[block, 0]]
            for k in range(_BLOCK):
                strengths[pair, k] = strengths[pair, k] * cosine * glass[hour]
        else:
            for k in range(_BLOCK):
                strengths[pair, k] = (
                    strengths[pair, k] * cosines[hour, faces[block, k]] * glass[hour]
                )
        for bar in range(len(bars)):
            upright = bars[bar, 0] > _ZERO
            slope = slope_u if upright else slope_z
            near, far = slope * bars[bar, 3], slope * bars[bar, 4]
            low, high = bars[bar, 1] - max(near, far), bars[bar, 2] - min(near, far)
            if high <= (least_u if upright else least_z) or low >= (most_u if upright else most_z):
                continue
            at = us if upright else zs
            for k in range(_BLOCK):
                inverse = numbers[block, 3, k]
                hidden = _passed(at[k] - low, inverse) * _passed(high - at[k], inverse)
                strengths[pair, k] *= _ONE - hidden
        for solid in range(len(solids)):
            if _may_shade(solids, solid, boxes[block], inverses, hour):
                _shade(solids, solid, axis, numbers, block, inverses, hour, strengths, pair)
    return hours, blocks, strengths


@compiled
def add_to_pixels(
    hours: Indices, blocks: Indices, strengths: Floats32, tone: Floats32, pixel: Indices,
    totals: Floats32,
) -> None:  # fmt: skip
    """Add the strengths of `lit_blocks`, times a tone of each ray [r], to pixels of hours [n, m].

    pixel: index below m of each ray's pixel [r].
    """
    for pair in range(len(hours)):
        first, hour = blocks[pair] * _BLOCK, hours[pair]
        current, total = pixel[first], _ZERO  # neighbouring rays belong to the same pixel
        for k in range(min(_BLOCK, len(pixel) - first)):
            if pixel[first + k] != current:
                totals[hour, current] += total
                current, total = pixel[first + k], _ZERO
            total += strengths[pair, k] * tone[first + k]
        totals[hour, current] += total


@compiled
def lit_pairs(
    hours: Indices, blocks: Indices, strengths: Floats32, rays: int
) -> tuple[Indices, Indices, Floats32]:
    """Return hour, ray and strength of the lit rays in `lit_blocks`, [k]; rays: their number r."""
    at_hour, at_ray = np.empty(strengths.size, np.intp), np.empty(strengths.size, np.intp)
    lit = np.empty(strengths.size, np.float32)
    count = 0
    for pair in range(len(hours)):
        first = blocks[pair] * _BLOCK
        for k in range(min(_BLOCK, rays - first)):
            if strengths[pair, k] > _ZERO:
                at_hour[count], at_ray[count] = hours[pair], first + k
                lit[count] = strengths[pair, k]
                count += 1
    return at_hour[:count].copy(), at_ray[:count].copy(), lit[:count].copy()
