"""Write one self-contained page of a session: index.html, with report.json next to it.

Results that do not exist yet are left out.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Progress, quiet, slot_id
from fieldlum.core.strict_csv import read_table
from fieldlum.report import assessor
from fieldlum.report.page import Page, Section, Table, named, render
from fieldlum.session import Session, remove_scraps, replacing
from fieldlum.session.files.held_out_npz import HeldOutMaps
from fieldlum.session.files.model_config import ModelConfig
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.session.files.scores_json import ScoresFile
from fieldlum.version import __version__
from fieldlum.year.glare.budget import BUDGET_FILE
from fieldlum.year.predict import Annual, read_annual, read_pictures


@dataclass(frozen=True, slots=True)
class SessionArtefacts:
    """Results of a session that the report shows; None for a result that does not exist yet."""

    model: Path | None
    config: ModelConfig | None
    scores: ScoresFile | None
    annual: Annual | None


def find(session: Session) -> SessionArtefacts:
    """Return the newest predicted year, and the model that predicted it, else the newest model.

    Newest is by the time of the files. Raises InputError for a damaged year or model.
    """
    from fieldlum.learn.models import read_config

    years = sorted(
        session.annual_folders(), key=lambda folder: (folder / "predict.json").stat().st_mtime
    )
    annual = read_annual(years[-1]) if years else None
    models = [path for path in session.model_folders() if (path / "weights.npz").is_file()]
    named = annual.summary.inputs["model"] if annual else ""
    newest = max(
        models, key=lambda f: (f.name == named, (f / "config.json").stat().st_mtime), default=None
    )
    if newest is None:
        return SessionArtefacts(None, None, None, annual)
    return SessionArtefacts(newest, read_config(newest), ScoresFile.find(newest), annual)


def _settings(session: Session, artefacts: SessionArtefacts) -> Section:
    """Return the settings of session, model and year as TOML."""
    groups: dict[str, Any] = {"fieldlum": __version__, "session": session.table()}
    if artefacts.config is not None:
        keep = ("model", "patch", "seed", "software", "training")
        groups["model"] = {k: v for k, v in artefacts.config.state.items() if k in keep}
    if artefacts.annual is not None:
        groups["prediction"] = dict(artefacts.annual.summary.inputs)
        groups["weather"] = artefacts.annual.about["weather"]
    plain = json.loads(json.dumps(groups, default=str), object_hook=_without_none)
    return Section("settings", "Settings and versions", code=tomli_w.dumps(plain))


def _without_none(table: dict[str, Any]) -> dict[str, Any]:
    """Return a table without what TOML cannot store, and with long lists as their length."""
    short = {
        key: f"{len(value)} entries" if isinstance(value, list) and len(value) > 12 else value
        for key, value in table.items()
    }
    return {key: value for key, value in short.items() if value is not None}


def _budget_section(year: Annual) -> list[Section]:
    """Return the uncertainty budget of each direction's DGP; empty for a year without the file."""
    path = year.folder / BUDGET_FILE
    if not path.is_file():
        return []
    table = read_table(path, "an uncertainty budget", "predict the year again: fieldlum predict")
    parts: dict[str, dict[str, str]] = {}
    for _, cells in table.dicts():
        figure = f"{float(cells['contribution']):.4f}"
        parts.setdefault(cells["azimuth_deg"], {})[cells["source"]] = figure
    sources = tuple(dict.fromkeys(name for row in parts.values() for name in row))
    rows = tuple(
        (named(float(azimuth)), *(row.get(name, "–") for name in sources))
        for azimuth, row in parts.items()
    )
    text = (
        "What each source adds to the standard uncertainty of the DGP exceeded in 5 % of the "
        "occupied hours. Another year's weather, and a blind that moves, are not in it. budget.csv "
        "has types, sensitivities and shares (GUM)."
    )
    tables = (Table(("facing", *sources), rows, "By direction", folded=True),)
    return [Section("budget", "Uncertainty budget", text, tables=tables)]


def _slot_names(pairs: PairsFile) -> dict[str, str]:
    """Return the panoramas' names (the ids of their slots), by the time of the pair."""
    return {slot_id(row.t_utc): Path(row.panorama).stem for row in pairs.usable if row.panorama}


