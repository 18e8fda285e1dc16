"""Fit a scene to captures: from the stated box to north, clock, edges, bars and furniture.

Numbers are searched by damped least squares. Elements are added one by one: the proposal that
lowers the misfit of all sunny hours most, if its gain exceeds its standard error over the hours.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from fieldlum.core.arrays import Floats
from fieldlum.core.progress import progress
from fieldlum.core.records import Room
from fieldlum.learn.models.training_data import Dataset
from fieldlum.room.fit.evidence import PIXELS, SceneEvidence, scene_evidence
from fieldlum.room.fit.guess import Guess, guess_of, room_of
from fieldlum.room.fit.parameters import (
    CLOCK_SD_MIN,
    all_parameters,
    glass_parameters,
    room_parameters,
    stated_albedo,
)
from fieldlum.room.fit.pose_prior import PosePrior
from fieldlum.room.fit.proposals import KINDS, Kind
from fieldlum.room.fit.scene_file import Scene
from fieldlum.room.fit.search import STEP_SHARES, SceneCost, covariance, prior_unit, search
from fieldlum.room.fit.sunny_hours import MIN_SUNNY_HOURS

# Rounds of proposals, and proposals of a kind that are searched in each; chosen, for time.
MAX_ROUNDS, _SEARCHED = 4, 6
MIN_STANDARD_ERRORS = 1.0  # of its mean over hours that an element's gain must have; chosen
# Factor on the search's own uncertainties, up to those of the stated numbers: in four rooms of
# other renderers north was off by 1.5 to 8 of them, because boxes lack what the rooms have.
MODEL_ERROR = 4.0


def fit_scene(
    data: Dataset,
    room: Room,
    *,
    pose: PosePrior | None = None,
    clock_sd_min: float = CLOCK_SD_MIN,
    pixels: int = PIXELS,
) -> Scene:
    """Find the scene that explains the sun patches of the captures, starting from the stated box.

    Return it with chosen "fitted", an empty verdict, and the misfits of `SceneSearch.misfit`;
    `fieldlum.room.fit.stage.judged_scene` sets the verdict. pose: camera pose and clock from the
    sun's discs, if any. clock_sd_min: standard uncertainty of the stated times; it is ignored with
    `pose`, which includes it. pixels: number to sample. Captures of a changed room, as with a lamp
    or a blind, hardly move the robust search. Raises InputError for a room that is not a box, has
    no window or is impossible, NotEnoughDataError for fewer than six captures with direct sun on a
    window.
    """
    with threadpool_limits(1, user_api="blas"):
        progress(0, 100, "light below the patches")
        fit = SceneSearch(data, room, pose, clock_sd_min, pixels)
        fit.run(lambda percent, text: progress(percent, 100, text))
        progress(90, 100, "uncertainties")
        u = fit.uncertainties()
    progress(100, 100, "")
    guess, parameters = fit.guess, fit.parameters
    return Scene(
        north_deg=guess.north_deg,
        clock_min=guess.clock_min,
        room=true_room(guess, room, fit.albedo),
        chosen="fitted",
        verdict="",
        stated_heading_deg=data.heading_deg,
        stated_room=room,
        hours=len(fit.evidence),
        misfit=fit.misfit(),
        before={p.name: p.measured(fit.start) for p in parameters},
        after={p.name: p.measured(guess) for p in parameters},
        u=u,
        notes=tuple(_notes(u, fit.evidence)),
    )


class SceneSearch:
    """State of one fit: the present guess, and the evidence and albedos that belong to it.

    data, room: captures and stated box. pose: pose and clock by sun discs, None without. start: the
    stated box as a guess. guess: the present one. evidence: with the light without direct sun that
    was estimated with its patches. parameters: those of the room, which have a prior. albedo: of
    west, east, south and north wall, floor and ceiling [6]. unit: cost of one standard deviation of
    one parameter.
    """

    def __init__(
        self,
        data: Dataset,
        room: Room,
        pose: PosePrior | None = None,
        clock_sd_min: float = CLOCK_SD_MIN,
        pixels: int = PIXELS,
        min_hours: int = MIN_SUNNY_HOURS,
    ) -> None:
        """Prepare the search for a room.

        clock_sd_min: standard uncertainty of the stated times, not used with `pose`; pixels: number
        to sample. Raises InputError for a room that is not a box, has no window or is impossible,
        NotEnoughDataError for fewer than `min_hours` captures with direct sun on a window.
        """
        self.data, self.room, self.pose = data, room, pose
        self.evidence = scene_evidence(data, room, pixels=pixels, min_hours=min_hours)
        self.start = self.guess = guess_of(room, data.heading_deg)
        self.parameters = room_parameters(self.start, clock_sd_min) + glass_parameters(self.start)
        self.albedo = self.evidence.albedos(self.start, stated_albedo(room))
        self.unit = prior_unit(self.evidence, self.start, self.albedo)

    def cost(self, *, coarse: bool = False) -> SceneCost:
        """Return the cost function of guesses; coarse: at about 1 000 pixels, for speed."""
        evidence = self.evidence.coarse() if coarse else self.evidence
        return SceneCost(evidence, self.start, self.parameters, self.albedo, self.unit, self.pose)

    def run(self, step: Callable[[int, str], None], kinds: Sequence[Kind] = KINDS) -> Guess:
        """Search all numbers and elements from the stated box; return the guess, the new state.

        step: called with the progress in percent and the step's name. kinds: of elements that are
        tried.
        """
        step(10, "box and clock")
        start = self.start if self.pose is None else self.pose.applied(self.start)
        self.accept(search(self.cost(coarse=True), start, self.parameters)[0])
        self._search_all()
        self._prune(kinds)
        for number in range(MAX_ROUNDS):
            step(20 + 15 * number, "shade, bars and furniture")
            more = self._with_more(kinds)
            if more is self.guess:
                break
            self.accept(more)
            self._search_all(STEP_SHARES[1:2])
            self._prune(kinds)
        step(80, "all together")
        self._search_all()
        return self.guess

    def _search_all(self, step_shares: Sequence[float] = STEP_SHARES[1:]) -> None:
        """Search all parameters again; the light without direct sun is that of the last guess."""
        parameters = all_parameters(self.guess, self.parameters)
        self.accept(search(self.cost(), self.guess, parameters, step_shares)[0])

    def _with_more(self, kinds: Sequence[Kind]) -> Guess:
        """Return the guess with more elements: of the best proposals, each that saves enough cost.

        kinds: of the elements that are proposed. Proposals are added in the order of their gains
        alone, each if it still gains with those before it.
        """
        cost = self.cost(coarse=True)
        trials: list[tuple[float, Kind, Guess]] = []
        for kind in kinds:
            proposals = list(kind.propose(self.guess))
            costs = np.array([cost(proposal) for proposal in proposals])
            for proposal in kind.best(proposals, costs, _SEARCHED):
                trial, _ = search(cost, proposal, kind.parameters(proposal), STEP_SHARES[:2])
                trials.append((self._gain(self.guess, trial), kind, trial))
        guess, solids, bars = self.guess, len(self.guess.solids), len(self.guess.bars)
        for _, kind, trial in sorted(trials, key=lambda trial: -trial[0]):  # by gain
            more = replace(
                guess,
                solids=(*guess.solids, *trial.solids[solids:]),
                bars=(*guess.bars, *trial.bars[bars:]),
            )
            guess = more if self._gain(guess, more) > kind.gain else guess
        return guess

    def _gain(self, without: Guess, with_it: Guess) -> float:
        """Return the share of the cost that an element saves; -inf if it can be by chance.

        The saving can be by chance if its mean over the hours does not exceed the standard error of
        that mean. The hours must support it without the skyline, which only forms what they
        support: a screen in the room hides sky too. without, with_it: the guesses without and with
        the element.
        """
        cost = self.cost()
        before, after = (cost.by_hour(guess) for guess in (without, with_it))
        saved = before - after
        standard_error = saved.std(ddof=1) / np.sqrt(len(saved))
        of_sky = [(cost.evidence.skyline.error(guess) ** 2).sum() for guess in (without, with_it)]
        own = saved.mean() - float(of_sky[0] - of_sky[1])  # of the hours without the skyline
        certain = min(saved.mean(), own) > MIN_STANDARD_ERRORS * standard_error
        return float(saved.sum() / before.sum()) if certain else -np.inf

    def _prune(self, kinds: Sequence[Kind]) -> None:
        """Remove bars and added solids whose gain is not over the smallest `gain` of `kinds`."""
        guess, minimum = self.guess, min((kind.gain for kind in kinds), default=0.0)
        for bar in guess.bars:
            without = replace(guess, bars=tuple(b for b in guess.bars if b is not bar))
            guess = guess if self._gain(without, guess) > minimum else without
        for solid in guess.solids[len(self.start.solids) :]:
            without = replace(guess, solids=tuple(s for s in guess.solids if s is not solid))
            guess = guess if self._gain(without, guess) > minimum else without
        self.guess = guess

    def accept(self, guess: Guess) -> None:
        """Set the guess and its albedos, and estimate the light without direct sun again."""
        self.guess = guess
        self.albedo = self.evidence.albedos(guess, stated_albedo(self.room))
        self.evidence = self.evidence.relit(self.data, self.evidence.patches(guess, self.albedo))

    def misfit(self) -> dict[str, float]:
        """Return the misfit, 0 to 1, of three geometries; keys: none, stated and fitted.

        It is the share of the sampled pixels whose luminance the sun patches do not explain, as a
        mean over the sunny hours: the mean of e^2 / (e^2 + 1.5^2), e being the error of ln
        luminance; 0 is a perfect fit. "none" is without sun patches; "stated" is the stated box
        with albedos that fit it.
        """
        of_fitted = self.evidence.patches(self.guess, self.albedo)
        albedo = self.evidence.albedos(self.start, stated_albedo(self.room))
        patches = {
            "none": np.zeros_like(of_fitted),
            "stated": self.evidence.patches(self.start, albedo),
            "fitted": of_fitted,
        }
        return {name: float(self.evidence.misfit(p).mean()) for name, p in patches.items()}

    def uncertainties(self) -> dict[str, float]:
        """Return standard uncertainties after `run`, by `Parameter.name`, in parameters' units.

        Those of the search are multiplied by up to `MODEL_ERROR` (4), but not beyond those of the
        stated numbers (`Parameter.sd`).
        """
        own = np.sqrt(np.diag(covariance(self.cost(), self.guess, self.parameters)))  # in steps
        stated = np.array([p.sd / p.step for p in self.parameters])
        wider = own * np.clip(stated / own, 1.0, MODEL_ERROR)
        return {p.name: u * p.step for p, u in zip(self.parameters, wider.tolist(), strict=True)}


def true_room(guess: Guess, stated: Room, albedo: Floats) -> Room:
    """Return the guess as a `Room` whose wall azimuth is relative to true north.

    The azimuth is the guess's plus its correction of north. stated: the room, for what is not
    fitted; albedo: of west, east, south and north wall, floor and ceiling [6].
    """
    return replace(
        room_of(guess, stated),
        wall_azimuth_deg=(guess.wall_azimuth_deg + guess.north_deg) % 360.0,
        reflectance_walls=float(np.mean(albedo[:4])),
        reflectance_floor=float(albedo[4]),
        reflectance_ceiling=float(albedo[5]),
    )


def _notes(u: dict[str, float], evidence: SceneEvidence) -> list[str]:
    """Return sentences for the user on what the captures do not determine.

    u: standard uncertainty by parameter's name, deg and min.
    """
    notes = []
    if u["north_deg"] > 0.2 and u["clock_min"] > 0.8:
        notes.append(
            f"north (+-{u['north_deg']:.1f} degrees) and clock (+-{u['clock_min']:.1f} min) "
            "cannot be separated well: capture another season, or pictures with the sun's disc"
        )
    if len(np.unique(evidence.days)) < 3:
        notes.append(
            "sunny hours on fewer than three days: the uncertainties do not "
            "include differences between days; capture more days"
        )
    return notes
