"""Colours and matplotlib settings of charts: no pyplot, no global state."""

from contextlib import AbstractContextManager
from typing import Any

INK, PALE, GRID = "#1d2733", "#b9c3cd", "#e5e7eb"
RED, BLUE, GREEN, SAND, AMBER = "#c4441c", "#1f5fa8", "#1a7f5a", "#f5e3bf", "#edb95c"
_SETTINGS: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10,
    "axes.edgecolor": PALE,
    "axes.labelcolor": INK,
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
    """Return a context in which new figures have fieldlum's colours and settings."""
    from matplotlib import rc_context

    return rc_context(_SETTINGS)


def open_axes(axes: Any) -> None:
    """Remove the upper and right frame of axes, and draw small ticks in ink."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.tick_params(labelsize=8, colors=INK)
