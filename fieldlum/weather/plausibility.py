"""Check units, columns and time labels of a weather file by comparing them with the sun.

Each of these mistakes leaves numbers that look like weather: kW instead of W, direct and diffuse
exchanged, global in the column of one of them, labels at the end of the hour instead of its middle.
The limits are far from what real files show (docs/file-formats.md) and far from what the mistakes
cause.
"""

from collections.abc import Sequence
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats, Mask
from fieldlum.core.errors import InputError
from fieldlum.core.records import Site
from fieldlum.sky import sun
from fieldlum.weather.year import Weather

# Seven files that are right have at most 8 min; labels at an end of the hour give 22 to 38 min.
# Chosen between them, on the same files (docs/validation.md).
MAX_SHIFT_MINUTES = 20.0
_SHIFTS_MIN = (-60.0, -30.0, 0.0, 30.0, 60.0)  # between them the result is interpolated; chosen
# Altitudes that are compared, deg. Lower ones may be behind a hill; at higher ones direct light
# hardly depends on the altitude. Chosen.
_ALTITUDES_DEG = np.arange(8.0, 33.0, 3.0)
MIN_HOURS = 20  # with fewer, a median or a quantile decides nothing; chosen


class _Sun:
    """The sun at a station in the hours of a weather year, for any shift of their times.

    t_unix_s [n]: middles of the hours. Positions are interpolated between quarters of an hour.
    """

    def __init__(self, weather: Weather, station: Site) -> None:
        """Compute the sun's positions every quarter of an hour around the hours of `weather`."""
        self.t_unix_s = np.array([t.timestamp() for t in weather.t_utc])
        # the half days (43 200 s) of all hours, and two more on each side
        half_days = np.unique(np.floor(self.t_unix_s / 43200.0)[:, None] + np.arange(-2.0, 3.0))
        self._grid_s = (43200.0 * half_days[:, None] + np.arange(0.0, 43200.0, 900.0)).ravel()
        at = sun.position([datetime.fromtimestamp(t, UTC) for t in self._grid_s], station)
        self._altitude_deg, self._east = at.altitude_deg, np.sin(np.radians(at.azimuth_deg))

    def altitude_deg(self, shift_min: float = 0.0) -> Floats:
        """Return the sun's altitudes [n] with all times `shift_min` later, at most 13 hours."""
        return np.interp(self.t_unix_s + 60.0 * shift_min, self._grid_s, self._altitude_deg)

    def is_morning(self, shift_min: float) -> Mask:
        """Return a mask [n], True for the sun in the east, with all times `shift_min` later."""
        return np.interp(self.t_unix_s + 60.0 * shift_min, self._grid_s, self._east) > 0.0


def _label_shift_min(weather: Weather, station: _Sun) -> float | None:
    """Return the minutes that, added to all times, make mornings as bright as afternoons.

    It is None if the file has under 300 days, because mornings and afternoons then differ by
    weather, or if no single shift of up to an hour does it.
    """
    if len({t.date() for t in weather.t_utc}) < 300:
        return None
    excess = np.array([_morning_excess(weather.dni_wm2, station, m) for m in _SHIFTS_MIN])
    falls = np.flatnonzero((excess[:-1] > 0.0) & (excess[1:] <= 0.0))
    if len(falls) != 1:
        return None
    k = int(falls[0])
    return float(np.interp(0.0, -excess[k : k + 2], _SHIFTS_MIN[k : k + 2]))


def _morning_excess(dni_wm2: Floats, station: _Sun, shift_min: float) -> float:
    """Return the relative excess of DNI in clear mornings over clear afternoons, -1 to 1.

    It is the difference of both divided by their sum, each at the quantile 0.8 of DNI, as a mean
    over solar altitudes. dni_wm2 [n], station: of the file's hours; shift_min: added to all times.
    NaN without an altitude at which both have 20 hours.
    """
    altitude, morning = station.altitude_deg(shift_min), station.is_morning(shift_min)
    excess = []
    for low, high in pairwise(_ALTITUDES_DEG):
        inside = (altitude >= low) & (altitude < high)
        mornings, afternoons = dni_wm2[inside & morning], dni_wm2[inside & ~morning]
        if min(len(mornings), len(afternoons)) >= MIN_HOURS:
            before, after = float(np.quantile(mornings, 0.8)), float(np.quantile(afternoons, 0.8))
            excess.append((before - after) / max(before + after, 20.0))  # dark hours decide nothing
    return float(np.mean(excess)) if excess else float("nan")


