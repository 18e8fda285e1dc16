"""The fit of a scene to captures: from the stated box to north, clock, edges, bars and furniture.

Every third sunny hour is kept out of the search. An element stays only if these hours want it, and
the misfit stated for no patch, the stated box and the fitted scene is theirs.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fieldlum.records import Progress, Room, quiet
from fieldlum.scene_fit.bars import MIN_BAR_M, propose_bars, window_picture
from fieldlum.scene_fit.evidence import PIXELS, SceneEvidence, gather
from fieldlum.scene_fit.furniture import pixel_depths, propose_solids, solid_parameters
from fieldlum.scene_fit.guess import Guess, guess_of, room_of
from fieldlum.scene_fit.posterior import posterior
from fieldlum.scene_fit.renderer import SHELL
from fieldlum.scene_fit.search import (
    CLOCK_SD_MIN,
    PRIOR_SHARE,
    SUN_DEG_PER_MIN,
    Objective,
    Parameter,
    bar_parameters,
    pattern_search,
    room_parameters,
    stated_albedo,
)
from fieldlum.scene_fit.solid_cost import SolidCost

if TYPE_CHECKING:
    from fieldlum.models.data import Dataset
    from fieldlum.scene_fit.pose_prior import PosePrior

Array = NDArray[np.floating]

KEPT_OUT_EVERY = 3
START_CLOCKS_MIN = (-9.0, -6.0, -3.0, 0.0, 3.0, 6.0, 9.0)
COARSE_PIXELS_EVERY = 3
BAR_GAIN = 0.002  # share of the misfit that a bar must take away
SOLID_GAIN = 0.004  # likewise a solid; a proposal that explains noise takes less (docs/scene.md)
KEPT_OUT_GAIN = 0.001  # on the hours kept out
MAX_SOLIDS = 8


@dataclass(frozen=True)
class Misfits:
    """Share of the pixels near sun patches that are wrong, on hours kept out of the search."""

    none: Array
    stated: Array
    fitted: Array
    days: NDArray[np.datetime64]

    def mean(self) -> dict[str, float]:
        return {name: float(getattr(self, name).mean()) for name in ("none", "stated", "fitted")}


@dataclass(frozen=True)
class SceneFit:
    """A fitted scene.

    stated, heading_deg: the room and the captures' heading that the fit started at.
    room: the fitted box in the stated world axes; `north_deg` and `clock_min` say how north and
    clock differ from those stated. u: standard uncertainties by parameter name. before and after:
    values by parameter name. albedo [6 + solids]. room_draws: see `posterior.Posterior`.
    """

    stated: Room
    heading_deg: float
    guess: Guess
    room: Room
    albedo: Array
    before: dict[str, float]
    after: dict[str, float]
    u: dict[str, float]
    misfits: Misfits
    hours: int
    notes: tuple[str, ...]
    room_draws: dict[str, tuple[float, ...]] = field(default_factory=dict)


def fit_scene(
    data: Dataset,
    room: Room,
    *,
    pose: PosePrior | None = None,
    clock_sd_min: float = CLOCK_SD_MIN,
    pixels: int = PIXELS,
    seed: int = 0,
    progress: Progress = quiet,
) -> SceneFit:
    """Find the scene that explains the sun patches of the captures, starting at the stated box.

    pose: what the sun's discs determined before. clock_sd_min: standard uncertainty of the stated
    times; with `pose` it is already in it.
    Raises InputError for a room without a window, NotEnoughDataError with too few sunny captures.
    """
    progress(0, 100, "light below the patches")
    evidence = gather(data, room, pixels=pixels, seed=seed)
    number = np.arange(len(evidence))
    kept_out = number % KEPT_OUT_EVERY == KEPT_OUT_EVERY - 1
    prior = _Stated(room, pose, clock_sd_min)
    search = _Search(data, evidence, np.flatnonzero(~kept_out), np.flatnonzero(kept_out), prior)
    guess = search.start
    progress(5, 100, "north, clock and box")
    guess = search.box(guess)
    progress(20, 100, "bars")
    guess = search.bars(guess)
    search.relight(guess)
    progress(30, 100, "furniture")
    for number in range(MAX_SOLIDS):
        progress(30 + 50 * number // MAX_SOLIDS, 100, f"furniture: {number} found")
        more = search.furniture(guess)
        if more is guess:
            break
        guess = search.polish(more, search.fit_hours)
        search.relight(guess)
    progress(80, 100, "all together")
    guess = search.polish(guess, search.fit_hours)
    misfits = search.misfits(guess)
    guess = search.polish(guess, np.arange(len(evidence)))
    progress(88, 100, "uncertainties")
    spread = posterior(search.objective(evidence), guess, room, seed)
    before = {p.name: p.read(search.start) for p in search.parameters}
    after = {p.name: p.read(guess) for p in search.parameters}
    room_found = _with_albedo(room_of(guess, room), search.albedo)
    notes = tuple(_notes(spread.u, evidence))
    progress(100, 100, "")
    return SceneFit(
        room,
        data.heading_deg,
        guess,
        room_found,
        search.albedo,
        before,
        after,
        spread.u,
        misfits,
        len(evidence),
        notes,
        spread.room_draws,
    )


def _with_albedo(room: Room, albedo: Array) -> Room:
    """The room with the albedos found; solids have theirs already."""
    return replace(
        room,
        reflectance_walls=float(np.mean(albedo[:4])),
        reflectance_floor=float(albedo[4]),
        reflectance_ceiling=float(albedo[5]),
    )


@dataclass(frozen=True, slots=True)
class _Stated:
    """What is known before the search."""

    room: Room
    pose: PosePrior | None
    clock_sd_min: float

    @property
    def start_clocks_min(self) -> tuple[float, ...]:
        """Clocks to start from: several where the clock is not known to a minute."""
        clock, sd = 0.0, self.clock_sd_min
        if self.pose is not None:
            clock, sd = float(self.pose.values[3]), self.pose.u_clock_min
        return START_CLOCKS_MIN if sd > 1.0 else (clock,)

    def at_clock(self, guess: Guess, clock_min: float) -> Guess:
        """The guess at another clock, with the pose that belongs to it."""
        if self.pose is not None:
            return self.pose.at_clock(guess, clock_min)
        moved = clock_min - guess.clock_min
        return replace(
            guess, clock_min=clock_min, north_deg=guess.north_deg - SUN_DEG_PER_MIN * moved
        )


class _Search:
    """State of one fit: evidence, which hours count, and the light below the patches."""

    def __init__(
        self,
        data: Dataset,
        evidence: SceneEvidence,
        fit_hours: NDArray[np.intp],
        kept_out: NDArray[np.intp],
        stated: _Stated,
    ) -> None:
        self.data, self.evidence, self.stated = data, evidence, stated
        self.fit_hours, self.kept_out = fit_hours, kept_out
        self.start = guess_of(stated.room, data.heading_deg)
        self.parameters = room_parameters(self.start, clock_sd_min=stated.clock_sd_min)
        self.albedo = evidence.albedos(self.start, stated_albedo(stated.room))
        patch = evidence.patches(self.start, self.albedo)
        self.prior_unit = PRIOR_SHARE * float(evidence.misfit(patch).mean())

    def objective(self, evidence: SceneEvidence) -> Objective:
        return Objective(
            evidence, self.start, self.parameters, self.albedo, self.prior_unit, self.stated.pose
        )

    @property
    def fit_evidence(self) -> SceneEvidence:
        return self.evidence.hours(self.fit_hours)

    def box(self, guess: Guess) -> Guess:
        """North, clock, sizes, camera and window edges, from several clocks."""
        coarse = self.objective(self.fit_evidence.thinned(COARSE_PIXELS_EVERY))
        tries = []
        for clock in self.stated.start_clocks_min:
            start = self.stated.at_clock(guess, clock)
            tries.append(pattern_search(coarse, start, self.parameters, fine=4.0))
        guess = min(tries, key=lambda pair: pair[1])[0]
        for _ in range(2):
            self.albedo = self.evidence.albedos(guess, self.albedo)
            fine = self.objective(self.fit_evidence)
            guess, _ = pattern_search(fine, guess, self.parameters, coarse=0.5)
        return guess

    def bars(self, guess: Guess) -> Guess:
        """Bars in the picture of each window, in place, width and depth."""
        bare = replace(guess, bars=())
        proposals = []
        for number in range(len(guess.windows)):
            picture = window_picture(self.fit_evidence, bare, number, self.albedo)
            proposals += propose_bars(picture, bare, number)
        if not proposals:
            return self._pruned(guess)
        objective = self.objective(self.fit_evidence)
        trial = replace(bare, bars=tuple(proposals))
        trial, _ = pattern_search(objective, trial, bar_parameters(trial))
        trial = self._pruned(trial)
        both = [*self.parameters, *bar_parameters(trial)]
        trial, cost = pattern_search(objective, trial, both, coarse=0.5)
        return trial if cost < objective(guess) else self._pruned(guess)

    def _pruned(self, guess: Guess) -> Guess:
        """Without the bars that are too thin, or that fit hours or hours kept out do not want."""
        bars = [b for b in guess.bars if b.span_m[1] - b.span_m[0] >= MIN_BAR_M]
        guess = replace(guess, bars=tuple(bars))
        for bar in list(guess.bars):
            without = replace(guess, bars=tuple(b for b in guess.bars if b is not bar))
            if not self._pays(without, guess, BAR_GAIN):
                guess = without
        return guess

    def _pays(self, without: Guess, with_it: Guess, least: float) -> bool:
        """Whether an element takes enough misfit away, in the search's hours and those kept out."""
        for hours, share in ((self.fit_hours, least), (self.kept_out, KEPT_OUT_GAIN)):
            objective = self.objective(self.evidence.hours(hours))
            if objective(with_it) > objective(without) * (1.0 - share):
                return False
        return True

    def furniture(self, guess: Guess) -> Guess:
        """Add the solid that takes most misfit away, of those that single pixels propose; none
        where none pays.
        """
        albedo = np.concatenate([self.albedo[:SHELL], [s.albedo for s in guess.solids]])
        depths = pixel_depths(self.fit_evidence, guess, albedo)
        coarse = self._solid_cost(self.fit_evidence.thinned(COARSE_PIXELS_EVERY), guess, albedo)
        limit = coarse.prior + coarse.without * (1.0 - SOLID_GAIN)
        trials: list[tuple[float, Guess]] = []
        parameters = solid_parameters(len(guess.solids))
        for solid in propose_solids(depths, guess):
            trial = replace(guess, solids=(*guess.solids, solid))
            trial, cost = pattern_search(coarse, trial, parameters, fine=4.0)
            if cost < limit:
                trials.append((cost, trial))
        fine = self._solid_cost(self.fit_evidence, guess, albedo)
        for _, trial in sorted(trials, key=lambda pair: pair[0])[:2]:
            better, _ = pattern_search(fine, trial, parameters, coarse=0.5)
            if self._pays(guess, better, SOLID_GAIN):
                return better
        return guess

    def _solid_cost(self, evidence: SceneEvidence, guess: Guess, albedo: Array) -> SolidCost:
        return SolidCost(evidence, guess, albedo, self.objective(evidence).prior(guess))

    def relight(self, guess: Guess) -> None:
        """Find the light below the patches again, now that the patches are known better."""
        self.albedo = self.evidence.albedos(guess, self.albedo)
        albedo = np.concatenate([self.albedo[:SHELL], [s.albedo for s in guess.solids]])
        self.evidence = self.evidence.relit(self.data, self.evidence.patches(guess, albedo))

    def polish(self, guess: Guess, hours: NDArray[np.intp]) -> Guess:
        """Everything together, in small steps."""
        objective = self.objective(self.evidence.hours(hours))
        parameters: list[Parameter] = [*self.parameters, *bar_parameters(guess)]
        for number in range(len(guess.solids)):
            parameters += solid_parameters(number)
        return pattern_search(objective, guess, parameters, coarse=0.25)[0]

    def misfits(self, guess: Guess) -> Misfits:
        """Misfit of no patch, the stated box and the guess on the hours kept out."""
        evidence = self.evidence.hours(self.kept_out)
        albedo = np.concatenate([self.albedo[:SHELL], [s.albedo for s in guess.solids]])
        stated = evidence.patches(self.start, evidence.albedos(self.start, self.albedo[:SHELL]))
        fitted = evidence.patches(guess, albedo)
        nothing = np.zeros_like(fitted)
        return Misfits(
            evidence.misfit(nothing),
            evidence.misfit(stated),
            evidence.misfit(fitted),
            evidence.days,
        )


def _notes(u: dict[str, float], evidence: SceneEvidence) -> list[str]:
    notes = []
    if u["north_deg"] > 0.2 and u["clock_min"] > 0.8:
        notes.append(
            f"north (+-{u['north_deg']:.1f} degrees) and clock (+-{u['clock_min']:.1f} min) cannot "
            f"be told apart well: captures of another season or of the sun's disc would do it"
        )
    if len(np.unique(evidence.days)) < 3:
        notes.append("sunny hours on fewer than three days: the uncertainties are of hours alone")
    return notes
