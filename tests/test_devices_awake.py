"""A computer that falls asleep: held awake where the system grants it, and let go however the
holder ends.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from fieldlum.devices.awake import kept_awake

pytestmark = [
    pytest.mark.contract,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="systemd-inhibit"),
]


@pytest.fixture
def tool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A stand-in for systemd-inhibit that grants what its first lines say, and notes its
    process.
    """
    path = tmp_path / "systemd-inhibit"
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    return path


def write(tool: Path, granted: str) -> Path:
    note = tool.with_name("pid")
    tool.write_text(
        f'#!/bin/sh\ncase "$1" in {granted}) echo $$ > {note}; exec cat;; *) exit 1;; esac\n'
    )
    tool.chmod(0o755)
    return note


def runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().split()[2] != "Z"
    except FileNotFoundError:
        return False


def gone(pid: int) -> bool:
    for _ in range(100):
        if not runs(pid):
            return True
        time.sleep(0.05)
    return False


@pytest.mark.parametrize(
    ("granted", "what"),
    [
        ("--what=*", "sleep:idle:handle-lid-switch"),
        ("--what=sleep:idle", "sleep:idle"),
        ("nothing", ""),
    ],
)
def test_the_widest_lock_that_is_granted_is_held_and_let_go(
    tool: Path, granted: str, what: str
) -> None:
    note = write(tool, granted)
    with kept_awake() as held:
        assert held == what
        assert not what or runs(int(note.read_text()))
    assert not what or gone(int(note.read_text()))


def test_without_the_tool_nothing_is_held(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with kept_awake() as held:
        assert held == ""


def test_a_lock_goes_with_a_process_that_is_killed(tool: Path) -> None:
    note = write(tool, "--what=*")
    code = (
        "import time\nfrom fieldlum.devices.awake import kept_awake\n"
        "with kept_awake() as what: print(what, flush=True); time.sleep(60)"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, env=dict(os.environ)
    )
    assert process.stdout is not None and process.stdout.readline().startswith(b"sleep")
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert gone(int(note.read_text()))
