"""`calibrate pixels`: defects are found, noise is not, and frames with light are refused."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fieldlum.calibrate import sensor as pixels
from fieldlum.cli import main
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Exposure
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Lens,
    Sensor,
    load_camera_profile,
    save_profile,
)
from fieldlum.optics.raw.writing import write_dng

SIDE = 256
HOT = {(100, 60), (131, 140), (64, 190)}
STUCK = {(150, 77)}
PROFILE = CameraProfile(
    CameraBody("small", "raw", SIDE, SIDE),
    (Lens((128.0, 128.0), 125.0, 180.0),),
    Bracket(4.0, 100.0, (0.1,)),
    Sensor("RGGB", (256.0,) * 4, (15000.0,) * 4, 16383.0, 2.0, 5.0, 100.0),
)


def frame(
    path: Path, light: np.ndarray, exposed: float = 1.0, seed: int = 0, defects: bool = True
) -> Path:
    rng = np.random.default_rng(seed)
    mean = light * exposed
    if defects:
        for x, y in HOT:
            mean[y, x] += 2500.0 * exposed
    counts = 256 + mean + np.sqrt(mean / 2 + 2.5**2) * rng.standard_normal(mean.shape)
    if defects:
        for x, y in STUCK:
            counts[y, x] = 5000.0
    path.parent.mkdir(exist_ok=True, parents=True)
    whole = np.clip(np.round(counts), 0, 15000).astype(np.uint16)
    write_dng(path, whole, Exposure(0.1 * exposed, 4.0), black_dn=(256,) * 4, white_dn=16383)
    return path


@pytest.mark.contract
def test_frames_too_noisy_to_tell_are_refused(tmp_path: Path) -> None:
    quiet = replace(PROFILE, sensor=replace(PROFILE.sensor, read_noise_e=0.5))
    dark = [frame(tmp_path / f"{i}.dng", np.zeros((SIDE, SIDE)), 8.0, i) for i in range(2)]
    with pytest.raises(NotEnoughDataError, match="by chance"):
        pixels.find(dark, quiet)


@pytest.mark.contract
def test_with_the_cap_on(tmp_path: Path) -> None:
    dark = [frame(tmp_path / f"{i}.dng", np.zeros((SIDE, SIDE)), 8.0, i) for i in range(3)]
    found = pixels.find(dark, PROFILE)
    assert set(found.bad_px) == HOT | STUCK
    with pytest.raises(NotEnoughDataError, match="expected at least 2"):
        pixels.find(dark[:1], PROFILE)
    with pytest.raises(InputError, match="put the lens cap on"):
        pixels.find([frame(tmp_path / "lit.dng", np.full((SIDE, SIDE), 400.0)), dark[0]], PROFILE)


@pytest.mark.slow
@pytest.mark.contract
def test_the_command(tmp_path: Path) -> None:
    camera, out = tmp_path / "small.toml", tmp_path / "new.toml"
    save_profile(camera, replace(PROFILE, sensor=replace(PROFILE.sensor, bad_px=((1, 2),))))
    dark = [str(frame(tmp_path / f"{i}.dng", np.zeros((SIDE, SIDE)), 8.0, i)) for i in range(2)]
    words = ["calibrate", "pixels", *dark, "--camera", str(camera), "--out", str(out)]
    ran = CliRunner().invoke(main, [*words, "--json", "--picture", str(tmp_path / "p.png")])
    assert ran.exit_code == 0, ran.output
    assert (
        len(json.loads(ran.stdout)["sensor"]["bad_px"]) == 5
        and (tmp_path / "p.png").stat().st_size > 1000
    )
    new = load_camera_profile(out)
    assert (
        set(new.sensor.bad_px) == HOT | STUCK | {(1, 2)} and "dark frames" in new.provenance.log[-1]
    )
    jpeg = CliRunner().invoke(
        main, [*words[:2], *dark, "--camera", "sim-dual-fisheye-jpeg", "--out", str(out)]
    )
    assert jpeg.exit_code == 3 and "JPEG camera" in jpeg.stderr and jpeg.stderr.count("\n") == 1
    few = CliRunner().invoke(main, [*words[:2], dark[0], *words[4:]])
    assert few.exit_code == 5 and few.stderr.count("\n") == 1
