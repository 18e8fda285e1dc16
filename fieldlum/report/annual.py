"""The report's sections on the predicted year: where to sit, when glare comes, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats32
from fieldlum.core.records import SunSource
from fieldlum.optics.projection import NOT_SEEN, PARTLY_SEEN
from fieldlum.report.figures import picture_grid, png, polar_svg
from fieldlum.report.page import (
    DGP,
    EV,
    NOT_TRUSTED,
    Figure,
    Row,
    Section,
    Table,
    day_hour_grid,
    heat_map,
    named,
    sentence,
)
from fieldlum.session.files.predict_json import DirectionYear
from fieldlum.sky.sun import shown_altitude_deg, standard_time
from fieldlum.year.glare import panorama_to_fisheye
from fieldlum.year.predict import Annual
from fieldlum.year.predict.annual import Pictures
from fieldlum.year.predict.glare_summary import best_and_worst

_FISHEYE_PX = 220  # of a fisheye's edge: about its size on the page
CLASS_WORDS = {
    "high": "high protection",
    "medium": "medium protection",
    "minimum": "minimum protection",
    "none": "worse than minimum protection",
}


def answer(annual: Annual) -> tuple[str, str]:
    """Return the view direction to sit in, and the reason, as text of the page.

    If no direction was seen enough, both state this and what to capture.
    """
    rows = annual.summary.protection
    ends = best_and_worst(rows)
    if ends is None:
        return (
            "No view direction can be judged: the camera saw less than half of each.",
            "Capture several headings (headings in SITE.toml), or use a lens that sees more.",
        )
    best, worst = ends
    hours = annual.summary.occupancy.hours
    first = f"Sit facing {named(best.azimuth_deg)}: {_class_words(best)}."
    contrast = (
        f"Facing {named(worst.azimuth_deg)}, disturbing glare (DGP above 0.40) comes in "
        f"{worst.hours_over['0.40']} of {hours} occupied hours of the year; facing "
        f"{named(best.azimuth_deg)} in {best.hours_over['0.40']}. "
    )
    limit = (
        "A class of EN 17037 is met when DGP exceeds 0.35 (high), 0.40 (medium) or 0.45 (minimum) "
        "in at most 5 % of the occupied hours."
    )
    place = (
        " All of it holds for the camera's place: half a metre away, the window's edges are "
        "elsewhere."
    )
    return first, f"{contrast}{_unseen_words(rows)}{limit}{place}"


def _unseen_words(rows: Sequence[DirectionYear]) -> str:
    """Return a sentence that names the directions without an answer."""
    blind = [named(row.azimuth_deg) for row in rows if row.glare_class == NOT_SEEN]
    if not blind:
        return ""
    return f"No result for views to {', '.join(blind)}: the camera saw less than half of them. "


def _class_words(row: DirectionYear) -> str:
    words = f"{CLASS_WORDS[row.glare_class]} from glare"
    if row.seen == PARTLY_SEEN and not row.certain:
        return f"{words}, for the part of the view that was seen"
    if row.low is None:
        return f"{words}; this model cannot state a confidence"
    return words if row.certain else f"{words} is likeliest, but the captures do not decide it yet"


def polar(annual: Annual) -> Figure:
    """Return the polar plot, north up, of the DGP exceeded in 5 % of the occupied hours."""
    rows = annual.summary.protection
    azimuths = np.array([row.azimuth_deg for row in rows])
    exceeded, *bounds = (
        np.array([np.nan if value is None else value for value in values], float)
        for values in zip(*((row.dgp_exceeded, row.low, row.high) for row in rows), strict=True)
    )
    bounds = [None if np.isnan(ends).all() else ends for ends in bounds]
    spoken = ", ".join(f"{named(row.azimuth_deg)} {_figure(row)}" for row in rows)
    band = " The grey band is its 95 % interval." if bounds[0] is not None else ""
    return Figure(
        polar_svg(azimuths, exceeded, *bounds),
        "Polar plot, north up, of the DGP exceeded in 5 % of occupied hours by view direction: "
        f"{spoken}.",
        "The DGP that is exceeded in 5 % of the occupied hours, by view direction; the rings are "
        "the limits 0.35, 0.40, "
        f"0.45.{band} Nearer the middle is better; values above 0.60 are drawn at the rim.",
    )


def _figure(row: DirectionYear) -> str:
    """Return the DGP that 5 % of the occupied hours exceed, or that it is unknown."""
    return NOT_SEEN if row.dgp_exceeded is None else f"{row.dgp_exceeded:.2f}"


def _settled(row: DirectionYear) -> str:
    if row.glare_class == NOT_SEEN:
        return "–"
    if row.certain:
        return "yes"
    return "cannot tell yet" if row.low is not None else "no uncertainty known"


def _direction_table(annual: Annual) -> Table:
    rows = []
    for row in annual.summary.protection:
        interval = "–" if row.low is None else f"{row.low:.2f} to {row.high:.2f}"
        chip = {"kind": row.glare_class if row.certain else "open", "text": row.glare_class}
        if row.seen == PARTLY_SEEN:
            chip["text"] += ", partly seen"
        over = {k: "–" if v is None else v for k, v in row.hours_over.items()}
        exceeded = "–" if row.dgp_exceeded is None else f"{row.dgp_exceeded:.2f}"
        hours = (over["0.35"], over["0.40"], over["0.45"])
        rows.append((named(row.azimuth_deg), chip, _settled(row), exceeded, interval, *hours))
    head = ("view direction", "class", "settled", "DGP in 5 %", "95 % interval")
    return Table((*head, "h > .35", "h > .40", "h > .45"), tuple(rows))


def directions_section(annual: Annual) -> Section:
    """Return the section with the class of each view direction, and hours that would decide it."""
    tables = [_direction_table(annual)]
    wanted = annual.summary.capture_next
    if wanted:
        rows = tuple((w.date, w.hour, f"{w.dni_wm2:.0f}", f"{w.dhi_wm2:.0f}") for w in wanted)
        head = ("date", "local time", "direct, W/m²", "diffuse, W/m²")
        tables.append(
            Table(head, rows, "Hours like these, when captured, would decide the open classes")
        )
    notes = " ".join(map(sentence, annual.summary.notes[1:]))
    text = f"Occupied hours: {annual.summary.occupancy.text}. {notes}"
    return Section("directions", "Where to sit", text, tables=tuple(tables))


# ----------------------------------------------------------------------------------------------
# when


def when_section(annual: Annual, zone: str) -> Section:
    """Return the section with the heat map: days by hours of standard time of the zone `zone`.

    Its layers are DGP, vertical illuminance and hours that are not trusted, for each direction.
    """
    local = [standard_time(t, zone) for t in annual.t_utc]
    day = np.array([t.timetuple().tm_yday for t in local])
    hour = np.array([t.hour for t in local])
    judged, dgp = annual.judged, annual.views["dgp"]
    doubt = np.where(judged, (annual.hours["trusted"] <= 0.0)[:, None], np.nan)
    grids = [
        (layer, day_hour_grid(day, hour, values, max(365, int(day.max()))))
        for layer, values in ((DGP, dgp), (EV, annual.views["ev_lx"]), (NOT_TRUSTED, doubt))
    ]
    ends = best_and_worst(annual.summary.protection)
    names = [
        named(a) if good else f"{named(a)}: not seen"
        for a, good in zip(annual.azimuths_deg, judged, strict=True)
    ]
    start = 0 if ends is None else int(np.argmin(np.abs(annual.azimuths_deg - ends[1].azimuth_deg)))
    alt = (
        "Map of the year with a cell for each hour: days run to the right, hours of standard time "
        "upwards. The arrow keys move from cell to cell."
    )
    used_hours = hour[annual.occupied]
    used = (int(used_hours.min()), int(used_hours.max()) + 1) if len(used_hours) else ()
    year = local[len(local) // 2].year
    text = (
        "Each cell is one hour of the year: days to the right from January, hours of local "
        "standard time upwards. The dashed lines bound the hours of use over the year."
    )
    picture = heat_map(grids, names, year, alt, start, used)
    return Section("when", "When glare comes", text, heatmap=picture)


# ----------------------------------------------------------------------------------------------
# what it looks like


def _when(annual: Annual, row: int, zone: str) -> str:
    return annual.t_utc[row].astimezone(ZoneInfo(zone)).strftime("%d %b %H:%M")


def _fisheyes(annual: Annual, pictures: Pictures, k: int, zone: str) -> Row:
    """Return fisheyes around the room in one hour, with the sun's disc."""
    row, disc_lx, hours = int(pictures.rows[k]), float(pictures.disc_lx[k]), annual.hours
    altitude = float(shown_altitude_deg(hours["sun_altitude_deg"][row]))
    sun = (
        SunSource(altitude, float(hours["sun_azimuth_deg"][row]), disc_lx) if disc_lx > 0 else None
    )
    views, titles = [], []
    axis = (np.arange(_FISHEYE_PX) + 0.5) / _FISHEYE_PX - 0.5
    outside = np.hypot(axis[None, :], axis[:, None]) > 0.5
    for i in np.flatnonzero(annual.judged)[:10]:
        azimuth = float(annual.azimuths_deg[i])
        view = panorama_to_fisheye(
            pictures.luminance_cdm2[k], pictures.heading_deg, azimuth, size=_FISHEYE_PX, sun=sun
        )
        views.append(np.where(outside, np.nan, view))
        titles.append(f"{named(azimuth)}  DGP {annual.views['dgp'][row, i]:.2f}")
    when = _when(annual, row, zone)
    figure = png(picture_grid(views, titles, 5, 2.3)[0])
    alt = f"Fisheye views around the room at {when}."
    shown = Figure(figure, alt, f"Around the room, {when} (predicted).")
    return Row((shown,), "View directions in the hour of the highest DGP")


