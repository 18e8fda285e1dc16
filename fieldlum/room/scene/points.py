"""Sort the surface points that pixels show into tiles, and test at each hour which are sunlit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask
from fieldlum.room.scene.geometry import BoxScene, Opening, glass_optics
from fieldlum.room.scene.trace import EPSILON_M, hides, may_block

_GRAZING = 1e-6  # cosine; chosen: a sun 0.00006 degrees above a surface
# Sums of weights below about one leave 1e-16 when all points are subtracted; a lit point has more.
_ROUNDING = 1e-12
_TILE = 64  # points in a tile, which is skipped by its bounding box; decides speed only; chosen
_PAIRS = 4096  # pairs of tile and box in work at a time; limits memory to some 10 MB; chosen


@dataclass(frozen=True)
class SunPoints:
    """Points on matt surfaces, ready for shadow tests.

    `direct(toward)` returns, for each target, the sum over its points of weight x cosine x
    glass x visibility: a luminance for weights of reflectance / pi, an irradiance for weights
    of 1 / count, both per lx on the sun's normal. Points inside the panes see the sun only
    through an opening; points outside see it past the building. For m points: position [m, 3]
    in m, slightly above the surface; axis and sign of the surface's normal; weight; target:
    index of the target that the point belongs to; inside: whether it is inside the panes.
    tile_low, tile_high: corners of boxes [tiles, 3] that hold neighbouring points. targets:
    their number.
    """

    scene: BoxScene
    position: Floats32
    axis: NDArray[np.int8]
    sign: NDArray[np.int8]
    weight: Floats32
    target: NDArray[np.int32]
    inside: Mask
    tile_low: Floats32
    tile_high: Floats32
    targets: int

    def direct(self, toward: Floats) -> Floats32:
        """Return each target's sum for a sun in direction `toward` [3] in room axes, [targets]."""
        total = np.zeros(self.targets)
        if toward[2] <= 0.0:
            return total.astype(np.float32)
        cosines = np.concatenate((toward, -toward))  # by face, as in `_face`
        for o in self.scene.openings:
            if toward[o.axis] * o.outward > _GRAZING:
                glass = float(glass_optics(o.transmittance, toward[o.axis])[0])
                total += glass * self._sum(self._through(o, toward), cosines)
        # Most points outside are lit: from the sum over all, those in shade are subtracted.
        total += np.where(cosines > _GRAZING, cosines, 0.0) @ self._sums_outside
        total -= self._sum(self._dark_outside(cosines, toward), cosines)
        total[total < _ROUNDING] = 0.0
        return total.astype(np.float32)

    def _sum(self, rows: Indices, cosines: Floats) -> Floats:
        """Return the sums of weight x cosine over some of the points, [targets]."""
        terms = self._weight[rows] * cosines[self._face[rows]]
        return np.bincount(self.target[rows], terms, self.targets).astype(float)

    @cached_property
    def _weight(self) -> Floats:
        return self.weight.astype(float)

    @cached_property
    def _face(self) -> NDArray[np.int8]:
        """Direction that a point faces, [m]: 0, 1, 2 for +x, +y, +z; 3, 4, 5 for -x, -y, -z."""
        return np.where(self.sign > 0, self.axis, self.axis + 3).astype(np.int8)

    @cached_property
    def _sums_outside(self) -> Floats:
        """Sums of the weights of points outside, by face and target, [6, targets]."""
        rows = self._outside_rows
        flat = self._face[rows].astype(np.intp) * self.targets + self.target[rows]
        sums = np.bincount(flat, self._weight[rows], 6 * self.targets).astype(float)
        return sums.reshape(6, self.targets)

    def _facing(self, rows: Indices, toward: Floats) -> Indices:
        return rows[self.sign[rows] * toward[self.axis[rows]] > _GRAZING]

    def _through(self, o: Opening, toward: Floats) -> Indices:
        """Return the inside points that see the sun through this opening.

        Their ray to the sun meets no frame and no furniture.
        """
        rows = self._facing(self._near(o, toward), toward)
        rows = rows[self.inside[rows]]
        p = self.position[rows]
        slope_u, slope_z = toward[o.along] / toward[o.axis], toward[2] / toward[o.axis]

        def passes(plane_m: float) -> Mask:
            across = np.float32(plane_m) - p[:, o.axis]
            u = p[:, o.along] + across * np.float32(slope_u)
            z = p[:, 2] + across * np.float32(slope_z)
            return o.contains(u, z)

        # A point within the wall need not pass the inner end: the opening is convex.
        behind = (p[:, o.axis] - o.inner_m) * o.outward > -2 * EPSILON_M
        ahead = (o.pane_m - p[:, o.axis]) * o.outward > 0  # not beyond the pane
        good = ahead & passes(o.outer_m) & (behind | passes(o.inner_m))
        rows = rows[good]
        return rows[~self._shaded(rows, toward, "frame", "obstruction")]

    def _near(self, o: Opening, toward: Floats) -> Indices:
        """Return the points of tiles whose bounding box may see the opening's outer end."""
        axis, reach = o.axis, np.float32(o.outward)
        near = (np.float32(o.outer_m) - self.tile_high[:, axis]) * reach
        far = (np.float32(o.outer_m) - self.tile_low[:, axis]) * reach
        least, most = np.minimum(near, far), np.maximum(near, far)
        keep = most > 0
        least = np.maximum(least, 0)
        for k, (low, high) in ((o.along, o.u_m), (2, o.z_m)):
            slope = np.float32(toward[k] / abs(toward[axis]))
            shift = np.sort(np.stack((least * slope, most * slope)), axis=0)
            keep &= (self.tile_high[:, k] + shift[1] > low) & (
                self.tile_low[:, k] + shift[0] < high
            )
        return _rows_of(keep, len(self.position))

    @cached_property
    def _outside_rows(self) -> Indices:
        return np.flatnonzero(~self.inside)

    @cached_property
    def _outside_by_face(self) -> tuple[tuple[Indices, Indices], ...]:
        """Points outside that face each of six directions, in the order of `_face`.

        For each direction: the points within the building's shell, then the others, ascending.
        """
        rows = self._outside_rows
        face, own = self._face[rows], self._in_shell[rows]
        return tuple((rows[(face == f) & own], rows[(face == f) & ~own]) for f in range(6))

    @cached_property
    def _in_shell(self) -> Mask:
        """Mask of the points within the building's shell, [m]."""
        low, high = np.array(self.scene.shell)
        return ((self.position > low) & (self.position < high)).all(axis=1)

    @cached_property
    def _boxes_outside(self) -> tuple[Floats, Floats]:
        """Low and high corners of the shell and of the boxes that are not within it, [b, 3]."""
        (low, high), which = self.scene.shell, self.scene.of_kind("obstruction")
        lows, highs = self.scene.low[which], self.scene.high[which]
        beyond = ((lows < low) | (highs > high)).any(axis=1)
        return np.vstack((low, lows[beyond])), np.vstack((high, highs[beyond]))

    def _dark_outside(self, cosines: Floats, toward: Floats) -> Indices:
        """Return the points beyond the panes that face the sun, but that a box hides from it.

        cosines: of the sun with the six directions of `_face` [6].
        """
        facing = [self._outside_by_face[f] for f in np.flatnonzero(cosines > _GRAZING)]
        own, other = (_merged(rows) for rows in zip(*facing, strict=True))
        # Points of outer reveals and frames are inside the shell: the walls themselves shade them.
        kinds = ("obstruction", "wall", "ceiling", "floor", "frame")
        own = own[self._shaded(own, toward, *kinds)]
        other = other[self._hidden(other, *self._boxes_outside, toward)]
        return _merged((own, other))

    def _shaded(self, rows: Indices, toward: Floats, *kinds: str) -> Mask:
        """Return which points are hidden from the sun by a box of these kinds."""
        which = self.scene.of_kind(*kinds)
        return self._hidden(rows, self.scene.low[which], self.scene.high[which], toward)

    def _hidden(self, rows: Indices, low: Floats, high: Floats, toward: Floats) -> Mask:
        """Return which points, in ascending order, are hidden from the sun by boxes [b, 3].

        Tiles that no box can hide are skipped.
        """
        out = np.zeros(len(rows), bool)
        if not len(low) or not len(rows):
            return out
        tile = rows // _TILE
        starts = np.flatnonzero(np.concatenate(([True], tile[1:] != tile[:-1])))  # [t], in `rows`
        counts = np.diff(starts, append=len(rows))
        tiles = tile[starts]
        possible = may_block(low, high, self.tile_low[tiles], self.tile_high[tiles], toward)
        which, box = np.nonzero(possible)  # pairs of tile and box
        for part in range(0, len(which), _PAIRS):
            some, boxes = which[part : part + _PAIRS], box[part : part + _PAIRS]
            size = counts[some]
            at = np.arange(size.sum()) + np.repeat(starts[some] - np.cumsum(size) + size, size)
            hit = hides(low, high, np.repeat(boxes, size), self.position[rows[at]], toward)
            out[at[hit]] = True
        return out


