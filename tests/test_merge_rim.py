"""A lens that is dark at the edge of its image."""

import numpy as np
import pytest

from fieldlum.merge.bracket import dark_rim
from fieldlum.merge.quality import verdict
from fieldlum.session.files.merge_report import DarkRim, MergeReport

RNG = np.random.default_rng(3)
FROM_EDGE_DEG = RNG.uniform(0.0, 3.4, 4000)
SCENE = 100.0 * np.exp(0.5 * RNG.normal(size=4000))  # a scene's luminance varies


@pytest.mark.analytic
def test_a_dark_rim_is_found_with_its_width_and_depth() -> None:
    fall = np.interp(FROM_EDGE_DEG, [0.0, 2.4], [0.1, 1.0])
    rim = dark_rim(SCENE * fall, FROM_EDGE_DEG)
    assert rim is not None
    assert rim[0] == pytest.approx(2.4, abs=0.5) and rim[1] == pytest.approx(0.2, abs=0.05)


@pytest.mark.property
@pytest.mark.parametrize("slope", [0.7, 1.0, 1.4])
def test_scenes_that_darken_or_brighten_towards_the_edge_have_no_rim(slope: float) -> None:
    assert dark_rim(SCENE * np.interp(FROM_EDGE_DEG, [0, 3.4], [slope, 1]), FROM_EDGE_DEG) is None


@pytest.mark.property
def test_few_pixels_are_not_judged() -> None:
    few = slice(0, 200)
    assert dark_rim(SCENE[few] * FROM_EDGE_DEG[few], FROM_EDGE_DEG[few]) is None


@pytest.mark.contract
def test_the_verdict_names_lens_width_and_command() -> None:
    report = MergeReport(residual_percent=0.5, dark_rims=(DarkRim("8 mm", 2.5, 0.21),))
    text = verdict(report)
    assert "outer 2.5 degrees of lens '8 mm' are dark" in text and "--trim 2.5" in text
    assert MergeReport.from_table(report.table()).dark_rims == report.dark_rims
