"""`fieldlum import`: a card folder, and a logger's file, into the session."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

from fieldlum.capture.bracket import shots, write_capture
from fieldlum.capture.group import (
    CardFrame,
    Group,
    Match,
    Offset,
    campaigns,
    find_offset,
    fits,
    fitting_offsets,
    group_frames,
    match_groups,
    refine_offset,
    same_exposure,
    true_time,
)
from fieldlum.capture.logger_rows import adopt_rows
from fieldlum.capture.misplaced import withdraw
from fieldlum.capture.state import Frame, SlotState, fold, frame_fields
from fieldlum.errors import InputError, NotEnoughDataError
from fieldlum.raw import read_exif
from fieldlum.records import CameraSetup, Exposure, Progress, SiteFile, Slot, quiet, utc_text
from fieldlum.session import (
    Journal,
    Session,
    read_journal,
    replacing_path,
    sha256,
    sole_user,
    update_session,
)

RAW_SUFFIXES = (
    ".dng", ".cr2", ".cr3", ".crw", ".nef", ".nrw", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".raw",
)  # fmt: skip
JPEG_SUFFIXES = (".jpg", ".jpeg")


@dataclass(frozen=True, slots=True)
class Report:
    """What an import did. lines: one sentence each about what was left out."""

    brackets: int = 0
    frames: int = 0
    known: int = 0  # brackets that were there already
    offsets: tuple[Offset, ...] = ()  # one a campaign
    late_s: tuple[float, ...] = ()
    left_out: tuple[str, ...] = ()
    rows: int = 0
    withdrawn: int = 0  # rows of the logger's file that it brought before with another clock or other columns
    slots: tuple[str, ...] = ()
    moved: tuple[str, ...] = ()  # slots that this card's brackets were taken out of: another clock before


def card_files(folder: Path) -> list[Path]:
    """Frames under a folder, raw before the JPEG of the same name. Raises InputError for a folder without any."""
    if folder.is_file():
        raise InputError(folder, "a file", "a card's folder, such as DCIM", "a logger's file goes with --irradiance")
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "a card's folder, such as DCIM", "check the path")
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
    raw = [p for p in files if p.suffix.lower() in RAW_SUFFIXES]
    twins = {p.with_suffix("") for p in raw}
    jpeg = [p for p in files if p.suffix.lower() in JPEG_SUFFIXES and p.with_suffix("") not in twins]
    if not raw and not jpeg:
        raise InputError(folder, "no raw or JPEG frames in it", "a card's folder, such as DCIM", "check the path")
    return [*raw, *jpeg]


def read_card(files: Sequence[Path], progress: Progress = quiet) -> tuple[list[CardFrame], list[str]]:
    """Frames with their EXIF, and a line for each file that cannot be used."""
    frames: list[CardFrame] = []
    left_out: list[str] = []
    for done, path in enumerate(files, start=1):
        progress(done, len(files), path.name)
        try:
            info = read_exif(path)
        except InputError as error:
            left_out.append(str(error))
            continue
        if info.t_camera is None:
            left_out.append(f"{path}: no time in its EXIF")
            continue
        aware = info.t_camera.tzinfo is not None
        when = info.t_camera.astimezone(UTC) if aware else info.t_camera.replace(tzinfo=UTC)
        frames.append(CardFrame(path, info.exposure, when, aware))
    return frames, left_out


def clock_offset(groups: Sequence[Group], slots: Sequence[Slot], setup: SiteFile, told_s: float | None) -> Offset:
    """How far the camera's clock is from UTC: as told, as the frames say, else as it fits the plan.

    Raises InputError when that is ambiguous.
    """
    if told_s is not None:
        start = Offset(told_s, "--utc-offset")
    elif all(frame.known_utc for group in groups for frame in group.frames):
        start = Offset(0.0, "the frames' own UTC offset")
    else:
        start = find_offset(groups, slots, _expected_s(slots, setup))
    if start is None and not fitting_offsets(groups, slots):
        first, last = (min(g.t_camera for g in groups), max(g.t_camera for g in groups))
        near = min(slots, key=lambda slot: abs(slot.t_utc - first), default=None)
        raise InputError(
            "import", f"brackets of {first:%Y-%m-%d %H:%M} to {last:%Y-%m-%d %H:%M} by the camera's clock",
            f"the plan's slots, the nearest at {near.t_utc:%Y-%m-%d %H:%M} UTC" if near else "a plan with slots",
            "is it another card? a wrong date is set right by exiftool -AllDates",
        )  # fmt: skip
    if start is None:
        raise InputError(
            "import", "several UTC offsets of the camera's clock fit the plan alike",
            "the camera's offset from UTC", "give it, like: --utc-offset -08:00",
        )  # fmt: skip
    return refine_offset(groups, slots, start)


def _expected_s(slots: Sequence[Slot], setup: SiteFile) -> list[float]:
    """The place's offsets over the plan, most frequent first, then UTC."""
    zone = ZoneInfo(setup.site.timezone)
    offsets = [(slot.t_utc.astimezone(zone).utcoffset() or timedelta()).total_seconds() for slot in slots]
    return [*sorted(set(offsets), key=lambda o: -offsets.count(o)), 0.0]


