"""One wall of a scene moves, and all else stays where the camera sees it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fieldlum.records import Room, Window
from fieldlum.scene.geometry import WALLS
from fieldlum.scene.view import pixel_rays
from fieldlum.scene_fit.guess import Bar, Guess, Solid, guess_of
from fieldlum.scene_fit.renderer import surfaces
from fieldlum.scene_fit.wall_moves import with_best_walls, with_wall_moved

ROOM = Room(
    width_m=4.6,
    depth_m=6.2,
    height_m=2.9,
    camera_x_m=2.2,
    camera_y_m=2.8,
    camera_z_m=1.4,
    window=(Window("south", 0.6, 3.0, 0.8, 1.7), Window("west", 1.5, 1.2, 0.9, 1.2)),
)
GUESS = replace(
    guess_of(ROOM),
    bars=(Bar(0, True, (2.0, 2.1), (0.1, 0.2)), Bar(1, True, (2.0, 2.1), (0.1, 0.2))),
    solids=(Solid((3.0, 3.5, 0.0), (3.8, 4.4, 0.7), 0.3),),
)
RAYS = pixel_rays(40, 180.0, 1)[1].astype(np.float32)


@pytest.mark.analytic
@pytest.mark.parametrize("wall", WALLS)
def test_only_the_wall_moves(wall: str) -> None:
    """Rays end at the same places from the camera, but for those that end on the moved wall."""
    before = surfaces(GUESS, RAYS)
    moved = with_wall_moved(GUESS, wall, 0.1)
    after = surfaces(moved, RAYS)
    off = (after.position_m - np.array(moved.camera_m, np.float32)) - (
        before.position_m - np.array(GUESS.camera_m, np.float32)
    )
    axis, side = WALLS[wall]
    edge = moved.size_m[axis] if side else 0.0
    is_moved = np.isclose(after.position_m[:, axis], edge, atol=1e-4)
    grows = np.abs(off).max(axis=1) > 1e-4
    assert not (grows & ~is_moved & (after.surface == before.surface)).any()
    hits = is_moved & (after.surface == before.surface)
    outward = 1.0 if side else -1.0
    assert hits.sum() > 50
    np.testing.assert_allclose(off[hits, axis], 0.1 * outward, atol=1e-3)


@pytest.mark.property
@pytest.mark.parametrize("wall", WALLS)
def test_a_move_and_back_changes_nothing(wall: str) -> None:
    back = with_wall_moved(with_wall_moved(GUESS, wall, 0.13), wall, -0.13)
    assert np.allclose(back.size_m, GUESS.size_m) and np.allclose(back.camera_m, GUESS.camera_m)
    for one, other in zip(back.windows, GUESS.windows, strict=True):
        assert np.allclose(one.u_m, other.u_m)
    for bar, same in zip(back.bars, GUESS.bars, strict=True):
        assert np.allclose(bar.span_m, same.span_m)
    assert with_wall_moved(GUESS, wall, -10.0) is GUESS


@pytest.mark.analytic
def test_a_displaced_wall_is_found() -> None:
    """The cost compares where rays end, from the camera, with the true room."""
    true = surfaces(GUESS, RAYS).position_m - np.array(GUESS.camera_m, np.float32)

    def cost(guess: Guess) -> float:
        ends = surfaces(guess, RAYS).position_m - np.array(guess.camera_m, np.float32)
        return float(np.abs(ends - true).mean())

    wrong = with_wall_moved(with_wall_moved(GUESS, "west", -0.1), "south", 0.07)
    found = with_best_walls(cost, wrong)
    assert np.allclose(found.size_m, GUESS.size_m, atol=0.01)
    assert np.allclose(found.camera_m, GUESS.camera_m, atol=0.01)
