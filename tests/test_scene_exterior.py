"""What is outside a window, and furniture: proposals and their acceptance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.text import Annotation
from test_scene_search import HEIGHT, ROOM, captures

from fieldlum.core.records import Obstruction, Room
from fieldlum.room.fit.evidence import PIXELS, gather
from fieldlum.room.fit.exterior import (
    exterior_parameters,
    is_outside,
    propose_exterior,
)
from fieldlum.room.fit.furniture import lattice, propose_solids
from fieldlum.room.fit.guess import Guess, Solid, guess_of
from fieldlum.room.fit.pictures import plan_of
from fieldlum.room.fit.scene_search import PRIOR_HOURS, SOLID_GAIN, SceneSearch, pays
from fieldlum.room.fit.search import PRIOR_SHARE
from fieldlum.room.fit.stated_room import StatedRoom

HIDDEN_ELEVATION_DEG = 22.0


def _search(obstruction: tuple[Obstruction, ...]) -> tuple[SceneSearch, Guess]:
    """Return a search of captures of ROOM with obstructions, and the guess without them."""
    return _search_of(replace(ROOM, obstruction=obstruction))


def _search_of(room: Room, height: int = HEIGHT, pixels: int = 1500) -> tuple[SceneSearch, Guess]:
    """Return a search of captures of `room`, which the user states as ROOM, and ROOM as a guess."""
    data = captures(room, height=height)
    data = replace(data, setup=replace(data.setup, room=ROOM))
    evidence = gather(data, ROOM, pixels=pixels)
    number = np.arange(len(evidence))
    out = number % 3 == 2
    stated = StatedRoom(ROOM, None, 5.0)
    return SceneSearch(data, evidence, number[~out], number[out], stated), guess_of(ROOM)


def _elevation_deg(guess: Guess) -> float:
    """Elevation of the only facade's upper edge, seen from the middle of the window."""
    (solid,) = guess.solids
    rise = solid.high_m[2] - float(np.mean(guess.windows[0].z_m))
    return float(np.degrees(np.arctan2(rise, -solid.high_m[1])))


@pytest.mark.slow
@pytest.mark.analytic
def test_a_facade_opposite_is_found_by_the_suns_that_it_hides() -> None:
    top = float(np.mean(guess_of(ROOM).windows[0].z_m)) + 10.0 * np.tan(
        np.radians(HIDDEN_ELEVATION_DEG)
    )
    facade = Obstruction(-30.0, -12.0, 0.0, 60.0, 2.0, top)
    search, start = _search((facade,))
    cost = search.objective(search.evidence)
    shaded = search.outside(start)
    assert cost(shaded) < 0.6 * cost(start)
    assert _elevation_deg(shaded) == pytest.approx(HIDDEN_ELEVATION_DEG, abs=3.0)


@pytest.mark.slow
@pytest.mark.analytic
def test_a_room_without_a_shade_gets_none() -> None:
    search, start = _search(())
    assert search.outside(start) == start


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize(
    "solid",
    [
        Obstruction(0.6, 1.3, 0.7, 1.4, 0.8, 0.05, 0.4),  # a table
        Obstruction(0.7, 1.2, 0.4, 1.1, 0.6, 0.05, 0.4),  # a low one
        Obstruction(0.6, 1.1, 0.55, 1.2, 0.8, 0.05, 0.5),
        Obstruction(3.4, 1.0, 0.0, 0.8, 0.8, 0.4, 0.5),  # a chest
        Obstruction(0.0, 1.4, 0.0, 0.4, 1.8, 2.0, 0.5),  # a cabinet at the west wall
    ],
    ids=["table", "low table", "table of unusual height", "chest", "cabinet"],
)
def test_furniture_is_found_where_it_is(solid: Obstruction) -> None:
    search, start = _search((solid,))
    search.relight(start)
    (found,) = search.furniture(start).solids
    low = (solid.x_m, solid.y_m)
    high = (solid.x_m + solid.width_m, solid.y_m + solid.depth_m, solid.z_m + solid.height_m)
    # pixels are 2.8 degrees wide: 0.15 m at the distance of the furniture
    np.testing.assert_allclose(found.low_m[:2], low, atol=0.25)
    np.testing.assert_allclose(found.high_m, high, atol=0.25)


@pytest.mark.slow
@pytest.mark.analytic
def test_a_bookcase_of_another_size_than_the_proposals_is_no_strip() -> None:
    search, start = _search((Obstruction(4.7, 1.0, 0.0, 0.3, 2.4, 1.8, 0.3),))
    search.relight(start)
    (found,) = search.furniture(start).solids
    # the sun reaches neither its top nor its end near the window
    assert found.low_m[0] == pytest.approx(4.7, abs=0.03)
    assert found.high_m[1] == pytest.approx(3.4, abs=0.1)
    assert found.high_m[1] - found.low_m[1] > 2.0


@pytest.mark.slow
@pytest.mark.analytic
def test_an_empty_room_gets_no_furniture() -> None:
    """Pixels of 0.8 degrees; in pixels of 2.8 degrees, edges of patches look like furniture."""
    search, start = _search_of(ROOM, 230, PIXELS)
    search.relight(start)
    assert search.furniture(start) is start


