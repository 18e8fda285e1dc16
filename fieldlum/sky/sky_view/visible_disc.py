"""Compute the sun's disc of every hour: the beam times the mean of the sky view over the disc.

The camera has looked through the window at the place of the eye. A stated room is used only in
directions that no lens saw, and by models without a sky view.
"""

from typing import NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import Room, SiteFile, counted
from fieldlum.optics.projection import direction
from fieldlum.sky.daylight import Light
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR
from fieldlum.sky.sun_disc import MIN_DISC_CDM2, SUN_RADIUS_RAD

DRAWS = 64  # of the pose and the view for an interval: 2.5 % of them is more than one; chosen
_RINGS = (1, 6, 12, 18)  # points of equal area in the disc: at its centre, and on three rings
_MIN_LX = MIN_DISC_CDM2 * SUN_SOLID_ANGLE_SR  # 68 lx: less is no disc in a picture either
# Standard deviation of the sun's direction relative to the edges of a stated room: a compass to 1
# degree, and 5 cm at an edge 2.5 m away. Chosen from these two.
EDGE_SD_DEG = 1.5
# Relative standard uncertainty of the beam's luminous efficacy for each air mass: Perez's model
# against SPECTRL2 (Bird and Riordan 1986) at aerosol optical depths of 0.05 to 0.35, and against
# Littlefair's fit (1988): within 8 % at 45 degrees, a factor of 0.7 to 1.9 at 5 to 6 degrees.
_EFFICACY_U = 0.04
# Largest direct transmittance of a pane: clear single glass (EN 410).
CLEAR_GLASS = 0.9


class DiscOfHours(NamedTuple):
    """The sun's disc at the lens in n hours, on a plane normal to the sun.

    best_lx [n]: most likely illuminance; low_lx, high_lx [n]: by the bounds of the sky view, with
    the view's most likely pose. not_seen [n]: True where the sun is up in a direction that no lens
    saw; the illuminances are then 0.
    """

    best_lx: Floats
    low_lx: Floats
    high_lx: Floats
    not_seen: Mask


def disc_of_hours(view: SkyView, light: Light) -> DiscOfHours:
    """Return the disc in the n hours of `light` by the sky view; 0 lx where no lens saw."""
    best, low, high = np.empty((3, len(light)))
    for rows, part in view.of_hours(light):
        suns = part.pose.in_pictures(light.apparent_sun_direction[rows])
        best[rows], low[rows], high[rows] = _over_disc(part, suns)
    best_lx = np.nan_to_num(best) * light.direct_lx
    return DiscOfHours(
        best_lx=np.where(best_lx < _MIN_LX, 0.0, best_lx),
        low_lx=np.nan_to_num(low) * light.direct_lx,
        high_lx=np.nan_to_num(high) * light.direct_lx,
        not_seen=np.isnan(best) & (light.direct_lx > 0.0),
    )


def drawn_shares(view: SkyView, light: Light, rng: np.random.Generator) -> Floats:
    """Return the disc's share of the beam in `DRAWS` draws of pose and view, [DRAWS, n].

    A draw has one pose and one position between the bounds of the view (-1: low, 0: best, 1: high)
    for all n hours of `light`. A share is NaN in directions that no lens saw, 0 without a beam.
    """
    poses = view.pose.drawn(rng, DRAWS)
    # Spread evenly; 4 % reach each bound, so that their 2.5th percentile is the bound itself: DGP
    # is .06 higher with 20 lx of a disc than with none.
    positions = np.clip((rng.permutation(DRAWS) + 0.5 - 0.5 * DRAWS) / (0.46 * DRAWS), -1.0, 1.0)
    drawn = np.zeros((DRAWS, len(light)))
    for hours, part in view.of_hours(light):
        rows = hours[light.direct_lx[hours] > 0.0]
        suns = light.apparent_sun_direction[rows]
        for k, (pose, position) in enumerate(zip(poses, positions, strict=True)):
            best, low, high = _over_disc(part, part.pose.in_pictures(suns, pose))
            drawn[k, rows] = best + abs(position) * ((high if position > 0.0 else low) - best)
    return drawn


def _over_disc(view: SkyView, suns: Floats) -> Floats:
    """Return the share of the beam over the disc: best, low and high, [3, n].

    suns [n, 3]: unit vectors to the disc's centre, where the pictures show it. NaN if no lens saw
    more than half of the disc.
    """
    shares = view.beam_shares(disc_points(suns))  # [3, n, 37]
    mean = np.nan_to_num(shares).mean(axis=2)
    return np.where(np.isnan(shares).mean(axis=2) > 0.5, np.nan, mean)


