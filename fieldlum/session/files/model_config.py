"""models/NAME/config.json: what a model is, its training data, and the model's own state."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from msgspec import Struct, field

from fieldlum.core.records import JsonTable
from fieldlum.session.codec import JsonFile

# Ten times the rows that glare by EN 17037 needs; a model with more pixels is not from this tool.
MAX_HEIGHT = 4096


class TrainingNote(Struct, frozen=True):
    """Training data of a model; source: the csv; slots: their ids; days: in local standard time."""

    source: str = ""
    slots: tuple[str, ...] = ()
    days: tuple[str, ...] = ()


UsedScene = dict[str, Any]
"""The fitted scene that a model was trained with.

north_deg, clock_min: fitted corrections of the heading [deg] and the clock [min]; chosen: the
geometry that was used, "none", "stated" or "fitted"; stated: SITE.toml as a table before the fit;
stated_heading_deg: heading of the captures.
"""


class ModelConfig(JsonFile, frozen=True):
    """The content of one config.json.

    height, width: of its maps [px], 0 if not stated; heading_deg: azimuth of their centre column;
    setup: SITE.toml as a table; state: all keys, from which `from_state` builds the model.
    """

    NAME = "config.json"
    EXPECTED, REMEDY = "a model folder", "train one with: fieldlum train"

    model: str
    height: int = 0
    width: int = 0
    heading_deg: float | None = None
    patch: str = "absolute"
    seed: int = 0
    setup: dict[str, Any] = field(default_factory=dict)
    training: TrainingNote = TrainingNote()
    state: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise ValueError for maps that are not twice as wide as high, or too high."""
        if not (0 <= self.height <= MAX_HEIGHT and self.width in (0, 2 * self.height)):
            raise ValueError(
                f"maps of {self.width} x {self.height} pixels, not twice as wide as high with at "
                f"most {MAX_HEIGHT} rows"
            )

    @property
    def scene(self) -> UsedScene | None:
        """The fitted scene that the model was trained with; None if no scene was fitted."""
        return self.state.get("scene")

    @classmethod
    def upgraded(cls, table: JsonTable, path: Path) -> JsonTable:
        """Return the table with itself as the state."""
        return {**table, "state": table}
