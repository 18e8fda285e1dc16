"""Choose by held-out days: kernel, its inputs, noise, robust rounds, patches, and features."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Array, Floats32
from fieldlum.learn.models import held_out_choice
from fieldlum.learn.models.held_out_choice import HeldOutErrors
from fieldlum.learn.transport.computed_light import ComputedLight
from fieldlum.learn.transport.features import (
    USUAL,
    StateColumns,
    TrainingArrays,
)
from fieldlum.learn.transport.held_out import FirstStage, HeldOutFit, hold_out, hold_out_first
from fieldlum.learn.transport.pixel_fit import RANK, Basis, Recipe, basis_of, leading
from fieldlum.learn.transport.seasons import one_season
from fieldlum.learn.transport.window_sky import SeenSky, SkyField
from fieldlum.sky.light import Features, Kernel

NOISES = (
    1e-4,
    1e-3,
    3e-3,
    1e-2,
    3e-2,
    1e-1,
)  # noises from that of a clean rendering to that of a room that changes; not measured
# Least noise for captures of one season, because their held-out days do not test other seasons.
# Chosen.
ONE_SEASON_NOISE = 3e-3
CHOOSING = 250  # number of pixels that choose kernel and recipe; chosen, limits the time
# Weight of the facade term if there is a room model, which knows when the sun is hidden. Chosen.
BESIDE_ROOM = 0.3
# Largest chords between two sun directions with the same sun patch, to be tried. Chosen.
SECOND_WIDTHS = (0.1, 0.15, 0.2)
LAMP_NOISES = (1e-3, 1e-2)  # noises to be tried with a lamp that is always on; chosen
SKY_NOISES = (1e-3, 1e-2, 1e-1)  # noises to be tried with the skies that windows showed; chosen
SKY_DAYS = 4  # fewer days do not show that other skies teach more; chosen
# share of the held-out error that skies seen through windows must explain; not measured
SKY_GAIN = 0.1
LAMP_GAIN = 0.3  # share of the held-out error that a constant lamp must explain; not measured
PATCH_GAIN_VARIANCE = 0.0025  # prior variance of a pixel's patch gain
# numbers of features to try before RANK of them; with under forty captures all are used; chosen
FEWER = (40, 60)
# largest ratio of held-out errors, of fewer features to RANK of them; not measured
FEWER_COST = 1.05


def choose(
    arrays: TrainingArrays, basis: Basis, recipes: list[Recipe]
) -> tuple[Recipe, list[tuple[Recipe, float, float]]]:
    """Return the recipe that `held_out_choice` prefers on held-out days, and a table of all.

    A row of the table: recipe, weighted mean squared log10 error, its standard error over days (0
    with one day).
    """
    tried, firsts = list[HeldOutErrors](), dict[Recipe, FirstStage]()
    for recipe in recipes:
        alone = replace(recipe, second=0.0)
        if alone not in firsts:
            firsts[alone] = hold_out_first(arrays, basis, recipe)
        tried.append(hold_out(arrays, basis, recipe, firsts[alone]).errors)
    table = [_row(recipe, errors) for recipe, errors in zip(recipes, tried, strict=True)]
    return recipes[held_out_choice.choose(tried).best], table


def _row(recipe: Recipe, errors: HeldOutErrors) -> tuple[Recipe, float, float]:
    return recipe, errors.figure("log10"), errors.standard_error("log10")


def _better(*candidates: SelectedRecipe) -> SelectedRecipe:
    """Return the candidate with the smallest error on held-out days, as `held_out_choice` ranks."""
    return candidates[held_out_choice.choose([c.held.errors for c in candidates]).best]


def _no_worse(one: HeldOutErrors, other: HeldOutErrors) -> bool:
    """Return whether `one` is not clearly worse than `other` on held-out days."""
    choice = held_out_choice.choose([other, one])
    return choice.best == 1 or choice.by is None


def _much_better(
    one: HeldOutErrors, other: HeldOutErrors, share: float, times: float = 1.0
) -> bool:
    """Return whether the log10 MSE of `one` is smaller by a share of that of `other`.

    The difference must also be larger than `times` standard errors.
    """
    gain, error = held_out_choice.difference(other, one, "log10")
    return bool(gain > max(share * other.figure("log10"), times * error))


# ----------------------------------------------------------------------------------------------
# choices


def _below(one_season: bool, *, patches: bool = False) -> list[Recipe]:
    """Return recipes that find the light without using the patches.

    For one season there is a single width: all its days have the sun at nearly the same places, and
    would accept any width.
    """
    widths = SECOND_WIDTHS[:1] if one_season else SECOND_WIDTHS
    return [
        Recipe(s, rounds=4, second=w, below=patches) for s in (1e-2, 3e-2, 1e-1) for w in widths
    ]


def recipes_for(
    with_patch: bool, one_season: bool, *, fitted_patches: bool = False
) -> list[Recipe]:
    """Return the recipes among which held-out days choose, simplest first.

    with_patch: whether sun patches are used; one_season: whether all captures are from one season,
    which excludes the smallest noises; fitted_patches: whether the patches are from a fitted room,
    which excludes all recipes that are not robust: patch edges that are 2 cm off teach a plain fit
    wrong light in all sunny hours, and held-out days do not show it.
    """
    noises = [s for s in NOISES if not one_season or s >= ONE_SEASON_NOISE]
    if not with_patch:
        return _below(one_season)
    plain = [Recipe(s, PATCH_GAIN_VARIANCE) for s in noises]
    robust = [Recipe(s, 0.0625, rounds=3, second=0.15) for s in (1e-2, 3e-2)]
    return robust if fitted_patches else plain + robust


@dataclass(frozen=True, slots=True)
class SelectedRecipe:
    """The kernel, inputs and recipe that held-out days support; their error need not be the least.

    A coarse room model may be worse by a standard error, and fewer features by 5 %; skies in
    windows and a lamp must lower the error clearly.

    features: of the n captures, as the kernel compares them; covariance: kernel between captures
    [n, n]; basis: its leading eigenvectors; held: prediction of each capture from other days;
    table: compared recipes, each with its weighted mean squared log10 error and the standard error
    of that over days; states: lamps and blinds; sky_field: statistics of the skies in the windows,
    None if Perez's skies were used; computed: whether light computed for the stated room is the
    prior mean.
    """

    kernel: Kernel
    features: Features
    covariance: Array
    basis: Basis
    recipe: Recipe
    held: HeldOutFit
    table: list[tuple[Recipe, float, float]]
    states: StateColumns = USUAL
    sky_field: SkyField | None = None
    computed: bool = False


def choose_model(
    drawn: TrainingArrays,
    kernel: Kernel,
    bounced: Floats32 | None,
    sky: SeenSky | None = None,
    under_sky: ComputedLight | None = None,
) -> SelectedRecipe:
    """Choose kernel, inputs and recipe by the errors of held-out days at the pixels `drawn`.

    bounced: result of `Physics.features` [n, k], None without a coarse room model; sky: the skies
    that windows showed, None without; under_sky: computed light of `drawn` under these skies. Each
    of these inputs, the computed light in `drawn`, and a lamp that is on in all captures is used
    only if it helps held-out days (`bounced`: if it is no worse).
    """
    under_seen, field = _with_seen_sky(drawn, kernel, sky, under_sky)
    drawn, first = _with_better_mean(drawn, kernel, bounced)
    if field is not None:
        under_seen, other = _with_better_mean(under_seen, kernel, bounced)
        field = field if _is_better_for_a_year(under_seen, other, first) else None
        drawn, first = (under_seen, other) if field is not None else (drawn, first)
    first = first if drawn.patch is not None and not drawn.fitted_patches else None
    used = drawn.computed is not None
    chosen = _choose_recipe(drawn, kernel, bounced, first)
    chosen = replace(chosen, sky_field=field, computed=used)
    always = replace(drawn.states, always=True)
    lit = replace(drawn, features=always.add(drawn.features, drawn.light), states=always)
    trial = _choose_kernel(lit, kernel, [Recipe(s, PATCH_GAIN_VARIANCE) for s in LAMP_NOISES], None)
    if not _lamp_is_on(chosen, trial):
        return _under_perez(drawn, chosen)
    chosen = replace(_choose_recipe(lit, kernel, bounced), states=always, sky_field=field)
    return _under_perez(lit, replace(chosen, computed=used))


def _with_better_mean(
    drawn: TrainingArrays, kernel: Kernel, bounced: Floats32 | None
) -> tuple[TrainingArrays, SelectedRecipe | None]:
    """Return the arrays with computed light as the prior mean, if it lowers held-out errors.

    The second value is the choice for them, None if there is no computed light to compare with.
    Patches used in full are compared by all recipes of the fit, because computed light wants a
    larger noise than captures alone. Robust recipes alone would take too long.
    """
    if drawn.computed is None:
        return drawn, None
    in_full = drawn.patch is not None and not drawn.fitted_patches
    recipes = [Recipe(s, PATCH_GAIN_VARIANCE) for s in SKY_NOISES]
    recipes = recipes_for(True, one_season(drawn.days)) if in_full else recipes
    tried = [
        (arrays, _choose_kernel(arrays, kernel, recipes, bounced))
        for arrays in (replace(drawn, computed=None), drawn)
    ]
    return tried[held_out_choice.choose([pair[1].held.errors for pair in tried]).best]


def _is_better_for_a_year(
    drawn: TrainingArrays, with_seen: SelectedRecipe | None, perez: SelectedRecipe | None
) -> bool:
    """Return whether held-out hours under Perez's skies, as in a year, are better by `with_seen`.

    drawn, with_seen: arrays with the skies that windows showed, and the choice for them; perez: the
    choice with Perez's skies. True without a room, for which `_with_seen_sky` decides alone.
    """
    if with_seen is None or perez is None:
        return True
    return _better(perez, as_predicted := _under_perez(drawn, with_seen)) is as_predicted


def _with_seen_sky(
    drawn: TrainingArrays, kernel: Kernel, sky: SeenSky | None, under_sky: ComputedLight | None
) -> tuple[TrainingArrays, SkyField | None]:
    """Return the arrays with the skies that windows showed, if these teach more than Perez's skies.

    Two conditions apply. With these skies, held-out hours must be better by a tenth and by one
    standard error. Under Perez's skies, as a year is predicted, they must not be worse. Then the
    second value is the field, and all later choices predict held-out hours under the seen skies,
    which show the room's response better.
    """
    if sky is None or len(np.unique(drawn.days)) < SKY_DAYS:
        return drawn, None
    plain = replace(drawn, computed=None)  # whose Perez skies would hide what the windows show
    trial = replace(plain, features=sky.features(drawn), perez_sky=drawn.features.sky)
    recipes = [Recipe(s, PATCH_GAIN_VARIANCE) for s in SKY_NOISES]
    without = _choose_kernel(plain, kernel, recipes, None)
    with_sky = _choose_kernel(trial, kernel, recipes, None)
    if not _much_better(with_sky.held.errors, without.held.errors, SKY_GAIN):
        return drawn, None
    no_worse = _no_worse(_under_perez(trial, with_sky).held.errors, without.held.errors)
    return (replace(trial, computed=under_sky), sky.field) if no_worse else (drawn, None)


def plain_held_out(drawn: TrainingArrays, kernel: Kernel) -> HeldOutFit:
    """Predict each capture from other days, at the pixels `drawn`, by the best of three recipes.

    They have no robust rounds and no second stage, and no coarse room model is used.
    """
    recipes = [Recipe(s, PATCH_GAIN_VARIANCE) for s in SKY_NOISES]
    return _choose_kernel(drawn, kernel, recipes, None).held


def _under_perez(drawn: TrainingArrays, chosen: SelectedRecipe) -> SelectedRecipe:
    """Return the choice with held-out hours predicted under Perez's skies."""
    if drawn.perez_sky is None:
        return chosen
    assumed = replace(chosen.features, sky=drawn.perez_sky)
    covariance = chosen.kernel(assumed, chosen.features)  # [n, n]
    basis = replace(chosen.basis, assumed=covariance @ chosen.basis.projector)
    drawn = replace(drawn, features=chosen.features, states=chosen.states)
    return replace(chosen, basis=basis, held=hold_out(drawn, basis, chosen.recipe))


