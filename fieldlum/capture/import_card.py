"""Copy a card's frames and a logger's file into the session (`fieldlum import`)."""

import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from itertools import chain
from pathlib import Path
from typing import Any

from fieldlum.capture import import_logger, match_card
from fieldlum.capture.bracket import FrameRequest, frame_requests, write_capture
from fieldlum.capture.match_card import CardFrame, Clocks, Group, Match, Offset, Report
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.progress import progress
from fieldlum.core.records import CameraSetup, Exposure, SiteFile, Slot, listed
from fieldlum.optics.profiles import CameraBody, load_camera_profile
from fieldlum.optics.raw import RAW_SUFFIXES, exif, is_jpeg, jpeg_size, read_exif, same_model
from fieldlum.session import Journal, Session, exposure_text, replacing_path, sha256, sole_user
from fieldlum.session.files.capture_json import Frame, frame_fields
from fieldlum.session.folder import DeviceTable, update_session
from fieldlum.session.slot_states import SlotState, read_slot_states


def run(
    session: Session,
    folder: Path | None,
    *,
    logger: Path | None = None,
    utc_offset_s: float | None = None,
    logger_utc_offset_s: float | None = None,
    **of_logger: Any,
) -> Report:
    """Copy the brackets that match the plan into raw/ and the journal; return what was imported.

    Add a logger's rows to the day files. An import can be repeated. The card and the logger's file
    are never changed. folder: of the card, None to import only the file `logger`. utc_offset_s:
    clocks of camera and logger minus UTC [s]; None reads the camera's from EXIF or fits it to the
    plan. logger_utc_offset_s: the logger's, if it is another. of_logger: further arguments of
    `import_rows`. Raises InputError for a folder without frames, an ambiguous clock, an invalid
    logger's file, or while a capture runs; NotEnoughDataError if no bracket matched.
    """
    with sole_user(session, "capture"):
        rows, report = Report(), Report()
        if logger is not None:
            offset_s = utc_offset_s if logger_utc_offset_s is None else logger_utc_offset_s
            rows = import_logger.import_rows(session, logger, offset_s, **of_logger)
        if folder is not None:
            report = _import_card(session, folder, utc_offset_s)
    left_out, notes = (*report.left_out, *rows.left_out), (*report.notes, *rows.notes)
    return replace(report, rows=rows.rows, withdrawn=rows.withdrawn, left_out=left_out, notes=notes)


def _import_card(session: Session, folder: Path, utc_offset_s: float | None) -> Report:
    """Import the brackets in a card's folder that match the plan; return what was imported.

    utc_offset_s: the camera's clock minus UTC [s], None to find it. Raises as `run` does.
    """
    setup, slots = session.site_file(), session.slots()
    groups, left_out = _brackets(folder, setup, slots, utc_offset_s is not None)
    clocks: list[tuple[Sequence[Group], Offset]] = []
    notes: list[str] = []
    refused: list[InputError] = []
    parts, zone = match_card.split_at_gaps(groups), setup.site.timezone  # campaigns
    if utc_offset_s is None and slots:  # divided where the fit to the plan shows a changed clock
        is_utc = match_card.exif_states_offset
        pieces = ([p] if is_utc(p) else match_card.clock_parts(p, slots, zone) for p in parts)
        parts = list(chain.from_iterable(pieces))
    for part in parts:
        try:
            offset = match_card.clock_offset(part, slots, setup, utc_offset_s)
        # One campaign has a wrong date, or brackets of another plan; others can still be imported.
        except InputError as error:
            refused.append(error)
            files = f"{_file_range(part[0])} and {len(part) - 1} brackets after it"
            left_out.append(f"{files}: {error.found}; {error.remedy}")
            continue
        clocks.append((part, offset))
        notes.append(match_card.exif_note(part, utc_offset_s))
        notes.append(match_card.offset_contradiction(part, slots, offset))
    if refused and clocks:  # a part that matches nothing can show what is wrong with all
        notes.append(match_card.offset_contradiction(groups, slots, clocks[0][1]))
    matches, others = match_card.match_groups(clocks, slots)
    left_out += [f"{_file_range(group)}: {why}" for group, why in others]
    if not matches:
        if refused:
            raise refused[0]
        found = f"none of {len(groups)} brackets matches the plan; {left_out[-1]}"
        raise NotEnoughDataError(f"{folder}: {found}; check --utc-offset and the plan")
    notes += match_card.clock_steps(clocks)
    notes += [_missing_text(match, setup.camera) for match in matches]
    new, moved = _import_brackets(session, setup.camera, clocks, matches)
    offsets = tuple(offset for _, offset in clocks)
    about = [{"camera_clock_minus_utc_s": round(o.seconds, 1), "how": o.how} for o in offsets]
    imported = session.table().get("imported", {})
    update_session(session, {"imported": {**imported, _utf8_text(folder): about}})
    return Report(
        brackets=len(new),
        frames=sum(len(m.group.frames) for m in new),
        known=len(matches) - len(new),
        offsets=offsets,
        late_s=tuple(m.late_s for m in matches),
        left_out=tuple(left_out),
        notes=tuple(filter(None, notes)),
        slots=tuple(m.slot.id for m in new),
        moved=moved,
    )


