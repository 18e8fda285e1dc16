"""Estimate how much of the sun's disc the camera sees in hours without a capture.

The estimate follows from the stated room, or from rooms drawn from its uncertainty, or is guessed
from a predicted map.
"""

from __future__ import annotations

import numpy as np

from fieldlum.arrays import Floats, Floats32
from fieldlum.light import Light
from fieldlum.projection import direction, equirect_pixel
from fieldlum.records import Room, SiteFile
from fieldlum.scene import RoomUncertainty
from fieldlum.scene.radiance import traced_sky_share

# Ratio of a pixel's luminance to that of the sky behind it. Between these limits the sun's pixel
# shows open sky through glass. Not measured.
SKY_SHARE = (0.3, 1.3)
# Standard deviation of the sun's direction relative to the edges of a room that has no parameters:
# a compass to 1 degree, and 5 cm at an edge 2.5 m away. Chosen from these two.
EDGE_SD_DEG = 1.5
# 2.5 % of them is more than one room; a year of them takes half a second of CPU time; chosen
DRAWN_ROOMS = 64


def stated_disc_lx(setup: SiteFile, light: Light) -> Floats | None:
    """Return the illuminance of the sun's disc at the lens by the room of `setup`, [n] lx.

    light: n hours. The illuminance is on a plane normal to the sun, 0 where the room hides the sun.
    None if `setup` has no room. Raises InputError for an impossible room or a room file that cannot
    be traced.
    """
    room = setup.room
    if room is None:
        return None
    if room.kind == "box":
        from fieldlum.scene import build, disc_visibility

        scene = build(room)
        visible, through = disc_visibility(scene, scene.to_room(light.shown_sun_direction))
        return visible * through * light.direct_lx
    return _traced_disc_lx(room, light, light.shown_sun_direction[None])[0]


def drawn_discs_lx(
    setup: SiteFile,
    light: Light,
    rng: np.random.Generator,
    count: int = DRAWN_ROOMS,
    uncertainty: RoomUncertainty | None = None,
) -> Floats | None:
    """Return the illuminance of the sun's disc in rooms drawn from the room's uncertainty.

    The result is [count, n] lx for the n hours of `light`, at the lens, on a plane normal to the
    sun. None if `setup` has no room. The room of `setup` is drawn `count` times with `rng`.
    uncertainty: that of a fitted room; None for 5 cm and 1 degree, as for a stated room. A room
    from a file has no parameters: there the sun is shifted at random instead, with a standard
    deviation of 1.5 degrees along each axis.
    """
    room = setup.room
    if room is None:
        return None
    if room.kind == "box":
        from fieldlum.scene import draw_rooms, drawn_disc_shares, stated_uncertainty

        rooms = draw_rooms(room, uncertainty or stated_uncertainty(room), count, rng)
        return drawn_disc_shares(rooms, light.shown_sun_direction) * light.direct_lx
    turns = rng.normal(0.0, EDGE_SD_DEG, (count, 2))
    suns = np.stack([_turned(light, *turn) for turn in turns])  # [count, n, 3]
    return _traced_disc_lx(room, light, suns)


def _turned(light: Light, azimuth_deg: float, altitude_deg: float) -> Floats:
    altitude = np.minimum(light.shown_altitude_deg + altitude_deg, 90.0)
    # near the zenith a given angle on the sky is a larger change of azimuth
    turn = azimuth_deg / np.maximum(np.cos(np.radians(altitude)), 0.2)
    return direction(altitude, light.sun_azimuth_deg + turn)


def _traced_disc_lx(room: Room, light: Light, suns: Floats) -> Floats:
    """Return the disc's illuminance behind a room file, for suns [k, n, 3], [k, n] lx."""
    shares = traced_sky_share(room, suns.reshape(-1, 3)).reshape(suns.shape[:2])
    shares = np.where((shares > 1e-3) & (suns[..., 2] > 0), shares, 0.0)
    return shares * light.direct_lx


def guessed_disc_lx(
    maps: Floats32, light: Light, heading_deg: float, turns_deg: Floats | None = None
) -> Floats:
    """Return the disc's illuminance guessed from predicted maps, without any geometry, [n] lx.

    maps: [n, H, W] cd/m2, of the n hours of `light`; heading_deg: azimuth of their centre column.
    turns_deg: shifts of the sun in azimuth and altitude, in degrees on the sky [k, 2]; the result
    is then [k, n], one row for each shift. None: no shift.

    If the sun is up and its pixel has 0.3 to 1.3 times the luminance of the Perez sky there, it
    shows sky through glass, and the disc shines through with that factor, at most 1; otherwise the
    illuminance is 0. A twig or a blind is not detected.
    """
    sky = np.array(
        [light[[k]].sky_at(light.sun_direction[k : k + 1])[0, 0] for k in range(len(light))]
    )
    turns = np.zeros((1, 2)) if turns_deg is None else turns_deg
    discs = np.stack([_guessed(maps, light, heading_deg, sky, turn) for turn in turns])
    return discs[0] if turns_deg is None else discs


def _guessed(
    maps: Floats32, light: Light, heading_deg: float, sky_cdm2: Floats, turn_deg: Floats
) -> Floats:
    height, width = maps.shape[1:]
    altitude = np.minimum(light.shown_altitude_deg + turn_deg[1], 90.0)
    turn = turn_deg[0] / np.maximum(np.cos(np.radians(altitude)), 0.2)
    row, column = equirect_pixel(altitude, light.sun_azimuth_deg + turn, height, width, heading_deg)
    i = np.clip(row.astype(int), 0, height - 1)
    j = np.minimum(column.astype(int), width - 1)
    share = maps[np.arange(len(maps)), i, j] / np.maximum(sky_cdm2, 1e-3)
    shows_sky = (share > SKY_SHARE[0]) & (share < SKY_SHARE[1]) & (light.sun_altitude_deg > 0)
    return np.where(shows_sky, np.minimum(share, 1.0) * light.direct_lx, 0.0)
