"""Tables that other programs write: read as these programs mean them, or refused with their cause.

Expected values come from pvlib's readers, from Python's csv module, or from the construction of
the file, as each test states.
"""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from zoneinfo import ZoneInfo

import numpy as np
import pandas as pd
import pvlib
import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import netcdf_file

from fieldlum.calibrate.fit_steps import read_table as read_readings
from fieldlum.capture.import_logger import import_rows
from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure, Site, SiteFile, Slot
from fieldlum.core.strict_csv import (
    is_wm2,
    lines_of,
    microvolts,
    read_time,
    split_heading,
    stated_unit,
)
from fieldlum.devices.logger_files import LoggerFile, read_logger_file
from fieldlum.optics.raw.exif import read_exposures
from fieldlum.report.compare import read_model_hours
from fieldlum.session import create_session, day_files, read_day
from fieldlum.session.files.irradiance_csv import CleanIrradiance
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.sky import sun
from fieldlum.weather import read_weather
from fieldlum.weather.formats import read_table
from fieldlum.weather.plausibility import _horizontal_beam as horizontal_beam
from fieldlum.year.predict.occupancy import read_occupancy

NORTH = Site("Town", 52.3, 4.8, "Europe/Amsterdam", 10.0)
EAST = Site("Town", 35.7, 139.7, "Asia/Tokyo", 10.0)
WEST = Site("Town", 33.8, -118.1, "America/Los_Angeles", 10.0)
ZONE = {"Town": 1, "Europe/Amsterdam": 1, "Asia/Tokyo": 9, "America/Los_Angeles": -8}
HALF = timedelta(minutes=30)


def hours_of(site: Site, year: int = 2023) -> list[datetime]:
    """The starts of the hours of a year on the site's clock, written as if in UTC."""
    start = datetime(year, 1, 1, tzinfo=UTC)
    return [start + timedelta(hours=k) for k in range(8760)]


def light_of(site: Site, starts: list[datetime], after: timedelta = HALF) -> Any:
    """DNI, DHI, GHI [n, 3] of a hazy sky without a cloud: moments `after` the local starts."""
    zone = timedelta(hours=ZONE[site.timezone])
    clear = sun.clearsky([t - zone + after for t in starts], site)
    return np.round(np.stack([0.7 * clear.dni_wm2, 1.5 * clear.dhi_wm2, 0.8 * clear.ghi_wm2], 1), 1)


def write_epw(path: Path, site: Site, light: Any, city: str = "Town", blank: str = "") -> Path:
    zone = ZONE[site.timezone]
    lines = [
        f"LOCATION,{city},-,XXX,made up,0,{site.latitude_deg},{site.longitude_deg},{zone},10.0"
    ]
    lines += [f"HEADER {k}" for k in range(7)]
    for t, (dni, dhi, _) in zip(hours_of(site), light, strict=True):
        before = [t.year, t.month, t.day, t.hour + 1, 60, "?9", 10.0, 5.0, 70, 101000, 0, 0, 300]
        cells = [*before, "9999", dni, dhi, *[0] * 18, 0.2]
        lines.append(",".join(map(str, cells)))
    path.write_text("\n".join(lines) + "\n")
    return path


def table(path: Path, site: Site = NORTH) -> Any:
    return read_table(path, lines_of(path.read_text(encoding="utf-8")), site)


# ----------------------------------------------------------------------------------------------
# weather: what other programs read


def tmy3(path: Path, heading: str = "(W/m^2)") -> Path:
    names = (
        f"Date (MM/DD/YYYY),Time (HH:MM),ETR (W/m^2),GHI {heading},GHI source,DNI {heading},"
        f"DHI {heading}"
    )
    rows = [
        f"{t:%m/%d/%Y},{t.hour + 1:02d}:00,0,{c},1,{a},{b}"
        for t, (a, b, c) in zip(hours_of(WEST), light_of(WEST, hours_of(WEST)), strict=True)
    ]
    path.write_text("\n".join(['0,"Town",XX,-8,33.8,-118.1,10', names, *rows]))
    return path


@pytest.mark.slow
@pytest.mark.authority
def test_tmy3_has_the_values_and_hours_of_pvlib(tmp_path: Path) -> None:
    """pvlib.iotools.read_tmy3 returns the ends of the hours; spellings of the unit are one unit."""
    path = tmp_path / "a.csv"
    expected, _ = pvlib.iotools.read_tmy3(tmy3(path), map_variables=True)
    read = table(path)
    ends = [t.to_pydatetime().replace(tzinfo=UTC) for t in expected.index]
    assert [row.when + HALF for row in read.rows] == ends
    assert [row.dni for row in read.rows] == list(expected["dni"])
    assert [row.dhi for row in read.rows] == list(expected["dhi"])
    for heading in ("(W/m^2))", "(W/m²)", "(W m^-2)", "[Watts/m^2]"):
        again = table(tmy3(tmp_path / "b.csv", heading))
        assert again.rows == read.rows, heading
    with pytest.raises(InputError, match="no column of DNI in W/m2 among"):
        table(tmy3(tmp_path / "c.csv", "(kW/m^2)"))


def pvgis_csv(path: Path, february: int) -> Path:
    """A typical year of PVGIS, whose February is of any year and ends with the 28th in UTC."""
    lines = [
        "Latitude (decimal degrees): 35.7",
        "Longitude (decimal degrees): 139.7",
        "Elevation (m): 10.0",
        "Irradiance Time Offset (h): 0.1761",
        "month,year",
        *(f"{month},{february if month == 2 else 2015}" for month in range(1, 13)),
        "time(UTC),T2m,RH,G(h),Gb(n),Gd(h),IR(h),WS10m,WD10m,SP",
    ]
    hours = hours_of(EAST, 2015)
    moments = [t + timedelta(hours=9 + 0.1761) for t in hours]
    light = light_of(EAST, moments, timedelta(0))
    for t, (dni, dhi, ghi) in zip(hours, light, strict=True):
        stamp = t.replace(year=february) if t.month == 2 else t
        lines.append(f"{stamp:%Y%m%d:%H%M},2.0,94.4,{ghi},{dni},{dhi},283.6,0.7,257.0,99870.0")
    path.write_text("\r\n".join([*lines, "", "T2m: temperature", ""]), newline="")
    return path


@pytest.mark.slow
@pytest.mark.authority
def test_a_pvgis_year_has_the_values_of_pvlib_and_all_hours_of_a_leap_february(
    tmp_path: Path,
) -> None:
    """pvlib.iotools.read_pvgis_tmy reads the same rows; 28 February in UTC is 1 March in Tokyo."""
    plain, leap = pvgis_csv(tmp_path / "a.csv", 2014), pvgis_csv(tmp_path / "b.csv", 2016)
    expected, meta = pvlib.iotools.read_pvgis_tmy(leap, pvgis_format="csv")
    assert meta["inputs"]["irradiance time offset"] == 0.1761
    read = table(leap, EAST)
    assert [row.when for row in read.rows] == [t.to_pydatetime() for t in expected.index]
    for name in ("dni", "dhi", "ghi"):
        assert [getattr(row, name) for row in read.rows] == list(expected[name])
    a, b = read_weather(plain, EAST), read_weather(leap, EAST)
    assert len(b) == 8760 and a.t_utc == b.t_utc and a.repairs == b.repairs
    assert (a.dni_wm2 == b.dni_wm2).all()
    february = datetime(2027, 2, 28, 23, 10, 34, tzinfo=UTC)
    assert february - timedelta(seconds=1) < min(b.t_utc, key=lambda t: abs(t - february))


def pvgis_series(path: Path, slope: int = 0) -> tuple[Path, Any]:
    """An hourly series of PVGIS: moments in UTC, and the beam on a horizontal plane."""
    moments = [datetime(2023, 6, 1, 0, 10, tzinfo=UTC) + timedelta(hours=k) for k in range(24 * 9)]
    clear = sun.clearsky(moments, NORTH)
    sine = np.maximum(np.sin(np.radians(sun.position(moments, NORTH).altitude_deg)), 0.0)
    dni, dhi = 0.7 * clear.dni_wm2, 1.5 * clear.dhi_wm2
    head = [
        "Latitude (decimal degrees):\t52.300",
        "Longitude (decimal degrees):\t4.800",
        "Elevation (m):\t10",
        "Radiation database:\tPVGIS-SARAH3",
        "",
        "",
        f"Slope: {slope} deg.",
        "Azimuth: 0 deg.",
        "time,Gb(i),Gd(i),Gr(i),H_sun,T2m,WS10m,Int",
    ]
    rows = [
        f"{t:%Y%m%d:%H%M},{a:.3f},{b:.3f},0.0,0,5,1,0.0"
        for t, a, b in zip(moments, dni * sine, dhi, strict=True)
    ]
    path.write_text("\r\n".join([*head, *rows, "", "Gb(i): beam", ""]), newline="")
    return path, (moments, dni, dhi, sine)


@pytest.mark.authority
def test_a_series_of_pvgis_has_the_diffuse_of_pvlib_and_the_beam_of_the_normal_plane(
    tmp_path: Path,
) -> None:
    """pvlib.iotools.read_pvgis_hourly reads the moments and the diffuse part; DNI from the test."""
    path, (moments, dni, dhi, sine) = pvgis_series(tmp_path / "a.csv")
    expected, *_ = pvlib.iotools.read_pvgis_hourly(path)
    read = table(path)
    assert [row.when for row in read.rows] == [t.to_pydatetime() for t in expected.index]
    assert [row.dhi for row in read.rows] == list(expected["poa_sky_diffuse"])
    high = sine > np.sin(np.radians(10.0))
    assert np.array([row.dni for row in read.rows])[high] == pytest.approx(dni[high], abs=0.02)
    assert moments[0].minute == 10 and not read.typical and np.isfinite(dhi).all()
    with pytest.raises(InputError, match="plane with slope 35 deg; expected a horizontal plane"):
        table(pvgis_series(tmp_path / "b.csv", 35)[0])
    for stated in ("", "Slope:\n", "Slope: optimum\n"):
        (tmp_path / "c.csv").write_text(path.read_text().replace("Slope: 0 deg.\n", stated))
        with pytest.raises(InputError, match="expected a horizontal plane"):
            table(tmp_path / "c.csv")


@pytest.mark.contract
def test_pvgis_in_json_is_the_csv(tmp_path: Path) -> None:
    """The same hours in both forms give the same rows; a file without hours is named."""
    path, _ = pvgis_series(tmp_path / "a.csv")
    lines = path.read_text().splitlines()
    start = next(k for k, line in enumerate(lines) if line.startswith("time"))
    names = lines[start].split(",")
    hours = []
    for line in lines[start + 1 : -2]:
        time, *numbers = line.split(",")
        hours.append(dict(zip(names, [time, *map(float, numbers)], strict=True)))
    location = {"latitude": 52.3, "longitude": 4.8, "elevation": 10.0}
    fixed = {"fixed": {"slope": {"value": 0, "optimal": False}}}
    answer = {"inputs": {"location": location}, "outputs": {"hourly": hours}}
    answer["inputs"]["mounting_system"] = fixed
    (tmp_path / "a.json").write_text(json.dumps(answer))
    csv_rows, json_rows = table(path).rows, table(tmp_path / "a.json").rows
    assert [(r.when, r.dni, r.dhi) for r in csv_rows] == [(r.when, r.dni, r.dhi) for r in json_rows]
    trackers: tuple[dict[str, Any], ...] = (
        {},
        {"two_axis": {"slope": {"value": "-"}}},
        {"vertical_axis": {"slope": {"value": 35}}},
        {"inclined_axis": {"slope": {"value": 0}}},
    )
    for mounting in trackers:  # as PVGIS 5.2 names them
        answer["inputs"]["mounting_system"] = mounting
        (tmp_path / "c.json").write_text(json.dumps(answer))
        with pytest.raises(InputError, match="expected a horizontal plane"):
            table(tmp_path / "c.json")
    (tmp_path / "d.json").write_text('[{"time(UTC)": "20180101:0000", "G(h)": 0.0}]')
    with pytest.raises(InputError, match="a list of hours without their place"):
        table(tmp_path / "d.json")
    (tmp_path / "b.json").write_text('{"inputs": {}, "outputs": {"monthly": []}}')
    with pytest.raises(InputError, match="no entry 'hourly'"):
        table(tmp_path / "b.json")