def _brackets(
    folder: Path, setup: SiteFile, slots: Sequence[Slot], own_clock: bool
) -> tuple[list[Group], list[str]]:
    """Return the brackets in a card's folder, and a sentence on each file that is not used.

    slots: of the plan. own_clock: whether times are those of the camera's clock, not corrected by
    EXIF's offset. Raises NotEnoughDataError without a usable frame.
    """
    files = card_files(folder)
    body = load_camera_profile(setup.camera.profile).camera
    frames, unread = read_card(files, body.fixed_f_number, own_clock)
    frames, other_cameras = of_session_camera(frames, body)
    frames, copies = without_edited(frames, (body.width_px, body.height_px))
    left_out = [*other_cameras, *copies, *unread]
    if not frames:
        remedy = "check that this is the right card"
        raise NotEnoughDataError(f"{folder}: no usable frame; {left_out[0]}; {remedy}")
    exposures = slots[0].exposures if slots else ()
    return match_card.group_frames(frames, exposures, max(1, len(setup.camera.headings))), left_out


def planned_frames(group: Group, slot: Slot, setup: CameraSetup) -> list[FrameRequest]:
    """Return the planned frame for each frame of a card's bracket.

    For one that is not in the plan it has the heading, but the exposure of the card. slot: to which
    the bracket belongs; setup: with the headings of each bracket.
    """
    requests, planned = iter(frame_requests(slot.exposures, setup)), list[FrameRequest]()
    for part in match_card.split_by_heading(group, slot.exposures, len(setup.headings) or 1):
        own = [next(requests) for _ in slot.exposures]
        of_heading = match_card.planned_indices(part, slot.exposures)
        for frame, k in zip(part.frames, of_heading, strict=True):
            planned.append(replace(own[0], exposure=frame.exposure) if k is None else own[k])
    return planned


def missing_frames(match: Match, setup: CameraSetup) -> list[FrameRequest]:
    """Return the planned frames, of all headings, that a card's bracket does not contain.

    match: the bracket and its slot; setup: with the headings of each bracket.
    """
    present = planned_frames(match.group, match.slot, setup)
    return [frame for frame in frame_requests(match.slot.exposures, setup) if frame not in present]


def _missing_text(match: Match, setup: CameraSetup) -> str:
    """Return a note on the frames that a card's bracket does not contain; "" if it is complete.

    EXIF does not record filters. A frame that may have one counts as taken without it, and `merge`
    detects the filter.
    """
    missing = missing_frames(match, setup)
    heading = " at heading {:g}" if setup.headings else ""
    shown = listed([exposure_text(r.exposure) + heading.format(r.heading_deg) for r in missing], 3)
    where = f"missing frames of slot {match.slot.id}"
    return f"{_file_range(match.group)}: {where}: {len(missing)} ({shown})" if missing else ""


