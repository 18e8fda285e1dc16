"""Render what a room's windows show as finely as a camera's sensor, for the simulated cameras.

What each direction meets first is traced at full size: sky, glass, frames, sunlit surfaces. Light
that surfaces receive from the sky or after bounces is that of the nearest points of the panorama.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Indices, Ints32, Ints64, Mask
from fieldlum.optics.projection import direction, smallest_arc
from fieldlum.room.scene import view as scene_view
from fieldlum.room.scene.radiosity import LitRoom, Rendering, box_room, joined, near_light
from fieldlum.room.scene.trace import SunPoints
from fieldlum.sky.sky_view.picture import SkyGrid, SkyPicture

_SUB = 2  # rays in each direction of a fine pixel: a camera's own pixel averages several
_BLOCK_RAYS = 1_000_000  # rays traced at a time; limits memory only
_NEIGHBOURS = 3  # number of the panorama's points whose light is averaged for a fine sample


@dataclass(frozen=True)
class FineWindows:
    """The p fine pixels around a room's windows, traced once.

    grid: that holds all of them; pixel [p]: flat index into the grid; rays [p, 3]: the pixels' true
    directions in world axes; sky, plain [p]: share of the pixel that sees sky or plain, times the
    transmittance of the glass; sun: surface points for direct sun; to_pixels: CSR [p, m], from the
    illuminance of the panorama's m points to the pixels' luminance.
    """

    grid: SkyGrid
    pixel: Indices
    rays: Floats
    sky: Floats32
    plain: Floats32
    sun: SunPoints
    to_pixels: Any

    def picture(self, rendering: Rendering, k: int) -> SkyPicture:
        """Return moment `k` (from 0) of a rendering, without the sun's disc.

        Luminance is NaN in the grid's pixels that are not around windows.
        """
        light = rendering.light[[k]]
        luminance = np.asarray(self.to_pixels @ rendering.points_lx[:, k], np.float32)
        direct_lx = float(light.direct_lx[0])
        if direct_lx > 0:
            toward = self.sun.scene.to_room(light.apparent_sun_direction)[0]
            luminance += self.sun.direct(toward) * np.float32(direct_lx)
        seen_sky = np.flatnonzero(self.sky)
        luminance[seen_sky] += light.sky_at(self.rays[seen_sky])[0] * self.sky[seen_sky]
        luminance += np.float32(light.sky.ground_cdm2[0]) * self.plain
        out = np.full((self.grid.height, self.grid.width), np.nan, np.float32)
        out.flat[self.pixel] = luminance
        return SkyPicture(out, np.zeros(out.shape, bool), self.grid)


def fine_windows(lit: LitRoom, pitch_deg: float) -> FineWindows | None:
    """Trace the windows of a room with pixels at most `pitch_deg` high; None without a window.

    lit: the room as traced for its panorama; the result is None if the panorama shows no window. A
    pixel of the panorama is divided into equal parts in each direction, so that both grids match.
    """
    from scipy.ndimage import maximum_filter
    from scipy.sparse import csr_matrix

    view, scene, room = lit.view, lit.view.scene, box_room(lit.setup)
    # pixels that show a pane, a frame or the outside, or are next, also across a corner, [H, W]
    s, shows = view.samples, (view.sky + view.plain).ravel() > 0
    shows[s.pixel[s.mirrored | np.isin(s.box, scene.of_kind("frame"))]] = True
    modes = ["nearest", "wrap"]
    near: Mask = maximum_filter(shows.reshape(view.sky.shape), 3, mode=modes)  # pyright: ignore
    if not near.any():
        return None
    parts = max(1, int(np.ceil(180.0 / view.height / pitch_deg - 1e-9)))
    grid, covered = _grid_of(near, parts, view.heading_deg)
    pixel = np.flatnonzero(covered)
    rays = np.empty((len(pixel), 3))
    sky, plain = np.zeros((2, len(pixel)), np.float32)
    blocks: list[scene_view.SurfaceSamples] = []
    faces: list[Ints64] = []
    for part, row, world in _blocks(grid, pixel):
        toward = scene_view.camera_rays(scene, room, world, view.heading_deg)
        count = part.stop - part.start
        samples, sky[part], plain[part] = scene_view.trace_pixels(scene, row, toward, count)
        middle = toward.reshape(count, _SUB**2, 3).mean(axis=1) @ scene.turn
        rays[part] = middle / np.linalg.norm(middle, axis=1, keepdims=True)
        samples, face = joined(samples)
        blocks.append(samples._replace(pixel=samples.pixel + np.int32(part.start)))
        faces.append(face)
    s = scene_view.SurfaceSamples._make(np.concatenate(v) for v in zip(*blocks, strict=True))
    reach_m = np.linalg.norm(s.position - scene.camera_m, axis=1) * np.pi / view.height
    places, points = (s.position, np.concatenate(faces)), (lit.samples.position, lit.faces)
    illuminance = near_light(places, points, _NEIGHBOURS, reach_m)  # from points to samples
    luminance = (s.weight * scene.reflectance[s.box] / np.pi).astype(np.float32)
    n = len(luminance)
    to_pixels = csr_matrix((luminance, (s.pixel, np.arange(n))), (len(pixel), n)) @ illuminance
    sun = scene_view.surface_points(scene, s, len(pixel))
    return FineWindows(grid, pixel, rays, sky, plain, sun, to_pixels.tocsr())


def _grid_of(near: Mask, parts: int, heading_deg: float) -> tuple[SkyGrid, Mask]:
    """Return the smallest fine grid around marked pixels, and a mask of its fine pixels in them.

    near: mask [H, 2 H] of a panorama; parts: number of fine pixels in a pixel in each direction;
    heading_deg: azimuth of the panorama's centre column. The mask is [grid.height, grid.width].
    """
    height = len(near)
    rows = np.flatnonzero(near.any(axis=1))
    first, span = smallest_arc(np.asarray(near.any(axis=0)))  # of columns
    cut = near[rows[0] : rows[-1] + 1][:, (first + np.arange(span)) % (2 * height)]
    pixel_deg = 180.0 / height
    grid = SkyGrid(
        first_altitude_deg=float(90.0 - rows[0] * pixel_deg),
        first_azimuth_deg=((first + height) % (2 * height) - height) * pixel_deg - 180.0,
        step_deg=pixel_deg / parts,
        heading_deg=heading_deg,
        height=parts * len(cut),
        width=parts * span,
    )
    return grid, cut.repeat(parts, axis=0).repeat(parts, axis=1)


def _blocks(grid: SkyGrid, pixel: Indices) -> Iterator[tuple[slice, Ints32, Floats]]:
    """Yield blocks of fine pixels: a slice of `pixel`, each ray's index in it [n], and rays [n, 3].

    pixel: flat indices into the grid [p]. Rays are directions in world axes; those of a pixel
    follow each other.
    """
    size = max(1, _BLOCK_RAYS // _SUB**2)
    step = (np.arange(_SUB) + 0.5) / _SUB
    down, across = (v.ravel() for v in np.meshgrid(step, step, indexing="ij"))
    for start in range(0, len(pixel), size):
        block = slice(start, min(start + size, len(pixel)))
        row, column = np.divmod(pixel[block], grid.width)
        altitude = grid.first_altitude_deg - (row[:, None] + down) * grid.step_deg
        azimuth = grid.first_azimuth_deg + (column[:, None] + across) * grid.step_deg
        rays = direction(altitude, grid.heading_deg + azimuth).reshape(-1, 3)
        yield block, np.arange(len(row)).repeat(_SUB**2).astype(np.int32), rays
