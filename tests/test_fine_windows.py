"""Windows as fine as the sensor: what simulate renders around them, and what cameras see of it."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from places import SEATTLE

from fieldlum.core.records import CameraSetup, Panorama, Room, SiteFile, SunSource, Window
from fieldlum.devices.simulated import optics
from fieldlum.devices.simulated.world import DetailedPanorama
from fieldlum.optics.projection import LensGeometry, lens_pixels
from fieldlum.room import simulate
from fieldlum.room.scene.trace import DISC_RAYS, disc_rays
from fieldlum.room.simulate.fine_windows import fine_windows
from fieldlum.sky.daylight import light_at
from fieldlum.sky.sky_view.picture import SkyGrid, SkyPicture, read_sky_picture, write_sky_picture

LENS = LensGeometry((150.0, 150.0), 145.0, 180.0, "equidistant")
SENSOR = (300, 300)
T_UTC = datetime(2027, 12, 20, 20, 30, tzinfo=UTC)


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.parametrize("azimuth_deg", [180.0, 350.0], ids=["ahead", "across the seam"])
def test_fine_pixels_of_a_window_have_the_mean_of_the_panorama(
    tmp_path: Path, azimuth_deg: float
) -> None:
    room = Room(
        width_m=4,
        depth_m=5,
        height_m=3,
        camera_x_m=2,
        camera_y_m=2,
        camera_z_m=1.4,
        wall_azimuth_deg=azimuth_deg,
        window=(Window("south", 0.5, 3, 0.8, 1.9, frame_m=0.05, panes=2),),
    )
    truth = simulate.lit_room(
        SiteFile(SEATTLE, CameraSetup(heading_deg=180.0), room), height=30, quality="draft"
    )
    light = light_at([T_UTC, T_UTC], SEATTLE, np.array([0.0, 600.0]), np.array([150.0, 80.0]))
    fine = fine_windows(truth, 0.5)
    assert fine is not None and fine.grid.step_deg == 0.5
    made = truth.render(light)
    for k in range(2):
        picture = fine.picture(made, k)
        h, w = picture.luminance_cdm2.shape
        means = picture.luminance_cdm2.reshape(h // 12, 12, w // 12, 12).mean(axis=(1, 3))
        rows = round((90.0 - fine.grid.first_altitude_deg) / 6.0) + np.arange(h // 12)
        columns = round((fine.grid.first_azimuth_deg + 180.0) / 6.0) + np.arange(w // 12)
        coarse = made.luminance_cdm2[k][np.ix_(rows, columns % 60)]
        shown = np.isfinite(means)  # the rectangle without what is far from the window
        means, coarse = means[shown], coarse[shown]
        # The panorama has nine rays a pixel: the share of frame in a pixel is right to a tenth.
        assert np.median(means / coarse) == pytest.approx(1.0, abs=0.02)
        assert means.sum() == pytest.approx(coarse.sum(), rel=0.04)


@pytest.mark.analytic
def test_a_camera_sees_the_finer_part(tmp_path: Path) -> None:
    """A strip of 1 degree, which a panorama of 4-degree pixels cannot hold."""
    light = np.full((40, 40), 100.0, np.float32)
    light[20] = 900.0
    light[:10, :10] = np.nan
    grid = SkyGrid(
        first_altitude_deg=20.0,
        first_azimuth_deg=-20.0,
        step_deg=1.0,
        heading_deg=30.0,
        height=40,
        width=40,
    )
    write_sky_picture(tmp_path / "a.npz", SkyPicture(light, np.isnan(light), grid))
    detail = read_sky_picture(tmp_path / "a.npz")
    panorama = DetailedPanorama(np.full((45, 90), 100.0, np.float32), 30.0, detail=detail)
    view = optics.lens_sampling(LENS, SENSOR, (45, 90), grid)
    image = optics.on_sensor(panorama, [view], SENSOR)[..., 0]
    x, y, _ = lens_pixels(
        LENS,
        SkyGrid(
            first_altitude_deg=0.0,
            first_azimuth_deg=0.0,
            step_deg=1.0,
            heading_deg=0.0,
            height=1,
            width=1,
        ).rays()[0, 0],
    )
    row, column = int(y), int(x)
    strip = image[row - 4 : row + 5, column]
    # 1.61 pixels a degree, of three samples each: the strip is 5 samples high instead of 4.83
    assert (strip - 100.0).sum() == pytest.approx(800.0 * 145.0 / 90.0, rel=0.05)
    assert strip[[0, -1]] == pytest.approx(100.0, abs=0.1) and strip.max() > 500.0  # 16-bit codes
    assert image[:20].max() == pytest.approx(100.0, abs=0.1)


@pytest.mark.analytic
def test_a_half_hidden_disc_is_half_a_disc() -> None:
    sun = SunSource(0.0, 180.0, 50_000.0, 0.5)
    right = disc_rays(np.array([0.0, 1.0, 0.0]))[:, 0] > 0.0
    marks = "".join("1" if ray else "0" for ray in right)
    lens = LensGeometry((150.0, 150.0), 1450.0, 180.0, "equidistant")  # 16 pixels a degree
    images = []
    for attributes in ({}, {DISC_RAYS: marks}):
        dark = np.zeros((20, 40), np.float32)
        panorama = Panorama(dark, 180.0, sun=sun, attributes=attributes)
        images.append(
            optics.on_sensor(panorama, [optics.lens_sampling(lens, SENSOR, (20, 40), None)], SENSOR)
        )
    full, half = (image[..., 0].astype(float) for image in images)
    assert half.sum() == pytest.approx(full.sum(), rel=1e-3)  # the source states the visible part
    assert half[:, :148].sum() < 0.02 * half.sum()
    assert full[:, :150].sum() == pytest.approx(0.5 * full.sum(), rel=0.01)
