"""Sum the direct sun on surface points: compiled loops for panoramas and for scene fits.

A point inside the panes sees the sun through an opening, past bars and boxes; a point outside sees
it past the building. Lengths are in m, in room axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask
from fieldlum.core.compiled import compiled
from fieldlum.room.scene.geometry import BoxScene, glass_optics
from fieldlum.room.scene.trace import EPSILON_M

_GRAZING = 1e-6  # cosine; chosen: a sun 0.00006 degrees above a surface
HARD_M = 1e-7  # width of a hard edge; chosen, below any length of a room
_SMALLEST = 1e-9  # of a direction along an axis: avoids a division by zero; chosen


@compiled
def _passed(beyond: float, softness: float) -> float:
    """Return the share of a ray's width that is past an edge; beyond: how far its middle is, m."""
    return min(max(beyond / softness + 0.5, 0.0), 1.0)


@compiled
def _inverses(sun: Floats) -> Floats:
    """Return one over each component of a direction [3], at most 10^9."""
    inverse = np.empty(3)
    for axis in range(3):
        inverse[axis] = 1.0 / (sun[axis] if abs(sun[axis]) >= _SMALLEST else _SMALLEST)
    return inverse


@compiled
def _unshaded(
    low: Floats, high: Floats, position: Floats32, point: int, inverse: Floats,
    softness: float,
) -> float:  # fmt: skip
    """Return the share of a point of [r, 3] from which none of the boxes [s, 3] hides the sun.

    softness: width over which the shade of a box grows at its edges, m. The line to the sun enters
    a box through a face of one axis and leaves it through one of another; its distance from the
    edge between them follows from its length inside, which is negative outside the box.
    """
    share = 1.0
    # no shade begins farther from a box than this, as a length along the line to the sun
    reach = 0.5 * softness * np.sqrt(inverse[0] ** 2 + inverse[1] ** 2 + inverse[2] ** 2)
    for box in range(len(low)):
        enters, leaves = -np.inf, np.inf
        for axis in range(3):
            first = (low[box, axis] - position[point, axis]) * inverse[axis]
            last = (high[box, axis] - position[point, axis]) * inverse[axis]
            enters, leaves = max(enters, min(first, last)), min(leaves, max(first, last))
        if leaves <= EPSILON_M or enters - leaves > reach:
            continue
        if leaves - enters > reach:
            return 0.0
        along, across, entered, left = 0.0, 0.0, -1, -1
        for axis in range(3):
            first = (low[box, axis] - position[point, axis]) * inverse[axis]
            last = (high[box, axis] - position[point, axis]) * inverse[axis]
            if entered < 0 and min(first, last) == enters:
                along, entered = inverse[axis], axis
            if left < 0 and max(first, last) == leaves:
                across, left = inverse[axis], axis
        if entered == left:
            return 0.0
        share *= 1.0 - _passed((leaves - enters) / np.hypot(along, across), softness)
        if share <= 0.0:
            return 0.0
    return share


@compiled
def _cosine(face: int, sun: Floats) -> float:
    """Return the cosine of the sun on a face: 0, 1, 2 for +x, +y, +z; 3, 4, 5 for -x, -y, -z."""
    return sun[face] if face < 3 else -sun[face - 3]


@compiled
def add_through(
    opening: Floats, bars: Floats, low: Floats, high: Floats, position: Floats32,
    face: NDArray[np.int8], softness: Floats32, weight: Floats, target: Indices, suns: Floats,
    glass: Floats, totals: Floats,
) -> None:  # fmt: skip
    """Add weight x cosine x glass x visible share of points that see suns through an opening.

    opening: axis of the wall's normal, its sign outwards, inner and outer face, u from and to, z
    from and to [8]. bars: upright (1 or 0), span from and to, depth from and to, outwards from the
    inner face [b, 5]. low, high: corners of boxes that shade [s, 3]. For r points: position [r, 3],
    slightly above its surface; face, as in `_cosine`, -1 for one that no sun reaches; softness:
    width over which an edge's shade grows, m; weight; target: column of `totals`. suns: unit
    vectors [n, 3]; glass: transmittance at each [n]; totals [n, targets].
    """
    axis, outward = int(opening[0]), opening[1]
    along, inner, thickness = 1 - axis, opening[2], (opening[3] - opening[2]) * opening[1]
    for hour in range(len(suns)):
        toward = suns[hour, axis] * outward
        if toward <= _GRAZING or suns[hour, 2] <= 0.0:
            continue
        inverse = _inverses(suns[hour])
        slope_u, slope_z = suns[hour, along] / toward, suns[hour, 2] / toward
        shift_u, shift_z = slope_u * thickness, slope_z * thickness
        low_u, high_u = opening[4] - min(shift_u, 0.0), opening[5] - max(shift_u, 0.0)
        low_z, high_z = opening[6] - min(shift_z, 0.0), opening[7] - max(shift_z, 0.0)
        for point in range(len(face)):
            if face[point] < 0:
                continue
            across = (inner - position[point, axis]) * outward
            u = position[point, along] + slope_u * across
            z = position[point, 2] + slope_z * across
            soft = softness[point]
            if across > 2.0 * EPSILON_M:
                share = _passed(u - low_u, soft) * _passed(high_u - u, soft)
                if share <= 0.0:
                    continue
                share *= _passed(z - low_z, soft) * _passed(high_z - z, soft)
            elif across > -thickness / 2.0:  # in the reveal: only the outer end is ahead
                share = _passed(u + shift_u - opening[4], soft)
                share *= _passed(opening[5] - u - shift_u, soft)
                share *= _passed(z + shift_z - opening[6], soft)
                share *= _passed(opening[7] - z - shift_z, soft)
            else:
                continue
            cosine = _cosine(face[point], suns[hour])
            if share <= 0.0 or cosine <= _GRAZING:
                continue
            for bar in range(len(bars)):
                upright = bars[bar, 0] > 0.0
                at, slope = (u, slope_u) if upright else (z, slope_z)
                near, far = slope * bars[bar, 3], slope * bars[bar, 4]
                below, above = (
                    at + max(near, far) - bars[bar, 1],
                    bars[bar, 2] - at - min(near, far),
                )
                share *= 1.0 - _passed(below, soft) * _passed(above, soft)
            if share > 0.0:
                share *= _unshaded(low, high, position, point, inverse, soft)
                totals[hour, target[point]] += share * cosine * glass[hour] * weight[point]


