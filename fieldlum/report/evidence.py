"""The report's section on accuracy: the scores of `train`, and the held-out maps behind them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fieldlum.core.records import counted
from fieldlum.report.figures import agreement_svg, comparison_png
from fieldlum.report.page import Figure, Row, Section, Table
from fieldlum.session.files.held_out_npz import HeldOutMaps
from fieldlum.session.files.scores_json import ScoresFile

# Suns of two planned days of one season are under 1 degree apart, of two seasons over 20 degrees.
# Chosen between the two.
SEASON_GAP_DEG = 8.0
_NO_MAPS = "The model has no held-out maps: train it again to show them here."
SHOWN = ("typical", "one in ten is worse", "worst")


def _likeness(held: HeldOutMaps) -> str:
    """Return a sentence if no captured day has suns like the held-out ones, else an empty text.

    The check is then too strict: the model of the year was trained on these days too.
    """
    alone = float((held.season_deg > SEASON_GAP_DEG).mean())
    if alone < 0.5:
        return ""
    return (
        f"This check is harder than the prediction of a year: in {100 * alone:.0f} % of these maps "
        f"the sun is over {SEASON_GAP_DEG:g} degrees from every sun position in the training "
        f"data, but the model of the year was trained on these days too."
    )


def _maps_row(held: HeldOutMaps, names: Mapping[str, str]) -> Row:
    order = np.argsort(held.log10_mse)
    n = len(order)
    picks = list(dict.fromkeys(int(order[i]) for i in (n // 2, min(int(0.9 * n), n - 1), n - 1)))
    slots = [names.get(str(held.slots[i]), str(held.slots[i])) for i in picks]
    labels = [f"{slot}\n{text}" for slot, text in zip(slots, SHOWN, strict=False)]
    measured, predicted = (
        10.0 ** maps[picks].astype(np.float32)
        for maps in (held.measured_log10, held.predicted_log10)
    )
    caption = (
        "Measured, predicted and their ratio for held-out hours "
        f"({', '.join(SHOWN[: len(picks)])}), without the sun's disc. Red is predicted too bright, "
        "blue too dark."
    )
    alt = "Measured and predicted luminance panoramas with their ratio."
    return Row((Figure(comparison_png(measured, predicted, labels), alt, caption),))


def _agreement_row(held: HeldOutMaps) -> Row:
    measured, predicted = held.dgp_measured, held.dgp_predicted
    contrast = held.contrast_measured.mean(axis=1), held.contrast_predicted.mean(axis=1)
    return Row(
        (
            Figure(
                agreement_svg(measured, predicted, "DGP"),
                "Predicted against measured DGP of ten directions.",
                "DGP of ten directions around each held-out hour.",
            ),
            Figure(
                agreement_svg(*contrast, "RAMMG, cd/m²"),
                "Predicted against measured RAMMG contrast.",
                "Contrast of each held-out hour: RAMMG, disc included.",
            ),
        ),
        "Glare and contrast",
    )


_COLUMNS = {
    "name": "model",
    "fit_s": "fit, s",
    "judged_dgp_error": "DGP error",
    "judged_ev_error": "ln Ev error",
    "judged_log10_mse": "log10 MSE",
    "n_judged": "judged hours",
    "dgp_mae": "DGP error, all hours",
    "log10_mse_weighted": "log10 MSE, all hours",
}


def _score_table(scores: ScoresFile | None) -> tuple[Table, ...]:
    if scores is None or not scores.models:
        return ()
    chosen = scores.chosen

    def cell(row: dict[str, Any], key: str) -> Any:
        value = row.get(key)
        if key == "name" and value == chosen:
            return {"kind": "high", "text": f"{value} (chosen)"}
        if isinstance(value, float):
            return f"{value:.3g}"
        return "–" if value is None else value

    rows = tuple(tuple(cell(row, key) for key in _COLUMNS) for row in scores.models)
    title = "Models tried, on held-out days; own disc: by the sky view, which saw these days too"
    return (Table(tuple(_COLUMNS.values()), rows, title),)


def section(
    held: HeldOutMaps | None, scores: ScoresFile | None, names: Mapping[str, str] | None = None
) -> Section:
    """Return the section on accuracy, from held-out maps and the scores of `train`.

    Without maps or scores their parts are left out, and the text states it. names: the slot's id in
    the session by its id in `held`, which is from the middle of its bracket.
    """
    rows = (_maps_row(held, names or {}), _agreement_row(held)) if held else ()
    judged = None if scores is None else scores.judged_row
    if judged is not None:
        median, worst = (10 ** np.sqrt(judged[key] or 0.0) for key in ("median", "worst"))
        maps = counted(int(judged["n_test"]), "held-out map")
        text = (
            f"Checked on {maps}, each predicted by a fit without its day: half of them are within "
            f"a factor of {median:.2f} (rms over the map), the worst within {worst:.2f}."
        )
        text += f" {_likeness(held)}" if held else f" {_NO_MAPS}"
    else:
        text = "The numbers of this report are not checked: training had no held-out day."
    title = "How good the numbers are"
    return Section("evidence", title, text.strip(), rows, _score_table(scores))
