"""A sun that a facade, water or a floor mirrors: found by its images, never by a lamp; taken out of
the captures; and stated in every result.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from learning_room import dataset

from fieldlum.core.errors import InputError
from fieldlum.learn import models
from fieldlum.learn.models.mirrors import (
    Mirror,
    SunImage,
    bright_spots,
    find_mirrors,
    mirrored,
    read_mirrors,
    split_images,
    tolerance_rad,
)
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.train import fit_and_score, run
from fieldlum.optics.projection import altitude_azimuth_deg, direction, equirect_rays
from fieldlum.room.scene.box_room import glass_optics
from fieldlum.session.files.predict_json import PredictFile
from fieldlum.sky.daylight import Light
from fieldlum.sky.sun_disc import SunDisc, add_source
from fieldlum.weather import read_weather
from fieldlum.year.glare.metrics import glare_directions
from fieldlum.year.glare.sources import panorama_views
from fieldlum.year.predict import run as predict
from fieldlum.year.predict.hour_blocks import HourJudge, blocks, room_of
from fieldlum.year.predict.year import light_of

DAYS = ("2027-03-19", "2027-03-21", "2027-05-02", "2027-06-21", "2027-09-24", "2027-10-20")
ROOM = dataset(DAYS, seed=3, height=30)
# Not the azimuth of any wall of the room, and tilted, as a pane of a facade that leans.
FACADE = direction(7.0, 203.0)
FACTOR = 2.0  # of a coated pane, relative to one surface of glass


def with_image(data: Dataset, towards: np.ndarray, image_lx: np.ndarray) -> Dataset:
    """Add a bright pixel of each illuminance [n] lx in the directions [n, 3]."""
    place = altitude_azimuth_deg(towards)
    maps = add_source(data.luminance_cdm2, place, image_lx, data.heading_deg)
    return replace(data, luminance_cdm2=maps)


def facade_light(light: Light, normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Directions [n, 3] and illuminance [n] of the images in a facade that fills the north."""
    suns = light.apparent_sun_direction
    towards, cosine = mirrored(suns, normal), suns @ normal
    visible = (cosine > 0.0) & in_facade(towards)
    share = FACTOR * glass_optics(0.0, cosine)[1]
    return towards, np.where(visible, share * light.direct_lx, 0.0)


def in_facade(towards: np.ndarray) -> np.ndarray:
    return (towards[..., 1] > 0.45) & (towards[..., 2] > -0.1)


def facade_room() -> Dataset:
    """The room with a pale facade in the north, in front of which the sun is mirrored."""
    rays = equirect_rays(*ROOM.shape, ROOM.heading_deg)
    maps = np.where(in_facade(rays), 4.0 * ROOM.luminance_cdm2 + 50.0, ROOM.luminance_cdm2)
    return replace(ROOM, luminance_cdm2=maps.astype(np.float32))


PLAIN = facade_room()
MIRRORING = with_image(PLAIN, *facade_light(PLAIN.light, FACADE))


