"""Which hours are trusted: not all where captures contradict each other, most on clean sets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from learning_room import dataset

from fieldlum.learn import models
from fieldlum.learn.models import TRUSTED_MSE, Prediction, trusted_hours
from fieldlum.learn.models.scores import evaluate, summary, truth
from fieldlum.learn.models.training_data import Dataset
from fieldlum.learn.train import held_out_warnings

DAYS = ("2027-03-19", "2027-03-20", "2027-03-21", "2027-06-20", "2027-06-21", "2027-06-22")
CLEAN = dataset(DAYS, height=16)
TEST = dataset(("2027-04-15", "2027-05-10"), seed=5, height=16)
ASKED = truth(TEST, glare=False)


def _share(data: Dataset) -> tuple[float, list[str]]:
    fitted = models.fit("transport", data, patch="none", seed=0)
    found = summary(evaluate(fitted, ASKED))
    return found["trusted_share"], held_out_warnings(fitted, data)


@pytest.mark.slow
@pytest.mark.property
def test_clean_captures_are_mostly_trusted_and_raise_no_warning() -> None:
    share, warnings = _share(CLEAN)
    assert share > 0.5 and warnings == []


@pytest.mark.slow
@pytest.mark.property
@pytest.mark.parametrize("trouble", ["lamp", "moved camera", "snow"])
def test_a_trouble_costs_trust(trouble: str) -> None:
    """The review's missing test 4, second half: warned, and not everything is trusted."""
    maps = CLEAN.luminance_cdm2.copy()
    if trouble == "lamp":
        maps[:, :4] += 300.0
        maps[CLEAN.light.total_lx < 30_000, 4:] += 150.0
    elif trouble == "moved camera":
        some = np.isin(CLEAN.days, np.unique(CLEAN.days)[::2])
        maps[some] = np.roll(maps[some], 2, axis=2)
    else:
        winter = CLEAN.days < np.datetime64("2027-03-21")
        maps[winter, 8:] *= 3.0
    share, warnings = _share(replace(CLEAN, luminance_cdm2=maps))
    assert share < 1.0, trouble
    assert any("camera or a lamp changed" in t or "room that changed" in t for t in warnings)


@pytest.mark.analytic
def test_an_hour_expected_to_be_off_is_not_trusted() -> None:
    expected = np.array([0.0, TRUSTED_MSE, 1.1 * TRUSTED_MSE, np.nan])
    prediction = Prediction(np.zeros((4, 1, 2), np.float32), None, expected, np.ones(4, bool))
    assert trusted_hours(prediction).tolist() == [True, True, False, True]
