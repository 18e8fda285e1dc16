"""Choosing hours from candidates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldlum import sun
from fieldlum.plan.days import Hours

Index = NDArray[np.intp]


def even(hours: Hours, count: int, rng: np.random.Generator) -> Index:
    """Indices [count], ascending: hours that fill the year's sun positions evenly, without any weather.

    Farthest-point sampling on the sphere of sun directions (Gonzalez 1985), so that the widest gap is at most twice
    the smallest possible; the first hour is drawn by `rng`.
    """
    if count >= len(hours):
        return np.arange(len(hours))
    points = sun.direction(hours.altitude_deg, hours.azimuth_deg)
    chosen = [int(rng.integers(len(points)))]
    gap = np.full(len(points), np.inf)
    while len(chosen) < count:
        gap = np.minimum(gap, 1.0 - points @ points[chosen[-1]])
        chosen.append(int(np.argmax(gap)))
    return np.sort(np.array(chosen))
