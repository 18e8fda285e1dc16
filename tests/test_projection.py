"""Lens mappings, poses and the flux-conserving resampling."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldlum.merge.project import resampler
from fieldlum.optics.projection import (
    Equirect,
    Fisheye,
    LensGeometry,
    angle_of_radius,
    column_azimuths_deg,
    direction,
    equirect_pixel,
    equirect_rays,
    equirect_solid_angles,
    lens_pixels,
    lens_rays,
    radius_of_angle,
)

POLYNOMIAL = (1.05, 0.0, -0.05)  # odd powers, as lenses have; 1 at the edge


def lens(mapping: str = "equisolid", **pose: float) -> LensGeometry:
    coefficients = POLYNOMIAL if mapping == "polynomial" else ()
    return LensGeometry((150.0, 150.0), 140.0, 186.0, mapping, coefficients, **pose)  # type: ignore[arg-type]


# ----------------------------------------------------------------------------------------------
# analytic


@pytest.mark.analytic
@pytest.mark.parametrize("height", [1, 7, 115, 230])
def test_solid_angles_sum_to_four_pi(height: int) -> None:
    assert equirect_solid_angles(height, 2 * height).sum() == pytest.approx(4 * np.pi, rel=1e-12)


@pytest.mark.analytic
def test_the_centre_column_faces_the_heading_and_right_is_clockwise() -> None:
    azimuths = column_azimuths_deg(4, 200.0)
    assert azimuths == pytest.approx([65.0, 155.0, 245.0, 335.0])
    row, column = equirect_pixel(0.0, 200.0, 2, 4, 200.0)
    assert (row, column) == (1.0, 2.0)


@pytest.mark.authority
def test_mappings_of_known_lenses() -> None:
    # Equisolid: r = 2 f sin(angle / 2); equidistant: r = f angle.
    full = LensGeometry((0.0, 0.0), 1.0, 180.0, "equisolid")
    assert radius_of_angle(full, np.pi / 3) == pytest.approx(np.sin(np.pi / 6) / np.sin(np.pi / 4))
    assert radius_of_angle(
        LensGeometry((0.0, 0.0), 1.0, 180.0, "equidistant"), np.pi / 4
    ) == pytest.approx(0.5)


@pytest.mark.analytic
def test_a_pose_turns_tilts_and_rolls_as_the_profile_says() -> None:
    # A point to the right of the axis stands right in the picture; a camera rolled clockwise shows
    # it higher up.
    x, y, _ = lens_pixels(lens(azimuth_deg=90.0), direction(0.0, 100.0))
    assert x > 150 and y == pytest.approx(150.0)
    x, y, angle = lens_pixels(lens(tilt_deg=30.0), direction(30.0, 0.0))
    assert (x, y) == pytest.approx((150.0, 150.0)) and angle == pytest.approx(0.0, abs=1e-7)
    x, y, _ = lens_pixels(lens(roll_deg=90.0), direction(0.0, 10.0))
    assert x == pytest.approx(150.0) and y < 150


@pytest.mark.contract
def test_a_polynomial_that_falls_inside_the_circle_is_refused() -> None:
    with pytest.raises(ValueError, match="does not rise"):
        angle_of_radius(LensGeometry((0.0, 0.0), 1.0, 180.0, "polynomial", (2.0, -1.5)), 0.5)


@pytest.mark.analytic
@pytest.mark.parametrize("height", [8, 33, 115])
def test_a_polynomial_that_falls_beyond_the_circle_shows_nothing_there(height: int) -> None:
    """R = 1.5 a - .5 a^3 is 1 at the edge and falls again, so directions beyond it
    land within the circle.
    """
    flat = replace(lens(), mapping="polynomial", coefficients=(1.5, 0.0, -0.5))
    r = resampler(Equirect(height), flat, (300, 300))
    angle = lens_pixels(flat, equirect_rays(height, 2 * height, 0.0))[2].ravel()
    beyond = angle > flat.half_angle_rad + np.pi / height
    assert beyond.any() and not r.coverage[beyond].any()
    assert r.coverage[angle < flat.half_angle_rad - 0.2 - np.pi / height].min() > 0.9


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.parametrize("height", [8, 33, 64])
@pytest.mark.parametrize("cfa", ["", "RGGB", "GBRG"])
def test_a_uniform_field_stays_uniform_at_any_size(height: int, cfa: str) -> None:
    r = resampler(Equirect(height), lens(), (300, 300), cfa)
    for matrix in r.matrices.values():
        values = matrix @ np.full(90_000, 7.0, np.float32)
        assert values[r.coverage > 0] == pytest.approx(7.0, rel=1e-5)  # float32 sums
    seen = (r.coverage * equirect_solid_angles(height, 2 * height).ravel()).sum()
    whole = 2 * np.pi * (1 - np.cos(np.radians(93.0)))
    assert seen == pytest.approx(whole, rel=0.03)  # the circle's outermost pixels are not used


@pytest.mark.analytic
def test_each_colour_comes_from_its_own_pixels() -> None:
    mosaic = np.zeros((300, 300), np.float32)
    mosaic[0::2, 0::2], mosaic[1::2, 1::2] = 1.0, 3.0
    mosaic[0::2, 1::2] = mosaic[1::2, 0::2] = 2.0
    r = resampler(Equirect(24), lens(), (300, 300), "RGGB")
    for colour, value in (("R", 1.0), ("G", 2.0), ("B", 3.0)):
        assert (r.matrices[colour] @ mosaic.ravel())[r.coverage > 0] == pytest.approx(
            value, rel=1e-5
        )


@pytest.mark.analytic
def test_every_sensor_pixel_gives_away_its_own_light() -> None:
    """What a panorama takes of one colour's pixel is that pixel's share of the sphere, wherever
    it stands.
    """
    height, geometry = 120, lens(azimuth_deg=20.0, tilt_deg=15.0)
    solid = equirect_solid_angles(height, 2 * height).ravel()
    # Solid angle of a sensor pixel from the rays of its corners.
    corner = lens_rays(geometry, np.arange(301.0)[None, :], np.arange(301.0)[:, None])
    own = (
        np.linalg.norm(
            np.cross(corner[1:, 1:] - corner[:-1, :-1], corner[1:, :-1] - corner[:-1, 1:]), axis=-1
        )
        / 2
    )
    middle = np.hypot(*(np.mgrid[:300, :300] + 0.5 - 150)) < 110
    for cfa, colour, every in (("", "", 1), ("GRBG", "R", 4), ("GRBG", "G", 2)):
        r = resampler(Equirect(height), geometry, (300, 300), cfa)
        given = (r.matrices[colour].T @ (solid * r.coverage)).reshape(300, 300)
        taken = middle & (given > 0)
        assert taken.sum() == pytest.approx(middle.sum() / every, rel=0.01)
        ratio = given[taken] / (every * own[taken])
        assert ratio.mean() == pytest.approx(1.0, abs=2e-3) and ratio.std() < 0.06


def disc_energy(azimuth_deg: float, altitude_deg: float, height: int) -> float:
    """Energy of a sun's disc after resampling, over the true one, for a sensor whose pixels
    integrate exactly.
    """
    radius, full = 1450.0, LensGeometry((60.0, 60.0), 1450.0, 186.0, "equisolid", azimuth_deg=0.0)
    # Only a patch of the sensor around the disc: the lens centre is moved so that the disc lands on
    # it.
    sun = direction(altitude_deg, azimuth_deg)
    x, y, _ = lens_pixels(full, sun)
    moved = LensGeometry(
        (60.0 + 60.0 - float(x), 60.0 + 60.0 - float(y)), radius, 186.0, "equisolid"
    )
    # Keep the fraction of a pixel at which the disc fell.
    moved = LensGeometry(
        (moved.centre_px[0] + float(x) % 1, moved.centre_px[1] + float(y) % 1),
        radius,
        186.0,
        "equisolid",
    )
    sub = 8
    at = (np.arange(120 * sub) + 0.5) / sub
    rays = lens_rays(moved, at[None, :], at[:, None])
    inside = (rays @ sun >= np.cos(0.004654)).astype(np.float32)
    sensor = inside.reshape(120, sub, 120, sub).mean(axis=(1, 3))
    first = max(round((90.0 - altitude_deg) / 180.0 * height) - 8, 0)  # rows around the disc
    band = Equirect(height, (first, 0, 16, 2 * height))
    r = resampler(band, moved, (120, 120))
    energy = (r.matrices[""] @ sensor.ravel() * r.coverage) @ band.solid_angles().ravel()
    return float(energy / (2 * np.pi * (1 - np.cos(0.004654))))


@pytest.mark.slow
@pytest.mark.analytic
def test_the_sun_keeps_its_energy_wherever_it_falls() -> None:
    # 1024 x 512, lens of 2900 px across; the sun's illuminance within 1 %.
    rng = np.random.default_rng(3)
    for azimuth, altitude in [
        (-3.0, 1.0),
        (86.0, 5.0),
        (40.0, 87.0),
        tuple(rng.uniform(-60, 60, 2)),
    ]:
        assert disc_energy(azimuth, altitude, 512) == pytest.approx(1.0, abs=0.01)


@pytest.mark.property
def test_turning_the_lens_by_whole_columns_shifts_the_panorama() -> None:
    rng = np.random.default_rng(0)
    sensor = rng.random(90_000).astype(np.float32)
    height = 36
    plain = resampler(Equirect(height), lens(), (300, 300))
    turned = resampler(Equirect(height), lens(azimuth_deg=40.0), (300, 300))
    a = (plain.matrices[""] @ sensor).reshape(height, -1)
    b = (turned.matrices[""] @ sensor).reshape(height, -1)
    assert np.roll(a, 8, axis=1) == pytest.approx(
        b, abs=2e-3
    )  # samples on a pixel's edge may fall to either side


@pytest.mark.analytic
def test_fisheye_target_looks_along_the_lens() -> None:
    target = Fisheye.of_size(64, replace(lens(azimuth_deg=70.0), full_angle_deg=186.0))
    r = resampler(target, lens(azimuth_deg=70.0), (300, 300))
    x = np.tile(np.arange(300, dtype=np.float32), (300, 1))
    picture = (r.matrices[""] @ x.ravel()).reshape(64, 64)
    assert picture[32, 20] < picture[32, 31] < picture[32, 44]
    assert target.solid_angles().sum() == pytest.approx(
        2 * np.pi * (1 - np.cos(np.radians(93.0))), rel=5e-3
    )
    # analytic: 70 degrees right of a heading of 20 degrees is east
    level = "-vta -vd 1.000000 0.000000 0.000000 -vu 0.000000 0.000000 1.000000 -vv 186 -vh 186"
    assert target.view(20.0) == level


# ----------------------------------------------------------------------------------------------
# property


@pytest.mark.property
@settings(deadline=None, max_examples=60)
@given(
    st.sampled_from(["equidistant", "equisolid", "polynomial"]),
    st.floats(-180, 180),
    st.floats(-60, 60),
    st.floats(-180, 180),
    st.floats(0.01, 1.6),
    st.floats(0, 6.28),
)
def test_directions_and_pixels_are_inverses(
    mapping: str, azimuth: float, tilt: float, roll: float, angle: float, around: float
) -> None:
    geometry = lens(mapping, azimuth_deg=azimuth, tilt_deg=tilt, roll_deg=roll)
    r = float(radius_of_angle(geometry, angle)) * geometry.radius_px
    x, y = 150 + r * np.cos(around), 150 + r * np.sin(around)
    back_x, back_y, back_angle = lens_pixels(geometry, lens_rays(geometry, x, y))
    assert (back_x, back_y) == pytest.approx(
        (x, y), abs=2e-3
    )  # the polynomial's inverse is a table
    assert back_angle == pytest.approx(angle, abs=1e-4)


@pytest.mark.property
@settings(deadline=None, max_examples=20)
@given(st.floats(-90, 90), st.floats(0, 360), st.floats(0, 360))
def test_every_direction_falls_into_the_pixel_that_looks_there(
    altitude: float, azimuth: float, heading: float
) -> None:
    row, column = equirect_pixel(altitude, azimuth, 90, 180, heading)
    ray = equirect_rays(90, 180, heading)[min(int(row), 89), min(int(column), 179)]
    assert ray @ direction(altitude, azimuth) >= np.cos(np.radians(1.5))
