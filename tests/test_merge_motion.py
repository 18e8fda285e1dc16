"""Frames left out where something moved: errors before and after, halos, no consensus, and a
still room.
"""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldlum.cli import main
from fieldlum.core.records import Exposure, Flag
from fieldlum.merge.bracket import merge_sensor
from fieldlum.merge.estimator import Merged, merge_signals
from fieldlum.merge.frames import JpegSignal, RawSignal
from fieldlum.merge.motion import Ballot, leave_out_moved, vote
from fieldlum.merge.shots import Shot, sorted_shots
from fieldlum.optics.images import read_panorama
from fieldlum.optics.photometry import srgb_table, z_per_cdm2
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Lens,
    Response,
    Sensor,
    save_profile,
)
from fieldlum.optics.raw import write_dng, write_jpeg

GAIN, READ_E, FULL = 4.0, 6.0, 14000.0
STEPS = (400.0, 100.0, 25.0, 6.25, 1.5625, 0.390625)
SHAPE = (120, 2, 240)


def expose(light: np.ndarray, per_cdm2: float, seed: list[int]) -> RawSignal:
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(np.minimum(light * per_cdm2 * GAIN, 1e9)) + rng.normal(
        0, READ_E, light.shape
    )
    counts = np.clip(np.round(electrons / GAIN + 512), 0, FULL).astype(np.uint16)
    constants = (np.asarray(v, np.float32) for v in (512.0, FULL - 512.0, per_cdm2))
    return RawSignal(counts, *constants, GAIN, (READ_E / GAIN) ** 2 + 1 / 12)


@pytest.mark.analytic
def test_the_variance_of_a_pixel_that_moved_is_its_chi2_about_the_mean() -> None:
    """Two frames with the variance 100 DN^2 show 100 and 120 cd/m2; the prediction is no mean."""
    exposures, counts = (100.0, 50.0), (10_000, 6_000)
    black, full = np.zeros((), np.float32), np.asarray(60_000.0, np.float32)
    frames = [
        RawSignal(
            np.full((1, 2, 2), y, np.uint16), black, full, np.asarray(e, np.float32), 1e12, 100.0
        )
        for e, y in zip(exposures, counts, strict=True)
    ]
    merged = merge_signals(frames, (1, 2, 2), passes=1)
    assert merged.value_cdm2 == pytest.approx(104.0, rel=1e-5)  # weights 100 and 25
    chi2 = 100 * (100 - 104) ** 2 + 25 * (120 - 104) ** 2
    assert merged.variance == pytest.approx(chi2 / 125, rel=1e-4)


def room() -> np.ndarray:
    """3 to 5000 cd/m2 from left to right, [240, 240]."""
    return np.broadcast_to(np.geomspace(3.0, 5000.0, 240), (240, 240))


def walker(light: np.ndarray, column: float, luminance: float) -> tuple[np.ndarray, np.ndarray]:
    """The room with somebody in it, edges soft over some pixels; and where he is seen by more
    than 1 %.
    """
    y, x = np.mgrid[:240, :240]
    away = np.hypot((x - column) / 20, (y - 120) / 50)
    cover = 1 / (1 + np.exp((away - 1) * 25))
    seen = light * (1 - cover) + luminance * cover
    return seen, np.abs(seen / light - 1) > 0.01


def both(lights: list[np.ndarray], seed: int = 0) -> tuple[Merged, Merged]:
    """Merged with all frames, and with the moved ones left out."""
    frames = [
        expose(light.reshape(SHAPE), e, [seed, i])
        for i, (light, e) in enumerate(zip(lights, STEPS, strict=True))
    ]
    kept = merge_signals(frames, SHAPE)
    copy = Merged(kept.value_cdm2.copy(), kept.variance.copy(), kept.flags.copy())
    return kept, leave_out_moved(frames, copy, 0.003)[0]