def looks_section(annual: Annual, pictures: Pictures, zone: str) -> Section:
    """Return the section with predicted pictures of typical and worst hours, and of a clear day."""
    day = [k for k, kind in enumerate(pictures.kinds) if kind == "clear day"]
    single = [k for k, kind in enumerate(pictures.kinds) if kind != "clear day"]
    when = [_when(annual, int(row), zone) for row in pictures.rows]
    rows = []
    if single:
        azimuths = [float(pictures.kinds[k].split()[-1]) for k in single]
        turned = [
            turned_map(pictures.luminance_cdm2[k], pictures.heading_deg, azimuth)
            for k, azimuth in zip(single, azimuths, strict=True)
        ]
        titles = [f"{_spoken(pictures.kinds[k])}, {when[k]}" for k in single]
        alt = f"False-colour panoramas: {'; '.join(titles)}."
        caption = "Predicted panoramas. The middle of each faces the direction that it is of."
        rows.append(Row((Figure(png(picture_grid(turned, titles, 2, 6.0)[0]), alt, caption),)))
    rows += [
        _fisheyes(annual, pictures, k, zone)
        for k in single
        if pictures.kinds[k].startswith("highest of worst")
    ]
    if day:
        figure = picture_grid([*pictures.luminance_cdm2[day]], [when[k] for k in day], 4, 3.0)[0]
        alt, caption = "Panoramas through a clear day.", "One clear day by hours (predicted)."
        rows.append(Row((Figure(png(figure, 90), alt, caption),), "A clear day"))
    return Section("looks", "What it looks like", "", tuple(rows))


def turned_map(luminance_cdm2: Floats32, heading_deg: float, azimuth_deg: float) -> Floats32:
    """Return a panorama [H, W] whose middle faces `azimuth_deg` instead of `heading_deg`."""
    columns = round((heading_deg - azimuth_deg) / 360.0 * luminance_cdm2.shape[1])
    return np.roll(luminance_cdm2, columns, axis=1)


def _spoken(kind: str) -> str:
    """Return ``p95 of worst view 180`` as a phrase."""
    share, _, which, _, azimuth = kind.split()
    names = {
        "typical": "Typical hour",
        "p95": "95th percentile of glare",
        "highest": "Highest glare",
    }
    return f"{names[share]}, {which} direction {named(float(azimuth))}"