@pytest.mark.slow
@pytest.mark.contract
def test_a_wea_file_of_radiance_has_the_hours_of_the_epw(tmp_path: Path) -> None:
    """Written as epw2wea does it, with longitude and zone to the west; units 2 are luminance."""
    light = light_of(WEST, hours_of(WEST))
    head = "place Town_USA\nlatitude 33.80\nlongitude 118.10\ntime_zone 120\nsite_elevation 10.0\n"
    rows = [
        f"{t.month} {t.day} {t.hour + 0.5:.3f} {dni:.1f} {dhi:.1f}"
        for t, (dni, dhi, _) in zip(hours_of(WEST), light, strict=True)
    ]
    path = tmp_path / "a.wea"
    path.write_text(head + "\n".join(["weather_data_file_units 1", *rows]) + "\n")
    a = read_weather(path, WEST)
    b = read_weather(write_epw(tmp_path / "a.epw", WEST, light), WEST)
    assert a.t_utc == b.t_utc and a.repairs == b.repairs == ()
    assert (a.dni_wm2 == b.dni_wm2).all() and (a.dhi_wm2 == b.dhi_wm2).all()
    path.write_text(path.read_text().replace("units 1", "units 2"))
    with pytest.raises(InputError, match="weather_data_file_units 2; expected 1"):
        table(path, WEST)


def sam(path: Path, minute: str | None = None, source: str = "NSRDB") -> Path:
    keys = "Source,Location ID,City,State,Country,Latitude,Longitude,Time Zone,Elevation"
    names = "Year,Month,Day,Hour,GHI,DNI,DHI,Tdry" + (",Minute" if minute else "")
    rows = [
        f"{t.year},{t.month},{t.day},{t.hour},{c},{a},{b},20" + (f",{minute}" if minute else "")
        for t, (a, b, c) in zip(hours_of(WEST), light_of(WEST, hours_of(WEST)), strict=True)
    ]
    path.write_text("\n".join([keys, f"{source},0,Town,AZ,USA,33.8,-118.1,-8,337", names, *rows]))
    return path


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize("latitude", [20.0, 34.0])
def test_light_of_another_latitude_is_refused_by_its_days(tmp_path: Path, latitude: float) -> None:
    """No column is blamed: the beam of a file from 34 degrees is too strong for the sun at 52."""
    light = light_of(replace(NORTH, latitude_deg=latitude), hours_of(NORTH))
    path = write_epw(tmp_path / "a.epw", NORTH, light)
    with pytest.raises(InputError, match=r"no shift of the row times explains.*file's place"):
        read_weather(path, NORTH)


@pytest.mark.slow
@pytest.mark.authority
def test_sam_files_are_read_as_sam_and_pvlib_mean_them(tmp_path: Path) -> None:
    """SAM's file format: without a column Minute a row is the middle of its hour.

    pvlib.iotools.read_nsrdb_psm4 reads the values of the form with minutes, after the key
    Local Time Zone, which NSRDB adds, is put in.
    """
    without, with_30 = table(sam(tmp_path / "a.csv")), table(sam(tmp_path / "b.csv", "30"))
    text = (tmp_path / "b.csv").read_text().replace("Elevation\n", "Elevation,Local Time Zone\n")
    (tmp_path / "p.csv").write_text(text.replace("-8,337\n", "-8,337,-8\n"))
    expected, _ = pvlib.iotools.read_nsrdb_psm4(tmp_path / "p.csv", map_variables=True)
    moments = [t.tz_convert("UTC").to_pydatetime() for t in expected.index]
    for read in (without, with_30):
        assert [row.when - read.clock + read.shift for row in read.rows] == moments
        assert [row.dni for row in read.rows] == list(expected["dni"])
    (tmp_path / "e.csv").write_text(text.splitlines()[0])
    with pytest.raises(InputError, match="expected a header with Latitude"):
        table(tmp_path / "e.csv")
    own = (tmp_path / "a.csv").read_text().splitlines()
    header = [
        "lat,lon,tz,elev",
        "33.8,-118.1,-8,337",
        own[2].lower(),
        *own[3:],
    ]  # SAM's other names
    (tmp_path / "l.csv").write_text("\n".join(header))
    assert table(tmp_path / "l.csv").rows == without.rows
    (tmp_path / "u.csv").write_text(
        "t_utc,lat,lon,dni_wm2,dhi_wm2\n2023-06-01T12:00Z,52,5,700,90\n"
    )
    assert [row.dni for row in table(tmp_path / "u.csv").rows] == [700.0]  # not a header of SAM
    minute_0 = table(sam(tmp_path / "c.csv", "0"))
    assert minute_0.shift == HALF and "hour starts" in minute_0.notes[0]
    assert table(sam(tmp_path / "d.csv", source="TMY3")).typical and not without.typical


# ----------------------------------------------------------------------------------------------
# weather: causes by their name


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.parametrize("city", ['"Town, West"', '"A ""new"" Town, East, North"', "Town"])
def test_a_comma_in_the_city_moves_no_coordinate(tmp_path: Path, city: str) -> None:
    """The expected cells of the header are those of Python's csv module."""
    path = write_epw(tmp_path / "a.epw", NORTH, light_of(NORTH, hours_of(NORTH)), city)
    cells = next(csv.reader([path.read_text().splitlines()[0]]))
    place = table(path).place
    assert (place.name, place.latitude_deg) == (cells[1], float(cells[6]))


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize(
    ("site", "minutes"), [(NORTH, 0), (WEST, 0), (EAST, 60)], ids=["north", "west", "east"]
)
def test_values_of_another_moment_of_the_hour_are_refused_with_the_right_shift(
    tmp_path: Path, site: Site, minutes: int
) -> None:
    """Values of the hour's start need -30 minutes, of its end +30; then nothing is noted."""
    light = light_of(site, hours_of(site), timedelta(minutes=minutes))
    path = write_epw(tmp_path / "a.epw", site, light)
    right = minutes - 30
    with pytest.raises(InputError, match=re.escape(f"--label-shift {right:+d}")):
        read_weather(path, site)
    moved = read_weather(path, site, label_shift_min=right)
    assert moved.repairs == (f"times of all rows moved by {right:+d} min",)


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize(
    ("column", "value"), [(0, 47.0), (1, 6.0), (0, 900.0)], ids=["dni", "dhi", "much dni"]
)
def test_light_at_night_is_named_and_no_time_zone_blamed(
    tmp_path: Path, column: int, value: float
) -> None:
    light = light_of(NORTH, hours_of(NORTH))
    light[light[:, 1] == 0, column] = value
    path = write_epw(tmp_path / "a.epw", NORTH, light)
    name = ("DNI", "DHI")[column]
    with pytest.raises(InputError, match=f"around midnight have light.*{name} {value:g} W/m2"):
        read_weather(path, NORTH)


@pytest.mark.slow
@pytest.mark.contract
def test_a_wrong_time_zone_is_blamed_with_its_hours(tmp_path: Path) -> None:
    light = np.roll(light_of(WEST, hours_of(WEST)), 7, axis=0)
    with pytest.raises(InputError, match=r"moved by -[67] h.*check the file's time zone"):
        read_weather(write_epw(tmp_path / "a.epw", WEST, light), WEST)


def is_summer_time(t: datetime) -> bool:
    return datetime(2023, 3, 26, 2, tzinfo=UTC) <= t < datetime(2023, 10, 29, 3, tzinfo=UTC)


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize(("site", "shift"), [(NORTH, 0), (NORTH, -30), (WEST, -30), (WEST, -60)])
def test_a_clock_of_summer_time_is_named_and_no_shift_is_offered(
    tmp_path: Path, site: Site, shift: int
) -> None:
    """A shift of -30 minutes fits both seasons by half an hour, and would hide the cause."""
    starts = [t - timedelta(hours=is_summer_time(t)) for t in hours_of(site)]
    path = write_epw(tmp_path / "a.epw", site, light_of(site, starts))
    with pytest.raises(InputError, match="the file's clock follows summer time") as caught:
        read_weather(path, site, label_shift_min=shift)
    assert "label-shift" not in str(caught.value)
    summer, winter = f"{-60 - shift:+d} min", f"{-shift:+d} min"
    assert summer in str(caught.value) and winter in str(caught.value)


@pytest.mark.slow
@pytest.mark.contract
def test_a_file_in_utc_is_read_and_no_header_blamed(tmp_path: Path) -> None:
    """NSRDB offers its rows in UTC: then its Time Zone is 0, at any longitude."""
    local = sam(tmp_path / "a.csv", "30").read_text()
    rows = local.splitlines()
    for k, line in enumerate(rows[3:], start=3):
        t = datetime(*map(int, line.split(",")[:4]), tzinfo=UTC) + timedelta(hours=8)  # type: ignore[misc]
        rows[k] = ",".join([f"{t.year},{t.month},{t.day},{t.hour}", *line.split(",")[4:]])
    (tmp_path / "b.csv").write_text("\n".join(rows).replace("33.8,-118.1,-8,", "33.8,-118.1,0,"))
    a, b = (read_weather(tmp_path / name, WEST) for name in ("a.csv", "b.csv"))
    assert a.t_utc == b.t_utc and (a.dni_wm2 == b.dni_wm2).all()
    assert not b.typical  # one series, although its last hours are in the next year


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize("lines", [6, 9])
def test_a_header_of_any_length_costs_no_hour(tmp_path: Path, lines: int) -> None:
    light = light_of(NORTH, hours_of(NORTH))
    whole = write_epw(tmp_path / "a.epw", NORTH, light).read_text().splitlines()
    header = [*whole[:1], *["COMMENTS 1"] * (lines - 2), "DATA PERIODS,1,1,Data,Sunday, 1/ 1,12/31"]
    (tmp_path / "b.epw").write_text("\n".join([*header, *whole[8:]]))
    a, b = (read_weather(tmp_path / name, NORTH) for name in ("a.epw", "b.epw"))
    assert a.t_utc == b.t_utc and b.repairs == ()
    (tmp_path / "b.epw").write_text("\n".join(header).replace("PERIODS,1,1", "PERIODS,1,4"))
    with pytest.raises(InputError, match="4 rows for each hour; expected one row for each hour"):
        table(tmp_path / "b.epw")


@pytest.mark.slow
@pytest.mark.contract
def test_a_negative_code_by_day_is_missing_and_no_night_offset(tmp_path: Path) -> None:
    light = light_of(NORTH, hours_of(NORTH))
    light[: 24 * 60][light[: 24 * 60] == 0] = -6.0  # nights of a thermopile
    noon = 24 * 170 + 11
    light[noon : noon + 5] = -9.0
    weather = read_weather(write_epw(tmp_path / "a.epw", NORTH, light), NORTH)
    assert len(weather) == 8755 and (weather.dni_wm2 >= 0).all()
    assert weather.repairs[0] == "5 hours negative by day count as missing"
    assert "(down to -6.0 W/m2, a night offset) set to zero" in weather.repairs[1]
    assert "5 missing hours left out" in weather.repairs[2]


@pytest.mark.contract
def test_two_spellings_of_one_weather_column_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text(
        "t_utc,dni_wm2,DNI (W/m2),dhi_wm2\n2027-03-20T16:30:00Z,500,7,90\n"
    )
    with pytest.raises(InputError, match="2 columns named dni"):
        table(tmp_path / "a.csv")


