"""Pictures and frames that other programs and cameras write.

Expected values: the tags as exiv2 (Python exiv2 0.19.2) printed them for these very
files; luminances by OpenEXR and Radiance's own pvalue; published colour spaces.
"""

from __future__ import annotations

import struct
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import IO

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from outside_jpeg import GOOD, Value, exif_segment, jpeg, segment
from PIL import TiffImagePlugin

from fieldlum.capture.import_card import card_files, without_edited
from fieldlum.capture.match_card import CardFrame
from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure
from fieldlum.optics.images import read_exr, read_radiance_hdr, rgb_to_xyz
from fieldlum.optics.raw import read_exif, read_jpeg, read_mosaic
from fieldlum.optics.raw.writing import write_dng
from fieldlum.sky.sky_view.view import SkyView

EXPOSURE = Exposure(1 / 60, 5.6, 100.0)
NAIVE = datetime(2027, 3, 20, 7, 30, tzinfo=UTC).replace(tzinfo=None)

# ----------------------------------------------------------------------------------------------
# EXIF


def _mpf(entry_offset: int = 2**31) -> bytes:
    """Return an index of two pictures whose entries are outside of the segment."""
    tags = struct.pack("<HHII", 0xB000, 7, 4, 0x30303130)
    tags += struct.pack("<HHII", 0xB001, 4, 1, 2)
    tags += struct.pack("<HHII", 0xB002, 7, 32, entry_offset)
    return segment(0xE2, b"MPF\0II*\0\x08\0\0\0" + struct.pack("<H", 3) + tags + bytes(4))


BEFORE_EXIF = {
    "app7 and app8": segment(0xE7, bytes(40_000)) + segment(0xE8, bytes(60_000)),
    "broken mpf": _mpf(),
    "fill bytes": b"\xff\xff" + segment(0xE0, b"JFIF\0\1\2\0\0\1\0\1\0\0") + b"\xff\xff",
    "xmp first": segment(0xE1, b"http://ns.adobe.com/xap/1.0/\0" + b"<x/>" * 12_000),
    "comments": segment(0xFE, b"Exif\0\0" * 9000) + segment(0xED, b"Photoshop 3.0\0" * 4000),
    "adobe": segment(0xEE, b"Adobe\0\x64\0\0\0\0\1") + segment(0xEF, bytes(65_000)),
}


@pytest.mark.authority
@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("before", BEFORE_EXIF)
def test_exif_is_found_behind_any_segments(tmp_path: Path, before: str, order: str) -> None:
    """Expected: exiv2 0.19.2, ExposureTime 1/60, FNumber 28/5, ISOSpeedRatings 100."""
    path = jpeg(tmp_path / "f.jpg", BEFORE_EXIF[before], exif_segment(GOOD, order))
    frame = read_jpeg(path)
    assert (frame.exposure, frame.t_camera, frame.model) == (EXPOSURE, NAIVE, "Model 1")
    assert np.abs(frame.codes.astype(int) - 120).max() <= 1


@pytest.mark.property
@settings(max_examples=20, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from([m for m in range(0xE0, 0xF0) if m != 0xE1] + [0xFE]),
            st.binary(max_size=200),
            st.integers(0, 3),
        ),
        max_size=6,
    )
)
def test_any_segments_before_exif(
    tmp_path_factory: pytest.TempPathFactory, parts: list[tuple[int, bytes, int]]
) -> None:
    before = b"".join(b"\xff" * fill + segment(mark, body) for mark, body, fill in parts)
    path = jpeg(tmp_path_factory.mktemp("j") / "f.jpg", before, exif_segment(GOOD))
    assert read_exif(path).exposure == EXPOSURE


@pytest.mark.authority
@pytest.mark.parametrize(
    ("tags", "iso"),
    [
        ({34855: 65535, 34864: 2, 34866: 102400}, 102400),
        ({34855: 65535, 34864: 1, 34865: 204800}, 204800),
        ({34855: 65535, 34864: 3, 34867: 81920}, 81920),
        ({34855: 0, 34864: 2, 34866: 200}, 200),
        ({34864: 2, 34866: 50}, 50),
        ({34866: 400}, 400),
        ({34855: 800, 34864: 2, 34866: 400}, 800),
    ],
)
def test_iso_beyond_sixteen_bits(tmp_path: Path, tags: dict[int, Value], iso: float) -> None:
    """Expected: exiv2.isoSpeed for the same file; without SensitivityType the tag itself."""
    rest: dict[int, Value] = {k: v for k, v in GOOD.items() if k != 34855}
    path = jpeg(tmp_path / "f.jpg", exif_segment(rest | tags))
    assert read_exif(path).exposure.iso == iso


