"""Choose the geometry for training, and its expected error: no patch, stated box, or fitted scene.

Hours that no search used choose between stated box and fitted scene, by the misfit of their sun
patches. Whether patches are used at all, the expected error of a trained model decides too: it
weighs patches that are centimetres off, so that these do less harm than their misfit states.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Floats, Indices, Mask
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Progress, Room, quiet
from fieldlum.learn.models import Patch
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.scores import Predictor, expect, light_of_year
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.room.fit.sunny import sunny_hours

# Chosen: suns closer than this leave together; neighbouring hours are 12 to 15 degrees apart.
BLOCK_DEG = 9.0
OUTSIDE_EVERY = 3  # chosen: a third of the sun's directions is outside the search
PIXELS = 250  # drawn by solid angle; measured: the ranking of three geometries is that with 500
# Largest expected error, or misfit, of a richer geometry over that of a simpler one. Chosen: the
# expected errors of one geometry differ by about 5 % with the drawn pixels and hours, the mean
# misfit of ten hours by about 10 %.
_WORTH, _WORTH_MISFIT = 0.95, 0.9
# Largest misfit of a richer geometry, over that of a simpler one, that needs no smaller expected
# error as well: in five rooms of other renderers a good fit had 0.22 to 0.58, in one where the
# box predicted better 0.84 (docs/validation.md).
_CLEAR_MISFIT = 0.67
# Chosen: a scene that leaves more than this share of the misfit without patches lacks something.
MAX_UNEXPLAINED = 0.5
MIN_TRUSTED_SHARE = 0.5  # chosen: of a year's hours; with less, most of the year is a guess


FitTransport = Callable[["Dataset", "Patch"], Predictor]


@dataclass(frozen=True, slots=True)
class GeometryCandidate:
    """A geometry to compare.

    data: captures with its heading, sun, room and sun patches (None: no patch). misfit: mean of
    `SceneEvidence.misfit`, 0 to 1, in the hours held out of the search (NaN: unknown).
    """

    name: str
    data: Dataset
    misfit: float = float("nan")


@dataclass(frozen=True, slots=True)
class GeometryScore:
    """How well a geometry predicts: errors expected in a year, and misfit of its sun patches.

    expected_log10_mse: NaN if unknown. misfit: mean of `SceneEvidence.misfit`, 0 to 1, in the hours
    held out of the search. trusted_share: of a year's hours, those that the model trusts.
    """

    name: str
    expected_log10_mse: float
    misfit: float
    trusted_share: float = 1.0


@dataclass(frozen=True, slots=True)
class SceneVerdict:
    """The chosen geometry and why it was chosen.

    trusted: whether the model trusts at least half of a year's hours. scores: of all candidates,
    simplest first.
    """

    chosen: str
    expected_log10_mse: float
    trusted: bool
    reason: str
    scores: tuple[GeometryScore, ...]
    trusted_share: float = 1.0


def sun_blocks(suns: Floats) -> Indices:
    """Return a block number from 0 for each sun, [n]; suns closer than BLOCK_DEG share one.

    suns: unit vectors [n, 3]. A chain of such neighbours is one block.
    """
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import connected_components

    near = suns @ suns.T > np.cos(np.radians(BLOCK_DEG))
    return connected_components(csr_matrix(near), directed=False)[1].astype(np.intp)


def outside_hours(data: Dataset, room: Room | None) -> Mask:
    """Return a mask [n], True for hours to hold out: sunny, in every third block of sun directions.

    Sunny is as in `sunny_hours`; a block (`sun_blocks`) has suns within 9 degrees of each other or
    in a chain. Raises NotEnoughDataError for fewer blocks than three.
    """
    sunny = sunny_hours(data, room)
    blocks = sun_blocks(data.light.sun_direction[sunny])
    count = int(blocks.max(initial=-1)) + 1
    if count < OUTSIDE_EVERY:
        raise NotEnoughDataError(
            f"{int(sunny.sum())} sunny hours with only {count} different directions of the sun; at "
            f"least {OUTSIDE_EVERY} are needed to judge a scene: capture clear hours all over a day"
        )
    outside = np.zeros(len(data), bool)
    outside[sunny] = blocks % OUTSIDE_EVERY == OUTSIDE_EVERY - 1
    return outside


def judge(
    candidates: Sequence[GeometryCandidate],
    fit: FitTransport,
    *,
    progress: Progress = quiet,
) -> SceneVerdict:
    """Choose among candidates of the same hours, as `choose_geometry`; simplest candidate first.

    fit: returns a transport model of captures with patch mode "absolute" or "none"; 250 pixels and
    drawn hours of a year give the expected errors. Raises NotEnoughDataError if the
    sunny hours have fewer than three blocks of sun directions (`outside_hours`).
    """
    first = candidates[0].data
    room = next((c.data.setup.room for c in candidates if c.data.setup.room is not None), None)
    outside_hours(first, room)  # raises NotEnoughDataError for too few directions
    rng = np.random.default_rng(0)
    pixels, light = _draw(first, rng), light_of_year(first, rng)
    scores = []
    for k, candidate in enumerate(candidates):
        progress(k, len(candidates), f"scene: judging {candidate.name}")
        data = replace(candidate.data, seen=pixels)
        mode: Patch = "none" if data.patch_cdm2 is None else "absolute"
        year = expect(fit(data, mode), data, light)
        scores.append(
            GeometryScore(
                candidate.name, year.expected_log10_mse, candidate.misfit, year.trusted_share
            )
        )
    progress(len(candidates), len(candidates), "")
    return choose_geometry(scores)


def _draw(data: Dataset, rng: np.random.Generator) -> Mask:
    """Return some of the seen pixels, drawn by solid angle, [H, W]."""
    chance = np.where(data.seen, equirect_solid_angles(*data.shape), 0.0).ravel()
    count = min(PIXELS, int((chance > 0.0).sum()))
    mask = np.zeros(chance.size, bool)
    mask[rng.choice(chance.size, count, replace=False, p=chance / chance.sum())] = True
    return mask.reshape(data.shape)


def choose_geometry(scores: Sequence[GeometryScore]) -> SceneVerdict:
    """Return the geometry that the captures support; scores are simplest first.

    Of the geometries with patches, the first counts that no later one undercuts: by a third of its
    misfit, or by 10 % with an expected error that is no larger. It is preferred to no patch if its
    expected error is over 5 % smaller, or its misfit by 10 %. The choice is not trusted if the
    model trusts less than half of a year's hours.
    """
    chosen = scores[0]
    if len(scores) > 1:
        best = scores[1]
        for score in scores[2:]:
            fewer = score.expected_log10_mse <= best.expected_log10_mse
            most = _WORTH_MISFIT if fewer else _CLEAR_MISFIT
            best = score if score.misfit < most * best.misfit else best
        promises = best.expected_log10_mse < _WORTH * chosen.expected_log10_mse
        chosen = best if promises or best.misfit < _WORTH_MISFIT * chosen.misfit else chosen
    errors = ", ".join(f"{s.name} {s.expected_log10_mse:.1e}" for s in scores)
    misfits = ", ".join(f"{s.name} {s.misfit:.3f}" for s in scores)
    reason = f"{chosen.name}, by misfits of sun patches in hours kept out of the search ({misfits})"
    if np.isfinite(chosen.expected_log10_mse):
        reason += (
            f" and expected log10 MSE ({errors}); the model trusts "
            f"{100.0 * chosen.trusted_share:.0f} % of a year's hours"
        )
    unexplained = chosen.misfit / max(scores[0].misfit, 1e-9)
    if chosen is not scores[0] and unexplained > MAX_UNEXPLAINED:
        reason += (
            f"; its sun patches leave {100.0 * unexplained:.0f} % of the misfit without patches: "
            "the room has something that the scene lacks (slats, leaves, a slope); see overlay.png"
        )
    return SceneVerdict(
        chosen.name,
        chosen.expected_log10_mse,
        chosen.trusted_share >= MIN_TRUSTED_SHARE,
        reason,
        tuple(scores),
        chosen.trusted_share,
    )
