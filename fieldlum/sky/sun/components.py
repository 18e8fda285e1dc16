"""The components of sunlight: without clouds, from global irradiance, and their limits."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.records import Site
from fieldlum.sky.sun.ephemeris import pandas_index, position

# Below this altitude a horizontal error of 10 W/m2 is over 100 W/m2 of DNI: mark such values.
# Chosen.
LOW_SUN_DEG = 5.0
# Above this altitude shares and ratios of horizontal readings can be tested. Chosen, not measured.
CLEAR_SUN_DEG = 10.0
# Global over extraterrestrial light, at least; the darkest storm transmits ten times as much, a
# file in kW has a thousandth. Chosen, not measured.
LEAST_CLEARNESS = 0.005


@contextmanager
def _old_names() -> Iterator[None]:
    """Ignore a warning: pvlib 0.16 uses `dayofyear` of pandas 3.1, which has a new name."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="DatetimeIndex.dayofyear is deprecated")
        yield


def extraterrestrial_wm2(times_utc: Sequence[datetime]) -> Floats:
    """Return the irradiance on a plane normal to the sun above the atmosphere, [n], in W/m2.

    Spencer 1971, through pvlib. Raises ValueError for naive times.
    """
    from pvlib.irradiance import get_extra_radiation

    with _old_names():
        return np.asarray(
            get_extra_radiation(pandas_index(times_utc, "extraterrestrial_wm2")), float
        )


class Irradiance(NamedTuple):
    """Global horizontal, direct normal, diffuse horizontal irradiance [n] W/m2; NaN: unknown."""

    ghi_wm2: Floats
    dni_wm2: Floats
    dhi_wm2: Floats


def clearsky(times_utc: Sequence[datetime], site: Site) -> Irradiance:
    """Return the irradiance of a cloudless sky, [n] each, in W/m2.

    Ineichen and Perez 2002 with pvlib's monthly turbidity, which needs no network. Raises
    ValueError for naive times.
    """
    from pvlib.location import Location

    place = Location(site.latitude_deg, site.longitude_deg, "UTC", site.altitude_m)
    with _old_names():
        table = place.get_clearsky(pandas_index(times_utc, "clearsky"), model="ineichen")
    return Irradiance(*(np.asarray(table[name], float) for name in ("ghi", "dni", "dhi")))


def dirint_dni(ghi_wm2: ArrayLike, times_utc: Sequence[datetime], site: Site) -> Floats:
    """Return DNI from a regular series of global irradiance by DIRINT, [n], in W/m2.

    Perez et al. 1992, through pvlib: the best of pvlib's decompositions on BSRN Payerne, June 2016,
    with RMSE 92 W/m2 (38 %) by the minute and 70 (30 %) by the hour. It uses neighbours: the series
    must be complete, sorted and evenly spaced. Zero with the sun under 3 degrees; NaN where the
    global is NaN. Raises ValueError for naive times.
    """
    from pvlib.atmosphere import alt2pres
    from pvlib.irradiance import dirint

    ghi = np.asarray(ghi_wm2, float)
    zenith = 90.0 - position(times_utc, site).altitude_deg
    with np.errstate(divide="ignore", invalid="ignore"), _old_names():
        computed = dirint(
            np.maximum(ghi, 0.0),
            zenith,
            pandas_index(times_utc, "dirint_dni"),
            pressure=alt2pres(site.altitude_m),
        )
    dni = np.nan_to_num(np.asarray(computed, float), nan=0.0)
    # The beam never exceeds what the global allows, nor the irradiance above the atmosphere.
    ceiling = np.maximum(ghi, 0.0) / np.maximum(np.cos(np.radians(zenith)), np.sin(np.radians(1.0)))
    dni = np.minimum(dni, np.minimum(np.nan_to_num(ceiling), extraterrestrial_wm2(times_utc)))
    return np.where(np.isnan(ghi), np.nan, np.where(zenith > 87.0, 0.0, dni))