@pytest.mark.contract
def test_an_iso_of_65535_alone_is_none(tmp_path: Path) -> None:
    path = jpeg(tmp_path / "f.jpg", exif_segment(GOOD | {34855: 65535}))
    with pytest.raises(InputError, match="no ISO in the EXIF"):
        read_exif(path)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("program", "shown", "iso"),
    [
        ("exiftool", "Exposure Time                   : 1/60\nISO                   : 64\n", 64.0),
        ("exiv2", "Exposure time   : 1/60 s\nAperture        : F5.6\nISO speed       : 64\n", 64.0),
        ("exiftool", "ISO                     : 65535\n", 0.0),
        ("exiv2", "ISO speed       : \n", 0.0),
    ],
)
def test_an_iso_of_the_makers_notes_is_that_of_exiftool_or_exiv2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, program: str, shown: str, iso: float
) -> None:
    """The texts are what both print for Casio.jpg of exiftool's own tests."""
    (tmp_path / program).write_text(f"#!/bin/sh\nprintf '{shown}'\n")
    (tmp_path / program).chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    rest = {k: v for k, v in GOOD.items() if k != 34855}
    path = jpeg(tmp_path / "f.jpg", exif_segment(rest))
    if not iso:
        with pytest.raises(InputError, match="no ISO in the EXIF"):
            read_exif(path)
        return
    assert read_exif(path).exposure == read_jpeg(path).exposure == Exposure(1 / 60, 5.6, iso)


@pytest.mark.authority
@pytest.mark.parametrize(
    ("tags", "when"),
    [
        ({36881: "   :  "}, NAIVE),
        ({36881: ""}, NAIVE),
        ({36881: "+99:99"}, NAIVE),
        ({36881: "local"}, NAIVE),
        ({36881: "+01:00"}, NAIVE.replace(tzinfo=timezone(timedelta(hours=1)))),
        ({36881: "Z"}, NAIVE.replace(tzinfo=UTC)),
        ({37521: "  "}, NAIVE),
        ({37521: "25 "}, NAIVE.replace(microsecond=250_000)),
        ({36867: "2027/03/20 07:30:00"}, NAIVE),
        ({36867: "2027-03-20 07:30:00"}, NAIVE),
        ({36867: "2027.03.20 07:30:00"}, NAIVE),
        ({36867: "2027-03-20T07:30:00Z"}, NAIVE.replace(tzinfo=UTC)),
        ({36867: "2027:3:20  7:30:00"}, NAIVE),
        ({36867: "    :  :     :  :  ", 36868: "2027:03:20 07:30:00"}, NAIVE),
        ({36867: "03/20/2027 07:30:00"}, None),
        ({36867: "0000:00:00 00:00:00"}, None),
    ],
)
def test_times_as_they_are_written(
    tmp_path: Path, tags: dict[int, Value], when: datetime | None
) -> None:
    """Expected: the fields that exiv2 prints; a blank zone is unknown."""
    path = jpeg(tmp_path / "f.jpg", exif_segment(GOOD | tags))
    assert read_exif(path).t_camera == when


@pytest.mark.contract
def test_a_broken_tag_costs_no_other(tmp_path: Path) -> None:
    path = jpeg(tmp_path / "f.jpg", exif_segment(GOOD | {36881: "+01:00", 37500: "x" * 50}))
    body = bytearray(path.read_bytes())
    maker_note = body.index(struct.pack("<HHI", 37500, 2, 51))
    body[maker_note + 8 : maker_note + 12] = b"\xff\xff\xff\x7f"  # its content is nowhere
    path.write_bytes(body)
    info = read_exif(path)
    assert info.exposure == EXPOSURE and info.model == "Model 1"
    assert info.t_camera == NAIVE.replace(tzinfo=timezone(timedelta(hours=1)))


