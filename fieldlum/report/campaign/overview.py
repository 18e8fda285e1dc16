"""Write one page and one table about all rooms of a campaign."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.errors import FieldlumError
from fieldlum.core.records import Progress, counted, quiet, utc_text
from fieldlum.report.campaign.campaign_file import CampaignFile, CampaignRoom
from fieldlum.report.page import Page, Section, Table, named, render
from fieldlum.session import Session, open_session, replacing
from fieldlum.session.codec import to_json
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.session.files.predict_json import DirectionYear, PredictFile, SkyToCapture
from fieldlum.version import __version__
from fieldlum.year.predict import Annual, best_and_worst, read_annual

GLARE_DGP = "0.40"  # disturbing, EN 17037
_NEXT = 3  # hours that are named for each room; chosen
# failed slots that are named for each reason, so that a row has one or two lines; chosen
_SLOTS = 6


@dataclass(frozen=True, slots=True)
class RoomOverview:
    """What the page shows about one room.

    broken: why the room could not be read, "" if it could. captured, planned: numbers of slots.
    to_do: slots that can still be captured. usable: rows of pairs.csv that training uses. failed:
    (slot, reason) of slots without a usable panorama. year: the predicted year's summary. worst,
    best: directions with the highest and lowest DGP in 5 % of the hours, as the room's own report
    names them; a partly seen direction counts with the upper end of its interval.
    """

    session: str
    broken: str = ""
    captured: int = 0
    planned: int = 0
    to_do: int = 0
    usable: int = 0
    failed: tuple[tuple[str, str], ...] = ()
    occupied_hours: int = 0
    worst: DirectionYear | None = None
    best: DirectionYear | None = None
    capture_next: tuple[SkyToCapture, ...] = ()


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
    from fieldlum.session.ledger import slots_ahead

    stages = status(session)
    pairs = PairsFile.find(session.pairs)
    years = [folder for folder in session.annual_folders() if folder.name == room.model]
    year = read_annual(years[0]).summary if years else PredictFile()
    best, worst = best_and_worst(year.protection) or (None, None)
    return RoomOverview(
        room.session,
        captured=stages["capture"]["done"],
        planned=stages["plan"]["slots"],
        to_do=len(slots_ahead(session, datetime.now(UTC))),
        usable=len(pairs.usable),
        failed=_failed(session, pairs),
        occupied_hours=year.occupancy.hours,
        worst=worst,
        best=best,
        capture_next=year.capture_next,
    )


def _failed(session: Session, pairs: PairsFile) -> tuple[tuple[str, str], ...]:
    """Return (slot, reason) of slots missed, aborted, not merged or rejected by `fieldlum pair`."""
    from fieldlum.session.ledger import read_ledger

    reasons = {
        name: state.outcome
        for name, state in read_ledger(session).slots.items()
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
        json.dump({"rooms": [to_json(room) for room in rooms]}, file, indent=1)
    return page, rooms


def _page(campaign: CampaignFile, rooms: Sequence[RoomOverview]) -> Page:
    broken = [room for room in rooms if room.broken]
    judged = [room.worst for room in rooms if room.worst is not None]
    bad = sum(worst.glare_class == "none" for worst in judged)
    answer = (
        f"{counted(bad, 'room')} of {len(judged)} with a predicted year "
        f"{'has' if bad == 1 else 'have'} a view direction without protection from glare."
        if judged
        else "No room has a predicted year yet."
    )
    return Page(
        title=campaign.name,
        answer=answer,
        why=f"{counted(sum(len(room.failed) for room in rooms), 'slot')} failed; "
        f"{counted(len(broken), 'session')} could not be read.",
        facts=(
            ("rooms", f"{len(rooms)}"),
            ("captures", f"{sum(room.captured for room in rooms)}"),
            ("usable pairs", f"{sum(room.usable for room in rooms)}"),
            ("predicted years", f"{len(judged)}"),
        ),
        sections=(_glare(rooms), _failures(rooms), _next(rooms)),
        footer=f"Written by fieldlum {__version__}. This page needs no network.",
        warnings=tuple(f"{room.session} was skipped. {room.broken}" for room in broken),
    )


def _chip(row: DirectionYear) -> dict[str, str]:
    return {"kind": row.glare_class if row.certain else "open", "text": row.glare_class}


def _glare(rooms: Sequence[RoomOverview]) -> Section:
    body: list[tuple[float, tuple[Any, ...]]] = []
    for room in rooms:
        worst, best = room.worst, room.best
        if worst is None or best is None:
            continue
        exceeded = -1.0 if worst.dgp_exceeded is None else worst.dgp_exceeded
        hours = f"{worst.hours_over[GLARE_DGP]} of {room.occupied_hours}"
        direction, other = named(worst.azimuth_deg), named(best.azimuth_deg)
        row = (room.session, direction, _chip(worst), f"{exceeded:.2f}", hours, other, _chip(best))
        body.append((exceeded, row))
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
    ordered = tuple(row for _, row in sorted(body, key=lambda item: -item[0]))
    return Section("glare", "Which room has glare", text, (), (Table(head, ordered),))


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


# ----------------------------------------------------------------------------------------------
# the table of all hours


def write_hours(campaign: CampaignFile, path: Path) -> int:
    """Write a csv row for each room, hour and view direction; return the number of rows.

    Rooms without a readable predicted year have no rows; without any year the file is empty.
    """
    count = 0
    with replacing(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        for name, annual in _years(campaign):
            hours, views, azimuths = annual.hours, annual.views, annual.azimuths_deg
            if not count:
                writer.writerow(["room", "t_utc", "azimuth_deg", *hours, *views])
            for k in range(len(annual)):
                head = [name, utc_text(annual.t_utc[k])]
                of_hour = [_cell(values[k]) for values in hours.values()]
                for j, azimuth_deg in enumerate(azimuths):
                    of_view = [_cell(values[k, j]) for values in views.values()]
                    writer.writerow([*head, _cell(azimuth_deg), *of_hour, *of_view])
            count += len(annual) * len(azimuths)
    return count


def _years(campaign: CampaignFile) -> Iterator[tuple[str, Annual]]:
    """Yield (session, predicted year) of each room with a readable year of its model."""
    for room in campaign.rooms:
        try:
            session = open_session(campaign.session_folder(room))
            folder = session.annual / room.model
            if (folder / "predict.json").is_file():
                yield room.session, read_annual(folder)
        except (FieldlumError, OSError):
            continue


def _cell(value: float) -> str:
    return f"{value:.7g}" if np.isfinite(value) else ""
