"""Choose between the stated box and no sun patch, without a fitted scene and with few clear hours.

As no search used the captures, all hours with direct sun judge the box.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Room
from fieldlum.learn.models.training_data import Dataset
from fieldlum.room.fit.apply_scene import apply_scene, with_patches, with_scene
from fieldlum.room.fit.evidence import scene_evidence
from fieldlum.room.fit.guess import guess_of
from fieldlum.room.fit.parameters import stated_albedo
from fieldlum.room.fit.scene_file import Chosen, Scene
from fieldlum.room.fit.sunny_hours import MIN_SUNNY_HOURS, sunny_hours
from fieldlum.room.scene.geometry import is_box_with_window

# With fewer clear hours, held-out days chose plain recipes for patches of a tape-measured box in
# two rooms of four, with up to 2.6 times the error.
MIN_CLEAR_HOURS = 12
# Of no patch. Chosen: with half of its patches beside the true ones a box has 1.5 times the misfit.
# The model gives such patches little weight, so that they do less harm than their misfit states.
MAX_BOX_MISFIT = 1.5
# Chosen: of the sum of two pictures of patches, beyond rounding; other patches are of a 3D model.
MAX_OTHER_SHARE = 0.02


def judge_box(data: Dataset, room: Room) -> tuple[Chosen, str] | None:
    """Choose between no patch ("none") and the stated box ("stated"); return the choice and why.

    With 12 clear hours or more the result is None.
    A clear hour has over 1 000 lx of direct sun on a window. The box is not used if its patches
    have over 1.5 times the misfit of no patch. Otherwise, also if no capture has direct sun on a
    window, it is used: a box of about the right place predicts suns that were not captured better
    than no patch does. Raises InputError for a room that, with fewer clear hours, is not a
    box, has no window or is impossible.
    """
    clear = int(sunny_hours(data, room).sum())
    if clear >= MIN_CLEAR_HOURS:
        return None
    remedy = (
        f"run fieldlum scene fit (from {MIN_SUNNY_HOURS} captures with direct sun), and capture "
        f"{MIN_CLEAR_HOURS} clear hours for a trusted scene ({clear} so far)"
    )
    try:
        evidence = scene_evidence(data, room, min_hours=1)
    except NotEnoughDataError:
        reason = f"stated [room]: no capture has direct sun on a window to test it; {remedy}"
        return "stated", reason
    start = guess_of(room, data.heading_deg)
    patch = evidence.patches(start, evidence.albedos(start, stated_albedo(room)))
    stated = float(evidence.misfit(patch).mean())
    none = float(evidence.misfit(np.zeros_like(patch)).mean())
    chosen: Chosen = "none" if stated > MAX_BOX_MISFIT * none else "stated"
    cause = ": check north, the clock and the windows of [room]" if chosen == "none" else ""
    name = {"stated": "stated [room]", "none": "no sun patch"}[chosen]
    return chosen, (
        f"{name}: misfit of sun patches in {len(evidence)} captures with direct sun: {none:.3f} "
        f"without patches, {stated:.3f} with those of [room], which must be under "
        f"{MAX_BOX_MISFIT:g} times as large{cause}; {remedy}"
    )


def training_captures(data: Dataset, pairs: Path, option: str, patch: str) -> tuple[Dataset, str]:
    """Return captures as `train` learns them, and the patch mode for training.

    Arguments and errors are those of `apply_scene`. If `option` is empty and there is no scene,
    captures with few clear hours decide whether the stated box is used, as in `with_judged_box`.
    """
    data, patch = apply_scene(data, pairs, option, patch)
    return (data, patch) if option else with_judged_box(data, patch)


def with_judged_box(data: Dataset, patch: str) -> tuple[Dataset, str]:
    """Return captures without a scene as `judge_box` decides, and the patch mode for training.

    If it decides for the box, they have its patches; if not, none, and the mode is "none". They do
    not change with a scene, with 12 clear hours or more, with `patch` "none", without a box
    `[room]` with windows, or with sun patches of another source than this room. As edges measured
    by tape are wrong by centimetres, patches of the stated box are learnt like those of a fitted
    scene, by robust recipes. Raises InputError for an impossible room.
    """
    room = data.setup.room
    if data.scene is not None or patch == "none" or not is_box_with_window(room):
        return data, patch
    judged = judge_box(data, room)
    if judged is None or not _has_patches_of_room(data):
        return data, patch
    chosen, reason = judged
    scene = Scene(
        north_deg=0.0,
        clock_min=0.0,
        room=room,
        chosen=chosen,
        verdict=reason,
        stated_heading_deg=data.heading_deg,
        stated_room=room,
    )
    data = with_scene(data, scene)
    return replace(data, notes=(*data.notes, reason)), "none" if chosen == "none" else patch


def with_same_box(data: Dataset, trained: Dataset) -> Dataset:
    """Return captures to predict with the choice that `with_judged_box` made for training.

    data: result of `apply_scene`; trained: the training captures. If these have no patches by that
    choice, neither does the result; if they have those of the stated box, it has those of its own
    box. Captures do not change if they have a scene, if `trained` has none, or, for the stated
    box, if they have no box with windows. Raises InputError for an impossible room.
    """
    if data.scene is not None or trained.scene is None:
        return data
    if trained.scene["chosen"] == "none":
        return replace(data, patch_cdm2=None, scene=trained.scene)
    if not is_box_with_window(data.setup.room):
        return data
    return with_patches(replace(data, scene=trained.scene))


def _has_patches_of_room(data: Dataset) -> bool:
    """Return whether the captures have no patches, or those of their `[room]`."""
    if data.patch_cdm2 is None:
        return True
    computed = with_patches(data).patch_cdm2
    assert computed is not None
    difference = float(np.abs(computed - data.patch_cdm2).sum())
    return difference <= MAX_OTHER_SHARE * float(computed.sum() + data.patch_cdm2.sum())