@pytest.mark.contract
def test_the_profile_raises_the_limit_on_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As 108 megapixels and more, with a small limit; Pillow's own limit plays no part."""
    from PIL import Image

    path = jpeg(tmp_path / "f.jpg", exif_segment(GOOD), size=(40, 30))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 100)
    assert read_jpeg(path).codes.shape == (30, 40, 3)
    monkeypatch.setattr("fieldlum.optics.raw.MAX_PIXELS", 1000)
    assert read_jpeg(path, camera_pixels=1200).codes.shape == (30, 40, 3)
    with pytest.raises(InputError, match=r"40 x 30 pixels; expected at most 1,000 pixels"):
        read_jpeg(path)


@pytest.mark.contract
@pytest.mark.parametrize("cut", [0.3, 0.6, 0.9])
def test_a_cut_jpeg_is_named_in_words(tmp_path: Path, cut: float) -> None:
    path = jpeg(tmp_path / "f.jpg", exif_segment(GOOD), size=(320, 200))
    path.write_bytes(path.read_bytes()[: int(cut * path.stat().st_size)])
    with pytest.raises(InputError, match="damaged or cut short"):
        read_jpeg(path)
    path.write_bytes(path.read_bytes()[:90])  # within the EXIF: nobody can write it into this file
    with pytest.raises(InputError, match="damaged or cut short"):
        read_exif(path)


# ----------------------------------------------------------------------------------------------
# exposures beside a bracket


@pytest.mark.contract
@pytest.mark.parametrize(
    ("start", "kind"),
    [
        (b"\x89PNG\r\n\x1a\n", "a PNG picture"),
        (b"RIFF\0\1\0\0WEBP", "a WebP picture"),
        (b"\0\0\0\x24ftypheic", "an HEIC picture"),
    ],
)
def test_a_picture_renamed_to_jpg_is_named(tmp_path: Path, start: bytes, kind: str) -> None:
    """To copy it from the card again would change nothing."""
    (tmp_path / "a.jpg").write_bytes(start + bytes(200))
    with pytest.raises(InputError, match=f"no JPEG, but {kind}.*name the JPEG files"):
        read_jpeg(tmp_path / "a.jpg")


@pytest.mark.contract
def test_exposures_are_stated_beside_frames_without_exif(tmp_path: Path) -> None:
    names = ("a.jpg", "b.jpg", "c.jpg")
    rows = [f"{name},1/{60 * 2**k},8,100" for k, name in enumerate(names)]
    table = tmp_path / "exposures.csv"
    table.write_text("\ufefffile, shutter_s, f_number, iso\n" + "\r\n".join(rows) + "\n\n")
    for k, name in enumerate(names):
        exposure = read_jpeg(jpeg(tmp_path / name)).exposure
        assert exposure == Exposure(1 / (60 * 2**k), 8.0, 100.0)
    with pytest.raises(InputError, match=r"no exposure time .* no line d.jpg in exposures\.csv"):
        read_jpeg(jpeg(tmp_path / "d.jpg"))
    same = jpeg(tmp_path / "a.jpg", exif_segment(GOOD | {33437: (8, 1)}))
    assert read_exif(same).exposure.f_number == 8
    with pytest.raises(InputError, match=r"f-number 5.6 in the EXIF, but 8 in exposures.csv"):
        read_exif(jpeg(tmp_path / "a.jpg", exif_segment(GOOD)))


@pytest.mark.contract
def test_exposures_are_found_by_names_in_other_capitals(tmp_path: Path) -> None:
    """They are not if the folder has a file of that very name, or if two names are possible."""
    table = tmp_path / "exposures.csv"
    table.write_text("file,shutter_s,f_number,iso\nIMG_1.JPG,1/60,8,100\n")
    assert read_jpeg(jpeg(tmp_path / "img_1.jpg")).exposure.f_number == 8
    jpeg(tmp_path / "IMG_1.JPG")
    with pytest.raises(InputError, match="no exposure time"):
        read_jpeg(tmp_path / "img_1.jpg")
    (tmp_path / "IMG_1.JPG").unlink()
    table.write_text("file,shutter_s,f_number,iso\nIMG_1.JPG,1,8,100\nImg_1.jpg,2,8,100\n")
    with pytest.raises(InputError, match="no exposure time"):
        read_jpeg(tmp_path / "img_1.jpg")


