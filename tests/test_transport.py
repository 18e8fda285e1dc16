"""Light transport: closed-form identities, physics that must hold exactly, and harmless files."""

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from learning_room import scaled
from places import SEATTLE

from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import CameraSetup, Room, SiteFile, Window, slot_id
from fieldlum.learn import models
from fieldlum.learn.models.held_out_choice import beam_variance, weight_of_variance
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.train import model_notes
from fieldlum.learn.transport import Transport, fit, seasons
from fieldlum.learn.transport.physics import physics_of
from fieldlum.learn.transport.solve import (
    MIN_SHARE,
    SECOND_NOISE,
    Basis,
    Columns,
    basis_of,
    fit_pixels,
    hold_out,
    second_covariance,
    solve,
)
from fieldlum.learn.transport.training_arrays import computed_light, training_arrays_of
from fieldlum.optics.projection import equirect_rays
from fieldlum.session.files.model_files import UsedScene
from fieldlum.sky.daylight import light_at
from fieldlum.sky.light_similarity import Kernel
from fieldlum.sky.perez import reinhart_patches

SETUP = SiteFile(SEATTLE, CameraSetup(heading_deg=180.0))
ROOM = Room(
    width_m=4.0,
    depth_m=4.0,
    height_m=3.0,
    camera_y_m=2.0,
    camera_x_m=2.0,
    window=(Window("south", 0.5, 3.0, 0.9, 1.8),),
)
HEIGHT, WIDTH = 16, 32


def toy(days: list[int], seed: int = 0) -> Dataset:
    """A made-up room, exactly linear in sky and sun: surfaces lit from the south, a sun patch, a
    window.
    """
    rng = np.random.default_rng(seed)
    start = datetime(2027, 1, 1, 16, 30, tzinfo=UTC)
    times = [start + timedelta(days=d, hours=h) for d in days for h in range(8)]
    n = len(times)
    light = light_at(
        times, SEATTLE, rng.uniform(0, 800, n) * (rng.random(n) < 0.7), rng.uniform(30, 300, n)
    )
    light = light[light.sun_altitude_deg > 0.0]
    rays = equirect_rays(HEIGHT, WIDTH, 180.0)
    patches = reinhart_patches()
    through = np.maximum(-patches.directions[:, 1], 0.0) * patches.solid_angles_sr
    side = 0.5 + 0.4 * rays.reshape(-1, 3) @ patches.directions.T
    sky = light.sky_cdm2 @ (side * through).T * 0.02
    sun, direct = light.sun_direction, light.direct_lx
    indirect = (direct * np.maximum(-sun[:, 1], 0.0))[:, None] * (
        0.01 + 0.005 * (rays.reshape(-1, 3) @ -sun.T).T
    )
    patch = np.where(
        ((rays.reshape(-1, 3) + sun[:, None]) ** 2).sum(-1) < 0.15, 0.1 * direct[:, None], 0.0
    )
    window = (rays[..., 1] < -0.8) & (rays[..., 2] > 0.1)
    maps = (sky + np.maximum(indirect, 0.0) + patch).reshape(-1, HEIGHT, WIDTH)
    maps[:, window] += 0.9 * light.sky_at(rays[window])
    days_of = np.array([t.date() for t in light.t_utc], "datetime64[D]")
    return Dataset(
        light,
        maps.astype(np.float32),
        patch.reshape(maps.shape).astype(np.float32),
        np.zeros(len(light)),
        180.0,
        days_of,
        tuple(slot_id(t) for t in light.t_utc),
        SETUP,
        np.ones((HEIGHT, WIDTH), bool),
        np.zeros(len(light)),
    )


TRAIN, TEST = toy([20, 79, 80, 120, 172, 173, 300, 355]), toy([50, 200], seed=1)


@cache
def model_of_train() -> Transport:
    return fit(TRAIN)


def log_mse(maps: np.ndarray, data: Dataset) -> float:
    error = np.log10(np.maximum(maps, 1.0)) - np.log10(np.maximum(data.luminance_cdm2, 1.0))
    return float((error**2 * data.weights).mean())


