"""Glare on the panorama: analytic fields, a published position index, and evalglare itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldlum.core.records import SunSource
from fieldlum.optics.projection import direction, equirect_rays, equirect_solid_angles
from fieldlum.sky.sun import SUN_SOLID_ANGLE_SR
from fieldlum.year.glare.metrics import (
    cgi,
    dgi,
    dgp,
    dgps,
    glare_directions,
    source_terms,
    sun_per_lx,
    ugp,
    ugr,
    veiling_cdm2,
)
from fieldlum.year.glare.pictures import (
    FISHEYE_VIEW,
    HEMISPHERE_SOURCES_SR,
    panorama_to_fisheye,
    parse_view,
    picture_views,
    reference_glare,
    reference_version,
)
from fieldlum.year.glare.sources import (
    glare_sources,
    group_pixels,
    panorama_views,
    position_index,
    sources_of,
    view_azimuths_deg,
    widen,
)
from fieldlum.year.glare.standards import disturbed_share

H, W = 90, 180


def _glare(maps: np.ndarray, heading: float, azimuths: object, *sun: np.ndarray) -> dict:
    views = panorama_views(*maps.shape[1:], heading, azimuths)  # type: ignore[arg-type]
    return glare_directions(maps, views, *sun)


def _uniform(value: float) -> np.ndarray:
    return np.full((1, H, W), value, np.float32)


# ----------------------------------------------------------------------------------------------
# analytic


@pytest.mark.analytic
@pytest.mark.parametrize("heading", [180.0, 33.3])
def test_a_uniform_sphere_gives_pi_l_in_every_direction(heading: float) -> None:
    got = _glare(_uniform(1000.0), heading, view_azimuths_deg(heading, 12))
    assert got["ev_lx"] == pytest.approx(np.pi * 1000.0, rel=2e-4)
    assert got["dgp"] == pytest.approx(
        5.87e-5 * np.pi * 1000.0 + 0.159, abs=1e-4
    )  # nothing is a source
    assert np.isnan(got["ugr"]).all()


@pytest.mark.analytic
def test_formulas_give_their_values_at_powers_of_ten() -> None:
    """Computed by hand from the publications named in `metrics`: each logarithm is an integer."""
    found = [
        dgp(1000.0, 99.0 * 10.0**5.61),  # 1000^1.87 = 10^5.61
        dgps(1000.0),
        ugr(4000.0, 10.0),
        ugp(4000.0, 10.0),
        dgi(100.0),
        cgi(10000.0, 400.0, 500.0),
        *(veiling_cdm2(2.0, age) for age in (0.0, 70.0, 140.0)),
        # on the line of sight P = 1; 0.01^0.8 = 10^-1.6
        source_terms(*(np.array(x) for x in (1e5, 0.01, 0.0, 0.0, 1.0, 1300.0)))[1],
    ]
    expected = [
        0.4017,
        0.2462,
        16.0,
        0.52,
        20.0,
        16.0,
        20.0,
        40.0,
        340.0,
        0.478 * 10.0**6.4 / 2000.0,
    ]
    assert [float(value) for value in found] == pytest.approx(expected, rel=1e-9)


@pytest.mark.analytic
def test_light_of_the_sources_is_not_in_the_background() -> None:
    """CIE 117: the background is Ev less what the sources give, over pi."""
    maps = np.full((1, H, W), 600.0 / np.pi, np.float32)
    maps[0, 40:50, 85:95] = 3000.0
    views = panorama_views(H, W, 180.0, [180.0])
    source = glare_sources(maps[0], views)
    got = glare_directions(maps, views)
    background = (got["ev_lx"] - source.ev_lx) / np.pi
    assert background[0, 0] < 600.0 / np.pi
    for name, formula in (("ugr", ugr), ("ugp", ugp)):
        assert got[name] == pytest.approx(formula(got["contrast"], background))


@pytest.mark.analytic
def test_the_veil_falls_with_the_square_of_the_angle() -> None:
    # 50 lx, 10 degrees to the right
    figures = (np.array(x) for x in (5e3, 0.01, np.radians(10.0), 0.0, 50.0, 1000.0))
    assert float(source_terms(*figures)[2]) == pytest.approx(0.5)


@pytest.mark.analytic
def test_a_uniform_bright_sphere_is_one_source() -> None:
    got = _glare(_uniform(5000.0), 180.0, [180.0])
    # One source of 2 pi sr: its centre is the line of sight (P = 1).
    expected = dgp(np.pi * 5000.0, 5000.0**2 * 2 * np.pi)
    assert got["dgp"][0, 0] == pytest.approx(float(expected), abs=2e-3)


@pytest.mark.analytic
@pytest.mark.parametrize(
    ("altitude", "turn"), [(0.0, 0.0), (30.0, 20.0), (-20.0, 45.0), (60.0, -10.0), (5.0, 80.0)]
)
def test_the_sun_alone_follows_the_formula(altitude: float, turn: float) -> None:
    lux, view = 2000.0, 200.0
    sun = direction(altitude, view + turn)
    got = _glare(_uniform(50.0), 180.0, [view], sun[None], np.array([lux]))
    cosine = float(sun @ direction(0.0, view))
    ev = 50.0 * np.pi + lux * cosine
    angle = np.arccos(cosine)
    side = np.cos(np.radians(altitude)) * np.sin(np.radians(turn))
    scale = angle / max(np.hypot(side, sun[2]), 1e-9)
    index = position_index(side * scale, sun[2] * scale)
    luminance = lux / SUN_SOLID_ANGLE_SR
    assert got["ev_lx"][0, 0] == pytest.approx(ev, rel=1e-3)
    contrast = luminance**2 * SUN_SOLID_ANGLE_SR / index**2
    assert got["dgp"][0, 0] == pytest.approx(float(dgp(ev, contrast)), abs=1e-3)
    assert got["ugr"][0, 0] == pytest.approx(float(8 * np.log10(0.25 / 50.0 * contrast)), abs=0.05)


@pytest.mark.analytic
def test_a_sun_behind_the_head_adds_nothing() -> None:
    lit = _glare(_uniform(50.0), 180.0, [0.0], direction(20.0, 180.0)[None], np.array([9e4]))
    dark = _glare(_uniform(50.0), 180.0, [0.0])
    assert lit["ev_lx"] == pytest.approx(dark["ev_lx"])
    assert lit["dgp"] == pytest.approx(dark["dgp"])


@pytest.mark.analytic
def test_illuminance_follows_the_cosine() -> None:
    maps = np.zeros((1, H, W), np.float32)
    maps[0, H // 2, W // 2] = 1e4  # straight ahead of heading 180, half a pixel below the horizon
    turns = np.array([0.0, 30.0, 60.0, 85.0, 95.0])
    got = _glare(maps, 180.0, 180.0 + turns)["ev_lx"][0]
    ray = equirect_rays(H, W, 180.0)[H // 2, W // 2]
    cosine = np.clip(direction(0.0, 180.0 + turns) @ ray, 0.0, None)
    expected = 1e4 * equirect_solid_angles(H, W)[H // 2, W // 2] * cosine
    assert got == pytest.approx(expected, rel=1e-3, abs=1e-6)


@pytest.mark.property
def test_turning_head_and_picture_together_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    maps = rng.lognormal(6.0, 1.5, (2, H, W)).astype(np.float32)
    a = _glare(maps, 180.0, [180.0, 216.0])
    b = _glare(maps, 70.0, [70.0, 106.0])
    for name in a:
        assert a[name] == pytest.approx(b[name], rel=1e-4, nan_ok=True)


# ----------------------------------------------------------------------------------------------
# authority


@pytest.mark.authority
@pytest.mark.parametrize(
    ("right_deg", "up_deg", "expected"),
    [
        # Luckiesh and Guth 1949 as fitted in the IES Lighting Handbook, 8th edition, figure 9-24: P
        # = 1 on the line of sight; about 2 at 20 degrees straight up; the values below are that
        # fit's, worked by hand.
        (0.0, 0.0, 1.0),
        (0.0, 20.0, float(np.exp((35.2 - 1.22) / 1000 * 20 + 21 / 1e5 * 400))),
        # 90 degrees aside (tau = 90): exp((35.2 - 28.7001) / 1000 * 40 + (21 + 24.0003 - 24.0003) /
        # 1e5 * 1600)
        (40.0, 1e-9, float(np.exp(6.4999 / 1000 * 40 + 21 / 1e5 * 1600))),
        # Iwata and Osterhaus 2010 straight below: beta = atan(tan(30) sqrt(1.3225)) = 33.58 degrees
        (0.0, -30.0, float(np.exp(6.49e-3 * 33.583 + 21e-5 * 33.583**2))),
    ],
)
def test_published_position_index(right_deg: float, up_deg: float, expected: float) -> None:
    assert position_index(np.radians(right_deg), np.radians(up_deg)) == pytest.approx(
        expected, rel=2e-3
    )


@pytest.mark.analytic
def test_a_hemisphere_has_its_sources() -> None:
    """The constant is the integral of solid angle over the squared position index."""
    angle, turn = (np.arange(400) + 0.5) / 400 * np.pi / 2, (np.arange(1600) + 0.5) / 800 * np.pi
    angle = angle[:, None]
    index = position_index(angle * np.sin(turn), angle * np.cos(turn))
    total = (np.sin(angle) / index**2).sum() * (np.pi / 800) ** 2
    assert total == pytest.approx(HEMISPHERE_SOURCES_SR, rel=1e-4)


@pytest.mark.analytic
def test_position_index_grows_and_is_capped() -> None:
    angles = np.radians(np.linspace(0.0, 90.0, 91))
    for right, up in ((angles, 0 * angles + 1e-9), (0 * angles, angles), (0 * angles, -angles)):
        values = position_index(right, up)
        assert (np.diff(values) >= -1e-12).all()
        assert values.max() <= 16.0


@pytest.mark.slow
@pytest.mark.authority
def test_evalglare_agrees_on_a_window_and_a_sun() -> None:
    # authority: evalglare of pyradiance, 800 px. Tolerances: half a per cent of Ev, 0.005 of DGP
    # (docs/validation.md).
    maps = np.full((115, 230), 120.0, np.float32)
    maps[40:58, 95:112] = 4000.0
    maps[40:58, 114:130] = 9000.0
    maps[80:90, 60:70] = 2500.0
    sun = SunSource(28.0, 215.0, 3000.0)
    got = _glare(maps[None], 180.0, [180.0], direction(28.0, 215.0)[None], np.array([3000.0]))
    ref = reference_glare(panorama_to_fisheye(maps, 180.0, 180.0, sun=sun))
    assert reference_version().startswith("evalglare 3.")
    assert got["ev_lx"][0, 0] == pytest.approx(ref.ev_lx, rel=0.005)
    assert got["dgp"][0, 0] == pytest.approx(ref.dgp, abs=0.005)
    assert got["ugr"][0, 0] == pytest.approx(ref.ugr, abs=0.4)
    assert got["dgi"][0, 0] == pytest.approx(ref.dgi, abs=0.4)


@pytest.mark.slow
@pytest.mark.authority
def test_the_share_of_disturbed_directions_is_that_of_evalglare() -> None:
    maps = np.full((115, 230), 400.0, np.float32)
    maps[30:70, 85:145] = 20_000.0
    azimuths = [0.0, 90.0, 150.0, 180.0, 230.0]
    own = _glare(maps[None], 180.0, azimuths)["dgp"]
    theirs = np.array(
        [[reference_glare(panorama_to_fisheye(maps, 180.0, a, size=400)).dgp for a in azimuths]]
    )
    assert np.abs(theirs - 0.40).min() > 0.02  # no direction is near the limit
    assert disturbed_share(own) == disturbed_share(theirs) == pytest.approx(0.6, abs=0.21)
    assert np.isnan(disturbed_share(np.full((1, 3), np.nan)))
    np.testing.assert_allclose(disturbed_share(np.array([[np.nan, 0.41, 0.2]])), 0.5)


# ----------------------------------------------------------------------------------------------
# grouping


@pytest.mark.analytic
def test_panes_nearer_than_the_reach_are_one_source_and_peaks_are_their_own() -> None:
    image = np.zeros((H, W), np.float32)
    image[40:50, 60:64] = image[40:50, 66:70] = 3000.0  # 4 degrees of frame between
    image[40:50, 90:94] = 3000.0  # 40 degrees further
    image[44, 62] = 80_000.0
    groups = sources_of(image)
    assert sorted(len(g) for g in groups) == [1, 40, 79]


@pytest.mark.analytic
def test_a_source_across_the_seam_is_one() -> None:
    mask = np.zeros((H, W), bool)
    mask[40:44, :2] = mask[40:44, -2:] = True
    assert len(np.unique(group_pixels(mask))) == 2


@pytest.mark.property
@settings(deadline=None, max_examples=25)
@given(row=st.integers(2, H - 3), column=st.integers(0, W - 1), radius_deg=st.floats(3.0, 12.0))
def test_widen_is_a_small_circle_on_the_sphere(row: int, column: int, radius_deg: float) -> None:
    # property: within half a pixel, a widened pixel is the set of pixels nearer than the radius,
    # also across the seam.
    mask = np.zeros((H, W), bool)
    mask[row, column] = True
    rays = equirect_rays(H, W, 180.0)
    angle = np.degrees(np.arccos(np.clip(rays @ rays[row, column], -1, 1)))
    got = widen(mask, np.radians(radius_deg))
    assert got[angle < radius_deg - 2.1].all()
    assert not got[angle > radius_deg + 2.1].any()


# ----------------------------------------------------------------------------------------------
# fisheyes


@pytest.mark.property
def test_fisheye_keeps_flux_and_the_suns_energy() -> None:
    size = 200
    picture = panorama_to_fisheye(
        _uniform(700.0)[0], 180.0, 180.0, size=size, sun=SunSource(20.0, 190.0, 5e4)
    )
    view = parse_view(f"{FISHEYE_VIEW} -vd 0 -1 0", Path("x"))
    omega = picture_views(view, size, size).moments[:, 0].reshape(size, size)
    assert omega.sum() == pytest.approx(2 * np.pi, rel=1e-3)
    assert (picture * omega).sum() == pytest.approx(700.0 * 2 * np.pi + 5e4, rel=2e-3)


@pytest.mark.analytic
def test_the_sun_and_its_images_add_up_over_hours_and_directions() -> None:
    """Four suns, two hours, three directions: contributions are added over the suns only."""
    rng = np.random.default_rng(1)
    views = panorama_views(H, W, 180.0, [150.0, 180.0, 240.0])
    maps = rng.uniform(50.0, 3000.0, (2, H, W)).astype(np.float32)
    suns = np.stack([direction(*place) for place in rng.uniform(10, 200, (8, 2))]).reshape(4, 2, 3)
    lx = rng.uniform(0.0, 900.0, (4, 2))
    dark, lit = glare_directions(maps, views), glare_directions(maps, views, suns, lx)
    ev, contrast = np.zeros((2, 2, 3))
    for sun, each_lx in zip(suns, lx, strict=True):
        per_lx = sun_per_lx(sun, views)
        ev += each_lx[:, None] * per_lx[0]
        contrast += each_lx[:, None] ** 2 * per_lx[1]
    assert lit["ev_lx"] == pytest.approx(dark["ev_lx"] + ev)
    assert lit["sun_contrast"] == pytest.approx(contrast)
    assert lit["contrast"] == pytest.approx(dark["contrast"] + contrast)
