"""`rpicam:` against a stand-in for rpicam-still that answers as the real program does."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_field import FAST, T0, Field, make_session

from fieldlum.capture.bracket import FrameChecks
from fieldlum.capture.frame_checks import compare_exif
from fieldlum.core.errors import DeviceError, InputError
from fieldlum.core.records import CameraSetup, Exposure
from fieldlum.devices import open_camera
from fieldlum.devices.clock import Clock, FastClock
from fieldlum.devices.rpicam import RpicamCamera, parse_cameras, parse_metadata
from fieldlum.optics.profiles import load_camera_profile
from fieldlum.optics.raw import read_exif, read_mosaic
from fieldlum.optics.raw.writing import write_dng
from fieldlum.session import disk_is_full, read_journal
from fieldlum.session.files.capture_json import CaptureFile

pytestmark = [
    pytest.mark.contract,
    pytest.mark.skipif(sys.platform == "win32", reason="rpicam-still is a Linux program"),
]

MARK_S = 0.123457  # exposure of the template; the stand-in replaces it
LIST = """Available cameras
-----------------
0 : imx477 [4056x3040 12-bit RGGB] (/base/soc/i2c0mux/i2c@1/imx477@1a)
    Modes: 'SRGGB12_CSI2P' : 2028x1520 [40.01 fps - (0, 0)/4056x3040 crop]
                             4056x3040 [10.00 fps - (0, 0)/4056x3040 crop]
"""
# The metadata's form is that of rpicam-apps (issues 297 and AllskyTeam/allsky 2909).
STAND_IN = """#!{python} -SE
import json, os, struct, sys, time
here = os.path.dirname(os.path.abspath(__file__))
mode = open(here + "/mode").read().strip() if os.path.exists(here + "/mode") else ""
with open(here + "/calls", "a") as calls:
    calls.write(" ".join(sys.argv[1:]) + "\\n")
if mode == "hangs":
    time.sleep(600)
if mode == "in-use":
    sys.exit("ERROR: *** failed to acquire camera imx477: "
        "Pipeline handler in use by another process ***")
if mode == "crash":
    os.abort()
if mode == "old":
    sys.exit("ERROR: *** unrecognised option '--metadata' ***")
if "--list-cameras" in sys.argv:
    print("No cameras available!" if mode == "none" else open(here + "/list").read())
    sys.exit(0)
asked = dict(zip(sys.argv[1:], sys.argv[2:]))
us, gain = int(asked["--shutter"]), float(asked["--gain"])
line = 114 / 6
real = min(max(114, round(round(us / line) * line)), 2_000_000)
digital = 4.0 if real < us / 1.2 else 1.000017
about = {{"ExposureTime": real, "FocusFoM": 272, "AnalogueGain": gain, "FrameDuration": real + 130,
    "Lux": 0.6, "AeLocked": False, "ColourGains": [1.0, 1.0], "DigitalGain": digital,
    "SensorBlackLevels": [4096, 4096, 4096, 4096], "SensorTimestamp": 12983988312000}}
changes = {{"gain": ("AnalogueGain", 2.0), "zero": ("ExposureTime", 0),
    "negative": ("ExposureTime", -5),
    "word": ("ExposureTime", "auto"), "null": ("AnalogueGain", None),
    "nan": ("ExposureTime", float("nan")),
    "infinite": ("AnalogueGain", float("inf")), "list": ("ExposureTime", [1])}}
if mode in changes:
    about[changes[mode][0]] = changes[mode][1]
if mode in ("ExposureTime", "AnalogueGain"):
    del about[mode]
text = json.dumps(about)
others = {{"half": text[:40], "empty-json": "", "array": "[1, 2]", "binary": "\\0\\1"}}
text = others.get(mode, text)
if mode != "no-metadata":
    open(asked["--metadata"], "w").write(text)
out = asked["--output"]
if mode == "full":
    sys.exit("ERROR: *** failed to write DNG: No space left on device ***")
