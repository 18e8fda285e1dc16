"""Copy a card's frames and a logger's file into the session (`fieldlum import`)."""

import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from fieldlum.capture import match_card
from fieldlum.capture.bracket import FrameRequest, frame_requests, write_capture
from fieldlum.capture.logger_import import import_rows
from fieldlum.capture.match_card import CardFrame, Group, Match, Offset, Report
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.progress import progress
from fieldlum.core.records import CameraSetup, Exposure, SiteFile, Slot, listed
from fieldlum.optics.profiles import CameraBody, load_camera_profile
from fieldlum.optics.raw import RAW_SUFFIXES, is_jpeg, jpeg_size, read_exif, same_model
from fieldlum.optics.raw.exif import tags_of, text_of
from fieldlum.session import Journal, Session, exposure_text, replacing_path, sha256, sole_user
from fieldlum.session.files.capture_json import Frame, frame_fields
from fieldlum.session.folder import DeviceTable, update_session
from fieldlum.session.slot_states import SlotState, SlotStates, read_slot_states


def run(
    session: Session,
    folder: Path | None,
    *,
    logger: Path | None = None,
    utc_offset_s: float | None = None,
    logger_utc_offset_s: float | None = None,
    columns: Mapping[str, str] | None = None,
    sensitivities: Mapping[str, float] | None = None,
) -> Report:
    """Copy brackets that match the plan into raw/ and the journal.

    Add a logger's rows to the day files. An import can be repeated. The card and the logger's file
    are never changed. utc_offset_s: clocks of camera and logger minus UTC [s]; None reads the
    camera's from EXIF or fits it to the plan. logger_utc_offset_s: the logger's, if it is another.
    columns: the logger's column name for each quantity,
    if it is unusual; sensitivities: of pyranometers whose column is a voltage, uV per W/m2. Raises
    InputError for a folder without frames, an ambiguous clock, an invalid logger's file, or while a
    capture runs; NotEnoughDataError if no bracket matched.
    """
    with sole_user(session, "capture"):
        rows, report = Report(), Report()
        if logger is not None:
            offset_s = utc_offset_s if logger_utc_offset_s is None else logger_utc_offset_s
            rows = import_rows(session, logger, offset_s, columns, sensitivities)
        if folder is not None:
            report = _import_card(session, folder, utc_offset_s)
        left_out, notes = (*report.left_out, *rows.left_out), (*report.notes, *rows.notes)
        about = {"left_out": left_out, "notes": notes}
        return replace(report, rows=rows.rows, withdrawn=rows.withdrawn, **about)


