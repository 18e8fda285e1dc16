"""Compute direct sun on the surfaces of a guessed scene, at sampled pixels, in milliseconds.

`fieldlum.room.scene` renders a complete panorama of one room exactly. A search needs thousands of
scenes at a few thousand pixels, so this renderer knows only boxes: a ray from the
camera ends on the shell of the room or on a solid; from there the sun is seen if the line towards
it passes the inner and the outer rectangle of a window, misses its bars and misses all solids.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fieldlum.room.fit.guess import Bar, Guess, Solid, WindowRect
from fieldlum.room.fit.sun_through_window import add_to_pixels, lit_blocks, lit_pairs
from fieldlum.room.fit.sunlit import end_points, entered, shaded, shell_ends
from fieldlum.room.scene.geometry import WALLS, glass_optics

Float32 = NDArray[np.float32]
Array = NDArray[np.floating]

# Surfaces of the shell: twice the axis of the normal, plus one at the high end.
WEST, EAST, SOUTH, NORTH, FLOOR, CEILING = range(6)
SHELL = 6  # solids are numbered from here on
OUTSIDE = -1  # a ray that leaves through a window
PANE, SILL, HEAD, JAMB, BAR = range(5)  # what a ray into an opening sees
_AHEAD_M = 1e-3  # chosen: a surface does not shade itself, and no object is as thin
_GRAZING = 1e-4  # chosen: cosine of a sun 0.006 degrees above the glass, which lets nothing in
# of a direction along an axis: avoids a division by zero; chosen
_SMALLEST = 1e-9


@dataclass(frozen=True)
class Surfaces:
    """Where r camera rays end, in room axes.

    position_m [r, 3]; axis (0 x, 1 y, 2 z) and sign (1.0 or -1.0) of the normal of the surface that
    is hit, towards the camera [r]; surface [r]: 0 to 5 for west, east, south and north wall, floor
    and ceiling, 6 + k for solid k, -1 for a ray through a window; spread_m [r]: angle between
    neighbouring rays, of which a pixel has several, times the ray's length.
    """

    position_m: Float32
    axis: NDArray[np.int8]
    sign: Float32
    surface: NDArray[np.int16]
    spread_m: Float32


@dataclass(frozen=True)
class RoomRays:
    """Rays from the camera in room axes.

    eye_m: the camera's place [3]; direction: unit vectors [3, r]; inverse: one over each component
    of `direction` [3, r]; spread: angle between neighbouring rays [rad].
    """

    eye_m: Float32
    direction: Float32
    inverse: Float32
    spread: float


def camera_rays(guess: Guess, rays_world: Float32, spread: float = 0.0) -> RoomRays:
    """Return the picture's rays [r, 3], in stated world axes, as rays of the guess's camera.

    World axes: x east, y north, z up by the stated heading. spread: angle between neighbouring rays
    [rad].
    """
    rays = (rays_world @ guess.camera_turn.T.astype(np.float32)).T  # [3, r]
    rays = np.where(np.abs(rays) < _SMALLEST, np.float32(_SMALLEST), rays).astype(np.float32)
    return RoomRays(np.array(guess.camera_m, np.float32), rays, 1.0 / rays, spread)


def surfaces(guess: Guess, rays_world: Float32, spread: float = 0.0) -> Surfaces:
    """Return where rays [r, 3] of the picture, in stated world axes, end in the guess.

    World axes: x east, y north, z up by the stated heading. spread: angle between neighbouring rays
    [rad]; 0 gives patches with hard edges.
    """
    return ends_of(guess, camera_rays(guess, rays_world, spread))[0]


def ends_of(guess: Guess, rays: RoomRays) -> tuple[Surfaces, Float32]:
    """Return where r camera rays end in the guess, and their length to there in m [r].

    A ray through a window ends at the wall's inner face.
    """
    count = rays.direction.shape[1]
    size = np.array(guess.size_m, np.float32)
    nearest, surface = shell_ends(rays.eye_m, rays.direction, rays.inverse, size)
    axis = (surface // 2).astype(np.int8)
    for number, solid in enumerate(guess.solids):
        rows, enters, entry_axis = entries(solid, rays, nearest)
        nearest[rows], axis[rows] = enters, entry_axis
        surface[rows] = SHELL + number
    ends = _ends(rays, np.arange(count), nearest, axis, surface)
    ends.surface[_in_window(guess, ends.position_m, surface)] = OUTSIDE
    return ends, nearest


def _ends(
    rays: RoomRays, rows: NDArray[np.intp], distance: Float32, axis: NDArray[np.int8],
    surface: NDArray[np.int16],
) -> Surfaces:  # fmt: skip
    """Return the ends of some of the rays; normals point against the ray."""
    position, sign = end_points(rays.eye_m, rays.direction, rows, distance, axis)
    spread_m = np.maximum(rays.spread * distance, _SMALLEST).astype(np.float32)
    return Surfaces(position, axis, sign, surface, spread_m)


def ends_on_solid(
    solid: Solid, number: int, rays: RoomRays, nearest: Float32
) -> tuple[NDArray[np.intp], Surfaces]:
    """Return the indices [k] of rays that end on a solid, and where.

    nearest: length of each ray to what it meets without the solid, m [r]; only shorter ways to the
    solid count. number: index of the solid from 0, which only names the surface.
    """
    rows, enters, axis = entries(solid, rays, nearest)
    surface = np.full(len(rows), SHELL + number, np.int16)
    return rows, _ends(rays, rows, enters, axis, surface)


def entries(
    solid: Solid, rays: RoomRays, nearest: Float32
) -> tuple[NDArray[np.intp], Float32, NDArray[np.int8]]:
    """Return rays that enter a solid before they are `nearest` [r] m long.

    These are k ray indices, distances to the entry in m, and axes of the face that is entered (0 x,
    1 y, 2 z). A ray that starts within the solid does not count.
    """
    return entered(solid_numbers(solid), rays.eye_m, rays.inverse, nearest)


def solid_numbers(solid: Solid) -> Float32:
    """Return a solid's numbers for the compiled loops, [2, 3]."""
    return np.array([solid.low_m, solid.high_m], np.float32)


