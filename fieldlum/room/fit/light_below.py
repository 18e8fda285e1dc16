"""Estimate from the captures alone the light that pixels would show without direct sun on them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fieldlum.sky.light import Kernel, facades_of, light_features

if TYPE_CHECKING:
    from fieldlum.learn.models.data import Dataset

Array = NDArray[np.floating]

# From a study of two rooms rendered by Radiance, made before this code (docs/scene.md).
RANK = 15  # few enough features that smooth light cannot imitate a patch; chosen with the study
ROUNDS = 6
# a sun patch only adds light, so brighter pixels lose weight sooner; chosen with the study
BRIGHTER, DARKER = 0.12, 0.5
# Chosen with the study: an hour's level is one number, so that dark pixels are noise for it; a
# luminance below that of a room by day; a share of the mean diagonal that makes the system
# solvable.
LEVEL_ROUNDS, LEVEL_DARKER = 12, 0.25
MIN_CDM2 = 0.1
_RIDGE = 1e-3
_PATCH_SHARE = 0.3  # share of a pixel's light; a stronger patch hides the light below; chosen


class LightBelow:
    """Smooth light of sky and sun in n captures, from which the light below patches is estimated.

    data: the captures, for their light and room.
    """

    def __init__(self, data: Dataset) -> None:
        features = light_features(data.light)
        kernel = Kernel(facades_of(data.setup.room))(features, features)  # [n, n]
        value, vector = np.linalg.eigh(kernel)
        rank = min(RANK, len(data) - 1)
        basis = vector[:, -rank:] * np.sqrt(np.maximum(value[-rank:], 0.0))  # [n, rank]
        scale = np.sqrt(np.mean(basis**2) * rank)
        # float32 is precise to 1e-5 of the light, and twice as fast
        terms = (np.column_stack([basis, np.ones(len(data))]) / scale).T.astype(np.float32)
        self.basis = terms  # [k, n]
        self.products = (terms[:, None] * terms).reshape(-1, len(data))  # [k k, n]
        self.total_lx = data.light.total_lx[:, None].astype(np.float32)  # [n, 1]

    def __call__(self, seen: Array, patch: Array, rounds: int = ROUNDS) -> Array:
        """Return the luminance that pixels would show without direct sun on them, cd/m2 [n, m].

        seen: captured luminance; patch: luminance of known sun patches, which is subtracted, and
        values that it dominates count less; each cd/m2 [n, m]. The result is a ridge regression of
        the rest on 15 smooth features of sky and sun. Its rounds reduce the weight of pixels that
        are brighter than the fit, because a sun patch only adds light. It is at least 0.1.
        """
        trust = _trust(patch, seen)
        y = np.maximum(seen - patch, 0.02 * seen) / self.total_lx
        scale = _middle(y)
        y = (y / scale).astype(np.float32)  # [n, m] of median 1
        trust = trust.astype(np.float32)
        fit = np.maximum(np.minimum(y, 1.5), 0.05)
        weight = trust / (y * fit)
        minimum, terms = np.float32(0.05), len(self.basis)
        for _ in range(rounds):
            normal = (self.products @ weight).T.reshape(-1, terms, terms)  # [m, k, k]
            mean = np.einsum("mkk->m", normal) / terms
            normal = normal + (_RIDGE * mean)[:, None, None] * np.eye(terms, dtype=np.float32)
            right = (self.basis @ (weight * y)).T[..., None]  # [m, k, 1]
            fit = np.maximum(self.basis.T @ np.linalg.solve(normal, right)[..., 0].T, minimum)
            q = np.log(y / fit)
            doubt = np.where(q > 0.0, q / BRIGHTER, q / DARKER) ** 2
            weight = trust / (y * fit) / (1.0 + doubt)
        return np.maximum(fit * scale * self.total_lx, MIN_CDM2)


def _middle(values: Array) -> Array:
    """Return the upper median of each column of values [n, m], [m]."""
    half = len(values) // 2
    return np.partition(np.ascontiguousarray(values.T), half, axis=1)[:, half]


def _trust(patch: Array, seen: Array) -> Array:
    return 1.0 / (1.0 + (patch / (_PATCH_SHARE * seen)) ** 2)


def levelled(below: Array, seen: Array, patch: Array, directions: Array, weights: Array) -> Array:
    """Return the light below patches, corrected for each hour by a smooth factor, [n, m] cd/m2.

    below: luminance estimated without direct sun; seen: captured; patch: of known sun patches; each
    [n, m] cd/m2; directions [m, 3] unit vectors; weights [m]. The features behind `below` do not
    determine how bright the room is under a sun that no other hour has. Therefore each hour
    corrects the logarithm by nine smooth functions of the direction, in rounds that reduce the
    weight of pixels brighter than the fit.
    """
    x, y, z = directions.T
    terms = np.stack([np.ones_like(x), x, y, z, x * y, x * z, y * z, x * x, z * z], axis=1)
    off = np.log(np.maximum(seen - patch, 0.02 * seen) / below)  # [n, m]
    first = weights * _trust(patch, seen)
    products = np.einsum("mk,ml->mkl", terms, terms).reshape(len(terms), -1)  # [m, 81]
    field = np.zeros_like(off)
    for number in range(LEVEL_ROUNDS):
        q = off - field
        doubt = np.where(q > 0.0, q / BRIGHTER, q / LEVEL_DARKER) ** 2
        weight = first / (1.0 + doubt) if number else first
        normal = (weight @ products).reshape(-1, 9, 9)
        normal = normal + 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(9)
        right = (weight * off) @ terms
        field = np.linalg.solve(normal, right[..., None])[..., 0] @ terms.T
    return below * np.exp(field)
