"""Remove brackets that an earlier import, with another clock, put into wrong slots."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from fieldlum.capture.match_card import Match, Offset, true_time
from fieldlum.session import Journal, Session, sha256
from fieldlum.session.ledger import Ledger, SlotState

SAME_TIME_S = 120.0  # a refined clock offset changes times by less; not measured


def withdraw(
    session: Session, journal: Journal, ledger: Ledger, matched: Sequence[tuple[Match, Offset]]
) -> tuple[str, ...]:
    """Remove imported brackets whose frames now have another slot or time; return their slots' ids.

    matched: the new matches, each with its clock offset; times over two minutes apart differ. The
    brackets' folders move to raw/withdrawn/, and what merge wrote from them is deleted. The slots
    are then without a bracket again.
    """
    held: dict[str, list[str]] = {}
    for slot, state in ledger.slots.items():
        if state.outcome == "done" and state.why == "imported":
            for frame in state.frames:
                held.setdefault(frame.file, []).append(slot)
    gone: list[str] = []
    for match, offset in matched:
        there = dict.fromkeys(
            slot for f in match.group.frames for slot in held.get(f.path.name, ())
        )
        for slot in there:
            if slot not in gone and _misplaced(ledger.slots[slot], slot, match, offset):
                # Before the journal entry: the next import repairs an interrupted one.
                _set_aside(session, slot)
                journal.append(
                    "withdrawn", datetime.now(UTC), slot=slot, why="imported with another clock"
                )
                gone.append(slot)
    return tuple(gone)


def _misplaced(state: SlotState, slot: str, match: Match, offset: Offset) -> bool:
    """Return whether a slot's imported bracket must be removed.

    It must if the match gives its frames to another slot, or the corrected clock gives them another
    time.
    """
    frames_by_file = {frame.file: frame for frame in state.frames}
    card = next((f for f in match.group.frames if f.path.name in frames_by_file), None)
    if card is None:
        return False
    frame = frames_by_file[card.path.name]
    apart_s = abs((true_time(card.t_camera, offset) - frame.t_utc).total_seconds())
    is_elsewhere = slot != match.slot.id or apart_s > SAME_TIME_S
    return is_elsewhere and frame.sha256 == sha256(card.path)


def _set_aside(session: Session, slot: str) -> None:
    folder, aside = session.capture_file(slot).parent, session.raw / "withdrawn"
    aside.mkdir(parents=True, exist_ok=True)
    if folder.is_dir():
        folder.replace(aside / f"{slot}.{len(list(aside.glob(f'{slot}.*')))}")
    for path in (session.panorama(slot), session.sidecar(slot), session.sunpatch(slot)):
        path.unlink(missing_ok=True)
