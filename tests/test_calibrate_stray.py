"""`calibrate stray`: a known haze is found from black traps, and merge removes it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fieldlum.calibrate import stray
from fieldlum.cli.calibrate_command import stray as command
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Panorama
from fieldlum.optics.images import write_panorama
from fieldlum.optics.profiles import (
    CameraProfile,
    StrayLight,
    check_profile,
    load_camera_profile,
    save_profile,
)
from fieldlum.optics.projection import direction, equirect_rays, equirect_solid_angles
from fieldlum.optics.stray_light import kernel_per_sr, stray_cdm2

HEIGHT = 48
RAYS = equirect_rays(HEIGHT, 2 * HEIGHT, 0.0).reshape(-1, 3)
SOLID = equirect_solid_angles(HEIGHT, 2 * HEIGHT).ravel()
TRUE = StrayLight((1.5, 12.0, 96.0), (0.08, 0.02, 0.004), 0.1)
BASE = load_camera_profile("canon-5d2-8mm-f5.6")
PROFILE: CameraProfile = replace(BASE, lens=(replace(BASE.lens[0], full_angle_deg=186.0),))


def exact_haze(light: np.ndarray) -> np.ndarray:
    """The sum over all pairs of pixels."""
    angle = np.arccos(np.clip(RAYS @ RAYS.T, -1.0, 1.0))
    kernel = kernel_per_sr(angle, np.asarray(TRUE.angle_deg), np.asarray(TRUE.per_sr))
    return kernel @ (light * SOLID)


def scene(lamp_deg: tuple[float, float]) -> np.ndarray:
    """A dim field with a window and a lamp, where the lens sees."""
    light = np.full(len(RAYS), 20.0)
    light[RAYS @ direction(10.0, -30.0) > np.cos(np.radians(12.0))] = 3000.0
    light[RAYS @ direction(*lamp_deg[::-1]) > np.cos(np.radians(5.0))] = 2e4
    return np.where(RAYS[:, 1] > np.cos(np.radians(93.0)), light, 0.0)


@pytest.mark.slow
@pytest.mark.analytic
def test_the_field_is_the_sum_over_all_pixels() -> None:
    light = scene((40.0, 20.0))
    found = stray_cdm2(light, SOLID, RAYS, np.asarray(TRUE.angle_deg), np.asarray(TRUE.per_sr))
    exact = exact_haze(light)
    seen = light > 0
    assert np.median(np.abs(found / exact - 1.0)[seen]) < 0.02
    # Next to a lamp the cell's width shows; the kernel's u_rel is at least a tenth for that.
    assert np.quantile(np.abs(found / exact - 1.0)[seen], 0.98) < 0.15


@pytest.fixture(scope="module")
def readings_csv(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two pictures with six traps of 6 degrees each."""
    folder, rng = tmp_path_factory.mktemp("stray"), np.random.default_rng(3)
    lines = ["panorama,azimuth_deg,altitude_deg"]
    for number, lamp in enumerate(((40.0, 20.0), (10.0, -40.0))):
        light = scene(lamp)
        places = [(a + rng.uniform(-5, 5), rng.uniform(-55, 55)) for a in range(-75, 76, 30)]
        for azimuth, altitude in places:
            light[RAYS @ direction(altitude, azimuth) > np.cos(np.radians(6.5))] = 1e-6
            lines.append(f"p{number}.exr,{azimuth:.3f},{altitude:.3f}")
        recorded = np.where(light > 0, light + exact_haze(light), 0.0)
        picture = Panorama(recorded.reshape(HEIGHT, -1).astype(np.float32), 0.0)
        write_panorama(folder / f"p{number}.exr", picture)
    path = folder / "traps.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.slow
@pytest.mark.analytic
def test_a_known_kernel_is_found_and_its_haze_removed(readings_csv: Path) -> None:
    found = stray.fit(stray.from_table(readings_csv, PROFILE))
    true_share = stray.total_share(TRUE.angle_deg, np.asarray(TRUE.per_sr))
    assert found.total_share == pytest.approx(true_share, rel=0.15)
    light = scene((-60.0, -10.0))
    seen = light > 0
    recorded = np.where(seen, light + exact_haze(light), 0.0)
    nodes = np.array(found.kernel.angle_deg), np.array(found.kernel.per_sr)
    haze = stray_cdm2(recorded, SOLID, RAYS, *nodes)
    left = (recorded - haze - light)[seen]
    assert np.sqrt((left**2).mean()) < 0.15 * np.sqrt(((recorded - light)[seen] ** 2).mean())
    assert (np.abs(left) < 2 * np.hypot(found.kernel.u_rel * haze[seen], 1e-3)).mean() > 0.9


@pytest.mark.slow
@pytest.mark.contract
def test_the_command_writes_the_kernel_and_a_picture(readings_csv: Path, tmp_path: Path) -> None:
    start, out, png = tmp_path / "start.toml", tmp_path / "mine.toml", tmp_path / "s.png"
    save_profile(start, PROFILE)
    words = [str(readings_csv), "--camera", str(start), "--out", str(out), "--picture", str(png)]
    answer = CliRunner().invoke(command, words, catch_exceptions=False)
    assert answer.exit_code == 0, answer.output
    assert "stray light:" in answer.output and png.stat().st_size > 10_000
    written = load_camera_profile(out)
    assert written.stray.angle_deg and written.glare_floor_rel == 0.0
    # Fitting again with the new profile gives the same: the pictures were merged without a kernel.
    again = stray.fit(stray.from_table(readings_csv, written))
    assert again.kernel == written.stray


@pytest.mark.slow
@pytest.mark.contract
def test_readings_that_cannot_be_are_refused(readings_csv: Path) -> None:
    readings = stray.from_table(readings_csv, PROFILE)
    with pytest.raises(NotEnoughDataError, match="at least 8"):
        stray.fit(readings[:5])
    grey = [r._replace(stray_cdm2=200.0 * r.stray_cdm2) for r in readings]
    with pytest.raises(InputError, match="the fitted stray light is"):
        stray.fit(grey)
    picture = Panorama(scene((40.0, 20.0)).reshape(HEIGHT, -1).astype(np.float32), 0.0)
    with pytest.raises(InputError, match="not more than its true"):
        row = {"panorama": Path("p.exr"), "azimuth_deg": 0.0, "altitude_deg": -40.0}
        stray.reading(picture, PROFILE, {**row, "luminance_cdm2": 30.0, "radius_deg": 0.5})


@pytest.mark.contract
@pytest.mark.parametrize(
    ("kernel", "words"),
    [
        (StrayLight((1.0, 2.0), (0.1,)), "angle_deg"),
        (StrayLight((2.0, 1.0), (0.2, 0.1)), "angle_deg"),
        (StrayLight((1.0, 2.0), (0.1, 0.2)), "per_sr"),
    ],
)
def test_kernels_that_no_lens_has_are_refused(kernel: StrayLight, words: str) -> None:
    with pytest.raises(InputError, match=words):
        check_profile(replace(PROFILE, stray=kernel), "mine.toml")
