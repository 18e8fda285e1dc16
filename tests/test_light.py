"""Light features, their kernel and the greedy choice of hours."""

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from learning_room import scaled
from places import SEATTLE

from fieldlum.core.records import Room, Window
from fieldlum.sky.daylight import Light, light_at
from fieldlum.sky.light_similarity import (
    Facades,
    Kernel,
    facades_of,
    light_features,
)


def some_light(count: int = 40, seed: int = 1) -> Light:
    rng = np.random.default_rng(seed)
    start = datetime(2027, 3, 1, 15, 30, tzinfo=UTC)
    times = [
        start + timedelta(days=int(d), hours=int(h))
        for d, h in zip(rng.integers(0, 300, count), rng.integers(0, 9, count), strict=True)
    ]
    return light_at(times, SEATTLE, rng.uniform(0, 800, count), rng.uniform(20, 300, count))


LIGHT = some_light()


def one_facade(azimuth_deg: float) -> Facades:
    return Facades(np.array([azimuth_deg % 360.0]), np.ones(1))


KERNELS = [Kernel(one_facade(180)), Kernel(facades_of(None))]


@pytest.mark.analytic
def test_light_divides_into_sky_and_sun() -> None:
    assert LIGHT.sky_cdm2.shape == (40, 2305)
    # The patch sum is the Perez diffuse illuminance but for the quadrature of 145 against 2305
    # points, and the blend of the lowest band into the ground.
    assert np.allclose(LIGHT.diffuse_lx, LIGHT.sky.diffuse_lx, rtol=0.05)
    assert np.allclose(LIGHT.total_lx, LIGHT.diffuse_lx + LIGHT.direct_lx)


@pytest.mark.property
def test_features_do_not_change_with_brightness() -> None:
    for once, twice in zip(*(_parts(light) for light in (LIGHT, scaled(LIGHT, 2.0))), strict=True):
        assert np.allclose(once, twice, rtol=1e-5)


def _parts(light: Light) -> list[np.ndarray]:
    f = light_features(light)
    return [f.sky, f.beam, f.direction]


@pytest.mark.property
@pytest.mark.parametrize("kernel", KERNELS)
def test_kernel_is_a_covariance(kernel: Kernel) -> None:
    f = light_features(LIGHT)
    k = kernel(f, f)
    assert np.allclose(k, k.T, atol=1e-5)
    assert np.linalg.eigvalsh(k).min() > -1e-4
    assert np.allclose(np.diagonal(k), kernel.diagonal(f), rtol=1e-4)


@pytest.mark.analytic
def test_facades_follow_the_room() -> None:
    room = Room(
        wall_azimuth_deg=200, window=(Window("south", 1, 3, 1, 2), Window("west", 1, 3, 1, 1))
    )
    facades = facades_of(room)
    assert facades.azimuths_deg.tolist() == [200.0, 290.0]
    assert np.allclose(facades.weights, [1.0, np.sqrt(0.5)])
    assert len(facades_of(None).weights) == 8
    assert np.allclose(Facades(np.array([90.0]), np.ones(1)).normals, [[1, 0, 0]], atol=1e-12)


@pytest.mark.analytic
def test_sun_behind_the_facade_teaches_little() -> None:
    f = light_features(
        light_at(
            [datetime(2027, 6, 21, 13, 0, tzinfo=UTC)],
            SEATTLE,
            np.array([500.0]),
            np.array([100.0]),
        )
    )
    sun_only = {"constant": 0.0, "sky": 0.0}
    behind = Kernel(one_facade(f_azimuth(f) + 180), **sun_only).diagonal(f)
    front = Kernel(one_facade(f_azimuth(f)), **sun_only).diagonal(f)
    assert behind[0] < 0.02 * front[0]


def f_azimuth(f: object) -> float:
    x, y, _ = f.direction[0]  # pyright: ignore
    return float(np.degrees(np.arctan2(x, y)))


@pytest.mark.contract
def test_index_by_slice_mask_and_list_agree() -> None:
    a, b, c = LIGHT[2:5], LIGHT[[2, 3, 4]], LIGHT[np.isin(np.arange(40), [2, 3, 4])]
    assert a.t_utc == b.t_utc == c.t_utc
    assert np.array_equal(a.sky_cdm2, b.sky_cdm2) and np.array_equal(b.dni_wm2, c.dni_wm2)
