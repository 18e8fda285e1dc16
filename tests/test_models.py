"""The registry, the baselines and the paper's network."""

import itertools
import json
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from learning_room import dataset

from fieldlum.core.errors import InputError
from fieldlum.core.progress import shown_by
from fieldlum.learn import models
from fieldlum.learn.models import dense
from fieldlum.learn.models.dense import (
    EPOCHS,
    Net,
    Run,
    Shape,
    Trainer,
    decode,
    encode,
    inputs_of,
    pixels_of,
)
from fieldlum.learn.models.scores import compare, evaluate, summary, truth

DATA = dataset(("2027-03-20", "2027-03-21"), height=8)
TEST = dataset(("2027-03-22",), seed=1, height=8)
SMALL = Shape(width=24, patch_width=12, depth=2)
BASE = inputs_of(np.zeros(DATA.shape), 180.0, torch.device("cpu"))
FEW = Run(100, 256)


@pytest.mark.authority
def test_the_network_has_the_papers_parameters() -> None:
    """600 more than 1 688 601, the "Base Model" without the sky of the thesis behind the paper."""
    assert sum(p.numel() for p in Net(Shape()).parameters()) == 1_689_201


@pytest.mark.property
@settings(deadline=None)
@given(luminance=st.floats(1.0, 1.5e9))
def test_normalisation_comes_back(luminance: float) -> None:
    """Encode and decode are inverse to float32's precision, and stay in [0, 1]."""
    encoded = encode(np.array([luminance]))
    assert 0.0 <= encoded[0] <= 1.0
    assert decode(encoded)[0] == pytest.approx(luminance, rel=2e-4)


@pytest.mark.analytic
def test_normalisation_at_known_points() -> None:
    """Floor 1, top 10^9.2, power 1/1.5."""
    np.testing.assert_allclose(encode(np.array([0.0, 1.0, 10.0**9.2])), [0.0, 0.0, 1.0], atol=1e-7)
    assert encode(np.array([10.0**4.6]))[0] == pytest.approx(0.5 ** (1 / 1.5))


