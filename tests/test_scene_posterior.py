"""A fitted room, from its file to the prediction of a year."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from learning_room import SEATTLE, dataset, write_pairs

import fieldlum
from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.records import CameraSetup, Room, SiteFile, Window
from fieldlum.learn import models
from fieldlum.learn.models.baselines import fit_mean
from fieldlum.learn.models.training_data import Dataset
from fieldlum.room.fit.apply_scene import apply_scene
from fieldlum.room.fit.scene_file import Scene, read_scene, write_scene
from fieldlum.year.predict.hour_blocks import room_of

ROOM = Room(
    width_m=5.0,
    depth_m=6.0,
    height_m=3.0,
    camera_x_m=2.4,
    camera_y_m=2.0,
    camera_z_m=1.3,
    wall_azimuth_deg=359.9,
    window=(Window("south", 0.6, 3.6, 0.8, 1.9, 0.85, 1, 0.0, 0.0),),
)
SETUP = SiteFile(SEATTLE, CameraSetup(heading_deg=180.0), ROOM)
DAYS = ("2027-03-20", "2027-06-21", "2027-12-21")


def _scene(room: Room) -> Scene:
    turned = replace(room, camera_x_m=2.5)
    return Scene(1.0, 0.0, turned, "fitted", "tested", 180.0, room)


def _captures(room: Room) -> Dataset:
    data = dataset(DAYS)
    return replace(data, patch_cdm2=None, setup=replace(SETUP, room=room))


@pytest.mark.contract
def test_the_fitted_room_reaches_the_prediction(tmp_path: Path) -> None:
    room = replace(ROOM, wall_azimuth_deg=180.0)
    scene = _scene(room)
    write_scene(tmp_path / "scene", scene)
    assert read_scene(tmp_path / "scene") == scene
    captures = _captures(room)
    data, patch = apply_scene(captures, tmp_path / "pairs.csv", "", "absolute")
    assert patch == "absolute" and data.setup.room == scene.room
    models.save(tmp_path / "model", fit_mean(data), data, patch=patch)
    config = models.read_config(tmp_path / "model")
    made_with = room_of(config, tmp_path / "model")
    assert made_with.setup.room == scene.room
    assert made_with.heading_deg == pytest.approx(181.0)


@pytest.mark.slow
@pytest.mark.contract
def test_bench_takes_a_scene_for_its_test_hours_too(tmp_path: Path) -> None:
    for name in ("train", "test"):
        (tmp_path / name).mkdir()
        write_pairs(tmp_path / name, dataset(DAYS[:2] if name == "train" else DAYS[2:]))
    asked = ["bench", str(tmp_path / "train/pairs.csv"), "--test", str(tmp_path / "test/pairs.csv")]
    more = ["--models", "mean", "--render", "0", "--out", str(tmp_path / "out")]
    ran = CliRunner().invoke(main, [*asked, *more, "--scene", str(tmp_path)])
    assert ran.exit_code == 3 and "scene fit" in ran.output
    scene = _scene(ROOM)
    write_scene(tmp_path / "train" / "scene", scene)  # of another [room] than site.toml states
    ran = CliRunner().invoke(main, [*asked, *more])
    assert ran.exit_code == 3 and "another [room]" in ran.output, ran.output
    ran = CliRunner().invoke(main, [*asked, *more, "--scene", "none"])
    assert ran.exit_code == 0, ran.output


@pytest.mark.contract
def test_the_python_api_uses_the_scene_as_train_does(tmp_path: Path) -> None:
    write_pairs(tmp_path, dataset(DAYS[:2]))
    pairs = tmp_path / "pairs.csv"
    assert fieldlum.load_pairs(pairs).scene is None
    write_scene(tmp_path / "scene", _scene(ROOM))  # of another [room] than site.toml states
    with pytest.raises(InputError, match=r"another \[room\]"):
        fieldlum.load_pairs(pairs)
    assert fieldlum.load_pairs(pairs, scene="none").scene is None
    with pytest.raises(InputError, match="scene fit"):
        fieldlum.load_pairs(pairs, scene=str(tmp_path))