@pytest.mark.slow
@pytest.mark.contract
def test_plan_moves_the_times_of_its_weather_file(tmp_path: Path) -> None:
    light = light_of(NORTH, hours_of(NORTH), timedelta(0))
    write_epw(tmp_path / "a.epw", NORTH, light)
    (tmp_path / "site.toml").write_text(
        '[site]\nname = "Town"\nlatitude_deg = 52.3\nlongitude_deg = 4.8\n'
        'timezone = "Europe/Amsterdam"\n[camera]\nheading_deg = 180.0\n'
    )
    asked = [
        "plan",
        str(tmp_path / "site.toml"),
        "--set",
        "even",
        "--count",
        "2",
        "--year",
        "2030",
    ]
    asked += ["--weather", str(tmp_path / "a.epw"), "--out", str(tmp_path / "s")]
    refused = CliRunner().invoke(main, asked)
    assert refused.exit_code == 3 and "--label-shift -30" in refused.output
    assert CliRunner().invoke(main, [*asked, "--label-shift", "-30"]).exit_code == 0


# ----------------------------------------------------------------------------------------------
# loggers


def logger_csv(path: Path, head: str = "t_utc,ghi_wm2,dhi_wm2", zone: str = "Z") -> list[str]:
    start = datetime(2027, 3, 20, 6, tzinfo=UTC)
    lines = [head]
    for k in range(60):
        t = start + timedelta(minutes=k)
        lines.append(f"{t:%Y-%m-%dT%H:%M:%S}{zone},{1.5 * k:.1f},{0.5 * k:.1f}")
    path.write_text("\n".join(lines) + "\n")
    return lines


def toa5(path: Path, names: str, units: str, encoding: str = "utf-8") -> Path:
    head = [
        '"TOA5","Roof","CR1000X","12345","OS","prog","9","T"',
        f'"TIMESTAMP","RECORD",{names}',
        f'"TS","RN",{units}',
        '"",""' + ',"Avg"' * (names.count(",") + 1),
    ]
    rows = [
        f'"2027-03-20 06:{k:02d}:00",{k}' + f",{8 * k:.2f}" * (names.count(",") + 1)
        for k in range(60)
    ]
    path.write_bytes(("\n".join([*head, *rows]) + "\n").encode(encoding))
    return path


@pytest.mark.analytic
@pytest.mark.parametrize("row", [2, 31, 60])
@pytest.mark.parametrize("cell", [0, 1, 2])
def test_a_stray_quote_loses_one_row_and_names_it(tmp_path: Path, row: int, cell: int) -> None:
    lines = logger_csv(tmp_path / "a.csv")
    whole = read_logger_file(tmp_path / "a.csv")
    cells = lines[row].split(",")
    cells[cell] = '"' + cells[cell]
    lines[row] = ",".join(cells)
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n")
    read = read_logger_file(tmp_path / "a.csv")
    assert read.samples == (*whole.samples[: row - 1], *whole.samples[row:])
    fault = "a quotation mark without its counterpart"
    assert read.left_out == (f"line {row + 1}: {fault}",)


@pytest.mark.contract
@pytest.mark.parametrize("head", ["t_utc", "time_utc", "Time(UTC)"])
def test_an_offset_never_moves_times_that_say_utc(tmp_path: Path, head: str) -> None:
    logger_csv(tmp_path / "a.csv", f"{head},ghi_wm2,dhi_wm2", zone="")
    for hours in (None, -8, 9):
        offset = None if hours is None else timedelta(hours=hours)
        read = read_logger_file(tmp_path / "a.csv", offset)
        assert read.samples[0].t_utc == datetime(2027, 3, 20, 6, tzinfo=UTC)
        assert any("no offset moves them" in note for note in read.notes) == (hours is not None)
    logger_csv(tmp_path / "b.csv", "time,ghi_wm2,dhi_wm2", zone="")
    local = read_logger_file(tmp_path / "b.csv", timedelta(hours=-8))
    assert local.samples[0].t_utc == datetime(2027, 3, 20, 14, tzinfo=UTC)


@pytest.mark.contract
def test_card_and_logger_have_offsets_of_their_own(tmp_path: Path) -> None:
    slot = Slot(datetime(2027, 3, 20, 16, 30, tzinfo=UTC), 30.0, 180.0, (Exposure(0.01, 5.6),))
    session = create_session(tmp_path / "s", SiteFile(Site("x", 47.6, -122.3)), [slot], {})
    path = str(toa5(tmp_path / "a.dat", '"GHI_Avg","Dif_Avg","Plane"', '"W/m^2","W/m²","W m-2"'))
    asked = ["import", str(session.root), "--irradiance", path, "--utc-offset", "+02:00"]
    done = CliRunner().invoke(main, [*asked, "--logger-utc-offset", "-08:00"])
    assert done.exit_code == 0, done.output
    assert "not used: Plane" in done.output
    samples, _ = read_day(day_files(session)[0])
    assert samples[0].t_utc == datetime(2027, 3, 20, 14, tzinfo=UTC)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("head", "dates", "first"),
    [
        ("Date,Time", ("13/12/2015,4:00:00", "01/12/2015,14:55:00"), "2015-12-13T04:00:00"),
        ("Date,Time", ("12/01/2015,14:55", "12/13/2015,04:00"), "2015-12-01T14:55:00"),
        ("timestamp", ("31/1/2016 00:00", "1/2/2016 00:00"), "2016-01-31T00:00:00"),
        ("Date,Time", ("2015-12-01,14:55", "2015-12-02,14:55"), "2015-12-01T14:55:00"),
    ],
)
def test_a_date_has_one_meaning_in_the_complete_file(
    tmp_path: Path, head: str, dates: tuple[str, str], first: str
) -> None:
    """A number above 12 shows which one is the day; the heading states name and unit."""
    path = tmp_path / "a.csv"
    rows = "".join(f"{date},{160 + k},1\n" for k, date in enumerate(dates))
    path.write_text(f"{head},Solar radiation (W/m2),UV Index\n{rows}")
    read = read_logger_file(path, timedelta(0))
    sample = next(sample for sample in read.samples if sample.ghi_wm2 == 160.0)
    assert sample.t_utc == datetime.fromisoformat(first).replace(tzinfo=UTC)
    assert read.notes == ("columns: Solar radiation (W/m2) as ghi_wm2",)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("dates", "cause"),
    [
        (("01/12/2015", "02/12/2015"), "cannot be distinguished"),
        (("13/12/2015", "12/13/2015"), "some with the day first and some with the month first"),
    ],
)
def test_an_ambiguous_date_is_refused(tmp_path: Path, dates: tuple[str, str], cause: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text("Date,Time,GHI (W/m2)\n" + "".join(f"{date},14:55,16\n" for date in dates))
    with pytest.raises(InputError, match=f"dates such as {dates[0]}.*{cause}.*2015-12-01"):
        read_logger_file(path, timedelta(0))


@pytest.mark.contract
def test_usual_names_count_with_their_unit_and_once(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = "\n2027-03-20T16:00:00Z,510,88\n"
    path.write_text(f"t_utc,GHI (W/m2),Diffuse [W/m^2]{rows}")
    sample = read_logger_file(path).samples[0]
    assert (sample.ghi_wm2, sample.dhi_wm2) == (510.0, 88.0)
    for names, found in (
        ("GHI,Diffuse", "columns t_utc, GHI"),  # no unit
        ("GHI (kW/m2),DHI (kW/m2)", "columns t_utc, GHI"),
        ("GHI (W/m2),Global (W/m2)", "several columns for ghi_wm2: GHI (W/m2), Global (W/m2)"),
    ):
        path.write_text(f"t_utc,{names}{rows}")
        with pytest.raises(InputError, match=re.escape(found)):
            read_logger_file(path)
    path.write_text(f"t_utc,ghi_wm2,Global (W/m2){rows}")
    assert "not used: Global (W/m2)" in read_logger_file(path).notes[0]


@pytest.mark.authority
def test_a_netcdf_file_of_arm_has_the_values_and_times_of_scipy(tmp_path: Path) -> None:
    """scipy.io.netcdf_file writes the variables of ARM's sgpsirs files; -9999 is missing."""
    path = tmp_path / "sgpsirsE13.b1.cdf"
    names = ("down_short_hemisp", "down_short_diffuse_hemisp", "short_direct_normal")
    with netcdf_file(path, "w") as file:
        file.createDimension("time", 3)
        time = file.createVariable("time", "d", ("time",))
        time.units, time[:] = "seconds since 2019-07-05 00:00:00 0:00", [0.0, 60.0, 120.0]
        for k, name in enumerate((*names, "up_short_hemisp", "qc_time")):
            values = file.createVariable(name, "f", ("time",))
            values.units = "1" if name == "qc_time" else "W/m^2"
            values.missing_value = np.float32(-9999.0)
            values[:] = [100.5 + k, -9999.0, 300.5 + k]
    read = read_logger_file(path)
    assert [s.t_utc for s in read.samples] == [
        datetime(2019, 7, 5, 0, minute, tzinfo=UTC) for minute in range(3)
    ]
    first, second, _ = read.samples
    assert (first.ghi_wm2, first.dhi_wm2, first.dni_wm2) == (100.5, 101.5, 102.5)
    assert (second.ghi_wm2, second.dhi_wm2, second.dni_wm2) == (None, None, None)
    assert "not used: up_short_hemisp" in read.notes[0] and len(read.notes) == 1
    with pytest.raises(InputError, match="no column GHI"):
        read_logger_file(path, None, {"ghi_wm2": "GHI"})
    with netcdf_file(path, "w") as file:
        file.createDimension("time", 3)
        file.createVariable("time", "d", ("time",))[:] = [0.0, 60.0, 120.0]
        file.createVariable("ghi_wm2", "f", ("time",))[:] = 100.0
    with pytest.raises(InputError, match="not one variable of times"):
        read_logger_file(path)
    content = path.read_bytes()
    for size in range(4, len(content), 4):  # cut within any field
        path.write_bytes(content[:size])
        with pytest.raises(InputError, match="export it as csv"):
            read_logger_file(path)


@pytest.mark.authority
@pytest.mark.parametrize(
    ("kind", "of_values", "of_flags"),
    [
        ("f", {"valid_max": np.float32(1500.0)}, {}),
        ("f", {"valid_range": np.array([0.0, 1500.0], np.float32)}, {}),
        (
            "i2",
            {"valid_range": np.array([0, 15000], np.int16), "scale_factor": np.float32(0.1)},
            {},
        ),
        (
            "i2",
            {"valid_range": np.array([0, 1500], np.float32), "scale_factor": np.float32(0.1)},
            {},
        ),
        ("f", {}, {"bit_1_assessment": "Indeterminate", "bit_2_assessment": "Bad"}),
        ("f", {"valid_range": "0 to 1500"}, {"bit_2_assessment": "Bad"}),  # a text is no limit
        (
            "f",
            {},
            {"flag_values": np.array([0, 1, 2], np.int32), "flag_meanings": "good night bad_data"},
        ),
        (
            "f",
            {},
            {"flag_values": np.arange(3, dtype=np.int32), "flag_meanings": "no_error night error"},
        ),
        (
            "f",
            {},
            {"flag_masks": np.array([1, 2], np.int32), "flag_meanings": "night sensor_failure"},
        ),
    ],
)
@pytest.mark.parametrize("clock", ["time", "valid_time"])
def test_values_that_a_netcdf_file_calls_bad_are_missing(
    tmp_path: Path, kind: str, of_values: dict[str, Any], of_flags: dict[str, Any], clock: str
) -> None:
    """CF conventions 1.11, 2.5.1 and 3.5, and ARM's standard; -8 W/m2 is a night offset."""
    path, light = tmp_path / "a.nc", np.array([500.0, 1800.0, -8.0, 600.0])
    with netcdf_file(path, "w") as file:
        file.createDimension(clock, 4)
        file.createDimension("station", 1)
        time = file.createVariable(clock, "d", (clock,))
        time.units, time[:] = "minutes since 2019-07-05", [0.0, 1.0, 2.0, 3.0]
        values = file.createVariable("ghi", kind, (clock, "station"))
        values.units, values.ancillary_variables = "W/m^2", "flags"
        values[:] = np.round(light[:, None] / of_values.get("scale_factor", 1.0))
        flags = file.createVariable("flags", "i4", (clock, "station"))
        flags[:] = np.array([0, 2, 1, 0])[:, None]
        for variable, about in ((values, of_values), (flags, of_flags)):
            for name, value in about.items():
                setattr(variable, name, value)
    read = read_logger_file(path)
    found = [np.nan if s.ghi_wm2 is None else s.ghi_wm2 for s in read.samples]
    np.testing.assert_allclose(found, [500.0, np.nan, -8.0, 600.0], rtol=1e-6)
    assert "missing by the file itself: 1 value of ghi" in read.notes[1]


def arm_file(path: Path, unit: str, kind: str, times: list[float]) -> Path:
    """Write global irradiance along the time as scipy does."""
    with netcdf_file(path, "w") as file:
        file.createDimension("time", len(times))
        time = file.createVariable("time", kind, ("time",))
        time.units, time[:] = f"{unit} since 2019-01-01 00:00:00 0:00", times
        values = file.createVariable("ghi_wm2", "f", ("time",))
        values.units, values[:] = "W/m^2", 500.0
    return path


@pytest.mark.analytic
@pytest.mark.parametrize(
    ("unit", "times", "step_s"),
    [
        ("days", [200.5, 200.50069], 1.3),
        ("hours", [7300.0, 7300.01667], 1.8),
        ("seconds", [31e6, 31e6 + 60.0], 2.0),
        ("minutes", [520000.0, 520001.0], 1.9),
    ],
)
def test_times_with_too_few_digits_are_refused(
    tmp_path: Path, unit: str, times: list[float], step_s: float
) -> None:
    """A single has 24 bits: of 200.5 days the last one is 1.3 s."""
    path = tmp_path / "a.cdf"
    with pytest.raises(InputError, match=f"times with 32 bits, enough for steps of {step_s:g} s;"):
        read_logger_file(arm_file(path, unit, "f", times))
    first, second = read_logger_file(arm_file(path, unit, "d", times)).samples
    assert abs((second.t_utc - first.t_utc).total_seconds() - 60.0) < 0.5
    if unit == "seconds":
        assert len(read_logger_file(arm_file(path, unit, "i", times)).samples) == 2


@pytest.mark.analytic
def test_times_of_a_day_in_single_precision_are_exact(tmp_path: Path) -> None:
    times = [30.0 * k for k in range(2880)]
    read = read_logger_file(arm_file(tmp_path / "a.cdf", "seconds", "f", times))
    assert read.samples[-1].t_utc == datetime(2019, 1, 1, 23, 59, 30, tzinfo=UTC)


@pytest.mark.contract
@pytest.mark.parametrize(
    "row", ["1,023.4,210.2,20.1", "612.0,-1,210.2,20.1", "1,023.4,1,210.2,20.1"]
)
def test_thousands_separators_refuse_the_file(tmp_path: Path, row: str) -> None:
    """Left out row by row, exactly the brightest minutes would be missing."""
    lines = ["t_utc,ghi_wm2,dhi_wm2,temperature_c"]
    for minute in range(60):
        values = row if minute in (3, 41) else "812.4,210.2,20.1"
        lines.append(f"2027-03-20T11:{minute:02}:00Z,{values}")
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines))
    with pytest.raises(InputError, match="2 of 60 rows have thousands separators: line 5"):
        read_logger_file(path)
    path.write_text("\n".join(lines[:30]))
    (left_out,) = read_logger_file(path).left_out
    assert left_out.endswith("because numbers have commas between thousands")


