"""Pixels whose frames disagree: their variance, and what the response may get wrong."""

from pathlib import Path

import numpy as np
import pytest

from fieldlum.core.records import Exposure, Flag
from fieldlum.merge import merge_sensor
from fieldlum.merge.estimator import FramePixels, merge_signals
from fieldlum.merge.linear_frames import RawSignal
from fieldlum.merge.shots import Shot, sorted_shots
from fieldlum.optics.camera_curves import response_table
from fieldlum.optics.exposure import z_per_cdm2
from fieldlum.optics.profiles import Bracket, CameraBody, CameraProfile, Lens, Response
from fieldlum.optics.raw.writing import write_jpeg


@pytest.mark.analytic
def test_the_variance_of_a_pixel_that_moved_is_its_chi2_about_the_mean() -> None:
    """Two frames with the variance 100 DN^2 show 100 and 120 cd/m2."""
    exposures, counts = (100.0, 50.0), (10_000, 6_000)
    black, full = np.zeros((), np.float32), np.asarray(60_000.0, np.float32)
    frames = [
        RawSignal(
            np.full((1, 2, 2), y, np.uint16), black, full, np.asarray(e, np.float32), 1e12, 100.0
        )
        for e, y in zip(exposures, counts, strict=True)
    ]
    merged = merge_signals(frames, (1, 2, 2))
    assert merged.value_cdm2 == pytest.approx(104.0, rel=1e-5)  # weights 100 and 25
    chi2 = 100 * (100 - 104) ** 2 + 25 * (120 - 104) ** 2
    assert merged.variance == pytest.approx(chi2 / 125, rel=1e-4)


@pytest.mark.analytic
def test_a_frame_fills_what_its_saturated_neighbour_lost_above_five_deviations() -> None:
    """Noise of 10 DN; 60 and 40 DN in the columns next to a saturated pixel; 4 DN per cd/m2."""
    black, full, per = (np.asarray(v, np.float32) for v in (0.0, 1000.0, 4.0))
    counts = np.tile(np.array([1000, 60, 40, 200, 200, 200], np.uint16), (1, 2, 1))
    signal = RawSignal(counts, black, full, per, 1e12, 100.0)
    rows = FramePixels(signal, *signal.strip(0, 1))
    assert rows.usable()[0, 0].tolist() == [False, False, False, True, True, True]
    merged = merge_signals([signal], counts.shape)
    value, variance, flags = (a[0, 0] for a in (merged.value_cdm2, merged.variance, merged.flags))
    limit_cdm2 = float(signal.max_cdm2)
    assert value == pytest.approx([limit_cdm2, 15.0, 0.0, 50.0, 50.0, 50.0])
    assert variance == pytest.approx([limit_cdm2**2, 6.25, 0.0, 6.25, 6.25, 6.25])
    assert flags.tolist() == [Flag.CLIPPED_HIGH, Flag.BLOOM, Flag.CLIPPED_HIGH, 0, 0, 0]


def jpeg_motion(folder: Path, dimmed: float, u_rel: float) -> float:
    """Share flagged of an area that one of three frames shows dimmed, by a response known to
    u_rel.
    """
    table = tuple(float(z) for z in response_table("srgb"))
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