def _import_card(session: Session, folder: Path, utc_offset_s: float | None) -> Report:
    """Import the brackets in a card's folder that match the plan.

    utc_offset_s: the camera's clock minus UTC, None to find it.
    """
    setup, slots = session.site_file(), session.slots()
    groups, left_out = _brackets(folder, setup, slots, utc_offset_s is not None)
    clocks: list[tuple[list[Group], Offset]] = []
    notes: list[str] = []
    refused: list[InputError] = []
    zone = setup.site.timezone
    for part in _parts_of_one_clock(groups, slots, utc_offset_s, zone):
        try:
            offset = match_card.clock_offset(part, slots, setup, utc_offset_s)
        # The error of one campaign: a wrong date, or brackets of another plan.
        except InputError as error:
            refused.append(error)
            whose = f"{_file_range(part[0])} and {len(part) - 1} brackets after it"
            left_out.append(f"{whose}: {error.found}; {error.remedy}")
            continue
        clocks.append((part, offset))
        notes.append(match_card.exif_note(part, utc_offset_s))
        notes.append(match_card.offset_contradiction(part, slots, offset, zone))
    matches, others = match_card.match_groups(clocks, slots)
    left_out += [f"{_file_range(group)}: {why}" for group, why in others]
    if not matches:
        if refused:
            raise refused[0]
        found = f"none of {len(groups)} brackets matches the plan; {left_out[-1]}"
        raise NotEnoughDataError(f"{folder}: {found}; check --utc-offset and the plan")
    notes += match_card.clock_steps(clocks)
    notes += [_missing_text(match, setup.camera) for match in matches]
    new, moved = _import_brackets(session, setup.camera, matches)
    offsets = tuple(offset for _, offset in clocks)
    about = [{"camera_clock_minus_utc_s": round(o.seconds, 1), "how": o.how} for o in offsets]
    imported = session.table().get("imported", {})
    update_session(session, {"imported": {**imported, _text(folder): about}})
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
    """Return the brackets in a card's folder, and sentences on files that are not used.

    own_clock: whether times are those of the camera's clock, not corrected by EXIF's offset. Raises
    NotEnoughDataError without a usable frame.
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


def _parts_of_one_clock(
    groups: Sequence[Group], slots: Sequence[Slot], utc_offset_s: float | None, zone: str
) -> list[list[Group]]:
    """Return the brackets in parts between which the camera's clock was set.

    groups: brackets in order of the camera's clock; slots: of the plan; zone: IANA name of the
    place. A stated offset `utc_offset_s`, and times that state UTC, hold for all frames of a part.
    """
    parts = match_card.split_at_gaps(groups)
    if utc_offset_s is not None or not slots:
        return parts
    pieces: list[list[Group]] = []
    for part in parts:
        is_utc = match_card.states_utc(part)
        pieces += [part] if is_utc else match_card.clock_parts(part, slots, zone)
    return pieces


def planned_frames(group: Group, slot: Slot, setup: CameraSetup) -> list[FrameRequest | None]:
    """Return the planned frame of each frame of a card's bracket; None for one of no plan."""
    requests = frame_requests(slot.exposures, setup)
    indices = match_card.planned_indices(group, [request.exposure for request in requests])
    return [None if index is None else requests[index] for index in indices]


def missing_frames(match: Match, setup: CameraSetup) -> list[FrameRequest]:
    """Return the planned frames, at each heading, that a card's bracket lacks."""
    present = planned_frames(match.group, match.slot, setup)
    return [r for r in frame_requests(match.slot.exposures, setup) if r not in present]


def _missing_text(match: Match, setup: CameraSetup) -> str:
    """Return a note on an incomplete bracket, or "".

    A frame that could be with or without a filter is used as one without it: `merge` finds it.
    """
    missing = missing_frames(match, setup)
    if not missing:
        return ""
    shown = listed([exposure_text(request.exposure) for request in missing], 3)
    where = f"missing frames of slot {match.slot.id}"
    return f"{_file_range(match.group)}: {where}: {len(missing)} ({shown})"


def _import_brackets(
    session: Session, setup: CameraSetup, matches: Sequence[Match]
) -> tuple[list[Match], tuple[str, ...]]:
    """Import every bracket that the journal does not record as done.

    Return the imported brackets, and the slots that an earlier import had filled wrongly.
    """
    with closing(Journal(session)) as journal:
        moved = remove_misplaced(session, journal, read_slot_states(session), matches)
        states = read_slot_states(session)
        new = [m for m in matches if states.state(m.slot.id).outcome != "done"]
        for number, match in enumerate(new, start=1):
            progress(number, len(new), match.slot.id)
            _import_bracket(session, setup, journal, match)
    return new, moved


def _file_range(group: Group) -> str:
    first, last = group.frames[0].path, group.frames[-1].path
    return f"{first}" if first == last else f"{first} to {last.name}"


def _text(path: Path) -> str:
    """Return a path as valid UTF-8, because file names on a card may have another encoding."""
    return str(path).encode("utf-8", "replace").decode()


