"""Contract: `fieldlum calibrate` end to end on simulated captures, its exit codes and its one
JSON object.
"""

import json
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from fieldlum.cli import main
from fieldlum.core.records import Exposure, Panorama
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated.camera import SimulatedCamera
from fieldlum.devices.simulated.world import SimulatedLight
from fieldlum.optics.camera_curves import vignetting_at
from fieldlum.optics.images import write_panorama
from fieldlum.optics.profiles import Lens, Response, load_camera_profile, save_profile
from fieldlum.optics.projection import direction, equirect_rays, lens_pixels

pytestmark = pytest.mark.contract

H = 180


class Still:
    def __init__(self, luminance_cdm2: np.ndarray) -> None:
        self._panorama = Panorama(luminance_cdm2.astype(np.float32), 180.0)

    def scene(self, t_utc: datetime) -> Panorama:
        return self._panorama

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        return SimulatedLight(ghi_wm2=0.0, dhi_wm2=0.0, dni_wm2=0.0)


TRUTH = load_camera_profile("sim-fisheye")


def _shoot(
    luminance: np.ndarray, target: Path, heading: float = 180.0, exposure: Exposure | None = None
) -> Path:
    camera = SimulatedCamera(
        Still(luminance), TRUTH, FastClock(datetime(2027, 3, 20, 12, tzinfo=UTC))
    )
    return camera.expose(exposure or Exposure(1 / 60, 5.6), target, heading_deg=heading)


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    path = tmp_path / "mine.toml"
    save_profile(path, replace(TRUTH, lens=(Lens((242.0, 242.0), 230.0, 190.0),)))
    return path


def _call(*words: object) -> dict:
    found = CliRunner().invoke(main, ["calibrate", *map(str, words), "--json"])
    assert found.exit_code == 0, found.output
    assert found.stdout.count("\n") == 1
    return json.loads(found.stdout)


@pytest.mark.slow
def test_lens_then_vignette_then_scale(tmp_path: Path, mine: Path) -> None:
    flat = _shoot(np.full((H, 2 * H), 300.0), tmp_path / "flat")
    keep = ("--camera", mine, "--out", mine)
    edge = _call("lens", flat, "--circle", *keep, "--picture", tmp_path / "c.png")
    assert (
        edge["lens"][0]["radius_px"] == pytest.approx(236, abs=2.5)
        and (tmp_path / "c.png").stat().st_size > 1000
    )

    lines = ["x_px,y_px,azimuth_deg,altitude_deg"]
    for azimuth in range(-80, 81, 32):
        for altitude in (-50, -15, 15, 50):
            x, y, _ = lens_pixels(TRUTH.lens[0], direction(altitude, azimuth))
            lines.append(f"{x:.2f},{y:.2f},{azimuth},{altitude}")
    (tmp_path / "targets.csv").write_text("\n".join(lines))
    mapping = _call("lens", tmp_path / "targets.csv", *keep, "--picture", tmp_path / "l.svg")
    assert mapping["lens"][0]["mapping"] == "equisolid" and "held-out" in mapping["why"][0]

    shade = _call("vignette", flat, *keep, "--picture", tmp_path / "v.png")
    r = np.linspace(0, 0.9, 20)
    truth = vignetting_at(TRUTH.lens[0].vignetting[1].coefficients, r)
    assert (
        np.abs(
            vignetting_at(tuple(shade["lens"][0]["vignetting"][-1]["coefficients"]), r) / truth - 1
        ).max()
        < 0.01
    )

    rays = equirect_rays(H, 2 * H, 180.0)
    luminance = 50 + 400 * np.clip(rays @ direction(20, 200), 0, 1) ** 2
    write_panorama(tmp_path / "p.exr", Panorama((luminance / 1.1).astype(np.float32), 180.0))
    spots = [
        f"p.exr,{a},0,{50 + 400 * max(direction(0, a) @ direction(20, 200), 0) ** 2:.2f}"
        for a in (150, 180, 210, 240)
    ]
    (tmp_path / "r.csv").write_text(
        "\n".join(["panorama,azimuth_deg,altitude_deg,luminance_cdm2", *spots])
    )
    scaled = _call("scale", tmp_path / "r.csv", *keep, "--picture", tmp_path / "s.png")
    assert scaled["factor"] == pytest.approx(1.1, rel=0.01) and len(scaled["points"]) == 4

    final = load_camera_profile(mine)
    assert len(final.provenance.log) == 4 and len(final.provenance.frames_sha256) >= 3
    assert final.scale.k == pytest.approx(TRUTH.scale.k * 1.1, rel=0.01)


