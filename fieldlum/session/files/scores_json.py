"""models/NAME/scores.json: what `train --json` prints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, NotRequired, TypedDict, cast

from fieldlum.session.files.json_file import content_of, from_json, read_object, write_sealed

FORMAT = 1  # of the file; docs/file-formats.md
_REMEDY = "train the model again (fieldlum train)"


class ScoreFigures(TypedDict):
    """Errors of predicted maps; None for a figure that was not computed.

    log10_mse: mean squared error of log10 luminance (floor 1 cd/m2), _weighted by solid angle,
    paper_ with equal pixels; median, p90, worst: of it over maps; rer: root of the summed squared
    errors over the summed squared truth; dgp: with the true disc, own_disc with that of the room,
    of fully seen directions; judged: trimmed means over the n_judged hours that decide a choice, of
    the absolute error of DGP, of ln Ev, and of log10_mse;
    bias_log10: mean signed error; in_90_band: share of pixels whose truth is within the model's 90
    % interval; worst_decile_found: share of the worst tenth of hours that the model expects to be
    worst.
    """

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
    judged_dgp_error: float | None
    judged_ev_error: float | None
    judged_log10_mse: float | None
    n_judged: int


class ScoreRow(ScoreFigures):
    """One model in `train --json`; earlier versions wrote fewer keys.

    fit_s, fit_cpu_s: seconds to fit; n_train: number of maps in training; folds: number of tests;
    not_judged_because: reason for missing figures, or None.
    """

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
    """How many captures would have been enough; without keys if there are too few captures.

    enough: the fewest captures within one standard error of the best; added_nothing: the slots
    beyond them.
    """

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

    models: one row for each model, with the columns of `train --json`; chosen: name of the chosen
    one; more: keys that other versions add.
    """

    models: tuple[ScoreRow, ...]
    chosen: str
    reason: str = ""
    parameters: int = 0
    final_fit_s: float = 0.0
    captures: CaptureCurve = field(default_factory=CaptureCurve)
    notes: tuple[str, ...] = ()
    more: dict[str, Any] = field(default_factory=dict)

    @property
    def judged_row(self) -> ScoreRow | None:
        """Row of the chosen model; None without such a row or without its held-out error.

        The error is missing for example because the time limit ended before.
        """
        rows = (row for row in self.models if row.get("name") == self.chosen)
        row = next(rows, None)
        return row if row is not None and row.get("median") is not None else None

    @classmethod
    def read(cls, folder: Path) -> ScoresFile:
        """Read scores.json of a model's folder.

        Raises InputError if it is missing or has other content.
        """
        path = folder / "scores.json"
        table = read_object(path, "the scores of a trained model", _REMEDY)
        return cls.from_table(table, path)

    @classmethod
    def from_table(cls, table: Mapping[str, Any], path: Path) -> ScoresFile:
        """Build from a JSON object; path: its file, for errors.

        Raises InputError for other content.
        """
        names = {field.name for field in fields(cls)} | {"format"}
        more = {key: value for key, value in table.items() if key not in names}
        with content_of(table, FORMAT, path, "what fieldlum train wrote", _REMEDY):
            return from_json(cls, {**table, "more": more})

    @classmethod
    def find(cls, folder: Path) -> ScoresFile | None:
        """Read scores.json; return None if it is missing. Raises InputError for other content."""
        return cls.read(folder) if (folder / "scores.json").is_file() else None

    def table(self) -> TrainAnswer:
        """Return the object that `train --json` prints, without its key `kept`."""
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
        """Write scores.json into a folder."""
        write_sealed(folder / "scores.json", {"format": FORMAT, **self.table()})
