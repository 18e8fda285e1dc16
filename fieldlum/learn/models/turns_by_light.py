"""Estimate how much direct light makes a camera seem turned, which varies with the sun's azimuth.

Sun on one side of a window's reveal moves the edges that `camera_turns` compares. So a still camera
seems to turn smoothly through each clear day, in the same way on every day. A camera that was
really turned differs between days or for all azimuths, and keeps its turn.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats
from fieldlum.core.statistics import MAD_TO_SIGMA

# Other days must predict the change within a day better than no effect does: by this factor in the
# sum of absolute deviations. In a room at 70 degrees north without a turned camera the factors are
# 0.48 to 0.68. Chosen above them.
MOST_LEFT = 0.8
LEAST_DAYS = 3  # two days to learn from, one to confirm; chosen
_ROUNDS = 20  # of the robust fit; chosen
_MOST_FOLDS = 10  # parts of the days, each predicted from the others; chosen, limits the time
_STIFFNESS = 0.02  # of the effect, px^-2: keeps an azimuth without captures near 0; chosen
_NOISE_PX = 0.02  # least residual that counts as usual, the scatter of overcast hours; chosen


@dataclass(frozen=True, slots=True)
class DirectLight:
    """The direct light of n captures, [n] each.

    share: of direct in global horizontal irradiance, 0 to 1; azimuth_deg: of the sun, clockwise
    from north; day: local standard date.
    """

    share: Floats
    azimuth_deg: Floats
    day: NDArray[Any]

    @property
    def basis(self) -> Floats:
        """Smooth functions of the sun's azimuth, times the share of direct light, [n, 4]."""
        turn = np.radians(self.azimuth_deg)
        waves = [wave(k * turn) for k in (1, 2) for wave in (np.cos, np.sin)]
        return self.share[:, None] * np.stack(waves, axis=1)


def turns_by_light(angles_px: Array, light: DirectLight) -> Floats:
    """Return the part of seeming turns [n, 3] that the sun's azimuth explains, in pixels.

    angles_px: heading, tilt and roll of each capture [n, 3], in pixels. The median of each day is
    zero, so that only changes within a day are explained. An axis is zero unless days are predicted
    from the other ones.
    """
    out = np.zeros_like(angles_px)
    days, day = np.unique(light.day, return_inverse=True)
    if len(days) < LEAST_DAYS:
        return out
    basis, fold = light.basis, day % min(_MOST_FOLDS, len(days))
    for axis, values in enumerate(angles_px.T):
        rest = values.copy()
        for k in np.unique(fold):
            inside, others = fold == k, fold != k
            rest[inside] -= basis[inside] @ _effect(basis[others], values[others], day[others])
        if _scatter(rest, day) <= MOST_LEFT * _scatter(values, day):
            effect = basis @ _effect(basis, values, day)
            # the level of a day may be a turn: it is not touched
            out[:, axis] = effect - _day_medians(effect, day)
    return out


def _day_medians(values: Floats, day: NDArray[np.intp]) -> Floats:
    """Return the median of each value's day, [n]; day: its number [n]."""
    medians = [np.median(values[day == k]) for k in range(day.max() + 1)]
    return np.array(medians)[day]


def _scatter(values: Floats, day: NDArray[np.intp]) -> float:
    return float(np.abs(values - _day_medians(values, day)).sum())


def _effect(basis: Floats, values: Floats, day: NDArray[np.intp]) -> Floats:
    """Return the coefficients of `basis` [n, k] by a robust fit; each day has its own pose, [k].

    The poses are not unknowns of the fit: weighted means of each day are subtracted from both sides
    (Frisch and Waugh 1933), so that the time grows with the captures alone.
    """
    columns = np.column_stack((basis, values))
    weights, solution = np.ones(len(values)), np.zeros(basis.shape[1])
    for _ in range(_ROUNDS):
        total = np.bincount(day, weights)
        sums = np.stack([np.bincount(day, weights * c) for c in columns.T], axis=1)
        within = columns - (sums / np.maximum(total, 1e-9)[:, None])[day]
        design, target = within[:, :-1], within[:, -1]
        normal = design.T @ (weights[:, None] * design) + _STIFFNESS * np.eye(len(solution))
        solution = np.linalg.solve(normal, design.T @ (weights * target))
        rest = np.abs(target - design @ solution)
        usual = MAD_TO_SIGMA * float(np.median(rest)) + _NOISE_PX
        weights = 1.0 / np.maximum(1.0, rest / (1.5 * usual))  # Huber
    return solution