@pytest.mark.analytic
@pytest.mark.parametrize(
    ("column", "frame", "luminance"), [(70, 0, 2.0), (120, 2, 800.0), (150, 2, 5.0)]
)
def test_somebody_walks_through_one_frame(column: float, frame: int, luminance: float) -> None:
    light = room()
    seen, place = walker(light, column, luminance)
    kept, dropped = both([seen if i == frame else light for i in range(len(STEPS))])
    still, _ = both([light] * len(STEPS))
    place = place.reshape(SHAPE)
    before, after, least = (
        np.abs(m.value_cdm2 / light.reshape(SHAPE) - 1) for m in (kept, dropped, still)
    )
    assert np.sqrt(np.mean(before[place] ** 2)) > 0.08
    assert np.sqrt(np.mean(after[place] ** 2)) < 4 * np.sqrt(
        np.mean(least[place] ** 2)
    )  # fewer frames, more noise
    assert after[place].max() < 0.25 * before[place].max()  # no halo
    pull = (after * light.reshape(SHAPE) / np.sqrt(dropped.variance))[place]
    assert np.mean(pull < 3) > 0.97  # and u says so
    changed = dropped.value_cdm2 != kept.value_cdm2
    assert np.all(dropped.flags[changed] & Flag.MOTION)
    assert np.all(dropped.flags[(kept.flags & Flag.MOTION) > 0] & Flag.MOTION)
    far = ~place & (np.abs(np.mgrid[:240, :240][1] - column).reshape(SHAPE) > 45)
    assert np.array_equal(dropped.value_cdm2[far], kept.value_cdm2[far])
    assert np.array_equal(dropped.variance[far], kept.variance[far])


@pytest.mark.analytic
def test_without_a_majority_nothing_is_left_out() -> (
    None
):  # two frames see the dark, and contradict
    dark = np.full(
        (240, 240), 0.05
    )  # 20, 5, 1.2 counts ...: from the third frame on all is read noise
    seen, _ = walker(dark, 120, 0.25)
    kept, dropped = both([seen, dark, dark, dark, dark, dark])
    assert np.array_equal(kept.value_cdm2, dropped.value_cdm2)
    assert (dropped.flags.reshape(240, 240)[seen > 0.24] & Flag.MOTION).astype(bool).mean() > 0.9


@pytest.mark.slow
@pytest.mark.property
@settings(deadline=None, max_examples=5)
@given(st.integers(0, 2**31), st.floats(0.1, 30.0))
def test_a_still_room_keeps_every_value(
    seed: int, factor: float
) -> None:  # changes by less than noise
    kept, dropped = both([room() * factor] * len(STEPS), seed)
    change = np.abs(dropped.value_cdm2 - kept.value_cdm2) / np.sqrt(kept.variance)
    assert np.mean(change > 0) < 1e-3 and change.max() < 5


@pytest.mark.analytic
def test_an_unresolved_disagreement_widens_u() -> None:  # two frames 10 % apart, nobody to ask
    lights = [np.full(SHAPE, 100.0), np.full(SHAPE, 110.0)]
    frames = [expose(light, 25.0, [0, i]) for i, light in enumerate(lights)]
    m = merge_signals(frames, SHAPE)
    moved = (m.flags & Flag.MOTION) > 0
    assert moved.mean() > 0.95
    assert np.median(np.sqrt(m.variance[moved])) == pytest.approx(
        5.0, rel=0.1
    )  # half of what lies between them


@pytest.mark.analytic
def test_saturated_frames_vote_for_what_is_bright() -> None:
    one = np.ones((4, 1), np.float32)
    value = np.array(
        [[50.0], [0.0], [0.0], [4000.0]], np.float32
    )  # a dark coat; two full frames; one that sees all
    readable, saturated = value > 0, value == 0
    ballot = Ballot(
        value,
        (0.01 * value + 0.01) ** 2,
        readable,
        saturated,
        np.array([[30], [120], [500], [9e3]], "f4"),
    )
    found = vote(ballot, 0.003)
    assert found.value_cdm2[0] == pytest.approx(4000.0) and found.clear[0]
    alone = Ballot(value[[0, 3]], 0.1 * one[:2], readable[[0, 3]], saturated[[0, 3]], 9e3 * one[:2])
    assert not vote(alone, 0.003).clear[0]


@pytest.mark.analytic
def test_colours_of_a_jpeg_go_together() -> None:
    table = np.repeat(srgb_table().astype(np.float32)[:, None], 3, axis=1)
    rng, light = np.random.default_rng(0), np.full((80, 80, 3), 0.3)
    moved = light.copy()
    moved[20:50, 20:50, 0] = 0.9  # red alone
    frames = []
    for i, e in enumerate((2.0, 1.0, 0.5, 0.25)):
        z = np.clip((moved if i == 1 else light) * e, 0, 1)
        codes = np.interp(z, srgb_table(), np.arange(256)) + rng.normal(0, 0.6, z.shape)
        per = np.full(3, e, np.float32)
        frames.append(
            JpegSignal(
                np.rint(codes).clip(0, 255).astype(np.uint8), table, per, 27, 228, i == 0, i == 3
            )
        )
    m, share = leave_out_moved(frames, merge_signals(frames, light.shape, u_ratio=0.01), 0.01)
    assert m.value_cdm2[25:45, 25:45] == pytest.approx(0.3, rel=0.05)
    assert share[1] > 0.1 and share[0] == share[2] == share[3] == 0


