"""Write one self-contained page of a session, index.html or assessor.html.

Results that do not exist yet are left out of index.html. The page for an assessor shows what
requirements ask, what was found, and what is missing. It certifies nothing: an interval that spans
a limit is "cannot tell". Names of its columns follow honeybee (GA) and ClimateStudio (sDG).
"""

import tomllib
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Site, SiteFile, slot_id
from fieldlum.core.strict_csv import read_table
from fieldlum.learn.models import read_config
from fieldlum.optics import profiles
from fieldlum.report import sections
from fieldlum.report.page import Page, Section, Table, class_name, named, render, sentence
from fieldlum.session import Session, remove_scraps, replacing, sha256
from fieldlum.session.codec import change_of
from fieldlum.session.files.model_files import HeldOutMaps, ScoresFile
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.version import __version__
from fieldlum.year.glare.budget import BUDGET_FILE
from fieldlum.year.predict import Annual, newest_annual, read_pictures


def _model_of(session: Session, annual: Annual | None) -> Path | None:
    """Return the model that predicted the year, else the newest model; None without one."""
    used = annual.summary.inputs["model"] if annual else ""
    return min(session.trained_models(), key=lambda folder: folder.name != used, default=None)


def _budget_section(year: Annual) -> list[Section]:
    """Return the uncertainty budget of each direction's DGP; empty for a year without the file."""
    path = year.folder / BUDGET_FILE
    if not path.is_file():
        return []
    table = read_table(path, "an uncertainty budget", "predict the year again: fieldlum predict")
    change_of(path)
    parts: dict[str, dict[str, str]] = {}
    for _, cells in table.dicts():
        figure = f"{float(cells['contribution']):.4f}"
        parts.setdefault(cells["azimuth_deg"], {})[cells["source"]] = figure
    sources = tuple(dict.fromkeys(name for row in parts.values() for name in row))
    rows = [
        (named(float(azimuth)), *(row.get(name, "–") for name in sources))
        for azimuth, row in parts.items()
    ]
    text = (
        "What each source adds to the standard uncertainty of the DGP exceeded in 5 % of the "
        "occupied hours. Another year's weather, and a blind that moves, are not in it. budget.csv "
        "has types, sensitivities and shares (GUM)."
    )
    tables = (Table(("facing", *sources), rows, "By direction", folded=True),)
    return [Section("budget", "Uncertainty budget", text, tables=tables)]


def _page(session: Session, year: Annual | None) -> str:
    site, pairs = session.site_file().site, PairsFile.read(session.pairs)
    model, zone = _model_of(session, year), site.timezone
    shown: list[Section] = []
    answer, polar = "No year has been predicted yet.", None
    why = "Train a model and run fieldlum predict to get the answer here."
    if year is not None:
        (answer, why), polar = sections.answer(year), sections.polar(year)
        shown += [sections.directions_section(year), sections.when_section(year, zone)]
        shown.append(sections.looks_section(year, read_pictures(year.folder), zone))
        shown.append(sections.melanopic_section(year, zone))
        shown += _budget_section(year)
    if model is not None:
        names = {slot_id(r.t_utc): Path(r.panorama).stem for r in pairs.usable if r.panorama}
        held, scores = HeldOutMaps.find(model), ScoresFile.find(model)
        shown.append(sections.accuracy_section(held, scores, names))
    hours = {} if year is None else year.hours
    shown.append(sections.captures_section(session, site, pairs, hours))
    facts, warnings = _facts(site, model, year, pairs), _warnings(session, year)
    return render(Page(site.name, answer, why, facts, shown, warnings, polar))


def _facts(
    site: Site, model: Path | None, year: Annual | None, pairs: PairsFile
) -> list[tuple[str, str]]:
    captures, facts = len(pairs.usable), []
    if model is not None:
        config = read_config(model)
        # training leaves out what it cannot use
        captures = len(config.training.slots) or captures
        facts = [("model", config.model)]
    place = f"{site.latitude_deg:.2f}, {site.longitude_deg:.2f}"
    facts = [("place", place), ("captures used", f"{captures}"), *facts]
    if year is None:
        return facts
    summary = year.summary
    unsure = summary.occupancy.unsure_share
    unsure = summary.occupancy.untrusted_share if unsure is None else unsure
    return [
        *facts,
        ("hours predicted", f"{summary.hours}"),
        ("weather", summary.weather.name),
        ("occupied hours with a certain DGP", f"{100 * (1 - unsure):.0f} %"),
        ("sun's disc by", summary.disc_from),
    ]


