"""How good the numbers are: the model's own scores, and measured against predicted maps of days
it did not see.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.glare import contrast_levels, glare_directions, panorama_views, view_azimuths_deg
from fieldlum.model_registry import MODELS
from fieldlum.models import fit, load
from fieldlum.models.data import Dataset
from fieldlum.records import Progress, quiet
from fieldlum.report.figures import (
    agreement_svg,
    comparison_png,
    contrast_levels_svg,
    error_by_sun_svg,
)
from fieldlum.report.page import Row, Section, Table, png_figure, svg_figure
from fieldlum.session.files.model_config import ModelConfig
from fieldlum.session.files.scores_json import ScoresFile
from fieldlum.sun_disc import add_disc

# Two planned days of one season are under 1 degree apart, seasons over 20 degrees.
SEASON_GAP_DEG = 8.0
SHOWN = ("typical", "one in ten is worse", "worst")


@dataclass(frozen=True, slots=True)
class HeldOutMaps:
    """Measured maps and what a model says of them that never saw their days; both without the
    disc, [n, H, W].
    """

    data: Dataset
    predicted_cdm2: NDArray[np.float32]
    log10_mse: NDArray[np.float64]
    about: str
    like_the_year: str = ""  # whether these hours are easier or harder than the year's


def held_out(
    data: Dataset, model: Path, config: ModelConfig, progress: Progress = quiet
) -> HeldOutMaps | None:
    """Every fifth captured day left out and predicted by a refit; a slow model shows its own
    validation images.
    """
    name = config.model
    days = np.unique(data.days)
    progress(0, 2, "held-out days")
    if not MODELS[name].slow and len(days) >= 3:
        out = np.isin(data.days, days[2::5] if len(days) >= 5 else days[-1:])
        patch = config.patch if data.patch_cdm2 is not None else "none"
        fitted = fit(name, data.take(~out), patch=patch, seed=config.seed)
        maps = _counted(int(out.sum()), "map")
        of_days = _counted(len(np.unique(data.days[out])), "day")
        about = f"{maps} of {of_days} that the fit behind them did not see"
    else:
        slots = set(config.state.get("validation_slots", ()))
        out = np.array([slot in slots for slot in data.slots])
        fitted, about = (
            load(model),
            f"{int(out.sum())} validation images, which stopped the training but were not fitted",
        )
    if not out.any():
        return None
    test = data.take(out)
    progress(1, 2, "held-out days")
    prediction = fitted.predict(test.light, test.patch_cdm2)
    predicted = prediction.luminance_cdm2
    error = np.log10(np.maximum(predicted, 1.0)) - np.log10(np.maximum(test.luminance_cdm2, 1.0))
    mse = (error**2 * test.weights).mean(axis=(1, 2), dtype=float)
    return HeldOutMaps(test, predicted, mse, about, _likeness(data, test, out))


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _likeness(data: Dataset, test: Dataset, out: NDArray[np.bool_]) -> str:
    """Say that the check is harder than the year where no remaining day has the held-out suns.

    The model of the year was fitted on these days too, so it knows their season.
    """
    rest = data.light.sun_direction[~out]
    nearest = (test.light.sun_direction @ rest.T).max(axis=1)
    alone = float((nearest < np.cos(np.radians(SEASON_GAP_DEG))).mean())
    if alone < 0.5:
        return ""
    return (
        f"This check is harder than the year: {100 * alone:.0f} % of these maps have a sun over "
        f"{SEASON_GAP_DEG:g} degrees from any that was left to learn from, while the model of the "
        f"year learned from these days too."
    )


def _views_of(held: HeldOutMaps, maps: NDArray[np.float32]) -> NDArray[np.float64]:
    """DGP of the paper's ten directions, [n, 10]."""
    height, width = held.data.shape
    azimuths = view_azimuths_deg(held.data.heading_deg)
    views = panorama_views(height, width, held.data.heading_deg, azimuths)
    light = held.data.light
    return glare_directions(
        maps, held.data.heading_deg, azimuths, light.sun_direction, held.data.disc_lx, views=views
    )["dgp"]


