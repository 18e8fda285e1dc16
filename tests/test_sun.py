"""Sun: seasons against almanacs, rise and set from pole to equator, decomposition, limits."""

from datetime import UTC, date, datetime, timedelta

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from places import SEATTLE

from fieldlum.core.records import Site
from fieldlum.sky import sun

SITES = tuple(
    Site(f"{latitude:+g}", latitude, longitude, f"Etc/GMT{-round(longitude / 15):+d}")
    for latitude, longitude in zip(
        (
            90,
            85,
            78.2,
            69.65,
            66,
            64.1,
            60,
            55,
            51.5,
            47.6,
            40,
            30,
            20,
            10,
            0,
            -10,
            -23.4,
            -33.9,
            -54.8,
            -77.8,
        ),
        (
            0,
            10,
            15.6,
            18.96,
            25,
            -21.9,
            30,
            12,
            0,
            -122.3,
            -75,
            31,
            77,
            -84,
            -78,
            39,
            -46.6,
            151.2,
            -68.3,
            166.7,
        ),
        strict=True,
    )
)

# U.S. Naval Observatory, Universal Time to the minute: its season service's answers for 1800 to
# 2100 as kept in GitHub cosinekitty/astronomy, generate/seasons/seasons.txt (commit b3ff85df), read
# there. Wikipedia's table of 2019 to 2028 (a copy at wiki.studentb.eu, March equinox) differs from
# it by a minute in eleven places of forty.
ALMANAC = {
    2016: ("03-20T04:30", "06-20T22:34", "09-22T14:21", "12-21T10:44"),
    2019: ("03-20T21:58", "06-21T15:54", "09-23T07:50", "12-22T04:19"),
    2020: ("03-20T03:50", "06-20T21:44", "09-22T13:31", "12-21T10:02"),
    2021: ("03-20T09:37", "06-21T03:32", "09-22T19:21", "12-21T15:59"),
    2022: ("03-20T15:33", "06-21T09:14", "09-23T01:04", "12-21T21:48"),
    2023: ("03-20T21:24", "06-21T14:58", "09-23T06:50", "12-22T03:27"),
    2024: ("03-20T03:06", "06-20T20:51", "09-22T12:44", "12-21T09:20"),
    2025: ("03-20T09:01", "06-21T02:42", "09-22T18:19", "12-21T15:03"),
    2026: ("03-20T14:46", "06-21T08:24", "09-23T00:05", "12-21T20:50"),
    2027: ("03-20T20:25", "06-21T14:11", "09-23T06:02", "12-22T02:42"),
    2028: ("03-20T02:17", "06-20T20:02", "09-22T11:45", "12-21T08:19"),
    2030: ("03-20T13:52", "06-21T07:31", "09-22T23:27", "12-21T20:09"),
}
# Meeus, Astronomical Algorithms, 2nd edition, table of instants for 1996 to 2005 from the complete
# VSOP87, Dynamical Time to the second: as typed in GitHub soniakeys/meeus,
# solstice/solstice_test.go (commit 0798b985), the same in commenthol/astronomia,
# test/solstice.test.js. First figure: TD - UT [s] in March, rounded, from cosinekitty/astronomy,
# generate/delta_t/recent.txt (it grows by up to 0.5 s until December). The book itself was not at
# hand.
MEEUS = {
    1996: (61.7, "03-20T08:04:07", "06-21T02:24:46", "09-22T18:01:08", "12-21T14:06:56"),
    1998: (63.1, "03-20T19:55:35", "06-21T14:03:38", "09-23T05:38:15", "12-22T01:57:31"),
    2000: (63.9, "03-20T07:36:19", "06-21T01:48:46", "09-22T17:28:40", "12-21T13:38:30"),
    2003: (64.5, "03-21T01:00:50", "06-21T19:11:32", "09-23T10:47:53", "12-22T07:04:53"),
    2005: (64.7, "03-20T12:34:29", "06-21T06:47:12", "09-22T22:24:14", "12-21T18:36:01"),
}
# U.S. Naval Observatory, "Rise and Set for the Sun for 2019", Universal Time to the minute
# (aa.usno.navy.mil, RS_OneYear), as kept in GitHub cosinekitty/astronomy,
# generate/riseset/sun_2019_*.html, read there. (latitude, longitude, zone): day of the rise, rise,
# and set of that same day at the place.
USNO_RISE_SET = {
    (29.0, -81.0, "Etc/GMT+5"): (
        ("01-15", "12:19", "22:48"),
        ("03-20", "11:28", "23:35"),
        ("06-15", "10:25", "00:24"),
        ("09-23", "11:13", "23:20"),
        ("12-22", "12:14", "22:31"),
    ),
    (60.0, 0.0, "UTC"): (
        ("01-15", "08:48", "15:31"),
        ("03-20", "06:03", "18:14"),
        ("06-21", "02:36", "21:28"),
        ("09-23", "05:46", "17:58"),
        ("12-22", "09:02", "14:55"),
    ),
    (-60.0, -150.0, "Etc/GMT+10"): (
        ("01-15", "13:12", "07:06"),
        ("03-20", "16:00", "04:13"),
        ("06-21", "19:06", "00:58"),
        ("09-23", "15:45", "04:01"),
        ("12-22", "12:32", "07:25"),
    ),
}


