"""Write one page about a campaign.

It shows which room has glare, which camera drifts, what failed, and what to capture next.
"""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.campaign.campaign_file import CampaignFile, CampaignRoom
from fieldlum.campaign.drift import FEWEST, FEWEST_DAYS, LIMITS, UNITS, DriftSeries, drifts_of
from fieldlum.errors import FieldlumError
from fieldlum.predict import best_and_worst, read_annual
from fieldlum.records import JsonTable, Progress, counted, quiet
from fieldlum.report.page import Figure, Page, Row, Section, Table, named, render, svg_figure
from fieldlum.session import Session, open_session, replacing
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.session.files.predict_json import DirectionYear, PredictFile, SkyToCapture
from fieldlum.version import __version__

GLARE_DGP = "0.40"  # disturbing, EN 17037
_NEXT = 3  # hours that are named for each room; chosen
# failed slots that are named for each reason, so that a row has one or two lines; chosen
_SLOTS = 6


@dataclass(frozen=True, slots=True)
class RoomOverview:
    """What the page shows about one room.

    broken: why the room could not be read, "" if it could. captured, planned: numbers of slots.
    to_do: slots that can still be captured. usable: rows of pairs.csv that training uses.
    protection: glare by view direction, of the predicted year; empty without one. failed: (slot,
    reason) of slots without a usable panorama. drifts: by name, as `drifts_of`.
    """

    session: str
    broken: str = ""
    captured: int = 0
    planned: int = 0
    to_do: int = 0
    usable: int = 0
    failed: tuple[tuple[str, str], ...] = ()
    protection: tuple[DirectionYear, ...] = ()
    occupied_hours: int = 0
    capture_next: tuple[SkyToCapture, ...] = ()
    drifts: dict[str, DriftSeries] = field(default_factory=dict)

    @property
    def worst(self) -> DirectionYear | None:
        """Direction with the highest DGP in 5 % of the hours; None without a predicted direction.

        The room's own report names the same direction.
        """
        ends = best_and_worst(self.protection)
        return ends and ends[1]

    @property
    def best(self) -> DirectionYear | None:
        """Direction with the lowest DGP in 5 % of the hours; None without a predicted direction.

        A partly seen direction counts with the upper end of its interval. The room's own report
        names the same direction.
        """
        ends = best_and_worst(self.protection)
        return ends and ends[0]

    @property
    def drifting(self) -> list[DriftSeries]:
        """Drift series whose change exceeds its limit and is significant."""
        return [series for series in self.drifts.values() if series.drifts]


def exceeded(row: DirectionYear | None) -> float:
    """Return the DGP that a direction exceeds in 5 % of the occupied hours; -1 if it is unknown."""
    return -1.0 if row is None or row.dgp_exceeded is None else row.dgp_exceeded


def overview_of(campaign: CampaignFile, room: CampaignRoom) -> RoomOverview:
    """Read one room; after any error, the overview's text `broken` states what is wrong."""
    try:
        return _read(open_session(campaign.session_folder(room)), room)
    except (FieldlumError, OSError) as error:
        return RoomOverview(room.session, broken=" ".join(str(error).split()))
    except Exception as error:
        return RoomOverview(room.session, broken=f"defect: {type(error).__name__}: {error}")


def _read(session: Session, room: CampaignRoom) -> RoomOverview:
    from fieldlum.capture.status import status

    stage_status = status(session)
    pairs = PairsFile.find(session.pairs)
    years = [folder for folder in session.annual_folders() if folder.name == room.model]
    year = read_annual(years[0]).summary if years else PredictFile()
    return RoomOverview(
        room.session,
        captured=stage_status["capture"]["done"],
        planned=stage_status["plan"]["slots"],
        to_do=_to_do(session, datetime.now(UTC)),
        usable=len(pairs.usable),
        failed=_failed(session, pairs),
        protection=year.protection,
        occupied_hours=year.occupancy.hours,
        capture_next=year.capture_next,
        drifts=drifts_of(session),
    )


def _to_do(session: Session, now_utc: datetime) -> int:
    """Return the number of planned slots that can still be captured."""
    from fieldlum.session.ledger import owed, read_ledger

    slots = owed(session.slots(), read_ledger(session))
    return sum(slot.t_utc + session.grace >= now_utc for slot in slots)


def _failed(session: Session, pairs: PairsFile) -> tuple[tuple[str, str], ...]:
    """Return (slot, reason) of slots missed, aborted, not merged or rejected by `fieldlum pair`."""
    from fieldlum.session.ledger import read_ledger

    ledger = read_ledger(session)
    reasons = {
        name: state.outcome
        for name, state in ledger.slots.items()
        if state.outcome in ("missed", "aborted")
    }
    merged = {path.stem for path in session.panorama_files()}
    for folder in session.captured_folders():
        if folder.name not in merged:
            reasons.setdefault(folder.name, "captured, not merged")
    for row in pairs.refused:
        reasons.setdefault(Path(row.panorama).stem or "?", row.why or "rejected by pair")
    return tuple(sorted(reasons.items()))


