"""models/NAME/scores.json: what `train --json` prints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NotRequired, TypedDict, cast

from fieldlum.session.files.json_file import content_of, from_json, read_object, write_object

FORMAT = 1  # of the file; docs/file-formats.md
_REMEDY = "train the model again (fieldlum train)"


class ScoreFigures(TypedDict):
    """Errors of predicted maps (docs/models.md); None for a figure that was not computed."""

    log10_mse_weighted: float | None
    rer_weighted: float | None
    median: float | None
    p90: float | None
    worst: float | None
    paper_log10_mse: float | None
    paper_rer: float | None
    dgp_mse: float | None
    dgp_mse_own_disc: float | None
    bias_log10: float | None
    expected_log10_mse: float | None
    trusted_share: float | None
    dgp_mae: float | None
    dgp_r2: float | None
    rammg_mse: float | None
    rammg_mse_cut: float | None
    n_test: int
    predict_s_per_map: float | None
    predict_cpu_s_per_map: float | None
    untrusted_share: float | None
    expected_mse: float | None
    in_90_band: float | None
    worst_decile_found: float | None


class ScoreRow(ScoreFigures):
    """One model in `train --json` (docs/cli.md); earlier versions wrote fewer keys."""

    name: str
    fit_s: float
    fit_cpu_s: float
    n_train: int
    seed: int
    folds: int
    not_judged_because: str | None


class CurvePoint(TypedDict):
    """A fit to some of the captures: their number, held-out log10 MSE and its standard error."""

    captures: int
    mse: float
    se: float


class CaptureCurve(TypedDict, total=False):
    """How many captures would have been enough; without keys if there are too few captures."""

    curve: list[CurvePoint]
    enough: int
    added_nothing: list[str]


class TrainAnswer(TypedDict):
    """The object that `train --json` prints; scores.json has it without `kept`."""

    models: list[ScoreRow]
    chosen: str
    reason: str
    parameters: int
    final_fit_s: float
    captures: CaptureCurve
    year: NotRequired[Mapping[str, float] | None]
    notes: list[str]
    inputs: NotRequired[Mapping[str, object]]
    model_sha256: NotRequired[str]
    kept: NotRequired[bool]


@dataclass(frozen=True, slots=True)
class ScoresFile:
    """The content of one scores.json.

    models: one row for each model, with the columns of `train --json` (docs/cli.md).
    """

    models: tuple[ScoreRow, ...]
    chosen: str
    reason: str = ""
    parameters: int = 0
    final_fit_s: float = 0.0
    captures: CaptureCurve = field(default_factory=CaptureCurve)
    notes: tuple[str, ...] = ()
    more: dict[str, Any] = field(default_factory=dict)  # keys that other versions add

    @property
    def judged_row(self) -> ScoreRow | None:
        """Row of the chosen model.

        None if the file has no row for it, or if the row has no held-out error, for example because
        the time limit ended before.
        """
        rows = (row for row in self.models if row.get("name") == self.chosen)
        row = next(rows, None)
        return row if row is not None and row.get("median") is not None else None

    @classmethod
    def read(cls, folder: Path) -> ScoresFile:
        """Read the file. Raises InputError for a missing file or other content."""
        path = folder / "scores.json"
        table = read_object(path, "the scores of a trained model", _REMEDY)
        return cls.from_table(table, path)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], path: Path) -> ScoresFile:
        """Build from the JSON object of `path`. Raises InputError for other content."""
        known = {field.name for field in fields(cls)} | {"format"}
        more = {key: value for key, value in table.items() if key not in known}
        with content_of(table, FORMAT, path, "what fieldlum train wrote", _REMEDY):
            return from_json(cls, {**table, "more": more})

    @classmethod
    def find(cls, folder: Path) -> ScoresFile | None:
        """Read the file; return None if it is missing."""
        return cls.read(folder) if (folder / "scores.json").is_file() else None

    def table(self) -> TrainAnswer:
        """Return the object that `train --json` prints, without `kept`."""
        answer: TrainAnswer = {
            "models": list(self.models),
            "chosen": self.chosen,
            "reason": self.reason,
            "parameters": self.parameters,
            "final_fit_s": self.final_fit_s,
            "captures": self.captures,
            "notes": list(self.notes),
        }
        return cast(TrainAnswer, {**answer, **self.more})

    def write(self, folder: Path) -> None:
        """Write scores.json."""
        write_object(folder / "scores.json", {"format": FORMAT, **self.table()})
