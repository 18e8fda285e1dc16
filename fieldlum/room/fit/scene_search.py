"""Search a scene: edges in the pictures of windows, box and clock, shade outside, bars, furniture.

An element stays if it lowers the cost in the searched hours and does not raise it in the held-out
ones: an element that only explains noise lowers the cost of the searched hours alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fieldlum.room.fit.bars import MIN_BAR_M, bars_in_patches, bars_in_picture, without_bars
from fieldlum.room.fit.evidence import SceneEvidence
from fieldlum.room.fit.exterior import exterior_parameters, is_outside, propose_exterior
from fieldlum.room.fit.furniture import propose_columns, propose_solids, solid_parameters
from fieldlum.room.fit.guess import Guess, guess_of
from fieldlum.room.fit.parameters import (
    Parameter,
    bar_parameters,
    room_parameters,
    stated_albedo,
)
from fieldlum.room.fit.renderer import SHELL
from fieldlum.room.fit.search import PRIOR_SHARE, Objective, ViewCost, aimed, pattern_search
from fieldlum.room.fit.solid_cost import SolidCost
from fieldlum.room.fit.stated_room import StatedRoom

if TYPE_CHECKING:
    from fieldlum.learn.models.data import Dataset

Array = NDArray[np.floating]

WALL = "wall_azimuth_deg"
START_TURNS_DEG = (-2.0, 0.0, 2.0)  # of the walls against the picture: the prior's uncertainty
# Chosen, for time: each element costs a search. Trials start from the best proposals of the grid.
MAX_SOLIDS, MAX_OUTSIDE, TRIALS = 8, 2, 3
# Sunny hours for which `PRIOR_SHARE` was chosen: nine days have 25 to 60.
PRIOR_HOURS = 30
# Chosen, not varied: shares by which an element must lower the cost. A bar shades few pixels. A
# solid that only explains noise gains less. A wrong facade moves north, clock and edges.
BAR_GAIN, SOLID_GAIN, OUTSIDE_GAIN = 0.002, 0.01, 0.02
# The same in held-out hours: it exceeds rounding. The sun may light an object in no held-out hour;
# with a gain of `UNSEEN_GAIN` in the others these need only not contradict.
KEPT_OUT_GAIN, UNSEEN_GAIN = 0.001, 0.02


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
        """The evidence of `fit_hours`."""
        return self.evidence.hours(self.fit_hours)

    def run(self, step: Callable[[int, str], None]) -> Guess:
        """Search everything from the stated box; `evidence` and `albedo` become the result's.

        step: called with the share done in percent and what is searched.
        """
        guess = self.best_room(self.windows(self.start), step)
        step(55, "furniture")
        guess = self.pruned(self.bars(self.furnished(guess)))
        step(80, "all together")
        objective = self.objective(self.fit_evidence)
        guess, _ = pattern_search(objective, guess, self.all_parameters(guess), coarse=0.25)
        self.relight(guess)
        return guess

    def best_room(self, starts: Sequence[Guess], step: Callable[[int, str], None]) -> Guess:
        """Search box, bars and what is outside from each guess; return the room of least cost.

        Rooms with turned walls cost the same until they have bars.
        """
        given = self.evidence, self.albedo
        rooms: list[tuple[float, Guess, SceneEvidence, Array]] = []
        for number, start in enumerate(starts):
            step(10 + 15 * number, "box, bars and what is outside")
            self.evidence, self.albedo = given
            guess = self.bars(self.box(start), fine=4.0)
            self.relight(guess)
            cost = self.objective(self.fit_evidence)(guess)
            rooms.append((cost, guess, self.evidence, self.albedo))
        _, guess, self.evidence, self.albedo = min(rooms, key=lambda room: room[0])
        return guess

    def windows(self, guess: Guess) -> list[Guess]:
        """Search edges and bars in the picture of the windows alone; return three guesses.

        Their walls are turned by -2, 0 and 2 degrees, because the picture and the tape measure
        leave this open; `run` chooses. If the picture shows no edges, they are only turned.
        """
        turned = aimed(next(p for p in self.parameters if p.name == WALL).change)
        starts = [turned(guess, turn_deg) for turn_deg in START_TURNS_DEG]
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

    def box(self, guess: Guess) -> Guess:
        """Search box, pose and what is outside from several clocks; set `albedo`."""
        coarse = self.objective(self.fit_evidence.coarse())
        starts = [self.stated.at_clock(guess, clock) for clock in self.stated.start_clocks_min]
        tries = [pattern_search(coarse, start, self.parameters, fine=4.0) for start in starts]
        guess = self.outside(min(tries, key=lambda pair: pair[1])[0])
        self.albedo = self.evidence.albedos(guess, self.albedo)
        return guess

    def outside(self, guess: Guess) -> Guess:
        """Add up to two facades or canopies that pay.

        A facade that hides every sun costs less than displaced patches, but explains nothing.
        """
        coarse = self.objective(self.fit_evidence.coarse())
        without_sun = coarse.evidence.dark_misfit + coarse.without_patches(guess)
        for _ in range(MAX_OUTSIDE):
            trial = self._faced(guess)
            if coarse(trial) > min(coarse(guess), without_sun) * (1.0 - OUTSIDE_GAIN):
                return guess
            trial, _ = pattern_search(coarse, trial, self.parameters, fine=4.0)
            if not self._pays(guess, trial, OUTSIDE_GAIN):
                return guess
            guess = trial
        return guess

    def _faced(self, guess: Guess) -> Guess:
        """Return the guess with the facade or canopy that lowers the misfit most."""
        cost = self._solid_cost(self.fit_evidence.coarse(), guess, self.albedo_with_solids(guess))
        parameters = exterior_parameters(len(guess.solids))
        trials = [replace(guess, solids=(*guess.solids, s)) for s in propose_exterior(guess)]
        best = sorted(trials, key=cost)[:TRIALS]
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
            return self._thinned(guess)
        objective = self.objective(self.fit_evidence.coarse())
        trial = replace(bare, bars=(*bare.bars, *proposals))
        trial, _ = pattern_search(objective, trial, bar_parameters(trial), fine=fine)
        trial = self._thinned(trial)
        both = [*self.parameters, *bar_parameters(trial)]
        trial, cost = pattern_search(objective, trial, both, coarse=0.5, fine=fine)
        return trial if cost < objective(guess) else self._thinned(guess)

    def _thinned(self, guess: Guess) -> Guess:
        """Return the guess without thin bars and without bars of too little effect."""
        bars = tuple(b for b in guess.bars if b.span_m[1] - b.span_m[0] >= MIN_BAR_M)
        guess = replace(guess, bars=bars)
        for bar in bars:
            without = replace(guess, bars=tuple(b for b in guess.bars if b is not bar))
            guess = guess if self._pays(without, guess, BAR_GAIN) else without
        return guess

    def pruned(self, guess: Guess) -> Guess:
        """Return the guess without bars and added solids that do not pay."""
        guess = self._thinned(guess)
        for solid in guess.solids[len(self.start.solids) :]:
            without = replace(guess, solids=tuple(s for s in guess.solids if s is not solid))
            guess = guess if self._pays(without, guess, SOLID_GAIN) else without
        return guess

    def _pays(self, without: Guess, with_it: Guess, least: float) -> bool:
        """Return whether an element lowers the cost enough; see `pays`."""
        gains = []
        for hours in (self.fit_hours, self.kept_out):
            cost = self.objective(self.evidence.hours(hours))
            gains.append(1.0 - cost(with_it) / cost(without))
        return pays(gains[0], gains[1], least)

    def furnished(self, guess: Guess) -> Guess:
        """Add up to `MAX_SOLIDS` solids that pay; after each, search the numbers again."""
        for _ in range(MAX_SOLIDS):
            more = self.furniture(guess)
            if more is guess:
                break
            objective = self.objective(self.fit_evidence.coarse())
            guess, _ = pattern_search(objective, more, self.all_parameters(more), coarse=0.25)
            self.relight(guess)
        return guess

    def furniture(self, guess: Guess) -> Guess:
        """Return the guess with a proposed solid that pays, else the same object; try three."""
        albedo = self.albedo_with_solids(guess)
        coarse = self._solid_cost(self.fit_evidence.coarse(), guess, albedo)
        limit = coarse.prior + coarse.without * (1.0 - SOLID_GAIN)
        trials: list[tuple[float, Guess]] = []
        parameters = solid_parameters(len(guess.solids))
        for solid in propose_solids(guess, coarse, coarse.prior + coarse.without):
            trial = replace(guess, solids=(*guess.solids, solid))
            trial, cost = pattern_search(coarse, trial, parameters, fine=4.0)
            if cost < limit:
                trials.append((cost, trial))
        fine = self._solid_cost(self.fit_evidence, guess, albedo)
        trials += self._columns(guess, limit)
        for _, trial in sorted(trials, key=lambda pair: pair[0])[:TRIALS]:
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

    def _solid_cost(self, evidence: SceneEvidence, guess: Guess, albedo: Array) -> SolidCost:
        return SolidCost(evidence, guess, albedo, self.objective(evidence).prior(guess))

    def albedo_with_solids(self, guess: Guess) -> Array:
        """Return the albedos of west, east, south, north, floor, ceiling, solids, [6 + solids]."""
        return np.concatenate([self.albedo[:SHELL], [s.albedo for s in guess.solids]])

    def relight(self, guess: Guess) -> None:
        """Set `albedo`, and the light without sun in `evidence`, to estimates with this guess."""
        self.albedo = self.evidence.albedos(guess, self.albedo)
        patch = self.evidence.patches(guess, self.albedo_with_solids(guess))
        self.evidence = self.evidence.relit(self.data, patch)

    def all_parameters(self, guess: Guess) -> Sequence[Parameter]:
        """Return the parameters of the room, its bars and its solids."""
        parameters = [*self.parameters, *bar_parameters(guess)]
        for number, solid in enumerate(guess.solids):
            of = exterior_parameters if is_outside(guess, solid) else solid_parameters
            parameters += of(number)
        return parameters


def pays(fitted: float, kept_out: float, least: float) -> bool:
    """Return whether an element stays, by the shares by which it lowers the cost.

    fitted, kept_out: in fitted and in held-out hours. It must lower the cost by the share `least`
    in fitted hours and by 0.1 % in held-out ones. If it lowers the former by 2 % or more, the
    latter may rise by up to 0.1 %.
    """
    if fitted < least:
        return False
    return kept_out >= (KEPT_OUT_GAIN if fitted < UNSEEN_GAIN else -KEPT_OUT_GAIN)