@pytest.mark.authority
@pytest.mark.parametrize("year", ALMANAC)
def test_seasons_to_the_minute(year: int) -> None:
    for which, text in enumerate(ALMANAC[year]):
        published = datetime.fromisoformat(f"{year}-{text}:00+00:00")
        # Printed to the minute: half of one, and the SPA's own 0.0003 degrees of longitude.
        assert abs((sun.season(year, which) - published).total_seconds()) <= 45


@pytest.mark.authority
@pytest.mark.parametrize("year", MEEUS)
def test_seasons_against_meeus(year: int) -> None:
    delta_t, *rows = MEEUS[year]
    for which, text in enumerate(rows):
        published = datetime.fromisoformat(f"{year}-{text}+00:00") - timedelta(seconds=delta_t)
        assert (
            abs((sun.season(year, which) - published).total_seconds()) <= 25
        )  # SPA: 0.0003 deg is 26 s of longitude


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.parametrize("place", USNO_RISE_SET, ids=lambda place: f"{place[0]:+g}")
def test_rise_and_set_to_the_minute(place: tuple[float, float, str]) -> None:
    for day, *published in USNO_RISE_SET[place]:
        found = sun.rise_transit_set(date.fromisoformat(f"2019-{day}"), Site("", *place))
        for moment, text in zip((found.rise, found.set), published, strict=True):
            assert moment is not None
            hour, minute = (int(part) for part in text.split(":"))
            off = moment - moment.replace(hour=hour, minute=minute, second=0)
            off_s = (off.total_seconds() + 43200.0) % 86400.0 - 43200.0
            assert abs(off_s) <= 90, (place, day, text, moment)  # both to the minute


@pytest.mark.property
@pytest.mark.parametrize(
    "place",
    [
        (1.87, -157.4, "Pacific/Kiritimati"),
        (-43.95, -176.5, "Pacific/Chatham"),
        (-18.1, 178.4, "Pacific/Fiji"),
    ],
    ids=lambda place: place[2],
)
def test_each_standard_day_has_its_own_sun_beside_the_date_line(
    place: tuple[float, float, str],
) -> None:
    days = [date(2027, 1, 1) + timedelta(days=13 * k) for k in range(28)]
    for day in days:
        found = sun.rise_transit_set(day, Site("", *place))
        start = sun.standard_midnight(day, place[2])
        assert all(t is not None and start <= t < start + timedelta(days=1) for t in found), day


def _crossing(site: Site, low: datetime, high: datetime, altitude_deg: float) -> datetime:
    """Where the true altitude passes `altitude_deg`, to 0.1 s by `sun.position`."""
    sign = np.sign(sun.position([high], site).altitude_deg[0] - altitude_deg)
    for _ in range(4):
        times = [low + (high - low) / 16 * k for k in range(17)]
        beyond = np.sign(sun.position(times, site).altitude_deg - altitude_deg) == sign
        first = max(int(np.argmax(beyond)), 1)
        low, high = times[first - 1], times[first]
    return low


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.parametrize("site", SITES, ids=lambda s: s.name)
def test_rise_and_set_agree_with_the_position(site: Site) -> None:
    """pvlib's rise and set (34 arc minutes of refraction, upper limb) against the position's own
    crossing.
    """
    for day in (date(2027, 3, 20), date(2027, 6, 21), date(2027, 9, 23), date(2027, 12, 22)):
        found = sun.rise_transit_set(day, site)
        around = [
            sun.standard_midnight(day, site.timezone) + timedelta(minutes=10 * k)
            for k in range(-72, 217)
        ]
        altitude = sun.position(around, site).altitude_deg
        if found.rise is None or found.set is None or found.transit is None:
            middle = altitude[72:217]
            assert (
                middle.min() > -1.3 or middle.max() < 0.5
            )  # never sets or never rises, within a day's drift
            continue
        if abs(site.latitude_deg) > 80:
            continue  # the sun grazes the horizon for hours: minutes mean nothing there
        assert found.rise < found.transit < found.set
        for moment in (found.rise, found.set):
            margin = timedelta(minutes=40)
            crossing = _crossing(site, moment - margin, moment + margin, sun.RISE_ALTITUDE_DEG)
            assert 0 <= (crossing - moment).total_seconds() <= 61
        almanac = _pvlib_rise(day, site)
        # pvlib takes the neighbouring day's sun far from Greenwich: up to 90 s, more where the sun
        # grazes
        assert abs((found.rise - almanac).total_seconds()) <= (
            150 if abs(site.latitude_deg) < 65 else 660
        )


def _pvlib_rise(day: date, site: Site) -> datetime:
    import pandas as pd
    from pvlib.solarposition import sun_rise_set_transit_spa

    index = pd.DatetimeIndex([pd.Timestamp(day)]).tz_localize(site.timezone)
    rise = sun_rise_set_transit_spa(index, site.latitude_deg, site.longitude_deg)["sunrise"].iloc[0]
    return rise.tz_convert("UTC").floor("s").to_pydatetime()


