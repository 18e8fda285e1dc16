"""Write the page for an assessor: what EN 17037, BREEAM, LEED and WELL ask, and the results.

The page certifies nothing: a result whose interval spans a limit is "cannot tell". Names of columns
follow honeybee (GA) and ClimateStudio (sDG). The texts are in requirements.toml.
"""

import tomllib
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import SiteFile, counted
from fieldlum.optics import profiles
from fieldlum.report import sections
from fieldlum.report.page import Page, Section, Table, class_name, direction_name, render, sentence
from fieldlum.session import Session, sha256
from fieldlum.session.files.model_files import ScoresFile
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.session.files.sidecar import of_other_profile
from fieldlum.session.folder import DeviceTable
from fieldlum.version import __version__
from fieldlum.year.glare.standards import CLASSES
from fieldlum.year.predict import Annual
from fieldlum.year.predict.melanopic import WELL_EDI_LX

_ITEMS = ("item", "value")


def _requirements(annual: Annual, zone: str, texts: Sequence[Mapping[str, str]]) -> Table:
    """Return the table of requirements next to the results of the year.

    zone: IANA name, for local standard time; texts: for each requirement its name, what it asks,
    and forms of the result (with the names in braces that are filled here) and of what is missing.
    """
    directions = annual.summary.protection
    decided = [row for row in directions if row.certain]
    classes = ", ".join(f"{direction_name(row.azimuth_deg)} {class_name(row)}" for row in decided)
    found = f"decided in {len(decided)} of {len(directions)} directions: {classes or 'none'}"
    answers = [text for text in sections.disturbed(annual) if text != "–"]
    yes, unknown = answers.count("yes"), answers.count("cannot tell")
    sdg = f"{yes} of {len(answers)} directions are disturbed, {unknown} cannot be decided"
    limit, ends = dict(CLASSES)["minimum"], [(row.low, row.high) for row in directions]
    low, high = np.array(ends, float).reshape(-1, 2).T  # of the DGP in 5 %; NaN where unknown
    met, exceeded = int((high <= limit).sum()), int((low > limit).sum())
    others = f"{exceeded} in more, {len(directions) - met - exceeded} cannot be decided"
    leed = f"{met} of {len(directions)} directions exceed it in at most 5 % of the hours, {others}"
    edi = well = "cannot tell: no melanopic colour was measured"
    if sections.has_melanopic(annual):
        shares = zip(sections.melanopic_shares(annual, zone), annual.judged, strict=True)
        judged = (of_direction for of_direction, is_judged in shares if is_judged)
        of_hours, of_days = max(judged, key=lambda of_direction: of_direction[0].value)
        edi = f"best direction: {of_hours.text()} of the hours"
        limits = zip(WELL_EDI_LX, of_days, strict=True)
        days = (f"{limit:.0f} lx on {share.text()} of the days" for limit, share in limits)
        well = f"best direction: {', '.join(days)}"
    results = {"found": found, "leed": leed, "sdg": sdg, "edi": edi, "well": well}
    keys = ("requirement", "asks", "found", "missing")
    rows = [[row[key].format(**results, hours=len(annual)) for key in keys] for row in texts]
    head = ("requirement", "what it asks", "what was found", "what is missing")
    return Table(head, rows, words=True)


def _reported(device: DeviceTable) -> str:
    """Return model and serial number as the device reported them, "" if it reported none."""
    return " ".join(str(device[key]) for key in ("model", "serial") if device.get(key))


