"""What a value teaches: flags and uncertainties of merge, and hours whose sun was not measured."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from learning_room import dataset, write_pairs
from scene_captures import SEATTLE, window_captures
from test_transport import TEST, TRAIN, log_mse, model_of_train

from fieldlum.core.records import Flag, Panorama
from fieldlum.learn.models.held_out_choice import light_variance
from fieldlum.learn.models.training_data import joined_counts, load_pairs, pixel_counts
from fieldlum.learn.transport import fit
from fieldlum.learn.transport.solve import basis_of, fit_pixels, patch_scale
from fieldlum.learn.transport.training_arrays import training_arrays_of
from fieldlum.optics.images import read_panorama, write_panorama
from fieldlum.room.fit.apply_scene import with_patches
from fieldlum.room.scene.view import traced_view
from fieldlum.sky.light_similarity import Kernel

SHAPE = (4, 8)


@pytest.mark.analytic
def test_flags_teach_nothing_and_uncertainty_counts_less() -> None:
    flags = np.zeros(SHAPE, np.uint8)
    flags[0] = Flag.MOTION
    flags[1] = Flag.ND  # a value like any other
    u = np.full(SHAPE, 10.0)
    u[3] = 0.0
    counts = pixel_counts(Panorama(np.full(SHAPE, 100.0), 0.0, u_cdm2=u, flags=flags))
    assert (counts[0] == 0.0).all() and (counts[3] == 1.0).all()
    assert counts[1:3] == pytest.approx(0.5)  # 10 % is the variance of 1e-2 that halves
    assert (pixel_counts(Panorama(np.ones(SHAPE), 0.0)) == 1.0).all()


@pytest.mark.analytic
def test_what_all_captures_share_cancels() -> None:
    half, seen = np.full(SHAPE, 0.5, np.float16), np.ones((3, *SHAPE), bool)
    assert joined_counts(np.stack([half, half, half]), seen) is None
    never = np.zeros(SHAPE, np.float16)  # a luminaire that clips in most captures keeps its values
    mostly = joined_counts(np.stack([never, never, never + 1]), seen)
    assert mostly is not None and (mostly[:2] > 0.0).all() and (mostly[:2] < 0.2).all()


@pytest.mark.analytic
def test_a_flagged_value_does_not_correct_hours_of_the_same_sun() -> None:
    """A wrong value without weight leaves the fit's second stage as it was."""
    arrays = training_arrays_of(TRAIN, with_patch=False)[:4]
    row = int(np.argmax(arrays.light.direct_lx))
    filled = np.zeros(arrays.luminance.shape, bool)
    filled[row] = True
    wrong = arrays.luminance.copy()
    wrong[row] *= 20.0
    basis = basis_of(Kernel(arrays.facades)(arrays.features, arrays.features))
    right, flagged, unflagged = (
        fit_pixels(
            replace(arrays, luminance=values, filled=mask, trust=np.where(mask, 0.0, 1.0)),
            basis,
            0.02,
        ).second
        for values, mask in ((arrays.luminance, filled), (wrong, filled), (wrong, arrays.filled))
    )
    others = np.delete(np.arange(len(TRAIN)), row)
    assert np.abs(flagged - right)[others].max() < 0.02
    assert np.abs(unflagged - right)[others].max() > 0.2


@pytest.mark.analytic
@pytest.mark.parametrize("day", [1, 2])
def test_ground_lit_in_most_hours_does_not_weaken_sun_patches(day: int) -> None:
    """Captures of one day: the ground outside is dark only at dawn and dusk."""
    data = with_patches(window_captures(SEATTLE, 30))
    data = data.take(np.flatnonzero(data.days == np.unique(data.days)[day]))
    assert data.setup.room is not None and data.patch_cdm2 is not None
    view = traced_view(data.setup.room, 30, data.heading_deg)
    s = view.samples
    of_ground = np.isin(s.box, view.scene.of_kind("ground")) & ~s.mirrored
    share = np.bincount(s.pixel, np.where(of_ground, s.weight, 0.0), view.plain.size)
    seen = share.reshape(view.plain.shape) + view.plain > 0.1
    lit_hours = (data.patch_cdm2 > 100.0).sum(axis=0)
    seen.ravel()[np.flatnonzero(((lit_hours >= 3) & ~seen).ravel())[:20]] = True
    arrays = training_arrays_of(replace(data, seen=seen), with_patch=True)
    assert patch_scale(arrays) == pytest.approx(1.0, abs=0.06)