@pytest.mark.analytic
def test_declination_at_the_seasons() -> None:
    times = [sun.season(2027, which) for which in range(4)]
    assert sun.declination_deg(times) == pytest.approx([0, 23.436, 0, -23.436], abs=0.01)


@pytest.mark.contract
def test_naive_times_are_refused() -> None:
    with pytest.raises(ValueError, match="naive"):
        sun.position([datetime(2027, 1, 1)], SEATTLE)  # noqa: DTZ001
    with pytest.raises(ValueError, match="naive"):
        sun.standard_time(datetime(2027, 1, 1), "UTC")  # noqa: DTZ001


@pytest.mark.analytic
@pytest.mark.parametrize(
    ("zone", "hours"),
    [
        ("America/Los_Angeles", -8),
        ("Europe/Dublin", 0),
        ("Australia/Sydney", 10),
        ("Asia/Kolkata", 5.5),
        ("Australia/Lord_Howe", 10.5),
        ("Asia/Singapore", 8),
        ("America/St_Johns", -3.5),
    ],
)
def test_standard_offset_is_winter_time_in_both_hemispheres(zone: str, hours: float) -> None:
    assert sun.standard_offset(zone, 2027) == timedelta(hours=hours)


@pytest.mark.analytic
def test_clock_changes_in_a_window() -> None:
    found = sun.clock_changes(date(2027, 3, 1), date(2027, 3, 31), "Europe/London")
    assert found == [(datetime(2027, 3, 28, 1, tzinfo=UTC), timedelta(hours=1))]
    assert sun.clock_changes(date(2027, 4, 1), date(2027, 4, 5), "Australia/Lord_Howe")[0][
        1
    ] == timedelta(minutes=-30)
    assert sun.clock_changes(date(2027, 1, 1), date(2027, 12, 31), "Asia/Singapore") == []


@pytest.mark.analytic
def test_dirint_splits_a_clear_day_and_an_overcast_one() -> None:
    times = [datetime(2027, 6, 21, 8, tzinfo=UTC) + timedelta(hours=h) for h in range(24)]
    clear = sun.clearsky(times, SEATTLE)
    dni = sun.dirint_dni(clear.ghi_wm2, times, SEATTLE)
    high = sun.position(times, SEATTLE).altitude_deg > 15
    assert np.abs(dni - clear.dni_wm2)[high].max() < 0.12 * clear.dni_wm2.max()
    assert sun.dirint_dni(0.2 * clear.ghi_wm2, times, SEATTLE).max() < 20
    assert (dni[sun.position(times, SEATTLE).altitude_deg < 0] == 0).all()
    assert np.isnan(sun.dirint_dni([np.nan] * 24, times, SEATTLE)).all()


@pytest.mark.slow
@pytest.mark.property
@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(-10, 1400), min_size=24, max_size=24))
def test_dirint_never_exceeds_the_global(ghi: list[float]) -> None:
    times = [datetime(2027, 6, 21, 8, tzinfo=UTC) + timedelta(hours=h) for h in range(24)]
    dni, altitude = sun.dirint_dni(ghi, times, SEATTLE), sun.position(times, SEATTLE).altitude_deg
    assert np.isfinite(dni).all() and (dni >= 0).all()
    beam = dni * np.sin(np.radians(np.maximum(altitude, 0)))
    assert (beam <= np.maximum(ghi, 0) + 1e-6).all()


@pytest.mark.property
@settings(deadline=None)
@given(st.floats(3, 90), st.floats(0, 1000), st.floats(0, 500))
def test_closure_round_trip(altitude: float, dni: float, dhi: float) -> None:
    ghi = dhi + dni * np.sin(np.radians(altitude))
    assert sun.dni_by_closure(ghi, dhi, altitude) == pytest.approx(dni, abs=1e-6)
    assert sun.dhi_by_closure(ghi, dni, altitude) == pytest.approx(dhi, abs=1e-6)
    ratio = sun.closure_ratio(
        np.array([ghi]), np.array([dhi]), np.array([dni]), np.array([altitude])
    )[0]
    assert np.isnan(ratio) if ghi <= 50 else ratio == pytest.approx(1)


@pytest.mark.authority
def test_bsrn_limits() -> None:
    """BSRN Global Network recommended QC tests V2.0 (Long and Dutton 2002), at the zenith and 1361
    W/m2.

    Factors as read in GitHub ARM-DOE/ACT, act/qc/bsrn_tests.py (commit 121776f7), which cites that
    document.
    """
    possible, rare = (
        sun.bsrn_limits([90.0], [1361.0]),
        sun.bsrn_limits([90.0], [1361.0], extreme=True),
    )
    assert [float(x[1][0]) for x in possible] == pytest.approx([2141.5, 1342.95, 1361.0])
    assert [float(x[1][0]) for x in rare] == pytest.approx([1683.2, 1050.75, 1302.95])
    assert sun.bsrn_limits([-5.0], [1361.0]).ghi_wm2[1][0] == 100.0
