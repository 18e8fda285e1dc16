"""The report's sections on the predicted year: where to sit, when glare comes, pictures."""

from __future__ import annotations

from collections.abc import Sequence
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats32
from fieldlum.core.false_colour import coloured, png_of
from fieldlum.core.records import SunSource
from fieldlum.optics.projection import NOT_SEEN, PARTLY_SEEN
from fieldlum.report.figures import (
    exceedance_svg,
    fisheyes_png,
    luminance_scale_svg,
    polar_svg,
    strip_png,
)
from fieldlum.report.page import (
    DGP_COLOURS,
    DGP_EDGES,
    EV_COLOURS,
    EV_EDGES,
    Figure,
    HeatMap,
    Quantity,
    Row,
    Section,
    Table,
    day_hour_grid,
    heat_map,
    named,
    png_figure,
    svg_figure,
)
from fieldlum.session.files.predict_json import DirectionYear
from fieldlum.sky.sun import shown_altitude_deg, standard_time
from fieldlum.year.glare import panorama_to_fisheye
from fieldlum.year.predict import Annual
from fieldlum.year.predict.annual import Pictures
from fieldlum.year.predict.glare_summary import best_and_worst

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
    return svg_figure(
        polar_svg(azimuths, exceeded, *bounds),
        f"Polar plot, north up, of the DGP exceeded in 5 % of occupied hours by view direction: "
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
    notes = (f"{note[0].upper()}{note[1:].rstrip('.')}." for note in annual.summary.notes[1:])
    text = f"Occupied hours: {annual.summary.occupancy.text}. {' '.join(notes)}"
    return Section("directions", "Where to sit", text, _exceedance(annual), tuple(tables))


def _exceedance(annual: Annual) -> tuple[Row, ...]:
    ends = best_and_worst(annual.summary.protection)
    if ends is None:
        return ()
    best, worst = ends
    curve = exceedance_svg(
        annual.views["dgp"][annual.occupied][:, annual.judged],
        annual.summary.occupancy.hours,
        annual.azimuths_deg[annual.judged],
        (("worst", worst.azimuth_deg), ("best", best.azimuth_deg)),
    )
    alt = "Exceedance curves of DGP for each direction over the occupied hours."
    caption = (
        "Share of the occupied hours in which a DGP is exceeded; each grey line is a view "
        "direction."
    )
    return (Row((svg_figure(curve, alt, caption),)),)


# ----------------------------------------------------------------------------------------------
# when


def _local_day_and_hour(
    annual: Annual, zone: str
) -> tuple[NDArray[np.int64], NDArray[np.int64], int]:
    """Return day of the year from 1, hour of local standard time, and a year for naming days."""
    local = [standard_time(t, zone) for t in annual.t_utc]
    days = np.array([t.timetuple().tm_yday for t in local])
    return days, np.array([t.hour for t in local]), local[len(local) // 2].year


def when_section(annual: Annual, zone: str) -> Section:
    """Return the section with the heat map: days by hours of standard time of the zone `zone`.

    Its layers are DGP, vertical illuminance and hours that are not trusted, for each direction.
    """
    day, hour, year = _local_day_and_hour(annual, zone)
    days = max(365, int(day.max()))
    dgp = day_hour_grid(day, hour, annual.views["dgp"], days)
    ev = day_hour_grid(day, hour, annual.views["ev_lx"], days)
    judged = annual.judged
    doubt = day_hour_grid(day, hour, np.where(annual.hours["trusted"] > 0, 0.0, 1.0)[:, None], days)
    quantities = (
        Quantity("DGP", "", dgp, 0.001, DGP_EDGES, DGP_COLOURS, (False, False, False, True), 2),
        Quantity(
            "Vertical illuminance",
            " lx",
            ev,
            10.0,
            EV_EDGES,
            EV_COLOURS,
            (True, True, True, True, False, False, False),
        ),
        Quantity(
            "Hours that are not trusted",
            "",
            np.where(judged, np.repeat(doubt, dgp.shape[2], axis=2), np.nan),
            1.0,
            (1.0,),
            ("#cfe6dc", "#8d6bb0"),
            (False, True),
        ),
    )
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
    picture: HeatMap = heat_map(quantities, names, year, alt, start, used)
    text = (
        "Each cell is one hour of the year: days to the right from January, hours of local "
        "standard time upwards. The dashed lines bound the hours of use over the year."
    )
    return Section("when", "When glare comes", text, heatmap=picture)


# ----------------------------------------------------------------------------------------------
# what it looks like


def _when(annual: Annual, row: int, zone: str) -> str:
    return annual.t_utc[row].astimezone(ZoneInfo(zone)).strftime("%d %b %H:%M")


def _sun_of(annual: Annual, row: int, disc_lx: float) -> SunSource | None:
    hours = annual.hours
    if disc_lx <= 0:
        return None
    return SunSource(
        float(shown_altitude_deg(hours["sun_altitude_deg"][row])),
        float(hours["sun_azimuth_deg"][row]),
        disc_lx,
    )


def _fisheyes(annual: Annual, pictures: Pictures, k: int, zone: str) -> Figure:
    row = int(pictures.rows[k])
    sun = _sun_of(annual, row, float(pictures.disc_lx[k]))
    shown = np.flatnonzero(annual.judged)[:10]
    views = np.stack(
        [
            panorama_to_fisheye(
                pictures.luminance_cdm2[k], pictures.heading_deg, float(a), size=220, sun=sun
            )
            for a in annual.azimuths_deg[shown]
        ]
    )
    axis = (np.arange(220) + 0.5) / 110.0 - 1.0
    views[:, np.hypot(axis[None, :], axis[:, None]) > 1.0] = np.nan
    png = fisheyes_png(views, annual.azimuths_deg[shown], annual.views["dgp"][row, shown])
    when = _when(annual, row, zone)
    return png_figure(
        png, f"Fisheye views around the room at {when}.", f"Around the room, {when} (predicted)."
    )


def looks_section(annual: Annual, pictures: Pictures, zone: str) -> Section:
    """Return the section with predicted pictures of typical and worst hours, and of a clear day."""
    single = [k for k, kind in enumerate(pictures.kinds) if kind != "clear day"]
    shown = []
    for k in single:
        row = int(pictures.rows[k])
        azimuth_deg = float(pictures.kinds[k].split()[-1])
        turned = turned_map(pictures.luminance_cdm2[k], pictures.heading_deg, azimuth_deg)
        image = png_of(coloured(turned))
        caption = (
            f"{_spoken(pictures.kinds[k])}: {_when(annual, row, zone)}. The middle faces "
            f"{named(azimuth_deg)}."
        )
        shown.append(png_figure(image, f"False-colour panorama, {caption}", caption))
    scale = svg_figure(
        luminance_scale_svg(), "Colour scale from 1 to 10 000 cd/m².", "Logarithmic colour scale."
    )
    rows = [Row((scale,)), *(Row(tuple(shown[i : i + 2])) for i in range(0, len(shown), 2))]
    worst = next((k for k in single if pictures.kinds[k].startswith("highest of worst")), None)
    if worst is not None:
        rows.append(
            Row(
                (_fisheyes(annual, pictures, worst, zone),),
                "View directions in the hour of the highest DGP",
            )
        )
    day = [k for k, kind in enumerate(pictures.kinds) if kind == "clear day"]
    if day:
        labels = [_when(annual, int(pictures.rows[k]), zone) for k in day]
        png = strip_png(pictures.luminance_cdm2[day], labels)
        strip = png_figure(
            png, "Panoramas through a clear day.", "One clear day, hour by hour (predicted)."
        )
        rows.append(Row((strip,), "A clear day"))
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
