"""The sun's disc in analytic scenes: a disc of known illuminance in a window, low, hidden, clipped.

Three stages use the module and are tested on the same scenes: merge (a place, flags), training data
(a place and DNI) and the glare of one picture (neither).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from learning_room import dataset

from fieldlum.core.records import Flag, Panorama, SunSource
from fieldlum.merge.sun_and_sky import take_out_disc
from fieldlum.optics.images import write_panorama
from fieldlum.optics.projection import (
    direction,
    equirect_pixel,
    equirect_rays,
    equirect_solid_angles,
)
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR
from fieldlum.sky.sun_disc import MIN_DISC_CDM2, add_disc, find_disc, without_disc
from fieldlum.year.glare.picture_glare import picture_glare

HEADING_DEG = 180.0
WALL_CDM2, SKY_CDM2 = 60.0, 9000.0
LUMENS_PER_WATT = 93.0


@dataclass(frozen=True)
class Scene:
    """A window sky in a dark wall, [H, W], and the same with a disc; bar: across the window."""

    without: np.ndarray
    light: np.ndarray
    normal_lx: float


def window_scene(
    altitude: float,
    azimuth: float,
    normal_lx: float,
    *,
    height: int = 180,
    bar: bool = False,
    blur_deg: float = 0.0,
) -> Scene:
    """Deposit a disc by energy on a fine grid, blurred by a lens, and average to [H, 2 H].

    The window is 40 degrees wide and reaches from -5 to 50 degrees around azimuth 180. A bar of 1
    degree covers all of the disc but its right half.
    """
    fine = 720 // height
    h, w = height * fine, 2 * height * fine
    altitudes = 90.0 - (np.arange(h) + 0.5) / h * 180.0
    azimuths = HEADING_DEG + ((np.arange(w) + 0.5) / w - 0.5) * 360.0
    inside = ((altitudes > -5) & (altitudes < 50))[:, None] & (np.abs(azimuths - 180) < 20)
    sky = np.where(inside, SKY_CDM2 * (1 + altitudes[:, None] / 90), WALL_CDM2)
    shadow = np.zeros((h, w), bool)
    if bar:
        shadow = inside & (np.abs(azimuths - (azimuth - 0.5 / np.cos(np.radians(altitude)))) < 0.5)
        sky = np.where(shadow, WALL_CDM2, sky)
    towards = direction(altitude, azimuth)
    angle = np.degrees(np.arccos(np.clip(equirect_rays(h, w, HEADING_DEG) @ towards, -1, 1)))
    disc = angle < 0.2665
    solid = equirect_solid_angles(h, w)
    spread = np.exp(-0.5 * (angle / blur_deg) ** 2) if blur_deg else disc.astype(float)
    spread *= normal_lx / (spread * solid).sum()
    spread[shadow] = 0.0

    def averaged(values: np.ndarray) -> np.ndarray:
        sums = (values * solid).reshape(height, fine, 2 * height, fine).sum(axis=(1, 3))
        return (sums / equirect_solid_angles(height, 2 * height)).astype(np.float32)

    return Scene(averaged(sky), averaged(sky + spread), float((spread * solid).sum()))


CASES = [
    pytest.param((25.0, 185.0, 70_000.0), {}, id="window-sky"),
    pytest.param((25.0, 185.0, 70_000.0), {"bar": True}, id="half-behind-a-bar"),
    pytest.param((25.0, 185.0, 70_000.0), {"blur_deg": 0.35}, id="blurred"),
    pytest.param((2.0, 171.3, 4000.0), {}, id="low-sun"),
    pytest.param((25.0, 185.0, 900.0), {}, id="weak-sun"),
    pytest.param((48.7, 198.9, 50_000.0), {}, id="corner-of-the-window"),
    pytest.param((20.0, 182.0, 60_000.0), {"height": 60}, id="coarse"),
    pytest.param((20.0, 182.0, 60_000.0), {"height": 24}, id="very-coarse"),
]


def split_disc(
    luminance_cdm2: np.ndarray, heading_deg: float, near_deg: tuple[float, float], dni_wm2: float
) -> tuple[np.ndarray, float]:
    """Return a map [H, W] without the disc, and the disc's normal illuminance in lx (0 without)."""
    disc = find_disc(luminance_cdm2, heading_deg, near_deg=near_deg, dni_wm2=dni_wm2)
    if disc is None:
        return luminance_cdm2, 0.0
    return without_disc(luminance_cdm2, disc), disc.normal_lx


