"""The camera's pose from measured sun discs: what it is, and what few discs leave open."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from learning_room import dataset
from places import SEATTLE

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Panorama
from fieldlum.core.strict_toml import convert
from fieldlum.learn.models.training_data import take_disc_out as take_out_of_map
from fieldlum.merge.sun_and_sky import take_out_disc
from fieldlum.optics.projection import altitude_azimuth_deg, rotation
from fieldlum.sky import sun
from fieldlum.sky.daylight import light_at
from fieldlum.sky.sky_view.estimate_from_captures import Captured, partly_hidden
from fieldlum.sky.sky_view.measured_discs import MeasuredDiscs, scaled, sun_earlier
from fieldlum.sky.sky_view.pose import STATED_SD, CameraPose, open_combination, pose_of_discs
from fieldlum.sky.sun_disc import SUN_RADIUS_RAD, add_source

TIMES = tuple(
    datetime(2027, 3, 20, 17, 30, tzinfo=UTC) + timedelta(hours=1.2 * k) for k in range(6)
)
AXIS_DEG = 180.0
DAY = replace(dataset(("2027-03-20",), height=60).take([0, 1]), patch_cdm2=None)


def measured(values: Floats, count: int, noise_deg: float = 0.0, seed: int = 0) -> MeasuredDiscs:
    """Discs as a camera of this true pose (heading, tilt, roll, lens scale) measures them."""
    at = sun.position(list(TIMES[:count]), SEATTLE)
    suns = sun.direction(at.apparent_altitude_deg, at.azimuth_deg)
    shown = suns @ rotation(*values[:3], AXIS_DEG)
    shown = scaled(shown, 1.0 / (1.0 + values[3]) - 1.0, AXIS_DEG)
    altitude, azimuth = altitude_azimuth_deg(shown)
    noise = np.random.default_rng(seed).normal(0.0, noise_deg, (2, count))
    azimuth = azimuth + noise[1] / np.cos(np.radians(altitude))
    return MeasuredDiscs(altitude + noise[0], azimuth % 360.0, np.full(count, 0.03), TIMES[:count])


@pytest.mark.analytic
def test_six_discs_give_the_pose() -> None:
    values = np.array([5.0, 1.0, -0.6, 0.01])
    pose = pose_of_discs(measured(values, 6), SEATTLE, AXIS_DEG)
    assert pose.discs == 6 and pose.heading_sd_deg < 0.2
    assert np.abs(pose.values - values) == pytest.approx(0.0, abs=0.35)
    assert (np.abs(pose.values - values) < 2.5 * np.sqrt(np.diag(pose.covariance))).all()
    at = sun.position(list(TIMES), SEATTLE)
    suns = sun.direction(at.apparent_altitude_deg, at.azimuth_deg)
    shown = pose.in_pictures(suns)
    names = ("heading_deg", "tilt_deg", "roll_deg", "lens_scale")
    true = CameraPose(**dict(zip(names, values, strict=True)), axis_deg=AXIS_DEG).in_pictures(suns)
    assert np.degrees(np.linalg.norm(shown - true, axis=1)).max() < 0.05
    assert pose.true_directions(shown) == pytest.approx(suns, abs=1e-9)
    assert convert(json.loads(json.dumps(asdict(pose))), CameraPose) == pose


@pytest.mark.analytic
def test_discs_that_an_edge_cuts_do_not_move_the_pose() -> None:
    """A horizontal edge that leaves 8 % of a disc moves its centre down by 0.83 radii."""
    discs, share = measured(np.zeros(4), 6), np.full(6, 0.8)
    share[[1, 3, 5]] *= 0.08
    lowered = discs.altitude_deg - 0.83 * np.degrees(SUN_RADIUS_RAD) * (share < 0.8)
    cut = replace(discs, altitude_deg=lowered)
    light = light_at(list(TIMES), SEATTLE, np.full(6, 700.0), np.full(6, 100.0))
    captured = Captured(light, lambda _: pytest.fail("no picture is needed"), share)
    known = partly_hidden(cut, captured)
    assert known.sigma_deg[::2][:1] == pytest.approx(discs.sigma_deg[:1])
    moved = (cut.altitude_deg - discs.altitude_deg)[[1, 3, 5]]
    assert known.sigma_deg[[1, 3, 5]] == pytest.approx(np.abs(moved), rel=0.1)
    pose, without = (pose_of_discs(d, SEATTLE, AXIS_DEG).values[:3] for d in (known, cut))
    assert np.abs(pose).max() < 0.06 < 0.1 < np.abs(without).max()


@pytest.mark.analytic
def test_a_heading_that_a_scene_corrects_is_not_corrected_twice() -> None:
    at = sun.position(list(TIMES), SEATTLE)
    suns = sun.direction(at.apparent_altitude_deg, at.azimuth_deg)

    def column_deg(pose: CameraPose) -> Floats:
        """Azimuths in the picture, from its axis."""
        return (altitude_azimuth_deg(pose.in_pictures(suns))[1] - pose.axis_deg) % 360.0

    by_discs = pose_of_discs(measured(np.array([5.0, 1.0, -0.6, 0.0]), 6), SEATTLE, AXIS_DEG)
    assert column_deg(by_discs.turned(4.6, 1.0)) == pytest.approx(column_deg(by_discs), abs=0.05)
    stated, corrected = CameraPose(axis_deg=AXIS_DEG), CameraPose(axis_deg=AXIS_DEG + 4.6)
    assert column_deg(stated.turned(4.6, 0.5)) == pytest.approx(column_deg(corrected), abs=0.2)
    assert stated.turned(4.6, 0.5).heading_sd_deg < 0.5


@pytest.mark.analytic
def test_a_clock_that_a_scene_corrects_leaves_captured_discs_in_place() -> None:
    at = sun.position(list(TIMES), SEATTLE)
    suns = sun.direction(at.apparent_altitude_deg, at.azimuth_deg)
    by_discs = pose_of_discs(measured(np.array([2.0, 1.0, -0.6, 0.002]), 6), SEATTLE, AXIS_DEG)
    earlier = sun_earlier(suns, 6.0, SEATTLE.latitude_deg)  # 1.5 degrees about the pole
    shown = by_discs.at_clock(6.0, SEATTLE.latitude_deg).in_pictures(earlier)
    assert shown == pytest.approx(by_discs.in_pictures(suns), abs=1e-9)
    stated = CameraPose(axis_deg=AXIS_DEG)  # knows nothing of the clock
    assert stated.at_clock(6.0, SEATTLE.latitude_deg) == stated


@pytest.mark.slow
@pytest.mark.property
def test_uncertainties_of_drawn_poses_hold() -> None:
    """The squared distance of 60 drawn poses has the mean of chi squared with 4 freedoms."""
    rng, distances = np.random.default_rng(1), []
    for k in range(60):
        values = rng.normal(0.0, 1.0, 4) * STATED_SD
        count = 1 + k % 3
        pose = pose_of_discs(measured(values, count, 0.07, seed=k), SEATTLE, AXIS_DEG)
        if pose.discs:
            off = pose.values - values
            distances.append(off @ np.linalg.solve(np.asarray(pose.covariance), off))
    assert len(distances) > 55
    assert 2.4 < np.mean(distances) < 5.0  # the clock had no error: a little below 4


@pytest.mark.property
def test_one_disc_leaves_a_combination_open() -> None:
    values = np.array([3.0, 0.4, 0.3, 0.0])
    pose = pose_of_discs(measured(values, 1), SEATTLE, AXIS_DEG)
    assert pose.discs == 1 and "leave open" in pose.notes[1]
    at = sun.position(list(TIMES[:1]), SEATTLE)
    suns = sun.direction(at.apparent_altitude_deg, at.azimuth_deg)
    places = [pose.in_pictures(suns, draw)[0] for draw in pose.drawn(np.random.default_rng(0), 200)]
    # where the disc was seen the directions are certain; a place 60 degrees away is not
    assert np.degrees(np.std(places, axis=0)).max() < 0.2
    away = sun.direction(np.array([20.0]), np.array([240.0]))
    places = [pose.in_pictures(away, draw)[0] for draw in pose.drawn(np.random.default_rng(0), 200)]
    assert np.degrees(np.std(places, axis=0)).max() > 0.25
    assert open_combination(1e-4 * np.eye(4)) == ""


@pytest.mark.analytic
def test_no_disc_is_the_stated_pose() -> None:
    none = MeasuredDiscs(*np.zeros((3, 0)), ())
    pose = pose_of_discs(none, SEATTLE, 90.0)
    assert pose.values.tolist() == [0.0, 0.0, 0.0, 0.0] and pose.heading_sd_deg == 2.5
    assert "would settle" in pose.notes[0]
    (note,) = pose.with_heading(1.0, 0.3).notes  # no contradiction to "as stated"
    assert "used: +1.0 +- 0.3; level as stated, to 1 degrees" in note


@pytest.mark.property
def test_two_lamps_do_not_turn_the_camera() -> None:
    discs = measured(np.array([25.0, 0.0, 0.0, 0.0]), 2)
    pose = pose_of_discs(discs, SEATTLE, AXIS_DEG)
    assert pose.discs == 0 and pose.heading_deg == 0.0 and "contradict" in pose.notes[0]
    # three that agree are believed
    discs = measured(np.array([12.0, 0.0, 0.0, 0.0]), 5)
    assert pose_of_discs(discs, SEATTLE, AXIS_DEG).heading_deg == pytest.approx(12.0, abs=0.3)


@pytest.mark.analytic
def test_merge_finds_a_strong_disc_5_degrees_away() -> None:
    def seen_from(illuminance_lx: float) -> tuple[bool, float]:
        light = np.full((180, 360), 500.0, np.float32)
        omega = 2.0 * np.pi / 360 * np.radians(1.0) * np.cos(np.radians(20.5))
        light[69, 186] += illuminance_lx / omega  # altitude 20.5, azimuth 186.5
        _, disc = take_out_disc(Panorama(light, 180.0), 20.5, 181.0)
        return disc is not None, disc.azimuth_deg if disc is not None else 0.0

    there, azimuth_deg = seen_from(70_000.0)
    assert there and azimuth_deg == pytest.approx(186.5, abs=0.5)
    assert not seen_from(15_000.0)[0]  # the mirror image in a facade


@pytest.mark.analytic
def test_a_disc_in_a_map_keeps_its_place_for_the_pose() -> None:
    """To half a pixel of 3 degrees; in a turned camera's map relative to where the sun is shown."""
    maps = np.full((2, 60, 120), 2e3, np.float32)
    for shown, at in ((150.0, 150.0), (151.0, 147.0)):
        place = np.array([31.0, 31.0]), np.array([shown, shown])
        lit = add_source(maps, place, np.full(2, 3e4), 180.0)
        places, lux = np.full((2, 2), np.nan), np.zeros(2)
        light = replace(DAY.light, dni_wm2=np.full(2, 600.0))
        data = replace(DAY, light=light, luminance_cdm2=lit, disc_lx=lux, disc_deg=places)
        take_out_of_map(data, 0, (31.0, at), (31.0, shown))
        assert places[0] == pytest.approx((31.0, at), abs=1.5) and np.isnan(places[1]).all()
        assert lux[0] == pytest.approx(3e4, rel=0.02)
        assert lit[0].max() < 3e3