def _wall_surface(wall: str) -> int:
    axis, side = WALLS[wall]
    return 2 * axis + side


def _in_window(guess: Guess, position: Array, surface: NDArray) -> NDArray[np.bool_]:
    """Return which of the rays' ends are in the opening of a window, [r]."""
    found = np.zeros(len(position), bool)
    for rect in guess.windows:
        along = 1 - WALLS[rect.wall][0]
        u, z = position[:, along], position[:, 2]
        on_wall = surface == _wall_surface(rect.wall)
        found |= on_wall & _within(u, rect.u_m) & _within(z, rect.z_m)
    return found


def seen_in_opening(guess: Guess, position: Array, direction: Array) -> NDArray[np.int8]:
    """Return what rays that enter an opening see: `PANE`, `SILL`, `HEAD`, `JAMB` or `BAR`, [r].

    position: where each ray crosses the wall's inner face [r, 3]; direction: outwards [r, 3]; both
    in room axes. A ray that is in no opening gives `BAR`.
    """
    shown = np.full(len(position), BAR, np.int8)
    for number, rect in enumerate(guess.windows):
        axis, side = WALLS[rect.wall]
        along = 1 - axis
        toward = direction[:, axis] * (1.0 if side else -1.0)
        inner = guess.size_m[axis] if side else 0.0
        here = (np.abs(position[:, axis] - inner) < _AHEAD_M) & (toward > _GRAZING)
        here &= _within(position[:, along], rect.u_m)
        here &= _within(position[:, 2], rect.z_m)
        rows = np.flatnonzero(here)
        u, z = position[rows, along], position[rows, 2]
        slope_u, slope_z = (direction[rows, k] / toward[rows] for k in (along, 2))
        outer_u, outer_z = u + slope_u * guess.thickness_m, z + slope_z * guess.thickness_m
        sees = np.full(len(rows), PANE, np.int8)
        for bar in guess.bars:
            if bar.window == number:
                at, slope = (u, slope_u) if bar.upright else (z, slope_z)
                below, above = _gaps(bar, at, slope)
                sees[(below < 0.0) & (above < 0.0)] = BAR
        sees[~_within(outer_u, rect.u_m)] = JAMB
        sees[outer_z > rect.z_m[1]] = HEAD
        sees[outer_z < rect.z_m[0]] = SILL
        shown[rows] = sees
    return shown


def _within(value: Array, span: tuple[float, float]) -> NDArray[np.bool_]:
    return (value > span[0]) & (value < span[1])


@dataclass(frozen=True)
class LitEntries:
    """Pairs of hour and ray that the sun reaches.

    hour, ray: indices from 0 [k]; strength: cosine of incidence times transmittance of the glass,
    times the share of the ray's spread that the edges of windows and bars do not shade [k].
    """

    hour: NDArray[np.intp]
    ray: NDArray[np.intp]
    strength: Float32


