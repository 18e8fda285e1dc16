"""models/NAME/config.json: what a model is, its training data, and the model's own state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NotRequired, TypedDict

from fieldlum.core.errors import InputError
from fieldlum.session.files.json_file import build_known, check_format, read_object, write_object

FORMAT = 1  # of the file; docs/file-formats.md
# Ten times the rows that glare by EN 17037 needs; a model with more pixels is not from this tool.
MAX_HEIGHT = 4096
_COMMON = ("model", "height", "width", "heading_deg", "patch", "seed")  # keys of every model
_EXPECTED, _REMEDY = "a model folder", "train one with: fieldlum train"


@dataclass(frozen=True, slots=True)
class TrainingNote:
    """Training data of a model; source: the csv; slots: their ids; days: in local standard time."""

    source: str = ""
    slots: tuple[str, ...] = ()
    days: tuple[str, ...] = ()


class UsedScene(TypedDict):
    """The fitted scene that a model was trained with.

    north_deg, clock_min: fitted corrections of the heading [deg] and the clock [min]; chosen: the
    geometry that was used, "none", "stated" or "fitted"; stated: SITE.toml as a table before the
    fit; stated_heading_deg: heading of the captures; room_draws: for each parameter of the room,
    its values in draws from the fit's uncertainty.
    """

    north_deg: float
    clock_min: float
    chosen: str
    stated: dict[str, Any]
    stated_heading_deg: float
    room_draws: NotRequired[dict[str, list[float]]]


@dataclass(frozen=True, slots=True)
class ModelConfig:
    """The content of one config.json.

    height, width: of its maps [px], 0 if not stated; heading_deg: azimuth of their centre column;
    setup: SITE.toml as a table; state: all keys, from which `from_state` builds the model.
    """

    model: str
    height: int = 0
    width: int = 0
    heading_deg: float | None = None
    patch: str = "absolute"
    seed: int = 0
    setup: dict[str, Any] = field(default_factory=dict)
    training: TrainingNote = TrainingNote()
    state: dict[str, Any] = field(default_factory=dict)

    @property
    def scene(self) -> UsedScene | None:
        """The fitted scene that the model was trained with; None if no scene was fitted."""
        return self.state.get("scene")

    @classmethod
    def read(cls, folder: Path) -> ModelConfig:
        """Read config.json of a model's folder.

        Raises InputError if it is missing or has other content.
        """
        path = folder / "config.json"
        if not path.is_file():
            raise InputError(folder, "no config.json in this folder", _EXPECTED, _REMEDY)
        table = read_object(path, "JSON", "train the model again (fieldlum train)")
        check_format(table, FORMAT, path)
        setup = table.get("setup")
        if setup is not None and not isinstance(setup, dict):
            raise InputError(
                path, f"the key setup has the type {type(setup).__name__}", "a table", _REMEDY
            )
        common = {name: table[name] for name in _COMMON if name in table}
        config = build_known(cls, common, str(path))
        if not (0 <= config.height <= MAX_HEIGHT and config.width in (0, 2 * config.height)):
            raise InputError(
                path,
                f"maps of {config.width} x {config.height} pixels",
                f"maps twice as wide as high, with at most {MAX_HEIGHT} rows",
                _REMEDY,
            )
        training = build_known(TrainingNote, table.get("training") or {}, str(path))
        return replace(config, setup=setup or {}, training=training, state=table)


def write_config(folder: Path, table: Mapping[str, object]) -> None:
    """Write config.json into a folder; table: a model's state and the keys common to all models."""
    write_object(folder / "config.json", {"format": FORMAT, **table})
