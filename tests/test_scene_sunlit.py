"""Compiled loops of the scene search: boxes, the sun through a window, and small systems."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fieldlum.projection import equirect_rays
from fieldlum.scene_fit.guess import Bar, Guess, Solid, WindowRect
from fieldlum.scene_fit.renderer import (
    SHELL,
    LitEntries,
    Surfaces,
    camera_rays,
    lit_entries,
    solid_numbers,
    surfaces,
)
from fieldlum.scene_fit.small_systems import solve_packed
from fieldlum.scene_fit.sunlit import entered, shaded

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


@pytest.mark.authority
def test_packed_systems_have_the_solutions_of_numpy() -> None:
    rng = np.random.default_rng(0)
    root = rng.standard_normal((300, 16, 16))
    matrix = root @ root.transpose(0, 2, 1) + 4.0 * np.eye(16)
    right = rng.standard_normal((300, 16))
    row, column = np.tril_indices(16)
    packed = np.ascontiguousarray(matrix[:, row, column].T.astype(np.float32))
    found = solve_packed(packed, np.ascontiguousarray(right.T.astype(np.float32)))
    expected = np.linalg.solve(matrix, right[..., None])[..., 0]
    # float32 has 7 digits, and the matrices a condition of at most 30
    assert np.allclose(found.T, expected, atol=1e-4)


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


@pytest.mark.analytic
def test_a_cylinder_is_entered_at_its_side_and_top() -> None:
    """A cylinder of radius 1 m around (2, 2), 1 m high: distances by hand."""
    cylinder = solid_numbers(Solid((1.0, 1.0, 0.0), (3.0, 3.0, 1.0), 0.5, is_round=True))
    small = np.float32(1e-9)
    toward = np.array([[1.0, small, small], [0.6, small, -0.8]], np.float32).T
    far = np.full(2, 9.0, np.float32)
    for offset_m, lengths in ((0.0, [2.0]), (0.6, [2.2]), (0.999, [2.955]), (1.01, [])):
        eye = np.array([-1.0, 2.0 + offset_m, 0.5], np.float32)
        rows, found, faces = entered(cylinder, eye, 1.0 / toward, far)
        assert rows.tolist() == [0] * len(lengths)
        assert found == pytest.approx(lengths, abs=2e-3)
        assert faces.tolist() == ([1] if offset_m > 0.9 else [0]) * len(lengths)
    above = np.array([1.4, 2.0, 1.8], np.float32)
    rows, found, faces = entered(cylinder, above, 1.0 / toward, far)
    assert rows.tolist() == [1] and found == pytest.approx([1.0], abs=1e-5) and faces[0] == 2


@pytest.mark.property
def test_a_round_solid_is_nearly_its_slabs() -> None:
    """What a cylinder hides and shades differs from its boxes only near its rim."""
    top = Solid((1.1, 1.0, 0.70), (2.5, 2.2, 0.74), 0.35, is_round=True)
    plain = replace(ROOM, solids=())
    both = [replace(plain, solids=(top,)), replace(plain, solids=tuple(top.boxes()))]
    area = sum((b.high_m[0] - b.low_m[0]) * (b.high_m[1] - b.low_m[1]) for b in top.boxes())
    assert area == pytest.approx(np.pi * 0.7 * 0.6, rel=1e-6)
    rays = equirect_rays(90, 180, 180.0).reshape(-1, 3).astype(np.float32)
    suns = np.array([[0.1, -0.6, 0.8], [-0.5, -0.7, 0.5]], np.float32)
    lit, seen = [], []
    for guess in both:
        ends = surfaces(guess, rays)
        seen.append(ends.surface >= SHELL)
        entries = lit_entries(guess, ends, suns)
        mask = np.zeros((2, len(rays)), bool)
        mask[entries.hour, entries.ray] = True
        lit.append(mask)
    assert seen[0].sum() > 200
    assert (seen[0] != seen[1]).sum() < 0.06 * seen[0].sum()
    assert (lit[0] != lit[1]).sum() < 0.06 * lit[0].sum()


@pytest.mark.property
@pytest.mark.parametrize("shape", [{}, {"arch_m": 0.5}, {"slant_m": -0.4}])
def test_the_order_of_rays_does_not_matter(shape: dict[str, float]) -> None:
    """Rays are left out in blocks of neighbours: other neighbours must give the same pairs."""
    guess = replace(ROOM, windows=(replace(ROOM.windows[0], **shape),))
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
