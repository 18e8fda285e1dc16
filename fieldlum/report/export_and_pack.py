"""Write a session for others: files of other programs, and an archive for publication.

`export` writes Radiance, netCDF and csv. The archive of `pack` is a zip with the
session's files, DATASHEET.md (Gebru et al., Commun. ACM 64, 2021, in short), datacite.json
(DataCite Metadata Schema 4.5) and MANIFEST.sha256.
"""

import hashlib
import json
import re
import warnings
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import tomli_w
import xarray as xr

from fieldlum.core import false_colour, strict_toml
from fieldlum.core.errors import Caution, InputError, NotEnoughDataError
from fieldlum.core.files import read_bytes
from fieldlum.core.progress import progress
from fieldlum.core.records import Flag, Room, counted, listed
from fieldlum.optics import images, profiles, raw
from fieldlum.optics.projection import NOT_SEEN, direction, seen_shares, seen_words
from fieldlum.optics.raw.exif import tags_of, text_of
from fieldlum.room.fit.scene_file import SCENE_TOML, read_scene
from fieldlum.room.scene import box_room, radiance
from fieldlum.session import Session, codec, panorama_sun, replacing_path, write_file
from fieldlum.session.files.pairs_csv import PairsFile
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.version import __version__
from fieldlum.year.glare.picture_glare import valid_pixels
from fieldlum.year.glare.pictures import FISHEYE_VIEW, panorama_to_fisheye, picture_centres
from fieldlum.year.predict import newest_annual, outdated_text, read_annual
from fieldlum.year.predict.annual import time_coordinate, unit_of

_FISHEYE_PX = 800  # evalglare's documentation recommends at least this for -vta pictures
_Y_AXIS = "# y points to azimuth"  # the first words of a room.rad of `export`
_PAIR_COLUMNS = ("dni_wm2", "dhi_wm2", "sun_altitude_deg", "sun_azimuth_deg")


def export(session: Session, out: Path, azimuths_deg: Sequence[float] = ()) -> list[Path]:
    """Write everything that a session has into the folder `out`, and return the files.

    maps/SLOT-AZ.hdr: Radiance fisheyes with VIEW and the sun, facing `azimuths_deg` (clockwise from
    true north; the camera's heading if empty). sky_view.csv: by altitude_deg and azimuth_deg,
    beam_share: the share of the sun's beam that arrives from there, with its 95 % bounds low and
    high, empty where it is unknown (not seen, or never sunny); sky_view_mask.png: the same as a
    fisheye. room.rad: the fitted room, else the stated one, in room axes.
    pairs.nc: usable rows of pairs.csv; year.nc: the newest predicted year; both netCDF 3 with
    units. Earlier files of these names are replaced. Raises InputError for a damaged file, and for
    a room.rad in `out` that export did not write; NotEnoughDataError without a
    merged map and a predicted year.
    """
    panoramas = session.panorama_files()
    if not panoramas and not session.annual_folders():
        raise NotEnoughDataError(f"{session.root}: no merged map and no year; run fieldlum merge")
    (out / "maps").mkdir(parents=True, exist_ok=True)
    not_written: set[float] = set()
    files = [*_sky(session, out), *_room(session, out), *_pairs(session, out)]
    if (annual := newest_annual(session)) is not None:
        files.append(_netcdf(annual.to_xarray(), out / "year.nc"))
    for number, path in enumerate(panoramas):
        progress(number, len(panoramas), "maps")
        panorama = panorama_sun.read_panorama_with_sun(path)
        light, _ = valid_pixels(panorama, path)
        asked_deg = azimuths_deg or (panorama.heading_deg,)
        for azimuth_deg in dict.fromkeys(round(a % 360.0, 1) % 360.0 for a in asked_deg):
            turn_deg = (panorama.heading_deg, azimuth_deg)  # from the map's heading to the view
            shares = seen_shares(panorama.seen, panorama.heading_deg, [azimuth_deg])
            if NOT_SEEN in seen_words(shares):
                not_written.add(azimuth_deg)
                continue
            picture = panorama_to_fisheye(light, *turn_deg, size=_FISHEYE_PX, sun=panorama.sun)
            unseen = panorama_to_fisheye(1.0 * ~panorama.seen, *turn_deg, size=_FISHEYE_PX)
            forward = " ".join(f"{value:.6f}" for value in direction(0.0, azimuth_deg))
            view = f"{FISHEYE_VIEW} -vp 0 0 0 -vd {forward} -vu 0 0 1"
            files.append(out / "maps" / f"{path.stem}-{azimuth_deg:g}.hdr")
            with replacing_path(files[-1]) as temporary:
                about = {"view": view, "seen": unseen < 0.5, "clipped": panorama.clipped_count}
                images.write_radiance_hdr(temporary, picture, **about)
    if not_written:
        listed_deg = listed([f"{azimuth_deg:g}" for azimuth_deg in sorted(not_written)])
        text = f"no maps to {listed_deg} degrees: the lens saw less than half of these views"
        warnings.warn(text, Caution, stacklevel=2)
    return files


