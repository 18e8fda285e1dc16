"""Separate the seasons of captured days by the sun's declination."""

from __future__ import annotations

from datetime import UTC

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Indices
from fieldlum.sky import sun

# captures with a smaller range of the sun's declination are from one season; chosen
ONE_SEASON_DEG = 20.0
SEASONS_APART_DEG = 10.0  # least gap between the declinations of two seasons' days; chosen


def _declination_deg(days: NDArray) -> Array:
    """Return the sun's declination at the beginning of each day, [n]."""
    names, inverse = np.unique(days.astype("datetime64[D]"), return_inverse=True)
    return sun.declination_deg(
        [day.replace(tzinfo=UTC) for day in names.astype("datetime64[s]").tolist()]
    )[inverse]


def one_season(days: NDArray) -> bool:
    """Return whether all days are from one season: a range of solar declination below 20 degrees.

    days: dates [n] (datetime64). If True, held-out days do not test other seasons.
    """
    return float(np.ptp(_declination_deg(days))) < ONE_SEASON_DEG


def seasons(days: NDArray) -> Indices:
    """Return the index of the season of each day, from 0, [n].

    Seasons are ordered by the sun's declination, lowest (northern winter) first. A gap of over 10
    degrees between the days' declinations separates two seasons. days: dates [n] (datetime64).
    """
    declination = _declination_deg(days)
    values = np.unique(declination)
    starts = values[1:][np.diff(values) > SEASONS_APART_DEG]
    return np.searchsorted(starts, declination, side="right")
