"""Choosing and keeping a model: folds, the one-standard-error rule, the command."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from learning_room import dataset, room, write_pairs

from fieldlum.cli import main
from fieldlum.core.arrays import Floats32
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.progress import progress, shown_by
from fieldlum.learn import models, train
from fieldlum.learn.models import dense
from fieldlum.learn.models.dense import validation_split
from fieldlum.learn.models.scores import expect_year, light_of_year
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.train import (
    day_folds,
    evaluate_folds,
    fit_and_score,
    notes_of,
    run,
    year_of,
)
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.sky.daylight import Light

DAYS = ("2027-03-19", "2027-03-20", "2027-03-21", "2027-06-20", "2027-06-21", "2027-06-22")
DATA = dataset(DAYS, height=8)
KEYS = {
    "name",
    "fit_s",
    "predict_s_per_map",
    "n_train",
    "n_test",
    "seed",
    "log10_mse_weighted",
    "rer_weighted",
    "paper_log10_mse",
    "paper_rer",
    "dgp_mse",
    "rammg_mse",
}


@pytest.mark.property
def test_no_day_is_on_both_sides_and_every_hour_is_asked_once() -> None:
    folds = day_folds(DATA)
    assert len(folds) == 5
    for fold in folds:
        assert not set(DATA.days[~fold]) & set(DATA.days[fold])
    assert (np.sum(folds, axis=0) == 1).all()


@pytest.mark.contract
def test_one_day_is_parted_by_hours_and_said_so() -> None:
    day = DATA.take(DATA.days == DATA.days[0])
    assert "one day" in notes_of(day, "absolute", "mean", [])[-1] and len(day_folds(day)) > 1
    with pytest.raises(NotEnoughDataError):
        fit_and_score(day.take([0]), "mean")


@pytest.mark.slow
@pytest.mark.contract
def test_auto_goes_on_without_a_model_that_needs_more_hours() -> None:
    """Three hours: two to learn from are too few for transport, and that is said."""
    result = fit_and_score(DATA.take(range(3)), "auto", budget_s=2.0)
    assert result.choice.name in {"mean", "nearest", "dense"}
    assert any(note.startswith("transport was not tried") for note in result.notes)


@pytest.mark.slow
@pytest.mark.contract
def test_run_keeps_a_model_its_scores_and_says_why(tmp_path: Path) -> None:
    answer = run(DATA, "nearest", out=tmp_path)
    assert {row["name"] for row in answer["models"]} == {"mean", "nearest"}
    assert all(set(row) >= KEYS for row in answer["models"])
    assert json.loads((tmp_path / "scores.json").read_text())["chosen"] == "nearest"
    config = json.loads((tmp_path / "config.json").read_text())
    assert (
        config["training"]["slots"] == list(DATA.slots)
        and config["setup"]["site"]["name"] == "Test room"
    )
    assert models.load(tmp_path).name == "nearest"


@pytest.mark.slow
@pytest.mark.analytic
def test_a_year_is_expected_to_be_harder_than_held_out_days_of_one_season() -> None:
    march = dataset(("2027-03-17", "2027-03-18", "2027-03-19", "2027-03-20"))
    result = fit_and_score(march, "transport", patch="none")
    assert result.year is not None
    held_out = result.table(0)[-1]["log10_mse_weighted"]
    year = light_of_year(result.data, np.random.default_rng(5))
    maps = result.fitted.predict(year).luminance_cdm2
    weights = equirect_solid_angles(*march.shape) / (4.0 * np.pi)
    error = float((weights * np.log10(maps / room(year)[0]) ** 2).sum(axis=(1, 2)).mean())
    assert error > 5.0 * held_out
    assert 3.0 * held_out < result.year.expected_log10_mse < 1.5 * error
    assert result.year.trusted_share < 0.8


@pytest.mark.contract
def test_only_captures_without_a_scene_are_advised_to_get_a_room() -> None:
    bare = replace(DATA, patch_cdm2=None)
    chosen = replace(bare, scene={"chosen": "none"})
    advice = [
        any("add a [room]" in n for n in notes_of(d, "none", "mean", ())) for d in (bare, chosen)
    ]
    assert advice == [True, False]


@pytest.mark.contract
def test_a_year_is_not_judged_without_a_room_for_its_patches() -> None:
    fitted = models.fit("transport", DATA)
    assert year_of(fitted, DATA, "absolute", 0) is None
    assert year_of(models.fit("mean", DATA), DATA, "none", 0) is None


@pytest.mark.property
def test_held_out_errors_are_those_of_a_fit_without_the_day() -> None:
    folds = day_folds(DATA)
    by_hand = models.fit("nearest", DATA.take(~folds[1]))
    check = DATA.take(folds[1])
    maps = by_hand.predict(check.light, check.patch_cdm2).luminance_cdm2
    error = np.log10(np.maximum(maps, 1)) - np.log10(np.maximum(check.luminance_cdm2, 1))
    found = evaluate_folds("nearest", DATA, folds, patch="absolute", seed=0)
    rows = [found.scores.slots.index(slot) for slot in check.slots]
    np.testing.assert_allclose(found.scores.mse[rows], (error**2).mean(axis=(1, 2)), rtol=1e-4)
    assert found.n_train == round(np.mean([(~fold).sum() for fold in folds]))


@pytest.mark.slow
@pytest.mark.contract
def test_a_short_budget_still_trains_the_network(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    few = DATA.take(np.flatnonzero(np.isin(DATA.days, np.unique(DATA.days)[:2]))[::2])
    monkeypatch.setattr(dense.Trainer, "pixels_per_s", lambda *_: 4e1)  # under any load
    monkeypatch.setattr(dense, "EPOCHS", 2)
    # by a clock that stands still, so that only the network itself takes time
    monkeypatch.setattr(train, "monotonic", lambda: 0.0)
    answer = run(few, "dense", budget_min=10.0, out=tmp_path)
    row = next(row for row in answer["models"] if row["name"] == "dense")
    assert row["log10_mse_weighted"] > 0.0
    assert not list(tmp_path.glob("checkpoint*"))
    assert models.load(tmp_path).name == "dense"


@pytest.mark.property
@pytest.mark.parametrize(("passes", "begins"), [(0.9, False), (20.0, True)])
def test_a_network_without_time_for_a_pass_is_not_trained(
    monkeypatch: pytest.MonkeyPatch, passes: float, begins: bool
) -> None:
    few = DATA.take(range(0, len(DATA), 6))
    teach, _ = validation_split(len(few), 0)
    per_s = passes * len(teach) * few.luminance_cdm2[0].size / 590.0
    monkeypatch.setattr(dense.Trainer, "pixels_per_s", lambda *_: per_s)
    if begins:

        def progress(*_: object) -> None:
            raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt), shown_by(progress):
            dense.fit(few, budget_s=600.0)
        return
    with pytest.raises(NotEnoughDataError, match="raise --budget"):
        dense.fit(few, budget_s=600.0)


@pytest.mark.slow
@pytest.mark.contract
def test_the_command(tmp_path: Path) -> None:
    path = write_pairs(tmp_path, DATA)
    runner = CliRunner()
    result = runner.invoke(main, ["train", str(path), "--model", "nearest", "--json"])
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert answer["chosen"] == "nearest" and set(answer["models"][0]) >= KEYS
    assert (tmp_path / "models" / "nearest" / "config.json").is_file()
    shown = runner.invoke(
        main, ["train", str(path), "--model", "mean", "--out", str(tmp_path / "m")]
    )
    assert "chosen: mean" in shown.stdout
    assert runner.invoke(main, ["train", str(tmp_path / "none.csv")]).exit_code == 3
    assert runner.invoke(main, ["train", str(path), "--budget", "0"]).exit_code == 2
    path.write_text("\n".join(path.read_text().splitlines()[:2]))
    assert runner.invoke(main, ["train", str(path), "--model", "mean"]).exit_code == 5


@pytest.mark.slow
@pytest.mark.contract
def test_a_model_of_the_same_captures_and_options_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Other captures, options, weights or arrays train again, and so does `force`."""
    out, few = tmp_path / "m", DATA.take(range(0, len(DATA), 6))

    def kept(data: Dataset = few, **options: Any) -> bool:
        return run(data, "mean", out=out, **options)["kept"]

    assert [kept(), kept()] == [False, True]
    assert [kept(seed=1), kept(seed=1), kept(seed=1, force=True)] == [False, True, False]
    darker = replace(few, luminance_cdm2=few.luminance_cdm2 * np.float32(0.99))
    assert [kept(darker, seed=1), kept(darker, seed=1)] == [False, True]
    assert kept(replace(darker, source="elsewhere/pairs.csv"), seed=1)
    (out / "weights.npz").write_bytes(b"damaged")
    assert [kept(darker, seed=1), kept(darker, seed=1)] == [False, True]
    with monkeypatch.context() as other_version:
        other_version.setattr("fieldlum.learn.models.baselines.from_state", lambda: None)
        assert not kept(darker, seed=1)
    (out / "scores.json").unlink()
    assert not kept(darker, seed=1)


