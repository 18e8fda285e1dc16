"""A facade opposite, found in the pictures of a window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_captures import ROOM, SEATTLE, room_captures
from scipy.ndimage import gaussian_filter

from fieldlum.light import Light
from fieldlum.models.data import Dataset
from fieldlum.scene.view import look, pixel_rays
from fieldlum.scene_fit.exterior import is_outside
from fieldlum.scene_fit.guess import Bar, Guess, Solid, WindowRect, guess_of
from fieldlum.scene_fit.skyline import facade_seen, with_skyline

HEIGHT = 60
GUESS = guess_of(ROOM)
RISE = 0.25  # of the facade's upper edge, m for each m away


def captures(rise: float, *, from_m: float = -np.inf, clouds: float = 0.0) -> Dataset:
    """Captures with a facade east of `from_m`, for each m away; `rise` is that of its edge.

    clouds: standard deviation of the logarithm of the sky's luminance, alike within 10 degrees.
    """
    pixel, rays = pixel_rays(HEIGHT, 180.0, 1)
    rays = rays[np.argsort(pixel)]
    panes = look(ROOM, HEIGHT, 180.0).sky.ravel() > 0.5
    toward = np.maximum(-rays[:, 1], 1e-6)
    east = rays[:, 0] / toward
    hidden = panes & (rays[:, 2] / toward < rise) & (east > from_m)

    def rest_cdm2(light: Light) -> np.ndarray:
        inside = 0.004 * light.diffuse_lx + 0.001 * light.direct_lx
        facade = 0.05 * light.diffuse_lx + 0.06 * light.direct_lx
        above = np.maximum(rays, (-1.0, -1.0, 0.01))
        sky = 0.88 * light.sky_at(above / np.linalg.norm(above, axis=1, keepdims=True))
        noise = np.random.default_rng(1).normal(0.0, clouds, (len(light), HEIGHT, 2 * HEIGHT))
        smooth = gaussian_filter(noise, (0.0, 3.0, 3.0)) * 10.6  # of standard deviation 1 again
        sky = sky * np.exp(smooth).reshape(len(light), -1)
        seen = np.where(panes, sky, inside[:, None])
        seen = np.where(hidden, facade[:, None], seen)
        return seen.reshape(len(light), HEIGHT, 2 * HEIGHT)

    return room_captures(SEATTLE, ROOM, HEIGHT, rest_cdm2)


def indifferent(guess: Guess) -> float:
    """Return a cost that contradicts nothing."""
    return 1.0


@pytest.mark.analytic
def test_a_facade_is_found_at_its_angle() -> None:
    found = with_skyline(indifferent, captures(RISE), GUESS)
    (facade,) = found.solids
    assert is_outside(found, facade)
    away_m = GUESS.camera_m[1] - facade.high_m[1]
    rise = (facade.high_m[2] - GUESS.camera_m[2]) / away_m
    assert rise == pytest.approx(RISE, abs=0.03)
    assert facade.high_m[0] - facade.low_m[0] > 60.0  # beyond the view on both sides


@pytest.mark.analytic
def test_a_facade_ends_where_the_sky_begins() -> None:
    found = with_skyline(indifferent, captures(RISE, from_m=0.1), GUESS)
    (facade,) = found.solids
    away_m = GUESS.camera_m[1] - facade.high_m[1]
    ends = [(x - GUESS.camera_m[0]) / away_m for x in (facade.low_m[0], facade.high_m[0])]
    assert min(abs(end - 0.1) for end in np.abs(ends)) < 0.08
    assert max(np.abs(ends)) > 2.0


@pytest.mark.analytic
@pytest.mark.parametrize("clouds", [0.0, 0.3, 0.6])
def test_a_free_horizon_gives_no_facade(clouds: float) -> None:
    assert with_skyline(indifferent, captures(0.0, clouds=clouds), GUESS) is GUESS


@pytest.mark.analytic
def test_a_facade_is_found_under_clouds() -> None:
    found = with_skyline(indifferent, captures(RISE, clouds=0.3), GUESS)
    (facade,) = found.solids
    rise = (facade.high_m[2] - GUESS.camera_m[2]) / (GUESS.camera_m[1] - facade.high_m[1])
    assert rise == pytest.approx(RISE, abs=0.05)


@pytest.mark.analytic
@pytest.mark.parametrize(
    "known",
    [
        replace(GUESS, bars=(Bar(0, False, (1.2, 1.55), (0.0, 0.1)),)),
        replace(GUESS, solids=(Solid((0.6, 0.3, 0.0), (2.4, 0.9, 1.7), 0.4),)),
    ],
    ids=["transom at eye height", "cabinet before the window"],
)
def test_what_hides_the_horizon_is_no_facade(known: Guess) -> None:
    assert with_skyline(indifferent, captures(0.0), known) is known


@pytest.mark.analytic
def test_a_facade_does_not_cross_the_view_of_another_wall() -> None:
    """The picture shows nothing of the western window, which may be free."""
    west = WindowRect("west", (1.0, 2.0), (0.9, 2.2), 0.85)
    corner = replace(GUESS, windows=(*GUESS.windows, west))
    seen = facade_seen(captures(RISE), corner, "south")
    assert seen is not None
    found = with_skyline(indifferent, captures(RISE), corner)
    away_m = GUESS.camera_m[1] - found.solids[0].high_m[1]
    assert found.solids[0].low_m[0] == pytest.approx(GUESS.camera_m[0] + seen.ends[0] * away_m)


@pytest.mark.analytic
def test_patches_that_contradict_keep_the_facade_away() -> None:
    def cost(guess: Guess) -> float:
        return 1.0 + 0.1 * len(guess.solids)

    assert with_skyline(cost, captures(RISE), GUESS) is GUESS


@pytest.mark.analytic
def test_something_found_outside_stays_alone() -> None:
    data = captures(RISE)
    once = with_skyline(indifferent, data, GUESS)
    assert with_skyline(indifferent, data, once) is once
    assert replace(once, solids=()) == GUESS
