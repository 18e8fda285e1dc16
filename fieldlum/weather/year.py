"""The record of a weather year, and a synthetic one for places without a file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta

import numpy as np

from fieldlum.core.arrays import ArrayLike, Floats
from fieldlum.core.records import Site
from fieldlum.sky import sun

# Hours of a typical year are dated in this year: any year without 29 February would do. Chosen.
TYPICAL_YEAR = 2027
_HOUR = timedelta(hours=1)
_LIGHT = ("ghi_wm2", "dhi_wm2", "dni_wm2")


@dataclass(frozen=True, slots=True)
class Weather:
    """Hours of irradiance in time order; t_utc is the middle of each hour. Arrays [n] in W/m2.

    name: of file and station; site: the place for which it is used. repairs: one sentence for each
    thing that was changed, left out or is doubtful. typical: the hours are one year that stands for
    every year, so that a moment of any year can be looked up. synthetic: computed, not from a file.
    """

    name: str
    site: Site
    t_utc: tuple[datetime, ...]
    ghi_wm2: Floats
    dhi_wm2: Floats
    dni_wm2: Floats
    repairs: tuple[str, ...] = ()
    typical: bool = True
    synthetic: bool = False

    def __len__(self) -> int:
        """Return the number of hours."""
        return len(self.t_utc)

    def __getitem__(self, index: ArrayLike | slice) -> Weather:
        """Return the hours that an index array, a boolean array or a slice selects."""
        rows = np.arange(len(self))[index]  # type: ignore[index]
        light = {name: getattr(self, name)[rows] for name in _LIGHT}
        return replace(self, t_utc=tuple(self.t_utc[i] for i in rows), **light)

    def daylight(self) -> Weather:
        """Return the hours with DNI or DHI above 0 and the sun above the horizon."""
        up = sun.position(self.t_utc, self.site).altitude_deg > 0.0
        return self[up & (self.dni_wm2 + self.dhi_wm2 > 0.0)]

    def at(self, times_utc: Sequence[datetime]) -> sun.Irradiance:
        """Return GHI, DHI and DNI of the hour around each moment, [n], W/m2; NaN if there is none.

        The hour is the one whose middle is within half an hour. A typical year is used for moments
        of every year; 29 February has the weather of the 28th.
        """
        moments = [self._dated(t) for t in times_utc] if self.typical else times_utc
        reach = timedelta(seconds=1800.5)  # half an hour, and rounding
        hours, wanted = sun.pandas_index(self.t_utc), sun.pandas_index(moments)
        nearest = hours.get_indexer(wanted, method="nearest", tolerance=reach)  # -1: none
        values = {name: getattr(self, name)[nearest] for name in _LIGHT}
        return sun.Irradiance(**{n: np.where(nearest < 0, np.nan, v) for n, v in values.items()})

    def _dated(self, t_utc: datetime) -> datetime:
        """Return the same moment of local standard time in this weather's own year."""
        offset = sun.standard_offset(self.site.timezone, t_utc.astimezone(UTC).year)
        local = t_utc.astimezone(UTC) + offset
        year = (self.t_utc[len(self) // 2] + offset).year
        day = 28 if (local.month, local.day) == (2, 29) else local.day
        return local.replace(year=year, day=day) - offset


# ----------------------------------------------------------------------------------------------
# synthetic


def synthetic_weather(site: Site, seed: int = 1) -> Weather:
    """Return a plausible year for a place without a weather file, not one to judge the place by.

    seed: of the random draws. It is the clear sky of pvlib times a random cloudiness: an hourly
    AR(1) series (correlation 0.85) around a slower daily one (0.6), mapped to a share of the beam
    and to a factor on the diffuse (thin clouds double it, thick ones halve it). All coefficients
    are chosen so that the hours look like weather; not fitted to measurements.
    """
    start = sun.standard_midnight(date(TYPICAL_YEAR, 1, 1), site.timezone)
    times = tuple(start + _HOUR * k + timedelta(minutes=30) for k in range(8760))
    clear = sun.clearsky(times, site)
    rng = np.random.default_rng(seed)
    days = _ar1(rng, 366, 0.6).repeat(24)[:8760]
    cloud = 1 / (1 + np.exp(-(2.2 * days + 1.2 * _ar1(rng, 8760, 0.85))))  # 0 clear, 1 overcast
    beam = np.clip(1.0 - 1.35 * cloud, 0.0, 1.0) ** 1.5
    diffuse = np.where(cloud < 0.5, 1 + 2.4 * cloud, 2.2 - 3.2 * (cloud - 0.5))
    dni, dhi = clear.dni_wm2 * beam, clear.dhi_wm2 * diffuse
    # Clouds scatter a share of the beam that they remove; it arrives as diffuse light.
    height = np.maximum(np.sin(np.radians(sun.position(times, site).altitude_deg)), 0.0)
    dhi = dhi + 0.22 * (clear.dni_wm2 - dni) * height
    dni[dni < 1.0] = 0.0
    dhi = np.minimum(dhi, np.maximum(1.1 * clear.ghi_wm2 - dni * height, 0.0))
    note = "synthetic: pvlib clear sky times random clouds; plausible, but not this place's climate"
    return Weather(
        name=f"synthetic, seed {seed}",
        site=site,
        t_utc=times,
        dni_wm2=dni,
        dhi_wm2=dhi,
        ghi_wm2=dhi + dni * height,
        repairs=(note,),
        synthetic=True,
    )


def _ar1(rng: np.random.Generator, n: int, correlation: float) -> Floats:
    """Return an autoregressive series of order 1 with standard deviation 1, [n]."""
    from scipy.signal import lfilter

    noise = rng.standard_normal(n) * math.sqrt(1 - correlation**2)
    noise[0] /= math.sqrt(1 - correlation**2)
    return np.asarray(lfilter([1.0], [1.0, -correlation], noise))
