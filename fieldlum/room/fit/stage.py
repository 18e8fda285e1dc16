"""Run a scene fit from captures to scene.toml and pictures (`fieldlum scene fit`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models.data import Dataset
from fieldlum.room.fit.apply import with_scene
from fieldlum.room.fit.checks import check_captures, reversed_compass_note
from fieldlum.room.fit.evidence import gather
from fieldlum.room.fit.fit import SceneFit, fit_scene, scene_of
from fieldlum.room.fit.parameters import CLOCK_SD_MIN
from fieldlum.room.fit.pictures import draw
from fieldlum.room.fit.pose_prior import pose_note, pose_of, prior_of
from fieldlum.room.fit.scene_file import Scene, write_scene
from fieldlum.room.fit.verdict import MIN_TRUSTED_SHARE, choose_geometry, doubt, expected_year
from fieldlum.session import Session, check_writable
from fieldlum.sky.sky_view.measured_discs import read_discs


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
    """Return the fit as a scene, with the geometry of the smallest misfit and its expected error.

    The scene is trusted if there are enough sunny hours (`verdict.doubt`), and if the model trusts
    at least half of a year's hours. With fewer than three directions of the sun, the expected error
    is unknown (None). data: all captures that the fit was given.
    """
    data = fit.used(data)
    chosen, reason = choose_geometry(fit.misfit)
    scene = scene_of(fit, chosen, reason)
    why = doubt(data, fit.stated, fit.hours)
    if why:
        scene = replace(scene, trusted=False, notes=(*scene.notes, why))
    if "directions" in why:
        return scene
    stated = replace(data, setup=replace(data.setup, room=fit.stated))
    year = expected_year(with_scene(stated, scene), progress)
    share = 100.0 * year.trusted_share
    return replace(
        scene,
        verdict=f"{reason}; the model trusts {share:.0f} % of a year's hours",
        trusted=scene.trusted and year.trusted_share >= MIN_TRUSTED_SHARE,
        expected_log10_mse=year.expected_log10_mse,
        trusted_share=year.trusted_share,
    )
