"""Weather files: the three formats agree, bad input is named, repairs are said."""

from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from places import SEATTLE

from fieldlum import weather
from fieldlum.cli import main
from fieldlum.core.errors import FieldlumError, InputError, NotEnoughDataError
from fieldlum.core.records import Site
from fieldlum.sky import sun
from fieldlum.weather import formats

PLACELESS = ("the file states no place: it is taken as weather of the site",)


@pytest.mark.slow
@pytest.mark.authority
def test_seattle_ships_with_4379_daylight_hours() -> None:
    """The paper counts 4 379 hours with light and the sun up, by its own sun; ours may move a
    few at the horizon.
    """
    year = weather.shipped_seattle()
    assert len(year) == 8760 and not year.repairs
    assert abs(len(year.daylight()) - 4379) < 15
    assert year.t_utc[0] == datetime(2027, 1, 1, 8, 30, tzinfo=UTC)


@cache
def _year(site: Site = SEATTLE) -> weather.Weather:
    return weather.synthetic_weather(site, seed=3)


def _write_csv(path: Path, year: weather.Weather, *, dated: bool) -> None:
    rows = ["t_utc,dni_wm2,dhi_wm2" if dated else "month,day,hour,dni_wm2,dhi_wm2"]
    for t, dni, dhi in zip(year.t_utc, year.dni_wm2, year.dhi_wm2, strict=True):
        local = sun.standard_time(t, year.site.timezone)
        stamp = (
            f"{t:%Y-%m-%dT%H:%M:%SZ}"
            if dated
            else f"{local.month},{local.day},{local.hour + local.minute / 60}"
        )
        rows.append(f"{stamp},{dni:.2f},{dhi:.2f}")
    path.write_text("\n".join(rows))


def _write_epw(
    path: Path, year: weather.Weather, zone: float = -8, longitude: float | None = None
) -> None:
    place = year.site
    where = longitude if longitude is not None else place.longitude_deg
    head = [f"LOCATION,Test,WA,USA,none,0,{place.latitude_deg},{where},{zone},5"]
    head += [f"HEADER {k}" for k in range(7)]
    rows = []
    for t, dni, dhi, ghi in zip(year.t_utc, year.dni_wm2, year.dhi_wm2, year.ghi_wm2, strict=True):
        local = t + timedelta(hours=zone)
        cells = [
            str(local.year),
            str(local.month),
            str(local.day),
            str(local.hour + 1),
            "60",
            "?",
            *["0"] * 7,
        ]
        rows.append(",".join([*cells, f"{ghi:.2f}", f"{dni:.2f}", f"{dhi:.2f}", "0"]))
    path.write_text("\n".join(head + rows))


def _write_tmy3(path: Path, year: weather.Weather, zone: float = -8) -> None:
    place = year.site
    head = [f'727930,"TEST",WA,{zone},{place.latitude_deg},{place.longitude_deg},5']
    head.append("Date (MM/DD/YYYY),Time (HH:MM),ETR (W/m^2),GHI (W/m^2),DNI (W/m^2),DHI (W/m^2)")
    rows = []
    for t, dni, dhi, ghi in zip(year.t_utc, year.dni_wm2, year.dhi_wm2, year.ghi_wm2, strict=True):
        local = t + timedelta(hours=zone)
        rows.append(f"{local:%m/%d/%Y},{local.hour + 1:02d}:00,0,{ghi:.2f},{dni:.2f},{dhi:.2f}")
    path.write_text("\n".join(head + rows))


@pytest.mark.analytic
def test_hours_1_to_24_of_month_and_day_keep_the_last_hour_of_february(tmp_path: Path) -> None:
    year = _year()
    rows = ["month,day,hour,dni_wm2,dhi_wm2"]
    for t, dhi in zip(year.t_utc, year.dhi_wm2, strict=True):
        local = sun.standard_time(t, year.site.timezone)  # a full hour and a half
        rows.append(f"{local.month},{local.day},{local.hour + 1},0,{dhi:.2f}")
    (tmp_path / "y.csv").write_text("\n".join(rows))
    read = weather.read_weather(tmp_path / "y.csv", year.site)
    assert len(read) == 8760 and not any("missing" in text for text in read.repairs)
    assert datetime(2027, 3, 1, 8, 0, tzinfo=UTC) in read.t_utc  # hour 24 of 28 February


