"""What held-out days decide: the kernel, what it looks at, noise, robust rounds, patches, how
many features.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.light import Features, Kernel
from fieldlum.models import Patch
from fieldlum.models.transport.pixel_fit import (
    RANK,
    Basis,
    HeldOutFit,
    Recipe,
    basis_of,
    choose,
    day_standard_error,
    hold_out,
    leading,
    one_season,
)
from fieldlum.models.transport.training_arrays import Material

Array = NDArray[Any]

NOISES = (1e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1)
ONE_SEASON_NOISE = (
    3e-3  # held-out days of one season know nothing of the others: take no less noise than this
)
CHOOSING = 250  # pixels that choose kernel and recipe
BESIDE_ROOM = (
    0.3  # weight of the facade term beside a room model, which knows when the sun is hidden
)
SECOND_WIDTHS = (
    0.1,
    0.15,
    0.2,
)  # chord of the sun's direction within which a sun patch was still the same
FEWER = (40, 60)  # numbers of features tried before RANK of them; under forty captures all are kept
FEWER_COST = 1.05  # of the held-out error of RANK features: what fewer may cost


def _below(one_season: bool, *, patches: bool = False) -> list[Recipe]:
    """Light found below all patches; days of one season, with the sun where it stood, would
    choose any width.
    """
    widths = SECOND_WIDTHS[:1] if one_season else SECOND_WIDTHS
    return [
        Recipe(s, rounds=4, second=w, below=patches) for s in (1e-2, 3e-2, 1e-1) for w in widths
    ]


def recipes_for(patch: Patch, one_season: bool) -> list[Recipe]:
    """What held-out days choose among, plainest first."""
    noises = [s for s in NOISES if not one_season or s >= ONE_SEASON_NOISE]
    if patch == "none":
        return _below(one_season)
    variance = 0.0625 if patch == "gain" else 0.0025
    plain = [Recipe(s, variance, rounds=1 if patch == "gain" else 0) for s in noises]
    robust = [Recipe(s, 0.0625, rounds=3, second=0.15) for s in (1e-2, 3e-2)]
    return plain + robust


@dataclass(frozen=True, slots=True)
class SelectedRecipe:
    """What held-out days chose: the kernel, what it looks at, the recipe; table of all that was
    tried.
    """

    kernel: Kernel
    features: Features
    covariance: Array
    basis: Basis
    recipe: Recipe
    held: HeldOutFit
    table: list[tuple[Recipe, float, float]]


def choose_model(
    drawn: Material, kernel: Kernel, patch: Patch, bounced: NDArray[np.float32] | None
) -> SelectedRecipe:
    """What serves held-out days best, asked of the pixels `drawn`; bounced: what a room model
    makes of the sun.
    """
    alike = one_season(drawn.days)
    chosen = _choose_kernel(drawn, kernel, recipes_for(patch, alike), bounced)
    if patch != "none" and chosen.recipe.second:
        chosen = _doubted(drawn, kernel, alike, bounced, chosen)
    # Days of one season do not know what others need; errors of unknown patches hide what fewer
    # features cost.
    return chosen if alike or chosen.recipe.second else fewest_features(drawn, chosen)


def _choose_kernel(
    drawn: Material, kernel: Kernel, recipes: list[Recipe], bounced: NDArray[np.float32] | None
) -> SelectedRecipe:
    """The kernel and recipe that serve held-out days best, asked of some pixels.

    A room model (its features `bounced`) speaks for suns that no capture had, held-out days do not:
    it stays unless it makes them worse by more than a standard error. Beside it the facade term
    counts less.
    """

    def tried(kernel: Kernel, features: Features) -> SelectedRecipe:
        covariance = kernel(features, features)
        basis = basis_of(covariance, RANK)
        recipe, table = choose(drawn[slice(CHOOSING)], basis, recipes)
        return SelectedRecipe(
            kernel, features, covariance, basis, recipe, hold_out(drawn, basis, recipe), table
        )

    without = tried(kernel, drawn.features)
    if bounced is None:
        return without
    with_room = tried(replace(kernel, facade=BESIDE_ROOM), replace(drawn.features, bounced=bounced))
    worse = with_room.held.judged - without.held.judged
    kept = with_room if worse.mean() <= day_standard_error(worse, drawn.days) else without
    return replace(kept, table=[*without.table, *with_room.table])


def _doubted(
    drawn: Material,
    kernel: Kernel,
    one_season: bool,
    bounced: NDArray[np.float32] | None,
    trusting: SelectedRecipe,
) -> SelectedRecipe:
    """Where held-out days had to mend patches, they are asked too whether the light is better
    learnt without them.
    """
    bare = replace(drawn, features=replace(drawn.features, flux=None, cells=None))
    doubting = _choose_kernel(bare, kernel, _below(one_season, patches=True), bounced)
    best = doubting if doubting.held.judged.mean() < trusting.held.judged.mean() else trusting
    return replace(best, table=[*trusting.table, *doubting.table])


def fewest_features(drawn: Material, chosen: SelectedRecipe) -> SelectedRecipe:
    """No more features than held-out days ask for: the first of FEWER that costs at most 5 % of the
    error of them all.

    What is noisy (pixels, irradiance, a sky that is not Perez's) supports fewer than a clean
    rendering does, and a smaller model is quicker everywhere.
    """
    drawn, table = replace(drawn, features=chosen.features), [*chosen.table]
    for rank in (r for r in FEWER if r < chosen.basis.values.shape[1]):
        recipe, basis = replace(chosen.recipe, rank=rank), leading(chosen.basis, rank)
        held = hold_out(drawn, basis, recipe)
        mean = float(held.judged.mean())
        table.append((recipe, mean, day_standard_error(held.judged, drawn.days)))
        if mean <= FEWER_COST * chosen.held.judged.mean():
            return replace(chosen, recipe=recipe, basis=basis, held=held, table=table)
    return replace(chosen, table=table)
