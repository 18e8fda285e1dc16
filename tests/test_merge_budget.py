"""The uncertainty budget: exposures that hang together, one curve a lens, and whole simulated
cameras.
"""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from fieldlum.core.records import Exposure
from fieldlum.merge.estimator import FramePixels
from fieldlum.merge.linear_frames import RawSignal
from fieldlum.merge.project import LensView, blend
from fieldlum.merge.ratios import fit_ratios, ratio_curve, unexplained_by_neighbours
from fieldlum.merge.shots import U_REPEAT, exposure_covariance
from fieldlum.optics.exposure import PairRatio
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Lens,
    NeutralDensity,
    ShutterTime,
)
from fieldlum.session.files.sidecar import NeighbourQuality


@pytest.fixture(scope="module")
def bench() -> ModuleType:
    path = Path(__file__).parent.parent / "bench" / "merge_budget.py"
    spec = spec_from_file_location("merge_budget", path)
    assert spec is not None and spec.loader is not None
    sys.modules["merge_budget"] = module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.authority
@pytest.mark.parametrize(("kind", "parts"), [("raw", ("random",)), ("jpeg", ("random",))])
def test_noise_is_covered(bench: ModuleType, kind: str, parts: tuple[str, ...]) -> None:
    # authority: simulated cameras; the tables with every part are bench/merge_budget.py's
    everything, _ = bench.run(bench.Set(kind, parts), 6, 5)
    assert 93 < bench.coverage(everything.pull) < 97.5


@pytest.mark.slow
@pytest.mark.property
def test_the_whole_budget_is_covered(bench: ModuleType) -> None:
    parts = tuple(p for p in bench.PARTS if p != "response")
    everything, _ = bench.run(bench.Set("raw", parts), 12, 5)
    assert (
        90 < bench.coverage(everything.pull) <= 100
    )  # 12 cameras: 3 % either way; and not by being too wide:
    assert np.sqrt(np.mean(everything.pull**2)) > 0.75


def frame(per_cdm2: float) -> FramePixels:
    constants = (np.asarray(v, np.float32) for v in (512.0, 13488.0, per_cdm2))
    counts = np.full((1, 2, 4), 600, np.uint16)
    return FramePixels(
        RawSignal(counts, *constants, 4.0, 2.33),
        counts.astype(np.float32),
        np.zeros(counts.shape, bool),
    )


@pytest.mark.analytic
def test_a_value_has_the_uncertainty_of_the_frames_that_read_it() -> None:
    curve = ratio_curve([frame(100.0), frame(1.0)], np.diag([0.003, 0.03]) ** 2)
    assert curve(np.array([5000.0, 1.0])) == pytest.approx([0.03, 0.003], rel=0.02)
    together = ratio_curve([frame(100.0), frame(1.0)], np.full((2, 2), 0.01**2), extra=0.01)
    levels = np.geomspace(1e-4, 1e5, 50)
    assert together(levels) == pytest.approx(np.sqrt(2) * 0.01)


@pytest.mark.analytic
def test_frames_of_one_shutter_time_or_filter_err_together() -> None:
    profile = CameraProfile(
        CameraBody("", "raw", 2, 2),
        (),
        Bracket(4.0, 100.0, ()),
        shutter=(ShutterTime(0.1, 0.1, 0.004),),
        nd=(NeutralDensity("nd3", (1e3, 1e3, 1e3), 0.02),),
    )
    shots = [Exposure(0.1, 4.0), Exposure(0.1, 4.0, 100.0, "nd3"), Exposure(1.0, 4.0, 100.0, "nd3")]
    c = exposure_covariance(shots, profile)
    assert np.diag(c) - U_REPEAT**2 == pytest.approx(
        [0.004**2, 0.004**2 + 0.02**2, 0.003**2 + 0.02**2]
    )
    assert (c[0, 1], c[1, 2], c[0, 2]) == pytest.approx((0.004**2, 0.02**2, 0.0))
    tied = fit_ratios(
        [PairRatio(long=0, short=1, log_ratio=0.02, u_log=1e-5, pixels=999)], c[:2, :2]
    )  # a filter 2 % off, found by its overlap
    assert tied.correction[1] / tied.correction[0] == pytest.approx(np.exp(0.02), rel=1e-4)
    assert tied.u_log == pytest.approx([0.004, 0.004], rel=0.02)


@pytest.mark.analytic
def test_disagreement_counts_once() -> (
    None
):  # 2 % apart, by a response that is 1.5 % uncertain: explained
    left = [NeighbourQuality(0, 1, 2.0, 0.1, 999), NeighbourQuality(1, 2, -2.0, 0.1, 999)]
    assert unexplained_by_neighbours(left, 0.03) == 0.0
    assert unexplained_by_neighbours(left, 0.0) == pytest.approx(
        1.4826 * 0.02 / np.sqrt(2), rel=0.01
    )
    assert unexplained_by_neighbours([], 0.0) == 0.0


@pytest.mark.analytic
def test_a_turned_lens_keeps_its_one_curve() -> (
    None
):  # two headings of one lens do not average its error
    unused: Any = None  # the sensor
    front, back = Lens((1.0, 1.0), 1.0, 180.0, name="a"), Lens((1.0, 1.0), 1.0, 180.0, name="b")

    def view(lens: Lens) -> LensView:
        one = np.ones(1)
        return LensView(
            10 * one,
            one,
            one,
            0.02 * one,
            0.01 * one,
            np.zeros(1, np.uint8),
            np.ones((1, 3)),
            0 * one,
            one,
            lens,
            unused,
        )

    assert blend([view(front), view(front)]).u_vignetting == pytest.approx(0.02)
    assert blend([view(front), view(back)]).u_vignetting == pytest.approx(0.02 / np.sqrt(2))
    assert blend([view(front), view(back)]).u_ratio == pytest.approx(0.01)