@pytest.mark.analytic
@pytest.mark.parametrize(("sun", "options"), CASES)
def test_every_stage_finds_the_disc(sun: tuple, options: dict, tmp_path: Path) -> None:
    altitude, azimuth, _ = sun
    scene = window_scene(*sun, **options)
    pixel_deg = 180.0 / len(scene.light)

    panorama = Panorama(scene.light, HEADING_DEG, flags=np.zeros(scene.light.shape, np.uint16))
    merged, _ = take_out_disc(
        panorama, altitude + 0.4, azimuth - 0.6
    )  # the camera points a bit off
    assert merged.sun is not None and merged.sun.origin == "merge"
    dni = sun[2] / LUMENS_PER_WATT
    trained, trained_lx = split_disc(scene.light, HEADING_DEG, (altitude, azimuth), dni)
    write_panorama(tmp_path / "p.exr", Panorama(scene.light, HEADING_DEG))
    alone = picture_glare(tmp_path / "p.exr", [180.0])["sun"]

    sky_lx = 2.0 * SKY_CDM2 * (1.2 + 2 * pixel_deg) ** 2 * np.radians(1.0) ** 2  # under the disc
    for normal_lx in (
        merged.sun.normal_illuminance_lx,
        trained_lx,
        alone["normal_illuminance_lx"],
    ):
        assert normal_lx == pytest.approx(scene.normal_lx, rel=0.01, abs=min(sky_lx, 0.05 * sun[2]))
    for left in (merged.luminance_cdm2, trained):  # energy is kept, and nothing glows
        assert left.max() < 2.0 * scene.without.max() + 2e4
        omega = equirect_solid_angles(*left.shape)
        total = float((left * omega).sum()) + trained_lx
        assert total == pytest.approx(float((scene.light * omega).sum()), rel=2e-3)
    towards = direction(alone["altitude_deg"], alone["azimuth_deg"])
    away = np.degrees(np.arccos(towards @ direction(altitude, azimuth)))
    assert away < 0.75 * pixel_deg + (0.15 if options.get("bar") else 0.05)


@pytest.mark.analytic
@pytest.mark.parametrize("height", [24, 60, 180])
def test_a_window_without_the_sun_has_no_disc(height: int, tmp_path: Path) -> None:
    """The sun is behind the wall beside the window, or behind a cloud in it."""
    sky = window_scene(25.0, 185.0, 1.0, height=height).without
    flags = np.zeros(sky.shape, np.uint16)
    for place in ((25.0, 185.0), (25.0, 203.0), (52.0, 180.0), (-0.2, 180.0)):
        panorama = Panorama(sky, HEADING_DEG, flags=flags)
        assert take_out_disc(panorama, *place)[0] is panorama
        for dni in (0.0, 30.0, 900.0):
            assert split_disc(sky, HEADING_DEG, place, dni)[1] == 0.0
    write_panorama(tmp_path / "p.exr", Panorama(sky, HEADING_DEG))
    assert picture_glare(tmp_path / "p.exr", [180.0])["sun"] is None


@pytest.mark.analytic
def test_a_lamp_is_no_sun_where_the_sun_is_elsewhere(tmp_path: Path) -> None:
    """A bright lamp far from the sun stays; one brighter than any sun is not taken for it."""
    lamp = window_scene(25.0, 150.0, 20_000.0).light
    assert find_disc(lamp, HEADING_DEG, near_deg=(25.0, 185.0)) is None
    impossible = window_scene(25.0, 150.0, 400_000.0).light
    assert find_disc(impossible, HEADING_DEG) is None
    assert find_disc(impossible, HEADING_DEG, near_deg=(25.0, 150.0)) is not None
    tube = np.where(
        np.abs(np.arange(180)[:, None] - 60) < 20, np.float32(2e5), np.zeros((180, 360), np.float32)
    )
    assert find_disc(tube, HEADING_DEG) is None  # larger than the sun


@pytest.mark.analytic
def test_no_light_has_no_disc() -> None:
    for value in (0.0, np.nan):
        dark = np.full((23, 46), value, np.float32)
        assert find_disc(dark, HEADING_DEG) is None
        assert find_disc(dark, HEADING_DEG, near_deg=(89.9, 10.0)) is None