def _import_brackets(
    session: Session, setup: CameraSetup, clocks: Clocks, matches: Sequence[Match]
) -> tuple[list[Match], tuple[str, ...]]:
    """Import every matched bracket whose slot is not yet done in the journal.

    clocks: all brackets of the card, with the offset of their clock. Return the imported brackets,
    and the ids of slots that an earlier import had filled wrongly.
    """
    with closing(Journal(session)) as journal:
        moved = remove_misplaced(session, journal, clocks, {m.group: m.slot.id for m in matches})
        states = read_slot_states(session)
        new = [m for m in matches if states.state(m.slot.id).outcome != "done"]
        for number, match in enumerate(new, start=1):
            progress(number, len(new), match.slot.id)
            _import_bracket(session, setup, journal, match)
    return new, moved


def _file_range(group: Group) -> str:
    """Return the path of a bracket's first frame and the name of its last, for messages."""
    first, last = group.frames[0].path, group.frames[-1].path
    return f"{first}" if first == last else f"{first} to {last.name}"


def _utf8_text(path: Path) -> str:
    """Return a path as a text that UTF-8 can encode; names on a card may have another encoding."""
    return str(path).encode("utf-8", "replace").decode()


def _import_bracket(session: Session, setup: CameraSetup, journal: Journal, match: Match) -> None:
    """Copy the frames of one bracket and journal them like captured ones."""
    slot, folder = match.slot, session.capture_file(match.slot.id).parent
    now, first = datetime.now(UTC), match.group.frames[0]
    journal.append("imported", now, slot=slot.id, source=_utf8_text(first.path.parent))
    journal.append("started", now, slot=slot.id, attempt=1)
    frames: list[Frame] = []
    planned = planned_frames(match.group, slot, setup)
    for index, (card, request) in enumerate(zip(match.group.frames, planned, strict=True)):
        name = card.path.name
        # Two folders of a card can have files of one name.
        if any(frame.file.casefold() == name.casefold() for frame in frames):
            name = f"{card.path.parent.name}_{name}"
        with replacing_path(folder / name) as copy:
            shutil.copyfile(card.path, copy)
        frame = Frame(
            index=index,
            file=name,
            exposure=request.exposure,
            heading_deg=request.heading_deg,
            t_utc=match_card.true_time(card.t_camera, match.offset),
            seconds=card.exposure.shutter_s,
            sha256=sha256(folder / name),
        )
        journal.append("frame", now, slot=slot.id, frame=frame_fields(frame))
        frames.append(frame)
    state = SlotState("done", 1, tuple(frames))
    about: DeviceTable = {"model": first.camera, "serial": first.serial}
    write_capture(folder, slot, state, setup, about, complete=not missing_frames(match, setup))
    journal.append("done", now, slot=slot.id, frames=len(frames), why="imported")


# ----------------------------------------------------------------------------------------------
# brackets that an earlier import, with another clock, put into wrong slots


def remove_misplaced(
    session: Session, journal: Journal, clocks: Clocks, slots: Mapping[Group, str]
) -> tuple[str, ...]:
    """Remove imported brackets whose frames now have another slot or time; return their slots' ids.

    clocks: all brackets of the new import with their clock offset; slots: ids of the slots of those
    that match one. Times differ if they are over two minutes apart. The brackets' folders move to
    raw/withdrawn/, and what merge wrote from them is deleted. The slots then have no bracket any
    more.
    """
    cards: dict[str, list[tuple[CardFrame, Offset, str]]] = {}
    for group, offset in ((group, offset) for part, offset in clocks for group in part):
        for card in group.frames:
            cards.setdefault(card.path.name, []).append((card, offset, slots.get(group, "")))
    withdrawn: list[str] = []
    for slot, state in read_slot_states(session).slots.items():
        pairs = [(frame, *card) for frame in state.frames for card in cards.get(frame.file, ())]
        is_imported = state.outcome == "done" and state.why == "imported"
        if is_imported and any(_is_elsewhere(slot, *pair) for pair in pairs):
            # Before the journal entry, so that the next import repairs an interrupted one.
            _set_aside(session, slot)
            why = "imported with another clock"
            journal.append("withdrawn", datetime.now(UTC), slot=slot, why=why)
            withdrawn.append(slot)
    return tuple(withdrawn)


