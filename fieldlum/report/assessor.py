"""The page for an assessor: what requirements ask, what was found, and what is missing.

It certifies nothing. Figures are those of the predicted year; an interval that spans a limit is
"cannot tell". Names of columns follow honeybee (GA) and ClimateStudio (sDG).
"""

from __future__ import annotations

from datetime import UTC, datetime

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.records import SiteFile
from fieldlum.optics.profiles import CameraProfile, find_camera_profile, load_camera_profile
from fieldlum.report.page import Section, Table, named, render, sentence
from fieldlum.report.sections import (
    WELL_EDI_LX,
    Share,
    exceeded_text,
    has_melanopic,
    interval_text,
    melanopic_section,
    melanopic_shares,
)
from fieldlum.session import Session, sha256
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.version import __version__
from fieldlum.year.glare.standards import EXCEEDED_SHARE
from fieldlum.year.predict import Annual

_GA_DGP, _SDG_DGP = 0.40, 0.38  # honeybee's and ClimateStudio's limits
_WORDS = {"none": "below minimum"}
METHOD = (
    "A camera of known calibration captured luminance maps of the room under many suns and skies, "
    "while irradiance was measured outside. A model learned how the room responds to sky and sun. "
    "It was tested on days that it had not seen, and predicted each daylight hour of the weather "
    "year. DGP, vertical illuminance and melanopic EDI were computed from the predicted maps at "
    "the camera's place and height. Intervals are for 95 %."
)


def _hours_over(annual: Annual, limit: float) -> list[Share]:
    """Return the share of the occupied hours whose DGP exceeds a limit, for each direction."""
    used, count = annual.occupied, max(annual.summary.occupancy.hours, 1)
    dgp, low, high = (annual.views[name][used] for name in ("dgp", "dgp_low", "dgp_high"))
    low, high = np.where(np.isnan(low), dgp, low), np.where(np.isnan(high), dgp, high)
    shares = [100.0 * (values > limit).sum(axis=0) / count for values in (dgp, low, high)]
    return [Share(*map(float, row)) for row in zip(*shares, strict=True)]


def _disturbed(annual: Annual) -> list[str]:
    """Return for each direction whether it is disturbed as sDG counts it: yes, no, cannot tell."""
    return [share.above(100 * EXCEEDED_SHARE) for share in _hours_over(annual, _SDG_DGP)]


def _glare_table(annual: Annual) -> Table:
    rows = []
    summary = annual.summary.protection
    each = zip(
        summary, annual.judged, _hours_over(annual, _GA_DGP), _disturbed(annual), strict=True
    )
    for row, good, over, disturbed in each:
        if not good:
            rows.append((named(row.azimuth_deg), "not seen", "–", "–", "–", "–"))
            continue
        word = _WORDS.get(row.glare_class, row.glare_class)
        settled = word if row.certain else f"cannot tell ({word} likeliest)"
        free = Share(100 - over.value, 100 - over.high, 100 - over.low).text()
        figures = exceeded_text(row), interval_text(row), free, disturbed
        rows.append((named(row.azimuth_deg), settled, *figures))
    head = ("view direction", "EN 17037 class", "DGP in 5 %", "95 % interval")
    return Table((*head, "GA (DGP ≤ 0.40)", "DGP > 0.38 in over 5 %"), rows)


# ----------------------------------------------------------------------------------------------
# requirements


