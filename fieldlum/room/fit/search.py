"""Search numbers of a scene: damped least squares on one robust cost with the tape's priors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.room.fit.evidence import WIDTH, SceneEvidence
from fieldlum.room.fit.guess import Guess, is_possible, thickened
from fieldlum.room.fit.parameters import POSE_NAMES, Parameter

if TYPE_CHECKING:
    from fieldlum.room.fit.pose_prior import PosePrior

# Of the stated misfit: what one standard deviation of one number must pay, with `PRIOR_HOURS` sunny
# hours or more: nine days have 25 to 60. With a quarter of it a room with a blind moved the clock
# by 10 minutes and north by 2 degrees, because boxes lack what rooms have (docs/validation.md).
PRIOR_SHARE, PRIOR_HOURS = 0.006, 30
# Chosen: shares of the parameters' steps over which derivatives are taken, one after the other;
# rounds with each; longest move, in such steps; share of the cost below which a gain is noise.
LEVELS = (1.0, 0.4, 0.15)
_ROUNDS, _REACH, _MIN_GAIN = 5, 3.0, 1e-3
_FIRST_DAMPING, _TRIES = 0.1, 5


def prior_unit(evidence: SceneEvidence, start: Guess, albedo: Floats) -> float:
    """Return the cost of one standard deviation of one parameter, from the misfit of the start.

    albedo: of the room's surfaces, as for `SceneEvidence.patches` [6].
    """
    few = max(1.0, PRIOR_HOURS / len(evidence))  # because the misfit is a mean over hours
    return few * PRIOR_SHARE * float(evidence.misfit(evidence.patches(start, albedo)).mean())


@dataclass(frozen=True, slots=True)
class SceneCost:
    """Misfit plus prior of a guess, as a sum of squares.

    start: the stated guess; parameters: those that have a prior; albedo: of west, east, south and
    north wall, floor, ceiling [6]; unit: cost of one standard deviation of one parameter; pose:
    replaces the priors of north, tilt, roll and clock.
    """

    evidence: SceneEvidence
    start: Guess
    parameters: Sequence[Parameter]
    albedo: Floats
    unit: float
    pose: PosePrior | None = None

    def __call__(self, guess: Guess) -> float:
        """Return the cost of a guess; infinite for an impossible one."""
        found = self.residuals(guess)
        return np.inf if found is None else float(found @ found)

    def by_hour(self, guess: Guess) -> Floats:
        """Return the misfit of each hour, with its share of the prior's cost, [n]."""
        prior = self.prior(guess)
        misfit = self.evidence.misfit(self.evidence.patches(guess, self.albedo))
        return misfit + float(prior @ prior)

    def residuals(self, guess: Guess) -> Floats32 | None:
        """Return numbers [q] whose squares add up to the cost; None for an impossible guess.

        First are those of each hour and pixel, then the priors.
        """
        if not is_possible(guess):
            return None
        patch = self.evidence.patches(guess, self.albedo)
        error = np.log(self.evidence.below + patch) - self.evidence.log_seen
        misfit = error / np.sqrt((error**2 + np.float32(WIDTH**2)) * np.float32(error.size))
        return np.concatenate([misfit.ravel(), self.prior(guess)]).astype(np.float32)

    def prior(self, guess: Guess) -> Floats:
        """Return deviations [q] from the stated numbers, whose squares are their cost.

        If sun discs determined a pose, north, tilt, roll and clock are compared with that pose
        instead: they count by their squared Mahalanobis distance from it.
        """
        by_disc = POSE_NAMES if self.pose is not None else ()
        off = [
            (p.measured(guess) - p.measured(self.start)) / p.sd
            for p in self.parameters
            if p.name not in by_disc
        ]
        if self.pose is not None:
            off += self.pose.deviations(guess).tolist()
        return np.sqrt(self.unit) * np.array(off)


def search(
    cost: SceneCost, guess: Guess, parameters: Sequence[Parameter], levels: Sequence[float] = LEVELS
) -> tuple[Guess, float]:
    """Search the guess of the smallest cost from a start; return it and its cost (no unit).

    parameters: what of the guess is changed. Levenberg-Marquardt: derivatives are differences over
    shares of the parameters' steps, which `levels` lists. A finer level follows when a round gains
    less than 0.1 % of the cost.
    """
    off = cost.residuals(guess)
    if off is None:
        return guess, np.inf
    value = float(off @ off)
    for level in levels:
        damping = _FIRST_DAMPING
        for _ in range(_ROUNDS):
            slopes = _slopes(cost, guess, parameters, off, level)
            normal, downhill = (slopes @ slopes.T).astype(float), (slopes @ off).astype(float)
            scale = np.diag(np.diag(normal) + 1e-4 * max(np.diag(normal).mean(), 1e-12))
            before = value
            for _ in range(_TRIES):
                step = -np.linalg.solve(normal + damping * scale, downhill)
                trial = stepped(guess, parameters, level * np.clip(step, -_REACH, _REACH))
                tried = cost.residuals(trial)
                if tried is not None and float(tried @ tried) < value:
                    guess, off, value = trial, tried, float(tried @ tried)
                    damping = max(damping / 4.0, 1e-3)
                    break
                damping *= 4.0
            if value > (1.0 - _MIN_GAIN) * before:
                break
    return guess, value


def stepped(guess: Guess, parameters: Sequence[Parameter], steps: Floats) -> Guess:
    """Return the guess with each of k parameters changed by steps [k] times `Parameter.step`."""
    for p, count in zip(parameters, steps.tolist(), strict=True):
        guess = p.change(guess, count * p.step)
    return thickened(guess)


def _slopes(
    cost: SceneCost, guess: Guess, parameters: Sequence[Parameter], found: Floats32, level: float
) -> Floats32:
    """Return by how much the residuals change with `level` of each parameter's step, [k, r].

    found: residuals of the guess, used where a changed one is impossible.
    """
    slopes = np.empty((len(parameters), len(found)), np.float32)
    for row, p in zip(slopes, parameters, strict=True):
        ends = (cost.residuals(p.change(guess, sign * level * p.step)) for sign in (1.0, -1.0))
        up, down = (found if end is None else end for end in ends)
        row[:] = (up - down) / np.float32(2.0)
    return slopes


def covariance(cost: SceneCost, guess: Guess, parameters: Sequence[Parameter]) -> Floats:
    """Return the covariance of parameters at the cheapest guess, in steps squared [k, k].

    guess: the one with the lowest cost; a parameter's step is its `Parameter.step`. The covariance
    is the sum of two. The first is by priors and noise: a displacement of one standard deviation
    raises the cost by `cost.unit`. The second is by the scatter of the cost's gradient between
    days, or between hours with under three days (sandwich estimator).
    """
    found = cost.residuals(guess)
    assert found is not None
    level = LEVELS[-1]
    slopes = _slopes(cost, guess, parameters, found, level).astype(float)
    inverse = np.linalg.pinv(slopes @ slopes.T, hermitian=True)
    hours = len(cost.evidence)
    count = cost.evidence.log_seen.size
    by_hour = slopes[:, :count] * found[:count]
    by_hour = by_hour.reshape(len(slopes), hours, -1).sum(axis=2)  # [k, n]
    days, which = np.unique(cost.evidence.days, return_inverse=True)
    if len(days) < 3:
        which = np.arange(hours)
    scores = np.stack([np.bincount(which, row) for row in by_hour])  # [k, days]
    scores -= scores.mean(axis=1, keepdims=True)
    spread = scores @ scores.T * scores.shape[1] / max(scores.shape[1] - 1, 1)
    return level**2 * (cost.unit * inverse + inverse @ spread @ inverse)
