"""Search of a scene with light below its patches that follows each trial."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_captures import ROOM, SEATTLE, shifted, window_captures

from fieldlum.models.data import Dataset
from fieldlum.scene_fit.evidence import SceneEvidence, gather
from fieldlum.scene_fit.guess import Bar, Guess, guess_of
from fieldlum.scene_fit.least_squares import damped_search
from fieldlum.scene_fit.parameters import inset_parameters, room_parameters, stated_albedo
from fieldlum.scene_fit.profiled import FINE_SUB, ProfiledCost
from fieldlum.scene_fit.reflected import relit
from fieldlum.scene_fit.search import PRIOR_SHARE, Objective

WIDTH = 0.4  # log error at which a pixel counts as half wrong


@pytest.fixture(scope="module")
def data() -> Dataset:
    return window_captures(SEATTLE, 48)


@pytest.fixture(scope="module")
def evidence(data: Dataset) -> SceneEvidence:
    return gather(data, ROOM, pixels=1200)


def objective_of(data: Dataset, evidence: SceneEvidence, lit_at: Guess) -> Objective:
    """Cost whose light below was estimated with the patches of `lit_at`."""
    true, albedo = guess_of(ROOM), stated_albedo(ROOM)
    own = relit(evidence, data, lit_at, albedo, reflects=False)
    return Objective(own, true, room_parameters(true), albedo, 1e-3 * PRIOR_SHARE)


@pytest.mark.analytic
@pytest.mark.parametrize("by_m", [-0.08, -0.03, 0.03, 0.08])
def test_light_below_that_follows_prefers_the_true_scene(
    data: Dataset, evidence: SceneEvidence, by_m: float
) -> None:
    true, wrong = guess_of(ROOM), shifted(by_m)
    cost = ProfiledCost(objective_of(data, evidence, wrong), data, wrong, WIDTH)
    assert cost(true) < (1.0 - 1.5 * abs(by_m)) * cost(wrong)


@pytest.mark.analytic
def test_light_below_of_unchanged_pixels_is_kept(data: Dataset, evidence: SceneEvidence) -> None:
    """The cost does not depend on the guess whose light below is kept."""
    true, other = guess_of(ROOM), shifted(0.1)
    cost = ProfiledCost(objective_of(data, evidence, true), data, true, WIDTH)
    first = cost(other)
    cost.move_base(other)
    assert cost(other) == pytest.approx(first, rel=1e-6)
    assert cost(other) == pytest.approx(
        float(np.sum(cost.residuals(other) ** 2)) + cost.objective.prior(other)
    )


@pytest.mark.slow
@pytest.mark.analytic
def test_a_displaced_scene_is_found_again(data: Dataset, evidence: SceneEvidence) -> None:
    true = guess_of(ROOM)
    start = replace(shifted(0.06), north_deg=0.6, thickness_m=true.thickness_m + 0.04)
    fine = evidence.finer(data, FINE_SUB)
    parameters = [
        p
        for p in room_parameters(true)
        if p.name in ("north_deg", "thickness_m") or p.name.startswith("window")
    ]
    found = start
    for width in (1.6, WIDTH):
        cost = ProfiledCost(objective_of(data, fine, found), data, found, width)
        before = cost(found)
        found = damped_search(cost, found, parameters, 0.3)
        assert cost(found) <= before
    off = {p.name: abs(p.read(found) - p.read(true)) for p in parameters}
    assert off["north_deg"] < 0.15
    assert all(value < 0.02 for name, value in off.items() if name.startswith("window"))


@pytest.mark.property
def test_finer_rays_show_the_same_patches(data: Dataset, evidence: SceneEvidence) -> None:
    fine = evidence.finer(data, FINE_SUB)
    counts = np.bincount(fine.pixel, minlength=len(fine.pixels))
    assert (counts == FINE_SUB**2).all()
    guess, albedo = guess_of(ROOM), stated_albedo(ROOM)
    coarse_cdm2, fine_cdm2 = evidence.patches(guess, albedo), fine.patches(guess, albedo)
    assert fine_cdm2.sum() == pytest.approx(coarse_cdm2.sum(), rel=0.01)
    clear = coarse_cdm2 > 0.999 * coarse_cdm2.max(axis=1, keepdims=True)
    assert np.median(np.abs(np.log(fine_cdm2[clear] / coarse_cdm2[clear]))) < 0.01


@pytest.mark.property
def test_a_bars_inner_face_stays_between_wall_and_outer_face() -> None:
    guess = replace(guess_of(ROOM), bars=(Bar(0, True, (2.0, 2.06), (0.05, 0.12)),))
    (inset,) = inset_parameters(guess)
    assert inset.read(inset.change(guess, 0.02)) == pytest.approx(0.07)
    assert inset.read(inset.change(guess, -1.0)) == 0.0
    assert inset.read(inset.change(guess, 1.0)) < 0.12
