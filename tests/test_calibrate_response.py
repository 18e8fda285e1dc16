"""`calibrate response` against simulated JPEG cameras whose curve is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_frames import LENS, PROFILE, SIZE

from fieldlum.calibrate import (
    response,
)
from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure
from fieldlum.optics.camera_curves import response_table
from fieldlum.optics.exposure import ShutterLaw, true_times_s
from fieldlum.optics.profiles import (
    CameraBody,
)
from fieldlum.optics.raw import read_jpeg
from fieldlum.optics.raw.writing import write_jpeg


def _bracket(
    folder: Path,
    table: np.ndarray,
    seed: int,
    shutters: tuple[float, ...],
    drift: float = 0.0,
    noise: float = 0.004,
) -> Path:
    rng = np.random.default_rng(seed)
    folder.mkdir()
    blocks = 0.02 * 10 ** (3.2 * rng.random((SIZE // 6, SIZE // 6)))
    scene = np.repeat(np.repeat(blocks, 6, axis=0), 6, axis=1)
    for i, shutter in enumerate(shutters):
        z = scene[..., None] * true_times_s(shutter) * np.array([0.8, 1.0, 0.7]) * (1 + drift * i)
        z = z * (1 + noise * rng.normal(size=z.shape))
        codes = np.rint(np.interp(z, table + np.arange(256) * 1e-9, np.arange(256.0))).astype(
            np.uint8
        )
        write_jpeg(folder / f"{i}.jpg", codes, exposure=Exposure(shutter, 5.6))
    return folder


JPEG_PROFILE = replace(
    PROFILE, camera=CameraBody("j", "jpeg", SIZE, SIZE), lens=(replace(LENS, radius_px=170.0),)
)


SHUTTERS = (2.0, 1.0, 0.5, 1 / 4, 1 / 8, 1 / 15, 1 / 30, 1 / 60)


@pytest.mark.slow
@pytest.mark.analytic
def test_response_recovers_an_unknown_curve(tmp_path: Path) -> None:
    """A curve that is neither sRGB nor linear, within 2 % of light over the codes that count,
    pooled brackets.
    """
    code = np.arange(256) / 255
    truth = 0.6 * code**2.6 + 0.25 * code**1.5 + 0.15 * code**5
    folders = [_bracket(tmp_path / f"b{seed}", truth, seed, SHUTTERS) for seed in (1, 2)]
    places = response.sample(response.brackets_in(folders), JPEG_PROFILE, np.random.default_rng(0))
    found = response.fit(places)
    assert found.response.kind == "table"
    z = response_table("table", found.response.green)
    codes = np.arange(response.LOW, response.HIGH)
    ratio = np.log(z[codes] / truth[codes])
    assert np.ptp(ratio) < 0.06 and np.std(ratio) < 0.02
    assert (np.diff(z) >= 0).all() and found.response.u_rel < 0.03


@pytest.mark.slow
@pytest.mark.analytic
def test_a_plain_srgb_camera_is_recognised(tmp_path: Path) -> None:
    folder = _bracket(tmp_path / "b", response_table("srgb"), 4, SHUTTERS)
    places = response.sample(response.brackets_in([folder]), JPEG_PROFILE, np.random.default_rng(0))
    found = response.fit(places)
    assert found.response.kind == "srgb" and "srgb" in found.choice.line
    assert "CAUTION" not in found.choice.line


@pytest.mark.slow
@pytest.mark.contract
def test_a_response_from_a_camera_that_moved_says_so(tmp_path: Path) -> None:
    still = _bracket(tmp_path / "b", response_table("srgb"), 4, SHUTTERS)
    for path in sorted(still.glob("*.jpg"))[::2]:
        frame = read_jpeg(path)
        write_jpeg(path, np.roll(frame.codes, 6, axis=1), exposure=frame.exposure)
    found = _fitted(still)
    assert (
        found.response.u_rel > 0.1
        and "check that camera and light did not change" in found.choice.line
    )


def _fitted(folder: Path) -> response.ResponseFit:
    return response.fit(
        response.sample(response.brackets_in([folder]), JPEG_PROFILE, np.random.default_rng(0))
    )


@pytest.mark.contract
def test_response_refuses_frames_of_another_size(tmp_path: Path) -> None:
    """Frames of another sensor were fitted where the profile's circle happened to lie on them."""
    _bracket(tmp_path / "b", response_table("srgb"), 3, (0.5, 0.25, 0.125, 1 / 15))
    other = replace(
        JPEG_PROFILE, camera=replace(JPEG_PROFILE.camera, width_px=5616, height_px=3744)
    )
    with pytest.raises(
        InputError,
        match=r"pixels; expected 5616 x 3744 pixels, the size of .*; use a profile of this camera",
    ):
        response.sample(response.brackets_in([tmp_path / "b"]), other, np.random.default_rng(1))


