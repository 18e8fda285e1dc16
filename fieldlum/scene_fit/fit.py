"""Fit a scene to captures: from the stated box to north, clock, edges, bars and furniture.

About a third of the sunny hours is held out of the search, as blocks of sun directions. An element
remains only if it lowers the misfit of these hours too. The reported misfits (no patch, stated box,
fitted scene) are those of the held-out hours.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fieldlum.arrays import Indices
from fieldlum.errors import NotEnoughDataError
from fieldlum.records import Progress, Room, quiet
from fieldlum.scene_fit.corrected import corrected, with_patches
from fieldlum.scene_fit.evidence import PIXELS, SceneEvidence, gather
from fieldlum.scene_fit.guess import Guess, room_of
from fieldlum.scene_fit.joined import joined
from fieldlum.scene_fit.last_search import last_cost, last_search
from fieldlum.scene_fit.misfits import Misfits, misfits_of
from fieldlum.scene_fit.open_bodies import body_notes
from fieldlum.scene_fit.parameters import CLOCK_SD_MIN
from fieldlum.scene_fit.posterior import posterior, true_room
from fieldlum.scene_fit.profile import CLOCK, WALL, reach_of
from fieldlum.scene_fit.scene_search import SceneSearch
from fieldlum.scene_fit.skyline import with_skyline
from fieldlum.scene_fit.stated_room import StatedRoom
from fieldlum.scene_fit.verdict import OUTSIDE_EVERY, outside_hours
from fieldlum.train.room_changes import find_changes

if TYPE_CHECKING:
    from fieldlum.models.data import Dataset
    from fieldlum.scene_fit.pose_prior import PosePrior

Array = NDArray[np.floating]

# Searches stop in different places near the best scene, and are joined. Two, because
# a laptop has two cores or more.
STARTS = 2
REACH_EVERY = 3  # chosen, for time: use every n-th pixel for how far numbers can move
# Fewer captures of a changed room hardly move a robust search, and imperfect patches, as of trees,
# can make one look changed. Chosen.
_FEWEST_CHANGED = 3
OPEN_WALL_DEG = 0.5  # chosen: a window's edge 3 m from the camera is 3 cm off


@dataclass(frozen=True)
class SceneFit:
    """A fitted scene.

    stated, heading_deg: the room and the captures' heading that the fit started at. room: the
    fitted box, with the stated wall azimuth; `guess` has the fitted azimuth and the corrections
    `north_deg` and `clock_min`. albedo: of west, east, south and north wall, floor, ceiling and
    solids [6 + solids]. before, after: values before and after the fit, and u: standard
    uncertainties, by parameter name. misfits: shares of wrong pixels in held-out hours. hours:
    number of sunny hours, with the held-out ones. notes: sentences for the user. room_draws: see
    `posterior.Posterior`. changed: indices of captures of a changed room, which were not used [k].
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
    changed: Indices = field(default_factory=lambda: np.empty(0, np.intp))

    def used(self, data: Dataset) -> Dataset:
        """Return the captures that the fit used; data: all that it was given."""
        return data.take(np.setdiff1d(np.arange(len(data)), self.changed))


def fit_scene(
    data: Dataset,
    room: Room,
    *,
    pose: PosePrior | None = None,
    clock_sd_min: float = CLOCK_SD_MIN,
    pixels: int = PIXELS,
    seed: int = 0,
    starts: int = STARTS,
    progress: Progress = quiet,
) -> SceneFit:
    """Find the scene that explains the sun patches of the captures, starting from the stated box.

    pose: camera pose and clock from the sun's discs, if any. clock_sd_min: standard uncertainty of
    the stated times; it is ignored with `pose`, which includes it. pixels: number to sample.
    starts: number of searches, each with other random pixels, which are then joined. If captures of
    a changed room are found with their patches, the searches are repeated without them. Raises
    InputError for a room that is not a box, has no window or is impossible, NotEnoughDataError for
    fewer than six captures with direct sun on a window.
    """
    # Two searches fill two cores; threads of BLAS would only wait for each other.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(starts) as pool:
        plan = _Plan(StatedRoom(room, pose, clock_sd_min), pixels, seed, starts, pool)
        tries = _searches(data, plan, progress)
        tries, changed = _without_changed(data, tries, plan, progress)
        guess = _joined(tries, plan, progress)
    return _described(data, tries[0], guess, changed, plan, progress)


