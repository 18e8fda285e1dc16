"""North, clock and camera from the captures: found when off, quiet when right, and the doubt
that follows.
"""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from typing import cast

import numpy as np
import pytest
from places import SEATTLE

from fieldlum.core.records import CameraSetup, Room, SiteFile, Window, slot_id
from fieldlum.learn.models import Fitted
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.transport import fit, sun_distance_deg
from fieldlum.room.fit.misplaced_patches import (
    Misplacement,
    misplacement_of,
    warnings_of,
)
from fieldlum.room.scene import sun_patches
from fieldlum.sky import sun
from fieldlum.sky.daylight import light_at

ROOM = Room(
    width_m=5.0,
    depth_m=6.0,
    height_m=3.0,
    camera_x_m=2.5,
    camera_y_m=3.0,
    window=(Window("south", 0.5, 4.0, 0.6, 2.1),),
)
SETUP = SiteFile(SEATTLE, CameraSetup(heading_deg=180.0), ROOM)
HEIGHT = 30


def with_patches(data: Dataset) -> Dataset:
    """Patches for the sun that is believed in."""
    light = data.light
    made = sun_patches(
        ROOM,
        light.apparent_sun_direction,
        light.direct_lx,
        heading_deg=SETUP.camera.heading_deg,
        height=HEIGHT,
    )
    return replace(data, patch_cdm2=made)


@cache
def captured() -> Dataset:
    """Four clear days; walls that follow the light and the patches of the room itself."""
    start = datetime(2027, 1, 1, 17, 0, tzinfo=UTC)
    times = [start + timedelta(days=d, hours=h) for d in (20, 75, 260, 330) for h in range(7)]
    n = len(times)
    light = light_at(times, SEATTLE, np.where(np.arange(n) % 5 == 0, 0.0, 700.0), np.full(n, 120.0))
    light = light[light.sun_altitude_deg > 3.0]
    n = len(light)
    data = Dataset(
        light,
        np.empty((n, HEIGHT, 2 * HEIGHT), np.float32),
        None,
        np.zeros(n),
        180.0,
        np.array([sun.standard_date(t, SEATTLE.timezone) for t in light.t_utc], "datetime64[D]"),
        tuple(slot_id(t) for t in light.t_utc),
        SETUP,
        np.ones((HEIGHT, 2 * HEIGHT), bool),
        np.zeros(n),
    )
    data = with_patches(data)
    assert data.patch_cdm2 is not None
    walls = light.diffuse_lx * 0.01 + light.direct_lx * 0.003 * np.maximum(
        -light.sun_direction[:, 1], 0.0
    )
    return replace(data, luminance_cdm2=(walls[:, None, None] + data.patch_cdm2).astype(np.float32))


def stated_otherwise(turn_deg: float = 0.0, fast_min: float = 0.0) -> Dataset:
    """The captures with north and clock stated wrongly."""
    data = captured()
    light = data.light
    now = sun.position(light.t_utc, SEATTLE)
    then = sun.position([t + timedelta(minutes=fast_min) for t in light.t_utc], SEATTLE)
    other = replace(
        light,
        sun_altitude_deg=light.sun_altitude_deg + then.altitude_deg - now.altitude_deg,
        sun_azimuth_deg=light.sun_azimuth_deg + turn_deg + then.azimuth_deg - now.azimuth_deg,
    )
    return with_patches(replace(data, light=other))


def found_in(data: Dataset) -> Misplacement:
    found = misplacement_of(data, "absolute")
    assert found is not None
    return found


# ---------------------------------------------------------------------------------------------- the
# test of the setting


@pytest.mark.slow
@pytest.mark.analytic
def test_a_right_setting_raises_no_alarm() -> None:
    found = found_in(captured())
    assert not found.off and warnings_of(found) == []


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("turn_deg", [-2.5])
def test_north_is_found(turn_deg: float) -> None:
    """At 6 degrees a pixel, 1.5 degrees of north cannot be told from a window 10 cm aside."""
    found = found_in(stated_otherwise(turn_deg))
    assert list(found.off) == ["north_deg"]
    assert found.off["north_deg"][0] == pytest.approx(turn_deg, abs=0.5)


@pytest.mark.slow
@pytest.mark.analytic
def test_a_clock_is_told_from_north() -> None:
    found = found_in(stated_otherwise(fast_min=15.0))
    assert list(found.off) == ["clock_min"]
    assert found.off["clock_min"][0] == pytest.approx(15.0, abs=2.0)


