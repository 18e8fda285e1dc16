"""Trace rays and sunlight exactly among boxes and panes: first hits, glass, sun disc, and shade.

A point inside the panes sees the sun through an opening, past bars and boxes; a point outside sees
it past the building. Lengths are in m, in room axes.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Indices, Integers, Ints8, Ints32, Mask
from fieldlum.core.compiled import compiled
from fieldlum.optics.projection import across_axes
from fieldlum.room.scene.box_room import Box, BoxScene, glass_optics, upright

EPSILON_M = 1e-4  # points are lifted by multiples of this above their surface, to miss it; chosen
_GRAZING = 1e-6  # cosine; chosen: a sun 0.00006 degrees above a surface
HARD_M = 1e-7  # width of a hard edge; chosen, below any length of a room
_BLOCK = 64  # neighbouring points that are tried together first; of 32 to 256 the fastest
_SMALLEST = 1e-9  # of a direction along an axis: avoids a division by zero; chosen
SUN_RADIUS_DEG = 0.2665  # mean angular radius seen from the Earth: 959.6 arc seconds (IAU)
# Attribute of a rendered panorama with a partly hidden disc: for each of `disc_rays` 1 if the
# camera sees it, else 0.
DISC_RAYS = "disc_rays"


class BoxHits(NamedTuple):
    """Where n rays first hit a box, [n] each.

    distance: inf without a hit [m]; box: its index, -1 without; axis: 0 to 2 of the face's normal;
    sign: 1 or -1, towards the ray's origin.
    """

    distance: Floats
    box: Ints32
    axis: Ints8
    sign: Ints8


@compiled
def nearest_box(low: Floats, high: Floats, origins: Floats, directions: Floats) -> BoxHits:
    """Return where n rays first hit one of b boxes; boxes that contain the origin are ignored.

    low, high: corners of the boxes [b, 3] m; origins, directions: of the rays [n, 3]. A ray is in a
    box from the last of its three entries, between the planes of x, y, z, to its first exit.
    """
    count, inverse = len(directions), _inverses(directions, 1e-12)
    distance, box = np.full(count, np.inf), np.full(count, -1, np.int32)
    axis, sign = np.zeros(count, np.int8), np.zeros(count, np.int8)
    for ray in range(count):
        for k in range(len(low)):
            enters, leaves, across = -np.inf, np.inf, 0
            for i in range(3):  # written out, a quarter faster; sun patches as a whole are not
                first = (low[k, i] - origins[ray, i]) * inverse[ray, i]
                last = (high[k, i] - origins[ray, i]) * inverse[ray, i]
                if min(first, last) > enters:
                    enters, across = min(first, last), i
                leaves = min(leaves, max(first, last))
            if enters < leaves and EPSILON_M / 10 < enters < distance[ray]:
                distance[ray], box[ray], axis[ray] = enters, k, across
        if box[ray] >= 0:
            sign[ray] = -1 if directions[ray, axis[ray]] > 0.0 else 1
    return BoxHits(distance, box, axis, sign)


class Ends(NamedTuple):
    """Where n rays end: on a box, or outdoors.

    row [n]: index of the ray; toward, position [n, 3]: its direction and its end (its origin if it
    ends outdoors); box [n]: index, -1 outdoors; axis, sign [n]: of the face's normal; weight [n]:
    transmittance of all panes that a straight ray crosses, reflectance of the pane for a mirrored
    one.
    """

    row: Indices
    toward: Floats
    position: Floats
    box: Ints32
    axis: Ints8
    sign: Ints8
    weight: Floats


def ray_ends(scene: BoxScene, origins: Floats, rays: Floats) -> tuple[Ends, Ends]:
    """Return where n rays end, and where those that cross a pane end if that pane mirrors them.

    origins [n, 3] m, rays [n, 3]: in room axes. Only the first pane mirrors. A box that contains
    the ray's origin is ignored.
    """
    origins, rays = np.ascontiguousarray(origins), np.ascontiguousarray(rays)
    hits = nearest_box(scene.low, scene.high, origins, rays)
    transmittance, reflectance, pane_m, normal = _panes(scene, origins, rays, hits.distance)
    at = origins + rays * np.where(hits.box >= 0, hits.distance, 0.0)[:, None]
    straight = Ends(np.arange(len(rays)), rays, at, hits.box, hits.axis, hits.sign, transmittance)
    rows = np.flatnonzero(reflectance)
    mirrored = rays[rows].copy()
    mirrored[np.arange(len(rows)), normal[rows]] *= -1.0
    origin = origins[rows] + rays[rows] * pane_m[rows, None] + mirrored * 2 * EPSILON_M
    hits = nearest_box(scene.low, scene.high, origin, mirrored)
    at = origin + mirrored * np.where(hits.box >= 0, hits.distance, 0.0)[:, None]
    return straight, Ends(rows, mirrored, at, hits.box, hits.axis, hits.sign, reflectance[rows])


def _panes(
    scene: BoxScene, origins: Floats, rays: Floats, limit_m: Floats
) -> tuple[Floats, Floats, Floats, Ints8]:
    """Return the transmittance of all panes that n rays cross, and three figures of the first pane.

    These are its reflectance (0 without a pane), its distance [m], and the axis of its normal. Each
    is [n]. origins [n, 3] m, rays [n, 3]: in room axes; limit_m [n]: where each ray ends.
    """
    transmittance, reflectance = np.ones(len(rays)), np.zeros(len(rays))
    nearest_m, normal = limit_m.copy(), np.zeros(len(rays), np.int8)
    for o in scene.openings:
        across = rays[:, o.axis]
        at_m = (o.pane_m - origins[:, o.axis]) / np.where(np.abs(across) < 1e-12, 1e-12, across)
        rows = np.flatnonzero((at_m > EPSILON_M / 10) & (at_m < limit_m))
        place = origins[rows] + at_m[rows, None] * rays[rows]
        rows = rows[o.contains(place[:, o.along], place[:, 2])]
        passed, mirrored = glass_optics(o.transmittance, across[rows])
        transmittance[rows] *= passed
        is_first = at_m[rows] < nearest_m[rows]
        first = rows[is_first]
        reflectance[first], nearest_m[first], normal[first] = (
            mirrored[is_first],
            at_m[first],
            o.axis,
        )
    return transmittance, reflectance, nearest_m, normal


def disc_glass(scene: BoxScene, toward: Floats) -> Floats:
    """Return the transmittance of the glass on each ray from the camera to the sun disc, [..., r].

    It is 0 for a ray that is hidden. toward: unit vectors to the sun's centre in room axes [...,
    3]; the r = 61 rays of each are `disc_rays`.
    """
    rays = disc_rays(toward)
    flat = rays.reshape(-1, 3)
    eye = np.broadcast_to(np.array(scene.camera_m), flat.shape)
    transmittance = _panes(scene, eye, flat, np.full(len(flat), np.inf))[0]
    is_up = np.broadcast_to(np.asarray(toward)[..., None, 2] > 0, rays.shape[:-1]).ravel()
    rows = np.flatnonzero((transmittance < 1.0) & is_up)  # other rays meet a wall
    out = np.zeros(len(flat))
    free = rows[nearest_box(scene.low, scene.high, eye[rows].copy(), flat[rows]).box < 0]
    out[free] = transmittance[free]
    return out.reshape(rays.shape[:-1])


def disc_visibility(scene: BoxScene, toward: Floats) -> tuple[Floats, Floats]:
    """Return the share of the sun disc that the camera sees, and the glass's transmittance there.

    [n] each; both are 0 for a hidden disc. toward : [n, 3] unit vectors to the sun in room axes.
    """
    parts = np.array_split(toward, len(toward) // 500 + 1)  # 500 suns need some 10 MB
    glass = np.concatenate([disc_glass(scene, part) for part in parts])
    visible = (glass > 0).mean(axis=1)
    return visible, glass.mean(axis=1) / np.maximum(visible, 1e-12)


def disc_rays(toward: Floats, rings: int = 4) -> Floats:
    """Return unit vectors to equal areas of the sun disc, [..., 1 + 3 rings (rings + 1), 3].

    toward : unit vectors to the disc's centre [..., 3]. The disc has the radius SUN_RADIUS_DEG. A
    ring has six vectors more than the one inside it; 4 rings give 61 vectors with the centre.
    """
    radius, angle = [0.0], [0.0]  # share of the disc's radius; position on the ring [rad]
    for ring in range(1, rings + 1):
        count = 6 * ring
        radius += [(ring - 0.25) / (rings + 0.25)] * count
        angle += list((np.arange(count) + 0.5 * (ring % 2)) * 2 * np.pi / count)
    r = np.array(radius)[:, None] * np.tan(np.radians(SUN_RADIUS_DEG))
    along = np.asarray(toward, float)[..., None, :]
    right, up = across_axes(along)
    rays = along + r * (np.cos(angle)[:, None] * right - np.sin(angle)[:, None] * up)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True)


# ----------------------------------------------------------------------------------------------
# the sun on points


@compiled
def _passed(beyond: float, softness: float) -> float:
    """Return the share of light, 0 to 1, that passes an edge whose shade grows over `softness` [m].

    beyond: distance from the edge, positive outside its shade [m].
    """
    return min(max(beyond / softness + 0.5, 0.0), 1.0)


@compiled
def _inverses(toward: Floats, smallest: float) -> Floats:
    """Return one over each component of directions [n, 3], of which `smallest` is the smallest."""
    inverse = np.empty((len(toward), 3))
    for row in range(len(toward)):
        for axis in range(3):  # for a row at a time, numba would compile an error's text too: 2 s
            component = toward[row, axis]
            inverse[row, axis] = 1.0 / (component if abs(component) >= smallest else smallest)
    return inverse


@compiled
def _unshaded(
    low: Floats, high: Floats, boxes: Indices, position: Floats32, point: int, inverse: Floats,
    softness: float,
) -> float:  # fmt: skip
    """Return the share of the sun's light, 0 to 1, that boxes leave to one point.

    low, high: corners of all boxes [s, 3]; boxes: indices of those to test; position: of all points
    [r, 3]; point: index of this one; inverse: 1 over the direction to the sun [3]. softness: width
    over which the shade of a box grows at its edges, m. The line to the sun enters a box through a
    face of one axis and leaves it through one of another; its distance from the edge between them
    follows from its length inside, which is negative outside the box.
    """
    share = 1.0
    # no shade begins farther from a box than this, as a length along the line to the sun
    reach = 0.5 * softness * np.sqrt(inverse[0] ** 2 + inverse[1] ** 2 + inverse[2] ** 2)
    for box in boxes:
        enters, leaves, enters_axis, leaves_axis = -np.inf, np.inf, 0, 0
        for axis in range(3):
            first = (low[box, axis] - position[point, axis]) * inverse[axis]
            last = (high[box, axis] - position[point, axis]) * inverse[axis]
            if min(first, last) > enters:
                enters, enters_axis = min(first, last), axis
            if max(first, last) < leaves:
                leaves, leaves_axis = max(first, last), axis
        if leaves <= EPSILON_M or enters - leaves > reach:
            continue
        if leaves - enters > reach or enters_axis == leaves_axis:
            return 0.0
        slope = np.hypot(inverse[enters_axis], inverse[leaves_axis])
        share *= 1.0 - _passed((leaves - enters) / slope, softness)
        if share <= 0.0:
            return 0.0
    return share


@compiled
def _cosine(face: int, sun: Floats) -> float:
    """Return the cosine of the sun's incidence on a face.

    face: direction of its normal, 0, 1, 2 for +x, +y, +z; 3, 4, 5 for -x, -y, -z. sun: unit vector
    [3].
    """
    return sun[face] if face < 3 else -sun[face - 3]


@compiled
def _bounds(position: Floats32, softness: Floats32, first: int, last: int) -> Floats:
    """Return the extent of the block of points `first` to `last` - 1, and of their soft shade, [7].

    0 to 2: lowest x, y, z; 3 to 5: highest x, y, z; 6: half of the largest softness, each in m.
    position [n, 3], softness [n]: of all points [m].
    """
    out = np.empty(7)
    for axis in range(3):
        out[axis] = position[first:last, axis].min()
        out[3 + axis] = position[first:last, axis].max()
    out[6] = 0.5 * softness[first:last].max()
    return out


@compiled
def _overlap(bounds: Floats, axis: int, near: float, far: float, low: float, high: float) -> int:
    """Return how many points of a block are from `low` to `high` on an axis, after a shift.

    0: none, 1: some or unknown, 2: all. bounds: of the block, by `_bounds`; near, far: smallest and
    largest shift of its points along the axis, in either order [m].
    """
    lowest = bounds[axis] + min(near, far) - bounds[6]
    highest = bounds[3 + axis] + max(near, far) + bounds[6]
    if highest < low or lowest > high:
        return 0
    return 2 if lowest >= low and highest <= high else 1


@compiled
def _boxes_towards_sun(
    low: Floats, high: Floats, bounds: Floats, inverse: Floats, boxes: Indices
) -> int:
    """Put the indices of boxes that may shade a block first into `boxes`; return their number.

    low, high: corners of all boxes [s, 3]; bounds: of the block of points, by `_bounds`; inverse: 1
    over the direction to the sun [3]; boxes [s]: changed in place.
    """
    reach = bounds[6] * np.sqrt(inverse[0] ** 2 + inverse[1] ** 2 + inverse[2] ** 2)
    count = 0
    for box in range(len(low)):
        enters, leaves = -np.inf, np.inf
        for axis in range(3):
            first = (low[box, axis] - bounds[3 + axis]) * inverse[axis]
            last = (high[box, axis] - bounds[axis]) * inverse[axis]
            enters, leaves = max(enters, min(first, last)), min(leaves, max(first, last))
        if leaves > EPSILON_M and enters - leaves <= reach:
            boxes[count] = box
            count += 1
    return count


@compiled
def _past_bars(
    bars: Floats, u: float, z: float, slope_u: float, slope_z: float, soft: float
) -> float:
    """Return the share of the sun's light, 0 to 1, that passes an opening's bars.

    bars [b, 5]: for each of b bars upright (1) or level (0), from and to across the bar, from and
    to outwards from the inner face, m; u, z: along the wall and in height, where the line to the
    sun meets the wall's inner face [m]; slope_u, slope_z: by how much they change per metre
    outwards; soft: width of the shade's edges [m].
    """
    share = 1.0
    for bar in range(len(bars)):  # columns: upright, span from and to, depth from and to
        at, slope = (u, slope_u) if bars[bar, 0] > 0.0 else (z, slope_z)
        near, far = slope * bars[bar, 3], slope * bars[bar, 4]
        below, above = at + max(near, far) - bars[bar, 1], bars[bar, 2] - at - min(near, far)
        share *= 1.0 - _passed(below, soft) * _passed(above, soft)
    return share


@compiled
def add_through(
    opening: Floats, bars: Floats, low: Floats, high: Floats, position: Floats32,
    face: Ints8, softness: Floats32, weight: Floats, target: Indices, suns: Floats,
    glass: Floats, totals: Floats,
) -> None:  # fmt: skip
    """Add to `totals` the sunlight of n suns on r points that see them through one opening.

    A point adds weight x cosine x glass x visible share. opening: axis of the wall's normal, its
    sign outwards, inner and outer face, u from and to, z from and to [8]; u is along the wall. bars
    [b, 5]: for each of b bars upright (1) or level (0), span from and to, depth from and to,
    outwards from the inner face. low, high: corners of boxes that shade [s, 3]. For each point:
    position [r, 3], slightly above its surface; face: direction of its normal, 0, 1, 2 for +x, +y,
    +z, 3, 4, 5 for -x, -y, -z, -1 for one that no sun reaches; softness: width over which an edge's
    shade grows, m; weight; target: column of `totals`. suns: unit vectors [n, 3]; glass:
    transmittance at each [n]; totals [n, targets]: changed in place.
    """
    axis, outward = int(opening[0]), opening[1]
    along, inner, thickness = 1 - axis, opening[2], (opening[3] - opening[2]) * opening[1]
    u_from, u_to, z_from, z_to = opening[4], opening[5], opening[6], opening[7]
    inverse, boxes = _inverses(suns, _SMALLEST), np.arange(len(low))
    for first in range(0, len(face), _BLOCK):
        last = min(first + _BLOCK, len(face))
        bounds = _bounds(position, softness, first, last)
        for hour in range(len(suns)):
            toward = suns[hour, axis] * outward
            if toward <= _GRAZING or suns[hour, 2] <= 0.0:
                continue
            slope_u, slope_z = suns[hour, along] / toward, suns[hour, 2] / toward
            shift_u, shift_z = slope_u * thickness, slope_z * thickness
            # on the inner face, the rectangle through which light also passes the outer one
            low_u, high_u = u_from - min(shift_u, 0.0), u_to - max(shift_u, 0.0)
            low_z, high_z = z_from - min(shift_z, 0.0), z_to - max(shift_z, 0.0)
            near, far = (inner - bounds[axis]) * outward, (inner - bounds[3 + axis]) * outward
            overlap = 1  # 1: some points of the block see the sun, or unknown; 0: none; 2: all
            if min(near, far) > 2.0 * EPSILON_M:
                overlap_u = _overlap(bounds, along, slope_u * near, slope_u * far, low_u, high_u)
                overlap_z = _overlap(bounds, 2, slope_z * near, slope_z * far, low_z, high_z)
                overlap = min(overlap_u, overlap_z)
            if overlap == 0:
                continue
            near_boxes = boxes[: _boxes_towards_sun(low, high, bounds, inverse[hour], boxes)]
            unshaded = overlap == 2 and len(near_boxes) + len(bars) == 0
            for point in range(first, last):
                if face[point] < 0:
                    continue
                cosine = _cosine(face[point], suns[hour])
                if cosine <= _GRAZING:
                    continue
                if unshaded:
                    totals[hour, target[point]] += cosine * glass[hour] * weight[point]
                    continue
                across = (inner - position[point, axis]) * outward
                u = position[point, along] + slope_u * across
                z = position[point, 2] + slope_z * across
                soft = softness[point]
                if across > 2.0 * EPSILON_M:
                    share = _passed(u - low_u, soft) * _passed(high_u - u, soft)
                    share *= _passed(z - low_z, soft) * _passed(high_z - z, soft)
                elif across > -thickness / 2.0:  # in the reveal: only the outer end is ahead
                    share = _passed(u + shift_u - u_from, soft)
                    share *= _passed(u_to - u - shift_u, soft)
                    share *= _passed(z + shift_z - z_from, soft)
                    share *= _passed(z_to - z - shift_z, soft)
                else:
                    continue
                if share > 0.0:
                    share *= _past_bars(bars, u, z, slope_u, slope_z, soft)
                if share > 0.0:
                    share *= _unshaded(low, high, near_boxes, position, point, inverse[hour], soft)
                    totals[hour, target[point]] += share * cosine * glass[hour] * weight[point]


@compiled
def _add_outside(
    low: Floats, high: Floats, position: Floats32, face: Ints8, weight: Floats,
    target: Indices, suns: Floats, totals: Floats,
) -> None:  # fmt: skip
    """Add to `totals` the sunlight of n suns on r points outside the panes, past all boxes.

    A point adds weight x cosine x visible share. low, high [s, 3]: corners of the boxes that shade,
    m; position [r, 3] m; face [r]: direction of the normal, 0, 1, 2 for +x, +y, +z, 3, 4, 5 for -x,
    -y, -z; weight [r]; target [r]: column of `totals`; suns [n, 3]: unit vectors; totals [n,
    targets]: changed in place.
    """
    inverse, boxes = _inverses(suns, _SMALLEST), np.arange(len(low))
    hard = np.full(len(face), HARD_M, np.float32)
    for first in range(0, len(face), _BLOCK):
        last = min(first + _BLOCK, len(face))
        bounds = _bounds(position, hard, first, last)
        for hour in range(len(suns)):
            if suns[hour, 2] <= 0.0:
                continue
            near_boxes = boxes[: _boxes_towards_sun(low, high, bounds, inverse[hour], boxes)]
            for point in range(first, last):
                cosine = _cosine(face[point], suns[hour])
                if cosine > _GRAZING:
                    share = _unshaded(low, high, near_boxes, position, point, inverse[hour], HARD_M)
                    totals[hour, target[point]] += share * cosine * weight[point]


class _Group(NamedTuple):
    """The r points inside or outside the panes, and the s boxes that shade them.

    position [r, 3] m; face [r]: direction of the normal, 0, 1, 2 for +x, +y, +z, 3, 4, 5 for -x,
    -y, -z; weight [r]; target [r]: index of the sum; low, high [s, 3]: corners of the boxes, m.
    """

    position: Floats32
    face: Ints8
    weight: Floats
    target: Indices
    low: Floats
    high: Floats


@dataclass(frozen=True)
class SunPoints:
    """Points on matt surfaces, prepared for shadow tests; `sun_points` creates it.

    Each point belongs to a target, such as a pixel or a piece of a surface. `direct(toward)`
    returns, for each target, the sum over its points of weight x cosine x glass x visible share: a
    luminance for weights of reflectance / pi, an irradiance for weights of 1 / count, both per lx
    on the sun's normal. Points inside the panes see the sun only through an opening; points outside
    see it past the building, whose panes let none through. targets: their number.
    """

    scene: BoxScene
    inside: _Group
    outside: _Group
    targets: int

    def direct(self, toward: Floats) -> Floats32:
        """Return each target's sunlight per lx on the sun's normal, [..., targets].

        toward: unit vectors to the suns in room axes [..., 3]; suns below the horizon give 0.
        """
        suns = np.asarray(toward, float).reshape(-1, 3)
        totals = np.zeros((len(suns), self.targets))
        g = self.inside
        softness = np.full(len(g.face), HARD_M, np.float32)
        for o in self.scene.openings:
            glass = glass_optics(o.transmittance, suns[:, o.axis])[0]
            add_through(
                np.array([o.axis, o.outward, o.inner_m, o.outer_m, *o.u_m, *o.z_m], float),
                np.empty((0, 5)), g.low, g.high, g.position, g.face, softness, g.weight, g.target,
                suns, glass, totals,
            )  # fmt: skip
        g = self.outside
        _add_outside(g.low, g.high, g.position, g.face, g.weight, g.target, suns, totals)
        return totals.astype(np.float32).reshape(*np.shape(toward)[:-1], self.targets)


def sun_points(
    scene: BoxScene,
    position: Floats,
    axis: Integers,
    sign: Integers,
    weight: Floats,
    target: Integers,
    targets: int,
) -> SunPoints:
    """Return k surface points prepared for shadow tests: `SunPoints.direct` sums their sunlight.

    position : in room axes [k, 3] m; axis, sign : of the surface's normal, 0 to 2 and -1 or 1 [k];
    weight : factor on a point's light [k]; target : index of the sum, below `targets`, to which a
    point adds [k].
    """
    low, high = np.array(scene.shell)
    inside = ((position > low - EPSILON_M) & (position < high + EPSILON_M)).all(axis=1)
    for o in scene.openings:  # on the room's side of every pane
        inside &= (o.pane_m - position[:, o.axis]) * o.outward > 0
    raised = position.copy()
    raised[np.arange(len(raised)), axis] += sign * 2 * EPSILON_M
    face = np.where(np.asarray(sign) > 0, axis, np.asarray(axis) + 3).astype(np.int8)

    def group(chosen: Mask, boxes: list[Box]) -> _Group:
        """Return the chosen points, in order of their target, and the boxes that may shade them.

        chosen: mask of the points [k].
        """
        rows = np.flatnonzero(chosen)
        rows = rows[np.argsort(np.asarray(target)[rows], kind="stable")]  # neighbours together
        return _Group(
            position=raised[rows].astype(np.float32),
            face=face[rows],
            weight=weight[rows].astype(float),
            target=np.asarray(target)[rows].astype(np.intp),
            low=np.array([box.low for box in boxes], float).reshape(-1, 3),
            high=np.array([box.high for box in boxes], float).reshape(-1, 3),
        )

    panes = [
        upright(o.axis, (o.pane_m - EPSILON_M, o.pane_m + EPSILON_M), o.u_m, o.z_m, 0.0, "pane")
        for o in scene.openings
    ]
    solid = [box for box in scene.boxes if box.kind != "ground"]
    small = [box for box in solid if box.kind in ("frame", "obstruction")]
    return SunPoints(scene, group(inside, small), group(~inside, solid + panes), targets)
