"""Search the numbers of a scene: damped least squares on a robust misfit plus the tape's priors."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.room.fit.evidence import WIDTH, SceneEvidence
from fieldlum.room.fit.guess import Guess, is_possible, thickened
from fieldlum.room.fit.parameters import POSE_NAMES, Parameter
from fieldlum.room.fit.pose_prior import PosePrior

# Cost of one standard deviation of one number, as a share of the stated misfit, with `PRIOR_HOURS`
# sunny hours or more: nine days have 25 to 60. With a quarter of it a room with a blind moved the
# clock by 10 minutes and north by 2 degrees, because boxes lack what rooms have
# (docs/validation.md).
PRIOR_SHARE, PRIOR_HOURS = 0.006, 30
# Chosen: shares of the parameters' steps over which derivatives are taken, from coarse to fine;
# rounds with each; longest move of a round, in such steps; share of the cost below which a gain is
# noise; first damping, and how often a round tries a damping four times as large.
STEP_SHARES = (1.0, 0.4, 0.15)
_ROUNDS, _MAX_STEPS, _MIN_GAIN = 5, 3.0, 1e-3
_FIRST_DAMPING, _TRIES = 0.1, 5


def prior_unit(evidence: SceneEvidence, start: Guess, albedo: Floats) -> float:
    """Return the cost of one standard deviation of one parameter, from the misfit of the start.

    It is 0.6 % of that misfit, and more with under 30 sunny hours. start: the stated guess; albedo
    [6]: of west, east, south and north wall, floor and ceiling, 0 to 1.
    """
    # the misfit is a mean over hours: with fewer of them, the prior counts more
    factor = max(1.0, PRIOR_HOURS / len(evidence))
    return factor * PRIOR_SHARE * float(evidence.misfit(evidence.patches(start, albedo)).mean())


@dataclass(frozen=True, slots=True)
class SceneCost:
    """Cost of a guess: its misfit to captures and skyline plus a prior, as a sum of squares.

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
        """Return the cost of a guess (no unit); infinite for an impossible one."""
        residuals = self.residuals(guess)
        return np.inf if residuals is None else float(residuals @ residuals)

    def by_hour(self, guess: Guess) -> Floats:
        """Return the cost of each hour, [n], whose mean is that of the guess.

        It is the hour's misfit plus the cost of skyline and prior.
        """
        same = np.concatenate([self.prior(guess), self.evidence.skyline.error(guess)])
        misfit = self.evidence.misfit(self.evidence.patches(guess, self.albedo))
        return misfit + float(same @ same)

    def residuals(self, guess: Guess) -> Floats32 | None:
        """Return numbers [q] whose squares add up to the cost; None for an impossible guess.

        First are those of n hours at m pixels, hour by hour, then those of skyline and prior.
        """
        if not is_possible(guess):
            return None
        patch = self.evidence.patches(guess, self.albedo)
        error = np.log(self.evidence.below + patch) - self.evidence.log_seen
        misfit = error / np.sqrt((error**2 + np.float32(WIDTH**2)) * np.float32(error.size))
        sky = self.evidence.skyline.error(guess)
        return np.concatenate([misfit.ravel(), sky, self.prior(guess)]).astype(np.float32)

    def prior(self, guess: Guess) -> Floats:
        """Return a guess's weighted deviations from the stated numbers; their squares are its cost.

        One for each parameter, in its order. If sun discs determined a pose, the last four replace
        those of north, tilt, roll and clock: these numbers are compared with that pose, and their
        cost is `unit` times the squared Mahalanobis distance from it.
        """
        by_disc = POSE_NAMES if self.pose is not None else ()
        deviations = [
            (p.measured(guess) - p.measured(self.start)) / p.sd
            for p in self.parameters
            if p.name not in by_disc
        ]
        if self.pose is not None:
            deviations += self.pose.deviations(guess).tolist()
        return np.sqrt(self.unit) * np.array(deviations)


def search(
    cost: SceneCost,
    guess: Guess,
    parameters: Sequence[Parameter],
    step_shares: Sequence[float] = STEP_SHARES,
) -> tuple[Guess, float]:
    """Search the guess of the smallest cost from a start; return it and its cost (no unit).

    guess: the start; if it is impossible, it is returned with an infinite cost. parameters: what of
    the guess is changed. Levenberg-Marquardt: derivatives are differences over shares of the
    parameters' steps. The next of `step_shares` follows when a round gains less than 0.1 % of the
    cost, or after five rounds.
    """
    residuals = cost.residuals(guess)
    if residuals is None:
        return guess, np.inf
    value = float(residuals @ residuals)
    for share in step_shares:
        damping = _FIRST_DAMPING
        for _ in range(_ROUNDS):
            slopes = _slopes(cost, guess, parameters, residuals, share)
            normal, gradient = (slopes @ slopes.T).astype(float), (slopes @ residuals).astype(float)
            scale = np.diag(np.diag(normal) + 1e-4 * max(np.diag(normal).mean(), 1e-12))
            before = value
            for _ in range(_TRIES):
                steps = -np.linalg.solve(normal + damping * scale, gradient)
                trial = stepped(guess, parameters, share * np.clip(steps, -_MAX_STEPS, _MAX_STEPS))
                tried = cost.residuals(trial)
                if tried is not None and float(tried @ tried) < value:
                    guess, residuals, value = trial, tried, float(tried @ tried)
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
    cost: SceneCost,
    guess: Guess,
    parameters: Sequence[Parameter],
    residuals: Floats32,
    step_share: float,
) -> Floats32:
    """Return by how much q residuals change with a share of each of k parameters' steps, [k, q].

    residuals: those of the guess [q], which also replace those of a changed guess that is
    impossible; step_share: of `Parameter.step`.
    """
    slopes = np.empty((len(parameters), len(residuals)), np.float32)
    for row, p in zip(slopes, parameters, strict=True):
        ends = (cost.residuals(p.change(guess, sign * step_share * p.step)) for sign in (1.0, -1.0))
        up, down = (residuals if end is None else end for end in ends)
        row[:] = (up - down) / np.float32(2.0)
    return slopes


def covariance(cost: SceneCost, guess: Guess, parameters: Sequence[Parameter]) -> Floats:
    """Return the covariance of k parameters at the cheapest guess, in steps squared [k, k].

    guess: the one with the lowest cost, which must be possible; a parameter's step is its
    `Parameter.step`. The covariance is the sum of two. The first is by priors and noise: a
    displacement of one standard deviation raises the cost by `cost.unit`. The second is by the
    scatter of the cost's gradient between days, or between hours with under three days (sandwich
    estimator).
    """
    residuals = cost.residuals(guess)
    assert residuals is not None
    share = STEP_SHARES[-1]
    slopes = _slopes(cost, guess, parameters, residuals, share).astype(float)
    inverse = np.linalg.pinv(slopes @ slopes.T, hermitian=True)
    hours = len(cost.evidence)
    count = cost.evidence.log_seen.size  # of the captures; those of skyline and prior follow
    gradient = slopes[:, :count] * residuals[:count]
    gradient = gradient.reshape(len(slopes), hours, -1).sum(axis=2)  # [k, n]
    days, group = np.unique(cost.evidence.days, return_inverse=True)
    if len(days) < 3:
        group = np.arange(hours)
    scores = np.stack([np.bincount(group, row) for row in gradient])  # [k, days]
    scores -= scores.mean(axis=1, keepdims=True)
    spread = scores @ scores.T * scores.shape[1] / max(scores.shape[1] - 1, 1)
    return share**2 * (cost.unit * inverse + inverse @ spread @ inverse)
