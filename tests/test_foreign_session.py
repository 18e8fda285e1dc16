"""A session that another person sends is data: nothing in it runs, nothing leaves its folder."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import socket
import struct
import subprocess
import sys
import tarfile
import tempfile
import zlib
from collections.abc import Callable
from contextlib import closing, suppress
from datetime import timedelta
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from click.testing import CliRunner, Result
from outside_jpeg import GOOD, exif_segment, jpeg
from tiny_field import T0, Field, make_session

from fieldlum.calibrate.fit_charts import grey_picture
from fieldlum.capture.notify import Message, _latest_contact_sheet, open_alerts
from fieldlum.cli import main
from fieldlum.core.errors import DeviceError, InputError
from fieldlum.core.files import encode_line
from fieldlum.core.records import (
    Exposure,
    IrradianceSample,
    Room,
    parse_utc,
    slot_id,
)
from fieldlum.core.strict_csv import read_text
from fieldlum.core.strict_toml import read_toml
from fieldlum.devices import open_camera
from fieldlum.devices.address_permission import permission_subject, require_permitted
from fieldlum.devices.clock import FastClock
from fieldlum.devices.logger_files import read_logger_file
from fieldlum.merge.shots import shots_of_slot
from fieldlum.optics.images import read_exr, read_panorama, read_radiance_hdr
from fieldlum.optics.raw import open_raw, read_jpeg
from fieldlum.optics.raw.exif import tags_of
from fieldlum.report.export_and_pack import Statement, pack
from fieldlum.room.fit.scene_file import read_scene
from fieldlum.session import (
    Journal,
    Session,
    open_session,
    read_journal,
    remove_scraps,
    replacing,
    replacing_path,
    sha256,
    update_session,
)
from fieldlum.session.codec import read_arrays, read_object, write_object
from fieldlum.session.day_files import DayFiles, decode_sample, read_day
from fieldlum.session.files.capture_json import CaptureFile, Frame, frame_fields, frame_from
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.sidecar import Sidecar
from fieldlum.session.folder import _CHECKED_STEMS
from fieldlum.session.journal import damaged_lines, decode_event, mark_slot
from fieldlum.session.permits import computer, config_folder, is_permitted, permit, subject
from fieldlum.session.safe_paths import link_subject, open_inside
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.web.snapshot import LineTail

pytestmark = [
    pytest.mark.contract,
    pytest.mark.skipif(sys.platform == "win32", reason="scripts and links of POSIX"),
]
PACKAGE = Path(sys.modules["fieldlum"].__file__ or "").parent
INERT = "void plastic grey\n0\n0\n5 .5 .5 .5 0 0\ngrey sphere ball\n0\n0\n4 0 0 0 1\n"


@pytest.fixture(autouse=True)
def _new_computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Begin each test on a computer whose user has permitted nothing."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "settings"))


def run_cli(*arguments: str | Path) -> Result:
    """Run the command line."""
    return CliRunner().invoke(main, list(map(str, arguments)))


def program(path: Path, proof: Path) -> Path:
    path.write_text(f"#!/bin/sh\ntouch {proof}\n", encoding="utf-8")
    path.chmod(0o755)
    return path


def with_camera(session: Session, address: str) -> None:
    update_session(session, {"devices": {"uris": {"camera": address}}})


# ----------------------------------------------------------------------------------------------
# programs


@pytest.mark.slow
@pytest.mark.parametrize("command", ["doctor", "capture"])
def test_a_program_in_a_stored_address_does_not_run(tmp_path: Path, command: str) -> None:
    session = make_session(tmp_path / "s")
    proof = tmp_path / "ran"
    address = f"rpicam:0?program={program(session.root / 'camera', proof)}"
    with_camera(session, address)
    result = run_cli(command, session.root)
    assert result.exit_code == InputError.exit_code
    assert not proof.exists()
    assert result.stderr.count("\n") == 1 and "permit it with: fieldlum doctor" in result.stderr


@pytest.mark.slow
def test_an_address_that_the_user_named_works_until_the_program_changes(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s")
    proof = tmp_path / "ran"
    script = program(tmp_path / "camera", proof)
    address = f"rpicam:0?program={script}"
    run_cli("doctor", session.root, "--camera", address)
    assert proof.exists()
    proof.unlink()
    with_camera(session, address)
    run_cli("doctor", session.root)
    assert proof.exists()
    proof.unlink()
    script.write_text(f"#!/bin/sh\ntouch {proof} # edited\n", encoding="utf-8")
    assert run_cli("doctor", session.root).exit_code == InputError.exit_code
    assert not proof.exists()


@pytest.mark.parametrize(
    "address",
    [
        "sim:office?seed=1&noise=2",
        "gphoto:Nikon?delete=1",
        "rpicam:0?f_number=2.0",
        "theta:",
        "serial:/dev/serial/by-id/usb-1?kind=spn1&baud=9600",
        "serial:usb=0403:6001?kind=ascii&profile=arduino-json",
        "modbus:/dev/ttyUSB0?kind=smp&unit=1",
        "cl200a:COM3?parity=E",
        "t10a:COM3?head=3",
    ],
)
def test_an_address_of_a_device_needs_no_permission(address: str) -> None:
    assert permission_subject(address) is None


@pytest.mark.parametrize(
    "address",
    [
        "rpicam:0?program=reboot",
        "sim:office?profile=/home/me/camera.toml",
        "sim:office?profile=camera.toml",
        "theta:http://10.0.0.1",
        "serial:/home/me/file?kind=spn1",
        "serial:/dev/../home/me/file?kind=spn1",
        "serial:/dev/watchdog?kind=spn1",
        "modbus:/dev/sda?kind=smp",
        "serial:/dev/ttyUSB0?kind=ascii&profile=../p.toml",
        "modbus:/dev/ttyUSB0?kind=/tmp/smp.toml",
        "gphoto:?newer=1",
    ],
)
def test_an_address_of_more_than_a_device_needs_a_permission(tmp_path: Path, address: str) -> None:
    with pytest.raises(InputError, match=r"permit it with: fieldlum doctor .* --camera"):
        require_permitted(address, tmp_path / "session.toml", "--camera")
    wanted = permission_subject(address)
    assert wanted is not None
    permit(wanted)
    require_permitted(address, tmp_path / "session.toml", "--camera")


def test_an_address_without_a_driver_is_refused_by_the_device(tmp_path: Path) -> None:
    """A permission for `replay:` of an earlier version would lead in a circle."""
    require_permitted("replay:/home/me", tmp_path / "session.toml", "--camera")
    with pytest.raises(DeviceError, match="no camera driver 'replay:'"):
        open_camera("replay:/home/me", clock=FastClock(T0))


@pytest.mark.parametrize("address", ["modbus:tcp=10.0.0.7:502?kind=smp", "theta:http://a.local"])
def test_a_permitted_computer_stays_so_in_another_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, address: str
) -> None:
    wanted = permission_subject(address)
    monkeypatch.chdir(tmp_path)
    assert wanted is not None and wanted == permission_subject(address)


@pytest.mark.slow
def test_children_of_a_command_in_a_session_import_nothing_from_it(tmp_path: Path) -> None:
    """`python -c`, as multiprocessing starts workers, imports from the current folder first."""
    session, proof = make_session(tmp_path / "s"), tmp_path / "ran"
    (session.root / "multiprocessing.py").write_text(f"open({str(proof)!r}, 'w')")
    for hour in range(3):
        session.capture_file(slot_id(T0 + timedelta(hours=hour))).parent.mkdir(parents=True)
    line = [sys.executable, Path(sys.executable).with_name("fieldlum"), "merge", "."]
    line += ["--scheduler", "2"]
    result = subprocess.run(line, cwd=session.root, capture_output=True, timeout=120, check=False)
    assert b"0 of 3 brackets could be merged" in result.stderr
    assert not proof.exists()


@pytest.mark.slow
def test_settings_of_libraries_in_a_session_have_no_effect(tmp_path: Path) -> None:
    """numba unpickles its cache, and matplotlib would run latex."""
    (tmp_path / ".numba_config.yaml").write_text(f"cache_dir: {tmp_path}\n")
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\n")
    code = (
        "from fieldlum.core.plot_style import styled; from matplotlib import rcParams\n"
        "from fieldlum.room.scene.trace import nearest_box\n"
        "with styled(): print(rcParams['text.usetex'], nearest_box._cache.cache_path)"
    )
    line = [sys.executable, "-c", code]
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    printed = subprocess.check_output(line, cwd=tmp_path, env=environment, text=True)
    assert printed.startswith("False ") and str(tmp_path) not in printed


# ----------------------------------------------------------------------------------------------
# rooms


def room_of(path: Path) -> Room:
    return Room(kind="radiance", file=str(path), viewpoint_m=(0.0, 0.0, 3.0))


def traced(path: Path) -> np.ndarray:
    from fieldlum.room import scene

    sun = np.array([[0.0, -0.7, 0.7]])
    return scene.sun_patches(room_of(path), sun, 1.0, height=8, heading_deg=180.0)


@pytest.mark.parametrize(
    "text",
    [
        "!touch {proof}\n",
        "{inert}  !touch {proof}\n",
        "{inert}!\\\ntouch {proof}\n",
        "#\rcomment\n!touch {proof}\n",
        "void mixfunc a\n3\n# x !b\n!touch {proof}\n",
        "!cat {nested}\n",
        "!xform -t 1 0 0 {nested}\n",
    ],
)
def test_commands_of_a_room_do_not_run(tmp_path: Path, text: str) -> None:
    proof, nested, room = (tmp_path / name for name in ("ran", "nested.rad", "room.rad"))
    nested.write_text(f"!touch {proof}\n")
    room.write_text(text.format(proof=proof, nested=nested, inert=INERT))
    with pytest.raises(InputError, match=r"runs the command: .*; expected .* mere geometry"):
        traced(room)
    assert not proof.exists()


def test_an_octree_and_a_scene_that_loads_one_are_refused(tmp_path: Path) -> None:
    """An octree that is not frozen names its scenes, and one of them can be a command."""
    import pyradiance

    proof = tmp_path / "ran"
    (tmp_path / "a.rad").write_text(INERT)
    octree = tmp_path / "a.oct"
    octree.write_bytes(pyradiance.oconv(tmp_path / "a.rad", warning=False))
    evil = octree.read_bytes().replace(str(tmp_path / "a.rad").encode(), f"!touch {proof}".encode())
    octree.write_bytes(evil)
    instance = tmp_path / "b.rad"
    instance.write_text(f"void instance a\n1 {octree}\n0\n0\n")
    for room in (octree, instance):
        with pytest.raises(InputError, match=r"(could run|runs the) command"):
            traced(room)
    assert not proof.exists()


def test_a_room_without_commands_is_traced(tmp_path: Path) -> None:
    (tmp_path / "room.rad").write_text(INERT)
    assert traced(tmp_path / "room.rad").shape == (1, 8, 16)


@pytest.mark.parametrize(
    "name", ["session.toml", "plan.csv", "journal.jsonl", "irradiance/2027-03-20.csv"]
)
def test_a_huge_file_is_refused_in_one_line(tmp_path: Path, name: str) -> None:
    """A sparse file of 8 GB needs no disk."""
    session = make_session(tmp_path / "s")
    session.irradiance.mkdir()
    with (session.root / name).open("wb") as file:
        try:
            file.truncate(1 << 33)
        except OSError:
            pytest.skip("no sparse files here")
    result = CliRunner().invoke(main, ["status", str(session.root)])
    assert result.exit_code == InputError.exit_code and result.stderr.count("\n") == 1
    assert f"{name}: 8192.0 MiB, more than the limit of " in result.stderr


READERS = [
    sha256,
    read_day,
    read_arrays,
    read_panorama,
    read_radiance_hdr,
    read_toml,
    open_raw,
    tags_of,
    lambda path: read_object(path, "", ""),
    lambda path: read_text(path, ""),
    lambda path: LineTail(path).update()._offset,  # 0: nothing was read
]


@pytest.mark.parametrize("read", READERS)
def test_no_reader_waits_for_a_pipe_or_reads_a_huge_file(
    tmp_path: Path, read: Callable[[Path], object]
) -> None:
    """Somebody may exchange a file after the session was checked."""
    pipe, huge, name = tmp_path / "pipe.exr", tmp_path / "huge.exr", tmp_path / "socket.exr"
    os.mkfifo(pipe)
    with socket.socket(socket.AF_UNIX) as listener, contextlib.chdir(tmp_path):
        listener.bind(name.name)  # a name of any length
    with huge.open("wb") as file:
        file.truncate(1 << 33)
    for path, why in ((pipe, "a pipe"), (name, "socket"), (huge, "more than the limit")):
        try:
            answer = read(path)
        except (InputError, OSError) as error:
            assert why in str(error)
        else:
            assert not answer


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("link", ["raw", f"raw/{slot_id(T0)}", "panoramas/day", "models/a.exr"])
def test_no_reader_follows_a_link_that_was_made_after_the_check(
    tmp_path: Path, link: str, read: Callable[[Path], object]
) -> None:
    """Also when it leads to another session; a link that the user permits is followed."""
    session = open_session(make_session(tmp_path / "s").root)
    name = "s/raw/plan.csv" if link == "raw" else "plan.csv"
    outside = make_session(tmp_path / "outside" / "s" / "raw").root
    target = outside.parents[1] if link == "raw" else outside
    place = session.root / link
    place.parent.mkdir(exist_ok=True)
    place.symlink_to(outside / name if place.suffix else target)
    path = place if place.suffix else place / name
    try:
        answer = read(path)
    except (InputError, OSError) as error:
        assert "a symbolic link" in str(error)
    else:
        assert not answer
    permit(link_subject(place, place.resolve()))
    assert read_text(path, "") == (outside / "plan.csv").read_text()


def test_no_result_is_written_behind_a_link_that_was_made_after_the_check(tmp_path: Path) -> None:
    session = open_session(make_session(tmp_path / "s").root)
    (tmp_path / "outside").mkdir()
    session.panoramas.symlink_to(tmp_path / "outside")
    with pytest.raises(OSError, match="a symbolic link"):
        write_object(session.sidecar(SLOT), {})
    assert not list((tmp_path / "outside").iterdir())


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("setpriv") is None and getattr(os, "getuid", int)() == 0, reason="no setpriv"
)
@pytest.mark.parametrize("name", ["session.toml", "plan.csv", "journal.jsonl", "irradiance"])
def test_what_a_user_may_not_read_is_one_line(name: str) -> None:
    """As another user where the tests run as root, who may read everything."""
    with tempfile.TemporaryDirectory() as folder:
        Path(folder).chmod(0o755)
        session = make_session(Path(folder) / "s")
        session.irradiance.mkdir()
        Journal(session).close()
        (session.root / name).chmod(0)
        code = f"from fieldlum.cli import main; main(['status', {str(session.root)!r}])"
        other = ["setpriv", "--reuid=65534", "--regid=65534", "--clear-groups"]
        line = [*(other if os.getuid() == 0 else ()), sys.executable, "-c", code]
        shown = subprocess.run(line, capture_output=True, text=True, check=False)
        if f"failed to execute {sys.executable}" in shown.stderr:
            pytest.skip("another user may not run this Python")
        (session.root / name).chmod(0o755)
    assert shown.returncode in (3, 4) and shown.stderr.count("\n") == 1, shown.stderr
    assert name in shown.stderr and "Permission denied" in shown.stderr


# ----------------------------------------------------------------------------------------------
# files that state or expand to more than they hold


def _exr_of(path: Path, width: int, height: int, tiles: tuple[int, int, int] | None = None) -> Path:
    """Write the header of an EXR of half RGB, without pixels, and 200 zeros."""

    def attribute(name: str, kind: str, data: bytes) -> bytes:
        size = struct.pack("<i", len(data))
        return name.encode() + b"\0" + kind.encode() + b"\0" + size + data

    box = struct.pack("<4i", 0, 0, width - 1, height - 1)
    rgb = b"".join(c + b"\0" + struct.pack("<iB3xii", 1, 0, 1, 1) for c in (b"B", b"G", b"R"))
    parts = [
        attribute("channels", "chlist", rgb + b"\0"),
        attribute("compression", "compression", b"\3"),
        attribute("dataWindow", "box2i", box),
        attribute("displayWindow", "box2i", box),
        attribute("lineOrder", "lineOrder", b"\0"),
        attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)),
        *([attribute("tiles", "tiledesc", struct.pack("<iiB", *tiles))] if tiles else []),
    ]
    start = struct.pack("<ii", 20000630, 0x202 if tiles else 2)
    path.write_bytes(start + b"".join(parts) + bytes(201))
    return path


EXR_BOMBS = {
    "140 megapixels": (14_000, 10_000, None),
    "one row": (100_000_000, 1, None),
    "all of 31 bits": (2**31 - 2, 2**31 - 2, None),
    "tiles of a pixel": (14_000, 10_000, (1, 1, 2)),
    "huge tiles": (100, 100, (2**30, 2**30, 0)),
    "no pixels": (64, 64, None),
}


@pytest.mark.parametrize("bomb", EXR_BOMBS)
def test_an_exr_that_states_many_pixels_is_refused_in_one_line(tmp_path: Path, bomb: str) -> None:
    """Within a second and 1 GiB of memory, and without lines of OpenEXR."""
    path = _exr_of(tmp_path / "a.exr", *EXR_BOMBS[bomb])
    limit = "import resource; resource.setrlimit(resource.RLIMIT_DATA, (2**30, 2**30)); "
    line = f"{limit}from fieldlum.cli import main; main(['info', {str(path)!r}])"
    command = [sys.executable, "-c", line]
    shown = subprocess.run(command, capture_output=True, text=True, check=False)
    assert shown.returncode == InputError.exit_code, shown.stderr
    assert shown.stderr.count("\n") == 1 and "a.exr: " in shown.stderr


@pytest.mark.slow
def test_an_exr_of_zeros_does_not_expand(tmp_path: Path) -> None:
    """A complete file of 0.3 MB, for pictures and for sky views."""
    black = np.zeros((5000, 4000), np.float16)
    channels = dict.fromkeys(("R", "G", "B"), black)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(tmp_path / "a.exr"))
    for read in (read_exr, SkyView.read):
        with pytest.raises(InputError, match="4000 x 5000 pixels of 3 channels"):
            read(tmp_path / "a.exr")


@pytest.mark.parametrize("pixels", [0, 10**12])
def test_no_profile_removes_the_limit_on_pixels(tmp_path: Path, pixels: int) -> None:
    path = jpeg(tmp_path / "a.jpg", exif_segment(GOOD))
    data = bytearray(path.read_bytes())
    at = data.index(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", 65_000, 65_000)
    path.write_bytes(data)
    with pytest.raises(InputError, match="65000 x 65000 pixels; expected at most"):
        read_jpeg(path, camera_pixels=pixels)
    with pytest.raises(InputError, match="65000 x 65000 pixels; expected at most"):
        grey_picture(path)


def test_a_png_that_states_many_pixels_is_refused(tmp_path: Path) -> None:
    head = b"\x89PNG\r\n\x1a\n" + struct.pack(">I4sII", 13, b"IHDR", 30_000, 30_000)
    (tmp_path / "a.png").write_bytes(head + bytes(20))
    with pytest.raises(InputError, match="30000 x 30000 pixels; expected at most"):
        grey_picture(tmp_path / "a.png")


@pytest.mark.parametrize(
    "text",
    ["a = " + "[" * 9999, "a = " + "{b=" * 9999, f"[{'.'.join('a' * 5000)}]", "a = " + "9" * 9999],
)
@pytest.mark.parametrize("name", ["session.toml", "scene/scene.toml", "camera.toml"])
def test_toml_nested_too_deeply_is_one_line(tmp_path: Path, name: str, text: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(text, encoding="utf-8")
    read = {"session.toml": open_session, "scene/scene.toml": read_scene}.get(name, read_toml)
    with pytest.raises(InputError, match="toml: "):
        read(path if name == "camera.toml" else path.parent)


def test_a_table_of_too_many_rows_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fieldlum.devices.logger_files._MAX_ROWS", 2)
    (tmp_path / "a.csv").write_text("t_utc,ghi_wm2\n" + "2027-03-20T06:00:00Z,1\n" * 3)
    with pytest.raises(InputError, match="3 rows; expected at most 2 rows"):
        read_logger_file(tmp_path / "a.csv")


def test_two_frames_of_one_name_are_refused(tmp_path: Path) -> None:
    """Names that differ in capitals only are one file on Windows and macOS."""
    exposure = {"shutter_s": 1.0, "f_number": 4.0, "iso": 100.0}
    row = {"exposure": exposure, "t_utc": "2027-03-20T15:30:00Z"}
    rows = [row | {"file": name} for name in ("a.DNG", "A.dng")]
    folder = tmp_path / "20270320T153000Z"
    folder.mkdir()
    (folder / "capture.json").write_text(json.dumps({"frames": rows}))
    with pytest.raises(InputError, match="two frames with the same file name"):
        CaptureFile.read(folder / "capture.json")


# ----------------------------------------------------------------------------------------------
# the terminal


def test_texts_of_a_session_do_not_control_the_terminal(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s")
    code, shown = "\x1b]0;name\x07\x9b2J\u202e", "?]0;name??2J?"
    with_camera(session, f"sim:{code}")
    result = CliRunner().invoke(main, ["info", str(session.root)])
    assert shown in result.stdout and not set(code) & set(result.stdout) - set("]0;name2J")
    answer = CliRunner().invoke(main, ["info", str(session.root), "--json"]).stdout
    assert not set("\x1b\x9b\u202e") & set(answer)
    assert json.loads(answer)["devices.uris.camera"] == f"sim:{code}"


# ----------------------------------------------------------------------------------------------
# the record


def test_a_permission_holds_for_one_computer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = subject("device", "x", "x")
    permit(wanted)
    assert is_permitted(wanted) and config_folder().is_relative_to(tmp_path)
    monkeypatch.setattr("fieldlum.session.permits.computer", lambda: f"not {computer()}")
    assert not is_permitted(wanted)


def test_a_permission_that_an_earlier_version_recorded_holds() -> None:
    wanted = subject("device", "x", "x")
    table = {"format": 1, "permitted": {computer(): {wanted.digest: "device x"}}}
    config_folder().mkdir(parents=True)
    (config_folder() / "permitted.json").write_text(json.dumps(table))
    assert is_permitted(wanted) and not is_permitted(subject("link", "x", "x"))
    assert not is_permitted(subject("device", "x", "y"))


@pytest.mark.parametrize("content", ["", "[]", "{}", '{"format": 1, "permitted": 7}', "\0"])
def test_a_damaged_record_permits_nothing(content: str) -> None:
    wanted = subject("device", "x", "x")
    permit(wanted)
    (config_folder() / "permitted.json").write_text(content)
    assert not is_permitted(wanted)
    permit(wanted)
    assert is_permitted(wanted)


def test_a_record_that_cannot_be_written_does_not_end_a_command(tmp_path: Path) -> None:
    from fieldlum.cli.options import device_uris

    (tmp_path / "settings").write_text("a file in place of the folder")
    session = make_session(tmp_path / "s")
    assert device_uris(session, "theta:http://10.0.0.1", "", "") == (
        "theta:http://10.0.0.1",
        "",
        "",
    )


# ----------------------------------------------------------------------------------------------
# paths and links

SLOT = slot_id(T0)
FIXED = [
    ".reserve",
    ".capture.lock",
    "session.toml",
    "plan.csv",
    "journal.jsonl",
    "raw",
    f"raw/{SLOT}",
    f"raw/{SLOT}/capture.json",
    f"raw/{SLOT}/00_1s.dng",
    "irradiance",
    "irradiance/2027-03-20.csv",
    "panoramas",
    f"panoramas/{SLOT}.json",
    "sunpatches",
    "suns.csv",
    "pairs.csv",
    "models/dense/weights.npz",
    "annual/dense",
    "scene/scene.toml",
    "truth",
    "watch/answers.json",
    "export",
    "compare",
    "plan.1.csv",
    "pairs.csv.sha256",
    "pairs.alignment.csv",
]


def linked(session: Session, name: str, target: Path) -> Path:
    """Replace a file or folder of the session by a link."""
    link = session.root / name
    link.parent.mkdir(parents=True, exist_ok=True)
    if link.is_file():
        shutil.copyfile(link, target)
        link.unlink()
    link.symlink_to(target)
    return link


@pytest.mark.parametrize("name", FIXED)
def test_a_session_with_a_link_is_refused(tmp_path: Path, name: str) -> None:
    session = make_session(tmp_path / "s")
    linked(session, name, tmp_path / "target")
    with pytest.raises(InputError, match=r"a symbolic link to .*; expected .*fieldlum permit"):
        open_session(session.root)


def test_a_link_that_fieldlum_never_opens_does_not_stop_a_capture(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s")
    (session.root / "my notes").symlink_to(tmp_path)
    (session.root / ".Trash-0").mkdir()
    (session.root / ".Trash-0" / "link").symlink_to(tmp_path)
    assert open_session(session.root) == session


def test_links_are_refused_wherever_the_code_names_a_file_of_a_session() -> None:
    texts = [path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")]
    named = {name for text in texts for name in re.findall(r'\broot / f?"([a-z_]+)', text)}
    assert {"plan", "export", "watch"} <= named <= _CHECKED_STEMS


@pytest.mark.parametrize("name", ["raw/frame.dng", "pairs.csv.sha256", ".capture.lock", ".reserve"])
def test_a_pipe_in_a_session_is_refused(tmp_path: Path, name: str) -> None:
    session = make_session(tmp_path / "s")
    session.raw.mkdir()
    os.mkfifo(session.root / name)
    with pytest.raises(InputError, match="a pipe, socket or device"):
        open_session(session.root)


def test_raw_on_another_disk_works_once_it_is_permitted(rig: Field, tmp_path: Path) -> None:
    other = tmp_path / "disk"
    other.mkdir()
    link = linked(rig.session, "raw", other)
    assert run_cli("permit", link).exit_code == 0
    assert open_session(rig.session.root) == rig.session
    rig.run()
    assert len(list(other.glob("*/*.dng"))) == 9
    link.unlink()
    link.symlink_to(tmp_path / "settings")
    with pytest.raises(InputError, match="a symbolic link"):
        open_session(rig.session.root)


def test_the_reserve_does_not_overwrite_the_target_of_a_link(rig: Field, tmp_path: Path) -> None:
    precious = tmp_path / "precious.txt"
    precious.write_text("precious")
    linked(rig.session, ".reserve", precious)
    rig.run()
    assert precious.read_text() == "precious"


@pytest.mark.parametrize("name", [".capture.lock", "journal.jsonl"])
def test_lock_and_journal_do_not_follow_a_link(rig: Field, tmp_path: Path, name: str) -> None:
    precious = tmp_path / "precious.txt"
    precious.write_text("precious")
    linked(rig.session, name, precious)
    with pytest.raises(OSError, match="symbolic link"):
        rig.run()
    assert precious.read_text() == "precious"


def unpacked(folder: Path, session: Session, names: list[str]) -> list[Path]:
    """Unpack the files of a session from an archive, as hard links to files next to it."""
    victims = []
    with tarfile.open(folder / "mail.tar", "w") as archive:
        for number, name in enumerate(names):
            victims.append(folder / f"{number}.txt")
            victims[-1].write_text("precious\n")
            member = tarfile.TarInfo(f"{session.root.name}/{name}")
            member.type, member.linkname = tarfile.LNKTYPE, victims[-1].name
            archive.addfile(member)
            (session.root / name).unlink(missing_ok=True)
    with tarfile.open(folder / "mail.tar") as archive:
        archive.extractall(folder, filter="data")
    assert all(victim.stat().st_nlink == 2 for victim in victims)
    return victims


def test_hard_links_of_an_archive_lead_to_no_file(rig: Field) -> None:
    """The filter of Python, and GNU tar, unpack links to the files of the folder around."""
    day = f"irradiance/{T0:%Y-%m-%d}.csv"
    names = [".reserve", ".capture.lock", ".log.lock", ".journal.lock", day, "journal.jsonl.torn"]
    victims = unpacked(rig.session.root.parent, rig.session, names)
    rig.run()
    assert [victim.read_text() for victim in victims] == ["precious\n"] * len(names)
    assert len(list(rig.session.raw.glob("*/*.dng"))) == 9


def test_a_journal_with_another_name_is_copied_first(rig: Field) -> None:
    good = rig.session.journal.read_bytes() if rig.session.journal.is_file() else b""
    victim = unpacked(rig.session.root.parent, rig.session, ["journal.jsonl"])[0]
    words = ["status", str(rig.session.root), "--mark", SLOT, "lamp=on"]
    assert CliRunner().invoke(main, words).exit_code == 0
    rig.run()
    assert victim.read_text() == "precious\n" and not good
    assert len(list(rig.session.raw.glob("*/*.dng"))) == 9


def test_a_backup_of_hard_links_stops_no_capture(rig: Field) -> None:
    """`cp -al` while a capture runs: it, a mark and a restart go on in the session's own files."""
    day = rig.session.irradiance / f"{T0:%Y-%m-%d}.csv"
    backup = rig.session.root.parent / "backup"
    backup.mkdir()
    with closing(Journal(rig.session)) as running, closing(DayFiles(rig.session)) as rows:
        running.append("note", T0, text="before")
        rows.append(
            IrradianceSample(
                T0, ghi_wm2=1.0, dhi_wm2=1.0, dni_wm2=None, temperature_c=None, status="", raw=""
            )
        )
        for path in (rig.session.journal, day):
            os.link(path, backup / path.name)
        mark_slot(rig.session, SLOT, "lamp=on")  # another process
        with closing(DayFiles(rig.session)) as others:
            others.append(
                IrradianceSample(
                    T0 + timedelta(seconds=1),
                    ghi_wm2=2.0,
                    dhi_wm2=1.0,
                    dni_wm2=None,
                    temperature_c=None,
                    status="",
                    raw="",
                )
            )
        running.append("note", T0, text="after")
        rows.append(
            IrradianceSample(
                T0 + timedelta(seconds=2),
                ghi_wm2=3.0,
                dhi_wm2=1.0,
                dni_wm2=None,
                temperature_c=None,
                status="",
                raw="",
            )
        )
    assert [e.get("text") for e in read_journal(rig.session)] == ["before", None, "after"]
    assert [sample.ghi_wm2 for sample in read_day(day)[0]] == [1.0, 2.0, 3.0]
    assert len(read_day(backup / day.name)[0]) == 1
    rig.run()
    assert len(list(rig.session.raw.glob("*/*.dng"))) == 9
    assert (backup / "journal.jsonl").read_bytes().count(b"\n") == 1