# ----------------------------------------------------------------------------------------------
# identities


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.numeric
def test_held_out_days_equal_fits_without_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """The closed form, against a ridge and a Gaussian process that never saw the day.

    Robust weights and scales are those of all days by design: without rounds, and with the scales
    of all days, both are equal.
    """
    arrays = training_arrays_of(TRAIN, with_patch=True)
    light = computed_light(arrays, arrays.luminance, 0.9 * arrays.luminance)
    arrays = replace(arrays, computed=light)[::64]
    assert arrays.computed is not None and arrays.patch is not None
    basis = basis_of(Kernel(arrays.facades)(arrays.features, arrays.features))
    monkeypatch.setattr("fieldlum.learn.transport.solve.ROUNDS", 0)
    monkeypatch.setattr("fieldlum.learn.transport.solve.MIN_SHARE", 0.0)
    held = hold_out(arrays, basis, 1e-2)
    unit = arrays.light.total_lx[:, None] * held.scale
    target = np.maximum(arrays.luminance, 0.1) / unit
    columns, asked = (
        Columns.of(arrays, unit, light)
        for light in (arrays.computed.luminance, arrays.computed.perez)
    )
    usual = np.exp(np.log(target).mean(axis=0))
    weights = arrays.trust / np.maximum(target, usual) ** 2
    first = np.empty_like(target)
    for day in np.unique(arrays.days):
        out, kept = arrays.days == day, arrays.days != day
        features = Basis(basis.values[kept], basis.projector[kept], basis.assumed[kept])
        some = replace(columns, values=columns.values[:, kept])
        taught = target[kept], weights[kept]
        b, gains = solve(features, some, *taught, 1e-2)
        first[out] = (basis.values @ b.T + np.einsum("knp,pk->np", asked.values, gains))[out]
    residual = np.where(arrays.filled, 0.0, np.log(target / first))
    covariance, second = second_covariance(arrays.features, arrays.features), np.empty_like(target)
    for day in np.unique(arrays.days):
        out, kept = arrays.days == day, arrays.days != day
        noise = SECOND_NOISE / weight_of_variance(arrays.unsure + beam_variance(arrays.light))
        noisy = covariance[np.ix_(kept, kept)] + np.diag(noise[kept])
        second[out] = covariance[np.ix_(out, kept)] @ np.linalg.solve(noisy, residual[kept])
    assert np.allclose(held.luminance, first * np.exp(second) * unit, rtol=1e-6)


@pytest.mark.analytic
def test_ridge_without_prior_is_least_squares() -> None:
    rng = np.random.default_rng(2)
    features, truth = rng.standard_normal((30, 3)), rng.standard_normal((4, 3))
    columns = Columns(rng.random((1, 30, 4)), np.array([1e12]), 0)
    target = features @ truth.T + columns.values[0] * 2.5
    basis = Basis(features, features, features)
    b, gains = solve(basis, columns, target, np.ones_like(target), 1e-9)
    assert np.allclose(b, truth, atol=1e-6) and np.allclose(gains, 2.5, atol=1e-6)


# ---------------------------------------------------------------------------------------------- the
# model


@pytest.mark.analytic
def test_learns_an_exactly_linear_room() -> None:
    assert (
        log_mse(model_of_train().predict(TEST.light, TEST.patch_cdm2).luminance_cdm2, TEST) < 1e-3
    )
    assert (
        log_mse(model_of_train().predict(TRAIN.light, TRAIN.patch_cdm2).luminance_cdm2, TRAIN)
        < 2e-4
    )


@pytest.mark.property
def test_twice_the_light_is_twice_the_map() -> None:
    assert TEST.patch_cdm2 is not None
    once = model_of_train().predict(TEST.light, TEST.patch_cdm2).luminance_cdm2
    twice = model_of_train().predict(scaled(TEST.light, 2.0), 2.0 * TEST.patch_cdm2).luminance_cdm2
    assert np.allclose(twice, 2.0 * once, rtol=1e-4)


@pytest.mark.property
def test_chunks_do_not_matter() -> None:
    assert TEST.patch_cdm2 is not None
    whole = model_of_train().predict(TEST.light, TEST.patch_cdm2)
    parts = [
        model_of_train().predict(TEST.light[i : i + 3], TEST.patch_cdm2[i : i + 3])
        for i in range(0, len(TEST), 3)
    ]
    assert np.allclose(
        whole.luminance_cdm2, np.concatenate([p.luminance_cdm2 for p in parts]), rtol=1e-4
    )
    assert np.allclose(
        whole.expected_mse, np.concatenate([p.expected_mse for p in parts]), rtol=1e-3
    )


