"""Weather files of PVGIS, NSRDB, TMY2 and SolarAnywhere, read by pvlib.

Each format states times in its own way. The documentation of the format defines which span or
moment a row is of. Where it leaves a choice, the choice that agrees best with sunrise and sunset is
taken and listed.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.arrays import Floats
from fieldlum.errors import InputError
from fieldlum.records import Site
from fieldlum.weather.plausibility import hours_against

_HALF = timedelta(minutes=30)  # of an hour, by definition
# A span of +-10 min separates labels that are half an hour apart, which a span of an hour does not.
# Chosen.
_NARROW = timedelta(minutes=10)
_EVERY_DAY = 5  # every fifth day decides: 73 sunrises and sunsets, at a fifth of the time; chosen
_OFFSET = re.compile(r"Irradiance Time Offset \(h\):\s*(-?\d+(?:\.\d+)?)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class ProviderYear:
    """Hours of a provider's file.

    t_utc : moments of the sun that the irradiance belongs to, [n]; irradiances [n] in W/m2, NaN
    where missing. notes : the choices of the reader, one sentence each.
    """

    place: Site
    t_utc: tuple[datetime, ...]
    dni_wm2: Floats
    dhi_wm2: Floats
    ghi_wm2: Floats
    typical: bool
    notes: tuple[str, ...] = ()


def read_provider(path: Path, lines: Sequence[str]) -> ProviderYear | None:
    """Read a file of PVGIS, NSRDB, TMY2 or SolarAnywhere; return None for another kind of file.

    Raises InputError if pvlib cannot read the file.
    """
    reader = _reader(path, lines)
    if reader is None:
        return None
    name, read = reader
    try:
        return read(path)
    except (KeyError, ValueError, IndexError, TypeError, AttributeError) as error:
        shown = str(error).splitlines()[0][:100] if str(error) else type(error).__name__
        raise InputError(
            path, shown, f"a weather file of {name}", "download it again as hourly data"
        ) from None


def _reader(path: Path, lines: Sequence[str]) -> tuple[str, Callable[[Path], ProviderYear]] | None:
    first = lines[0].lstrip("\ufeff")
    if first.startswith("Latitude (decimal degrees)"):
        return "PVGIS (TMY, csv)", _read_pvgis_csv
    if first.lstrip().startswith("{"):
        return "PVGIS (TMY, json)", _read_pvgis_json
    if first.startswith("Source,Location ID"):
        return "NSRDB (PSM)", _read_nsrdb
    if path.suffix.lower() == ".tm2":
        return "TMY2", _read_tmy2
    if len(lines) > 1 and "ObservationTime(LST)" in lines[1]:
        return "SolarAnywhere", _read_solaranywhere
    return None


# ----------------------------------------------------------------------------------------------
# PVGIS


def epw_time_offset(lines: Sequence[str]) -> timedelta | None:
    """Return the irradiance time offset that the comments of a PVGIS EPW state, or None."""
    for line in lines[:8]:
        if line.upper().startswith("COMMENTS") and (match := _OFFSET.search(line)):
            return timedelta(hours=float(match[1]))
    return None


def _read_pvgis_csv(path: Path) -> ProviderYear:
    from pvlib.iotools import read_pvgis_tmy

    data: Any
    meta: Any
    data, meta = read_pvgis_tmy(path, pvgis_format="csv")
    inputs = meta["inputs"]
    place = Site("PVGIS", inputs["latitude"], inputs["longitude"], "UTC", inputs["elevation"])
    return _pvgis_year(data, place, inputs.get("irradiance time offset", 0.0))


def _read_pvgis_json(path: Path) -> ProviderYear:
    from pvlib.iotools import read_pvgis_tmy

    if "tmy_hourly" not in json.loads(path.read_text(encoding="utf-8"))["outputs"]:
        raise ValueError("no key tmy_hourly")
    data: Any
    meta: Any
    data, meta = read_pvgis_tmy(path, pvgis_format="json")
    location = meta["inputs"]["location"]
    place = Site("PVGIS", location["latitude"], location["longitude"], "UTC", location["elevation"])
    offsets = [v for k, v in location.items() if "offset" in k.lower()]
    return _pvgis_year(data, place, float(offsets[0]) if offsets else 0.0)


def _pvgis_year(data: Any, place: Site, offset_h: float) -> ProviderYear:
    """Return the hours of a PVGIS file.

    Values are of one moment: the UTC time of the row plus the offset that the header states
    (PVGIS, "TMY generator" page).
    """
    year = _year_of(data, place, typical=True, shift=timedelta(hours=float(offset_h)))
    minutes = 60 * float(offset_h)
    note = f"rows moved by {minutes:+.0f} min, the irradiance time offset that PVGIS states"
    return replace(year, notes=(note,)) if offset_h else year


# ----------------------------------------------------------------------------------------------
# others


def _read_nsrdb(path: Path) -> ProviderYear:
    """Read an NSRDB file; its labels are the middle of the hour (minute 30), in standard time."""
    from pvlib.iotools import read_nsrdb_psm4

    data: Any
    meta: Any
    data, meta = read_nsrdb_psm4(path)
    place = Site("NSRDB", meta["latitude"], meta["longitude"], "UTC", float(meta["altitude"]))
    return _year_of(data, place, typical=len(set(data["Year"])) > 1, shift=timedelta(0))


def _read_tmy2(path: Path) -> ProviderYear:
    """Read a TMY2 file: a row is the mean of the hour that ends at its label.

    pvlib returns the start of that hour.
    """
    from pvlib.iotools import read_tmy2

    data: Any
    meta: Any
    data, meta = read_tmy2(path)
    place = Site(
        str(meta["City"]).strip(), meta["latitude"], meta["longitude"], "UTC", meta["altitude"]
    )
    return _year_of(data, place, typical=True, shift=_HALF)


def _read_solaranywhere(path: Path) -> ProviderYear:
    """Read a SolarAnywhere file; labels are the start, middle or end of the hour, by product."""
    from pvlib.iotools import read_solaranywhere

    data: Any
    meta: Any
    data, meta = read_solaranywhere(path)
    place = Site(
        str(meta["name"]).strip(), meta["latitude"], meta["longitude"], "UTC", meta["altitude"]
    )
    typical = len(set(data.index.year)) > 1 or str(meta.get("Type", "")).startswith("Typical")
    year = _year_of(data, place, typical=typical, shift=timedelta(0))
    return best_shift(
        year, {"hour starts": _HALF, "hour middles": timedelta(0), "hour ends": -_HALF}
    )


def _year_of(data: Any, place: Site, *, typical: bool, shift: timedelta) -> ProviderYear:
    data = data.rename(columns={name: name.lower() for name in ("DNI", "DHI", "GHI")})
    times = data.index.tz_convert("UTC").to_pydatetime()
    columns = [
        np.asarray(data[name], float) if name in data else np.full(len(data), np.nan)
        for name in ("dni", "dhi", "ghi")
    ]
    if not len(times) or any(name not in data for name in ("dni", "dhi")):
        raise ValueError("no columns of direct and diffuse irradiance")
    moments = tuple((t.astimezone(UTC) + shift).replace(microsecond=0) for t in times)
    return ProviderYear(place, moments, *columns, typical=typical)


def best_shift(
    year: ProviderYear, shifts: dict[str, timedelta], what: str = "row times taken as"
) -> ProviderYear:
    """Return the year moved by the shift after which the fewest hours contradict the sun.

    shifts : the choices by name; what : how the note begins that lists the choice.
    """
    some = [k for k in range(len(year.t_utc)) if (k // 24) % _EVERY_DAY == 0]
    light = (np.nan_to_num(year.dni_wm2) + np.nan_to_num(year.dhi_wm2))[some]
    against = {}
    for name, shift in shifts.items():
        times = [year.t_utc[k] + shift for k in some]
        counts = [hours_against(times, light, year.place, half) for half in (_HALF, _NARROW)]
        against[name] = sum(counts)
    chosen = min(against, key=lambda name: against[name])
    counts = ", ".join(f"{name} {count}" for name, count in against.items())
    note = f"{what} {chosen}, with which the fewest hours contradict sunrise and sunset ({counts})"
    moved = tuple(t + shifts[chosen] for t in year.t_utc)
    return replace(year, t_utc=moved, notes=(*year.notes, note))