def test_the_illuminance_on_a_desk_is_not_called_vertical(tmp_path: Path, mine: Path) -> None:
    write_panorama(tmp_path / "p.exr", Panorama(np.full((60, 120), 100.0, np.float32), 180.0))
    rows = [f"p.exr,180,{altitude},{100.0 * np.pi:.1f}" for altitude in (90, 80, 70)]
    table = tmp_path / "r.csv"
    table.write_text("\n".join(["panorama,azimuth_deg,altitude_deg,illuminance_lx", *rows]))
    why = _call("scale", table, "--camera", mine, "--out", mine)["why"][0]
    assert "; illuminance: " in why and "vertical" not in why


@pytest.mark.slow
def test_colour_by_spots(tmp_path: Path, mine: Path) -> None:
    """Grey spots prove nothing about colour: the prior stays, and the scale is said."""
    rays = equirect_rays(H, 2 * H, 180.0)
    luminance = np.full((H, 2 * H), 20.0)
    lines = ["file,x_px,y_px,radius_px,luminance_cdm2"]
    profile = load_camera_profile(mine)
    profile = replace(profile, lens=TRUTH.lens)
    save_profile(mine, profile)

    for i, azimuth in enumerate((-40, -20, 0, 20, 40)):
        value = 60.0 * (i + 1)
        luminance[rays @ direction(0, 180 + azimuth) > np.cos(np.radians(5))] = value
        x, y, _ = lens_pixels(TRUTH.lens[0], direction(0, azimuth))
        lines.append(f"spots.dng,{x:.1f},{y:.1f},5,{value}")
    _shoot(luminance, tmp_path / "spots")
    (tmp_path / "spots.csv").write_text("\n".join(lines))
    out = tmp_path / "colour.toml"
    found = _call(
        "colour",
        tmp_path / "spots.csv",
        "--camera",
        mine,
        "--out",
        out,
        "--picture",
        tmp_path / "c.png",
    )
    assert found["colour"]["y_from_rgb"] == pytest.approx(TRUTH.colour.y_from_rgb, abs=1e-5)
    assert found["colour"]["u_rel"] == load_camera_profile(out).colour.u_rel < 0.03


@pytest.mark.slow
def test_response_of_the_simulated_jpeg_camera(tmp_path: Path) -> None:
    truth = load_camera_profile("sim-dual-fisheye-jpeg")
    save_profile(tmp_path / "mine.toml", replace(truth, response=Response()))
    rng = np.random.default_rng(3)
    luminance = np.repeat(
        np.repeat(10 ** rng.uniform(0.5, 3, (H // 6, H // 3)), 6, axis=0), 6, axis=1
    )
    camera = SimulatedCamera(
        Still(luminance), truth, FastClock(datetime(2027, 3, 20, 12, tzinfo=UTC))
    )
    folder = tmp_path / "bracket"
    folder.mkdir()
    for i, shutter in enumerate((0.625, 0.25, 0.1, 0.04, 1 / 60, 1 / 160)):
        camera.expose(Exposure(shutter, 5.6), folder / f"f{i}", heading_deg=180.0)
    found = _call(
        "response",
        folder,
        "--camera",
        tmp_path / "mine.toml",
        "--out",
        tmp_path / "new.toml",
        "--picture",
        tmp_path / "r.png",
    )
    assert found["response"]["kind"] in ("table", "srgb") and found["response"]["u_rel"] < 0.04
    assert load_camera_profile(tmp_path / "new.toml").response.kind == found["response"]["kind"]


def test_bad_input_is_one_line(tmp_path: Path, mine: Path) -> None:
    keep = ["--camera", str(mine), "--out", str(tmp_path / "new.toml")]
    table = tmp_path / "t.csv"
    table.write_text("angle_deg,value\n0,1\n10,1.1\n30,1.2\n50,1.3\n70,1.5\n80,1.7\n")
    rising = CliRunner().invoke(main, ["calibrate", "vignette", str(table), *keep])
    assert (
        rising.exit_code == 3
        and "correction factors" in rising.stderr
        and rising.stderr.count("\n") == 1
    )
    table.write_text("x_px,y_px,azimuth_deg\n1,2,3\n")
    missing = CliRunner().invoke(main, ["calibrate", "lens", str(table), *keep])
    assert missing.exit_code == 3 and "no column altitude_deg" in missing.stderr
    table.write_text("x_px,y_px,azimuth_deg,altitude_deg\n1,2,3,4\n")
    few = CliRunner().invoke(main, ["calibrate", "lens", str(table), *keep])
    assert few.exit_code == 5
    both = CliRunner().invoke(
        main, ["calibrate", "lens", str(table), "--circle", "--chessboard", "9x6", *keep]
    )
    assert both.exit_code == 2
    wrong = CliRunner().invoke(main, ["calibrate", "colour", str(table), "--corners", "1,2", *keep])
    assert wrong.exit_code in (2, 3)
    assert not (tmp_path / "new.toml").exists()
