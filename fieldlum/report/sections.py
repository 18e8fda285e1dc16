"""The report's sections: where to sit, when glare comes, pictures, EDI, accuracy, captures."""

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from typing import NamedTuple
from zoneinfo import ZoneInfo

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.errors import InputError
from fieldlum.core.progress import progress
from fieldlum.core.records import Site, counted
from fieldlum.optics import profiles
from fieldlum.optics.projection import NOT_SEEN, PARTLY_SEEN
from fieldlum.report import page
from fieldlum.report.page import Figure, Section, Table, direction_name, sentence
from fieldlum.session import Session
from fieldlum.session.files.model_files import HeldOutMaps, ScoresFile
from fieldlum.session.files.pairs_csv import PairRow, PairsFile
from fieldlum.session.files.predict_json import DirectionYear
from fieldlum.session.panorama_sun import SUN_FROM, read_suns
from fieldlum.sky import sun
from fieldlum.sky.sun_disc import add_source
from fieldlum.year.glare.pictures import panorama_to_fisheye, picture_centres
from fieldlum.year.glare.standards import EXCEEDED_SHARE, dgp_per_scale
from fieldlum.year.glare.uncertainty_budget import BUDGET_FILE, read_budgets
from fieldlum.year.predict import Annual, melanopic
from fieldlum.year.predict.annual import Pictures
from fieldlum.year.predict.year import best_and_worst, outdated_text

_FISHEYE_PX = 220  # width and height of a fisheye: about its size on the page
_OF_POSE = ("pose by ", "heading ", "the discs leave open ")  # beginnings of notes on the method
GA_DGP, SDG_DGP = 0.40, 0.38  # honeybee's limit of GA, and ClimateStudio's of sDG


def best_direction(annual: Annual) -> tuple[str, str]:
    """Return two texts of the page: the direction with the least glare, and the reason.

    If no direction was seen enough, the texts state this and what to capture.
    """
    rows = annual.summary.protection
    ends = best_and_worst(rows)
    if ends is None:
        return (
            "No view direction can be judged: the camera saw less than half of each.",
            "Capture several headings (headings in SITE.toml), or use a lens that sees more.",
        )
    best, worst = ends
    hidden = [direction_name(row.azimuth_deg) for row in rows if row.glare_class == NOT_SEEN]
    unseen = f"No result for views to {', '.join(hidden)}: the camera saw less than half of them. "
    advice = f"facing {direction_name(best.azimuth_deg)}: {_class_words(best)}."
    glare = _hours_texts(annual, GA_DGP)
    is_open = best.low is None or best.seen == PARTLY_SEEN
    doubtful = best.glare_class == "none" or (is_open and not best.certain)
    # 0 days: unknown, in a year of 0.1.0; other limits as for `are_full_years`
    period = "the year" if 360 <= ((days := annual.summary.days) or 365) < 372 else f"{days} days"
    lead = "Least glare" if doubtful or annual.summary.weather.synthetic else "Sit"
    if annual.summary.weather.synthetic:
        lead = f"In a synthetic year only, {lead.lower()}"
    return (
        f"{lead} {advice}",
        f"Facing {direction_name(worst.azimuth_deg)}, disturbing glare (DGP above 0.40) comes in "
        f"{glare[rows.index(worst)]} of {annual.summary.occupancy.hours} occupied hours of "
        f"{period}; facing {direction_name(best.azimuth_deg)} in {glare[rows.index(best)]}. "
        f"{unseen if hidden else ''}A class of EN 17037 is met when DGP exceeds 0.35 (high), 0.40 "
        "(medium) or 0.45 (minimum) in at most 5 % of the occupied hours. All of it holds for the "
        "camera's place: half a metre away, the window's edges are elsewhere.",
    )


def _class_words(row: DirectionYear) -> str:
    """Return the class of a direction in words, with its restrictions: unseen parts, doubt."""
    name = f"{row.glare_class} protection"
    words = f"{'worse than minimum protection' if row.glare_class == 'none' else name} from glare"
    if row.seen == PARTLY_SEEN and not row.certain:
        words += " for the seen part of the view"
    if row.low is None:
        return f"{words} is likeliest, but this model cannot state a confidence"
    return words if row.certain else f"{words} is likeliest, but the captures do not decide it yet"