@dataclass(frozen=True, slots=True)
class _Plan:
    """How often to search, with how many random pixels, drawn with which seed; see `fit_scene`."""

    prior: StatedRoom
    pixels: int
    seed: int
    starts: int
    pool: Executor


def _searches(data: Dataset, plan: _Plan, progress: Progress) -> list[Searched]:
    """Search as often as planned, at the same time; return the search of least cost first."""

    def searched(number: int) -> Searched:
        shown = quiet if number else progress
        return _searched(data, plan.prior, plan.pixels, plan.seed + number, shown)

    tries = list(plan.pool.map(searched, range(plan.starts)))
    best = _cheapest(tries, plan.pool)
    return [best, *(one for one in tries if one is not best)]


def _without_changed(
    data: Dataset, tries: list[Searched], plan: _Plan, progress: Progress
) -> tuple[list[Searched], Indices]:
    """Search again without captures of a changed room; return the searches and these captures.

    With fewer than three, or if too few sunny hours remain, the given searches stay.
    """
    changed = _changed_captures(data, tries[0], plan.prior.room)
    if len(changed) < _FEWEST_CHANGED:
        return tries, changed[:0]

    def again(done: int, total: int, text: str) -> None:
        progress(done, total, f"{text}, without {len(changed)} captures of a changed room")

    rest = data.take(np.setdiff1d(np.arange(len(data)), changed))
    try:
        return _searches(rest, plan, again), changed
    except NotEnoughDataError:
        return tries, changed[:0]


def _joined(tries: list[Searched], plan: _Plan, progress: Progress) -> Guess:
    """Return the guess that the searches together find; light below the first one becomes its."""
    best, others = tries[0], tries[1:]
    if not others:
        return best.guess
    progress(90, 100, "both searches together")
    more, new = 2 * plan.pixels, plan.seed + plan.starts
    guesses = [one.guess for one in others]
    guess = joined(best.search, best.guess, guesses, pixels=more, seed=new, pool=plan.pool)
    best.search.relight(guess)
    return guess


def _described(
    data: Dataset, best: Searched, inside: Guess, changed: Indices, plan: _Plan, progress: Progress
) -> SceneFit:
    """Return a guess with a facade that panes show, and with uncertainties and notes.

    data: all captures; changed: those that were not used [k].
    """
    search, room = best.search, plan.prior.room
    used = data.take(np.setdiff1d(np.arange(len(data)), changed))
    cost = last_cost(search, inside)
    guess = with_skyline(cost, used, inside)
    progress(95, 100, "uncertainties")
    spread = posterior(search.objective(search.evidence), guess, room, plan.seed)
    coarse = search.objective(search.evidence.coarse().thinned(REACH_EVERY))
    reach = reach_of(coarse, guess, (WALL, CLOCK) if plan.prior.is_clock_open else (WALL,))
    u = {
        name: float(np.linalg.norm((u, search.valley[name], reach[name])))
        for name, u in spread.u.items()
    }
    notes = (
        *_notes(u, search.evidence),
        *_facade_notes(inside, guess),
        *body_notes(cost, inside, len(search.start.solids)),
        *_changed_notes(len(changed), len(data)),
    )
    progress(100, 100, "")
    return SceneFit(
        stated=room,
        heading_deg=data.heading_deg,
        guess=guess,
        room=_with_albedo(room_of(guess, room), search.albedo),
        albedo=search.albedo_with_solids(guess),
        before={p.name: p.read(search.start) for p in search.parameters},
        after={p.name: p.read(guess) for p in search.parameters},
        u=u,
        misfits=best.misfits,
        hours=len(search.evidence),
        notes=notes,
        room_draws=spread.room_draws,
        changed=changed,
    )


@dataclass(frozen=True, slots=True)
class Searched:
    """A search that has ended, its best guess, and the misfits in held-out hours."""

    search: SceneSearch
    guess: Guess
    misfits: Misfits


