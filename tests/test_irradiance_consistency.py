"""Consistency of three components: what lasts is flagged, broken clouds are not."""

from __future__ import annotations

import numpy as np
import pytest

from fieldlum.pair.irradiance import closure_fails

DAY = np.arange(0.0, 86400.0, 60.0)
ALTITUDE = 60.0 * np.sin(2.0 * np.pi * (DAY / 86400.0 - 0.25))


def clear_day() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Global, diffuse and direct of a cloudless day, in exact closure."""
    sine = np.maximum(np.sin(np.radians(ALTITUDE)), 0.0)
    dni = np.where(sine > 0, 900.0 * np.exp(-0.08 / np.maximum(sine, 0.02)), 0.0)
    dhi = 90.0 * np.sqrt(sine)
    return dhi + dni * sine, dhi, dni


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
