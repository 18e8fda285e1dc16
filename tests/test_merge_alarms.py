"""No alarm over good brackets: noise near one count."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fieldlum.core.records import Exposure
from fieldlum.merge import merge_sensor, shots_of_files
from fieldlum.merge.sensor_frames import NOISE_OF_PROFILE
from fieldlum.merge.shots import sorted_shots
from fieldlum.optics.exposure import true_times_s, z_per_cdm2
from fieldlum.optics.profiles import Bracket, CameraBody, CameraProfile, Lens, Sensor
from fieldlum.optics.raw.writing import write_dng

pytestmark = pytest.mark.analytic

SIZE, BLACK, WHITE = 160, 512.0, 16383.0
EXPOSURES = tuple(Exposure(t, 5.6) for t in (1.0, 1 / 4, 1 / 15, 1 / 60, 1 / 250))
SENSOR = Sensor("GBRG", (BLACK,) * 4, (15800.0,) * 4, WHITE, 4.0, 6.0, 100.0)
PROFILE = CameraProfile(
    CameraBody("calm", "raw", SIZE, SIZE, "lab", "calm"),
    (Lens((SIZE / 2, SIZE / 2), SIZE / 2 - 2, 180.0),),
    Bracket(5.6, 100.0, tuple(e.shutter_s for e in EXPOSURES)),
    SENSOR,
)


@pytest.mark.parametrize(
    ("gain", "read_e"),
    [
        (4.0, 0.5),
        (4.0, 1.0),
        (4.0, 2.0),
        (2.0, 2.0),
        (1.0, 1.0),
        (1.0, 0.8),
        (2.0, 2.5),
        (1.0, 4.0),
    ],
)
def test_noise_of_about_one_count_is_no_more_than_said(
    tmp_path: Path, gain: float, read_e: float
) -> None:
    """Medians of whole numbers jump: a true profile with 1 DN of read noise was told 1.7 times
    as noisy before.
    """
    rng, paths = np.random.default_rng(4), []
    light = np.broadcast_to(np.geomspace(5.0, 5000.0, SIZE), (SIZE, SIZE))
    for i, e in enumerate(EXPOSURES):
        per = z_per_cdm2(true_times_s(e.shutter_s), e.f_number, e.iso) * (WHITE - BLACK)
        electrons = rng.poisson(light * per * gain) + rng.normal(0, read_e, light.shape)
        counts = np.minimum(np.rint(electrons / gain + BLACK), 15800).astype(np.uint16)
        write_dng(
            tmp_path / f"{i}.dng",
            counts,
            e,
            black_dn=(BLACK,) * 4,
            white_dn=WHITE,
            cfa="GBRG",
            model="calm",
        )
        paths.append(tmp_path / f"{i}.dng")
    profile = replace(PROFILE, sensor=replace(SENSOR, gain_e_per_dn=gain, read_noise_e=read_e))
    assert (
        merge_sensor(sorted_shots(shots_of_files(paths), profile), profile)[1].noise
        == NOISE_OF_PROFILE
    )
