"""Pack a session for publication: checked, without what must not travel, with metadata.

The archive is a zip with the session's files, DATASHEET.md (Gebru et al., Commun. ACM 64, 2021, in
short), CITATION.cff, datacite.json (DataCite Metadata Schema 4.5) and MANIFEST.sha256.
"""

from __future__ import annotations

import hashlib
import json
import re
import tomllib
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import tomli_w

from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, Progress, counted, quiet
from fieldlum.optics.images import read_panorama
from fieldlum.optics.raw import RAW_SUFFIXES
from fieldlum.optics.raw.exif import tags_of, text_of
from fieldlum.session import Session, replacing_path
from fieldlum.version import __version__

# The parts of a session that others can use; everything else (locks, outbox, models of other
# versions, the watch page's files, simulated truth) stays at home.
_FOLDERS = ("raw", "panoramas", "irradiance", "sunpatches", "annual", "scene")
_FILES = ("plan.csv", "journal.jsonl", "pairs.csv", "pairs.alignment.csv", "suns.csv")
_HOME_PATH = re.compile(rb"/home/|/Users/|[A-Z]:[\\]+Users")  # in a text: a person's folder
_LEFT_OUT = re.compile(r"(^|/)\.|\.tmp$|\.torn$|\.sha256$|^outbox")
_HOME_TABLES = ("imported", "logger_files")  # have folders of this computer
_JPEG = (".jpg", ".jpeg")
_FRAMES = (*_JPEG, ".tif", ".tiff", ".png", ".heic", *RAW_SUFFIXES)
# EXIF 2.32: GPS IFD and its version, which cameras write without a position; CameraOwnerName and
# Artist; BodySerialNumber, LensSerialNumber, and CameraSerialNumber of DNG 1.4
_GPS, _GPS_VERSION, _OWNER, _SERIAL = 0x8825, 0, (0xA430, 0x013B), (0xA431, 0xA435, 0xC62F)
_PLACE = re.compile(r'(l(?:at|ong)itude_deg"?\s*[:=]\s*)(-?[\d.]+(?:[eE][-+]?\d+)?)')
_MOVED_SHARE = 0.02  # of the view: something as large as a person 3 m away moved; chosen
_POSITION_DIGITS = 2  # decimals of a coarse position: 1.1 km, 0.01 degrees of the sun


@dataclass(frozen=True, slots=True)
class Statement:
    """What only its authors know of a data set.

    title; authors: "Family, Given" each; licence: SPDX identifier, such as CC-BY-4.0; people: who
    can be seen, and how they consented.
    """

    title: str
    authors: tuple[str, ...]
    licence: str
    people: str


def pack(
    session: Session,
    out: Path,
    statement: Statement,
    *,
    coarse_position: bool = False,
    progress: Progress = quiet,
) -> list[str]:
    """Write the archive `out` (.zip) and return notes for its authors.

    coarse_position: round latitude and longitude to 0.01 degrees, about a kilometre. Raises
    InputError for frames whose EXIF has a position, an owner's name or a serial number.
    """
    _check_place(session, out)
    if not session.captured_folders() and not session.panorama_files():
        raise InputError(session.root, "no captures", "data to publish", "pack it when it has some")
    files = sorted(_files(session))
    stated = [(path, _private_exif(path)) for path in files]
    private = [text for _, text in stated if text]
    if private:
        raise InputError(
            session.root,
            f"{counted(len(private), 'frame')} with private EXIF, such as {private[0]}",
            "frames without position, owner and serial number",
            "remove them in a copy: exiftool -gps:all= -OwnerName= -Artist= -SerialNumber= "
            "-LensSerialNumber= -CameraSerialNumber= -r COPY/raw "
            "(merge it again, because checksums change)",
        )
    notes = _notes(session)
    if unread := [path.name for path, text in stated if text is None]:
        found = counted(len(unread), "frame")
        notes.insert(0, f"EXIF of {found} such as {unread[0]} cannot be read: look with exiftool")
    if coarse_position:
        notes.insert(0, "times and positions of the sun in the tables still give the exact place")
    texts = {
        "session.toml": _session_toml(session, coarse_position),
        "DATASHEET.md": _data_sheet(session, statement, notes, len(files)),
        "CITATION.cff": _citation(statement),
        "datacite.json": json.dumps(_datacite(session, statement), indent=1, ensure_ascii=False),
    }
    digests = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
    top = session.root.resolve().name  # of ".", too
    with replacing_path(out) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_STORED) as archive:
        for name, text in texts.items():
            archive.writestr(f"{top}/{name}", text)
        for number, path in enumerate(files):
            progress(number, len(files), "files")
            name = path.relative_to(session.root).as_posix()
            data = path.read_bytes()
            if coarse_position and path.suffix in (".json", ".toml"):
                data = _coarse(data.decode("utf-8", "surrogateescape")).encode(
                    "utf-8", "surrogateescape"
                )
            digests[name] = hashlib.sha256(data).hexdigest()
            archive.writestr(f"{top}/{name}", data)
        manifest = "".join(f"{digest}  {name}\n" for name, digest in sorted(digests.items()))
        archive.writestr(f"{top}/MANIFEST.sha256", manifest)
    return notes


def _check_place(session: Session, out: Path) -> None:
    """Raise InputError for an archive that exists, or that the next archive would contain."""
    if out.exists():
        raise InputError(out, "it exists", "a new file", "remove it, or choose another name")
    folders = {(session.root / name).resolve() for name in _FOLDERS}
    if folders & set(out.resolve().parents):
        raise InputError(
            out, "a place in the packed folders", "another folder", "write it next to the session"
        )