# Energy of the year's global irradiance over that of a cloudless sky. Chosen so that every climate
# is inside and a file in kW (0.001) or kJ (3.6) is outside; not measured.
_SHARE_OF_CLEAR = (0.03, 1.3)
# Share of the hours outside the extremely rare limits of BSRN (Long and Dutton 2010). Chosen so
# that single bad hours pass and an exchanged column does not; not measured.
MAX_EXTREME_SHARE = 0.02
# Global irradiance is never below the diffuse one, and equals it under overcast skies. Direct
# irradiance is below it in most overcast hours. Of the hours with over 20 W/m2 of diffuse, the
# files of five places have 34 to 62 % below and 1 to 3 % equal (to 5 %); with global as direct they
# have at most 2 % below and at least 10 % equal. Measured (docs/validation.md); chosen between.
_BETWEEN_RIGHT_AND_GLOBAL = 0.05
# Median of |global - diffuse - direct| over the global, where a file has all three. Chosen so that
# hourly means around a moving sun pass; not measured.
MAX_CLOSURE_ERROR = 0.2
# Altitudes, deg, at which the strongest direct light is compared, over the sine of the altitude.
# The ratio of low to high ones, over that of pvlib's clear sky of the same level at high ones, is
# 1.0 to 2.0 in three files and in skies of any haze, on a horizontal plane 0.3 to 0.8; with hidden
# low suns under 0.1. Measured; chosen between.
_LOW_DEG, _HIGH_DEG, _MIN_LOW_HOURS = (8.0, 13.0), 35.0, 200
# Share of the sunrises and sunsets that may contradict. Half an hour of shift gives 0.10 to 0.14 at
# 36 to 55 degrees north. Chosen, a third of that. Up to the second share only a warning is given,
# because a high horizon has it too.
_MAX_CONTRADICTIONS = (0.04, 0.25)
MIN_CONTRADICTIONS = 12  # in files of a few days fewer decide nothing; not measured
_LABELS = "check the time zone, and whether a row's time is its hour's start, middle or end"
_CORRECT_COLUMNS = "write the right columns, in W/m2"
STANDARD_TIME = "write standard time"
_SEASONS = ((6, 7, 8), (12, 1, 2))  # no country sets its clocks within these months


def check_plausible(path: Path, weather: Weather, place: Site, ghi_wm2: Floats) -> list[str]:
    """Return warnings about a file whose values or labels are doubtful at `place`.

    They are about sunrises and sunsets that are not those of `place`, a wrong level of clear hours,
    and labels that seem to be off by more than 20 minutes. ghi_wm2: [n] global irradiance of the
    file itself, NaN where it has none, W/m2. Raises InputError if values or labels cannot be true.
    """
    station = _Sun(weather, place)
    altitude = station.altitude_deg()
    up = altitude > sun.CLEAR_SUN_DEG
    if not up.any():
        return []
    total = weather.dhi_wm2 + sun.horizontal_beam(weather.dni_wm2, altitude)
    share = float(total.sum() / max(sun.clearsky(weather.t_utc, place).ghi_wm2.sum(), 1.0))
    low, high = _SHARE_OF_CLEAR
    if share < low and (dark := int((total[up] == 0.0).sum())) > 0.5 * up.sum():
        raise _dark_error(path, dark)
    if not low <= share <= high:
        found = f"the sum of irradiance is {share:.2g} times that of cloudless skies at "
        remedy = f"check whether values are in kW or kJ; {_CORRECT_COLUMNS}"
        raise InputError(path, found + place.name, f"{low:g} to {high:g} times", remedy)
    # Labels before columns: with labels an hour off, low suns look like overcast hours with much
    # DNI.
    doubt = _check_labels(path, weather, station, place)
    wrong = _wrong_column(weather, altitude, total, ghi_wm2)
    if wrong is not None and doubt:
        raise _place_error(path, f"{doubt}; {wrong[0]}")
    # With labels half an hour off, clear light at low altitudes looks like wrong columns.
    shift = _label_shift_min(weather, station) or 0.0
    is_moved, rounded = abs(shift) > MAX_SHIFT_MINUTES, 30 * round(shift / 30)
    if wrong is None and not is_moved:
        wrong = _horizontal_beam(weather.dni_wm2, altitude)
    if wrong is not None and not is_moved:
        found, expected, cause = wrong
        raise InputError(path, found, expected, f"check whether {cause}; {_CORRECT_COLUMNS}")
    text = "direct light of mornings and afternoons agrees"
    if wrong is not None:
        raise _shift_error(path, f"{text} only", rounded, "times at the middle of their hours")
    notes = [f"WARNING: {doubt}; check that the file is of this place"] if doubt else []
    if level := sun.wrong_level(weather.t_utc, total, weather.dhi_wm2, altitude, place):
        notes.append(f"WARNING: {level}: check the file's unit (W/m2)")
    if is_moved:
        text += f" if all row times are moved by {shift:+.0f} min"
        notes.append(f"{text}: {_LABELS} (--label-shift {rounded:+d})")
    return notes


