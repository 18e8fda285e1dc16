"""Define the steps of a fit: box and shades, bars, furniture, and everything together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fieldlum.scene_fit.acceptance import BAR_GAIN, SHADE_GAIN, SOLID_GAIN, pays
from fieldlum.scene_fit.bars import (
    MIN_BAR_M,
    bars_in_patches,
    bars_in_picture,
    is_near,
    propose_merged,
    without_bars,
)
from fieldlum.scene_fit.evidence import SceneEvidence
from fieldlum.scene_fit.exterior import (
    exterior_parameters,
    is_outside,
    propose_covers,
    propose_exterior,
    propose_shapes,
)
from fieldlum.scene_fit.furniture import propose_columns, propose_solids, solid_parameters
from fieldlum.scene_fit.guess import Guess, guess_of
from fieldlum.scene_fit.least_squares import damped_search, principal_search
from fieldlum.scene_fit.parameters import (
    Parameter,
    bar_parameters,
    inset_parameters,
    room_parameters,
    shape_parameters,
    stated_albedo,
)
from fieldlum.scene_fit.pixel_depths import clustered_solids, pixel_depths
from fieldlum.scene_fit.profile import WALL
from fieldlum.scene_fit.profiled import FINE_SUB, STAGES, ProfiledCost
from fieldlum.scene_fit.reflected import relit
from fieldlum.scene_fit.renderer import SHELL
from fieldlum.scene_fit.search import (
    PRIOR_SHARE,
    Objective,
    ViewCost,
    aimed,
    along_valley,
    pattern_search,
)
from fieldlum.scene_fit.solid_cost import SolidCost
from fieldlum.scene_fit.stated_room import StatedRoom

if TYPE_CHECKING:
    from fieldlum.models.data import Dataset

Array = NDArray[np.floating]

SAME_COST = 1.03  # costs within 3 % are alike: exact and wrong clocks differ by less in a valley
RESTART_CLOCKS_MIN = (-3.0, 3.0)  # chosen, not varied: half of the prior's 5 min
RESTART_TURNS_DEG = (-2.0, 0.0, 2.0)  # of the walls against the picture: the prior's uncertainty
# Chosen, for time: each solid costs a search. Trials start from the best proposals of the grid.
MAX_SOLIDS = 8
MAX_SHADES = 2
SHADE_TRIALS = 3
SOLID_TRIALS = 3
# Sunny hours for which `PRIOR_SHARE` was chosen: nine days of bench/scene_rooms.py have 25 to 60.
PRIOR_HOURS = 30
# In the last searches: of the stated numbers, of the windows' picture (decisions 31, 28).
FINAL_PRIOR_WEIGHT, FINAL_VIEW_WEIGHT = 0.25, 0.2


class SceneSearch:
    """State of one fit: evidence, albedos, hours to fit and to check; methods return guesses."""

    def __init__(
        self,
        data: Dataset,
        evidence: SceneEvidence,
        fit_hours: NDArray[np.intp],
        kept_out: NDArray[np.intp],
        stated: StatedRoom,
    ) -> None:
        self.data, self.evidence, self.stated = data, evidence, stated
        self.fit_hours, self.kept_out = fit_hours, kept_out
        self.is_late = False  # True in the last searches
        self.valley: dict[str, float] = {}
        self.start = guess_of(stated.room, data.heading_deg)
        self.parameters = room_parameters(self.start, clock_sd_min=stated.clock_sd_min)
        self.albedo = evidence.albedos(self.start, stated_albedo(stated.room))
        patch = evidence.patches(self.start, self.albedo)
        few = max(1.0, PRIOR_HOURS / len(evidence))  # because the misfit is a mean over hours
        self.prior_unit = few * PRIOR_SHARE * float(evidence.misfit(patch).mean())

    def objective(self, evidence: SceneEvidence) -> Objective:
        """Return the cost function of a guess (misfit plus prior) for some hours or pixels."""
        return Objective(
            evidence, self.start, self.parameters, self.albedo, self.prior_unit, self.stated.pose
        )

    @property
    def fit_evidence(self) -> SceneEvidence:
        """The evidence of `fit_hours`; the last searches use all hours."""
        return self.evidence.hours(self.fit_hours)

    def windows(self, guess: Guess) -> list[Guess]:
        """Search edges and bars in the picture of the windows alone; return three guesses.

        Their walls are turned by -2, 0 and 2 degrees, because the picture and the tape measure
        leave this open; `contents` chooses. If the picture shows no edges, they are only turned.
        """
        turned = aimed(next(p for p in self.parameters if p.name == WALL).change)
        starts = [turned(guess, turn_deg) for turn_deg in RESTART_TURNS_DEG]
        if not self.evidence.view.weights.any():
            return starts
        cost = ViewCost(self.objective(self.evidence))
        others = [p for p in self.parameters if p.name != WALL]
        found: list[Guess] = []
        for start in starts:
            trial, _ = pattern_search(cost, start, others, fine=2.0)
            proposals = bars_in_picture(self.evidence.view, trial)
            trial = replace(trial, bars=(*trial.bars, *proposals))
            best, least = pattern_search(cost, trial, [*others, *bar_parameters(trial)], fine=2.0)
            for bar in best.bars[len(guess.bars) :]:
                without = replace(best, bars=tuple(b for b in best.bars if b is not bar))
                if cost(without) < (1.0 + BAR_GAIN) * least:
                    best, least = without, cost(without)
            found.append(best)
        return found

    def contents(self, starts: Sequence[Guess], step: Callable[[int], None]) -> Guess:
        """Search shades and bars from each guess; return the best one with furniture added.

        Rooms with turned walls cost the same until they have bars. step: called with the number of
        searches done. `evidence` and `albedo` become those of the result.
        """
        given = self.evidence, self.albedo
        rooms: list[tuple[float, Guess, SceneEvidence, Array]] = []
        for number, start in enumerate(starts):
            step(number)
            self.evidence, self.albedo = given
            guess = self.bars(self.box(start), fine=4.0)
            self.relight(guess)
            cost = self.objective(self.fit_evidence)(guess)
            rooms.append((cost, guess, self.evidence, self.albedo))
        _, guess, self.evidence, self.albedo = min(rooms, key=lambda room: room[0])
        step(len(starts))
        return self.furnished(guess, MAX_SOLIDS)

    def box(self, guess: Guess) -> Guess:
        """Search box, pose and shades from several clocks; set `albedo`, return the best guess."""
        coarse = self.objective(self.fit_evidence.coarse())
        starts = [self.stated.at_clock(guess, clock) for clock in self.stated.start_clocks_min]
        tries = [pattern_search(coarse, start, self.parameters, fine=4.0) for start in starts]
        guess = self.shaded(min(tries, key=lambda pair: pair[1])[0])
        self.albedo = self.evidence.albedos(guess, self.albedo)
        return guess

    def shaded(self, guess: Guess) -> Guess:
        """Add up to two blinds, curtains, facades, canopies, arched or slanted tops that pay.

        A facade that hides every sun costs less than displaced patches, but explains nothing.
        """
        coarse = self.objective(self.fit_evidence.coarse())
        without_sun = coarse.evidence.dark_misfit + coarse.without_patches(guess)
        for _ in range(MAX_SHADES):
            trials = [self._covered(guess, coarse), self._faced(guess), self._shaped(guess, coarse)]
            trial = min(trials, key=coarse)
            if coarse(trial) > min(coarse(guess), without_sun) * (1.0 - SHADE_GAIN):
                return guess
            both = [*self.parameters, *self._shape_parameters(trial)]
            trial, _ = pattern_search(coarse, trial, both, fine=4.0)
            if not self._pays(guess, trial, SHADE_GAIN):
                return guess
            guess = trial
        return guess

    def _shape_parameters(self, guess: Guess) -> list[Parameter]:
        return [p for number in range(len(guess.windows)) for p in shape_parameters(guess, number)]

    def _shaped(self, guess: Guess, coarse: Objective) -> Guess:
        """Return the guess with the arched or slanted window that lowers the misfit most."""
        trial = min(propose_shapes(guess), key=coarse)
        return pattern_search(coarse, trial, self._shape_parameters(trial), fine=2.0)[0]

    def _covered(self, guess: Guess, coarse: Objective) -> Guess:
        """Return the guess with the blind or curtain that lowers the misfit most."""
        trials = [replace(guess, bars=(*guess.bars, bar)) for bar in propose_covers(guess)]
        trial = min(trials, key=coarse)
        return pattern_search(coarse, trial, bar_parameters(trial)[-3:], coarse=4.0, fine=2.0)[0]

    def _faced(self, guess: Guess) -> Guess:
        """Return the guess with the facade or canopy that lowers the misfit most."""
        cost = self._solid_cost(self.fit_evidence.coarse(), guess, self.albedo_with_solids(guess))
        parameters = exterior_parameters(len(guess.solids))
        trials = [replace(guess, solids=(*guess.solids, s)) for s in propose_exterior(guess)]
        best = sorted(trials, key=cost)[:SHADE_TRIALS]
        tries = [pattern_search(cost, trial, parameters, fine=4.0) for trial in best]
        return min(tries, key=lambda pair: pair[1])[0]

    def bars(self, guess: Guess, fine: float = 1.0) -> Guess:
        """Find bars in each window from its sun patches; search their place, width and depth.

        They replace those up to 20 cm wide if the cost falls. Bars of too little effect are
        removed. fine: factor on the last steps of the search.
        """
        bare = without_bars(guess)
        proposals = bars_in_patches(self.fit_evidence, bare, self.albedo_with_solids(bare))
        if not proposals:
            return self._pruned(guess)
        objective = self.objective(self.fit_evidence.coarse())
        trial = replace(bare, bars=(*bare.bars, *proposals))
        trial, _ = pattern_search(objective, trial, bar_parameters(trial), fine=fine)
        trial = self._pruned(trial)
        both = [*self.parameters, *bar_parameters(trial)]
        trial, cost = pattern_search(objective, trial, both, coarse=0.5, fine=fine)
        return trial if cost < objective(guess) else self._pruned(guess)

    def _pruned(self, guess: Guess) -> Guess:
        """Return the guess without thin bars and without bars of too little effect."""
        bars = tuple(b for b in guess.bars if b.span_m[1] - b.span_m[0] >= MIN_BAR_M)
        guess = replace(guess, bars=bars)
        for bar in bars:
            without = replace(guess, bars=tuple(b for b in guess.bars if b is not bar))
            guess = guess if self._pays(without, guess, BAR_GAIN) else without
        return guess

    def more_bars(self, guess: Guess) -> Guess:
        """Return the guess with more window bars that pay; displaced patches hid thin ones."""
        objective = self.objective(self.fit_evidence)
        albedo = self.albedo_with_solids(guess)
        proposals = bars_in_patches(self.evidence, without_bars(guess), albedo)
        for bar in sorted(proposals, key=lambda b: b.span_m[0] - b.span_m[1]):
            if not any(is_near(bar, other) for other in guess.bars):
                trial = replace(guess, bars=(*guess.bars, bar))
                trial, _ = pattern_search(objective, trial, bar_parameters(trial)[-3:], fine=2.0)
                guess = trial if self._pays(guess, trial, BAR_GAIN) else guess
        return guess

    def _merged(self, guess: Guess) -> Guess:
        """Return the guess with one bar for two neighbours that hardly explain more."""
        objective = self.objective(self.evidence.coarse())
        for trial in propose_merged(guess):
            merged, cost = pattern_search(objective, trial, bar_parameters(trial)[-3:])
            if cost < objective(guess) * (1.0 + BAR_GAIN):
                return self._merged(merged)
        return guess

    def _pays(self, without: Guess, with_it: Guess, least: float) -> bool:
        """Return whether an element lowers the misfit enough, in fitted and in held-out hours."""
        both = (self.fit_hours, self.kept_out)
        fitted, kept_out = (self.objective(self.evidence.hours(hours)) for hours in both)
        return pays(fitted, kept_out, without, with_it, least)

    def furniture(self, guess: Guess) -> Guess:
        """Return the guess with a proposed solid that pays, else the same object; try three."""
        albedo = self.albedo_with_solids(guess)
        coarse = self._solid_cost(self.fit_evidence.coarse(), guess, albedo)
        limit = coarse.prior + coarse.without * (1.0 - SOLID_GAIN)
        trials: list[tuple[float, Guess]] = []
        parameters = solid_parameters(len(guess.solids))
        clustered = clustered_solids(pixel_depths(self.fit_evidence, guess, albedo), guess)
        usual = propose_solids(guess, coarse, coarse.prior + coarse.without)
        for solid in (*usual, *clustered):
            trial = replace(guess, solids=(*guess.solids, solid))
            trial, cost = pattern_search(coarse, trial, parameters, fine=4.0)
            if cost < limit:
                trials.append((cost, trial))
        fine = self._solid_cost(self.fit_evidence, guess, albedo)
        trials += self._columns(guess, limit)
        for _, trial in sorted(trials, key=lambda pair: pair[0])[:SOLID_TRIALS]:
            better = trial
            if trial.windows == guess.windows:
                better, _ = pattern_search(fine, trial, parameters, coarse=0.5)
            if self._pays(guess, better, SOLID_GAIN):
                return better
        return guess

    def _columns(self, guess: Guess, limit: float) -> list[tuple[float, Guess]]:
        """Return columns before a window's end that is far inside the stated one, with their costs.

        A column and a narrower window look alike, but shade differently. Costs are below the limit.
        """
        objective = self.objective(self.fit_evidence.coarse())
        trials: list[tuple[float, Guess]] = []
        for p, column in propose_columns(guess, self.start, self.parameters):
            moves = [p, *solid_parameters(len(guess.solids))]
            trial, cost = pattern_search(objective, column, moves, fine=2.0)
            if cost < limit:
                trials.append((cost, trial))
        return trials

    def furnished(self, guess: Guess, most: int) -> Guess:
        """Add up to `most` solids that lower the misfit enough; after each, search again."""
        for _ in range(most):
            more = self.furniture(guess)
            if more is guess:
                break
            objective = self.objective(self.fit_evidence.coarse())
            guess, _ = pattern_search(objective, more, self.all_parameters(more), coarse=0.25)
            self.relight(guess)
        return guess

    def _solid_cost(self, evidence: SceneEvidence, guess: Guess, albedo: Array) -> SolidCost:
        return SolidCost(evidence, guess, albedo, self.objective(evidence).prior(guess))

    def pruned(self, guess: Guess) -> Guess:
        """Return the guess without thin bars, bars and added solids that do not pay."""
        return self._cleared(self._pruned(guess))

    def _cleared(self, guess: Guess) -> Guess:
        """Return the guess without added solids that do not lower the misfit enough."""
        for solid in guess.solids[len(self.start.solids) :]:
            without = replace(guess, solids=tuple(s for s in guess.solids if s is not solid))
            guess = guess if self._pays(without, guess, SOLID_GAIN) else without
        return guess

    def albedo_with_solids(self, guess: Guess) -> Array:
        """Return the albedos of west, east, south, north, floor, ceiling, solids, [6 + solids]."""
        return np.concatenate([self.albedo[:SHELL], [s.albedo for s in guess.solids]])

    def relight(self, guess: Guess) -> None:
        """Set `albedo`, and the light without sun in `evidence`, to estimates with this guess."""
        self.albedo = self.evidence.albedos(guess, self.albedo)
        albedo = self.albedo_with_solids(guess)
        self.evidence = relit(self.evidence, self.data, guess, albedo, reflects=self.is_late)

    def restarted(self, guess: Guess, seed: int) -> Guess:
        """Return the best of several searches from other clocks and displaced rooms.

        A guess with bars and furniture can leave a valley in which an earlier search stopped.
        `valley` becomes each parameter's standard deviation over results within 3 % of the best.
        """
        rng = np.random.default_rng(seed)
        coarse = self.objective(self.fit_evidence.coarse())
        tries = [pattern_search(coarse, guess, self.parameters, coarse=0.25, fine=4.0)]
        turned = aimed(next(p for p in self.parameters if p.name == WALL).change)
        clocks = RESTART_CLOCKS_MIN if self.stated.is_clock_open else (0.0,)
        for later, turn_deg in product(clocks, RESTART_TURNS_DEG):
            start = turned(along_valley(guess, later), turn_deg)
            for p in self.parameters:
                start = p.change(start, float(rng.normal(0.0, 0.5 * p.first_step)))
            tries.append(pattern_search(coarse, start, self.parameters, coarse=0.5, fine=4.0))
        best, least = min(tries, key=lambda pair: pair[1])
        alike = [trial for trial, cost in tries if cost < SAME_COST * least]
        self.valley = {
            p.name: float(np.std([p.read(trial) for trial in alike])) for p in self.parameters
        }
        return best

    def polish(self, guess: Guess) -> Guess:
        """Search all parameters, then along principal axes."""
        objective = self.objective(self.fit_evidence)
        parameters = self.all_parameters(guess)
        guess, _ = pattern_search(objective, guess, parameters, coarse=0.25)
        return principal_search(objective, guess, parameters)[0]

    def refined(self, guess: Guess, tick: Callable[[float], None]) -> Guess:
        """Search all parameters together, then shades and furniture; return the best guess.

        The windows' picture, of rough reveals, and the prior lose most of their weight. Bars stay.
        From here on `relight` knows what patches reflect. tick: called with the share done, 0 to 1.
        """
        view = self.evidence.view
        view = replace(view, weights=FINAL_VIEW_WEIGHT * view.weights)
        self.evidence = replace(self.evidence, view=view)
        self.prior_unit *= FINAL_PRIOR_WEIGHT
        self.is_late = True
        self.relight(guess)
        guess = self._cleared(self._adjusted(self._merged(guess), lambda s: tick(0.5 * s)))
        more = self.furnished(self.more_bars(self.shaded(guess)), MAX_SOLIDS)
        if more is not guess:
            guess = self._cleared(self._adjusted(more, lambda s: tick(0.5 + 0.5 * s)))
        return guess

    def _adjusted(self, guess: Guess, tick: Callable[[float], None]) -> Guess:
        """Search all parameters together, with light below that follows the trial's patches."""
        for number, stage in enumerate(STAGES):
            tick(number / len(STAGES))
            evidence = self.evidence.thinned(stage.every).finer(self.data, FINE_SUB)
            cost = ProfiledCost(self.objective(evidence), self.data, guess, stage.width)
            guess = damped_search(cost, guess, self.free_parameters(guess), stage.share)
            self.relight(guess)
        return guess

    def free_parameters(self, guess: Guess) -> list[Parameter]:
        """Return all parameters and bars' insets, without slides: faces move solids too."""
        every = (*self.all_parameters(guess), *inset_parameters(guess))
        return [p for p in every if "slide" not in p.name]

    def all_parameters(self, guess: Guess) -> list[Parameter]:
        """Return the parameters of the room, its windows' shapes, its bars and its solids."""
        parameters = [*self.parameters, *self._shape_parameters(guess), *bar_parameters(guess)]
        for number, solid in enumerate(guess.solids):
            of = exterior_parameters if is_outside(guess, solid) else solid_parameters
            parameters += of(number)
        return parameters
