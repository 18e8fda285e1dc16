"""Render the report as one self-contained HTML page: sections, tables and heat map."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.optics.projection import compass_name

NOTHING = 65535  # in a heat map's 16-bit cells: no daylight, or not predicted


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture with its alternative text and caption: either SVG text, or a PNG in base64.

    The unused one of svg and png is "".
    """

    alt: str
    caption: str
    svg: str = ""
    png: str = ""


def named(azimuth_deg: float) -> str:
    """Return the compass name of a direction with its degrees, such as "S (180°)"."""
    return f"{compass_name(azimuth_deg)} ({azimuth_deg:.0f}°)"


def svg_figure(svg: str, alt: str, caption: str) -> Figure:
    """Return a figure from SVG text."""
    return Figure(alt, caption, svg=svg)


def png_figure(data: bytes, alt: str, caption: str) -> Figure:
    """Return a figure from PNG bytes, which it stores in base64."""
    return Figure(alt, caption, png=base64.b64encode(data).decode())


@dataclass(frozen=True, slots=True)
class Row:
    """Figures in one row under a small title."""

    figures: tuple[Figure, ...]
    title: str = ""


@dataclass(frozen=True, slots=True)
class Table:
    """A table with an optional title.

    rows: cells of each row, as many as `head`; folded: shown after a click; words: cells are words,
    aligned left.
    """

    head: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]
    title: str = ""
    folded: bool = False
    words: bool = False


@dataclass(frozen=True, slots=True)
class HeatMap:
    """Day x hour grids of several quantities and directions, as JSON for the page's script.

    quantities: settings of each; start: index, from 0, of the direction shown first; used: hours of
    the day at which lines are drawn, the begin and the end of use, or empty.
    """

    json: str
    directions: tuple[str, ...]
    quantities: tuple[dict[str, Any], ...]
    alt: str
    start: int = 0
    used: tuple[int, ...] = ()  # first and last hour of use, drawn as lines


@dataclass(frozen=True, slots=True)
class Section:
    """One section of the page: text, rows of figures, tables and a heat map, where it has them."""

    id: str
    title: str
    text: str = ""
    rows: tuple[Row, ...] = ()
    tables: tuple[Table, ...] = ()
    heatmap: HeatMap | None = None


@dataclass(frozen=True, slots=True)
class Page:
    """All content of the page.

    answer, why: the direction to sit in, and the reason; facts: (name, value) pairs.
    """

    title: str
    answer: str
    why: str
    facts: tuple[tuple[str, str], ...]
    sections: tuple[Section, ...]
    footer: str
    polar: Figure | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Quantity:
    """One layer of the heat map. values: [days, 24, directions], NaN where there is no value.

    step: resolution of the stored values; edges: values at which the colour changes; colours: one
    more than edges; dark: True for colours that need white text; digits: decimals shown.
    """

    name: str
    unit: str
    values: Floats
    step: float  # resolution of the stored integers
    edges: tuple[float, ...]
    colours: tuple[str, ...]  # one more than edges
    dark: tuple[bool, ...]  # whether white text reads on it
    digits: int = 0


DGP_EDGES, DGP_COLOURS = (0.35, 0.40, 0.45), ("#cfe6dc", "#f2d16b", "#e58a2b", "#b03427")
# Colours of vertical illuminance change at these values [lx]. Not measured.
EV_EDGES = (100.0, 300.0, 500.0, 1000.0, 2000.0, 4000.0)
EV_COLOURS = ("#20233a", "#3b3a78", "#6a4c93", "#a8628f", "#d98880", "#f0b68a", "#fbe3b0")


def _cells(values: Floats, step: float) -> str:
    """Return [days, 24] as little-endian 16-bit integers in base64."""
    steps = np.clip(np.nan_to_num(values, nan=0.0) / step, 0, NOTHING - 1).round().astype("<u2")
    steps[~np.isfinite(values)] = NOTHING
    return base64.b64encode(steps.tobytes()).decode()


def heat_map(
    quantities: Sequence[Quantity],
    directions: Sequence[str],
    year: int,
    alt: str,
    start: int,
    used: tuple[int, ...] = (),
) -> HeatMap:
    """Return the heat map of `quantities`, all with the same days and directions.

    start: index, from 0, of the direction shown first; used: hours of the day, 0 to 24, at which
    lines are drawn; year: for the dates of the days; alt: text instead of the picture.
    """
    names = ("name", "unit", "step", "edges", "colours", "dark", "digits")
    shown = tuple({name: getattr(q, name) for name in names} for q in quantities)
    data = {
        "year": year,
        "days": int(quantities[0].values.shape[0]),
        "quantities": [
            {**meta, "grids": [_cells(q.values[:, :, d], q.step) for d in range(q.values.shape[2])]}
            for meta, q in zip(shown, quantities, strict=True)
        ],
    }
    return HeatMap(
        json.dumps(data).replace("</", "<\\/"), tuple(directions), shown, alt, start, used
    )


def day_hour_grid(
    day_of_year: NDArray[np.integer], hour: NDArray[np.integer], values: Floats, days: int
) -> Floats:
    """Return the values [n, d] of n hours as a grid [days, 24, d].

    day_of_year: of each value, from 1; hour: 0 to 23. Hours without a value are NaN.
    """
    grid = np.full((days, 24, values.shape[1]), np.nan)
    grid[day_of_year - 1, hour] = values
    return grid


def render(page: Page) -> str:
    """Return the page as HTML; all text but SVG and JSON is escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    content = {field.name: getattr(page, field.name) for field in fields(page)}
    return environment.get_template("page.html.j2").render(content)
