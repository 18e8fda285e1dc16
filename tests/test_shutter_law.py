"""One shutter law for a bracket: from the profile, the labels, or the frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure
from fieldlum.merge import MergeOptions, merge_shots, shots_of_files
from fieldlum.optics.exposure import (
    LAWS,
    PairRatio,
    law_of_frames,
    law_of_labels,
    true_times_s,
    z_per_cdm2,
)
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Lens,
    Sensor,
    ShutterTime,
    load_camera_profile,
    save_profile,
)
from fieldlum.optics.raw.writing import write_dng

FULL_STOPS_S = (1 / 4, 1 / 8, 1 / 15, 1 / 30, 1 / 60, 1 / 125, 1 / 250)
HALF_STOPS_S = (1 / 20, 1 / 30, 1 / 45, 1 / 60, 1 / 90, 1 / 125, 1 / 180, 1 / 250)
SMALL = CameraProfile(
    CameraBody("small", "raw", 128, 64),
    (Lens((64.0, 32.0), 31.0, 180.0),),
    Bracket(4.0, 100.0, (0.125, 1 / 15, 1 / 60)),
    Sensor("RGGB", (256.0,) * 4, (4000.0,) * 4, 4095.0, 2.0, 5.0, 100.0),
)


@pytest.mark.analytic
def test_a_half_stop_bracket_keeps_to_half_stops() -> None:
    """1/20 alone is nearer to a third of a stop: 11.6 % off in one frame of a Nikon D7000."""
    assert law_of_labels(HALF_STOPS_S).law == "half-stops"
    assert true_times_s(HALF_STOPS_S, "half-stops")[0] == pytest.approx(2**-4.5)
    assert true_times_s(1 / 20) == pytest.approx(2 ** (-13 / 3))
    assert law_of_labels(FULL_STOPS_S).law == "third-stops"
    assert law_of_labels(FULL_STOPS_S, "RICOH THETA Z1").law == "exact"


@pytest.mark.property
@settings(deadline=None, max_examples=60)
@given(st.sampled_from(LAWS), st.floats(-0.08, 0.08), st.integers(0, 1000))
def test_the_frames_give_the_law_whatever_the_response(true: str, bend: float, seed: int) -> None:
    """A response that is wrong stretches all steps alike; frames err by 0.5 % each."""
    nominal = np.array(HALF_STOPS_S if true == "half-stops" else FULL_STOPS_S)
    labels = law_of_labels(nominal)
    by_law = {law: true_times_s(nominal, law) for law in LAWS}
    seen = np.log(by_law[true]) * (1 + bend) - np.log(by_law[labels.law])
    seen += 0.005 * np.random.default_rng(seed).standard_normal(len(nominal))
    pairs = [
        PairRatio(long=i, short=j, log_ratio=seen[j] - seen[i], u_log=1e-3, pixels=1000)
        for i in range(len(nominal))
        for j in range(i + 1, min(i + 4, len(nominal)))
    ]
    found = law_of_frames(by_law, labels, pairs)
    assert found.law == true and found.decided_by == "frames"


@pytest.mark.contract
def test_frames_that_scatter_do_not_decide() -> None:
    """The phone's bracket through a response that is not its own: steps disagree by tens of %."""
    labels = law_of_labels(FULL_STOPS_S)
    by_law = {law: true_times_s(FULL_STOPS_S, law) for law in LAWS}
    seen = (-0.63, -0.11, -0.48, -0.66, -0.65, -0.76)  # ln ratios between neighbours, measured
    pairs = [
        PairRatio(long=i, short=i + 1, log_ratio=ratio, u_log=0.003, pixels=1000)
        for i, ratio in enumerate(seen)
    ]
    found = law_of_frames(by_law, labels, pairs)
    assert (found.law, found.decided_by) == ("third-stops", "labels")


@pytest.mark.contract
def test_without_pairs_the_labels_decide() -> None:
    labels = law_of_labels(FULL_STOPS_S)
    by_law = {law: true_times_s(FULL_STOPS_S, law) for law in LAWS}
    assert law_of_frames(by_law, labels, []) == labels


def _bracket(folder: Path, law: str) -> list[Path]:
    """Three raw frames of a uniform 100 cd/m2 by a shutter that keeps to a law."""
    files, rng = [], np.random.default_rng(1)
    for nominal_s in SMALL.bracket.shutter_s:
        true_s = float(true_times_s(nominal_s, law))
        mean = 100.0 * z_per_cdm2(true_s, 4.0, 100.0) * (4095 - 256)
        noise = np.sqrt(mean / 2 + (5 / 2) ** 2) * rng.standard_normal((64, 128))
        counts = np.clip(np.round(256 + mean + noise), 0, 4000).astype(np.uint16)
        files.append(folder / f"{nominal_s:.5f}.dng")
        exposure = Exposure(nominal_s, 4.0)
        write_dng(files[-1], counts, exposure, black_dn=(256,) * 4, white_dn=4095)
    return files


@pytest.mark.analytic
@pytest.mark.parametrize("law", ["exact", "third-stops"])
def test_a_merge_finds_the_law_and_reports_it(tmp_path: Path, law: str) -> None:
    result = merge_shots(shots_of_files(_bracket(tmp_path, law)), SMALL, MergeOptions(height=16))
    assert result.quality["shutter_law"]["law"] == law
    assert result.quality["shutter_law"]["decided_by"] == "frames"
    corrections = [frame["correction"] for frame in result.quality["frames"]]
    assert corrections == pytest.approx([1.0] * 3, abs=0.003)
    seen = np.asarray(result.panorama.flags) == 0
    assert np.median(result.panorama.luminance_cdm2[seen]) == pytest.approx(100.0, rel=0.003)


@pytest.mark.contract
def test_measured_times_of_the_profile_replace_the_law(tmp_path: Path) -> None:
    """Single frames, so that nothing but the profile tells the true times."""
    files = _bracket(tmp_path, "exact")
    known = tuple(ShutterTime(t, t, 1e-3) for t in SMALL.bracket.shutter_s)
    save_profile(tmp_path / "p.toml", replace(SMALL, shutter=known))
    measured = load_camera_profile(tmp_path / "p.toml")
    assert measured.shutter == known

    def level(file: Path, profile: CameraProfile) -> float:
        panorama = merge_shots(shots_of_files([file]), profile, MergeOptions(height=16)).panorama
        return float(np.median(panorama.luminance_cdm2[np.asarray(panorama.flags) == 0]))

    assert [level(file, measured) for file in files] == pytest.approx([100.0] * 3, rel=0.003)
    assert level(files[-1], SMALL) == pytest.approx(100.0 * 64 / 60, rel=0.003)


@pytest.mark.contract
def test_the_profile_has_the_last_word(tmp_path: Path) -> None:
    stated = replace(SMALL, shutter_law="third-stops")
    save_profile(tmp_path / "p.toml", stated)
    assert load_camera_profile(tmp_path / "p.toml").shutter_law == "third-stops"
    quality = merge_shots(
        shots_of_files(_bracket(tmp_path, "exact")), stated, MergeOptions(height=16)
    ).quality
    assert quality["shutter_law"]["decided_by"] == "profile"
    text = (tmp_path / "p.toml").read_text().replace("third-stops", "thirds")
    (tmp_path / "p.toml").write_text(text)
    with pytest.raises(InputError, match="shutter_law"):
        load_camera_profile(tmp_path / "p.toml")
