"""Captures that no scene can explain are refused in one line, before anything is written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_captures import ROOM, window_captures

from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Site
from fieldlum.learn.models.training_data import Dataset
from fieldlum.room.fit.misplaced_patches import misplacement_of
from fieldlum.room.fit.stage import run
from fieldlum.room.fit.turned_windows import check_captures

HEIGHT = 32
SITE = Site("test room", 47.6, -122.3, "America/Los_Angeles")


@pytest.fixture(scope="module")
def captures() -> Dataset:
    """Clear and overcast hours of a room: skylight, a bright window, the sun's own light."""

    return window_captures(SITE, HEIGHT)


@pytest.mark.property
def test_captures_of_the_stated_room_pass(captures: Dataset) -> None:
    check_captures(captures, ROOM)
    check_captures(captures.take(np.arange(4)), ROOM)  # too few to show a pattern


@pytest.mark.analytic
def test_a_camera_heading_off_by_180_degrees_is_refused(captures: Dataset, tmp_path: Path) -> None:
    turned = replace(captures, heading_deg=0.0)
    with pytest.raises(InputError, match=r"windows about -180 degrees.*nothing was written"):
        run(turned, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()
    found = misplacement_of(
        replace(turned, patch_cdm2=np.zeros_like(turned.luminance_cdm2)), "absolute"
    )
    assert found is not None and "-180 degrees" in found.note


@pytest.mark.analytic
def test_a_compass_read_backwards_is_refused(captures: Dataset, tmp_path: Path) -> None:
    setup = replace(captures.setup, room=replace(ROOM, wall_azimuth_deg=0.0))
    turned = replace(captures, heading_deg=0.0, setup=setup)
    with pytest.raises(NotEnoughDataError, match="check that wall_azimuth_deg is not turned"):
        run(turned, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()


@pytest.mark.contract
def test_a_room_without_windows_is_refused(captures: Dataset, tmp_path: Path) -> None:
    for room in (replace(ROOM, window=()), replace(ROOM, kind="radiance", file="room.rad")):
        bare = replace(captures, setup=replace(captures.setup, room=room))
        with pytest.raises(InputError, match="a box with a window"):
            run(bare, tmp_path / "scene")
    none = replace(captures, setup=replace(captures.setup, room=None))
    with pytest.raises(InputError, match=r"no \[room\]"):
        run(none, tmp_path / "scene")
    assert not (tmp_path / "scene").exists()
