"""Estimate the light that sun patches reflect onto other surfaces, after one reflection.

Near a patch it changes within decimetres. The smooth features of `light_below` do not follow it, so
without it walls near a patch look as if the sun reached them, and patches grow.
"""

from __future__ import annotations

import numpy as np

from fieldlum.arrays import Floats, Floats32, Indices
from fieldlum.models.data import Dataset
from fieldlum.scene_fit.evidence import SceneEvidence
from fieldlum.scene_fit.guess import Guess
from fieldlum.scene_fit.renderer import OUTSIDE, Surfaces, lit_entries, surfaces

Float32 = Floats32

# Chosen, for time: rays whose ends stand for the lit surfaces.
_SOURCES = 4000
# Chosen: share of a piece's area that is added to squared distances, so that a piece at a corner
# does not shine infinitely onto the other wall.
_SOFT_SHARE = 0.3
_GRAZING = 1e-3  # least cosine of a camera ray and a surface; chosen


def relit(
    evidence: SceneEvidence, data: Dataset, guess: Guess, albedo: Floats, *, reflects: bool
) -> SceneEvidence:
    """Return the evidence with the light below patches estimated again, with the guess's patches.

    data: all captures; albedo: as in `reflected_once`; reflects: include the light that patches
    reflect, which only a scene near the true one knows.
    """
    patch = evidence.patches(guess, albedo)
    reflected = reflected_once(evidence, guess, albedo) if reflects else np.zeros_like(patch)
    return evidence.relit(data, patch, reflected)


def reflected_once(evidence: SceneEvidence, guess: Guess, albedo: Floats) -> Floats:
    """Return the luminance of each hour's pixels by light that sun patches reflect, cd/m2 [n, m].

    Surfaces are matt (Lambert). Light that was reflected twice, and objects between patch and
    surface, are ignored. albedo: of west, east, south and north wall, floor, ceiling and solids
    [6 + solids].
    """
    count = len(evidence.pixels)
    rays = np.arange(0, len(evidence.rays), max(1, len(evidence.rays) // _SOURCES))
    share = evidence.weights[evidence.pixel[rays]]
    solid_angle_sr = (evidence.solid_angle_sr * share / share.sum()).astype(np.float32)  # [s]
    ends = surfaces(guess, evidence.rays[rays], evidence.spread)
    lit = lit_entries(guess, ends, evidence.suns_room(guess))
    sources, place = np.unique(lit.ray, return_inverse=True)
    tone = albedo.astype(np.float32)
    emitted = np.zeros((len(evidence), len(sources)), np.float32)  # per lx of the sun
    emitted[lit.hour, place] = lit.strength * tone[ends.surface[lit.ray]]
    area_m2 = _area_m2(guess, ends, sources, solid_angle_sr)
    first = np.zeros(count, np.intp)  # a ray of each pixel
    first[evidence.pixel] = np.arange(len(evidence.pixel))
    pixels = surfaces(guess, evidence.rays[first], evidence.spread)
    received = _received(ends, sources, area_m2, pixels)  # [m, s]
    shade = np.where(pixels.surface == OUTSIDE, np.float32(0.0), tone[pixels.surface])
    illuminance_lx = evidence.direct_lx[:, None] * (emitted @ received.T)  # [n, m]
    return illuminance_lx * shade / np.pi


def _area_m2(guess: Guess, ends: Surfaces, rows: Indices, solid_angle_sr: Float32) -> Float32:
    """Return the area that each of some rays stands for, in m2 [s]; rows: indices of the rays."""
    away = ends.position_m[rows] - np.array(guess.camera_m, np.float32)  # [s, 3]
    squared = np.sum(away**2, axis=1)
    across = np.abs(away[np.arange(len(rows)), ends.axis[rows]])
    cosine = np.maximum(across / np.sqrt(squared), np.float32(_GRAZING))
    return solid_angle_sr[rows] * squared / cosine


def _received(ends: Surfaces, rows: Indices, area_m2: Float32, pixels: Surfaces) -> Float32:
    """Return the illuminance at pixels by sources of 1 lm/m2, in lx [m, s].

    ends, rows: ray ends, and the indices of those that are sources; area_m2: of the sources [s].
    """
    source_m = ends.position_m[rows]
    offset = source_m[None, :, :] - pixels.position_m[:, None, :]  # [m, s, 3]
    squared = np.sum(offset**2, axis=2) + _SOFT_SHARE * area_m2
    leaving = -np.take_along_axis(offset, ends.axis[rows][None, :, None].astype(np.intp), axis=2)
    arriving = np.take_along_axis(offset, pixels.axis[:, None, None].astype(np.intp), axis=2)
    from_source = np.maximum(leaving[:, :, 0] * ends.sign[rows], 0.0)
    at_pixel = np.maximum(arriving[:, :, 0] * pixels.sign[:, None], 0.0)
    return from_source * at_pixel * area_m2 / (np.pi * squared**2)
