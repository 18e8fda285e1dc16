"""Run a scene fit from captures to scene.toml and pictures (`fieldlum scene fit`)."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.errors import InputError
from fieldlum.core.records import Room
from fieldlum.learn.models.training_data import Dataset, with_sky_view
from fieldlum.room.fit import apply_scene, parameters, turned_windows
from fieldlum.room.fit.fit import fit_scene
from fieldlum.room.fit.pose_prior import pose_note, pose_of, prior_of
from fieldlum.room.fit.scene_file import Chosen, Scene, write_scene
from fieldlum.room.fit.sunny_hours import direct_on_windows_lx, sunny_hours
from fieldlum.room.scene.drawing import write_room
from fieldlum.session import Session, check_writable, replacing_path
from fieldlum.sky.sky_view.measured_discs import read_discs

_SHOWN_HOURS = 4  # in the picture of the fit; chosen: one page in print
_FITTED_COLOUR, _STATED_COLOUR = "#d62728", "#1f77b4"


def run(
    data: Dataset, out: Path, *, clock_sd_min: float = parameters.CLOCK_SD_MIN
) -> tuple[Scene, list[Path]]:
    """Fit the scene of captures and write scene.toml, overlay.png and plan.svg.

    Return the scene and the paths of the files. out: the folder, created if needed. Centres of the
    sun's disc that merge measured are used if there are at least three. clock_sd_min: standard
    uncertainty of the captures' times. Raises InputError without a `[room]`, for one that is not a
    box, has no window or is impossible, for captures that contradict it (`check_captures`),
    and for a damaged sidecar; NotEnoughDataError for fewer than six captures with direct sun on a
    window. Nothing is written then.
    """
    room = data.setup.room
    if room is None:
        expected = "a box with a window, measured by tape"
        remedy = "add [room] to SITE.toml, or train with --scene none"
        raise InputError(data.source or "the site", "no [room]", expected, remedy)
    turned_windows.check_captures(data, room)
    check_writable(out)
    data = with_sky_view(data)
    discs = read_discs(Session(Path(data.source).parent))
    pose = pose_of(discs, data.setup.site, data.heading_deg, clock_sd_min)
    fitted = fit_scene(data, room, pose=pose and prior_of(pose), clock_sd_min=clock_sd_min)
    scene = judged_scene(data, fitted)
    if pose is not None:
        scene = replace(scene, notes=(pose_note(pose, len(discs)), *scene.notes))
    pictures = draw(out, data, fitted)
    return scene, [write_scene(out, scene), *pictures]


def judged_scene(data: Dataset, fitted: Scene) -> Scene:
    """Return a fitted scene with `chosen` (the geometry of the smallest misfit) and its verdict.

    `trusted` is True if there are enough sunny hours (`why_untrusted`); if not, the reason is added
    to its notes. data: the captures of the fit.
    """
    chosen, reason = choose_geometry(fitted.misfit)
    doubt = why_untrusted(data, fitted.stated_room, fitted.hours)
    notes = (*fitted.notes, doubt) if doubt else fitted.notes
    return replace(fitted, chosen=chosen, verdict=reason, trusted=not doubt, notes=notes)


# ----------------------------------------------------------------------------------------------
# the verdict

# Chosen: suns closer than this are one direction; neighbouring hours are 12 to 15 degrees apart.
SAME_DIRECTION_DEG = 9.0
# Chosen: fewer clear hours or directions of the sun do not confirm a scene.
MIN_CLEAR_HOURS, MIN_DIRECTIONS = 18, 3
# Chosen: a scene with a larger misfit, as a share of that without patches, lacks something.
MAX_UNEXPLAINED = 0.5


def directions_apart(suns: Floats) -> int:
    """Return the number of suns that are at least 9 degrees from each one counted before.

    suns: unit vectors [n, 3], counted in their order.
    """
    apart = suns[:1]
    for sun in suns[1:]:
        if (apart @ sun).max() < np.cos(np.radians(SAME_DIRECTION_DEG)):
            apart = np.vstack([apart, sun])
    return len(apart)


def why_untrusted(data: Dataset, room: Room, hours: int) -> str:
    """Return a sentence on why sunny hours cannot confirm a scene; empty if they can.

    They cannot if they are too few, or have fewer than three different directions of the sun. room:
    the stated one; hours: number that the fit used.
    """
    sunny = sunny_hours(data, room)
    directions = directions_apart(data.light.sun_direction[sunny])
    if directions < MIN_DIRECTIONS:
        return (
            f"{int(sunny.sum())} sunny hours with only {directions} different directions of the "
            f"sun; at least {MIN_DIRECTIONS} are needed to judge a scene: capture clear hours all "
            "over a day"
        )
    if hours < MIN_CLEAR_HOURS:
        return (
            f"only {hours} clear hours, too few to confirm the fitted scene; capture until there "
            f"are {MIN_CLEAR_HOURS}"
        )
    return ""


def choose_geometry(misfit: Mapping[str, float]) -> tuple[Chosen, str]:
    """Return the geometry of the smallest misfit, "none", "stated" or "fitted", and the reason.

    misfit: mean of `SceneEvidence.misfit` in the sunny hours, for each of these three.
    """
    names: tuple[Chosen, ...] = ("none", "stated", "fitted")
    chosen = min(names, key=lambda name: misfit[name])
    each = ", ".join(f"{name} {misfit[name]:.3f}" for name in names)
    reason = f"{chosen}, by the misfit of sun patches in sunny hours ({each})"
    unexplained = misfit[chosen] / max(misfit["none"], 1e-9)
    if chosen != "none" and unexplained > MAX_UNEXPLAINED:
        reason += (
            f"; its sun patches leave {100.0 * unexplained:.0f} % of the misfit without patches: "
            "the room has something that the scene lacks (slats, leaves, a slope); see overlay.png"
        )
    return chosen, reason


def draw(folder: Path, data: Dataset, scene: Scene) -> list[Path]:
    """Write overlay.png and plan.svg into a folder and return their paths.

    overlay.png: edges of fitted and stated patches over up to four captures; plan.svg: the fitted
    room from above. The folder is created; existing files are replaced. data: the captures of the
    fit; scene: its `chosen` must be "fitted", as `fit_scene` returns it. Raises InputError
    as `with_scene`.
    """
    figure = _overlay(data, scene)
    with replacing_path(folder / "overlay.png") as temporary:
        figure.savefig(temporary, dpi=110, bbox_inches="tight")
    heading_deg = (data.heading_deg + scene.north_deg) % 360.0
    camera = replace(data.setup.camera, heading_deg=heading_deg)
    fitted = replace(data.setup, camera=camera, room=scene.room)
    write_room(fitted, folder / "plan.svg")
    return [folder / "overlay.png", folder / "plan.svg"]


def _overlay(data: Dataset, scene: Scene) -> Any:
    """Return a figure of up to four captures in grey, with the edges of fitted and stated patches.

    A matplotlib Figure.
    """
    from matplotlib.figure import Figure

    # of each quarter of the sunny hours, in time order, the one with most direct sun on a window
    direct_lx = direct_on_windows_lx(data, data.setup.room)
    parts = np.array_split(np.flatnonzero(sunny_hours(data, data.setup.room)), _SHOWN_HOURS)
    rows = np.array([part[np.argmax(direct_lx[part])] for part in parts if len(part)])
    hours = data.take(rows)
    fitted = apply_scene.with_scene(hours, scene).patch_cdm2
    stated = apply_scene.with_patches(hours).patch_cdm2
    assert fitted is not None and stated is not None
    figure = Figure(figsize=(9, 4.2 * len(rows)))
    axes = figure.subplots(len(rows), 1, squeeze=False)
    for k, axis in enumerate(axes[:, 0]):
        axis.imshow(np.log10(np.maximum(hours.luminance_cdm2[k], 1.0)), cmap="gray")
        for patch, colour in ((stated[k], _STATED_COLOUR), (fitted[k], _FITTED_COLOUR)):
            if (patch > 0.0).any():
                axis.contour(patch > 0.0, levels=[0.5], colors=[colour], linewidths=0.9)
        axis.set_title(f"{hours.slots[k]}: patches fitted (red) and as stated (blue)", fontsize=9)
        axis.set_axis_off()
    return figure
