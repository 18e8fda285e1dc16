"""Direct sun on the surfaces of a guessed scene, at sampled pixels and hours: a few milliseconds.

`fieldlum.scene` renders a complete panorama of one room exactly. A search needs thousands of
scenes at a few thousand pixels, so this renderer knows only boxes: a ray from the camera ends on
the shell of the room or on a solid; from there the sun is seen if the line towards it passes the
inner and the outer rectangle of a window, misses its bars and misses all solids.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.scene.geometry import WALLS, glass_optics
from fieldlum.scene_fit.guess import Bar, Guess, Solid, WindowRect

Float32 = NDArray[np.float32]
Array = NDArray[np.floating]

# Surfaces of the shell: twice the axis of the normal, plus one at the high end.
WEST, EAST, SOUTH, NORTH, FLOOR, CEILING = range(6)
SHELL = 6  # solids are numbered from here on
OUTSIDE = -1  # a ray that leaves through a window
_AHEAD_M = 1e-3  # a surface does not shade itself
_GRAZING = 1e-4


@dataclass(frozen=True)
class Surfaces:
    """Where camera rays end: position [r, 3], axis and sign of the face's normal [r], surface [r]
    (`FLOOR` ..., `SHELL` + number of a solid, or `OUTSIDE`).
    """

    position_m: Float32
    axis: NDArray[np.int8]
    sign: Float32
    surface: NDArray[np.int16]


def surfaces(guess: Guess, rays_world: Float32) -> Surfaces:
    """Return where rays [r, 3] from the camera end, world axes as stated."""
    rays = (rays_world @ guess.camera_turn.T.astype(np.float32)).astype(np.float32)  # [r, 3]
    eye = np.array(guess.camera_m, np.float32)
    bounds = np.where(rays > 0.0, np.array(guess.size_m, np.float32), np.float32(0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = np.where(rays != 0.0, (bounds - eye) / rays, np.inf)  # [r, 3]
    axis = distance.argmin(axis=1).astype(np.int8)
    rows = np.arange(len(rays))
    nearest = distance[rows, axis]
    high = rays[rows, axis] > 0.0
    surface = (2 * axis + high).astype(np.int16)
    sign = np.where(high, -1.0, 1.0).astype(np.float32)  # normals point into the room
    for number, solid in enumerate(guess.solids):
        enters, entry_axis = _entry(solid, eye, rays)
        nearer = enters < nearest
        nearest = np.where(nearer, enters, nearest)
        axis = np.where(nearer, entry_axis, axis).astype(np.int8)
        facing = -np.sign(rays[rows, entry_axis])
        sign = np.where(nearer, facing, sign).astype(np.float32)
        surface = np.where(nearer, SHELL + number, surface).astype(np.int16)
    position = eye + rays * nearest[:, None].astype(np.float32)
    surface[_in_window(guess, position, surface)] = OUTSIDE
    return Surfaces(position.astype(np.float32), axis, sign, surface)


def _entry(solid: Solid, eye: Array, rays: Float32) -> tuple[Array, NDArray[np.intp]]:
    """Distance at which rays [r, 3] enter a solid (inf: never), and the axis of the face, [r]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a = (np.array(solid.low_m, np.float32) - eye) / rays  # [r, 3]
        b = (np.array(solid.high_m, np.float32) - eye) / rays
    near, far = np.minimum(a, b), np.maximum(a, b)
    axis = np.nan_to_num(near, nan=-np.inf).argmax(axis=1)
    enters = near[np.arange(len(rays)), axis]
    hit = (enters > 0.0) & (enters < np.nanmin(far, axis=1))
    return np.where(hit, enters, np.inf), axis


def _wall_surface(wall: str) -> int:
    axis, side = WALLS[wall]
    return 2 * axis + side


def _in_window(guess: Guess, position: Array, surface: NDArray) -> NDArray[np.bool_]:
    """Which of the rays' ends lie in the opening of a window, [r]."""
    found = np.zeros(len(position), bool)
    for rect in guess.windows:
        along = 1 - WALLS[rect.wall][0]
        u, z = position[:, along], position[:, 2]
        on_wall = surface == _wall_surface(rect.wall)
        found |= on_wall & _within(u, rect.u_m) & _within(z, rect.z_m)
    return found


def _within(value: Array, span: tuple[float, float]) -> NDArray[np.bool_]:
    return (value > span[0]) & (value < span[1])