def _files(session: Session) -> Iterator[Path]:
    for name in (*_FILES, "sky_view.exr"):
        if (path := session.root / name).is_file():
            yield path
    for folder in _FOLDERS:
        for path in (session.root / folder).rglob("*"):
            name = path.relative_to(session.root).as_posix()
            if path.is_file() and not path.is_symlink() and not _LEFT_OUT.search(name):
                yield path


def _private_exif(path: Path) -> str | None:
    """Return what a frame's EXIF states of its place, owner or camera; "" for nothing.

    None: the EXIF cannot be read.
    """
    if path.suffix.lower() not in _FRAMES:
        return ""
    try:
        tags = tags_of(path)
    except InputError:
        return None
    if not tags and path.suffix.lower() not in _JPEG:
        return None
    found = ["a position"] if _is_place(tags.get(_GPS)) else []
    found += ["an owner's name"] if any(text_of(tags, tag) for tag in _OWNER) else []
    found += ["a serial number"] if any(text_of(tags, tag) for tag in _SERIAL) else []
    return f"{path.name} ({', '.join(found)})" if found else ""


def _is_place(gps: Mapping[int, Any] | int | None) -> bool:
    """Return whether a GPS directory (a number: one that cannot be read) may have a position."""
    return bool(set(gps) - {_GPS_VERSION}) if isinstance(gps, Mapping) else gps is not None


def _session_toml(session: Session, coarse_position: bool) -> str:
    table: dict[str, Any] = tomllib.loads(session.toml.read_text(encoding="utf-8"))
    table = {name: part for name, part in table.items() if name not in _HOME_TABLES}
    table.get("devices", {}).pop("uris", None)  # addresses
    text = tomli_w.dumps(table)
    return _coarse(text) if coarse_position else text


def _coarse(text: str) -> str:
    """Return a TOML or JSON text with rounded latitudes and longitudes."""
    return _PLACE.sub(lambda m: f"{m[1]}{round(float(m[2]), _POSITION_DIGITS)}", text)


def _notes(session: Session) -> list[str]:
    """Return what the authors should look at before they publish."""
    moved = []
    for path in session.panorama_files():
        flags = read_panorama(path).flags
        if flags is not None and float(((flags & Flag.MOTION) > 0).mean()) > _MOVED_SHARE:
            moved.append(path.stem)
    notes = []
    if moved:
        listed = ", ".join(moved[:5]) + (" ..." if len(moved) > 5 else "")
        notes.append(f"something moved, perhaps people: look at the frames of {listed}")
    named = [n for n in _FILES if _HOME_PATH.search(_content(session.root / n))]
    if named:
        notes.append(f"folders of this computer are named in {', '.join(named)}")
    return [*notes, "look at every contact sheet for people, screens and papers before you publish"]


def _content(path: Path) -> bytes:
    return path.read_bytes() if path.is_file() else b""


def _span(session: Session) -> tuple[str, str]:
    times = [path.stem for path in session.panorama_files()]
    days = [f"{t[:4]}-{t[4:6]}-{t[6:8]}" for t in times] or [date.today().isoformat()]  # noqa: DTZ011
    return days[0], days[-1]


def _data_sheet(session: Session, s: Statement, notes: Sequence[str], count: int) -> str:
    setup, (first, last) = session.site_file(), _span(session)
    captured, merged = len(session.captured_folders()), len(session.panorama_files())
    return f"""# {s.title}

- **Who**: {"; ".join(s.authors)}. Licence: {s.licence}.
- **What**: luminance captures of {setup.site.name}: {captured} brackets, {merged} merged maps in
  cd/m2 with uncertainty and flags, irradiance in W/m2; {count} files.
- **When**: {first} to {last}, UTC. **Where**: latitude and longitude in session.toml.
- **How**: camera profile "{setup.camera.profile or "none stated"}", heading
  {setup.camera.heading_deg:g} degrees from true north; merged and paired by fieldlum {__version__}.
- **People**: {s.people}
- **Files**: docs/file-formats.md of fieldlum; MANIFEST.sha256 has the checksum of each file.
- **Left out**: device addresses, messages, locks, models, simulated truth.
- **To check before publication**: {"; ".join(notes)}.
- **Uses**: daylight and glare research. Not suited to identify people or to judge other rooms.
"""


def _citation(s: Statement) -> str:
    authors = ""
    for author in s.authors:
        family, _, given = (part.strip() for part in author.partition(","))
        if given:
            names = f"family-names: {json.dumps(family)}\n    given-names: {json.dumps(given)}"
        else:
            names = f"name: {json.dumps(family)}"
        authors += f"  - {names}\n"
    return (
        "cff-version: 1.2.0\nmessage: Please cite this data set.\ntype: dataset\n"
        f"title: {json.dumps(s.title)}\nlicense: {s.licence}\nauthors:\n{authors}"
    )


def _datacite(session: Session, s: Statement) -> dict[str, Any]:
    first, last = _span(session)
    return {
        "schemaVersion": "http://datacite.org/schema/kernel-4",
        "titles": [{"title": s.title}],
        "creators": [{"name": author} for author in s.authors],
        "publisher": {"name": ""},
        "publicationYear": last[:4],
        "types": {"resourceTypeGeneral": "Dataset", "resourceType": "luminance maps"},
        "subjects": [{"subject": word} for word in ("daylight", "glare", "HDR photography")],
        "dates": [{"date": f"{first}/{last}", "dateType": "Collected"}],
        "rightsList": [{"rightsIdentifier": s.licence, "rightsIdentifierScheme": "SPDX"}],
    }
