"""Render the report as one self-contained HTML page, and draw its pictures."""

import base64
import io
import json
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure as Drawing

from fieldlum.core.arrays import Array, Floats, Floats32
from fieldlum.core.false_colour import COLOUR_MAP, RANGE_CDM2
from fieldlum.core.plot_style import GREEN, INK, PALE, RED, styled, svg_of
from fieldlum.core.records import JsonTable
from fieldlum.optics.projection import compass_name
from fieldlum.session.files.predict_json import DirectionYear
from fieldlum.sky.sun_disc import BRIGHTEST_SURFACE_CDM2
from fieldlum.version import __version__
from fieldlum.year.glare.standards import CLASSES

NOTHING = 65535  # in a heat map's 16-bit cells: no daylight, or not predicted


def direction_name(azimuth_deg: float) -> str:
    """Return the compass name of a direction with its degrees, such as "S (180°)".

    azimuth_deg: clockwise from north.
    """
    return f"{compass_name(azimuth_deg)} ({azimuth_deg:.0f}°)"


def sentence(text: str) -> str:
    """Return a text as a sentence: with a capital at its beginning and a full stop at its end.

    text: not empty. "+-" in it becomes "±".
    """
    return f"{text[0].upper()}{text[1:].rstrip('.')}.".replace("+-", "±")


def class_name(row: DirectionYear) -> str:
    """Return the glare class of a direction, such as "high"; "below minimum" for the class "none".

    EN 17037 has no name for what is below its minimum.
    """
    return "below minimum" if row.glare_class == "none" else row.glare_class


def chip(row: DirectionYear, more: str = "") -> dict[str, str]:
    """Return a table cell that shows a direction's glare class in the colour of the class.

    more: text after the class. Keys for the template: kind, the class, or "open" (grey) while it is
    not certain; text, the class in words and `more`.
    """
    return {"kind": row.glare_class if row.certain else "open", "text": class_name(row) + more}


class Figure(NamedTuple):
    """A picture of the page.

    content: SVG text, or the bytes of a PNG; caption: text below the picture; alt: text for screen
    readers, "" to use the caption.
    """

    content: str | bytes
    caption: str
    alt: str = ""