@pytest.mark.contract
def test_response_refuses_what_is_no_bracket(tmp_path: Path) -> None:
    folder = _bracket(tmp_path / "b", response_table("srgb"), 4, (0.5, 0.25))
    with pytest.raises(InputError, match="three different exposures"):
        response.sample(response.brackets_in([folder]), JPEG_PROFILE, np.random.default_rng(0))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no frames in this folder"):
        response.brackets_in([tmp_path / "empty"])


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("law", ["third-stops", "exact"])
def test_steps_of_a_shutter_that_keeps_decimals_are_corrected(
    tmp_path: Path, law: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """1/15 to 1/60 s as decimals or as powers of two, 6.7 % apart."""
    if law == "exact":
        monkeypatch.setitem(globals(), "true_times_s", float)
    code = np.arange(256) / 255
    folder = _bracket(tmp_path / "b", 0.6 * code**2.6 + 0.4 * code**1.5, 5, SHUTTERS)
    brackets = response.brackets_in([folder])
    places = response.sample(brackets, JPEG_PROFILE, np.random.default_rng(0))
    assert places.law.law == "third-stops" and places.law.decided_by == "labels"
    assert places.steps.deviation.any() == (law == "exact")
    stated = replace(JPEG_PROFILE, shutter_law="half-stops")
    assert response.sample(brackets, stated, np.random.default_rng(0)).law.law == "half-stops"


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("noise", [0.05, 0.1])
def test_noise_of_a_phone_hides_no_wrong_label(
    tmp_path: Path, noise: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Blocks with a spread over 9 codes were edges: few were left, and the labels remained.

    The true steps are all one stop, except by labels of 1/15 to 1/60 s; a power is free.
    """
    true_s = dict(zip(SHUTTERS, 2.0 ** np.arange(1.0, -7.0, -1.0), strict=True))
    true_s[1 / 15] *= 1.1
    monkeypatch.setitem(globals(), "true_times_s", true_s.get)
    code = np.arange(256) / 255
    table = 0.6 * code**2.6 + 0.4 * code**1.5
    folder = _bracket(tmp_path / "b", table, 6, SHUTTERS, noise=noise)
    brackets = response.brackets_in([folder])
    places = response.sample(brackets, JPEG_PROFILE, np.random.default_rng(0))
    true = np.diff(np.log(sorted(true_s.values())))
    found = np.diff(places.log_exposure)
    assert found - true * (found @ true) / (true @ true) == pytest.approx(0.0, abs=0.015)


def _gathered(table: np.ndarray, step: float) -> response.Places:
    """Places of nearly one brightness, as of a lit wall, in steps of `step` stops: codes gather in
    bands, with noise of 2 codes.
    """
    rng = np.random.default_rng(0)
    log_e = np.log(2.0) * np.arange(-9.0, 2.0, step)
    light = np.exp(0.15 * rng.normal(size=(400, 1, 1)) + log_e[:, None])
    exact = np.interp(light * np.array([0.8, 1.0, 0.7]), table, np.arange(256.0))
    codes = np.rint(exact + 2.0 * rng.normal(size=exact.shape)).clip(0, 255).astype(np.uint8)
    law, steps = ShutterLaw("exact", "profile", {}), response.Steps(log_e, 0.0 * log_e[1:])
    return response.Places(codes, log_e, np.zeros(400, int), law, steps, ())


@pytest.mark.slow
@pytest.mark.analytic
def test_equal_steps_leave_no_scallops_in_a_curve(monkeypatch: pytest.MonkeyPatch) -> None:
    """A curve that is flat where codes gather and steep between them had the least held-out rms."""
    code = np.arange(256) / 255
    truth = 0.6 * code**2.6 + 0.25 * code**1.5 + 0.15 * code**5
    places, fine = _gathered(truth, 1.0), _gathered(truth, 1 / 3)
    found = response.fit(places)
    used = np.s_[found.response.low_code : response.HIGH + 1]
    own = np.gradient(np.log(response_table("table", found.response.green)))[used]
    own /= np.gradient(np.log(np.maximum(truth, 1e-9)))[used]
    assert own.min() > 0.8 and own.max() < 1.25
    assert "ripple" not in found.choice.line
    monkeypatch.setattr(response, "_STIFFNESSES", (300.0,))
    scalloped = response.fit(places)
    assert "CAUTION: the curve has a ripple of 7 %" in scalloped.choice.line
    assert scalloped.response.u_rel > 1.3 * scalloped.choice.rms
    assert "ripple" not in response.fit(fine).choice.line  # the remedy
