"""`calibrate vignette` against simulated lenses whose vignetting is known."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_frames import LENS, PROFILE, SIZE, TRUE_V, raw_frame, relative_angles
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldlum.calibrate import (
    vignette,
)
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Exposure
from fieldlum.optics.camera_curves import vignetting_at
from fieldlum.optics.projection import LensGeometry, direction, lens_pixels


@pytest.mark.analytic
def test_vignetting_from_a_uniform_field(tmp_path: Path) -> None:
    """Within 0.3 % of the truth up to 95 % of the radius, from one noisy frame."""
    rng = np.random.default_rng(2)
    field = 400.0 * vignetting_at(TRUE_V, relative_angles())[..., None] * np.array([0.8, 1.0, 0.6])
    path = raw_frame(tmp_path / "flat.dng", field, Exposure(1 / 60, 5.6), rng)
    found = vignette.fit(vignette.from_uniform([path], PROFILE))
    r = np.linspace(0, 0.95, 50)
    assert np.abs(vignetting_at(found.coefficients, r) / vignetting_at(TRUE_V, r) - 1).max() < 3e-3
    assert "order 4" in found.choice.line.split(";")[0]


@pytest.mark.contract
def test_frames_of_several_apertures_are_named(tmp_path: Path) -> None:
    rng, field = np.random.default_rng(2), np.full((SIZE, SIZE, 3), 200.0)
    paths = [
        raw_frame(tmp_path / f"{number}.dng", field, Exposure(1 / 60, f_number), rng)
        for number, f_number in enumerate((5.6, 5.6, 8.0))
    ]
    with pytest.raises(InputError, match=r"\(f/5.6: 1.dng; f/8: 2.dng\).*each aperture separately"):
        vignette.from_uniform(paths, PROFILE)
    table = tmp_path / "angles.csv"
    table.write_text("angle_deg,value,f_number\n0,1,5.6\n20,0.9,\n40,0.8,8\n")
    with pytest.raises(InputError, match=r"\(f/5.6: reading 2; f/8: reading 3\).*one table"):
        vignette.from_table(table, PROFILE)


@pytest.mark.slow
@pytest.mark.analytic
def test_vignetting_from_one_patch_at_many_angles(tmp_path: Path) -> None:
    rng, lines = np.random.default_rng(3), ["file,x_px,y_px,radius_px,reference"]
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    for i, angle in enumerate(np.linspace(0, 85, 18)):
        at = lens_pixels(
            LensGeometry(LENS.centre_px, LENS.radius_px, LENS.full_angle_deg), direction(0, angle)
        )
        drift = 1.0 + 0.02 * i
        shown = np.where(np.hypot(x - at[0], y - at[1]) < 9, 300.0 * drift, 5.0)
        picture = (
            shown[..., None] * vignetting_at(TRUE_V, relative_angles())[..., None] * np.ones(3)
        )
        raw_frame(tmp_path / f"{i}.dng", picture, Exposure(1 / 60, 5.6), rng)
        lines.append(f"{i}.dng,{float(at[0]):.2f},{float(at[1]):.2f},6,{drift}")
    table = tmp_path / "patches.csv"
    table.write_text("\n".join(lines))
    found = vignette.fit(vignette.from_table(table, PROFILE))
    r = np.linspace(0, 0.9, 40)
    assert np.abs(vignetting_at(found.coefficients, r) / vignetting_at(TRUE_V, r) - 1).max() < 0.01


@pytest.mark.slow
@pytest.mark.property
@settings(deadline=None, max_examples=25)
@given(st.floats(0, 0.4), st.floats(0, 0.4), st.integers(0, 9))
def test_vignetting_only_falls(second: float, fourth: float, seed: int) -> None:
    rng, r = np.random.default_rng(seed), np.linspace(0, 1, 15)
    value = 7.0 * (1 - second * r**2 - fourth * r**4) * (1 + 0.01 * rng.normal(size=15))
    found = vignette.fit(vignette.Samples(r, value, np.full(15, 0.01), 5.6, 0, (Path("x"),)))
    v = vignetting_at(found.coefficients, np.linspace(0, 1, 101))
    assert (np.diff(v) <= 1e-5).all() and v[0] == 1.0
    assert (
        np.abs(
            v[::10]
            / (1 - second * np.linspace(0, 1, 11) ** 2 - fourth * np.linspace(0, 1, 11) ** 4)
            - 1
        ).max()
        < 0.08
    )


@pytest.mark.contract
def test_the_wrong_sign_is_refused(tmp_path: Path) -> None:
    table = tmp_path / "t.csv"
    rows = [f"{angle},{1 / (1 - 0.35 * (angle / 93) ** 2):.4f}" for angle in range(0, 91, 10)]
    table.write_text("\n".join(["angle_deg,value", *rows]))
    with pytest.raises(InputError, match=r"rise by .* correction factors"):
        vignette.fit(vignette.from_table(table, PROFILE))
    table.write_text("angle_deg,value\n0,1\n20,0.9\n")
    with pytest.raises(NotEnoughDataError):
        vignette.fit(vignette.from_table(table, PROFILE))


@pytest.mark.analytic
@pytest.mark.parametrize("slip", [1.12, 0.3, 10.0])
def test_one_slip_among_vignetting_readings_is_left_out(tmp_path: Path, slip: float) -> None:
    """12 % at half the angle had bent the whole curve by 4 % before."""
    half, angles = LENS.full_angle_deg / 2, np.abs(np.linspace(-90, 90, 15))
    values = 100 * vignetting_at(TRUE_V, angles / half)
    values[10] *= slip
    table = tmp_path / "v.csv"
    table.write_text(
        "angle_deg;value\n"
        + "\n".join(f"{a:g};{v:.2f}".replace(".", ",") for a, v in zip(angles, values, strict=True))
    )
    found = vignette.fit(vignette.from_table(table, PROFILE))
    r = np.linspace(0, 0.95, 30)
    assert np.abs(vignetting_at(found.coefficients, r) / vignetting_at(TRUE_V, r) - 1).max() < 0.003
    assert found.choice.line.endswith(
        "left out, because neighbouring readings differ: one at "
        f"{100 * angles[10] / half:.0f} % of the half angle"
    )
    assert len(found.residual_rel) == 15


@pytest.mark.analytic
def test_a_steep_rim_is_no_slip() -> None:
    r = np.abs(np.linspace(-0.98, 0.98, 21))
    value = 100 * (1 - 0.1 * r**2 - 0.5 * r**8)
    found = vignette.fit(vignette.Samples(r, value, np.full(21, 0.002), 5.6, 0, (Path("t.csv"),)))
    assert "left out" not in found.choice.line
    assert np.abs(vignetting_at(found.coefficients, r) * found.level / value - 1).max() < 0.02


@pytest.mark.contract
def test_vignetting_beyond_the_lens_is_refused(tmp_path: Path) -> None:
    table = tmp_path / "v.csv"
    table.write_text(
        "angle_deg,value\n" + "\n".join(f"{a},{100 - a / 4}" for a in range(0, 180, 20))
    )
    with pytest.raises(
        InputError,
        match=r"v.csv: an angle of 160 deg from the axis; expected at most 93 deg, .*check that",
    ):
        vignette.from_table(table, PROFILE)
    table.write_text(
        "angle_deg,value\n"
        + "\n".join(f"{np.radians(a):.3f},{100 - a / 4}" for a in range(0, 90, 10))
    )
    with pytest.raises(NotEnoughDataError, match=r"v.csv: 9 readings up to 2 %.*degrees"):
        vignette.fit(vignette.from_table(table, PROFILE))


@pytest.mark.contract
def test_angles_are_those_of_the_named_lens(tmp_path: Path) -> None:
    """80 deg is inside the first lens, and beyond the second one of 120 deg."""
    table = tmp_path / "angles.csv"
    table.write_text("angle_deg,value\n0,1\n80,0.8\n")
    profile = replace(PROFILE, lens=(LENS, replace(LENS, full_angle_deg=120.0)))
    assert vignette.from_table(table, profile).lens == 0
    with pytest.raises(InputError, match="at most 60 deg"):
        vignette.from_table(table, profile, 1)


@pytest.mark.contract
def test_the_bad_reading_is_named() -> None:
    r = np.linspace(0.0, 1.0, 9)
    value = np.where(np.arange(9) == 5, 0.0, 100.0)
    frames = (Path("d/f00.dng"), Path("d/f08.dng"))
    samples = vignette.Samples(r, value, np.full(9, 0.002), 5.6, 0, frames)
    with pytest.raises(
        InputError, match=r"f00.dng to f08.dng: the reading at 62 % of the half angle is 0"
    ):
        vignette.fit(samples)


@pytest.mark.contract
def test_vignetting_is_extrapolated_little_and_with_a_caution() -> None:
    """Readings up to 70 % of the half angle gave a lens of this kind 33 % too much at its edge."""

    def fitted(reach: float, begin: float = 0.0) -> vignette.VignettingFit:
        r = np.linspace(begin, reach, 24)
        value = 1.0 - 0.12 * r**2 - 0.38 * r**6
        return vignette.fit(vignette.Samples(r, value, np.full(24, 0.003), 5.6, 0, (Path("t"),)))

    with pytest.raises(NotEnoughDataError, match="up to 70 % of the half angle"):
        fitted(0.7)
    assert "CAUTION: readings from 0 to 90 % of the half angle" in fitted(0.9).choice.line
    assert "CAUTION" not in fitted(1.0).choice.line
    assert "CAUTION: readings from 50 to 100 % of the half" in fitted(1.0, begin=0.5).choice.line


@pytest.mark.analytic
@pytest.mark.parametrize("factor", [0.3, 0.8, 1.3])
@pytest.mark.parametrize("reach", [1.0, -1.0], ids=["one side", "two sides"])
@pytest.mark.parametrize("n", [11, 15])
def test_a_slip_on_the_axis_is_left_out(n: int, reach: float, factor: float) -> None:
    """x0.3 of 11 or 15 readings was refused as correction factors, x1.3 bent the edge by 7 %."""
    r = np.abs(np.linspace(min(reach, 0.0), 1.0, n if reach < 0 else n // 2 + 1))
    truth = vignetting_at((1.0, 0.0, -0.1, 0.0, -0.15), r)
    value = np.where(r < 1e-9, factor, 1.0) * truth
    found = vignette.fit(vignette.Samples(r, value, np.full(len(r), 0.005), 5.6, 0, (Path("t"),)))
    assert "neighbouring readings differ: one at 0 % of the half angle" in found.choice.line
    assert np.abs(vignetting_at(found.coefficients, r) / truth - 1).max() < 0.001


@pytest.mark.analytic
def test_a_slip_among_few_readings_is_left_out() -> None:
    """Readings 17 % of the half angle apart had no neighbours to be compared with."""
    r = np.linspace(0.0, 1.0, 7)
    truth = vignetting_at((1.0, 0.0, -0.1, 0.0, -0.15), r)
    value = truth * np.where(np.arange(7) == 3, 0.8, 1.0)
    found = vignette.fit(vignette.Samples(r, value, np.full(7, 0.005), 5.6, 0, (Path("t"),)))
    assert "neighbouring readings differ: one at 50 % of the half angle" in found.choice.line
    assert np.abs(vignetting_at(found.coefficients, r) / truth - 1).max() < 0.001
