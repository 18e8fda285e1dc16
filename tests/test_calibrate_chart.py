"""A chart is found under perspective among other things; what is no chart is refused."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from calibration_frames import CHART_SRGB

from fieldlum.calibrate import colour as chart
from fieldlum.calibrate.fit_steps import LinearFrame
from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure
from fieldlum.optics.camera_curves import response_table

CAMERA = np.array(
    [[0.60, 0.30, 0.05], [0.15, 0.75, 0.10], [0.02, 0.25, 0.60]]
)  # its colours of sRGB's
CELL, RIM = 60, 10


def drawn(
    seed: int, order: list[int], width_px: float = 300, turn_deg: float = 0.0
) -> tuple[LinearFrame, np.ndarray]:
    """A chart with black gaps, at an angle, over a clutter of boxes; and its patches' corners,
    dark skin first.
    """
    rng = np.random.default_rng(seed)
    colours = response_table("srgb")[CHART_SRGB][order]
    card = np.full((4 * CELL + 2 * RIM, 6 * CELL + 2 * RIM, 3), 0.02)
    for i, colour in enumerate(colours):
        y, x = RIM + i // 6 * CELL, RIM + i % 6 * CELL
        card[y + 4 : y + CELL - 4, x + 4 : x + CELL - 4] = colour
    high, wide = card.shape[:2]
    room = np.full((520, 700, 3), 0.25)
    for _ in range(30):
        x, y, w, h = rng.integers(0, 700), rng.integers(0, 520), *rng.integers(30, 200, 2)
        room[y : y + h, x : x + w] = rng.uniform(0.02, 0.8, 3)
    outline = np.array([[0, 0], [wide, 0], [wide, high], [0, high]], float)
    turn = np.radians(turn_deg)
    away = (outline - outline.mean(axis=0)) * width_px / wide
    away = away @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    placed = away * (1 + rng.uniform(-0.1, 0.1, (4, 1))) + (350, 260)  # seen at an angle
    how = cv2.getPerspectiveTransform(outline.astype(np.float32), placed.astype(np.float32))
    mask = cv2.warpPerspective(np.ones((high, wide)), how, (700, 520))[..., None]
    picture = room * (1 - mask) + cv2.warpPerspective(card, how, (700, 520)) * mask
    picture = cv2.GaussianBlur(picture, (0, 0), 0.8) + rng.normal(0, 0.004, picture.shape)
    inner = np.array(
        [[RIM, RIM], [wide - RIM, RIM], [wide - RIM, high - RIM], [RIM, high - RIM]], np.float32
    )
    corners = cv2.perspectiveTransform(inner[None], how)[0]
    rgb = (np.maximum(picture, 0) @ CAMERA.T * 120).astype(np.float32)
    return LinearFrame(
        Path("chart.dng"), rgb, np.zeros((520, 700), bool), 1, Exposure(0.01, 5.6)
    ), corners


CASES = [
    (1, 300, 0),
    (2, 160, 10),
    (3, 380, 180),
    (4, 240, -12),
    (11, 300, 90),
    (12, 120, 45),
    (13, 200, -30),
]


def found_inside(frame: LinearFrame, corners: np.ndarray) -> bool:
    """Whether every found centre, with its radius, lies within the true patch, by its shorter
    side.
    """
    centres, radius_px = chart.patch_centres(chart.find_chart(frame))
    true, _ = chart.patch_centres(corners)
    patch = np.linalg.norm(true[1] - true[0])
    return bool(np.linalg.norm(centres - true, axis=1).max() + radius_px < 0.55 * patch)


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize(("seed", "width_px", "turn_deg"), CASES)
def test_a_chart_is_found_at_an_angle(seed: int, width_px: float, turn_deg: float) -> None:
    assert found_inside(*drawn(seed, list(range(24)), width_px, turn_deg))


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.parametrize(("seed", "width_px", "turn_deg"), CASES[1:5])
def test_a_chart_is_found_in_a_poor_frame(seed: int, width_px: float, turn_deg: float) -> None:
    frame, corners = drawn(seed, list(range(24)), width_px, turn_deg)
    rng = np.random.default_rng(seed)
    uneven = frame.rgb * np.linspace(1, 3, frame.rgb.shape[1])[:, None]
    blurred = cv2.GaussianBlur(uneven, (0, 0), 0.008 * width_px)
    noisy = rng.poisson(np.maximum(blurred, 0) * 5) / 5.0
    poor = replace(frame, rgb=np.minimum(noisy, 0.8 * noisy.max(axis=(0, 1))).astype(np.float32))
    assert found_inside(poor, corners)


@pytest.mark.contract
def test_what_is_no_chart_is_refused() -> None:
    """No chart at all, and a card of other colours: a wrong find must not become a calibration."""
    card = drawn(1, list(np.random.default_rng(7).permutation(24)))[0]
    flat = replace(card, rgb=np.full_like(card.rgb, 30.0))
    for frame in (flat, card):
        with pytest.raises(InputError, match=r"no colour chart found.*--corners") as caught:
            chart.find_chart(frame)
        assert "\n" not in str(caught.value)


@pytest.mark.property
def test_the_order_of_colours_tells_a_chart() -> None:
    rgb = response_table("srgb")[CHART_SRGB] @ CAMERA.T
    glare = rgb + 0.03 * rgb.mean(axis=0)
    assert chart.misfit(rgb) < 0.03 and chart.misfit(glare) < 0.06
    grid = rgb.reshape(4, 6, 3)
    for other in (
        grid[::-1],
        grid[:, ::-1],
        grid[::-1, ::-1],
        np.roll(grid, 1, axis=0),
        np.roll(grid, 1, axis=1),
    ):
        assert chart.misfit(other.reshape(24, 3)) > 0.5
