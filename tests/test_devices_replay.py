"""devices: frames of an earlier day, given out again in their order."""

from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from fieldlum.core.errors import DeviceError
from fieldlum.core.records import Exposure
from fieldlum.devices import open_camera
from fieldlum.devices.clock import FastClock
from fieldlum.optics.raw.writing import write_dng, write_jpeg

pytestmark = pytest.mark.contract

START = datetime(2027, 3, 20, 15, tzinfo=UTC)
CLOCK = FastClock(START)
LONG, SHORT = Exposure(1 / 60, 5.6), Exposure(1 / 250, 5.6)


def card(folder: Path) -> None:
    """Two brackets, written in another order than they were taken, and things that are no
    frames.
    """
    (folder / "100CANON").mkdir(parents=True)
    for number, (exposure, minute) in enumerate([(SHORT, 61), (LONG, 60), (SHORT, 1), (LONG, 0)]):
        t_camera = START.replace(tzinfo=None) + timedelta(minutes=minute)
        path = folder / "100CANON" / f"IMG_{number}.DNG"
        counts = np.full((4, 4), 600 + number, np.uint16)
        write_dng(
            path,
            counts,
            exposure,
            black_dn=(512,) * 4,
            white_dn=16383,
            t_camera=t_camera,
            model="M",
        )
    (folder / "100CANON" / "notes.txt").write_text("x")
    (folder / "broken.jpg").write_bytes(b"\xff\xd8\xff")
    write_jpeg(folder / "other.jpg", np.zeros((8, 8, 3), np.uint8), Exposure(2.0, 5.6))


def test_frames_come_in_the_order_of_the_cameras_clock(tmp_path: Path) -> None:
    card(tmp_path / "card")
    camera = open_camera(f"replay:{tmp_path / 'card'}", clock=CLOCK)
    assert camera.info.model == "M"
    given = [camera.expose(e, tmp_path / f"f{i}") for i, e in enumerate((LONG, SHORT, SHORT, LONG))]
    originals = [tmp_path / "card" / "100CANON" / f"IMG_{n}.DNG" for n in (3, 2, 0, 1)]
    assert [p.read_bytes() for p in given] == [p.read_bytes() for p in originals]
    assert given[0].name == "f0.dng"
    with pytest.raises(DeviceError, match=r"no unused frame of 1/250 f/5.6 .*, only 1"):
        camera.expose(SHORT, tmp_path / "g")
    camera.close()


def test_folders_without_frames(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="no frames in"):
        open_camera(f"replay:{tmp_path}", clock=CLOCK)
    with pytest.raises(DeviceError, match="no such folder"):
        open_camera("replay:/does/not/exist", clock=CLOCK)
