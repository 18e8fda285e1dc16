"""Render what a room's windows show as finely as a camera's sensor, for the simulated cameras.

What each direction meets first is traced at full size: sky, glass, frames, sunlit surfaces. Light
that surfaces receive from the sky or after bounces is that of the nearest points of the truth.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask
from fieldlum.optics.projection import altitude_azimuth_deg, direction, rotation, smallest_arc
from fieldlum.room.scene.geometry import BoxScene, Opening
from fieldlum.room.scene.points import SunPoints, sun_points
from fieldlum.room.scene.view import SurfaceSamples, camera_rays, trace_pixels
from fieldlum.room.simulate.gather import representatives
from fieldlum.room.simulate.pixel_points import sample_codes
from fieldlum.room.simulate.truth import Rendering, SimulatedRoom, box_room
from fieldlum.sky.sky_view import SkyGrid, SkyPicture

# Rays in each direction of a fine pixel. Chosen: a camera averages several fine pixels in each of
# its own.
_SUB = 2
_BLOCK_RAYS = 1_000_000  # rays traced at a time; limits memory only
_EDGE_STEPS = 33  # points on an edge of an opening, whose directions bound it; chosen
_NEIGHBOURS = 3  # points of the truth whose light a fine sample has; chosen
# Distance [m] by which points of another face are farther; larger than any room with its outdoors.
_OTHER_FACE_M = 1000.0


@dataclass(frozen=True)
class FineWindows:
    """The p fine pixels around a room's windows, traced once.

    grid: of all of them; pixel [p]: flat index into the grid; rays [p, 3]: the pixels' true
    directions in world axes; sky, plain [p]: share of the pixel that sees them, times the glass;
    sun: surface points for direct sun; to_pixels: CSR [p, m], from the irradiance of the truth's
    points to the pixels' luminance; smooth: CSR [m, m], applied to that irradiance first.
    """

    grid: SkyGrid
    pixel: Indices
    rays: Floats
    sky: Floats32
    plain: Floats32
    sun: SunPoints
    to_pixels: Any
    smooth: Any

    def picture(self, made: Rendering, k: int, factor: Floats32 | None = None) -> SkyPicture:
        """Return moment `k` (from 0) of a rendering, without the sun's disc.

        factor: on the luminance of each of the truth's pixels [H, W]; None for 1.
        """
        light = made.light[[k]]
        value = np.asarray(self.to_pixels @ (self.smooth @ made.points_lx[:, k]), np.float32)
        direct_lx = float(light.direct_lx[0])
        if direct_lx > 0:
            toward = self.sun.scene.to_room(light.shown_sun_direction)[0]
            value += self.sun.direct(toward) * np.float32(direct_lx)
        seen_sky = np.flatnonzero(self.sky)
        value[seen_sky] += light.sky_at(self.rays[seen_sky])[0] * self.sky[seen_sky]
        value += np.float32(light.sky.ground_cdm2[0]) * self.plain
        if factor is not None:
            value *= factor.ravel()[self._coarse_pixels(len(factor))]
        out = np.full(self.grid.height * self.grid.width, np.nan, np.float32)
        out[self.pixel] = value
        shape = (self.grid.height, self.grid.width)
        return SkyPicture(out.reshape(shape), np.zeros(shape, bool), self.grid)

    def _coarse_pixels(self, height: int) -> Indices:
        """Return the flat index of the panorama pixel that holds each fine pixel, [p]."""
        grid, coarse = self.grid, 180.0 / height
        row, column = np.divmod(self.pixel, grid.width)
        down = 90.0 - grid.first_altitude_deg + (row + 0.5) * grid.step_deg
        across = grid.first_azimuth_deg + 180.0 + (column + 0.5) * grid.step_deg
        columns = np.floor(across / coarse).astype(np.intp) % (2 * height)
        return np.floor(down / coarse).astype(np.intp) * 2 * height + columns


def fine_windows(truth: SimulatedRoom, pitch_deg: float) -> FineWindows | None:
    """Trace the windows of a truth with pixels of at most `pitch_deg`; None without a window.

    A pixel of the truth is divided into equal parts in each direction, so that both grids match.
    """
    view, room = truth.view, box_room(truth.setup)
    near = _near_windows(view.scene, room.camera_tilt_deg, room.camera_roll_deg, truth)
    if not near.any():
        return None
    parts = max(1, int(np.ceil(180.0 / truth.height / pitch_deg - 1e-9)))
    grid, covered = _grid_of(near, parts, view.heading_deg)
    pixel = np.flatnonzero(covered)
    rays = np.empty((len(pixel), 3))
    sky, plain = np.zeros((2, len(pixel)), np.float32)
    blocks: list[SurfaceSamples] = []
    codes: list[NDArray[np.int64]] = []
    for some, row, world in _blocks(grid, pixel):
        toward = camera_rays(view.scene, room, world, view.heading_deg)
        count = some.stop - some.start
        samples, straight, sky[some], plain[some] = trace_pixels(
            view.scene, row, toward, _SUB, count
        )
        middle = toward.reshape(count, _SUB**2, 3).mean(axis=1) @ view.scene.turn
        rays[some] = middle / np.linalg.norm(middle, axis=1, keepdims=True)
        joined, code = _one_for_each_face(samples, straight)
        blocks.append(joined._replace(pixel=joined.pixel + np.int32(some.start)))
        codes.append(code)
    made = SurfaceSamples._make(np.concatenate(parts) for parts in zip(*blocks, strict=True))
    luminance = made.weight * view.scene.reflectance[made.box] / np.pi
    faces = made.axis, made.sign
    points = sun_points(view.scene, made.position, *faces, luminance, made.pixel, len(pixel))
    near_light = _light_of_neighbours(truth, made.position, np.concatenate(codes))
    from scipy.sparse import csr_matrix

    direct = csr_matrix(
        (luminance, (made.pixel, np.arange(len(luminance)))), (len(pixel), len(luminance))
    )
    to_pixels = (direct @ near_light).tocsr().astype(np.float32)
    return FineWindows(grid, pixel, rays, sky, plain, points, to_pixels, truth.points.smooth)


def _near_windows(scene: BoxScene, tilt_deg: float, roll_deg: float, truth: SimulatedRoom) -> Mask:
    """Return the truth's pixels that may show a window, or border on one that does, [H, W]."""
    height, heading = truth.height, truth.view.heading_deg
    level = rotation(0.0, tilt_deg, roll_deg, heading)
    near = np.zeros((height, 2 * height), bool)
    step = 180.0 / height
    for opening in scene.openings:
        toward = _edges(opening) - np.array(scene.camera_m)
        toward /= np.linalg.norm(toward, axis=1, keepdims=True)
        altitude, azimuth = altitude_azimuth_deg(toward @ scene.turn @ level)
        middle = float(altitude_azimuth_deg(toward.mean(axis=0) @ scene.turn @ level)[1])
        turn = (azimuth - middle + 180.0) % 360.0 + middle - heading  # no seam within the window
        first, last = (int(np.floor(v / step)) for v in (turn.min(), turn.max()))
        top, bottom = (int((90.0 - v) / step) for v in (altitude.max(), altitude.min()))
        columns = np.arange(first - 1, last + 2) % (2 * height)
        near[max(top - 1, 0) : bottom + 2, columns] = True
    return near


