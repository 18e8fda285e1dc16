"""Define colours and settings of charts; matplotlib's pyplot and global settings are not used."""

from __future__ import annotations

import warnings
from contextlib import AbstractContextManager
from io import StringIO
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, PALE, GRID = "#1d2733", "#b9c3cd", "#e5e7eb"
RED, BLUE, GREEN, SAND, AMBER = "#c4441c", "#1f5fa8", "#1a7f5a", "#f5e3bf", "#edb95c"
_SETTINGS: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.edgecolor": PALE,
    "axes.labelcolor": INK,
    "axes.formatter.useoffset": False,  # each tick shows its value
    "axes.spines.top": False,
    "axes.spines.right": False,
    "xtick.color": INK,
    "ytick.color": INK,
    "text.color": INK,
    "svg.fonttype": "none",
    "svg.hashsalt": "fieldlum",  # the same data give the same bytes
    "legend.frameon": False,
}


def styled() -> AbstractContextManager[None]:
    """Return a context for `with`, in which new figures have fieldlum's colours and settings.

    A file matplotlibrc in the current folder, which may be somebody else's session, has no effect.
    """
    from matplotlib import rc_context, rcParamsDefault

    return rc_context({**rcParamsDefault, **_SETTINGS})


def new_figure(width_in: float, height_in: float, **settings: Any) -> Figure:
    """Return an empty figure, in which matplotlib arranges the parts without overlap.

    width_in, height_in: in inches; settings: of matplotlib's Figure. It has fieldlum's colours only
    if it is created and filled inside `with styled():`.
    """
    from matplotlib.figure import Figure

    return Figure(figsize=(width_in, height_in), layout="constrained", **settings)


def svg_of(figure: Figure, **settings: Any) -> str:
    """Return a figure as inline SVG, without the XML prologue and without a date.

    settings: of `Figure.savefig` of matplotlib.
    """
    text = StringIO()
    with styled(), warnings.catch_warnings():
        # The site's name may have letters that the font lacks.
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(text, format="svg", metadata={"Date": None}, **settings)
    return text.getvalue()[text.getvalue().index("<svg") :]


def open_axes(axes: Any) -> None:
    """Remove the upper and the right line of a frame; draw small tick labels and ticks in `INK`.

    axes: of matplotlib.
    """
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8, colors=INK)
