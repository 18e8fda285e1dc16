"""Read exposure, time and camera of a frame: from its EXIF, and from exposures.csv without it."""

import mmap
import re
import shutil
import subprocess
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.files import open_to_read
from fieldlum.core.records import Exposure
from fieldlum.core.strict_csv import read_number, read_table
from fieldlum.optics.exposure import SAME_SETTING_EV

EXPOSURES_CSV = "exposures.csv"
COLUMNS = ("file", "shutter_s", "f_number", "iso")
_NO_EXPOSURE = (0.0, 0.0, 0.0)  # shutter time, f-number, ISO
# Roll of the camera by EXIF Orientation (EXIF 2.32). Mirrored orientations are written by no
# camera.
_ROLL_DEG = {1: 0.0, 3: 180.0, 6: 90.0, 8: -90.0}
# PhotographicSensitivity, then the tags that count where it is 0, missing, or 65535, the largest
# value of its 16 bits: recommended exposure index, standard output sensitivity, ISO speed (EXIF
# 2.32, 4.6.5; of the last three a file has those that its SensitivityType names, in this order).
_ISO, *_OTHER_ISO = 34855, 34866, 34865, 34867
_NO_ISO = 65535.0
# Time, fraction of a second, offset from UTC: of the exposure, its digitisation, the file.
_TIME_TAGS = ((36867, 37521, 36881), (36868, 37522, 36882), (306, 37520, 36880))
# Year, month, day by : / - or . as cameras and editors write them, then the time of day.
_TIME = re.compile(
    r"(\d{4})([:/.-])(\d{1,2})\2(\d{1,2})[ T]+(\d{1,2}):(\d{2}):(\d{2})(?:[.,](\d+))?"
    r"\s*(Z|[+-]\d{2}:?\d{2})?"
)
_UTC_OFFSET = re.compile(r"Z|[+-](?:0\d|1[0-4]):?[0-5]\d")  # civil time is within 14 h of UTC
# Programs that read makers' notes, with arguments, and the lines of both that count.
_READERS = (("exiftool", "-ExposureTime", "-FNumber", "-ISO"), ("exiv2",))
_READ = tuple(
    re.compile(rf"^(?:{name})\s*: F?(\d[\d.]*)(?:/(\d+))?", re.IGNORECASE | re.MULTILINE)
    for name in ("exposure time", "f number|aperture", "iso|iso speed")
)
# First bytes of Panasonic (RW2) and Olympus (ORF) files, and those of a TIFF with the same content.
TIFF_VARIANTS = {b"IIU\0": b"II*\0", b"IIRO": b"II*\0", b"IIRS": b"II*\0", b"MMOR": b"MM\0*"}

Tags = Mapping[int, Any]
"""Values of EXIF tags by number, as Pillow reads them."""


# Parts of an exposure: name, tag of exiftool with an example, possible values (chosen), unit.
_QUANTITIES = (
    ("exposure time", "ExposureTime=1/250", 1e-7, 1e5, " s"),
    ("f-number", "FNumber=5.6", 0.3, 1e3, ""),
    ("ISO", "ISO=100", 1.0, 1e7, ""),
)


@dataclass(frozen=True, slots=True)
class FrameInfo:
    """What the EXIF of a frame states.

    exposure: shutter time, f-number, ISO, and `nd`, the name of a filter, from an ImageDescription
    ``ND=name``, which fieldlum and exiftool write and cameras do not. t_camera: time of the frame
    by the camera's own clock, naive unless the file states its offset from UTC
    (OffsetTimeOriginal), None if the file has no valid time. make, model: of the camera, "" if not
    recorded.
    """

    exposure: Exposure
    t_camera: datetime | None = None
    make: str = ""
    model: str = ""


# ----------------------------------------------------------------------------------------------
# exposures that a user states for frames without EXIF


