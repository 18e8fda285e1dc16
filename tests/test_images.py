"""Pictures on disk: round trips, headers that Radiance reads, malformed input."""

import subprocess
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from radiance_header import add_lines

from fieldlum.core.errors import InputError
from fieldlum.core.records import Panorama, SunSource
from fieldlum.optics.images import (
    encode_rgbe,
    read_panorama,
    read_radiance_hdr,
    write_panorama,
    write_radiance_hdr,
)

SHAPE = (8, 16)
IN_A_FOLDER = settings(
    deadline=None, max_examples=30, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


def _panorama(seed: int = 0) -> Panorama:
    rng = np.random.default_rng(seed)
    luminance = rng.lognormal(4, 3, SHAPE).astype(np.float32)
    return Panorama(
        luminance,
        187.5,
        0.03 * luminance,
        rng.integers(0, 127, SHAPE),
        datetime(2027, 3, 20, 15, 30, tzinfo=UTC),
        SunSource(31.25, 140.5, 61_234.0, 0.75, "dni"),
        attributes={"bracket": "20270320T153000Z"},
    )


@pytest.mark.property
def test_exr_round_trip_keeps_every_bit(tmp_path: Path) -> None:
    made = _panorama()
    write_panorama(tmp_path / "a.exr", made)
    found = read_panorama(tmp_path / "a.exr")
    np.testing.assert_array_equal(found.luminance_cdm2, made.luminance_cdm2)
    np.testing.assert_array_equal(found.u_cdm2, made.u_cdm2)
    np.testing.assert_array_equal(found.flags, made.flags)
    assert (found.heading_deg, found.t_utc, found.attributes) == (
        made.heading_deg,
        made.t_utc,
        made.attributes,
    )
    assert found.sun == made.sun


@pytest.mark.analytic
def test_exr_holds_the_sun_where_half_floats_overflow(tmp_path: Path) -> None:
    write_panorama(tmp_path / "a.exr", Panorama(np.full(SHAPE, 1.6e9, np.float32), 180.0))
    assert read_panorama(tmp_path / "a.exr").luminance_cdm2.max() == np.float32(1.6e9)


@pytest.mark.property
@IN_A_FOLDER
@given(arrays(np.float32, SHAPE, elements=st.floats(2.0**-6, 2.0**30, width=32)))
def test_hdr_round_trip_is_within_half_a_step(tmp_path: Path, luminance: np.ndarray) -> None:
    """RGBE has 8 bits of mantissa in [128, 256): at most 0.5 / 128 off."""
    write_radiance_hdr(tmp_path / "a.hdr", luminance, heading_deg=90.0)
    found = read_panorama(tmp_path / "a.hdr")
    assert found.heading_deg == 90.0
    np.testing.assert_allclose(found.luminance_cdm2, luminance, rtol=0.5 / 128)


@pytest.mark.authority
def test_radiance_reads_what_we_write(tmp_path: Path) -> None:
    """Radiance's own pvalue on our file; it prints W/sr/m2 per channel with three digits."""
    from pyradiance.anci import BINPATH

    luminance = np.linspace(1.0, 5000.0, 128).reshape(SHAPE)
    write_radiance_hdr(tmp_path / "a.hdr", luminance, view="-vta -vh 180 -vv 180")
    command = [str(Path(BINPATH) / "pvalue"), "-h", "-H", "-d", "-b", str(tmp_path / "a.hdr")]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    # -b prints brightness in W/sr/m2, to about four digits: 0.5 / 128 of RGBE and those digits
    np.testing.assert_allclose(
        179.0 * np.array(shown.split(), float).reshape(SHAPE), luminance, rtol=0.006
    )


@pytest.mark.analytic
def test_exposure_lines_multiply_and_are_undone(tmp_path: Path) -> None:
    write_radiance_hdr(tmp_path / "a.hdr", np.full(SHAPE, 100.0))
    add_lines(tmp_path / "a.hdr", "EXPOSURE=2", "EXPOSURE=.5")
    np.testing.assert_allclose(
        read_radiance_hdr(tmp_path / "a.hdr")[0].luminance_cdm2, 100.0, rtol=0.004
    )
    write_radiance_hdr(tmp_path / "b.hdr", np.full(SHAPE, 100.0))
    add_lines(tmp_path / "b.hdr", "EXPOSURE=4")
    np.testing.assert_allclose(
        read_radiance_hdr(tmp_path / "b.hdr")[0].luminance_cdm2, 25.0, rtol=0.004
    )


@pytest.mark.authority
def test_run_length_pictures_are_read(tmp_path: Path) -> None:
    """A scanline of one repeated run a channel, as Radiance's own tools write it."""
    row = b"\x02\x02\x00\x10" + b"".join(bytes((128 + 16, value)) for value in (128, 64, 32, 129))
    head = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2 +X 16\n"
    (tmp_path / "a.hdr").write_bytes(head + row + row)
    found = read_radiance_hdr(tmp_path / "a.hdr")[0].rgb
    np.testing.assert_allclose(found[1, 3], np.array([128.5, 64.5, 32.5]) / 128.0)


@pytest.mark.property
@IN_A_FOLDER
@given(st.integers(0, 2000), st.integers(0, 255), st.booleans())
@example(124, 249, False)  # an exponent that overflows single precision
@example(392, 1, False)  # the type of the attribute sun is no "string" any more
@example(210, 128, False)  # the value of an attribute is no text any more
@example(507, 128, False)  # nor is that of the view
def test_a_damaged_picture_gives_a_picture_or_one_line(
    tmp_path: Path, at: int, value: int, cut: bool
) -> None:
    write_radiance_hdr(tmp_path / "a.hdr", _panorama().luminance_cdm2, heading_deg=180.0)
    write_panorama(tmp_path / "a.exr", _panorama())
    for name in ("a.hdr", "a.exr"):
        data = bytearray((tmp_path / name).read_bytes())
        data = data[: at % len(data)] if cut else data
        if not cut:
            data[at % len(data)] = value
        broken = tmp_path / f"broken{Path(name).suffix}"
        broken.write_bytes(bytes(data))
        try:
            assert read_panorama(broken).luminance_cdm2.ndim == 2
        except InputError as error:
            assert "\n" not in str(error)


@pytest.mark.contract
@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("u_percent", "scale"),
        ("u_percent", "scale=a"),
        ("u_percent", "scale=2=3"),
        ("melanopic", "1 2 b 4"),
        ("melanopic", "1 2 3"),
        ("melanopic", "1 2 3 nan"),
    ],
)
def test_a_damaged_attribute_of_numbers_is_refused(tmp_path: Path, name: str, text: str) -> None:
    write_panorama(tmp_path / "a.exr", replace(_panorama(), attributes={name: text}))
    with pytest.raises(InputError, match=r"a\.exr: .*; expected attributes as .*; merge the"):
        read_panorama(tmp_path / "a.exr")


@pytest.mark.contract
@pytest.mark.parametrize("name", ["missing.exr", "text.exr", "text.hdr"])
def test_what_is_no_picture_is_refused_by_name(tmp_path: Path, name: str) -> None:
    if not name.startswith("missing"):
        (tmp_path / name).write_text("no picture", encoding="ascii")
    with pytest.raises(InputError, match=name):
        read_panorama(tmp_path / name)


@pytest.mark.contract
def test_a_picture_that_is_not_twice_as_wide_as_high_is_no_panorama(tmp_path: Path) -> None:
    write_radiance_hdr(tmp_path / "a.hdr", np.ones((16, 16)))
    with pytest.raises(InputError, match="twice as wide"):
        read_panorama(tmp_path / "a.hdr")


@pytest.mark.analytic
def test_encoding_keeps_black_black() -> None:
    assert not encode_rgbe(np.zeros((2, 2, 3))).any()
