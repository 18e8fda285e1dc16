"""Bars and solids of a scene, corrected below learned light."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_captures import ROOM, SEATTLE, room_captures

from fieldlum.light import Light
from fieldlum.models.data import Dataset
from fieldlum.records import Obstruction, Room, Window
from fieldlum.scene_fit.evidence import gather
from fieldlum.scene_fit.guess import Bar, Guess, Solid, guess_of, room_of
from fieldlum.scene_fit.last_elements import Elements, scanned_bars
from fieldlum.scene_fit.last_search import last_objective
from fieldlum.scene_fit.learned_light import LearnedCost, learned_light
from fieldlum.scene_fit.open_bodies import body_notes
from fieldlum.scene_fit.scene_search import SceneSearch
from fieldlum.scene_fit.stated_room import StatedRoom

BARRED = replace(ROOM, window=(Window("south", 0.6, 3.6, 0.8, 1.9, 0.85, 3, 0.07, 0.0),))
TRUE = guess_of(BARRED)
# near the ceiling, behind the camera
UNLIT = Obstruction(x_m=0.1, y_m=5.5, z_m=2.6, width_m=0.3, depth_m=0.4, height_m=0.3)
UPRIGHT = [bar for bar in TRUE.bars if bar.upright]  # two of the frame, two between panes


def rest_cdm2(light: Light) -> np.ndarray:
    """What the room shows besides its sun patches, [n, 1, 1]."""
    return (0.004 * light.diffuse_lx + 0.0005 * light.direct_lx)[:, None, None]


@pytest.fixture(scope="module")
def data() -> Dataset:
    """Captures of the room with bars."""
    return room_captures(SEATTLE, BARRED, 48, rest_cdm2)


def search_from(data: Dataset, stated: Room) -> SceneSearch:
    evidence = gather(data, stated, pixels=1500)
    hours = np.arange(len(evidence))
    return SceneSearch(data, evidence, hours[::2], hours[1::2], StatedRoom(stated, None, 5.0))


@pytest.fixture(scope="module")
def search(data: Dataset) -> SceneSearch:
    return search_from(data, ROOM)


def corrected(search: SceneSearch, guess: Guess) -> Guess:
    search.relight(guess)  # without the true albedos, a thin slab on the floor would pay
    objective = last_objective(search)
    light = learned_light(objective, search.data, guess, ROOM)
    return Elements(LearnedCost(objective, light, 0.4), search).corrected(guess, reshape=True)


def middles_m(guess: Guess) -> list[float]:
    return sorted(float(np.mean(bar.span_m)) for bar in guess.bars if bar.upright)


@pytest.mark.analytic
def test_a_missed_bar_is_found(search: SceneSearch) -> None:
    missed = UPRIGHT[2]
    guess = replace(TRUE, bars=tuple(bar for bar in TRUE.bars if bar is not missed))
    found = corrected(search, guess)
    assert middles_m(found) == pytest.approx(middles_m(TRUE), abs=0.015)


@pytest.mark.analytic
def test_elements_of_no_effect_go_and_true_ones_stay(search: SceneSearch) -> None:
    thin = Bar(0, True, (1.5, 1.502), (0.1, 0.12))
    unlit = guess_of(replace(BARRED, obstruction=(UNLIT,))).solids
    guess = replace(TRUE, bars=(*TRUE.bars, thin), solids=unlit)
    found = corrected(search, guess)
    assert found.solids == ()
    assert middles_m(found) == pytest.approx(middles_m(TRUE), abs=0.01)


@pytest.mark.analytic
def test_two_halves_of_a_bar_become_one(search: SceneSearch) -> None:
    whole = UPRIGHT[2]
    low, high = whole.span_m
    middle = (low + high) / 2.0
    halves = [replace(whole, span_m=span) for span in ((low, middle), (middle, high))]
    others = [bar for bar in TRUE.bars if bar is not whole]
    found = corrected(search, replace(TRUE, bars=(*others, *halves)))
    assert middles_m(found) == pytest.approx(middles_m(TRUE), abs=0.01)


@pytest.mark.analytic
def test_a_stated_object_stays(data: Dataset) -> None:
    """An object that the user stated stays even if no capture shows it."""
    search = search_from(data, replace(ROOM, obstruction=(UNLIT,)))
    found = corrected(search, replace(TRUE, solids=search.start.solids))
    assert len(found.solids) == 1


@pytest.mark.analytic
def test_a_square_top_in_place_of_a_round_one_becomes_round() -> None:
    round_top = Solid((1.5, 1.0, 0.69), (2.7, 2.2, 0.74), 0.4, is_round=True)
    room = room_of(replace(TRUE, solids=(round_top,)), BARRED)
    data = room_captures(SEATTLE, room, 48, rest_cdm2)
    search = search_from(data, ROOM)
    square = replace(round_top, low_m=(1.55, 1.1, 0.69), high_m=(2.65, 2.15, 0.74), is_round=False)
    (found,) = corrected(search, replace(TRUE, solids=(square,))).solids
    assert found.is_round
    assert found.low_m == pytest.approx(round_top.low_m, abs=0.03)
    assert found.high_m == pytest.approx(round_top.high_m, abs=0.03)


@pytest.mark.analytic
def test_missed_furniture_is_found() -> None:
    desk = Solid((1.5, 1.0, 0.0), (2.7, 2.2, 0.74), 0.4)
    room = room_of(replace(TRUE, solids=(desk,)), BARRED)
    search = search_from(room_captures(SEATTLE, room, 48, rest_cdm2), ROOM)
    (found,) = corrected(search, TRUE).solids
    assert found.low_m[:2] == pytest.approx(desk.low_m[:2], abs=0.15)  # the sun is behind it
    assert found.high_m == pytest.approx(desk.high_m, abs=0.05)


@pytest.mark.analytic
@pytest.mark.parametrize(
    ("low_m", "costs", "noted"),
    [
        (0.0, (1.0, 1.001), "a body down to the floor"),
        (0.7, (1.0, 0.999), "a top without a body"),
        (0.0, (1.0, 1.01), None),  # captures contradict a top
    ],
)
def test_a_top_that_may_be_a_body_is_stated(
    low_m: float, costs: tuple[float, float], noted: str | None
) -> None:
    desk = Solid((1.5, 1.0, low_m), (2.7, 2.2, 0.74), 0.4)
    guess = replace(TRUE, solids=(desk,))

    def cost(tried: Guess) -> float:
        return costs[0] if tried == guess else costs[1]

    notes = body_notes(cost, guess)
    assert len(notes) == (noted is not None)
    assert all(f"is fitted as {noted}" in note and "up to 0.74 m" in note for note in notes)
    assert body_notes(cost, guess, stated=1) == []
    tall = replace(guess, solids=(replace(desk, high_m=(2.7, 2.2, 1.9)),))
    assert body_notes(cost, tall) == []


@pytest.mark.analytic
def test_a_square_top_stays_square() -> None:
    square = Solid((1.5, 1.0, 0.69), (2.7, 2.2, 0.74), 0.4)
    room = room_of(replace(TRUE, solids=(square,)), BARRED)
    search = search_from(room_captures(SEATTLE, room, 48, rest_cdm2), ROOM)
    (found,) = corrected(search, replace(TRUE, solids=(square,))).solids
    assert not found.is_round


@pytest.mark.property
def test_scanned_bars_are_inside_their_window() -> None:
    (rect,) = TRUE.windows
    bars = scanned_bars(TRUE)
    spans = {True: rect.u_m, False: rect.z_m}
    assert {bar.upright for bar in bars} == {True, False}
    for bar in bars:
        low, high = spans[bar.upright]
        assert low <= bar.span_m[0] < bar.span_m[1] <= high
        assert 0.0 <= bar.depth_m[0] < bar.depth_m[1] <= TRUE.thickness_m