def _sky(session: Session, out: Path) -> list[Path]:
    """Write sky_view.csv and sky_view_mask.png; return the files, none without a sky view.

    The csv has a row for each degree of azimuth and of altitude, 0 to 90. The picture is an
    equidistant fisheye that looks to the zenith, north up and east left as in pictures of the sky:
    white where the beam arrives, black where it does not, grey where that is unknown: no lens saw
    the direction, or the sun is never there. out: the folder.
    """
    view = SkyView.find(session.root / "sky_view.exr")
    if view is None:
        return []
    altitude, azimuth = (part.ravel() for part in np.mgrid[0:91, 0:360].astype(float))
    shares = view.beam_shares(direction(altitude, azimuth))  # beam_share, low, high
    table, picture = out / "sky_view.csv", out / "sky_view_mask.png"
    names = ("altitude_deg", "azimuth_deg", "beam_share", "low", "high")
    rows = zip(altitude, azimuth, *shares, strict=True)
    codec.write_csv(table, (dict(zip(names, row, strict=True)) for row in rows), names, digits=4)
    # pixels from the middle, 1 at the horizon
    y, x = 2.0 * np.array(np.broadcast_arrays(*picture_centres(_FISHEYE_PX, _FISHEYE_PX)))
    radius = np.hypot(x, y)
    rays = direction(90.0 * (1.0 - radius), np.degrees(np.arctan2(-x, y)))
    share = view.beam_shares(rays)[0]
    grey = np.where(np.isnan(share), 128.0, 255.0 * share) * (radius <= 1.0)
    write_file(picture, false_colour.png_of(np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)))
    return [table, picture]


def _room(session: Session, out: Path) -> list[Path]:
    """Write room.rad for Radiance; return the file.

    The fitted room is written if it was chosen, else the stated one; without a box room nothing is.
    Raises InputError if the file exists and was not written by export.
    """
    scene = session.root / "scene"
    room: Room | None = session.site_file().room
    if (scene / SCENE_TOML).is_file():
        fitted = read_scene(scene)
        room = fitted.room if fitted.chosen == "fitted" else room
    if room is None or room.kind != "box":
        return []
    file = out / "room.rad"
    if file.is_file() and not read_bytes(file).startswith(_Y_AXIS.encode()):
        found = "a file that export did not write"
        raise InputError(file, found, "another folder", "choose another --out")
    north = f"{_Y_AXIS} {(room.wall_azimuth_deg + 180) % 360:g} deg from true north\n"
    write_file(file, north + radiance.rad_text(box_room.build(room)))
    return [file]


