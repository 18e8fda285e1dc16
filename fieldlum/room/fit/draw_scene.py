"""Draw a fitted scene: patch edges over captures, and the room from above."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Indices
from fieldlum.learn.models.training_data import Dataset
from fieldlum.room.fit.apply_scene import with_patches, with_scene
from fieldlum.room.fit.scene_file import Scene
from fieldlum.room.fit.sunny_hours import direct_on_windows_lx, sunny_hours
from fieldlum.room.scene.drawing import write_room
from fieldlum.session import replacing_path

SHOWN_HOURS = 4  # chosen: one page in print
FITTED_COLOUR, STATED_COLOUR = "#d62728", "#1f77b4"


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

    rows = _rows_to_draw(data)
    hours = data.take(rows)
    fitted = with_scene(hours, scene).patch_cdm2
    stated = with_patches(hours).patch_cdm2
    assert fitted is not None and stated is not None
    figure = Figure(figsize=(9, 4.2 * len(rows)))
    axes = figure.subplots(len(rows), 1, squeeze=False)
    for k, axis in enumerate(axes[:, 0]):
        axis.imshow(np.log10(np.maximum(hours.luminance_cdm2[k], 1.0)), cmap="gray")
        for patch, colour in ((stated[k], STATED_COLOUR), (fitted[k], FITTED_COLOUR)):
            if (patch > 0.0).any():
                axis.contour(patch > 0.0, levels=[0.5], colors=[colour], linewidths=0.9)
        axis.set_title(f"{hours.slots[k]}: patches fitted (red) and as stated (blue)", fontsize=9)
        axis.set_axis_off()
    return figure


def _rows_to_draw(data: Dataset) -> Indices:
    """Return the indices of up to four sunny hours, of each quarter the one with most direct sun.

    Direct sun is that on a window; quarters are of the sunny hours in time order.
    """
    direct_lx = direct_on_windows_lx(data, data.setup.room)
    parts = np.array_split(np.flatnonzero(sunny_hours(data, data.setup.room)), SHOWN_HOURS)
    return np.array([part[np.argmax(direct_lx[part])] for part in parts if len(part)])
