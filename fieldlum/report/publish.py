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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

import tomli_w
from PIL import Image, UnidentifiedImageError

from fieldlum.core.errors import InputError
from fieldlum.core.records import Flag, Progress, counted, quiet
from fieldlum.optics.images import read_panorama
from fieldlum.session import Session, replacing_path
from fieldlum.version import __version__

# The parts of a session that others can use; everything else (locks, outbox, models of other
# versions, the watch page's files, simulated truth) stays at home.
_FOLDERS = ("raw", "panoramas", "irradiance", "sunpatches", "annual", "scene")
_FILES = ("plan.csv", "journal.jsonl", "pairs.csv", "pairs.alignment.csv", "suns.csv")
_HOME_PATH = re.compile(rb"/home/|/Users/|[A-Z]:[\\]+Users")  # in a text: a person's folder
_LEFT_OUT = re.compile(r"(^|/)\.|\.tmp$|\.torn$|\.sha256$|^outbox")
_HOME_TABLES = ("imported", "logger_files")  # have folders of this computer
_GPS, _OWNER, _SERIAL = 0x8825, 0xA430, 0xA431  # EXIF 2.32: GPS IFD, CameraOwnerName, BodySerial
_EXIF_IFD = 0x8769
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
    files = sorted(_files(session))
    private = [text for path in files if (text := _private_exif(path))]
    if private:
        raise InputError(
            session.root,
            f"{counted(len(private), 'frame')} with private EXIF, such as {private[0]}",
            "frames without position, owner and serial number",
            "remove them in a copy: exiftool -gps:all= -OwnerName= -SerialNumber= -r COPY/raw "
            "(merge it again, because checksums change)",
        )
    notes = _notes(session)
    texts = {
        "session.toml": _session_toml(session, coarse_position),
        "DATASHEET.md": _data_sheet(session, statement, notes, len(files)),
        "CITATION.cff": _citation(statement),
        "datacite.json": json.dumps(_datacite(session, statement), indent=1, ensure_ascii=False),
    }
    digests = {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()}
    with replacing_path(out) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_STORED) as archive:
        for name, text in texts.items():
            archive.writestr(f"{session.root.name}/{name}", text)
        for number, path in enumerate(files):
            progress(number, len(files), "files")
            name = path.relative_to(session.root).as_posix()
            data = path.read_bytes()
            digests[name] = hashlib.sha256(data).hexdigest()
            archive.writestr(f"{session.root.name}/{name}", data)
        manifest = "".join(f"{digest}  {name}\n" for name, digest in sorted(digests.items()))
        archive.writestr(f"{session.root.name}/MANIFEST.sha256", manifest)
    return notes


def _files(session: Session) -> Iterator[Path]:
    for name in (*_FILES, "sky_view.exr"):
        if (path := session.root / name).is_file():
            yield path
    for folder in _FOLDERS:
        for path in (session.root / folder).rglob("*"):
            name = path.relative_to(session.root).as_posix()
            if path.is_file() and not path.is_symlink() and not _LEFT_OUT.search(name):
                yield path


def _private_exif(path: Path) -> str:
    """Return what a frame's EXIF states of its place, owner or camera; "" for nothing."""
    if path.suffix.lower() not in (".jpg", ".jpeg", ".dng", ".tif", ".tiff"):
        return ""
    try:
        with Image.open(path) as picture:
            exif = picture.getexif()
    except (OSError, UnidentifiedImageError):
        return ""
    inner = exif.get_ifd(_EXIF_IFD)
    found = ["a position"] if exif.get_ifd(_GPS) else []
    found += ["an owner's name"] if str(inner.get(_OWNER, "")).strip("\0 ") else []
    found += ["a serial number"] if str(inner.get(_SERIAL, "")).strip("\0 ") else []
    return f"{path.name} ({', '.join(found)})" if found else ""


def _session_toml(session: Session, coarse_position: bool) -> str:
    table: dict[str, Any] = tomllib.loads(session.toml.read_text(encoding="utf-8"))
    table = {name: part for name, part in table.items() if name not in _HOME_TABLES}
    table.get("devices", {}).pop("uris", None)  # addresses
    if coarse_position:
        site = table["setup"]["site"]
        for name in ("latitude_deg", "longitude_deg"):
            site[name] = round(site[name], _POSITION_DIGITS)
    return tomli_w.dumps(table)


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
        family, _, given = (json.dumps(part.strip()) for part in author.partition(","))
        authors += f"  - family-names: {family}\n    given-names: {given}\n"
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