@pytest.mark.slow
@pytest.mark.analytic
def test_unknown_gain_is_found_and_costs_little() -> None:
    assert TRAIN.patch_cdm2 is not None and TEST.patch_cdm2 is not None
    model = fit(replace(TRAIN, patch_cdm2=TRAIN.patch_cdm2 / 3.7), patch="gain")
    assert model.patch_scale == pytest.approx(3.7, rel=0.1)
    assert (
        log_mse(model.predict(TEST.light, TEST.patch_cdm2 / np.float32(3.7)).luminance_cdm2, TEST)
        < 1e-3
    )


@pytest.mark.slow
@pytest.mark.analytic
def test_the_level_of_a_fitted_scene_is_learnt_too() -> None:
    """Suns that no capture has meet other surfaces, whose own gains are then unknown."""
    assert TRAIN.patch_cdm2 is not None
    dark = replace(TRAIN, patch_cdm2=TRAIN.patch_cdm2 / np.float32(1.3))
    scene: UsedScene = {
        "north_deg": 0.0,
        "clock_min": 0.0,
        "chosen": "stated",
        "stated": {},
        "stated_heading_deg": TRAIN.heading_deg,
    }
    found, own = fit(replace(dark, scene=scene)), model_of_train()
    assert isinstance(found, Transport) and isinstance(own, Transport)
    assert found.patch_scale is not None and own.patch_scale is not None
    assert found.patch_scale / own.patch_scale == pytest.approx(1.3, rel=1e-3)


@pytest.mark.slow
@pytest.mark.contract
def test_no_patch_is_learnt_and_needs_none() -> None:
    model = fit(TRAIN, patch="none")
    found = model.predict(TEST.light)
    assert model.patch_scale is None and log_mse(found.luminance_cdm2, TEST) < 0.05
    with pytest.raises(InputError, match="sun patches"):
        model_of_train().predict(TEST.light)


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.parametrize("rows", [[0, 1, 2], [3, 3, 3, 3], list(range(5))])
@pytest.mark.parametrize("patch", ["absolute", "gain", "none"])
def test_tiny_or_doubled_sets_give_finite_maps(rows: list[int], patch: models.Patch) -> None:
    data = TRAIN.take(rows)
    model = fit(data, patch=patch)
    found = model.predict(TEST.light, None if patch == "none" else TEST.patch_cdm2)
    assert np.isfinite(found.luminance_cdm2).all() and found.luminance_cdm2.min() > 0.0
    assert (
        found.log10_sd is not None
        and np.isfinite(found.log10_sd).all()
        and np.isfinite(found.expected_mse).all()
    )


@pytest.mark.slow
@pytest.mark.property
def test_captures_under_changing_light_teach_less() -> None:
    """A third of the pictures are off in level; with the range of their irradiance known, the fit
    is closer to the truth. Robust weights already help without it.
    """
    assert TRAIN.patch_cdm2 is not None
    rng = np.random.default_rng(6)
    change = np.where(rng.random(len(TRAIN)) < 0.33, 0.6, 0.0)
    level = 1.0 + change * rng.uniform(-0.5, 0.5, len(TRAIN))
    factor = level[:, None, None].astype(np.float32)
    off = replace(
        TRAIN, luminance_cdm2=TRAIN.luminance_cdm2 * factor, patch_cdm2=TRAIN.patch_cdm2 * factor
    )
    unknown, known = (
        log_mse(fit(data).predict(TEST.light, TEST.patch_cdm2).luminance_cdm2, TEST)
        for data in (off, replace(off, steadiness=change))
    )
    assert known < 0.9 * unknown