def stated_exposure(path: Path) -> tuple[float, float, float]:
    """Return the shutter time [s], f-number and ISO that exposures.csv states for a frame.

    The file is in the frame's folder. All are 0 without it, or if it does not name the frame.
    Raises InputError for an invalid one.
    """
    table = path.parent / EXPOSURES_CSV
    if not table.is_file():
        return _NO_EXPOSURE
    stated, files = read_exposures(table), {file.name for file in path.parent.iterdir()}
    # A card written on Windows can have other capitals in its names than a table.
    others = [name for name in stated if name.lower() == path.name.lower() and name not in files]
    return stated.get(path.name) or stated.get(others[0] if len(others) == 1 else "", _NO_EXPOSURE)


def read_exposures(path: Path) -> dict[str, tuple[float, float, float]]:
    """Read shutter time [s], f-number and ISO by file name from a table exposures.csv.

    Its columns are file, shutter_s (a number or a fraction such as 1/60), f_number and iso. Raises
    InputError for a missing file or other content.
    """
    expected = f"the columns {','.join(COLUMNS)}"
    exposures: dict[str, tuple[float, float, float]] = {}
    for line, row in read_table(path, expected, "write one frame a line", needed=COLUMNS).dicts():
        if row["file"] in exposures:
            finding = f"line {line}: {row['file']} again"
            raise InputError(path, finding, "each frame once", "remove the line")
        shutter_s, f_number, iso = (_positive(row[name], path, line) for name in COLUMNS[1:])
        exposures[row["file"]] = shutter_s, f_number, iso
    return exposures


def _positive(cell: str, path: Path, line: int) -> float:
    """Return a number above 0, which may be a fraction such as 1/60.

    line: of exposures.csv, for the error. Raises InputError for another text.
    """
    numerator, _, denominator = cell.partition("/")
    with suppress(ValueError, ZeroDivisionError):
        parts = [read_number(part, has_codes=False) for part in (numerator, denominator or "1")]
        if (value := parts[0] / parts[1]) > 0:
            return value
    expected = "a number above 0, such as 0.5 or 1/60"
    raise InputError(path, f"line {line}: {cell!r}", expected, "write only a number, with a point")


# ----------------------------------------------------------------------------------------------
# EXIF


def tags_of(path: Path) -> dict[int, Any]:
    """Return the EXIF tags of a frame by number: of its main directory and of its Exif directory.

    The tag of the GPS directory is a dict of its tags. A file that is neither a JPEG nor like a
    TIFF gives no tags. Raises InputError for a file that is missing, empty or unreadable.
    """
    from PIL import ExifTags

    tags: dict[int, Any] = {}
    remedy = "check the path and its permissions"
    with input_errors(path, "a readable file", remedy, OSError), open_to_read(path) as file:
        if not (head := file.read(4)):
            again = "copy it from the card again"
            raise InputError(path, "the file is empty", "a frame of a camera", again)
        # warnings: about tags that are not used; exceptions: of a broken directory
        with warnings.catch_warnings(action="ignore"), suppress(Exception):
            exif = _directories(file, head)
            for directory in (exif, exif.get_ifd(ExifTags.IFD.Exif)):
                for number in directory:
                    with suppress(Exception):  # a broken tag costs no other
                        tags[number] = directory[number]
            if ExifTags.IFD.GPSInfo in tags:
                tags[ExifTags.IFD.GPSInfo] = dict(exif.get_ifd(ExifTags.IFD.GPSInfo))
    return tags


def _directories(file: BinaryIO, head: bytes) -> Any:
    """Return the EXIF of an open file as Pillow's object, which reads each tag when it is used.

    Pillow's class for JPEG finds an Exif segment behind any other segments.
    """
    from PIL import Image
    from PIL.JpegImagePlugin import JpegImageFile

    file.seek(0)
    if head.startswith(b"\xff\xd8"):
        return JpegImageFile(file).getexif()
    exif, content = Image.Exif(), mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    content[:4] = TIFF_VARIANTS.get(head, head)  # Pillow knows only the marks of plain TIFF
    exif.load_from_fp(content)  # pyright: ignore[reportArgumentType]
    return exif