@pytest.mark.analytic
@pytest.mark.parametrize(
    ("gain", "kept_out_gain", "stays"),
    [
        (0.012, 0.002, True),
        (0.012, 0.0, False),  # only the searched hours want it
        (0.008, 0.1, False),
        (0.03, 0.0, True),  # no held-out hour sees it
        (0.03, -0.01, False),  # held-out hours contradict
    ],
)
def test_an_element_stays_if_held_out_hours_agree(
    gain: float, kept_out_gain: float, stays: bool
) -> None:
    assert pays(gain, kept_out_gain, SOLID_GAIN) is stays


@pytest.mark.analytic
@pytest.mark.parametrize(
    ("azimuth_deg", "right", "up"), [(180.0, 0, 1), (90.0, 1, 0), (0.0, 0, -1)]
)
def test_the_plan_shows_north(azimuth_deg: float, right: int, up: int) -> None:
    """A wall that faces south is at the bottom, so that north is up."""
    room = replace(ROOM, wall_azimuth_deg=azimuth_deg)
    figure = plan_of(guess_of(room), room)
    (label,) = (text for text in figure.axes[0].texts if text.get_text() == "N")
    assert isinstance(label, Annotation)
    camera = np.array(guess_of(room).camera_m[:2])
    away = np.array(label.get_position()) - camera
    np.testing.assert_allclose(away / np.linalg.norm(away), (right, up), atol=1e-9)
    assert label.xy == pytest.approx(camera)
    figure.canvas.draw()
    assert label.arrow_patch is not None
    drawn = np.asarray(label.arrow_patch.get_path().vertices, float)
    along = drawn[0] - drawn[2] if np.ptp(drawn[:3], axis=0).any() else drawn[-1] - drawn[0]
    np.testing.assert_allclose(
        np.abs(along / np.linalg.norm(along)), np.abs((right, up)), atol=0.01
    )


@pytest.mark.analytic
def test_the_plan_states_what_is_too_far_to_draw() -> None:
    facade = Solid((-30.0, -14.0, 0.0), (30.0, -12.0, 3.1), 0.4)
    figure = plan_of(replace(guess_of(ROOM), solids=(facade,)), ROOM)
    assert "outside: 3.1 m high, 12 m from the south wall" in figure.axes[0].get_title()


@pytest.mark.property
def test_usual_furniture_is_in_the_room_and_not_around_the_camera() -> None:
    guess = guess_of(ROOM)
    solids = lattice(guess)
    assert len(solids) > 500
    for solid in solids:
        assert min(solid.low_m) >= 0.0
        assert all(high <= size for high, size in zip(solid.high_m, guess.size_m, strict=True))
        assert all(h > low for low, h in zip(solid.low_m, solid.high_m, strict=True))
        holds = zip(solid.low_m, guess.camera_m, solid.high_m, strict=True)
        assert not all(low <= at <= high for low, at, high in holds)
    best = propose_solids(guess, lambda g: sum(g.solids[-1].low_m), 1.5)
    assert 1 < len(best) <= 6
    assert all(sum(solid.low_m) < 1.5 for solid in best)


@pytest.mark.property
def test_proposals_are_outside_and_stay_there() -> None:
    guess = guess_of(ROOM)
    rng = np.random.default_rng(3)
    for solid in propose_exterior(guess):
        assert is_outside(guess, solid)
    moved = replace(guess, solids=(propose_exterior(guess)[-1],))
    for _ in range(60):
        for parameter in exterior_parameters(0):
            moved = parameter.change(moved, float(rng.normal(0.0, 0.5)))
    assert is_outside(moved, moved.solids[0])


@pytest.mark.slow
@pytest.mark.analytic
def test_the_room_that_explains_the_captures_best_is_chosen_with_its_own_light() -> None:
    """A room's light below the patches comes from its own patches, not from the room before."""
    search, start = _search(())
    tries: list[Guess] = []

    class _Bare(SceneSearch):
        def box(self, guess: Guess) -> Guess:
            tries.append(guess)
            return guess

        def bars(self, guess: Guess, fine: float = 1.0) -> Guess:
            return guess

    search.__class__ = _Bare
    turned = [replace(start, wall_azimuth_deg=start.wall_azimuth_deg + t) for t in (-2, 0.3, 3)]
    steps: list[int] = []

    def step(done: int, text: str) -> None:
        steps.append(done)

    given = search.evidence, search.albedo
    assert search.best_room(turned, step) == turned[1]
    own = search.evidence.below
    search.evidence, search.albedo = given
    search.relight(turned[1])
    assert np.allclose(own, search.evidence.below, rtol=1e-9)
    assert tries == turned and steps == [10, 25, 40]


@pytest.mark.analytic
def test_stated_values_count_more_with_few_sunny_hours() -> None:
    search, guess = _search(())
    few = search.evidence.hours(np.arange(6))
    number = np.arange(6)
    again = SceneSearch(search.data, few, number[:4], number[4:], search.stated)
    misfit = few.misfit(few.patches(guess, again.albedo)).mean()
    assert again.prior_unit == pytest.approx(PRIOR_HOURS / 6 * PRIOR_SHARE * misfit)
