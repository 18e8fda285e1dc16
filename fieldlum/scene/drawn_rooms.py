"""Draw random rooms that are possible within the uncertainty of a stated room.

A tape measure is wrong by centimetres and a compass by a degree. Near bars, jambs and obstructions
this decides whether the sun disc is seen, and therefore the glare of an hour.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.arrays import Floats, Floats32, Mask
from fieldlum.errors import InputError
from fieldlum.projection import signed_angle_deg
from fieldlum.records import Obstruction, Room, Window
from fieldlum.scene.geometry import BoxScene, Opening, build, glass_optics
from fieldlum.scene.sun_disc import SUN_RADIUS_DEG

# Standard uncertainties if none are stated: a tape measure over furniture, a phone's compass.
# Chosen, not measured.
STATED_LENGTH_M = 0.05
STATED_ANGLE_DEG = 1.0
# Standard uncertainties of a fitted room at best: bars of the office were found within 1 to 2 cm
# (docs/scene.md), and the search ends at 4 mm and 0.03 degrees.
SEARCH_LENGTH_M = 0.01
SEARCH_ANGLE_DEG = 0.05
_ROOM_LENGTHS = ("camera_x_m", "camera_y_m", "camera_z_m")
_WINDOW_LENGTHS = ("left_m", "width_m", "sill_m", "height_m", "transom_m")
_OBSTRUCTION_LENGTHS = ("x_m", "y_m", "z_m", "width_m", "depth_m", "height_m")
_LEAST_SIZE_M = 0.02  # of a drawn window or obstruction
_CAMERA_GAP_M = 0.05  # between the camera and a wall
_TRIES = 20  # draws of a room before the stated one is used; overlapping windows are rare
_RING = 6  # rays near the rim of the disc, in addition to one at its centre; chosen for speed


@dataclass(frozen=True, slots=True)
class RoomUncertainty:
    """A normal distribution of a room's parameters around their values in the room.

    names [p] are keys of `room_parameters`; covariance [p, p] is in their units (m, deg). A fitted
    posterior has the same form: the fitted room, and the covariance of the fitted parameters.
    """

    names: tuple[str, ...]
    covariance: Floats


def room_parameters(room: Room) -> dict[str, float]:
    """Return the parameters of a box room that can be uncertain, by name, in m and deg.

    Names are camera_x_m, wall_azimuth_deg, window.0.left_m, obstruction.0.x_m and so on.
    """
    values = {name: float(getattr(room, name)) for name in (*_ROOM_LENGTHS, "wall_azimuth_deg")}
    for k, window in enumerate(room.window):
        values |= {f"window.{k}.{name}": getattr(window, name) for name in _WINDOW_LENGTHS}
    for k, obstruction in enumerate(room.obstruction):
        values |= {
            f"obstruction.{k}.{name}": getattr(obstruction, name) for name in _OBSTRUCTION_LENGTHS
        }
    return values


def with_parameters(room: Room, values: Mapping[str, float]) -> Room:
    """Return the room with some of its `room_parameters` replaced by `values` [m, deg].

    Raises KeyError for a name that the room does not have.
    """
    if unknown := set(values) - set(room_parameters(room)):
        raise KeyError(f"the room has no {', '.join(sorted(unknown))}")

    def part(kind: str, k: int, of: Window | Obstruction) -> dict[str, float]:
        names = {f"{kind}.{k}.{f.name}": f.name for f in fields(of)}
        return {names[name]: float(v) for name, v in values.items() if name in names}

    own = {name: float(value) for name, value in values.items() if "." not in name}
    return replace(
        room,
        window=tuple(replace(w, **part("window", k, w)) for k, w in enumerate(room.window)),
        obstruction=tuple(
            replace(o, **part("obstruction", k, o)) for k, o in enumerate(room.obstruction)
        ),
        **own,
    )


def stated_uncertainty(
    room: Room, length_m: float = STATED_LENGTH_M, angle_deg: float = STATED_ANGLE_DEG
) -> RoomUncertainty:
    """Return the uncertainty of a room whose parameters were measured independently by hand.

    length_m, angle_deg : standard uncertainty of each length and of each angle. A transom of height
    0 (no transom) is not varied.
    """
    names = tuple(
        name
        for name, value in room_parameters(room).items()
        if not (name.endswith("transom_m") and value == 0.0)
    )
    sd = np.array([angle_deg if name.endswith("_deg") else length_m for name in names])
    return RoomUncertainty(names, np.diag(sd**2))


def uncertainty_of_draws(room: Room, draws: Mapping[str, Sequence[float]]) -> RoomUncertainty:
    """Return the uncertainty of a fitted room as the covariance of its parameters over searches.

    draws: for each of `room_parameters`, its values in two or more searches with resampled
    captures. Parameters that the room does not have are ignored. Standard uncertainties are at
    least 1 cm and 0.05 degrees.
    """
    values = room_parameters(room)
    names = tuple(
        name
        for name in draws
        if name in values and not (name.endswith("transom_m") and values[name] == 0.0)
    )
    rows = np.array([draws[name] for name in names], float)  # [p, k]
    turns = np.array([name.endswith("_deg") for name in names])
    off = rows - rows[:, :1]
    off[turns] = signed_angle_deg(off[turns])
    off = off - off.mean(axis=1, keepdims=True)
    least = np.where(turns, SEARCH_ANGLE_DEG, SEARCH_LENGTH_M)
    covariance = off @ off.T / (rows.shape[1] - 1) + np.diag(least**2)
    return RoomUncertainty(names, covariance)


def draw_rooms(
    room: Room, uncertainty: RoomUncertainty, count: int, rng: np.random.Generator
) -> tuple[Room, ...]:
    """Return `count` rooms drawn from the uncertainty around `room`.

    Windows stay within their walls, and the camera within the room. If 20 draws are impossible,
    `room` itself is returned for that draw. Raises KeyError for a parameter that the room does not
    have, InputError for a room that is not a box.
    """
    build(room)
    stated = room_parameters(room)
    centre = np.array([stated[name] for name in uncertainty.names])
    return tuple(_drawn(room, centre, uncertainty, rng) for _ in range(count))


def _drawn(
    room: Room, centre: Floats, uncertainty: RoomUncertainty, rng: np.random.Generator
) -> Room:
    for _ in range(_TRIES):
        values = rng.multivariate_normal(centre, uncertainty.covariance, method="cholesky")
        pairs = zip(uncertainty.names, map(float, values), strict=True)
        drawn = _within_walls(with_parameters(room, dict(pairs)))
        try:
            build(drawn)
        except InputError:  # windows that overlap, a camera inside furniture
            continue
        return drawn
    return room


def _within_walls(room: Room) -> Room:
    """Return the nearest room whose camera is inside and whose windows fit their walls."""

    def fitted(window: Window) -> Window:
        length = room.width_m if window.wall in ("south", "north") else room.depth_m
        left_m = float(np.clip(window.left_m, 0.0, length - _LEAST_SIZE_M))
        sill = float(np.clip(window.sill_m, 0.0, room.height_m - _LEAST_SIZE_M))
        return replace(
            window,
            left_m=left_m,
            sill_m=sill,
            width_m=float(np.clip(window.width_m, _LEAST_SIZE_M, length - left_m)),
            height_m=float(np.clip(window.height_m, _LEAST_SIZE_M, room.height_m - sill)),
        )

    def sized(box: Obstruction) -> Obstruction:
        names = ("width_m", "depth_m", "height_m")
        return replace(box, **{name: max(getattr(box, name), _LEAST_SIZE_M) for name in names})

    gap = _CAMERA_GAP_M
    return replace(
        room,
        camera_x_m=float(np.clip(room.camera_x_m, gap, room.width_m - gap)),
        camera_y_m=float(np.clip(room.camera_y_m, gap, room.depth_m - gap)),
        camera_z_m=float(np.clip(room.camera_z_m, gap, room.height_m - gap)),
        window=tuple(fitted(window) for window in room.window),
        obstruction=tuple(sized(box) for box in room.obstruction),
    )


# ----------------------------------------------------------------------------------------------
# the disc in many rooms


def drawn_disc_shares(rooms: Sequence[Room], sun_direction: ArrayLike) -> Floats32:
    """Return the disc's illuminance at the camera over the sun's normal illuminance, [k, n].

    It is the visible share of the disc times the glass's transmittance, 0 to 1. sun_direction : [n,
    3] unit vectors in world axes (x east, y north, z up); k rooms, n times.
    """
    suns = np.asarray(sun_direction, float)
    out = np.zeros((len(rooms), len(suns)), np.float32)
    for k, room in enumerate(rooms):
        scene = build(room)
        toward = scene.to_room(suns)  # [n, 3]
        for opening in scene.openings:
            out[k] += _share_through(scene, opening, toward)
    return out


def _share_through(scene: BoxScene, o: Opening, toward: Floats) -> Floats:
    """Return the visible share of the disc through one opening, times its glass, [n]."""
    share = np.zeros(len(toward))
    rows = np.flatnonzero((toward[:, o.axis] * o.outward > 1e-6) & (toward[:, 2] > 0))
    eye = np.array(scene.camera_m)
    margin_rad = np.radians(2.0 * SUN_RADIUS_DEG)
    rows = rows[_passes(o, eye, toward[rows], margin_rad)]
    if not len(rows):
        return share
    rays = _disc_rays(toward[rows]).reshape(-1, 3)  # [m * 7, 3]
    free = _passes(o, eye, rays, 0.0)
    for k in scene.of_kind("frame", "obstruction"):
        free &= ~_meets(scene.low[k], scene.high[k], eye, rays)
    through = glass_optics(o.transmittance, toward[rows, o.axis])[0]
    share[rows] = free.reshape(len(rows), -1).mean(axis=1) * through
    return share


def _passes(o: Opening, eye: Floats, rays: Floats, margin_rad: float) -> Mask:
    """Return a mask of rays [m, 3] from the eye that pass both ends of the opening.

    The opening is widened by an angle.
    """
    inside = np.ones(len(rays), bool)
    for plane in (o.inner_m, o.outer_m):
        at = (plane - eye[o.axis]) / rays[:, o.axis]  # [m]
        u, z = eye[o.along] + at * rays[:, o.along], eye[2] + at * rays[:, 2]
        reach = margin_rad * at / np.maximum(np.abs(rays[:, o.axis]), 0.05)
        inside &= (u > o.u_m[0] - reach) & (u < o.u_m[1] + reach)
        inside &= (z > o.z_m[0] - reach) & (z < o.z_m[1] + reach)
    return inside


def _disc_rays(toward: Floats) -> Floats:
    """Return rays to the centre of the disc and to points at 0.75 of its radius, [m, 7, 3]."""
    side = np.cross(toward, (0.0, 0.0, 1.0))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    other = np.cross(toward, side)
    angle = np.arange(_RING) * 2.0 * np.pi / _RING
    radius = 0.75 * np.tan(np.radians(SUN_RADIUS_DEG))
    offsets = radius * (
        np.cos(angle)[:, None] * side[:, None, :] + np.sin(angle)[:, None] * other[:, None, :]
    )
    return np.concatenate([toward[:, None, :], toward[:, None, :] + offsets], axis=1)


def _meets(low: Floats, high: Floats, eye: Floats, rays: Floats) -> Mask:
    """Return a mask of rays [m, 3] from the eye that meet a box (slab test).

    The box has the corners `low` and `high`.
    """
    d = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
    a, b = (low - eye) / d, (high - eye) / d
    enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
    return (enter < leave) & (leave > 0.0)