data = open(here + "/template.dng", "rb").read()
shown = {{"exif": real * 2}}.get(mode, real)
data = data.replace(struct.pack("<2I", 123457, 1000000), struct.pack("<2I", shown, 1000000))
open(out, "wb").write(b"jpeg")
if mode == "no-dng":
    sys.exit(0)
open(out[:-4] + ".dng", "wb").write({{"empty": b"", "short": data[:5000]}}.get(mode, data))
if mode == "late-error":
    print("ERROR: *** camera frontend has timed out ***")
if mode == "code":
    sys.exit(255)
"""


@pytest.fixture
def pi(tmp_path: Path) -> Path:
    """A folder with the stand-in, its list of cameras and a DNG without an f-number."""
    folder = tmp_path / "pi"
    folder.mkdir()
    program = folder / "rpicam-still"
    program.write_text(STAND_IN.format(python=sys.executable), encoding="utf-8")
    program.chmod(0o755)
    (folder / "list").write_text(LIST, encoding="utf-8")
    counts = np.full((240, 320), 9000, np.uint16)
    template = folder / "template.dng"
    black = (4096.0,) * 4
    write_dng(template, counts, Exposure(MARK_S, 2.0), black_dn=black, white_dn=65520.0)
    # 33437 is FNumber; 33436 is no tag at all
    data = template.read_bytes()
    assert data.count(b"\x9d\x82\x05\x00") == 1
    template.write_bytes(data.replace(b"\x9d\x82\x05\x00", b"\x9c\x82\x05\x00"))
    return program


def _camera(pi: Path) -> RpicamCamera:
    uri = f"rpicam:0?f_number=2.0&program={pi}"
    camera = open_camera(uri, clock=Clock(), session=None)
    assert isinstance(camera, RpicamCamera)
    return camera


@pytest.mark.parametrize(
    ("asked_us", "taken_us"), [(60, 114), (122, 114), (4000, 4009), (500_000, 500_004)]
)
def test_the_exposure_is_the_one_of_the_metadata(
    pi: Path, tmp_path: Path, asked_us: int, taken_us: int
) -> None:
    camera = _camera(pi)
    asked = Exposure(asked_us * 1e-6, 2.0, 100.0)
    written = camera.expose(asked, tmp_path / ".frame")
    taken = camera.exposure_taken(written)
    assert taken is not None
    assert taken.shutter_s == pytest.approx(taken_us * 1e-6, abs=1e-6)
    assert (taken.f_number, taken.iso) == (2.0, 100.0)
    assert compare_exif(written, taken)[0] == ""
    call = (pi.parent / "calls").read_text().splitlines()[-1]
    for part in (f"--shutter {asked_us}", "--gain 1 ", "--awbgains 1,1", "--raw", "--immediate"):
        assert part in call
    assert sorted(path.name for path in tmp_path.iterdir()) == [".frame.dng", "pi"]


def test_a_dng_without_an_aperture_reads_with_the_lens_of_the_profile(pi: Path) -> None:
    template = pi.parent / "template.dng"
    with pytest.raises(InputError, match="no f-number"):
        read_exif(template)
    assert read_exif(template, lens_f_number=2.0).exposure.f_number == 2.0
    assert read_mosaic(template, lens_f_number=2.0).exposure.shutter_s == pytest.approx(MARK_S)


FAULTS = (
    "hangs",
    "in-use",
    "crash",
    "old",
    "gain",
    "zero",
    "negative",
    "word",
    "null",
    "nan",
    "infinite",
    "list",
    "ExposureTime",
    "AnalogueGain",
    "half",
    "empty-json",
    "array",
    "binary",
    "no-metadata",
    "no-dng",
    "empty",
    "short",
    "late-error",
    "code",
)


@pytest.mark.slow
@pytest.mark.parametrize("mode", FAULTS)
def test_a_fault_is_one_line_and_leaves_no_file(pi: Path, tmp_path: Path, mode: str) -> None:
    camera = _camera(pi)
    camera._start_s = 1.0 if mode == "hangs" else 60.0
    (pi.parent / "mode").write_text(mode)
    with pytest.raises(DeviceError, match=r"^rpicam: ") as caught:
        camera.expose(Exposure(0.001, 2.0), tmp_path / ".frame")
    assert "\n" not in str(caught.value)
    assert [path.name for path in tmp_path.iterdir()] == ["pi"]
    (pi.parent / "mode").unlink()  # the next frame is taken
    assert camera.expose(Exposure(0.001, 2.0), tmp_path / ".frame").is_file()


def test_other_faults_are_named(pi: Path, tmp_path: Path) -> None:
    camera = _camera(pi)
    (pi.parent / "mode").write_text("full")
    with pytest.raises(OSError, match="No space left") as caught:
        camera.expose(Exposure(0.1, 2.0), tmp_path / ".frame")
    assert disk_is_full(caught.value)
    (pi.parent / "mode").unlink()
    with pytest.raises(DeviceError, match="too long for this camera module"):
        camera.expose(Exposure(6.0, 2.0), tmp_path / ".frame")
    with pytest.raises(DeviceError, match="turning head"):
        camera.expose(Exposure(0.1, 2.0), tmp_path / ".frame", heading_deg=90.0)
    with pytest.raises(DeviceError, match=r"f/5.6 is planned, and the lens has f/2"):
        camera.check_offered(Exposure(0.1, 5.6))
    with pytest.raises(DeviceError, match="gain below 1"):
        camera.check_offered(Exposure(0.1, 2.0, 50.0))
    (pi.parent / "mode").write_text("exif")  # the file contradicts the metadata
    written = camera.expose(Exposure(0.01, 2.0), tmp_path / ".frame")
    taken = camera.exposure_taken(written)
    assert taken is not None and "shutter" in compare_exif(written, taken)[0]
    (pi.parent / "mode").write_text("none")
    for uri, text in (
        (f"rpicam:?f_number=2&program={pi}", "check the ribbon cable"),
        (f"rpicam:3?f_number=2&program={pi}", "camera 3"),
        (f"rpicam:front?f_number=2&program={pi}", "by its number"),
        (f"rpicam:?program={pi}", "state the lens's aperture"),
        ("rpicam:?f_number=2&program=/nowhere/rpicam-still", "sudo apt install rpicam-apps"),
        (f"rpicam:?f_number=2&gain=4&program={pi}", "unknown option"),
    ):
        with pytest.raises(DeviceError, match=text):
            open_camera(uri, clock=Clock(), session=None)


def test_capture_writes_the_true_exposures(pi: Path, tmp_path: Path) -> None:
    """Through the whole loop: capture.json has the metadata's times; nothing is taken twice."""
    session = make_session(tmp_path / "s", 1, CameraSetup("rpi-hq-fisheye-uncalibrated"))
    field = Field(session, FastClock(T0))
    uri = f"rpicam:0?f_number=5.6&program={pi}"
    options = replace(FAST, watchdog_s=60.0)
    field.run(
        options,
        open_cam=lambda: open_camera(uri, clock=field.clock, session=session),
        checks=FrameChecks(compare_exif),
    )
    frames = CaptureFile.read(session.capture_file(session.slots()[0].id)).frames
    times_us = [round(frame.exposure.shutter_s * 1e6) for frame in frames]
    assert times_us == [1000008, 500004, 250002]
    assert not [e for e in read_journal(session) if e["event"] == "retake"]
    assert [frame.doubt for frame in frames] == ["", "", ""]


def test_the_shipped_start_of_a_profile_says_that_it_is_none() -> None:
    profile = load_camera_profile("rpi-hq-fisheye-uncalibrated")
    assert profile.shutter_law == "exact" and profile.camera.fixed_f_number == 2.0
    assert profile.scale.u_rel >= 0.5


def test_texts_of_the_program_are_read() -> None:
    assert parse_cameras(LIST) == {0: "imx477"}
    assert parse_cameras("") == {}
    asked = json.dumps({"ExposureTime": 1064891, "AnalogueGain": 1.0, "DigitalGain": 4.0})
    assert parse_metadata(asked).digital_gain == 4.0