def polar(annual: Annual) -> Figure:
    """Return the polar plot, north up, of the DGP exceeded in 5 % of the occupied hours."""
    rows = annual.summary.protection
    # [d, 4], NaN where unknown
    figures = np.array([(r.azimuth_deg, r.dgp_exceeded, r.low, r.high) for r in rows], float)
    each = (f"{direction_name(row.azimuth_deg)} {exceeded_text(row, NOT_SEEN)}" for row in rows)
    what = "DGP exceeded in 5 % of the occupied hours, by view direction"
    band = "" if np.isnan(figures[:, 2]).all() else " The grey band is its 95 % interval."
    return Figure(
        page.polar_svg(*figures.T),
        f"The {what}; the rings are the limits 0.35, 0.40, 0.45.{band} Nearer the middle is "
        "better; values above 0.60 are drawn at the rim.",
        f"Polar plot, north up, of the {what}: {', '.join(each)}.",
    )


def exceeded_text(row: DirectionYear, unknown: str = "–") -> str:
    """Return the DGP that 5 % of the occupied hours exceed, as a text with two decimals.

    unknown: the text for a direction without a DGP.
    """
    return unknown if row.dgp_exceeded is None else f"{row.dgp_exceeded:.2f}"


class Share(NamedTuple):
    """A share of a year's hours or of its days, in percent.

    value: the best estimate; low, high: ends of its 95 % interval.
    """

    value: float
    low: float
    high: float

    def text(self) -> str:
        """Return a text such as "12 % (8 to 15)", without the interval if its ends round alike."""
        if np.isnan(self[0]):
            return "unknown"
        value, low, high = (f"{part:.0f}" for part in self)
        return f"{value} %" if low == high else f"{value} % ({low} to {high})"

    def above(self, limit: float) -> str:
        """Return whether the share exceeds a limit [%]: "yes", "no" or "cannot tell".

        The answer is "cannot tell" if the limit is within the interval.
        """
        return "yes" if self.low > limit else "no" if self.high <= limit else "cannot tell"


def _hours_over(annual: Annual, limit: float) -> list[Share]:
    """Return the share of the occupied hours whose DGP exceeds a limit, for each direction.

    limit: of DGP. The interval of a share includes the uncertainty of the camera's scale, which the
    intervals of single hours do not. An hour without a stated uncertainty can have any DGP.
    """
    count = max(annual.summary.occupancy.hours, 1)  # dark hours too, which have no glare
    names = ("dgp", "dgp_low", "dgp_high", "u_dgp", "ev_lx")
    dgp, low, high, u_dgp, ev_lx = (annual.views[n][annual.occupied] for n in names)  # [n, d]
    is_open = np.isnan(low + high + u_dgp)
    low, high = np.where(is_open, 0.0, low), np.where(is_open, 1.0, high)
    of_scale = 1.96 * annual.summary.u_scale_rel * dgp_per_scale(dgp, ev_lx)
    low, high = dgp - np.hypot(dgp - low, of_scale), dgp + np.hypot(high - dgp, of_scale)
    shares = np.stack([100.0 * (hours > limit).sum(axis=0) / count for hours in (dgp, low, high)])
    return [Share(*of_direction) for of_direction in shares.T.tolist()]


def _hours_texts(annual: Annual, limit: float) -> list[str]:
    """Return the occupied hours whose DGP exceeds a limit of EN 17037, for each direction.

    Each is a number with its 95 % interval, such as "305 (210 to 640)"; "–" if it is not known.
    """
    texts, count = [], annual.summary.occupancy.hours
    for row, share in zip(annual.summary.protection, _hours_over(annual, limit), strict=True):
        low, high = (round(count * part / 100) for part in (share.low, share.high))
        hours = row.hours_over.get(f"{limit:.2f}")
        interval = f" ({low} to {high})" if row.low is not None and low < high else ""
        texts.append("–" if hours is None else f"{hours}{interval}")
    return texts


def disturbed(annual: Annual) -> list[str]:
    """Return for each direction whether it is disturbed: "yes", "no" or "cannot tell".

    As sDG (ClimateStudio) counts it, it is if DGP exceeds 0.38 in over 5 % of the occupied hours.
    The text is "–" for a direction that was not seen. The order is that of `annual.azimuths_deg`.
    """
    shares = zip(_hours_over(annual, SDG_DGP), annual.judged, strict=True)
    return [share.above(100 * EXCEEDED_SHARE) if seen else "–" for share, seen in shares]