def _import_bracket(session: Session, setup: CameraSetup, journal: Journal, match: Match) -> None:
    """Copy the frames of one bracket and journal them like captured ones."""
    slot, folder = match.slot, session.capture_file(match.slot.id).parent
    now = datetime.now(UTC)
    journal.append("imported", now, slot=slot.id, source=_text(match.group.frames[0].path.parent))
    journal.append("started", now, slot=slot.id, attempt=1)
    frames: list[Frame] = []
    planned = planned_frames(match.group, slot, setup)
    for index, (card, request) in enumerate(zip(match.group.frames, planned, strict=True)):
        name = card.path.name
        if any(frame.file.casefold() == name.casefold() for frame in frames):
            name = f"{card.path.parent.name}_{name}"
        with replacing_path(folder / name) as copy:
            shutil.copyfile(card.path, copy)
        frame = Frame(
            index,
            name,
            request.exposure if request else card.exposure,
            request.heading_deg if request else next(iter(setup.headings), None),
            t_utc=match_card.true_time(card.t_camera, match.offset),
            seconds=card.exposure.shutter_s,
            sha256=sha256(folder / name),
        )
        journal.append("frame", now, slot=slot.id, frame=frame_fields(frame))
        frames.append(frame)
    state = SlotState("done", 1, tuple(frames))
    is_complete = not missing_frames(match, setup)
    first = match.group.frames[0]
    about: DeviceTable = {"model": first.camera, "serial": first.serial}
    write_capture(folder, slot, state, setup, about, complete=is_complete)
    journal.append("done", now, slot=slot.id, frames=len(frames), why="imported")


# ----------------------------------------------------------------------------------------------
# brackets that an earlier import, with another clock, put into wrong slots


def remove_misplaced(
    session: Session, journal: Journal, states: SlotStates, matches: Sequence[Match]
) -> tuple[str, ...]:
    """Remove imported brackets whose frames now have another slot or time; return their slots' ids.

    matches: the new ones, each with its clock offset; times over two minutes apart differ. The
    brackets' folders move to raw/withdrawn/, and what merge wrote from them is deleted. The slots
    are then without a bracket again.
    """
    cards: dict[str, list[tuple[Match, CardFrame]]] = {}
    for match in matches:
        for card in match.group.frames:
            cards.setdefault(card.path.name, []).append((match, card))
    withdrawn: list[str] = []
    for slot, state in states.slots.items():
        pairs = [(frame, *card) for frame in state.frames for card in cards.get(frame.file, ())]
        is_imported = state.outcome == "done" and state.why == "imported"
        if is_imported and any(_is_elsewhere(slot, *pair) for pair in pairs):
            # Before the journal entry: the next import repairs an interrupted one.
            _set_aside(session, slot)
            why = "imported with another clock"
            journal.append("withdrawn", datetime.now(UTC), slot=slot, why=why)
            withdrawn.append(slot)
    return tuple(withdrawn)


def _is_elsewhere(slot: str, frame: Frame, match: Match, card: CardFrame) -> bool:
    """Return whether a slot's imported frame has another slot or time by a match and its clock."""
    apart = match_card.true_time(card.t_camera, match.offset) - frame.t_utc
    # a refined clock offset changes times by less
    is_elsewhere = slot != match.slot.id or abs(apart.total_seconds()) > 120.0
    return is_elsewhere and frame.sha256 == sha256(card.path)


def _set_aside(session: Session, slot: str) -> None:
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
    file; it names what the folder has, such as .heic.
    """
    if not folder.is_dir():
        found = "this is a file, not a folder" if folder.is_file() else "no such folder"
        remedy = "import a logger's file with --irradiance, or check the path of the card"
        raise InputError(folder, found, "a card's folder, such as DCIM", remedy)
    files = sorted(
        p
        for p in folder.rglob("*")
        if p.is_file() and not any(name[0] in ".@" for name in p.relative_to(folder).parts)
    )
    frames = [p for p in files if p.suffix.lower() in RAW_SUFFIXES or is_jpeg(p)]
    if not frames:
        kinds = listed(sorted({p.suffix.lower() for p in files})) if files else "no files"
        found = f"no raw or JPEG frames in this folder ({kinds})"
        remedy = "check the path of the card, and set the camera to record raw files"
        raise InputError(folder, found, "a card's folder, such as DCIM", remedy)
    return frames


def read_card(
    files: Sequence[Path], lens_f_number: float, own_clock: bool
) -> tuple[list[CardFrame], list[str]]:
    """Return the frames with their EXIF, and a note on each file that cannot be used.

    lens_f_number: f-number of a lens that writes none to EXIF, 0 for others. own_clock: whether
    times are those that the camera's clock showed, not corrected by EXIF's offset.
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
        when = info.t_camera.replace(tzinfo=UTC)
        when -= timedelta() if own_clock or offset is None else offset
        who = info.model or info.make or "a camera that EXIF does not name"
        # BodySerialNumber (EXIF 2.3) distinguishes two bodies of one model.
        serial = text_of(tags_of(path), 42033)
        frames.append(CardFrame(path, info.exposure, when, offset_s, who, serial))
    return frames, left_out