@pytest.mark.authority
def test_inputs_are_scaled_as_the_paper_says() -> None:
    at = BASE.at(DATA.light)
    light = DATA.light
    np.testing.assert_allclose(at.sun[:, 0], light.sun_altitude_deg / 90, rtol=1e-5)
    west = light.sun_azimuth_deg > 180
    assert (at.sun[:, 1].numpy()[west] > 0.5).all() and (at.sun[:, 1].numpy()[~west] < 0.5).all()
    assert at.sky.shape == (len(DATA), 2306) and float(at.sky[:, -1].max()) == 0.0


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.numeric
@pytest.mark.parametrize("ranks", [1, 2])
def test_a_step_has_the_gradient_of_the_loss(ranks: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """MSE + 10 RER of the batch, differentiated by torch in one piece; torchrun's ranks add up."""
    torch.manual_seed(3)
    net = Net(SMALL)
    pixels = pixels_of(DATA, BASE, "absolute", torch.device("cpu"))
    numbers = torch.randperm(len(pixels))[:501]
    trainer = Trainer(net, pixels)
    sums = [torch.zeros(3, dtype=torch.float64)]
    monkeypatch.setattr(dense, "world", lambda: ranks)
    for k in range(ranks):
        monkeypatch.setattr(dense, "rank", lambda k=k: k)
        sums.append(trainer.sums(pixels, numbers).detach().double())
    every = torch.stack(sums).sum(dim=0)
    monkeypatch.setattr(dense, "sum_over_ranks", lambda t: t.copy_(every) if t.shape == (3,) else t)
    gradient = [torch.zeros_like(p) for p in net.parameters()]
    loss = 0.0
    for k in range(ranks):
        monkeypatch.setattr(dense, "rank", lambda k=k: k)
        loss = trainer.step(numbers, rate=0.0)
        for gathered, parameter in zip(gradient, net.parameters(), strict=True):
            assert parameter.grad is not None
            gathered += parameter.grad
    net.zero_grad()
    scene, patch, target, weight = pixels.batch(numbers)
    error = net(scene, patch) - target
    s = (weight * error**2).sum()
    whole = s / 501 + 10 * torch.sqrt(s / (weight * target**2).sum())
    whole.backward()
    assert loss == pytest.approx(whole.item(), rel=1e-5)
    for mine, parameter in zip(gradient, net.parameters(), strict=True):
        torch.testing.assert_close(mine, parameter.grad, rtol=1e-3, atol=1e-5)


@pytest.mark.slow
@pytest.mark.property
def test_the_network_learns_a_tiny_set_by_heart() -> None:
    one = DATA.take(np.array([2]))  # a lone image validates itself
    plan = Run(400, 128)
    fitted = models.fit("dense", one, plan=plan, shape=Shape(128, patch_width=32))
    error = compare(fitted.predict(one.light, one.patch_cdm2), one)
    assert error.mse[0] < 0.01 * np.log10(np.maximum(one.luminance_cdm2, 1)).var()


def interrupted_after(epochs: int, **options: Any) -> None:
    """Train until the middle of an epoch, as a power cut would end it."""
    updates = itertools.count()

    def progress(*_: object) -> None:
        if next(updates) > epochs * FEW.steps // EPOCHS:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), shown_by(progress):
        models.fit("dense", DATA, **options)


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.numeric
def test_resuming_equals_training_in_one_go(tmp_path: Path) -> None:
    options = {"plan": FEW, "seed": 5, "shape": SMALL}
    straight = models.fit("dense", DATA, **options)
    kept = tmp_path / "checkpoint.pt"
    interrupted_after(2, checkpoint=kept, **options)
    assert kept.is_file()
    resumed = models.fit("dense", DATA, checkpoint=kept, **options)
    for name, value in straight.state().arrays.items():
        np.testing.assert_array_equal(value, resumed.state().arrays[name])


@pytest.mark.slow
@pytest.mark.contract
def test_a_checkpoint_of_other_pictures_is_refused(tmp_path: Path) -> None:
    """Pictures merged anew under the same slots must not go on from weights taught by
    the old ones.
    """
    kept = tmp_path / "checkpoint.pt"
    interrupted_after(1, checkpoint=kept, plan=FEW, shape=SMALL)
    brighter = replace(DATA, luminance_cdm2=DATA.luminance_cdm2 * np.float32(1.02))
    with pytest.raises(InputError, match="of other pictures, other irradiance or another seed"):
        models.fit("dense", brighter, checkpoint=kept, plan=FEW, shape=SMALL)
    with pytest.raises(InputError, match="of other pictures, other irradiance or another seed"):
        models.fit("dense", DATA, checkpoint=kept, plan=FEW, seed=1, shape=SMALL)


@pytest.mark.slow
@pytest.mark.property
def test_the_same_seed_gives_the_same_network_and_another_another() -> None:
    a, b, c = (
        models.fit("dense", DATA, plan=FEW, seed=s, shape=SMALL).state().arrays for s in (1, 1, 2)
    )
    assert all((a[name] == b[name]).all() for name in a)
    assert any((a[name] != c[name]).any() for name in a)


@pytest.mark.slow
@pytest.mark.contract
def test_a_strangers_checkpoint_cannot_run_code(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return (Path.touch, (tmp_path / "owned",))  # type: ignore[return-value]

    path = tmp_path / "checkpoint.pt"
    torch.save({"net": Evil()}, path)
    with pytest.raises(InputError, match="a checkpoint that cannot be used"):
        models.fit("dense", DATA, plan=FEW, checkpoint=path, shape=SMALL)
    path.write_bytes(pickle.dumps(Evil()))
    with pytest.raises(InputError):
        models.fit("dense", DATA, plan=FEW, checkpoint=path, shape=SMALL)
    assert not (tmp_path / "owned").exists()


@pytest.mark.contract
def test_a_strangers_model_folder_cannot_run_code(tmp_path: Path) -> None:
    fitted = models.fit("mean", DATA)
    models.save(tmp_path, fitted, DATA)
    with (tmp_path / "weights.npz").open("wb") as file:
        np.savez(file, log10_mean=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match="weights that cannot be used"):
        models.load(tmp_path)
    (tmp_path / "weights.npz").write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(InputError):
        models.load(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config | {"model": "os.system"}))
    (tmp_path / "config.json.sha256").unlink()
    with pytest.raises(InputError, match="the unknown model"):
        models.load(tmp_path)


@pytest.mark.property
@pytest.mark.parametrize("name", ["mean", "nearest", "dense"])
def test_a_kept_model_predicts_as_before(tmp_path: Path, name: str) -> None:
    options = {"plan": FEW, "shape": SMALL} if name == "dense" else {}
    fitted = models.fit(name, DATA, **options)
    models.save(tmp_path, fitted, DATA, patch="absolute")
    again = models.load(tmp_path)
    a, b = (m.predict(TEST.light, TEST.patch_cdm2) for m in (fitted, again))
    np.testing.assert_allclose(a.luminance_cdm2, b.luminance_cdm2, rtol=1e-5)
    np.testing.assert_array_equal(a.trusted, b.trusted)
    assert again.parameters == fitted.parameters > 0


@pytest.mark.property
def test_nearest_doubles_with_the_light() -> None:
    """Twice the irradiance, twice the map (its features move a little: the same hours
    are asked for).
    """
    fitted = models.fit("nearest", DATA, patch="none")
    one = fitted.predict(DATA.light).luminance_cdm2
    np.testing.assert_allclose(one, DATA.luminance_cdm2, rtol=1e-5)


@pytest.mark.property
def test_hours_far_from_the_captured_ones_are_not_trusted() -> None:
    winter = dataset(("2027-12-20", "2027-12-21"), height=8)
    fitted = models.fit("mean", winter)
    june = dataset(("2027-06-21",), height=8)
    sunny = june.light.dni_wm2 > 200
    assert sunny.any() and not fitted.predict(june.light).trusted[sunny].any()
    assert fitted.predict(winter.light).trusted.all()


@pytest.mark.slow
@pytest.mark.contract
def test_a_network_without_patches() -> None:
    bare = models.fit("dense", DATA, plan=FEW, patch="none", shape=SMALL)
    assert bare.predict(TEST.light).luminance_cdm2.shape == TEST.luminance_cdm2.shape
    fitted = models.fit("dense", DATA, plan=FEW, shape=SMALL)
    with pytest.raises(ValueError, match="trained with sun patches"):
        fitted.predict(TEST.light)


@pytest.mark.analytic
def test_a_loss_that_is_no_number_halves_the_rate() -> None:
    """In the middle of a training the rate is half of what it starts from."""
    run = Run(1000, 512, step=500)
    assert run.rate_now(None) == pytest.approx(5e-4)
    run.rate /= 2.0
    assert run.rate_now(None) == pytest.approx(2.5e-4)


@pytest.mark.analytic
def test_pixels_without_count_teach_the_network_nothing() -> None:
    counts = np.ones(DATA.luminance_cdm2.shape, np.float16)
    counts[1, 2, 3] = 0.0
    data = replace(DATA, counts=counts)
    pixels = pixels_of(data, BASE, "absolute", torch.device("cpu"))
    _, _, _, weight = pixels.batch(torch.arange(len(pixels)))
    flat = weight.reshape(len(DATA), -1)
    place = np.flatnonzero(np.flatnonzero(DATA.seen) == 2 * DATA.shape[1] + 3)
    assert flat[1, place] == 0.0 and (flat[0] > 0.0).all()
    assert (flat == 0.0).sum() == 1


@pytest.mark.property
def test_a_loss_that_is_no_number_changes_nothing() -> None:
    """Training never ends in NaN: the update is skipped and the best weights are taken up again."""
    net = Net(SMALL)
    pixels = pixels_of(DATA, BASE, "absolute", torch.device("cpu"))
    pixels.target[0, 0] = float("nan")
    before = [p.clone() for p in net.parameters()]
    trainer = Trainer(net, pixels)
    assert np.isnan(trainer.step(torch.arange(10), rate=1e-3))
    assert all(torch.equal(a, b) for a, b in zip(before, net.parameters(), strict=True))


@pytest.mark.analytic
def test_scores_of_a_constant_factor() -> None:
    """Everything 10^0.1 too bright is 0.01 in both modes."""
    bright = DATA.take(np.arange(4))
    prediction = models.Prediction(
        np.maximum(bright.luminance_cdm2, 1.0) * np.float32(10**0.1),
        None,
        np.full(4, np.nan),
        np.ones(4, bool),
    )
    found = summary(compare(prediction, bright))
    assert found["paper_log10_mse"] == pytest.approx(0.01, rel=1e-3)
    assert found["log10_mse_weighted"] == pytest.approx(0.01, rel=1e-3)
    assert found["dgp_mse"] is None


@pytest.mark.contract
def test_a_perfect_prediction_scores_nothing_and_nan_is_never_unseen() -> None:
    class Oracle:
        name, parameters, held_out_mse = "mean", 0, None
        maps = TEST.luminance_cdm2.copy()

        def predict(self, light: object, patch: object = None) -> models.Prediction:
            return models.Prediction(
                self.maps, None, np.zeros(len(self.maps)), np.ones(len(self.maps), bool)
            )

    oracle = Oracle()
    found = summary(evaluate(oracle, truth(TEST)))  # type: ignore[arg-type]
    assert found["paper_log10_mse"] == 0.0 and found["dgp_mse"] == 0.0 and found["rammg_mse"] == 0.0
    oracle.maps[0, 0, 0] = np.nan
    with pytest.raises(FloatingPointError):
        evaluate(oracle, truth(TEST))  # type: ignore[arg-type]