def directions_section(annual: Annual) -> Section:
    """Return the section with a table of view directions: class, DGP, and hours above limits."""
    rows, summary = [], annual.summary.protection
    disturbing = _hours_texts(annual, GA_DGP)
    shown = (summary, _hours_over(annual, GA_DGP), disturbed(annual), disturbing)
    for row, over, sdg, of_glare in zip(*shown, strict=True):
        counts = {name: "–" if n is None else n for name, n in row.hours_over.items()}
        hours = (counts | {f"{GA_DGP:.2f}": of_glare}).values()
        unknown = "cannot tell yet" if row.low is not None else "no uncertainty known"
        settled = "–" if row.glare_class == NOT_SEEN else "yes" if row.certain else unknown
        of_class = page.chip(row, ", partly seen" if row.seen == PARTLY_SEEN else "")
        free = Share(100 - over.value, 100 - over.high, 100 - over.low).text()
        interval = "–" if row.low is None else f"{row.low:.2f} to {row.high:.2f}"
        figures = (exceeded_text(row), interval, *hours, "–" if sdg == "–" else free, sdg)
        rows.append((direction_name(row.azimuth_deg), of_class, settled, *figures))
    head = ("view direction", "class", "settled", "DGP in 5 %", "95 % interval")
    occupied = f"Occupied hours: {annual.summary.occupancy.text}."
    autonomy = (
        "GA (glare autonomy, honeybee): occupied hours with DGP of at most 0.40. sDG "
        "(ClimateStudio): whether DGP exceeds 0.38 in over 5 % of them."
    )
    notes = [note for note in annual.summary.notes[1:] if not note.startswith(_OF_POSE)]
    text = "\n".join((occupied, *map(sentence, notes), autonomy))
    table = Table((*head, "h > .35", "h > .40", "h > .45", "GA", "sDG: disturbed"), rows)
    return Section("directions", "Where to sit", text, tables=(table,))


