"""Compiled loops that scenes and scene fits share: boxes on rays, and the sun on points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fieldlum.core.records import Obstruction, Room, Window
from fieldlum.room.fit.guess import Guess, guess_of
from fieldlum.room.fit.renderer import Surfaces, surfaces, unit_patches
from fieldlum.room.scene import build
from fieldlum.room.scene.trace import nearest_box, sun_points

ROOM = Room(
    width_m=4.0,
    depth_m=5.0,
    height_m=3.0,
    camera_x_m=2.0,
    camera_y_m=3.0,
    camera_z_m=1.4,
    window=(Window("south", 0.8, 2.4, 0.8, 1.8, 0.88, 2, 0.1),),
    obstruction=(Obstruction(0.5, 1.0, 0.0, 1.0, 0.8, 0.7, 0.4),),
)


def _guess() -> Guess:
    return guess_of(ROOM)


@pytest.mark.analytic
def test_a_ray_enters_a_box_at_its_near_face_but_not_from_within() -> None:
    low, high = np.array([[0.5, 1.0, 0.0]]), np.array([[1.5, 1.8, 0.7]])
    toward = np.array([[-0.6, 0.0, -0.8], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    # 1 m from the middle of the face x, within the box, and beside it
    eye = np.array([[2.1, 1.4, 1.15], [1.0, 1.4, 0.3], [3.0, 1.4, 0.3]])
    distance, box, axis, sign = nearest_box(low, high, eye, toward)
    assert box.tolist() == [0, -1, -1] and axis[0] == 0 and sign[0] == 1
    assert distance[0] == pytest.approx(1.0) and np.isinf(distance[1:]).all()


@pytest.mark.analytic
def test_a_box_shades_what_is_behind_it() -> None:
    """At x = 1 the line is 0.27 m high, below the top; the second passes beside the box."""
    box = Obstruction(1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 0.5)
    room = replace(ROOM, window=(Window("east", 0.0, 5.0, 0.0, 3.0),), obstruction=(box,))
    at = np.array([[0.5, 1.5, 0.0], [0.5, 2.5, 0.0], [1.5, 1.5, 1.0]])
    up, one = np.full(3, 2), np.ones(3, int)
    points = sun_points(build(room), at, up, one, one.astype(float), np.arange(3), 3)
    lit = points.direct(np.array([0.88, 0.0, 0.475]))
    assert (lit > 0.3).tolist() == [False, True, True]


@pytest.mark.property
def test_the_order_of_rays_does_not_matter() -> None:
    guess = _guess()
    rng = np.random.default_rng(1)
    world = rng.standard_normal((3000, 3))
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    ends = surfaces(guess, world.astype(np.float32), 0.01)
    altitude, azimuth = np.radians(rng.uniform((5, -60), (60, 60), (12, 2))).T
    across = np.cos(altitude)
    suns = np.stack([np.sin(azimuth) * across, -np.cos(azimuth) * across, np.sin(altitude)], axis=1)
    order = rng.permutation(len(world))
    mixed = Surfaces(
        ends.position_m[order],
        ends.axis[order],
        ends.sign[order],
        ends.surface[order],
        ends.spread_m[order],
    )
    plain = unit_patches(guess, ends, suns, np.arange(len(world)), 1, np.ones(len(world)))
    other = unit_patches(guess, mixed, suns, order, 1, np.ones(len(world)))
    assert (plain > 0.0).sum() > 500
    np.testing.assert_allclose(plain, other, rtol=1e-6)
