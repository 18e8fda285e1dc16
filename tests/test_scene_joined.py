"""Searches of other pixels, joined."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scene_captures import ROOM, SEATTLE, room_captures

from fieldlum.records import Window
from fieldlum.scene_fit.evidence import gather
from fieldlum.scene_fit.guess import Bar, Guess, Solid, camera_is_free, guess_of
from fieldlum.scene_fit.joined import joined, mean_guess
from fieldlum.scene_fit.last_search import last_cost
from fieldlum.scene_fit.scene_search import SceneSearch
from fieldlum.scene_fit.stated_room import StatedRoom

BARRED = replace(ROOM, window=(Window("south", 0.6, 3.6, 0.8, 1.9, 0.85, 3, 0.07, 0.0),))
TABLE = Solid((1.0, 2.0, 0.0), (2.0, 3.0, 0.75), 0.4)
TRUE = replace(guess_of(BARRED), solids=(TABLE,))


def moved(guess: Guess, by_m: float) -> Guess:
    """Return the guess with camera, the window's left edge, a bar and the table displaced [m]."""
    window, bar, table = guess.windows[0], guess.bars[0], guess.solids[0]
    window = replace(window, u_m=(window.u_m[0] + by_m, window.u_m[1]))
    bar = replace(bar, span_m=(bar.span_m[0] + by_m, bar.span_m[1] + by_m))
    table = replace(table, low_m=(table.low_m[0] + by_m, *table.low_m[1:]))
    camera = (guess.camera_m[0] + by_m, *guess.camera_m[1:])
    return replace(
        guess,
        camera_m=camera,
        windows=(window,),
        bars=(bar, *guess.bars[1:]),
        solids=(table, *guess.solids[1:]),
    )


def numbers(guess: Guess) -> np.ndarray:
    window, bar, table = guess.windows[0], guess.bars[0], guess.solids[0]
    angles = (guess.north_deg, guess.clock_min, guess.wall_azimuth_deg)
    return np.array([*guess.camera_m, *window.u_m, *bar.span_m, *table.low_m, *angles])


@pytest.mark.property
@given(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05))
def test_errors_of_opposite_sign_cancel(one_m: float, other_m: float) -> None:
    mean = mean_guess(moved(TRUE, one_m), moved(TRUE, other_m))
    expected = moved(TRUE, (one_m + other_m) / 2.0)
    # 1e-9 m: rounding of sums of a few metres is 1e-15 m
    np.testing.assert_allclose(numbers(mean), numbers(expected), atol=1e-9)


@pytest.mark.analytic
def test_an_azimuth_has_its_mean_across_north() -> None:
    one, other = replace(TRUE, wall_azimuth_deg=359.0), replace(TRUE, wall_azimuth_deg=3.0)
    assert mean_guess(one, other).wall_azimuth_deg % 360.0 == pytest.approx(1.0)


@pytest.mark.analytic
def test_an_element_that_only_one_has_stays() -> None:
    """The other's second table is not added, and a table 0.5 m away is another table."""
    away = replace(TABLE, low_m=(1.5, 2.0, 0.0), high_m=(2.5, 3.0, 0.75))
    other = replace(TRUE, solids=(away, away), bars=TRUE.bars[1:])
    mean = mean_guess(TRUE, other)
    assert mean.solids == TRUE.solids
    assert mean.bars == TRUE.bars


@pytest.mark.analytic
def test_a_neighbouring_bar_is_no_partner() -> None:
    """A bar that only one search found lies 20 cm from bars that both found."""
    bars = [Bar(0, True, (at, at + 0.06), (0.1, 0.2)) for at in (1.0, 1.2, 1.4)]
    mean = mean_guess(replace(TRUE, bars=tuple(bars)), replace(TRUE, bars=(bars[0], bars[2])))
    assert mean.bars == tuple(bars)


@pytest.mark.analytic
def test_a_shape_that_only_one_has_is_not_halved() -> None:
    arched = replace(TRUE, windows=(replace(TRUE.windows[0], arch_m=0.4),))
    assert mean_guess(TRUE, arched).windows[0].arch_m == 0.0
    assert mean_guess(arched, TRUE).windows[0].arch_m == 0.4


@pytest.fixture(scope="module")
def search() -> SceneSearch:
    """The state of a search of the room without bars."""
    data = room_captures(SEATTLE, ROOM, 48, lambda light: 0.004 * light.diffuse_lx[:, None, None])
    evidence = gather(data, ROOM, pixels=1000)
    hours = np.arange(len(evidence))
    return SceneSearch(data, evidence, hours[::2], hours[1::2], StatedRoom(ROOM, None, 5.0))


@pytest.mark.analytic
@pytest.mark.slow
def test_a_joined_search_finds_the_edge(search: SceneSearch) -> None:
    """From -3 and +1 cm (mean: -1 cm) it ends within 8 mm, and costs less than its start."""
    true = guess_of(ROOM)
    starts = [moved_edge(true, by_m) for by_m in (-0.03, 0.01)]
    search.relight(starts[0])
    with ThreadPoolExecutor(2) as pool:
        found = joined(search, starts[0], starts[1:], pixels=2000, seed=1, pool=pool)
    assert found.windows[0].u_m[0] == pytest.approx(true.windows[0].u_m[0], abs=0.008)
    cost = last_cost(search, starts[0])  # its light favours the start
    assert cost(found) < cost(starts[0])
    assert len(search.evidence.pixels) == 1000  # the search given to `joined` did not change


@pytest.mark.analytic
@pytest.mark.slow
def test_a_mean_whose_furniture_holds_the_camera_is_not_searched(search: SceneSearch) -> None:
    true = guess_of(ROOM)
    x, y, z = true.camera_m
    # 10 cm and 20 cm of a table's faces apart: only the mean's faces are around the camera
    box = Solid((x - 0.05, y - 0.5, 0.0), (x + 0.5, y + 0.5, z + 0.2), 0.4)
    first = replace(true, solids=(replace(box, low_m=(x + 0.05, y - 0.5, 0.0)),))
    other = replace(true, solids=(replace(box, low_m=(x - 0.17, y - 0.5, 0.0)),))
    assert not camera_is_free(mean_guess(first, other))
    search.relight(first)
    with ThreadPoolExecutor(2) as pool:
        found = joined(search, first, [other], pixels=1000, seed=1, pool=pool)
    assert camera_is_free(found)


def moved_edge(guess: Guess, by_m: float) -> Guess:
    window = guess.windows[0]
    return replace(guess, windows=(replace(window, u_m=(window.u_m[0] + by_m, window.u_m[1])),))