def _pairs(session: Session, out: Path) -> list[Path]:
    """Write the usable rows of pairs.csv as pairs.nc; return the file, none without rows."""
    rows = PairsFile.find(session.pairs).usable
    if not rows:
        return []
    columns = {
        name: ("time", [getattr(row, name) for row in rows], {"units": unit_of(name)})
        for name in _PAIR_COLUMNS
    }
    columns["panorama"] = ("time", [row.panorama for row in rows], {})
    coordinates = {"time": time_coordinate([row.t_utc for row in rows])}
    return [_netcdf(xr.Dataset(columns, coordinates), out / "pairs.nc")]


def _netcdf(data: xr.Dataset, path: Path) -> Path:
    """Write a dataset as netCDF 3; return its path."""
    with replacing_path(path) as temporary:
        # netCDF 3 has no integers above 32 bits, which are 68 years of seconds
        encoding = {"time": {"dtype": "float64"}}
        data.to_netcdf(temporary, engine="scipy", format="NETCDF3_64BIT", encoding=encoding)
    return path


# ----------------------------------------------------------------------------------------------
# archive

# The parts of a session that others can use. Everything else is not packed: locks, outbox, models,
# the watch page's files, simulated truth.
_FOLDERS = ("raw", "panoramas", "irradiance", "sunpatches", "annual", "scene")
_FILES = ("plan.csv", "journal.jsonl", "pairs.csv", "pairs.alignment.csv", "suns.csv")
_PERSONAL_PATH = re.compile(rb"/home/|/Users/|[A-Z]:[\\]+Users")
_LEFT_OUT = re.compile(r"(^|/)\.|\.(tmp|torn|sha256|zip)$|^outbox")
_SERIAL_KEY = re.compile(r'^serial = "[^"]', re.MULTILINE)
_LOCAL_TABLES = ("imported", "logger_files")  # of session.toml; they name folders of this computer
_JPEG = (".jpg", ".jpeg")
_FRAMES = (*_JPEG, ".tif", ".tiff", ".png", ".heic", *raw.RAW_SUFFIXES)
# Tags of EXIF 2.32: GPS IFD, and its version, which cameras write without a position;
# CameraOwnerName and Artist; BodySerialNumber, LensSerialNumber, and CameraSerialNumber of DNG 1.4.
_GPS, _GPS_VERSION, _OWNER, _SERIAL = 0x8825, 0, (0xA430, 0x013B), (0xA431, 0xA435, 0xC62F)


class Statement(NamedTuple):
    """What only the authors of a data set can state about it.

    title: of the data set; authors: "Family, Given" each; licence: SPDX identifier, such as
    CC-BY-4.0; publisher: who gives the DOI, such as Zenodo; people: a sentence on who can be seen,
    and how they consented.
    """

    title: str
    authors: tuple[str, ...]
    licence: str
    publisher: str
    people: str


