"""A campaign of rooms: independent, the broken one named, one page, one table of all hours."""

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest
from click.testing import CliRunner
from json_answers import WEATHER
from learning_room import dataset, write_pairs

from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.records import CameraSetup, Exposure, Room, SiteFile, Slot
from fieldlum.report.campaign import overview_of, read_campaign
from fieldlum.session import create_session

DATA = dataset(("2027-03-20", "2027-06-21"), height=8)


def campaign_file(folder: Path, text: str) -> Path:
    path = folder / "CAMPAIGN.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.contract
def test_keys_of_earlier_versions_are_read(tmp_path: Path) -> None:
    """Keys of earlier versions, which also ran the stages, are no error."""
    path = campaign_file(
        tmp_path,
        'name = "Lab"\n[common]\nmodel = "transport"\nviews = 4\n'
        '[[room]]\nsession = "a"\n[[room]]\nsession = "b"\nmodel = "dense"\nseed = 0\n',
    )
    assert read_campaign(path) == (path, "Lab", ("a", "b"))


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("rooms = 3\n", "unknown key 'rooms'"),
        ('name = "x"\n', r"no \[\[room\]\]"),
        ("[[room]]\nviews = 4\n", "no entry 'session'"),
        ('[[room]]\nsession = "a"\n[[room]]\nsession = "a"\n', "session a occurs twice"),
        ('[[room]]\nsesion = "a"\n', "did you mean 'session'"),
    ],
)
def test_a_wrong_campaign_file_is_one_line(tmp_path: Path, text: str, found: str) -> None:
    with pytest.raises(InputError, match=found):
        read_campaign(campaign_file(tmp_path, text))


@pytest.fixture
def three_rooms(tmp_path: Path) -> Path:
    """Return a campaign of a good session, a missing one and one whose session.toml is broken."""
    setup = SiteFile(DATA.setup.site, CameraSetup(heading_deg=180.0), Room())
    slots = [Slot(t, 10.0, 180.0, (Exposure(0.1, 4.0),)) for t in DATA.light.t_utc]
    session = create_session(tmp_path / "good", setup, slots, {"set": "test"})
    write_pairs(session.root, DATA)
    shutil.copytree(session.root, tmp_path / "broken")
    (tmp_path / "broken" / "session.toml").write_text("no toml [", encoding="utf-8")
    rooms = "".join(f'[[room]]\nsession = "{name}"\n' for name in ("good", "missing", "broken"))
    common = '[common]\nmodel = "nearest"\nweather = "synthetic"\nviews = 2\n'
    return campaign_file(tmp_path, common + rooms)


@pytest.mark.slow
@pytest.mark.contract
def test_a_broken_room_is_named_and_passed_over(three_rooms: Path, tmp_path: Path) -> None:
    good, weather = str(tmp_path / "good"), tmp_path / "weather.csv"
    weather.write_text(WEATHER, encoding="ascii")
    year = ["predict", f"{good}/models/nearest", "--weather", str(weather), "--views", "2"]
    for words in (["train", good, "--model", "nearest"], year):
        assert CliRunner().invoke(main, words).exit_code == 0
    result = CliRunner().invoke(main, ["campaign", "report", str(three_rooms), "--json"])
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert answer["passed_over"] == ["missing", "broken"]
    page = (tmp_path / "campaign" / "index.html").read_text(encoding="utf-8")
    assert "missing was skipped" in page and "worst direction" in page
    assert "glare: 0 of 1; 1 cannot be decided yet." in page  # nearest states no uncertainty


@pytest.mark.contract
def test_a_missed_slot_is_not_to_be_captured(tmp_path: Path) -> None:
    times = (datetime(2020, 3, 1, 20, tzinfo=UTC), datetime(2090, 3, 1, 20, tzinfo=UTC))
    slots = [Slot(t, 30.0, 180.0, (Exposure(0.1, 4.0),)) for t in times]
    create_session(tmp_path / "a", SiteFile(DATA.setup.site, CameraSetup()), slots, {})
    campaign = read_campaign(campaign_file(tmp_path, '[[room]]\nsession = "a"\n'))
    room = overview_of(tmp_path, campaign.sessions[0])
    assert (room.broken, room.planned, room.captured, room.to_do) == ("", 2, 0, 1)
