"""Search a scene with light below its patches that is estimated again for each trial.

Light below that was estimated with one scene's patches favours this scene: patches that it lacks
count as light below. A search that keeps this light stays where it starts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fieldlum.scene_fit.guess import Guess, camera_is_free
from fieldlum.scene_fit.light_below import LEAST_CDM2, LightBelow, levelled
from fieldlum.scene_fit.reflected import reflected_once
from fieldlum.scene_fit.search import Objective

if TYPE_CHECKING:
    from fieldlum.models.data import Dataset

Array = NDArray[np.floating]

# Chosen in rooms of bench/scene_rooms.py. Rays in a pixel, each way: with 2 the cost
# of the true scene was 6 % higher, and rough. Rounds of the light below: with 6 the minimum is
# flatter.
FINE_SUB = 4
_ROUNDS = 3


@dataclass(frozen=True, slots=True)
class Stage:
    """One search of several.

    width: log error at which a pixel counts as half wrong; a wide one lets far patches attract.
    share: steps of the slopes, in first steps of the parameters. every: of the pixels one in so
    many is used.
    """

    width: float
    share: float
    every: int


# chosen with the numbers above; the last width is that of the other searches
STAGES = (
    Stage(1.6, 0.5, 2),
    Stage(1.6, 0.3, 2),
    Stage(0.8, 0.3, 2),
)
_SAME_PATCH = 1e-3  # share of a pixel's brightest patch: a smaller change is none


class ProfiledCost:
    """The cost of a guess, with the light below that its own patches leave.

    objective: for prior, albedos and windows' picture, with the evidence of n hours and m pixels;
    data: all captures; guess: determines what patches reflect and the level of each hour, which
    stay constant; width: log error at which a pixel counts as half wrong.
    """

    def __init__(self, objective: Objective, data: Dataset, guess: Guess, width: float) -> None:
        self.objective, self.width = objective, width
        evidence = objective.evidence
        seen = data.luminance_cdm2.reshape(len(data), -1)[:, evidence.pixels]
        self._seen = np.maximum(seen, LEAST_CDM2)
        self._light = LightBelow(data)
        self._near = np.zeros_like(self._seen)
        self._near[evidence.rows] = reflected_once(evidence, guess, objective.albedo_of(guess))
        patch = evidence.patches(guess, objective.albedo_of(guess))
        every = np.arange(len(evidence.pixels))
        self._level = np.ones_like(patch)
        raw = self._estimated(patch, every)
        seen_then = self._seen[evidence.rows]
        level = levelled(raw, seen_then, patch, evidence.directions, evidence.weights)
        self._level = level / raw
        self._base = patch, self._estimated(patch, every)

    def move_base(self, guess: Guess) -> None:
        """Keep the light below of a guess: it is estimated again where patches differ from it."""
        patch = self.objective.evidence.patches(guess, self.objective.albedo_of(guess))
        self._base = patch, self._below(patch)

    def residuals(self, guess: Guess) -> Array:
        """Return numbers whose squares add up to the cost without prior, [n m + q].

        The last q are of pixels that show windows.
        """
        evidence = self.objective.evidence
        patch = evidence.patches(guess, self.objective.albedo_of(guess))
        error = np.log(self._below(patch) + patch) - evidence.log_seen  # [n, m]
        scale = np.sqrt(evidence.weights / len(evidence))
        patches = (scale * error / np.sqrt(error**2 + self.width**2)).ravel()
        return np.concatenate([patches, evidence.view.residuals(guess)])

    def __call__(self, guess: Guess) -> float:
        """Return the cost of a guess, infinite if a solid holds the camera."""
        if not camera_is_free(guess):
            return np.inf
        return float(np.sum(self.residuals(guess) ** 2)) + self.objective.prior(guess)

    def _below(self, patch: Array) -> Array:
        known, below = self._base
        least = _SAME_PATCH * np.maximum(known.max(axis=0), 1.0)
        changed = np.flatnonzero(np.abs(patch - known).max(axis=0) > least)
        if len(changed):
            below = below.copy()
            below[:, changed] = self._estimated(patch[:, changed], changed)
        return below

    def _estimated(self, patch: Array, pixels: NDArray[np.intp]) -> Array:
        """Return the light below patches [n, k] at some pixels [k], cd/m2 [n, k]."""
        rows = self.objective.evidence.rows
        seen = self._seen[:, pixels]
        direct = np.zeros_like(seen)
        direct[rows] = patch
        below = self._light(seen, direct, self._near[:, pixels], _ROUNDS)[rows]
        return np.maximum(below * self._level[:, pixels], LEAST_CDM2)
