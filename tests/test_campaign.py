"""A campaign of rooms: independent, the broken one named, one page, one table of all hours."""

import json
import shutil
from datetime import UTC, datetime
from pathlib import Path

import pytest
from click.testing import CliRunner
from learning_room import dataset, write_pairs

from fieldlum.cli import main
from fieldlum.core.errors import InputError
from fieldlum.core.records import CameraSetup, Exposure, Room, SiteFile, Slot
from fieldlum.learn.models import read_config
from fieldlum.learn.models.data import load_pairs
from fieldlum.report.campaign import overview_of, read_campaign
from fieldlum.room.fit.scene_file import Scene, write_scene
from fieldlum.session import create_session

DATA = dataset(("2027-03-20", "2027-06-21"), height=8)


def campaign_file(folder: Path, text: str) -> Path:
    path = folder / "CAMPAIGN.toml"
    path.write_text(text, encoding="utf-8")
    return path


def stage_results(stage: str, path: Path) -> dict[str, dict[str, str]]:
    result = CliRunner().invoke(main, ["campaign", stage, str(path), "--json"])
    return {room["session"]: room for room in json.loads(result.stdout)["rooms"]}


@pytest.mark.contract
def test_values_come_from_the_room_then_from_common(tmp_path: Path) -> None:
    path = campaign_file(
        tmp_path,
        'name = "Lab"\n[common]\nmodel = "transport"\nviews = 4\n'
        '[[room]]\nsession = "a"\n[[room]]\nsession = "b"\nviews = 6\n',
    )
    found = read_campaign(path)
    assert [room.session for room in found.rooms] == ["a", "b"]
    assert [room.views for room in found.rooms] == [4, 6]
    assert {room.model for room in found.rooms} == {"transport"}
    assert found.file(found.rooms[0].session) == tmp_path / "a"


@pytest.mark.contract
def test_a_stated_zero_is_not_replaced_by_common(tmp_path: Path) -> None:
    text = '[common]\nseed = 5\nset = ""\n[[room]]\nsession = "a"\nseed = 0\n'
    room = read_campaign(campaign_file(tmp_path, text)).rooms[0]
    assert (room.seed, room.set) == (0, "9-day")


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('[[room]]\nsession = "a"\nbudget_min = 0\n', "budget_min = 0; expected a number above 0"),
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
    for stage in ("status", "train", "predict"):
        results = stage_results(stage, three_rooms)
        assert results["good"]["state"] == "done", results["good"]["text"]
        assert results["missing"]["state"] == "failed"
        assert stage != "status" or "no session.toml" in results["missing"]["text"]
        assert stage == "train" or results["broken"]["state"] == "failed"
    result = CliRunner().invoke(main, ["campaign", "report", str(three_rooms), "--json"])
    assert result.exit_code == 0, result.output
    answer = json.loads(result.stdout)
    assert answer["passed_over"] == ["missing", "broken"]
    page = (tmp_path / "campaign" / "index.html").read_text(encoding="utf-8")
    assert "missing was skipped" in page and "worst direction" in page


@pytest.mark.contract
def test_a_missed_slot_is_not_to_be_captured(tmp_path: Path) -> None:
    times = (datetime(2020, 3, 1, 20, tzinfo=UTC), datetime(2090, 3, 1, 20, tzinfo=UTC))
    slots = [Slot(t, 30.0, 180.0, (Exposure(0.1, 4.0),)) for t in times]
    create_session(tmp_path / "a", SiteFile(DATA.setup.site, CameraSetup()), slots, {})
    campaign = read_campaign(campaign_file(tmp_path, '[[room]]\nsession = "a"\n'))
    room = overview_of(campaign, campaign.rooms[0])
    assert (room.broken, room.planned, room.captured, room.to_do) == ("", 2, 0, 1)


@pytest.mark.slow
@pytest.mark.contract
def test_a_room_is_trained_with_the_scene_of_its_session(three_rooms: Path, tmp_path: Path) -> None:
    data = load_pairs(tmp_path / "good")
    assert data.setup.room is not None
    heading_deg, room = data.heading_deg, data.setup.room
    scene = Scene(1.0, 2.0, room, "none", "no patch", heading_deg, room)
    write_scene(tmp_path / "good" / "scene", scene)
    results = stage_results("train", three_rooms)
    assert results["good"]["state"] == "done", results["good"]["text"]
    trained = read_config(tmp_path / "good" / "models" / "nearest")
    assert trained.scene is not None and trained.scene["chosen"] == "none"


@pytest.mark.contract
def test_the_command_exits_with_3_when_a_room_was_passed_over(tmp_path: Path) -> None:
    path = campaign_file(tmp_path, '[[room]]\nsession = "missing"\n')
    result = CliRunner().invoke(main, ["campaign", "status", str(path)])
    assert result.exit_code == 3
    assert result.stdout.startswith("missing failed: ") and "no session.toml" in result.stdout


@pytest.mark.slow
@pytest.mark.contract
def test_a_room_without_a_session_is_planned(tmp_path: Path) -> None:
    text = '[site]\nname = "Here"\nlatitude_deg = 51.5\nlongitude_deg = 0.0\ntimezone = "UTC"\n'
    (tmp_path / "site.toml").write_text(text)
    path = campaign_file(
        tmp_path, '[common]\nset = "4-day"\n[[room]]\nsession = "a"\nsite = "site.toml"\n'
    )
    first, again = (stage_results("plan", path)["a"]["text"] for _ in range(2))
    assert "slots" in first and again == "already done"
    assert (tmp_path / "a" / "plan.csv").is_file()
