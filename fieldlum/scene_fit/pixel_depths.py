"""Propose furniture where the light on single pixels fits a nearer surface better.

Pixels that are close together in plan give a box on the floor or a table top of any height.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import label

from fieldlum.arrays import Floats, Indices, Mask
from fieldlum.scene_fit.evidence import SceneEvidence
from fieldlum.scene_fit.furniture import TABLE_TOP_M
from fieldlum.scene_fit.guess import Guess, Solid
from fieldlum.scene_fit.renderer import OUTSIDE, Surfaces, lit_entries, surfaces

# From the study of the office and one more room (docs/scene.md): depths and albedos tried for each
# pixel; gain in a pixel's misfit that exceeds noise; cells of the plan in which pixels are grouped;
# numbers of cells and boxes that are enough; smallest box.
DEPTHS = 40
NEAREST_M = 0.3
ALBEDOS = (0.1, 0.2, 0.35, 0.5, 0.7)
MIN_PIXEL_GAIN = 0.02
CELL_M = 0.15
MIN_CELLS = 2
MAX_PROPOSALS = 12
MIN_SIZE_M = 0.08
# Chosen, not measured: the sun passes below the top of a table with thin legs.
MIN_TABLE_M = 0.35

# The faces that a pixel can see: axis and sign of the normal.
FACES = ((2, 1.0), (0, 1.0), (0, -1.0), (1, 1.0), (1, -1.0))


@dataclass(frozen=True)
class PixelDepths:
    """The surface, nearer than the guess's, that explains the light of each of m pixels best.

    position_m: in room axes [m, 3]; face: index in `FACES` (axis and sign of the normal) [m];
    albedo [m]; gain: decrease of the pixel's mean loss (0 to 1) over the hours [m]. Where no nearer
    surface is better, the gain is 0 and the position is that of the guess.
    """

    position_m: Floats
    face: Indices
    albedo: Floats
    gain: Floats


def pixel_depths(evidence: SceneEvidence, guess: Guess, albedo: Floats) -> PixelDepths:
    """Find for each pixel the nearer surface that explains its sunlit and dark hours best.

    40 depths along the ray, 5 faces and 5 albedos are tried for each pixel separately. If one is
    better than the guess, an object is missing in the guess. albedo: of west, east, south and north
    wall, floor, ceiling and solids [6 + solids].
    """
    order = np.argsort(evidence.pixel, kind="stable")
    first = np.searchsorted(evidence.pixel[order], range(len(evidence.pixels)))
    rays = evidence.rays[order[first + evidence.sub**2 // 2]]
    ends = surfaces(guess, rays)
    stated = _loss(evidence, evidence.patches(guess, albedo))  # [m]
    pixels = len(rays)
    position, face = ends.position_m.astype(float), np.zeros(pixels, np.intp)
    tone, gain = np.full(pixels, 0.35), np.zeros(pixels)
    # No depth can gain more than the pixel's own loss.
    open_ = np.flatnonzero(stated > MIN_PIXEL_GAIN)
    few = evidence.at_pixels(open_)
    suns = evidence.suns_room(guess)
    eye = np.array(guess.camera_m, np.float32)
    full_m = np.linalg.norm(ends.position_m[open_] - eye, axis=1)  # [o]
    room_rays = (ends.position_m[open_] - eye) / np.maximum(full_m, 1e-6)[:, None]
    spread_m = np.full(len(open_), 1e-9, np.float32)  # a point of the pixel
    dark = few.dark_loss.ravel()
    least = stated[open_] - few.dark_loss.mean(axis=0)  # [o] what removing the patch would gain
    for share in np.linspace(0.0, 1.0, DEPTHS + 1)[:-1]:
        depth = NEAREST_M + share * np.maximum(full_m - NEAREST_M, 0.0)
        at = (eye + room_rays * depth[:, None]).astype(np.float32)
        for number, (axis, sign) in enumerate(FACES):
            sees = -sign * room_rays[:, axis] > 0.02  # the face looks at the camera
            if not sees.any():
                continue
            point = Surfaces(
                at,
                np.full(len(at), axis, np.int8),
                np.full(len(at), sign, np.float32),
                np.where(sees, 0, OUTSIDE).astype(np.int16),
                spread_m,
            )
            lit = lit_entries(guess, point, suns)
            entry = lit.hour * len(at) + lit.ray
            luminance = evidence.direct_lx[lit.hour] * lit.strength / np.pi
            for value in ALBEDOS:
                better = dark[entry] - few.loss(entry, value * luminance)
                trial = least + np.bincount(lit.ray, better, len(at)) / len(evidence)
                take = sees & (trial > gain[open_])
                rows = open_[take]
                position[rows], face[rows] = at[take], number
                tone[rows], gain[rows] = value, trial[take]
    return PixelDepths(position, face, tone, gain)


def _loss(evidence: SceneEvidence, patch: Floats) -> Floats:
    """Return the mean misfit over the hours, for each pixel [m]."""
    lit = np.flatnonzero(patch)
    loss = evidence.dark_loss.copy()
    loss.ravel()[lit] = evidence.loss(lit, patch.ravel()[lit])
    return loss.mean(axis=0)


def clustered_solids(depths: PixelDepths, guess: Guess) -> list[Solid]:
    """Return at most 12 boxes on the floor or table tops, roughly in order of decreasing gain.

    A box is proposed where pixels that a nearer surface explains better (`depths`) are close
    together in plan. The list is empty if there are none.
    """
    use = depths.gain > MIN_PIXEL_GAIN
    inside = (depths.position_m[:, 2] > 0.1) & (depths.position_m[:, 2] < guess.size_m[2] - 0.1)
    use &= inside
    if not use.any():
        return []
    proposals: list[tuple[float, Solid]] = []
    tops = use & (depths.face == 0)
    sides = use & (depths.face != 0)
    for group in (tops, sides, use):
        proposals += _clusters(depths, group, guess)
    proposals.sort(key=lambda pair: -pair[0])
    return _distinct([solid for _, solid in proposals])[:MAX_PROPOSALS]


def _clusters(depths: PixelDepths, group: Mask, guess: Guess) -> list[tuple[float, Solid]]:
    rows = np.flatnonzero(group)
    if not len(rows):
        return []
    cells = np.floor(depths.position_m[rows, :2] / CELL_M).astype(int)
    low = cells.min(axis=0)
    grid = np.zeros(cells.max(axis=0) - low + 1)
    np.add.at(grid, tuple((cells - low).T), depths.gain[rows])
    labelled: Any = label(grid > 2.0 * MIN_PIXEL_GAIN, np.ones((3, 3)))
    names, count = labelled
    of = names[tuple((cells - low).T)]
    proposals: list[tuple[float, Solid]] = []
    for number in range(1, count + 1):
        member = rows[of == number]
        if (names == number).sum() < MIN_CELLS or len(member) < 5:
            continue
        points = depths.position_m[member]
        x0, y0 = np.quantile(points[:, :2], 0.05, axis=0)
        x1, y1 = np.quantile(points[:, :2], 0.95, axis=0)
        flat = member[depths.face[member] == 0]
        heights = depths.position_m[flat, 2] if len(flat) else points[:, 2]
        top = float(np.median(heights)) if len(flat) else float(np.quantile(heights, 0.95))
        albedo = float(np.median(depths.albedo[member]))
        x0, x1 = _at_least(x0, x1)
        y0, y1 = _at_least(y0, y1)
        camera = guess.camera_m
        if x0 < camera[0] < x1 and y0 < camera[1] < y1 and top > camera[2] - 0.2:
            continue
        gain = float(depths.gain[member].sum())
        top = max(top, MIN_SIZE_M)
        proposals.append((gain, Solid((x0, y0, 0.0), (x1, y1, top), albedo)))
        if len(flat) and top > MIN_TABLE_M:
            slab = Solid((x0, y0, top - TABLE_TOP_M), (x1, y1, top), albedo)
            proposals.append((0.9 * gain, slab))
        if depths.gain[member].size > 10:
            tall = Solid((x0, y0, 0.0), (x1, y1, guess.size_m[2]), albedo)
            proposals.append((0.5 * gain, tall))
    return proposals


def _at_least(low: float, high: float) -> tuple[float, float]:
    lacking = max(MIN_SIZE_M - (high - low), 0.0) / 2.0
    return float(low) - lacking, float(high) + lacking


def _distinct(solids: Sequence[Solid]) -> list[Solid]:
    kept: list[Solid] = []
    for solid in solids:
        corners = np.array(solid.low_m + solid.high_m)
        near = (np.abs(corners - np.array(k.low_m + k.high_m)).max() < 0.1 for k in kept)
        if not any(near):
            kept.append(solid)
    return kept
