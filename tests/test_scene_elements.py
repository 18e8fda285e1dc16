"""What is outside a window, bars, and furniture: proposals and their acceptance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_scene_search import HEIGHT, ROOM, captures

from fieldlum.core.records import Obstruction, Room
from fieldlum.room.fit.evidence import PIXELS, scene_evidence, skyline_of
from fieldlum.room.fit.fit import SceneSearch
from fieldlum.room.fit.guess import Bar, Guess, guess_of, is_outside, is_possible
from fieldlum.room.fit.proposals import BARS, FURNITURE, KINDS, SHADES, Kind, with_box_outside
from fieldlum.room.fit.renderer import sky_openness
from fieldlum.room.fit.search import PRIOR_HOURS, PRIOR_SHARE, prior_unit
from fieldlum.sky.sky_view.picture import SkyGrid
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.sky.sun import OBLIQUITY_DEG, celestial_pole

HIDDEN_ELEVATION_DEG = 22.0


def _search(room: Room, height: int = HEIGHT, pixels: int = 1500) -> SceneSearch:
    """Return a search of captures of `room`, which the user states as ROOM."""
    data = captures(room, height=height)
    data = replace(data, setup=replace(data.setup, room=ROOM))
    return SceneSearch(data, ROOM, None, 5.0, pixels)


def _one(kind: Kind, *obstruction: Obstruction) -> tuple[SceneSearch, Guess]:
    """Return a search of ROOM with obstructions, and its scene with elements of a kind."""
    search = _search(replace(ROOM, obstruction=obstruction))
    search.accept(search._with_more((kind,)))
    search._search_all()
    return search, search.guess


@pytest.mark.slow
@pytest.mark.analytic
def test_a_facade_opposite_is_found_by_the_suns_that_it_hides() -> None:
    middle = float(np.mean(guess_of(ROOM).windows[0].z_m))
    top = middle + 10.0 * np.tan(np.radians(HIDDEN_ELEVATION_DEG))
    search, shaded = _one(SHADES, Obstruction(-30.0, -12.0, 0.0, 60.0, 2.0, top))
    assert search.cost()(shaded) < 0.6 * search.cost()(search.start)
    (solid,) = shaded.solids
    rise = solid.high_m[2] - float(np.mean(shaded.windows[0].z_m))
    elevation_deg = float(np.degrees(np.arctan2(rise, -solid.high_m[1])))
    assert elevation_deg == pytest.approx(HIDDEN_ELEVATION_DEG, abs=3.0)


@pytest.mark.slow
@pytest.mark.analytic
def test_a_building_is_found_between_suns_that_pass_it() -> None:
    """It hides the noon of December, and no other hour; a facade as wide as a wall hides more."""
    search, shaded = _one(SHADES, Obstruction(-1.5, -26.0, 0.0, 8.0, 6.0, 9.0))
    assert search.cost()(shaded) < 0.6 * search.cost()(search.start)


def _sky_view(guess: Guess, step_deg: float = 1.0) -> SkyView:
    """Return the sky as the camera of a guess sees it."""
    grid = SkyGrid(
        first_altitude_deg=90.0,
        first_azimuth_deg=-180.0,
        step_deg=step_deg,
        heading_deg=180.0,
        height=round(90.0 / step_deg),
        width=round(360.0 / step_deg),
    )
    rays = grid.rays().reshape(-1, 3).astype(np.float32)
    openness = sky_openness(guess, rays, 0.0).reshape(grid.height, grid.width)
    full = np.ones_like(openness)
    return SkyView(grid, openness, 0.0 * full, full, full, openness, openness)


@pytest.mark.analytic
def test_the_sky_beside_a_building_bounds_it() -> None:
    """No capture needs to have the sun there: too wide, narrow, high or low a building costs."""
    start = guess_of(ROOM)
    (rect,) = start.windows

    def built(half_m: float, top_m: float) -> Guess:
        middle = float(np.mean(rect.u_m))
        along = (middle - half_m, middle + half_m)
        return with_box_outside(start, rect, along, (8.0, 12.0), (0.0, top_m))

    true = built(2.0, 4.0)
    skyline = skyline_of(_sky_view(true), start, 47.6)
    costs = [(skyline.error(g) ** 2).sum() for g in (true, built(40.0, 4.0), built(1.0, 4.0))]
    costs += [(skyline.error(g) ** 2).sum() for g in (built(2.0, 5.0), built(2.0, 3.0), start)]
    assert costs[0] < 0.2 * min(costs[1:])
    assert len(skyline_of(None, start, 47.6).rays) == 0


@pytest.mark.analytic
def test_a_stated_bar_does_not_hang() -> None:
    """What the user has stated above open sky does not hide buildings behind it."""
    start = guess_of(ROOM)
    (rect,) = start.windows
    middle = float(np.mean(rect.z_m))
    bar = Bar(0, False, (middle - 0.1, middle + 0.1), (0.0, 0.05))
    barred = replace(start, bars=(bar,))
    tower = with_box_outside(barred, rect, (2.0, 3.0), (8.0, 12.0), (0.0, 9.0))
    shut = [(skyline_of(_sky_view(tower), g, 47.6).openness < 0.1).sum() for g in (barred, start)]
    assert shut[0] > 2 * shut[1]


@pytest.mark.analytic
def test_directions_without_sun_are_not_examined_and_build_nothing() -> None:
    """A merged session has openness 0 there, whatever the camera sees (merge's `sun_tiles`)."""
    start = guess_of(ROOM)
    view = _sky_view(start)
    declination = np.arcsin(view.grid.rays() @ celestial_pole(47.6))
    passes = np.abs(declination) < np.radians(OBLIQUITY_DEG + 3.0)
    openness, pane = (np.where(passes, x, 0.0) for x in (view.openness, view.transmittance))
    skyline = skyline_of(replace(view, openness=openness, transmittance=pane), start, 47.6)
    assert len(skyline.rays) > 50
    assert (skyline.error(start) ** 2).sum() < 1e-5


@pytest.mark.slow
@pytest.mark.analytic
def test_a_screen_in_the_room_is_no_building() -> None:
    """A monitor before the camera hides sky, and no sun of any capture."""
    monitor = Obstruction(2.1, 1.9, 1.1, 0.6, 0.05, 0.5)
    data = captures(ROOM)
    view = _sky_view(guess_of(replace(ROOM, obstruction=(monitor,))))
    search = SceneSearch(replace(data, sky_view=view), ROOM, None, 5.0, 1500)
    search.accept(search._with_more((SHADES,)))
    assert not search.guess.solids


@pytest.mark.analytic
def test_what_hangs_is_no_building() -> None:
    """Behind a half-closed blind a building may have any height; open sky still excludes it."""
    start = guess_of(ROOM)
    (rect,) = start.windows
    low, high = rect.z_m
    middle = (low + high) / 2.0
    blind = with_box_outside(start, rect, (-1.0, 9.0), (0.1, 0.15), (middle, high))
    skyline = skyline_of(_sky_view(blind), start, 47.6)
    assert len(skyline.rays) > 50 and (skyline.openness > 0.5).all()
    eye_m = start.camera_m[2]
    top = np.degrees(np.arcsin(skyline.rays[:, 2].max()))
    assert top < np.degrees(np.arctan2(middle - eye_m, start.camera_m[1])) + 1.0


@pytest.mark.analytic
def test_a_patch_brighter_than_the_capture_does_not_change_the_light_below() -> None:
    data = captures(ROOM)
    evidence = scene_evidence(data, ROOM, pixels=300)
    false = np.zeros_like(evidence.below)
    false[4] = 3.0 * np.exp(evidence.log_seen[4])
    np.testing.assert_array_equal(evidence.relit(data, false).below, evidence.below)


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("kind", [SHADES, BARS], ids=["shade", "bars"])
def test_what_is_not_there_is_not_found(kind: Kind) -> None:
    search = _search(ROOM)
    search.run(lambda *_: None, ())  # the numbers alone
    assert search._with_more((kind,)) is search.guess


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize(
    "solid",
    [
        Obstruction(0.6, 1.3, 0.7, 1.4, 0.8, 0.05, 0.4),  # a table
        Obstruction(3.4, 1.0, 0.0, 0.8, 0.8, 0.4, 0.5),  # a chest
        Obstruction(0.0, 1.4, 0.0, 0.4, 1.8, 2.0, 0.5),  # a cabinet at the west wall
    ],
    ids=["table", "chest", "cabinet"],
)
def test_furniture_is_found_where_it_is(solid: Obstruction) -> None:
    _, guess = _one(FURNITURE, solid)
    found = guess.solids[0]  # of the largest gain; a second box may follow its shape
    low = (solid.x_m, solid.y_m)
    high = (solid.x_m + solid.width_m, solid.y_m + solid.depth_m, solid.z_m + solid.height_m)
    # pixels are 2.8 degrees wide: 0.15 m at the distance of the furniture
    np.testing.assert_allclose(found.low_m[:2], low, atol=0.25)
    np.testing.assert_allclose(found.high_m, high, atol=0.25)


@pytest.mark.slow
@pytest.mark.analytic
def test_an_empty_room_gets_no_furniture() -> None:
    """Pixels of 1.6 degrees; in pixels of 2.8 degrees, edges of patches look like furniture."""
    search = _search(ROOM, 115, PIXELS)
    search.run(lambda *_: None, ())
    assert search._with_more((FURNITURE,)) is search.guess


@pytest.mark.property
@pytest.mark.parametrize("kind", KINDS, ids=[kind.name for kind in KINDS])
def test_proposals_add_one_possible_element(kind: Kind) -> None:
    guess = guess_of(ROOM)
    proposals = list(kind.propose(guess))
    assert len(proposals) > 50
    for trial in proposals:
        assert is_possible(trial)
        assert len(trial.solids) + len(trial.bars) == len(guess.solids) + len(guess.bars) + 1
        if kind is SHADES:
            assert is_outside(trial, trial.solids[-1])
        if kind is FURNITURE:
            solid = trial.solids[-1]
            assert min(solid.low_m) >= 0.0
            assert all(b <= size for b, size in zip(solid.high_m, guess.size_m, strict=True))


@pytest.mark.property
def test_a_shade_stays_outside() -> None:
    moved = list(SHADES.propose(guess_of(ROOM)))[-1]
    rng = np.random.default_rng(3)
    for _ in range(60):
        for parameter in SHADES.parameters(moved):
            moved = parameter.change(moved, float(rng.normal(0.0, 0.5)))
    assert is_outside(moved, moved.solids[0])


@pytest.mark.analytic
def test_stated_values_count_more_with_few_sunny_hours() -> None:
    search = _search(ROOM)
    every = search.evidence
    parts = {name: getattr(every, name)[:6] for name in ("log_seen", "below", "direct_lx", "rows")}
    few = replace(every, **parts, clock=every.clock[:, :6])
    misfit = few.misfit(few.patches(search.start, search.albedo)).mean()
    unit = prior_unit(few, search.start, search.albedo)
    assert unit == pytest.approx(PRIOR_HOURS / 6 * PRIOR_SHARE * misfit)
