"""`calibrate colour`: luminance weights from readings and from a chart."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from calibration_frames import CHART_SRGB, LENS, PROFILE, SIZE, TRUE_V, raw_frame, relative_angles

from fieldlum.calibrate import colour, fit_steps
from fieldlum.calibrate.fit_charts import Place
from fieldlum.calibrate.fit_steps import LinearFrame, linear_frame, transmission
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Exposure
from fieldlum.optics.camera_curves import response_table, vignetting_at
from fieldlum.optics.profiles import CameraProfile, Colour


def _colours(
    count: int, noise: float, truth: tuple[float, float, float], seed: int = 1
) -> colour.Colours:
    rng = np.random.default_rng(seed)
    rgb = rng.uniform(0.1, 1.0, (count, 3)) * rng.uniform(20, 400, (count, 1))
    y = 1.07 * rgb @ np.array(truth) * (1 + noise * rng.normal(size=count))
    places = tuple(Place(Path("x"), i, 0) for i in range(count))
    return colour.Colours(rgb, y, np.full(count, max(noise, 0.01)), places)


@pytest.mark.analytic
def test_colour_leaves_a_wrong_prior_when_readings_prove_it() -> None:
    truth = (0.40, 0.50, 0.10)
    found = colour.fit(_colours(30, 0.01, truth), PROFILE)
    shares = np.array(found.y_from_rgb) / sum(found.y_from_rgb)
    assert shares == pytest.approx(truth, abs=0.02) and found.u_rel < 0.02


@pytest.mark.analytic
def test_colour_leaves_out_a_slip_and_refuses_a_muddle() -> None:
    colours = _colours(12, 0.005, (0.30, 0.60, 0.10))
    y = colours.y.copy()
    y[4] *= 10
    found = colour.fit(replace(colours, y=y), replace(PROFILE, colour=Colour((0.25, 0.68, 0.07))))
    clean = colour.fit(colours, replace(PROFILE, colour=Colour((0.25, 0.68, 0.07))))
    assert found.y_from_rgb == pytest.approx(clean.y_from_rgb, rel=0.05) and found.u_rel < 0.02
    assert "left out: x 4,0, 9." in found.choice.line and len(found.residual) == 12
    with pytest.raises(InputError, match="readings do not fit the colours"):
        colour.fit(replace(colours, y=np.roll(colours.y, 1) * np.geomspace(0.2, 5, 12)), PROFILE)


@pytest.mark.analytic
def test_colour_keeps_a_right_prior() -> None:
    found = colour.fit(_colours(8, 0.03, PROFILE.colour.y_from_rgb), PROFILE)
    assert found.y_from_rgb == pytest.approx(PROFILE.colour.y_from_rgb, abs=0.05)
    assert found.scale == pytest.approx(1.07, abs=0.04)
    with pytest.raises(NotEnoughDataError):
        colour.fit(_colours(3, 0.01, (0.3, 0.6, 0.1)), PROFILE)


def _chart_frame(path: Path, seed: int = 1) -> tuple[Path, list[float]]:
    """A chart of known luminance: its colours, scaled so that a . rgb is the chart's own Y."""
    rng, a = np.random.default_rng(seed), np.array([0.30, 0.60, 0.10])
    rgb = response_table("srgb")[CHART_SRGB]
    rgb *= (colour.chart_xyz()[:, 1] / (rgb @ a))[:, None] * 3.0
    picture = np.full((SIZE, SIZE, 3), 20.0)
    left, top, cell = 60, 80, 20
    for i in range(24):
        row, column = divmod(i, 6)
        picture[
            top + row * cell : top + (row + 1) * cell,
            left + column * cell : left + (column + 1) * cell,
        ] = rgb[i]
    picture = picture * vignetting_at(TRUE_V, relative_angles())[..., None]
    corners = [
        left,
        top,
        left + 6 * cell,
        top,
        left + 6 * cell,
        top + 4 * cell,
        left,
        top + 4 * cell,
    ]
    return raw_frame(path, picture, Exposure(1 / 60, 5.6), rng), [float(c) for c in corners]


@pytest.mark.analytic
def test_colour_from_a_chart(tmp_path: Path) -> None:
    path, corners = _chart_frame(tmp_path / "chart.dng")
    colours = colour.from_chart(path, PROFILE, corners)
    colours = replace(colours, matrix=None)
    found = colour.fit(colours, PROFILE)
    shares = np.array(found.y_from_rgb) / sum(found.y_from_rgb)
    assert shares == pytest.approx((0.30, 0.60, 0.10), abs=0.03)
    with pytest.raises(
        InputError, match=r"in a chart.s order.*clockwise"
    ):  # the corners from the black patch on
        colour.from_chart(path, PROFILE, corners[4:] + corners[:4])


@pytest.mark.contract
def test_a_frame_without_a_chart_says_what_to_do(tmp_path: Path) -> None:
    path = raw_frame(
        tmp_path / "flat.dng",
        np.full((SIZE, SIZE, 3), 200.0),
        Exposure(1 / 60, 5.6),
        np.random.default_rng(1),
    )
    with pytest.raises(InputError, match=r"no colour chart.*--corners"):
        colour.from_chart(path, PROFILE)


@pytest.mark.analytic
def test_patches_are_linear_and_clipping_is_refused(tmp_path: Path) -> None:
    rng, rgb = np.random.default_rng(4), np.array([120.0, 200.0, 80.0])
    flat = np.broadcast_to(rgb, (SIZE, SIZE, 3))
    frame = linear_frame(raw_frame(tmp_path / "a.dng", flat, Exposure(1 / 60, 5.6), rng), PROFILE)
    mean, u_rel = frame.patch(100, 100, 30)
    assert mean == pytest.approx(rgb, rel=0.01) and u_rel < 0.005
    over = linear_frame(
        raw_frame(tmp_path / "b.dng", 1000 * flat, Exposure(1 / 60, 5.6), rng), PROFILE
    )
    with pytest.raises(InputError, match="clipped"):
        over.patch(100, 100, 30)
    with pytest.raises(InputError, match="inside"):
        frame.patch(1, 1, 30)
    assert transmission(PROFILE, 5.6, *LENS.centre_px) == pytest.approx(1.0)


@pytest.mark.contract
def test_a_frame_with_several_readings_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = np.full((SIZE, SIZE, 3), 300.0)
    raw_frame(tmp_path / "a.dng", shown, Exposure(1 / 60, 5.6), np.random.default_rng(1))
    reads: list[Path] = []

    def counted(path: Path, profile: CameraProfile) -> LinearFrame:
        reads.append(path)
        return linear_frame(path, profile)

    monkeypatch.setattr(fit_steps, "linear_frame", counted)
    table = tmp_path / "spots.csv"
    middle = SIZE / 2
    rows = [f"a.dng,{middle},{middle + shift},300" for shift in (-20, 0, 20)]
    table.write_text("\n".join(["file,x_px,y_px,luminance_cdm2", *rows]))
    assert len(colour.from_table(table, PROFILE).y) == 3 and len(reads) == 1
