"""Radiance pictures as Radiance's own programs and others write them."""

from __future__ import annotations

import os
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from radiance_header import add_lines

from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, Panorama, SunSource
from fieldlum.optics.images import (
    RADIANCE_LM_PER_W,
    RADIANCE_Y,
    encode_rgbe,
    radiance_program,
    read_radiance_hdr,
    write_picture,
    write_radiance_hdr,
)
from fieldlum.year.glare.picture_glare import picture_glare

SCENE = """
void glow sky 0 0 4 5 6 9 0
sky source all 0 0 4 0 0 1 360
void glow lamp 0 0 4 900 700 300 0
lamp sphere ball 0 0 4 1 3 .5 .4
"""
STEPS = (
    ("pfilt", "-1", "-e", "2.5"),
    ("pfilt", "-1", "-eg", "1.5", "-eb", ".5"),
    ("pfilt", "-1", "-x", "13", "-y", "11"),
    ("pflip", "-h"),
    ("pflip", "-v"),
    ("protate",),
    ("protate", "-r"),
    ("pcomb", "-s", "3"),
    ("pcomb", "-o", "-s", ".2"),
    ("pcompos", "-x", "12", "-y", "9", "-", "-2", "-3"),
    ("ra_xyze",),
    ("ra_xyze", "-r"),
    ("ra_xyze", "-r", "-u"),
)


def _radiance(*command: str, stdin: bytes = b"") -> bytes:
    from pyradiance.anci import BINPATH

    environment = {**os.environ, "RAYPATH": str(Path(BINPATH).parent / "lib")}
    program = [radiance_program(command[0]), *command[1:]]
    return subprocess.run(
        program, input=stdin, capture_output=True, check=True, env=environment
    ).stdout


