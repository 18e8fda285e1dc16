"""Copy a card's frames and a logger's file into the session (`fieldlum import`)."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

from fieldlum.capture.bracket import shots, write_capture
from fieldlum.capture.card import (
    card_files,
    of_the_session,
    read_card,
    without_copies,
    without_edited,
)
from fieldlum.capture.logger_rows import adopt_rows, logger_table, read_as
from fieldlum.capture.match_card import (
    Group,
    Match,
    Offset,
    as_shown,
    campaigns,
    clock_offset,
    clock_parts,
    clock_steps,
    contradiction,
    doubt,
    group_frames,
    match_groups,
    misfit,
    missing_exposures,
    tells_utc,
    true_time,
)
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import (
    CameraSetup,
    Exposure,
    Progress,
    Slot,
    quiet,
    shutter_text,
    utc_text,
)
from fieldlum.optics.photometry import same_exposure
from fieldlum.optics.profiles import load_camera_profile
from fieldlum.session import (
    Journal,
    Session,
    exposure_text,
    replacing_path,
    sha256,
    sole_user,
    update_session,
)
from fieldlum.session.files.capture_json import Frame, frame_fields
from fieldlum.session.ledger import Ledger, SlotState, read_ledger


@dataclass(frozen=True, slots=True)
class Report:
    """Result of an import.

    brackets, frames: number of new ones; known: number of brackets imported before. offsets: the
    camera's clock minus UTC, for each campaign on the card. late_s: start of each bracket minus its
    slot's time [s]. left_out: sentences on files and brackets that were not imported. notes:
    sentences on imported brackets that may be wrong. slots: of the new brackets. moved: slots whose
    bracket of an earlier import was removed. rows, withdrawn: rows of a logger's file that were
    added, and removed.
    """

    brackets: int = 0
    frames: int = 0
    known: int = 0
    offsets: tuple[Offset, ...] = ()
    late_s: tuple[float, ...] = ()
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    rows: int = 0
    withdrawn: int = 0
    slots: tuple[str, ...] = ()
    moved: tuple[str, ...] = ()


def run(
    session: Session,
    folder: Path | None,
    *,
    logger: Path | None = None,
    utc_offset_s: float | None = None,
    logger_utc_offset_s: float | None = None,
    columns: Mapping[str, str] | None = None,
    sensitivities: Mapping[str, float] | None = None,
    progress: Progress = quiet,
) -> Report:
    """Copy brackets that match the plan into raw/ and the journal.

    Add a logger's rows to the day files. An import can be repeated. The card and the logger's file
    are never changed. utc_offset_s: clocks of camera and logger minus UTC [s]; None reads the
    camera's from EXIF or fits it to the plan. logger_utc_offset_s: the logger's, if it differs.
    columns: the logger's column name for each quantity, if it is unusual; sensitivities: of
    pyranometers whose column is a voltage, uV per W/m2. Raises InputError for a folder without
    frames, an ambiguous clock, an invalid logger's file, or while a capture runs;
    NotEnoughDataError if no bracket matched.
    """
    with sole_user(session, "capture"):
        if logger is not None:
            # check before the card is read, so that both are imported or none
            if logger_utc_offset_s is None:
                logger_utc_offset_s = utc_offset_s
            read_as(logger, logger_table(logger, logger_utc_offset_s, columns, sensitivities))
        report = (
            Report() if folder is None else _adopt_card(session, folder, utc_offset_s, progress)
        )
        if logger is None:
            return report
        adopted = adopt_rows(session, logger, logger_utc_offset_s, columns, sensitivities)
        return replace(
            report,
            rows=adopted.rows,
            withdrawn=adopted.withdrawn,
            left_out=(*report.left_out, *adopted.left_out),
            notes=(*report.notes, *adopted.notes),
        )


def _adopt_card(
    session: Session, folder: Path, utc_offset_s: float | None, progress: Progress
) -> Report:
    setup, slots = session.site_file(), session.slots()
    files, others = card_files(folder)
    profile = load_camera_profile(setup.camera.profile)
    frames, unread = read_card(files, progress, lens_f_number=profile.camera.fixed_f_number)
    frames, other_cameras = of_the_session(frames, setup)
    frames, copies = without_copies(frames)
    body = profile.camera
    frames, edited = without_edited(frames, (body.width_px, body.height_px))
    if utc_offset_s is not None:
        frames = as_shown(frames)
    groups = group_frames(
        frames, slots[0].exposures if slots else (), max(1, len(setup.camera.headings))
    )
    left_out = [*other_cameras, *copies, *edited, *unread, *others]
    if not groups:
        raise NotEnoughDataError(
            f"{folder}: no usable frame; {left_out[0]}; check that this is the right card"
        )
    matched: list[tuple[Match, Offset]] = []
    clocks: list[tuple[list[Group], Offset]] = []
    notes: list[str] = []
    refused: list[InputError] = []
    for part in _parts(groups, slots, utc_offset_s):
        try:
            offset = clock_offset(part, slots, setup, utc_offset_s)
        # The error of one campaign: a wrong date, or brackets of another plan.
        except InputError as error:
            refused.append(error)
            whose = f"{_range(part[0])} and {len(part) - 1} brackets after it"
            left_out.append(f"{whose}: {error.found}; {error.remedy}")
            continue
        matches, unmatched = match_groups(part, slots, offset)
        clocks.append((part, offset))
        matched += [(match, offset) for match in matches]
        left_out += [
            f"{_range(u.group)}: {u.why} ({utc_text(true_time(u.group.t_camera, offset))})"
            for u in unmatched
        ]
        opposed = contradiction(part, slots, utc_offset_s) if utc_offset_s is not None else ""
        if warning := opposed or doubt(part, slots, offset):
            notes.append(warning)
    if refused and not matched:
        raise refused[0]
    if not matched:
        raise NotEnoughDataError(
            f"{folder}: none of {len(groups)} brackets matches the plan; {left_out[-1]}; "
            "check --utc-offset and the plan"
        )
    notes += clock_steps(clocks)
    offsets = [offset for _, offset in clocks]
    matched, doubles = _one_a_slot(matched)
    left_out += doubles
    notes += [text for match, _ in matched if (text := _lacking_text(match, setup.camera))]
    new, moved = _adopt_all(session, setup.camera, matched, progress)
    about = [{"camera_clock_minus_utc_s": round(o.seconds, 1), "how": o.how} for o in offsets]
    update_session(
        session, {"imported": {**session.table().get("imported", {}), _text(folder): about}}
    )
    return Report(
        len(new),
        sum(len(m.group.frames) for m in new),
        len(matched) - len(new),
        tuple(offsets),
        tuple(m.late_s for m, _ in matched),
        tuple(left_out),
        tuple(notes),
        slots=tuple(m.slot.id for m in new),
        moved=moved,
    )


def _parts(
    groups: Sequence[Group], slots: Sequence[Slot], utc_offset_s: float | None
) -> list[list[Group]]:
    """Return the brackets in parts between which the camera's clock was set."""
    parts = campaigns(groups)
    if utc_offset_s is not None or not slots:
        return parts
    return [
        piece
        for part in parts
        for piece in ([part] if tells_utc(part) else clock_parts(part, slots))
    ]


