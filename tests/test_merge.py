"""The estimator, one bracket against known luminance, flags, the sun, and bad frames."""

import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldlum.core.errors import InputError
from fieldlum.core.progress import shown_by
from fieldlum.core.records import Exposure, Flag, Panorama, SunSource
from fieldlum.devices.clock import FastClock
from fieldlum.devices.simulated.camera import SimulatedCamera
from fieldlum.devices.simulated.world import SimulatedLight
from fieldlum.merge import MergeOptions, MergeResult, Shot, merge_shots
from fieldlum.merge.estimator import Merged, merge_signals
from fieldlum.merge.linear_frames import JpegSignal, RawSignal, lens_crop, load_raw
from fieldlum.merge.project import LensView, blend, resampler
from fieldlum.merge.shots import sorted_shots
from fieldlum.merge.sun_and_sky import disc_px, mosaic_u_rel, take_out_disc
from fieldlum.optics.illuminance import illuminance_lx
from fieldlum.optics.linear_light import vignetting_of
from fieldlum.optics.profiles import (
    CameraProfile,
    Lens,
    Vignetting,
    bracket_exposures,
    load_camera_profile,
)
from fieldlum.optics.projection import direction, equirect_rays, equirect_solid_angles
from fieldlum.optics.raw.writing import write_dng

GAIN, READ_E = 4.0, 6.0

# ---------------------------------------------------------------------------------------------- the
# estimator


def raw_signal(
    counts: np.ndarray, per_cdm2: float, black: float = 512.0, full: float = 14000.0
) -> RawSignal:
    def constant(value: float) -> np.ndarray:
        return np.asarray(value, np.float32)

    return RawSignal(
        counts.astype(np.uint16),
        constant(black),
        constant(full - black),
        constant(per_cdm2),
        GAIN,
        (READ_E / GAIN) ** 2 + 1 / 12,
    )


def expose(light: np.ndarray, per_cdm2: float, rng: np.random.Generator) -> RawSignal:
    electrons = rng.poisson(np.minimum(light * per_cdm2 * GAIN, 1e9)) + rng.normal(
        0, READ_E, light.shape
    )
    return raw_signal(np.clip(np.round(electrons / GAIN + 512), 0, 14000), per_cdm2)


def merged(signals: list[RawSignal], shape: tuple[int, ...]) -> Merged:
    return merge_signals(signals, shape)


STEPS = (100.0, 25.0, 6.25, 1.5625)


@pytest.mark.analytic
@pytest.mark.parametrize("light", [0.02, 1.0, 50.0, 2000.0])
def test_merge_is_unbiased_and_says_how_sure_it_is(light: float) -> None:
    # analytic: the scene is known; the full table is bench/merge_estimator.py
    rng = np.random.default_rng(5)
    scene = np.full((60, 2, 250), light)
    m = merged([expose(scene, e, rng) for e in STEPS], scene.shape)
    error = m.value_cdm2.astype(float) - light
    u = np.sqrt(m.variance.astype(float))
    assert abs(error.mean()) < 4 * error.std() / np.sqrt(error.size) + 0.01 * light * (light < 0.1)
    assert 0.93 < np.mean(np.abs(error) < 1.96 * u) < 0.97