@pytest.mark.slow
@pytest.mark.contract
def test_the_formats_agree(tmp_path) -> None:
    """EPW labels are starts in hour 1..24, TMY3 labels are ends, CSV stands at
    centres: the same year.
    """
    year = _year()
    _write_csv(tmp_path / "a.csv", year, dated=True)
    _write_csv(tmp_path / "b.csv", year, dated=False)
    _write_epw(tmp_path / "c.epw", year)
    _write_tmy3(tmp_path / "d.csv", year)
    for name in ("a.csv", "b.csv", "c.epw", "d.csv"):
        found = weather.read_weather(tmp_path / name, SEATTLE)
        assert found.t_utc == year.t_utc, name
        assert found.dni_wm2 == pytest.approx(year.dni_wm2, abs=0.006)
        assert found.dhi_wm2 == pytest.approx(year.dhi_wm2, abs=0.006)
        assert found.repairs == (PLACELESS if name in ("a.csv", "b.csv") else ()), name


@pytest.mark.slow
@pytest.mark.analytic
def test_clear_sky_noon_stands_at_the_hour_centre(tmp_path) -> None:
    """In a cloudless EPW the beam-weighted mean time of a day is solar noon within
    three minutes.
    """
    times = _year().t_utc
    clear = sun.clearsky(times, SEATTLE)
    year = weather.Weather(
        "clear",
        SEATTLE,
        t_utc=times,
        dni_wm2=clear.dni_wm2,
        dhi_wm2=clear.dhi_wm2,
        ghi_wm2=clear.ghi_wm2,
    )
    _write_epw(tmp_path / "clear.epw", year)
    found = weather.read_weather(tmp_path / "clear.epw", SEATTLE)
    day = slice(24 * 171, 24 * 172)
    seconds = np.array([t.timestamp() for t in found.t_utc[day]])
    middle = datetime.fromtimestamp(float(np.average(seconds, weights=found.ghi_wm2[day])), UTC)
    date_ = sun.standard_date(found.t_utc[24 * 171 + 12], SEATTLE.timezone)
    noon = sun.rise_transit_set(date_, SEATTLE).transit
    assert noon is not None and abs((middle - noon).total_seconds()) < 180


@pytest.mark.slow
@pytest.mark.contract
def test_typical_year_answers_for_any_year() -> None:
    year = _year()
    noon = [datetime(y, 3, 21, 20, 10, tzinfo=UTC) for y in (2019, 2024, 2027)]
    assert len(set(year.at(noon).dhi_wm2)) == 1
    leap = [datetime(2028, 2, 29, 20, 30, tzinfo=UTC), datetime(2028, 2, 28, 20, 30, tzinfo=UTC)]
    assert np.ptp(year.at(leap).dhi_wm2) == 0
    ends = [datetime(2027, 1, 1, 8, 0, tzinfo=UTC), datetime(2027, 12, 31, 23, 59, tzinfo=UTC)]
    assert np.isfinite(year.at(ends).ghi_wm2).all()


@pytest.mark.slow
@pytest.mark.analytic
def test_steady_within_the_hour() -> None:
    year = _year()
    k = 24 * 100 + 12
    times = [year.t_utc[k] + timedelta(minutes=m) for m in (-29, 0, 29)]
    assert np.ptp(year.at(times).dhi_wm2) == 0


