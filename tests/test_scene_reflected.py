"""Light that sun patches reflect onto other surfaces, as part of the light below the patches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_captures import ROOM, room_captures

from fieldlum.models.data import Dataset
from fieldlum.records import Site
from fieldlum.scene_fit.evidence import SceneEvidence, gather
from fieldlum.scene_fit.guess import guess_of
from fieldlum.scene_fit.parameters import stated_albedo
from fieldlum.scene_fit.reflected import reflected_once
from fieldlum.scene_fit.renderer import WEST, surfaces

SITE = Site("test room", 47.6, -122.3, "America/Los_Angeles")


@pytest.fixture(scope="module")
def data() -> Dataset:
    return room_captures(SITE, ROOM, 64, lambda light: light.total_lx[:, None, None] * 0.004)


@pytest.fixture(scope="module")
def evidence(data: Dataset) -> SceneEvidence:
    return gather(data, ROOM, pixels=4000)


@pytest.mark.analytic
def test_walls_receive_the_light_that_patches_emit(evidence: SceneEvidence) -> None:
    """In a box all light of a patch reaches other surfaces, or leaves by the window."""
    guess, albedo = guess_of(ROOM), stated_albedo(ROOM)
    ends = surfaces(guess, evidence.rays, evidence.spread)
    first = np.zeros(len(evidence.pixels), int)
    first[evidence.pixel] = np.arange(len(evidence.pixel))
    away = ends.position_m[first] - np.array(guess.camera_m)
    squared = np.sum(away**2, axis=1)
    cosine = np.abs(away[np.arange(len(first)), ends.axis[first]]) / np.sqrt(squared)
    share = evidence.weights / evidence.weights.sum()
    area_m2 = evidence.solid_angle_sr * share * squared / cosine  # [m] that pixels stand for
    inside = ends.surface[first] >= 0
    tone = np.where(inside, albedo[ends.surface[first]], 1.0)
    emitted_lm = np.pi * (evidence.patches(guess, albedo) @ area_m2)
    lit_lx = np.pi * reflected_once(evidence, guess, albedo) / tone  # [n, m]
    received_lm = (lit_lx * inside) @ area_m2
    bright = emitted_lm > 0.2 * emitted_lm.max()
    ratio = received_lm[bright] / emitted_lm[bright]
    assert bright.sum() >= 10
    assert 0.75 < np.median(ratio) < 1.1


@pytest.mark.analytic
def test_a_wall_is_lit_by_the_floor_and_not_by_itself(evidence: SceneEvidence) -> None:
    guess, albedo = guess_of(ROOM), stated_albedo(ROOM)
    ends = surfaces(guess, evidence.rays, evidence.spread)
    first = np.zeros(len(evidence.pixels), int)
    first[evidence.pixel] = np.arange(len(evidence.pixel))
    west = ends.surface[first] == WEST
    black = albedo.copy()
    black[WEST] = 0.0  # neither shows nor reflects light
    assert not reflected_once(evidence, guess, black)[:, west].any()
    only_west = np.zeros_like(albedo)
    only_west[WEST] = 0.5
    assert not reflected_once(evidence, guess, only_west).any()
    assert reflected_once(evidence, guess, albedo)[:, west].max() > 1.0


@pytest.mark.analytic
def test_the_light_below_has_what_patches_reflect(data: Dataset, evidence: SceneEvidence) -> None:
    """Captures with reflected light: the light below is found if the scene is known."""
    guess, albedo = guess_of(ROOM), stated_albedo(ROOM)
    patch = evidence.patches(guess, albedo)
    reflected = reflected_once(evidence, guess, albedo)
    luminance = data.luminance_cdm2.reshape(len(data), -1).copy()
    luminance[np.ix_(evidence.rows, evidence.pixels)] += reflected.astype(np.float32)
    lit = replace(data, luminance_cdm2=luminance.reshape(data.luminance_cdm2.shape))
    true = luminance[np.ix_(evidence.rows, evidence.pixels)] - patch
    near = (patch == 0.0) & (reflected > 0.3 * true)
    assert near.sum() > 50
    unaware = evidence.relit(lit, patch, np.zeros_like(patch)).below
    aware = evidence.relit(lit, patch, reflected).below
    off = [np.abs(np.log(below[near] / true[near])).mean() for below in (unaware, aware)]
    assert off[1] < 0.5 * off[0]