def pack(session: Session, out: Path, statement: Statement) -> list[str]:
    """Write the archive `out` (.zip) and return notes for its authors, one sentence each.

    It has raw frames, panoramas, tables, predicted years, a data sheet with the notes, and
    checksums; models, links and folders of this computer in session.toml are left out. Warns of a
    file that was changed after it was written. Raises InputError if `out` exists or is no .zip, for
    frames whose EXIF has a position, an owner's name or a serial number, and for a damaged file;
    NotEnoughDataError for a session without captures.
    """
    if out.suffix.lower() != ".zip":
        raise InputError(out, f"the suffix '{out.suffix}'", "a .zip", "correct the name")
    if out.exists():
        raise InputError(out, "it exists", "a new file", "remove it, or choose another name")
    if not session.captured_folders() and not session.panorama_files():
        raise NotEnoughDataError(f"{session.root}: no captures; pack it when it has some")
    files = sorted(_files(session))
    exif = [(path, _private_exif(path)) for path in files]
    if private := [text for _, text in exif if text]:
        found = f"{counted(len(private), 'frame')} with private EXIF, such as {private[0]}"
        remedy = (
            "remove them in a copy: exiftool -gps:all= -OwnerName= -Artist= -SerialNumber= "
            "-LensSerialNumber= -CameraSerialNumber= -r COPY/raw (merge it again)"
        )
        raise InputError(session.root, found, "frames without position, owner, serial", remedy)
    profile, setup = _own_profile(session), _session_toml(session)
    notes = _notes(session, setup)
    if unread := [p.name for p, text in exif if text is None and not p.match("contact-*.png")]:
        found = counted(len(unread), "frame")
        notes.insert(0, f"EXIF of {found} such as {unread[0]} cannot be read: look with exiftool")
    texts = {
        "session.toml": setup,
        "DATASHEET.md": _data_sheet(session, statement, notes, len(files)),
        "datacite.json": json.dumps(_datacite(session, statement), indent=1, ensure_ascii=False),
    }
    top, digests = session.root.resolve().name, []  # resolved, because "." has no name
    with replacing_path(out) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_STORED) as archive:

        def add(name: str, data: bytes) -> None:
            """Add a file to the archive, and its checksum to the manifest.

            name: path of the file, relative to the session's folder; data: its content.
            """
            digests.append((name, hashlib.sha256(data).hexdigest()))
            archive.writestr(f"{top}/{name}", data)

        for name, text in texts.items():
            add(name, text.encode())
        for number, path in enumerate(files):
            progress(number, len(files), "files")
            codec.warn_if_changed(path)  # the archive has no checksum files, but its own manifest
            add(path.relative_to(session.root).as_posix(), read_bytes(path))
        if profile is not None and profile.is_file():
            add(_packed_profile(profile), read_bytes(profile))
        manifest = "".join(f"{digest}  {name}\n" for name, digest in sorted(digests))
        archive.writestr(f"{top}/MANIFEST.sha256", manifest)
    return notes


def _files(session: Session) -> Iterator[Path]:
    """Yield the files of a session that are packed as they are; links are not."""
    files = [session.root / name for name in (*_FILES, "sky_view.exr")]
    files += [path for folder in _FOLDERS for path in (session.root / folder).rglob("*")]
    for path in files:
        name = path.relative_to(session.root).as_posix()
        if path.is_file() and not path.is_symlink() and not _LEFT_OUT.search(name):
            yield path


def _private_exif(path: Path) -> str | None:
    """Return a text on the private facts in a frame's EXIF: position, owner, serial number.

    The result is "" if there are none, or if the file is no frame; None if the EXIF cannot be read.
    """
    if path.suffix.lower() not in _FRAMES:
        return ""
    try:
        tags = tags_of(path)
    except InputError:
        return None
    if not tags and path.suffix.lower() not in _JPEG:
        return None
    gps = tags.get(_GPS)  # a directory; or a number, if the directory cannot be read
    has_place = set(gps) - {_GPS_VERSION} if isinstance(gps, Mapping) else gps is not None
    found = ["a position"] if has_place else []
    found += ["an owner's name"] if any(text_of(tags, tag) for tag in _OWNER) else []
    found += ["a serial number"] if any(text_of(tags, tag) for tag in _SERIAL) else []
    return f"{path.name} ({', '.join(found)})" if found else ""


def _own_profile(session: Session) -> Path | None:
    """Return the file of the session's camera profile, which may be missing; None if shipped."""
    name = session.site_file().camera.profile
    with suppress(InputError):
        path = profiles.find_camera_profile(name)
        return None if path.parent == profiles.shipped("calibration") else path
    return Path(name)


def _packed_profile(profile: Path) -> str:
    """Return where an archive has a camera profile of one's own, relative to its session."""
    return f"calibration/{profile.name}"


def _session_toml(session: Session) -> str:
    """Return session.toml without folders of this computer and addresses of devices."""
    stored = strict_toml.read_toml(session.toml)
    table = {name: part for name, part in stored.items() if name not in _LOCAL_TABLES}
    table.get("devices", {}).pop("uris", None)
    if (profile := _own_profile(session)) is not None:
        table["setup"]["camera"]["profile"] = _packed_profile(profile)
    return tomli_w.dumps(table)


