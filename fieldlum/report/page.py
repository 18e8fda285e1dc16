"""Render the report as one self-contained HTML page: sections, tables and heat map."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.optics.projection import compass_name

NOTHING = 65535  # in a heat map's 16-bit cells: no daylight, or not predicted


def named(azimuth_deg: float) -> str:
    """Return the compass name of a direction with its degrees, such as "S (180°)"."""
    return f"{compass_name(azimuth_deg)} ({azimuth_deg:.0f}°)"


def sentence(text: str) -> str:
    """Return a note as a sentence: a capital at its begin, a full stop at its end."""
    return f"{text[0].upper()}{text[1:].rstrip('.')}."


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture with its alternative text and caption: SVG text, or the bytes of a PNG."""

    content: str | bytes
    alt: str
    caption: str

    @property
    def png(self) -> str:
        """The PNG in base64; "" for SVG text."""
        return base64.b64encode(self.content).decode() if isinstance(self.content, bytes) else ""


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

    quantities: name of each; start: index, from 0, of the direction shown first; used: hours of
    the day at which lines are drawn, the begin and the end of use, or empty.
    """

    json: str
    directions: tuple[str, ...]
    quantities: tuple[str, ...]
    alt: str
    start: int = 0
    used: tuple[int, ...] = ()


@dataclass(frozen=True, slots=True)
class Section:
    """One section of the page: text, figures, tables, a heat map and code, where it has them."""

    id: str
    title: str
    text: str = ""
    rows: tuple[Row, ...] = ()
    tables: tuple[Table, ...] = ()
    heatmap: HeatMap | None = None
    code: str = ""


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
    """One layer of the heat map.

    step: resolution of the stored integers; edges: values at which the colour changes; colours: one
    more than edges; digits: decimals shown.
    """

    name: str
    unit: str
    step: float
    edges: tuple[float, ...]
    colours: tuple[str, ...]
    digits: int = 0


DGP = Quantity(
    "DGP", "", 0.001, (0.35, 0.40, 0.45), ("#cfe6dc", "#f2d16b", "#e58a2b", "#b03427"), 2
)
# Colours of illuminances change at these values [lx]. Not measured.
_LX = (100.0, 300.0, 500.0, 1000.0, 2000.0, 4000.0)
_LX_COLOURS = ("#20233a", "#3b3a78", "#6a4c93", "#a8628f", "#d98880", "#f0b68a", "#fbe3b0")
EV = Quantity("Vertical illuminance", " lx", 10.0, _LX, _LX_COLOURS)
NOT_TRUSTED = Quantity("Hours that are not trusted", "", 1.0, (1.0,), ("#cfe6dc", "#8d6bb0"))


def _cells(values: Floats, step: float) -> str:
    """Return [days, 24] as little-endian 16-bit integers in base64."""
    steps = np.clip(np.nan_to_num(values, nan=0.0) / step, 0, NOTHING - 1).round().astype("<u2")
    steps[~np.isfinite(values)] = NOTHING
    return base64.b64encode(steps.tobytes()).decode()


def heat_map(
    grids: Sequence[tuple[Quantity, Floats]],
    directions: Sequence[str],
    year: int,
    alt: str,
    start: int,
    used: tuple[int, ...] = (),
) -> HeatMap:
    """Return the heat map of quantities with values [days, 24, directions], NaN where undefined.

    start: index, from 0, of the direction shown first; used: hours of the day, 0 to 24, at which
    lines are drawn; year: for the dates of the days; alt: text instead of the picture.
    """
    quantities = [
        {
            **asdict(layer),
            "dark": [_is_dark(colour) for colour in layer.colours],
            "grids": [_cells(values[:, :, d], layer.step) for d in range(values.shape[2])],
        }
        for layer, values in grids
    ]
    data = {"year": year, "days": len(grids[0][1]), "quantities": quantities}
    names = tuple(layer.name for layer, _ in grids)
    text = json.dumps(data).replace("</", "<\\/")
    return HeatMap(text, tuple(directions), names, alt, start, used)


def _is_dark(colour: str) -> bool:
    """Return whether white text is readable on a colour such as #20233a (weights of BT.709)."""
    red, green, blue = bytes.fromhex(colour[1:])
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue < 125.0


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