@pytest.mark.contract
@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("file,shutter_s,f_number\n", "no column iso"),
        ("file,shutter_s,f_number,iso\na.jpg,0,5,8,100\n", "line 2: 5 cells"),
        ("file,shutter_s,f_number,iso\na.jpg,1,8\n", "line 2: 3 cells"),
        ("file,shutter_s,f_number,iso\na.jpg,1,8,0\n", "line 2: '0'"),
        ("file,shutter_s,f_number,iso\na.jpg,1_0,8,1\n", "line 2: '1_0'"),
        ("file,shutter_s,f_number,iso\na.jpg,1/60/2,8,1\n", "line 2: '1/60/2'"),
        ("file,shutter_s,f_number,iso\na.jpg,1,8,1\na.jpg,2,8,1\n", "line 3: a.jpg again"),
        ('file,shutter_s,f_number,iso\na.jpg,"1,8,1\nb.jpg,2,8,1\n', "line 2: a quotation mark"),
    ],
)
def test_invalid_exposures_are_refused_with_the_line(tmp_path: Path, text: str, found: str) -> None:
    (tmp_path / "exposures.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        read_jpeg(jpeg(tmp_path / "a.jpg"))
    assert found in str(caught.value) and "exposures.csv" in str(caught.value)


# ----------------------------------------------------------------------------------------------
# cards


def _card_frame(path: Path, second: int, *, size: tuple[int, int] = (24, 16)) -> CardFrame:
    exposure = Exposure(2.0**-second, 5.6, 100.0)
    when = datetime(2027, 3, 20, 7, 30, second, tzinfo=UTC)
    return CardFrame(jpeg(path, size=size, code=100 + second), exposure, when)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("name", "second", "size"),
    [
        ("IMG_0003_edit.JPG", 3, (24, 16)),
        ("IMG_0003-2.JPG", 3, (24, 16)),
        ("IMG_0003 (1).JPG", 3, (24, 16)),
        ("IMG_E0003.JPG", 3, (24, 16)),
        ("Copy of IMG_0003.JPG", 3, (24, 16)),
        ("office, brighter.jpg", 3, (24, 16)),
        ("Edited/IMG_0003.JPG", 3, (24, 16)),
        ("small/IMG_0003.JPG", 3, (12, 8)),
        ("IMG_0009.JPG", 9, (12, 8)),
    ],
)
def test_a_file_that_the_camera_did_not_write_splits_no_bracket(
    tmp_path: Path, name: str, second: int, size: tuple[int, int]
) -> None:
    folder = tmp_path / "DCIM" / "100CANON"
    frames = [_card_frame(folder / f"IMG_{k:04d}.JPG", k) for k in range(1, 6)]
    copy = _card_frame(folder / name, second, size=size)
    for size_px in ((24, 16), (6000, 4000)):
        kept, notes = without_edited([*frames, copy], size_px)
        assert kept == frames
        assert len(notes) == 1 and notes[0].startswith(str(copy.path))


@pytest.mark.contract
@pytest.mark.parametrize("name", ["IMG_{}-edited.JPG", "IMG_{} (1).JPG", "Copy of IMG_{}.JPG"])
def test_a_copy_of_every_frame_is_no_camera_of_its_own(tmp_path: Path, name: str) -> None:
    frames = [_card_frame(tmp_path / f"IMG_{k:04d}.JPG", k) for k in range(1, 6)]
    copies = [_card_frame(tmp_path / name.format(f"{k:04d}"), k) for k in range(1, 6)]
    kept, notes = without_edited([*copies, *frames], (24, 16))
    assert kept == frames and " and 4 more: a copy" in notes[0]


@pytest.mark.contract
def test_frames_of_one_second_with_their_own_numbers_remain(tmp_path: Path) -> None:
    frames = [_card_frame(tmp_path / f"IMG_{k:04d}.JPG", 3) for k in range(1, 6)]
    assert without_edited(frames, (24, 16)) == (frames, [])