@pytest.mark.analytic
def test_a_disc_that_clips_is_placed_and_is_a_lower_bound() -> None:
    scene = window_scene(25.0, 185.0, 70_000.0, blur_deg=0.4)
    top = 2e5
    clipped = scene.light >= top
    flags = np.where(clipped, np.uint16(Flag.CLIPPED_HIGH), np.uint16(0))
    panorama = Panorama(np.minimum(scene.light, top).astype(np.float32), HEADING_DEG, flags=flags)
    out, _ = take_out_disc(panorama, 24.5, 185.7)
    assert out.sun is not None and out.sun.origin == "clipped" and out.flags is not None
    assert 0 < out.sun.normal_illuminance_lx < 70_000
    assert out.luminance_cdm2.max() < 3e4
    assert (((out.flags & Flag.FILLED) > 0) >= clipped).all()
    disc = find_disc(panorama.luminance_cdm2, 180.0, near_deg=(24.5, 185.7), clipped=clipped)
    assert disc is not None and disc.clipped
    assert (disc.altitude_deg, disc.azimuth_deg) == pytest.approx((25.0, 185.0), abs=0.3)


@pytest.mark.analytic
def test_a_window_that_clips_shows_no_disc_beside_it() -> None:
    """A bracket that is too short: all of the window is clipped, no place can be measured."""
    sky = window_scene(25.0, 185.0, 1.0).without
    clipped = sky > 5000
    found = find_disc(sky, HEADING_DEG, near_deg=(25.0, 185.0), clipped=clipped)
    assert found is not None and found.clipped and np.isnan(found.sigma_deg)
    assert (found.altitude_deg, found.azimuth_deg) == pytest.approx((25.0, 185.0))
    assert found.normal_lx < 20.0
    assert find_disc(sky, HEADING_DEG, near_deg=(25.0, 203.0), clipped=clipped) is None


@pytest.mark.slow
@pytest.mark.property
@given(
    altitude=st.floats(-80, 89),
    azimuth=st.floats(0, 359.9),
    dni=st.floats(5, 1000),
    wall=st.floats(1, 8000),
)
def test_a_disc_is_taken_out_and_put_back(
    altitude: float, azimuth: float, dni: float, wall: float
) -> None:
    height, width = 58, 116
    clean = np.full((height, width), wall, np.float32)
    row, column = equirect_pixel(altitude, azimuth, height, width, HEADING_DEG)
    i, j = int(row), int(column) % width
    lux = LUMENS_PER_WATT * dni
    with_disc = clean.copy()
    with_disc[i, j] += lux / equirect_solid_angles(height, width)[i, j]
    if with_disc[i, j] < max(3.0 * wall, 9e4):  # not brighter than any surface
        return
    left, energy = split_disc(with_disc, HEADING_DEG, (altitude, azimuth), dni)
    assert energy == pytest.approx(lux, rel=1e-4)
    np.testing.assert_allclose(left, clean, rtol=1e-5)


@pytest.mark.analytic
def test_a_sunlit_wall_is_no_disc() -> None:
    bright = np.full((58, 116), 93.0 * 900 / np.pi, np.float32)
    bright[:, :50] = 10.0
    left, energy = split_disc(bright, HEADING_DEG, (30.0, 180.0), 900.0)
    assert energy == 0.0 and left is bright


@pytest.mark.analytic
def test_the_least_disc_is_the_stated_one() -> None:
    least_lx = MIN_DISC_CDM2 * SUN_SOLID_ANGLE_SR  # 68 lx
    for share, expected in ((0.95, False), (1.1, True)):
        light = window_scene(25.0, 185.0, share * least_lx, height=240).light
        assert (find_disc(light, HEADING_DEG, near_deg=(25.0, 185.0)) is not None) == expected


@pytest.mark.analytic
def test_a_disc_put_back_holds_all_energy_in_the_suns_pixel() -> None:
    data = dataset(("2027-03-20",))
    maps, lux = np.zeros_like(data.luminance_cdm2), np.full(len(data), 5e4)
    with_disc = add_disc(maps, data.light, lux, HEADING_DEG)
    np.testing.assert_allclose(
        (with_disc * equirect_solid_angles(*data.shape)).sum(axis=(1, 2)), lux, rtol=1e-5
    )
    disc = find_disc(
        with_disc[0],
        HEADING_DEG,
        near_deg=(float(data.light.sun_altitude_deg[0]), float(data.light.sun_azimuth_deg[0])),
    )
    assert disc is not None and disc.normal_lx == pytest.approx(5e4, rel=1e-4)
    np.testing.assert_allclose(without_disc(with_disc[0], disc), maps[0], atol=1e-6)


@pytest.mark.analytic
def test_a_recorded_sun_stays(tmp_path: Path) -> None:
    sky = window_scene(25.0, 185.0, 70_000.0).light
    recorded = SunSource(25.0, 185.0, 123.0, 1.0, "dni")
    write_panorama(tmp_path / "p.exr", Panorama(sky, HEADING_DEG, sun=recorded))
    assert picture_glare(tmp_path / "p.exr", [180.0])["sun"]["normal_illuminance_lx"] == 123.0
