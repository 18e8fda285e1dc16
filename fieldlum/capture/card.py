"""Read a camera's card: the frames of the session's camera, and notes on other pictures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

from fieldlum.capture.match_card import CardFrame
from fieldlum.errors import InputError
from fieldlum.profiles import CameraBody, load_camera_profile
from fieldlum.raw import RAW_SUFFIXES, is_jpeg, read_exif, same_model
from fieldlum.raw.exif import tags_of
from fieldlum.records import Exposure, Progress, SiteFile, counted, quiet
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
    ignored. Raises InputError if the folder is missing, or has no raw or JPEG file.
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
    files = sorted(p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
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
    return kept, [
        f"{copies[0]}: a copy of another frame"
        + (f", as are {counted(len(copies) - 1, 'more file')}" if len(copies) > 1 else "")
    ] if copies else []


def _likeness(frame: CardFrame) -> tuple[datetime, Exposure, int]:
    return frame.t_camera, frame.exposure, frame.path.stat().st_size


def _body_serial(path: Path) -> str:
    """Return the serial number of the camera body, or "" if EXIF has none.

    It distinguishes two bodies of one model.
    """
    return str(getattr(tags_of(path).get("EXIF BodySerialNumber"), "values", "")).strip("\0 ")


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
