"""What a bracket is not told of its camera: each colour's own plateau, ISO, light that changes,
noise, black.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from msgspec import structs

from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure, Flag
from fieldlum.merge import MergeOptions, Shot, merge_sensor, merge_shots, shots_of_files
from fieldlum.merge.bracket import orientation_conflict, verdict
from fieldlum.merge.project import footprint_px, u_of_edges
from fieldlum.merge.ratios import any_beyond_prior, fit_ratios, unexplained_by_fit
from fieldlum.merge.sensor_frames import Findings, SensorImage
from fieldlum.merge.shots import U_ISO, exposure_covariance, sorted_shots
from fieldlum.optics.exposure import PairRatio, true_times_s, z_per_cdm2
from fieldlum.optics.profiles import Bracket, CameraBody, CameraProfile, Lens, Sensor
from fieldlum.optics.projection import Equirect, Fisheye, LensGeometry
from fieldlum.optics.raw.writing import write_dng, write_jpeg

SIZE = 160
SMALL = MergeOptions(height=24)
TIMES = (1.0, 1 / 4, 1 / 15, 1 / 60, 1 / 250)
BLACK, WHITE = 512.0, 16383.0
PROFILE = CameraProfile(
    CameraBody("doubt", "raw", SIZE, SIZE, "lab", "doubt"),
    (Lens((SIZE / 2, SIZE / 2), SIZE / 2 - 2, 180.0),),
    Bracket(5.6, 100.0, TIMES),
    Sensor("GBRG", (BLACK,) * 4, (15800.0,) * 4, WHITE, 4.0, 6.0, 100.0),
)
EXPOSURES = tuple(Exposure(t, 5.6) for t in TIMES)

FISHEYE = Fisheye.of_size(48, replace(PROFILE.lens[0], full_angle_deg=180.0))
WEAK = np.eye(8) * 0.3**2  # prior of the exposures


def scene() -> np.ndarray:
    """Three decades from left to right, an even ramp on the mosaic. [cd/m2]"""
    return np.broadcast_to(np.geomspace(5.0, 5000.0, SIZE), (SIZE, SIZE)).copy()


def take(
    folder: Path,
    exposures: Sequence[Exposure] = EXPOSURES,
    *,
    light: Sequence[float] | None = None,
    gain: float = 4.0,
    read_e: float = 6.0,
    black: float = BLACK,
    full: np.ndarray | float = 15800.0,
    room: np.ndarray | None = None,
) -> list[Shot]:
    """A bracket of `room` (`scene`) by a camera that need not be what PROFILE says; light: a factor
    for each frame.
    """
    rng = np.random.default_rng(4)
    shots = []
    for i, e in enumerate(exposures):
        per = z_per_cdm2(true_times_s(e.shutter_s), e.f_number, e.iso) * (WHITE - BLACK)
        room = scene() if room is None else room
        signal = room * per * (1.0 if light is None else light[i])
        electrons = rng.poisson(signal * gain) + rng.normal(0, read_e, signal.shape)
        counts = np.minimum(np.rint(electrons / gain + black), full).astype(np.uint16)
        path = folder / f"{i}.dng"
        write_dng(path, counts, e, black_dn=(black,) * 4, white_dn=WHITE, cfa="GBRG", model="doubt")
        shots.append(Shot(path, e))
    return shots


def merged(shots: Sequence[Shot], profile: CameraProfile = PROFILE) -> tuple[SensorImage, Findings]:
    return merge_sensor(sorted_shots(shots, profile), profile)


def off(sensor: SensorImage) -> np.ndarray:
    """Relative error of the unflagged pixels' columns. [columns]"""
    value = np.where(sensor.merged.flags == 0, sensor.merged.value_cdm2, np.nan).reshape(
        -1, sensor.crop.width
    )
    return (
        np.nanmean(value, axis=0)
        / scene()[0, sensor.crop.left : sensor.crop.left + sensor.crop.width]
        - 1
    )


