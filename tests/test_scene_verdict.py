"""Which geometry the learning uses: sun directions left out together, and the choice."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from numpy.typing import NDArray

from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import CameraSetup, Room, Site, SiteFile, Window, slot_id
from fieldlum.learn.models import Patch
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.scores import light_of_year
from fieldlum.learn.transport import Transport, fit
from fieldlum.room import scene
from fieldlum.room.fit import stage
from fieldlum.room.fit.apply import with_patches
from fieldlum.room.fit.evidence import gather
from fieldlum.room.fit.fit import Misfits, SceneFit
from fieldlum.room.fit.guess import guess_of
from fieldlum.room.fit.parameters import stated_albedo
from fieldlum.room.fit.sunny import direct_on_windows_lx, sunny_hours
from fieldlum.room.fit.verdict import (
    GeometryCandidate,
    GeometryScore,
    SceneVerdict,
    choose_geometry,
    judge,
    outside_hours,
    sun_blocks,
)
from fieldlum.sky import sun
from fieldlum.sky.light import Light, light_at

SEATTLE = Site("office", 47.6, -122.3, "America/Los_Angeles")
ROOM = Room(
    width_m=4.0,
    depth_m=5.0,
    height_m=3.0,
    camera_x_m=2.0,
    camera_y_m=3.0,
    camera_z_m=1.5,
    window=(Window("south", 1.0, 2.0, 0.8, 1.8, 0.88, 1, 0.0),),
)
SHIFTED = replace(ROOM, window=(replace(ROOM.window[0], left_m=1.6, sill_m=0.4),))


HEIGHT = 12


def _patch_of(light: Light) -> NDArray[np.float32]:
    suns, lx = light.shown_sun_direction, light.direct_lx
    return scene.sun_patches(ROOM, suns, lx, height=HEIGHT, heading_deg=180.0).luminance_cdm2


def _light_in_room(light: Light) -> NDArray[np.float32]:
    """Luminance of a room whose light is the diffuse light outside and its sun patches."""
    base = (0.01 * light.diffuse_lx)[:, None, None] * np.ones((HEIGHT, 2 * HEIGHT))
    return (base + _patch_of(light)).astype(np.float32)


def _captures(days: tuple[tuple[int, int], ...], clear: bool = True) -> Dataset:
    """Captures of the room; clear: with direct sun."""
    times = [
        datetime(2027, *day, 16, 30, tzinfo=UTC) + timedelta(hours=h)
        for day in days
        for h in range(8)
    ]
    place = sun.position(times, SEATTLE)
    up = np.asarray(np.maximum(np.sin(np.radians(place.altitude_deg)), 0.0), float)
    beam = np.where((up > 0.05) & clear, 800.0, 0.0)
    light = light_at(times, SEATTLE, beam, np.asarray(60.0 + 40.0 * up, np.float64))
    n = len(times)
    return Dataset(
        light,
        _light_in_room(light),
        _patch_of(light),
        np.zeros(n),
        180.0,
        np.array([sun.standard_date(t, SEATTLE.timezone) for t in times], "datetime64[D]"),
        tuple(map(slot_id, times)),
        SiteFile(SEATTLE, CameraSetup(heading_deg=180.0), ROOM),
        np.ones((HEIGHT, 2 * HEIGHT), bool),
        np.zeros(n),
    )


def _fit(data: Dataset, mode: Patch) -> Transport:
    return fit(data, patch=mode)


CAPTURES = _captures(((3, 19), (3, 20), (3, 21), (12, 20), (12, 21)))


@pytest.mark.analytic
def test_suns_of_neighbouring_days_are_one_block() -> None:
    suns = CAPTURES.light.sun_direction
    blocks = sun_blocks(suns[:24])  # three days at the equinox, eight hours each
    assert (blocks[:8] == blocks[8:16]).all() and len(np.unique(blocks)) == 8


@pytest.mark.property
def test_no_sunny_hour_outside_the_search_has_a_neighbour_inside() -> None:
    outside = outside_hours(CAPTURES, ROOM)
    sunny = np.flatnonzero(sunny_hours(CAPTURES, ROOM))
    blocks = sun_blocks(CAPTURES.light.sun_direction[sunny])
    for block in np.unique(blocks):
        assert len(np.unique(outside[sunny[blocks == block]])) == 1
    assert 0.1 < outside[sunny].mean() < 0.6


def _under(dni_wm2: np.ndarray) -> Dataset:
    """Return the captures under other direct irradiance, with suns over 3 degrees."""
    light = CAPTURES.light
    up = light.sun_altitude_deg > 3.0
    light = light_at(light.t_utc, SEATTLE, np.where(up, dni_wm2, 0.0), light.dhi_wm2)
    return replace(CAPTURES, light=light)


@pytest.mark.property
def test_the_faint_sun_of_overcast_days_is_no_sunny_hour() -> None:
    """Sunshine is direct irradiance of at least 120 W/m2 (WMO-No. 8)."""
    faint = _under(np.full(len(CAPTURES), 60.0))
    assert direct_on_windows_lx(faint, ROOM).max() > 1000.0
    for near_strongest in (False, True):
        assert not sunny_hours(faint, ROOM, near_strongest=near_strongest).any()
    with pytest.raises(NotEnoughDataError) as refused:
        gather(faint, ROOM)
    line = str(refused.value)
    assert line.startswith("0 captures have direct sun of at least 120 W/m² on a window")
    assert "capture clear hours" in line and "\n" not in line
    few = np.full(len(CAPTURES), 60.0)
    few[3:6] = 700.0  # with three hours of sunshine, only these count
    assert (np.flatnonzero(sunny_hours(_under(few), ROOM, near_strongest=True)) == [3, 4, 5]).all()


@pytest.mark.property
def test_with_sunshine_strong_hours_count_by_their_light_alone() -> None:
    weak = np.where(np.arange(len(CAPTURES)) % 2, 100.0, 800.0)
    data = _under(weak)
    onto = direct_on_windows_lx(data, ROOM)
    near = sunny_hours(data, ROOM, near_strongest=True)
    assert (near == (onto > 0.1 * onto.max())).all() and near[weak < 120.0].any()
    strong = (onto > 1000.0) & (onto > 0.1 * data.light.total_lx)
    assert (sunny_hours(data, ROOM) == strong).all() and strong[weak < 120.0].any()


def _with_patches_of(data: Dataset, room: Room) -> Dataset:
    setup = replace(data.setup, room=room)
    return with_patches(replace(data, setup=setup))


@pytest.mark.slow
@pytest.mark.analytic
def test_true_patches_are_chosen_and_a_wrong_window_is_not() -> None:
    wrong = _with_patches_of(CAPTURES, SHIFTED)
    verdict = judge(
        [
            GeometryCandidate("stated", wrong, 0.3),
            GeometryCandidate("fitted", CAPTURES, 0.01),
        ],
        _fit,
    )
    expected = {s.name: s.expected_log10_mse for s in verdict.scores}
    assert verdict.chosen == "fitted"
    assert verdict.expected_log10_mse == expected["fitted"] < expected["stated"]
    # five days of two seasons: the suns of other seasons are far from all captures
    assert not verdict.trusted and verdict.trusted_share < 0.5


@pytest.mark.analytic
def test_the_year_has_the_captures_skies() -> None:
    times = CAPTURES.light.t_utc
    clear = sun.clearsky(times, SEATTLE)
    half = light_at(times, SEATTLE, 0.5 * clear.dni_wm2, 2.0 * clear.dhi_wm2)
    year = light_of_year(replace(CAPTURES, light=half), np.random.default_rng(0))
    here = sun.clearsky(year.t_utc, SEATTLE)
    assert (year.sun_altitude_deg > 0.0).all() and len({t.month for t in year.t_utc}) == 12
    np.testing.assert_allclose(year.dni_wm2, 0.5 * here.dni_wm2, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(year.dhi_wm2, 2.0 * here.dhi_wm2, rtol=1e-6, atol=1e-6)


@pytest.mark.property
def test_misfits_choose_the_geometry_and_errors_whether_it_is_used() -> None:
    box = [GeometryScore("none", 5e-3, 0.10), GeometryScore("stated", 3e-3, 0.20)]
    assert choose_geometry(box).chosen == "stated"  # the model weighs misplaced patches
    assert choose_geometry([*box, GeometryScore("fitted", 4e-3, 0.04)]).chosen == "fitted"
    assert choose_geometry([*box, GeometryScore("fitted", 2e-3, 0.19)]).chosen == "stated"
    assert choose_geometry([*box, GeometryScore("fitted", 4e-3, 0.16)]).chosen == "stated"
    assert choose_geometry([*box, GeometryScore("fitted", 3e-3, 0.16)]).chosen == "fitted"
    worse = [GeometryScore("none", 5e-3, 0.10), GeometryScore("stated", 6e-3, 0.20)]
    assert choose_geometry(worse).chosen == "none"
    assert choose_geometry([*worse, GeometryScore("fitted", 6e-3, 0.05)]).chosen == "fitted"


@pytest.mark.property
def test_a_scene_that_explains_little_says_so() -> None:
    scores = [GeometryScore("none", 3e-3, 0.05), GeometryScore("fitted", 2e-3, 0.03)]
    verdict = choose_geometry(scores)
    assert verdict.chosen == "fitted" and verdict.trusted
    assert "leave 60 %" in verdict.reason


@pytest.mark.property
def test_a_model_that_trusts_few_hours_is_not_trusted() -> None:
    scores = [GeometryScore("none", 3e-2, 0.05, 0.1), GeometryScore("fitted", 2e-2, 0.01, 0.4)]
    verdict = choose_geometry(scores)
    assert verdict.chosen == "fitted" and not verdict.trusted
    assert verdict.trusted_share == 0.4 and "40 % of a year" in verdict.reason


@pytest.mark.property
def test_a_richer_geometry_must_be_clearly_better() -> None:
    scores = [
        GeometryScore("none", 5.0e-3, 0.1),
        GeometryScore("stated", 4.8e-3, 0.1),
    ]
    assert choose_geometry(scores).chosen == "none"


@pytest.mark.contract
def test_overcast_captures_say_what_is_missing() -> None:
    overcast = _captures(((3, 20),), clear=False)
    with pytest.raises(NotEnoughDataError, match="capture clear hours"):
        judge([GeometryCandidate("none", overcast)], _fit)


def _fit_of(captures: Dataset) -> SceneFit:
    """A fit whose kept-out misfits speak for the fitted scene, which is the true room."""
    hours = np.arange(6)
    misfits = Misfits(0.2 + 0.01 * hours, 0.1 + 0.01 * hours, 0.01 * hours)
    heading_deg = captures.heading_deg
    albedo = stated_albedo(ROOM)
    return SceneFit(SHIFTED, heading_deg, guess_of(ROOM), ROOM, albedo, {}, {}, {}, misfits, 6, ())


@pytest.mark.property
@pytest.mark.parametrize("chosen", ["none", "stated", "fitted"])
def test_the_verdict_reaches_the_scene(chosen: str, monkeypatch: pytest.MonkeyPatch) -> None:
    verdict = SceneVerdict(chosen, 3e-3, chosen == "fitted", f"{chosen}: least error", (), 0.9)
    monkeypatch.setattr(stage, "judge_fit", lambda *_args, **_more: verdict)
    scene_ = stage.judged_scene(CAPTURES, _fit_of(CAPTURES))
    assert scene_.chosen == chosen and scene_.trusted == (chosen == "fitted")
    assert scene_.expected_log10_mse == 3e-3 and scene_.trusted_share == 0.9
    assert scene_.verdict == f"{chosen}: least error"


@pytest.mark.property
def test_too_few_directions_of_the_sun_are_not_trusted() -> None:
    one = CAPTURES.take([3, 11, 19])  # the same hour of three days
    stated = replace(one, patch_cdm2=None, setup=replace(one.setup, room=SHIFTED))
    scene_ = stage.judged_scene(stated, _fit_of(CAPTURES))
    assert scene_.chosen == "fitted" and not scene_.trusted
    assert scene_.expected_log10_mse is None
    assert any("directions" in note for note in scene_.notes)


@pytest.mark.property
def test_a_choice_by_few_clear_hours_is_not_trusted(monkeypatch: pytest.MonkeyPatch) -> None:
    verdict = SceneVerdict("fitted", 3e-3, True, "fitted: least error", ())
    monkeypatch.setattr(stage, "judge_fit", lambda *_args, **_more: verdict)
    many = _fit_of(CAPTURES)
    m = many.misfits
    few = replace(many, hours=15, misfits=Misfits(m.none[:5], m.stated[:5], m.fitted[:5]))
    scene_ = stage.judged_scene(CAPTURES, few)
    assert scene_.chosen == "fitted" and not scene_.trusted
    assert any("until there are 18 clear hours in all" in note for note in scene_.notes)
    # Five held out of twenty-five: six of them need thirty.
    more = stage.judged_scene(CAPTURES, replace(few, hours=25))
    assert any("until there are 30 clear hours in all" in note for note in more.notes)