@dataclass(frozen=True)
class LitEntries:
    """The pairs of hour and ray that the sun reaches: hour [k], ray [k], and cosine of incidence
    times transmittance of the glass [k].
    """

    hour: NDArray[np.intp]
    ray: NDArray[np.intp]
    strength: Float32


def lit_entries(guess: Guess, ends: Surfaces, suns_room: Float32) -> LitEntries:
    """Return which ray ends the suns [n, 3] (room axes) reach through a window."""
    parts = [
        _through(guess, number, rect, ends, suns_room) for number, rect in enumerate(guess.windows)
    ]
    hour, ray, strength = (np.concatenate(column) for column in zip(*parts, strict=True))
    return LitEntries(hour, ray, strength)


def _through(
    guess: Guess, number: int, rect: WindowRect, ends: Surfaces, suns: Float32
) -> tuple[NDArray[np.intp], NDArray[np.intp], Float32]:
    axis, side = WALLS[rect.wall]
    along = 1 - axis
    outward = np.float32(1.0 if side else -1.0)
    inner = np.float32(guess.size_m[axis] if side else 0.0)
    toward = suns[:, axis] * outward  # [n] component of the sun's direction out of this wall
    before = np.flatnonzero((toward > _GRAZING) & (suns[:, 2] > 0.0))
    inside = np.flatnonzero(ends.surface != OUTSIDE)
    p = ends.position_m[inside]  # [r, 3]
    across = (inner - p[:, axis]) * outward  # [r] distance to the wall's inner face
    slope_u = suns[before, along] / toward[before]  # [n]
    slope_z = suns[before, 2] / toward[before]
    u = p[:, along] + slope_u[:, None] * across  # [n, r] where the line crosses the inner face
    z = p[:, 2] + slope_z[:, None] * across
    t = np.float32(guess.thickness_m)
    du, dz = (slope_u * t)[:, None], (slope_z * t)[:, None]
    passes = (across > 0.0) & _within(u, rect.u_m) & _within(z, rect.z_m)
    passes &= _within(u + du, rect.u_m) & _within(z + dz, rect.z_m)
    h, r = np.nonzero(passes)
    cosine = ends.sign[inside[r]] * suns[before[h], ends.axis[inside[r]]]
    keep = cosine > 0.0
    h, r, cosine = h[keep], r[keep], cosine[keep]
    for bar in guess.bars:
        if bar.window == number:
            at, slope = (u, slope_u) if bar.upright else (z, slope_z)
            free = ~_meets(bar, at[h, r], slope[h])
            h, r, cosine = h[free], r[free], cosine[free]
    hour, ray = before[h], inside[r]
    for solid in guess.solids:
        free = ~_shades(solid, ends.position_m[ray], suns[hour])
        hour, ray, cosine = hour[free], ray[free], cosine[free]
    glass = glass_optics(rect.transmittance, suns[hour, axis])[0]
    return hour, ray, (cosine * glass).astype(np.float32)


def _meets(bar: Bar, at_inner: Array, slope: Array) -> NDArray[np.bool_]:
    """Whether lines that cross the wall's inner face at `at_inner` [k] meet the bar."""
    first = at_inner + slope * np.float32(bar.depth_m[0])
    last = at_inner + slope * np.float32(bar.depth_m[1])
    return (np.maximum(first, last) > bar.span_m[0]) & (np.minimum(first, last) < bar.span_m[1])


def _shades(solid: Solid, position: Float32, suns: Float32) -> NDArray[np.bool_]:
    """Whether the solid stands between positions [k, 3] and suns [k, 3]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a = (np.array(solid.low_m, np.float32) - position) / suns  # [k, 3]
        b = (np.array(solid.high_m, np.float32) - position) / suns
    enters = np.nanmax(np.minimum(a, b), axis=1)
    leaves = np.nanmin(np.maximum(a, b), axis=1)
    return (leaves > enters) & (leaves > _AHEAD_M) & (enters > -_AHEAD_M)


def unit_patches(
    guess: Guess, ends: Surfaces, suns_room: Float32, pixel: NDArray[np.intp], pixels: int, sub: int
) -> Float32:
    """Return irradiance of the pixels' surfaces per lx of the sun on its normal, [n, m].

    pixel [r]: which of the m pixels a ray belongs to; sub x sub rays make a pixel. Times
    illuminance, times albedo over pi, this is the luminance of the sun patch.
    """
    lit = lit_entries(guess, ends, suns_room)
    flat = lit.hour * pixels + pixel[lit.ray]
    total = np.bincount(flat, lit.strength, len(suns_room) * pixels)
    return (total / sub**2).reshape(len(suns_room), pixels).astype(np.float32)