class Table(NamedTuple):
    """A table with an optional title.

    head: names of the columns; rows: cells of each row, as many as `head`: text, numbers or dicts
    as from `chip`; title: "" for none; folded: whether the table is shown only after a click;
    words: whether the cells are words, aligned left.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[Any]]
    title: str = ""
    folded: bool = False
    words: bool = False


class Section(NamedTuple):
    """One section of the page.

    id: anchor in the page; title: its heading; text: a paragraph in each line; rows: each has
    figures that are next to each other; heatmap: the result of `heat_map`, None for none.
    """

    id: str
    title: str
    text: str = ""
    rows: Sequence[Sequence[Figure]] = ()
    tables: Sequence[Table] = ()
    heatmap: JsonTable | None = None


class Quantity(NamedTuple):
    """A quantity that the heat map can show.

    name, unit: as texts on the page, the unit with a blank before it; step: of the values as
    stored, in the unit; edges: values at which the colour changes, in the unit, ascending; colours:
    of CSS, one more than edges; digits: decimals shown.
    """

    name: str
    unit: str
    step: float
    edges: tuple[float, ...]
    colours: tuple[str, ...]
    digits: int = 0


_DGP_COLOURS = ("#cfe6dc", "#f2d16b", "#e58a2b", "#b03427")
DGP = Quantity("DGP", "", 0.001, (0.35, 0.40, 0.45), _DGP_COLOURS, 2)
_LX_COLOURS = ("#20233a", "#3b3a78", "#6a4c93", "#a8628f", "#d98880", "#f0b68a", "#fbe3b0")
_LX = (100.0, 300.0, 500.0, 1000.0, 2000.0, 4000.0)  # chosen
EV = Quantity("Vertical illuminance", " lx", 10.0, _LX, _LX_COLOURS)
NOT_TRUSTED = Quantity("Hours that are not trusted", "", 1.0, (1.0,), ("#cfe6dc", "#8d6bb0"))


def heat_map(
    day: Array, hour: Array, layers: Sequence[tuple[Quantity, Floats]], year: int, **about: Any
) -> JsonTable:
    """Return the heat map of a year for the template: a cell for each day and hour.

    day: of the year, from 1, and hour, 0 to 23, of n hours, [n]; year: of the calendar, for the
    dates. layers: quantities, each with its values [n, d] in d directions, NaN for none. about:
    keys for the template, which the result has too: directions: names [d]; start: index of the
    direction shown first; used: hours of the day at which lines are drawn; alt: text instead of the
    picture. Other keys of the result: json, the data for the script; quantities, names of the
    layers.
    """
    days = max(365, int(day.max()))
    quantities = []
    for layer, values in layers:
        cells = np.full((values.shape[1], days, 24), NOTHING, "<u2")
        steps = np.clip(np.nan_to_num(values) / layer.step, 0, NOTHING - 1).round()
        cells[:, day - 1, hour] = np.where(np.isfinite(values), steps, NOTHING).T
        grids = [base64.b64encode(grid.tobytes()).decode() for grid in cells]
        quantities.append(layer._asdict() | {"grids": grids})
    data = json.dumps({"year": year, "days": days, "quantities": quantities})
    names = [layer.name for layer, _ in layers]
    return about | {"json": data.replace("<", "\\u003c"), "quantities": names}


class Page(NamedTuple):
    """What a page shows.

    title: of the page; answer, why: the sentences at its top, such as the direction to sit in, and
    the reason; facts: (name, value) pairs below them; sections: in the order of the page; warnings:
    one sentence each; polar: glare by direction, next to the answer, None for no picture.
    """

    title: str
    answer: str
    why: str
    facts: Sequence[tuple[str, str]]
    sections: Sequence[Section]
    warnings: Sequence[str] = ()
    polar: Figure | None = None


def render(page: Page) -> str:
    """Return a page as one self-contained HTML file; all text but SVG and JSON is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    blocks = {"trim_blocks": True, "lstrip_blocks": True, "undefined": StrictUndefined}
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(loader=loader, autoescape=True, **blocks)
    environment.filters["base64"] = lambda data: base64.b64encode(data).decode()
    return environment.get_template("page.html.j2").render(page._asdict(), version=__version__)


# ----------------------------------------------------------------------------------------------
# pictures: pure functions from arrays to SVG text or PNG bytes, without pyplot

POLAR_RANGE = (0.15, 0.6)  # of DGP; points above it are drawn at the rim; chosen
CLASS_COLOURS = {"high": GREEN, "medium": "#7fae2e", "minimum": "#e0a100", "none": "#c0392b"}