def _edges(o: Opening) -> Floats:
    """Return points on the edges of an opening, on both sides of its wall, [n, 3] m."""
    along = np.linspace(0.0, 1.0, _EDGE_STEPS)
    (left, right), (bottom, top) = o.u_m, o.z_m
    u, z = left + along * (right - left), bottom + along * (top - bottom)
    rim = [(u, np.full_like(u, v)) for v in o.z_m] + [(np.full_like(z, v), z) for v in o.u_m]
    across, up = (np.concatenate(parts) for parts in zip(*rim, strict=True))
    out = np.empty((2, len(across), 3))
    out[..., o.along], out[..., 2] = across, up
    out[0, :, o.axis], out[1, :, o.axis] = o.inner_m, o.outer_m
    return out.reshape(-1, 3)


def _grid_of(near: Mask, parts: int, heading_deg: float) -> tuple[SkyGrid, Mask]:
    """Return the smallest grid around the marked pixels, divided, and its covered pixels [h, w].

    near: mask [H, 2 H] of a panorama; parts: of a pixel in each direction.
    """
    height = len(near)
    rows = np.flatnonzero(near.any(axis=1))
    first, span = smallest_arc(np.asarray(near.any(axis=0)))
    cut = near[rows[0] : rows[-1] + 1][:, (first + np.arange(span)) % (2 * height)]
    coarse = 180.0 / height
    start = (first + height) % (2 * height) - height
    shape = (parts * len(cut), parts * span)
    grid = SkyGrid(
        float(90.0 - rows[0] * coarse), start * coarse - 180.0, coarse / parts, heading_deg, *shape
    )
    return grid, cut.repeat(parts, axis=0).repeat(parts, axis=1)