@pytest.mark.analytic
def test_each_colour_is_full_where_it_is(tmp_path: Path) -> None:
    """The file's tag and the profile say 16383, red stops at 14000: it read -0.5 % and 14 %
    "motion" before.
    """
    full = np.full((SIZE, SIZE), 15800.0)
    full[1::2, ::2] = 14000.0  # red of GBRG
    trusting = replace(PROFILE, sensor=replace(PROFILE.sensor, saturation_dn=(WHITE,) * 4))
    image, found = merged(take(tmp_path, full=full), trusting)
    assert found.saturation.plateau_dn[100.0] == pytest.approx((14000, 15800, 15800, 15800), abs=2)
    assert np.nanmax(np.abs(off(image))) < 0.01
    assert (image.merged.flags & Flag.MOTION > 0).mean() < 1e-3


@pytest.mark.analytic
def test_an_iso_that_is_not_what_it_says(tmp_path: Path) -> None:
    """ISO 400 collects 6 % less: found by the frames, for its u allows it."""
    exposures = (*EXPOSURES[:3], Exposure(1 / 60, 5.6, 400.0), *EXPOSURES[3:])
    c = exposure_covariance(exposures, PROFILE)
    assert c[3, 3] - c[4, 4] == pytest.approx(U_ISO**2) and c[3, 4] == pytest.approx(0.003**2)
    light = [1.0, 1.0, 1.0, 0.94, 1.0, 1.0]
    image, found = merged(take(tmp_path, exposures, light=light))
    assert np.nanmax(np.abs(off(image))) < 0.01
    assert max(abs(n.residual_percent) for n in found.exposures.neighbours) < 0.5
    assert not any_beyond_prior(found.exposures.log_deviation, found.exposures.u_prior)


@pytest.mark.analytic
@pytest.mark.parametrize("change", [1.0, 0.94])
def test_a_dusk_of_noise_agrees_and_a_change_of_it_is_found(tmp_path: Path, change: float) -> None:
    """The few pixels over the least signal are over it by noise: frames differed by 4 % of it."""
    light = [0.00065, 0.00065 * change]
    uniform = scene() * 0.0 + 600.0
    shots = take(tmp_path, EXPOSURES[:2], light=light, room=uniform)
    (pair,) = merged(shots)[1].exposures.fit.pairs
    assert pair.pixels < 5000
    assert pair.log_ratio == pytest.approx(np.log(change), abs=3.0 * pair.u_log)


@pytest.mark.slow
@pytest.mark.analytic
def test_light_that_changes_is_told_and_counted(tmp_path: Path) -> None:
    """Ten percent over the bracket: the ratio fit takes it up, so neighbours agree; "good"
    before.
    """
    light = np.linspace(1.0, 1.1, len(TIMES)).tolist()
    files = [shot.path for shot in take(tmp_path, light=light)]
    result = merge_shots(shots_of_files(files), PROFILE, SMALL)
    assert result.quality["residual_percent"] < 0.5
    assert result.quality["exposure_span_percent"] == pytest.approx(100 * np.log(1.1), abs=0.7)
    assert (
        result.verdict.startswith("fitted exposures differ from the profile by -")
        and "the light changed during the bracket" in result.verdict
    )
    steady = merge_shots(shots_of_files([s.path for s in take(tmp_path)]), PROFILE, SMALL)
    assert steady.verdict.startswith("good") and steady.quality["exposure_span_percent"] < 0.5
    assert result.quality["u_ratio_percent"] > 3 * steady.quality["u_ratio_percent"]


@pytest.mark.analytic
def test_priors_that_are_contradicted_widen() -> None:
    """Birge's ratio: corrections of -5 and +5 % where 0.3 % was expected leave the level unsure
    by percents.
    """
    pairs = [PairRatio(long=0, short=1, log_ratio=0.1, u_log=5e-4, pixels=999)]
    prior = np.eye(2) * 0.003**2
    wild, calm = fit_ratios(pairs, prior), fit_ratios([replace(pairs[0], log_ratio=0.003)], prior)
    assert np.log(wild.correction) == pytest.approx([-0.05, 0.05], abs=0.002)
    assert calm.u_log == pytest.approx(0.003 / np.sqrt(2), rel=0.05)
    assert wild.u_log == pytest.approx(
        0.05, rel=0.05
    )  # chi2 2 (0.05 / 0.003)^2 of one freedom, halved by the pair


