"""The report's pictures: pure functions from arrays to SVG text or PNG bytes, without pyplot."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.false_colour import COLOUR_MAP, RANGE_CDM2
from fieldlum.core.plot_style import GREEN, INK, PALE, RED, styled
from fieldlum.year.glare.standards import CLASSES

POLAR_RANGE = (0.15, 0.6)  # of DGP; points above it are drawn at the rim; chosen
CLASS_COLOURS = {"high": GREEN, "medium": "#7fae2e", "minimum": "#e0a100", "none": "#c0392b"}


def _svg(figure: Figure) -> str:
    """Return inline SVG without the XML prologue."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", bbox_inches="tight", metadata={"Date": None})
    text = buffer.getvalue()
    return text[text.index("<svg") :]


def png(figure: Figure, dpi: int = 110) -> bytes:
    """Return a figure as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, bbox_inches="tight")
    return buffer.getvalue()


# ----------------------------------------------------------------------------------------------
# luminance pictures


def picture_grid(
    maps: Sequence[Floats | Floats32],
    titles: Iterable[str],
    columns: int,
    width_in: float,
    scale_cdm2: tuple[float, float] = RANGE_CDM2,
) -> tuple[Figure, list[Axes]]:
    """Draw luminance pictures [H, W] in cd/m2 in false colour, with titles and one colour bar.

    width_in: of one picture in inches. NaN is white. The axes are in pixels from the top left.
    """
    rows, columns = -(-len(maps) // columns), min(columns, len(maps))
    height_in = width_in * max(image.shape[0] / image.shape[1] for image in maps) + 0.4
    with styled():
        figure = Figure((width_in * columns, height_in * rows + 0.6), layout="constrained")
        cells = list(figure.subplots(rows, columns, squeeze=False).flat)
        norm = LogNorm(*scale_cdm2)
        for axes in cells:
            axes.set_axis_off()
        for axes, image, title in zip(cells, maps, titles, strict=False):
            extent = (0.0, float(image.shape[1]), float(image.shape[0]), 0.0)
            axes.imshow(np.clip(image, *scale_cdm2), norm=norm, cmap=COLOUR_MAP, extent=extent)
            axes.set_title(title, fontsize=9)
        bar = ScalarMappable(norm, COLOUR_MAP)
        options: dict[str, Any] = {"shrink": 0.5, "aspect": 40, "extend": "both"}
        figure.colorbar(bar, ax=cells, location="bottom", label="luminance, cd/m²", **options)
    return figure, cells[: len(maps)]


def comparison_png(
    measured: Sequence[Floats] | Floats,
    predicted: Sequence[Floats] | Floats,
    labels: Sequence[str],
    name: str = "predicted",
) -> bytes:
    """Return a PNG with a row for each of n maps: measured, predicted, and their ratio.

    measured, predicted: [H, W] each, cd/m2; labels: [n]; name: of the second column. The ratio
    is red above 1, on a logarithmic scale from 1/2 to 2; values below 1 cd/m2 count as 1. As Liu,
    Colburn and Inanici 2020, Figures 9 and 23.
    """
    n = len(measured)
    ratio = [
        np.log2(np.maximum(other, 1.0) / np.maximum(own, 1.0))
        for own, other in zip(measured, predicted, strict=True)
    ]
    styles = ((LogNorm(*RANGE_CDM2), COLOUR_MAP), (Normalize(-1.0, 1.0), "RdBu_r"))
    columns = (
        ("measured", measured, *styles[0]),
        (name, predicted, *styles[0]),
        (f"{name} over measured", ratio, *styles[1]),
    )
    with styled():
        figure = Figure((12.0, 2.0 * n + 0.9), layout="constrained")
        cells = figure.subplots(n, 3, squeeze=False)
        for k, (title, maps, norm, colours) in enumerate(columns):
            for axes, image in zip(cells[:, k], maps, strict=True):
                shown = np.clip(image, *RANGE_CDM2) if k < 2 else image
                axes.imshow(shown, norm=norm, cmap=colours)
                axes.set(xticks=[], yticks=[])
            cells[0, k].set_title(title, fontsize=10)
        for axes, label in zip(cells[:, 0], labels, strict=True):
            axes.set_ylabel(label, fontsize=8)
        bars = [
            figure.colorbar(ScalarMappable(*style), ax=cells[:, part], location="bottom", aspect=40)
            for style, part in zip(styles, (slice(2), 2), strict=True)
        ]
        bars[0].set_label("cd/m²")
        factors = {0.5: "÷2", 0.8: "÷1.25", 1.0: "1", 1.25: "×1.25", 2.0: "×2"}
        bars[1].set_ticks([float(np.log2(f)) for f in factors], labels=list(factors.values()))
        return png(figure)


# ----------------------------------------------------------------------------------------------
# the light domain


def captured_svg(
    year: Sequence[Floats], captured: Sequence[Floats], label: str, **axes_settings: Any
) -> str:
    """Plot the captures over the hours of a year, x and y [n] of each; return SVG text."""
    with styled():
        figure = Figure(figsize=(5.2, 3.4))
        axes = figure.add_subplot()
        if len(year[0]):
            axes.scatter(*year, s=3, c=PALE, lw=0, label=label, rasterized=True)
        axes.scatter(*captured, s=12, c=RED, lw=0, label="captured")
        axes.set(**axes_settings)
        axes.legend(loc="upper left", bbox_to_anchor=(0, 1.14), ncols=2)
        return _svg(figure)


# ----------------------------------------------------------------------------------------------
# glare


def polar_svg(azimuths_deg: Floats, dgp_exceeded: Floats, low: Floats, high: Floats) -> str:
    """Plot the DGP exceeded in 5 % of the occupied hours by view direction, over the class limits.

    All arrays: [d]. Directions run clockwise from north; low and high bound the 95 % interval. A
    NaN is a direction that was not seen, or an unknown interval: there is a gap. Return SVG text.
    """
    order = np.argsort(azimuths_deg)
    around = np.append(order, order[0])
    angle = np.radians(np.append(azimuths_deg[order], azimuths_deg[order[0]] + 360.0))
    floor, top = POLAR_RANGE
    limits = [limit for _, limit in CLASSES]
    middle, lower, upper = (
        np.clip(values[around], floor, top) for values in (dgp_exceeded, low, high)
    )
    with styled():
        figure = Figure(figsize=(4.6, 4.6))
        axes: Any = figure.add_subplot(projection="polar")
        axes.set_theta_zero_location("N")
        axes.set_theta_direction(-1)
        ring, ends = np.linspace(0, 2 * np.pi, 361), pairwise((floor, *limits, top))
        for pair, colour in zip(ends, CLASS_COLOURS.values(), strict=True):
            axes.fill_between(ring, *pair, color=colour, alpha=0.16, lw=0)
        axes.fill_between(angle, lower, upper, color=INK, alpha=0.18, lw=0)
        axes.plot(angle, middle, color=INK, lw=1.8, marker="o", ms=4, clip_on=False)
        axes.set_ylim(floor, top)
        axes.set_yticks(limits, [f"{limit:.2f}" for limit in limits], fontsize=8)
        names = ["N", "NE", "E", "SE", "S", "SW", "W", "NW"]
        axes.set_xticks(np.radians(np.arange(0, 360, 45)), names)
        axes.grid(color=PALE, lw=0.5)
        axes.spines["polar"].set_visible(False)
        return _svg(figure)