def _is_elsewhere(slot: str, frame: Frame, card: CardFrame, offset: Offset, now: str) -> bool:
    """Return whether a frame that was imported into `slot` now has another slot or time.

    card: of the new import; a card's frame of the same name but another content is another frame,
    which gives False. offset: of its clock; now: its slot, "" if it matches none, or if another
    bracket of the slot is better.
    """
    difference = match_card.true_time(card.t_camera, offset) - frame.t_utc
    # A refined clock offset changes times by less than two minutes.
    is_elsewhere = now not in ("", slot) or abs(difference.total_seconds()) > 120.0
    return is_elsewhere and frame.sha256 == sha256(card.path)


def _set_aside(session: Session, slot: str) -> None:
    """Move a slot's folder to raw/withdrawn/SLOT.NUMBER, and delete what merge wrote from it."""
    folder, aside = session.capture_file(slot).parent, session.raw / "withdrawn"
    aside.mkdir(parents=True, exist_ok=True)
    if folder.is_dir():
        folder.replace(aside / f"{slot}.{len(list(aside.glob(f'{slot}.*')))}")
    for path in (session.panorama(slot), session.sidecar(slot), session.sunpatch(slot)):
        path.unlink(missing_ok=True)


# ----------------------------------------------------------------------------------------------
# the files of a card


def card_files(folder: Path) -> list[Path]:
    """Return the raw and JPEG files in a folder and its subfolders.

    Other files are ignored, and so are folders that begin with `.` or `@`, in which systems store
    thumbnails and deleted files. Raises InputError if the folder is missing, or has no raw or JPEG
    file; the error names the suffixes in the folder, such as .heic.
    """
    if not folder.is_dir():
        found = "this is a file, not a folder" if folder.is_file() else "no such folder"
        remedy = "import a logger's file with --irradiance, or check the path of the card"
        raise InputError(folder, found, "a card's folder, such as DCIM", remedy)
    files = sorted(
        path
        for path in folder.rglob("*")
        if path.is_file() and not any(name[0] in ".@" for name in path.relative_to(folder).parts)
    )
    frames = [path for path in files if path.suffix.lower() in RAW_SUFFIXES or is_jpeg(path)]
    if not frames:
        kinds = listed(sorted({path.suffix.lower() for path in files})) if files else "no files"
        found = f"no raw or JPEG frames in this folder ({kinds})"
        remedy = "check the path of the card, and set the camera to record raw files"
        raise InputError(folder, found, "a card's folder, such as DCIM", remedy)
    return frames


def read_card(
    files: Sequence[Path], lens_f_number: float, own_clock: bool
) -> tuple[list[CardFrame], list[str]]:
    """Return the frames with their EXIF, and a sentence on each file that cannot be used.

    files: raw and JPEG files, as `card_files` returns them; lens_f_number: f-number of a lens that
    writes none to EXIF, 0 for others. own_clock: whether times are those that the camera's clock
    showed, not corrected by EXIF's offset.
    """
    frames: list[CardFrame] = []
    left_out: list[str] = []
    for number, path in enumerate(files, start=1):
        progress(number, len(files), path.name)
        try:
            info = read_exif(path, lens_f_number=lens_f_number)
        except InputError as error:
            left_out.append(str(error))
            continue
        if info.t_camera is None:
            left_out.append(f"{path}: EXIF has no time")
            continue
        offset = info.t_camera.utcoffset()  # None for a camera that writes no offset
        offset_s = None if offset is None else offset.total_seconds()
        t_camera = info.t_camera.replace(tzinfo=UTC)
        t_camera -= timedelta() if own_clock or offset is None else offset
        camera = info.model or info.make or "a camera that EXIF does not name"
        # BodySerialNumber (EXIF 2.3) distinguishes two bodies of one model.
        serial = exif.text_of(exif.tags_of(path), 42033)
        frames.append(CardFrame(path, info.exposure, t_camera, offset_s, camera, serial))
    return frames, left_out