def _wrong_column(
    weather: Weather, altitude: Floats, total: Floats, ghi_wm2: Floats
) -> tuple[str, str, str] | None:
    """Return texts if a column has another component: what was found, expected, and the cause.

    altitude: of the sun [n] deg; total: DHI + DNI sin(altitude) [n] W/m2; ghi_wm2: global
    irradiance of the file itself [n], NaN where it has none. None if nothing shows a wrong column.
    """
    up, dni, dhi = altitude > sun.CLEAR_SUN_DEG, weather.dni_wm2, weather.dhi_wm2
    top = sun.extraterrestrial_wm2(weather.t_utc)
    limits = sun.bsrn_limits(altitude, top, extreme=True)
    (_, dni_limit), (_, dhi_limit) = limits.dni_wm2, limits.dhi_wm2
    tested = {"DNI": dni > dni_limit, "DHI": dhi > dhi_limit}
    over = {name: float(is_over[up].mean()) for name, is_over in tested.items()}
    name = max(over, key=lambda name: over[name])
    if over[name] > MAX_EXTREME_SHARE:
        found = f"{name} is above the limit of any sky in {100 * over[name]:.0f} % of the daylight"
        cause = f"the column of {name} has another component"
        return f"{found} hours", f"at most {100 * MAX_EXTREME_SHARE:g} %", cause
    cause = "the column of DNI has global or diffuse"
    # Below a clearness index of 0.25 nearly all light is diffuse (Erbs, Klein, Duffie 1982: 97 %).
    clearness = total / (top * np.maximum(np.sin(np.radians(altitude)), 1e-9))
    overcast = up & (clearness < 0.25) & (total > 10.0)
    if overcast.sum() >= MIN_HOURS and (share := np.median(dhi[overcast] / total[overcast])) < 0.9:
        found = f"only {100 * share:.0f} % of the irradiance of overcast hours is diffuse (median)"
        return found, "over 90 %", cause
    ratio = dni[dhi > 20.0] / dhi[dhi > 20.0] - 1.0
    if len(ratio) >= MIN_HOURS:
        below, equal = float((ratio < -0.05).mean()), float((abs(ratio) <= 0.05).mean())
        if below < _BETWEEN_RIGHT_AND_GLOBAL < equal:
            found = f"DNI equals DHI in {100 * equal:.0f} % of the daylight hours, and is below it"
            expected = "overcast hours with less direct than diffuse irradiance"
            return f"{found} in {100 * below:.1f} %", expected, cause
    tested = up & (ghi_wm2 > 50.0)
    error = np.abs(1.0 - total[tested] / ghi_wm2[tested])
    off = float(np.median(error)) if tested.any() else 0.0
    if off > MAX_CLOSURE_ERROR:
        found = f"GHI differs from DHI + DNI sin(altitude) by {100 * off:.0f} % (median)"
        cause = "a column has another component, or direct on a horizontal plane"
        return found, f"at most {100 * MAX_CLOSURE_ERROR:g} %", cause
    return None


