"""Run a scene fit from captures to scene.toml and pictures (`fieldlum scene fit`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path
from typing import Any, cast

import numpy as np

from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models import Patch
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.scores import Predictor
from fieldlum.room.fit.apply import with_scene
from fieldlum.room.fit.checks import check_captures, reversed_compass_note
from fieldlum.room.fit.evidence import gather
from fieldlum.room.fit.fit import SceneFit, fit_scene, scene_of
from fieldlum.room.fit.parameters import CLOCK_SD_MIN
from fieldlum.room.fit.pictures import draw
from fieldlum.room.fit.pose_prior import pose_note, pose_of, prior_of
from fieldlum.room.fit.scene_file import Chosen, Scene, write_scene
from fieldlum.room.fit.verdict import (
    OUTSIDE_EVERY,
    GeometryCandidate,
    GeometryScore,
    SceneVerdict,
    choose_geometry,
    judge,
)
from fieldlum.session import Session, check_writable
from fieldlum.sky.sky_view.measured_discs import read_discs

# With four or five, two of four scenes had 2.4 and 3.3 times their expected error.
MIN_HOURS_OUTSIDE = 6


@dataclass(frozen=True, slots=True)
class SceneResult:
    """A fitted scene, and the files that were written: scene.toml and two pictures."""

    scene: Scene
    files: tuple[Path, ...]


def run(
    data: Dataset,
    out: Path,
    *,
    clock_sd_min: float = CLOCK_SD_MIN,
    find_changes: Callable[..., Any] | None = None,
    progress: Progress = quiet,
) -> SceneResult:
    """Fit the scene of captures and write scene.toml, overlay.png and plan.png.

    out: the folder, created if needed. Centres of the sun's disc that merge measured are used if
    there are at least three. find_changes: see `fit_scene`. clock_sd_min: standard uncertainty of
    the captures' times. Raises InputError without a `[room]`, for one that is not a box, has no
    window or is impossible, for captures that contradict it (`checks.check_captures`), and for a
    damaged sidecar; NotEnoughDataError for fewer than six captures with direct sun on a window.
    Nothing is written then.
    """
    room = data.setup.room
    if room is None:
        raise InputError(
            data.source or "the site",
            "no [room]",
            "a box with a window, measured by tape",
            "add [room] to SITE.toml, or train with --scene none",
        )
    check_captures(data, room)
    check_writable(out)
    discs = read_discs(Session(Path(data.source).parent))
    pose = pose_of(discs, data.setup.site, data.heading_deg, clock_sd_min)
    note = reversed_compass_note(data, room)
    try:
        fit = fit_scene(
            data,
            room,
            pose=pose and prior_of(pose),
            clock_sd_min=clock_sd_min,
            find_changes=find_changes,
            progress=progress,
        )
    except NotEnoughDataError as error:
        raise NotEnoughDataError(f"{error}; {note}" if note else str(error)) from None
    scene = judged_scene(data, fit, progress=progress)
    if note:
        scene = replace(scene, notes=(note, *scene.notes))
    if pose is not None:
        scene = replace(scene, notes=(pose_note(pose, len(discs)), *scene.notes))
    files = [write_scene(out, scene)]
    used = fit.used(data)
    files += draw(out, used, fit, gather(used, room))
    return SceneResult(scene, tuple(files))


def judged_scene(data: Dataset, fit: SceneFit, *, progress: Progress = quiet) -> Scene:
    """Return the fit as a scene, with the geometry that `judge_fit` chooses.

    If the sunny hours have fewer than three blocks of sun directions (`outside_hours`), the misfit
    of patches on held-out hours chooses alone, the expected error is unknown
    (None), and the choice is not trusted. The choice is not trusted either with fewer than six
    held-out hours. data: all captures that the fit was given.
    """
    data, mean = fit.used(data), fit.misfits.mean()
    try:
        verdict = judge_fit(data, fit, progress=progress)
    except NotEnoughDataError as error:
        verdict = choose_geometry([GeometryScore(k, np.nan, m) for k, m in mean.items()])
        scene = scene_of(fit, cast("Chosen", verdict.chosen), verdict.reason)
        return replace(scene, trusted=False, notes=(*scene.notes, str(error)))
    scene = scene_of(fit, cast("Chosen", verdict.chosen), verdict.reason)
    outside = len(fit.misfits.none)
    if outside < MIN_HOURS_OUTSIDE:
        # Blocks of sun directions are held out: their share of the hours can be below a third.
        per_hour_outside = max(OUTSIDE_EVERY, fit.hours / max(outside, 1))
        needed = ceil(MIN_HOURS_OUTSIDE * per_hour_outside)
        note = (
            f"only {outside} of {fit.hours} clear hours were held out of the fit, too few to "
            f"confirm the chosen geometry; capture until there are {needed} clear hours in all"
        )
        scene = replace(scene, notes=(*scene.notes, note))
    return replace(
        scene,
        trusted=verdict.trusted and outside >= MIN_HOURS_OUTSIDE,
        expected_log10_mse=verdict.expected_log10_mse,
        trusted_share=verdict.trusted_share,
    )


def judge_fit(data: Dataset, fit: SceneFit, *, progress: Progress = quiet) -> SceneVerdict:
    """Choose between no patch, the stated box and the fitted scene; return the choice with reasons.

    Misfits of held-out hours, and the error that a transport model with each geometry expects over
    a year, decide (`choose_geometry`). Raises NotEnoughDataError if the sunny hours have fewer than
    three blocks of sun directions (`outside_hours`).
    """
    from fieldlum.learn.transport import fit as fit_transport

    def fit_model(captures: Dataset, patch: Patch) -> Predictor:
        return fit_transport(captures, patch=patch)

    mean = fit.misfits.mean()
    stated = replace(data, setup=replace(data.setup, room=fit.stated))
    bare = replace(stated, patch_cdm2=None)
    boxed = with_scene(stated, scene_of(fit, "stated", ""))
    fitted = with_scene(data, scene_of(fit, "fitted", ""))
    candidates = [
        GeometryCandidate("none", bare, mean["none"]),
        GeometryCandidate("stated", boxed, mean["stated"]),
        GeometryCandidate("fitted", fitted, mean["fitted"]),
    ]
    return judge(candidates, fit_model, progress=progress)
