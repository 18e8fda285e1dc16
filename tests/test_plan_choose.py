"""Choosing, coverage, calendar, sheets and make-ups."""

import json
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st
from places import SEATTLE

from fieldlum import plan
from fieldlum.cli import main
from fieldlum.core.plot_style import svg_of
from fieldlum.core.records import (
    CameraSetup,
    Exposure,
    Room,
    Site,
    SiteFile,
    Window,
)
from fieldlum.optics.profiles import save_profile
from fieldlum.plan import capture_days, makeup
from fieldlum.plan import sheet as calendar
from fieldlum.plan.capture_days import (
    DaylightHours,
    band_directions,
    coverage,
    daylight_hours,
    days_of_set,
    span,
)
from fieldlum.session import Journal, create_session, open_session
from fieldlum.session.site_toml import site_table
from fieldlum.sky import sun
from fieldlum.weather import Weather, synthetic_weather

ROOM = Room(window=(Window("south", 0.5, 5.0, 0.9, 3.1),))
EXPOSURES = (Exposure(0.5, 5.6), Exposure(0.01, 5.6))


@pytest.fixture(scope="module")
def weather() -> Weather:
    return synthetic_weather(SEATTLE)


@pytest.fixture(scope="module")
def year() -> DaylightHours:
    return daylight_hours(span(date(2027, 1, 1), 365), SEATTLE)


def _set(name: str) -> DaylightHours:
    return daylight_hours(days_of_set(name, SEATTLE, date(2027, 1, 1), None, 2027, None), SEATTLE)


# ----------------------------------------------------------------------------------------------
# choosing


@pytest.mark.property
@settings(deadline=None, max_examples=25)
@given(st.integers(2, 60), st.integers(1, 70), st.integers(0, 9))
def test_choices_are_distinct_and_as_many_as_asked(points: int, count: int, seed: int) -> None:
    cloud = np.random.default_rng(seed).normal(size=(points, 3))
    found = capture_days.medoids(cloud, count, np.random.default_rng(seed))
    assert len(found) == len(set(found.tolist())) == min(points, count)
    assert (np.diff(found) > 0).all()