@pytest.mark.slow
@pytest.mark.contract
def test_repairs_are_said(tmp_path) -> None:
    year = _year()
    path = tmp_path / "w.csv"
    _write_csv(path, year, dated=False)
    lines = path.read_text().splitlines()
    lines[3] = "1,1,2.5,-1.5,0"
    del lines[5000:5002]  # two hours lacking
    del lines[6000:6010]  # ten hours lacking
    lines.append("2,29,12.5,100,100")
    path.write_text("\n".join(lines))
    found = weather.read_weather(path, SEATTLE)
    said = " | ".join(found.repairs)
    assert "29 February" in said and "negative" in said and "2 missing hours interpolated" in said
    assert "10 missing hours left out" in said
    assert len(found) == 8750
    assert (found.dni_wm2 >= 0).all()


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda rows: rows.__setitem__(9, "1,1,8.5,abc,20"), "line 10: dni_wm2 is 'abc'"),
        (lambda rows: rows.__setitem__(9, "1,1,8.5,-500,20"), "line 10: dni_wm2 is -500"),
        (lambda rows: rows.__setitem__(9, "1,1,8.5,100"), "line 10: 4 cells"),
        (lambda rows: rows.__setitem__(9, "1,41,8.5,100,20"), "line 10: no such time"),
        (lambda rows: rows.__setitem__(9, rows[8]), "lines 9 and 10 are of the same hour"),
        (lambda rows: rows.__setitem__(0, "month,day,hour,dni,dhi"), "no column dni_wm2, dhi_wm2"),
        (lambda rows: rows.__setitem__(9, "inf,1,8.5,100,20"), "w.csv: "),
        (lambda rows: rows.insert(0, "# place: Nowhere, 47.6, -122.3, UTC+9"), "time zone UTC+9"),
        (lambda rows: rows.insert(0, "# place: Paris, 48.9, 2.3, UTC+1"), "km"),
    ],
)
def test_bad_files_are_named(tmp_path, change, expected: str) -> None:
    path = tmp_path / "w.csv"
    _write_csv(path, _year(), dated=False)
    rows = path.read_text().splitlines()
    change(rows)
    path.write_text("\n".join(rows))
    with pytest.raises(InputError, match=expected.replace("+", r"\+")):
        weather.read_weather(path, SEATTLE)


@pytest.mark.slow
@pytest.mark.contract
def test_wrong_time_zone_shows_as_light_at_night(tmp_path) -> None:
    path = tmp_path / "w.csv"
    _write_csv(path, _year(), dated=False)
    lost = Site("Seattle", 47.6, -122.3, "UTC")
    with pytest.raises(InputError, match="sun is down"):
        weather.read_weather(path, lost)
    _write_epw(tmp_path / "w.epw", _year(), longitude=122.3)
    with pytest.raises(InputError, match="time zone UTC-8"):
        weather.read_weather(tmp_path / "w.epw", SEATTLE)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("zone", "longitude", "fits"),
    [
        (13, -171.8, True),
        (14, -157.4, True),
        (10, -157.9, False),
        (-11, -171.8, True),
        (13, 171.8, True),
        (12, -179.0, True),
    ],
)
def test_zones_east_of_the_date_line(zone: int, longitude: float, fits: bool) -> None:
    """Samoa and Kiritimati have the date of the east; Hawaii with a wrong sign does not."""
    cells = [-13.8, longitude, 10.0, zone]
    if fits:
        assert formats._place(Path("w.epw"), cells, "a header", "Apia")[1] == timedelta(hours=zone)
    else:
        with pytest.raises(InputError, match="time zone UTC\\+10"):
            formats._place(Path("w.epw"), cells, "a header", "Honolulu")


@pytest.mark.contract
@pytest.mark.parametrize(
    "content", [b"", b"\x00\x01\x02", b"LOCATION,x\n", b"t_utc,dni_wm2,dhi_wm2\n2027-01-01,1,1\n"]
)
def test_hopeless_files(tmp_path, content: bytes) -> None:
    path = tmp_path / "w.csv"
    path.write_bytes(content)
    with pytest.raises(InputError):
        weather.read_weather(path, SEATTLE)
    path.write_text("t_utc,dni_wm2,dhi_wm2\n")
    with pytest.raises(NotEnoughDataError):
        weather.read_weather(path, SEATTLE)
    with pytest.raises(InputError):
        weather.read_weather(tmp_path / "missing.epw", SEATTLE)


