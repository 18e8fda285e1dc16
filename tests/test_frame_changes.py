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
from fieldlum.core.records import CameraSetup, Exposure, Site, SiteFile, Slot
from fieldlum.optics.profiles import save_profile
from fieldlum.session import Session, create_session, sha256


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