def _lamp_is_on(without: SelectedRecipe, lit: SelectedRecipe) -> bool:
    """Return whether a constant light explains much of the held-out error, on most days."""
    return _much_better(lit.held.errors, without.held.errors, LAMP_GAIN, times=2.0)


def _choose_recipe(
    drawn: TrainingArrays,
    kernel: Kernel,
    bounced: Floats32 | None,
    first: SelectedRecipe | None = None,
) -> SelectedRecipe:
    """Return the complete choice; first: of `_choose_kernel` among all recipes, if known."""
    alike, with_patch = one_season(drawn.days), drawn.patch is not None
    recipes = recipes_for(with_patch, alike, fitted_patches=drawn.fitted_patches)
    chosen = first or _choose_kernel(drawn, kernel, recipes, bounced)
    if with_patch and chosen.recipe.second:
        chosen = _doubted(drawn, kernel, alike, bounced, chosen)
    chosen = replace(chosen, states=drawn.states)
    # Keep all features if all captures are from one season, or if errors of patches dominate the
    # held-out score.
    return chosen if alike or chosen.recipe.second else fewest_features(drawn, chosen)


def _choose_kernel(
    drawn: TrainingArrays, kernel: Kernel, recipes: list[Recipe], bounced: Floats32 | None
) -> SelectedRecipe:
    """Return the kernel and recipe with the least error on held-out days, tested on some pixels.

    A room model (its features are `bounced`) describes suns without a capture, which held-out days
    do not test: it is used unless it is worse by more than a standard error. With it the facade
    term has less weight.
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
    kept = with_room if _no_worse(with_room.held.errors, without.held.errors) else without
    return replace(kept, table=[*without.table, *with_room.table])


def _doubted(
    drawn: TrainingArrays,
    kernel: Kernel,
    one_season: bool,
    bounced: Floats32 | None,
    trusting: SelectedRecipe,
) -> SelectedRecipe:
    """Return the better choice: light fitted with or without patches, by held-out days.

    The test is made if robust rounds had to correct patches.
    """
    bare = replace(drawn, features=replace(drawn.features, cells=None, flux=None))
    doubting = _choose_kernel(bare, kernel, _below(one_season, patches=True), bounced)
    return replace(_better(trusting, doubting), table=[*trusting.table, *doubting.table])


def fewest_features(drawn: TrainingArrays, chosen: SelectedRecipe) -> SelectedRecipe:
    """Return `chosen` with 40, 60 or all of its features: the fewest that held-out days allow.

    The error of fewer features may be at most 5 % above that of all. Noisy data (pixels,
    irradiance, a sky that differs from Perez's) support fewer features than a clean rendering, and
    a smaller model is faster.
    """
    drawn, table = replace(drawn, features=chosen.features), [*chosen.table]
    for rank in (r for r in FEWER if r < chosen.basis.values.shape[1]):
        recipe, basis = replace(chosen.recipe, rank=rank), leading(chosen.basis, rank)
        held = hold_out(drawn, basis, recipe)
        table.append(_row(recipe, held.errors))
        limit = FEWER_COST * chosen.held.errors.figure("log10")
        if held.errors.figure("log10") <= limit:
            return replace(chosen, recipe=recipe, basis=basis, held=held, table=table)
    return replace(chosen, table=table)