@pytest.mark.slow
@pytest.mark.contract
def test_synthetic_is_seeded_plausible_and_labelled() -> None:
    for place in (SEATTLE, Site("Sydney", -33.9, 151.2, "Australia/Sydney")):
        a, b = weather.synthetic_weather(place, 1), weather.synthetic_weather(place, 1)
        assert np.array_equal(a.dni_wm2, b.dni_wm2) and a.synthetic and "synthetic" in a.repairs[0]
        assert 800e3 < a.ghi_wm2.sum() < 2200e3  # Wh/m2 in a year, anywhere people live
        assert (a.ghi_wm2 <= 1.25 * np.maximum(sun.clearsky(a.t_utc, place).ghi_wm2, 1.0)).all()


_DAY = [
    f"2027-06-{20 + h // 24:02d}T{h % 24:02d}:30:00Z,{max(0, 40 * (h % 24 - 13))},{5 * (h % 24)}"
    for h in range(48)
]
_SMALL = "\n".join(["t_utc,dni_wm2,dhi_wm2", *_DAY]).encode()
_HEAD = b"LOCATION,Test,WA,USA,none,0,47.6,-122.3,-8,5\n" + b"X\n" * 7
_ROWS = b"".join(
    b"2027,6,%d,%d,60,?,0,0,0,0,0,0,0,10,20,30,0\n" % (20 + h // 24, h % 24 + 1) for h in range(48)
)


@pytest.mark.slow
@pytest.mark.property
@settings(
    deadline=None, max_examples=80, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    st.sampled_from([_SMALL, _HEAD + _ROWS]),
    st.lists(
        st.tuples(st.integers(0, 3000), st.binary(max_size=4), st.integers(0, 12)), max_size=4
    ),
)
def test_mutated_files_are_read_or_refused(tmp_path, whole: bytes, changes) -> None:
    """Property (fuzz): whatever happens to a file, it gives a finite weather or one of the
    tool's own errors.
    """
    data = bytearray(whole)
    for at, insert, cut in changes:
        data[at % len(data) : at % len(data) + cut] = insert
        data = data or bytearray(b"x")
    path = tmp_path / "w.csv"
    path.write_bytes(bytes(data))
    try:
        found = weather.read_weather(path, SEATTLE)
    except FieldlumError as error:
        assert "\n" not in str(error)
        return
    for series in (found.dni_wm2, found.dhi_wm2, found.ghi_wm2):
        assert np.isfinite(series).all() and (series >= 0).all()
    assert list(found.t_utc) == sorted(set(found.t_utc))


@pytest.mark.contract
def test_a_mistyped_year_is_named(tmp_path) -> None:
    path = tmp_path / "w.csv"
    path.write_text(_SMALL.decode().replace("2027-06-21T12", "9027-06-21T12"))
    with pytest.raises(InputError, match="is followed by 9027"):
        weather.read_weather(path, SEATTLE)


# ----------------------------------------------------------------------------------------------
# what it can mean


def _write_dated(
    path: Path, year: weather.Weather, *, shift_min: float = 0.0, ghi: bool = False, **columns
) -> None:
    """The year with its labels moved and its columns exchanged or scaled."""
    dni, dhi = (columns.get(name, getattr(year, f"{name}_wm2")) for name in ("dni", "dhi"))
    rows = ["t_utc,dni_wm2,dhi_wm2" + (",ghi_wm2" if ghi else "")]
    for k, t in enumerate(year.t_utc):
        rows.append(
            f"{t + timedelta(minutes=shift_min):%Y-%m-%dT%H:%M:%SZ},{dni[k]:.3f},{dhi[k]:.3f}"
        )
        rows[-1] += f",{year.ghi_wm2[k]:.3f}" if ghi else ""
    path.write_text("\n".join(rows))


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize("shift_min", [-60, -30, 30, 60])
def test_labels_beside_their_hours_are_refused_with_the_shift(tmp_path, shift_min: int) -> None:
    """Hour-end labels, hour-start labels and daylight saving all look like weather;
    the sun says no.
    """
    _write_dated(tmp_path / "w.csv", weather.shipped_seattle(), shift_min=shift_min)
    with pytest.raises(
        InputError, match=rf"with all row times moved by {-shift_min:+d} min".replace("+", r"\+")
    ):
        weather.read_weather(tmp_path / "w.csv", SEATTLE)


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda y: {"dni": y.dhi_wm2, "dhi": y.dni_wm2}, "DHI is above the limit of any sky"),
        (lambda y: {"dhi": y.ghi_wm2}, "DHI is above the limit of any sky"),
        (lambda y: {"dni": y.ghi_wm2}, "the column of DNI has global or diffuse"),
        (lambda y: {"dni": y.dni_wm2 / 1e3, "dhi": y.dhi_wm2 / 1e3}, "values are in kW"),
        (
            lambda y: {"dni": 0.5 * y.dni_wm2, "dhi": 0.6 * y.dhi_wm2, "ghi": True},
            "GHI differs from DHI",
        ),
    ],
)
def test_columns_and_units_that_cannot_be_are_refused(tmp_path, change, expected: str) -> None:
    """Numbers that look like weather, and are another component or another unit."""
    year = weather.shipped_seattle()
    _write_dated(tmp_path / "w.csv", year, **change(year))
    with pytest.raises(InputError, match=expected):
        weather.read_weather(tmp_path / "w.csv", SEATTLE)