@pytest.mark.contract
def test_folders_of_systems_are_no_folders_of_a_camera(tmp_path: Path) -> None:
    frame = jpeg(tmp_path / "DCIM" / "100CANON" / "IMG_0001.JPG")
    for folder in (".Trashes", "@eaDir/IMG_0001.JPG", "DCIM/.thumbnails", "DCIM/100CANON/@tmp"):
        jpeg(tmp_path / folder / "IMG_0001.JPG")
    assert card_files(tmp_path) == [frame]


# ----------------------------------------------------------------------------------------------
# raw


@pytest.mark.analytic
@pytest.mark.parametrize("cfa", ["RGGB", "GBRG", "GRBG", "BGGR"])
@pytest.mark.parametrize("top", [0, 1, 2, 3])
def test_black_levels_belong_to_the_active_area(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cfa: str, top: int
) -> None:
    """DNG 1.7: the cells of CFAPattern and BlackLevel begin at the ActiveArea."""
    save = TiffImagePlugin.ImageFileDirectory_v2.save

    def with_area(directory: TiffImagePlugin.ImageFileDirectory_v2, file: IO[bytes]) -> int:
        directory.tagtype[50829] = 4
        directory[50829] = (top, left, 30, 40)
        return save(directory, file)

    monkeypatch.setattr(TiffImagePlugin.ImageFileDirectory_v2, "save", with_area)
    for left in (0, 1):  # noqa: B007  (a variable of with_area)
        counts = np.full((32, 44), 5000, np.uint16)
        write_dng(
            tmp_path / "f.dng",
            counts,
            EXPOSURE,
            black_dn=(100, 200, 300, 400),
            white_dn=16383,
            cfa=cfa,
        )
        assert read_mosaic(tmp_path / "f.dng").black_dn == (100, 200, 300, 400)


# ----------------------------------------------------------------------------------------------
# EXR and Radiance pictures

SHAPE = (6, 9)


def _planes(value: float, layer: str = "", names: str = "RGB") -> dict[str, np.ndarray]:
    return {f"{layer}{c}": np.full(SHAPE, value, np.float32) for c in names}