@pytest.mark.property
@settings(deadline=None, max_examples=15)
@given(st.floats(0.05, 20.0), st.integers(0, 2**31))
def test_scaling_all_exposures_scales_the_luminance(factor: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    scene = np.exp(rng.uniform(0, 6, (4, 2, 8)))
    frames = [expose(scene, e, rng) for e in STEPS]
    scaled = [replace(f, per_cdm2=(f.per_cdm2 * factor).astype(np.float32)) for f in frames]
    a, b = merged(frames, scene.shape), merged(scaled, scene.shape)
    assert b.value_cdm2 * factor == pytest.approx(a.value_cdm2, rel=1e-4)
    assert np.array_equal(a.flags, b.flags)


@pytest.mark.analytic
def test_what_saturates_everywhere_is_a_flagged_lower_bound() -> None:
    light = np.full((10, 2, 20), 100.0)
    light[4:6, :, 8:12] = 1e6
    m = merged([expose(light, e, np.random.default_rng(0)) for e in STEPS], light.shape)
    clipped = (m.flags & Flag.CLIPPED_HIGH) > 0
    assert np.array_equal(clipped, light > 1e5)
    assert np.all(m.value_cdm2[clipped] < 1e6) and np.all(
        m.value_cdm2[clipped] > 0.9 * 13000 / STEPS[-1]
    )
    assert np.all(np.sqrt(m.variance[clipped]) >= m.value_cdm2[clipped] * 0.999)
    bloom = (m.flags & Flag.BLOOM) > 0
    assert bloom.any() and not (bloom & clipped).any()
    assert m.value_cdm2[bloom] == pytest.approx(100.0, rel=0.3)  # the shortest frame's own noise
    assert not m.flags[0].any()


@pytest.mark.analytic
def test_frames_that_disagree_are_flagged_as_motion() -> None:
    light = np.full((10, 2, 40), 100.0)
    moved = light.copy()
    moved[:, :, :10] = 150.0
    frames = [
        expose(moved if i == 1 else light, e, np.random.default_rng(i)) for i, e in enumerate(STEPS)
    ]
    flagged = (merged(frames, light.shape).flags & Flag.MOTION) > 0
    assert flagged[:, :, :10].mean() > 0.95 and flagged[:, :, 10:].mean() < 0.01


@pytest.mark.analytic
def test_negative_signals_are_kept() -> None:  # cutting them would bias the dark by some counts
    dark = np.zeros((40, 2, 200))
    m = merged([expose(dark, e, np.random.default_rng(0)) for e in STEPS], dark.shape)
    assert (
        abs(m.value_cdm2.mean()) < 4 * m.value_cdm2.std() / np.sqrt(dark.size)
        and (m.value_cdm2 < 0).any()
    )


@pytest.mark.property
@settings(deadline=None, max_examples=15)
@given(st.lists(st.floats(0.2, 0.8), min_size=2, max_size=5))
def test_jpeg_weights_follow_the_codes_limits(levels: list[float]) -> None:
    table = np.repeat((np.arange(256, dtype=np.float32)[:, None] / 255) ** 2, 3, axis=1)
    frame = JpegSignal(
        np.zeros((1, 1, 3), np.uint8), table, np.ones(3, np.float32), 27, 228, False, False
    )
    z = np.repeat(np.asarray(levels, np.float32)[None, :, None] ** 2, 3, axis=2)
    assert np.all(frame.weight(z) > 0)
    assert np.all(frame.weight(np.full_like(z, 0.99)) == 0) and np.all(
        frame.weight(np.full_like(z, 1e-4)) == 0
    )


# ---------------------------------------------------------------------------------------------- a
# whole bracket

HEIGHT = 46


def scene(height: int) -> np.ndarray:
    """A smooth room with a bright window, 15 to 7000 cd/m2, [height, 2 height]."""
    rays = equirect_rays(height, 2 * height, 180.0)
    light = 60 * np.exp(1.2 * rays[..., 2] + 0.8 * rays[..., 0])
    window = (
        (np.abs(rays[..., 0]) < 0.45)
        & (rays[..., 1] < -0.6)
        & (rays[..., 2] > 0)
        & (rays[..., 2] < 0.55)
    )
    return np.where(window, 4000 * (1 + rays[..., 2]), light)


class StillWorld:
    def __init__(self, sun: SunSource | None, uniform: float | None) -> None:
        fine = scene(4 * HEIGHT) if uniform is None else np.full((4 * HEIGHT, 8 * HEIGHT), uniform)
        rgb = np.repeat(fine[..., None] / 179.0, 3, axis=2).astype(np.float32)
        self.panorama = Panorama(fine.astype(np.float32), 180.0, sun=sun, rgb=rgb)

    def scene(self, t_utc: datetime) -> Panorama:
        return self.panorama

    def irradiance(self, t_utc: datetime) -> SimulatedLight:
        return SimulatedLight(ghi_wm2=0.0, dhi_wm2=0.0, dni_wm2=0.0)


def photograph(
    folder: Path,
    profile: CameraProfile,
    *,
    headings: tuple[float | None, ...] = (None,),
    sun: SunSource | None = None,
    uniform: float | None = None,
) -> list[Shot]:
    clock = FastClock(datetime(2027, 3, 20, 20, tzinfo=UTC))
    camera = SimulatedCamera(StillWorld(sun, uniform), profile, clock, heading_deg=180.0)
    exposures = bracket_exposures(profile.bracket, "nd5")
    return [
        Shot(camera.expose(e, folder / f"{i:02d}_{heading}", heading_deg=heading), e, heading)
        for heading in headings
        for i, e in enumerate(exposures)
    ]


def smaller(profile: CameraProfile, factor: float = 0.5) -> CameraProfile:
    """The same camera with fewer pixels, for speed."""
    body = profile.camera
    lenses = [
        replace(
            x,
            centre_px=(factor * x.centre_px[0], factor * x.centre_px[1]),
            radius_px=factor * x.radius_px,
        )
        for x in profile.lens
    ]
    size = {"width_px": int(body.width_px * factor), "height_px": int(body.height_px * factor)}
    return replace(profile, camera=replace(body, **size), lens=tuple(lenses))


@pytest.fixture(scope="module")
def bracket(
    tmp_path_factory: pytest.TempPathFactory,
) -> Callable[..., tuple[list[Shot], CameraProfile]]:
    @cache
    def make(name: str, **options: object) -> tuple[list[Shot], CameraProfile]:
        profile = smaller(load_camera_profile(name))
        return photograph(tmp_path_factory.mktemp("frames"), profile, **options), profile  # type: ignore[arg-type]

    return make


def merge(shots: list[Shot], profile: CameraProfile, heading: float = 180.0) -> MergeResult:
    return merge_shots(shots, profile, MergeOptions(height=HEIGHT), heading_deg=heading)


def truth() -> np.ndarray:
    """Mean luminance of each pixel of the merged size."""
    fine, solid = scene(4 * HEIGHT), equirect_solid_angles(4 * HEIGHT, 8 * HEIGHT)
    sums = [
        (a * solid).reshape(HEIGHT, 4, 2 * HEIGHT, 4).sum(axis=(1, 3))
        for a in (fine, np.ones_like(fine))
    ]
    return sums[0] / sums[1]


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.parametrize(
    ("name", "headings"),
    [
        ("sim-dual-fisheye", (None,)),
        ("sim-fisheye", (180.0, 0.0)),
        ("sim-dual-fisheye-jpeg", (None,)),
    ],
)
def test_known_luminance_comes_back(bracket, name: str, headings: tuple) -> None:
    # authority: the simulator's own scene; median under 1 %, 95 % of unflagged pixels
    # within 5 %
    shots, profile = bracket(name, headings=headings)
    result = merge(shots, profile)
    panorama = result.panorama
    assert panorama.flags is not None and panorama.u_cdm2 is not None
    good = panorama.flags == 0
    error = panorama.luminance_cdm2 / truth() - 1
    assert good.mean() > 0.98
    assert abs(np.median(error[good])) < 2e-3
    assert np.mean(np.abs(error[good]) < 0.05) > 0.95
    assert (
        np.all(panorama.u_cdm2[good] > 0)
        and np.median(panorama.u_cdm2[good] / panorama.luminance_cdm2[good]) < 0.05
    )
    image, known = (
        illuminance_lx(a, 180.0, 0.0, 180.0) for a in (panorama.luminance_cdm2, truth())
    )
    assert image == pytest.approx(
        known, rel=5e-3
    )  # one half per cent of the budget is the window's edge
    assert result.quality["residual_percent"] < 1.5 and result.verdict.startswith("good")


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.numeric
def test_the_order_of_frames_does_not_matter(bracket) -> None:
    shots, profile = bracket("sim-dual-fisheye", headings=(None,))
    a = merge(shots, profile).panorama
    b = merge(
        [shots[i] for i in np.random.default_rng(1).permutation(len(shots))], profile
    ).panorama
    assert np.array_equal(a.luminance_cdm2, b.luminance_cdm2)
    assert np.array_equal(a.flags, b.flags)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.property
def test_a_turned_heading_turns_the_panorama(bracket) -> None:  # whole columns
    shots, profile = bracket("sim-fisheye", headings=(180.0, 0.0))
    a = merge(shots, profile).panorama.luminance_cdm2
    turn = 360 / (2 * HEIGHT) * 7
    b = merge(shots, profile, heading=180.0 + turn).panorama.luminance_cdm2
    assert np.roll(a, -7, axis=1) == pytest.approx(b, rel=2e-3)


@pytest.mark.slow
@pytest.mark.analytic
def test_a_uniform_room_gives_pi_l(
    bracket,
) -> None:  # analytic: within 0.05 % (and the camera's noise)
    shots, profile = bracket("sim-dual-fisheye", uniform=200.0)
    panorama = merge(shots, profile).panorama
    assert illuminance_lx(panorama.luminance_cdm2, 180.0, 0.0, 30.0) == pytest.approx(
        200 * np.pi, rel=1e-3
    )


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.parametrize("name", ["sim-dual-fisheye", "sim-dual-fisheye-jpeg"])
def test_a_filter_that_was_not_there_is_named_and_changes_nothing(bracket, name: str) -> None:
    """Frames without a filter, of which two carry its name: same map as with the right names."""
    shots, profile = bracket(name)
    bare = [shot for shot in shots if not shot.exposure.nd]
    right, labelled = list(bare), list(bare)
    for filtered in (shot for shot in shots if shot.exposure.nd):
        like = min(bare, key=lambda s: abs(s.exposure.shutter_s / filtered.exposure.shutter_s - 1))
        copy = filtered.path.with_name(f"copy_{like.path.name}")
        shutil.copy(like.path, copy)
        right.append(replace(like, path=copy))
        exposure = replace(like.exposure, nd=filtered.exposure.nd)
        labelled.append(replace(like, path=copy, exposure=exposure))
    a, b = merge(right, profile), merge(labelled, profile)
    assert np.array_equal(a.panorama.luminance_cdm2, b.panorama.luminance_cdm2)
    assert len(b.report.filter_absent) == 2 and not a.report.filter_absent
    assert "as bright as without the filter" in b.verdict and "motion" not in b.verdict
    assert not merge(shots, profile).report.filter_absent


@pytest.mark.slow
@pytest.mark.analytic
def test_the_sun_is_measured_through_the_filter_and_taken_out(bracket) -> None:
    sun = SunSource(25.0, 190.0, 60_000.0)
    shots, profile = bracket("sim-dual-fisheye", sun=sun)
    panorama = merge(shots, profile).panorama
    assert panorama.flags is not None and (panorama.flags & Flag.ND).any()
    without, _ = take_out_disc(panorama, 25.0, 190.0)
    assert without.sun is not None and without.flags is not None
    assert without.sun.origin == "nd-frames"
    u_rel = mosaic_u_rel(
        disc_px(profile.lens)
    )  # each colour stands on every second pixel of a small sensor
    assert without.sun.normal_illuminance_lx == pytest.approx(60_000, rel=u_rel) and u_rel < 0.6
    assert without.luminance_cdm2.max() < 2e4 and (without.flags & Flag.FILLED).any()
    total = illuminance_lx(without.luminance_cdm2, 180.0, 0.0, 180.0, without.sun)
    assert total == pytest.approx(
        illuminance_lx(panorama.luminance_cdm2, 180.0, 0.0, 180.0), rel=0.01
    )


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("through_filter", [True, False])
def test_the_suns_centre_is_measured_on_the_sensor(bracket, through_filter: bool) -> None:
    """The map's pixels are far larger than sigma, and the ephemeris is a degree off."""
    shots, profile = bracket("sim-dual-fisheye", sun=SunSource(25.0, 190.0, 60_000.0))
    start = datetime(2027, 3, 20, 20, tzinfo=UTC)
    timed = [
        replace(s, t_utc=start + timedelta(seconds=10 * i))
        for i, s in enumerate(shots)
        if through_filter or not s.exposure.nd
    ]
    sun = merge_shots(timed, profile, MergeOptions(height=HEIGHT), sun_deg=(25.7, 189.2)).sun
    assert sun is not None and sun.sigma_deg < (0.05 if through_filter else 0.25)
    away = direction(25.0, 190.0) @ direction(sun.altitude_deg, sun.azimuth_deg)
    assert np.degrees(np.arccos(min(away, 1.0))) < 3 * np.sqrt(2) * sun.sigma_deg
    shown = [s.t_utc.timestamp() for s in timed if s.t_utc and s.exposure.nd]
    last = min((s for s in timed), key=lambda s: s.exposure.shutter_s).t_utc
    assert sun.t_utc is not None and last is not None
    assert sun.t_utc.timestamp() == pytest.approx(
        np.mean(shown) if through_filter else last.timestamp()
    )


@pytest.mark.slow
@pytest.mark.analytic
def test_the_suns_centre_is_measured_at_a_heading_of_north(tmp_path: Path) -> None:
    """A camera that turns takes the sun at 0 deg, while the panorama's centre is at 180 deg."""
    profile = smaller(load_camera_profile("sim-dual-fisheye"))
    shots = photograph(tmp_path, profile, headings=(0.0,), sun=SunSource(25.0, 190.0, 60_000.0))
    sun = merge_shots(shots, profile, MergeOptions(height=HEIGHT), sun_deg=(25.7, 189.2)).sun
    assert sun is not None
    away = direction(25.0, 190.0) @ direction(sun.altitude_deg, sun.azimuth_deg)
    assert np.degrees(np.arccos(min(away, 1.0))) < 0.5


@pytest.mark.property
@pytest.mark.parametrize("wide_px", [1.3, 3.0, 8.0])
def test_a_small_disc_scatters_as_stated(
    wide_px: float,
) -> None:  # over the places between the pixels
    rng, size, fine, errors = np.random.default_rng(2), 2 * int(wide_px / 2 + 4), 8, []
    at = (np.arange(size * fine) + 0.5) / fine
    for x, y in size / 2 + rng.uniform(-1, 1, (150, 2)):
        disc = np.hypot(at - x, at[:, None] - y) <= wide_px / 2
        pixels = disc.reshape(size, fine, size, fine).sum(axis=(1, 3)) / disc.sum()
        red, blue = 4 * pixels[::2, ::2].sum(), 4 * pixels[1::2, 1::2].sum()
        green = 2 * (pixels[::2, 1::2].sum() + pixels[1::2, ::2].sum())
        errors.append(0.405 * red + 0.543 * green + 0.052 * blue - 1)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(mosaic_u_rel(wide_px), rel=0.4)


@pytest.mark.slow
@pytest.mark.analytic
def test_without_a_filter_the_sun_is_a_lower_bound(bracket) -> None:
    shots, profile = bracket("sim-dual-fisheye", sun=SunSource(25.0, 190.0, 60_000.0))
    panorama = merge([s for s in shots if not s.exposure.nd], profile).panorama
    without, _ = take_out_disc(panorama, 25.0, 190.0)
    assert without.sun is not None and without.flags is not None
    assert without.sun.origin == "clipped" and without.sun.normal_illuminance_lx < 60_000
    assert (without.flags & Flag.CLIPPED_HIGH).any()
    short = [s for s in shots if not s.exposure.nd]
    assert "clipped in every frame" in merge(short, profile).verdict
    told = merge_shots(short, profile, MergeOptions(height=HEIGHT), sun_deg=(25.0, 190.0)).verdict
    assert "the sun's disc, whose illuminance is a lower bound" in told, told
    assert "add shorter" not in told


@pytest.mark.slow
@pytest.mark.analytic
def test_bad_pixels_of_the_profile_are_not_used(bracket) -> None:
    shots, profile = bracket("sim-dual-fisheye", uniform=200.0)
    plain = merge(shots, profile).panorama.luminance_cdm2
    spoilt = merge(shots, replace(profile, lens=profile.lens[:1])).panorama
    assert (np.asarray(spoilt.flags) & Flag.OUTSIDE_LENS).any()
    bad = tuple((x, y) for x in range(100, 104) for y in range(100, 104))
    mended = merge(
        shots, replace(profile, sensor=replace(profile.sensor, bad_px=bad))
    ).panorama.luminance_cdm2
    assert mended == pytest.approx(plain, rel=0.02) and not np.array_equal(mended, plain)


@pytest.mark.slow
@pytest.mark.analytic
def test_a_hidden_sun_is_left_alone(bracket) -> None:
    shots, profile = bracket("sim-dual-fisheye", headings=(None,))
    panorama = merge(shots, profile).panorama
    assert take_out_disc(panorama, 25.0, 0.0)[0].sun is None


@pytest.mark.analytic
def test_a_sun_behind_the_only_lens_takes_nothing_out_and_says_nothing() -> None:
    light = np.zeros((60, 120), np.float32)
    light[:, 30:90] = 500.0
    panorama = Panorama(light, 0.0)
    assert take_out_disc(panorama, 25.0, 180.0)[0] is panorama


# ----------------------------------------------------------------------------------------------
# blending, bad frames


@pytest.mark.analytic
def test_a_spoilt_lens_gives_way() -> None:
    unused: Any = None  # the sensor

    def view(value: float, flags: int) -> LensView:
        one = np.ones(3)
        return LensView(
            value * one,
            one,
            one,
            0 * one,
            0 * one,
            np.full(3, flags, np.uint8),
            np.full((3, 3), value),
            np.zeros(3),
            one,
            Lens((1.0, 1.0), 1.0, 180.0),
            unused,
        )

    both = blend([view(10.0, 0), view(20.0, 0)])
    assert both.luminance == pytest.approx(15.0)
    spoilt = blend([view(10.0, Flag.CLIPPED_HIGH), view(20.0, 0)])
    assert spoilt.luminance == pytest.approx(20.0, rel=1e-4) and not spoilt.flags.any()


@pytest.mark.contract
def test_vignetting_of_another_aperture_is_refused() -> None:
    lens = Lens((1.0, 1.0), 1.0, 180.0, vignetting=(Vignetting(5.6, (1.0, 0.0, -0.3)),))
    assert vignetting_of(lens, 5.6)[0] == (1.0, 0.0, -0.3)
    with pytest.raises(InputError, match="no vignetting curve for f/16"):
        vignetting_of(lens, 16.0)
    with pytest.raises(InputError, match="sign"):
        vignetting_of(replace(lens, vignetting=(Vignetting(5.6, (1.0, 0.04)),)), 5.6)


@pytest.mark.contract
def test_frames_of_another_camera_are_refused(tmp_path: Path) -> None:
    profile = load_camera_profile("sim-dual-fisheye")
    path = tmp_path / "other.dng"
    write_dng(
        path,
        np.zeros((64, 128), np.uint16),
        Exposure(0.1, 5.6),
        black_dn=(0, 0, 0, 0),
        white_dn=4095,
    )
    with pytest.raises(InputError, match="128 x 64 pixels; expected 968 x 484"):
        load_raw(Shot(path, Exposure(0.1, 5.6)), profile, lens_crop(profile))
    own = replace(
        profile, camera=replace(profile.camera, width_px=128, height_px=64, model="Alpha 2")
    )
    own = replace(own, lens=(replace(own.lens[0], centre_px=(64.0, 32.0), radius_px=30.0),))
    for model, said in (
        ("ALPHA  2", ""),
        ("Maker Alpha 2", ""),
        ("", ""),
        ("Alpha 3", "taken by Alpha 3; expected Alpha 2"),
    ):
        counts = np.zeros((64, 128), np.uint16)
        write_dng(
            path, counts, Exposure(0.1, 5.6), black_dn=(0, 0, 0, 0), white_dn=4095, model=model
        )
        with pytest.raises(InputError, match=said) if said else nullcontext():
            load_raw(Shot(path, Exposure(0.1, 5.6)), own, lens_crop(own))
    with pytest.raises(InputError, match="filter 'nd9'"):
        sorted_shots([Shot(path, Exposure(0.1, 5.6, 100, "nd9"))], profile)
    with pytest.raises(InputError, match="a JPEG frame"):
        sorted_shots([Shot(tmp_path / "a.jpg", Exposure(0.1, 5.6))], profile)
    canon = load_camera_profile("canon-5d2-8mm-f5.6")
    with pytest.raises(InputError, match="k is not calibrated for other apertures"):
        sorted_shots([Shot(tmp_path / "a.jpg", Exposure(0.1, 8.0))], canon)


@pytest.mark.contract
def test_every_phase_of_a_merge_shows_its_progress(
    bracket: Callable[..., tuple[list[Shot], CameraProfile]],
) -> None:
    """Only the reading of frames did; merging and projecting take twice as long."""
    shown: list[tuple[float, str]] = []
    resampler.cache_clear()
    with shown_by(lambda done, total, text: shown.append((done / total, text))):
        merge(*bracket("sim-dual-fisheye"))
    shares, texts = zip(*shown, strict=True)
    assert {"frames", "merging rows", "projecting rows"} <= {*texts}
    assert list(shares) == sorted(shares)