@pytest.mark.contract
def test_clear_hours_show_another_unit(tmp_path) -> None:
    """Wh/m2 of half an hour, for example: ratios of the columns are right."""
    year = weather.shipped_seattle()
    _write_dated(tmp_path / "w.csv", year, dni=0.5 * year.dni_wm2, dhi=0.5 * year.dhi_wm2)
    repairs = weather.read_weather(tmp_path / "w.csv", SEATTLE).repairs
    assert any("clear hours is 0.52 times that of a cloudless sky" in text for text in repairs)


@pytest.mark.slow
@pytest.mark.contract
def test_global_for_direct_is_refused_under_bright_clouds(tmp_path) -> None:
    """Clouds that transmit 70 % are below a clearness of 0.25 at low suns only, where sin(altitude)
    hides the wrong column; but global irradiance is never below the diffuse one.
    """
    year = _year(Site("Sydney", -33.87, 151.21, "Australia/Sydney"))
    clear = sun.clearsky(year.t_utc, year.site)
    cloudy = np.arange(len(year)) // 24 % 8 > 0
    dni = np.where(cloudy, 0.0, clear.dni_wm2)
    dhi = np.where(cloudy, 0.7 * clear.ghi_wm2, clear.dhi_wm2)
    ghi = np.where(cloudy, dhi, clear.ghi_wm2)
    _write_dated(tmp_path / "right.csv", year, dni=dni, dhi=dhi)
    assert weather.read_weather(tmp_path / "right.csv", year.site).repairs == PLACELESS
    _write_dated(tmp_path / "wrong.csv", year, dni=ghi, dhi=dhi)
    with pytest.raises(InputError, match=r"DNI equals DHI in.*the column of DNI has global"):
        weather.read_weather(tmp_path / "wrong.csv", year.site)


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize(
    ("latitude_deg", "longitude_deg", "zone"),
    [(-33.87, 151.21, "Australia/Sydney"), (-0.2, -78.5, "America/Guayaquil")],
)
@pytest.mark.parametrize("shift_min", [-30, 0, 30])
def test_labels_half_an_hour_off_are_reported_at_any_latitude(
    tmp_path, latitude_deg: float, longitude_deg: float, zone: str, shift_min: int
) -> None:
    """Sunrise and sunset do not show half an hour here; mornings and afternoons do."""
    year = _year(Site("There", latitude_deg, longitude_deg, zone))
    _write_dated(tmp_path / "w.csv", year, shift_min=shift_min)
    notes = [
        text
        for text in weather.read_weather(tmp_path / "w.csv", year.site).repairs
        if "mornings and afternoons" in text
    ]
    assert len(notes) == (shift_min != 0)
    assert not notes or f"(--label-shift {-shift_min:+d})" in notes[0]


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize("shift_min", [-60, 60])
def test_a_cloudless_year_an_hour_off_is_not_an_exchanged_column(tmp_path, shift_min: int) -> None:
    """Low suns of the wrong hour look like overcast hours with much direct light."""
    year = _year(Site("There", 33.0, 0.0, "UTC"))
    clear = sun.clearsky(year.t_utc, year.site)
    _write_dated(
        tmp_path / "w.csv", year, shift_min=shift_min, dni=clear.dni_wm2, dhi=clear.dhi_wm2
    )
    with pytest.raises(
        InputError, match=rf"all row times moved by \{-shift_min:+d} min.*time zone"
    ):
        weather.read_weather(tmp_path / "w.csv", year.site)


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize(
    ("latitude_deg", "expected"),
    [(47.6, "sun is down"), (20.0, "check that the file is of this place")],
)
def test_weather_of_the_other_hemisphere_is_refused(
    tmp_path, latitude_deg: float, expected: str
) -> None:
    """Hours of local time fit any longitude; the length of the days does not."""
    north, south = (
        Site("Somewhere", sign * latitude_deg, -122.3, "America/Los_Angeles") for sign in (1, -1)
    )
    _write_csv(tmp_path / "w.csv", _year(south), dated=False)
    with pytest.raises(InputError, match=expected):
        weather.read_weather(tmp_path / "w.csv", north)