def run(
    session: Session,
    folder: Path | None,
    *,
    logger: Path | None = None,
    utc_offset_s: float | None = None,
    columns: Mapping[str, str] | None = None,
    progress: Progress = quiet,
) -> Report:
    """Copy what matches the plan into raw/ and the journal; add a logger's rows to the day files. Can be run again.

    utc_offset_s: what the clocks of camera and logger show minus UTC; None: the camera's is fitted to the plan.
    columns: quantity to the logger's name for it, where that is an unusual one.
    Raises InputError for a folder without frames or an ambiguous clock, NotEnoughDataError when nothing matched. Card
    and file are never changed.
    """
    with sole_user(session, "capture"):
        report = Report() if folder is None else _adopt_card(session, folder, utc_offset_s, progress)
        if logger is None:
            return report
        found = adopt_rows(session, logger, utc_offset_s, columns)
        return replace(report, rows=found.rows, withdrawn=found.withdrawn, left_out=(*report.left_out, *found.left_out))


def _adopt_card(session: Session, folder: Path, utc_offset_s: float | None, progress: Progress) -> Report:
    setup, slots = session.site_file(), session.slots()
    frames, left_out = read_card(card_files(folder), progress)
    groups = group_frames(frames, slots[0].exposures if slots else (), max(1, len(setup.camera.headings)))
    if not groups:
        raise NotEnoughDataError(f"{folder}: no usable frame; {left_out[0]}")
    matched: list[tuple[Match, Offset]] = []
    offsets: list[Offset] = []
    for part in campaigns(groups):
        offset = clock_offset(part, slots, setup, utc_offset_s)
        found, unmatched = match_groups(part, slots, offset)
        offsets.append(offset)
        matched += [(match, offset) for match in found]
        left_out += [f"{_range(u.group)}: {u.why} ({utc_text(true_time(u.group.t_camera, offset))})" for u in unmatched]
    if not matched:
        raise NotEnoughDataError(f"{folder}: none of {len(groups)} brackets matches the plan; {left_out[-1]}")
    new, moved = _adopt_all(session, setup.camera, matched, progress)
    about = [{"camera_clock_minus_utc_s": round(o.seconds, 1), "how": o.how} for o in offsets]
    update_session(session, {"imported": {**session.table().get("imported", {}), str(folder): about}})
    return Report(
        len(new), sum(len(m.group.frames) for m in new), len(matched) - len(new), tuple(offsets),
        tuple(m.late_s for m, _ in matched), tuple(left_out), slots=tuple(m.slot.id for m in new), moved=moved,
    )  # fmt: skip


def _adopt_all(
    session: Session, setup: CameraSetup, matched: Sequence[tuple[Match, Offset]], progress: Progress
) -> tuple[list[Match], tuple[str, ...]]:
    """Everything that the journal does not call done; returns what was new, and the slots that were wrong before."""
    journal = Journal(session)
    new: list[Match] = []
    try:
        moved = withdraw(session, journal, fold(read_journal(session)), matched)
        ledger = fold(read_journal(session))
        for done, (match, offset) in enumerate(matched, start=1):
            progress(done, len(matched), match.slot.id)
            if ledger.slots.get(match.slot.id, SlotState()).outcome != "done":
                _adopt(session, setup, journal, match, offset)
                new.append(match)
    finally:
        journal.close()
    return new, moved


def _range(group: Group) -> str:
    first, last = group.frames[0].path, group.frames[-1].path
    return f"{first}" if first == last else f"{first} to {last.name}"


def _adopt(session: Session, setup: CameraSetup, journal: Journal, match: Match, offset: Offset) -> None:
    """One bracket: frames copied whole, then journalled like captured ones."""
    slot, folder = match.slot, session.raw / match.slot.id
    now = datetime.now(UTC)
    journal.append("imported", now, slot=slot.id, source=str(match.group.frames[0].path.parent))
    journal.append("started", now, slot=slot.id, attempt=1)
    frames: list[Frame] = []
    for index, card in enumerate(match.group.frames):
        name = _name(card.path, [f.file for f in frames])
        with replacing_path(folder / name) as copy:
            shutil.copyfile(card.path, copy)
        frame = Frame(
            index, name, *meant(match.group, index, slot, setup), true_time(card.t_camera, offset),
            card.exposure.shutter_s, sha256(folder / name),
        )  # fmt: skip
        journal.append("frame", now, slot=slot.id, frame=frame_fields(frame))
        frames.append(frame)
    state = SlotState("done", 1, tuple(frames))
    write_capture(folder, slot, state, setup, {}, complete=fits(match.group, slot) == len(slot.exposures))
    journal.append("done", now, slot=slot.id, frames=len(frames), why="imported")


def meant(group: Group, index: int, slot: Slot, setup: CameraSetup) -> tuple[Exposure, float | None]:
    """The plan's exposure and heading that a frame is; neither filter nor heading is in EXIF, but their order is kept.

    A frame that is not the plan's stays as EXIF has it.
    """
    exposure = group.frames[index].exposure
    before = sum(same_exposure(f.exposure, exposure) for f in group.frames[:index])
    alike = [shot for shot in shots(slot.exposures, setup) if same_exposure(shot.exposure, exposure)]
    if not alike:
        return exposure, setup.headings[0] if setup.headings else None
    shot = alike[min(before, len(alike) - 1)]
    return shot.exposure, shot.heading_deg


def _name(path: Path, taken: Sequence[str]) -> str:
    return path.name if path.name not in taken else f"{path.parent.name}_{path.name}"