@pytest.mark.analytic
def test_medoids_find_clusters() -> None:
    rng = np.random.default_rng(3)
    centres = np.array([[0, 0], [10, 0], [0, 10], [10, 10]], float)
    cloud = np.repeat(centres, 25, axis=0) + rng.normal(scale=0.2, size=(100, 2))
    assert sorted(capture_days.medoids(cloud, 4, rng) // 25) == [0, 1, 2, 3]


@pytest.mark.slow
@pytest.mark.property
def test_even_hours_reach_more_skies_than_a_month(weather: Weather, year: DaylightHours) -> None:
    chosen = year[capture_days.even_hours(year, weather, 40, np.random.default_rng(1))]
    even, january = (coverage(some, SEATTLE, weather) for some in (chosen, year[range(40)]))
    assert even.both_percent is not None and january.both_percent is not None
    assert even.both_percent > 2 * january.both_percent


# ----------------------------------------------------------------------------------------------
# coverage


@pytest.mark.analytic
def test_band_is_the_solstice_band() -> None:
    up = band_directions(SEATTLE)[:, 2]
    assert np.degrees(np.arcsin(up.max())) == pytest.approx(
        90 - 47.6 + 23.44, abs=0.8
    )  # 41 steps of declination


@pytest.mark.analytic
def test_all_hours_of_a_weather_year_have_all_its_skies(weather: Weather) -> None:
    """Direct and diffuse irradiance of plan and year are compared, each with its own kind."""
    year = daylight_hours((date(2027, 1, 1) + timedelta(days=k) for k in range(365)), SEATTLE)
    every = coverage(year, SEATTLE, weather).irradiance_percent
    assert every is not None and every > 99.0


@pytest.mark.slow
@pytest.mark.property
def test_coverage_grows_with_the_set(weather: Weather) -> None:
    four, nine, twelve = (
        coverage(_set(name), SEATTLE, weather) for name in ("4-day", "9-day", "12-day")
    )
    assert four.sun_band_percent < nine.sun_band_percent + 1 < twelve.sun_band_percent + 2
    assert four.both_percent < nine.both_percent < twelve.both_percent  # type: ignore[operator]
    assert coverage(_set("9-day"), SEATTLE).irradiance_percent is None


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.parametrize("latitude", [-90.0, -33.9, 0.0, 69.6, 90.0])
def test_figures_draw_anywhere(latitude: float, weather: Weather) -> None:
    setup = SiteFile(Site("x", latitude, 0.0))
    hours = daylight_hours(span(date(2027, 3, 20), 2), setup.site)
    assert svg_of(calendar.sky_chart(hours, setup)).startswith("<svg")
    assert calendar.irradiance_figure(_set("4-day"), SEATTLE, weather).axes


# ----------------------------------------------------------------------------------------------
# calendar and sheets


def _setup(profile: str = "") -> SiteFile:
    return SiteFile(SEATTLE, CameraSetup(profile=profile), ROOM)


@pytest.mark.contract
def test_calendar_reads_back_with_stable_names() -> None:
    from icalendar import Calendar

    slots = plan.make_slots(_set("9-day"), _setup(), EXPOSURES)
    made = datetime(2027, 1, 1, tzinfo=UTC)
    first, second = (calendar.ics(slots, SEATTLE, 30.0, made, sequence) for sequence in (0, 1))
    events = [list(Calendar.from_ical(data).walk("VEVENT")) for data in (first, second)]
    assert len(events[0]) == 9
    assert [e["UID"] for e in events[0]] == [e["UID"] for e in events[1]]
    assert len({e["UID"] for e in events[0]}) == 9
    assert [int(e["SEQUENCE"]) for e in (events[0][0], events[1][0])] == [0, 1]
    assert events[0][0].decoded("DTSTART") == slots[0].t_utc
    assert all(len(list(e.walk("VALARM"))) == 1 for e in events[0])
    assert all(len(line) <= 75 for line in first.split(b"\r\n"))


@pytest.mark.slow
@pytest.mark.contract
def test_sheets_hold_a_page_a_day_and_say_when_clocks_change() -> None:
    from fieldlum.plan.sheet import html

    days = span(date(2027, 3, 13), 3)
    slots = plan.make_slots(daylight_hours(days, SEATTLE), _setup(), EXPOSURES)
    page = html(slots, _setup(), (30.0, 50.0), notes=["a <note>"])
    assert page.count('<section class="sheet"') == 3 and page.count("The clocks change today") == 1
    assert page.count('class="box"') == len(slots) + 2 * 3
    assert "does not rise" not in page and "<small>PDT</small>" in page
    assert "a &lt;note&gt;" in page and "<script" not in page and 'src="http' not in page


@pytest.mark.slow
@pytest.mark.contract
def test_a_sheet_under_the_midnight_sun_names_the_next_day() -> None:
    """By the wall clock the standard day ends after midnight: its last slot is tomorrow's."""
    from fieldlum.plan.sheet import html

    setup = SiteFile(Site("東京 Tromso", 69.65, 18.96, "Europe/Oslo"))
    slots = plan.make_slots(daylight_hours([date(2027, 6, 20)], setup.site), setup, EXPOSURES)
    page = html(slots, setup, (30.0, 50.0))
    assert (
        page.count("00:30 <small>CEST Mon 21</small>") == 1
        and page.count("<small>CEST</small>") == 23
    )
    assert "The sun neither rises nor sets today." in page
    assert "minmax(0, 1fr)" in page  # the right column stays on the paper


@pytest.mark.slow
@pytest.mark.contract
def test_a_sheet_tells_when_to_turn_the_camera_and_the_minutes_of_its_suns() -> None:
    setup = SiteFile(SEATTLE, CameraSetup(heading_deg=20.0, headings=(20.0, 200.0)))
    hours = daylight_hours([date(2027, 3, 20)], SEATTLE)
    page = calendar.html(plan.make_slots(hours, setup, EXPOSURES), setup, (45.0, 50.0))
    text = " ".join(page.split())
    assert "at 20&deg;: all frames, then turn to 200&deg;: all frames." in text
    assert "45 s each and time to turn, start" in text
    still = calendar.html(plan.make_slots(hours, _setup(), EXPOSURES), _setup(), (45.0, 50.0))
    assert "urn the camera" not in still and "to turn" not in still
    said = calendar.sky_chart(hours, setup, date(2027, 3, 20)).axes[0].texts
    assert all(t.get_text().endswith(":30") for t in said) and len(said) == (len(hours) + 1) // 2


# ----------------------------------------------------------------------------------------------
# make-ups


def _session(folder: Path, hours: DaylightHours, done: int) -> Path:
    slots = plan.make_slots(hours, _setup(), EXPOSURES)
    about = {"set": "month", "revision": 0, "seconds_per_slot": 30.0, "megabytes_per_slot": 50.0}
    session = create_session(folder / "s", _setup(), slots, about)
    journal = Journal(session)
    for slot in slots[:done]:
        journal.append("done", slot.t_utc, slot=slot.id)
    journal.close()
    return session.root


@pytest.mark.slow
@pytest.mark.property
def test_make_ups_have_the_same_sun_and_nothing_is_taken_out(tmp_path: Path) -> None:
    hours = daylight_hours(span(date(2027, 4, 10), 5), SEATTLE)
    root = _session(tmp_path, hours, 20)
    session, before = open_session(root), open_session(root).slots()
    now = datetime(2027, 4, 16, tzinfo=UTC)
    answer = makeup.run(session, now)
    assert answer["missed"] == len(before) - 20 == len(answer["made_up"]) and not answer["lost"]
    after = {slot.id: slot for slot in session.slots()}
    assert {slot.id for slot in before} <= set(after) and (root / "plan.0.csv").exists()
    added = [after[pair["slot"]].t_utc for pair in answer["made_up"]]
    local = {sun.standard_date(t, SEATTLE.timezone) for t in added}
    assert len(local) < len({t.date() for t in added})  # afternoons of the west are tomorrow in UTC
    assert f"added on {len(local)} days" in makeup.sentences(answer, SEATTLE.timezone)[1]
    for pair in answer["made_up"]:
        old, new = after[pair["missed"]], after[pair["slot"]]
        assert new.t_utc > now and new.exposures == old.exposures
        declinations = sun.declination_deg([old.t_utc, new.t_utc])
        assert abs(declinations[1] - declinations[0]) < 0.4 and pair["sun_off_deg"] < 8
    assert answer["sun_band_percent"]["without"] < answer["sun_band_percent"]["with"]
    again = makeup.run(session, now)
    assert (
        again["already"] == again["missed"]
        and not again["made_up"]
        and len(session.slots()) == len(after)
    )


@pytest.mark.slow
@pytest.mark.contract
def test_a_missed_make_up_is_made_up_again(tmp_path: Path) -> None:
    session = open_session(_session(tmp_path, daylight_hours([date(2027, 4, 10)], SEATTLE), 0))
    first = makeup.run(session, datetime(2027, 4, 12, tzinfo=UTC))
    second = makeup.run(session, datetime(2027, 9, 20, tzinfo=UTC))
    assert (
        len(first["made_up"]) == len(second["made_up"]) == first["missed"] == second["missed"] == 13
    )
    assert {p["missed"] for p in second["made_up"]} == {p["missed"] for p in first["made_up"]}
    assert not {p["slot"] for p in second["made_up"]} & {p["slot"] for p in first["made_up"]}
    journal = Journal(session)
    for pair in second["made_up"][:5]:
        journal.append("done", datetime(2028, 3, 1, tzinfo=UTC), slot=pair["slot"])
    journal.append("withdrawn", datetime(2028, 3, 1, tzinfo=UTC), slot=second["made_up"][0]["slot"])
    journal.close()
    third = makeup.run(session, datetime(2029, 5, 1, tzinfo=UTC))
    assert (third["missed"], third["recovered"], len(third["made_up"])) == (9, 4, 9)
    assert (
        makeup.sentences(third, SEATTLE.timezone)[0]
        == "9 slots missed, 0 of them already have a make-up slot; "
        "4 missed slots have been made up for"
    )


@pytest.mark.contract
def test_a_replan_killed_before_its_last_write_is_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = open_session(_session(tmp_path, daylight_hours([date(2027, 4, 10)], SEATTLE), 0))
    now = datetime(2027, 4, 12, tzinfo=UTC)

    def killed(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(makeup, "update_session", killed)
        with pytest.raises(KeyboardInterrupt):
            makeup.run(session, now)
    from fieldlum.session import sha256

    answer = makeup.run(session, now)
    assert answer["revision"] == 1 and not answer["made_up"]
    assert session.table()["plan"]["sha256"] == sha256(session.plan)


@pytest.mark.contract
def test_nothing_missed_is_nothing_to_do(tmp_path: Path) -> None:
    session = open_session(_session(tmp_path, daylight_hours([date(2027, 4, 10)], SEATTLE), 0))
    answer = makeup.run(session, datetime(2027, 4, 1, tzinfo=UTC))
    assert answer["missed"] == 0 and makeup.sentences(answer, SEATTLE.timezone) == [
        "no slot is missing; the plan is unchanged"
    ]


@pytest.mark.slow
@pytest.mark.contract
def test_command_best_and_replan(tmp_path: Path, weather: Weather) -> None:
    import tomli_w

    from fieldlum.optics.profiles import Bracket, CameraBody, CameraProfile, Lens

    profile = tmp_path / "camera.toml"
    save_profile(
        profile,
        CameraProfile(
            CameraBody("c", "raw", 9, 9),
            (Lens((4.0, 4.0), 4.0, 180.0),),
            Bracket(5.6, 100.0, (0.5, 0.01)),
        ),
    )
    site, file, out = tmp_path / "site.toml", tmp_path / "weather.csv", tmp_path / "s"
    site.write_text(tomli_w.dumps(site_table(_setup(str(profile)))))
    times = [t - timedelta(hours=8) for t in weather.t_utc]
    rows = zip(times, weather.dni_wm2, weather.dhi_wm2, strict=True)
    file.write_text(
        "month,day,hour,dni_wm2,dhi_wm2\n"
        + "".join(f"{t.month},{t.day},{t.hour}.5,{a:.1f},{b:.1f}\n" for t, a, b in rows)
    )
    start = (datetime.now(UTC) - timedelta(days=200)).strftime("%Y-%m-%d")

    def call(*words: object) -> dict:
        found = CliRunner().invoke(main, ["plan", *map(str, words), "--json"])
        assert found.exit_code == 0, found.output
        assert found.stdout.count("\n") == 1
        return json.loads(found.stdout)

    base = ("--year", "2027", "--weather", file)
    made = call(site, "--set", "even", "--count", "5", *base, "--out", out)
    assert made["slots"] == 5 and made["coverage"]["both_percent"] > 0
    assert (out / "plan.ics").exists() and (out / "plan.html").exists()
    past = call(site, "--set", "month", "--start", start, "--days", "1", "--out", tmp_path / "p")
    assert call(tmp_path / "p", "--replan")["missed"] == past["slots"]
    day = f"{datetime.fromisoformat(start) + timedelta(days=9):%Y-%m-%d}"
    before = open_session(tmp_path / "p").slots()
    added = call(tmp_path / "p", "--add", day)["added"]
    after = {slot.id: slot for slot in open_session(tmp_path / "p").slots()}
    assert added and {*after} == {*added} | {slot.id for slot in before}
    assert all(after[slot].exposures == before[0].exposures for slot in added)
    assert call(tmp_path / "p", "--add", day)["added"] == []
    replanned = call(tmp_path / "p", "--replan")
    assert replanned["missed"] == past["slots"], "an added day is missed by nobody"
    for wrong in ("2207-04-09", "0001-01-01"):
        done = CliRunner().invoke(main, ["plan", str(tmp_path / "p"), "--add", wrong])
        assert done.exit_code == 2 and "expected a year from 1950" in done.stderr
    assert len(open_session(tmp_path / "p").slots()) == len(after) + len(replanned["made_up"])