def _part(name: str, channels: dict[str, np.ndarray], **header: object) -> OpenEXR.Part:
    head = {"type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION, **header}
    return OpenEXR.Part(head, channels, name)


def _deep() -> OpenEXR.Part:
    samples = np.empty(SHAPE, object)
    for at in np.ndindex(*SHAPE):
        samples[at] = np.array([1.0, 2.0], np.float32)
    head = {"type": OpenEXR.deepscanline, "compression": OpenEXR.ZIPS_COMPRESSION}
    return OpenEXR.Part(head, dict.fromkeys("RGB", samples), "deep")


PARTS = {
    "two passes": (
        lambda: [_part("direct", _planes(1)), _part("beauty", _planes(7))],
        {"direct": 1, "beauty": 7},
    ),
    "depth first": (
        lambda: [_part("depth", _planes(1, names="Z")), _part("beauty", _planes(7))],
        {"beauty": 7},
    ),
    "stereo": (
        lambda: [_part("l", _planes(3), view="left"), _part("r", _planes(4), view="right")],
        {"l": 3, "r": 4},
    ),
    "layers in parts": (
        lambda: [
            _part("a", _planes(3, "rgba.") | _planes(2, "glow.")),
            _part("b", _planes(4, "rgba.")),
        ],
        {"a.glow": 2, "a.rgba": 3, "b": 4},
    ),
    "deep first": (lambda: [_deep(), _part("flat", _planes(5))], {"flat": 5}),
}


@pytest.mark.authority
@pytest.mark.parametrize("case", PARTS)
def test_several_parts_are_refused_until_one_is_named(tmp_path: Path, case: str) -> None:
    """Expected: the values that OpenEXR wrote into the named part."""
    make, expected = PARTS[case]
    path = tmp_path / "a.exr"
    OpenEXR.File(make()).write(str(path))
    listed = ", ".join(expected)
    with pytest.raises(InputError, match=rf"2 parts: .*{listed}; name one with --part NAME"):
        read_exr(path)
    for name, value in expected.items():
        picture, view = read_exr(path, name)
        np.testing.assert_allclose(picture.luminance_cdm2, value, rtol=1e-6)
        assert view == ""
    with pytest.raises(InputError, match=f"in a part nothing; expected one of {listed}"):
        read_exr(path, "nothing")
    for name in {str(part.name()) for part in make()} - set(expected):  # depth, deep data, layers
        with pytest.raises(InputError, match=f"in a part {name}; expected"):
            read_exr(path, name)


@pytest.mark.authority
def test_stereo_views_in_one_part_are_not_chosen_silently(tmp_path: Path) -> None:
    channels = _planes(3) | _planes(4, "right.")
    path = tmp_path / "a.exr"
    OpenEXR.File([_part("", channels, multiView=["left", "right"])]).write(str(path))
    with pytest.raises(InputError, match="2 views: left, right; expected one of left, right"):
        read_exr(path)
    for name, value in (("left", 3), ("right", 4)):
        assert read_exr(path, name)[0].luminance_cdm2 == pytest.approx(value)


@pytest.mark.authority
def test_layers_next_to_plain_channels_are_named(tmp_path: Path) -> None:
    channels = _planes(7) | _planes(1, "diffuse.") | _planes(900, "normal.", "XYZ")
    path = tmp_path / "a.exr"
    OpenEXR.File([_part("", channels)]).write(str(path))
    picture = read_exr(path)[0]
    assert picture.luminance_cdm2 == pytest.approx(7)
    assert "the EXR has further layers: diffuse" in picture.attributes["note"]
    assert read_exr(path, "diffuse")[0].luminance_cdm2 == pytest.approx(1)
    with pytest.raises(InputError, match="no flat picture with luminance in a part normal"):
        read_exr(path, "normal")
    OpenEXR.File([_part("", _planes(7))]).write(str(path))
    with pytest.raises(InputError, match=r"in a part depth; expected one of .*; omit --part"):
        read_exr(path, "depth")


@pytest.mark.contract
def test_a_position_is_no_luminance(tmp_path: Path) -> None:
    path = tmp_path / "a.exr"
    OpenEXR.File([_part("", _planes(900, "P.", "XYZ"))]).write(str(path))
    with pytest.raises(InputError, match=r"channels P.X, P.Y, P.Z; expected a channel Y"):
        read_exr(path)


COLOUR_SPACES = {
    # SMPTE ST 2065-1, table of the Y row of the matrix of ACES AP0
    "ACES AP0": (
        (0.7347, 0.2653, 0.0, 1.0, 0.0001, -0.077, 0.32168, 0.33767),
        (0.3439664498, 0.7281660966, -0.0721325464),
    ),
    # SMPTE ST 2065-4 / S-2014-004: ACES AP1
    "ACES AP1": (
        (0.713, 0.293, 0.165, 0.830, 0.128, 0.044, 0.32168, 0.33767),
        (0.2722287168, 0.6740817658, 0.0536895174),
    ),
    # ARRI, "ALEXA LogC curve, usage in VFX", 2017: ALEXA Wide Gamut RGB to XYZ
    "ALEXA Wide Gamut": (
        (0.684, 0.313, 0.221, 0.848, 0.0861, -0.102, 0.3127, 0.329),
        (0.291954, 0.823841, -0.115795),
    ),
    # ITU-R BT.2020, table 4
    # Chromaticities_XYZ.exr of OpenEXR's images: the channels R, G, B are CIE X, Y, Z
    "CIE XYZ": ((1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1 / 3, 1 / 3), (0.0, 1.0, 0.0)),
    "BT.2020": ((0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329), (0.2627, 0.678, 0.0593)),
}


@pytest.mark.authority
@pytest.mark.parametrize("space", COLOUR_SPACES)
def test_primaries_that_are_no_real_colours(space: str) -> None:
    chromaticities, weights = COLOUR_SPACES[space]
    np.testing.assert_allclose(rgb_to_xyz(chromaticities)[1], weights, atol=5e-5)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("chromaticities", "found"),
    [
        ((0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.31, 0.0), "y of white other than 0"),
        ((0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.9, 0.33), "white is not between"),
        ((0.1, 0.1, 0.2, 0.2, 0.3, 0.3, 0.31, 0.33), "on one line"),
        ((0.64, float("nan"), 0.3, 0.6, 0.15, 0.06, 0.31, 0.33), "finite"),
    ],
)
def test_chromaticities_that_cannot_be_true(chromaticities: tuple[float, ...], found: str) -> None:
    with pytest.raises(ValueError, match=found):
        rgb_to_xyz(chromaticities)[1]


