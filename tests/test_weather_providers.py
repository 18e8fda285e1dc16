"""Weather files of providers, in the forms that their documentation states, from one known year."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pvlib
import pytest
from places import SEATTLE

from fieldlum import weather
from fieldlum.core.errors import InputError
from fieldlum.core.records import Site
from fieldlum.sky import sun

EAST = Site("Turin", 45.0, 8.0, "Europe/Rome")
OFFSET_H = 0.1761  # of PVGIS at 45 N 8 E


def _year(site: Site) -> weather.Weather:
    return weather.synthetic_weather(site, seed=3)


def _moments(site: Site) -> weather.Weather:
    """The same climate at hh:10:34 UTC, the moments of PVGIS, as instants."""
    year = _year(site)
    start = datetime(2015, 1, 1, tzinfo=UTC)
    hours = [start + timedelta(hours=k) for k in range(8760)]
    moments = [t + timedelta(hours=OFFSET_H) for t in hours]
    clear = sun.clearsky(moments, site)
    return replace(
        year,
        t_utc=tuple(hours),
        dni_wm2=0.7 * clear.dni_wm2,
        dhi_wm2=1.3 * clear.dhi_wm2,
        ghi_wm2=np.nan * clear.ghi_wm2,
    )


def _pvgis_csv(path: Path, year: weather.Weather) -> Path:
    lines = [
        f"Latitude (decimal degrees): {EAST.latitude_deg}",
        f"Longitude (decimal degrees): {EAST.longitude_deg}",
        "Elevation (m): 250.0",
        f"Irradiance Time Offset (h): {OFFSET_H}",
        "month,year",
        *(f"{month},2015" for month in range(1, 13)),
        "time(UTC),T2m,RH,G(h),Gb(n),Gd(h),IR(h),WS10m,WD10m,SP",
    ]
    for t, dni, dhi in zip(year.t_utc, year.dni_wm2, year.dhi_wm2, strict=True):
        lines.append(f"{t:%Y%m%d:%H%M},10,50,nan,{dni:.2f},{dhi:.2f},300,1,90,98000")
    path.write_text("\r\n".join(lines) + "\r\n", encoding="ascii", newline="")
    return path


def _pvgis_json(path: Path, year: weather.Weather) -> Path:
    rows = [
        {"time(UTC)": f"{t:%Y%m%d:%H%M}", "G(h)": None, "Gb(n)": float(a), "Gd(h)": float(b)}
        for t, a, b in zip(year.t_utc, year.dni_wm2, year.dhi_wm2, strict=True)
    ]
    location = {
        "latitude": EAST.latitude_deg,
        "longitude": EAST.longitude_deg,
        "elevation": 250.0,
        "irradiance_time_offset": OFFSET_H,
    }
    answer = {
        "inputs": {"location": location},
        "outputs": {"months_selected": [], "tmy_hourly": rows},
        "meta": {"inputs": {}},
    }
    path.write_text(json.dumps(answer), encoding="ascii")
    return path


def _pvgis_epw(path: Path, year: weather.Weather, zone: int) -> Path:
    """Hours 1 to 24 of UTC days, whatever the header's zone, as PVGIS 5.2 writes them."""
    head = [f"LOCATION,unknown,-,unknown,ECMWF/ERA,unknown,45.0,8.0,{zone},250.0"]
    head += [f"HEADER {k}" for k in range(5)]
    head += [f"COMMENTS 2,Irradiance Time Offset (h): {OFFSET_H - 1}", "DATA PERIODS,1,1"]
    for t, dni, dhi in zip(year.t_utc, year.dni_wm2, year.dhi_wm2, strict=True):
        cells = [str(t.year), str(t.month), str(t.day), str(t.hour + 1), "60"]
        head.append(",".join([*cells, *(["0"] * 8), "9999", f"{dni:.2f}", f"{dhi:.2f}"]))
    path.write_text("\n".join(head), encoding="ascii")
    return path


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize("kind", ["csv", "json", "epw with a zone"])
def test_every_form_of_pvgis_gives_the_same_hours(tmp_path: Path, kind: str) -> None:
    """Contract: the time offset that the file states is applied, and named."""
    year = _moments(EAST)
    if kind == "csv":
        path = _pvgis_csv(tmp_path / "a.csv", year)
    elif kind == "json":
        path = _pvgis_json(tmp_path / "a.json", year)
    else:
        path = _pvgis_epw(tmp_path / "a.epw", year, 1 if "zone" in kind else 0)
    found = weather.read_weather(str(path), EAST)
    assert any("time offset" in text for text in found.repairs)
    assert len(found) == 8760
    noon = found.at([datetime(2027, 6, 21, 11, 10, 34, tzinfo=found.t_utc[0].tzinfo)])
    at = next(k for k, t in enumerate(year.t_utc) if (t.month, t.day, t.hour) == (6, 21, 11))
    assert noon.dni_wm2[0] == pytest.approx(year.dni_wm2[at], abs=0.01)
    minutes = {round((t.minute * 60 + t.second) / 60.0, 1) for t in found.t_utc}
    assert minutes == {10.6}