@pytest.mark.slow
@pytest.mark.property
def test_a_person_and_clipped_pixels_change_no_prediction() -> None:
    """Review, missing test 7: by 3 % at most, which is the model's own error on a clean room."""
    maps, counts = TRAIN.luminance_cdm2.copy(), np.ones(TRAIN.luminance_cdm2.shape, np.float16)
    height, width = TRAIN.shape
    for k in range(0, len(TRAIN), 6):  # somebody walks through, dark as a coat
        left = (7 * k) % (width - 4)
        maps[k, height // 3 :, left : left + 4] *= 0.1
        counts[k, height // 3 :, left : left + 4] = 0.0
    for k in range(3, len(TRAIN), 6):  # brightest pixels clipped
        bright = maps[k] > np.quantile(maps[k], 0.95)
        maps[k][bright], counts[k][bright] = maps[k][bright].min(), 0.0
    damaged = fit(replace(TRAIN, luminance_cdm2=maps, counts=counts))
    blind = fit(replace(TRAIN, luminance_cdm2=maps))
    clean = model_of_train().predict(TEST.light, TEST.patch_cdm2).luminance_cdm2
    answer = damaged.predict(TEST.light, TEST.patch_cdm2).luminance_cdm2
    change = np.abs(np.log(np.maximum(answer, 1.0) / np.maximum(clean, 1.0)))
    assert np.quantile(change, 0.95) < 0.03
    unflagged = blind.predict(TEST.light, TEST.patch_cdm2).luminance_cdm2
    assert log_mse(answer, TEST) < 0.2 * log_mse(unflagged, TEST)


@pytest.mark.slow
@pytest.mark.property
def test_an_unmeasured_low_sun_changes_no_other_hour() -> None:
    """Review, missing test 10: under 2 % (median over pixels and hours)."""
    rows = np.arange(0, len(TRAIN), 9)
    light = TRAIN.light
    altitude, dni = light.sun_altitude_deg.copy(), light.dni_wm2.copy()
    altitude[rows], dni[rows] = 1.8, 0.0  # pictures in the sun, irradiance without it
    low = replace(TRAIN, light=replace(light, sun_altitude_deg=altitude, dni_wm2=dni, perez=None))
    assert (light_variance(low)[rows] >= 1.0).all() and (light_variance(low) < 1.0).sum() > 0
    others = np.setdiff1d(np.arange(len(TRAIN)), rows)
    with_low = fit(low).predict(TEST.light, TEST.patch_cdm2).luminance_cdm2
    without = fit(TRAIN.take(others)).predict(TEST.light, TEST.patch_cdm2).luminance_cdm2
    change = np.abs(np.log(np.maximum(with_low, 1.0) / np.maximum(without, 1.0)))
    assert np.median(change) < 0.01


@pytest.mark.contract
def test_flags_of_pictures_are_read(tmp_path: Path) -> None:
    path = write_pairs(tmp_path, dataset(("2027-03-20", "2027-06-20")))
    assert load_pairs(path).counts is None
    picture = read_panorama(tmp_path / "m1.exr")
    flags = np.zeros(picture.luminance_cdm2.shape, np.uint8)
    flags[2:5, 3:6] = Flag.CLIPPED_HIGH
    write_panorama(tmp_path / "m1.exr", replace(picture, flags=flags))
    counts = load_pairs(path).counts
    assert counts is not None
    assert (counts[1, 2:5, 3:6] == 0.0).all() and counts.sum() == counts.size - 9