@pytest.mark.authority
@pytest.mark.parametrize(
    "line", ["EXPOSURE=0", "EXPOSURE=          0.0000000000000", "EXPOSURE= 0"]
)
@pytest.mark.parametrize("other", ["", "EXPOSURE=2\n"])
def test_an_exposure_of_zero_is_none(tmp_path: Path, line: str, other: str) -> None:
    """Expected: 179 lm/W of a stored 128.5/256, over the other EXPOSURE."""
    path = tmp_path / "a.hdr"
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n{other}{line}\n\n-Y 2 +X 3\n"
    path.write_bytes(head.encode() + bytes((128, 128, 128, 128)) * 6)
    expected = 179.0 * 128.5 / 256.0 / (2.0 if other else 1.0)
    assert read_radiance_hdr(path)[0].luminance_cdm2 == pytest.approx(expected, rel=1e-4)


@pytest.mark.contract
@pytest.mark.parametrize(
    "line", ["EXPOSURE=-1", "EXPOSURE=nan", "EXPOSURE=", "COLORCORR=1 0 1", "GAMMA=-2"]
)
def test_other_exposures_are_refused(tmp_path: Path, line: str) -> None:
    path = tmp_path / "a.hdr"
    path.write_bytes(f"#?RADIANCE\n{line}\n\n-Y 2 +X 3\n".encode() + bytes(24))
    with pytest.raises(InputError, match="above 0"):
        read_radiance_hdr(path)


@pytest.mark.contract
def test_a_small_file_of_many_equal_pixels_is_refused_before_decoding(tmp_path: Path) -> None:
    """Runs of 127 pixels: 48 values a byte; 160 million pixels took 4.4 GB of memory."""
    path, row = tmp_path / "a.hdr", b"\x02\x02\x4e\x20" + 4 * (157 * b"\xff\x50" + b"\xbd\x50")
    path.write_bytes(b"#?RADIANCE\n\n-Y 100 +X 20000\n" + 100 * row)
    assert read_radiance_hdr(path)[0].luminance_cdm2.shape == (100, 20000)
    path.write_bytes(b"#?RADIANCE\n\n-Y 8000 +X 20000\n" + 8000 * row)
    with pytest.raises(InputError, match=r"20000 x 8000 pixels; expected .* each byte of a large"):
        read_radiance_hdr(path)


@pytest.mark.contract
def test_a_stated_gamma_is_no_linear_picture(tmp_path: Path) -> None:
    """GAMMA of Bruce Walter's rgbe.c: the stored values are already corrected with it."""
    path = tmp_path / "a.hdr"
    path.write_bytes(b"#?RGBE\nGAMMA=2.2\n\n-Y 2 +X 3\n" + bytes((128, 128, 128, 128)) * 6)
    with pytest.raises(InputError, match=r"a gamma of 2\.2; expected linear values"):
        read_radiance_hdr(path)
    path.write_bytes(path.read_bytes().replace(b"GAMMA=2.2", b"GAMMA=1.0"))
    assert read_radiance_hdr(path)[0].luminance_cdm2 == pytest.approx(
        179.0 * 128.5 / 256.0, rel=1e-4
    )


@pytest.mark.contract
@pytest.mark.parametrize("white", [0.0, -1.0, float("nan"), float("inf")])
def test_a_white_luminance_that_cannot_be_true_is_no_unit(tmp_path: Path, white: float) -> None:
    path = tmp_path / "a.exr"
    OpenEXR.File([_part("", _planes(7), whiteLuminance=white)]).write(str(path))
    picture = read_exr(path)[0]
    assert picture.luminance_cdm2 == pytest.approx(7)
    assert "states no unit" in picture.attributes["note"]


