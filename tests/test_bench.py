"""Benchmarks: tables, charts, stress, and what counts as flagged."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from json_answers import KEPT, keys_of
from learning_room import dataset, write_pairs

from fieldlum.bench import markdown, pareto, stress
from fieldlum.bench.score_rows import load, parse_specs, without_training_hours
from fieldlum.cli import main
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.learn import models

DAYS = ("2027-03-19", "2027-03-20", "2027-03-21", "2027-06-20", "2027-06-21", "2027-12-21")
DATA = dataset(DAYS, height=8)
TEST = dataset(("2027-04-02", "2027-06-25"), seed=1, height=8)


@pytest.mark.slow
@pytest.mark.contract
def test_the_command_writes_table_charts_and_curve(tmp_path: Path) -> None:
    for name, data in (("train", DATA), ("test", TEST)):
        (tmp_path / name).mkdir()
        write_pairs(tmp_path / name, data)
    out = tmp_path / "out"
    asked = ["bench", str(tmp_path / "train/pairs.csv"), "--test", str(tmp_path / "test/pairs.csv")]
    options = ["--models", "mean,nearest,transport,transport:none", "--out", str(out), "--json"]
    result = CliRunner().invoke(main, [*asked, *options])
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert [row["name"] for row in answer["models"]] == [
        "mean",
        "nearest",
        "transport",
        "transport:none",
    ]
    assert answer["chosen"] in {row["name"] for row in answer["models"]}
    train_keys = json.loads(KEPT.read_text(encoding="utf-8"))["train"]
    rows = {key for key in train_keys if key.startswith("models[].")}
    assert rows - {"models[].folds"} <= set(keys_of(answer))
    with (out / "scores.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 4
    assert (out / "scores.png").stat().st_size > 10_000
    assert "| transport:none |" in (out / "bench.md").read_text()
    bad = CliRunner().invoke(main, [*asked, "--models", "magic", "--out", str(out)])
    assert bad.exit_code == 3 and "'magic'" in bad.stderr


@pytest.mark.contract
def test_test_pictures_of_another_size_are_refused_in_one_line(tmp_path: Path) -> None:
    small = dataset(DAYS[:2], height=8).take(range(6))
    for name, data in (("train", small), ("test", dataset(DAYS[3:4], height=6).take(range(3)))):
        (tmp_path / name).mkdir()
        write_pairs(tmp_path / name, data)
    asked = ["bench", str(tmp_path / "train/pairs.csv"), "--test", str(tmp_path / "test/pairs.csv")]
    ran = CliRunner().invoke(main, [*asked, "--models", "mean", "--out", str(tmp_path / "out")])
    assert ran.exit_code == 3 and ran.stderr.splitlines()[-1].count("pixels") == 2, ran.output
    assert "12 x 6 pixels" in ran.stderr and "16 x 8 pixels" in ran.stderr


@pytest.mark.contract
def test_only_pixels_that_were_learnt_are_judged(tmp_path: Path) -> None:
    """A single fisheye sees half of the sphere; test pictures may be of all of it."""
    small = dataset(DAYS[:2], height=8).take(range(6))
    maps = small.luminance_cdm2.copy()
    maps[:, :, :5] = np.nan
    for name, data in (("train", replace(small, luminance_cdm2=maps)), ("test", TEST.take([0]))):
        (tmp_path / name).mkdir()
        write_pairs(tmp_path / name, data)
    read = load(tmp_path / "train/pairs.csv", ["mean"], test=tmp_path / "test/pairs.csv")
    assert read.test is not None and not read.test.seen[:, :5].any()
    assert read.test.seen[:, 5:].all()


@pytest.mark.slow
@pytest.mark.contract
def test_one_usable_hour_is_refused_in_one_line(tmp_path: Path) -> None:
    pairs = write_pairs(tmp_path, DATA.take([20]))
    line = ["bench", str(pairs), "--models", "mean", "--out", str(tmp_path / "out")]
    ran = CliRunner().invoke(main, line)
    assert (ran.exit_code, ran.stderr.count("\n")) == (5, 1), ran.output
    assert "1 usable hour; at least 2" in ran.stderr


@pytest.mark.contract
def test_specs_name_models_patches_and_folders(tmp_path: Path) -> None:
    models.save(tmp_path / "kept", models.fit("mean", DATA), DATA, patch="absolute")
    found = parse_specs(["dense", "transport:gain", str(tmp_path / "kept")])
    assert [(s.label, s.name, s.patch) for s in found] == [
        ("dense", "dense", "absolute"),
        ("transport:gain", "transport", "gain"),
        ("mean (kept)", "mean", "absolute"),
    ]
    with pytest.raises(InputError):
        parse_specs(["transport:half"])


@pytest.mark.slow
@pytest.mark.property
def test_training_hours_are_never_asked() -> None:
    mixed = DATA.take(range(10))
    assert len(without_training_hours(DATA, mixed)) == len(DATA) - 10
    with pytest.raises(NotEnoughDataError):
        without_training_hours(mixed, DATA)


@pytest.mark.slow
@pytest.mark.contract
def test_hours_of_a_kept_model_are_never_asked(tmp_path: Path) -> None:
    """A model trained before knows its own hours, wherever they came from."""
    early, late = DATA.take(range(10)), DATA.take(range(10, 20))
    models.save(tmp_path / "kept", models.fit("mean", early), early, patch="absolute")
    assert set(without_training_hours(DATA, late, tmp_path / "kept").slots) == set(DATA.slots[20:])


@pytest.mark.slow
@pytest.mark.contract
def test_stress_without_a_test_asks_held_out_days(tmp_path: Path) -> None:
    """The nearest hour of a training hour is itself, so an error of nothing would mean
    that it was asked.
    """
    write_pairs(tmp_path, DATA)
    options = [
        "--models",
        "nearest",
        "--render",
        "0",
        "--stress",
        "--out",
        str(tmp_path / "out"),
        "--json",
    ]
    result = CliRunner().invoke(main, ["bench", str(tmp_path / "pairs.csv"), *options])
    assert result.exit_code == 0, result.output
    with (tmp_path / "out/stress.csv").open() as file:
        normal = next(csv.DictReader(file))
    assert int(normal["n_train"]) + int(normal["n_test"]) == len(DATA)
    assert float(normal["log10_mse_weighted"]) > 1e-5


@pytest.mark.slow
@pytest.mark.analytic
def test_the_front_holds_what_nothing_beats() -> None:
    """(3, 3) is beaten by (2, 2)."""
    points = [(3.0, 3.0), (1.0, 5.0), (2.0, 2.0), (9.0, 1.0), (9.5, 1.5)]
    assert pareto(points) == [1, 2, 3]


@pytest.mark.slow
@pytest.mark.contract
def test_markdown_leaves_empty_columns_out() -> None:
    text = markdown([{"a": 1.5e-5, "b": None, "c": True}], {"a": "A", "b": "B", "c": "C"})
    assert text == "| A | C |\n|---|---|\n| 1.50e-05 | yes |\n"


@pytest.mark.slow
@pytest.mark.contract
def test_stress_rows_stand_beside_their_normal_case() -> None:
    spec = parse_specs(["nearest"])[0]
    rows = stress.run(spec, DATA, TEST)
    by_name = {row["regime"]: row for row in rows}
    assert by_name["normal"]["times_normal"] == 1.0
    mixed = "mixed sky: DNI off by 30 %, global kept"
    for name in ("another seed (1)", "pixel noise 5 %", mixed):
        assert np.isfinite(by_name[name]["log10_mse_weighted"])
    assert by_name["another seed (1)"]["times_normal"] == pytest.approx(1.0, abs=1e-6)
    assert by_name["blind down in a third of the days"]["times_normal"] > 1.0


@pytest.mark.slow
@pytest.mark.property
def test_transport_does_not_fail_unseen_in_any_regime() -> None:
    """No wild map may pass that the model trusted and expected to be good, whatever was done to
    the captures.
    """
    rows = stress.run(parse_specs(["transport"])[0], DATA, TEST)
    assert all(np.isfinite(row["log10_mse_weighted"]) for row in rows)
    assert [row["regime"] for row in rows if row["gross_unflagged"]] == []


@pytest.mark.slow
@pytest.mark.analytic
def test_a_turned_north_turns_the_sun_and_a_late_clock_moves_it_on() -> None:
    """15 minutes are 3.75 degrees of hour angle; near the equinox noon that is over 4
    degrees of azimuth.
    """
    turned = stress.wrong_north(TEST, 2.0)
    np.testing.assert_allclose(
        (turned.light.sun_azimuth_deg - TEST.light.sun_azimuth_deg) % 360.0, 2.0, atol=1e-9
    )
    late = stress.late_clock(TEST, 15.0)
    moved = (late.light.sun_azimuth_deg - TEST.light.sun_azimuth_deg) % 360.0
    assert (moved > 1.5).all() and (moved < 12.0).all()


@pytest.mark.slow
@pytest.mark.contract
def test_irradiance_changes_keep_what_they_say_they_keep() -> None:
    light = DATA.light
    rise = np.sin(np.radians(light.sun_altitude_deg))
    for changed in (stress.disagreeing(DATA, 0.3, 1), stress.from_global(DATA)):
        total = changed.light.dni_wm2 * rise + changed.light.dhi_wm2
        np.testing.assert_allclose(total, light.dni_wm2 * rise + light.dhi_wm2, rtol=0.02, atol=2.0)
        assert np.abs(changed.light.dni_wm2 - light.dni_wm2).max() > 20.0
