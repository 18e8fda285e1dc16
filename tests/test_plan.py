"""Plans: the paper's sets, the seasons, the poles, clock changes, and bad site files."""

from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from places import SEATTLE

from fieldlum import plan
from fieldlum.cli import main
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import CameraSetup, Site, SiteFile
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Lens,
    NeutralDensity,
    save_profile,
)
from fieldlum.plan import summary
from fieldlum.session import create_session, open_session
from fieldlum.sky import sun
from fieldlum.weather import Weather

TODAY = date(2026, 11, 21)


@pytest.fixture(scope="module")
def profile(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("profile") / "camera.toml"
    bracket = Bracket(
        5.6, 100.0, (1.0, 0.1, 0.01), nd=("nd3",), nd_shutter_s=(0.001,), megabytes_per_frame=10.0
    )
    body = CameraBody("test", "raw", 100, 100)
    lenses = (Lens((50.0, 50.0), 45.0, 180.0),)
    filters = (NeutralDensity("nd3", (1000.0, 1000.0, 1000.0)),)
    save_profile(path, CameraProfile(body, lenses, bracket, nd=filters))
    return str(path)


def _plan(site: Site, profile: str, name: str, **asked: object) -> plan.Plan:
    setup = SiteFile(site, CameraSetup(profile=profile))
    return plan.make_plan(setup, plan.Request(name, **{"today": TODAY, **asked}))  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.parametrize(("name", "count"), [("9-day", 108), ("12-day", 144), ("4-day", 48)])
@pytest.mark.parametrize("asked", [{"year": 2027}, {}, {"start": date(2025, 1, 1)}])
def test_the_papers_seattle_sets(profile: str, name: str, count: int, asked: dict) -> None:
    """Liu, Colburn, Inanici 2020: 9 days give 108 hours in Seattle, 12 days 144, 4 days 48."""
    assert len(_plan(SEATTLE, profile, name, **asked).slots) == count


@pytest.mark.slow
@pytest.mark.authority
def test_nine_days_are_the_papers_dates(profile: str) -> None:
    """19-21 March, 20-22 June, 20-22 December (the paper's section on training data)."""
    days = _plan(SEATTLE, profile, "9-day", year=2026).days
    assert [d.strftime("%m-%d") for d in days] == [
        "03-19",
        "03-20",
        "03-21",
        "06-20",
        "06-21",
        "06-22",
        "12-20",
        "12-21",
        "12-22",
    ]


@pytest.mark.analytic
def test_slots_stand_at_half_past_standard_time_through_a_clock_change(profile: str) -> None:
    made = _plan(SEATTLE, profile, "month", year=2027)
    assert {(s.t_utc + timedelta(hours=-8)).minute for s in made.slots} == {30}
    assert 365 <= len(made.slots) <= 376
    assert len(made.days) == 31 and made.days[15] == date(2027, 3, 20)
    assert [w for w in made.warnings if "clocks go forward by 1 h on 2027-03-14" in w]


@pytest.mark.slow
@pytest.mark.analytic
def test_half_hour_zones_keep_to_their_own_standard_time(profile: str) -> None:
    made = _plan(Site("Delhi", 28.6, 77.2, "Asia/Kolkata"), profile, "4-day", year=2027)
    assert {s.t_utc.minute for s in made.slots} == {0}


@pytest.mark.slow
@pytest.mark.analytic
def test_month_without_start_is_the_next_whole_one(profile: str) -> None:
    assert _plan(SEATTLE, profile, "month", today=date(2026, 11, 21)).days[15] == date(2027, 3, 20)
    assert _plan(SEATTLE, profile, "month", today=date(2027, 3, 10)).days[15] == date(2027, 9, 22)
    assert _plan(SEATTLE, profile, "month", start=date(2027, 5, 1)).days[0] == date(2027, 5, 1)


@pytest.mark.slow
@pytest.mark.analytic
def test_events_without_year_lie_ahead(profile: str) -> None:
    days = _plan(SEATTLE, profile, "9-day", today=date(2026, 12, 21)).days
    assert days[0] == date(2027, 3, 19) and days[-1] == date(2027, 12, 22)


@pytest.mark.slow
@pytest.mark.analytic
def test_polar_night_warns_and_midnight_sun_is_listed(profile: str) -> None:
    tromso = Site("Tromso", 69.65, 18.96, "Europe/Oslo")
    said = " ".join(_plan(tromso, profile, "9-day", year=2027).warnings)
    assert "polar night: no slot on 3 of 9 days" in said and "midnight sun" in said


@pytest.mark.contract
def test_fewer_hours_than_asked_for_are_said(profile: str) -> None:
    """Three June days in Seattle hold 48 half-past hours of daylight."""
    made = _plan(SEATTLE, profile, "even", start=date(2027, 6, 1), days=3, count=500)
    assert (
        len(made.slots) == 48
        and "--count 500: the plan has only 48 slots, because no more hours of its days are "
        "suitable"
        in made.warnings
    )


@pytest.mark.contract
def test_nothing_but_polar_night_is_not_enough_data(profile: str) -> None:
    with pytest.raises(NotEnoughDataError, match="polar night"):
        _plan(
            Site("Longyearbyen", 78.2, 15.6, "Arctic/Longyearbyen"),
            profile,
            "month",
            start=date(2026, 12, 1),
        )


@pytest.mark.slow
@pytest.mark.analytic
def test_southern_hemisphere_has_its_long_day_in_december(profile: str) -> None:
    made = _plan(Site("Sydney", -33.9, 151.2, "Australia/Sydney"), profile, "9-day", year=2027)
    count = {
        tag: sum(tag in s.tags for s in made.slots)
        for tag in ("june-solstice", "december-solstice")
    }
    assert count["june-solstice"] < count["december-solstice"]


@pytest.mark.slow
@pytest.mark.property
def test_even_spreads_over_sun_positions_and_is_repeatable(profile: str) -> None:
    first, second = (_plan(SEATTLE, profile, "even", year=2027, count=60) for _ in range(2))
    assert first.slots == second.slots and len(first.slots) == 60
    altitude = [s.sun_altitude_deg for s in first.slots]
    assert min(altitude) < 5 and max(altitude) > 60


@pytest.mark.analytic
def test_cost_counts_headings_and_filters(profile: str, tmp_path: Path) -> None:
    """Analytic: a filter adds frames only where it is named; its name must be the profile's."""
    camera = CameraSetup(profile=profile, headings=(180.0, 0.0))
    request = plan.Request("4-day", TODAY, year=2027)
    bare = plan.make_plan(SiteFile(SEATTLE, camera), request)
    assert len(bare.slots[0].exposures) == 3 and bare.megabytes_per_slot == 60.0
    with pytest.raises(InputError, match="no filter 'nd9'; expected one of its filters"):
        plan.make_plan(SiteFile(SEATTLE, replace(camera, filter="nd9")), request)
    setup = SiteFile(SEATTLE, replace(camera, filter="nd3"))
    made = plan.make_plan(setup, request)
    assert len(made.slots[0].exposures) == 4
    assert made.megabytes_per_slot == 80.0
    assert made.seconds_per_slot == pytest.approx(2 * (8.0 + 1.111), abs=0.1)
    session = create_session(tmp_path, setup, made.slots[:3], {})
    assert summary(session, replace(made, slots=made.slots[:3]))["frames"] == 3 * 4 * 2


@pytest.mark.analytic
def test_weather_of_other_dates_is_not_enough_data(profile: str) -> None:
    times = tuple(datetime(2025, 6, day, 20, tzinfo=UTC) for day in range(1, 6))
    light = np.full(5, 100.0)
    weather = Weather(
        "june", SEATTLE, t_utc=times, dni_wm2=light, dhi_wm2=light, ghi_wm2=2 * light, typical=False
    )
    setup = SiteFile(SEATTLE, CameraSetup(profile=profile))
    with pytest.raises(NotEnoughDataError, match="the weather file has no daylight"):
        plan.make_plan(setup, plan.Request("even", TODAY, year=2027, days=5), weather)


def _site_file(folder: Path, text: str) -> Path:
    path = folder / "site.toml"
    path.write_text(text)
    return path


GOOD = (
    '[site]\nname = "S"\nlatitude_deg = 47.6\nlongitude_deg = -122.3\ntimezone = '
    '"America/Los_Angeles"\n'
)


@pytest.mark.slow
@pytest.mark.contract
def test_command_makes_a_session(tmp_path: Path, profile: str) -> None:
    site = _site_file(tmp_path, GOOD + f'[camera]\nprofile = "{profile}"\n')
    out = tmp_path / "session"
    asked = ["plan", str(site), "--set", "9-day", "--year", "2027", "--out", str(out), "--json"]
    found = CliRunner().invoke(main, asked)
    assert found.exit_code == 0, found.output
    assert '"slots": 108' in found.stdout
    assert len(open_session(out).slots()) == 108
    again = CliRunner().invoke(main, asked)
    assert again.exit_code == 3 and "already a session" in again.stderr


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "said"),
    [
        (GOOD.replace("latitude_deg", "lattitude_deg"), "did you mean 'latitude_deg'"),
        (GOOD.replace("47.6", "147"), "latitude_deg = '147', expected a number <= 90"),
        (GOOD.replace("America/Los_Angeles", "Mars/Base"), "unknown time zone 'Mars/Base'"),
        ("nonsense", "TOML"),
    ],
)
def test_bad_site_files_get_one_line(tmp_path: Path, text: str, said: str) -> None:
    site = _site_file(tmp_path, text)
    found = CliRunner().invoke(
        main, ["plan", str(site), "--set", "4-day", "--out", str(tmp_path / "o")]
    )
    assert found.exit_code == 3 and said in found.stderr and found.stderr.count("\n") == 1
    assert not (tmp_path / "o").exists()


