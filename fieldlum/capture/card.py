"""Read a camera's card: the frames of the session's camera, and notes on other pictures."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from fieldlum.capture.match_card import CardFrame
from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure, Progress, SiteFile, counted, quiet
from fieldlum.optics.profiles import CameraBody, load_camera_profile
from fieldlum.optics.raw import RAW_SUFFIXES, is_jpeg, jpeg_size, read_exif, same_model
from fieldlum.optics.raw.exif import tags_of, text_of
from fieldlum.session import sha256

_OTHER_PICTURES = (
    ".mpo",
    ".heic",
    ".heif",
    ".hif",
    ".tif",
    ".tiff",
    ".png",
    ".insp",
    ".gpr",
    ".x3f",
    ".3fr",
    ".iiq",
    ".avif",
)


def card_files(folder: Path) -> tuple[list[Path], list[str]]:
    """Return the raw and JPEG files in a folder and its subfolders, and notes on other pictures.

    There is one note for each kind of picture that cannot be merged, such as .heic; other files are
    ignored, and so are folders that begin with `.` or `@`, in which systems store thumbnails and
    deleted files. Raises InputError if the folder is missing, or has no raw or JPEG file.
    """
    if folder.is_file():
        raise InputError(
            folder,
            "this is a file, not a folder",
            "a card's folder, such as DCIM",
            "import a logger's file with --irradiance",
        )
    if not folder.is_dir():
        raise InputError(
            folder, "no such folder", "a card's folder, such as DCIM", "check the path of the card"
        )
    files = sorted(
        p
        for p in folder.rglob("*")
        if p.is_file() and not any(name[0] in ".@" for name in p.relative_to(folder).parts)
    )
    frames = [p for p in files if p.suffix.lower() in RAW_SUFFIXES or is_jpeg(p)]
    other = Counter(p.suffix.lower() for p in files if p.suffix.lower() in _OTHER_PICTURES)
    notes = [
        f"{folder}: {count} {suffix} files, which cannot be merged"
        for suffix, count in sorted(other.items())
    ]
    if not frames:
        other_text = " and ".join(f"{count} {suffix}" for suffix, count in sorted(other.items()))
        other_text = f", but {other_text} files" if other else ""
        remedy = "set the camera to record raw files" if other else "check the path of the card"
        raise InputError(
            folder,
            f"no raw or JPEG frames in this folder{other_text}",
            "a card's folder, such as DCIM",
            remedy,
        )
    return frames, notes


def read_card(
    files: Sequence[Path], progress: Progress = quiet, *, lens_f_number: float = 0.0
) -> tuple[list[CardFrame], list[str]]:
    """Return the frames with their EXIF, and a note on each file that cannot be used.

    lens_f_number: f-number of a lens that writes none to EXIF.
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
        aware = offset is not None
        when = info.t_camera.astimezone(UTC) if aware else info.t_camera.replace(tzinfo=UTC)
        who = info.model or info.make or "a camera that EXIF does not name"
        frames.append(CardFrame(path, info.exposure, when, offset_s, who, _body_serial(path)))
    return frames, left_out


def without_copies(frames: Sequence[CardFrame]) -> tuple[list[CardFrame], list[str]]:
    """Return the frames without copies of the same file content, and a note if there were copies.

    The first frame of each content remains. A copy would split its bracket in two.
    """
    by_likeness: dict[tuple[datetime, Exposure, int], dict[str, CardFrame]] = {}
    alike = Counter(_likeness(frame) for frame in frames)
    kept: list[CardFrame] = []
    copies: list[Path] = []
    for frame in frames:
        if alike[_likeness(frame)] > 1:
            by_digest = by_likeness.setdefault(_likeness(frame), {})
            if by_digest.setdefault(sha256(frame.path), frame) is not frame:
                copies.append(frame.path)
                continue
        kept.append(frame)
    return kept, _note(copies, "a copy of another frame")


def _likeness(frame: CardFrame) -> tuple[datetime, Exposure, int]:
    return frame.t_camera, frame.exposure, frame.path.stat().st_size