def _instruments(session: Session, setup: SiteFile) -> Table:
    """Return the table of camera and pyranometer with their calibrations, as far as stated.

    A camera profile that cannot be read is named in the table, and that of panoramas which were
    merged with another one.
    """
    pyranometer, devices = setup.pyranometer, session.table().get("devices", {})
    serial = _reported(devices.get("pyranometer", {}))
    try:
        path = profiles.find_camera_profile(setup.camera.profile)
        profile = profiles.load_camera_profile(path)
        camera, colour = profile.camera, profile.colour
        melanopic = f"{100 * colour.melanopic_u_rel:.1f} %" if colour.melanopic_from_rgb else "none"
        origin = profile.provenance.fitted_by or profile.provenance.source or "not stated"
        rows = {
            "camera's profile": f"{camera.name} ({camera.make} {camera.model})",
            "camera, calibrated": f"{camera.date or 'no date'}, by {origin}",
            "camera, valid until": profile.expires or "not stated",
            "luminance scale, standard uncertainty": f"{100 * profile.scale.u_rel:.1f} %",
            "melanopic colour, standard uncertainty": melanopic,
            "profile, sha256": sha256(path),
        }
    except InputError as error:
        rows = {"camera": f"cannot tell: {error}"}
    if others := of_other_profile(session):
        profile = others[0].profile
        of_these = f"{counted(len(others), 'panorama')} of profile {profile.get('name', '')}"
        again = "so the profile above is not that of the results: merge, pair and train again"
        rows["results"] = f"{of_these}, sha256 {profile['sha256']}, {again}"
    rows |= {
        "camera, as it reported itself": _reported(devices.get("camera", {})) or "not recorded",
        "pyranometer": f"{pyranometer.kind} {pyranometer.profile} {serial}".strip() or "not stated",
        "pyranometer, calibration": "state the date of its certificate here: ________",
        "camera's place": f"{setup.camera.height_m:g} m above the floor",
    }
    return Table(_ITEMS, tuple(rows.items()), "Instruments and calibrations", words=True)


def assessor_page(session: Session, annual: Annual | None, model: Path | None) -> str:
    """Return the page for an assessor as HTML.

    annual: the predicted year; model: folder of the model, whose scores are shown, None if it is
    missing. Raises NotEnoughDataError if there is no predicted year, InputError for a session or
    results that cannot be read. A camera profile that cannot be read is only named on the page.
    """
    if annual is None:
        raise NotEnoughDataError(f"{session.root}: no predicted year; run fieldlum predict first")
    text = Path(__file__).with_name("requirements.toml").read_text(encoding="utf-8")
    texts, setup, summary = tomllib.loads(text), session.site_file(), annual.summary
    site, weather, occupancy = setup.site, summary.weather, summary.occupancy
    versions = [
        ("fieldlum", __version__),
        ("model", summary.model),
        ("weather", f"{weather.name}{' (synthetic)' if weather.synthetic else ''}"),
        ("hours that the model does not trust", f"{100 * occupancy.untrusted_share:.0f} %"),
    ]
    files = ("predict.json", "hourly.csv")
    versions += [(f"{name}, sha256", sha256(annual.folder / name)) for name in files]
    measured = sections.captures_section(session, site, PairsFile.find(session.pairs), annual.hours)
    measured = measured._replace(tables=(_instruments(session, setup), *measured.tables))
    accuracy = [] if model is None else [sections.accuracy_section(None, ScoresFile.find(model))]
    roles = [(role, "", "", "") for role in ("measured by", "calculated by", "checked by")]
    signatures = Table(("role", "name", "date", "signature"), roles, words=True)
    zone = site.timezone
    requirements = _requirements(annual, zone, texts["row"])
    shown = (
        Section("requirements", "Requirements", tables=(requirements,)),
        sections.directions_section(annual)._replace(title="Glare by view direction"),
        sections.melanopic_section(annual, zone),
        sections.budget_section(annual, folded=False),
        Section("method", "Method", " ".join((texts["method"], *map(sentence, summary.notes[:1])))),
        *accuracy,
        measured,
        Section("versions", "Versions and files", tables=(Table(_ITEMS, versions, words=True),)),
        Section("signatures", "Signatures", tables=(signatures,)),
    )
    place, today = f"{site.latitude_deg:.3f}, {site.longitude_deg:.3f}", datetime.now(UTC)
    hours = ("occupied hours", f"{occupancy.hours}")
    facts = [("place", place), ("written", f"{today:%d %B %Y}"), hours]
    title = f"{site.name}: glare and daylight for an assessor"
    warnings, answer, why = sections.warnings_of(session, annual), texts["title"], texts["caution"]
    return render(Page(title, answer, why, facts=facts, sections=shown, warnings=warnings))