def without_edited(
    frames: Sequence[CardFrame], size_px: tuple[int, int]
) -> tuple[list[CardFrame], list[str]]:
    """Return the frames as the camera wrote them, and notes on copies and other sizes.

    A copy, edited or not, has the time and exposure of a frame, but a rarer or longer form of name
    (IMG_0003_edit.JPG), or the same name in another folder. size_px : width and
    height of the camera's frames by its profile; if no JPEG has it, the commonest size counts.
    """
    sizes = {f.path: jpeg_size(f.path) for f in frames if is_jpeg(f.path)}
    common = Counter(sizes.values())
    size = size_px if size_px in common else max(common, key=lambda s: common[s], default=size_px)
    other_size = {path for path, its in sizes.items() if its not in (size, (0, 0))}
    full = [frame for frame in frames if frame.path not in other_size]
    counts = Counter(_name_pattern(frame.path) for frame in full)
    rank = {frame.path: (counts[f := _name_pattern(frame.path)], -len(f)) for frame in full}
    alike: dict[tuple[datetime, Exposure], list[CardFrame]] = {}
    for frame in full:
        key = (frame.t_camera.replace(microsecond=0), frame.exposure)
        alike.setdefault(key, []).append(frame)
    edited: set[Path] = set()
    for same in (group for group in alike.values() if len(group) > 1):
        best = max(rank[frame.path] for frame in same)
        usual = [frame for frame in same if rank[frame.path] == best]
        # Two files of one name in two folders: the camera's own folder is below DCIM (DCF 2.0).
        usual.sort(key=lambda f: ("DCIM" not in f.path.parts, len(f.path.parts), f.path))
        first = {frame.path.stem: frame for frame in reversed(usual)}
        edited |= {f.path for f in same if first.get(f.path.stem) is not f}
    what = f"not the size of the camera's frames, {size[0]} x {size[1]}"
    notes = _note(sorted(other_size), what) + _note(sorted(edited), "a copy of another frame")
    return [frame for frame in full if frame.path not in edited], notes


def _name_pattern(path: Path) -> str:
    """Return a file's name without suffix and with # for each digit, such as IMG_####."""
    return re.sub(r"\d", "#", path.stem)


def _note(paths: Sequence[Path], what: str) -> list[str]:
    return [f"{listed(paths, 1)}: {what}"] if paths else []


def of_session_camera(
    frames: Sequence[CardFrame], body: CameraBody
) -> tuple[list[CardFrame], list[str]]:
    """Return the frames of the session's camera in one format, and a note on each other camera.

    body: of the profile. The session's camera is the one that it names, else the one with most
    frames: frames of two cameras never form a bracket. If it has raw and JPEG frames, those of the
    profile's kind are returned, and the other ones are skipped without a note.
    """
    count = Counter((frame.camera, frame.serial) for frame in frames)
    order = {who: (not same_model(who[0], body.model), -count[who]) for who in count}
    ours = min(order, key=order.__getitem__, default=("", ""))
    ending = f"the session's camera is {' '.join(ours).strip()}"
    others = [(" ".join(who).strip(), number) for who, number in count.items() if who != ours]
    notes = [f"{number} frames of {who}: {ending}" for who, number in others]
    mine = [frame for frame in frames if (frame.camera, frame.serial) == ours]
    of_kind = [frame for frame in mine if is_jpeg(frame.path) == (body.kind == "jpeg")]
    return of_kind or mine, notes
