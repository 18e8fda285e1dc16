"""Measure how far a number can move before the captures contradict it, if all others follow."""

from __future__ import annotations

from collections.abc import Sequence

from fieldlum.scene_fit.guess import Guess
from fieldlum.scene_fit.parameters import Parameter
from fieldlum.scene_fit.search import Objective, along_valley, pattern_search
from fieldlum.statistics import is_no_worse

# Numbers that others compensate for: the clock by north, the walls' azimuth by the window's edges
# and the camera. Distances chosen: the prior's standard deviation, its halves and quarters.
CLOCK, WALL = "clock_min", "wall_azimuth_deg"
DISTANCES = {CLOCK: (1.25, 2.5, 5.0), WALL: (0.5, 1.0, 2.0)}


def reach_of(objective: Objective, guess: Guess, names: Sequence[str]) -> dict[str, float]:
    """Return how far each parameter can move in scenes that explain the captures as well, by name.

    The result has all parameters. names: "clock_min", "wall_azimuth_deg" or both: these are moved
    in turn, both ways in three steps (to 5 min or 2 degrees), and the others are searched. A scene
    explains the captures as well if its misfit by hours is not worse than the guess's by the
    one-standard-error rule, with independent days. A result is 0 if no move is possible, and at
    most the standard deviation of the prior. This is needed because searches that start at the
    guess stay near it: their spread is too small for numbers that compensate for each other.
    """
    parameters = objective.parameters
    reach = dict.fromkeys((p.name for p in parameters), 0.0)
    base, _ = pattern_search(objective, guess, parameters, coarse=0.25, fine=2.0)
    least = objective.misfits(base)
    for name in names:
        others = [p for p in parameters if p.name != name]
        for sign in (1.0, -1.0):
            trial = base
            moved = 0.0
            for distance in DISTANCES[name]:
                start = _moved(parameters, trial, name, sign * (distance - moved))
                trial, _ = pattern_search(objective, start, others, coarse=0.5, fine=2.0)
                moved = distance
                if not is_no_worse(objective.misfits(trial), least, objective.evidence.days):
                    break
                for p in parameters:
                    off = min(abs(p.read(trial) - p.read(guess)), p.sd)
                    reach[p.name] = max(reach[p.name], off)
    return reach


def _moved(parameters: Sequence[Parameter], guess: Guess, name: str, by: float) -> Guess:
    """Return the guess with one number moved; if the clock moves, north follows it."""
    if name == CLOCK:
        return along_valley(guess, by)
    return next(p for p in parameters if p.name == name).change(guess, by)