def _horizontal_beam(dni_wm2: Floats, altitude: Floats) -> tuple[str, str, str] | None:
    """Return texts as `_wrong_column` if the column of DNI is of a horizontal plane, else None.

    dni_wm2: as the file states it [n]; altitude: of the sun [n] deg. The strongest light over the
    sine of the altitude is compared at low and high suns, and with the clear sky of a haze that
    gives the same level at high suns. None too for a year without bright direct light, and where
    low suns are hidden.
    """
    from pvlib import atmosphere, clearsky

    used = altitude > _LOW_DEG[0]
    dni_wm2, altitude = dni_wm2[used], altitude[used]
    low, high, sine = altitude < _LOW_DEG[1], altitude > _HIGH_DEG, np.sin(np.radians(altitude))
    if not low.sum() >= _MIN_LOW_HOURS <= high.sum():
        return None

    def strongest(dni: Floats) -> tuple[float, float]:
        """Return the strongest light's ratio of low to high suns, and its DNI at high suns."""
        of_low, of_high = (np.quantile((dni / sine)[part], 0.98) for part in (low, high))
        return float(of_low / max(of_high, 1e-9)), float(np.quantile(dni[high], 0.98))

    zenith = 90.0 - altitude
    air_mass = np.asarray(atmosphere.get_relative_airmass(zenith))
    turbidities = (12, 10, 8, 7, 6, 5, 4, 3, 2)  # of Linke: from haze to very clear air
    clear_skies = (clearsky.ineichen(zenith, air_mass, haze)["dni"] for haze in turbidities)
    ratios, levels = zip(*(strongest(np.asarray(dni)) for dni in clear_skies), strict=True)
    ratio, level = strongest(dni_wm2)
    expected = float(np.interp(level, levels, ratios))
    if level < 100.0 or not 0.1 < ratio / expected < 0.88:
        return None
    found = f"DNI over the sine of the altitude is {ratio:.2f} times as strong at low as at high"
    cause = "the column of DNI has direct irradiance on a horizontal plane"
    return f"{found} altitudes", f"about {expected:.2f} times under a sky so clear", cause


def _check_labels(path: Path, weather: Weather, station: _Sun, place: Site) -> str:
    """Return a text about hours that contradict sunrise and sunset, "" if there are few.

    station: the sun of the file's hours; place: for the texts. Raises InputError with the likely
    cause if there are many, or if a cause explains them: labels or a zone that are off, cells of
    missing hours with zeros, a column with light at midnight, or another place.
    """
    light = weather.dni_wm2 + weather.dhi_wm2
    _check_summer_time(path, weather, light, station)
    # number of sunrises and sunsets
    edges = 2 * len({sun.standard_date(t, weather.site.timezone) for t in weather.t_utc})
    maximum = max(int(_MAX_CONTRADICTIONS[0] * edges), MIN_CONTRADICTIONS)
    against = {m: _against(light, station, m) for m in range(-720, 721, 15)}  # by shift in minutes
    if against[0] <= maximum:
        return ""
    found = f"{against[0]} hours have light while the sun is down or none while it is up"
    # Sunrise and sunset often permit several shifts. Mornings and afternoons decide between them,
    # otherwise the middle one is likeliest.
    fewest = min(against.values())
    equal = [m for m, count in against.items() if count <= fewest + 0.01 * edges]
    stated = _label_shift_min(weather, station)
    likeliest = float(np.median(equal)) if stated is None else stated
    best = min(equal, key=lambda m: (abs(m - likeliest), abs(m)))
    if against[best] <= maximum and against[best] < 0.5 * against[0]:
        found += f"; only {against[best]} hours"
        raise _shift_error(path, found, best, f"at most {maximum} such hours in {edges // 2} days")
    found += f" at {place.name}, and no shift of the row times explains them"
    dark = _against(np.minimum(light, 2.0), station, 0)  # 2 W/m2 contradict no night
    if dark > 0.9 * against[0]:
        raise _dark_error(path, dark)
    hours = station.t_unix_s / 3600.0 + place.longitude_deg / 15.0
    midnight = np.abs((hours + 12.0) % 24.0 - 12.0) < 1.5  # no day of a wrong latitude reaches it
    lit = midnight & (station.altitude_deg() < -8.0) & (light > 3.0)
    if lit.sum() > MIN_CONTRADICTIONS:
        dni, dhi = np.median(weather.dni_wm2[lit]), np.median(weather.dhi_wm2[lit])
        found += f": {lit.sum()} hours around midnight have light (median DNI {dni:.3g} W/m2, DHI "
        remedy = "check that column: it has another quantity, or an offset that its days have too"
        expected = "irradiance only while the sun is up"
        raise InputError(path, f"{found}{dhi:.3g} W/m2)", expected, remedy)
    if against[best] < 0.5 * against[0] or against[0] > _MAX_CONTRADICTIONS[1] * edges:
        raise _place_error(path, found)
    return found