def test_what_is_packed_comes_from_the_session(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another program exchanges a file for a link after `pack` listed the files."""
    session, secret = make_session(tmp_path / "s"), tmp_path / "secret"
    secret.write_text("secret")
    frame = session.capture_file(SLOT).with_name("00.txt")
    frame.parent.mkdir(parents=True)
    frame.touch()

    def exchanged(session: Session, setup: str) -> list[str]:
        frame.unlink()
        frame.symlink_to(secret)
        return []

    monkeypatch.setattr("fieldlum.report.export_and_pack._notes", exchanged)
    with pytest.raises(OSError, match="symbolic link"):
        pack(session, tmp_path / "a.zip", Statement("t", ("a",), "CC0-1.0", "p", "nobody"))
    assert not (tmp_path / "a.zip").exists()


@pytest.mark.slow
def test_a_folder_exchanged_for_a_link_while_it_is_opened_leads_nowhere(tmp_path: Path) -> None:
    """A second process exchanges the folder, without a pause, between the check and the open."""
    root, outside = tmp_path / "s", tmp_path / "outside"
    for folder in (root / "real", outside):
        folder.mkdir(parents=True)
    (root / "link").symlink_to(outside)
    code = (
        "import os, sys\nos.chdir(sys.argv[1])\n"
        "while True:\n"
        "    os.rename('real', 'day'); os.rename('day', 'real')\n"
        "    os.rename('link', 'day'); os.rename('day', 'link')\n"
    )
    other = subprocess.Popen([sys.executable, "-c", code, str(root)])
    opened_files = 0
    try:
        for number in range(4000):
            with suppress(OSError):
                path = root / "day" / f"{number}.csv"
                os.close(open_inside(root, path, os.O_WRONLY | os.O_CREAT))
                opened_files += 1
    finally:
        other.kill()
        other.wait()
    assert opened_files > 0 and not list(outside.iterdir())


@pytest.mark.parametrize("name", [f"raw/{SLOT}", "raw"])
def test_a_capture_neither_sweeps_nor_writes_behind_a_link(
    rig: Field, tmp_path: Path, name: str
) -> None:
    home = tmp_path / "home"
    (home / SLOT).mkdir(parents=True)
    for path in (home / ".bashrc", home / SLOT / ".profile"):
        path.write_text("precious")
    linked(rig.session, name, home)
    rig.run()
    assert sorted(p.name for p in home.rglob("*") if p.is_file()) == [".bashrc", ".profile"]
    aborted = [e for e in read_journal(rig.session) if e["event"] == "aborted"]
    assert "is a symbolic link" in aborted[0].get("why", "")


def test_a_folder_of_irradiance_that_is_a_link_is_refused(rig: Field, tmp_path: Path) -> None:
    linked(rig.session, "irradiance", tmp_path)
    with pytest.raises(InputError, match="a symbolic link"):
        rig.run()


def test_a_temporary_name_that_is_a_link_is_replaced(tmp_path: Path) -> None:
    precious = tmp_path / "precious.txt"
    precious.write_text("precious")
    with replacing_path(tmp_path / "file.txt") as temporary:
        pass_over = temporary.name
        temporary.write_text("first")
    (tmp_path / pass_over).symlink_to(precious)
    with replacing(tmp_path / "file.txt", "w") as file:
        file.write("second")
    assert precious.read_text() == "precious" and (tmp_path / "file.txt").read_text() == "second"


def test_scraps_behind_a_link_stay(tmp_path: Path) -> None:
    (tmp_path / "home").mkdir()
    scrap = tmp_path / "home" / ".host.1.tmp.x"
    scrap.write_text("precious")
    os.utime(scrap, (0, 0))
    (tmp_path / "panoramas").symlink_to(tmp_path / "home")
    remove_scraps(tmp_path / "panoramas")
    assert scrap.exists()


BAD_NAMES = [
    "../thesis.txt",
    "../../../thesis.txt",
    "/etc/passwd",
    "sub/frame.dng",
    "..",
    ".",
    "",
    ".hidden",
    "a\\b",
    "C:x",
    "a\0b",
    "a\nb",
    "x" * 300,
    "\ud800",
]


@pytest.mark.parametrize("name", BAD_NAMES)
def test_only_plain_names_are_frames_and_slots(tmp_path: Path, name: str) -> None:
    session = make_session(tmp_path / "s")
    fields = frame_fields(Frame(0, "00.dng", Exposure(1.0, 5.6), None, T0))
    bad = [("file", name)] + [("instead_of", name)] * bool(name)
    for key, value in bad:
        with pytest.raises(ValueError, match="file name"):
            frame_from({**fields, key: value})
        path = session.capture_file(SLOT)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps({"slot": SLOT, "frames": [{**fields, key: value}]}))
        with pytest.raises(InputError, match="file name"):
            shots_of_slot(path.parent)
    for place in (session.capture_file, session.panorama, session.sidecar, session.sunpatch):
        with pytest.raises(InputError, match="slot name"):
            place(name)


@pytest.mark.parametrize("value", [0.0, -1.0, float("nan"), float("inf")])
@pytest.mark.parametrize("key", ["shutter_s", "f_number", "iso"])
def test_an_impossible_exposure_is_no_frame(key: str, value: float) -> None:
    fields = dict(frame_fields(Frame(0, "00.dng", Exposure(1.0, 5.6), None, T0)))
    exposure = {"shutter_s": 1.0, "f_number": 5.6, "iso": 100.0, key: value}
    with pytest.raises(ValueError, match="expected a number"):
        frame_from({**fields, "exposure": exposure})


@pytest.mark.parametrize("seconds", [1e308, float("inf"), float("nan"), 10**400])
def test_a_duration_that_no_clock_can_add_is_no_frame(seconds: float) -> None:
    fields = dict(frame_fields(Frame(0, "00.dng", Exposure(1.0, 5.6), None, T0)))
    with pytest.raises((ValueError, OverflowError)):
        frame_from({**fields, "seconds": seconds})


@pytest.mark.parametrize("year", ["0001", "1899", "2200", "9999"])
def test_a_year_without_an_ephemeris_is_refused(tmp_path: Path, year: str) -> None:
    t_utc = f"{year}-06-01T12:00:00Z"
    fields = frame_fields(Frame(0, "00.dng", Exposure(1.0, 5.6), None, T0))
    row = f"{t_utc},1,1,,,,".encode()
    assert decode_sample(row + b",%08x\n" % zlib.crc32(row)) is None
    assert decode_event(encode_line({"event": "note", "t_utc": t_utc})) is None
    frames = {"frames": [fields], "t_open_utc": t_utc, "t_close_utc": t_utc}
    log = tmp_path / "log.csv"
    log.write_text(f"t_utc,ghi_wm2\n{t_utc},1\n")
    measured = {"altitude_deg": 1.0, "azimuth_deg": 1.0, "sigma_deg": 1.0, "t_utc": t_utc}
    reads: tuple[Callable[[], object], ...] = (
        lambda: parse_utc(t_utc),
        lambda: read_logger_file(log),
        lambda: frame_from({**fields, "t_utc": t_utc}),
        lambda: CaptureFile.from_table(frames, tmp_path / SLOT / "capture.json"),
        lambda: Sidecar.from_table({"t_utc": t_utc}, tmp_path / "a.json"),
        lambda: Sidecar.from_table({"sun": {"measured": measured}}, tmp_path / "a.json"),
    )
    for read in reads:
        with pytest.raises((InputError, ValueError), match=f"time '?{int(year):d}|time '{year}"):
            read()


def test_a_journal_cannot_move_a_file_into_the_session(rig: Field, tmp_path: Path) -> None:
    thesis = rig.session.root.parent / "thesis.txt"
    thesis.write_text("precious")
    folder = rig.session.capture_file(SLOT).parent
    folder.mkdir(parents=True)
    fields = frame_fields(Frame(0, "00.dng", Exposure(1.0, 5.6), None, T0 - timedelta(hours=1)))
    journal = Journal(rig.session)
    early = T0 - timedelta(hours=1)
    journal.append("started", early, slot=SLOT, attempt=1)
    frame = {**fields, "file": "../../../thesis.txt", "instead_of": "../../../thesis.txt"}
    journal.append("frame", early, slot=SLOT, frame=frame)  # type: ignore[typeddict-item]
    journal.close()
    rig.run()
    assert damaged_lines(rig.session) == [2]
    assert thesis.read_text() == "precious"


def test_a_frame_that_is_a_link_is_not_merged(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s")
    folder = session.capture_file(SLOT).parent
    folder.mkdir(parents=True)
    secret = tmp_path / "secret.dng"
    secret.write_text("secret")
    (folder / "00.dng").symlink_to(secret)
    with pytest.raises(InputError, match="a symbolic link"):
        shots_of_slot(folder)
    fields = frame_fields(Frame(0, "00.dng", Exposure(1.0, 5.6), None, T0))
    write_object(session.capture_file(SLOT), {"format": 1, "slot": SLOT, "frames": [fields]})
    with pytest.raises(InputError, match="a symbolic link"):
        shots_of_slot(folder)


def pairs(path: Path, panorama: str, sunpatch: str = "") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    PairsFile(path, (PairRow(T0, panorama, 100.0, 50.0, sunpatch=sunpatch),)).write()
    return path


@pytest.mark.parametrize("place", ["pairs.csv", "more/pairs.csv"])
@pytest.mark.parametrize(
    "name", ["../x.exr", "/etc/passwd", "panoramas/../../x.exr", "panoramas/l"]
)
def test_pairs_of_a_session_name_pictures_of_this_session(
    tmp_path: Path, place: str, name: str
) -> None:
    session = make_session(tmp_path / "s")
    name = name if place == "pairs.csv" or name.startswith("/") else f"../{name}"
    session.panoramas.mkdir()
    (session.panoramas / "l").symlink_to("/etc/passwd")
    for path in (
        pairs(session.root / place, name),
        pairs(session.root / place, f"panoramas/{SLOT}.exr", name),
    ):
        with pytest.raises(InputError, match=r"line 2: the file name|a symbolic link"):
            PairsFile.read(path)


def test_pairs_may_name_pictures_anywhere_outside_a_session(tmp_path: Path) -> None:
    path = pairs(tmp_path / "tape" / "9d.csv", "../panoramas/x.hdr", "/data/y.hdr")
    assert len(PairsFile.read(path).rows) == 1
    truth = make_session(tmp_path / "s").truth_pairs
    assert len(PairsFile.read(pairs(truth, "a.exr", "../sunpatches/a.exr")).rows) == 1


@pytest.mark.parametrize(
    "text",
    [
        "plan = 5",
        "[plan]\nrevision = '../../x'",
        "[plan]\nolder_sha256 = [1]",
        "[plan]\nseconds_per_slot = 1e308",
        "[plan]\nrevision = 1180591620717411303424",
        "[[logger_files]]\nfile = 'x'\nutc_offset_s = 1e308",
        "[capture]\ngrace_s = 'long'",
        "[capture]\ngrace_s = nan",
        "devices = []",
        "[devices]\nuris = 'x'",
        "[devices.uris]\ncamera = 5",
        "[[logger_files]]\nfile = 1",
        "imported = [1]",
        "setup = 'x'",
    ],
)
def test_a_wrong_type_in_session_toml_is_one_line(tmp_path: Path, text: str) -> None:
    session = make_session(tmp_path / "s")
    session.toml.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"session\.toml: \w.*; expected TOML with the types"):
        open_session(session.root)


# ----------------------------------------------------------------------------------------------
# messages


def test_an_outbox_of_another_computer_is_not_sent(tmp_path: Path) -> None:
    """Earlier versions stored messages in the session; one that travels may be anybody's."""
    session, sent = make_session(tmp_path / "s"), list[Message]()
    stored = session.root / "outbox.jsonl"
    stored.write_text('{"title": "id_rsa", "body": "x", "picture": "/etc/passwd", "seal": ""}\n')
    with open_alerts(session, lambda message: not sent.append(message), "", print) as remote:
        remote.send(Message("own", ""))
    assert [message.title for message in sent] == ["own"] and stored.is_file()


def test_the_contact_sheet_of_a_summary_is_no_link(tmp_path: Path) -> None:
    session = make_session(tmp_path / "s")
    session.panoramas.mkdir()
    (session.panoramas / "contact-1.png").symlink_to("/etc/passwd")
    assert _latest_contact_sheet(session) is None
    (session.panoramas / "contact-0.png").touch()
    assert _latest_contact_sheet(session) == session.panoramas / "contact-0.png"
