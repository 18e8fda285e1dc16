"""Direct light on one side of a window is not a turned camera."""

from __future__ import annotations

import numpy as np
import pytest

from fieldlum.learn.models.camera_turns import DirectLight, _poses, turns_by_light

HOURS = 12
# Times a share of 0.7: as in 230 x 115 renderings of a clear equinox day at 70 degrees north.
SHIFT_PX = 0.75


def _light(shares: tuple[float, ...]) -> DirectLight:
    """Days of twelve hours with the sun from east to west, each with its share of direct light."""
    azimuth_deg = np.tile(np.linspace(100.0, 265.0, HOURS), len(shares))
    return DirectLight(np.repeat(shares, HOURS), azimuth_deg, np.repeat(range(len(shares)), HOURS))


def _by_light(light: DirectLight) -> np.ndarray:
    """What a still camera seems to be turned in heading: left in the morning, right later, px."""
    rng = np.random.default_rng(0)
    afternoon = np.exp(-(((light.azimuth_deg - 230.0) / 25.0) ** 2))
    angles = rng.normal(0.0, 0.02, (len(light.share), 3))
    angles[:, 0] += light.share * (SHIFT_PX * afternoon - 0.1)
    return angles


def _named(angles_px: np.ndarray) -> np.ndarray:
    return _poses(angles_px, np.ones(len(angles_px), bool), 1.0)


@pytest.mark.property
def test_a_still_camera_in_direct_light_is_not_turned() -> None:
    light = _light((0.7, 0.0, 0.6))
    seeming = _by_light(light)
    assert _named(seeming).any()  # without the light, a turn would be reported
    assert not _named(seeming - turns_by_light(seeming, light)).any()


@pytest.mark.property
@pytest.mark.parametrize(
    ("first", "last"),
    [(12, 24), (24, 36), (0, 12), (17, 24)],
    ids=["overcast day", "clear day", "first day", "half a day"],
)
def test_a_turned_camera_is_still_found(first: int, last: int) -> None:
    light = _light((0.7, 0.0, 0.6, 0.7, 0.5))
    angles = _by_light(light)
    angles[first:last, 0] += 0.6
    found = _named(angles - turns_by_light(angles, light))[:, 0]
    turned = np.zeros(len(found), bool)
    turned[first:last] = True
    assert ((found > 0.0) == turned).mean() > 0.95
    assert np.median(found[turned]) == pytest.approx(0.6, abs=0.1)


@pytest.mark.property
def test_two_days_explain_nothing_and_a_turn_of_one_day_is_not_of_the_light() -> None:
    light = _light((0.7, 0.6))
    assert not turns_by_light(_by_light(light), light).any()
    calm = _light((0.7, 0.6, 0.7))
    knocked = np.random.default_rng(1).normal(0.0, 0.02, (36, 3))
    knocked[6:12] += 0.4
    assert np.abs(turns_by_light(knocked, calm)).max() < 0.05
