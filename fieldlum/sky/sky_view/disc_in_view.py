"""Compute how much of the sun's disc the camera sees in hours without a capture.

The sky view decides it: the camera has looked through the window at the place of the eye. A stated
room is used only in directions that no lens saw, and by models without a sky view.
"""

from __future__ import annotations

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Room, SiteFile
from fieldlum.optics.projection import direction
from fieldlum.sky.light import Light
from fieldlum.sky.sky_view import DRAWS, SkyView, disc_of_hours, drawn_shares

# Standard deviation of the sun's direction relative to the edges of a stated room: a compass to 1
# degree, and 5 cm at an edge 2.5 m away. Chosen from these two.
EDGE_SD_DEG = 1.5
# Relative standard uncertainty of the beam's luminous efficacy for each air mass: Perez's model
# against SPECTRL2 (Bird and Riordan 1986) at aerosol optical depths of 0.05 to 0.35: 5 % at 45
# degrees, 20 % at 6 degrees.
_EFFICACY_U = 0.02
# Largest direct transmittance of a pane: clear single glass (EN 410).
_CLEAR_GLASS = 0.9


def disc_lx(view: SkyView | None, setup: SiteFile, light: Light) -> Floats:
    """Return the illuminance of the sun's disc at the lens, on a plane normal to the sun, [n] lx.

    By the sky view; by the room of `setup` in directions that no lens saw, or without a view. It is
    0 where neither is known. Raises InputError for an impossible room.
    """
    if view is None:
        return room_shares(setup.room, light.shown_sun_direction) * light.direct_lx
    disc = disc_of_hours(view, light)
    if setup.room is None or not disc.not_seen.any():
        return disc.best_lx
    some = light[disc.not_seen]
    best = disc.best_lx.copy()
    best[disc.not_seen] = room_shares(setup.room, some.shown_sun_direction) * some.direct_lx
    return best


def drawn_discs_lx(
    view: SkyView | None,
    setup: SiteFile,
    light: Light,
    rng: np.random.Generator,
    count: int = DRAWS,
) -> Floats:
    """Return the disc's illuminance in `count` random draws of what is uncertain, [count, n] lx.

    The sky view and its pose are drawn. Directions that no lens saw are drawn by the room of
    `setup`, with the sun moved at random by 1.5 degrees; without a room, from 0 to clear glass. The
    beam's luminous efficacy is drawn too.
    """
    shares = (
        np.full((count, len(light)), np.nan)
        if view is None
        else drawn_shares(view, light, rng, count)
    )
    turns = rng.normal(0.0, EDGE_SD_DEG, (count, 2))
    guesses = rng.permutation((np.arange(count) + 0.5) / count) * _CLEAR_GLASS
    open_hours = np.flatnonzero(np.isnan(shares).any(axis=0) & (light.direct_lx > 0.0))
    if len(open_hours):
        some = light[open_hours]
        filled = np.repeat(guesses[:, None], len(some), axis=1)
        if setup.room is not None:
            suns = np.stack([_turned(some, *turn) for turn in turns])  # [count, m, 3]
            filled = room_shares(setup.room, suns.reshape(-1, 3)).reshape(filled.shape)
        part = shares[:, open_hours]
        shares[:, open_hours] = np.where(np.isnan(part), filled, part)
    sine = np.sin(np.radians(np.maximum(light.shown_altitude_deg, 3.0)))
    efficacy = np.exp(rng.normal(0.0, 1.0, (count, 1)) * _EFFICACY_U / sine)
    return np.nan_to_num(shares) * light.direct_lx * efficacy


def disc_source(view: SkyView | None, setup: SiteFile, file: str = "") -> str:
    """Return how the visibility of the sun's disc is known, as predict.json states it.

    file: name of a sky view from elsewhere, or "".
    """
    if view is None:
        if setup.room is None:
            return "unknown: the model has no sky view and its site no [room]; train it again"
        return "the stated room: the model has no sky view; train it again"
    filled = "; the stated room where no lens saw" if setup.room is not None else ""
    unseen = np.isnan(view.openness).any()
    source = f"in {file}" if file else f"of {view.captures} captures"
    return f"the sky view {source}{filled if unseen else ''}"


def _turned(light: Light, azimuth_deg: float, altitude_deg: float) -> Floats:
    altitude = np.minimum(light.shown_altitude_deg + altitude_deg, 90.0)
    # near the zenith a given angle on the sky is a larger change of azimuth
    turn = azimuth_deg / np.maximum(np.cos(np.radians(altitude)), 0.2)
    return direction(altitude, light.sun_azimuth_deg + turn)


def room_shares(room: Room | None, suns: Floats) -> Floats:
    """Return the share of the beam that reaches the camera in a stated room, [m]; 0 without one."""
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
