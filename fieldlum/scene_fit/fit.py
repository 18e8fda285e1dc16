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

# Searches stop in different places near the best scene, and are joined (decision 41). Two, because
# a laptop has two cores or more (decision 33).
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
    prior = StatedRoom(room, pose, clock_sd_min)

    def search_all(captures: Dataset, shown: Progress) -> tuple[list[Searched], Searched]:
        def searched(number: int) -> Searched:
            shown_by = quiet if number else shown
            return _searched(captures, prior, pixels, seed + number, shown_by)

        tries = list(pool.map(searched, range(starts)))
        return tries, _cheapest(tries, pool)

    # Two searches fill two cores; threads of BLAS would only wait for each other.
    with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(starts) as pool:
        tries, best = search_all(data, progress)
        changed = _changed_captures(data, best, room)
        if len(changed) < _FEWEST_CHANGED:
            changed = changed[:0]
        else:
            rest = data.take(np.setdiff1d(np.arange(len(data)), changed))

            def again(done: int, total: int, text: str) -> None:
                progress(done, total, f"{text}, without {len(changed)} captures of a changed room")

            try:
                tries, best = search_all(rest, again)
                data = rest
            except NotEnoughDataError:  # too few sunny hours without them
                changed = changed[:0]
        search, misfits = best.search, best.misfits
        guess = best.guess
        if others := [one.guess for one in tries if one is not best]:
            progress(90, 100, "both searches together")
            more, new = 2 * pixels, seed + starts
            guess = joined(search, guess, others, pixels=more, seed=new, pool=pool)
            search.relight(guess)
    inside = guess
    cost = last_cost(search, inside)
    guess = with_skyline(cost, data, inside)
    progress(95, 100, "uncertainties")
    spread = posterior(search.objective(search.evidence), guess, room, seed)
    coarse = search.objective(search.evidence.coarse().thinned(REACH_EVERY))
    reach = reach_of(coarse, guess, (WALL, CLOCK) if prior.is_clock_open else (WALL,))
    u = {
        name: float(np.linalg.norm((u, search.valley[name], reach[name])))
        for name, u in spread.u.items()
    }
    before = {p.name: p.read(search.start) for p in search.parameters}
    after = {p.name: p.read(guess) for p in search.parameters}
    room_found = _with_albedo(room_of(guess, room), search.albedo)
    notes = (
        *_notes(u, search.evidence),
        *_facade_notes(inside, guess),
        *body_notes(cost, inside, len(search.start.solids)),
    )
    if len(changed):
        notes += (
            f"in {len(changed)} of {len(data) + len(changed)} captures a lamp was on, or the light "
            "contradicts the other days: the fit does not use them; see the warnings of train",
        )
    progress(100, 100, "")
    return SceneFit(
        room,
        data.heading_deg,
        guess,
        room_found,
        search.albedo_with_solids(guess),
        before,
        after,
        u,
        misfits,
        len(search.evidence),
        notes,
        spread.room_draws,
        changed,
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
