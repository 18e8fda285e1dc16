"""devices: a tethered camera, on the virtual Nikon that the gphoto2 wheel ships; hangs and
crashes on stand-ins.
"""

import errno
import io
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from fieldlum.capture.frame_checks import compare_exif
from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure
from fieldlum.devices import not_offered, open_camera
from fieldlum.devices.clock import FastClock
from fieldlum.devices.gphoto import Child, GphotoCamera, choose, serve, setting_value

pytest.importorskip("gphoto2", reason="the gphoto2 extra is not installed")
CLOCK = FastClock(datetime(2027, 3, 20, 15, tzinfo=UTC))
SIZE = 12_000


def photo(exposure: Exposure) -> bytes:
    """A JPEG with EXIF, padded: the virtual camera fixes the size of its picture when it is
    opened.
    """
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    exif = Image.Exif()
    fields = exif.get_ifd(0x8769)
    fields[33434] = IFDRational(round(exposure.shutter_s * 10_000), 10_000)
    fields[33437], fields[34855] = (
        IFDRational(round(exposure.f_number * 10), 10),
        round(exposure.iso),
    )
    buffer = io.BytesIO()
    Image.new("RGB", (64, 64), (90, 90, 90)).save(buffer, "JPEG", exif=exif)
    return buffer.getvalue().ljust(SIZE, b"\0")


@pytest.fixture
def picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[[Exposure], None]]:
    """Plays the sensor: what the virtual camera's next picture will be."""
    source = tmp_path / "vcamera" / "DCIM" / "100NIKON" / "DSC_0001.JPG"
    source.parent.mkdir(parents=True)
    monkeypatch.setenv(
        "VCAMERADIR", str(tmp_path / "vcamera")
    )  # read when the child imports gphoto2

    def play(exposure: Exposure) -> None:
        source.write_bytes(photo(exposure))

    play(Exposure(0.01, 5.6))
    yield play


@pytest.mark.slow
@pytest.mark.authority
def test_bracket_on_the_virtual_camera(picture: Callable[[Exposure], None], tmp_path: Path) -> None:
    camera = open_camera("gphoto:?delete=1", clock=CLOCK)
    assert camera.info.model == "VC" and camera.info.clock_offset_s is not None
    for shutter_s in (0.1, 0.01, 0.0025):
        exposure = Exposure(shutter_s, 5.6, 100.0)
        picture(exposure)
        path = camera.expose(exposure, tmp_path / f"f_{shutter_s}")
        assert path.name == f"f_{shutter_s}.jpg"
        assert path.read_bytes() == photo(exposure), "the file is the camera's, bit for bit"
    camera.close()


@pytest.mark.slow
@pytest.mark.contract
def test_what_is_not_offered_is_known_without_a_picture(
    picture: Callable[[Exposure], None],
) -> None:
    camera = open_camera("gphoto:", clock=CLOCK)
    offered, between, wide = Exposure(0.01, 5.6), Exposure(1 / 250, 5.6), Exposure(0.01, 2.0)
    assert not_offered(camera, [offered]) == []
    said = not_offered(camera, [offered, between, wide, between])
    assert [text.partition(":")[0] for text in said] == ["camera shutter", "camera aperture"]
    camera.close()


@pytest.mark.slow
@pytest.mark.contract
def test_settings_are_checked_before_and_after(
    picture: Callable[[Exposure], None], tmp_path: Path
) -> None:
    camera = open_camera("gphoto:Nikon", clock=CLOCK)
    with pytest.raises(
        DeviceError,
        match=r"shutter: 0.004 s is not offered by the camera; the nearest value is 1/200",
    ):
        camera.expose(Exposure(1 / 250, 5.6), tmp_path / "f")
    with pytest.raises(
        DeviceError, match=r"aperture: 2 is not offered"
    ):  # the value that kills libgphoto2
        camera.expose(Exposure(0.01, 2.0), tmp_path / "f")
    with pytest.raises(DeviceError, match="no turning head"):
        camera.expose(Exposure(0.01, 5.6), tmp_path / "f", heading_deg=90.0)
    assert not list(tmp_path.glob("f*"))
    camera.close()


@pytest.mark.slow
@pytest.mark.contract
def test_what_the_camera_made_is_kept(picture: Callable[[Exposure], None], tmp_path: Path) -> None:
    camera = open_camera("gphoto:Nikon?delete=1", clock=CLOCK)
    asked, made = Exposure(0.01, 5.6), Exposure(0.02, 5.6)
    picture(made)
    path = camera.expose(asked, tmp_path / "f")
    assert path.read_bytes() == photo(made), "its card is cleared: this is the only copy"
    assert compare_exif(path, asked)[0] == "shutter 0.02 instead of 0.01"
    camera.close()