def _one_a_slot(
    matched: Sequence[tuple[Match, Offset]],
) -> tuple[list[tuple[Match, Offset]], list[str]]:
    """Return the best bracket for each slot, and a note on each other bracket that matched.

    Two brackets can match one slot if the camera's clock was set.
    """
    best: dict[str, tuple[Match, Offset]] = {}
    left_out_notes: list[str] = []
    for match, offset in sorted(matched, key=lambda pair: misfit(pair[0])):
        if match.slot.id in best:
            left_out_notes.append(
                f"{_range(match.group)}: not imported, because another bracket "
                f"matches {match.slot.id} better"
            )
        else:
            best[match.slot.id] = match, offset
    return sorted(best.values(), key=lambda pair: pair[0].slot.t_utc), left_out_notes


def lacking(group: Group, slot: Slot, setup: CameraSetup) -> list[Exposure]:
    """Return the planned exposures, counted once for each heading, that a card's bracket lacks."""
    planned = [shot.exposure for shot in shots(slot.exposures, setup)]
    return missing_exposures(group, planned)


def _lacking_text(match: Match, setup: CameraSetup) -> str:
    """Return a note on an incomplete bracket, or "".

    The note also names frames that could be with or without a filter.
    """
    missing = lacking(match.group, match.slot, setup)
    if not missing:
        return ""
    there = [frame.exposure for frame in match.group.frames]
    same_exposures = [
        e
        for e in missing
        if any(same_exposure(e, f) for f in there)
        and any(e.nd != other.nd and same_exposure(e, other) for other in match.slot.exposures)
    ]
    unsure = (
        f"; frames of {shutter_text(same_exposures[0].shutter_s)} s may have been taken with or "
        "without the filter, and are used as frames without it"
        if same_exposures
        else ""
    )
    shown = ", ".join(exposure_text(e) for e in missing[:3]) + (" ..." if len(missing) > 3 else "")
    return (
        f"{_range(match.group)}: missing frames of slot {match.slot.id}: {len(missing)} "
        f"({shown}){unsure}"
    )