def without_edited(
    frames: Sequence[CardFrame], size_px: tuple[int, int]
) -> tuple[list[CardFrame], list[str]]:
    """Return the frames that the camera wrote, and notes on copies and on pictures of other sizes.

    A copy, edited or not, has the time and exposure of a frame, but a rarer or longer form of name
    (IMG_0003_edit.JPG), or the same name in another folder. size_px: width and height of the
    camera's frames by its profile; if no JPEG has it, the most frequent size counts.
    """
    sizes = {frame.path: jpeg_size(frame.path) for frame in frames if is_jpeg(frame.path)}
    if sizes and size_px not in sizes.values():
        size_px, _ = Counter(sizes.values()).most_common(1)[0]
    resized = {path for path, size in sizes.items() if size not in (size_px, (0, 0))}
    full = [frame for frame in frames if frame.path not in resized]
    counts = Counter(_name_pattern(frame.path) for frame in full)
    # The frame that the camera wrote has the most frequent form of name, then the shortest.
    rank = {frame.path: (counts[p := _name_pattern(frame.path)], -len(p)) for frame in full}
    same_shots: dict[tuple[datetime, Exposure], list[CardFrame]] = {}
    for frame in full:
        shot = (frame.t_camera.replace(microsecond=0), frame.exposure)
        same_shots.setdefault(shot, []).append(frame)
    copies: set[Path] = set()
    for same in (group for group in same_shots.values() if len(group) > 1):
        best = max(rank[frame.path] for frame in same)
        originals = [frame for frame in same if rank[frame.path] == best]
        # Two files of one name in two folders: the camera's own folder is below DCIM (DCF 2.0).
        originals.sort(key=lambda f: ("DCIM" not in f.path.parts, len(f.path.parts), f.path))
        first_of_name = {frame.path.stem: frame for frame in reversed(originals)}
        copies |= {f.path for f in same if first_of_name.get(f.path.stem) is not f}
    width, height = size_px
    notes = _note(sorted(resized), f"not the size of the camera's frames, {width} x {height}")
    notes += _note(sorted(copies), "a copy of another frame")
    return [frame for frame in full if frame.path not in copies], notes


def _name_pattern(path: Path) -> str:
    """Return a file's name without suffix and with # for each digit, such as IMG_####."""
    return re.sub(r"\d", "#", path.stem)


def _note(paths: Sequence[Path], what: str) -> list[str]:
    """Return one note that `what` is true of these files; no note without a file."""
    return [f"{listed(paths, 1)}: {what}"] if paths else []


def of_session_camera(
    frames: Sequence[CardFrame], body: CameraBody
) -> tuple[list[CardFrame], list[str]]:
    """Return the frames of the session's camera in one format, and a note on each other camera.

    body: of the profile. The session's camera is that of the profile's model, else the one with the
    most frames: frames of two cameras never form a bracket. If it has raw and JPEG frames, those of
    the profile's kind are returned, and the other ones are skipped without a note.
    """
    counts = Counter((frame.camera, frame.serial) for frame in frames)  # by model and serial number
    order = {who: (not same_model(who[0], body.model), -counts[who]) for who in counts}
    own = min(order, key=order.__getitem__, default=("", ""))
    ours = f"the session's camera is {' '.join(own).strip()}"
    others = [(" ".join(who).strip(), count) for who, count in counts.items() if who != own]
    notes = [f"{count} frames of {name}: {ours}" for name, count in others]
    own_frames = [frame for frame in frames if (frame.camera, frame.serial) == own]
    of_kind = [frame for frame in own_frames if is_jpeg(frame.path) == (body.kind == "jpeg")]
    return of_kind or own_frames, notes