@pytest.mark.analytic
def test_a_plane_turns_the_sun_and_glass_reflects_as_fresnel_states() -> None:
    sun = direction(30.0, 180.0)[None]
    np.testing.assert_allclose(mirrored(sun, [0.0, -1.0, 0.0])[0], direction(30.0, 0.0), atol=1e-12)
    np.testing.assert_allclose(mirrored(sun, [0, 0, 1])[0], direction(-30.0, 180.0), atol=1e-12)
    # ((n - 1) / (n + 1))^2 at normal incidence; half of r_s^2 at Brewster's angle; 1 at grazing
    brewster = np.arctan(1.52)
    across = np.cos(brewster) ** 2 - np.sin(brewster) ** 2
    expected = [(0.52 / 2.52) ** 2, across**2 / 2.0, 1.0]
    reflectance = glass_optics(0.0, [1.0, np.cos(brewster), 0.0])[1]
    np.testing.assert_allclose(reflectance, expected, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.property
@settings(max_examples=30, deadline=None)
@given(
    azimuth=st.floats(0.0, 360.0),
    altitude=st.floats(-20.0, 90.0),
    lamps=st.integers(0, 2),
    seed=st.integers(0, 1000),
)
def test_any_mirror_is_found_among_lamps_within_its_uncertainty(
    azimuth: float, altitude: float, lamps: int, seed: int
) -> None:
    height, heading = 60, 180.0
    rng = np.random.default_rng(seed)
    suns = direction(rng.uniform(10.0, 60.0, 14), rng.uniform(90.0, 270.0, 14))
    normal = direction(altitude, azimuth)
    far = np.abs(suns @ normal) > 0.3  # a grazing image has nearly the place of the sun
    maps = np.full((14, height, 2 * height), 100.0, np.float32)
    data = replace(ROOM.take(np.arange(14)), luminance_cdm2=maps)
    data = with_image(data, mirrored(suns, normal), np.where(far, 4000.0, 0.0))
    for k in range(lamps):
        data = with_image(
            data, np.tile(direction(40.0 + 30.0 * k, 20.0), (14, 1)), np.full(14, 900.0)
        )
    spots = [
        spot
        for k in range(14)
        for spot in bright_spots(data.luminance_cdm2[k], heading, suns[k], 700.0, k)
    ]
    found = find_mirrors(spots, suns, np.full(14, 65_000.0), height)
    if far.sum() < 5:
        assert len(found) <= 1
        return
    (mirror,) = found
    off_deg = np.degrees(np.arccos(min(abs(float(mirror.normal @ normal)), 1.0)))
    # two axes; places in pixels are not normal, so that 3.5 u is exceeded in none of the draws
    assert off_deg < 3.5 * mirror.u_deg * np.sqrt(2.0) and mirror.u_deg < 1.0
    assert {image.row for image in mirror.images} <= set(np.flatnonzero(far))
    for image in mirror.images:
        error = np.arccos(np.clip(mirrored(suns, normal)[image.row] @ image.towards, -1.0, 1.0))
        assert error < tolerance_rad(height)
        # a lamp of 900 lx, too dim for a spot of its own, may be in the image's pixel
        assert 0.9 * 4000.0 < image.spot.normal_lx < 1.02 * 4900.0


@pytest.mark.property
def test_panes_that_are_not_parallel_are_one_mirror() -> None:
    height, count, rng = 180, 24, np.random.default_rng(4)
    suns = direction(rng.uniform(15.0, 60.0, count), rng.uniform(120.0, 270.0, count))
    panes = FACADE + np.radians(0.4) * rng.normal(size=(count, 3))
    panes /= np.linalg.norm(panes, axis=1, keepdims=True)
    towards = np.stack([mirrored(suns[k : k + 1], panes[k])[0] for k in range(count)])
    disc = SunDisc(0.0, 0.0, 0.1, 4000.0, 100.0, np.zeros((0, 0), bool))
    spots = [SunImage(k, towards[k], disc) for k in range(count)]
    (mirror,) = find_mirrors(spots, suns, np.full(count, 65_000.0), height)
    assert np.degrees(np.arccos(mirror.normal @ FACADE)) < 0.4  # sd of a single pane
    assert len(mirror.images) > 0.8 * count


@pytest.mark.property
@pytest.mark.parametrize("lit", ["always", "when overcast", "two lamps"])
def test_lamps_and_captures_without_a_mirror_change_nothing(lit: str) -> None:
    on = PLAIN.light.dni_wm2 < 200.0 if lit == "when overcast" else np.ones(len(PLAIN), bool)
    lamp = np.tile(direction(35.0, 10.0), (len(PLAIN), 1))
    data = with_image(PLAIN, lamp, np.where(on, 2000.0, 0.0))
    if lit == "two lamps":
        data = with_image(data, np.tile(direction(20.0, 60.0), (len(PLAIN), 1)), 2000.0 * on)
    for captures in (PLAIN, data):
        after, mirrors = split_images(captures)
        assert after is captures and mirrors == ()


@pytest.mark.property
def test_images_are_taken_out_and_hours_without_them_are_distinguished() -> None:
    data, (mirror,) = split_images(MIRRORING)
    assert np.degrees(np.arccos(mirror.normal @ FACADE)) < 2.5 * mirror.u_deg * np.sqrt(2.0)
    # a spot of a pixel 6 degrees wide contains some of the surroundings
    assert mirror.factor == pytest.approx(FACTOR, rel=0.1)
    bright = MIRRORING.luminance_cdm2.max(axis=(1, 2)) > 1e5
    assert mirror.captures >= 0.9 * bright.sum()
    assert data.luminance_cdm2[bright].max() < 2.0 * PLAIN.luminance_cdm2.max()
    other = dataset(("2027-04-10", "2027-08-15", "2027-11-02"), seed=9, height=30)
    images = mirror.images(other.light, other.heading_deg)
    towards, image_lx = facade_light(other.light, FACADE)
    np.testing.assert_allclose((images.towards * towards).sum(axis=1), 1.0, atol=2e-3)
    visible = image_lx > 0.0
    # one or two hours are in a pixel 6 degrees wide at the facade's edge
    assert (images.shown == visible).mean() > 0.9 and visible.sum() > 8
    certain = ~images.uncertain
    assert (images.shown == visible)[certain].mean() > 0.95 and certain.mean() > 0.5
    both = images.shown & visible
    np.testing.assert_allclose(images.shown_lx[both], image_lx[both], rtol=0.1)


@pytest.mark.slow
@pytest.mark.contract
def test_the_warning_is_in_every_result(tmp_path: Path) -> None:
    answer = run(MIRRORING, "nearest", patch="none", out=tmp_path / "m")
    (warning,) = [note for note in answer["notes"] if "plane mirror" in note]
    assert warning.startswith("WARNING: ") and "azimuth 203" in warning
    assert "not trusted" in warning and "Predicted hours include the mirrored sun" in warning
    config = models.read_config(tmp_path / "m")
    assert warning in config.state["warnings"]
    (mirror,) = read_mirrors(tmp_path / "m", config)
    assert isinstance(mirror, Mirror) and mirror.chance.shape == MIRRORING.shape
    weather = tmp_path / "w.csv"
    lines = [
        f"{month},{day},{hour + 0.5},{700 * lit},{80 * lit}"
        for month in (3, 9)
        for day in (20, 21, 22)
        for hour in range(24)
        for lit in [6 <= hour < 18]
    ]
    weather.write_text("\n".join(["month,day,hour,dni_wm2,dhi_wm2", *lines]) + "\n")
    year, _ = predict(tmp_path / "m", weather, out=tmp_path / "y", views=4)
    assert warning in PredictFile.read(tmp_path / "y").model_warnings
    # The view to the facade has the image: without it, DGP is that of the same map alone.
    room = room_of(config, tmp_path / "m")
    bare = replace(room, mirrors=())
    light = light_of(read_weather(weather, room.setup.site).daylight())
    fitted = models.load(tmp_path / "m")
    (block,) = blocks(fitted, room, light[:64])
    (image,) = block.images
    shown = np.flatnonzero(image.shown_lx > 1000.0)
    assert len(shown) > 3
    north = int(np.argmin(np.abs((year.azimuths_deg + 180.0) % 360.0 - 180.0)))
    (alone,) = blocks(fitted, bare, light[:64])
    without = HourJudge(bare, year.azimuths_deg).glare(alone)["dgp"]
    gain = year.views["dgp"][:64] - without
    assert gain[shown, north].min() > 0.1
    np.testing.assert_allclose(gain[image.shown_lx == 0.0], 0.0, atol=1e-4)
    assert (block.pictures_cdm2(room.heading_deg)[shown].max(axis=(1, 2)) > 5e4).all()
    assert not year.hours["trusted"][:64][image.uncertain].any()
    # If the captures do not decide, both cases are inside the interval of DGP.
    open_question = replace(mirror, chance=np.full(MIRRORING.shape, 0.45, np.float32))
    models.save(tmp_path / "n", fitted, MIRRORING, mirrors=[open_question])
    year, _ = predict(tmp_path / "n", weather, out=tmp_path / "z", views=4)
    np.testing.assert_allclose(year.views["dgp"][:64], without, atol=1e-4)
    width = (year.views["dgp_high"] - year.views["dgp_low"])[:64][shown, north]
    assert width.min() > 0.1 and not year.hours["trusted"][:64][shown].any()


@pytest.mark.property
def test_an_image_without_known_energy_is_not_predicted() -> None:
    clipped = MIRRORING.luminance_cdm2 != PLAIN.luminance_cdm2
    counts = np.where(clipped, np.float16(0.0), np.float16(1.0))
    _, (mirror,) = split_images(replace(MIRRORING, counts=counts))
    assert not mirror.predicted and "clipped" in mirror.warning and "lower bound" in mirror.warning
    images = mirror.images(MIRRORING.light, MIRRORING.heading_deg)
    visible = facade_light(MIRRORING.light, FACADE)[1] > 3000.0
    assert not images.shown.any() and images.uncertain[visible].all()


@pytest.mark.analytic
def test_an_image_has_the_glare_of_a_sun_in_its_place() -> None:
    maps, suns = np.full((2, 30, 60), 200.0, np.float32), direction([20.0, 40.0], [180.0, 150.0])
    images = mirrored(suns, FACADE)
    lx = np.array([3000.0, 500.0])
    views = panorama_views(30, 60, 0.0, [0.0, 30.0])
    hidden = glare_directions(maps, views, images, lx)
    both = glare_directions(maps, views, np.stack([suns, images]), np.stack([np.zeros(2), lx]))
    for name, values in hidden.items():
        np.testing.assert_allclose(both[name], values, rtol=1e-12, err_msg=name)
    twice = glare_directions(maps, views, np.stack([images, images]), np.stack([lx, 2.0 * lx]))
    np.testing.assert_allclose(twice["sun_ev_lx"], 3.0 * hidden["sun_ev_lx"])
    np.testing.assert_allclose(twice["sun_contrast"], 5.0 * hidden["sun_contrast"])


@pytest.mark.contract
def test_a_damaged_mirror_is_rejected(tmp_path: Path) -> None:
    fitted = models.fit("mean", PLAIN, patch="none")
    normal = (float(FACADE[0]), float(FACADE[1]), float(FACADE[2]))
    mirror = Mirror(normal, 0.3, 5, 1.0, True, 9, 0, np.zeros((2, 4), np.float32))
    models.save(tmp_path, fitted, PLAIN, mirrors=[mirror])
    with pytest.raises(InputError, match="mirrors that cannot be used"):
        read_mirrors(tmp_path, models.read_config(tmp_path))
    models.save(tmp_path, fitted, PLAIN)
    assert "mirrors" not in json.loads((tmp_path / "config.json").read_text())


@pytest.mark.slow
@pytest.mark.property
def test_a_mirror_changes_only_the_pixels_of_its_images() -> None:
    with_images = fit_and_score(MIRRORING, "mean", patch="none")
    without = fit_and_score(PLAIN, "mean", patch="none")
    a = with_images.fitted.predict(PLAIN.light[:3]).luminance_cdm2
    b = without.fitted.predict(PLAIN.light[:3]).luminance_cdm2
    np.testing.assert_allclose(a, b, rtol=0.15)