@pytest.mark.contract
def test_usage_errors_exit_two(tmp_path: Path) -> None:
    site = _site_file(tmp_path, GOOD)
    assert CliRunner().invoke(main, ["plan", str(site)]).exit_code == 2
    assert (
        CliRunner().invoke(main, ["plan", str(site), "--set", "5-day", "--out", "x"]).exit_code == 2
    )


@pytest.mark.contract
@pytest.mark.parametrize(
    "asked",
    [
        ["--set", "month", "--count", "5"],
        ["--set", "9-day", "--days", "3"],
        ["--set", "month", "--start", "2027-03-01", "--year", "2028"],
    ],
)
def test_what_would_be_passed_over_is_a_usage_error(tmp_path: Path, asked: list[str]) -> None:
    found = CliRunner().invoke(
        main, ["plan", str(_site_file(tmp_path, GOOD)), *asked, "--out", str(tmp_path / "o")]
    )
    assert found.exit_code == 2 and asked[2] in found.stderr
    assert not (tmp_path / "o").exists()


@pytest.mark.contract
def test_a_session_cannot_be_a_file(tmp_path: Path) -> None:
    site = _site_file(tmp_path, GOOD)
    found = CliRunner().invoke(main, ["plan", str(site), "--set", "4-day", "--out", str(site)])
    assert found.exit_code == 3 and "File exists; expected a folder" in found.stderr


