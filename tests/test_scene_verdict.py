"""Which geometry the learning uses, and how much its sun patches count."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.progress import shown_by
from fieldlum.core.records import CameraSetup, Room, Site, SiteFile, Window, slot_id
from fieldlum.learn.models import Prediction, load, save
from fieldlum.learn.models.scores import expect_year, light_of_year
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.transport import MAX_SHARE, MeanTransport, fit
from fieldlum.room import scene
from fieldlum.room.fit import stage
from fieldlum.room.fit.apply_scene import with_patches
from fieldlum.room.fit.evidence import scene_evidence
from fieldlum.room.fit.scene_file import Scene
from fieldlum.room.fit.stage import choose_geometry, directions_apart
from fieldlum.room.fit.sunny_hours import direct_on_windows_lx, sunny_hours
from fieldlum.session.site_toml import site_table
from fieldlum.sky import sun
from fieldlum.sky.daylight import Light, light_at

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
    suns, lx = light.apparent_sun_direction, light.direct_lx
    return scene.sun_patches(ROOM, suns, lx, height=HEIGHT, heading_deg=180.0)


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


@cache
def captures() -> Dataset:
    return _captures(((3, 19), (3, 20), (3, 21), (12, 20), (12, 21)))


@pytest.mark.analytic
def test_suns_of_neighbouring_days_are_one_direction() -> None:
    suns = captures().light.sun_direction[:24]  # three days at the equinox, eight hours each
    assert directions_apart(suns) == 8


@pytest.mark.analytic
def test_a_dense_series_has_as_many_directions_as_a_sparse_one() -> None:
    """Suns of ten-minute steps, each near the next, were counted as one direction."""
    turn = np.radians(np.arange(0.0, 90.5, 2.5))
    suns = np.stack([np.cos(turn), np.sin(turn), 0.0 * turn], 1)
    assert directions_apart(suns[::4]) == directions_apart(suns) == 10
    assert directions_apart(suns[:0]) == 0


def _under(dni_wm2: np.ndarray) -> Dataset:
    """Return the captures under other direct irradiance, with suns over 3 degrees."""
    light = captures().light
    up = light.sun_altitude_deg > 3.0
    light = light_at(light.t_utc, SEATTLE, np.where(up, dni_wm2, 0.0), light.dhi_wm2)
    return replace(captures(), light=light)


@pytest.mark.property
def test_the_faint_sun_of_overcast_days_is_no_sunny_hour() -> None:
    """Sunshine is direct irradiance of at least 120 W/m2 (WMO-No. 8)."""
    faint = _under(np.full(len(captures()), 60.0))
    assert direct_on_windows_lx(faint, ROOM).max() > 1000.0
    assert not sunny_hours(faint, ROOM).any()
    with pytest.raises(NotEnoughDataError) as refused:
        scene_evidence(faint, ROOM)
    line = str(refused.value)
    assert line.startswith("0 captures have direct sun of at least 120 W/m² on a window")
    assert "capture clear hours" in line and "\n" not in line
    few = np.full(len(captures()), 60.0)
    few[3:6] = 700.0  # with three hours of sunshine, only these count
    assert (np.flatnonzero(sunny_hours(_under(few), ROOM)) == [3, 4, 5]).all()


@pytest.mark.property
def test_with_sunshine_strong_hours_count_by_their_light_alone() -> None:
    weak = np.where(np.arange(len(captures())) % 2, 100.0, 800.0)
    data = _under(weak)
    onto = direct_on_windows_lx(data, ROOM)
    strong = sunny_hours(data, ROOM)
    assert (strong == (onto > 0.1 * onto.max())).all() and strong[weak < 120.0].any()


def _with_patches_of(data: Dataset, room: Room) -> Dataset:
    setup = replace(data.setup, room=room)
    return with_patches(replace(data, setup=setup))


def _mean(data: Dataset, stated: Room) -> MeanTransport:
    """Return the model of captures whose room is a scene fitted from a stated room."""
    table = site_table(replace(data.setup, room=stated))
    scene = {"chosen": "fitted", "stated": table, "stated_heading_deg": data.heading_deg}
    model = fit(replace(data, scene=scene))
    assert isinstance(model, MeanTransport)
    return model


@pytest.mark.slow
@pytest.mark.analytic
def test_a_wrong_window_has_a_small_share_and_a_larger_expected_error() -> None:
    """A model that has true patches counts them, up to the share that is left to other suns."""
    wrong = _with_patches_of(captures(), SHIFTED)
    shares = [_mean(captures(), SHIFTED).share, _mean(wrong, ROOM).share]
    assert shares[0] == MAX_SHARE > shares[1]
    years = [expect_year(fit(d), d, np.random.default_rng(0)) for d in (captures(), wrong)]
    assert years[0].expected_log10_mse < years[1].expected_log10_mse
    # five days of two seasons: the suns of other seasons are far from all captures
    assert years[0].trusted_share < 0.5


@pytest.mark.property
def test_the_mean_of_two_models_is_no_worse_than_their_mean(tmp_path: Path) -> None:
    data = _with_patches_of(captures(), SHIFTED)
    some = captures().take(np.arange(3, 40, 7))
    patches = _with_patches_of(some, SHIFTED).patch_cdm2
    mean = _mean(data, ROOM)
    save(tmp_path, mean, data)
    back = load(tmp_path)
    assert isinstance(back, MeanTransport) and back.share == mean.share

    def error(made: Prediction) -> float:
        return float((np.log(made.luminance_cdm2 / some.luminance_cdm2) ** 2).mean())

    one = mean.fitted.predict(some.light, patches)
    other = mean.stated.predict(some.light, _patch_of(some.light))
    shown: list[tuple[int, int, str]] = []
    with shown_by(lambda *line: shown.append(line)):
        both = back.predict(some.light, patches)
    assert not shown  # a prediction is a step of other work
    bound = mean.share * error(one) + (1.0 - mean.share) * error(other)
    assert error(both) <= bound
    # half of it by their difference, because where the two differ one of them is wrong
    gap = np.log10(one.luminance_cdm2 / other.luminance_cdm2)
    assert both.log10_sd is not None and other.log10_sd is not None
    part = 0.5 * min(mean.share * (1.0 - mean.share) / (MAX_SHARE * (1.0 - MAX_SHARE)), 1.0)
    assert (both.log10_sd >= part**0.5 * np.abs(gap) * 0.999).all()
    unused = replace(mean, share=0.0).predict(some.light, patches)
    assert unused.expected_mse == pytest.approx(other.expected_mse)
    largest = int(np.argmax((gap**2).mean(axis=(1, 2))))
    assert both.expected_mse[largest] > part * (gap[largest] ** 2).mean() / 2.0


@pytest.mark.analytic
def test_the_year_has_the_captures_skies() -> None:
    times = captures().light.t_utc
    clear = sun.clearsky(times, SEATTLE)
    half = light_at(times, SEATTLE, 0.5 * clear.dni_wm2, 2.0 * clear.dhi_wm2)
    year = light_of_year(replace(captures(), light=half), np.random.default_rng(0))
    here = sun.clearsky(year.t_utc, SEATTLE)
    assert (year.sun_altitude_deg > 0.0).all() and len({t.month for t in year.t_utc}) == 12
    np.testing.assert_allclose(year.dni_wm2, 0.5 * here.dni_wm2, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(year.dhi_wm2, 2.0 * here.dhi_wm2, rtol=1e-6, atol=1e-6)


@pytest.mark.property
def test_the_smallest_misfit_chooses_the_geometry() -> None:
    for chosen in ("none", "stated", "fitted"):
        misfit = {"none": 0.2, "stated": 0.2, "fitted": 0.2, chosen: 0.05}
        assert choose_geometry(misfit)[0] == chosen


@pytest.mark.property
def test_a_scene_that_explains_little_says_so() -> None:
    chosen, reason = choose_geometry({"none": 0.05, "stated": 0.06, "fitted": 0.03})
    assert chosen == "fitted" and "leave 60 %" in reason


def _fit_of(captures: Dataset) -> Scene:
    """A fit whose misfits speak for the fitted scene, which is the true room."""
    misfit = {"none": 0.3, "stated": 0.2, "fitted": 0.1}
    return Scene(
        north_deg=0.0,
        clock_min=0.0,
        room=ROOM,
        chosen="fitted",
        verdict="",
        stated_heading_deg=captures.heading_deg,
        stated_room=SHIFTED,
        hours=20,
        misfit=misfit,
    )


@cache
def stated() -> Dataset:
    setup = replace(captures().setup, room=SHIFTED)
    return replace(captures(), patch_cdm2=None, setup=setup)


@pytest.mark.property
def test_a_scene_with_enough_clear_hours_is_trusted() -> None:
    found = stage.judged_scene(stated(), _fit_of(stated()))
    assert found.chosen == "fitted" and found.trusted and not found.notes


@pytest.mark.property
def test_too_few_directions_of_the_sun_are_not_trusted() -> None:
    one = stated().take([3, 11, 19])  # the same hour of three days
    scene_ = stage.judged_scene(one, _fit_of(captures()))
    assert scene_.chosen == "fitted" and not scene_.trusted
    assert any("directions" in note for note in scene_.notes)


@pytest.mark.property
def test_a_choice_by_few_clear_hours_is_not_trusted() -> None:
    scene_ = stage.judged_scene(stated(), replace(_fit_of(stated()), hours=15))
    assert scene_.chosen == "fitted" and not scene_.trusted
    assert any("until there are 18" in note for note in scene_.notes)
