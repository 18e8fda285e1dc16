"""What a predicted year depends on: it is predicted again, or named as outdated, after a change."""

import os
import shutil
import warnings
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from learning_room import SETUP, dataset, write_pairs
from msgspec import structs

from fieldlum.core.errors import Caution
from fieldlum.core.records import Exposure, Panorama, Slot
from fieldlum.learn import models
from fieldlum.optics.images import read_panorama, write_panorama
from fieldlum.optics.melanopic import attribute_text
from fieldlum.report.campaign import overview_of, read_campaign, write_overview
from fieldlum.report.export_and_pack import _notes
from fieldlum.report.sections import melanopic_shares, warnings_of
from fieldlum.session import Session, create_session
from fieldlum.session.files.predict_json import PredictFile
from fieldlum.year.glare.uncertainty_budget import BUDGET_FILE
from fieldlum.year.predict import newest_annual, outdated_text, run
from fieldlum.year.predict.hour_blocks import room_of
from fieldlum.year.predict.year import _notes as _year_notes

pytestmark = pytest.mark.contract

DATA = dataset(("2027-03-20", "2027-06-21"), height=8)
ZONE = DATA.setup.site.timezone
DAYS = tuple((month, day) for month in (3, 6) for day in (20, 21, 22))


def weather_file(path: Path, without: tuple[str, ...] = ()) -> Path:
    """Six days of hours with 500 W/m2 of sun and 150 of sky, without some (month,day,hour)."""
    rows = [
        f"{month},{day},{hour + 0.5},{500 * (6 <= hour < 18)},{150 * (6 <= hour < 18)}"
        for month, day in DAYS
        for hour in range(24)
    ]
    rows = [row for row in rows if not row.startswith(without)] if without else rows
    path.write_text("\n".join(["month,day,hour,dni_wm2,dhi_wm2", *rows]) + "\n")
    return path


def merge(
    session: Session, weight: float = 0.2, scale_percent: float = 2.0, vignetting_percent: float = 0
) -> None:
    """Write the session's grey pictures with colour weights and uncertainties of the camera."""
    text = attribute_text(np.array([weight, 0.5, 0.1]), np.eye(3), 0.03)
    about = {"melanopic": text, "u_percent": f"scale={scale_percent:g}"}
    about["u_percent"] += f" vignetting={vignetting_percent:g}"
    session.panoramas.mkdir(exist_ok=True)
    for path in session.root.glob("m*.exr"):
        light = read_panorama(path).luminance_cdm2
        rgb = np.repeat(light[..., None], 3, axis=2) / 179.0
        write_panorama(path, Panorama(light, DATA.heading_deg, rgb=rgb, attributes=about))
    shutil.copy(session.root / "m0.exr", session.panorama("20270320T160000Z"))


@pytest.fixture
def session(tmp_path: Path) -> Session:
    """Two models of a session whose pictures have colour."""
    slots = [Slot(t, 10.0, 180.0, (Exposure(0.1, 4.0),)) for t in DATA.light.t_utc]
    made = create_session(tmp_path / "office", SETUP, slots, {})
    write_pairs(made.root, DATA)
    merge(made)
    for name in ("nearest", "other"):
        models.save(made.models / name, models.fit("nearest", DATA, patch="none"), DATA)
    return made


@pytest.mark.slow
def test_a_recalibrated_camera_gives_another_year(session: Session, tmp_path: Path) -> None:
    """`predict` stated "nothing to do" after a new colour or uncertainty and another merge."""
    weather, folder = weather_file(tmp_path / "w.csv"), session.models / "nearest"
    first = run(folder, weather, views=2).annual
    assert not run(folder, weather, views=2).new and not outdated_text(session, first)
    merge(session, weight=0.6)
    assert outdated_text(session, first).startswith("Year nearest is of another model, calib")
    second, new = run(folder, weather, views=2)
    assert new and not outdated_text(session, second)
    of_map = [year.views["melanopic_edi_lx"] / year.views["ev_lx"] for year in (first, second)]
    assert np.median(of_map[1] / of_map[0]) == pytest.approx(1.2 / 0.8, rel=0.1)
    merge(session, weight=0.6, scale_percent=10.0)
    assert outdated_text(session, second)
    third, new = run(folder, weather, views=2)
    assert new and (second.summary.u_scale_rel, third.summary.u_scale_rel) == (0.02, 0.1)


def test_vignetting_differs_by_capture_and_is_in_the_budget(
    session: Session, tmp_path: Path
) -> None:
    """A later capture with another one does not outdate the year."""
    merge(session, vignetting_percent=1.0)
    year = run(session.models / "nearest", weather_file(tmp_path / "w.csv"), views=2).annual
    budget = (year.folder / BUDGET_FILE).read_text()
    assert "camera scale" in budget and "camera vignetting" in budget
    newest = session.panorama("20270320T160000Z")
    attributes = {"u_percent": "scale=2 vignetting=1.5"}
    write_panorama(newest, replace(read_panorama(newest), attributes=attributes))
    assert not outdated_text(session, year)
    write_panorama(newest, replace(read_panorama(newest), attributes={"u_percent": "scale=3"}))
    assert outdated_text(session, year)