# ----------------------------------------------------------------------------------------------
# the page


def write_overview(
    campaign: CampaignFile, out: Path, *, progress: Progress = quiet
) -> tuple[Path, list[RoomOverview]]:
    """Write index.html and overview.json into `out`; return the page's path and the overviews.

    The overviews are in the order of the rooms.
    """
    rooms = []
    for k, room in enumerate(campaign.rooms):
        progress(k, len(campaign.rooms), room.session)
        rooms.append(overview_of(campaign, room))
    page = out / "index.html"
    with replacing(page, "w", encoding="utf-8") as file:
        file.write(render(_page(campaign, rooms)))
    with replacing(out / "overview.json", "w", encoding="utf-8") as file:
        json.dump({"rooms": [_plain(room) for room in rooms]}, file, indent=1)
    return page, rooms


def _plain(room: RoomOverview) -> JsonTable:
    changes = {
        kind: {"change": s.change, "low": s.low, "high": s.high, "drifts": s.drifts}
        for kind, s in room.drifts.items()
        if np.isfinite(s.change)
    }
    return {
        "session": room.session,
        "broken": room.broken,
        "captured": room.captured,
        "planned": room.planned,
        "usable": room.usable,
        "failed": [list(pair) for pair in room.failed],
        "worst": room.worst.table() if room.worst else None,
        "best": room.best.table() if room.best else None,
        "capture_next": [asdict(hour) for hour in room.capture_next],
        "drift": changes,
    }


def _page(campaign: CampaignFile, rooms: Sequence[RoomOverview]) -> Page:
    broken = [room for room in rooms if room.broken]
    judged = [room for room in rooms if room.worst is not None]
    bad = [room for room in judged if room.worst and room.worst.glare_class == "none"]
    moving = [room for room in rooms if room.drifting]
    slots = sum(len(room.failed) for room in rooms)
    answer = (
        f"{counted(len(bad), 'room')} of {len(judged)} with a predicted year "
        f"{'has' if len(bad) == 1 else 'have'} a view direction without protection from glare."
        if judged
        else "No room has a predicted year yet."
    )
    names = ", ".join(room.session for room in moving)
    why = (
        f"{counted(len(moving), 'camera')} drift{'s' if len(moving) == 1 else ''}"
        f"{f' ({names})' if names else ''}; {counted(slots, 'slot')} failed; "
        f"{counted(len(broken), 'session')} could not be read."
    )
    return Page(
        title=campaign.name,
        answer=answer,
        why=why,
        facts=(
            ("rooms", f"{len(rooms)}"),
            ("captures", f"{sum(room.captured for room in rooms)}"),
            ("usable pairs", f"{sum(room.usable for room in rooms)}"),
            ("predicted years", f"{len(judged)}"),
        ),
        sections=(_glare(rooms), _drift(rooms), _failures(rooms), _next(rooms)),
        footer=f"Written by fieldlum {__version__}. This page needs no network.",
        warnings=tuple(f"{room.session} was skipped. {room.broken}" for room in broken),
    )


def _chip(row: DirectionYear) -> dict[str, str]:
    return {"kind": row.glare_class if row.certain else "open", "text": row.glare_class}


def _glare(rooms: Sequence[RoomOverview]) -> Section:
    body: list[tuple[Any, ...]] = []
    for room in sorted(rooms, key=lambda r: -exceeded(r.worst)):
        worst, best = room.worst, room.best
        if worst is None or best is None:
            continue
        body.append(
            (
                room.session,
                named(worst.azimuth_deg),
                _chip(worst),
                f"{exceeded(worst):.2f}",
                f"{worst.hours_over[GLARE_DGP]} of {room.occupied_hours}",
                named(best.azimuth_deg),
                _chip(best),
            )
        )
    head = (
        "room",
        "worst direction",
        "class",
        "DGP in 5 % of hours",
        f"hours above {GLARE_DGP}",
        "best direction",
        "class",
    )
    without = [room.session for room in rooms if room.worst is None and not room.broken]
    text = (
        "Rooms with a predicted year, the worst first. A class in grey is not certain yet: the "
        "captures do not decide it."
    )
    if without:
        text += f" Without a predicted year: {', '.join(without)}."
    return Section("glare", "Which room has glare", text, (), (Table(head, tuple(body)),))