@pytest.mark.slow
@pytest.mark.contract
def test_a_full_disk_is_no_fault_of_the_camera(
    picture: Callable[[Exposure], None], tmp_path: Path
) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    camera = open_camera("gphoto:", clock=CLOCK)
    (tmp_path / "f.jpg").symlink_to("/dev/full")
    with pytest.raises(OSError, match="No space left") as caught:
        camera.expose(Exposure(0.01, 5.6), tmp_path / "f")
    assert caught.value.errno == errno.ENOSPC
    camera.close()


@pytest.mark.slow
@pytest.mark.contract
def test_a_full_card_is_told(picture: Callable[[Exposure], None], tmp_path: Path) -> None:
    camera = GphotoCamera(serve)
    with pytest.raises(DeviceError, match="card is full"):
        for i in range(40):  # the virtual card takes 26 pictures
            camera.expose(Exposure(0.01, 5.6), tmp_path / f"f{i}")
    assert len(list(tmp_path.glob("f*.jpg"))) > 20
    camera.close()


@pytest.mark.slow
@pytest.mark.contract
def test_no_camera_and_unknown_names(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "empty" / "DCIM").mkdir(parents=True)
    monkeypatch.setenv("VCAMERADIR", str(tmp_path / "empty"))
    with pytest.raises(DeviceError, match="no camera named Hasselblad"):
        open_camera("gphoto:Hasselblad", clock=CLOCK)
    with pytest.raises(DeviceError, match="unknown option 'delet'"):
        open_camera("gphoto:?delet=1", clock=CLOCK)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1/250", 0.004),
        ("0.0040s", 0.004),
        ("1.3", 1.3),
        ("30", 30.0),
        ("13/10", 1.3),
        ("f/5.6", 5.6),
        ("5.6", 5.6),
        ("ISO 100", 100.0),
        ("100", 100.0),
        ("Bulb", None),
        ("Auto", None),
        ("", None),
        ("1/0", None),
        ("x200", None),
    ],
)
def test_texts_of_cameras(text: str, value: float | None) -> None:
    assert setting_value(text) == value


@pytest.mark.contract
def test_choose_gives_the_camera_its_own_text() -> None:
    assert choose("shutter", 1 / 64, ["Bulb", "1/50", "1/60", "1/80"]) == "1/60"
    with pytest.raises(DeviceError, match="the camera offers no values"):
        choose("iso", 100.0, ["Auto"])


# ------------------------------------------------------------------------------------------ hangs
# and crashes


def moody(pipe: Connection) -> None:
    """A stand-in for the driver: hangs or dies when it is told to."""
    while True:
        command, arguments = pipe.recv()
        if command == "open":
            settings = {"shutter": ("shutterspeed", ["1/100"])}
            pipe.send(("ok", {"make": "m", "model": arguments[0], "settings": settings}))
        elif command == "expose" and Path(arguments[0]).name == "hang":
            time.sleep(60)
        elif command == "expose" and Path(arguments[0]).name == "crash":
            os.abort()
        elif command == "expose":
            path = Path(f"{arguments[0]}.jpg")
            shutil.copyfile(path.with_name("photo"), path)
            pipe.send(("ok", str(path)))
        elif command == "close":
            return
        else:
            pipe.send(("ok", arguments[1]))


@pytest.mark.slow
@pytest.mark.contract
def test_hang_and_crash_are_survived(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    exposure = Exposure(0.01, 5.6)
    (tmp_path / "photo").write_bytes(photo(exposure))
    for name, why in (
        ("hang", r"did not answer within 3.01 s and its process was killed"),
        ("crash", r"crashed in 'expose' \(signal SIGABRT\)"),
    ):
        camera = GphotoCamera(moody, "Moody")
        monkeypatch.setattr("fieldlum.devices.gphoto.PATIENCE_S", 3.0)
        assert camera.expose(exposure, tmp_path / f"before_{name}").is_file()
        with pytest.raises(DeviceError, match=why):
            camera.expose(exposure, tmp_path / name)
        with pytest.raises(DeviceError, match="gphoto: "):  # until it is opened again
            camera.expose(exposure, tmp_path / "after")
        camera.close()
        monkeypatch.undo()


def dies(pipe: Connection) -> None:
    sys.exit(3)


@pytest.mark.slow
@pytest.mark.contract
def test_a_child_that_dies_at_once() -> None:
    child = Child("driver", dies)
    with pytest.raises(DeviceError, match=r"crashed in 'open' \(exit code 3\)"):
        child.ask("open", timeout_s=60.0)
    child.close()
