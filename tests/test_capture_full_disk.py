"""Capture on a file system that really gets full: what is acknowledged stays, and a slot is taken
within its window.

The scenario runs in a process of its own, on a memory file system that it may mount as root of a
namespace of its own.
"""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from tiny_field import FAST, T0, Field, TinyCamera, make_session

from fieldlum.core.records import Exposure
from fieldlum.devices.clock import FastClock
from fieldlum.session import day_files, read_day, read_journal, sha256
from fieldlum.session.slot_states import apply_events

pytestmark = pytest.mark.property

FRAME_BYTES, RESERVE_BYTES = 100_000, 1 << 18


class Ballast:
    """Somebody else's file, which takes all the room there is until it goes."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def fill(self) -> None:
        with self.path.open("wb", buffering=0) as file:
            try:
                while True:
                    file.write(bytes(4096))
            except OSError:
                return


class BigCamera(TinyCamera):
    """Frames of a size that matters; `fault` comes before each."""

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        written = super().expose(exposure, target)
        with written.open("ab") as file:
            file.write(bytes(FRAME_BYTES))
        return written


def scenario(folder: Path, frame: int, seconds: float) -> dict[str, Any]:
    """Three slots; before frame number `frame` the disk is filled, and `seconds` later there is
    room again.
    """
    field, ballast = (
        Field(make_session(folder / "s"), FastClock(T0 - timedelta(minutes=5))),
        Ballast(folder / "ballast"),
    )
    until = [field.clock.boottime()]

    def fault(count: int) -> None:
        if count == frame and not ballast.path.exists():
            ballast.fill()
            until[0] = field.clock.boottime() + seconds

    def passing(wait_s: float, sleep: Any = field.clock.sleep) -> None:
        sleep(wait_s)
        if ballast.path.exists() and field.clock.boottime() >= until[0]:
            ballast.path.unlink()

    field.clock.sleep = passing  # type: ignore[method-assign]
    made: list[BigCamera] = []

    def open_camera() -> BigCamera:
        made.append(BigCamera(field.clock, fault, sum(camera.count for camera in made)))
        return made[-1]

    events = field.run(replace(FAST, reserve_bytes=RESERVE_BYTES), open_cam=open_camera)
    states = apply_events(read_journal(field.session))
    acknowledged = [
        e["frame"]["sha256"] for e in read_journal(field.session) if e["event"] == "frame"
    ]
    on_disk = sorted(sha256(path) for path in field.session.raw.rglob("*.dng"))
    return {
        "outcomes": field.outcomes(),
        "why": [states.slots[slot.id].why for slot in field.session.slots()],
        "lost": sorted(set(acknowledged) - set(on_disk)),
        "strays": sorted(set(on_disk) - set(acknowledged)),
        "half": [str(path) for path in field.session.raw.rglob(".*")],
        "disk_full": events.count("disk-full"),
        "device_lost": events.count("device-lost"),
        "rows_broken": sum(read_day(path)[1] for path in day_files(field.session)),
        "rows": sum(len(read_day(path)[0]) for path in day_files(field.session)),
        "reserve": (field.session.root / ".reserve").exists(),
    }


def on_a_small_disk(tmp_path: Path, frame: int, seconds: float) -> dict[str, Any]:
    place = tmp_path / "disk"
    place.mkdir()
    words = f'mount -t tmpfs -o size=4m tmpfs "{place}" && exec "$0" "$@"'
    command = [
        "unshare",
        "-rm",
        "sh",
        "-c",
        words,
        sys.executable,
        __file__,
        str(place),
        str(frame),
        str(seconds),
    ]
    try:
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError:
        pytest.skip("no unshare here")
    if ran.returncode and "Traceback" not in ran.stderr:
        pytest.skip(f"no file system of one's own here: {ran.stderr.strip()[:100]}")
    assert ran.returncode == 0, ran.stderr
    return json.loads(ran.stdout)


def kept(told: dict[str, Any]) -> bool:
    """Nothing acknowledged is lost, nothing half is left, the failure is told once, and no
    device is blamed.
    """
    sound = not (
        told["lost"] or told["strays"] or told["half"] or told["rows_broken"] or told["device_lost"]
    )
    return sound and told["disk_full"] == 1 and not told["reserve"]


@pytest.mark.slow
def test_a_frame_that_meets_the_full_disk_first_is_taken_in_the_reserve(
    tmp_path: Path,
) -> None:
    told = on_a_small_disk(tmp_path, 6, 3000.0)
    assert kept(told) and told["outcomes"] == ["done", "done", "done"]


@pytest.mark.slow
def test_a_slot_waits_for_room_within_its_window(tmp_path: Path) -> None:
    told = on_a_small_disk(tmp_path, 4, 120.0)
    assert kept(told) and told["outcomes"] == ["done", "done", "done"]


@pytest.mark.slow
def test_without_room_the_slot_is_given_up_and_says_how_much_is_missing(
    tmp_path: Path,
) -> None:
    told = on_a_small_disk(tmp_path, 4, 1800.0)
    assert kept(told) and told["outcomes"] == ["done", "aborted", "done"]
    assert "MB of free space are missing" in told["why"][1]


if __name__ == "__main__":
    print(json.dumps(scenario(Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3]))))
