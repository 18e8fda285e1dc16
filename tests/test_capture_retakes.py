"""Capture: each frame is checked at once and taken again once."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tiny_field import FAST, LADDER, Field, make_session

from fieldlum.capture.bracket import FrameChecks
from fieldlum.capture.frame_checks import compare_exif
from fieldlum.capture.notify import Alerts, Message
from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure, Panorama
from fieldlum.devices import Camera
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated.camera import SimulatedCamera
from fieldlum.optics.profiles import load_camera_profile
from fieldlum.session import (
    read_journal,
    sha256,
)
from fieldlum.session.files.capture_json import CaptureFile
from fieldlum.session.slot_states import apply_events, captured_ids

EVEN_LIGHT = Panorama(np.full((46, 92), 100.0, np.float32), 180.0)


class SlippingCamera(Camera):
    """The simulated camera, whose dial slips to twice the time at the frames in `slips` (counted
    from 1).
    """

    def __init__(self, clock: FastClock, slips: set[int]) -> None:
        world = SimpleNamespace(scene=lambda t_utc: EVEN_LIGHT)
        self._camera = SimulatedCamera(world, load_camera_profile("sim-fisheye"), clock)  # type: ignore[arg-type]
        self._slips, self.count, self.info = slips, 0, self._camera.info

    def expose(self, exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        self.count += 1
        slip = 2.0 if self.count in self._slips else 1.0
        return self._camera.expose(replace(exposure, shutter_s=slip * exposure.shutter_s), target)

    def close(self) -> None:
        self._camera.close()


@pytest.mark.slow
@pytest.mark.contract
def test_a_frame_unlike_what_was_asked_is_taken_again_once(rig: Field) -> None:
    camera = SlippingCamera(rig.clock, {2})
    rig.session = make_session(rig.session.root.parent / "one", slots=1)
    events = rig.run(open_cam=lambda: camera, checks=FrameChecks(compare_exif))
    assert rig.outcomes() == ["done"] and camera.count == 4 and events.count("frame") == 3
    journal = read_journal(rig.session)
    told = next(e for e in journal if e["event"] == "retake")
    assert (
        told["why"] == "shutter 1 instead of 0.5" and told["frame"]["instead_of"] == "01_0.5s.dng"
    )
    assert (
        next(e for e in journal if e["event"] == "done")["why"] == "01_0.5s_again.dng taken again"
    )
    folder = rig.session.raw / rig.session.slots()[0].id
    frames = json.loads((folder / "capture.json").read_text())["frames"]
    assert [f["file"] for f in frames] == ["00_1s.dng", "01_0.5s_again.dng", "02_0.25s.dng"]
    assert not any("doubt" in f for f in frames) and all(
        sha256(folder / f["file"]) == f["sha256"] for f in frames
    )
    assert compare_exif(folder / "01_0.5s.dng", LADDER[1])[0] == "shutter 1 instead of 0.5", (
        "the first file is kept"
    )
    assert sorted(f.instead_of for f in apply_events(journal).slots[folder.name].frames) == [
        "",
        "",
        "01_0.5s.dng",
    ]


@pytest.mark.slow
@pytest.mark.contract
def test_a_camera_set_wrongly_is_not_asked_twice_for_every_frame(rig: Field) -> None:
    camera = SlippingCamera(rig.clock, set(range(100)))
    rig.session = make_session(rig.session.root.parent / "one", slots=1)
    rig.run(open_cam=lambda: camera, checks=FrameChecks(compare_exif))
    assert camera.count == 4, "one retake, in vain: the rest of the bracket is not taken twice"
    why = next(e for e in read_journal(rig.session) if e["event"] == "done")["why"]
    assert why.count("instead of") == 3 and "taken again" not in why
    frames = json.loads((rig.session.raw / rig.session.slots()[0].id / "capture.json").read_text())[
        "frames"
    ]
    assert [f["exposure"]["shutter_s"] for f in frames] == [2.0, 1.0, 0.5], (
        "merge reads the exposure that they have"
    )


@pytest.mark.contract
def test_half_a_frame_is_seen_at_once_and_taken_again(rig: Field) -> None:
    """Its EXIF is whole: only its pixels end early. It is looked at when the camera is done."""
    seen: list[str] = []

    def opens(path: Path) -> str:
        seen.append(path.name)
        return (
            "its pixels end later"
            if seen.count("01_0.5s.dng") == 1 and path.name == "01_0.5s.dng"
            else ""
        )

    events = rig.run(checks=FrameChecks(pixels=opens))
    assert rig.outcomes() == ["done"] * 3 and events.count("retake") == 1
    folder = rig.session.raw / rig.session.slots()[0].id
    frames = json.loads((folder / "capture.json").read_text())["frames"]
    assert [f["file"] for f in frames] == ["00_1s.dng", "01_0.5s_again.dng", "02_0.25s.dng"]
    assert (folder / "01_0.5s.dng").exists() and "doubt" not in frames[1]


@pytest.mark.contract
def test_pictures_that_nothing_here_reads_are_not_taken_twice_each(rig: Field) -> None:
    """A camera newer than LibRaw: one second try, in vain, and every file stays. The slot has no
    bracket that can be merged, so it is aborted, for make-up slots and alerts.
    """
    rig.session = make_session(rig.session.root.parent / "one", slots=1)
    events = rig.run(checks=FrameChecks(pixels=lambda path: "an unknown format"))
    assert events.count("retake") == 1 and rig.cameras[0].count == 4
    told = next(e for e in read_journal(rig.session) if e["event"] == "aborted")["why"]
    assert told == "3 of 3 frames cannot be read: 00_1s_again.dng: an unknown format"
    folder = rig.session.raw / rig.session.slots()[0].id
    frames = CaptureFile.read(folder / "capture.json").frames
    assert all((folder / f.file).is_file() and f.doubt for f in frames) and len(frames) == 3


@pytest.mark.contract
def test_brackets_that_cannot_be_read_count_as_misses(rig: Field) -> None:
    told: list[Message] = []
    alerts = Alerts("office", "UTC", told.append)
    rig.run(
        checks=FrameChecks(pixels=lambda path: "" if path.name.startswith("00") else "no raw file"),
        listen=alerts.listen,
    )
    assert rig.outcomes() == ["aborted"] * 3
    assert [m.title for m in told] == ["fieldlum office: 2 slots in a row gave no bracket"]
    assert not captured_ids(rig.session), "--replan adds make-up slots for them"


@pytest.mark.slow
@pytest.mark.contract
def test_no_retake_after_the_window(rig: Field) -> None:
    camera = SlippingCamera(rig.clock, {2})
    rig.session = make_session(rig.session.root.parent / "one", slots=1)
    events = rig.run(
        replace(FAST, grace_s=4.0), open_cam=lambda: camera, checks=FrameChecks(compare_exif)
    )
    assert "retake" not in events and rig.outcomes() == ["done"] and camera.count == 3


@pytest.mark.slow
@pytest.mark.contract
def test_a_camera_that_fails_at_the_retake_costs_nothing(rig: Field) -> None:
    camera = SlippingCamera(rig.clock, {2})
    whole = camera.expose

    def expose(exposure: Exposure, target: Path, *, heading_deg: float | None = None) -> Path:
        if camera.count == 2:
            camera.count += 1
            raise DeviceError("gone")
        return whole(exposure, target)

    camera.expose = expose
    rig.session = make_session(rig.session.root.parent / "one", slots=1)
    events = rig.run(open_cam=lambda: camera, checks=FrameChecks(compare_exif))
    assert "retake" not in events and "device-lost" in events and rig.outcomes() == ["done"]


@pytest.mark.contract
def test_a_bracket_that_clips_all_over_is_told_at_once(rig: Field) -> None:
    looked: list[str] = []

    def clipped(path: Path) -> str:
        looked.append(path.name)
        return "97 % of the shortest exposure's pixels are clipped"

    rig.run(
        checks=FrameChecks(
            lambda path, asked: ("ISO 200 instead of 100" if asked.shutter_s == 1 else "", asked),
            darkest=clipped,
        ),
    )
    done = [e for e in read_journal(rig.session) if e["event"] == "done"]
    assert looked == ["02_0.25s.dng"] * 3
    assert "00_1s_again.dng: ISO 200" in done[0]["why"] and "97 %" in done[0]["why"]


@pytest.mark.contract
def test_frames_are_checked_against_what_was_asked(tmp_path: Path) -> None:
    import numpy as np

    from fieldlum.capture.frame_checks import clipping_text, compare_exif
    from fieldlum.optics.raw import unreadable
    from fieldlum.optics.raw.writing import write_dng, write_jpeg

    asked = Exposure(1 / 250, 5.6)
    grey, white = np.full((16, 16, 3), 90, np.uint8), np.full((16, 16, 3), 255, np.uint8)
    write_jpeg(tmp_path / "a.jpg", grey, asked)
    write_jpeg(tmp_path / "b.jpg", white, Exposure(1 / 200, 5.6))
    assert compare_exif(tmp_path / "a.jpg", asked)[0] == "" == clipping_text(tmp_path / "a.jpg")
    assert "shutter 0.005 instead of 0.004" in compare_exif(tmp_path / "b.jpg", asked)[0]
    assert clipping_text(tmp_path / "b.jpg").startswith("100 % of the shortest exposure")
    counts = np.full((48, 48), 16383, np.uint16)
    write_dng(tmp_path / "c.dng", counts, asked, black_dn=(64.0,) * 4, white_dn=16383.0)
    assert compare_exif(tmp_path / "c.dng", asked)[0] == "" and "clipped" in clipping_text(
        tmp_path / "c.dng"
    )
    (tmp_path / "d.dng").write_bytes((tmp_path / "c.dng").read_bytes()[:300])
    assert compare_exif(tmp_path / "d.dng", asked)[0] or clipping_text(tmp_path / "d.dng")
    for name in ("a.jpg", "c.dng"):
        whole = (tmp_path / name).read_bytes()
        (tmp_path / f"half_{name}").write_bytes(whole[: len(whole) - len(whole) // 4])
        assert unreadable(tmp_path / name) == ""
        assert unreadable(tmp_path / f"half_{name}")
    assert unreadable(tmp_path / "gone.dng") == "No such file or directory"
