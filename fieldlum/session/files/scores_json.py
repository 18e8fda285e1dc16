"""models/NAME/scores.json: what `train --json` prints."""

from __future__ import annotations

from typing import Any

from msgspec import field

from fieldlum.session.codec import JsonFile

ScoreFigures = dict[str, Any]
"""Errors of predicted maps; None for a figure that was not computed.

log10_mse: mean squared error of log10 luminance (floor 1 cd/m2), _weighted by solid angle, paper_
with equal pixels; median, p90, worst: of it over maps; rer: root of the summed squared errors over
the summed squared truth; dgp: with the true disc, own_disc with that of the room, of fully seen
directions; judged: trimmed means over the n_judged hours that decide a choice, of the absolute
error of DGP, of ln Ev, and of log10_mse; bias_log10: mean signed error; in_90_band: share of pixels
whose truth is within the model's 90 % interval; worst_decile_found: share of the worst tenth of
hours that the model expects to be worst.
"""
ScoreRow = ScoreFigures
"""One model in `train --json`: ScoreFigures, name, seed and costs.

fit_s, fit_cpu_s: seconds to fit; n_train: number of maps in training; folds: number of tests;
not_judged_because: None; earlier versions had a reason for missing figures.
"""
TrainAnswer = dict[str, Any]
"""The object that `train --json` prints: the keys of `ScoresFile`, and whether it was `kept`."""


class ScoresFile(JsonFile, frozen=True):
    """The content of one scores.json, which is a `TrainAnswer` without `kept`.

    models: one row for each model, as `ScoreRow`, of which earlier versions wrote fewer keys;
    chosen: name of the chosen one; captures: how many were enough, of earlier versions.
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