@pytest.mark.analytic
def test_the_noise_of_pairs_is_no_disagreement() -> None:
    """Pairs that scatter by just their u say nothing of exposures: in the mean over draws
    nothing is left.
    """
    rng, left = np.random.default_rng(4), []
    for _ in range(200):
        pairs = [
            PairRatio(
                long=i, short=i + 1, log_ratio=float(0.01 * rng.normal()), u_log=0.01, pixels=999
            )
            for i in range(7)
        ]
        left.append(unexplained_by_fit(fit_ratios(pairs, WEAK), 0.0) ** 2)
    alone = np.mean([np.var(np.cumsum(0.01 * rng.normal(size=8))) for _ in range(200)])
    assert (
        np.mean(left) < 0.5 * alone
    )  # what is left is the half of the draws that scatter more than usual


@pytest.mark.analytic
def test_small_steps_add_up() -> None:
    """Seven neighbours that agree within 2 % each, all to one side, lie 14 % apart."""
    pairs = [
        PairRatio(long=i, short=i + 1, log_ratio=0.02, u_log=0.001, pixels=999) for i in range(7)
    ]
    free = fit_ratios(pairs, WEAK)
    found = np.log(free.correction)
    assert found == pytest.approx(0.02 * (np.arange(8) - 3.5), abs=0.003)
    assert unexplained_by_fit(free, 0.01) == pytest.approx(
        np.sqrt(found.std() ** 2 - 0.01**2), rel=0.01
    )
    assert unexplained_by_fit(fit_ratios([], WEAK), 0.01) == 0.0
    assert any_beyond_prior(found, np.full(8, 0.01))
    assert not any_beyond_prior(found, np.full(8, 0.03))


@pytest.mark.analytic
def test_noise_beyond_the_profile_is_no_motion(tmp_path: Path) -> None:
    """Gain 1 e-/DN and 12 e- where the profile says 4 and 6: 93 % of the view was "motion"
    before.
    """
    image, found = merged(take(tmp_path, gain=1.0, read_e=12.0))
    assert found.noise[0] == pytest.approx(4.0, rel=0.15)
    assert found.noise[1] == pytest.approx(12**2 / (1.5**2 + 1 / 12), rel=0.3)
    assert (image.merged.flags & Flag.MOTION > 0).mean() < 2e-3
    value, u = image.merged.value_cdm2.reshape(-1, image.crop.width), np.sqrt(image.merged.variance)
    left = image.crop.left
    error = value - scene()[: len(value), left : left + image.crop.width]
    assert 0.92 < (np.abs(error) < 1.96 * u.reshape(value.shape)).mean() < 0.98
    (own := tmp_path / "own").mkdir()
    _, calm = merged(take(own))
    assert calm.noise == (1.0, 1.0)


@pytest.mark.analytic
def test_a_black_level_unlike_the_profiles_is_told(tmp_path: Path) -> None:
    result = merge_shots(
        shots_of_files([s.path for s in take(tmp_path, black=BLACK + 3)]), PROFILE, SMALL
    )
    assert result.quality["black_off_dn"] == pytest.approx(3.0)
    assert "black level differs from the profile's by +3.0 DN" in result.verdict
    assert verdict(structs.replace(result.report, black_off_dn=0.5)).startswith("good")


@pytest.mark.contract
def test_what_makes_no_bracket_is_refused(tmp_path: Path) -> None:
    shots = take(tmp_path)
    with pytest.raises(
        InputError, match=r"0.dng: the same content as 0.dng: this frame would count twice"
    ):
        shots_of_files([shots[0].path, shots[1].path, tmp_path / "." / "0.dng"])
    copy = tmp_path / "0 (1).dng"
    copy.write_bytes(shots[0].path.read_bytes())
    with pytest.raises(InputError, match=r"0 \(1\).dng: the same content as 0.dng"):
        shots_of_files([shots[0].path, shots[1].path, copy])
    copy.unlink()
    with pytest.raises(
        InputError, match=r"2.dng: a frame with f/8 in a bracket with f/5.6; expected one aperture"
    ):
        sorted_shots([*shots[:2], replace(shots[2], exposure=Exposure(1 / 15, 8.0))], PROFILE)


