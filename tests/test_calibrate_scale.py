"""`calibrate scale`: the factor to cd/m2 from spot readings, and slips among them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_frames import PROFILE

from fieldlum.calibrate import (
    scale,
)
from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, Panorama
from fieldlum.optics.images import calibration_mark, write_panorama
from fieldlum.optics.profiles import (
    Colour,
)


@pytest.mark.analytic
def test_scale_with_an_outlier(tmp_path: Path) -> None:
    """k is off by 8 %; nine spots with 2 % noise, one read from the wrong place, and the
    vertical illuminance.
    """
    rng = np.random.default_rng(5)
    luminance = np.full((90, 180), 100.0, np.float32)
    luminance[:45] = 400.0
    luminance[40:60, 30:150] *= np.linspace(0.5, 3, 120, dtype=np.float32)
    write_panorama(tmp_path / "p.exr", Panorama(luminance, 180.0))
    lines = ["panorama,azimuth_deg,altitude_deg,luminance_cdm2,illuminance_lx"]
    picture = Panorama(luminance, 180.0)
    for azimuth in range(100, 280, 20):
        seen = scale.spot_cdm2(picture, azimuth, -20.0)[0]
        lines.append(f"p.exr,{azimuth},-20,{1.08 * seen * (1 + 0.02 * rng.normal()):.2f},")
    lines.append("p.exr,180,30,2000,")
    from fieldlum.optics.illuminance import illuminance_lx

    lines.append(f"p.exr,180,0,,{1.08 * illuminance_lx(luminance, 180.0, 0.0, 180.0):.1f}")
    table = tmp_path / "spots.csv"
    table.write_text("\n".join(lines))
    readings, frames, _ = scale.from_table(table, PROFILE)
    found = scale.fit(readings)
    assert found.factor == pytest.approx(1.08, abs=0.02) and 0.02 <= found.u_rel < 0.035
    assert found.far == ("p 180/30 deg",) and len(frames) == 1 and len(found.residual) == 11


def _spots(path: Path, lines: list[str]) -> Path:
    path.write_text(
        "\n".join(["panorama,azimuth_deg,altitude_deg,luminance_cdm2,illuminance_lx", *lines])
    )
    return path


@pytest.mark.analytic
def test_scale_asked_twice_gives_k_once(tmp_path: Path) -> None:
    """The picture says with which k it was merged; it moved k twice before."""
    write_panorama(
        tmp_path / "p.exr",
        Panorama(
            np.full((60, 120), 100.0, np.float32), 180.0, attributes=calibration_mark(PROFILE)
        ),
    )
    table = _spots(tmp_path / "t.csv", [f"p.exr,{a},0,{148 + a % 3}," for a in range(150, 200, 10)])
    k = PROFILE.scale.k
    for _ in range(2):
        profile = replace(PROFILE, scale=replace(PROFILE.scale, k=k))
        readings, _, notes = scale.from_table(table, profile)
        k = profile.scale.k * scale.fit(readings).factor
        assert k == pytest.approx(1.49 * PROFILE.scale.k, rel=0.01) and not notes
    other = replace(PROFILE, colour=Colour((0.3, 0.6, 0.1)))
    with pytest.raises(
        InputError,
        match=r"p.exr: merged with another calibration .sim.*merge it again",
    ):
        scale.from_table(table, other)
    grey = np.full((60, 120), 100.0, np.float32)
    for wrong in ("nan", "0", "-1", "one"):
        mark = {**calibration_mark(PROFILE), "k": wrong}
        write_panorama(tmp_path / "p.exr", Panorama(grey, 180.0, attributes=mark))
        with pytest.raises(InputError, match=f"'{wrong}'"):
            scale.from_table(table, PROFILE)
    write_panorama(tmp_path / "p.exr", Panorama(grey, 180.0))
    assert "no factor k is stored in p.exr" in scale.from_table(table, PROFILE)[2][0]


def _readings(meter: list[float], image: list[float]) -> list[scale.LuminanceReading]:
    pairs = enumerate(zip(meter, image, strict=True))
    return [scale.LuminanceReading("spot", f"spot {i}", m, p, 0.02) for i, (m, p) in pairs]


@pytest.mark.contract
def test_scale_names_slips_of_units_and_refuses_what_contradicts_itself(tmp_path: Path) -> None:
    picture = [80.0, 120.0, 300.0, 40.0, 900.0, 60.0]
    slip = _readings([80.0, 1200.0, 300.0, 40.0 / 3.426, 900.0, 60.0], picture)
    said = scale.outlier_texts(slip, scale.fit(slip))
    assert len(said) == 2 and said[0].startswith("spot 1: the reading of 1200 is 10")
    assert "0.292 times the picture's value: check its unit (1 fL" in said[1]
    with pytest.raises(
        InputError,
        match=r"t.csv: 3 of 6 readings differ from the fitted k by over 10 %.*one unit",
    ):
        scale.fit(_readings([80.0, 20.0, 300.0, 9.0, 4000.0, 60.0], picture), source="t.csv")
    right = scale.fit(_readings(picture, picture))
    assert scale.check_level(right, PROFILE, tmp_path) == ""
    feet = scale.fit(_readings([p / 3.426 for p in picture], picture))
    assert "1 fL" in scale.check_level(feet, PROFILE, tmp_path)
    with pytest.raises(InputError, match=r"over R, G and B, would be 0.001.*klx"):
        scale.check_level(
            scale.fit(_readings([p / 1000 for p in picture], picture)), PROFILE, tmp_path
        )


@pytest.mark.contract
def test_scale_takes_no_reading_from_what_is_clipped(tmp_path: Path) -> None:
    flags = np.zeros((60, 120), np.uint16)
    flags[20, 60] = Flag.CLIPPED_HIGH
    picture = Panorama(np.full((60, 120), 100.0, np.float32), 180.0, flags=flags)
    write_panorama(tmp_path / "p.exr", picture)
    for line in ("p.exr,180,28.5,100,", "p.exr,180,0,,310"):
        with pytest.raises(InputError, match=r"p.exr: the picture is clipped in every frame"):
            scale.from_table(_spots(tmp_path / "t.csv", [line]), PROFILE)
    assert (
        len(
            scale.from_table(
                _spots(tmp_path / "t.csv", ["p.exr,180,-30,100,", "p.exr,0,0,,310"]), PROFILE
            )[0]
        )
        == 2
    )


@pytest.mark.contract
def test_scale_refuses_a_line_without_reading(tmp_path: Path) -> None:
    write_panorama(tmp_path / "p.exr", Panorama(np.ones((20, 40), np.float32), 0.0))
    table = tmp_path / "t.csv"
    table.write_text(
        "panorama,azimuth_deg,altitude_deg,luminance_cdm2,illuminance_lx\np.exr,0,0,,\n"
    )
    with pytest.raises(InputError, match="neither"):
        scale.from_table(table, PROFILE)
    table.write_text("panorama,azimuth_deg,altitude_deg,luminance_cdm2\np.exr,0,zero,5\n")
    with pytest.raises(InputError, match="altitude_deg is 'zero'"):
        scale.from_table(table, PROFILE)


@pytest.mark.contract
def test_a_stated_uncertainty_is_not_reported_as_uneven_luminance(tmp_path: Path) -> None:
    write_panorama(tmp_path / "p.exr", Panorama(np.full((60, 120), 100.0, np.float32), 180.0))
    table = tmp_path / "spots.csv"
    table.write_text(
        "panorama,azimuth_deg,altitude_deg,luminance_cdm2,u_rel\np.exr,180,0,100,0.15\n"
    )
    readings, _, notes = scale.from_table(table, PROFILE)
    assert readings[0].u_rel == pytest.approx(0.15) and not any("uneven" in n for n in notes)


@pytest.mark.contract
def test_scale_takes_no_illuminance_of_what_no_lens_saw(tmp_path: Path) -> None:
    """Unseen pixels would count as black: a meter in a uniform room then gave a third too much."""
    flags = np.zeros((60, 120), np.uint16)
    flags[:, :30] = flags[:, 90:] = Flag.OUTSIDE_LENS  # a lens to the south sees half of it
    light = np.where(flags == 0, np.float32(200.0), np.float32(0.0))
    write_panorama(tmp_path / "p.exr", Panorama(light, 180.0, flags=flags))
    full = _spots(tmp_path / "t.csv", [f"p.exr,180,0,,{200 * np.pi:.1f}"])
    assert scale.fit(scale.from_table(full, PROFILE)[0]).factor == pytest.approx(1.0, abs=2e-3)
    for place in ("240,0", "180,60"):
        part = _spots(tmp_path / "t.csv", [f"p.exr,{place},,{200 * np.pi:.1f}"])
        with pytest.raises(InputError, match=r"p.exr: no lens saw 25 % of what lights the plane"):
            scale.from_table(part, PROFILE)