@pytest.mark.contract
@pytest.mark.parametrize("keep", [0.5, 0.8])
def test_a_cut_exr_prints_nothing_into_the_answer(
    tmp_path: Path, keep: float, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.exr"
    noise = np.random.default_rng(1).uniform(1, 9, (90, 120)).astype(np.float32)
    OpenEXR.File([_part("", dict.fromkeys("RGB", noise))]).write(str(path))
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(InputError, match=r"broken EXR \(.*pixel data.*\); expected a complete EXR"):
        read_exr(path)
    with pytest.raises(InputError, match=r"broken EXR \(Exception raised reading pixel data"):
        SkyView.read(path)
    assert capsys.readouterr().out == ""


@pytest.mark.contract
def test_info_gives_a_picture_of_another_program_no_heading(tmp_path: Path) -> None:
    from fieldlum.cli.info_command import describe

    view = "-vta -vd 0 -1 0 -vu 0 0 1 -vh 180 -vv 180"
    path = tmp_path / "a.exr"
    for stated, shown in ((view, view), ("left", "missing")):
        OpenEXR.File([_part("", _planes(7), view=stated)]).write(str(path))
        facts = describe(path)
        assert (facts["kind"], facts["view"]) == ("EXR picture", shown)
        assert "heading_deg" not in facts and facts["median_cdm2"] == 7


@pytest.mark.authority
@pytest.mark.parametrize(
    ("tags", "exposure"),
    [
        ({37377: (5907, 1000)}, (1 / 60, 5.6)),
        ({37377: (5907, 1000), 33434: (0, 1)}, (1 / 60, 5.6)),
        ({37378: (497, 100), 33434: (1, 60)}, (1 / 60, 5.6)),
        ({37378: (497, 100), 33434: (1, 60), 33437: (0, 1)}, (1 / 60, 5.6)),
    ],
)
def test_settings_that_only_apex_tags_state(
    tmp_path: Path, tags: dict[int, Value], exposure: tuple[float, float]
) -> None:
    """Expected: EXIF 2.32, annex C: T = 2 ** -Tv, A = 2 ** (Av / 2)."""
    rest = {k: v for k, v in GOOD.items() if k != (33437 if 37378 in tags else 33434)}
    frame = read_exif(jpeg(tmp_path / "f.jpg", exif_segment(rest | tags)))
    assert (frame.exposure.shutter_s, frame.exposure.f_number) == pytest.approx(exposure, rel=1e-3)


@pytest.mark.contract
def test_a_lens_without_electronics_has_no_aperture(tmp_path: Path) -> None:
    path = jpeg(tmp_path / "f.jpg", exif_segment(GOOD | {33437: (0, 1), 37378: (0, 1)}))
    with pytest.raises(InputError, match="no f-number in the EXIF"):
        read_exif(path)


@pytest.mark.contract
def test_a_luminance_that_contradicts_the_colours_is_not_chosen_silently(tmp_path: Path) -> None:
    rgb = np.random.default_rng(1).uniform(1.0, 9.0, (8, 8, 3)).astype(np.float32)
    channels = {name: np.ascontiguousarray(rgb[..., k]) for k, name in enumerate("RGB")}
    luminance = (rgb @ np.array([0.2126, 0.7152, 0.0722])).astype(np.float32)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    for factor in (1.0, 3.0):
        path = tmp_path / f"{factor}.exr"
        OpenEXR.File(header, {**channels, "Y": luminance * np.float32(factor)}).write(str(path))
    np.testing.assert_allclose(
        read_exr(tmp_path / "1.0.exr")[0].luminance_cdm2, luminance, rtol=1e-3
    )
    with pytest.raises(InputError, match="Y is not the luminance of R, G and B"):
        read_exr(tmp_path / "3.0.exr")


@pytest.mark.contract
@pytest.mark.parametrize("aspect", [2.0, 0.5])
def test_pixels_that_are_no_squares_are_refused(tmp_path: Path, aspect: float) -> None:
    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        "pixelAspectRatio": aspect,
    }
    OpenEXR.File(header, {"Y": np.ones((8, 8), np.float32)}).write(str(tmp_path / "a.exr"))
    with pytest.raises(InputError, match="times as wide as high; expected square pixels"):
        read_exr(tmp_path / "a.exr")