@pytest.mark.contract
@pytest.mark.parametrize(
    ("names", "used", "unused"),
    [
        ('"SlrW_Avg","Dif_Avg"', {"ghi_wm2", "dhi_wm2"}, ""),
        ('"SlrW_Avg","Tilted_Avg"', {"ghi_wm2"}, "not used: Tilted_Avg"),
        ('"GHI","SW_up","LW_dn"', {"ghi_wm2"}, "not used: SW_up, LW_dn"),
    ],
)
def test_every_column_in_wm2_is_listed(
    tmp_path: Path, names: str, used: set[str], unused: str
) -> None:
    units = ",".join('"W/m^2"' for _ in names.split(","))
    read = read_logger_file(toa5(tmp_path / "a.dat", names, units), timedelta(0))
    last = read.samples[-1]
    values = {"ghi_wm2": last.ghi_wm2, "dhi_wm2": last.dhi_wm2, "dni_wm2": last.dni_wm2}
    assert {name for name, value in values.items() if value is not None} == used
    assert all(f" as {name}" in read.notes[0] for name in used) and unused in read.notes[0]


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("t_utc,ghi_wm2,ghi_wm2\n2027-03-20T16:00:00Z,1,2\n", "2 columns named ghi_wm2"),
        ("t_utc,GHI_wm2,ghi_wm2\n2027-03-20T16:00:00Z,1,2\n", "2 columns named ghi_wm2"),
        ("t_utc,t_utc,ghi_wm2\n1,2027-03-20T16:00:00Z,2\n", "2 columns named t_utc"),
        ("time,ghi_wm2\n2027-03-20,5\n", "line 2: '2027-03-20' is a date without a time of day"),
        ("time,ghi_wm2\n20270320,5\n", "is a date without a time of day"),
        ("t_utc,ghi_wm2\n2027-03-20,5\n2027-03-21,6\n", "is a date without a time of day"),
        ("t_utc,ghi_wm2\n2027-03-20T16:00Z,3,6\n2027-03-20T16:01Z,3,7\n", "2 of 2 rows have dec"),
        ('t_utc,ghi_wm2\n2027-03-20T16:00Z,"3,6"\n2027-03-20T16:01Z,"3,7"\n', "decimal commas"),
        (
            't_utc,ghi_wm2\n2027-03-20T16:00Z,950.5\n2027-03-20T16:01Z,"1,003.6"\n'
            '2027-03-20T16:02Z,"1,004.7"\n',
            "2 of 3 rows have decimal commas",
        ),
        ("t_utc,ghi_wm2\n2027-03-20T16:00Z,5\nx\ny\nz\n", "3 rows cannot be read, 1 can"),
        ("t_utc,ghi (kW/m2)\n2027-03-20T16:00Z,0.5\n", "columns t_utc, ghi"),
        ("t_utc,ghi_wm2\n", "no row could be read: it has no rows"),
        ("when;ghi_wm2\n2027-03-20T16:00Z;5,1\n", "columns when, ghi_wm2; expected a column t_utc"),
        (
            "t_utc;ghi_wm2\n2027-03-20T16:00Z;950,5\n2027-03-20T16:01Z;1.003,6\n"
            "2027-03-20T16:02Z;1.004,7\n2027-03-20T16:03Z;950,5\n",
            "2 of 4 rows have thousands separators",
        ),
        (
            "t_utc,ghi_wm2,dhi_wm2\n2027-03-20T16:00Z,5,1\nt_utc,dhi_wm2,ghi_wm2\n",
            "line 3: other column names",
        ),
        ("time,ghi_wm2\n27/03/20 16:00,5\n", "day and year cannot be distinguished"),
        ('"TOA5";"a"\n"TIMESTAMP";"GHI"\n', "columns separated by ';'"),
        ("Plot Title: roof\nwhen,ghi_wm2\n2027-03-20T16:00Z,5\n", "remove the lines above"),
    ],
)
def test_each_refusal_states_its_cause(tmp_path: Path, text: str, found: str) -> None:
    (tmp_path / "a.csv").write_text(text)
    with pytest.raises(InputError, match=re.escape(found)):
        read_logger_file(tmp_path / "a.csv", timedelta(0), None)


NO_VALUES = (
    "NAN",
    "",
    "---",
    "NULL",
    "#N/A",
    "n/a",
    "None",
    "-INF",
    "-9999",
    "-99.9",
    "-999",
    "7999",
)


