"""Estimate the light that sun patches reflect onto other surfaces, after one reflection.

Near a patch it changes within decimetres. The smooth features of `light_below` do not follow it, so
without it walls near a patch look as if the sun reached them, and patches grow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fieldlum.arrays import Floats, Floats32, Indices
from fieldlum.compiled import compiled
from fieldlum.models.data import Dataset
from fieldlum.scene_fit.evidence import SceneEvidence
from fieldlum.scene_fit.guess import Guess
from fieldlum.scene_fit.renderer import OUTSIDE, Surfaces, lit_entries, surfaces

Float32 = Floats32

# Chosen, for time: rays whose ends stand for the lit surfaces.
_SOURCES = 4000
# Chosen: share of a piece's area that is added to squared distances, so that a piece at a corner
# does not shine infinitely onto the other wall.
_SOFT_SHARE = np.float32(0.3)
_ZERO, _PI = np.float32(0.0), np.float32(np.pi)
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
    return _received_pairs(
        ends.position_m[rows], ends.axis[rows], ends.sign[rows], area_m2,
        pixels.position_m, pixels.axis, pixels.sign,
    )  # fmt: skip


@compiled
def _received_pairs(
    source_m: Float32, source_axis: NDArray[np.int8], source_sign: Float32, area_m2: Float32,
    pixel_m: Float32, pixel_axis: NDArray[np.int8], pixel_sign: Float32,
) -> Float32:  # fmt: skip
    """Return `_received` from places, axes of normals and their signs."""
    received = np.zeros((len(pixel_m), len(source_m)), np.float32)
    for pixel in range(len(pixel_m)):
        for source in range(len(source_m)):
            x = source_m[source, 0] - pixel_m[pixel, 0]
            y = source_m[source, 1] - pixel_m[pixel, 1]
            z = source_m[source, 2] - pixel_m[pixel, 2]
            axis, other = source_axis[source], pixel_axis[pixel]
            along = x if axis == 0 else y if axis == 1 else z
            across = x if other == 0 else y if other == 1 else z
            leaves, arrives = -along * source_sign[source], across * pixel_sign[pixel]
            if leaves > _ZERO and arrives > _ZERO:
                squared = x * x + y * y + z * z + _SOFT_SHARE * area_m2[source]
                received[pixel, source] = (
                    leaves * arrives * area_m2[source] / (_PI * squared * squared)
                )
    return received
