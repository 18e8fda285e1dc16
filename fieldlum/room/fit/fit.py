"""Fit a scene to captures: from the stated box to north, clock, edges, bars and furniture.

About a third of the sunny hours is held out of the search, as blocks of sun directions. An element
remains only if it does not raise the misfit of these hours. The reported misfits (no patch, stated
box, fitted scene) are those of the held-out hours.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from fieldlum.core.arrays import Indices
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Progress, Room, quiet
from fieldlum.learn.train.outliers import find_changes
from fieldlum.room.fit.corrected import corrected, with_patches
from fieldlum.room.fit.evidence import PIXELS, SceneEvidence, gather
from fieldlum.room.fit.guess import Guess, room_of
from fieldlum.room.fit.misfits import Misfits, misfits_of
from fieldlum.room.fit.parameters import CLOCK_SD_MIN
from fieldlum.room.fit.posterior import posterior, true_room
from fieldlum.room.fit.scene_search import SceneSearch
from fieldlum.room.fit.stated_room import StatedRoom
from fieldlum.room.fit.verdict import OUTSIDE_EVERY, outside_hours

if TYPE_CHECKING:
    from fieldlum.learn.models.data import Dataset
    from fieldlum.room.fit.pose_prior import PosePrior

Array = NDArray[np.floating]

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
    uncertainties, by parameter name. misfits: of the held-out hours. hours: number of sunny hours,
    with the held-out ones. notes: sentences for the user. room_draws: see `posterior.Posterior`.
    changed: indices of captures of a changed room, which were not used [k].
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
    progress: Progress = quiet,
) -> SceneFit:
    """Find the scene that explains the sun patches of the captures, starting from the stated box.

    pose: camera pose and clock from the sun's discs, if any. clock_sd_min: standard uncertainty of
    the stated times; it is ignored with `pose`, which includes it. pixels: number to sample. If
    captures of a changed room are found with the scene's patches, the search is repeated without
    them. Raises InputError for a room that is not a box, has no window or is impossible,
    NotEnoughDataError for fewer than six captures with direct sun on a window.
    """
    prior = StatedRoom(room, pose, clock_sd_min)
    with threadpool_limits(1, user_api="blas"):
        search, guess, misfits = _searched(data, prior, pixels, seed, progress)
        changed = _changed_captures(data, search, guess)
        if len(changed) >= _FEWEST_CHANGED:
            rest = data.take(np.setdiff1d(np.arange(len(data)), changed))
            try:
                search, guess, misfits = _searched(rest, prior, pixels, seed, progress)
            except NotEnoughDataError:
                changed = changed[:0]
        else:
            changed = changed[:0]
        progress(90, 100, "uncertainties")
        spread = posterior(search.objective(search.evidence), guess, room, seed)
    progress(100, 100, "")
    return SceneFit(
        stated=room,
        heading_deg=data.heading_deg,
        guess=guess,
        room=_with_albedo(room_of(guess, room), search.albedo),
        albedo=search.albedo_with_solids(guess),
        before={p.name: p.read(search.start) for p in search.parameters},
        after={p.name: p.read(guess) for p in search.parameters},
        u=spread.u,
        misfits=misfits,
        hours=len(search.evidence),
        notes=(*_notes(spread.u, search.evidence), *_changed_notes(len(changed), len(data))),
        room_draws=spread.room_draws,
        changed=changed,
    )


def _searched(
    data: Dataset, prior: StatedRoom, pixels: int, seed: int, progress: Progress
) -> tuple[SceneSearch, Guess, Misfits]:
    """Search the scene at random pixels drawn with `seed`; return it with its held-out misfits."""
    progress(0, 100, "light below the patches")
    evidence = gather(data, prior.room, pixels=pixels, seed=seed)
    kept_out = _kept_out(data, prior.room, evidence)
    search = SceneSearch(data, evidence, np.flatnonzero(~kept_out), np.flatnonzero(kept_out), prior)
    guess = search.run(lambda done, text: progress(done, 100, text))
    held_out = search.evidence.hours(search.kept_out)
    misfits = misfits_of(held_out, search.start, guess, search.albedo_with_solids(guess))
    return search, guess, misfits


def _changed_captures(data: Dataset, search: SceneSearch, guess: Guess) -> Indices:
    """Return the captures with a lamp, or that contradict the other days, under a scene's patches.

    They are indices from 0 [k].
    """
    room = _with_albedo(true_room(guess, search.stated.room), search.albedo)
    lit = with_patches(corrected(data, guess.north_deg, guess.clock_min, room))
    changes = find_changes(lit, with_patch=True)
    if changes is None:
        return np.empty(0, np.intp)
    return np.union1d(changes.lamp, changes.unexplained)


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
