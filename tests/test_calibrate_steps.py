"""Exposure steps of a JPEG bracket by the overlap of its frames, against simulated shutters."""

from __future__ import annotations

import re

import numpy as np
import pytest

from fieldlum.calibrate.response import Steps, steps_by_overlap
from fieldlum.optics.exposure import true_times_s

NOMINAL_S = np.array([1 / 60, 1 / 30, 1 / 15, 1 / 8, 1 / 4, 1 / 2, 1, 2])
THIRDS_S = true_times_s(NOMINAL_S, "third-stops")
CODE = np.arange(256) / 255.0
CURVES = {
    "steep": 0.6 * CODE**2.6 + 0.25 * CODE**1.5 + 0.15 * CODE**5,
    "gamma": CODE**2.2,
}


def _codes(true_s: np.ndarray, curve: str, places: int = 250) -> np.ndarray:
    """Codes [places, frames, 3] of grey places through a curve, with 2 % of noise."""
    rng = np.random.default_rng(4)
    light = 0.02 * 10 ** (3.2 * rng.random(places)) * 0.7
    z = light[:, None, None] * true_s[None, :, None] * np.array([0.8, 1.0, 0.7])
    z = z * np.exp(0.02 * rng.normal(size=z.shape))
    return np.rint(np.interp(z, CURVES[curve], np.arange(256.0))).astype(np.uint8)


def _measured(true_s: np.ndarray, labelled_s: np.ndarray, curve: str = "steep") -> Steps:
    codes = _codes(true_s, curve)
    return steps_by_overlap(codes, np.log(labelled_s), np.zeros(len(codes), int))


def _errors_percent(steps: Steps, true_s: np.ndarray) -> np.ndarray:
    """Return the errors of the steps [%], with the true steps on the same span."""
    own, true = np.diff(steps.log_exposure), np.diff(np.log(true_s))
    return 100.0 * (own - true * own.sum() / true.sum())


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("curve", CURVES)
def test_labels_that_are_rounded_are_corrected_by_the_overlap(curve: str) -> None:
    """An electronic shutter: 1/15 s after 1/8 s is 6.5 % less than a stop, by its decimals."""
    steps = _measured(NOMINAL_S, THIRDS_S, curve)
    assert np.abs(_errors_percent(steps, NOMINAL_S)).max() < 0.8
    assert np.ptp(steps.log_exposure) == pytest.approx(np.log(THIRDS_S[-1] / THIRDS_S[0]))
    assert re.search(r"contradicts 1 of 7 steps by the labels, by up to [67]\.", steps.text)


@pytest.mark.slow
@pytest.mark.analytic
def test_two_steps_of_opposite_errors_are_corrected() -> None:
    """The bracket of a phone: +4.4 and -3.1 %."""
    true_s = THIRDS_S * np.exp([0.0, 0.0, 0.013, 0.044, 0.0, 0.0, 0.0, 0.0])
    steps = _measured(true_s, THIRDS_S)
    assert np.abs(_errors_percent(steps, true_s)).max() < 0.8


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.parametrize("power", [0.94, 1.0, 1.06])
def test_true_labels_remain_and_a_power_cannot_be_seen(power: float) -> None:
    """Steps that are all longer by one share are a power, which is free."""
    labelled_s = THIRDS_S**power
    steps = _measured(THIRDS_S, labelled_s)
    np.testing.assert_allclose(steps.log_exposure, np.log(labelled_s), atol=1e-9)
    assert not steps.deviation.any() and steps.text == ""


@pytest.mark.analytic
def test_without_overlap_the_labels_remain() -> None:
    steps = _measured(NOMINAL_S[::3], NOMINAL_S[::3] ** 1.02)
    assert np.abs(np.diff(steps.log_exposure) / np.diff(np.log(NOMINAL_S[::3])) - 1.02).max() < 0.02
    few = steps_by_overlap(np.zeros((5, 8, 3), np.uint8), np.log(THIRDS_S), np.zeros(5, int))
    assert np.array_equal(few.log_exposure, np.log(THIRDS_S))


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("colour", [0, 2])
def test_a_white_balance_that_changes_is_told(colour: int) -> None:
    """A gain of one colour from a frame on is no step of all colours; noise is no gain."""
    codes = _codes(THIRDS_S, "gamma")
    bracket = np.zeros(len(codes), int)
    assert steps_by_overlap(codes, np.log(THIRDS_S), bracket).balance == 0.0
    gain = np.ones((8, 3))
    gain[4:, colour] = 1.25
    z = np.interp(codes, np.arange(256.0), CURVES["gamma"]) * gain
    codes = np.rint(255.0 * np.minimum(z, 1.0) ** (1 / 2.2)).astype(np.uint8)
    steps = steps_by_overlap(codes, np.log(THIRDS_S), bracket)
    assert 0.1 < steps.balance < np.log(1.27)
    assert "CAUTION: the white balance changes by over" in steps.text