def _merged(rows: Sequence[Indices]) -> Indices:
    """Return all of `rows`, of which each part is ascending, in ascending order."""
    return np.sort(np.concatenate(rows), kind="stable")  # a merge, linear for few ascending parts


def _rows_of(tiles: Mask, count: int) -> Indices:
    which = np.flatnonzero(tiles)
    rows = (which[:, None] * _TILE + np.arange(_TILE)).ravel()
    return rows[rows < count]


def sun_points(
    scene: BoxScene,
    position: Floats,
    axis: NDArray[np.integer],
    sign: NDArray[np.integer],
    weight: Floats,
    target: NDArray[np.integer],
    targets: int,
) -> SunPoints:
    """Return surface points as `SunPoints`, sorted into compact tiles for fast shadow tests.

    position : [m, 3] in room axes; axis, sign : of the surface's normal [m]; weight : factor on a
    point's light [m]; target : index of the sum, below `targets`, to which a point adds [m].
    """
    inside = _inside(scene, position)
    low, high = position.min(axis=0), position.max(axis=0)
    grid = np.clip((position - low) / np.maximum(high - low, 1e-9) * 255, 0, 255).astype(np.int64)
    grid = np.where(
        inside[:, None], np.clip((position - scene.shell[0]) / _extent(scene) * 255, 0, 255), grid
    )
    face = axis.astype(np.int64) * 2 + (sign > 0)
    order = np.lexsort((_interleave(grid.astype(np.int64)), face, inside))
    raised = position.copy()
    raised[np.arange(len(raised)), axis] += sign * 2 * EPSILON_M
    p = raised[order].astype(np.float32)
    starts = np.arange(0, len(p), _TILE)
    tile_low, tile_high = np.minimum.reduceat(p, starts), np.maximum.reduceat(p, starts)
    pad = np.float32(10 * EPSILON_M)
    return SunPoints(
        scene,
        p,
        axis[order].astype(np.int8),
        sign[order].astype(np.int8),
        weight[order].astype(np.float32),
        target[order].astype(np.int32),
        inside[order],
        tile_low - pad,
        tile_high + pad,
        targets,
    )


def _extent(scene: BoxScene) -> Floats:
    low, high = np.array(scene.shell)
    return high - low


def _inside(scene: BoxScene, p: Floats) -> Mask:
    """Return which points are within the building and on the room's side of every pane, [n]."""
    low, high = np.array(scene.shell)
    inside = ((p > low - EPSILON_M) & (p < high + EPSILON_M)).all(axis=1)
    for o in scene.openings:
        inside &= (o.pane_m - p[:, o.axis]) * o.outward > 0
    return inside


def _interleave(grid: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the Morton code of 8-bit coordinates [n, 3], [n]."""
    code = np.zeros(len(grid), np.int64)
    for bit in range(8):
        for k in range(3):
            code |= ((grid[:, k] >> bit) & 1) << (3 * bit + k)
    return code
