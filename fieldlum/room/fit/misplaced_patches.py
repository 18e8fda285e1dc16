"""Test north, clock and the room's measures by the places of captured sun patches, before training.

Sun patches have sharp edges. If computed patches are displaced from captured ones, held-out days
have large errors, but do not show the cause. Here the numbers of the stated room are searched as in
a scene fit, on the same evidence and cost; a number is wrong if its correction is far from zero.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.progress import progress
from fieldlum.core.records import SiteFile
from fieldlum.learn.models import Patch
from fieldlum.learn.models.training_data import Dataset
from fieldlum.room.fit.evidence import COARSE_PIXELS
from fieldlum.room.fit.fit import SceneSearch
from fieldlum.room.fit.parameters import room_parameters
from fieldlum.room.fit.search import STEP_SHARES, covariance, search
from fieldlum.room.fit.turned_windows import turned_windows_note
from fieldlum.room.scene.box_room import is_box_with_window

MIN_HOURS = 3  # sunny captures that a test needs; chosen
MIN_UNCERTAINTIES = 3.0  # smallest ratio of a correction to its standard uncertainty; chosen
# Smallest corrections that are reported: a compass and a hand-set clock are no better. Chosen.
MIN_OFF = {"north_deg": 0.5, "wall_azimuth_deg": 0.5, "clock_min": 1.0}
# A length that is off by more standard deviations of a tape is wrong, not inaccurate; chosen.
TAPE_SDS = 3.0
MIN_GAIN = 0.02  # share of the misfit that wrong numbers must explain; chosen


@dataclass(frozen=True, slots=True)
class Misplacement:
    """Wrong settings that would explain why sun patches are not where they are computed.

    off: by the name of a number (`Parameter.name`), the correction that must be added to the stated
    one, and its standard uncertainty (deg, min, m; clock_min above 0: stated times are later than
    the true ones); empty if nothing is wrong. gain: share of the misfit, 0 to 1, that this
    explains, in `hours` sunny hours. note: a sentence on a grossly wrong direction, "" without;
    with it nothing else was tested.
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
        state = SceneSearch(data, room, pixels=COARSE_PIXELS, min_hours=MIN_HOURS)
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
        enough = max(MIN_UNCERTAINTIES * u, MIN_OFF.get(p.name, TAPE_SDS * p.sd))
        if abs(by) > enough and p.name not in ("tilt_deg", "roll_deg"):
            off[p.name] = (by, u)
    # Lengths also absorb what the room has and a box lacks: they count if nothing else is wrong.
    off = {name: value for name, value in off.items() if name in MIN_OFF} or off
    gain, hours = 1.0 - final / cost(state.start), len(state.evidence)
    if off and gain > MIN_GAIN:
        return Misplacement(off, gain=gain, hours=hours)
    return Misplacement(hours=hours)


def warnings_of(misplacement: Misplacement | None, setup: SiteFile) -> list[str]:
    """Return lines that warn of a wrong setting: what is wrong, then a remedy for each cause.

    misplacement: result of `misplacement_of`; setup: of the captures. The list is empty if nothing
    is certain. Nothing is corrected: a wrong north must be corrected in SITE.toml, which all stages
    read.
    """
    if misplacement is None:
        return []
    hours, off, gain = misplacement.hours, misplacement.off, misplacement.gain
    if misplacement.note or not off:
        return [f"WARNING: {misplacement.note}"] if misplacement.note else []
    causes, remedies = zip(*(_advice(name, off[name], setup) for name in off), strict=True)
    return [
        f"WARNING: captured sun patches are displaced from the computed ones ({hours} hours): "
        f"{', '.join(causes)}, which explains {gain:.0%} of the misfit",
        *(f"to fix {name}: {remedy}" for name, remedy in zip(off, remedies, strict=True)),
    ]


def _advice(name: str, off: tuple[float, float], setup: SiteFile) -> tuple[str, str]:
    """Return a clause on what is wrong, and a remedy, such as what to write into SITE.toml.

    off: correction of the parameter `name`, and its standard uncertainty, deg, min or m.
    """
    (by, u), room = off, setup.room
    azimuth = ((room.wall_azimuth_deg if room else 180.0) + by) % 360.0
    wall, again = f"[room] wall_azimuth_deg = {azimuth:.1f}", "then merge, pair and train again"
    if name == "north_deg":
        heading = f"[camera] heading_deg = {(setup.camera.heading_deg + by) % 360.0:.1f}"
        remedy = f"check the compass; in SITE.toml {wall} and {heading}, {again}"
        return f"north is wrong by {by:+.1f} +- {u:.1f} degrees", remedy
    if name == "clock_min":
        late, change = ("late", "increased") if by > 0 else ("early", "decreased")
        remedy = (
            f"the recorded times of the pictures are {abs(by):.1f} min too {late}: correct the "
            "clock that recorded them (the computer's for fieldlum capture, else the camera's), or "
            f"import the card again with --utc-offset {change} by {abs(by):.1f} min, {again}"
        )
        return f"the clock is wrong by {by:+.1f} +- {u:.1f} minutes", remedy
    if name == "wall_azimuth_deg":
        remedy = f"check where the window wall faces; in SITE.toml {wall}, then train again"
        turned = f"turned clockwise by {by:+.1f} +- {u:.1f} degrees"
        return f"the room, not the camera, is {turned}", remedy
    return f"{name} would have to be {by:+.2f} +- {u:.2f} m off", (
        "measure the camera's place and the windows again; if they are right, the room has what "
        "[room] lacks: run fieldlum scene fit"
    )
