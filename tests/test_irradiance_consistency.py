"""Consistency of three components: what lasts is flagged, broken clouds are not."""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np
import pytest
from places import SEATTLE

from fieldlum.pair.irradiance.consistency import (
    clear_sky,
    closure_fails,
    k_index_fails,
    shaded_horizon,
)
from fieldlum.sky import sun

DAY = np.arange(0.0, 86400.0, 60.0)
ALTITUDE = 60.0 * np.sin(2.0 * np.pi * (DAY / 86400.0 - 0.25))
AZIMUTH = DAY / 86400.0 * 360.0
TOP = np.full(len(DAY), 1361.0)


def clear_day() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Global, diffuse and direct of a cloudless day, in exact closure."""
    sine = np.maximum(np.sin(np.radians(ALTITUDE)), 0.0)
    dni = np.where(sine > 0, 900.0 * np.exp(-0.08 / np.maximum(sine, 0.02)), 0.0)
    dhi = 90.0 * np.sqrt(sine)
    return dhi + dni * sine, dhi, dni


@pytest.mark.analytic
def test_the_clear_sky_between_its_five_minutes_is_that_of_the_moment() -> None:
    t = datetime(2027, 6, 21, 17, tzinfo=UTC).timestamp() + 97.0 * np.arange(60)
    times = [datetime.fromtimestamp(x, UTC) for x in t]
    azimuth, dni = clear_sky(t, SEATTLE)
    # the sun moves by at most 2.5 degrees in a step, nearly straight
    assert azimuth == pytest.approx(sun.position(times, SEATTLE).azimuth_deg, abs=0.05)
    assert dni == pytest.approx(sun.clearsky(times, SEATTLE).dni_wm2, rel=1e-3)


@pytest.mark.analytic
def test_closure_is_judged_by_what_lasts() -> None:
    ghi, dhi, dni = clear_day()
    cloud, fault = ghi.copy(), ghi.copy()
    cloud[700:706] *= 1.3  # six minutes at a cloud's edge
    fault[700:760] *= 1.3
    assert not closure_fails(DAY, cloud, dhi, dni, ALTITUDE).any()
    marked = np.flatnonzero(closure_fails(DAY, fault, dhi, dni, ALTITUDE))
    assert 700 <= marked.min() <= 701
    assert 758 <= marked.max() <= 759


@pytest.mark.analytic
def test_indices_of_a_clear_day_pass_and_exchanged_components_fail() -> None:
    ghi, dhi, dni = clear_day()
    assert not k_index_fails(DAY, ghi, dhi, dni, ALTITUDE, TOP).any()
    up = ALTITUDE > 30.0
    assert k_index_fails(DAY, dhi, ghi, dni, ALTITUDE, TOP)[up].all()  # kd far above one


@pytest.mark.analytic
def test_a_tracker_that_points_elsewhere_is_flagged_and_an_overcast_sky_is_not() -> None:
    ghi, _, dni = clear_day()
    nothing, high = np.zeros_like(dni), ALTITUDE > 30.0
    assert k_index_fails(DAY, ghi, ghi, nothing, ALTITUDE, TOP)[high].all()
    assert not k_index_fails(DAY, 0.4 * ghi, 0.4 * ghi, nothing, ALTITUDE, TOP).any()


@pytest.mark.analytic
def test_a_hill_is_found_from_days_that_agree() -> None:
    _, _, dni = clear_day()
    clear = np.tile(dni, 6)
    t = (np.arange(6)[:, None] * 86400.0 + DAY).ravel()
    altitude, azimuth = np.tile(ALTITUDE, 6), np.tile(AZIMUTH, 6)
    hill = (altitude < 8.0) & (azimuth < 180.0)
    found = shaded_horizon(t, np.where(hill, 0.0, clear), altitude, azimuth, clear)
    inside = hill & (altitude > 3.0)
    assert found[inside].mean() > 0.9
    assert not found[~hill].any()
    assert not shaded_horizon(t, clear, altitude, azimuth, clear).any()
    gaps = np.where(np.arange(len(t)) % 50 == 0, np.nan, 0.0)  # a reading in fifty is missing
    gappy = shaded_horizon(t, np.where(hill, 0.0, clear) + gaps, altitude, azimuth, clear)
    assert gappy[inside].mean() > 0.9 and not gappy[~hill].any()
