"""The report's sections on accuracy and on the captures: scores, held-out maps, light, brackets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Site, counted
from fieldlum.core.strict_csv import read_table
from fieldlum.report.page import Figure, Section, Table, captured_svg, comparison_png
from fieldlum.session import Session
from fieldlum.session.files.held_out_npz import HeldOutMaps
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.scores_json import ScoresFile
from fieldlum.session.panorama_sun import SUN_FROM, read_suns
from fieldlum.sky import sun

SHOWN = ("typical", "one in ten is worse", "worst")


def accuracy_section(
    held: HeldOutMaps | None, scores: ScoresFile | None, names: Mapping[str, str] | None = None
) -> Section:
    """Return the section on accuracy, from held-out maps and the scores of `train`.

    Without maps or scores their parts are left out, and the text states it. names: the slot's id in
    the session by its id in `held`, which is from the middle of its bracket.
    """
    judged = None if scores is None else scores.judged_row
    text = "The numbers of this report are not checked: training had no held-out day."
    if judged is not None:
        median, worst = (10 ** np.sqrt(judged[key] or 0.0) for key in ("median", "worst"))
        maps = counted(int(judged["n_test"]), "held-out map")
        text = (
            f"Checked on {maps}, each predicted by a fit without its day: half of them are within "
            f"a factor of {median:.2f} (rms over the map), the worst within {worst:.2f}."
        )
        if held is None:
            text += " The model has no held-out maps: train it again to show them here."
    tables = [] if scores is None or not scores.models else [_score_table(scores)]
    rows = [] if held is None else [(_held_out_figure(held, names or {}),)]
    return Section("evidence", "How good the numbers are", text, rows, tables)


def _held_out_figure(held: HeldOutMaps, names: Mapping[str, str]) -> Figure:
    order, n = np.argsort(held.log10_mse), len(held)
    picks = list(dict.fromkeys(int(order[i]) for i in (n // 2, min(int(0.9 * n), n - 1), n - 1)))
    slots = [names.get(str(held.slots[i]), str(held.slots[i])) for i in picks]
    labels = [f"{slot}\n{text}" for slot, text in zip(slots, SHOWN, strict=False)]
    measured, predicted = (
        10.0 ** maps[picks].astype(np.float32)
        for maps in (held.measured_log10, held.predicted_log10)
    )
    return Figure(
        comparison_png(measured, predicted, labels),
        "Measured and predicted luminance panoramas with their ratio.",
        "Measured, predicted and their ratio for held-out hours "
        f"({', '.join(SHOWN[: len(picks)])}), without the sun's disc. Red is predicted too bright, "
        "blue too dark.",
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


def _score_table(scores: ScoresFile) -> Table:
    def cell(row: Mapping[str, Any], key: str) -> Any:
        value = row.get(key)
        if key == "name" and value == scores.chosen:
            return {"kind": "high", "text": f"{value} (chosen)"}
        if isinstance(value, float):
            return f"{value:.3g}"
        return "–" if value is None else value

    rows = [[cell(row, key) for key in _COLUMNS] for row in scores.models]
    title = "Models tried, on held-out days; own disc: by the sky view, which saw these days too"
    return Table(tuple(_COLUMNS.values()), rows, title)


# ----------------------------------------------------------------------------------------------
# captures


def captures_section(
    session: Session, site: Site, pairs: PairsFile, year: Mapping[str, Floats]
) -> Section:
    """Return the section on suns, skies, quality and refusals of the captures.

    year: irradiance [W/m2] of the predicted year's hours, by column; empty without a year.
    """
    used = pairs.usable
    start = datetime(used[0].t_utc.year if used else 2027, 1, 1, 0, 30, tzinfo=UTC)
    hours = sun.position([start + timedelta(hours=h) for h in range(8760)], site)
    up = hours.altitude_deg > 0
    suns, skies = ("sun_azimuth_deg", "sun_altitude_deg"), ("dni_wm2", "dhi_wm2")
    path = captured_svg(
        (hours.azimuth_deg[up], hours.altitude_deg[up]),
        _columns(used, suns),
        "hours of the year",
        xlabel="sun azimuth, ° from north",
        ylabel="sun altitude, °",
        ylim=(0, None),
    )
    irradiance = captured_svg(
        [year.get(name, np.empty(0)) for name in skies],
        _columns(used, skies),
        "weather file",
        xlabel="direct normal irradiance, W/m²",
        ylabel="diffuse horizontal irradiance, W/m²",
    )
    figures = (
        Figure(
            path,
            f"Sun positions of a year in grey and of the {len(used)} captured hours in red.",
            "Sun positions of the year and of the captures. Hours far from every red point are "
            "extrapolated.",
        ),
        Figure(
            irradiance,
            "Direct against diffuse irradiance of the weather year in grey and of the captures in "
            "red.",
            "Skies of the weather file and of the captures.",
        ),
    )
    refused = Counter(row.why or "no reason recorded" for row in pairs.refused)
    columns, quality = read_quality(session.quality)
    tables = (
        Table(("reason", "brackets"), tuple(refused.items()), "Brackets that are not used"),
        Table(columns, quality, f"Quality of each bracket ({len(quality)})", folded=True),
    )
    some = [table for table in tables if table.rows]
    text = _captures_text(session, site, pairs)
    return Section("captured", "What was captured", text, (figures,), some)


def read_quality(path: Path) -> tuple[tuple[str, ...], tuple[tuple[str, ...], ...]]:
    """Return the columns and the rows of a quality.csv as text; both empty for a missing file.

    Raises InputError, with the line, for a damaged file.
    """
    if not path.is_file():
        return (), ()
    table = read_table(path, "a quality.csv that merge wrote", "run fieldlum merge again")
    return table.names, tuple(cells for _, cells in table.rows)


def _columns(rows: Sequence[PairRow], names: Sequence[str]) -> list[Floats]:
    return [np.array([getattr(row, name) for row in rows], float) for name in names]


def _captures_text(session: Session, site: Site, pairs: PairsFile) -> str:
    used = pairs.usable
    days = sorted({sun.standard_date(row.t_utc, site.timezone).isoformat() for row in used})
    planned = len(session.slots()) if session.plan.is_file() else len(used)
    text = f"{len(used)} usable of {planned} planned brackets, on {counted(len(days), 'day')}"
    if not used:
        return f"{text}."
    measured = sum(row.source == "measured" for row in used)
    kind = f"measured in {measured} brackets and derived in the others"
    text += f" between {days[0]} and {days[-1]}. Direct and diffuse irradiance were "
    text += f"{'measured' if measured == len(used) else kind}."
    origins = Counter(row.origin for row in read_suns(session.suns).values())
    if not origins:
        return text
    parts = [f"{SUN_FROM.get(origin, origin)} in {n}" for origin, n in origins.most_common()]
    count = counted(origins.total(), "picture")
    return f"{text} {count} show the sun's disc, whose illuminance was {', '.join(parts)}."