def lit_entries(guess: Guess, ends: Surfaces, suns_room: Float32) -> LitEntries:
    """Return the pairs of hour and ray end that the sun reaches through a window.

    ends: of r rays; suns_room: unit vectors to the sun in room axes, one for each hour [n, 3]. Bars
    and solids shade; surfaces that face down and rays through a window are never lit.
    """
    count = len(ends.surface)
    parts = [lit_pairs(*blocks, count) for blocks in _lit_blocks(guess, ends, suns_room)]
    hour, ray, strength = (np.concatenate(column) for column in zip(*parts, strict=True))
    return LitEntries(hour, ray, strength)


def _lit_blocks(
    guess: Guess, ends: Surfaces, suns_room: Float32
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Float32]]:
    """Yield what the sun reaches through each window, as `lit_blocks` returns it."""
    faces_down = (ends.axis == 2) & (ends.sign < 0.0)
    face = (ends.axis + np.where(ends.sign > 0.0, 0, 3)).astype(np.int8)
    face[faces_down | (ends.surface == OUTSIDE)] = -1
    solids = np.array([solid_numbers(s) for s in guess.solids], np.float32).reshape(-1, 2, 3)
    suns = suns_room.astype(np.float32)
    for number, rect in enumerate(guess.windows):
        axis, _ = WALLS[rect.wall]
        glass = _glass(rect.transmittance, suns[:, axis])
        window = _numbers(guess, rect)
        bars = [_bar_numbers(bar) for bar in guess.bars if bar.window == number]
        bars = np.array(bars, np.float32).reshape(-1, 5)
        yield lit_blocks(
            axis, window, bars, solids, ends.position_m, face, ends.spread_m, suns, glass
        )


def _numbers(guess: Guess, rect: WindowRect) -> Float32:
    """Return a window's numbers for `lit_pairs`, [7]."""
    axis, side = WALLS[rect.wall]
    inner, outward = (guess.size_m[axis], 1.0) if side else (0.0, -1.0)
    return np.array((inner, outward, guess.thickness_m, *rect.u_m, *rect.z_m), np.float32)


def _bar_numbers(bar: Bar) -> tuple[float, ...]:
    """Return a bar's five numbers for `lit_pairs`."""
    return (float(bar.upright), *bar.span_m, *bar.depth_m)


def _glass(transmittance: float, cosine: Float32) -> Float32:
    """Return the transmittance of a pane at cosines of incidence of either sign, [n]."""
    cosines, through = _glass_table(transmittance)
    return np.interp(np.abs(cosine), cosines, through).astype(np.float32)


@lru_cache(maxsize=16)
def _glass_table(transmittance: float) -> tuple[Array, Array]:
    """Return cosines from 0 to 1, and a pane's transmittance there; steps are 2e-4."""
    cosines = np.linspace(0.0, 1.0, 5001)
    return cosines, glass_optics(transmittance, cosines)[0]


def _gaps(bar: Bar, at_inner: Array, slope: Array) -> tuple[Array, Array]:
    """Return by how much lines that cross the wall's inner face at `at_inner` miss a bar, [k].

    At its lower and its upper side; a line that meets the bar misses neither.
    """
    first = at_inner + slope * np.float32(bar.depth_m[0])
    last = at_inner + slope * np.float32(bar.depth_m[1])
    below = np.float32(bar.span_m[0]) - np.maximum(first, last)
    return below, np.minimum(first, last) - np.float32(bar.span_m[1])


def shades(
    solid: Solid, position: Float32, suns: Float32, hour: NDArray[np.intp], ray: NDArray[np.intp]
) -> NDArray[np.bool_]:
    """Return whether a solid is between position and sun, for k pairs of hour and ray, [k].

    position: in room axes, m [r, 3]; suns: unit vectors to the sun in room axes [n, 3]; hour, ray:
    indices into these [k].
    """
    return shaded(solid_numbers(solid), position, suns, hour, ray)


def unit_patches(
    guess: Guess,
    ends: Surfaces,
    suns_room: Float32,
    pixel: NDArray[np.intp],
    pixels: int,
    sub: int,
    tone: Array | None = None,
) -> Float32:
    """Return irradiance of the pixels' surfaces per lx of the sun on its normal, [n, m].

    ends: of r rays; suns_room: unit vectors in room axes [n, 3]; pixels: their number m. pixel:
    index below m of each ray's pixel [r]; sub x sub rays make a pixel. tone: a factor of each ray,
    such as albedo, None for 1 [r]. Times the sun's illuminance, times albedo over pi, the result is
    the luminance of the sun patch.
    """
    total = np.zeros((len(suns_room), pixels), np.float32)
    factor = np.ones(len(pixel), np.float32) if tone is None else tone.astype(np.float32)
    for blocks in _lit_blocks(guess, ends, suns_room):
        add_to_pixels(*blocks, factor, pixel, total)
    return total / np.float32(sub**2)
