"""With few clear hours and no scene, captures choose between the stated box and no sun patch."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_captures import ROOM, window_captures

from fieldlum.bench import score_rows
from fieldlum.core.records import Room, Site
from fieldlum.learn.models.training_data import Dataset
from fieldlum.room.fit.apply_scene import with_patches
from fieldlum.room.fit.stated_box import judge_box, with_judged_box, with_same_box

HEIGHT = 24
SITE = Site("test room", 47.6, -122.3, "America/Los_Angeles")
SHIFTED = replace(ROOM, window=(replace(ROOM.window[0], wall="east"),))


@pytest.fixture(scope="module")
def captures() -> Dataset:
    """Four clear hours and eight overcast ones of a room."""

    every = window_captures(SITE, HEIGHT)
    clear = np.flatnonzero((every.light.dni_wm2 > 0.0) & (every.light.sun_altitude_deg > 15.0))
    overcast = np.flatnonzero(every.light.dni_wm2 == 0.0)
    return every.take(np.sort(np.concatenate([clear[1:20:5], overcast])))


def _stated(captures: Dataset, room: Room) -> Dataset:
    return replace(captures, setup=replace(captures.setup, room=room))


@pytest.mark.property
def test_a_box_that_explains_the_patches_is_used_and_learnt_robustly(captures: Dataset) -> None:
    judged, patch = with_judged_box(captures, "absolute")
    assert patch == "absolute" and judged.patch_cdm2 is not None
    assert judged.scene is not None
    assert judged.notes[-1].startswith("stated [room]: misfit of sun patches")


@pytest.mark.property
def test_a_box_that_explains_no_patch_is_not_used(captures: Dataset) -> None:
    judged, patch = with_judged_box(_stated(captures, SHIFTED), "absolute")
    assert patch == "none" and judged.patch_cdm2 is None
    assert judged.notes[-1].startswith("no sun patch: ")
    assert "capture 12 clear hours for a trusted scene" in judged.notes[-1]


@pytest.mark.property
def test_without_a_clear_hour_the_box_is_used_untested(captures: Dataset) -> None:
    overcast = captures.take(captures.light.dni_wm2 == 0.0)
    judged, patch = with_judged_box(overcast, "absolute")
    assert patch == "absolute" and "no capture has direct sun" in judged.notes[-1]
    assert judged.scene is not None


@pytest.mark.property
def test_other_captures_do_not_change(captures: Dataset) -> None:
    rendered = _stated(captures, replace(ROOM, kind="radiance", file="room.rad"))
    bare = _stated(captures, replace(ROOM, window=()))
    for data, patch in ((captures, "none"), (rendered, "absolute"), (bare, "absolute")):
        same, mode = with_judged_box(data, patch)
        assert same is data and mode == patch
    assert captures.patch_cdm2 is None
    other = with_patches(_stated(captures, SHIFTED)).patch_cdm2  # of a 3D model
    modelled = replace(captures, patch_cdm2=other)
    assert with_judged_box(modelled, "absolute")[0] is modelled
    for own in (captures, with_patches(captures)):
        assert with_judged_box(own, "absolute")[0].scene is not None
    more = captures.take(np.tile(np.arange(len(captures)), 3))  # twelve clear hours
    assert judge_box(more, ROOM) is None
    assert with_judged_box(more, "absolute")[0] is more


@pytest.mark.property
@pytest.mark.parametrize(("room", "chosen"), [(ROOM, "stated"), (SHIFTED, "none")])
def test_bench_uses_the_choice_of_train_for_all_its_captures(
    captures: Dataset, room: Room, chosen: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given = _stated(captures, room)
    trained, _ = with_judged_box(given, "absolute")
    monkeypatch.setattr(score_rows, "load_pairs", lambda *_, **__: given)
    monkeypatch.setattr(score_rows, "without_training_hours", lambda test, *_: test)
    loaded = score_rows.load(tmp_path / "pairs.csv", ["mean"], test=tmp_path / "test.csv")
    assert loaded.test is not None and loaded.data.scene is not None
    assert loaded.data.scene["chosen"] == chosen and loaded.data.notes[-1] == trained.notes[-1]
    for data in (loaded.data, loaded.test):
        if chosen == "none":
            assert data.patch_cdm2 is None
        else:
            assert data.patch_cdm2 is not None and trained.patch_cdm2 is not None
            np.testing.assert_array_equal(data.patch_cdm2, trained.patch_cdm2)


@pytest.mark.property
def test_captures_to_predict_keep_their_patches_if_train_decided_nothing(captures: Dataset) -> None:
    own = with_patches(captures)
    assert with_same_box(own, captures) is own
