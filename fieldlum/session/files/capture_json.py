"""raw/SLOT/capture.json: the frames of one bracket, and the time of each."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from msgspec import field

from fieldlum.core.records import Exposure, JsonTable, require_known_year
from fieldlum.session.codec import JsonFile, Seconds, Utc, convert, to_json
from fieldlum.session.safe_paths import is_plain


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame of a bracket: its file, exposure, times and sha256.

    index: place in the bracket, from 0; file: its name in the slot's folder; sha256: of the file,
    in hex, "" if unknown; exposure: as planned, or from EXIF if that differs, and then `doubt` is
    set; heading_deg: view direction, clockwise from north, None without a turning head; t_utc: when
    the frame was requested; seconds: from then until the file was on the disk; doubt: what looked
    wrong when the frame was checked; instead_of: file of the doubtful frame that this one replaces.
    """

    index: int
    file: str
    exposure: Exposure
    heading_deg: float | None
    t_utc: Utc
    seconds: Seconds = 0.0
    sha256: str = ""
    doubt: str = ""
    instead_of: str = ""

    def __post_init__(self) -> None:
        """Raise ValueError for a time outside the years of the ephemeris."""
        require_known_year(self.t_utc)


def frame_fields(frame: Frame) -> JsonTable:
    """Return a frame as the JSON object of journal and capture.json, without empty texts."""
    return {key: value for key, value in to_json(frame).items() if value != ""}


def frame_from(fields: Mapping[str, Any]) -> Frame:
    """Return the frame in a JSON object that `frame_fields` returned.

    Raises TypeError or ValueError for other content, such as a file in another folder.
    """
    frame = convert({"heading_deg": None, **fields}, Frame)
    for name in (frame.file, frame.instead_of or frame.file):
        if not is_plain(name):
            raise ValueError(f"the file name {name!r}, which is not a plain name")
    return frame


class CaptureFile(JsonFile, frozen=True):
    """The content of one capture.json.

    slot: id; frames: in order of `index`, as `capture` and `import` write them; t_open_utc: first
    request to the camera; t_close_utc: when the last file was on the disk; complete: whether all
    planned frames were taken; profile: name of the camera profile; heading_deg: of the panorama's
    centre column, clockwise from true north, None if unknown; camera: fields of `CameraInfo` that
    are known; illuminance_lx: mean reading of a meter at the lens, or None.
    """

    EXPECTED = "the frames of a bracket, as capture and import write them"
    REMEDY = "restore the file from a copy, or import the card again (fieldlum import)"

    slot: str
    frames: tuple[Frame, ...]
    t_open_utc: Utc
    t_close_utc: Utc
    complete: bool = True
    profile: str = ""
    heading_deg: float | None = None
    camera: dict[str, Any] = field(default_factory=dict)
    illuminance_lx: float | None = None

    def __post_init__(self) -> None:
        """Raise ValueError for a time outside the years of the ephemeris."""
        require_known_year(self.t_open_utc, self.t_close_utc)

    @property
    def t_mid_utc(self) -> datetime:
        """Middle between `t_open_utc` and `t_close_utc`, which is the time of the panorama."""
        return self.t_open_utc + (self.t_close_utc - self.t_open_utc) / 2

    @classmethod
    def upgraded(cls, table: JsonTable, path: Path) -> JsonTable:
        """Return the JSON object of a file of any version with the keys of the present version.

        Files of earlier versions lack times and slot; the slot is then the name of the folder of
        `path`. Raises ValueError for two frames with the same file.
        """
        rows = enumerate(table.get("frames", ()))
        frames = tuple(frame_from({"index": index, **row}) for index, row in rows)
        if len({frame.file.casefold() for frame in frames}) < len(frames):
            raise ValueError("two frames with the same file name, apart from capitals")
        if "t_open_utc" not in table:
            opened, closed = interval_of(frames)
            table = {**table, "t_open_utc": opened, "t_close_utc": closed}
        return {"slot": path.parent.name, **table, "frames": frames}

    def table(self) -> JsonTable:
        """Return the JSON object by its keys, with the middle of the two times as t_mid_utc."""
        frames = [frame_fields(frame) for frame in self.frames]
        return {**to_json(self), "t_mid_utc": to_json(self.t_mid_utc), "frames": frames}


def interval_of(frames: tuple[Frame, ...]) -> tuple[datetime, datetime]:
    """Return the UTC times of the first request of some frames, and of the last file on the disk.

    Raises ValueError without frames.
    """
    if not frames:
        raise ValueError("no frames and no t_open_utc")
    opened = min(frame.t_utc for frame in frames)
    return opened, max(frame.t_utc + timedelta(seconds=frame.seconds) for frame in frames)
