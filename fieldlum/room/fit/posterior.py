"""Estimate the uncertainty of a scene by repeated searches.

Each search has resampled days, resampled pixels of the windows' picture, and other stated values.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.records import Room
from fieldlum.room.fit.guess import Guess, room_of
from fieldlum.room.fit.search import Objective, pattern_search
from fieldlum.room.scene.room_parameters import room_parameters

SEARCHES_AGAIN = 6  # chosen: the fit takes twice its time, and a spread is known to 30 %
_THIN = 2  # use every second pixel; measured: a sixth of the fit's time for each search


@dataclass(frozen=True, slots=True)
class Posterior:
    """Result of the repeated searches.

    u: standard uncertainty of each parameter, by name, in its unit. room_draws: by name of
    `fieldlum.room.scene.room_parameters.room_parameters`, the value that each search found [6]; the
    walls' azimuth is relative to true north.
    """

    u: dict[str, float]
    room_draws: dict[str, tuple[float, ...]]


def posterior(objective: Objective, guess: Guess, stated: Room, seed: int) -> Posterior:
    """Return the uncertainty of a fitted guess by six searches with other days and stated values.

    objective: cost of all hours; stated: the room for fields that are not fitted. Days (with under
    three days: hours) are resampled, as are weights of the windows' picture. Stated values are
    drawn from their priors, so that a parameter which the captures do not determine has the prior's
    uncertainty. Every u includes the last step of the search.
    """
    rng = np.random.default_rng(seed)
    parameters = objective.parameters
    days = objective.evidence.days
    groups = np.unique(days)
    if len(groups) < 3:
        groups, days = np.arange(len(days)), np.arange(len(days))
    thin = objective.evidence.thinned(_THIN)
    values: list[list[float]] = []
    rooms: list[dict[str, float]] = []
    for _ in range(SEARCHES_AGAIN):
        drawn = rng.choice(groups, len(groups))
        hours = np.concatenate([np.flatnonzero(days == g) for g in drawn])
        start, tape = guess, objective.start
        for p in parameters:
            start = p.change(start, float(rng.normal(0.0, p.first_step)))
            tape = p.change(tape, float(rng.normal(0.0, p.sd)))
        pose = objective.pose and objective.pose.drawn(rng)
        evidence = replace(thin.hours(hours), view=thin.view.redrawn(rng))
        again = replace(objective, evidence=evidence, start=tape, pose=pose)
        best, _ = pattern_search(again, start, parameters, fine=2.0)
        values.append([p.read(best) for p in parameters])
        rooms.append(room_parameters(true_room(best, stated)))
    spread = np.std(values, axis=0, ddof=1)
    u = {p.name: float(np.hypot(s, p.last_step)) for p, s in zip(parameters, spread, strict=True)}
    return Posterior(u, {name: tuple(room[name] for room in rooms) for name in rooms[0]})


def true_room(guess: Guess, stated: Room) -> Room:
    """Return the guess as a `Room` whose wall azimuth is relative to true north.

    The azimuth is the guess's plus its correction of north; stated: the room for fields that are
    not fitted.
    """
    azimuth_deg = (guess.wall_azimuth_deg + guess.north_deg) % 360.0
    return replace(room_of(guess, stated), wall_azimuth_deg=azimuth_deg)