def numbers(tags: Tags, *numbers_of_tags: int) -> list[float]:
    """Return the values of the first of these tags that has finite numbers only; [] without one."""
    for number in numbers_of_tags:
        with suppress(TypeError, ValueError, ZeroDivisionError, OverflowError):
            value = tags.get(number, ())
            values = [] if isinstance(value, str | bytes) else np.ravel(value).astype(float)
            if len(values) and np.isfinite(values).all():
                return [float(v) for v in values]
    return []


def text_of(tags: Tags, number: int) -> str:
    """Return the text of the tag `number` without blanks around it; "" without one."""
    value = tags.get(number, "")
    text = value.decode("ascii", "replace") if isinstance(value, bytes) else value
    return text.strip("\0 ") if isinstance(text, str) else ""


def _camera_time(tags: Tags) -> datetime | None:
    """Return the first valid time of the tags.

    With a blank or invalid offset from UTC the time is naive.
    """
    for number, fraction_number, offset_number in _TIME_TAGS:
        match = _TIME.fullmatch(text_of(tags, number))
        if match is None:
            continue
        year, _, month, day, hour, minute, second, fraction, own_offset = match.groups()
        fraction = text_of(tags, fraction_number) or fraction or ""
        offset = text_of(tags, offset_number) if own_offset is None else own_offset
        microseconds = f"{fraction[:6]:0<6}" if fraction.isdecimal() else "000000"
        text = f"{year}-{month:0>2}-{day:0>2}T{hour:0>2}:{minute}:{second}.{microseconds}"
        with suppress(ValueError):
            return datetime.fromisoformat(text + (offset if _UTC_OFFSET.fullmatch(offset) else ""))
    return None


def _setting(tags: Tags, number: int, apex_number: int, steps: float) -> float:
    """Return the value of a tag, else 2 to the power of `steps` times that of an APEX tag, else 0.

    number, apex_number: of the tags; an APEX tag states a logarithm. Cameras with a lens without
    electronics write 0 into both tags.
    """
    value, apex = ((numbers(tags, n) or [0.0])[0] for n in (number, apex_number))
    return value or (2.0 ** (steps * apex) if 0.0 < abs(apex) < 64.0 else 0.0)


def _iso(tags: Tags) -> float:
    """Return the ISO by the tags (`_ISO`, then `_OTHER_ISO`), 0 if they state none."""
    iso = next(iter(numbers(tags, _ISO)), 0.0)
    others = (numbers(tags, number) for number in _OTHER_ISO)
    stated = (values[0] for values in others if values and values[0] > 0)
    return next(stated, 0.0) if iso in (0.0, _NO_ISO) else iso


def by_other_program(path: Path) -> tuple[float, float, float]:
    """Return shutter time [s], f-number and ISO by exiftool or exiv2; 0 for what they lack.

    Some cameras state the ISO in their maker's notes alone, which Pillow does not read. All are 0
    if neither program is installed.
    """
    for program, *options in _READERS:
        if (command := shutil.which(program)) is None:
            continue
        with suppress(OSError, subprocess.SubprocessError):
            call = [command, *options, str(path.absolute())]
            shown = subprocess.run(call, capture_output=True, text=True, timeout=30, check=False)
            lines = [pattern.search(shown.stdout) for pattern in _READ]
            # a line has a number, or numerator and denominator
            time_s, f_number, iso = (float(m[1]) / float(m[2] or 1) if m else 0.0 for m in lines)
            return time_s, f_number, 0.0 if iso == _NO_ISO else iso
    return _NO_EXPOSURE


