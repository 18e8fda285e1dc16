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

from fieldlum.arrays import Array, Floats
from fieldlum.statistics import MAD_TO_SIGMA

# Other days must predict the change within a day better than no effect does: by this factor in the
# sum of absolute deviations. In a room at 70 degrees north without a turned camera the factors are
# 0.48 to 0.68. Chosen above them.
MOST_LEFT = 0.8
LEAST_DAYS = 3  # two days to learn from, one to confirm; chosen
_ROUNDS = 20  # of the robust fit; chosen
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
    days = np.unique(light.day)
    if len(days) < LEAST_DAYS:
        return out
    basis = light.basis
    for axis, values in enumerate(angles_px.T):
        before = after = 0.0
        for day in days:
            inside = light.day == day
            effect = _effect(basis[~inside], values[~inside], light.day[~inside])
            before += _scatter(values[inside])
            after += _scatter(values[inside] - basis[inside] @ effect)
        if after <= MOST_LEFT * before:
            out[:, axis] = basis @ _effect(basis, values, light.day)
            for day in days:  # the level of a day may be a turn: it is not touched
                inside = light.day == day
                out[inside, axis] -= np.median(out[inside, axis])
    return out


def _scatter(values: Floats) -> float:
    return float(np.abs(values - np.median(values)).sum())


def _effect(basis: Floats, values: Floats, day: NDArray[Any]) -> Floats:
    """Return the coefficients of `basis` [n, k] by a robust fit; each day has its own pose, [k]."""
    design = np.hstack([basis, (day[:, None] == np.unique(day)).astype(float)])
    stiffness = np.zeros(design.shape[1])
    stiffness[: basis.shape[1]] = _STIFFNESS
    penalty = np.diag(stiffness + 1e-9)
    weights = np.ones(len(values))
    solution = np.zeros(design.shape[1])
    for _ in range(_ROUNDS):
        normal = design.T @ (weights[:, None] * design) + penalty
        solution = np.linalg.solve(normal, design.T @ (weights * values))
        rest = np.abs(values - design @ solution)
        usual = MAD_TO_SIGMA * float(np.median(rest)) + _NOISE_PX
        weights = 1.0 / np.maximum(1.0, rest / (1.5 * usual))  # Huber
    return solution[: basis.shape[1]]