def when_section(annual: Annual, zone: str) -> Section:
    """Return the section with the heat map of the year: days by hours, for each direction.

    Its layers are DGP, vertical illuminance and hours that are not trusted. zone: IANA name, for
    local standard time.
    """
    local = [sun.standard_time(t, zone) for t in annual.t_utc]
    hour = np.array([t.hour for t in local])
    not_trusted = np.where(annual.judged, (annual.hours["trusted"] <= 0.0)[:, None], np.nan)
    layers = [(page.DGP, annual.views["dgp"]), (page.EV, annual.views["ev_lx"])]
    layers.append((page.NOT_TRUSTED, not_trusted))
    ends = best_and_worst(annual.summary.protection)
    worst_deg = annual.azimuths_deg[0] if ends is None else ends[1].azimuth_deg
    used = hour[annual.occupied]
    picture = page.heat_map(
        np.array([t.timetuple().tm_yday for t in local]),
        hour,
        layers,
        local[-1 if annual.summary.days > 371 else len(local) // 2].year,
        directions=[
            direction_name(azimuth) if seen else f"{direction_name(azimuth)}: not seen"
            for azimuth, seen in zip(annual.azimuths_deg, annual.judged, strict=True)
        ],
        start=int(np.argmin(np.abs(annual.azimuths_deg - worst_deg))),
        used=(int(used.min()), int(used.max()) + 1) if len(used) else (),
        alt="Map of the year with a cell for each hour: days run to the right, hours of standard "
        "time upwards. The arrow keys move from cell to cell.",
    )
    text = (
        "Each cell is one hour of the year: days to the right from January, hours of local "
        "standard time upwards. The dashed lines bound the hours of use over the year."
    )
    return Section("when", "When glare comes", text, heatmap=picture)


# ----------------------------------------------------------------------------------------------
# what it looks like


_RING = "A blue ring marks the sun's disc, which is smaller than a pixel."


def looks_section(annual: Annual, pictures: Pictures, zone: str) -> Section:
    """Return the section with predicted pictures of typical hours and of those with most glare.

    pictures: those stored with the year; zone: IANA name of the time zone of the hours that are
    named, with summer time.
    """
    names = {"typical": "Typical hour", "p95": "95th percentile"}
    turned, titles, rows = [], [], []
    for k, kind in enumerate(pictures.kinds):
        progress(k, len(pictures.kinds), "pictures")
        if " view " not in kind:  # earlier versions have a clear day too
            continue
        share, _, which, _, azimuth = kind.split()  # such as "p95 of worst view 180"
        azimuth_deg, light = float(azimuth), _with_disc(annual, pictures, k)
        columns = round((pictures.heading_deg - azimuth_deg) / 360.0 * light.shape[1])
        turned.append(np.roll(light, columns, axis=1))  # the view direction in the middle
        when = annual.t_utc[pictures.rows[k]].astimezone(ZoneInfo(zone)).strftime("%d %b %H:%M")
        share = names.get(share, "Highest glare")
        titles.append(f"{share}, {which} direction {direction_name(azimuth_deg)}, {when}")
        if kind.startswith("highest of worst"):
            rows.append((_fisheyes(annual, pictures, k, when),))
    if turned:
        alt = f"False-colour panoramas: {'; '.join(titles)}."
        caption = (
            f"Predicted panoramas. The middle of each faces the direction that it is of. {_RING}"
        )
        figure = Figure(page.png(page.picture_grid(turned, titles, 2, 6.0)[0]), caption, alt)
        rows.insert(0, (figure,))
    return Section("looks", "What it looks like", rows=rows)


def _with_disc(annual: Annual, pictures: Pictures, k: int) -> Floats32:
    """Return picture k of `pictures` [H, W] with the sun's disc, if it is seen in that hour."""
    row, hours, light = pictures.rows[[k]], annual.hours, pictures.luminance_cdm2[[k]]
    place = sun.apparent_altitude_deg(hours["sun_altitude_deg"][row]), hours["sun_azimuth_deg"][row]
    return add_source(light, place, pictures.disc_lx[[k]], pictures.heading_deg)[0]


def _fisheyes(annual: Annual, pictures: Pictures, k: int, when: str) -> Figure:
    """Return a figure of fisheyes around the room in one hour, with the sun's disc.

    k: index of the hour in `pictures`; when: its time, as a text. At most ten directions are shown.
    """
    row, light = int(pictures.rows[k]), _with_disc(annual, pictures, k)
    views, titles = [], []
    is_outside = np.hypot(*picture_centres(_FISHEYE_PX, _FISHEYE_PX)) > 0.5
    for i in np.flatnonzero(annual.judged)[:10]:
        azimuth_deg = float(annual.azimuths_deg[i])
        shown = panorama_to_fisheye(light, pictures.heading_deg, azimuth_deg, size=_FISHEYE_PX)
        views.append(np.where(is_outside, np.nan, shown))
        titles.append(f"{direction_name(azimuth_deg)}  DGP {annual.views['dgp'][row, i]:.2f}")
    what = f"View directions around the room in the hour of the highest DGP, {when} (predicted). "
    return Figure(page.png(page.picture_grid(views, titles, 5, 2.3)[0]), what + _RING)


def budget_section(annual: Annual, *, folded: bool = True) -> Section:
    """Return the section with the uncertainty budget of the year, a table for each figure.

    A row is a view direction, a column a source of uncertainty. A source that adds under a
    hundredth of the combined uncertainty is a dash. folded: whether the tables are shown only after
    a click. For a year without budget.csv a sentence replaces the tables. Raises InputError for a
    damaged one.
    """
    tables, budget = [], read_budgets(annual.folder / BUDGET_FILE)
    for figure, unit in dict.fromkeys((row["figure"], row["unit"]) for row in budget):
        shown = [row for row in budget if row["figure"] == figure and row["contribution"]]
        # shares are of the variance: 0.01 % is a hundredth of the uncertainty
        shown = [row for row in shown if float(row["share_percent"] or 0) > 0.01]
        names = dict.fromkeys(["combined", *(row["source"] for row in shown)])
        views: dict[tuple[str, str], dict[str, str]] = {}  # texts of the sources
        for row in shown:
            direction = (row["azimuth_deg"], row["estimate"])
            of_sources = views.setdefault(direction, dict.fromkeys(names, "–"))
            of_sources[row["source"]] = f"{float(row['contribution']):.2g}"
        rows = [
            (direction_name(float(azimuth)), f"{float(estimate):.3g}", *of_sources.values())
            for (azimuth, estimate), of_sources in views.items()
        ]
        title = figure if unit == "1" else f"{figure} [{unit}]"
        tables.append(Table(("facing", "estimate", *names), rows, title, folded=folded))
    text = (
        "What each source adds to the standard uncertainty of a figure of the year, unless it is "
        "under a hundredth of the combined one. Another year's weather, and a blind that moves, "
        "are not in it. budget.csv has types, sensitivities and shares (GUM)."
        if budget
        else "This year has no budget.csv: run fieldlum predict again."
    )
    text = " ".join((text, *(sentence(n) for n in annual.summary.notes if n.startswith(_OF_POSE))))
    return Section("budget", "Uncertainty budget", text, tables=tuple(tables))


# ----------------------------------------------------------------------------------------------
# melanopic light


def has_melanopic(annual: Annual) -> bool:
    """Return whether any hour of the year has melanopic EDI by the captures' measured colour."""
    return bool(np.isfinite(annual.views["melanopic_edi_lx"]).any())


def melanopic_shares(annual: Annual, zone: str) -> list[tuple[Share, list[Share]]]:
    """Return the shares of the year with enough melanopic light, for each of d directions.

    The first share is of hours (`ENOUGH_HOURS` of `YearHours.shares`), those in the list are of
    days, by the limits of `ENOUGH_DAYS` in this order. zone: IANA name, for local standard time.
    The intervals are those of budget.csv; for a year without it the errors of all hours count as
    equal. Without measured colour the shares are estimates, and both ends of their intervals are
    the value. Shares of a direction that was not seen are NaN. Raises InputError for a damaged
    budget.csv.
    """
    hours = melanopic.YearHours.of(annual.t_utc, zone, annual.summary)
    edi_lx, u_lx = annual.views["melanopic_edi_lx"], annual.views["u_melanopic_edi_lx"]  # [n, d]
    if not has_melanopic(annual):
        edi_lx, u_lx = annual.views["melanopic_edi_lx_estimate"], np.zeros(1)
    # shares [d] by name, and the ends of their 95 % intervals
    best, low, high = (hours.shares(edi_lx + sign * 1.96 * u_lx) for sign in (0, -1, 1))
    for row in read_budgets(annual.folder / BUDGET_FILE):
        if (name := row["figure"]) in best and row["source"] == "combined" and row["contribution"]:
            k = int(np.argmin(np.abs(annual.azimuths_deg - float(row["azimuth_deg"]))))
            half_width = 1.96 * float(row["contribution"])
            low[name][k] = np.clip(best[name][k] - half_width, 0.0, 100.0)
            high[name][k] = np.clip(best[name][k] + half_width, 0.0, 100.0)

    def share(name: str, k: int) -> Share:
        """Return the share of the year with enough melanopic light in one direction.

        name: `ENOUGH_HOURS` or one of `ENOUGH_DAYS`, which decides whether the share is of hours or
        of days; k: index of the direction in `annual.azimuths_deg`.
        """
        return Share(float(best[name][k]), float(low[name][k]), float(high[name][k]))

    return [
        (share(melanopic.ENOUGH_HOURS, k), [share(name, k) for name in melanopic.ENOUGH_DAYS])
        for k in range(edi_lx.shape[1])
    ]


def melanopic_section(annual: Annual, zone: str) -> Section:
    """Return the section with the shares of hours and days with enough melanopic light.

    It has a row for each direction that was seen (`melanopic_shares`). zone: IANA name, for local
    standard time. Raises InputError for a damaged budget.csv.
    """
    shares = zip(annual.azimuths_deg, annual.judged, melanopic_shares(annual, zone), strict=True)
    rows = [
        (direction_name(azimuth), hours.text(), *(share.text() for share in days))
        for azimuth, seen, (hours, days) in shares
        if seen
    ]
    limits = (f"days ≥ {limit:.0f} lx, 9 to 13 h" for limit in melanopic.WELL_EDI_LX)
    head = ("view direction", "hours ≥ 250 lx, 6 to 19 h", *limits)
    origin = (
        "By the colour of the captures, with 95 % intervals."
        if has_melanopic(annual)
        else "An estimate, because no melanopic colour was measured: vertical illuminance times "
        "1.0, as if the light had the spectrum of D65. For 58 spectra of daylight behind "
        "electrochromic glass it is 11 to 17 % too high. Calibrate the camera's colour (fieldlum "
        "calibrate colour), then merge and predict again."
    )
    lamps = annual.summary.inputs.get("lamps")
    light = (
        "Lamps as stated" if lamps else "Intervals allow for lamps (predict --lamps states them)"
    )
    if lamps == "off" or not has_melanopic(annual):
        light = "Daylight alone"
    text = (
        f"{origin} {light}; at the camera's place and height; hours of local standard time. "
        "250 lx from 06:00 to 19:00 is the advice of Brown et al. 2022. WELL v2 L03 asks for 136 "
        "or 250 lx in the four hours from 09:00 to 13:00, with enhanced daylight for 109 or 163 lx."
    )
    return Section("melanopic", "Melanopic light of day", text, tables=(Table(head, rows),))


# ----------------------------------------------------------------------------------------------
# accuracy

# Names of the held-out maps that are shown, by their error.
SHOWN = ("typical", "one in ten is worse", "worst")


def accuracy_section(
    held: HeldOutMaps | None, scores: ScoresFile | None, names: Mapping[str, str] | None = None
) -> Section:
    """Return the section on accuracy, from held-out maps and the scores of `train`.

    held: held-out maps of the model, scores: its scores; None if missing, and their part of the
    section is omitted. names: for each slot the id that the session uses, by the id in `held`,
    which is the time of the middle of its bracket; None to show the ids in `held`.
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
    notes = () if scores is None else scores.notes  # warnings are on top of the page
    text = "\n".join((text, *(sentence(n) for n in notes if not n.startswith("WARNING"))))
    tables = [] if scores is None or not scores.models else [_score_table(scores)]
    rows = [] if held is None else [(_held_out_figure(held, names or {}),)]
    return Section("evidence", "How good the numbers are", text, rows, tables)


def _held_out_figure(held: HeldOutMaps, names: Mapping[str, str]) -> Figure:
    """Return a figure of the held-out maps with the median, 90 % and largest error.

    Each is next to its prediction. names: of a slot in the session, by slot in `held`. Fewer than
    three maps are shown once each.
    """
    order, count = np.argsort(held.log10_mse), len(held)
    ranks = (count // 2, min(int(0.9 * count), count - 1), count - 1)  # by error, as `SHOWN`
    picks = list(dict.fromkeys(int(order[rank]) for rank in ranks))
    slots = [names.get(str(held.slots[i]), str(held.slots[i])) for i in picks]
    labels = [f"{slot}, {name}" for slot, name in zip(slots, SHOWN, strict=False)]
    measured = 10.0 ** held.measured_log10[picks].astype(np.float32)
    predicted = 10.0 ** held.predicted_log10[picks].astype(np.float32)
    what = (
        "Measured and predicted luminance panoramas and their ratio for held-out hours "
        f"({', '.join(SHOWN[: len(picks)])}), without the sun's disc. Red is predicted too bright, "
        "blue too dark."
    )
    return Figure(page.comparison_png(measured, predicted, labels, "predicted"), what)


# Headings of the score table, by the key of a score.
_COLUMNS = {"name": "model", "fit_s": "fit, s", "judged_dgp_error": "DGP error"}
_COLUMNS |= {"judged_ev_error": "ln Ev error", "judged_log10_mse": "log10 MSE"}
_COLUMNS |= {"dgp_mae": "DGP error, all hours"}
_COLUMNS |= {"log10_mse_weighted": "log10 MSE, all hours"}


def _score_table(scores: ScoresFile) -> Table:
    """Return the table of the models that were tried; the chosen one is marked."""
    rows = []
    for row in scores.models:
        name, *figures = (row.get(key) for key in _COLUMNS)
        name = {"kind": "high", "text": f"{name} (chosen)"} if name == scores.chosen else name
        rows.append((name, *("–" if value is None else f"{value:.3g}" for value in figures)))
    title = "Models tried, on held-out days; DGP with the sun's disc that was measured"
    return Table(tuple(_COLUMNS.values()), rows, title)


# ----------------------------------------------------------------------------------------------
# captures


def captures_section(
    session: Session, site: Site, pairs: PairsFile, year: Mapping[str, Floats]
) -> Section:
    """Return the section on the captures: their suns, skies and irradiance, and refused brackets.

    pairs: the session's pairs.csv. year: columns of hourly.csv of the predicted year, of which
    dni_wm2 and dhi_wm2 are used; empty without one. Raises InputError if the session cannot be
    read.
    """
    used = pairs.usable
    start = datetime(used[0].t_utc.year if used else 2027, 1, 1, 0, 30, tzinfo=UTC)
    hours = sun.position([start + timedelta(hours=h) for h in range(8760)], site)
    is_day = hours.altitude_deg > 0
    suns, skies = ("sun_azimuth_deg", "sun_altitude_deg"), ("dni_wm2", "dhi_wm2")
    positions = (hours.azimuth_deg[is_day], hours.altitude_deg[is_day])
    labels = ("hours of the year", "sun azimuth, ° from north", "sun altitude, °")
    svg = page.captured_svg(positions, _columns(used, suns), *labels)
    what = "Sun positions of a year (grey) and of the captures (red)."
    path = Figure(svg, f"{what} Hours far from every red point are extrapolated.")
    weather = [year.get(name, np.empty(0)) for name in skies]
    labels = ("weather file", "direct normal irradiance, W/m²", "diffuse irradiance, W/m²")
    svg = page.captured_svg(weather, _columns(used, skies), *labels)
    irradiance = Figure(svg, "Skies of the weather file (grey) and of the captures (red).")
    refused = Counter(row.why or "no reason recorded" for row in pairs.refused)
    table = Table(("reason", "brackets"), tuple(refused.items()), "Brackets that are not used")
    text, tables = _captures_text(session, site, pairs), [table] if refused else []
    return Section("captured", "What was captured", text, ((path, irradiance),), tables)


def _columns(rows: Sequence[PairRow], names: Sequence[str]) -> list[Floats]:
    """Return columns of pairs.csv by name, [n] each."""
    return [np.array([getattr(row, name) for row in rows], float) for name in names]


def _captures_text(session: Session, site: Site, pairs: PairsFile) -> str:
    """Return sentences on the usable brackets: number, days, origin of irradiance and sun."""
    used = pairs.usable
    days = sorted({sun.standard_date(row.t_utc, site.timezone).isoformat() for row in used})
    planned = len(session.slots()) if session.plan.is_file() else len(used)
    text = f"{len(used)} usable of {planned} planned brackets, on {counted(len(days), 'day')}"
    if not used:
        return f"{text}."
    measured = sum(row.source == "measured" for row in used)
    kind = f"measured in {counted(measured, 'bracket')} and derived in the others"
    text += f" between {days[0]} and {days[-1]}. Direct and diffuse irradiance were "
    text += f"{'measured' if measured == len(used) else kind}."
    origins = Counter(row.origin for row in read_suns(session.suns).values())
    parts = [f"{SUN_FROM.get(origin, origin)} in {n}" for origin, n in origins.most_common()]
    suns = f" {counted(origins.total(), 'picture')} with the sun's disc, whose illuminance was"
    return f"{text}{suns} {', '.join(parts)}." if origins else text


def warnings_of(session: Session, year: Annual | None) -> list[str]:
    """Return the warnings of the page, one sentence each.

    They are about assumed settings and the camera; with a predicted year also about training,
    weather, whether the year is of the present model and session (`outdated_text`), and which other
    years the session has. year: None without one. Raises InputError if the session or the year's
    model cannot be read.
    """
    camera = session.site_file().camera
    texts = profiles.assumed_texts(camera)
    with suppress(InputError):  # the profile can be missing where only the report is written again
        profile = profiles.load_camera_profile(camera.profile)
        texts += filter(None, [profiles.uncalibrated_text(profile)])
    texts += PairsFile.find(session.pairs).pair_again
    if year is not None:
        weather, of_model = year.summary.weather, year.summary.model_warnings
        texts += [f"From training: {text.removeprefix('WARNING: ')}" for text in of_model]
        kind = "The weather is" if weather.synthetic else "Weather:"
        texts += [f"{kind} {text}" for text in weather.repairs]
        texts += filter(None, [outdated_text(session, year)])
        others = [f.name for f in session.annual_folders() if f.name != year.folder.name]
        texts += [f"Shown: year {year.folder.name}; others: {', '.join(others)}"] if others else []
    return [sentence(text) for text in texts]