def dhi_by_closure(ghi_wm2: ArrayLike, dni_wm2: ArrayLike, altitude_deg: ArrayLike) -> Floats:
    """Return diffuse = global - DNI sin(altitude), never negative, [n], in W/m2.

    With the sun below the horizon it is the global.
    """
    beam = np.asarray(dni_wm2, float) * np.maximum(np.sin(np.radians(altitude_deg)), 0.0)
    return np.maximum(np.asarray(ghi_wm2, float) - beam, 0.0)


def dni_by_closure(ghi_wm2: ArrayLike, dhi_wm2: ArrayLike, altitude_deg: ArrayLike) -> Floats:
    """Return DNI = (global - diffuse) / sin(altitude), [n], in W/m2.

    Noise can make it negative: values are not clipped, so that a mean has no bias. Zero at
    altitudes up to 2 degrees, where it cannot be determined.
    """
    altitude = np.asarray(altitude_deg, float)
    sine = np.sin(np.radians(np.maximum(altitude, 2.0)))
    beam = np.asarray(ghi_wm2, float) - np.asarray(dhi_wm2, float)
    return np.where(altitude > 2.0, beam / sine, 0.0)


class Limits(NamedTuple):
    """Lowest (one number) and highest plausible value [n] of each component, in W/m2."""

    ghi_wm2: tuple[float, Floats]
    dhi_wm2: tuple[float, Floats]
    dni_wm2: tuple[float, Floats]


def bsrn_limits(
    altitude_deg: ArrayLike, extraterrestrial: ArrayLike, *, extreme: bool = False
) -> Limits:
    """Return BSRN's limits of irradiance: the physically possible ones, or the extremely rare ones.

    Source: Long and Dutton 2002 (QCRad). Each of GHI, DHI and DNI has a lowest and a highest value.
    altitude_deg : [n], below 0 counts as 0; extraterrestrial : [n] on a plane normal to the sun,
    W/m2. extreme : return the narrower limits, which are exceeded extremely rarely.
    """
    mu = np.maximum(np.sin(np.radians(altitude_deg)), 0.0)
    sa = np.asarray(extraterrestrial, float)
    if extreme:
        return Limits(
            (-2.0, 1.2 * sa * mu**1.2 + 50.0),
            (-2.0, 0.75 * sa * mu**1.2 + 30.0),
            (-2.0, 0.95 * sa * mu**0.2 + 10.0),
        )
    return Limits(
        (-4.0, 1.5 * sa * mu**1.2 + 100.0),
        (-4.0, 0.95 * sa * mu**1.2 + 50.0),
        (-4.0, sa + 0.0 * mu),
    )


def too_weak(ghi_wm2: ArrayLike, altitude_deg: ArrayLike, extraterrestrial: ArrayLike) -> Mask:
    """Return True where global is under 0.5 % of extraterrestrial sin(altitude), [n].

    False for a sun up to 10 degrees. Where True, the instrument is covered or dead, or the unit is
    kW/m2.
    """
    altitude = np.asarray(altitude_deg, float)
    top = np.asarray(extraterrestrial, float) * np.sin(np.radians(np.maximum(altitude, 0.0)))
    return (altitude > CLEAR_SUN_DEG) & (np.asarray(ghi_wm2, float) < LEAST_CLEARNESS * top)


def closure_ratio(
    ghi_wm2: ArrayLike, dhi_wm2: ArrayLike, dni_wm2: ArrayLike, altitude_deg: ArrayLike
) -> Floats:
    """Return global over (diffuse + DNI sin altitude), [n].

    NaN (not testable) where that sum is not over 50 W/m2. Irradiances in W/m2.
    """
    beam = np.asarray(dni_wm2, float) * np.maximum(np.sin(np.radians(altitude_deg)), 0.0)
    total = np.asarray(dhi_wm2, float) + beam
    return np.divide(ghi_wm2, total, out=np.full(total.shape, np.nan), where=total > 50.0)
