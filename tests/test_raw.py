"""raw: frames in, frames out, and every broken file told in one line."""

import contextlib
import os
import struct
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure
from fieldlum.optics.raw import channel_positions, read_exif, read_jpeg, read_mosaic
from fieldlum.optics.raw.writing import write_dng, write_jpeg

WHEN = datetime(2027, 3, 20, 15, 30, 0, 250_000, tzinfo=UTC)
EXPOSURE = Exposure(1 / 250, 5.6, 100.0, "nd3")


def counts(height: int = 32, width: int = 50) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 16383, (height, width)).astype(np.uint16)


def dng(path: Path, cfa: str = "RGGB") -> np.ndarray:
    given_counts = counts()
    black = (512.0, 513.0, 514.0, 515.0)
    write_dng(
        path,
        given_counts,
        EXPOSURE,
        black_dn=black,
        white_dn=16383,
        cfa=cfa,
        t_camera=WHEN,
        model="Cam 1",
    )
    return given_counts


@pytest.mark.analytic
@pytest.mark.parametrize("cfa", ["RGGB", "BGGR", "GRBG", "GBRG"])
def test_dng_returns_bit_for_bit(tmp_path: Path, cfa: str) -> None:
    written = dng(tmp_path / "f.dng", cfa)
    mosaic = read_mosaic(tmp_path / "f.dng")
    assert np.array_equal(mosaic.counts, written)
    assert (mosaic.cfa, mosaic.black_dn, mosaic.white_dn) == (cfa, (512, 513, 514, 515), 16383)
    assert mosaic.exposure == EXPOSURE
    assert mosaic.t_camera == WHEN and mosaic.make == "fieldlum" and mosaic.model == "Cam 1"
    assert mosaic.colour_matrix is not None and mosaic.colour_matrix[0, 0] == pytest.approx(
        3.2404542, abs=1e-6
    )


@pytest.mark.analytic
def test_libraw_reads_the_same_exposure(tmp_path: Path) -> None:
    import rawpy

    dng(tmp_path / "f.dng")
    with rawpy.imread(str(tmp_path / "f.dng")) as raw:
        assert raw.other.shutter_speed == pytest.approx(0.004)
        assert (raw.other.aperture, raw.other.iso_speed) == (pytest.approx(5.6), 100)


@pytest.mark.analytic
def test_jpeg_round_trip(tmp_path: Path) -> None:
    grey = np.full((16, 24, 3), 120, np.uint8)
    write_jpeg(tmp_path / "f.jpg", grey, EXPOSURE, t_camera=WHEN, model="Cam 1")
    frame = read_jpeg(tmp_path / "f.jpg")
    assert np.abs(frame.codes.astype(int) - 120).max() <= 1
    assert frame.exposure == EXPOSURE and frame.t_camera == WHEN
    assert read_exif(tmp_path / "f.jpg").exposure == EXPOSURE


@pytest.mark.contract
def test_green_one_stands_in_the_rows_of_red() -> None:
    assert channel_positions("GBRG") == ((1, 0), (1, 1), (0, 0), (0, 1))


@pytest.mark.contract
@pytest.mark.parametrize("magic", [b"IIU\0", b"IIRO", b"IIRS"])
def test_a_cut_raw_of_a_maker_with_a_tiff_of_its_own_is_refused(
    tmp_path: Path, magic: bytes
) -> None:
    """Panasonic (whose newer files name the place of their pixels in tag 280) and Olympus."""
    dng(tmp_path / "f.dng")
    whole = bytearray((tmp_path / "f.dng").read_bytes())
    whole[:4] = magic
    if magic == b"IIU\0":
        strips, planar = (
            whole.index(struct.pack("<HHI", 273, 4, 1)),
            whole.index(struct.pack("<HHI", 284, 3, 1)),
        )
        whole[planar : planar + 12] = (
            struct.pack("<HHI", 280, 4, 1) + whole[strips + 8 : strips + 12]
        )
        whole[strips + 8 : strips + 12] = b"\xff" * 4
    for size, cut in ((len(whole), False), (len(whole) - 2, True), (2000, True)):
        (tmp_path / "f.raw").write_bytes(whole[:size])
        said = ""
        try:
            read_mosaic(tmp_path / "f.raw")
        except (
            InputError
        ) as error:  # of the whole one too: LibRaw may know that it is none of theirs
            said = str(error)
        assert ("its pixels end later" in said) == cut