@pytest.mark.slow
@pytest.mark.contract
def test_a_place_without_time_zone_is_told(profile: str) -> None:
    made = _plan(Site("Seattle", 47.6, -122.3), profile, "4-day")
    assert any("timezone is UTC at longitude -122.3" in said for said in made.warnings)


@pytest.mark.analytic
def test_today_is_the_sites_own() -> None:
    assert plan.today_at(SEATTLE, datetime(2027, 3, 20, 3, tzinfo=UTC)) == date(2027, 3, 19)
    assert sun.standard_date(datetime(2027, 7, 1, 7, 30, tzinfo=UTC), SEATTLE.timezone) == date(
        2027, 6, 30
    )


@pytest.mark.contract
def test_session_toml_records_what_a_plan_can_be_made_from_again() -> None:
    request = plan.Request("even", TODAY, days=9, count=5, seed=7)
    about = plan.make_plan(SiteFile(SEATTLE, CameraSetup()), request).about(request)
    assert {name: about.get(name) for name in ("set", "days", "count", "seed", "year")} == {
        **{"set": "even", "days": 9, "count": 5, "seed": 7, "year": None}
    }
    request = plan.Request("4-day", TODAY)  # nothing in it is drawn
    assert "seed" not in plan.make_plan(SiteFile(SEATTLE, CameraSetup()), request).about(request)