def _blocks(grid: SkyGrid, pixel: Indices) -> Iterator[tuple[slice, NDArray[np.int32], Floats]]:
    """Yield blocks of pixels: a slice, each ray's pixel in it [n], and world rays [n, 3].

    The rays of a pixel follow each other.
    """
    size = max(1, _BLOCK_RAYS // _SUB**2)
    step = (np.arange(_SUB) + 0.5) / _SUB
    down, across = (v.ravel() for v in np.meshgrid(step, step, indexing="ij"))
    for start in range(0, len(pixel), size):
        some = slice(start, min(start + size, len(pixel)))
        row, column = np.divmod(pixel[some], grid.width)
        altitude = grid.first_altitude_deg - (row[:, None] + down) * grid.step_deg
        turn = grid.first_azimuth_deg + (column[:, None] + across) * grid.step_deg
        rays = direction(altitude, grid.heading_deg + turn).reshape(-1, 3)
        yield some, np.arange(len(row)).repeat(_SUB**2).astype(np.int32), rays


def _one_for_each_face(
    samples: SurfaceSamples, straight: int
) -> tuple[SurfaceSamples, NDArray[np.int64]]:
    """Join the samples of one face in a pixel to one, with the sum of their weights.

    Return the samples, and the code of each one's face.
    """
    code = sample_codes(samples.box, samples.axis, samples.sign, straight)
    rows, total = representatives((samples.pixel, code), samples.position, samples.weight)
    joined = SurfaceSamples._make(values[rows] for values in samples)
    return joined._replace(weight=total), code[rows]


def _light_of_neighbours(truth: SimulatedRoom, position: Floats, code: NDArray[np.int64]) -> Any:
    """Return the matrix [n, m] from the light of the truth's points to that of n fine samples.

    A sample has that of the nearest points of its face; of a face without a point, that of the
    nearest point that faces the same way.
    """
    from scipy.sparse import csr_matrix
    from scipy.spatial import KDTree

    points, view = truth.points, truth.view
    at, m = view.position[points.rows], len(points.rows)
    facing, of_point = code // 2 % 6, points.code // 2 % 6
    index, weight = np.zeros((len(code), _NEIGHBOURS), np.intp), np.zeros((len(code), _NEIGHBOURS))
    for side in np.unique(facing):
        mine = np.flatnonzero(facing == side)
        theirs = np.flatnonzero(of_point == side)
        if not len(theirs):
            theirs = np.arange(m)
        tree = KDTree(np.column_stack((at[theirs], points.code[theirs] * _OTHER_FACE_M)))
        near = min(_NEIGHBOURS, len(theirs))
        places = np.column_stack((position[mine], code[mine] * _OTHER_FACE_M))
        away, which = (np.reshape(v, (-1, near)) for v in tree.query(places, k=near))
        index[mine[:, None], np.arange(near)] = theirs[which]
        weight[mine[:, None], np.arange(near)] = 1.0 / (away + 1e-3)
    weight /= weight.sum(axis=1, keepdims=True)
    row = np.arange(len(code)).repeat(_NEIGHBOURS)
    return csr_matrix((weight.ravel(), (row, index.ravel())), (len(code), m))
