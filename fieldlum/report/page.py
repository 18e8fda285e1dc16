"""Render the report as one self-contained HTML page: sections, tables and heat map."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats
from fieldlum.core.records import JsonTable
from fieldlum.optics.projection import compass_name
from fieldlum.session.files.predict_json import DirectionYear
from fieldlum.version import __version__

NOTHING = 65535  # in a heat map's 16-bit cells: no daylight, or not predicted


def named(azimuth_deg: float) -> str:
    """Return the compass name of a direction with its degrees, such as "S (180°)"."""
    return f"{compass_name(azimuth_deg)} ({azimuth_deg:.0f}°)"


def sentence(text: str) -> str:
    """Return a note as a sentence: a capital at its begin, a full stop at its end."""
    return f"{text[0].upper()}{text[1:].rstrip('.')}."


def chip(row: DirectionYear, more: str = "") -> dict[str, str]:
    """Return a cell with the glare class of a direction in its colour, grey while it is open."""
    return {"kind": row.glare_class if row.certain else "open", "text": row.glare_class + more}


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


class Table(NamedTuple):
    """A table with an optional title.

    rows: cells of each row, as many as `head`; folded: shown after a click; words: cells are words,
    aligned left.
    """

    head: Sequence[str]
    rows: Sequence[Sequence[Any]]
    title: str = ""
    folded: bool = False
    words: bool = False


class Section(NamedTuple):
    """One section of the page: text, rows of figures, tables and `heat_map`."""

    id: str
    title: str
    text: str = ""
    rows: Sequence[Sequence[Figure]] = ()
    tables: Sequence[Table] = ()
    heatmap: JsonTable | None = None


class Quantity(NamedTuple):
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
_LX_COLOURS = ("#20233a", "#3b3a78", "#6a4c93", "#a8628f", "#d98880", "#f0b68a", "#fbe3b0")
_LX = (100.0, 300.0, 500.0, 1000.0, 2000.0, 4000.0)  # chosen
EV = Quantity("Vertical illuminance", " lx", 10.0, _LX, _LX_COLOURS)
NOT_TRUSTED = Quantity("Hours that are not trusted", "", 1.0, (1.0,), ("#cfe6dc", "#8d6bb0"))


def heat_map(
    day: NDArray[np.integer],
    hour: NDArray[np.integer],
    layers: Sequence[tuple[Quantity, Floats]],
    year: int,
    **about: Any,
) -> JsonTable:
    """Return the heat map for the template: days by hours, for each layer [n, d] of n hours.

    day: of the year, from 1, and hour, 0 to 23, of each, [n]; year: for the dates. Further entries
    for the template: directions: names [d]; start: index of the direction shown first; used: hours
    of the day at which lines are drawn; alt: text instead of the picture.
    """
    days = max(365, int(day.max()))
    quantities = []
    for layer, values in layers:
        steps = np.full((values.shape[1], days, 24), NOTHING, "<u2")
        cells = np.clip(np.nan_to_num(values) / layer.step, 0, NOTHING - 1).round()
        steps[:, day - 1, hour] = np.where(np.isfinite(values), cells, NOTHING).T
        grids = [base64.b64encode(grid.tobytes()).decode() for grid in steps]
        quantities.append(layer._asdict() | {"grids": grids})
    data = json.dumps({"year": year, "days": days, "quantities": quantities})
    names = [layer.name for layer, _ in layers]
    return about | {"json": data.replace("</", "<\\/"), "quantities": names}


def render(
    title: str,
    answer: str,
    why: str,
    facts: Sequence[tuple[str, str]],
    sections: Sequence[Section],
    warnings: Sequence[str] = (),
    polar: Figure | None = None,
) -> str:
    """Return the page as HTML; all text but SVG and JSON is escaped.

    answer, why: the direction to sit in, and the reason; facts: (name, value) pairs.
    """
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template("page.html.j2").render(
        title=title,
        answer=answer,
        why=why,
        facts=facts,
        sections=sections,
        warnings=warnings,
        polar=polar,
        version=__version__,
    )