def _warnings(session: Session, year: Annual | None) -> list[str]:
    """Return warnings of assumed settings, of the camera, of training, and of the weather."""
    camera = session.site_file().camera
    texts = profiles.assumed_texts(camera)
    with suppress(InputError):  # the profile can be missing where only the report is written again
        profile = profiles.load_camera_profile(camera.profile)
        texts += filter(None, [profiles.uncalibrated_text(profile)])
    if year is not None:
        weather, of_model = year.summary.weather, year.summary.model_warnings
        texts += [f"From training: {text.removeprefix('WARNING: ')}" for text in of_model]
        if weather.synthetic:
            texts.append("The weather is synthetic: do not judge this place by it.")
        texts += [f"Weather: {text}" for text in weather.repairs]
    return [sentence(text) for text in texts]


# ----------------------------------------------------------------------------------------------
# the page for an assessor

METHOD = (
    "A camera captured luminance maps of the room under many suns and skies, "
    "while irradiance was measured outside. A model learned how the room responds to sky and sun. "
    "It was tested on days that it had not seen, and predicted each daylight hour of the weather "
    "year. DGP, vertical illuminance and melanopic EDI were computed from the predicted maps at "
    "the camera's place and height. Intervals are for 95 %."
)
_ABOUT = (
    "What each requirement asks, what was found, and what is missing",
    "Nothing on this page is certified. Words in the column of findings are those of the "
    "predicted year; “cannot tell” means that the interval spans the limit.",
)


def _requirements(annual: Annual, zone: str) -> Table:
    directions = annual.summary.protection
    decided = [row for row in directions if row.certain]
    classes = ", ".join(f"{named(row.azimuth_deg)} {class_name(row)}" for row in decided)
    found = f"decided in {len(decided)} of {len(directions)} directions: {classes or 'none'}"
    answers = [text for text in sections.disturbed(annual) if text != "–"]
    sdg = (
        f"{answers.count('yes')} of {len(answers)} directions are disturbed, "
        f"{answers.count('cannot tell')} cannot be decided"
    )
    edi = well = "cannot tell: no melanopic colour was measured"
    if sections.has_melanopic(annual):
        each = zip(sections.melanopic_shares(annual, zone), annual.judged, strict=True)
        best = max((s for s, good in each if good), key=lambda share: share[0].value)
        edi = f"best direction: {best[0].text()} of the hours"
        limits = zip(sections.WELL_EDI_LX, best[1], strict=True)
        days = (f"{limit:.0f} lx on {share.text()} of the days" for limit, share in limits)
        well = f"best direction, daylight alone: {', '.join(days)}"
    words = {"found": found, "sdg": sdg, "edi": edi, "well": well, "hours": len(annual)}
    text = Path(__file__).with_name("requirements.toml").read_text(encoding="utf-8")
    rows = [
        [row[key].format(**words) for key in ("requirement", "asks", "found", "missing")]
        for row in tomllib.loads(text)["row"]
    ]
    head = ("requirement", "what it asks", "what was found", "what is missing")
    return Table(head, rows, words=True)


def _instruments(session: Session, setup: SiteFile) -> Table:
    meter = setup.pyranometer
    try:
        path = profiles.find_camera_profile(setup.camera.profile)
        camera = profiles.load_camera_profile(path)
        rows = [*_camera_rows(camera), ("profile, sha256", sha256(path))]
    except InputError as error:
        rows = [("camera", f"cannot tell: {error}")]
    times = sorted(row.t_utc for row in PairsFile.find(session.pairs).usable)
    span = f", {times[0]:%d %B %Y} to {times[-1]:%d %B %Y}" if times else ""
    rows += [
        ("pyranometer", f"{meter.kind or 'not stated'} {meter.profile}".strip()),
        ("pyranometer, calibration", "state the date of its certificate here: ________"),
        ("camera's place", f"{setup.camera.height_m:g} m above the floor"),
        ("captures used", f"{len(times)}{span}"),
    ]
    return _words(rows, "Instruments and calibrations")


