"""Search a scene's last centimetres, below light that is learned away from patch edges."""

from __future__ import annotations

from dataclasses import replace

from fieldlum.scene_fit.guess import Guess
from fieldlum.scene_fit.learned_light import LearnedCost, learned_light
from fieldlum.scene_fit.profiled import FINE_SUB, damped_search
from fieldlum.scene_fit.scene_search import SceneSearch
from fieldlum.scene_fit.search import Objective

# Log errors at which a pixel counts as half wrong, one search each. Chosen for time: in three rooms
# of draw 8 (1.6, 0.8, 0.4, 0.2) gives the same errors within 10 % (decision 36).
_WIDTHS = (0.8, 0.2)
_COST_WIDTH = 0.4
# Chosen in rooms of bench/scene_rooms.py, draw 7 (decision 36).
_SHARE = 0.15  # steps of the slopes, in first steps of the parameters
_STEPS, _SMALL_GAIN = 12, 1e-5
_PRIOR_WEIGHT = 0.01  # of the stated numbers, next to the search before


def last_search(search: SceneSearch, guess: Guess) -> Guess:
    """Return a guess of lower cost near one that has all its elements."""
    for width in _WIDTHS:
        cost = _cost(search, guess, width)
        parameters = search.free_parameters(guess)
        guess = damped_search(cost, guess, parameters, _SHARE, steps=_STEPS, small_gain=_SMALL_GAIN)
        search.relight(guess)
    return guess


def last_cost(search: SceneSearch, guess: Guess) -> float:
    """Return the cost of a guess at the pixels of a search, with light below its own patches."""
    return _cost(search, guess, _COST_WIDTH)(guess)


def last_objective(search: SceneSearch) -> Objective:
    """Return the objective of the last search: the stated numbers count a hundredth.

    A pose that the sun's discs measured keeps its weight.
    """
    objective = search.objective(search.evidence.finer(search.data, FINE_SUB))
    pose = objective.pose
    if pose is not None:
        pose = replace(pose, covariance=_PRIOR_WEIGHT * pose.covariance)
    return replace(objective, prior_unit=_PRIOR_WEIGHT * objective.prior_unit, pose=pose)


def _cost(search: SceneSearch, guess: Guess, width: float) -> LearnedCost:
    objective = last_objective(search)
    light = learned_light(objective, search.data, guess, search.stated.room)
    return LearnedCost(objective, light, width)
