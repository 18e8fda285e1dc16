"""models/NAME/: config.json (what a model is), scores.json and held_out.npz (how good it is)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats16, evenly_spread
from fieldlum.core.files import replacing
from fieldlum.core.records import JsonTable
from fieldlum.session.codec import JsonFile, open_arrays

# Ten times the rows that glare by EN 17037 needs; a model with more pixels is not from this tool.
MAX_HEIGHT = 4096


class TrainingNote(Struct, frozen=True):
    """What a model was trained with.

    source: path of the pairs.csv or session; slots: ids; days: dates of the slots in local standard
    time, such as 2027-03-20.
    """

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

    model: name of its kind, such as transport; height, width: of its maps [px], 0 if not stated;
    heading_deg: azimuth of their centre column, clockwise from true north, None if not stated;
    patch: use of sun patches, "absolute", "gain" (up to a factor) or "none"; seed: of random
    numbers in training; setup: SITE.toml as a table; training: see `TrainingNote`; untrusted:
    whether errors of held-out days are so large that no hour is trusted; state: all keys, from
    which `from_state` builds the model.
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
    untrusted: bool = False
    state: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise ValueError for maps that are not twice as wide as high, or too high."""
        if not (0 <= self.height <= MAX_HEIGHT and self.width in (0, 2 * self.height)):
            size = f"maps of {self.width} x {self.height} pixels"
            raise ValueError(f"{size}, not twice as wide as high with at most {MAX_HEIGHT} rows")

    @property
    def scene(self) -> UsedScene | None:
        """The fitted scene that the model was trained with; None if no scene was fitted."""
        return self.state.get("scene")

    @classmethod
    def upgraded(cls, table: JsonTable, path: Path) -> JsonTable:
        """Return a file's JSON object with the present keys, and with all its keys as `state`."""
        # Earlier versions stated `untrusted` only as a sentence.
        stated = any("do not trust single maps" in text for text in table.get("warnings", ()))
        return {"untrusted": stated, **table, "state": table}


# ----------------------------------------------------------------------------------------------
# scores.json: what `train --json` prints

ScoreFigures = dict[str, Any]
"""Errors of predicted maps; None for a figure that was not computed.

log10_mse: mean squared error of log10 luminance (floor 1 cd/m2), _weighted by solid angle, paper_
with equal pixels; median, p90, worst: of it over maps; rer: root of the summed squared errors over
the summed squared truth; dgp: with the true disc, own_disc with that of the room, of fully seen
directions; judged: trimmed means over the n_judged hours that decide a choice, of the absolute
error of DGP, of ln Ev, and of log10_mse; bias_log10: mean signed error; in_90_band: share of pixels
whose truth is within the model's 90 % interval.
"""
ScoreRow = ScoreFigures
"""One model in `train --json`: ScoreFigures, name, seed and costs.

fit_s, fit_cpu_s: seconds to fit; n_train: number of maps in training; folds: number of tests.
"""
TrainAnswer = dict[str, Any]
"""The object that `train --json` prints: the keys of `ScoresFile`, and whether it was `kept`."""


class ScoresFile(JsonFile, frozen=True):
    """The content of one scores.json, which is a `TrainAnswer` without `kept`.

    models: one row for each model, as `ScoreRow`, of which earlier versions wrote fewer keys;
    chosen: name of the chosen one; reason: of the choice, a sentence; parameters: their number in
    the chosen model; final_fit_s: time to fit it to all captures [s]; year: expected errors and
    trusted share of a year, None if not computed; notes: sentences; inputs: what the scores depend
    on, to detect a change; model_sha256: of the model's files.
    """

    NAME, SEALED = "scores.json", True
    EXPECTED = "the scores of a trained model"
    REMEDY = "train the model again (fieldlum train)"

    models: tuple[dict[str, Any], ...]
    chosen: str
    reason: str = ""
    parameters: int = 0
    final_fit_s: float = 0.0
    year: dict[str, Any] | None = None
    notes: tuple[str, ...] = ()
    inputs: dict[str, Any] = field(default_factory=dict)
    model_sha256: str = ""

    @property
    def judged_row(self) -> dict[str, Any] | None:
        """Row of the chosen model, as `ScoreRow`; None if it has no held-out error.

        A model has no held-out error for example if the time limit of the training ended before.
        """
        row = next((row for row in self.models if row.get("name") == self.chosen), None)
        return row if row is not None and row.get("median") is not None else None


# ----------------------------------------------------------------------------------------------
# held_out.npz: measured and predicted maps of the hours that scores.json is about

HELD_OUT_FORMAT = 1  # of held_out.npz; docs/file-formats.md
MAX_MAPS = 150  # most maps in the file, spread evenly: 4 MB at 116 x 58; chosen


@dataclass(frozen=True, slots=True)
class HeldOutMaps:
    """Measured and predicted maps of n held-out hours, in the order of the folds.

    slots: ids [n]; log10_mse: mean squared error of log10 luminance, weighted by solid angle, [n];
    measured_log10, predicted_log10: log10 of luminance in cd/m2 [n, h, w], float16 (to 0.2 %),
    reduced to fewer pixels, without the sun disc.
    """

    slots: NDArray[np.str_]
    log10_mse: Floats
    measured_log10: Floats16
    predicted_log10: Floats16

    def __len__(self) -> int:
        return len(self.slots)

    @classmethod
    def join(cls, parts: Sequence[HeldOutMaps]) -> HeldOutMaps | None:
        """Return the maps of several folds as one object, in their order; None without any fold."""
        if not parts:
            return None
        return cls(**{n: np.concatenate([getattr(p, n) for p in parts]) for n in _ARRAYS})

    def write(self, folder: Path) -> None:
        """Write held_out.npz into a folder: at most 150 hours.

        These are spread evenly from the best to the worst prediction by log10_mse, and written in
        the order of the folds.
        """
        order = np.argsort(self.log10_mse, kind="stable")
        kept = np.sort(order[evenly_spread(len(order), MAX_MAPS)])
        arrays: dict[str, Any] = {name: getattr(self, name)[kept] for name in _ARRAYS}
        with replacing(folder / "held_out.npz") as file:
            np.savez_compressed(file, format=HELD_OUT_FORMAT, **arrays)

    @classmethod
    def find(cls, folder: Path) -> HeldOutMaps | None:
        """Return the maps in held_out.npz of a folder; None without it, as in models of 0.1.0.

        Raises InputError for other content.
        """
        path = folder / "held_out.npz"
        if not path.is_file():
            return None
        remedy = "train the model again (fieldlum train)"
        with open_arrays(path, "held-out maps", remedy, HELD_OUT_FORMAT) as stored:
            return cls(**{name: stored[name] for name in _ARRAYS})


_ARRAYS = tuple(field.name for field in fields(HeldOutMaps))