@pytest.mark.contract
def test_the_error_of_a_year_is_one_count(monkeypatch: pytest.MonkeyPatch) -> None:
    def patches(data: Dataset, light: Light) -> Floats32:
        progress(1, 2, "sun patches")
        return np.zeros((len(light), *data.seen.shape), np.float32)

    monkeypatch.setattr(Dataset, "patches", patches)
    data = replace(DATA, patch_cdm2=np.zeros_like(DATA.luminance_cdm2))
    shown: list[tuple[int, int, str]] = []
    with shown_by(lambda *line: shown.append(line)):
        expect_year(models.fit("mean", data), data, np.random.default_rng(0))
    assert {line[1:] for line in shown} == {(150, "error of a year")}


@pytest.mark.slow
@pytest.mark.property
def test_the_budget_is_the_networks_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of it is for five folds, half for the stored network; quick models get all folds."""
    spent_s: list[float] = []

    def fit(name: str, data: Dataset, **options: Any) -> models.Fitted:
        if name == "dense":
            spent_s.append(options["budget_s"])
        return real("nearest" if name == "dense" else "mean", data, patch="none", seed=0)

    real = models.fit
    monkeypatch.setattr(models, "fit", fit)
    answer = run(DATA, "dense", budget_min=5.0, out=tmp_path)
    assert spent_s == pytest.approx([30.0] * 5 + [150.0])
    assert {row["folds"] for row in answer["models"]} == {5}


@pytest.mark.contract
def test_a_state_of_one_day_is_named_as_not_scored() -> None:
    """Held-out days have no other capture with it, so its error rises once it is marked."""
    of_day = np.array([str(day) == DAYS[1] for day in DATA.days])
    twice = of_day | (DATA.days == np.datetime64(DAYS[4]))
    states = tuple(
        ";".join(filter(None, ("blind=down" * int(a), "lamp=on" * int(b))))
        for a, b in zip(of_day, twice, strict=True)
    )
    marked = replace(DATA, light=replace(DATA.light, states=states))
    notes = [note for note in notes_of(marked, "absolute", "mean", ()) if "one day" in note]
    assert notes == ["blind=down was captured on one day only: held-out days cannot score it"]
    one_day = marked.take(of_day)
    assert not any("score it" in note for note in notes_of(one_day, "absolute", "mean", ()))