@pytest.mark.contract
@pytest.mark.parametrize("step_min", [10, 30, 180])
def test_rows_that_are_no_hours_are_refused(tmp_path, step_min: int) -> None:
    """Ten-minute rows would count each hour of glare six times."""
    start = datetime(2027, 6, 20, tzinfo=UTC)
    times = [start + timedelta(minutes=step_min * k) for k in range(20)]
    rows = [f"{t:%Y-%m-%dT%H:%M:%SZ},100,100" for t in times]
    (tmp_path / "w.csv").write_text("\n".join(["t_utc,dni_wm2,dhi_wm2", *rows]))
    with pytest.raises(InputError, match=f"rows that are {step_min} min apart"):
        weather.read_weather(tmp_path / "w.csv", SEATTLE)


@pytest.mark.slow
@pytest.mark.authority
def test_measured_tmy3_files_pass() -> None:
    """The two TMY3 files that pvlib ships, of 36 and 55 degrees north, are read
    without a word.
    """
    import pvlib

    data = Path(pvlib.__file__).parent / "data"
    for name, place in (
        ("703165TY.csv", Site("Sand Point", 55.32, -160.52, "America/Anchorage")),
        ("723170TYA.CSV", Site("Greensboro", 36.1, -79.95, "America/New_York")),
    ):
        found = weather.read_weather(data / name, place)
        assert len(found) == 8760 and not found.repairs


@pytest.mark.contract
def test_info_names_a_weather_file_and_its_command(tmp_path: Path) -> None:
    """LibRaw was once named as the reader of an .epw."""
    _write_epw(tmp_path / "c.epw", _year())
    result = CliRunner().invoke(main, ["info", str(tmp_path / "c.epw")])
    assert result.exit_code == 3 and "LibRaw" not in result.stderr
    assert "c.epw: a weather file; expected a frame" in result.stderr
    assert "read it with: fieldlum predict MODELDIR --weather FILE" in result.stderr


@pytest.mark.contract
def test_info_names_the_kind_of_another_file(tmp_path: Path) -> None:
    path = tmp_path / "a.pdf"
    path.write_bytes(b"%PDF-1.4")
    result = CliRunner().invoke(main, ["info", str(path)])
    assert result.exit_code == 3
    assert "a.pdf: a PDF; expected a frame, .exr" in result.stderr and "LibRaw" not in result.stderr
