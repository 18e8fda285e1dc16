"""Compute the sun's disc of every hour: the beam times the mean of the sky view over the disc."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.sky.light import Light
from fieldlum.sky.sky_view.view import SharpView, SkyView
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR
from fieldlum.sky.sun_disc import LEAST_DISC_CDM2, SUN_RADIUS_RAD

DRAWS = 64  # of the pose and the view for an interval: 2.5 % of them is more than one; chosen
_RINGS = (1, 6, 12, 18)  # points of equal area in the disc: at its centre, and on three rings
# A share of the beam below it is shown as no disc; a beam of 100 klx then has 20 lx. Chosen.
LEAST_SHARE = 2e-4
_LEAST_LX = LEAST_DISC_CDM2 * SUN_SOLID_ANGLE_SR  # 68 lx: less is no disc in a picture either


@dataclass(frozen=True, slots=True)
class DiscOfHours:
    """The sun's disc at the lens in n hours, on a plane normal to the sun.

    best_lx [n]; low_lx, high_lx [n]: by the bounds of the sky view, in the stated pose. not_seen
    [n]: True where no lens saw the sun's direction; the illuminances are then 0.
    """

    best_lx: Floats
    low_lx: Floats
    high_lx: Floats
    not_seen: Mask


def disc_of_hours(view: SkyView, light: Light) -> DiscOfHours:
    """Return the disc of the n hours of `light` by the sky view."""
    suns = view.pose.in_pictures(light.shown_sun_direction)
    best, low, high = _over_disc(view.sharp, suns)  # [n] each
    best_lx = np.nan_to_num(best) * light.direct_lx
    return DiscOfHours(
        np.where(best_lx < _LEAST_LX, 0.0, best_lx),
        np.nan_to_num(low) * light.direct_lx,
        np.nan_to_num(high) * light.direct_lx,
        np.isnan(best) & (light.direct_lx > 0.0),
    )


def drawn_shares(
    view: SkyView, light: Light, rng: np.random.Generator, count: int = DRAWS
) -> Floats:
    """Return the disc's share of the beam in draws of the pose and of the view, [count, n].

    A draw has one pose and one place within the bounds of the view for all hours. It is NaN in
    directions that no lens saw.
    """
    poses = view.pose.drawn(rng, count)
    # Spread evenly, so that few draws reach both bounds; the bounds hold 95 %.
    places = np.clip((rng.permutation(count) + 0.5 - 0.5 * count) / (0.475 * count), -1.0, 1.0)
    drawn = np.zeros((count, len(light)))
    rows = np.flatnonzero(light.direct_lx > 0.0)
    suns = light.shown_sun_direction[rows]
    for k, (values, place) in enumerate(zip(poses, places, strict=True)):
        best, low, high = _over_disc(view.sharp, view.pose.in_pictures(suns, values))
        drawn[k, rows] = best + abs(place) * ((high if place > 0.0 else low) - best)
    return drawn


def _over_disc(sharp: SharpView, suns: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the means of best, low and high over the disc, [n] each; NaN if it is not seen."""
    points = disc_points(suns)  # [n, 37, 3]
    means = []
    for values in sharp.at(points):
        share = np.nan_to_num(values).mean(axis=1)
        share = np.where(share < LEAST_SHARE, 0.0, share)
        means.append(np.where(np.isnan(values).mean(axis=1) > 0.5, np.nan, share))
    return means[0], means[1], means[2]


def disc_points(suns: Floats) -> Floats:
    """Return unit vectors to 37 points of equal area in the sun's disc, [n, 37, 3]."""
    side = np.cross(suns, (0.0, 0.0, 1.0))
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    other = np.cross(suns, side)
    offsets = [np.zeros((1, 2))]
    total, inner = sum(_RINGS), 1
    for number in _RINGS[1:]:
        radius = SUN_RADIUS_RAD * np.sqrt((inner + 0.5 * number) / total)
        angle = (np.arange(number) + 0.5) * 2.0 * np.pi / number
        offsets.append(radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        inner += number
    x, y = np.concatenate(offsets).T  # [37] each
    points = suns[:, None] + x[:, None] * side[:, None] + y[:, None] * other[:, None]
    return points / np.linalg.norm(points, axis=-1, keepdims=True)