def _notes(session: Session, setup: str) -> list[str]:
    """Return what the authors should check before they publish, one sentence each.

    setup: session.toml as it is packed.
    """
    notes, moved = [], []
    for path in session.panorama_files():
        flags = images.read_panorama(path).flags
        # a person 3 m away covers 2 % of the view
        if flags is not None and float(((flags & Flag.MOTION) > 0).mean()) > 0.02:
            moved.append(path.stem)
    if moved:
        notes.append(f"something moved, perhaps people: look at the frames of {listed(moved)}")
    files = [session.root / name for name in _FILES if (session.root / name).is_file()]
    texts = {"session.toml": setup.encode(), **{path.name: read_bytes(path) for path in files}}
    if named := [name for name, text in texts.items() if _PERSONAL_PATH.search(text)]:
        notes.append(f"folders of this computer are named in {', '.join(named)}")
    if (profile := _own_profile(session)) is not None and not profile.is_file():
        notes.append(f"the camera profile {profile.name} is not found, and so is not packed")
    if _SERIAL_KEY.search(setup):
        notes.append("session.toml and raw/SLOT/capture.json have serial numbers of the devices")
    place = "latitude and longitude in session.toml, and the suns in the tables, give the place"
    people = "look at every contact sheet for people, screens and papers before you publish"
    years = map(read_annual, session.annual_folders())
    return [*notes, *filter(None, (outdated_text(session, year) for year in years)), place, people]


def _span(session: Session) -> tuple[str, str]:
    """Return the days of the first and of the last panorama, in UTC; without any, today."""
    slots = [path.stem for path in session.panorama_files()]  # such as 20270320T193000Z
    days = [f"{s[:4]}-{s[4:6]}-{s[6:8]}" for s in slots] or [date.today().isoformat()]  # noqa: DTZ011
    return days[0], days[-1]


def _data_sheet(session: Session, s: Statement, notes: Sequence[str], count: int) -> str:
    """Return DATASHEET.md of an archive.

    s: the authors' statement; notes: what to check before publication; count: number of files.
    """
    setup, (first, last) = session.site_file(), _span(session)
    captured, merged = len(session.captured_folders()), len(session.panorama_files())
    return f"""# {s.title}

- **Who**: {"; ".join(s.authors)}. Licence: {s.licence}. Published by: {s.publisher}.
- **What**: luminance of {setup.site.name}: {counted(captured, "bracket")}, {counted(merged, "map")}
  in cd/m2 with uncertainty and flags, irradiance in W/m2; {counted(count, "file")}.
- **When**: {first} to {last}, UTC. **Where**: latitude and longitude in session.toml.
- **How**: camera profile "{Path(setup.camera.profile).name or "none stated"}", heading
  {setup.camera.heading_deg:g} degrees from true north; merged and paired by fieldlum {__version__}.
- **People**: {s.people}
- **Files**: docs/file-formats.md of fieldlum; MANIFEST.sha256 has the checksum of each file.
- **Left out**: device addresses, messages, locks, models, simulated truth.
- **To check before publication**: {"; ".join(notes)}.
- **Uses**: daylight and glare research. Not suited to identify people or to judge other rooms.
"""


def _datacite(session: Session, s: Statement) -> dict[str, Any]:
    """Return the metadata of an archive by DataCite's schema; s: the authors' statement."""
    first, last = _span(session)
    return {
        "schemaVersion": "http://datacite.org/schema/kernel-4",
        "titles": [{"title": s.title}],
        "creators": [{"name": author} for author in s.authors],
        "publisher": {"name": s.publisher},
        "publicationYear": str(date.today().year),  # noqa: DTZ011
        "types": {"resourceTypeGeneral": "Dataset", "resourceType": "luminance maps"},
        "subjects": [{"subject": word} for word in ("daylight", "glare", "HDR photography")],
        "dates": [{"date": f"{first}/{last}", "dateType": "Collected"}],
        "rightsList": [{"rightsIdentifier": s.licence, "rightsIdentifierScheme": "SPDX"}],
    }