def _check_summer_time(path: Path, weather: Weather, light: Floats, station: _Sun) -> None:
    """Raise InputError if the file's clock follows summer time.

    Then summer and winter agree with sunrise and sunset only after shifts that are an hour apart.
    light: DNI + DHI of each hour [n] W/m2; station: the sun of these hours.
    """
    months = np.array([t.month for t in weather.t_utc])
    in_summer, in_winter = (  # contradictions by shift in minutes
        {m: _against(light, station, m, np.isin(months, season)) for m in range(-180, 181, 15)}
        for season in _SEASONS
    )
    summer, winter = _best_shift_min(in_summer), _best_shift_min(in_winter)
    exchanged = min(in_summer[winter], in_winter[summer])
    with_own = max(in_summer[summer], in_winter[winter])
    if abs(abs(summer - winter) - 60) <= 15 and exchanged > max(4 * with_own, MIN_CONTRADICTIONS):
        moved = f"{summer:+d} min, and from December to February by {winter:+d} min"
        found = f"sunrise and sunset agree from June to August if rows are moved by {moved}"
        remedy = f"{STANDARD_TIME} in all rows: the file's clock follows summer time"
        raise InputError(path, found, "one clock in all months", remedy)


def _best_shift_min(against: dict[int, int]) -> int:
    """Return the shift with the fewest contradictions, the middle one of several equal ones."""
    middle = np.median([shift for shift in against if against[shift] == min(against.values())])
    return 15 * round(float(middle) / 15)


def _shift_error(path: Path, found: str, shift_min: int, expected: str) -> InputError:
    """Return the error for labels or a zone that are off by `shift_min` minutes."""
    is_zone = abs(shift_min) >= 180
    moved = f"{shift_min / 60:+.0f} h" if is_zone else f"{shift_min:+d} min"
    remedy = "check the file's time zone, and the sign of the site's longitude"
    if not is_zone:
        remedy = f"{_LABELS}; if the labels are wrong, use --label-shift {shift_min:+d}"
    return InputError(path, f"{found} with all row times moved by {moved}", expected, remedy)


def _dark_error(path: Path, count: int) -> InputError:
    """Return the error for missing hours that are written as zeros."""
    expected = "diffuse light while the sun is up"
    remedy = "leave cells of missing hours empty; check that the file is of this place"
    return InputError(path, f"{count} hours have no light while the sun is up", expected, remedy)


def _place_error(path: Path, found: str) -> InputError:
    """Return the error for a file whose sunrises and sunsets are those of another place."""
    expected = "the sunrises and sunsets of the file's place"
    cause = "the direct light would be computed with the wrong sun"
    return InputError(path, found, expected, f"check that the file is of this place: {cause}")


def check_hourly(path: Path, times: Sequence[datetime]) -> None:
    """Raise InputError if the median or the shortest time between rows is not one hour.

    Other stages count rows as hours. times: of the rows, in ascending order. Fewer than three rows
    are not checked.
    """
    steps = np.diff([t.timestamp() for t in times]) / 60.0
    for step in (np.median(steps), steps.min()) if len(steps) > 1 else ():
        if abs(step - 60.0) > 1.0:
            found = f"rows that are {step:g} min apart"
            raise InputError(path, found, "one row for each hour", "average the file to hours")


def _against(
    light: Floats, station: _Sun, shift_min: float, rows: Mask | slice = slice(None)
) -> int:
    """Return how many hours among `rows` contradict sunrise or sunset after a shift of labels.

    light: DNI + DHI of all hours [n] W/m2; station: the sun of these hours; shift_min: added to
    their times.
    """
    ends = (station.altitude_deg(shift_min + half)[rows] for half in (-30.0, 30.0))
    return contradictions(light[rows], *ends)


def contradictions(light: Floats, before_deg: Floats, after_deg: Floats) -> int:
    """Return how many of n spans of time have light at night, or none by day.

    light: mean DNI + DHI of each span [n] W/m2; before_deg, after_deg: the sun's altitude at its
    two ends [n]. Night is below -0.5 deg at both ends, and light there is over 3 W/m2; day is above
    1.5 deg at both, and no light is under 1 W/m2. The limits are on both sides of sunrise (-0.8
    deg), and above the rounding of files; chosen.
    """
    lit_at_night = (light > 3.0) & (np.maximum(before_deg, after_deg) < -0.5)
    dark_by_day = (light < 1.0) & (np.minimum(before_deg, after_deg) > 1.5)
    return int(lit_at_night.sum() + dark_by_day.sum())
