"""A camera that turned within its bracket is named; one that stood still is not."""

from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from fieldlum.core.records import Panorama
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated.camera import SimulatedCamera
from fieldlum.devices.simulated.world import SimulatedLight
from fieldlum.merge import MergeOptions, Shot, merge_shots
from fieldlum.merge.shift import reduce_frame, turns_between
from fieldlum.merge.stage import QUALITY_COLUMNS
from fieldlum.optics.exposure import z_per_cdm2
from fieldlum.optics.profiles import CameraProfile, bracket_exposures, load_camera_profile
from fieldlum.optics.projection import LensGeometry, lens_pixels, lens_rays

HEIGHT = 180


def furnished() -> np.ndarray:
    """Patches of some 15 degrees with sharp edges, 10 to 400 cd/m2 and a window, [HEIGHT, 2
    HEIGHT].
    """
    patches = np.exp(np.random.default_rng(3).normal(4.0, 0.6, (12, 24)))
    light = np.repeat(np.repeat(patches, HEIGHT // 12, axis=0), HEIGHT // 12, axis=1)
    light[60:100, 170:200] = 4000.0
    return light.astype(np.float32)


class StillWorld:
    def __init__(self) -> None:
        light = furnished()
        self.panorama = Panorama(
            light, 180.0, rgb=np.repeat(light[..., None] / 179.0, 3, axis=2).astype(np.float32)
        )

    def scene(self, t_utc: datetime) -> Panorama:
        return self.panorama

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        return SimulatedLight(ghi_wm2=0.0, dhi_wm2=0.0, dni_wm2=0.0)


def small_camera(name: str) -> CameraProfile:
    """A shipped camera with half of its pixels a side, for speed."""
    profile = load_camera_profile(name)
    body = profile.camera
    lenses = [
        replace(x, centre_px=(x.centre_px[0] / 2, x.centre_px[1] / 2), radius_px=x.radius_px / 2)
        for x in profile.lens
    ]
    half = replace(body, width_px=body.width_px // 2, height_px=body.height_px // 2)
    return replace(profile, camera=half, lens=tuple(lenses))


def pixels_per_degree(profile: CameraProfile) -> float:
    lens = profile.lens[0]
    a = LensGeometry(
        lens.centre_px, lens.radius_px, lens.full_angle_deg, lens.mapping, lens.coefficients
    )
    x = lens_pixels(
        a, np.array([[0.0, 1.0, 0.0], [np.sin(np.radians(1)), np.cos(np.radians(1)), 0.0]])
    )[0]
    return float(abs(x[1] - x[0]))


def photograph(folder: Path, profile: CameraProfile, turn_px: float, of_frame: int) -> list[Shot]:
    """A bracket whose camera turns before one of its frames, the longest first."""
    turn = turn_px / pixels_per_degree(profile)
    turned = replace(
        profile, lens=tuple(replace(x, azimuth_deg=x.azimuth_deg + turn) for x in profile.lens)
    )
    clock, world = FastClock(datetime(2027, 3, 20, 20, tzinfo=UTC)), StillWorld()
    before, after = (SimulatedCamera(world, p, clock, heading_deg=180.0) for p in (profile, turned))
    unfiltered = [e for e in bracket_exposures(profile.bracket) if not e.nd]
    exposures = sorted(unfiltered, key=lambda e: -z_per_cdm2(e.shutter_s, e.f_number, e.iso))
    return [
        Shot((before if i < of_frame else after).expose(e, folder / f"{i:02d}"), e)
        for i, e in enumerate(exposures)
    ]


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("name", ["sim-fisheye", "sim-dual-fisheye-jpeg"])
def test_a_camera_that_turned_by_two_pixels_is_named(tmp_path: Path, name: str) -> None:
    profile = small_camera(name)
    shots = photograph(tmp_path, profile, 2.0, 5)
    result = merge_shots(shots, profile, MergeOptions(height=16))
    assert result.quality["shift_px"] == pytest.approx(2.0, abs=0.2)
    assert f"px) between {shots[4].path.name} and {shots[5].path.name}" in result.verdict
    assert result.verdict.count("turned") == 1
    assert {"shift_px", "shift_u_px"} <= set(QUALITY_COLUMNS)


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("name", ["sim-fisheye", "sim-dual-fisheye-jpeg"])
def test_a_camera_that_stood_still_is_not(tmp_path: Path, name: str) -> None:
    profile = small_camera(name)
    shots = photograph(tmp_path, profile, 0.0, 5)
    result = merge_shots(shots, profile, MergeOptions(height=16))
    assert result.quality["shifts"] and result.quality["shift_px"] < 0.2
    assert "turned" not in result.verdict


LENS = LensGeometry((150.0, 150.0), 145.0, 180.0, "equidistant")


def _turned(
    vector_deg: tuple[float, float, float], gain: float, rng: np.random.Generator
) -> np.ndarray:
    """A picture of random patches by a camera turned about x, y, z (y is its axis), [300, 300];
    0 outside the lens.
    """
    y, x = np.mgrid[:300, :300] + 0.5
    rays = lens_rays(LENS, x, y)
    vector = np.radians(vector_deg)
    angle = float(np.linalg.norm(vector))
    unit = vector / max(angle, 1e-12)
    rays = (
        rays * np.cos(angle)
        + np.cross(unit, rays) * np.sin(angle)
        + unit * (rays @ unit)[..., None] * (1 - np.cos(angle))
    )
    waves = np.random.default_rng(8).normal(0, 9, (12, 3))
    light = np.exp(0.25 * np.sin(rays @ waves.T).sum(axis=-1))
    light = np.where(np.hypot(x - 150, y - 150) < 145, light, 0)
    return (gain * light * (1 + rng.normal(0, 0.01, light.shape))).astype(np.float32)


@pytest.mark.analytic
@pytest.mark.parametrize(
    "vector_deg", [(0.0, 0.0, 1.5), (-0.8, 0.0, 0.0), (0.0, 2.0, 0.0), (6.0, -2.0, 5.0)]
)
def test_any_turn_is_found_through_the_lens(
    vector_deg: tuple[float, float, float],
) -> None:
    rng = np.random.default_rng(0)
    pictures = [
        _turned((0.0, 0.0, 0.0), 1.0, rng),
        _turned(vector_deg, 1.3, rng),
    ]  # an exposure that is off
    seen = [(p > 0.3) & (p < limit) for p, limit in zip(pictures, (3.0, 5.0), strict=True)]
    seen[0][100:140, 60:200] = False  # clipped in the longer frame only
    (moved,) = turns_between(
        [reduce_frame(p, s, 0.0) for p, s in zip(pictures, seen, strict=True)], [LENS], "ab"
    )
    assert moved.turn_deg == pytest.approx(np.linalg.norm(vector_deg), rel=0.03, abs=0.02)
    assert moved.shift_px == pytest.approx(moved.turn_deg * 145 / 90, rel=1e-3)
    assert moved.sure_px > 0.8


@pytest.mark.contract
def test_an_empty_wall_tells_nothing() -> None:
    rng = np.random.default_rng(1)
    walls = [(100 * (1 + rng.normal(0, 0.002, (300, 300)))).astype(np.float32) for _ in range(2)]
    assert turns_between([reduce_frame(w, w > 0, 0.0) for w in walls], [LENS], "ab") == []
    assert turns_between([reduce_frame(walls[0], walls[0] > 0, 0.0)], [LENS], "a") == []


@pytest.mark.analytic
def test_noise_of_a_dark_frame_is_no_turn() -> None:
    """The stated u was that along the axis that noise chose, and too small where few blocks have
    points: a still camera "turned" by over three of them in five of these pairs.
    """
    for seed in range(12):
        rng = np.random.default_rng(seed)
        long = _turned((0.0, 0.0, 0.0), 1.0, rng)
        dark = (long * (1 + rng.normal(0, 0.2, long.shape))).astype(np.float32)
        seen = [(long > 1.2) & (long < 9), dark > 0.05]
        frames = [reduce_frame(p, s, 0.0) for p, s in zip((long, dark), seen, strict=True)]
        (still,) = turns_between(frames, [LENS], "ab")
        assert still.sure_px == 0.0
        assert still.shift_px < 2.0 * still.u_px