@compiled
def _add_outside(
    low: Floats, high: Floats, position: Floats32, face: NDArray[np.int8], weight: Floats,
    target: Indices, sun: Floats, total: Floats,
) -> None:  # fmt: skip
    """Add weight x cosine of points from which no box hides the sun; see `add_through`."""
    inverse = _inverses(sun)
    for point in range(len(face)):
        cosine = _cosine(face[point], sun)
        if cosine > _GRAZING:
            share = _unshaded(low, high, position, point, inverse, HARD_M)
            total[target[point]] += share * cosine * weight[point]


@dataclass(frozen=True)
class _Group:
    """Points of one kind, as `add_through` describes them, and corners of the boxes that shade."""

    position: Floats32
    face: NDArray[np.int8]
    weight: Floats
    target: Indices
    low: Floats
    high: Floats


@dataclass(frozen=True)
class SunPoints:
    """Points on matt surfaces, ready for shadow tests.

    `direct(toward)` returns, for each target, the sum over its points of weight x cosine x
    glass x visibility: a luminance for weights of reflectance / pi, an irradiance for weights
    of 1 / count, both per lx on the sun's normal. Points inside the panes see the sun only
    through an opening; points outside see it past the building: those within its shell are shaded
    by its parts, others by the shell. targets: their number.
    """

    scene: BoxScene
    inside: _Group
    outside: tuple[_Group, _Group]
    targets: int

    def direct(self, toward: Floats) -> Floats32:
        """Return each target's sum for a sun in direction `toward` [3] in room axes, [targets]."""
        total = np.zeros((1, self.targets))
        sun = np.asarray(toward, float)
        if sun[2] <= 0.0:
            return total[0].astype(np.float32)
        group = self.inside
        softness = np.full(len(group.face), HARD_M, np.float32)
        for o in self.scene.openings:
            glass = glass_optics(o.transmittance, sun[o.axis : o.axis + 1])[0]
            add_through(
                np.array([o.axis, o.outward, o.inner_m, o.outer_m, *o.u_m, *o.z_m], float),
                np.empty((0, 5)), group.low, group.high, group.position, group.face, softness,
                group.weight, group.target, sun[None], glass, total,
            )  # fmt: skip
        for g in self.outside:
            _add_outside(g.low, g.high, g.position, g.face, g.weight, g.target, sun, total[0])
        return total[0].astype(np.float32)


def sun_points(
    scene: BoxScene,
    position: Floats,
    axis: NDArray[np.integer],
    sign: NDArray[np.integer],
    weight: Floats,
    target: NDArray[np.integer],
    targets: int,
) -> SunPoints:
    """Return surface points as `SunPoints`.

    position : [m, 3] in room axes; axis, sign : of the surface's normal [m]; weight : factor on a
    point's light [m]; target : index of the sum, below `targets`, to which a point adds [m].
    """
    inside = _inside(scene, position)
    raised = position.copy()
    raised[np.arange(len(raised)), axis] += sign * 2 * EPSILON_M
    shell_low, shell_high = np.array(scene.shell)
    own = ((raised > shell_low) & (raised < shell_high)).all(axis=1) & ~inside
    face = np.where(np.asarray(sign) > 0, axis, np.asarray(axis) + 3).astype(np.int8)

    def group(rows: Mask, low: Floats, high: Floats) -> _Group:
        return _Group(
            raised[rows].astype(np.float32),
            face[rows],
            weight[rows].astype(float),
            np.asarray(target)[rows].astype(np.intp),
            np.ascontiguousarray(low),
            np.ascontiguousarray(high),
        )

    def boxes(*kinds: str) -> tuple[Floats, Floats]:
        which = scene.of_kind(*kinds)
        return scene.low[which].reshape(-1, 3), scene.high[which].reshape(-1, 3)

    lows, highs = boxes("obstruction")
    beyond = ((lows < shell_low) | (highs > shell_high)).any(axis=1)
    around = np.vstack((shell_low, lows[beyond])), np.vstack((shell_high, highs[beyond]))
    parts = boxes("obstruction", "wall", "ceiling", "floor", "frame")
    outside = group(own, *parts), group(~inside & ~own, *around)
    return SunPoints(scene, group(inside, *boxes("frame", "obstruction")), outside, targets)


def _inside(scene: BoxScene, p: Floats) -> Mask:
    """Return which points are within the building and on the room's side of every pane, [n]."""
    low, high = np.array(scene.shell)
    inside = ((p > low - EPSILON_M) & (p < high + EPSILON_M)).all(axis=1)
    for o in scene.openings:
        inside &= (o.pane_m - p[:, o.axis]) * o.outward > 0
    return inside
