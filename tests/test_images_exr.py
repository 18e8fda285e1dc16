"""EXR pictures of other programs."""

from __future__ import annotations

import struct
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest

from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag
from fieldlum.optics.images import NO_UNIT, opened_exr, read_exr

REC709 = np.array([0.2126, 0.7152, 0.0722])
SHAPE = (6, 9)


def _write(path: Path, channels: dict[str, np.ndarray], **header: Any) -> Path:
    head = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **header}
    OpenEXR.File(head, channels).write(str(path))
    return path


def _rgb(kind: type = np.float32) -> np.ndarray:
    return np.random.default_rng(3).uniform(1.0, 900.0, (*SHAPE, 3)).astype(kind)


@pytest.mark.contract
@pytest.mark.contract
@pytest.mark.parametrize("kind", [np.float16, np.float32])
@pytest.mark.parametrize("alpha", [False, True])
def test_rgb_and_rgba_of_half_and_float(tmp_path: Path, kind: type, alpha: bool) -> None:
    rgb = _rgb(kind)
    channels = {c: np.ascontiguousarray(rgb[..., i]) for i, c in enumerate("RGB")}
    if alpha:
        channels["A"] = np.ones(SHAPE, kind)
    picture, view = read_exr(_write(tmp_path / "a.exr", channels))
    np.testing.assert_allclose(picture.luminance_cdm2, rgb.astype(float) @ REC709, rtol=2e-4)
    assert picture.luminance_cdm2.dtype == np.float32
    assert view == ""
    assert picture.attributes["note"] == NO_UNIT


@pytest.mark.contract
@pytest.mark.authority
def test_chromaticities_and_white_luminance_set_the_unit(tmp_path: Path) -> None:
    rgb = _rgb()
    radiance = (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, 1 / 3, 1 / 3)
    channels = {c: np.ascontiguousarray(rgb[..., i]) for i, c in enumerate("RGB")}
    path = _write(tmp_path / "a.exr", channels, chromaticities=radiance, whiteLuminance=179.0)
    picture = read_exr(path)[0]
    expected = 179.0 * rgb @ np.array([0.265, 0.670, 0.065])
    np.testing.assert_allclose(picture.luminance_cdm2, expected, rtol=3e-3)
    assert "note" not in picture.attributes


@pytest.mark.contract
@pytest.mark.contract
def test_tiles_and_the_only_layer_are_read(tmp_path: Path) -> None:
    rgb = _rgb()
    channels = {f"beauty.{c}": np.ascontiguousarray(rgb[..., i]) for i, c in enumerate("RGB")}
    channels["depth.Z"] = np.ones(SHAPE, np.float32)
    tiles = OpenEXR.TileDescription()
    tiles.xSize = tiles.ySize = 4
    path = _write(tmp_path / "a.exr", channels, type=OpenEXR.tiledimage, tiles=tiles)
    np.testing.assert_allclose(read_exr(path)[0].luminance_cdm2, rgb @ REC709, rtol=2e-4)


@pytest.mark.contract
@pytest.mark.contract
def test_two_layers_are_refused_with_their_names(tmp_path: Path) -> None:
    plane = np.ones(SHAPE, np.float32)
    channels = {f"{layer}.{c}": plane for layer in ("sun", "sky") for c in "RGB"}
    with pytest.raises(InputError, match=r"2 layers: sky, sun.*--part NAME"):
        read_exr(_write(tmp_path / "a.exr", channels))


@pytest.mark.contract
@pytest.mark.contract
def test_a_crop_stands_in_its_display_window(tmp_path: Path) -> None:
    """What the file does not hold is outside the lens, never black."""
    window = (np.array([0, 0], np.int32), np.array([19, 9], np.int32))
    data = (np.array([5, 2], np.int32), np.array([5 + 8, 2 + 5], np.int32))
    path = _write(
        tmp_path / "a.exr",
        {"Y": np.full(SHAPE, 3.0, np.float32)},
        displayWindow=window,
        dataWindow=data,
    )
    picture = read_exr(path)[0]
    assert picture.luminance_cdm2.shape == (10, 20)
    assert picture.flags is not None
    inside = picture.flags != Flag.OUTSIDE_LENS
    assert inside.sum() == SHAPE[0] * SHAPE[1] and inside[2, 5] and not inside[1, 5]
    assert (picture.luminance_cdm2[inside] == 3.0).all()


@pytest.mark.contract
@pytest.mark.contract
def test_a_picture_that_claims_too_many_pixels_is_refused_before_decoding(tmp_path: Path) -> None:
    path = _write(tmp_path / "a.exr", {"Y": np.ones(SHAPE, np.float32)})
    data = path.read_bytes()
    box = struct.pack("<4i", 0, 0, SHAPE[1] - 1, SHAPE[0] - 1)
    assert data.count(box) == 2
    path.write_bytes(data.replace(box, struct.pack("<4i", 0, 0, 39_999, 39_999)))
    with pytest.raises(InputError, match="40000 x 40000"):
        read_exr(path)


@pytest.mark.contract
def test_what_another_thread_prints_while_a_picture_is_opened_is_shown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The watch page reads pictures in threads of a process that prints."""
    path, read, output = _write(tmp_path / "a.exr", {"RGB": _rgb()}), OpenEXR.File, sys.stdout

    def read_while_another_prints(*arguments: Any, **how: Any) -> Any:
        other = threading.Thread(target=print, args=("from another thread",))
        other.start()
        other.join()
        print("of OpenEXR" if "broken" in arguments[0] else "", end="")
        return read(*arguments, **how)

    monkeypatch.setattr(OpenEXR, "File", read_while_another_prints)
    with opened_exr(path, header_only=True) as exr:
        assert len(exr.parts) == 1
    assert set(capsys.readouterr().out.split("\n")) == {"from another thread", ""}
    broken = path.rename(tmp_path / "broken.exr")
    with pytest.raises(ValueError, match="of OpenEXR"), opened_exr(broken, header_only=True):
        pass
    assert sys.stdout is output
