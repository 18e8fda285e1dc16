"""The room from its own captures: sun discs, a small renderer, what is found and what is not."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Site
from fieldlum.optics.projection import rotation, turned
from fieldlum.sky import sun
from fieldlum.sky.sky_view.measured_discs import MeasuredDiscs, fit_pose, sun_earlier

SEATTLE = Site("office", 47.6, -122.3, "America/Los_Angeles")
TRUE = {"heading": 1.3, "tilt": 0.4, "roll": -0.3, "clock": 0.1, "scale": 0.004}


PRIOR_SD = (5.0, 1.0, 1.0, 0.01, 0.1)


def _measured(
    rng: np.random.Generator, count: int, sigma: float, scale: float = 0.0
) -> MeasuredDiscs:
    """Discs of a camera facing south that is off by TRUE: angles [deg] and recorded times."""
    days = ((3, 20), (6, 21), (12, 21))
    times = [
        datetime(2027, *days[k % 3], 18, tzinfo=UTC) + timedelta(minutes=40.0 * (k // 3))
        for k in range(count)
    ]
    shown = sun.position([t - timedelta(minutes=TRUE["clock"]) for t in times], SEATTLE)
    true = sun.direction(shown.altitude_deg, shown.azimuth_deg)
    turn = rotation(TRUE["heading"], TRUE["tilt"], TRUE["roll"], 180.0)
    camera = true @ turn  # the inverse of a rotation is its transpose
    axis = np.array([0.0, -1.0, 0.0])
    angle = np.arccos(camera @ axis)[:, None]
    side = camera - (camera @ axis)[:, None] * axis
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    wide = angle / (1.0 + scale)
    camera = np.cos(wide) * axis + np.sin(wide) * side
    camera += np.radians(sigma) * rng.standard_normal(camera.shape)
    camera /= np.linalg.norm(camera, axis=1, keepdims=True)
    bent = sun.position(times, SEATTLE)
    altitude = np.degrees(np.arcsin(camera[:, 2])) + bent.apparent_altitude_deg - bent.altitude_deg
    azimuth = np.degrees(np.arctan2(camera[:, 0], camera[:, 1])) % 360.0
    return MeasuredDiscs(altitude, azimuth, np.full(count, sigma), tuple(times))


@pytest.mark.analytic
def test_sun_moves_along_its_path() -> None:
    times = [datetime(2027, 6, 21, 20, tzinfo=UTC) + timedelta(minutes=m) for m in (0.0, -10.0)]
    place = sun.position(times, SEATTLE)
    now, before = sun.direction(place.altitude_deg, place.azimuth_deg)
    off = np.degrees(np.arccos(sun_earlier(now[None], 10.0, 47.6)[0] @ before))
    assert off < 0.005


@pytest.mark.analytic
def test_turns_have_the_signs_of_their_names() -> None:
    south = np.array([0.0, -1.0, 0.0])
    west = np.array([-1.0, 0.0, 0.0])
    assert turned(south, 90.0) == pytest.approx(west, abs=1e-12)
    assert rotation(90.0, 0.0, 0.0, 180.0) @ south == pytest.approx(west, abs=1e-12)
    assert (rotation(0.0, 10.0, 0.0, 180.0) @ south)[2] > 0.0
    assert (rotation(0.0, 0.0, 10.0, 180.0) @ west)[2] < 0.0  # west is right of south


@pytest.mark.slow
@pytest.mark.analytic
def test_discs_give_north_level_and_clock_to_a_twentieth_of_a_degree() -> None:
    rng = np.random.default_rng(1)
    pose = fit_pose(_measured(rng, 12, 0.03, TRUE["scale"]), SEATTLE, 180.0, PRIOR_SD)
    assert pose["heading_deg"] == pytest.approx(TRUE["heading"], abs=0.05)
    assert pose["tilt_deg"] == pytest.approx(TRUE["tilt"], abs=0.05)
    assert pose["roll_deg"] == pytest.approx(TRUE["roll"], abs=0.05)
    assert pose["clock_min"] == pytest.approx(TRUE["clock"], abs=0.2)
    assert pose["lens_scale"] == pytest.approx(TRUE["scale"], abs=0.002)
    assert pose.u["heading_deg"] < 0.05 and not pose.dropped


@pytest.mark.slow
@pytest.mark.analytic
def test_a_known_level_gives_the_clock() -> None:
    rng, prior = np.random.default_rng(1), (5.0, 1.0, 0.02, 0.01, 10.0)
    pose = fit_pose(_measured(rng, 12, 0.03), SEATTLE, 180.0, prior)
    # The true roll of -0.3 degrees is taken for 0: the clock and north follow it.
    assert pose.u["clock_min"] < 0.3
    assert pose["clock_min"] == pytest.approx(TRUE["clock"] - 0.3 / 0.168, abs=0.3)


@pytest.mark.slow
@pytest.mark.analytic
def test_a_free_clock_and_a_free_level_are_one_uncertainty() -> None:
    prior = (5.0, 1.0, 1.0, 0.01, 5.0)
    pose = fit_pose(_measured(np.random.default_rng(1), 12, 0.03), SEATTLE, 180.0, prior)
    together = pose.covariance[2, 4] / (pose.u["roll_deg"] * pose.u["clock_min"])
    assert abs(together) > 0.98 and pose.u["roll_deg"] > 0.5
    assert abs(pose["heading_deg"] - TRUE["heading"]) < 2.0 * pose.u["heading_deg"]


@pytest.mark.slow
@pytest.mark.analytic
def test_uncertainties_of_the_discs_cover_the_truth() -> None:
    names = ("heading_deg", "tilt_deg", "roll_deg", "clock_min")
    inside = []
    for seed in range(20):
        pose = fit_pose(_measured(np.random.default_rng(seed), 8, 0.05), SEATTLE, 180.0, PRIOR_SD)
        inside += [abs(pose[n] - TRUE[n.split("_")[0]]) <= 1.96 * pose.u[n] for n in names]
    assert np.mean(inside) >= 0.9


@pytest.mark.slow
@pytest.mark.analytic
def test_one_reflection_among_the_discs_is_left_out() -> None:
    discs = _measured(np.random.default_rng(2), 7, 0.03)
    discs.azimuth_deg[3] += 2.5
    pose = fit_pose(discs, SEATTLE, 180.0, PRIOR_SD)
    assert pose.dropped == (3,)
    assert pose["heading_deg"] == pytest.approx(TRUE["heading"], abs=0.1)


@pytest.mark.contract
def test_two_discs_are_too_few() -> None:
    discs = _measured(np.random.default_rng(4), 2, 0.03)
    with pytest.raises(NotEnoughDataError, match="2 measured sun discs"):
        fit_pose(discs, SEATTLE, 180.0, PRIOR_SD)