def _drift_chip(room: RoomOverview) -> dict[str, str]:
    if room.drifting:
        return {"kind": "none", "text": "drifts"}
    if any(np.isfinite(series.change) for series in room.drifts.values()):
        return {"kind": "high", "text": "steady"}
    return {"kind": "open", "text": "too few"}


def _drift(rooms: Sequence[RoomOverview]) -> Section:
    readable = [room for room in rooms if not room.broken]
    body = [
        (room.session, _drift_chip(room), *(room.drifts[kind].text for kind in LIMITS))
        for room in readable
    ]
    figures = [_curve(room.session, s) for room in readable for s in room.drifting]
    head = (
        "room",
        "camera",
        "k by the window sky",
        "azimuth of the sun's disc, less the computed",
        "residual of merging",
    )
    limits = ", ".join(f"{kind} {limit:g} {UNITS[kind]}" for kind, limit in LIMITS.items())
    text = (
        "The change of a robust fitted line from the first to the last capture, with its 95 % "
        f"interval, for {FEWEST} or more captures on {FEWEST_DAYS} or more days. A camera drifts "
        f"if the change is larger than its interval and than the limit ({limits}). k compares the "
        "sky in the window with the Perez sky of the logged irradiance: dirt on the pane or on the "
        "pyranometer counts as drift too."
    )
    rows = (Row(tuple(figures)),) if figures else ()
    return Section("drift", "Which camera drifts", text, rows, (Table(head, tuple(body)),))


def _curve(name: str, series: DriftSeries) -> Figure:
    """Draw a drifting quantity over time, with the robust line in red."""
    width, height, pad = 420.0, 130.0, 26.0
    top = float(np.abs(series.values).max()) or 1.0
    x = pad + (width - 2 * pad) * series.days / max(float(series.days.max()), 1e-9)
    y = height / 2 - (height / 2 - pad) * series.values / top
    points = "".join(
        f'<circle cx="{a:.1f}" cy="{b:.1f}" r="2.5" fill="#1f5fa8"/>'
        for a, b in zip(x, y, strict=True)
    )
    ends = np.clip([series.start, series.start + series.change], -top, top)
    low, high = height / 2 - (height / 2 - pad) * ends / top
    marks = (
        f'<line x1="{x.min():.1f}" x2="{x.max():.1f}" y1="{low:.1f}" y2="{high:.1f}" '
        'stroke="#c4441c" stroke-width="2"/>'
    )
    unit = UNITS[series.kind]
    svg = (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" xmlns="http://www.w3.org/2000/svg" '
        f'style="max-width: {width:.0f}px" font-size="11" font-family="sans-serif">'
        f'<line x1="{pad}" x2="{width - pad}" '
        f'y1="{height / 2}" y2="{height / 2}" stroke="#9aa5b0"/>{points}'
        f'{marks}<text x="2" y="{pad - 8}">{top:+.3g} {unit}</text>'
        f'<text x="2" y="{height - 4}">{-top:+.3g} {unit}</text><text x="{width - pad}" '
        f'y="{height - 4}" text-anchor="end">{series.days.max():.0f} days</text></svg>'
    )
    text = f"{name}: {series.kind} changed by {series.text}"
    return svg_figure(svg, html.escape(text), f"{text}.")


def _failures(rooms: Sequence[RoomOverview]) -> Section:
    body = []
    for room in rooms:
        reasons: dict[str, list[str]] = {}
        for slot, why in room.failed:
            reasons.setdefault(why, []).append(slot)
        for why, slots in reasons.items():
            more = f" and {len(slots) - _SLOTS} more" if len(slots) > _SLOTS else ""
            body.append((room.session, why, f"{len(slots)}", ", ".join(slots[:_SLOTS]) + more))
    text = (
        "Slots that were missed or aborted, captured but not merged, or rejected by fieldlum pair."
    )
    text += "" if body else " No slot failed."
    table = Table(("room", "reason", "slots", "which"), tuple(body), words=True)
    return Section("failed", "Which slots failed", text, (), (table,) if body else ())


def _next(rooms: Sequence[RoomOverview]) -> Section:
    body = []
    for room in rooms:
        hours = "; ".join(
            f"{h.date} {h.hour} (direct {h.dni_wm2:.0f}, diffuse {h.dhi_wm2:.0f} W/m²)"
            for h in room.capture_next[:_NEXT]
        )
        if room.to_do or hours:
            body.append((room.session, f"{room.to_do}", hours or "nothing is open"))
    text = (
        "For each room, the number of slots that can still be captured, and examples of hours "
        "whose capture would help to decide the glare class of a view direction where it is "
        "still uncertain."
    )
    text += "" if body else " Nothing is open."
    table = Table(("room", "slots to do", "hours like these"), tuple(body), words=True)
    return Section("next", "What to capture next", text, (), (table,) if body else ())