@pytest.mark.contract
@pytest.mark.parametrize("text", NO_VALUES)
def test_spellings_of_a_missing_value_cost_no_other_value(tmp_path: Path, text: str) -> None:
    """In a logger the other columns remain; in a weather file the hour is missing, not zero."""
    lines = logger_csv(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text(
        "\n".join([lines[0], *(f"{line.rpartition(',')[0]},{text}" for line in lines[1:])])
    )
    before, after = (read_logger_file(tmp_path / name) for name in ("a.csv", "b.csv"))
    assert [s.ghi_wm2 for s in after.samples] == [s.ghi_wm2 for s in before.samples]
    assert {s.dhi_wm2 for s in after.samples} == {None} and not after.left_out
    path = tmp_path / "c.csv"
    path.write_text(
        f"t_utc,dni_wm2,dhi_wm2\n2027-03-20T16:30:00Z,5,90\n2027-03-20 17:30,{text},9\n"
    )
    assert np.isnan(table(path).rows[1].dni) and table(path).rows[1].dhi == 9


@pytest.mark.contract
def test_a_voltage_has_no_codes_and_digits_have_no_underscore(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("time,sun_uV\n2021-04-21 11:40:00,7999\n")
    read = read_logger_file(path, timedelta(0), {"ghi_wm2": "sun_uV"}, {"ghi_wm2": 8.0})
    assert read.samples[0].ghi_wm2 == pytest.approx(999.875)
    path.write_text("t_utc,dni_wm2,dhi_wm2\n2027-03-20T16:30:00Z,1_0,90\n")
    with pytest.raises(InputError, match="line 2: dni_wm2 is '1_0'"):
        table(path)


@pytest.mark.contract
def test_a_second_line_of_units_counts(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    rows = "\n2027-03-20T16:00:00Z,510,88\n2027-03-20T16:01:00Z,511,88\n"
    for names, units in (("GHI,Diffuse", "UTC,W/m2,W/m²"), ("ghi_wm2,dhi_wm2", ",W/m2,W m-2")):
        path.write_text(f"sep=,\nt_utc,{names}\n{units}{rows}")
        read = read_logger_file(path)
        assert [(s.ghi_wm2, s.dhi_wm2) for s in read.samples] == [(510.0, 88.0), (511.0, 88.0)]
        assert not read.left_out
    path.write_text(f"t_utc,ghi_wm2,dhi_wm2\nUTC,kW/m2,W/m2{rows}")
    with pytest.raises(InputError, match="the column ghi_wm2 is in 'kW/m2'"):
        read_logger_file(path)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("head", "text", "utc"),
    [
        ("time", "2027/03/20 06:00:00", False),
        ("time", "2027.03.20 06:00", False),
        ("time", "2027-03-20 06:00:00 UTC", True),
        ("Time (UTC)", "2027-03-20 06:00:00", True),
        ("Timestamp_UTC", "2027/03/20 06:00", True),
    ],
)
def test_times_of_loggers(tmp_path: Path, head: str, text: str, utc: bool) -> None:
    (tmp_path / "a.csv").write_text(f"{head},ghi_wm2\n{text},160\n")
    read = read_logger_file(tmp_path / "a.csv", timedelta(hours=-8))
    assert read.samples[0].t_utc == datetime(2027, 3, 20, 6 if utc else 14, tzinfo=UTC)


@pytest.mark.contract
@pytest.mark.parametrize("name", ["utc_offset", "GMT Offset", "tz", "Time Zone"])
def test_a_column_of_offsets_counts_and_another_zone_is_named(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"time,{name},ghi_wm2\n2027-03-28 01:30,+01:00,5\n2027-03-28 03:30,+0200,6\n")
    times = [datetime(2027, 3, 28, hour, 30, tzinfo=UTC) for hour in (0, 1)]
    assert [s.t_utc for s in read_logger_file(path).samples] == times
    stated = read_logger_file(path, timedelta(hours=5))
    assert [s.t_utc for s in stated.samples] == times
    assert f"offsets in column {name} count, not --utc-offset" in stated.notes[1]
    path.write_text(f"time,{name},ghi_wm2\n2027-03-28 01:30,CET,5\n")
    assert f"{name} (CET) is not used" in read_logger_file(path, timedelta(hours=1)).notes[1]
    with pytest.raises(InputError, match="state it with --logger-utc-offset"):
        read_logger_file(path)


@pytest.mark.contract
@pytest.mark.parametrize(
    "text", ["2027-03-20 06.30", "2027-03-20T06.30Z", "20270320 06.5", "2027-03-20T06:30.5Z"]
)
def test_a_point_after_the_hour_is_no_fraction_of_a_second(tmp_path: Path, text: str) -> None:
    """Python reads 06.30, as Finnish and Italian programs write it, as 06:00:00.3."""
    path = tmp_path / "a.csv"
    path.write_text(f"time,ghi_wm2\n{text},160\n")
    with pytest.raises(InputError, match=f"line 2: time '{text}', expected one like"):
        read_logger_file(path, timedelta(0))
    path.write_text(f"t_utc,dni_wm2,dhi_wm2\n{text},160,5\n")
    with pytest.raises(InputError, match=f"line 2: time '{text}'"):
        table(path)
    path.write_text(f"t_utc,panorama,dni_wm2,dhi_wm2\n{text},a.exr,160,5\n")
    with pytest.raises(InputError, match="line 2: time"):
        PairsFile.read(path)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("head", "hours"),
    [("TIMESTAMP (UTC+1)", 1), ("Date Time, GMT-08:00", -8), ("Date/Time (UTC)", 0), ("date", 2)],
)
def test_a_zone_in_the_heading_counts(tmp_path: Path, head: str, hours: int) -> None:
    (tmp_path / "a.csv").write_text(f'"{head}",ghi_wm2\n2027-03-20 06:00:00,160\n')
    read = read_logger_file(tmp_path / "a.csv", timedelta(hours=2))
    assert read.samples[0].t_utc == datetime(2027, 3, 20, 6, tzinfo=UTC) - timedelta(hours=hours)
    assert any("--utc-offset" in n or "no offset" in n for n in read.notes) == (hours != 2)
    (tmp_path / "a.csv").write_text("when,ghi_wm2\n2027-03-20 06:00:00,160\n")
    with pytest.raises(InputError, match="--column time=NAME, and state --logger-utc-offset"):
        read_logger_file(tmp_path / "a.csv", timedelta(0))


PANGAEA = (
    "/* DATA DESCRIPTION:\nCitation:\tDoe, J (2020): Basic measurements of radiation\n"
    "Parameter(s):\tDATE/TIME (Date/Time) * GEOCODE\n*/\n"
    "Date/Time\tHeight [m]\tSWD [W/m**2]\tSWD std dev [±]\tDIR [W/m**2]\tDIF [W/m**2]\n"
)
HOBO = '"Plot Title: roof"\n"#","Date Time, GMT+00:00","{}, W/m² (LGR S/N: 2, SEN S/N: 1)","Note"\n'
OF_PROGRAMS = {
    "PANGAEA": (PANGAEA, "{t:%Y-%m-%dT%H:%M}\t2\t{g}\t1.5\t300.5\t{d}"),
    "HOBOware": (HOBO.format("Solar Radiation"), "7,{t:%m/%d/%y %I:%M:%S %p},{g},"),
    "HOBOware in German": (
        HOBO.format("Global").replace('","', '";"'),
        "7;{t:%d.%m.%y %H:%M};{g};",
    ),
    "a spreadsheet in German": (
        "Datum;Uhrzeit;GHI (W/m²);DHI (W/m²)\n",
        "{t:%d.%m.%Y;%H:%M};{g};{d}",
    ),
    "a spreadsheet in French": ("Date;Heure;GHI (W/m²);DHI (W/m²)\n", "{t:%d/%m/%Y;%H:%M};{g};{d}"),
    "a spreadsheet in Chinese": ("日期,时间,GHI (W/m²)\n", "{t:%Y/%m/%d,%H:%M},{g}"),
    "LabVIEW": ("Time\tGHI (W/m2)\tDHI (W/m2)\n", "{t:%Y-%m-%d %H:%M}\t{g}\t{d}"),
    "pandas": (",ghi_wm2,dhi_wm2\n", "{t:%Y-%m-%d %H:%M:%S}+00:00,{g},{d}"),
    "HOBOconnect": ('#,Date-Time (UTC),"Solar Radiation , W/m²"\n', "7,{t:%m/%d/%Y %H:%M:%S},{g}"),
    "MIDC": ("DATE (MM/DD/YYYY),LST,Global [W/m^2]\n", "{t:%m/%d/%Y,%H:%M},{g}"),
}


@pytest.mark.authority
@pytest.mark.parametrize("comma", [False, True])
@pytest.mark.parametrize("program", OF_PROGRAMS)
def test_tables_with_other_separators_titles_and_commas(
    tmp_path: Path, program: str, comma: bool
) -> None:
    """Expected: the numbers and moments of which Python's format writes each row."""
    head, form = OF_PROGRAMS[program]
    times = [datetime(2027, 3, 20, 6, tzinfo=UTC) + timedelta(minutes=k) for k in range(60)]
    numbers = [(f"{900 + 2.5 * k:.1f}", f"{40 + 0.5 * k:.1f}") for k in range(60)]
    is_comma = comma and not {",", "2"} & set(form)
    rows = [
        form.format(
            t=t, g=g.replace(".", ",") if is_comma else g, d=d.replace(".", ",") if is_comma else d
        )
        for t, (g, d) in zip(times, numbers, strict=True)
    ]
    path = tmp_path / "a.csv"
    path.write_text(
        head + "\n".join(rows) + "\n", encoding="utf-8-sig" if "HOBO" in program else "utf-8"
    )
    read = read_logger_file(path, timedelta(0))
    assert [s.t_utc for s in read.samples] == times and not read.left_out
    assert [s.ghi_wm2 for s in read.samples] == [float(g) for g, _ in numbers]
    if "{d}" in form:
        assert [s.dhi_wm2 for s in read.samples] == [float(d) for _, d in numbers]


@pytest.mark.contract
@pytest.mark.parametrize(
    "cell", ["1.234", "1.234,5", "nan", "inf", "-9999", "1_0", "5 cd", "1 234"]
)
def test_a_reading_is_one_number_or_refused(tmp_path: Path, cell: str) -> None:
    """In a file with decimal commas 1.234 is 1234, and a calibration has no missing values."""
    path = tmp_path / "a.csv"
    path.write_text(f"x_px;y_px;azimuth_deg;note_px\n1,5;2;3;4\n1;{cell};3;4\n")
    with pytest.raises(InputError, match=f"a.csv: line 3: y_px is '{re.escape(cell)}'"):
        _readings(path)
    path.write_text("x_px;y_px;azimuth_deg;note_px\n1,5;2;-99;4\n")
    assert _readings(path)[0]["x_px"] == 1.5 and _readings(path)[0]["azimuth_deg"] == -99.0


@pytest.mark.contract
@pytest.mark.parametrize(
    "start",
    [
        b"CDF\x01",
        b"\x89HDF\r\n",
        b"PK\x03\x04",
        b"\x1f\x8b\x08",
        b"<!DOCTYPE html>",
        b'"TOB1","a"\r\n',
    ],
)
def test_files_that_are_no_text_are_named(tmp_path: Path, start: bytes) -> None:
    (tmp_path / "a.csv").write_bytes(start + b"t_utc,ghi_wm2\n" * 3)
    for read in (
        lambda path: read_logger_file(path),
        lambda path: read_weather(path, NORTH),
        PairsFile.read,
    ):
        with pytest.raises(InputError, match=r"netCDF|zip archive|gzip|web page|TOB"):
            read(tmp_path / "a.csv")


SPELLINGS = (
    "W/m²", "W m^-2", "Watts/m^2", "Wm^-2", "W/m2", "W/M^2", "W.m-2", "W m⁻²", "W/m**2",
    "Watts per square meter", "W·m⁻²", "watt/m2", "W/sq m", "W/metre^2",
)  # fmt: skip


@pytest.mark.contract
@pytest.mark.parametrize("unit", SPELLINGS)
def test_spellings_of_one_unit_are_one_unit(tmp_path: Path, unit: str) -> None:
    assert is_wm2(unit) and split_heading(f"DNI ({unit})") == ("DNI", unit)
    read = read_logger_file(toa5(tmp_path / "a.dat", '"SlrW_Avg"', f'"{unit}"'), timedelta(0))
    assert len(read.samples) == 60


@pytest.mark.contract
@pytest.mark.parametrize("unit", ["W/m²", "W m^-2", "kW/m²", "W", "°C"])
def test_a_cell_may_repeat_the_unit(tmp_path: Path, unit: str) -> None:
    """Grafana exports ``26.4 W/m²``; another unit is no irradiance in W/m2."""
    path = tmp_path / "a.csv"
    path.write_text(f'"Time","GHI"\n2022-12-22 08:50:15,26.4 {unit}\n', encoding="utf-8-sig")
    if is_wm2(unit):
        read = read_logger_file(path, timedelta(0), {"ghi_wm2": "GHI"})
        assert read.samples[0].ghi_wm2 == 26.4
        return
    with pytest.raises(InputError, match=f"line 2: ghi_wm2 is '26.4 {unit}'"):
        read_logger_file(path, timedelta(0), {"ghi_wm2": "GHI"})


@pytest.mark.contract
@pytest.mark.parametrize(
    "unit", ["kW/m2", "mW/cm2", "W/m2/nm", "J/m2", "kWh/m2", "W/ft2", "MJ/m^2", "lux", "Wm"]
)
def test_other_units_are_not_taken_for_it(tmp_path: Path, unit: str) -> None:
    assert not is_wm2(unit) and microvolts(unit) is None
    with pytest.raises(InputError, match="is in"):
        read_logger_file(toa5(tmp_path / "a.dat", '"SlrW_Avg"', f'"{unit}"'), timedelta(0))
    if "/" in unit:
        (tmp_path / "a.csv").write_text(f"t_utc,sky ({unit})\n2027-03-20T16:00Z,5\n")
        assert stated_unit(f"sky ({unit})") == unit
        with pytest.raises(InputError, match="is in"):
            read_logger_file(tmp_path / "a.csv", None, {"ghi_wm2": f"sky ({unit})"})


@pytest.mark.analytic
@pytest.mark.parametrize(("unit", "scale"), [("mV", 1.0), ("uV", 1e3), ("V", 1e-3)])
def test_a_voltage_becomes_irradiance_by_its_sensitivity(
    tmp_path: Path, unit: str, scale: float
) -> None:
    """8.63 uV per W/m2: 8.024312 mV are 929.816 W/m2 (the station of Patras, 21 April 2021)."""
    time = "2021-04-21 11:40:00"
    (tmp_path / "a.csv").write_text(f"time,sun_{unit}\n{time},{8.024312 * scale:.9g}\n")
    column, sensitivity = {"ghi_wm2": f"sun_{unit}"}, {"ghi_wm2": 8.63}
    read = read_logger_file(tmp_path / "a.csv", timedelta(hours=2), column, sensitivity)
    assert read.samples[0].ghi_wm2 == pytest.approx(929.816, abs=0.001)
    with pytest.raises(InputError, match="state the sensitivity of the pyranometer"):
        read_logger_file(tmp_path / "a.csv", timedelta(hours=2), column)
    (tmp_path / "b.dat").write_text(f"{time},3963626,0.1,8.024312\n")
    numbers = {"ghi_wm2": "4", "dhi_wm2": "3"}
    both = {"ghi_wm2": 8.63, "dhi_wm2": 8.64}
    raw = read_logger_file(tmp_path / "b.dat", timedelta(hours=2), numbers, both)
    assert raw.samples[0].ghi_wm2 == pytest.approx(929.816, abs=0.001)
    assert "unit is not stated" in raw.notes[1]
    bare = read_logger_file(tmp_path / "b.dat", timedelta(hours=2), numbers)
    assert "a voltage needs --sensitivity" in bare.notes[-1]


@pytest.mark.contract
def test_a_day_file_with_the_line_ends_of_windows_is_whole(tmp_path: Path) -> None:
    """Sent by mail, or through git; a cell that a spreadsheet changed fails its checksum."""
    slot = Slot(datetime(2027, 3, 20, 16, 30, tzinfo=UTC), 30.0, 180.0, (Exposure(0.01, 5.6),))
    session = create_session(tmp_path / "s", SiteFile(Site("x", 47.6, -122.3)), [slot], {})
    logger_csv(tmp_path / "a.csv")
    import_rows(session, tmp_path / "a.csv", None)
    (path,) = day_files(session)
    whole, content = read_day(path)[0], path.read_bytes()
    path.write_bytes(b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n"))
    assert read_day(path) == (whole, 0) and len(whole) == 60
    path.write_bytes(content.replace(b",1.5,", b",1.6,", 1))
    assert read_day(path)[1] == 1


@pytest.mark.contract
def test_a_changed_sensitivity_replaces_the_earlier_rows(tmp_path: Path) -> None:
    slot = Slot(datetime(2027, 3, 20, 16, 30, tzinfo=UTC), 30.0, 180.0, (Exposure(0.01, 5.6),))
    session = create_session(tmp_path / "s", SiteFile(Site("x", 47.6, -122.3)), [slot], {})
    lines = logger_csv(tmp_path / "a.csv", "t_utc,sun_mV,sky_mV")
    columns = {"ghi_wm2": "sun_mV"}
    first = import_rows(session, tmp_path / "a.csv", None, columns, {"ghi_wm2": 50.0})
    again = import_rows(session, tmp_path / "a.csv", None, columns, {"ghi_wm2": 100.0})
    assert (first.rows, again.rows, again.withdrawn) == (60, 60, 60)
    samples, _ = read_day(day_files(session)[0])
    assert samples[-1].ghi_wm2 == pytest.approx(885.0) and lines[60].endswith("88.5,29.5")


@pytest.mark.contract
@pytest.mark.parametrize(
    ("start", "end"),
    [("8:00", "18:00"), ("08:00", "9:30"), ("0:15", "24:00"), ("8:00:00", "18:00:30")],
)
def test_occupancy_takes_hours_of_one_digit(tmp_path: Path, start: str, end: str) -> None:
    (tmp_path / "a.csv").write_text(f"days,start,end\nmon-fri,{start},{end}\n")
    padded = ",".join(text if text.find(":") == 2 else f"0{text}" for text in (start, end))
    (tmp_path / "b.csv").write_text(f"days,start,end\nmon-fri,{padded}\n")
    assert read_occupancy(tmp_path / "a.csv").periods == read_occupancy(tmp_path / "b.csv").periods
    for text in ("08.30", "8", "6:00 PM", "8:60"):  # 08.30 was 08:00 and 0.3 s
        (tmp_path / "a.csv").write_text(f"days,start,end\nmon-fri,{text},{end}\n")
        with pytest.raises(InputError, match="correct line 2"):
            read_occupancy(tmp_path / "a.csv")


@pytest.mark.contract
def test_a_period_between_the_middles_of_hours_is_refused(tmp_path: Path) -> None:
    """It was counted as 0 hours, without a word."""
    (tmp_path / "a.csv").write_text("days,start,end\nmon,12:30,13:00\nmon,12:35,13:25\n")
    with pytest.raises(InputError, match=r"12:35 to 13:25 without the middle.*correct line 3"):
        read_occupancy(tmp_path / "a.csv")


@pytest.mark.contract
@pytest.mark.parametrize(
    ("days", "count"),
    [
        ("Monday - Friday", 5),
        ("mon\u2013fri", 5),  # as word processors write it
        ("tues thurs", 2),
        ("sat-mon", 3),
        ("mon;tue", 0),
        ("monthly", 0),
        ("1-5", 0),
    ],
)
def test_days_are_read_completely_or_refused(tmp_path: Path, days: str, count: int) -> None:
    path = tmp_path / "a.csv"
    path.write_text(f"days,start,end\n{days},08:00,18:00\n", encoding="utf-8")
    if count:
        assert len(read_occupancy(path).periods) == count
        return
    with pytest.raises(InputError, match=f"unknown days '{days}'.*correct line 2"):
        read_occupancy(path)


# ----------------------------------------------------------------------------------------------
# weather of Solcast, CAMS and Open-Meteo, and days of a spreadsheet


def _summer() -> tuple[list[datetime], Any]:
    """The starts of the hours of nine days in UTC, and DNI, DHI, GHI of each."""
    starts = [datetime(2023, 6, 1, tzinfo=UTC) + timedelta(hours=k) for k in range(24 * 9)]
    clear = sun.clearsky([t + HALF for t in starts], NORTH)
    return starts, np.round(
        np.stack([0.7 * clear.dni_wm2, 1.5 * clear.dhi_wm2, 0.8 * clear.ghi_wm2], 1), 1
    )


def _cams(path: Path, reference: str = "Universal time (UT)", minutes: int = 60) -> Path:
    starts, light = _summer()
    head = [
        "# Coding: utf-8",
        "# Title: CAMS Radiation Service v4.6 all-sky irradiation (derived from satellite data)",
        "# Latitude (positive North, ISO 19115): 52.3000",
        "# Longitude (positive East, ISO 19115): 4.8000",
        "# Altitude (m): 10.00",
        f"# Time reference: {reference}",
        "# Summarization (integration) period: 0 year 0 month 0 day 1 h 0 min 0 s",
        "# noValue: nan",
        "#",
        "# Observation period;TOA;Clear sky GHI;Clear sky BHI;Clear sky DHI;Clear sky BNI;GHI;BHI;"
        "DHI;BNI;Reliability",
    ]
    for k, (t, (dni, dhi, ghi)) in enumerate(zip(starts, light, strict=True)):
        a = starts[0] + timedelta(minutes=minutes * k) if minutes != 60 else t
        b = a + timedelta(minutes=minutes)
        span = f"{a:%Y-%m-%dT%H:%M:%S}.0/{b:%Y-%m-%dT%H:%M:%S}.0"
        head.append(f"{span};900.0;1.0;2.0;3.0;4.0;{ghi};5.0;{dhi};{dni};1.0000")
    path.write_text("\n".join(head) + "\n")
    return path


@pytest.mark.authority
def test_a_csv_of_cams_has_the_values_and_hours_of_pvlib(tmp_path: Path) -> None:
    """pvlib.iotools.read_cams labels each span by its start."""
    path = _cams(tmp_path / "a.csv")
    expected, meta = pvlib.iotools.read_cams(path)
    read = read_weather(path, NORTH)
    assert list(read.t_utc) == [
        t.to_pydatetime().replace(tzinfo=UTC) + HALF for t in expected.index
    ]
    for name in ("dni", "dhi", "ghi"):
        assert getattr(read, f"{name}_wm2").tolist() == expected[name].tolist()
    assert meta["latitude"] == 52.3
    plain = path.read_text()
    commas, quoted = plain.replace(";", ","), '"# Latitude (positive North, ISO 19115): 52.3000",,'
    sheet = commas.replace(quoted.strip('",'), quoted)
    for text in ("\n" + plain, commas, sheet):
        path.write_text(text)
        np.testing.assert_array_equal(read_weather(path, NORTH).dni_wm2, read.dni_wm2)
    with pytest.raises(InputError, match="time reference True solar time"):
        table(_cams(tmp_path / "b.csv", "True solar time (TST)"))
    with pytest.raises(InputError, match="rows that are 15 min apart"):
        read_weather(_cams(tmp_path / "c.csv", minutes=15), NORTH)


@pytest.mark.authority
@pytest.mark.parametrize("zone", [0, 2])
@pytest.mark.parametrize(
    "head",
    ["air_temp,dni,dhi,ghi,period_end,period", "PeriodEnd,PeriodStart,Period,Dni,Dhi,Ghi,AirTemp"],
)
def test_a_csv_of_solcast_has_the_middles_of_its_periods(
    tmp_path: Path, head: str, zone: int
) -> None:
    """Expected: the end less half of the period, by pandas."""
    starts, light = _summer()
    rows, is_new = [head], head.startswith("air")
    for t, (dni, dhi, ghi) in zip(starts, light, strict=True):
        a, b = (
            (t + timedelta(hours=zone + k)).strftime(f"%Y-%m-%dT%H:%M:%S+0{zone}:00")
            for k in (0, 1)
        )
        rows.append(
            f"12,{dni},{dhi},{ghi},{b},PT60M" if is_new else f"{b},{a},PT1H,{dni},{dhi},{ghi},12"
        )
    path = tmp_path / "a.csv"
    path.write_text("\r\n".join(rows) + "\r\n", encoding="utf-8-sig", newline="")
    read = read_weather(path, NORTH)
    stated = pd.read_csv(path, encoding="utf-8-sig")
    ends = pd.to_datetime(stated["period_end" if is_new else "PeriodEnd"], utc=True)
    middles = ends - pd.to_timedelta(list(stated["period" if is_new else "Period"])) / 2
    assert list(read.t_utc) == [t.to_pydatetime() for t in middles]
    assert read.dni_wm2.tolist() == stated["dni" if is_new else "Dni"].tolist()
    zoneless = path.read_text(encoding="utf-8-sig").replace(f"+0{zone}:00", "")
    path.write_text(zoneless)
    with pytest.raises(InputError, match=r"line 2: time '2023-06-01T.*' has no zone"):
        table(path)
    path.write_text(zoneless.replace("PT60M", "PT30M").replace("PT1H", "PT30M"))
    with pytest.raises(InputError, match="line 2: period 'PT30M'; expected hours"):
        table(path)


def _open_meteo(unix: bool, zone: int) -> tuple[dict[str, Any], list[str]]:
    """The same answer as json and as the lines of a csv."""
    starts, light = _summer()
    ends = [t + timedelta(hours=1) for t in starts]
    place = {"latitude": 52.3, "longitude": 4.8, "elevation": 10.0}
    local = [f"{t + timedelta(hours=zone):%Y-%m-%dT%H:%M}" for t in ends]
    times = [int(t.timestamp()) for t in ends] if unix else local
    names = ("shortwave_radiation", "direct_normal_irradiance", "diffuse_radiation")
    columns = dict(zip(names, light[:, [2, 0, 1]].T.tolist(), strict=True))
    answer = {
        **place,
        "generationtime_ms": 0.5,
        "utc_offset_seconds": 3600 * zone,
        "timezone": "GMT",
        "hourly_units": {"time": "iso8601", **dict.fromkeys(names, "W/m²")},
        "hourly": {"time": times, **columns},
    }
    lines = [
        "latitude,longitude,elevation,utc_offset_seconds,timezone,timezone_abbreviation",
        f"52.3,4.8,10.0,{3600 * zone},GMT,GMT",
        "",
        ",".join(["time", *(f"{name} (W/m²)" for name in names)]),
    ]
    rows = zip(times, *columns.values(), strict=True)
    return answer, [*lines, *(",".join(map(str, row)) for row in rows)]


@pytest.mark.authority
@pytest.mark.parametrize("unix", [False, True])
@pytest.mark.parametrize("zone", [0, 1])
def test_open_meteo_has_means_of_the_hour_before_its_label(
    tmp_path: Path, unix: bool, zone: int
) -> None:
    """Expected by construction, as its documentation says; csv and json are the same."""
    starts, light = _summer()
    answer, lines = _open_meteo(unix, zone)
    (tmp_path / "a.json").write_text(json.dumps(answer))
    (tmp_path / "a.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for name in ("a.json", "a.csv"):
        read = read_weather(tmp_path / name, NORTH)
        assert list(read.t_utc) == [t + HALF for t in starts]
        assert read.dni_wm2.tolist() == light[:, 0].tolist()
        assert read.dhi_wm2.tolist() == light[:, 1].tolist()
    for bad in (lines[:1] + lines[3:], [*lines[:2], lines[1], *lines[2:]]):
        (tmp_path / "b.csv").write_text("\n".join(bad) + "\n", encoding="utf-8")
        with pytest.raises(InputError, match="no line that begins with 'time' below one place"):
            table(tmp_path / "b.csv")


@pytest.mark.authority
@pytest.mark.parametrize(("mark", "comma"), [(",", False), (";", False), (";", True), ("\t", True)])
@pytest.mark.parametrize("seconds", [5, 60, 900])
def test_days_of_a_spreadsheet_are_the_times_of_pandas(
    tmp_path: Path, mark: str, comma: bool, seconds: int
) -> None:
    """Expected: pandas.to_datetime with unit D and origin 1899-12-30, to the second."""
    days = [46101.25 + k * seconds / 86400.0 for k in range(100)]
    cells = [f"{day:.10g}" for day in days]
    rows = [f"{c}{mark}{100.5 + k}" for k, c in enumerate(cells)]
    rows = [row.replace(".", ",") for row in rows] if comma else rows
    (tmp_path / "a.csv").write_text("\n".join([f"Date Time{mark}ghi_wm2", *rows]) + "\n")
    read = read_logger_file(tmp_path / "a.csv", timedelta(0))
    expected = pd.to_datetime(days, unit="D", origin="1899-12-30").round("s")
    assert [s.t_utc.replace(tzinfo=None) for s in read.samples] == expected.to_pydatetime().tolist()
    assert [s.ghi_wm2 for s in read.samples] == [100.5 + k for k in range(100)]
    rounded = [f"{day:.2f}{mark}5.5" for day in days]
    (tmp_path / "b.csv").write_text("\n".join([f"time{mark}ghi_wm2", *rounded]) + "\n")
    with pytest.raises(InputError, match=r"too few decimals|a date without"):
        read_logger_file(tmp_path / "b.csv", timedelta(0))
    (tmp_path / "c.csv").write_text(f"time{mark}ghi_wm2\n46101{mark}5\n46102{mark}6\n")
    with pytest.raises(InputError, match="'46101' is a date without a time of day"):
        read_logger_file(tmp_path / "c.csv", timedelta(0))


@pytest.mark.contract
@pytest.mark.parametrize("mark", [",", ";", "\t"])
@pytest.mark.parametrize("second", ["t_utc,ghi_wm2", "time_utc,dhi_wm2,ghi_wm2", "Time,a,b,c", ""])
def test_a_second_table_in_a_logger_file_is_named_once(
    tmp_path: Path, second: str, mark: str
) -> None:
    """Another header, or three rows with another number of values, refuse the file."""
    lines = logger_csv(tmp_path / "a.csv")
    count = second.count(",") + 1 if second else 4
    below = [",".join([f"2027-03-20T08:{k:02d}:00Z", *["5.5"] * (count - 1)]) for k in range(20)]
    lines += [second] * bool(second) + below
    (tmp_path / "a.csv").write_text("\n".join(lines).replace(",", mark) + "\n")
    said = (
        "line 62: other column names, for 20 rows; expected one table"
        if second
        else ("line 62: 4 values, expected 3, as in 20 rows from it")
    )
    with pytest.raises(InputError, match=re.escape(said)):
        read_logger_file(tmp_path / "a.csv")


# ----------------------------------------------------------------------------------------------
# property: one damage at a random place


def _readings(path: Path) -> list[Any]:
    return read_readings(path, ("x_px", "y_px", "azimuth_deg"), {"note_px": None})


def _clean(path: Path) -> list[list[Any]]:
    read = CleanIrradiance.read(path)
    return [values.tolist() for values in (read.t_unix_s, read.ghi_wm2, read.dni_wm2, read.flags)]


def _samples(path: Path) -> LoggerFile:
    return read_logger_file(path, timedelta(0))


def _hours(path: Path) -> list[tuple[Any, ...]]:
    text_lines = lines_of(path.read_text(encoding="utf-8"))
    return [
        tuple(map(repr, (r.when, r.dni, r.dhi, r.ghi)))
        for r in read_table(path, text_lines, NORTH).rows
    ]


def _model_hours(path: Path) -> list[list[float]]:
    hours = read_model_hours(path, [180.0])
    return [hours.index.tolist(), *hours.to_numpy().tolist()]


def _files() -> dict[str, tuple[str, int, Any]]:
    """A text with decimals in all rows, the number of header lines, and its reader."""
    days = [datetime(2023, 6, 1, tzinfo=UTC) + timedelta(hours=k) for k in range(12)]
    epw = ["LOCATION,Town,-,X,made up,0,52.3,4.8,1,10.0", *(f"HEADER {k}" for k in range(7))]
    epw += [
        f"2023,6,1,{t.hour + 1},60,?9,10.5,5.5,70,101000,0,0,300,{9.5 + k},{3.5 + k},{6.5 + k},0.2"
        for k, t in enumerate(days)
    ]
    tmy = [
        "0,Town,X,1,52.3,4.8,10",
        "Date (MM/DD/YYYY),Time (HH:MM),GHI (W/m^2),DNI (W/m^2),DHI (W/m^2)",
    ]
    tmy += [f"{t:%m/%d/%Y},{t.hour + 1:02d}:00,{k}.5,{k}.4,{k}.3" for k, t in enumerate(days)]
    sam_ = ["Source,City,Latitude,Longitude,Time Zone,Elevation", "x,Town,52.3,4.8,1,10"]
    sam_ += ["Year,Month,Day,Hour,GHI,DNI,DHI"]
    sam_ += [f"2023,6,1,{t.hour},{k}.5,{k}.4,{k}.3" for k, t in enumerate(days)]
    own = ["t_utc,dni_wm2,dhi_wm2"]
    own += [f"{t:%Y-%m-%dT%H:%M:%SZ},{k}.5,{k}.4" for k, t in enumerate(days)]
    pairs = ["t_utc,panorama,dni_wm2,dhi_wm2"]
    pairs += [f"{t:%Y-%m-%dT%H:%M:%SZ},a{k}.exr,{k}.5,{k}.4" for k, t in enumerate(days)]
    logger = [
        "t_utc,ghi_wm2,dhi_wm2",
        *(f"{t:%Y-%m-%dT%H:%M:%SZ},{t.hour}.5,{t.hour}.4" for t in days),
    ]
    table5 = ['"TOA5","a","b","c","d","e","f","T"', '"TIMESTAMP","RECORD","GHI","Dif"']
    table5 += ['"TS","RN","W/m^2","W/m^2"', '"","","Avg","Avg"']
    table5 += [f'"{t:%Y-%m-%d %H:%M:%S}",{k},{k}.5,{k}.4' for k, t in enumerate(days)]
    clean = ["t_utc,ghi_wm2,dhi_wm2,dni_wm2,source,flags"]
    clean += [f"{t:%Y-%m-%dT%H:%M:%S.000Z},{k}.5,{k}.4,{k}.3,measured," for k, t in enumerate(days)]
    pvgis = ["Latitude (decimal degrees): 52.3", "Longitude (decimal degrees): 4.8"]
    pvgis += ["Elevation (m): 10.0", "time(UTC),T2m,G(h),Gb(n),Gd(h)"]
    pvgis += [f"{t:%Y%m%d:%H%M},5.5,{k}.5,{k}.4,{k}.3" for k, t in enumerate(days)]
    exposures = ["file,shutter_s,f_number,iso"]
    exposures += [f"f{k:02d}.jpg,{k}.5,5.6,100.5" for k in range(12)]
    table = ["hoy,dgp@180,ev@180,note", *(f"{k}.5,0.{k:02d},{k}.25,1.5" for k in range(12))]
    readings = ["x_px,y_px,azimuth_deg,note_px", *(f"{k}.5,{k}.4,{k}.3,{k}.2" for k in range(12))]
    return {
        "epw": ("\n".join(epw) + "\n", 8, _hours),
        "tmy3": ("\n".join(tmy) + "\n", 2, _hours),
        "sam": ("\n".join(sam_) + "\n", 3, _hours),
        "weather csv": ("\n".join(own) + "\n", 1, _hours),
        "pairs": ("\n".join(pairs) + "\n", 1, lambda path: PairsFile.read(path).rows),
        "logger": ("\n".join(logger) + "\n", 1, _samples),
        "toa5": ("\n".join(table5) + "\n", 4, _samples),
        "pvgis": ("\n".join(pvgis) + "\n", 4, _hours),
        "exposures": ("\n".join(exposures) + "\n", 1, read_exposures),
        "compare": ("\n".join(table) + "\n", 1, _model_hours),
        "readings": ("\n".join(readings) + "\n", 1, _readings),
        "clean": ("\n".join(clean) + "\n", 1, _clean),
    }


FILES = _files()


def _damaged(line: str, kind: str, place: int, mark: str) -> str:
    """A line with one cell more or less, one quotation mark, or one decimal comma."""
    cells = line.split(mark)
    k = place % len(cells)
    if kind == "more":
        cells.insert(k, "")
    elif kind == "less":
        del cells[k]
    elif kind == "quote":
        cells[k] = '"' + cells[k]
    else:
        decimals = [k for k, cell in enumerate(cells) if re.fullmatch(r"[\d]+\.\d+", cell)]
        k = decimals[place % len(decimals)]
        cells[k] = cells[k].replace(".", ",")
    return mark.join(cells)


@pytest.mark.property
@pytest.mark.slow
@settings(
    deadline=None, max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.sampled_from(sorted(FILES)),
    st.sampled_from(["more", "less", "quote", "comma"]),
    st.sampled_from([",", ";", "\t"]),
    st.integers(0, 11),
    st.integers(0, 40),
)
def test_one_damage_at_any_place_is_refused_with_its_line_or_costs_its_row(
    tmp_path: Path, name: str, kind: str, mark: str, row: int, place: int
) -> None:
    """Property: loggers lose the damaged row and name it; all other readers refuse the line.

    A reader of commas alone refuses another separator by its name, or the line of the header.
    """
    text, header, read = FILES[name]
    path = tmp_path / ("a.epw" if name == "epw" else "a.csv")
    path.write_text(text)
    of_commas = read(path)
    text = text.replace(",", mark)
    path.write_text(text)
    try:
        whole = read(path)
    except InputError as error:
        assert mark != "," and (name == "clean" or "columns separated by" in str(error)), str(error)
        return
    if name == "toa5" and mark != ",":  # a table of another program, with a row of "Avg"
        whole = replace(whole, left_out=whole.left_out[1:])
    assert isinstance(whole, LoggerFile) or whole == of_commas
    lines = text.splitlines()
    lines[header + row] = _damaged(lines[header + row], kind, place, mark)
    path.write_text("\n".join(lines) + "\n")
    named = f"line {header + row + 1}: "
    try:
        found = read(path)
    except InputError as error:
        assert named in str(error), str(error)
        return
    if isinstance(found, LoggerFile) and name == "toa5" and mark != ",":
        found = replace(found, left_out=found.left_out[1:])
    if isinstance(found, LoggerFile) and found.left_out:
        assert found.left_out[0].startswith(named)
        assert found.samples == (*whole.samples[:row], *whole.samples[row + 1 :])
    else:
        # A quotation mark before an already quoted cell, or inside an unused one, changes nothing.
        assert found == whole


@pytest.mark.property
@pytest.mark.slow
@settings(
    deadline=None, max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.sampled_from(sorted(FILES)),
    st.sampled_from(["utf-8-sig", "utf-16", "utf-16-le", "latin-1", "cp1252", "utf-32"]),
    st.sampled_from(["\n", "\r\n", "\r"]),
    st.sampled_from(["", "# station Zürich, Plätze\n"]),
)
def test_every_encoding_is_read_exactly_or_refused_by_its_name(
    tmp_path: Path, name: str, encoding: str, end: str, comment: str
) -> None:
    """Property: a byte order mark, UTF-16 or a Western encoding changes no value."""
    text, header, read = FILES[name]
    if name in ("toa5",) and end == "\r":
        end = "\n"
    path = tmp_path / ("a.epw" if name == "epw" else "a.csv")
    path.write_text(text)
    values = read_weather_rows(path) if read is _hours else read(path)
    if header == 1 and read is not _samples:
        text = comment + text
    path.write_bytes(text.replace("\n", end).encode(encoding))
    try:
        found = read_weather_rows(path) if read is _hours else read(path)
    except InputError as error:
        assert "UTF-16 without its byte order mark" in str(error), str(error)
        assert encoding in ("utf-16-le", "utf-32")
        return
    lines = {"line": 0}
    if name == "pairs":
        found, values = ([{**_asdict(row), **lines} for row in rows] for rows in (found, values))
    assert found == values


def _asdict(row: Any) -> dict[str, Any]:
    return {key: repr(getattr(row, key)) for key in row.__slots__}


def read_weather_rows(path: Path) -> list[tuple[Any, ...]]:
    """The rows of a weather file, by the reader of texts that `read_weather` uses."""
    from fieldlum.core.strict_csv import read_text

    rows = read_table(path, lines_of(read_text(path, "a file")), NORTH).rows
    return [tuple(map(repr, (r.when, r.dni, r.dhi, r.ghi))) for r in rows]


# ----------------------------------------------------------------------------------------------
# the clock and the columns of tables, as loggers in several countries write them

FORMS = [  # of 20 March 2027 06:00 and 17:00
    ("{d}.{m}.{y} {h:02d}:{i:02d}", "Germany"),
    ("{y}/{m1}/{d} {h}:{i:02d}", "Japan"),
    ("{d}/{m}/{y} {h:02d}:{i:02d}", "France"),
    ("{m1}/{d}/{y} {half}", "United States"),
    ("{y}-{m}-{d} {half}", "Onset HOBOware"),
    ("{y}-{m}-{d} {h:02d}:{i:02d}:00 GMT", "a spreadsheet"),
    ("{y}{m}{d}T{h:02d}{i:02d}00Z", "ISO 8601, basic"),
]


@pytest.mark.authority
@pytest.mark.parametrize(("form", "country"), FORMS)
def test_times_of_several_countries(tmp_path: Path, form: str, country: str) -> None:
    """Expected: the same moments by strftime of Python."""
    starts = [datetime(2027, 3, 20, h, 30, tzinfo=UTC) for h in range(24)]
    texts = [
        form.format(
            y=t.year,
            m=f"{t:%m}",
            m1=t.month,
            d=t.day,
            h=t.hour,
            i=t.minute,
            half=f"{t:%I:%M:%S %p}",
        )
        for t in starts
    ]
    rows = [f"{text},{k + 40.5}" for k, text in enumerate(texts)]
    path = tmp_path / "a.csv"
    path.write_text("\n".join(["time,GHI (W/㎡)", *rows]) + "\n", encoding="utf-8")
    read = read_logger_file(path, timedelta(0))
    assert [s.t_utc for s in read.samples] == starts and not read.left_out, country
    assert [s.ghi_wm2 for s in read.samples] == [k + 40.5 for k in range(24)]


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "t"),
    [
        ("2027-03-20 24:00", datetime(2027, 3, 21, tzinfo=UTC)),
        ("2027-03-20 24:00:00", datetime(2027, 3, 21, tzinfo=UTC)),
        ("2027-12-31T24:00", datetime(2028, 1, 1, tzinfo=UTC)),
        ("2027-03-20 12:00 AM", datetime(2027, 3, 20, tzinfo=UTC)),
        ("2027-03-20 12:15:00 p.m.", datetime(2027, 3, 20, 12, 15, tzinfo=UTC)),
        ("2027/3/2 1:00p", datetime(2027, 3, 2, 13, tzinfo=UTC)),
        ("202703201600", datetime(2027, 3, 20, 16, tzinfo=UTC)),
        ("1805558400", datetime(2027, 3, 20, 16, tzinfo=UTC)),
        ("1805558400500", datetime(2027, 3, 20, 16, 0, 0, 500000, tzinfo=UTC)),
    ],
)
def test_ends_and_halves_of_days(text: str, t: datetime) -> None:
    assert read_time(text, utc=True) == t


@pytest.mark.contract
@pytest.mark.parametrize(
    "text", ["2027-03-20 13:00 PM", "2027-03-20 0:30 AM", "2027-03-20 24:30", "20.03.2027"]
)
def test_times_that_no_clock_shows(text: str) -> None:
    with pytest.raises(ValueError, match="expected one like"):
        read_time(text)


def _clock_file(path: Path, times: list[datetime], form: str) -> Path:
    rows = [f"{t.strftime(form)},{k + 50}" for k, t in enumerate(times)]
    path.write_text("\n".join(["time,ghi_wm2", *rows]) + "\n", encoding="utf-8")
    return path


@pytest.mark.contract
@pytest.mark.parametrize("minutes", [1, 10, 30])
@pytest.mark.parametrize("zone", ["Europe/Berlin", "America/New_York", "Australia/Sydney"])
def test_a_clock_that_leaves_summer_time_is_refused(
    tmp_path: Path, zone: str, minutes: int
) -> None:
    """Expected: the civil times of tzdata; standard time of the same days is read."""
    first = (
        datetime(2027, 4, 3, tzinfo=UTC) if "Aus" in zone else datetime(2027, 10, 30, tzinfo=UTC)
    )
    first = datetime(2027, 11, 6, tzinfo=UTC) if "York" in zone else first
    times = [first + k * timedelta(minutes=minutes) for k in range(2880 // minutes)]
    civil = [t.astimezone(ZoneInfo(zone)).replace(tzinfo=None) for t in times]
    path = _clock_file(tmp_path / "a.csv", civil, "%Y-%m-%d %H:%M")
    with pytest.raises(InputError, match=r"clock goes back.*end of summer time.*standard time"):
        read_logger_file(path, timedelta(hours=1))
    standard = _clock_file(tmp_path / "b.csv", times, "%Y-%m-%d %H:%M")
    assert len(read_logger_file(standard, timedelta(hours=1)).samples) == len(times)


@pytest.mark.contract
@pytest.mark.parametrize("minutes", [1, 10, 60])
@pytest.mark.parametrize(
    ("zone", "day", "hours"),
    [
        ("Europe/Berlin", (3, 28), 1),
        ("Europe/London", (3, 28), 0),
        ("America/New_York", (3, 14), -5),
        ("Australia/Sydney", (10, 3), 10),
    ],
)
def test_a_clock_that_enters_summer_time_is_refused(
    tmp_path: Path, zone: str, day: tuple[int, int], hours: int, minutes: int
) -> None:
    """Expected: the civil times of tzdata; a gap of a standard clock at another hour is read."""
    slot = Slot(datetime(2027, 3, 20, 16, 30, tzinfo=UTC), 30.0, 180.0, (Exposure(0.01, 5.6),))
    site = SiteFile(Site("x", 50.0 if hours < 9 else -34.0, 15.0 * hours, zone))
    session = create_session(tmp_path / "s", site, [slot], {})
    first = datetime(2027, *day, tzinfo=ZoneInfo(zone)).astimezone(UTC) - timedelta(hours=12)
    times = [first + k * timedelta(minutes=minutes) for k in range(1440 // minutes)]
    civil = [t.astimezone(ZoneInfo(zone)).replace(tzinfo=None) for t in times]
    path = _clock_file(tmp_path / "a.csv", civil, "%Y-%m-%d %H:%M")
    leap = "to 02:00" if hours == 0 else "to 03:00"
    with pytest.raises(InputError, match=f"{leap}, as at the beginning of summer time in {zone}"):
        import_rows(session, path, 3600.0 * hours)
    standard = [(t + timedelta(hours=hours)).replace(tzinfo=None) for t in times]
    some = standard[: 600 // minutes] + standard[660 // minutes :]
    _clock_file(path, some, "%Y-%m-%d %H:%M")
    assert import_rows(session, path, 3600.0 * hours).rows == len(some)


@pytest.mark.contract
@pytest.mark.parametrize("hours", [(6, 18), (0, 24)])
def test_twelve_hours_without_am_and_pm_are_refused(tmp_path: Path, hours: tuple[int, int]) -> None:
    start = datetime(2027, 3, 20, tzinfo=UTC)
    times = [start + timedelta(minutes=10 * k) for k in range(6 * hours[0], 6 * hours[1])]
    path = _clock_file(tmp_path / "a.csv", times, "%Y-%m-%d %I:%M")
    with pytest.raises(InputError, match=r"no hour is above 12.*AM and PM"):
        read_logger_file(path, timedelta(0))


@pytest.mark.contract
def test_parts_of_a_file_may_be_in_any_order(tmp_path: Path) -> None:
    start = datetime(2027, 3, 20, tzinfo=UTC)
    times = [start + timedelta(minutes=10 * k) for k in range(36, 72)]
    for name, order in (("newest", times[::-1]), ("parts", times[18:] + times[:18])):
        path = _clock_file(tmp_path / f"{name}.csv", order, "%Y-%m-%d %H:%M")
        assert [s.t_utc for s in read_logger_file(path, timedelta(0)).samples] == times


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize("site", [NORTH, WEST])
def test_direct_irradiance_of_a_horizontal_plane_is_refused(tmp_path: Path, site: Site) -> None:
    """A file without global irradiance, which would contradict it."""
    starts = hours_of(site)
    light = light_of(site, starts)
    light[::2] = light[::2, 2:] * [0.0, 0.35, 0.35]  # every second hour is overcast
    moments = [t - timedelta(hours=ZONE[site.timezone]) + HALF for t in starts]
    altitude = np.radians(sun.position(moments, site).altitude_deg)
    light[:, 0] = np.round(light[:, 0] / 0.7 * np.sin(np.maximum(altitude, 0.0)), 1)  # pvlib's beam
    with pytest.raises(InputError, match="DNI has direct irradiance on a horizontal plane"):
        read_weather(write_epw(tmp_path / "a.epw", site, light), site)


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.parametrize("latitude_deg", [0.0, 28.6, 45.0, 60.0])
def test_a_hazy_sky_is_no_horizontal_plane(latitude_deg: float) -> None:
    """Expected: pvlib's clear skies from a Linke turbidity of 2 to 8 (a humid or dusty city)."""
    start = datetime(2027, 1, 1, tzinfo=UTC)
    times = [start + timedelta(hours=k) for k in range(8760)]
    altitude = sun.position(times, Site("place", latitude_deg, 0.0, "UTC")).altitude_deg
    zenith = 90.0 - np.maximum(altitude, 0.0)
    air_mass = np.asarray(pvlib.atmosphere.get_relative_airmass(zenith))
    for turbidity in (2, 3, 5, 6, 7, 8):
        clear = pvlib.clearsky.ineichen(zenith, air_mass, turbidity)
        dni = np.where(altitude > 0.0, np.asarray(clear["dni"]), 0.0)
        assert horizontal_beam(dni, altitude) is None
        assert horizontal_beam(np.where(altitude < 13.0, 0.0, dni), altitude) is None  # a valley
        on_plane = dni * np.sin(np.radians(np.maximum(altitude, 0.0)))
        assert turbidity > 5 or horizontal_beam(on_plane, altitude) is not None


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize("hours", [slice(4000, 4300), slice(0, 8760, 9), slice(0, 8760)])
def test_missing_hours_that_are_zeros_are_named(tmp_path: Path, hours: slice) -> None:
    light = light_of(NORTH, hours_of(NORTH))
    light[hours] = 0.0
    with pytest.raises(InputError, match="hours have no light while the sun is up"):
        read_weather(write_epw(tmp_path / "a.epw", NORTH, light), NORTH)


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize(("first", "days", "count"), [(3250, 3, 45), (8472, 1, 7)])
def test_a_few_days_without_satellite_images_are_missing(
    tmp_path: Path, first: int, days: int, count: int
) -> None:
    """PVGIS writes them as zeros: in its year at 45 N, 8 E 45 hours, which pvlib returns as 0."""
    light = light_of(NORTH, hours_of(NORTH))
    light[first : first + 24 * days] = 0.0  # from 16 May, and 20 December
    weather = read_weather(write_epw(tmp_path / "a.epw", NORTH, light), NORTH)
    assert f"{count} hours without any light by day count as missing" in weather.repairs[0]
    assert len(weather) == 8760 - count and f"{count} missing hours left" in weather.repairs[1]


@pytest.mark.contract
@pytest.mark.parametrize(
    "heading", ["_" * 200_000 + "x", "a" + " " * 200_000 + "(b", "(" * 200_000]
)
def test_a_heading_of_any_length_is_read_at_once(heading: str) -> None:
    assert split_heading(heading)[1] == "" and stated_unit(heading) in ("", "b")