@pytest.fixture(scope="module")
def rendering(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    folder = tmp_path_factory.mktemp("radiance")
    (folder / "a.rad").write_text(SCENE, encoding="ascii")
    (folder / "a.oct").write_bytes(_radiance("oconv", str(folder / "a.rad")))
    options = "-vta -vd 0 1 0 -vu 0 0 1 -vh 180 -vv 140 -x 24 -y 24 -ab 0"
    return _radiance("rpict", *options.split(), str(folder / "a.oct"))


def _pvalue(path: Path) -> np.ndarray:
    """Original values as pvalue prints them, upright, [H, W, 3]; its y counts from the bottom."""
    lines = _radiance("pvalue", "-h", "-o", str(path)).decode().splitlines()
    table = np.array([line.split() for line in lines[1:]], float)
    x, y = table[:, 0].astype(int), table[:, 1].astype(int)
    out = np.full((y.max() + 1, x.max() + 1, 3), np.nan)
    out[y.max() - y, x] = table[:, 2:]
    return out


@pytest.mark.slow
@pytest.mark.contract
@pytest.mark.property
@settings(
    deadline=None,
    max_examples=40,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(steps=st.lists(st.sampled_from(STEPS), max_size=4))
def test_any_radiance_pipeline_gives_the_values_of_pvalue(
    tmp_path: Path, rendering: bytes, steps: list[tuple[str, ...]]
) -> None:
    picture = rendering
    for step in steps:
        command = step if step[0] == "pcompos" else (*step, "-") if step[0] == "pcomb" else step
        if step[0] in ("pflip", "protate", "ra_xyze", "pfilt"):
            (tmp_path / "in.hdr").write_bytes(picture)
            command = (*step, str(tmp_path / "in.hdr"))
        picture = _radiance(*command, stdin=picture)
    path = tmp_path / "out.hdr"
    path.write_bytes(picture)
    image, header = read_radiance_hdr(path)
    luminance = image.luminance_cdm2
    expected = _pvalue(path)
    tolerance = {"rtol": 2e-3, "atol": 1e-6 * np.nanmax(expected)}  # pvalue prints four digits
    if header.xyze:
        np.testing.assert_allclose(luminance, expected[..., 1], **tolerance)
    else:
        np.testing.assert_allclose(
            luminance, expected @ (179.0 * np.array(RADIANCE_Y)), **tolerance
        )
        np.testing.assert_allclose(image.rgb, expected, **tolerance)
    of_rgb = image.rgb @ (179.0 * np.array(RADIANCE_Y))
    np.testing.assert_allclose(of_rgb, luminance, rtol=1e-3, atol=1e-3)


@pytest.mark.analytic
@pytest.mark.authority
@pytest.mark.parametrize("first", ["-Y", "+Y", "-X", "+X"])
@pytest.mark.parametrize("second", ["-", "+"])
def test_all_eight_orientations_give_the_same_picture(
    tmp_path: Path, first: str, second: str
) -> None:
    truth = np.arange(1.0, 13.0).reshape(3, 4)
    rows_first = first[1] == "Y"
    second = second + ("X" if rows_first else "Y")
    stored = truth if rows_first else truth.T
    if first in ("+Y", "-X"):
        stored = stored[::-1]
    if second in ("-X", "+Y"):
        stored = stored[:, ::-1]
    size = f"{first} {stored.shape[0]:8d} {second} {stored.shape[1]:8d}\n"
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n{size}"
    pixels = encode_rgbe(np.repeat(stored[..., None], 3, axis=-1)).tobytes()
    (tmp_path / "a.hdr").write_bytes(head.encode() + pixels)
    found = read_radiance_hdr(tmp_path / "a.hdr")[0].luminance_cdm2 / 179.0
    np.testing.assert_allclose(found, truth, rtol=0.004)


@pytest.mark.contract
@pytest.mark.authority
def test_xyze_and_other_primaries_keep_their_luminance(tmp_path: Path, rendering: bytes) -> None:
    """ra_xyze between colour spaces: the luminance of each pixel stays, to RGBE's steps."""
    plain = tmp_path / "plain.hdr"
    plain.write_bytes(rendering)
    truth = read_radiance_hdr(plain)[0].luminance_cdm2
    rec709 = [".64", ".33", ".3", ".6", ".15", ".06", ".3127", ".329"]
    for name, options in (("xyze", ()), ("rec709", ("-r", "-p", *rec709))):
        path = tmp_path / f"{name}.hdr"
        path.write_bytes(_radiance("ra_xyze", *options, str(plain)))
        found = read_radiance_hdr(path)[0].luminance_cdm2
        np.testing.assert_allclose(found, truth, rtol=0.02, err_msg=name)


@pytest.mark.contract
@pytest.mark.authority
def test_old_run_length_coding_is_read(tmp_path: Path) -> None:
    """A pixel, then 1 1 1 n: n more of it, with the count's high byte in the next run."""
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X 300\n"
    pixels = bytes((128, 64, 32, 129)) + bytes((1, 1, 1, 43)) + bytes((1, 1, 1, 1))
    (tmp_path / "a.hdr").write_bytes(head + pixels)
    found = read_radiance_hdr(tmp_path / "a.hdr")[0].rgb
    assert found.shape == (1, 300, 3)
    np.testing.assert_allclose(found[0, 299], np.array([128.5, 64.5, 32.5]) / 128.0)


@pytest.mark.contract
@pytest.mark.authority
@pytest.mark.parametrize(
    "head",
    [
        "#?RGBE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 3\n",  # OpenCV
        "#?RADIANCE\n# Made with FreeImage 3.18.0\nFORMAT=32-bit_rle_rgbe\nGAMMA=1\nEXPOSURE=1\n\n"
        "-Y 2 +X 3\n",  # imageio
        "#?RADIANCE\n# PFStools writer to Radiance RGBE format\nFORMAT=32-bit_rle_rgbe\n\n"
        "-Y 2 +X 3\n",
        "#?RADIANCE\nGAMMA=1\nPRIMARIES=0 0 0 0 0 0 0 0\nFORMAT=32-bit_rle_rgbe\n\n"
        "-Y 2 +X 3\n",  # Adobe Photoshop
        "#?RADIANCE\r\nFORMAT=32-bit_rle_rgbe\r\n\r\n-Y 2 +X 3\n",
    ],
)
def test_headers_of_other_programs(tmp_path: Path, head: str) -> None:
    pixels = encode_rgbe(np.full((2, 3, 3), 7.0)).tobytes()
    (tmp_path / "a.hdr").write_bytes(head.encode() + pixels)
    found = read_radiance_hdr(tmp_path / "a.hdr")[0].luminance_cdm2
    np.testing.assert_allclose(found, 7.0 * 179.0, rtol=0.004)


@pytest.mark.contract
@pytest.mark.authority
def test_opencv_and_imageio_files_are_read(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2")
    truth = np.random.default_rng(1).lognormal(0, 2, (20, 30, 3)).astype(np.float32)
    cv2.imwrite(str(tmp_path / "cv.hdr"), truth[..., ::-1])
    found = read_radiance_hdr(tmp_path / "cv.hdr")[0].rgb
    error = np.abs(found - truth) / truth.max(axis=-1, keepdims=True)
    assert error.max() < 1 / 128  # RGBE: one step of the largest channel


@pytest.mark.contract
def test_inherited_views_count_only_when_the_picture_has_none(tmp_path: Path) -> None:
    own, inherited = "VIEW= -vta -vh 180 -vv 180", "\tVIEW= -vth -vh 180 -vv 180"
    path = tmp_path / "a.hdr"
    write_radiance_hdr(path, np.ones((4, 4)))
    add_lines(path, inherited, own)
    header = read_radiance_hdr(path)[1]
    assert "-vta" in header.view and header.views
    write_radiance_hdr(path, np.ones((4, 4)))
    add_lines(path, inherited, inherited)
    header = read_radiance_hdr(path)[1]
    assert "-vth" in header.view and not header.views
    write_radiance_hdr(path, np.ones((4, 4)))
    add_lines(path, inherited, "\t" + own)
    assert read_radiance_hdr(path)[1].view == ""


@pytest.mark.contract
@pytest.mark.parametrize(
    ("lines", "size", "stated"),
    [
        ("FORMAT=Radiance_spectra\n", "-Y 2 +X 3", "rcomb"),
        ("FORMAT=float\n", "-Y 2 +X 3", "rmtxop"),
        ("FORMAT=32-bit_rle_rgbe\n", "-Y 2 +Y 3", "two axes"),
        ("FORMAT=32-bit_rle_rgbe\n", "-Y 90000 +X 90000", "pixels"),
        ("FORMAT=32-bit_rle_rgbe\nEXPOSURE=-1\n", "-Y 2 +X 3", "above 0"),
        ("FORMAT=32-bit_rle_rgbe\nCOLORCORR= 1 1\n", "-Y 2 +X 3", "3 numbers"),
        ("FORMAT=32-bit_rle_rgbe\nPRIMARIES= 1 1 1 1 1 1 1 1\n", "-Y 2 +X 3", "PRIMARIES"),
        ("FORMAT=32-bit_rle_rgbe\n", "-Y 20 +X 30", "cut short"),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line(
    tmp_path: Path, lines: str, size: str, stated: str
) -> None:
    path = tmp_path / "a.hdr"
    path.write_bytes(f"#?RADIANCE\n{lines}\n{size}\n".encode() + bytes(24))
    with pytest.raises(InputError, match=stated) as refused:
        read_radiance_hdr(path)
    assert "\n" not in str(refused.value)


@pytest.mark.authority
def test_pixels_that_no_lens_saw_stay_unseen_and_pvalue_reads_the_others(tmp_path: Path) -> None:
    """The colour keeps its hue, and gets the luminance of the map, which was scaled to a meter."""
    light = np.geomspace(1.0, 1e4, 8 * 16).reshape(8, 16)
    light[0, 0], light[7, 0] = 0.0, np.nan
    rgb = np.array([0.5, 1.0, 2.0]) * light[..., None] / RADIANCE_LM_PER_W
    rgb[3, 3] = 0.0
    flags = np.zeros((8, 16), np.uint16)
    flags[:, 8:] = Flag.OUTSIDE_LENS
    path = tmp_path / "a.hdr"
    write_picture(path, Panorama(2.0 * light, 90.0, flags=flags, rgb=rgb))
    picture, _ = read_radiance_hdr(path)
    seen = flags == 0
    seen[7, 0] = False
    assert (picture.seen == seen).all()
    np.testing.assert_allclose(picture.luminance_cdm2[seen], 2.0 * light[seen], 0.008, 1e-8)
    assert picture.rgb is not None and (picture.rgb[~seen] == 0.0).all()
    hue = picture.rgb[4, 4] / picture.rgb[4, 4, 0]
    np.testing.assert_allclose(hue, [1.0, 2.0, 4.0], rtol=0.02)
    values = np.loadtxt(_radiance("pvalue", "-h", "-H", "-d", "-b", str(path)).splitlines())
    of_other = RADIANCE_LM_PER_W * values.reshape(8, 16)
    np.testing.assert_allclose(of_other[seen], picture.luminance_cdm2[seen], 0.01, 1e-8)
    write_picture(path, Panorama(light[:7], 90.0))
    assert read_radiance_hdr(path)[0].flags is None, "black is black where all was seen"


@pytest.mark.contract
def test_a_hdr_keeps_the_sun_and_the_number_of_clipped_pixels(tmp_path: Path) -> None:
    """The sun is drawn, because no header line can state it; DGP was 0.2 in place of 1.0."""
    flags = np.zeros((60, 120), np.uint16)
    flags[10, 20:23] = Flag.CLIPPED_HIGH
    sun = SunSource(30.0, 200.0, 20_000.0)
    scene = Panorama(np.full((60, 120), 300.0, np.float32), 180.0, flags=flags, sun=sun)
    rgb = np.full((60, 120, 3), 300.0 / RADIANCE_LM_PER_W)
    hidden = flags.copy()
    hidden[19:22, 65:69] = Flag.OUTSIDE_LENS  # around the sun
    for picture in (scene, replace(scene, rgb=rgb), replace(scene, flags=hidden)):
        write_picture(tmp_path / "a.hdr", picture)
        write_picture(tmp_path / "a.exr", picture)
        hdr, exr = (picture_glare(tmp_path / f"a.{suffix}", [180.0]) for suffix in ("hdr", "exr"))
        for name, tolerance in (("ev_lx", 0.02), ("dgp", 0.01)):
            of_hdr, of_exr = (answer["views"][0][name] for answer in (hdr, exr))
            assert of_hdr == pytest.approx(of_exr, rel=tolerance)
        assert [
            any("clipped in every frame: 3 pixels" in t for t in a["warnings"]) for a in (hdr, exr)
        ] == [True, True]
