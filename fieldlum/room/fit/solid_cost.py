"""Compute the cost of one solid in a scene that does not change otherwise."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.room.fit.evidence import SceneEvidence
from fieldlum.room.fit.guess import Guess, Solid
from fieldlum.room.fit.pose_prior import PosePrior
from fieldlum.room.fit.renderer import (
    BAR,
    LitEntries,
    RoomRays,
    camera_rays,
    ends_of,
    ends_on_solid,
    entries,
    lit_entries,
    shades,
)


@dataclass(slots=True)
class SolidCost:
    """Cost function (misfit plus prior) of guesses that differ only in their last solid.

    guess: the scene without that solid; albedo: of its surfaces [6 + solids]; prior: its prior's
    cost, as a solid adds none; pose: None, as no solid moves it. All but the solid is rendered
    once, which costs a fifth of `search.Objective`.
    """

    evidence: SceneEvidence
    guess: Guess  # without the solid
    albedo: Floats  # [6 + solids] of the guess
    prior: float  # of the guess: a solid has none
    pose: PosePrior | None = None  # the pose does not move with a solid
    _rays: RoomRays = field(init=False)
    _nearest: Floats32 = field(init=False)
    _position: Floats32 = field(init=False)
    _suns: Floats32 = field(init=False)
    _lit: LitEntries = field(init=False)
    _shine: Floats32 = field(init=False)
    _view_rays: RoomRays = field(init=False)
    _view_nearest: Floats32 = field(init=False)
    _kind: NDArray[np.int8] = field(init=False)
    _view_misfit: float = field(init=False)

    def __post_init__(self) -> None:
        self._rays = camera_rays(self.guess, self.evidence.rays, self.evidence.spread)
        ends, self._nearest = ends_of(self.guess, self._rays)
        self._position = ends.position_m
        self._suns = self.evidence.suns_room(self.guess)
        self._lit = lit_entries(self.guess, ends, self._suns)
        tone = self.albedo.astype(np.float32)[ends.surface]  # [r]
        self._shine = self._lit.strength * tone[self._lit.ray]
        view = self.evidence.view
        self._view_rays = camera_rays(self.guess, view.rays)
        _, self._view_nearest = ends_of(self.guess, self._view_rays)
        self._kind = view.kinds(self.guess)
        self._view_misfit = view.misfit_of(self._kind)

    @property
    def without(self) -> float:
        """The misfit of `guess`, without the solid; nothing is fitted again.

        It is the sum of those of sun patches and of the windows' picture, without the prior.
        """
        patches = self.evidence.misfit_of_lit(self._lit.hour, self._lit.ray, self._shine)
        return patches + self._view_misfit

    def _view(self, solid: Solid) -> float:
        """Return the misfit of the windows' picture with the solid before them."""
        rows, _, _ = entries(solid, self._view_rays, self._view_nearest)
        if (self._kind[rows] == BAR).all():
            return self._view_misfit
        kind = self._kind.copy()
        kind[rows] = BAR
        return self.evidence.view.misfit_of(kind)

    def __call__(self, guess: Guess) -> float:
        """Return the cost with the last solid of a guess."""
        solid = guess.solids[-1]
        rows, ends = ends_on_solid(solid, len(guess.solids) - 1, self._rays, self._nearest)
        lit = self._lit
        hidden = np.zeros(len(self._nearest), bool)
        hidden[rows] = True
        free = np.flatnonzero(~hidden[lit.ray])
        hour, ray, shine = lit.hour[free], lit.ray[free], self._shine[free]
        free = ~shades(solid, self._position, self._suns, hour, ray)
        own = lit_entries(guess, ends, self._suns)
        return (
            self.prior
            + self._view(solid)
            + self.evidence.misfit_of_lit(
                np.concatenate([hour[free], own.hour]),
                np.concatenate([ray[free], rows[own.ray]]),
                np.concatenate([shine[free], own.strength * np.float32(solid.albedo)]),
            )
        )
