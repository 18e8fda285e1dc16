"""Learn the light below sun patches away from their edges, and compare scenes with it.

The light of `light_below` follows each trial, so that a scene can lower its cost by light far from
its patches. Here the light does not change during a search. Values within a pixel of
a patch's edge teach it almost nothing, and values in a patch little: a Gaussian process with the
kernel of the transport model predicts them from other hours and from neighbouring pixels, and
states their uncertainty.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import KDTree

from fieldlum.arrays import Array, Floats, Indices
from fieldlum.light import Kernel
from fieldlum.models.transport.features import training_arrays_of
from fieldlum.models.transport.patch_edges import edge_range
from fieldlum.models.transport.pixel_fit import basis_of
from fieldlum.models.transport.ridge import pair_products
from fieldlum.records import Room
from fieldlum.scene.view import LEAST_RAYS
from fieldlum.scene_fit.corrected import corrected, with_patches
from fieldlum.scene_fit.evidence import SceneEvidence
from fieldlum.scene_fit.guess import Guess, camera_is_free
from fieldlum.scene_fit.light_below import LEAST_CDM2
from fieldlum.scene_fit.posterior import true_room
from fieldlum.scene_fit.reflected import reflected_once
from fieldlum.scene_fit.search import Objective

if TYPE_CHECKING:
    from fieldlum.models.data import Dataset
    from fieldlum.scene_fit.pose_prior import PosePrior

# Chosen in rooms of bench/scene_rooms.py, draw 7.
_RANK = 60  # features of the process
_NOISE = 0.02  # relative standard deviation of a value far from patches
_TONE_SD = 0.1  # of the luminance of a sun patch, as a share of it: albedos differ within a surface
_EDGE_DEG = 1.0  # values nearer than this (at least a pixel) to an edge teach little
_EDGE_FACTOR = 4.0  # on the variance by a displaced edge
_ROUNDS = 3  # robust rounds
_ROBUST_WIDTH = 0.15  # log residual at which a value has half weight; as in the transport model
# What a neighbour on the same surface teaches, as a share of the pixel's own values.
_NEIGHBOURS, _NEIGHBOUR_SHARE, _NEIGHBOUR_DEG = 16, 0.003, 5.0
_HALF_WEIGHT_SD = 0.1  # standard deviation of ln luminance at which a value counts half
# Standard deviation of the lit share of a pixel that has 4 x 4 rays. Without it a cost has kinks at
# edges of solids, at which a search stops.
_PART_SD = 0.03
_MOST_REFLECTED = 0.8  # share of a value's light; chosen, as in light_below


@dataclass(frozen=True, slots=True)
class LearnedLight:
    """Light below patches of n sunny hours at m pixels.

    luminance: cd/m2 [n, m]; log_sd: standard deviation of its natural logarithm [n, m]. brightest:
    luminance of the brightest patch within a pixel or a degree, 0 without one, cd/m2 [n, m].
    """

    luminance: Floats
    log_sd: Floats
    brightest: Floats


class LearnedCost:
    """The cost of a guess with light below that stays.

    objective: for prior, albedos and evidence of n hours and m pixels; light: below the patches;
    width: log error at which a pixel counts as half wrong.
    """

    def __init__(self, objective: Objective, light: LearnedLight, width: float) -> None:
        self.objective, self.light, self.width = objective, light, width

    @property
    def pose(self) -> PosePrior | None:
        """The prior of north, tilt, roll [deg] and clock [min]; None for under three sun discs."""
        return self.objective.pose

    def move_base(self, guess: Guess) -> None:
        """Change nothing: the light below does not depend on the guess."""

    def residuals(self, guess: Guess) -> Array:
        """Return numbers whose squares add up to the cost without prior, [n m]."""
        evidence = self.objective.evidence
        patch = evidence.patches(guess, self.objective.albedo_of(guess))
        total = self.light.luminance + patch
        error = np.log(total) - evidence.log_seen  # [n, m]
        sd = self.light.log_sd * self.light.luminance / total
        part = _PART_SD * self.light.brightest / total  # a sliver of a patch in a dark pixel
        squared_width = self.width**2 * (1.0 + (sd / _HALF_WEIGHT_SD) ** 2) + part**2
        scale = np.sqrt(evidence.weights / len(evidence))
        return (scale * error / np.sqrt(error**2 + squared_width)).ravel()

    def at(self, hours: Indices) -> Callable[[Guess], float]:
        """Return the cost of a guess in some of the n hours, without the prior."""

        def cost(guess: Guess) -> float:
            squares = self.residuals(guess).reshape(len(self.light.luminance), -1) ** 2
            return float(squares[hours].sum())

        return cost

    def __call__(self, guess: Guess) -> float:
        """Return the cost of a guess, infinite if a solid holds the camera."""
        if not camera_is_free(guess):
            return np.inf
        return float(np.sum(self.residuals(guess) ** 2)) + self.objective.prior(guess)


def learned_light(objective: Objective, data: Dataset, guess: Guess, stated: Room) -> LearnedLight:
    """Learn the light below the patches of a guess from all captures.

    objective: its evidence has the n hours and m pixels; data: all N captures; stated: the room,
    for fields that are not fitted.
    """
    evidence, albedo = objective.evidence, objective.albedo_of(guess)
    room = true_room(guess, stated)
    moved = corrected(data, guess.north_deg, guess.clock_min, room)
    lit = with_patches(moved, sub=LEAST_RAYS)  # only where edges are, and hours without the sun
    arrays = training_arrays_of(lit, with_patch=True)
    covariance = Kernel(arrays.facades)(arrays.features, arrays.features)  # [N, N]
    basis = basis_of(covariance, _RANK).values  # [N, r]

    maps = lit.patch_cdm2
    assert maps is not None
    count = len(data)
    patch = maps.reshape(count, -1)[:, evidence.pixels].astype(float)  # [N, m]
    patch[evidence.rows] = evidence.patches(guess, albedo)
    seen = np.maximum(data.luminance_cdm2.reshape(count, -1)[:, evidence.pixels], LEAST_CDM2)
    rest = np.maximum(seen - patch, 0.05 * seen)
    near = np.zeros_like(rest)  # what patches reflect
    near[evidence.rows] = reflected_once(evidence, guess, albedo)
    near = np.minimum(near, _MOST_REFLECTED * rest)

    total = data.light.total_lx[:, None]
    dark = np.median(rest / total, axis=0) * total
    low, high, _ = edge_range(maps, _EDGE_DEG * maps.shape[1] / 180.0)
    low, high = (edge.reshape(count, -1)[:, evidence.pixels] for edge in (low, high))
    edge = np.log((dark + high) / (dark + low))
    tone = _TONE_SD * patch / np.minimum(rest, dark)
    variance = _NOISE**2 + tone**2 + _EDGE_FACTOR * edge**2

    y = (rest - near) / total
    scale = np.exp(np.average(np.log(y), axis=0, weights=1.0 / variance))  # [m]
    fit, sd = _process(basis, y / scale, variance, _neighbours(evidence, guess), evidence.rows)
    luminance = fit[evidence.rows] * scale * total[evidence.rows] + near[evidence.rows]
    brightest = high[evidence.rows].astype(float)
    return LearnedLight(np.maximum(luminance, LEAST_CDM2), sd, brightest)


def _process(
    basis: Array, y: Floats, variance: Floats, neighbours: csr_matrix, rows: Indices
) -> tuple[Floats, Floats]:
    """Return a robust fit to y [N, m], and the standard deviation of its logarithm at `rows`.

    basis: features of prior variance 1 [N, r]; variance: relative, of each value [N, m];
    neighbours: weights by which pixels teach each other [m, m].
    """
    products, a, b = pair_products(basis)
    r = basis.shape[1]
    fit, robust = np.clip(y, 0.2, 5.0), np.ones_like(y)
    matrix = np.empty((y.shape[1], r, r))
    for _ in range(_ROUNDS):
        weight = robust / (variance * fit * np.clip(y, 0.2 * fit, 5.0 * fit))  # [N, m]
        packed = weight.T @ products  # [m, r (r + 1) / 2]
        right = (weight * y).T @ basis  # [m, r]
        packed, right = packed + neighbours @ packed, right + neighbours @ right
        matrix[:, a, b] = matrix[:, b, a] = packed
        matrix[:, np.arange(r), np.arange(r)] += 1.0
        solved = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]  # [m, r]
        fit = np.maximum(basis @ solved.T, 0.05)
        robust = 1.0 / (1.0 + (np.log(y / fit) / _ROBUST_WIDTH) ** 2)
    inverse = np.linalg.inv(matrix)
    asked = basis[rows]  # [n, r]
    spread = np.einsum("nmi,ni->nm", np.einsum("ni,mij->nmj", asked, inverse), asked)
    return fit, np.sqrt(spread) / fit[rows]


def _neighbours(evidence: SceneEvidence, guess: Guess) -> csr_matrix:
    """Return the weights by which pixels on the same surface teach each other, [m, m]."""
    ends = evidence.unit(guess)[1]
    surface = np.full(len(evidence.pixels), -1)
    surface[evidence.pixel] = ends.surface
    directions = evidence.directions
    count = min(_NEIGHBOURS + 1, len(directions))
    distance, index = KDTree(directions).query(directions, k=count)
    weight = np.exp(-0.5 * (distance / np.radians(_NEIGHBOUR_DEG)) ** 2)  # [m, k]
    weight[surface[index] != surface[:, None]] = 0.0
    weight[:, 0] = 0.0  # the pixel itself
    own = np.repeat(np.arange(len(directions)), count)
    shape = (len(directions), len(directions))
    return csr_matrix((_NEIGHBOUR_SHARE * weight.ravel(), (own, index.ravel())), shape)
