"""A session on a read-only disk: stages say so before they compute, with a real file system."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from learning_room import dataset

from fieldlum.core.errors import InputError
from fieldlum.core.progress import shown_by
from fieldlum.learn import train
from fieldlum.session import check_writable

pytestmark = pytest.mark.contract

KEPT = Path(__file__).parent / "fixtures" / "session-0.1.0"


def on_a_read_only_disk(session: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run fieldlum while the session's folder is mounted read-only."""
    words = f'mount --bind "{session}" "{session}" && mount -o remount,ro,bind "{session}"'
    program = [sys.executable, "-c", "from fieldlum.cli import main; main()", *arguments]
    command = ["unshare", "-rm", "sh", "-c", f'{words} && exec "$0" "$@"', *program]
    try:
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        pytest.skip("no unshare here")
    if "fieldlum" not in ran.stderr + ran.stdout:
        pytest.skip(f"no file system of one's own here: {ran.stderr.strip()[:100]}")
    return ran


@pytest.mark.slow
def test_train_says_at_once_that_the_disk_is_read_only(tmp_path: Path) -> None:
    session = tmp_path / "session"
    shutil.copytree(KEPT, session)
    ran = on_a_read_only_disk(session, "train", str(session), "--model", "nearest", "--force")
    assert ran.returncode == 3, ran.stderr
    last = ran.stderr.strip().splitlines()[-1]
    assert last == (
        f"fieldlum train: {session}: Read-only file system; "
        "expected a place open to you; change its permissions, or choose another place"
    )


def test_train_asks_before_it_computes(tmp_path: Path) -> None:
    (tmp_path / "model").write_text("")
    told: list[str] = []
    data = dataset(("2027-03-20", "2027-06-21"), height=8)
    with pytest.raises(NotADirectoryError), shown_by(lambda done, total, text: told.append(text)):
        train.run(data, "nearest", out=tmp_path / "model" / "x")
    assert told == []


def test_a_link_to_a_disk_that_is_not_there_is_refused(tmp_path: Path) -> None:
    (tmp_path / "usb").symlink_to(tmp_path / "unmounted")
    with pytest.raises(InputError, match="mount the disk"):
        check_writable(tmp_path / "usb" / "model")


def test_nothing_remains_of_the_test(tmp_path: Path) -> None:
    check_writable(tmp_path / "a" / "b")
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "model").write_text("")
    with pytest.raises(NotADirectoryError, match="model"):
        check_writable(tmp_path / "model" / "x")
