"""Move the sun along its path, for a clock that is fast or slow."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats

# Apparent rotation of the sky: 360 degrees in a mean solar day; the sun's own motion in declination
# (at most 0.4 degrees a day) is below 0.003 degrees in ten minutes.
SKY_TURN_DEG_PER_MIN = 0.25


def sun_earlier(sun_direction: ArrayLike, minutes: float, latitude_deg: float) -> Floats:
    """Return the sun's directions `minutes` earlier (negative: later), [n, 3].

    sun_direction: [n, 3] unit vectors (x east, y north, z up); latitude_deg: north positive. The
    sky turns about the celestial pole by 0.25 degrees a minute from east to west (Rodrigues'
    formula).
    """
    suns = np.asarray(sun_direction, float)
    angle = np.radians(SKY_TURN_DEG_PER_MIN * minutes)  # counter-clockwise about the pole
    latitude = np.radians(latitude_deg)
    pole = np.array([0.0, np.cos(latitude), np.sin(latitude)])
    along = (suns @ pole)[..., None] * pole
    return (
        suns * np.cos(angle) + np.cross(pole, suns) * np.sin(angle) + along * (1.0 - np.cos(angle))
    )
