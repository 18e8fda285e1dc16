"""Pixels that contradict themselves over a bracket are not used."""

from pathlib import Path

import numpy as np
import pytest

from fieldlum.core.records import Exposure, Flag
from fieldlum.merge import MergeOptions, merge_shots, shots_of_files
from fieldlum.merge.linear_frames import Crop
from fieldlum.merge.sensor_frames import good_pixels, isolated_pixels
from fieldlum.optics.profiles import Bracket, CameraBody, CameraProfile, Lens, Sensor
from fieldlum.optics.raw.writing import write_dng

pytestmark = pytest.mark.analytic

SIDE = 96
PROFILE = CameraProfile(
    CameraBody("small", "raw", SIDE, SIDE),
    (Lens((48.0, 48.0), 46.0, 180.0),),
    Bracket(4.0, 100.0, (0.1,)),
    Sensor("RGGB", (256.0,) * 4, (15000.0,) * 4, 16383.0, 2.0, 5.0, 100.0, bad_px=((3, 7),)),
)


def test_lonely_pixels_are_odd_and_moving_things_are_not() -> None:
    flags = np.zeros((SIDE, SIDE), np.uint8)
    flags[20, 31] = flags[60, 60] = flags[61, 60] = (
        Flag.MOTION | Flag.ND
    )  # of two colours: each alone in its own
    flags[40:44, 10:14] = Flag.MOTION
    flags[5, 5] = Flag.BLOOM
    assert {tuple(at) for at in isolated_pixels(flags)} == {(20, 31), (60, 60), (61, 60)}
    good = good_pixels(PROFILE, Crop(2, 2, SIDE - 2, SIDE - 2), flags[2:, 2:])
    assert good is not None and not good[18, 29] and not good[5, 1] and (~good).sum() == 4


def test_a_stuck_pixel_leaves_no_light_in_the_map(tmp_path: Path) -> None:
    rng, frames = np.random.default_rng(0), []
    for i, exposed in enumerate((4.0, 1.0, 0.25, 0.0625)):
        mean = np.full((SIDE, SIDE), 800.0 * exposed)
        counts = 256 + mean + np.sqrt(mean / 2 + 2.5**2) * rng.standard_normal(mean.shape)
        counts[40, 60] = 9000.0
        path = tmp_path / f"{i}.dng"
        whole = np.clip(np.round(counts), 0, 15000).astype(np.uint16)
        write_dng(path, whole, Exposure(0.1 * exposed, 4.0), black_dn=(256,) * 4, white_dn=16383)
        frames.append(path)
    panorama = merge_shots(shots_of_files(frames), PROFILE, MergeOptions(height=60)).panorama
    seen = np.asarray(panorama.flags) == 0
    middle = float(np.median(panorama.luminance_cdm2[seen]))
    assert panorama.luminance_cdm2[seen] == pytest.approx(middle, rel=0.05)
