"""Draw a fitted scene: patch edges over captures, windows as the sun sees them, the plan."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fieldlum.core.arrays import Indices
from fieldlum.room.fit.apply_scene import with_patches, with_scene
from fieldlum.room.fit.evidence import SceneEvidence
from fieldlum.room.fit.fit import SceneFit, scene_of
from fieldlum.room.fit.guess import Guess, Solid
from fieldlum.room.scene.geometry import WALLS, wall_named

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fieldlum.core.records import Room
    from fieldlum.learn.models.data import Dataset

SHOWN_HOURS = 4  # chosen: one page in print
PLAN_MARGIN_M = 2.0  # chosen: shows what is next to the walls
FITTED_COLOUR, STATED_COLOUR = "#d62728", "#1f77b4"


def draw(folder: Path, data: Dataset, fit: SceneFit, evidence: SceneEvidence) -> list[Path]:
    """Write overlay.png and plan.png into a folder and return their paths.

    overlay.png: edges of fitted and stated patches over up to four captures; plan.png: the room
    from above. The folder is created; existing files are replaced.
    """
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    folder.mkdir(parents=True, exist_ok=True)
    makers = {
        "overlay.png": lambda: _overlay(data, fit, evidence),
        "plan.png": lambda: plan_of(fit.guess, fit.stated),
    }
    written = []
    for name, make in makers.items():
        figure = make()
        figure.savefig(folder / name, dpi=110, bbox_inches="tight")
        pyplot.close(figure)
        written.append(folder / name)
    return written


def _overlay(data: Dataset, fit: SceneFit, evidence: SceneEvidence) -> Any:
    """Draw captures in grey, with the edges of fitted and of stated patches."""
    from matplotlib import pyplot

    rows = _rows_to_draw(evidence)
    hours = data.take(rows)
    fitted = with_scene(hours, scene_of(fit, "fitted", "")).patch_cdm2
    stated = with_patches(hours).patch_cdm2
    assert fitted is not None and stated is not None
    figure, axes = pyplot.subplots(len(rows), 1, figsize=(9, 4.2 * len(rows)), squeeze=False)
    for k, axis in enumerate(axes[:, 0]):
        axis.imshow(np.log10(np.maximum(hours.luminance_cdm2[k], 1.0)), cmap="gray")
        for patch, colour in ((stated[k], STATED_COLOUR), (fitted[k], FITTED_COLOUR)):
            if (patch > 0.0).any():
                axis.contour(patch > 0.0, levels=[0.5], colors=[colour], linewidths=0.9)
        axis.set_title(f"{hours.slots[k]}: patches fitted (red) and as stated (blue)", fontsize=9)
        axis.set_axis_off()
    return figure


def _rows_to_draw(evidence: SceneEvidence) -> Indices:
    """Return the hours with most light in patches, one for each of several sun directions."""
    excess = np.clip(np.exp(evidence.log_seen) - evidence.below, 0.0, None) @ evidence.weights
    parts = np.array_split(np.arange(len(evidence)), SHOWN_HOURS)
    best = [part[np.argmax(excess[part])] for part in parts if len(part)]
    return evidence.rows[np.array(best)]


def _is_above(solid: Solid, place: tuple[float, float], top: float) -> bool:
    """Return whether a solid covers a place in plan and is higher than `top`."""
    sides = zip(solid.low_m, place, solid.high_m, strict=False)
    return solid.high_m[2] > top and all(low <= at <= high for low, at, high in sides)


def _far_away(guess: Guess) -> list[str]:
    """Return a line of text for each solid that is too far outside to be drawn."""
    lines = []
    for solid in guess.solids:
        for wall, (axis, side) in WALLS.items():
            beyond_m = solid.low_m[axis] - guess.size_m[axis] if side else -solid.high_m[axis]
            if beyond_m > PLAN_MARGIN_M:
                lines.append(
                    f"outside: {solid.high_m[2]:.1f} m high, {beyond_m:.0f} m from the "
                    f"{wall_named(wall, guess.wall_azimuth_deg)}"
                )
    return lines


def plan_of(guess: Guess, stated: Room) -> Figure:
    """Draw the room from above: walls, windows, furniture, camera, and north as a labelled arrow.

    stated: the room before the fit, drawn in blue. The "south" wall is at the bottom. What is too
    far outside is stated above the drawing.
    """
    from matplotlib import pyplot
    from matplotlib.patches import Rectangle

    figure, axis = pyplot.subplots(figsize=(5.5, 8))
    before = Rectangle(
        (0, 0), stated.width_m, stated.depth_m, fill=False, edgecolor=STATED_COLOUR, ls="--"
    )
    axis.add_patch(before)
    axis.add_patch(Rectangle((0, 0), *guess.size_m[:2], fill=False, edgecolor="black", lw=1.5))
    for rect in guess.windows:
        wall_axis, side = WALLS[rect.wall]
        at = guess.size_m[wall_axis] if side else 0.0
        ends = (rect.u_m, (at, at)) if wall_axis == 1 else ((at, at), rect.u_m)
        axis.plot(*ends, color="#ff9900", lw=5, solid_capstyle="butt")
    for solid in guess.solids:
        (x0, y0, _), (x1, y1, top) = solid.low_m, solid.high_m
        middle, sides = ((x0 + x1) / 2, (y0 + y1) / 2), (x1 - x0, y1 - y0)
        shape = Rectangle((x0, y0), *sides)
        shape.set_color("0.75")
        axis.add_patch(shape)
        if not any(_is_above(other, middle, top) for other in guess.solids):
            axis.annotate(f"{top:.2f} m", middle, ha="center", fontsize=8)
    axis.plot(*guess.camera_m[:2], "k^", ms=9)
    north = np.radians(guess.wall_azimuth_deg + guess.north_deg)
    x, y = guess.camera_m[:2]
    # In room axes, north is turn @ (0, 1): x = sin(azimuth), y = -cos(azimuth).
    tip = (x + 0.8 * float(np.sin(north)), y - 0.8 * float(np.cos(north)))
    # The arrow ends at the middle of the text: with another alignment it points beside north.
    arrow = {"arrowstyle": "<-", "color": "0.3"}
    axis.annotate("N", (x, y), tip, arrowprops=arrow, color="0.3", ha="center", va="center")
    axis.set_aspect("equal")
    axis.set_xlabel("x [m]")
    axis.set_ylabel("y [m]")
    lines = ["plan: fitted (black), stated (blue), windows orange", *_far_away(guess)]
    axis.set_title("\n".join(lines), fontsize=9)
    # A facade may be 40 m wide, so only the surroundings of the room are drawn.
    axis.set_xlim(-PLAN_MARGIN_M, guess.size_m[0] + PLAN_MARGIN_M)
    axis.set_ylim(-PLAN_MARGIN_M, guess.size_m[1] + PLAN_MARGIN_M)
    return figure