def _adopt_all(
    session: Session,
    setup: CameraSetup,
    matched: Sequence[tuple[Match, Offset]],
    progress: Progress,
) -> tuple[list[Match], tuple[str, ...]]:
    """Import every bracket that the journal does not record as done.

    Return the imported brackets, and the slots that an earlier import had filled wrongly.
    """
    journal = Journal(session)
    new: list[Match] = []
    try:
        moved = withdraw(session, journal, read_ledger(session), matched)
        ledger = read_ledger(session)
        for number, (match, offset) in enumerate(matched, start=1):
            progress(number, len(matched), match.slot.id)
            if ledger.state(match.slot.id).outcome != "done":
                _adopt(session, setup, journal, match, offset)
                new.append(match)
    finally:
        journal.close()
    return new, moved


def _range(group: Group) -> str:
    first, last = group.frames[0].path, group.frames[-1].path
    return f"{first}" if first == last else f"{first} to {last.name}"


def _text(path: Path) -> str:
    """Return a path as valid UTF-8, because file names on a card may have another encoding."""
    return str(path).encode("utf-8", "replace").decode()


def _adopt(
    session: Session, setup: CameraSetup, journal: Journal, match: Match, offset: Offset
) -> None:
    """Copy the frames of one bracket and journal them like captured ones."""
    slot, folder = match.slot, session.capture_file(match.slot.id).parent
    now = datetime.now(UTC)
    journal.append("imported", now, slot=slot.id, source=_text(match.group.frames[0].path.parent))
    journal.append("started", now, slot=slot.id, attempt=1)
    frames: list[Frame] = []
    for index, card in enumerate(match.group.frames):
        name = _name(card.path, [f.file for f in frames])
        with replacing_path(folder / name) as copy:
            shutil.copyfile(card.path, copy)
        frame = Frame(
            index,
            name,
            *meant(match.group, index, slot, setup),
            true_time(card.t_camera, offset),
            card.exposure.shutter_s,
            sha256(folder / name),
        )
        journal.append("frame", now, slot=slot.id, frame=frame_fields(frame))
        frames.append(frame)
    state = SlotState("done", 1, tuple(frames))
    write_capture(folder, slot, state, setup, {}, complete=not lacking(match.group, slot, setup))
    journal.append("done", now, slot=slot.id, frames=len(frames), why="imported")


def meant(
    group: Group, index: int, slot: Slot, setup: CameraSetup
) -> tuple[Exposure, float | None]:
    """Return the planned exposure and heading of frame `index` of a card's bracket.

    EXIF has neither filter nor heading, so they follow from the order of the frames. A frame that
    is not in the plan keeps its EXIF exposure, at the first heading.
    """
    exposure = group.frames[index].exposure
    before = sum(same_exposure(f.exposure, exposure) for f in group.frames[:index])
    alike = [
        shot for shot in shots(slot.exposures, setup) if same_exposure(shot.exposure, exposure)
    ]
    if not alike:
        return exposure, setup.headings[0] if setup.headings else None
    shot = alike[min(before, len(alike) - 1)]
    return shot.exposure, shot.heading_deg


def _name(path: Path, taken: Sequence[str]) -> str:
    return path.name if path.name not in taken else f"{path.parent.name}_{path.name}"


# ----------------------------------------------------------------------------------------------
# brackets that an earlier import, with another clock, put into wrong slots

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