def _requirements(annual: Annual, zone: str) -> Table:
    rows = annual.summary.protection
    decided = [row for row in rows if row.certain]
    classes = ", ".join(
        f"{named(row.azimuth_deg)} {_WORDS.get(row.glare_class, row.glare_class)}"
        for row in decided
    )
    found = f"decided in {len(decided)} of {len(rows)} directions: {classes or 'none'}"
    answers = [text for text, good in zip(_disturbed(annual), annual.judged, strict=True) if good]
    sdg = (
        f"{answers.count('yes')} of {len(answers)} directions are disturbed, "
        f"{answers.count('cannot tell')} cannot be decided"
    )
    edi = well = "cannot tell: no melanopic colour was measured"
    if has_melanopic(annual):
        each = zip(melanopic_shares(annual, zone), annual.judged, strict=True)
        best = max((s for s, good in each if good), key=lambda share: share[0].value)
        edi = f"best direction: {best[0].text()} of the hours"
        limits = zip(WELL_EDI_LX, best[1], strict=True)
        days = (f"{limit:.0f} lx on {share.text()} of the days" for limit, share in limits)
        well = f"best direction, daylight alone: {', '.join(days)}"
    place = "views at other places of the room"
    return Table(
        ("requirement", "what it asks", "what was found", "what is missing"),
        (
            (
                "EN 17037:2018+A1:2021, protection from glare",
                "DGP above 0.35 (high), 0.40 (medium), 0.45 (minimum) in at most 5 % of the "
                "occupied hours",
                found,
                place,
            ),
            (
                "BREEAM, control of glare; KBCN1800, KBCN1821",
                "hourly DGP of the year with robust reporting; or EN 17037 or LM-83",
                f"hourly DGP of {len(annual)} daylight hours with intervals (hourly.csv)",
                f"{place}; the strategy of shading, and the assessor's judgement",
            ),
            (
                "LEED v5, glare under Lighting Environment",
                "glare control for regularly occupied spaces; a regional path names DGP 0.45 in "
                "at most 5 % of the hours",
                f"class minimum or better is DGP 0.45: {found}",
                f"{place}; shading controls; the credit's own forms",
            ),
            (
                "sDG (ClimateStudio), GA (honeybee)",
                "share of views with DGP above 0.38 in over 5 % of the occupied hours; share of "
                "the hours with DGP of at most 0.40",
                sdg,
                f"{place}: a floor area needs a grid of views",
            ),
            (
                "WELL v2 L03, circadian lighting design",
                "melanopic EDI of 136 lx (250 lx for more points) at the eye from electric light, "
                "four hours between 09:00 and 13:00; 109 lx (163 lx) with enhanced daylight",
                well,
                "melanopic EDI of the electric light, which L03 counts",
            ),
            (
                "WELL v2 L04, electric light glare",
                "UGR or luminance limits of luminaires",
                "not examined",
                "figures of the luminaires, or captures at night",
            ),
            (
                "Brown et al. 2022; DIN/TS 67600:2022",
                "melanopic EDI of 250 lx or more at the eye throughout the day",
                edi,
                "electric light, and the hours in which people are there",
            ),
        ),
        words=True,
    )


# ----------------------------------------------------------------------------------------------
# evidence


def _instruments(session: Session, setup: SiteFile) -> Table:
    rows: list[tuple[str, str]] = []
    try:
        path = find_camera_profile(setup.camera.profile)
        rows = [*_camera_rows(load_camera_profile(path)), ("profile, sha256", sha256(path))]
    except InputError as error:
        rows.append(("camera", f"cannot tell: {error}"))
    meter = setup.pyranometer
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


def _camera_rows(profile: CameraProfile) -> list[tuple[str, str]]:
    scale, colour = 100 * profile.scale.u_rel, profile.colour
    melanopic = f"{100 * colour.melanopic_u_rel:.1f} %" if colour.melanopic_from_rgb else "none"
    origin = profile.provenance.fitted_by or profile.provenance.source or "not stated"
    return [
        ("camera", f"{profile.camera.name} ({profile.camera.make} {profile.camera.model})"),
        ("camera, calibrated", f"{profile.camera.date or 'no date'}, by {origin}"),
        ("camera, valid until", profile.expires or "not stated"),
        ("luminance scale, standard uncertainty", f"{scale:.1f} %"),
        ("melanopic colour, standard uncertainty", melanopic),
    ]


def page(session: Session, annual: Annual | None) -> str:
    """Return the page as HTML. Raises InputError without a predicted year."""
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
    signatures = Table(
        ("role", "name", "date", "signature"),
        [(role, "", "", "") for role in ("measured by", "calculated by", "checked by")],
        words=True,
    )
    notes, zone = " ".join(map(sentence, summary.notes)), site.timezone
    sections = (
        Section("requirements", "Requirements", tables=(_requirements(annual, zone),)),
        Section("glare", "Glare by view direction", notes, tables=(_glare_table(annual),)),
        melanopic_section(annual, zone),
        Section("method", "Method", METHOD),
        Section("instruments", "What was measured", tables=(_instruments(session, setup),)),
        Section("versions", "Versions and files", tables=(_words(versions),)),
        Section("signatures", "Signatures", tables=(signatures,)),
    )
    return render(
        f"{site.name}: glare and daylight for an assessor",
        "What each requirement asks, what was found, and what is missing",
        "Nothing on this page is certified. Words in the column of findings are those of the "
        "predicted year; “cannot tell” means that the interval spans the limit.",
        (
            ("place", f"{site.latitude_deg:.3f}, {site.longitude_deg:.3f}"),
            ("written", f"{datetime.now(UTC):%d %B %Y}"),
            ("occupied hours", f"{occupancy.hours}"),
        ),
        sections,
    )
