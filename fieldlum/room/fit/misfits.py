"""Compare no sun patches, the stated box and the fitted scene on hours outside of the search."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.room.fit.evidence import SceneEvidence
from fieldlum.room.fit.guess import Guess
from fieldlum.room.fit.renderer import SHELL


@dataclass(frozen=True)
class Misfits:
    """Misfits (`SceneEvidence.misfit`) of n held-out hours [n], by geometry; days: local dates."""

    none: Floats
    stated: Floats
    fitted: Floats
    days: NDArray[np.datetime64]

    def mean(self) -> dict[str, float]:
        """Return the mean misfit over the hours: "none", "stated" and "fitted"."""
        return {name: float(getattr(self, name).mean()) for name in ("none", "stated", "fitted")}


def misfits_of(evidence: SceneEvidence, stated: Guess, fitted: Guess, albedo: Floats) -> Misfits:
    """Return the misfits in the hours of `evidence` with three geometries.

    They are no sun patch, the stated box and the fitted scene. albedo: of the fitted scene's west,
    east, south and north wall, floor, ceiling and solids [6 + solids]. The stated box gets albedos
    of its own from these hours.
    """
    of_fitted = evidence.patches(fitted, albedo)
    of_stated = evidence.patches(stated, evidence.albedos(stated, albedo[:SHELL]))
    return Misfits(
        evidence.misfit(np.zeros_like(of_fitted)),
        evidence.misfit(of_stated),
        evidence.misfit(of_fitted),
        evidence.days,
    )
