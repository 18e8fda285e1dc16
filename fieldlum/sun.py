"""Where the sun stands and how its light splits, by pvlib. Heavy imports stay inside the functions."""

from collections.abc import Sequence
from datetime import datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldlum.records import Site

SUN_SOLID_ANGLE_SR = 6.797e-5  # 2 pi (1 - cos 0.2665 deg): the mean disc, as Radiance's gendaylit uses it


class SunPosition(NamedTuple):
    """Arrays [n]: true altitude (physics), apparent altitude (pictures), azimuth clockwise from north. [deg]"""

    altitude_deg: NDArray[np.float64]
    apparent_altitude_deg: NDArray[np.float64]
    azimuth_deg: NDArray[np.float64]


def position(times_utc: Sequence[datetime], site: Site) -> SunPosition:
    """Sun position by NREL's SPA (Reda and Andreas 2004, through pvlib). Raises ValueError for naive times."""
    import pandas as pd
    from pvlib.solarposition import get_solarposition

    if any(t.tzinfo is None for t in times_utc):
        raise ValueError("naive time given to sun.position: give it a time zone")
    index = pd.DatetimeIndex(pd.to_datetime(list(times_utc), utc=True))
    if len(index) == 0:
        return SunPosition(np.empty(0), np.empty(0), np.empty(0))
    found = get_solarposition(index, site.latitude_deg, site.longitude_deg, site.altitude_m, method="nrel_numpy")
    return SunPosition(
        np.asarray(found["elevation"], float),
        np.asarray(found["apparent_elevation"], float),
        np.asarray(found["azimuth"], float) % 360.0,
    )
