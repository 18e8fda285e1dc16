"""Draw a false-colour PNG: log scale, legend, regions, glare sources, isolines with --isolines."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from fieldlum.core.false_colour import COLOUR_MAP
from fieldlum.report.view.measured_picture import MeasuredPicture
from fieldlum.report.view.regions import Region, region_mask, shared_scale

_INCHES, _DPI = 6.4, 150  # 960 pixels wide
_MOST_PIXELS = 1200  # drawn along an edge; more is not visible at this size; chosen


def write_png(
    path: Path, pictures: Sequence[MeasuredPicture], regions: Sequence[Region], isolines: bool
) -> None:
    """Draw the pictures next to each other on one scale, with the regions; write a PNG.

    isolines: draw lines at the powers of ten.
    """
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

    low, high = shared_scale(pictures)
    figure = Figure(
        figsize=(_INCHES * len(pictures) + 1.0, _INCHES), dpi=_DPI, layout="constrained"
    )
    axes = figure.subplots(1, len(pictures), squeeze=False)[0]
    norm = LogNorm(low, high)
    image = None
    for axis, picture in zip(axes, pictures, strict=True):
        step = max(1, -(-max(picture.luminance_cdm2.shape) // _MOST_PIXELS))
        values = np.where(picture.solid_angle_sr > 0, picture.luminance_cdm2, np.nan)
        values = np.maximum(values[::step, ::step], low * 1e-3)
        height, width = picture.luminance_cdm2.shape
        extent = (0.0, float(width), float(height), 0.0)
        image = axis.imshow(values, norm=norm, cmap=COLOUR_MAP, extent=extent)
        _draw_marks(axis, picture, regions)
        if isolines:
            levels = 10.0 ** np.arange(np.ceil(np.log10(low)), np.floor(np.log10(high)) + 1)
            lines = axis.contour(
                values, levels, colors="white", linewidths=0.6, extent=extent, origin="upper"
            )
            axis.clabel(lines, fontsize=6, fmt="%g")
        axis.set_title(_title(picture), fontsize=8)
        axis.set_axis_off()
    if image is not None:
        bar = figure.colorbar(image, ax=list(axes), shrink=0.8, extend="both")
        bar.set_label("luminance, cd/m²")
    figure.savefig(path, format="png")


def _title(picture: MeasuredPicture) -> str:
    figures = [] if picture.ev_lx is None else [f"Ev {picture.ev_lx:.0f} lx"]
    if picture.edi_lx is not None:
        figures.append("m-EDI {:.0f} ± {:.0f} lx".format(*picture.edi_lx))
    figures += [] if picture.dgp is None else [f"DGP {picture.dgp:.3f}"]
    return "  ".join([picture.name, *figures])


def _draw_marks(axis, picture: MeasuredPicture, regions: Sequence[Region]) -> None:
    for outline in picture.outlines:
        x, y = np.array([*outline, outline[0]]).T + 0.5
        axis.plot(x, y, color="cyan", linewidth=0.8)
    for number, region in enumerate(regions, start=1):
        mask = region_mask(region, picture)
        if not mask.any():
            continue
        height, width = mask.shape
        axis.contour(
            mask.astype(float), [0.5], colors="lime", linewidths=1.0, extent=(0, width, 0, height)
        )
        rows, columns = np.nonzero(mask)
        axis.text(columns.mean(), rows.mean(), str(number), color="lime", fontsize=8, ha="center")
