"""models/NAME/scores.json: what `train --json` prints."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NotRequired, TypedDict

from msgspec import field

from fieldlum.session.codec import JsonFile


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


class ScoresFile(JsonFile, frozen=True):
    """The content of one scores.json, which is a `TrainAnswer` without `kept`.

    models: one row for each model, as `ScoreRow`, of which earlier versions wrote fewer keys;
    chosen: name of the chosen one; captures: as `CaptureCurve`.
    """

    NAME, SEALED = "scores.json", True
    EXPECTED = "the scores of a trained model"
    REMEDY = "train the model again (fieldlum train)"

    models: tuple[dict[str, Any], ...]
    chosen: str
    reason: str = ""
    parameters: int = 0
    final_fit_s: float = 0.0
    captures: dict[str, Any] = field(default_factory=dict)
    year: dict[str, Any] | None = None
    notes: tuple[str, ...] = ()
    inputs: dict[str, Any] = field(default_factory=dict)
    model_sha256: str = ""

    @property
    def judged_row(self) -> dict[str, Any] | None:
        """Row of the chosen model; None without such a row or without its held-out error.

        The error is missing for example because the time limit ended before.
        """
        rows = (row for row in self.models if row.get("name") == self.chosen)
        row = next(rows, None)
        return row if row is not None and row.get("median") is not None else None