def _searched(
    data: Dataset, prior: StatedRoom, pixels: int, seed: int, progress: Progress
) -> Searched:
    """Search the scene once, at random pixels drawn with `seed`."""
    progress(0, 100, "light below the patches")
    evidence = gather(data, prior.room, pixels=pixels, seed=seed)
    kept_out = _kept_out(data, prior.room, evidence)
    search = SceneSearch(data, evidence, np.flatnonzero(~kept_out), np.flatnonzero(kept_out), prior)
    rooms = search.windows(search.start)

    def step(number: int) -> None:
        progress(5 + 70 * number // (len(rooms) + 1), 100, "shades, bars and furniture")

    guess = search.contents(rooms, step)
    progress(75, 100, "all together")
    guess = search.restarted(search.bars(search.pruned(guess)), seed)
    guess = search.polish(guess)
    held_out = search.evidence.hours(search.kept_out)
    misfits = misfits_of(held_out, search.start, guess, search.albedo_with_solids(guess))

    def refined(share: float) -> None:
        progress(82 + round(6 * share), 100, "light below each scene")

    guess = search.refined(guess, refined)
    progress(88, 100, "the last centimetres")
    return Searched(search, last_search(search, guess), misfits)


def _changed_captures(data: Dataset, found: Searched, stated: Room) -> Indices:
    """Return the captures with a lamp, or that contradict the other days, under a scene's patches.

    They are indices from 0 [k].
    """
    guess = found.guess
    room = _with_albedo(true_room(guess, stated), found.search.albedo)
    lit = with_patches(corrected(data, guess.north_deg, guess.clock_min, room))
    changes = find_changes(lit, with_patch=True)
    if changes is None:
        return np.empty(0, np.intp)
    return np.union1d(changes.lamp, changes.unexplained)


def _cheapest(tries: Sequence[Searched], pool: Executor) -> Searched:
    """Return the search whose guess costs least at the pixels of all searches."""
    if len(tries) == 1:
        return tries[0]

    def costs(judge: Searched) -> list[float]:
        return [last_cost(judge.search, one.guess)(one.guess) for one in tries]

    return tries[int(np.argmin(np.sum(list(pool.map(costs, tries)), axis=0)))]


def _kept_out(data: Dataset, room: Room, evidence: SceneEvidence) -> NDArray[np.bool_]:
    """Return which hours of the evidence the search does not see, [n]: blocks of sun directions.

    With fewer than three blocks it is every third hour.
    """
    try:
        kept_out = outside_hours(data, room)[evidence.rows]
    except NotEnoughDataError:
        kept_out = np.zeros(len(evidence), bool)
    if not kept_out.any() or kept_out.all():
        kept_out[OUTSIDE_EVERY - 1 :: OUTSIDE_EVERY] = True
    return kept_out


def _with_albedo(room: Room, albedo: Array) -> Room:
    """Return the room with the fitted albedos; solids already have theirs."""
    return replace(
        room,
        reflectance_walls=float(np.mean(albedo[:4])),
        reflectance_floor=float(albedo[4]),
        reflectance_ceiling=float(albedo[5]),
    )


def _facade_notes(before: Guess, guess: Guess) -> list[str]:
    """Return a note for each facade that was added because panes show it."""
    eye = np.array(guess.camera_m)
    notes = []
    for solid in guess.solids[len(before.solids) :]:
        low, high = np.array(solid.low_m), np.array(solid.high_m)
        away_m = float(np.max(np.maximum(low - eye, eye - high)[:2]))
        angle_deg = float(np.degrees(np.arctan2(high[2] - eye[2], away_m)))
        notes.append(
            f"panes show an object outside up to {angle_deg:.0f} degrees above the horizon; its "
            f"distance ({away_m:.0f} m assumed) is known only from the sun patches it hides: "
            "state an [[room.obstruction]] with its measures"
        )
    return notes


def _changed_notes(changed: int, captures: int) -> list[str]:
    """Return a note on captures of a changed room, if there are any."""
    if not changed:
        return []
    return [
        f"in {changed} of {captures} captures a lamp was on, or the light contradicts the other "
        "days: the fit does not use them; see the warnings of train"
    ]


def _notes(u: dict[str, float], evidence: SceneEvidence) -> list[str]:
    notes = []
    if u["north_deg"] > 0.2 and u["clock_min"] > 0.8:
        notes.append(
            f"north (+-{u['north_deg']:.1f} degrees) and clock (+-{u['clock_min']:.1f} min) "
            "cannot be separated well: capture another season, or pictures with the sun's disc"
        )
    if u["wall_azimuth_deg"] > OPEN_WALL_DEG:
        notes.append(
            f"the walls' azimuth (+-{u['wall_azimuth_deg']:.1f} degrees) and the window's edges "
            f"cannot be separated well: measure the edges again, to 1 cm"
        )
    if len(np.unique(evidence.days)) < 3:
        notes.append(
            "sunny hours on fewer than three days: the uncertainties do not "
            "include differences between days; capture more days"
        )
    return notes
