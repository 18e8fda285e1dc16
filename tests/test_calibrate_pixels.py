"""`calibrate pixels`: defects are found, small lights are not, and views that cannot tell are
refused.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fieldlum.calibrate import pixels
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
from fieldlum.optics.raw import write_dng

SIDE = 256
HOT = {(100, 60), (131, 140), (64, 190)}
DEAD = {(90, 101), (180, 120)}
STUCK = {(150, 77)}
COLUMN = {(121, y) for y in range(150, 190)}
PROFILE = CameraProfile(
    CameraBody("small", "raw", SIDE, SIDE),
    (Lens((128.0, 128.0), 125.0, 180.0),),
    Bracket(4.0, 100.0, (0.1,)),
    Sensor("RGGB", (256.0,) * 4, (15000.0,) * 4, 16383.0, 2.0, 5.0, 100.0),
)


def view(seed: int) -> np.ndarray:
    """Mean counts above black of a room: surfaces, thin bars, and some lights of one or two
    pixels.
    """
    rng = np.random.default_rng(seed)
    light = np.full((SIDE, SIDE), 400.0)
    for _ in range(60):
        y, x = rng.integers(0, SIDE - 30, 2)
        h, w = rng.integers(2, 30, 2)
        light[y : y + h, x : x + w] = 10 ** rng.uniform(1.8, 3.6)
    for y, x in rng.integers(10, SIDE - 10, (12, 2)):
        light[y : y + rng.integers(1, 3), x : x + rng.integers(1, 3)] = 9000.0
    return light


def frame(
    path: Path, light: np.ndarray, exposed: float = 1.0, seed: int = 0, defects: bool = True
) -> Path:
    rng = np.random.default_rng(seed)
    mean = light * exposed
    if defects:
        for x, y in HOT:
            mean[y, x] += 2500.0 * exposed
        for x, y in DEAD | COLUMN:
            mean[y, x] *= 0.2
    counts = 256 + mean + np.sqrt(mean / 2 + 2.5**2) * rng.standard_normal(mean.shape)
    if defects:
        for x, y in STUCK:
            counts[y, x] = 5000.0
    path.parent.mkdir(exist_ok=True, parents=True)
    whole = np.clip(np.round(counts), 0, 15000).astype(np.uint16)
    write_dng(path, whole, Exposure(0.1 * exposed, 4.0), black_dn=(256,) * 4, white_dn=16383)
    return path


def brackets(folder: Path, seeds: tuple[int, ...], defects: bool = True) -> list[Path]:
    """A folder for each view, three exposures in each."""
    for number, seed in enumerate(seeds):
        for i, exposed in enumerate((0.1, 1.0, 4.0)):
            frame(folder / f"v{number}" / f"{i}.dng", view(seed), exposed, 10 * number + i, defects)
    return sorted(folder.iterdir())


@pytest.mark.analytic
def test_defects_are_found_and_nothing_else(tmp_path: Path) -> None:
    found = pixels.find(brackets(tmp_path, (1, 2, 3, 4)), PROFILE)
    known = set(found.bad_px)
    assert known >= HOT | DEAD | STUCK and known <= HOT | DEAD | STUCK | COLUMN
    assert len(known & COLUMN) > 5  # of a line, those that no view hides behind detail of its own
    assert found.views == 4 and len(found.frames) == 12 and found.by_chance < 0.5


@pytest.mark.analytic
def test_a_faultless_sensor_has_no_bad_pixels(tmp_path: Path) -> None:
    assert pixels.find(brackets(tmp_path, (5, 6, 7, 8), defects=False), PROFILE).bad_px == ()


@pytest.mark.slow
@pytest.mark.contract
def test_one_view_again_and_again_is_refused(tmp_path: Path) -> None:
    """A small light at the same place in every frame is a light, however often it is taken."""
    with pytest.raises(NotEnoughDataError, match="different views: 1;"):
        pixels.find(brackets(tmp_path, (1, 1, 1, 1)), PROFILE)
    with pytest.raises(NotEnoughDataError, match="different views: 2;"):
        pixels.find(brackets(tmp_path / "two", (1, 2, 1, 2)), PROFILE)
    blank = [
        frame(tmp_path / "blank" / f"{i}.dng", np.full((SIDE, SIDE), 300.0), seed=i)
        for i in range(4)
    ]
    with pytest.raises(NotEnoughDataError, match="4 views with too little detail"):
        pixels.find(blank, PROFILE)


@pytest.mark.contract
def test_views_too_busy_to_tell_are_refused(tmp_path: Path) -> None:
    for i in range(3):
        busy = 10 ** np.random.default_rng(i).uniform(2, 3.5, (SIDE, SIDE))
        busy += np.kron(view(i)[::4, ::4], np.ones((4, 4)))
        frame(tmp_path / f"v{i}" / "0.dng", busy, seed=i)
    with pytest.raises(NotEnoughDataError, match="by chance"):
        pixels.find(sorted(tmp_path.iterdir()), PROFILE)


@pytest.mark.contract
def test_with_the_cap_on(tmp_path: Path) -> None:
    dark = [frame(tmp_path / f"{i}.dng", np.zeros((SIDE, SIDE)), 8.0, i) for i in range(3)]
    found = pixels.find(dark, PROFILE, dark=True)
    assert set(found.bad_px) == HOT | STUCK  # a dead pixel is dark like the others
    with pytest.raises(NotEnoughDataError, match="expected at least 2"):
        pixels.find(dark[:1], PROFILE, dark=True)
    with pytest.raises(InputError, match="put the lens cap on"):
        pixels.find([frame(tmp_path / "lit.dng", view(1)), dark[0]], PROFILE, dark=True)


@pytest.mark.slow
@pytest.mark.contract
def test_the_command(tmp_path: Path) -> None:
    camera, out = tmp_path / "small.toml", tmp_path / "new.toml"
    save_profile(camera, replace(PROFILE, sensor=replace(PROFILE.sensor, bad_px=((1, 2),))))
    dark = [str(frame(tmp_path / f"{i}.dng", np.zeros((SIDE, SIDE)), 8.0, i)) for i in range(2)]
    words = ["calibrate", "pixels", *dark, "--dark", "--camera", str(camera), "--out", str(out)]
    ran = CliRunner().invoke(main, [*words, "--json", "--picture", str(tmp_path / "p.png")])
    assert ran.exit_code == 0, ran.output
    assert json.loads(ran.stdout)["found"] == 4 and (tmp_path / "p.png").stat().st_size > 1000
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
