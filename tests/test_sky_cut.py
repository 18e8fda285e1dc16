"""The luminance around what can be sky: which directions, how fine, and what merge writes."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from fieldlum.core.records import Panorama, Site
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated.camera import SimulatedCamera
from fieldlum.devices.simulated.world import DetailedPanorama, SimulatedLight
from fieldlum.merge import MergeOptions, Shot, merge_shots
from fieldlum.merge.project import resampler
from fieldlum.merge.sun_and_sky import sun_tiles
from fieldlum.optics.linear_light import sensor_pitch_deg
from fieldlum.optics.profiles import bracket_exposures, load_camera_profile
from fieldlum.optics.projection import Equirect, LensGeometry, smallest_arc
from fieldlum.sky import sun
from fieldlum.sky.sky_view.picture import SkyGrid, SkyPicture


@pytest.mark.property
@pytest.mark.parametrize("latitude_deg", [-60.0, -20.0, 0.0, 47.6, 66.0])
def test_no_sun_of_a_year_is_outside_the_tiles(latitude_deg: float) -> None:
    site = Site("a", latitude_deg, 0.0)
    times = [datetime(2027, 1 + k % 12, 21, k % 24, 17, tzinfo=UTC) for k in range(288)]
    at = sun.position(times, site)
    up = at.apparent_altitude_deg > -0.3
    for wrong in (-5.0, 5.0):
        tiles = sun_tiles(180.0 + wrong, latitude_deg)
        row = ((90.0 - at.apparent_altitude_deg[up]) / 2.0).astype(int)
        column = (((at.azimuth_deg[up] - 180.0) % 360.0 + 180.0) % 360.0 / 2.0).astype(int)
        assert tiles[row, column].all()
        assert tiles.mean() < 0.45


@pytest.mark.analytic
def test_the_smallest_arc_passes_the_last_column() -> None:
    used = np.zeros(10, bool)
    used[[8, 1]] = True
    assert smallest_arc(used) == (8, 4)
    assert smallest_arc(np.ones(10, bool))[1] == 10


@pytest.mark.property
def test_a_part_of_a_panorama_is_resampled_like_the_panorama() -> None:
    lens = LensGeometry((60.0, 60.0), 58.0, 180.0, "equidistant", azimuth_deg=20.0)
    image = np.random.default_rng(1).random(120 * 120)
    complete = resampler(Equirect(40), lens, (120, 120))
    part = resampler(Equirect(40, (8, 30, 16, 20)), lens, (120, 120))
    of = (complete.matrices[""] @ image).reshape(40, 80)[8:24, 30:50]
    assert (part.matrices[""] @ image).reshape(16, 20) == pytest.approx(of, rel=1e-5)
    assert part.coverage.reshape(16, 20) == pytest.approx(
        complete.coverage.reshape(40, 80)[8:24, 30:50], abs=1e-5
    )


class _World:
    def __init__(self, panorama: Panorama) -> None:
        self.panorama = panorama

    def scene(self, t_utc: datetime) -> Panorama:
        return self.panorama

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        return SimulatedLight(ghi_wm2=0.0, dhi_wm2=0.0, dni_wm2=0.0)


@pytest.mark.slow
@pytest.mark.analytic
def test_merge_keeps_bars_that_the_panorama_cannot_show(tmp_path: Path) -> None:
    """Bars 2 degrees apart before a sky of 3 000 cd/m2, in a panorama of 3.9 degrees."""
    profile = load_camera_profile("sim-fisheye")
    grid = SkyGrid(
        first_altitude_deg=40.0,
        first_azimuth_deg=-24.0,
        step_deg=0.25,
        heading_deg=180.0,
        height=160,
        width=192,
    )
    bars = np.where((np.arange(160) // 4) % 2 == 0, 3000.0, 30.0).astype(np.float32)
    light = np.repeat(bars[:, None], 192, axis=1)
    panorama = DetailedPanorama(
        np.full((46, 92), 30.0, np.float32),
        180.0,
        detail=SkyPicture(light, np.zeros(light.shape, bool), grid),
    )
    clock = FastClock(datetime(2027, 3, 20, 20, 0, tzinfo=UTC))
    camera = SimulatedCamera(_World(panorama), profile, clock, heading_deg=180.0)
    shots = [
        Shot(camera.expose(e, tmp_path / f"{i:02d}"), e, None)
        for i, e in enumerate(bracket_exposures(profile.bracket, "nd5"))
    ]
    sky = merge_shots(shots, profile, MergeOptions(height=46), latitude_deg=47.6).sky
    assert sky is not None and sky.grid.step_deg < 1.05 * sensor_pitch_deg(profile)
    altitude, azimuth = sky.grid.altitudes_deg, sky.grid.azimuths_deg
    middle = np.abs(azimuth - 180.0) < 10.0
    rows = (altitude < 38.0) & (altitude > 20.0)  # below, no sun stands in the south at noon
    cut = sky.luminance_cdm2[np.ix_(rows, middle)].astype(float)
    # energy: the mean of the bars; bars of 2.5 pixels keep most of their contrast
    assert cut.mean() == pytest.approx(1515.0, rel=0.03)
    profile_of_rows = cut.mean(axis=1)
    assert np.percentile(profile_of_rows, 95) > 2300.0
    assert np.percentile(profile_of_rows, 5) < 700.0
    # the dark room beyond is not kept
    side = (np.abs(azimuth - 180.0) > 40.0) & (np.abs(azimuth - 180.0) < 60.0)
    assert np.isnan(sky.luminance_cdm2[np.ix_(rows, side)]).all()
    assert not sky.clipped.any()
    assert 30.0 < sky.dark_cdm2 < 45.0