def _maps_row(held: HeldOutMaps) -> Row:
    order = np.argsort(held.log10_mse)
    n = len(order)
    picks = [int(order[i]) for i in dict.fromkeys((n // 2, min(int(0.9 * n), n - 1), n - 1))]
    labels = [f"{held.data.slots[i]}\n{text}" for i, text in zip(picks, SHOWN, strict=False)]
    png = comparison_png(held.data.luminance_cdm2[picks], held.predicted_cdm2[picks], labels)
    which = ", ".join(text for text, _ in zip(SHOWN, picks, strict=False))
    caption = (
        f"Measured, predicted and their ratio for held-out hours ({which}); the sun's disc is "
        "apart from the maps. Red is predicted too bright, blue too dark."
    )
    return Row(
        (png_figure(png, "Measured and predicted luminance panoramas with their ratio.", caption),)
    )


def _agreement_rows(held: HeldOutMaps) -> tuple[Row, ...]:
    measured, predicted = (
        _views_of(held, held.data.luminance_cdm2),
        _views_of(held, held.predicted_cdm2),
    )
    light = held.data.light
    disc = (light, held.data.disc_lx, held.data.heading_deg)
    whole = [add_disc(maps, *disc) for maps in (held.data.luminance_cdm2, held.predicted_cdm2)]
    true_levels, guess_levels = (
        np.stack([contrast_levels(image) for image in maps]) for maps in whole
    )
    mean_error = (predicted - measured).mean(axis=1)
    glare = Row(
        (
            svg_figure(
                agreement_svg(measured, predicted, "DGP"),
                "Predicted against measured DGP of ten directions.",
                "DGP of ten directions around each held-out hour.",
            ),
            svg_figure(
                error_by_sun_svg(mean_error, light.sun_altitude_deg, light.sun_azimuth_deg, "DGP"),
                "Mean DGP error against sun altitude and sun azimuth.",
                "Where the sun stood when the glare was predicted wrong.",
            ),
        ),
        "Glare",
    )
    contrast = Row(
        (
            svg_figure(
                contrast_levels_svg(true_levels, guess_levels),
                "Mean local contrast of measured and predicted maps at five pyramid levels.",
                "Local contrast per pyramid level, disc included.",
            ),
            svg_figure(
                agreement_svg(true_levels.mean(axis=1), guess_levels.mean(axis=1), "RAMMG, cd/m²"),
                "Predicted against measured RAMMG contrast.",
                "RAMMG, the mean of the levels, of each held-out hour.",
            ),
        ),
        "Contrast",
    )
    return glare, contrast


def _score_table(scores: ScoresFile | None) -> Table | None:
    rows = scores.models if scores else ()
    if scores is None or not rows:
        return None
    head = (
        "model",
        "fit, s",
        "log10 MSE",
        "RER",
        "log10 MSE (paper mode)",
        "DGP MSE, disc of the room",
        "DGP MSE, true disc",
        "trained on",
        "tested on",
    )
    keys = (
        "name",
        "fit_s",
        "log10_mse_weighted",
        "rer_weighted",
        "paper_log10_mse",
        "dgp_mse_own_disc",
        "dgp_mse",
        "n_train",
        "n_test",
    )
    chosen = scores.chosen

    def cell(row: dict[str, Any], key: str) -> Any:
        value = row.get(key)
        if key == "log10_mse_weighted" and row.get("not_judged_because"):
            return "no time to judge"
        if key == "name":
            return {"kind": "high", "text": f"{value} (chosen)"} if value == chosen else value
        if isinstance(value, float):
            return f"{value:.3g}"
        return "–" if value is None else value

    return Table(
        head,
        tuple(tuple(cell(row, key) for key in keys) for row in rows),
        "Models tried, on held-out days",
    )


def section(held: HeldOutMaps | None, scores: ScoresFile | None) -> Section:
    table = _score_table(scores)
    rows = (_maps_row(held), *_agreement_rows(held)) if held else ()
    if held:
        factor = 10 ** np.sqrt(np.median(held.log10_mse))
        worst = 10 ** np.sqrt(held.log10_mse.max())
        text = (
            f"Checked on {held.about}: half of them are predicted within a factor of {factor:.2f} "
            f"(rms over the map), the worst within {worst:.2f}. {held.like_the_year}"
        ).strip()
    else:
        text = (
            "Too few captured days to leave some out: the numbers of this report are not checked."
        )
    return Section("evidence", "How good the numbers are", text, rows, (table,) if table else ())