def png(figure: Drawing, dpi: int = 110) -> bytes:
    """Return a figure of matplotlib as PNG bytes, without empty margins.

    dpi: pixels per inch of the figure's size.
    """
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
    *,
    ratios: bool = False,
) -> tuple[Drawing, list[Axes]]:
    """Draw luminance pictures in false colour with one colour bar; return the figure and its axes.

    maps: at least one, [H, W] each, in cd/m2, NaN is white; titles: of the maps; columns: pictures
    in a row; width_in: of one picture in inches; scale_cdm2: ends of the logarithmic colour scale,
    at which values are cut off. ratios: the maps of the last column are binary logarithms of
    ratios, drawn from blue (1/2) to red (2) with their own bar. A blue ring is around a pixel as
    bright as the sun's disc. The list of axes has one for each
    map, in pixels from its top left.
    """
    rows, columns = -(-len(maps) // columns), min(columns, len(maps))  # rows rounded up
    height_in = width_in * max(image.shape[0] / image.shape[1] for image in maps) + 0.4
    light = ScalarMappable(LogNorm(*scale_cdm2), COLOUR_MAP)
    ratio = ScalarMappable(Normalize(-1.0, 1.0), "RdBu_r")
    with styled():
        figure = Drawing((width_in * columns, height_in * rows + 0.6), layout="constrained")
        grid = figure.subplots(rows, columns, squeeze=False)
        styles = [light] * (columns - ratios) + [ratio] * ratios
        for axes in grid.flat:
            axes.set_axis_off()
        for axes, image, title, style in zip(grid.flat, maps, titles, styles * rows, strict=False):
            extent = (0.0, float(image.shape[1]), float(image.shape[0]), 0.0)
            shown = np.clip(image, *scale_cdm2) if style is light else image
            axes.imshow(shown, norm=style.norm, cmap=style.cmap, extent=extent)
            axes.set_title(title, fontsize=9)
            if np.nanmax(image) > BRIGHTEST_SURFACE_CDM2 and style is light:
                row, column = np.unravel_index(np.nanargmax(image), image.shape)
                axes.plot(column + 0.5, row + 0.5, "o", ms=10, mew=2, mfc="none", mec="deepskyblue")
        options: dict[str, Any] = {"location": "bottom", "aspect": 40, "extend": "both"}
        cells = grid[:, : columns - ratios]
        shrink = 1.0 if ratios else 0.5
        figure.colorbar(light, ax=cells, label="luminance, cd/m²", shrink=shrink, **options)
        if ratios:
            bar = figure.colorbar(ratio, ax=grid[:, -1], label="ratio", **options)
            factors = {0.5: "÷2", 0.8: "÷1.25", 1.0: "1", 1.25: "×1.25", 2.0: "×2"}
            bar.set_ticks([float(np.log2(f)) for f in factors], labels=list(factors.values()))
    return figure, list(grid.flat)[: len(maps)]


def comparison_png(
    measured: Iterable[Floats], predicted: Iterable[Floats], labels: Sequence[str], name: str
) -> bytes:
    """Return a PNG with a row for each of n maps: measured, predicted, predicted over measured.

    measured, predicted: n maps each, [H, W], cd/m2; labels: of the rows [n]; name: of the second
    column. Values below 1 cd/m2 count as 1 in the ratio. As Liu, Colburn and Inanici 2020, Figures
    9 and 23.
    """
    maps, titles = [], []
    for true, model, label in zip(measured, predicted, labels, strict=True):
        maps += [true, model, np.log2(np.maximum(model, 1.0) / np.maximum(true, 1.0))]
        titles += [f"measured: {label}", name, f"{name} over measured"]
    return png(picture_grid(maps, titles, 3, 4.0, ratios=True)[0])


# ----------------------------------------------------------------------------------------------
# the light domain


def captured_svg(
    year: Sequence[Floats], captured: Sequence[Floats], label: str, x_name: str, y_name: str
) -> str:
    """Return an SVG of captured hours over the other hours of a year, in any two quantities.

    year, captured: x and y of the points, two arrays of equal length each; y is at least 0, and a
    year without points is not drawn. label: of the year's points; x_name, y_name: of the axes, with
    units.
    """
    with styled():
        figure = Drawing(figsize=(5.2, 3.4))
        axes = figure.add_subplot()
        if len(year[0]):
            axes.scatter(*year, s=3, c=PALE, lw=0, label=label, rasterized=True)
        axes.scatter(*captured, s=12, c=RED, lw=0, label="captured")
        axes.set(xlabel=x_name, ylabel=y_name, ylim=(0, None))
        axes.legend(loc="upper left", bbox_to_anchor=(0, 1.14), ncols=2)
        return svg_of(figure, bbox_inches="tight")


# ----------------------------------------------------------------------------------------------
# glare


def polar_svg(azimuths_deg: Floats, dgp_exceeded: Floats, low: Floats, high: Floats) -> str:
    """Return an SVG of the DGP exceeded in 5 % of the occupied hours, by view direction.

    It is a polar plot over the limits of the classes. azimuths_deg, dgp_exceeded, low, high: [d];
    directions run clockwise from north, low and high bound the 95 % interval. A NaN is a direction
    that was not seen, or an unknown interval: there is a gap. Values outside `POLAR_RANGE` are
    drawn at its ends.
    """
    order = np.argsort(azimuths_deg)
    around = np.append(order, order[0])  # a closed line
    angle = np.radians(np.append(azimuths_deg[order], azimuths_deg[order[0]] + 360.0))
    floor, top = POLAR_RANGE
    limits = [limit for _, limit in CLASSES]
    middle = np.clip(dgp_exceeded[around], floor, top)
    lower, upper = np.clip(low[around], floor, top), np.clip(high[around], floor, top)
    with styled():
        figure = Drawing(figsize=(4.6, 4.6))
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
        return svg_of(figure, bbox_inches="tight")
