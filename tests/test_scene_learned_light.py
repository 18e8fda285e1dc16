"""Last search of a scene, below light that is learned from unlit values only."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_captures import ROOM, SEATTLE, shifted, window_captures

from fieldlum.models.data import Dataset
from fieldlum.scene_fit.evidence import SceneEvidence, gather
from fieldlum.scene_fit.guess import guess_of
from fieldlum.scene_fit.last_search import last_objective
from fieldlum.scene_fit.learned_light import LearnedCost, LearnedLight, learned_light
from fieldlum.scene_fit.least_squares import damped_search
from fieldlum.scene_fit.parameters import room_parameters, stated_albedo
from fieldlum.scene_fit.pose_prior import PosePrior
from fieldlum.scene_fit.scene_search import SceneSearch
from fieldlum.scene_fit.search import PRIOR_SHARE, Objective
from fieldlum.scene_fit.stated_room import StatedRoom

WIDTH = 0.4  # log error at which a pixel counts as half wrong


@pytest.fixture(scope="module")
def data() -> Dataset:
    return window_captures(SEATTLE, 48)


@pytest.fixture(scope="module")
def evidence(data: Dataset) -> SceneEvidence:
    return gather(data, ROOM, pixels=1200)


def objective_of(evidence: SceneEvidence) -> Objective:
    true = guess_of(ROOM)
    parameters = room_parameters(true)
    return Objective(evidence, true, parameters, stated_albedo(ROOM), 1e-5 * PRIOR_SHARE)


def log_errors(data: Dataset, evidence: SceneEvidence, light: LearnedLight) -> np.ndarray:
    """Errors of ln luminance below the patches, which are exact, in units of the stated sd."""
    seen = np.exp(evidence.log_seen)
    below = seen - evidence.finer(data, 4).patches(guess_of(ROOM), stated_albedo(ROOM))
    known = below > 0.3 * seen
    return (np.log(light.luminance[known] / below[known]) / light.log_sd[known]).astype(float)


@pytest.mark.analytic
def test_light_below_is_within_its_uncertainty(data: Dataset, evidence: SceneEvidence) -> None:
    light = learned_light(objective_of(evidence), data, guess_of(ROOM), ROOM)
    assert np.isfinite(light.luminance).all()
    assert (np.abs(log_errors(data, evidence, light)) < 3.0).mean() > 0.95


@pytest.mark.property
def test_values_in_a_patch_do_not_teach_the_light_below(
    data: Dataset, evidence: SceneEvidence
) -> None:
    """A patch 30 % brighter changes the light below it by less than its uncertainty."""
    true = guess_of(ROOM)
    patch = evidence.patches(true, stated_albedo(ROOM))
    lit = patch > np.exp(evidence.log_seen) * 0.5
    flat = data.luminance_cdm2.reshape(len(data), -1).copy()
    hours, pixels = np.nonzero(lit)
    flat[evidence.rows[hours], evidence.pixels[pixels]] += 0.3 * patch[lit]
    brighter = replace(data, luminance_cdm2=flat.reshape(data.luminance_cdm2.shape))
    first, second = (learned_light(objective_of(evidence), d, true, ROOM) for d in (data, brighter))
    change = np.log(second.luminance / first.luminance)
    assert (np.abs(change[lit]) < 2.0 * first.log_sd[lit]).mean() > 0.9


@pytest.mark.analytic
def test_a_sliver_of_a_patch_in_a_dark_pixel_counts_less(
    data: Dataset, evidence: SceneEvidence
) -> None:
    """Of 16 rays in a pixel one more or less is lit, which is much in a pixel without patch."""
    objective = objective_of(evidence)
    light = learned_light(objective, data, guess_of(ROOM), ROOM)
    moved = shifted(0.02)
    sharp = np.abs(LearnedCost(objective, without_patches_near(light), 0.2).residuals(moved))
    soft = np.abs(LearnedCost(objective, light, 0.2).residuals(moved))
    near = light.brightest.ravel() > 0.0
    assert soft[~near] == pytest.approx(sharp[~near])
    assert (soft[near] <= sharp[near] + 1e-12).all()
    patch = evidence.patches(guess_of(ROOM), objective.albedo).ravel()
    sliver = near & (patch == 0.0) & (sharp > 0.5 * sharp.max())
    assert sliver.any() and (soft[sliver] < sharp[sliver]).all()


def without_patches_near(light: LearnedLight) -> LearnedLight:
    return replace(light, brightest=np.zeros_like(light.brightest))


@pytest.mark.slow
@pytest.mark.analytic
@pytest.mark.parametrize("by_m", [-0.02, 0.0, 0.02])
def test_the_last_search_ends_at_the_true_scene(
    data: Dataset, evidence: SceneEvidence, by_m: float
) -> None:
    fine, true, found = evidence.finer(data, 4), guess_of(ROOM), shifted(by_m)
    parameters = [
        p for p in room_parameters(true) if p.name == "north_deg" or p.name.startswith("window")
    ]
    for _ in range(2):
        light = learned_light(objective_of(fine), data, found, ROOM)
        found = damped_search(
            LearnedCost(objective_of(fine), light, WIDTH), found, parameters, 0.15, steps=8
        )
    off = {p.name: abs(p.read(found) - p.read(true)) for p in parameters}
    assert off["north_deg"] < 0.15
    assert all(value < 0.008 for name, value in off.items() if name.startswith("window"))


@pytest.mark.property
def test_a_pose_from_discs_keeps_its_weight(data: Dataset, evidence: SceneEvidence) -> None:
    """The stated numbers lose weight in the last search; a measured pose does not."""
    pose = PosePrior(np.zeros(4), np.diag([0.05, 0.05, 0.05, 0.2]) ** 2)
    every = np.arange(len(evidence))
    search = SceneSearch(data, evidence, every, every, StatedRoom(ROOM, pose, 5.0))
    true = guess_of(ROOM)
    turned = replace(true, north_deg=0.2)
    before, last = (
        [objective.prior(guess) for guess in (true, turned, shifted(0.1))]
        for objective in (search.objective(evidence), last_objective(search))
    )
    assert last[1] - last[0] == pytest.approx(before[1] - before[0])
    assert last[2] - last[0] == pytest.approx(0.01 * (before[2] - before[0]))
