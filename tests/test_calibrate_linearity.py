"""`calibrate linearity` on simulated sensors whose curve is known, and what merge does with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fieldlum.calibrate import sensor as linearity
from fieldlum.cli.calibrate_command import linearity as command
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Exposure
from fieldlum.merge.linear_frames import Crop, load_raw
from fieldlum.merge.shots import Shot
from fieldlum.optics.camera_curves import linearity_factor
from fieldlum.optics.linear_light import curve_u_rel, true_shutter_s
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Lens,
    Sensor,
    check_profile,
    load_camera_profile,
    save_profile,
)
from fieldlum.optics.raw.writing import write_dng

BLACK, WHITE = 64.0, 4095.0
TRUE = (-0.02, 0.035)  # of the light: +-1 % over the scale, as a real CCD has
OFFSET_S = 5e-6
TIMES = (2e-4, 5e-4, 1e-3, 2e-3, 3e-3, 4.5e-3, 6e-3, 7.5e-3, 9e-3)
PROFILE = CameraProfile(
    CameraBody("linear", "raw", 64, 48),
    (Lens((32.0, 24.0), 30.0, 60.0),),
    Bracket(4.0, 100.0, (1e-3,)),
    Sensor("RGGB", (BLACK,) * 4, (4000.0,) * 4, WHITE, 3.0, 8.0, 100.0),
    shutter_law="exact",
)


def frames(folder: Path, curve: tuple[float, ...] = TRUE) -> list[Path]:
    """Two frames a time of a gradient under steady light, with shot noise."""
    rng = np.random.default_rng(1)
    folder.mkdir()
    scene = np.linspace(0.6, 1.0, 64) * np.ones((48, 1)) * 0.97 / max(TIMES)
    share = np.linspace(0.0, 1.05, 2000)
    light_of_share = share * linearity_factor(share, curve)
    out = []
    for k, seconds in enumerate(np.repeat(TIMES, 2)):
        recorded = np.interp(scene * (seconds + OFFSET_S), light_of_share, share) * (WHITE - BLACK)
        noisy = recorded + rng.normal(size=recorded.shape) * np.sqrt(recorded / 30.0 + 4.0)
        counts = np.clip(np.rint(noisy + BLACK), 0, WHITE).astype(np.uint16)
        out.append(folder / f"{k:02d}.dng")
        exposure = Exposure(float(seconds), 4.0, 100.0)
        write_dng(out[-1], counts, exposure, black_dn=(BLACK,) * 4, white_dn=WHITE)
    return out


@pytest.mark.slow
@pytest.mark.analytic
def test_the_curve_and_the_shutters_offset_are_found(tmp_path: Path) -> None:
    found = linearity.fit(linearity.read_levels(frames(tmp_path / "steady"), PROFILE))
    share = np.linspace(0.02, 0.9, 50)
    ratio = linearity_factor(share, found.coefficients) / linearity_factor(share, TRUE)
    # blocks of 48 pixels at 1 % noise, 60 of them a frame: 0.02 % a frame
    assert np.ptp(np.log(ratio)) < 0.002
    assert found.offset_s == pytest.approx(OFFSET_S, abs=1e-6)
    assert found.u_rel < 0.004  # it includes the noise of blocks of 12 pixels


@pytest.mark.slow
@pytest.mark.analytic
def test_a_linear_sensor_gets_no_curve(tmp_path: Path) -> None:
    found = linearity.fit(linearity.read_levels(frames(tmp_path / "steady", ()), PROFILE))
    share = np.linspace(0.02, 0.9, 50)
    assert np.abs(linearity_factor(share, found.coefficients) - 1.0).max() < 0.001
    assert len(found.coefficients) <= 1


@pytest.mark.contract
def test_too_few_times_are_refused(tmp_path: Path) -> None:
    paths = frames(tmp_path / "steady")
    with pytest.raises(NotEnoughDataError, match="steady light"):
        linearity.fit(linearity.read_levels(paths[:6], PROFILE))


@pytest.mark.slow
@pytest.mark.contract
def test_the_command_writes_what_merge_applies(tmp_path: Path) -> None:
    folder, mine = tmp_path / "steady", tmp_path / "mine.toml"
    paths = frames(folder)
    save_profile(mine, PROFILE)
    arguments = [str(folder), "--camera", str(mine), "--out", str(mine), "--json"]
    result = CliRunner().invoke(command, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    fitted = load_camera_profile(mine)
    assert fitted.sensor.linearity and fitted.sensor.linearity_u_rel == curve_u_rel(fitted)
    assert true_shutter_s(1e-3, fitted)[0] == pytest.approx(1e-3 + OFFSET_S, abs=1e-6)
    means = []
    for path, seconds in zip(paths, np.repeat(TIMES, 2), strict=True):
        shot = Shot(path, Exposure(float(seconds), 4.0, 100.0))
        signal = load_raw(shot, fitted, Crop(0, 0, 48, 64))
        counts, _ = signal.strip(0, len(signal.counts))
        means.append(float(counts.mean() / np.mean(signal.per_cdm2)))
    assert np.ptp(np.log(means[2:-2])) < 0.004  # 1.5 % and more as recorded


@pytest.mark.contract
def test_counts_stay_where_there_is_no_curve_and_impossible_curves_are_refused() -> None:
    share = np.array([-0.01, 0.0, 0.1, 0.5])
    assert (linearity_factor(share, ()) == 1.0).all()
    factor = linearity_factor(share, TRUE)
    assert (factor[:2] == 1.0).all() and factor[3] != 1.0
    folded = replace(PROFILE, sensor=replace(PROFILE.sensor, linearity=(-0.9,)))
    with pytest.raises(InputError, match="rise with the raw counts"):
        check_profile(folded, "mine.toml")