def info_of(
    path: Path,
    tags: Tags,
    by_program: Callable[[Path], tuple[float, float, float]],
    lens_f_number: float = 0.0,
) -> FrameInfo:
    """Return the exposure, time and camera that the EXIF tags of a frame state.

    path: of the frame, for errors, and for exposures.csv in its folder, which is used where the
    tags lack a value. lens_f_number: f-number to use if both lack one, as for a lens without
    electronics; 0 for none. by_program: gives shutter time [s], f-number and ISO by LibRaw or
    another program, 0 for one that it lacks; called only if a value is still missing. Raises
    InputError for an exposure time, f-number or ISO that is missing, impossible, or not the one
    that exposures.csv states.
    """
    stated = stated_exposure(path)
    # ExposureTime or ShutterSpeedValue, FNumber or ApertureValue
    in_tags = (_setting(tags, 33434, 37377, -1.0), _setting(tags, 33437, 37378, 0.5), _iso(tags))
    by_source = zip(in_tags, stated, (0.0, lens_f_number, 0.0), strict=True)
    values = [next(filter(None, sources), 0.0) for sources in by_source]
    if not all(values):
        values = [value or other for value, other in zip(values, by_program(path), strict=True)]
    for value, in_csv, quantity in zip(values, stated, _QUANTITIES, strict=True):
        _check_value(path, value, in_csv, quantity)
    description = text_of(tags, 270)  # ImageDescription; 271, 272: Make, Model
    filter_name = description.removeprefix("ND=") if description.startswith("ND=") else ""
    exposure = Exposure(shutter_s=values[0], f_number=values[1], iso=values[2], nd=filter_name)
    return FrameInfo(
        exposure, t_camera=_camera_time(tags), make=text_of(tags, 271), model=text_of(tags, 272)
    )


def _check_value(
    path: Path, value: float, stated: float, quantity: tuple[str, str, float, float, str]
) -> None:
    """Raise InputError for a value that is 0, impossible, or not the stated one.

    stated: by exposures.csv, 0 if it has none; quantity: of `_QUANTITIES`.
    """
    name, tag, low, high, unit = quantity
    remedy = f"write it with: exiftool -{tag} FILE"
    finding = f"{name} {value:g}{unit} in the EXIF"
    if not value:
        remedy = f"{remedy}; or state it in {EXPOSURES_CSV} in the frame's folder"
        finding = f"no {name} in the EXIF"
        if (path.parent / EXPOSURES_CSV).is_file():
            finding += f", and no line {path.name} in {EXPOSURES_CSV}"
        raise InputError(path, finding, "exposure time, f-number and ISO", remedy)
    if not low <= value <= high:
        raise InputError(path, finding, f"{low:g} to {high:g}{unit}", remedy)
    if stated and abs(np.log2(stated / value)) >= SAME_SETTING_EV:
        finding += f", but {stated:g}{unit} in {EXPOSURES_CSV}"
        raise InputError(path, finding, "the same value, or none in the EXIF", "correct the line")


def roll_deg_of(path: Path) -> float | None:
    """Return the camera's roll in degrees that EXIF Orientation states: 0, 90, 180 or -90.

    Positive is clockwise as seen from behind the camera. None if Orientation is missing or
    mirrored. fieldlum never turns pixels by it. Raises InputError for a file that is missing or
    empty.
    """
    tag = numbers(tags_of(path), 274)  # Orientation
    return _ROLL_DEG.get(int(tag[0])) if tag else None


def white_balance_is_fixed(path: Path) -> bool:
    """Return whether EXIF WhiteBalance of a JPEG states 1, a manual setting (EXIF 2.32, 4.6.5).

    Raises InputError for a file that is missing or empty.
    """
    return numbers(tags_of(path), 41987) == [1.0]  # WhiteBalance


def same_model(model: str, wanted: str) -> bool:
    """Return whether `model` and `wanted` are equal, or one is a sequence of words in the other.

    Case and spaces do not count; an empty name equals no other. The second rule exists because a
    frame may state the maker's name in front of the model.
    """
    a, b = (f" {' '.join(name.split())} ".casefold() for name in (model, wanted))
    return bool(a.strip() and b.strip()) and (a in b or b in a)
