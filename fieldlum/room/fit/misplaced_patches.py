"""Test north, clock and the room's measures by the places of captured sun patches, before training.

Sun patches have sharp edges. If computed patches are displaced from captured ones, held-out days
have large errors, but do not show the cause. Here the numbers of the stated room are searched as in
a scene fit, on the same evidence and cost; a number is wrong if its correction is far from zero.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.progress import progress
from fieldlum.core.records import listed
from fieldlum.learn.models import Patch
from fieldlum.learn.models.training_data import Dataset
from fieldlum.room.fit.evidence import COARSE_PIXELS
from fieldlum.room.fit.fit import MODEL_ERROR, SceneSearch
from fieldlum.room.fit.parameters import room_parameters
from fieldlum.room.fit.pose_prior import PosePrior
from fieldlum.room.fit.search import STEP_SHARES, covariance, search
from fieldlum.room.fit.turned_windows import turned_windows_note
from fieldlum.room.scene.box_room import is_box_with_window

MIN_HOURS = 3  # sunny captures that a test needs; chosen
MIN_UNCERTAINTIES = 3.0  # smallest ratio of a correction to its standard uncertainty; chosen
# Smallest corrections that are reported: a compass and a hand-set clock are no better. Chosen.
# Lengths are not reported: they absorb what the room has and a box lacks, such as a blind.
MIN_OFF = {"north_deg": 0.5, "wall_azimuth_deg": 0.5, "clock_min": 1.0}
MIN_GAIN = 0.02  # share of the misfit that wrong numbers must explain; chosen
_WORDS = {  # what a correction is of, its unit, and what it is if the correction is over or under 0
    "north_deg": ("heading_deg and wall_azimuth_deg", "degrees", "small", "large"),
    "wall_azimuth_deg": ("wall_azimuth_deg alone", "degrees", "small", "large"),
    "clock_min": ("the pictures' times", "minutes", "late", "early"),
}
_ANY_CLOCK_MIN = 60.0  # standard uncertainty of a clock that nobody compared; chosen


@dataclass(frozen=True, slots=True)
class Misplacement:
    """Wrong settings that would explain why sun patches are not where they are computed.

    off: by the name of a number (`Parameter.name`), the correction that must be added to the stated
    one, and its standard uncertainty, which includes what a box lacks (deg, min; clock_min above
    0: stated times are later than the true ones); empty if nothing is wrong. gain: share of the
    misfit, 0 to 1, that corrections explain, in `hours` sunny hours. note: a sentence on a grossly
    wrong direction, "" without; with it nothing else was tested.
    """

    off: dict[str, tuple[float, float]] = field(default_factory=dict)
    gain: float = 0.0
    hours: int = 0
    note: str = ""


def misplacement_of(data: Dataset, patch: Patch) -> Misplacement | None:
    """Return what is wrong with north, clock and the room's measures, by captured sun patches.

    Return None if nothing can be tested: patches are not used (patch "none", or `data` has none),
    the room is not a box with windows, or under three captures have direct sun on a window. Raises
    InputError for an impossible room.
    """
    room = data.setup.room
    if patch == "none" or data.patch_cdm2 is None or not is_box_with_window(room):
        return None
    if note := turned_windows_note(data, room):
        note += "; check heading_deg, wall_azimuth_deg and the windows' walls"
        return Misplacement(note=note)
    progress(0, 100, "setting: light without patches")
    try:
        state = SceneSearch(data, room, _disc_pose(data), pixels=COARSE_PIXELS, min_hours=MIN_HOURS)
    except NotEnoughDataError:
        return None
    # A wrong north or clock has no prior: a compass near steel is off by any angle.
    parameters = state.parameters = [
        replace(p, sd=np.inf) if p.name in ("north_deg", "clock_min") else p
        for p in room_parameters(state.start)
    ]
    progress(30, 100, "setting: north, clock and room")
    # the first estimate of the light below the patches includes a part of them
    for step_shares in (STEP_SHARES, STEP_SHARES[1:]):
        state.accept(search(state.cost(), state.guess, parameters, step_shares)[0])
    cost = state.cost()
    guess, final = search(cost, state.guess, parameters, STEP_SHARES[1:])
    u_steps = np.sqrt(np.diag(covariance(cost, guess, parameters)))
    off: dict[str, tuple[float, float]] = {}
    for p, steps in zip(parameters, u_steps.tolist(), strict=True):
        by, u = p.measured(guess) - p.measured(state.start), steps * p.step
        if p.name in MIN_OFF and abs(by) > max(MIN_UNCERTAINTIES * u, MIN_OFF[p.name]):
            off[p.name] = (by, MODEL_ERROR * u)
    gain = 1.0 - final / cost(state.start)
    return Misplacement(off if gain > MIN_GAIN else {}, gain, len(state.evidence))


def _disc_pose(data: Dataset) -> PosePrior | None:
    """Return the camera's pose by sun discs in the captures, with any clock; None without discs."""
    if data.sky_view is None or not data.sky_view.pose.discs:
        return None
    pose, covariance = data.sky_view.pose, np.diag([0.0, 0.0, 0.0, _ANY_CLOCK_MIN**2])
    covariance[:3, :3] = np.asarray(pose.covariance)[:3, :3]
    return PosePrior(np.append(pose.values[:3], 0.0), covariance)


def warnings_of(misplacement: Misplacement | None) -> list[str]:
    """Return a sentence that warns of wrong settings; none if nothing is certain.

    It names no single cause: in rooms of other renderers whose north was 2 degrees off, patches
    were displaced as by a clock that is 14 minutes off. misplacement: by `misplacement_of`.
    """
    if misplacement is None or not (misplacement.note or misplacement.off):
        return []
    if misplacement.note:
        return [f"WARNING: {misplacement.note}"]
    return [
        f"WARNING: captured sun patches are displaced from the computed ones ({misplacement.hours} "
        f"hours), as if {listed([_cause(n, *v) for n, v in misplacement.off.items()])}. This "
        f"explains {misplacement.gain:.0%} of the misfit; a wrong north, clock, window or camera "
        "place look alike. Check them before you change one; then run fieldlum scene fit"
    ]


def _cause(name: str, by: float, u: float) -> str:
    """Return a clause on the correction of a parameter and its uncertainty, deg or min."""
    what, unit, above, below = _WORDS[name]
    return f"{what} were {abs(by):.1f} +- {u:.1f} {unit} too {above if by > 0 else below}"
