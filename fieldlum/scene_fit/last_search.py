"""Search a scene's last centimetres, below light that is learned away from patch edges."""

from __future__ import annotations

from dataclasses import replace

from fieldlum.scene_fit.guess import Guess
from fieldlum.scene_fit.last_elements import Elements
from fieldlum.scene_fit.learned_light import LearnedCost, LearnedLight, learned_light
from fieldlum.scene_fit.least_squares import damped_search, principal_search
from fieldlum.scene_fit.profiled import FINE_SUB
from fieldlum.scene_fit.scene_search import SceneSearch
from fieldlum.scene_fit.search import Objective

# Log errors at which a pixel counts as half wrong: of the first search, of the following ones, and
# of the comparison of scenes. Chosen in rooms of bench/scene_rooms.py, draws 7 and 8.
_FIRST_WIDTH, _WIDTH, _COST_WIDTH = 0.8, 0.2, 0.4
_ROUNDS = 2
_SHARE = 0.15  # steps of the slopes, in first steps of the parameters
_STEPS, _SMALL_GAIN = 4, 1e-4
_AXIS_GAIN = 0.005  # share of the cost that the first step along a principal axis changes
_PRIOR_WEIGHT = 0.01  # of the stated numbers, next to the search before


def last_search(search: SceneSearch, guess: Guess) -> Guess:
    """Return a guess of lower cost near one that has most of its elements."""
    objective = last_objective(search)
    cost = LearnedCost(objective, _light(search, objective, guess), _FIRST_WIDTH)
    guess = damped_search(cost, guess, search.free_parameters(guess), _SHARE, steps=_STEPS)
    search.relight(guess)
    for number in range(_ROUNDS):
        objective = last_objective(search)
        light = _light(search, objective, guess)
        elements = Elements(LearnedCost(objective, light, _COST_WIDTH), search)
        guess = elements.corrected(guess, reshape=number == 0)
        guess = _together(search, LearnedCost(objective, light, _WIDTH), guess)
        search.relight(guess)
    return guess


def refined_numbers(search: SceneSearch, guess: Guess) -> Guess:
    """Search all numbers once more below newly learned light; elements stay.

    The light below and the albedos of `search` become those of the result.
    """
    objective = last_objective(search)
    cost = LearnedCost(objective, _light(search, objective, guess), _WIDTH)
    guess = _together(search, cost, guess)
    search.relight(guess)
    return guess


def _together(search: SceneSearch, cost: LearnedCost, guess: Guess) -> Guess:
    """Return the guess of least cost by all numbers at once."""
    parameters = search.free_parameters(guess)
    guess = damped_search(cost, guess, parameters, _SHARE, steps=_STEPS, small_gain=_SMALL_GAIN)
    return principal_search(cost, guess, parameters, _SHARE, gain=_AXIS_GAIN)[0]


def last_cost(search: SceneSearch, guess: Guess) -> LearnedCost:
    """Return the cost at the pixels of a search, with light below the patches of a guess."""
    objective = last_objective(search)
    return LearnedCost(objective, _light(search, objective, guess), _COST_WIDTH)


def last_objective(search: SceneSearch) -> Objective:
    """Return the objective of the last search: the stated numbers count a hundredth.

    A pose that the sun's discs measured keeps its weight.
    """
    objective = search.objective(search.evidence.finer(search.data, FINE_SUB))
    pose = objective.pose
    if pose is not None:
        pose = replace(pose, covariance=_PRIOR_WEIGHT * pose.covariance)
    return replace(objective, prior_unit=_PRIOR_WEIGHT * objective.prior_unit, pose=pose)


def _light(search: SceneSearch, objective: Objective, guess: Guess) -> LearnedLight:
    return learned_light(objective, search.data, guess, search.stated.room)
