"""Frames that changed after the capture: the bracket is refused by name, the others are merged."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from click.testing import CliRunner
from test_merge_stage import SMALL, START, profile, take

from fieldlum import merge
from fieldlum.cli import main
from fieldlum.core.errors import ChangedFileWarning
from fieldlum.core.records import CameraSetup, Exposure, Site, SiteFile, Slot
from fieldlum.optics.profiles import save_profile
from fieldlum.session import Session, create_session, sha256, update_session


def recorded(session: Session, number: int) -> Path:
    """Take a bracket whose capture.json has the sha256 of each frame; return its folder."""
    folder = session.raw / take(session, number)
    note = json.loads((folder / "capture.json").read_text())
    for frame in note["frames"]:
        frame["sha256"] = sha256(folder / frame["file"])
    (folder / "capture.json").write_text(json.dumps(note), encoding="utf-8")
    return folder


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Session, Path, Path]:
    save_profile(tmp_path / "small.toml", profile())
    setup = SiteFile(Site("here", 51.5, 0.0), CameraSetup(str(tmp_path / "small.toml"), 180.0))
    slot = Slot(START, 10.0, 180.0, (Exposure(0.1, 4.0),))
    session = create_session(tmp_path / "s", setup, [slot], {})
    return session, recorded(session, 0), recorded(session, 1)


def states(session: Session, *, force: bool = False) -> list[str]:
    return [v.state for v in merge.run(session, SMALL, force=force)]


def one_bit(frame: Path) -> None:
    data = bytearray(frame.read_bytes())
    data[-100] ^= 1
    frame.write_bytes(data)


def cut_short(frame: Path) -> None:
    frame.write_bytes(frame.read_bytes()[:-200])


def exchanged(frame: Path) -> None:
    other = frame.with_name("2.dng")
    content = frame.read_bytes()
    shutil.copy(other, frame)
    other.write_bytes(content)


@pytest.mark.contract
@pytest.mark.parametrize("damage", [one_bit, cut_short, exchanged])
def test_a_changed_frame_is_refused_by_name_and_merged_once_restored(
    folders: tuple[Session, Path, Path], damage: Callable[[Path], None]
) -> None:
    session, folder, _ = folders
    copy = shutil.copytree(folder, folder.parent.parent / "copy")
    damage(folder / "1.dng")
    first, second = merge.run(session, SMALL)
    assert (first.state, second.state) == ("failed", "merged")
    assert "1.dng" in first.text and "changed after capture or import" in first.text
    assert not session.panorama(folder.name).exists()
    shutil.copytree(copy, folder, dirs_exist_ok=True)
    assert states(session) == ["merged", "kept"]


@pytest.mark.contract
def test_a_frame_that_changes_after_the_merge_is_noticed(
    folders: tuple[Session, Path, Path],
) -> None:
    session, folder, _ = folders
    assert states(session) == ["merged", "merged"]
    one_bit(folder / "1.dng")
    assert states(session) == ["failed", "kept"]
    assert states(session, force=True) == ["failed", "merged"]
    assert session.panorama(folder.name).exists(), "the earlier panorama has the right frames"
    one_bit(folder / "1.dng")
    assert states(session) == ["kept", "kept"]


@pytest.mark.contract
@pytest.mark.parametrize("key", ["shutter_s", "f_number", "iso"])
def test_an_exposure_that_changes_after_the_merge_is_merged_again(
    folders: tuple[Session, Path, Path], key: str
) -> None:
    session, folder, _ = folders
    assert states(session) == ["merged", "merged"]
    path = folder / "capture.json"
    note = json.loads(path.read_text())
    for frame in note["frames"]:
        frame["exposure"][key] = 1.05 * frame["exposure"].get(key, 100.0)
    path.write_text(json.dumps(note), encoding="utf-8")
    assert states(session)[0] != "kept"


@pytest.mark.contract
@pytest.mark.parametrize("key, value", [("latitude_deg", 51.6), ("longitude_deg", 1.0)])
def test_another_place_of_the_site_is_merged_again(
    folders: tuple[Session, Path, Path], key: str, value: float
) -> None:
    session, _, _ = folders
    states(session)
    setup = session.table().get("setup", {})
    update_session(session, {"setup": {**setup, "site": {**setup["site"], key: value}}})
    assert states(session) == ["merged", "merged"]
    assert states(session) == ["kept", "kept"]


@pytest.mark.contract
def test_a_changed_summary_is_reported(folders: tuple[Session, Path, Path]) -> None:
    session, _, _ = folders
    states(session)
    session.quality.write_text(session.quality.read_text().replace(",3,", ",4,"))
    with pytest.warns(ChangedFileWarning, match=r"quality\.csv: the content changed after"):
        states(session)


@pytest.mark.slow
@pytest.mark.contract
def test_merge_exits_with_3_if_a_bracket_failed(folders: tuple[Session, Path, Path]) -> None:
    session, folder, _ = folders
    one_bit(folder / "1.dng")
    command = ["merge", str(session.root), "--size", "32x16"]
    result = CliRunner().invoke(main, command)
    assert result.exit_code == 3 and "1 merged, 1 failed" in result.stderr
    assert CliRunner().invoke(main, [*command, "--json"]).exit_code == 3
    note = json.loads((folder / "capture.json").read_text())
    note["frames"].pop(1)
    (folder / "capture.json").write_text(json.dumps(note), encoding="utf-8")
    assert CliRunner().invoke(main, command).exit_code == 0, "as the error advises"