def test_captures_that_were_added_do_not_make_a_year_outdated(
    session: Session, tmp_path: Path
) -> None:
    """They give another EDI, so `predict` predicts again."""
    weather, folder = weather_file(tmp_path / "w.csv"), session.models / "nearest"
    text = session.pairs.read_text()
    session.pairs.write_text("\n".join(text.splitlines()[:-1]) + "\n")
    year = run(folder, weather, views=2).annual
    session.pairs.write_text(text)
    assert not outdated_text(session, year) and run(folder, weather, views=2).new
    assert outdated_text(session, replace(year, summary=PredictFile(inputs={"colour": 3}))) == ""


@pytest.mark.slow
@pytest.mark.parametrize("option", ["occupancy_path", "lamps"])
def test_an_edited_file_of_hours_gives_another_year(
    session: Session, tmp_path: Path, option: str
) -> None:
    """With the same name and number of hours it was ignored."""
    weather, folder = weather_file(tmp_path / "w.csv"), session.models / "nearest"
    path, counts = tmp_path / "hours.csv", []
    given: dict[str, Any] = {option: path if option == "occupancy_path" else str(path)}
    for hours in ((2, 3), (9, 10)):
        cells = (str(int(hour % 24 in hours)) for hour in range(8760))
        path.write_text("occupied\n" + "\n".join(cells) + "\n")
        year, new = run(folder, weather, views=1, **given)
        assert new and not run(folder, weather, views=1, **given).new
        counts.append(year.summary.occupancy.lit)
    assert counts == ([0, 12] if option == "occupancy_path" else [60, 60])


def test_hours_without_weather_are_not_hours_without_melanopic_light(
    session: Session, tmp_path: Path
) -> None:
    """A day with a gap at 9 and one without light hours lowered the shares of the year."""
    gaps = [*(f"6,21,{h}." for h in range(9, 13)), *(f"6,22,{h}." for h in range(4, 22))]
    weather = weather_file(tmp_path / "w.csv", tuple(gaps))
    year = run(session.models / "nearest", weather, views=1).annual
    assert year.summary.days == 6 and year.summary.known == (13 * 5 - 4, 4)
    views = {"melanopic_edi_lx": 300.0, "u_melanopic_edi_lx": 0.0}
    bright = {name: np.full((len(year), 1), value) for name, value in views.items()}
    ((hours, days),) = melanopic_shares(replace(year, views=bright), ZONE)
    lit = sum(6 <= (t - timedelta(hours=8)).hour < 19 for t in year.t_utc)
    assert hours.value == pytest.approx(100.0 * lit / 61) and lit < 61
    assert [share.value for share in days] == [100.0] * 4
    earlier = replace(year, views=bright, summary=PredictFile(days=6))
    assert melanopic_shares(earlier, ZONE)[0][0].value == pytest.approx(100.0 * lit / 78)


def test_the_year_that_was_predicted_last_is_the_newest(session: Session, tmp_path: Path) -> None:
    """Also if there was nothing to do; the report names the others."""
    weather = weather_file(tmp_path / "w.csv")
    for name, seconds in (("nearest", 100), ("other", 200)):
        year = run(session.models / name, weather, views=1).annual
        os.utime(year.folder / "predict.json", (seconds, seconds))
    found = newest_annual(session)
    assert found is not None and found.folder.name == "other"
    assert not run(session.models / "nearest", weather, views=1).new
    found = newest_annual(session)
    assert found is not None and found.folder.name == "nearest"
    assert "Shown: year nearest; others: other." in warnings_of(session, found)


def test_an_outdated_year_is_never_used_silently(session: Session, tmp_path: Path) -> None:
    """As by export, compare, campaign and pack after another merge."""
    year = run(session.models / "nearest", weather_file(tmp_path / "w.csv"), views=1).annual
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert newest_annual(session) is not None
    assert not any("Year nearest" in note for note in _notes(session, ""))
    merge(session, weight=0.6)
    with pytest.warns(Caution, match="office: Year nearest is of another model"):
        newest_annual(session)
    assert outdated_text(session, year) in _notes(session, "")
    with pytest.warns(Caution):
        assert overview_of(tmp_path, "office").caution == outdated_text(session, year)
    (tmp_path / "C.toml").write_text('[[room]]\nsession = "office"\n')
    with pytest.warns(Caution):
        page, _ = write_overview(read_campaign(tmp_path / "C.toml"), tmp_path / "campaign")
    assert "office: Year nearest is of another model" in page.read_text("utf-8")


def test_weather_of_two_years_is_named(session: Session, tmp_path: Path) -> None:
    """Its hours were counted as those of one year."""
    folder = session.models / "nearest"
    summary = run(folder, weather_file(tmp_path / "w.csv"), views=1).annual.summary
    room = room_of(models.read_config(folder), folder)
    for days, named in ((367, False), (730, True)):
        notes = " ".join(_year_notes(structs.replace(summary, days=days), room, []))
        assert ("hours are counted over all 730 days" in notes) == named