@pytest.mark.analytic
def test_a_camera_on_its_side_is_told(tmp_path: Path) -> None:
    from PIL import Image

    profile = replace(PROFILE, camera=replace(PROFILE.camera, kind="jpeg", model=""))
    shots = []
    for i, tag in enumerate((6, 6, 1)):
        path = tmp_path / f"{i}.jpg"
        write_jpeg(path, np.full((SIZE, SIZE, 3), 120, np.uint8), EXPOSURES[i])
        image = Image.open(path)
        exif = image.getexif()
        exif[0x0112] = tag
        image.save(path, exif=exif)
        shots.append(Shot(path, EXPOSURES[i]))
    assert (
        orientation_conflict(shots[:2], profile)
        == "by EXIF, the camera was held 90 deg off the profile's roll of 0 deg: hold it as in "
        "the calibration, or correct roll_deg of the profile"
    )
    lens = replace(profile.lens[0], roll_deg=88.0)
    assert (
        orientation_conflict(shots[:2], replace(profile, lens=(lens,)))
        == orientation_conflict(shots[2:], profile)
        == ""
    )
    up = replace(profile.lens[0], tilt_deg=90.0)
    for lenses in (
        (up,),
        (*profile.lens, replace(profile.lens[0], azimuth_deg=180.0)),
    ):  # a guess; as its maker liked
        assert orientation_conflict(shots, replace(profile, lens=lenses)) == ""
    assert orientation_conflict(shots, profile).endswith(
        "roll angles 0 and 90 deg; capture it again"
    )
    assert (
        "held 90 deg off"
        in merge_shots(shots_of_files([s.path for s in shots[:2]]), profile, SMALL).verdict
    )


@pytest.mark.analytic
@pytest.mark.parametrize("target", [Equirect(24), FISHEYE])
def test_edges_leak_and_slopes_do_not(target: Equirect | Fisheye) -> None:
    height, width = target.shape
    seen = np.ones((height, width), bool)
    slope = np.broadcast_to(np.linspace(1.0, 500.0, width), (height, width))
    assert u_of_edges(slope, seen, target, PROFILE)[8:16, 4 : width - 4].max() == pytest.approx(
        0.0, abs=1e-9
    )
    window = np.full((height, width), 100.0)
    window[:, width // 2 :] = 8000.0
    share = min(0.35 / footprint_px(PROFILE.lens[0], target), 0.5) / np.sqrt(3)
    u = u_of_edges(window, seen, target, PROFILE)[12, width // 2 - 3 : width // 2 + 3]
    assert u == pytest.approx([0.0, 0.0, 7900 * share, 7900 * share, 0.0, 0.0], rel=0.01)
    seen[:, width // 2 :] = False  # beyond the lens there is no light known to leak
    assert (
        u_of_edges(np.where(seen, window, 0.0), seen, target, PROFILE)[12, 4 : width - 4].max()
        == 0.0
    )


@pytest.mark.analytic
def test_beside_a_window_u_covers_the_truth(tmp_path: Path) -> None:
    """A wall of 100 right beside a window of 5000 cd/m2 catches a part of it; its u was below 1
    % before.
    """
    light = np.full((SIZE, SIZE), 100.0)
    light[:, SIZE // 2 :] = 5000.0
    rng, shots = np.random.default_rng(5), []
    for i, e in enumerate(EXPOSURES):
        per = z_per_cdm2(true_times_s(e.shutter_s), e.f_number, e.iso) * (WHITE - BLACK)
        electrons = rng.poisson(light * per * 4.0) + rng.normal(0, 6.0, light.shape)
        counts = np.minimum(np.rint(electrons / 4.0 + BLACK), 15800).astype(np.uint16)
        write_dng(
            tmp_path / f"{i}.dng",
            counts,
            e,
            black_dn=(BLACK,) * 4,
            white_dn=WHITE,
            cfa="GBRG",
            model="doubt",
        )
        shots.append(tmp_path / f"{i}.dng")
    panorama = merge_shots(shots_of_files(shots), PROFILE, MergeOptions(height=32)).panorama
    wall = np.s_[8:24, 24:32]  # right up to the border
    assert panorama.u_cdm2 is not None
    off = np.abs(panorama.luminance_cdm2 - 100.0)[wall]
    assert off.max() > 20.0 and (off <= 2 * panorama.u_cdm2[wall]).all()
    assert (panorama.u_cdm2[wall][:, :6] < 6.0).all()


@pytest.mark.analytic
def test_a_target_pixel_on_the_sensor() -> None:  # 100 px for 90 degrees, pixels of 9 degrees
    assert footprint_px(LensGeometry((0.0, 0.0), 100.0, 180.0), Equirect(20)) == pytest.approx(10.0)
    assert footprint_px(LensGeometry((0.0, 0.0), 100.0, 180.0), Equirect(2000)) == 1.0