def _words(rows: list[tuple[str, str]], title: str = "") -> Table:
    return Table(("item", "value"), rows, title, words=True)


def _camera_rows(profile: profiles.CameraProfile) -> list[tuple[str, str]]:
    camera, colour = profile.camera, profile.colour
    melanopic = f"{100 * colour.melanopic_u_rel:.1f} %" if colour.melanopic_from_rgb else "none"
    origin = profile.provenance.fitted_by or profile.provenance.source or "not stated"
    return [
        ("camera", f"{camera.name} ({camera.make} {camera.model})"),
        ("camera, calibrated", f"{camera.date or 'no date'}, by {origin}"),
        ("camera, valid until", profile.expires or "not stated"),
        ("luminance scale, standard uncertainty", f"{100 * profile.scale.u_rel:.1f} %"),
        ("melanopic colour, standard uncertainty", melanopic),
    ]


def _assessor_page(session: Session, annual: Annual | None) -> str:
    """Return the page as HTML. Raises InputError if `annual`, the predicted year, is None."""
    if annual is None:
        remedy = "run fieldlum predict first"
        raise InputError(session.root, "no predicted year", "a year of figures", remedy)
    setup, summary = session.site_file(), annual.summary
    site, weather, occupancy = setup.site, summary.weather, summary.occupancy
    versions = [
        ("fieldlum", __version__),
        ("model", str(summary.inputs.get("model", summary.model))),
        ("weather", f"{weather.name}{' (synthetic)' if weather.synthetic else ''}"),
        ("occupied hours", occupancy.text),
        ("hours that the model does not trust", f"{100 * occupancy.untrusted_share:.0f} %"),
    ]
    files = ("predict.json", "hourly.csv")
    versions += [(f"{name}, sha256", sha256(annual.folder / name)) for name in files]
    roles = [(role, "", "", "") for role in ("measured by", "calculated by", "checked by")]
    signatures = Table(("role", "name", "date", "signature"), roles, words=True)
    zone = site.timezone
    shown = (
        Section("requirements", "Requirements", tables=(_requirements(annual, zone),)),
        sections.directions_section(annual)._replace(title="Glare by view direction"),
        sections.melanopic_section(annual, zone),
        Section("method", "Method", " ".join((METHOD, *map(sentence, summary.notes[:1])))),
        Section("instruments", "What was measured", tables=(_instruments(session, setup),)),
        Section("versions", "Versions and files", tables=(_words(versions),)),
        Section("signatures", "Signatures", tables=(signatures,)),
    )
    facts = (
        ("place", f"{site.latitude_deg:.3f}, {site.longitude_deg:.3f}"),
        ("written", f"{datetime.now(UTC):%d %B %Y}"),
        ("occupied hours", f"{occupancy.hours}"),
    )
    title = f"{site.name}: glare and daylight for an assessor"
    return render(Page(title, *_ABOUT, facts, shown, _warnings(session, annual)))


# ----------------------------------------------------------------------------------------------
# writing a page


def run(session: Session, out: Path | None = None, *, for_assessor: bool = False) -> Path:
    """Write index.html into `out`, by default report/, and return its path.

    It shows the newest predicted year and the model of it. for_assessor: write assessor.html
    instead. Raises NotEnoughDataError if the session has no pairs.csv yet, InputError for results
    that cannot be read, and for an assessor also without a predicted year.
    """
    if not session.pairs.is_file():
        raise NotEnoughDataError(
            f"{session.root}: no pairs.csv, because no bracket was paired yet; run fieldlum merge "
            "and fieldlum pair first"
        )
    folder, year = out or session.report, newest_annual(session)
    remove_scraps(folder)
    page = folder / ("assessor.html" if for_assessor else "index.html")
    text = _assessor_page(session, year) if for_assessor else _page(session, year)
    with replacing(page, "w", encoding="utf-8") as file:
        file.write(text)
    return page
