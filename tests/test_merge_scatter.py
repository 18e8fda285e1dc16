"""The noise of JPEG frames, measured on the bracket: white, coherent over blocks, beside an
error of the response.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fieldlum.core.records import Flag
from fieldlum.merge.estimator import Merged, merge_signals
from fieldlum.merge.frames import JpegSignal
from fieldlum.merge.jpeg_noise import footprint_px, with_seen_noise
from fieldlum.optics.photometry import srgb_table
from fieldlum.optics.projection import Equirect, LensGeometry

SIZE = (192, 256)
Y = (0.3, 0.6, 0.1)
TABLE = np.repeat(np.asarray(srgb_table(), np.float32)[:, None], 3, axis=1)
EXPOSURES = (0.02, 0.005, 0.00125)  # z per cd/m2


def light_cdm2() -> NDArray[np.float64]:
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    wave = np.sin(rows / 40) + np.cos(columns / 55)
    return np.stack([40 * np.exp(0.6 * wave + c) for c in (-0.3, 0.0, 0.2)], axis=2)


def frames(noise: Sequence[NDArray[np.float64]], bent: float = 0.0) -> list[JpegSignal]:
    """A bracket with noise [h, w, 3] in codes; bent: relative error of the longest frame, over
    its codes.
    """
    signals = []
    for i, (per, off) in enumerate(zip(EXPOSURES, noise, strict=True)):
        codes = np.interp(light_cdm2() * per, TABLE[:, 0], np.arange(256.0))
        codes *= 1 + (bent * np.sin(codes / 60) if i == 0 else 0.0)
        whole = np.clip(np.rint(codes + off), 0, 255).astype(np.uint8)
        signals.append(
            JpegSignal(
                whole, TABLE, np.full(3, per, np.float32), 20, 235, i == 0, i == len(noise) - 1
            )
        )
    return signals


def merged(store: list[JpegSignal]) -> Merged:
    return merge_signals(store, (*SIZE, 3))


def scale(
    noise: Sequence[NDArray[np.float64]], edge_px: float, bent: float = 0.0
) -> NDArray[np.float64]:
    store = frames(noise, bent)
    before = merged(store)
    still = (before.flags & Flag.MOTION) == 0
    return np.asarray(
        (with_seen_noise(before, store, Y, edge_px).variance / before.variance)[still], np.float64
    )


def white(rng: np.random.Generator, sigma: float = 1.0) -> list[NDArray[np.float64]]:
    return [rng.normal(0, sigma, (*SIZE, 3)) for _ in EXPOSURES]


def in_blocks(rng: np.random.Generator, edge: int) -> list[NDArray[np.float64]]:
    size = SIZE[0] // edge, SIZE[1] // edge, 3
    return [rng.normal(size=size).repeat(edge, axis=0).repeat(edge, axis=1) for _ in EXPOSURES]


@pytest.mark.analytic
@pytest.mark.parametrize("edge_px", [1.0, 4.2, 8.0])
def test_independent_noise_stays_as_it_was(
    edge_px: float,
) -> None:  # one code, as the signals say
    assert scale(white(np.random.default_rng(1)), edge_px).mean() == pytest.approx(1.0, abs=0.1)


@pytest.mark.analytic
def test_noise_that_is_alike_over_a_cell_counts_as_often_as_it_has_pixels() -> None:
    rng = np.random.default_rng(2)
    known = 16 * 1.0 / (1.0 + 1 / 12)  # rounding is alike only where the picture is flat
    assert scale(in_blocks(rng, 4), 4.0).mean() == pytest.approx(known, rel=0.15)
    shared = [np.repeat(n[..., :1], 3, axis=2) for n in white(rng)]  # of all three colours together
    shares = np.array(Y) * np.exp([-0.3, 0.0, 0.2])
    assert scale(shared, 4.0).mean() == pytest.approx(
        shares.sum() ** 2 / (shares**2).sum(), rel=0.2
    )


@pytest.mark.analytic
def test_an_error_of_the_response_is_no_noise() -> (
    None
):  # 2 % over the codes leave the figure as it was
    noise = white(np.random.default_rng(3))
    assert scale(noise, 4.0, bent=0.02).mean() == pytest.approx(scale(noise, 4.0).mean(), rel=0.15)


@pytest.mark.analytic
def test_noise_is_told_where_it_is() -> None:  # one half of the picture three times as noisy
    noise = [
        n * np.where(np.arange(SIZE[1]) < 128, 1.0, 3.0)[:, None]
        for n in white(np.random.default_rng(4))
    ]
    store = frames(noise)
    before = replace(merged(store), flags=np.zeros((*SIZE, 3), np.uint8))
    found = with_seen_noise(before, store, Y, 4.0).variance / before.variance
    assert (
        1.0 < found[:, :110].mean() < 1.5
    )  # a little of the whole picture's, and of its curve over the level
    assert found[:, 150:].mean() == pytest.approx(9.0, rel=0.15)


@pytest.mark.property
def test_what_moved_keeps_its_variance_and_raises_its_surroundings_little() -> None:
    noise = white(np.random.default_rng(5))
    noise[1][80:100, 100:120] += 60.0
    store = frames(noise)
    before = merged(store)
    after = with_seen_noise(before, store, Y, 4.0)
    moved = (before.flags & Flag.MOTION) > 0
    assert moved[84:96, 104:116].mean() > 0.5
    assert np.array_equal(after.variance[moved], before.variance[moved])
    far = np.ones(SIZE, bool)
    far[60:120, 80:140] = False
    assert (after.variance / before.variance)[far & ~moved.any(axis=2)].mean() == pytest.approx(
        1.0, abs=0.1
    )


@pytest.mark.contract
def test_frames_that_do_not_overlap_say_nothing() -> None:
    alone = frames(white(np.random.default_rng(6)))[:1]
    before = merged(alone)
    assert np.array_equal(with_seen_noise(before, alone, Y, 4.0).variance, before.variance)


@pytest.mark.contract
@pytest.mark.parametrize("dark", [slice(None), slice(0, 1)])
def test_black_colours_are_no_trouble(dark: slice) -> None:
    store = frames(white(np.random.default_rng(8)))
    for i in range(len(store)):
        codes = store[i].codes
        codes[..., dark] = 0
    after = with_seen_noise(merged(store), store, Y, 4.0)
    assert np.isfinite(after.variance).all() and (after.variance >= 0).all()


@pytest.mark.analytic
def test_a_target_pixel_on_the_sensor() -> None:  # 100 px for 90 degrees, pixels of 9 degrees
    assert footprint_px(LensGeometry((0.0, 0.0), 100.0, 180.0), Equirect(20)) == pytest.approx(10.0)
    assert footprint_px(LensGeometry((0.0, 0.0), 100.0, 180.0), Equirect(2000)) == 1.0