@pytest.mark.slow
@pytest.mark.contract
def test_nothing_to_test() -> None:
    assert misplacement_of(replace(captured(), patch_cdm2=None), "absolute") is None
    assert misplacement_of(captured(), "none") is None
    dull = captured().take(captured().light.dni_wm2 == 0.0)
    assert misplacement_of(dull, "absolute") is None
    assert misplacement_of(replace(captured(), setup=replace(SETUP, room=None)), "absolute") is None


# ---------------------------------------------------------------------------------------------- the
# doubt


@cache
def fitted() -> Fitted:
    return cast(Fitted, fit(captured()))


@pytest.mark.slow
@pytest.mark.property
def test_a_wrong_north_is_warned_of_and_expected() -> None:
    data = stated_otherwise(2.3)
    (said,) = warnings_of(misplacement_of(data, "absolute"))
    assert said.startswith("WARNING") and "heading_deg and wall_azimuth_deg were 2." in said
    assert "degrees too small" in said and "scene fit" in said
    sunny = data.light.dni_wm2 > 0.0
    wrong, right = (
        fit(of).predict(of.light, of.patch_cdm2).expected_mse[sunny] for of in (data, captured())
    )
    assert wrong.mean() > 2.0 * right.mean()


@pytest.mark.slow
@pytest.mark.property
def test_experience_of_like_suns_raises_the_expectation() -> None:
    model = fit(captured())
    hours, of = model.captured, model.uncertainty
    sunny = hours.beam > 0.3
    wrong = np.where(sunny[of.tested], 20.0, 1.0) * of.guess_of
    of = replace(of, error_of=wrong, careful=False)
    guess, here = np.full(len(hours), 1e-3), np.zeros(len(hours))
    expected = of.expected_mse(hours, hours, guess, here)
    assert (expected[sunny] > 0.015).all() and (expected[hours.beam < 0.01] < 2e-3).all()
    careful = replace(of, careful=True).expected_mse(hours, hours, guess, here)
    assert (careful >= expected).all()


@pytest.mark.slow
@pytest.mark.property
def test_far_from_captured_suns_the_error_of_held_out_seasons_is_expected() -> None:
    model = fit(captured())
    hours, of = model.captured, model.uncertainty
    n = len(hours)
    assert len(of.tested) == 2 * n  # held-out days, then seasons
    of = replace(of, error_of=np.repeat((1e-3, 1e-2), n), careful=True)
    guess, angle = np.full(n, 1e-9), np.full(n, 8.0)
    for distance_deg, share in (
        (0.0 * angle, 0.0),
        (angle, 1.0 - np.exp(-1.0)),
        (1e3 * angle, 1.0),
    ):
        expected = of.expected_mse(hours, hours, guess, distance_deg)
        assert expected == pytest.approx(np.full(n, 10.0 ** (share - 3.0)), rel=1e-6)
    assert sun_distance_deg(hours, hours)[hours.beam > 0.2] == pytest.approx(0.0, abs=1e-3)
    assert (sun_distance_deg(hours, hours[hours.beam < 0.1]) == 180.0).all()


@pytest.mark.contract
@pytest.mark.parametrize("name", ["north_deg", "clock_min", "wall_azimuth_deg"])
def test_every_cause_has_words(name: str) -> None:
    found = Misplacement({name: (1.2, 0.1)}, gain=0.5, hours=40)
    (text,) = warnings_of(found)
    assert text.startswith("WARNING") and "1.2 +- 0.1" in text and "too" in text
    assert warnings_of(replace(found, off={})) == []


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.parametrize("measure", ["camera_x_m", "left_m"])
def test_a_room_wrong_by_a_tape_measure_makes_no_alarm_of_north(measure: str) -> None:
    window = ROOM.window[0]
    wrong = {
        "camera_x_m": replace(ROOM, camera_x_m=ROOM.camera_x_m + 0.15),
        "left_m": replace(ROOM, window=(replace(window, left_m=window.left_m + 0.10),)),
    }[measure]
    data = captured()
    light = data.light
    made = sun_patches(
        wrong,
        light.apparent_sun_direction,
        light.direct_lx,
        heading_deg=SETUP.camera.heading_deg,
        height=HEIGHT,
    )
    told = replace(data, patch_cdm2=made, setup=replace(SETUP, room=wrong))
    found = found_in(told)
    assert not {"north_deg", "clock_min", "wall_azimuth_deg"} & set(found.off)
