"""Compiled loops of the scene search: boxes, the sun through a window, and small systems."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fieldlum.room.fit.guess import Bar, Guess, Solid, WindowRect
from fieldlum.room.fit.renderer import (
    LitEntries,
    Surfaces,
    camera_rays,
    lit_entries,
    solid_numbers,
    surfaces,
)
from fieldlum.room.fit.sunlit import entered, shaded

pytestmark = pytest.mark.slow

ROOM = Guess(
    (4.0, 5.0, 3.0),
    (2.0, 3.0, 1.4),
    180.0,
    0.3,
    (WindowRect("south", (0.8, 3.2), (0.8, 2.6), 0.88),),
    (Bar(0, True, (1.9, 2.0), (0.1, 0.2)),),
    (Solid((0.5, 1.0, 0.0), (1.5, 1.8, 0.7), 0.4),),
)


@pytest.mark.analytic
def test_a_ray_enters_a_box_at_its_near_face_but_not_from_within() -> None:
    solid = ROOM.solids[0]
    numbers = solid_numbers(solid)
    toward = np.array([[-0.6, 0.0, -0.8], [1.0, 0.0, 0.0]], np.float32)
    rays = camera_rays(ROOM, toward @ ROOM.camera_turn.astype(np.float32))
    eye = np.array([1.5 + 0.6, 1.4, 0.35 + 0.8], np.float32)  # 1 m from the middle of the face x
    rows, lengths, faces = entered(numbers, eye, rays.inverse, np.full(2, 9.0, np.float32))
    assert rows.tolist() == [0] and faces.tolist() == [0]
    assert lengths == pytest.approx([1.0], abs=1e-5)
    inside = np.array([1.0, 1.4, 0.3], np.float32)
    assert not len(entered(numbers, inside, rays.inverse, np.full(2, 9.0, np.float32))[0])


@pytest.mark.analytic
def test_a_box_shades_what_is_behind_it() -> None:
    box = solid_numbers(Solid((1.0, 1.0, 0.0), (2.0, 2.0, 1.0), 0.5))
    suns = np.array([[0.6, 0.0, 0.8]], np.float32)
    behind = np.array([[0.5, 1.5, 0.0], [0.5, 2.5, 0.0], [1.5, 1.5, 1.0]], np.float32)
    hour, ray = np.zeros(3, np.intp), np.arange(3)
    # at x = 1 the line is 0.67 m high, below the top; the second passes beside, the third is on top
    assert shaded(box, behind, suns, hour, ray).tolist() == [True, False, False]


@pytest.mark.property
def test_the_order_of_rays_does_not_matter() -> None:
    """Rays are left out in blocks of neighbours: other neighbours must give the same pairs."""
    guess = ROOM
    rng = np.random.default_rng(1)
    world = rng.standard_normal((3000, 3))
    world /= np.linalg.norm(world, axis=1, keepdims=True)
    ends = surfaces(guess, world.astype(np.float32), 0.01)
    altitude, azimuth = np.radians(rng.uniform((5, -60), (60, 60), (12, 2))).T
    suns = np.stack(
        [np.sin(azimuth) * np.cos(altitude), -np.cos(azimuth) * np.cos(altitude), np.sin(altitude)],
        axis=1,
    ).astype(np.float32)
    order = rng.permutation(len(world))
    mixed = Surfaces(
        ends.position_m[order],
        ends.axis[order],
        ends.sign[order],
        ends.surface[order],
        ends.spread_m[order],
    )
    plain, other = lit_entries(guess, ends, suns), lit_entries(guess, mixed, suns)
    assert len(plain.hour) > 500
    assert _table(plain) == _table(replace(other, ray=order[other.ray]))


def _table(lit: LitEntries) -> dict[tuple[int, int], float]:
    keys = zip(lit.hour.tolist(), lit.ray.tolist(), strict=True)
    return dict(zip(keys, lit.strength.tolist(), strict=True))