def without_edited(
    frames: Sequence[CardFrame], size_px: tuple[int, int]
) -> tuple[list[CardFrame], list[str]]:
    """Return the frames as the camera wrote them, and notes on edited copies and other sizes.

    An edited copy has the time and exposure of another frame, but another form of name than most
    frames of the card (IMG_0003_edit.JPG), or the same name in another folder. size_px : width and
    height of the camera's frames by its profile; if no JPEG has it, the commonest size counts.
    """
    sizes = {f.path: jpeg_size(f.path) for f in frames if is_jpeg(f.path)}
    common = Counter(sizes.values())
    size = size_px if size_px in common else max(common, key=lambda s: common[s], default=size_px)
    other_size = {path for path, its in sizes.items() if its not in (size, (0, 0))}
    full = [frame for frame in frames if frame.path not in other_size]
    forms = Counter(_form(frame.path) for frame in full)
    alike: dict[tuple[datetime, Exposure], list[CardFrame]] = {}
    for frame in full:
        key = frame.t_camera.replace(microsecond=0), frame.exposure
        alike.setdefault(key, []).append(frame)
    edited: set[Path] = set()
    for same in (group for group in alike.values() if len(group) > 1):
        best = max(forms[_form(frame.path)] for frame in same)
        usual = [frame for frame in same if forms[_form(frame.path)] == best]
        # Two files of one name in two folders: the camera's own folder is below DCIM (DCF 2.0).
        usual.sort(key=lambda f: ("DCIM" not in f.path.parts, len(f.path.parts), f.path))
        first = {frame.path.stem: frame for frame in reversed(usual)}
        edited |= {f.path for f in same if first.get(f.path.stem) is not f}
    notes = [
        *_note(sorted(other_size), f"not the size of the camera's frames, {size[0]} x {size[1]}"),
        *_note(sorted(edited), "an edited copy of another frame"),
    ]
    return [frame for frame in full if frame.path not in edited], notes


def _form(path: Path) -> str:
    """Return a file's name without suffix and with # for each digit, such as IMG_####."""
    return re.sub(r"\d", "#", path.stem)


def _note(paths: Sequence[Path], what: str) -> list[str]:
    if not paths:
        return []
    more = f", as are {counted(len(paths) - 1, 'more file')}" if len(paths) > 1 else ""
    return [f"{paths[0]}: {what}{more}"]


def _body_serial(path: Path) -> str:
    """Return the serial number of the camera body, or "" if EXIF has none.

    It distinguishes two bodies of one model.
    """
    return text_of(tags_of(path), 42033)


def _bodies(frames: Sequence[CardFrame]) -> list[tuple[str, str]]:
    """Return camera model and serial number of each frame.

    If there is only one body of a model, frames without a serial number belong to it.
    """
    serials: dict[str, set[str]] = {}
    for frame in frames:
        serials.setdefault(frame.camera, set()).update({frame.serial} - {""})
    return [
        (
            f.camera,
            f.serial or (next(iter(serials[f.camera])) if len(serials[f.camera]) == 1 else ""),
        )
        for f in frames
    ]


def of_the_session(
    frames: Sequence[CardFrame], setup: SiteFile
) -> tuple[list[CardFrame], list[str]]:
    """Return the frames of the session's camera in one format, and a note on each other camera.

    The session's camera is the one that the profile names, else the one with most frames: frames of
    two cameras never form a bracket. If the camera has raw and JPEG frames, those of the profile's
    kind are returned, and the other ones are skipped without a note.
    """
    body = CameraBody("", "raw", 0, 0)
    # doctor and merge report a missing profile; the frames are imported anyway
    with suppress(InputError):
        body = load_camera_profile(setup.camera.profile).camera
    bodies = _bodies(frames)
    count = Counter(bodies)
    ours = min(
        count, key=lambda who: (not same_model(who[0], body.model), -count[who]), default=("", "")
    )
    notes = [
        f"{number} frames of {' '.join(who).strip()}: the session's camera is "
        f"{' '.join(ours).strip()}"
        for who, number in count.items()
        if who != ours
    ]
    mine = [frame for frame, who in zip(frames, bodies, strict=True) if who == ours]
    jpeg = [frame for frame in mine if is_jpeg(frame.path)]
    raw = [frame for frame in mine if not is_jpeg(frame.path)]
    first, second = (jpeg, raw) if body.kind == "jpeg" else (raw, jpeg)
    return first or second, notes
