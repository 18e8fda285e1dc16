"""A campaign: the sessions that CAMPAIGN.toml lists, and one page of all their rooms.

A room that cannot be read is named on the page.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from fieldlum.core.errors import FieldlumError, InputError
from fieldlum.core.progress import progress
from fieldlum.core.records import counted
from fieldlum.core.strict_toml import build, read_toml
from fieldlum.report.page import Page, Section, Table, chip, direction_name, render
from fieldlum.report.sections import exceeded_text
from fieldlum.session import codec, open_session, write_file
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.session.files.predict_json import DirectionYear, PredictFile
from fieldlum.year.predict import best_and_worst, newest_annual, outdated_text

_GLARE_DGP = "0.40"  # key of `hours_over`: disturbing glare by EN 17037


# Keys of earlier versions, whose campaigns also ran the stages; they are read and not used.
_EARLIER = {"site", "set", "model", "seed", "budget_min", "weather", "views", "size"}


@dataclass(frozen=True, slots=True)
class _Room:
    """One table [[room]] of a CAMPAIGN.toml; session: folder."""

    session: str


@dataclass(frozen=True, slots=True)
class _Tables:
    """The tables of a CAMPAIGN.toml as they are stated."""

    name: str = ""
    common: dict[str, Any] = field(default_factory=dict)  # of earlier versions
    room: tuple[dict[str, Any], ...] = ()


class CampaignFile(NamedTuple):
    """The content of a CAMPAIGN.toml.

    path: of the file; name: of the campaign; sessions: folders of its sessions, relative to the
    folder of the file, or absolute.
    """

    path: Path
    name: str
    sessions: tuple[str, ...]


def read_campaign(path: Path) -> CampaignFile:
    """Read a CAMPAIGN.toml; a campaign without the key `name` has the name of the file.

    Raises InputError for a missing file or one that is no TOML, for unknown keys or values of a
    wrong type, without a room, for a room without a session, and for a session named twice.
    """
    tables = build(_Tables, read_toml(path), str(path))
    sessions: list[str] = []
    for number, table in enumerate(tables.room, start=1):
        used = {key: value for key, value in table.items() if key not in _EARLIER}
        sessions.append(build(_Room, used, f"{path} [[room]] {number}").session)
    twice = next((name for name in sessions if sessions.count(name) > 1), "")
    if twice or not sessions:
        found = f"session {twice} occurs twice" if twice else "no [[room]]"
        expected = "one table [[room]] with session = FOLDER for each room"
        raise InputError(path, found, expected, "correct the tables [[room]]")
    return CampaignFile(path, tables.name or path.stem, tuple(sessions))


# ----------------------------------------------------------------------------------------------
# overview


@dataclass(frozen=True, slots=True)
class RoomOverview:
    """What the page shows about one room.

    session: its folder, as in `CampaignFile`. broken: why the room could not be read, "" if it
    could; if not, the further fields have their defaults. caution: why its year is outdated,
    or "". Numbers of slots: captured: with a complete bracket; planned: of the plan; to_do: that
    can still be captured; failed: missed, aborted or rejected by `pair`. usable: number of rows of
    pairs.csv that training uses. occupied_hours: number in the newest predicted year, 0 without
    one. worst, best: directions with the most and the least glare in this year, as `best_and_worst`
    and the room's own report name them; None without a year or a direction with a class.
    is_unprotected: whether a direction of it is certainly without protection from glare.
    """

    session: str
    broken: str = ""
    caution: str = ""
    captured: int = 0
    planned: int = 0
    to_do: int = 0
    usable: int = 0
    failed: int = 0
    occupied_hours: int = 0
    worst: DirectionYear | None = None
    best: DirectionYear | None = None
    is_unprotected: bool = False


def overview_of(folder: Path, name: str) -> RoomOverview:
    """Return the overview of one room; after any error, its field `broken` states the reason.

    folder: of CAMPAIGN.toml; name: the session's folder, as the file states it. No error is raised.
    """
    from fieldlum.year.stage_status import stage_status

    try:
        session = open_session(folder / name)
        stages, pairs = stage_status(session), PairsFile.find(session.pairs)
        annual, capture = newest_annual(session), stages["capture"]
        year = PredictFile() if annual is None else annual.summary
        best, worst = best_and_worst(year.protection) or (None, None)
        return RoomOverview(
            name,
            caution="" if annual is None else outdated_text(session, annual),
            captured=capture["done"],
            planned=stages["plan"]["slots"],
            to_do=capture["owed"],
            usable=len(pairs.usable),
            failed=capture["missed"] + capture["aborted"] + len(pairs.refused),
            occupied_hours=year.occupancy.hours,
            worst=worst,
            best=best,
            is_unprotected=any(r.certain and r.glare_class == "none" for r in year.protection),
        )
    except Exception as error:
        defect = "" if isinstance(error, FieldlumError | OSError) else f"{type(error).__name__}: "
        return RoomOverview(name, broken=defect + " ".join(str(error).split()))


def write_overview(campaign: CampaignFile, out: Path) -> tuple[Path, list[RoomOverview]]:
    """Write index.html and overview.json into `out`; return the page's path and the overviews.

    The overviews are in the order of `campaign.sessions`; a room that cannot be read has one too.
    """
    rooms = []
    for k, name in enumerate(campaign.sessions):
        progress(k, len(campaign.sessions), name)
        rooms.append(overview_of(campaign.path.parent, name))
    page = out / "index.html"
    write_file(page, _page(campaign.name, rooms))
    codec.write_object(out / "overview.json", {"rooms": [codec.to_json(room) for room in rooms]})
    return page, rooms


def _page(name: str, rooms: Sequence[RoomOverview]) -> str:
    """Return the overview of the rooms as HTML; name: of the campaign."""
    broken = [room for room in rooms if room.broken]
    worst = [room.worst for room in rooms if room.worst is not None]
    bad = sum(room.is_unprotected for room in rooms)
    open_rooms = [r for r in rooms if r.worst and not (r.worst.certain or r.is_unprotected)]
    unsettled = f"{len(open_rooms)} cannot be decided yet"
    answer = f"Rooms with a view direction without protection from glare: {bad} of {len(worst)}"
    facts = [("rooms", f"{len(rooms)}"), ("predicted years", f"{len(worst)}")]
    failed = f"{counted(sum(room.failed for room in rooms), 'slot')} failed"
    why = f"{failed}; {counted(len(broken), 'session')} could not be read."
    notes = [f"{room.session} was skipped. {room.broken}" for room in broken]
    notes += [f"{room.session}: {room.caution}." for room in rooms if room.caution]
    return render(Page(name, f"{answer}; {unsettled}.", why, facts, [_table(rooms)], notes))


def _table(rooms: Sequence[RoomOverview]) -> Section:
    """Return the section with a row for each room: captures, worst and best direction."""
    rows = []
    for room in sorted(rooms, key=lambda r: -((r.worst and r.worst.dgp_exceeded) or -1.0)):
        worst, best, glare = room.worst, room.best, ("–",) * 6
        if worst is not None and best is not None:
            hours = f"{worst.hours_over[_GLARE_DGP]} of {room.occupied_hours}"
            glare = (direction_name(worst.azimuth_deg), chip(worst), exceeded_text(worst), hours)
            glare = (*glare, direction_name(best.azimuth_deg), chip(best))
        counts = (f"{room.captured} of {room.planned}", f"{room.to_do}", f"{room.failed}")
        rows.append((room.session, *(("not read", "–", "–") if room.broken else counts), *glare))
    text = (
        "The room with the most glare first. A class in grey is not certain yet: the captures do "
        "not decide it. Failed slots were missed, aborted, or rejected by fieldlum pair: fieldlum "
        "status lists them."
    )
    counts = ("room", "captured", "to do", "failed")
    glare = ("worst direction", "class", "DGP in 5 %", f"hours above {_GLARE_DGP}")
    head = (*counts, *glare, "best direction", "class")
    return Section("rooms", "Rooms", text, tables=(Table(head, rows),))