def jpeg_motion(folder: Path, dimmed: float, u_rel: float) -> float:
    """Share flagged of an area that one of three frames shows dimmed, by a response known to
    u_rel.
    """
    table = tuple(float(z) for z in srgb_table())
    times = (0.5, 1 / 8, 1 / 32)
    profile = CameraProfile(
        CameraBody("small", "jpeg", 128, 128),
        (Lens((64.0, 64.0), 63.0, 180.0),),
        Bracket(4.0, 100.0, times),
        response=Response("table", table, table, table, u_rel=u_rel),
    )
    light = np.broadcast_to(np.geomspace(10.0, 200.0, 128), (3, 128, 128)).copy()
    light[1, 40:80, 50:75] *= dimmed
    shots = []
    for i, t in enumerate(times):
        codes = np.interp(light[i] * z_per_cdm2(t, 4.0, 100.0), table, np.arange(256.0))
        path = folder / f"{i}.jpg"
        write_jpeg(
            path,
            np.repeat(np.rint(codes).astype(np.uint8)[..., None], 3, 2),
            Exposure(t, 4.0),
            quality=98,
        )
        shots.append(Shot(path, Exposure(t, 4.0)))
    flags = merge_sensor(sorted_shots(shots, profile), profile)[0].merged.flags
    return float(((flags[44:76, 54:71] & Flag.MOTION) > 0).mean())


@pytest.mark.slow
@pytest.mark.analytic
def test_what_the_response_may_get_wrong_is_no_motion(tmp_path: Path) -> None:
    assert jpeg_motion(tmp_path, 0.75, 0.0) > 0.9
    assert jpeg_motion(tmp_path, 0.75, 0.1) == 0.0
    assert jpeg_motion(tmp_path, 0.2, 0.1) > 0.9


@pytest.mark.slow
@pytest.mark.contract
def test_the_option_on_files(tmp_path: Path) -> None:
    camera = CameraProfile(
        CameraBody("small", "raw", 128, 128),
        (Lens((64.0, 64.0), 63.0, 180.0),),
        Bracket(4.0, 100.0, (0.5, 1 / 8, 1 / 32)),
        Sensor("RGGB", (256.0,) * 4, (4000.0,) * 4, 4095.0, 2.0, 5.0, 100.0),
    )
    save_profile(tmp_path / "small.toml", camera)
    rng, files = np.random.default_rng(0), []
    for i, t in enumerate((0.5, 1 / 8, 1 / 32)):
        light = np.full((128, 128), 20.0)
        if i == 1:
            light[40:80, 50:75] = 5.0
        mean = light * z_per_cdm2(t, 4.0, 100.0) * (4095 - 256)
        counts = np.clip(
            np.round(256 + mean + np.sqrt(mean / 2 + 6) * rng.standard_normal(mean.shape)), 0, 4000
        )
        files.append(str(tmp_path / f"{i}.dng"))
        write_dng(
            Path(files[-1]),
            counts.astype(np.uint16),
            Exposure(t, 4.0),
            black_dn=(256,) * 4,
            white_dn=4095,
        )
    worst = []
    for option in ([], ["--drop-moved"]):
        out = tmp_path / f"out{len(option)}.exr"
        given = [
            "--camera",
            str(tmp_path / "small.toml"),
            "--out",
            str(out),
            "--size",
            "64x32",
            *option,
            "--json",
        ]
        result = CliRunner().invoke(main, ["merge", "--frames", *files, *given])
        assert result.exit_code == 0, result.output
        frames = json.loads(result.stdout)["quality"]["frames"]
        assert all((f["dropped_percent"] is not None) == bool(option) for f in frames)
        panorama = read_panorama(out)
        assert panorama.flags is not None and (panorama.flags & Flag.MOTION).any()
        seen = (panorama.flags & Flag.OUTSIDE_LENS) == 0
        worst.append(np.abs(panorama.luminance_cdm2[seen] / 20.0 - 1).max())
    assert worst[0] > 0.1 and worst[1] < 0.04
