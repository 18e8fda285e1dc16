"""Robust spread, standard errors, the one-standard-error rule, signed angles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldlum.core.statistics import (
    is_no_worse,
    median_standard_error,
    nan_percentiles,
    robust_sigma,
    standard_error,
)
from fieldlum.optics.projection import signed_angle_deg

RNG = np.random.default_rng(3)


@pytest.mark.analytic
def test_robust_sigma_of_normal_values_with_gross_errors() -> None:
    values = RNG.normal(5.0, 2.0, 20_000)
    values[:2000] = 1e6
    assert robust_sigma(values) == pytest.approx(2.0 * 1.15, rel=0.04)  # 10 % of gross errors
    assert robust_sigma([-3.0, 3.0, 3.0], 0.0) == pytest.approx(1.4826 * 3.0)


@pytest.mark.analytic
def test_the_median_scatters_as_stated() -> None:
    medians = np.median(RNG.normal(0.0, 3.0, (4000, 51)), axis=1)
    assert medians.std() == pytest.approx(median_standard_error(3.0, 51), rel=0.05)


@pytest.mark.analytic
def test_standard_error_of_single_groups_is_the_plain_one() -> None:
    values = RNG.normal(size=17)
    plain = values.std(ddof=1) / np.sqrt(17)
    assert standard_error(values) == pytest.approx(plain)
    assert standard_error(values, np.arange(17)) == pytest.approx(plain)
    twice = standard_error(np.repeat(values, 2), np.repeat(np.arange(17), 2))
    assert twice == pytest.approx(plain)  # copies of a value add no information
    assert np.isnan(standard_error(values[:1])) and np.isnan(standard_error(values, np.zeros(17)))


@pytest.mark.analytic
def test_is_no_worse_pairs_the_data() -> None:
    days = np.array([1.0, 4.0, 9.0, 16.0])  # days differ by far more than the two models do
    assert not is_no_worse(1.01 * days + 0.1, days)
    assert is_no_worse(days + np.array([1.0, -1.0, 1.0, -0.9]), days)
    assert is_no_worse(days, days) and not is_no_worse(days[:1] + 1e-9, days[:1])


@pytest.mark.property
@given(turn=st.floats(-1e4, 1e4))
def test_a_signed_angle_is_the_same_direction(turn: float) -> None:
    signed = float(signed_angle_deg(turn))
    assert -180.0 <= signed < 180.0
    assert np.cos(np.radians(signed - turn)) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.authority
def test_percentiles_without_nan_are_numpys() -> None:
    values = np.where(RNG.random((31, 40)) < 0.3, np.nan, RNG.normal(size=(31, 40)))
    expected = np.nanpercentile(values, (10, 50, 90), axis=0)
    np.testing.assert_allclose(nan_percentiles(values, (10, 50, 90)), expected, atol=1e-14)
    assert np.isnan(nan_percentiles(np.full((3, 2), np.nan), (50,))).all()