@pytest.mark.contract
def test_a_cut_raw_is_refused(tmp_path: Path) -> None:
    dng(tmp_path / "f.dng")
    whole = (tmp_path / "f.dng").read_bytes()
    for size in (0, 5, 60, 400, len(whole) // 2, len(whole) - 1):
        (tmp_path / "cut.dng").write_bytes(whole[:size])
        with pytest.raises(InputError) as caught:
            read_mosaic(tmp_path / "cut.dng")
        assert "cut.dng" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("compression", "said"), [(7, "no lossless JPEG"), (8, "LibRaw"), (5, "LibRaw")]
)
def test_pixels_of_another_kind_are_no_picture(tmp_path: Path, compression: int, said: str) -> None:
    dng(tmp_path / "f.dng")
    body = bytearray((tmp_path / "f.dng").read_bytes())
    at = body.index(b"\x03\x01\x03\x00\x01\x00\x00\x00\x01\x00")  # compression 1: none
    body[at + 8] = compression
    (tmp_path / "f.dng").write_bytes(bytes(body))
    with pytest.raises(InputError, match=said):
        read_mosaic(tmp_path / "f.dng")


@pytest.mark.contract
def test_what_libraw_only_mutters_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import rawpy

    dng(tmp_path / "f.dng")
    whole = rawpy.imread

    def muttering(path: str) -> object:
        os.write(2, b"f.dng: data corrupted at 25108\nsomebody else's line\n")
        return whole(path)

    monkeypatch.setattr(rawpy, "imread", muttering)
    kept = os.dup(2)
    with (tmp_path / "stderr").open("wb") as file:
        os.dup2(file.fileno(), 2)
        try:
            with pytest.raises(InputError, match="LibRaw: data corrupted"):
                read_mosaic(tmp_path / "f.dng")
        finally:
            os.dup2(kept, 2)
            os.close(kept)
    assert (tmp_path / "stderr").read_text() == "somebody else's line\n"


@pytest.mark.contract
def test_a_renamed_jpeg_is_named(tmp_path: Path) -> None:
    write_jpeg(tmp_path / "f.jpg", np.zeros((16, 16, 3), np.uint8), EXPOSURE)
    (tmp_path / "f.jpg").rename(tmp_path / "f.dng")
    with pytest.raises(InputError, match=r"content is a JPEG.*give the file the suffix .jpg"):
        read_mosaic(tmp_path / "f.dng")


@pytest.mark.contract
def test_a_png_is_refused_with_a_remedy_that_can_be_followed(tmp_path: Path) -> None:
    (tmp_path / "f.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(64))
    with pytest.raises(InputError, match=r"a PNG picture; .*leave the file out if it is no frame"):
        read_mosaic(tmp_path / "f.png")


@pytest.mark.contract
def test_a_renamed_raw_is_no_jpeg(tmp_path: Path) -> None:
    dng(tmp_path / "f.jpg")
    with pytest.raises(InputError, match="no JPEG"):
        read_jpeg(tmp_path / "f.jpg")


@pytest.mark.contract
def test_missing_shutter_names_the_remedy(tmp_path: Path) -> None:
    from PIL import Image

    Image.new("RGB", (16, 16)).save(tmp_path / "f.jpg")
    for read in (read_jpeg, read_exif):
        with pytest.raises(
            InputError, match=r"no exposure time in the EXIF.*exiftool -ExposureTime"
        ):
            read(tmp_path / "f.jpg")


@pytest.mark.contract
def test_a_missing_file(tmp_path: Path) -> None:
    for read in (read_mosaic, read_jpeg, read_exif):
        with pytest.raises(InputError, match="No such file"):
            read(tmp_path / "none.dng")


@pytest.mark.slow
@pytest.mark.property
@settings(
    deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(st.data())
def test_a_mutated_frame_reads_or_is_refused(tmp_path: Path, data: st.DataObject) -> None:
    suffix, read = data.draw(st.sampled_from([(".dng", read_mosaic), (".jpg", read_jpeg)]))
    path = tmp_path / f"f{suffix}"
    if suffix == ".dng":
        dng(path)
    else:
        write_jpeg(path, np.full((24, 24, 3), 90, np.uint8), EXPOSURE)
    body = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        body[data.draw(st.integers(0, min(len(body) - 1, 700)))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(body))
    with contextlib.suppress(InputError):
        frame = read(path)
        assert frame.exposure.shutter_s > 0


@pytest.mark.contract
@pytest.mark.parametrize("size", [1, 4, 6])  # monochrome; quad Bayer; X-Trans
def test_a_mosaic_other_than_bayers_is_named(size: int) -> None:
    import rawpy

    from fieldlum.optics.raw import _pattern  # pyright: ignore[reportPrivateUsage]

    raw = SimpleNamespace(raw_type=rawpy.RawType.Flat, raw_pattern=np.zeros((size, size), int))
    with pytest.raises(InputError) as refused:
        _pattern(Path("a.raf"), raw)
    found = f"a.raf: a mosaic of {size} x {size} colour filters; expected a Bayer mosaic"
    assert str(refused.value).startswith(found)