def _page(session: Session, artefacts: SessionArtefacts) -> Page:
    from fieldlum.report import annual, captured, evidence, melanopic

    setup = session.site_file()
    zone = setup.site.timezone
    pairs = PairsFile.read(session.pairs)
    year = artefacts.annual
    sections: list[Section] = []
    if year is not None:
        sections += [annual.directions_section(year), annual.when_section(year, zone)]
        sections.append(annual.looks_section(year, read_pictures(year.folder), zone))
        sections.append(melanopic.section(year, zone))
        sections += _budget_section(year)
    if artefacts.model is not None:
        held, names = HeldOutMaps.find(artefacts.model), _slot_names(pairs)
        sections.append(evidence.section(held, artefacts.scores, names))
    hours = year.hours if year else {"dni_wm2": np.empty(0), "dhi_wm2": np.empty(0)}
    captures = captured.section(session, setup.site, pairs, hours["dni_wm2"], hours["dhi_wm2"])
    sections += [captures, _settings(session, artefacts)]
    answer = "No year has been predicted yet."
    why = "Train a model and run fieldlum predict to get the answer here."
    if year is not None:
        answer, why = annual.answer(year)
    return Page(
        title=setup.site.name,
        answer=answer,
        why=why,
        facts=_facts(session, artefacts, pairs),
        sections=tuple(sections),
        footer=f"Written by fieldlum {__version__}. Glare figures are fieldlum's own, checked "
        "against evalglare; see docs/accuracy.md. This page needs no network.",
        polar=annual.polar(year) if year else None,
        warnings=(*_assumed(session), *_warnings(year)),
    )


def _facts(
    session: Session, artefacts: SessionArtefacts, pairs: PairsFile
) -> tuple[tuple[str, str], ...]:
    site = session.site_file().site
    captures = len(pairs.usable)
    if artefacts.config is not None and artefacts.config.training.slots:
        captures = len(artefacts.config.training.slots)  # training leaves out what it cannot use
    facts = [
        ("place", f"{site.latitude_deg:.2f}, {site.longitude_deg:.2f}"),
        ("captures used", f"{captures}"),
    ]
    if artefacts.config is not None:
        facts.append(("model", artefacts.config.model))
    if artefacts.annual is not None:
        summary = artefacts.annual.summary
        unsure = summary.occupancy.unsure_share
        unsure = summary.occupancy.untrusted_share if unsure is None else unsure
        facts += [
            ("hours predicted", f"{summary.hours}"),
            ("weather", summary.weather.name),
            ("occupied hours with a certain DGP", f"{100 * (1 - unsure):.0f} %"),
            ("sun's disc by", summary.disc_from),
        ]
    return tuple(facts)


def _assumed(session: Session) -> list[str]:
    """Return the warnings of a heading or camera that SITE.toml did not state."""
    from fieldlum.optics.profiles import assumed_texts

    texts = assumed_texts(session.site_file().camera)
    return [f"{text[0].upper()}{text[1:]}." for text in texts]


def _warnings(year: Annual | None) -> tuple[str, ...]:
    if year is None:
        return ()
    weather = year.summary.weather
    warnings = [_spoken(text) for text in year.summary.model_warnings]
    if weather.synthetic:
        warnings.append("The weather is synthetic: do not judge this place by it.")
    return (*warnings, *(f"Weather repaired: {text}." for text in weather.repairs))


def _spoken(warning: str) -> str:
    """Return a warning of `train` as a sentence for the page."""
    text = warning.removeprefix("WARNING: ")
    return f"From training: {text}{'' if text.endswith('.') else '.'}"


def run(
    session: Session,
    out: Path | None = None,
    *,
    for_assessor: bool = False,
    progress: Progress = quiet,
) -> Path:
    """Write index.html and report.json into `out`, by default report/; return the page's path.

    for_assessor: write assessor.html instead of index.html. Raises NotEnoughDataError if the
    session has no pairs.csv yet, InputError for results that cannot be read, and for an assessor
    also without a predicted year.
    """
    if not session.pairs.is_file():
        raise NotEnoughDataError(
            f"{session.root}: no pairs.csv, because no bracket was paired yet; run fieldlum merge "
            "and fieldlum pair first"
        )
    artefacts = find(session)
    folder = out or session.report
    remove_scraps(folder)
    page = folder / ("assessor.html" if for_assessor else "index.html")
    progress(0, 1, "page")
    if for_assessor:
        text = render(assessor.page_of(session, artefacts.annual))
    else:
        text = render(_page(session, artefacts))
    progress(1, 1, "")
    with replacing(page, "w", encoding="utf-8") as file:
        file.write(text)
    summary = {
        "site": session.site_file().site.name,
        "fieldlum": __version__,
        "model": artefacts.model.name if artefacts.model else None,
        "scores": artefacts.scores.table() if artefacts.scores else {},
        "annual": artefacts.annual.about if artefacts.annual else None,
    }
    with replacing(folder / "report.json", "w", encoding="utf-8") as file:
        json.dump(summary, file, indent=1, ensure_ascii=False, default=str)
    return page
