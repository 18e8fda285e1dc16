"""Exposure arithmetic, response curves, exposure ratios, vignetting and illuminance."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure, SunSource
from fieldlum.devices import nearest
from fieldlum.merge.estimator import FramePixels
from fieldlum.merge.linear_frames import RawSignal
from fieldlum.merge.ratios import fit_ratios, pair_ratio, pair_ratios
from fieldlum.optics.camera_curves import (
    check_vignetting,
    dark_floor,
    fit_response,
    monotone,
    response_table,
    vignetting_at,
)
from fieldlum.optics.exposure import prior_u_log, same_exposure, true_times_s, z_per_cdm2
from fieldlum.optics.illuminance import illuminance_lx, illuminance_verdict
from fieldlum.optics.linear_light import saturation_plateau

# ----------------------------------------------------------------------------------------------
# exposure


# authority: shutters run in powers of two (README of wjakob/hdrmerge; linearhdr's 2^(n/3))
@pytest.mark.authority
@pytest.mark.parametrize(
    ("nominal", "power"),
    [
        (1 / 60, -6),
        (1 / 125, -7),
        (1 / 8000, -13),
        (13, 11 / 3),
        (0.3, -5 / 3),
        (1 / 45, -5.5),
        (1 / 1250, -31 / 3),
    ],
)
def test_nominal_shutter_times_are_powers_of_two(nominal: float, power: float) -> None:
    assert true_times_s(nominal) == pytest.approx(2.0**power, rel=1e-12)


@pytest.mark.analytic
def test_a_time_that_is_no_dial_figure_is_kept() -> None:
    assert true_times_s(0.1105) == 0.1105


@pytest.mark.analytic
def test_luminance_of_an_exposure() -> None:
    # analytic: L = k 87 N^2 / (t S) z; f/5.6, 1/100 s, ISO 100, k 1.18, z 0.5
    luminance = 0.5 / z_per_cdm2(0.01, 5.6, 100.0, 1.18)
    assert luminance == pytest.approx(1.18 * 87 * 5.6**2 / (0.01 * 100) * 0.5)


@pytest.mark.analytic
def test_third_stops_are_other_settings_and_rounded_values_are_not() -> None:
    asked = Exposure(1 / 60, 5.6)
    assert same_exposure(Exposure(1 / 64, 5.66), asked)  # 0.09 and 0.03 EV
    assert not same_exposure(Exposure(1 / 60, 5.0), asked)  # a third of a stop in light
    assert not same_exposure(Exposure(1 / 80, 5.6), asked)
    with pytest.raises(DeviceError, match="nearest value is 5: plan"):
        nearest(5.6, (4.0, 5.0, 8.0), "aperture", ev_per_double=2.0)


@pytest.mark.analytic
def test_the_plateau_is_found_below_the_tag_and_only_where_there_is_one() -> None:
    rng = np.random.default_rng(0)
    counts = rng.integers(500, 14000, (200, 200))
    full = counts.copy()
    full[:20] = 15000
    assert saturation_plateau(full.astype(np.uint16), 16383) == pytest.approx(15000, abs=1)
    full[0, :3] = 16383  # hot pixels
    assert saturation_plateau(full.astype(np.uint16), 16383) == pytest.approx(15000, abs=1)
    assert saturation_plateau(counts.astype(np.uint16), 16383) is None
    assert saturation_plateau((counts // 4).astype(np.uint16), 16383) is None


# ----------------------------------------------------------------------------------------------
# response


@pytest.mark.contract
def test_response_tables() -> None:
    assert response_table("srgb")[255] == pytest.approx(1.0)
    assert response_table("linear")[51] == pytest.approx(0.2)
    assert response_table("polynomial", (0.0, 0.0, 1.0))[128] == pytest.approx((128 / 255) ** 2)
    with pytest.raises(ValueError, match="256 increasing"):
        response_table("table", tuple(range(256, 0, -1)))
    with pytest.raises(ValueError, match="coefficients"):
        response_table("polynomial", (1.0,))


@pytest.mark.property
@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-2, 2), min_size=2, max_size=6))
def test_any_response_polynomial_becomes_monotone(coefficients: list[float]) -> None:
    z = response_table("polynomial", coefficients)
    assert np.all(np.diff(z) >= 0) and np.all(z >= 0)
    assert monotone(z) == pytest.approx(z, abs=1e-12)


@pytest.mark.analytic
def test_a_response_is_recovered_from_a_bracket() -> None:
    rng = np.random.default_rng(0)
    light = np.exp(rng.uniform(-7, 1, 1500))
    log_exposure = np.log(2.0) * np.arange(-2, 5)
    z = np.minimum(light[:, None] * np.exp(log_exposure), 1.0)
    codes = np.clip(np.round(255 * z ** (1 / 2.2) + rng.normal(0, 0.5, z.shape)), 0, 255).astype(
        np.uint8
    )
    found, rms = fit_response(codes, log_exposure)
    middle = np.arange(30, 229)
    expected = (middle / 255) ** 2.2
    ratio = found[middle] / expected
    assert (
        np.ptp(ratio / np.median(ratio)) < 0.06 and rms < 0.04
    )  # half a code at code 27 is 4 % of z
    assert np.all(np.diff(found) >= 0)


def _film_codes(black: float) -> tuple[np.ndarray, np.ndarray]:
    """Codes [places, frames] of a gamma 2.2 camera whose black lies at a code of its own, 1 EV
    steps, 16 frames.
    """
    rng = np.random.default_rng(1)
    light, log_exposure = np.exp(rng.uniform(-2, 7, 1500)), np.log(2.0) * np.arange(-15, 1)
    z = np.minimum(light[:, None] * np.exp(log_exposure), 1.0)
    codes = black + (255 - black) * z ** (1 / 2.2) + rng.normal(0, 0.5, z.shape)
    return np.clip(np.round(codes), 0, 255).astype(np.uint8), log_exposure


@pytest.mark.slow
@pytest.mark.analytic
def test_a_black_level_is_no_light() -> (
    None
):  # analytic; Memorial Church's scans have their black at codes 12 to 17
    codes, log_exposure = _film_codes(30.0)
    assert 30 < dark_floor(codes, log_exposure) <= 39
    middle = np.arange(45, 229)
    expected = np.log(((middle - 30.0) / 225) ** 2.2)
    found, rms = fit_response(codes, log_exposure)
    blind, worse = fit_response(codes, log_exposure, low=3)
    off, off_blind = (np.ptp(np.log(table[middle]) - expected) for table in (found, blind))
    assert off < 0.04 and rms < 0.1  # noise of 0.58 codes is 14 % of z nine codes above black
    assert off_blind > 1.5 * off and worse > 2 * rms


@pytest.mark.property
def test_without_a_black_level_nearly_every_code_counts() -> None:
    assert dark_floor(*_film_codes(0.0)) <= 6
    assert (
        dark_floor(np.full((30, 3), 40, np.uint8), np.array([0.0, 0.1, 0.2])) == 3
    )  # steps too small to tell


@pytest.mark.contract
def test_too_few_places_give_no_response() -> None:
    with pytest.raises(ValueError, match="too few"):
        fit_response(np.zeros((3, 5), np.uint8), np.arange(5.0))


# ----------------------------------------------------------------------------------------------
# exposure ratios


def _pair(true_ratio: float, assumed: float, rng: np.random.Generator, moved: float = 0.0):
    long = rng.uniform(2000, 12000, 20000)
    short = long * true_ratio
    short[: int(moved * short.size)] *= 3.0
    y_long, y_short = (rng.normal(y, np.sqrt(y / 4)) for y in (long, short))
    return pair_ratio(y_long, y_short, y_long / 4, y_long * assumed / 4, assumed)


@pytest.mark.analytic
@pytest.mark.parametrize("moved", [0.0, 0.1])
def test_a_pair_tells_its_ratio_even_when_something_moved(moved: float) -> None:
    pair = _pair(0.26, 0.25, np.random.default_rng(0), moved)
    assert pair is not None
    assert pair.log_ratio == pytest.approx(
        np.log(0.26 / 0.25), abs=8e-3 if moved else 5e-4
    )  # a tenth of the pixels moved


@pytest.mark.analytic
def test_too_few_pixels_make_no_pair() -> None:
    few = np.ones(10)
    assert pair_ratio(few, few, few, few, 1.0) is None


@pytest.mark.analytic
def test_ratios_of_a_bracket_and_a_pair_that_contradicts() -> None:
    truth = np.array([0.0, 0.02, -0.03, 0.05])
    rng = np.random.default_rng(1)
    pairs = []
    for i in range(4):
        for j in range(i + 1, 4):
            pair = _pair(float(np.exp(truth[j] - truth[i])), 1.0, rng)
            assert pair is not None
            pairs.append(replace(pair, long=i, short=j))
    fit = fit_ratios(pairs, np.diag(prior_u_log(np.array([1.0, 0.1, 1 / 2000, 1 / 4000])) ** 2))
    found = np.log(fit.correction)
    assert found - found[0] == pytest.approx(truth, abs=1e-3)
    assert np.all(fit.u_log < 0.01)


@pytest.mark.analytic
def test_without_pairs_the_priors_stand() -> None:
    fit = fit_ratios([], np.diag([0.003, 0.03]) ** 2)
    assert fit.correction == pytest.approx([1.0, 1.0]) and fit.u_log == pytest.approx([0.003, 0.03])


# ----------------------------------------------------------------------------------------------
# vignetting, illuminance


@pytest.mark.analytic
def test_vignetting_signs() -> None:
    loss = (1.0, 0.0, -0.35)
    assert check_vignetting(loss) == "" and vignetting_at(loss, 1.0) == pytest.approx(0.65)
    assert "sign" in check_vignetting((1.0, 0.0, 0.04))  # what darkens the edge instead
    assert "1.05" in check_vignetting((1.0, 0.0, 1.0006))
    assert "on the axis" in check_vignetting((0.5,))
    assert vignetting_at(loss, 1.5) == pytest.approx(0.65) and vignetting_at((), 0.5) == 1.0


@pytest.mark.analytic
@pytest.mark.parametrize("height", [4, 16, 115, 230])
@pytest.mark.parametrize("azimuth", [0.0, 33.3])
def test_a_uniform_field_gives_pi_l_at_any_size(height: int, azimuth: float) -> None:
    field = np.full((height, 2 * height), 100.0)
    tolerance = 5e-4  # the 0.05 %
    assert illuminance_lx(field, 10.0, 0.0, azimuth) == pytest.approx(100 * np.pi, rel=tolerance)
    assert illuminance_lx(field, 10.0, 90.0, 0.0) == pytest.approx(100 * np.pi, rel=tolerance)


@pytest.mark.analytic
def test_the_sun_beside_the_map_adds_its_cosine() -> None:
    sun = SunSource(30.0, 200.0, 50_000.0)
    dark = np.zeros((32, 64))
    assert illuminance_lx(dark, 180.0, 90.0, 0.0, sun) == pytest.approx(25_000)
    assert illuminance_lx(dark, 180.0, 0.0, 20.0, sun) == 0.0


@pytest.mark.authority
@pytest.mark.parametrize(
    ("image", "said"), [(105, "pass"), (112, "warn"), (80, "warn"), (70, "reject"), (130, "reject")]
)
def test_the_gate_on_vertical_illuminance(image: float, said: str) -> None:
    # authority: Pierson et al. 2021: within 10 % expected, beyond 25 % reject
    assert illuminance_verdict(image, 100.0) == said


@pytest.mark.analytic
def test_a_meter_that_reads_nothing_is_no_pass() -> None:
    assert illuminance_verdict(100.0, 0.0) == "reject"


@pytest.mark.analytic
def test_light_that_only_the_short_frame_has_gives_no_ratio() -> None:
    """Frames of a telephone with another order of exposures: warnings were printed."""
    counts = np.full((1, 2, 400), 4000, np.uint16)
    constants = [np.asarray(v, np.float32) for v in (512.0, 13488.0)]
    above = counts.astype(np.float32) - 512.0
    dark = np.where(np.arange(400) < 100, np.float32(0.0), above)
    full = np.zeros(counts.shape, bool)
    frames = [
        FramePixels(RawSignal(counts, *constants, np.float32(per), 4.0, 2.33), light, full)
        for per, light in ((1.0, dark), (0.5, above))
    ]
    (pair,) = pair_ratios(frames)
    assert pair.pixels == 600 and pair.log_ratio == pytest.approx(np.log(2.0), abs=1e-3)