@pytest.mark.slow
@pytest.mark.analytic
def test_a_person_in_one_capture_is_mostly_not_learnt() -> None:
    """Mean errors of log10 luminance where the person was, in five rooms. With weights 1 / y^2 the
    median of that hour is 0.99, the mean of the other hours 0.030. Of ten such rooms, four keep the
    person in that hour.
    """
    same_hour, other_hours = [], []
    for seed in range(5):
        data = toy([0, 1, 2, 3, 90, 91, 92, 93], seed)
        dim = int(np.argsort(data.light.total_lx)[len(data) // 3])
        hidden = np.s_[8:13, 24:27]  # of a wall
        maps = data.luminance_cdm2.copy()
        maps[dim][hidden] = 0.04 * np.median(maps[dim])
        fitted = fit(replace(data, luminance_cdm2=maps))
        predicted = fitted.predict(data.light, data.patch_cdm2).luminance_cdm2
        error = np.abs(np.log10(predicted / data.luminance_cdm2))[:, *hidden].mean(axis=(1, 2))
        same_hour.append(error[dim])
        other_hours.append(np.delete(error, dim).mean())
    assert np.median(same_hour) < 0.3 and np.mean(other_hours) < 0.01


@pytest.mark.slow
@pytest.mark.property
def test_noise_of_the_level_leaves_no_bias() -> None:
    """Levels off by 20 % (log-normal): the mean signed log error of what is fitted, less the mean
    log level of the draw, is within 1 % over twenty draws. Weights 1 / y^2 alone gave -6 %.
    """
    arrays = training_arrays_of(TRAIN, with_patch=True)[::16]
    kernel = Kernel(arrays.facades)
    basis = basis_of(kernel(arrays.features, arrays.features))
    errors = []
    for seed in range(20):
        log_level = 0.2 * np.random.default_rng(seed).standard_normal(len(TRAIN))
        noisy = arrays.luminance * np.exp(log_level)[:, None].astype(np.float32)
        pixels = fit_pixels(replace(arrays, luminance=noisy), basis, 0.1)
        unit = arrays.light.total_lx[:, None] * pixels.scale
        found = np.maximum(basis.values @ pixels.b.T, MIN_SHARE) * unit
        assert arrays.patch is not None
        found += pixels.patch_gain * arrays.patch + pixels.sky_gain * arrays.sky
        errors.append(np.log(found / arrays.luminance).mean() - log_level.mean())
    assert abs(np.mean(errors)) < 0.01


@pytest.mark.analytic
def test_seasons_are_parted_by_gaps_in_the_declination() -> None:
    nine = np.array(
        [f"2027-{d}" for d in ("03-19", "03-20", "06-20", "06-21", "12-20", "12-21")],
        "datetime64[D]",
    )
    assert seasons(nine).tolist() == [1, 1, 2, 2, 0, 0]
    assert seasons(np.arange("2027-01-01", "2028-01-01", 3, "datetime64[D]")).max() == 0


@pytest.mark.contract
def test_two_captures_are_not_enough() -> None:
    with pytest.raises(NotEnoughDataError):
        fit(TRAIN.take([0, 1]))


@pytest.mark.slow
@pytest.mark.property
def test_duplicates_change_little() -> None:
    twice = fit(TRAIN.take([*range(len(TRAIN)), *range(len(TRAIN))]))
    assert log_mse(twice.predict(TEST.light, TEST.patch_cdm2).luminance_cdm2, TEST) < 1.5e-3


@pytest.mark.slow
@pytest.mark.analytic
def test_one_season_is_not_trusted_in_another() -> None:
    december = fit(toy([350, 352, 354, 356, 358]))
    found = december.predict(TEST.light, TEST.patch_cdm2)
    summer = np.array([t.month == 7 for t in TEST.light.t_utc]) & (TEST.light.dni_wm2 > 200)
    assert summer.any() and not found.trusted[summer].all()
    assert found.expected_mse[summer].mean() > 3.0 * np.mean(december.held_out_mse)


@pytest.mark.slow
@pytest.mark.property
def test_room_physics_is_linear_used_and_survives_saving(tmp_path: Path) -> None:
    with_room = replace(TRAIN, setup=replace(SETUP, room=ROOM))
    model = fit(with_room)
    physics = physics_of(with_room.setup, 180.0)
    assert physics is not None and model.physics is not None
    once, twice = physics.sunlight(TEST.light), physics.sunlight(scaled(TEST.light, 2.0))
    assert np.allclose(2.0 * once, twice, rtol=1e-4)
    assert not once[TEST.light.dni_wm2 == 0].any() and once.any()
    assert log_mse(model.predict(TEST.light, TEST.patch_cdm2).luminance_cdm2, TEST) < 1.5e-3
    models.save(tmp_path / "m", model, with_room)
    again = models.load(tmp_path / "m").predict(TEST.light, TEST.patch_cdm2)
    assert np.allclose(
        again.luminance_cdm2, model.predict(TEST.light, TEST.patch_cdm2).luminance_cdm2, rtol=1e-4
    )


def computed(data: Dataset, *, upside_down: bool = False) -> Dataset:
    """The captures of a room that is as `Physics` computes it, but for the tone of each pixel, and
    for constant light that it does not know: 2 % of the pixel's mean in `TRAIN`.

    upside_down: it is dark when it is computed bright.
    """
    physics = physics_of(replace(SETUP, room=ROOM), 180.0)
    assert physics is not None
    every, light = (
        physics.luminance(d.light, physics.sunlight(d.light), d.seen) for d in (TRAIN, data)
    )
    if upside_down:
        light = 100.0**2 / np.maximum(light, 1.0)
    tone = np.random.default_rng(3).uniform(0.3, 1.5, light.shape[1])
    maps = (tone * (light + 0.02 * every.mean(axis=0))).astype(np.float32)
    maps = maps.reshape(data.luminance_cdm2.shape)
    setup = replace(SETUP, room=ROOM)
    return replace(data, luminance_cdm2=maps, patch_cdm2=np.zeros_like(maps), setup=setup)


@pytest.mark.slow
@pytest.mark.analytic
def test_two_days_predict_the_year_of_a_room_as_computed(tmp_path: Path) -> None:
    few, year = computed(TRAIN.take(np.isin(TRAIN.days, TRAIN.days[[0, -1]]))), computed(TEST)
    model = fit(few)
    answer = model.predict(year.light, year.patch_cdm2)
    error = log_mse(answer.luminance_cdm2, year)
    assert error < 2e-5  # without the room 7e-3
    assert error < answer.expected_mse.mean() < 1e-3
    models.save(tmp_path / "m", model, few)
    again = models.load(tmp_path / "m").predict(year.light, year.patch_cdm2)
    assert np.allclose(again.luminance_cdm2, answer.luminance_cdm2, rtol=1e-4)


@pytest.mark.slow
@pytest.mark.property
def test_captures_that_contradict_computed_light_switch_it_off() -> None:
    four = TRAIN.take(np.isin(TRAIN.days, np.unique(TRAIN.days)[::2]))
    assert not fit(computed(four, upside_down=True)).pixels.computed_gain.any()


@pytest.mark.slow
@pytest.mark.property
def test_a_stated_room_that_captures_contradict_is_not_used() -> None:
    assert TRAIN.patch_cdm2 is not None
    stated = replace(TRAIN, setup=replace(SETUP, room=ROOM))
    shaded = replace(  # no sun comes in, and the room has it at other hours
        stated,
        luminance_cdm2=TRAIN.luminance_cdm2 - TRAIN.patch_cdm2,
        patch_cdm2=TRAIN.patch_cdm2[::-1].copy(),
    )
    model, right = fit(shaded), fit(stated)
    assert isinstance(model, Transport) and isinstance(right, Transport)
    assert right.patch_scale is not None and model.patch_scale is None and model.physics is None
    assert "[room] is not used" in model_notes(model, shaded, "absolute")[-1]
    assert not any("[room]" in note for note in model_notes(right, stated, "absolute"))
    bare = fit(replace(shaded, patch_cdm2=None, setup=SETUP))
    one, other = (m.predict(TEST.light).luminance_cdm2 for m in (model, bare))
    assert np.array_equal(one, other)


# ----------------------------------------------------------------------------------------------
# files


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize("patch", ["absolute", "none"])
def test_saved_and_loaded_predicts_the_same(tmp_path: Path, patch: models.Patch) -> None:
    model = fit(TRAIN, patch=patch)
    models.save(tmp_path / "m", model, TRAIN)
    again = models.load(tmp_path / "m")
    given = None if patch == "none" else TEST.patch_cdm2
    a, b = model.predict(TEST.light, given), again.predict(TEST.light, given)
    assert np.allclose(a.luminance_cdm2, b.luminance_cdm2, rtol=1e-5)
    assert (
        a.log10_sd is not None
        and b.log10_sd is not None
        and np.allclose(a.log10_sd, b.log10_sd, rtol=1e-4)
    )
    assert np.array_equal(a.trusted, b.trusted) and again.parameters == model.parameters


class _Bomb:
    def __reduce__(self) -> tuple:
        return Path.touch, (Path("exploded"),)


@pytest.mark.contract
def test_a_strangers_file_runs_no_code(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    models.save(tmp_path / "m", model_of_train(), TRAIN)
    with np.load(tmp_path / "m" / "weights.npz") as stored:
        arrays = {name: stored[name] for name in stored.files}
    bomb = np.empty(1, object)
    bomb[0] = _Bomb()
    np.savez(tmp_path / "m" / "weights.npz", **(arrays | {"projector": bomb}))  # pyright: ignore[reportArgumentType]
    with pytest.raises(InputError):
        models.load(tmp_path / "m")
    assert not (tmp_path / "exploded").exists()
