"""raw/SLOT/capture.json: the frames of one bracket, and the time of each."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from fieldlum.core.records import Exposure, utc_text
from fieldlum.session.files.json_file import content_of, from_json, read_object, write_object
from fieldlum.session.inside import plain
from fieldlum.session.tables import FrameTable

FORMAT = 1  # of the file; docs/file-formats.md
_EXPECTED = "the frames of a bracket, as capture and import write them"
_REMEDY = "restore the file from a copy, or import the card again (fieldlum import)"


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of a bracket: its file, exposure, times and sha256.

    index: place in the bracket, from 0; file: relative to the slot's folder; exposure: as
    requested, or from EXIF if that differs, and then `doubt` is set; t_utc: time of the request;
    seconds: from the request to the file on the disk; doubt: what looked wrong when the frame was
    checked; instead_of: file of the doubtful frame that this one replaces.
    """

    index: int
    file: str
    exposure: Exposure
    heading_deg: float | None
    t_utc: datetime
    seconds: float = 0.0
    sha256: str = ""
    doubt: str = ""
    instead_of: str = ""


def frame_fields(frame: Frame) -> FrameTable:
    """Return a frame as the journal and capture.json store it."""
    e = frame.exposure
    table: FrameTable = {
        "index": frame.index,
        "file": frame.file,
        "exposure": {"shutter_s": e.shutter_s, "f_number": e.f_number, "iso": e.iso, "nd": e.nd},
        "heading_deg": frame.heading_deg,
        "t_utc": utc_text(frame.t_utc),
        "seconds": round(frame.seconds, 3),
        "sha256": frame.sha256,
    }
    if frame.doubt:
        table["doubt"] = frame.doubt
    if frame.instead_of:
        table["instead_of"] = frame.instead_of
    return table


def frame_from(fields: Mapping[str, Any]) -> Frame:
    """Return the frame of a table that `frame_fields` wrote.

    Raises KeyError, TypeError or ValueError for other content, such as a file in another folder.
    """
    frame = from_json(Frame, fields)
    e = frame.exposure
    if not all(0.0 < value < math.inf for value in (e.shutter_s, e.f_number, e.iso)):
        raise ValueError(f"frame {frame.file}: an exposure that is not above 0 and finite: {e}")
    plain(frame.file)
    if frame.instead_of:
        plain(frame.instead_of)
    return frame


@dataclass(frozen=True, slots=True)
class CaptureFile:
    """The content of one capture.json.

    t_open_utc: first request to the camera; t_close_utc: when the last file was on the disk;
    complete: whether all planned frames were taken; profile: name of the camera profile;
    heading_deg: clockwise from north; camera: what it reports; illuminance_lx: mean reading of a
    meter at the lens, or None.
    """

    slot: str
    frames: tuple[Frame, ...]
    t_open_utc: datetime
    t_close_utc: datetime
    complete: bool = True
    profile: str = ""
    heading_deg: float | None = None
    camera: dict[str, Any] = field(default_factory=dict)
    illuminance_lx: float | None = None

    @property
    def t_mid_utc(self) -> datetime:
        """Middle between `t_open_utc` and `t_close_utc`, which is the time of the panorama."""
        return self.t_open_utc + (self.t_close_utc - self.t_open_utc) / 2

    @classmethod
    def read(cls, path: Path) -> CaptureFile:
        """Read the file. Raises InputError for a missing file or other content."""
        table = read_object(path, _EXPECTED, _REMEDY)
        with content_of(table, FORMAT, path, _EXPECTED, _REMEDY):
            rows = [{"index": number, **row} for number, row in enumerate(table.get("frames", ()))]
            frames = tuple(frame_from(row) for row in rows)
            if "t_open_utc" not in table:
                opened, closed = interval_of(frames)
                table |= {"t_open_utc": utc_text(opened), "t_close_utc": utc_text(closed)}
            capture = from_json(cls, {"slot": path.parent.name, **table, "frames": ()})
            return replace(capture, frames=frames)

    @classmethod
    def find(cls, path: Path) -> CaptureFile | None:
        """Read the file; return None if it is missing. Raises InputError for other content."""
        return cls.read(path) if path.is_file() else None

    def write(self, path: Path) -> None:
        """Write the file, with the middle of the two times as t_mid_utc."""
        lux = {} if self.illuminance_lx is None else {"illuminance_lx": self.illuminance_lx}
        table = {
            "format": FORMAT,
            "slot": self.slot,
            "t_open_utc": utc_text(self.t_open_utc),
            "t_close_utc": utc_text(self.t_close_utc),
            "t_mid_utc": utc_text(self.t_mid_utc),
            "complete": self.complete,
            "profile": self.profile,
            "heading_deg": self.heading_deg,
            "camera": self.camera,
            **lux,
            "frames": [frame_fields(frame) for frame in self.frames],
        }
        write_object(path, table)


def interval_of(frames: tuple[Frame, ...]) -> tuple[datetime, datetime]:
    """Return the earliest request and the latest end (request plus duration) of some frames [UTC].

    Raises ValueError without frames.
    """
    if not frames:
        raise ValueError("no frames and no t_open_utc")
    opened = min(frame.t_utc for frame in frames)
    return opened, max(frame.t_utc + timedelta(seconds=frame.seconds) for frame in frames)