@pytest.mark.slow
@pytest.mark.contract
def test_nsrdb_and_solaranywhere_give_the_same_hours(tmp_path: Path) -> None:
    year = _year(SEATTLE)
    local = [t - timedelta(hours=8) for t in year.t_utc]
    rows = list(zip(local, year.dni_wm2, year.dhi_wm2, year.ghi_wm2, strict=True))
    nsrdb = [
        "Source,Location ID,City,State,Country,Latitude,Longitude,Time Zone,Elevation,"
        "Local Time Zone",
        f"NSRDB,1,-,-,-,{SEATTLE.latitude_deg},{SEATTLE.longitude_deg},-8,50,-8",
        "Year,Month,Day,Hour,Minute,DNI,DHI,GHI",
        *(f"{t.year},{t.month},{t.day},{t.hour},30,{a:.2f},{b:.2f},{c:.2f}" for t, a, b, c in rows),
    ]
    (tmp_path / "n.csv").write_text("\n".join(nsrdb) + "\n", encoding="ascii")
    anywhere = [
        f"0,Seattle,WA,-8,{SEATTLE.latitude_deg},{SEATTLE.longitude_deg},50,"
        "Data Version: 3.4 / Type: Time Series / LatLon Resolution: 0.1",
        "ObservationTime(LST),Global Horizontal Irradiance (GHI) W/m2,"
        "Direct Normal Irradiance (DNI) W/m2,Diffuse Horizontal Irradiance (DIF) W/m2",
    ]
    for t, dni, dhi, ghi in rows:
        end = t + timedelta(minutes=30)
        anywhere.append(f"{end:%m/%d/%Y %H:%M},{ghi:.2f},{dni:.2f},{dhi:.2f}")
    (tmp_path / "s.csv").write_text("\n".join(anywhere) + "\n", encoding="ascii")
    for name in ("n.csv", "s.csv"):
        found = weather.read_weather(tmp_path / name, SEATTLE)
        assert found.t_utc[:2] == year.t_utc[:2], name
        np.testing.assert_allclose(found.dni_wm2, year.dni_wm2, atol=0.01, err_msg=name)


@pytest.mark.slow
@pytest.mark.authority
def test_the_tmy2_file_of_pvlib_is_read() -> None:
    """Miami's TMY2 file, which pvlib ships: 8760 hours, centred on hh:30."""
    path = Path(pvlib.__file__).parent / "data" / "12839.tm2"
    found = weather.read_weather(path, Site("Miami", 25.8, -80.27, "America/New_York"))
    assert len(found) == 8760 and not found.repairs
    assert {t.minute for t in found.t_utc} == {30}


@pytest.mark.slow
@pytest.mark.contract
def test_a_label_shift_mends_labels_that_are_known_to_be_wrong(tmp_path: Path) -> None:
    year = _year(SEATTLE)
    rows = ["t_utc,dni_wm2,dhi_wm2"]
    for t, dni, dhi in zip(year.t_utc, year.dni_wm2, year.dhi_wm2, strict=True):
        rows.append(f"{t + timedelta(minutes=60):%Y-%m-%dT%H:%M:%SZ},{dni:.2f},{dhi:.2f}")
    path = tmp_path / "late.csv"
    path.write_text("\n".join(rows), encoding="ascii")
    with pytest.raises(InputError, match="with all row times moved by -"):
        weather.read_weather(path, SEATTLE)
    found = weather.read_weather(path, SEATTLE, label_shift_min=-60)
    assert found.t_utc == year.t_utc
    assert "times of all rows moved by -60 min" in found.repairs


@pytest.mark.slow
@pytest.mark.contract
def test_the_word_synthetic_gives_a_marked_year() -> None:
    found = weather.read_weather(Path("synthetic"), SEATTLE)
    assert found.synthetic and len(found) == 8760


@pytest.mark.contract
@pytest.mark.parametrize(
    "text",
    [
        "Latitude (decimal degrees): x\n",
        '{"outputs": {}}',
        "Source,Location ID,City\nNSRDB,1,-\nYear\n",
    ],
)
def test_a_damaged_provider_file_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.csv").write_text(text, encoding="ascii")
    with pytest.raises(InputError) as refused:
        weather.read_weather(tmp_path / "a.csv", SEATTLE)
    assert "\n" not in str(refused.value)


@pytest.mark.contract
@pytest.mark.parametrize(
    "header", ["Source,Location ID", "Latitude (decimal degrees): 1", "LOCATION,x"]
)
def test_a_comment_above_a_providers_header_is_named(tmp_path: Path, header: str) -> None:
    (tmp_path / "a.csv").write_text(f"# from the archive\n{header}\n", encoding="ascii")
    with pytest.raises(InputError, match="a comment above the header"):
        weather.read_weather(tmp_path / "a.csv", SEATTLE)
