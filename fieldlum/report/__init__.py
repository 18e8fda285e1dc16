"""Write one self-contained page of a session, index.html or assessor.html.

Results that do not exist yet are left out of index.html.
"""

from pathlib import Path

from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Site, slot_id
from fieldlum.learn.models import read_config
from fieldlum.report import sections
from fieldlum.report.assessor import assessor_page
from fieldlum.report.page import Page, Section, render
from fieldlum.session import Session, remove_scraps, write_file
from fieldlum.session.files.model_files import HeldOutMaps, ScoresFile
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.year.predict import Annual, newest_annual, read_pictures


def _model_of(session: Session, annual: Annual | None) -> Path | None:
    """Return the folder of the model that predicted the year, else of the newest model.

    The result is None if no model is trained.
    """
    name = annual.summary.inputs["model"] if annual else ""
    # the newest model is the first; the minimum is the first one with the name, or else the newest
    return min(session.trained_models(), key=lambda folder: folder.name != name, default=None)


def _page(session: Session, year: Annual | None) -> str:
    """Return the report as HTML; year: the predicted year, None if there is none yet."""
    site, pairs = session.site_file().site, PairsFile.read(session.pairs)
    model, zone = _model_of(session, year), site.timezone
    shown: list[Section] = []
    answer, polar = "No year has been predicted yet.", None
    why = "Train a model and run fieldlum predict to get the answer here."
    if year is not None:
        (answer, why), polar = sections.best_direction(year), sections.polar(year)
        shown += [sections.directions_section(year), sections.when_section(year, zone)]
        shown.append(sections.looks_section(year, read_pictures(year.folder), zone))
        shown.append(sections.melanopic_section(year, zone))
        shown.append(sections.budget_section(year))
    if model is not None:
        names = {slot_id(r.t_utc): Path(r.panorama).stem for r in pairs.usable if r.panorama}
        held, scores = HeldOutMaps.find(model), ScoresFile.find(model)
        shown.append(sections.accuracy_section(held, scores, names))
    hours = {} if year is None else year.hours
    shown.append(sections.captures_section(session, site, pairs, hours))
    facts, warnings = _facts(site, model, year, pairs), sections.warnings_of(session, year)
    return render(Page(site.name, answer, why, facts, shown, warnings, polar))


def _facts(
    site: Site, model: Path | None, year: Annual | None, pairs: PairsFile
) -> list[tuple[str, str]]:
    """Return the facts below the page's answer, as pairs of a name and a text.

    model: folder of the model, None without one; year: the predicted year, None without one.
    """
    facts = {"place": f"{site.latitude_deg:.2f}, {site.longitude_deg:.2f}"}
    facts["captures used"] = f"{len(pairs.usable)}"
    if model is not None:
        config = read_config(model)
        facts["model"] = config.model
        if slots := config.training.slots:  # training leaves out what it cannot use
            facts["captures used"] = f"{len(slots)}"
    if year is not None:
        summary, occupancy = year.summary, year.summary.occupancy
        facts["hours predicted"] = f"{summary.hours}"
        facts["weather"] = summary.weather.name
        facts["occupied hours with trusted maps"] = f"{100 * (1 - occupancy.untrusted_share):.0f} %"
        if occupancy.wide_share is not None:
            known = f"{100 * (1 - occupancy.wide_share):.0f} %"
            facts["occupied hours with DGP known to 0.2"] = known
        facts["sun's disc by"] = summary.disc_from
    return list(facts.items())


# ----------------------------------------------------------------------------------------------
# writing a page


def run(session: Session, out: Path | None = None, *, for_assessor: bool = False) -> Path:
    """Write index.html into `out`, by default the session's report/, and return its path.

    It shows the newest predicted year and the model that predicted it. for_assessor: write
    assessor.html instead. Temporary files of killed runs in `out` are removed. Raises
    NotEnoughDataError if the session has no pairs.csv yet, or for an assessor no predicted year;
    InputError for results that cannot be read.
    """
    if not session.pairs.is_file():
        remedy = "run fieldlum merge and fieldlum pair first"
        raise NotEnoughDataError(f"{session.root}: no bracket was paired yet; {remedy}")
    folder, year = out or session.report, newest_annual(session)
    remove_scraps(folder)
    page = folder / ("assessor.html" if for_assessor else "index.html")
    if for_assessor:
        return write_file(page, assessor_page(session, year, _model_of(session, year)))
    return write_file(page, _page(session, year))
