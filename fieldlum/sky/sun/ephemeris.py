"""The sun's position, computed by pvlib. Naive times are refused."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site

if TYPE_CHECKING:
    import pandas as pd

# 2 pi (1 - cos 0.2665 deg): the mean disc, as in Radiance's gendaylit.
SUN_SOLID_ANGLE_SR = 6.797e-5
# Conditions of the standard atmosphere, hPa and deg C; 20 degrees or 2 km more change refraction by
# 7 % and 22 %, a hundredth of a degree with the sun at 10 degrees.
_STANDARD_PRESSURE_HPA, _STANDARD_TEMPERATURE_C = 1013.25, 12.0
_HORIZON_REFRACTION_DEG = (
    0.5667  # pvlib's default; 0.27 degrees (the disc) below it nothing is seen
)


class SunPosition(NamedTuple):
    """Sun positions, arrays [n] in deg.

    altitude_deg: without refraction; apparent_altitude_deg: with refraction, as in pictures;
    azimuth_deg: clockwise from north, in [0, 360).
    """

    altitude_deg: Floats
    apparent_altitude_deg: Floats
    azimuth_deg: Floats


def pandas_index(times_utc: Sequence[datetime], who: str) -> pd.DatetimeIndex:
    """Return times as a pandas index in UTC.

    Raises ValueError for naive times, with `who` as the caller's name.
    """
    import pandas as pd

    if any(t.tzinfo is None for t in times_utc):
        raise ValueError(f"naive time given to sun.{who}; add a time zone")
    return pd.DatetimeIndex(pd.to_datetime(list(times_utc), utc=True))


def position(times_utc: Sequence[datetime], site: Site) -> SunPosition:
    """Return the sun position by NREL's SPA (Reda and Andreas 2004, through pvlib).

    Arrays are in the order of times_utc, empty without times. Raises ValueError for naive times.
    """
    from pvlib.solarposition import get_solarposition

    index = pandas_index(times_utc, "position")
    if len(index) == 0:
        return SunPosition(np.empty(0), np.empty(0), np.empty(0))
    table = get_solarposition(
        index, site.latitude_deg, site.longitude_deg, site.altitude_m, method="nrel_numpy"
    )
    return SunPosition(
        np.asarray(table["elevation"], float),
        np.asarray(table["apparent_elevation"], float),
        np.asarray(table["azimuth"], float) % 360.0,
    )


def shown_altitude_deg(altitude_deg: ArrayLike) -> Floats:
    """Return the altitude at which a picture shows the sun, from the true one, [n] deg.

    Refraction by SPA's formula (Bennett 1982, Reda and Andreas 2004) at standard pressure and 12 C:
    0.16 degrees at 5 degrees, 0.09 at 10; none for a sun that is below the visible horizon.
    """
    from pvlib import spa

    altitude = np.asarray(altitude_deg, float)
    visible = altitude >= -(0.26667 + _HORIZON_REFRACTION_DEG)
    raised = spa.atmospheric_refraction_correction(
        _STANDARD_PRESSURE_HPA,
        _STANDARD_TEMPERATURE_C,
        np.where(visible, altitude, 0.0),
        _HORIZON_REFRACTION_DEG,
    )
    return altitude + np.where(visible, raised, 0.0)