def disc_points(suns: Floats) -> Floats:
    """Return unit vectors to 37 points of equal area in the sun's disc, [n, 37, 3].

    suns: unit vectors to its centre [n, 3].
    """
    side = np.cross(suns, (0.0, 0.0, 1.0))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    other = np.cross(suns, side)
    offsets = [np.zeros((1, 2))]  # from the centre along side and other, of each ring [k, 2]
    total, inner = sum(_RINGS), 1
    for number in _RINGS[1:]:
        # the circle that halves the ring's area
        radius = SUN_RADIUS_RAD * np.sqrt((inner + 0.5 * number) / total)
        angle = (np.arange(number) + 0.5) * 2.0 * np.pi / number
        offsets.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        inner += number
    x, y = np.concatenate(offsets).T  # [37] each
    points = suns[:, None] + x[:, None] * side[:, None] + y[:, None] * other[:, None]
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def disc_lx(view: SkyView | None, setup: SiteFile, light: Light) -> Floats:
    """Return the illuminance of the sun's disc at the lens, on a plane normal to the sun, [n] lx.

    It is that by the sky view; in directions that no lens saw, or without a view, that by the room
    of `setup`; 0 without either. Raises InputError for an impossible room.
    """
    best_lx, not_seen = np.zeros(len(light)), np.ones(len(light), bool)
    if view is not None:
        disc = disc_of_hours(view, light)
        best_lx, not_seen = disc.best_lx, disc.not_seen
    if not_seen.any():
        unseen = light[not_seen]
        shares = room_shares(setup.room, unseen.apparent_sun_direction)
        best_lx[not_seen] = shares * unseen.direct_lx
    return best_lx


def drawn_discs_lx(
    view: SkyView | None, setup: SiteFile, light: Light, rng: np.random.Generator
) -> Floats:
    """Return the disc's illuminance at the lens in `DRAWS` random draws, [DRAWS, n] lx.

    Each draw varies the sky view, its pose and the beam's luminous efficacy within their
    uncertainties. In directions that no lens saw, the room of `setup` decides, with the sun moved
    at random by about 1.5 degrees; without a room, the share is drawn from 0 to 0.9, the
    transmittance of clear glass. Raises InputError for an impossible room.
    """
    shares = np.full((DRAWS, len(light)), np.nan)
    if view is not None:
        shares = drawn_shares(view, light, rng)
    turns = rng.normal(0.0, EDGE_SD_DEG, (DRAWS, 2))  # of azimuth and altitude
    guesses = rng.permutation((np.arange(DRAWS) + 0.5) / DRAWS) * CLEAR_GLASS
    open_hours = np.flatnonzero(np.isnan(shares).any(axis=0) & (light.direct_lx > 0.0))
    if len(open_hours):
        unknown = light[open_hours]
        filled = np.repeat(guesses[:, None], len(unknown), axis=1)
        if setup.room is not None:
            suns = np.stack([_turned(unknown, *turn) for turn in turns])  # [DRAWS, m, 3]
            filled = room_shares(setup.room, suns.reshape(-1, 3)).reshape(filled.shape)
        part = shares[:, open_hours]
        shares[:, open_hours] = np.where(np.isnan(part), filled, part)
    efficacy = np.exp(rng.normal(0.0, 1.0, (DRAWS, 1)) * efficacy_u(light.apparent_altitude_deg))
    return np.nan_to_num(shares) * light.direct_lx * efficacy


def efficacy_u(altitudes_deg: Floats) -> Floats:
    """Return the relative standard uncertainty of the beam's luminous efficacy, [n].

    altitudes_deg: apparent altitudes of the sun [n]. It is 4 % for each air mass, 1 /
    sin(altitude), of Perez's efficacy compared with SPECTRL2 and Littlefair 1988.
    """
    return _EFFICACY_U / np.sin(np.radians(np.maximum(altitudes_deg, 3.0)))


def disc_source(view: SkyView | None, setup: SiteFile, file: str = "") -> str:
    """Return a text that names the source of the disc's visibility: sky view, room or none.

    file: name of a sky view from another session, or "".
    """
    if view is None:
        if setup.room is None:
            return "unknown: the model has no sky view and its site no [room]; train it again"
        return "the stated room: the model has no sky view; train it again"
    filled = "; the stated room where no lens saw" if setup.room is not None else ""
    unseen = np.isnan(view.openness).any()
    source = f"in {file}" if file else f"of {counted(view.captures, 'capture')}"
    return f"the sky view {source}{filled if unseen else ''}"


def _turned(light: Light, azimuth_deg: float, altitude_deg: float) -> Floats:
    """Return unit vectors to the apparent sun, turned by these angles on the sky, [n, 3]."""
    altitude = np.minimum(light.apparent_altitude_deg + altitude_deg, 90.0)
    # near the zenith a given angle on the sky is a larger change of azimuth
    turn = azimuth_deg / np.maximum(np.cos(np.radians(altitude)), 0.2)
    return direction(altitude, light.sun_azimuth_deg + turn)


def room_shares(room: Room | None, suns: Floats) -> Floats:
    """Return the share of the beam (0 to 1) that reaches the camera in a stated room, [n].

    room: a box or a Radiance scene; None gives 0. suns: unit vectors to the apparent sun, x east, y
    north, z up [n, 3]. In a Radiance scene a share up to 0.001 counts as 0, and so does a sun below
    the horizon. Raises InputError for an impossible room.
    """
    if room is None:
        return np.zeros(len(suns))
    if room.kind == "box":
        from fieldlum.room.scene import build, disc_visibility

        scene = build(room)
        visible, through = disc_visibility(scene, scene.to_room(suns))
        return np.asarray(visible * through, float)
    from fieldlum.room.scene.radiance import traced_sky_share

    shares = traced_sky_share(room, suns)
    return np.where((shares > 1e-3) & (suns[..., 2] > 0), shares, 0.0)
