"""Choose the geometry for training, and its expected error: no patch, stated box, or fitted scene.

How much its sun patches count against a model without any is learnt from held-out days and seasons
(`fieldlum.learn.transport.MeanTransport`): captures seldom tell which is better under other suns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from fieldlum.core.arrays import Floats, Indices, Mask
from fieldlum.core.records import Progress, Room, quiet
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.scores import YearExpectation, expect, light_of_year
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.room.fit.scene_file import Chosen
from fieldlum.room.fit.sunny import sunny_hours

# Chosen: suns closer than this are one direction; neighbouring hours are 12 to 15 degrees apart.
BLOCK_DEG = 9.0
# Chosen: fewer clear hours or directions of the sun do not confirm a scene.
MIN_CLEAR_HOURS, MIN_DIRECTIONS = 18, 3
PIXELS = 250  # drawn by solid angle; measured: the ranking of three geometries is that with 500
# Chosen: a scene that leaves more than this share of the misfit without patches lacks something.
MAX_UNEXPLAINED = 0.5
MIN_TRUSTED_SHARE = 0.5  # chosen: of a year's hours; with less, most of the year is a guess


def sun_blocks(suns: Floats) -> Indices:
    """Return a block number from 0 for each sun, [n]; suns closer than BLOCK_DEG share one.

    suns: unit vectors [n, 3]. A chain of such neighbours is one block.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    near = suns @ suns.T > np.cos(np.radians(BLOCK_DEG))
    return connected_components(csr_matrix(near), directed=False)[1].astype(np.intp)


def doubt(data: Dataset, room: Room, hours: int) -> str:
    """Return why sunny hours cannot confirm a scene; empty if they can.

    They are too few, or have fewer than three different directions of the sun. hours: that the fit
    used.
    """
    sunny = sunny_hours(data, room)
    directions = len(np.unique(sun_blocks(data.light.sun_direction[sunny])))
    if directions < MIN_DIRECTIONS:
        return (
            f"{int(sunny.sum())} sunny hours with only {directions} different directions of the "
            f"sun; at least {MIN_DIRECTIONS} are needed to judge a scene: capture clear hours all "
            "over a day"
        )
    if hours < MIN_CLEAR_HOURS:
        return (
            f"only {hours} clear hours, too few to confirm the fitted scene; capture until there "
            f"are {MIN_CLEAR_HOURS}"
        )
    return ""


def choose_geometry(misfit: Mapping[str, float]) -> tuple[Chosen, str]:
    """Return the geometry of the smallest misfit, "none", "stated" or "fitted", and the reason.

    misfit: mean of `SceneEvidence.misfit` in the sunny hours, by geometry.
    """
    names: tuple[Chosen, ...] = ("none", "stated", "fitted")
    chosen = min(names, key=lambda name: misfit[name])
    each = ", ".join(f"{name} {misfit[name]:.3f}" for name in names)
    reason = f"{chosen}, by the misfit of sun patches in sunny hours ({each})"
    unexplained = misfit[chosen] / max(misfit["none"], 1e-9)
    if chosen != "none" and unexplained > MAX_UNEXPLAINED:
        reason += (
            f"; its sun patches leave {100.0 * unexplained:.0f} % of the misfit without patches: "
            "the room has something that the scene lacks (slats, leaves, a slope); see overlay.png"
        )
    return chosen, reason


def expected_year(data: Dataset, progress: Progress = quiet) -> YearExpectation:
    """Return what a transport model of captures with a scene expects of a year, at 250 pixels."""
    from fieldlum.learn.transport import fit

    rng = np.random.default_rng(0)
    data = replace(data, seen=_draw(data, rng))
    return expect(fit(data), data, light_of_year(data, rng), progress)


def _draw(data: Dataset, rng: np.random.Generator) -> Mask:
    """Return some of the seen pixels, drawn by solid angle, [H, W]."""
    chance = np.where(data.seen, equirect_solid_angles(*data.shape), 0.0).ravel()
    count = min(PIXELS, int((chance > 0.0).sum()))
    mask = np.zeros(chance.size, bool)
    mask[rng.choice(chance.size, count, replace=False, p=chance / chance.sum())] = True
    return mask.reshape(data.shape)
