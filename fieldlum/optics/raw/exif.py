"""Read exposure, time and camera from the EXIF of a frame; compute the values to write it."""

from __future__ import annotations

import csv
import io
import logging
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np

from fieldlum.core.errors import InputError, input_errors
from fieldlum.core.records import Exposure

# ----------------------------------------------------------------------------------------------
# exposures that a user states for frames without EXIF, in exposures.csv


EXPOSURES_CSV = "exposures.csv"
COLUMNS = ("file", "shutter_s", "f_number", "iso")
NO_EXPOSURE = (0.0, 0.0, 0.0)


def stated_exposure(path: Path) -> tuple[float, float, float]:
    """Return the shutter time [s], f-number and ISO that exposures.csv states for a frame.

    The file is in the frame's folder. All are 0 without it, or if it does not name the frame.
    Raises InputError for an invalid one.
    """
    table = path.parent / EXPOSURES_CSV
    try:
        modified_ns = table.stat().st_mtime_ns
    except OSError:
        return NO_EXPOSURE
    return _rows(table, modified_ns).get(path.name, NO_EXPOSURE)


@lru_cache(maxsize=16)  # each frame of a bracket asks for it
def _rows(table: Path, modified_ns: int) -> dict[str, tuple[float, float, float]]:
    """Return the exposures by file name. modified_ns: only a key of the cache."""
    remedy = f"write the columns {','.join(COLUMNS)}, with one frame on each line"
    with (
        input_errors(table, "a csv in UTF-8", remedy, OSError, UnicodeDecodeError, csv.Error),
        table.open(encoding="utf-8-sig", newline="") as file,
    ):
        rows = [[cell.strip() for cell in row] for row in csv.reader(file, strict=True)]
    if not rows or tuple(rows[0]) != COLUMNS:
        shown = ",".join(rows[0])[:80] if rows else "nothing"
        raise InputError(table, f"a first line {shown}", ",".join(COLUMNS), remedy)
    exposures: dict[str, tuple[float, float, float]] = {}
    for number, row in enumerate(rows[1:], start=2):
        if not any(row):
            continue
        place = f"{table}:{number}"
        if len(row) != len(COLUMNS):
            raise InputError(
                place, f"{len(row)} cells", f"{len(COLUMNS)} cells: {','.join(COLUMNS)}", remedy
            )
        if row[0] in exposures:
            raise InputError(place, f"{row[0]} for the second time", "each frame once", remedy)
        shutter_s, f_number, iso = (_positive(cell, place) for cell in row[1:])
        exposures[row[0]] = shutter_s, f_number, iso
    return exposures


def _positive(cell: str, place: str) -> float:
    """Return a number above 0, which may be a fraction such as 1/60."""
    numerator, _, denominator = cell.partition("/")
    try:
        value = float(numerator) / float(denominator or 1)
    except (ValueError, ZeroDivisionError):
        value = 0.0
    if not 0 < value < float("inf"):
        raise InputError(
            place,
            repr(cell),
            "a number above 0, such as 0.5 or 1/60",
            "write decimals with a point",
        )
    return value


# ----------------------------------------------------------------------------------------------
# EXIF


# Roll of the camera by EXIF Orientation (EXIF 2.32). Mirrored orientations are written by no
# camera.
_ROLL_DEG = {1: 0.0, 3: 180.0, 6: 90.0, 8: -90.0}
# Largest value of the 16-bit tag PhotographicSensitivity, which then means "look at the tag that
# SensitivityType names" (EXIF 2.32, 4.6.5). 0 is no sensitivity.
_ISO_ELSEWHERE = 65535
_ISO_TAGS = {  # by SensitivityType, the most comparable first (EXIF 2.32, table 9)
    1: ("StandardOutputSensitivity",),
    2: ("RecommendedExposureIndex",),
    3: ("ISOSpeed",),
    4: ("RecommendedExposureIndex", "StandardOutputSensitivity"),
    5: ("StandardOutputSensitivity", "ISOSpeed"),
    6: ("RecommendedExposureIndex", "ISOSpeed"),
    7: ("RecommendedExposureIndex", "StandardOutputSensitivity", "ISOSpeed"),
}
# exifread has no name for tag 0x8831.
_OTHER_NAMES = {"StandardOutputSensitivity": ("EXIF Tag 0x8831",)}
# Tags that Pillow names in another way than exifread.
_PILLOW_NAMES = {34855: "ISOSpeedRatings"}
_TIME_TAGS = (  # time, fraction of a second, offset from UTC
    ("EXIF DateTimeOriginal", "EXIF SubSecTimeOriginal", "EXIF OffsetTimeOriginal"),
    ("Image DateTimeOriginal", "EXIF SubSecTimeOriginal", "EXIF OffsetTimeOriginal"),
    ("EXIF DateTimeDigitized", "EXIF SubSecTimeDigitized", "EXIF OffsetTimeDigitized"),
    ("Image DateTime", "EXIF SubSecTime", "EXIF OffsetTime"),
)
# Year, month, day by : / - or . as cameras and editors write them, then the time of day.
_TIME = re.compile(
    r"(\d{4})([:/.-])(\d{1,2})\2(\d{1,2})[ T]+(\d{1,2}):(\d{2}):(\d{2})(?:[.,](\d+))?"
    r"\s*(Z|[+-]\d{2}:?\d{2})?"
)
_UTC_OFFSET = re.compile(r"Z|[+-](?:0\d|1[0-4]):?[0-5]\d")  # civil time is within 14 h of UTC
# Settings are a third of a stop apart: half of it is a rounded value of the same setting. Chosen.
_SAME_SETTING = 2 ** (1 / 6)
_EXPOSURE_LIMITS = (  # name, tag of exiftool, example, least and largest possible value; chosen
    ("exposure time", "ExposureTime", "1/250", 1e-7, 1e5),
    ("f-number", "FNumber", "5.6", 0.3, 1e3),
    ("ISO", "ISO", "100", 1.0, 1e7),
)
_JPEG_START, _JPEG_EXIF, _JPEG_PIXELS = b"\xff\xd8", 0xE1, (0xDA, 0xD9)
_EXIF_MARK = b"Exif\0"


class ExifTag(Protocol):
    """A tag of exifread: text, or a list of numbers or fractions."""

    @property
    def values(self) -> object:
        """Content of the tag: a text, or a list of numbers or fractions."""
        ...


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


def tags_of(path: Path) -> dict[str, ExifTag]:
    """Return the EXIF tags of a frame by exifread's name, such as "EXIF FNumber".

    There are no tags if exifread cannot parse the file. Raises InputError for a file that is
    missing, empty or unreadable.
    """
    import exifread

    logging.getLogger("exifread").setLevel(logging.CRITICAL)
    remedy = "check the path and its permissions"
    with input_errors(path, "a readable file", remedy, OSError), path.open("rb") as file:
        if not (head := file.read(2)):
            raise InputError(
                path, "the file is empty", "a frame of a camera", "copy it from the card again"
            )
        file.seek(0)
        block = io.BytesIO(_exif_block(file)) if head == _JPEG_START else file
        with suppress(Exception):  # exifread may raise anything for a broken file
            tags = dict(exifread.process_file(block, details=False))
            if tags or block is file:
                return tags
        return _by_pillow(block) if block is not file else {}


def _exif_block(file: BinaryIO) -> bytes:
    """Return the TIFF structure of a JPEG's Exif segment, b"" without one.

    Every segment is passed by its stated length: exifread gives up at large APP segments.
    """
    file.seek(2)
    while file.read(1) == b"\xff":
        while (marker := file.read(1)) == b"\xff":  # fill bytes
            pass
        if not marker or marker[0] in _JPEG_PIXELS:
            break
        size = int.from_bytes(file.read(2), "big")
        if size < 2:
            break
        if marker[0] == _JPEG_EXIF and (body := file.read(size - 2)).startswith(_EXIF_MARK):
            return body[len(_EXIF_MARK) + 1 :]
        if marker[0] != _JPEG_EXIF:
            file.seek(size - 2, io.SEEK_CUR)
    return b""


@dataclass(frozen=True, slots=True)
class _PillowTag:
    values: object


def _by_pillow(block: BinaryIO) -> dict[str, ExifTag]:
    """Return the tags that Pillow finds in a TIFF structure, by the names of exifread.

    Pillow continues after a broken tag, exifread ends there.
    """
    import warnings

    from PIL import ExifTags, Image

    exif, tags = Image.Exif(), {}
    block.seek(0)
    with warnings.catch_warnings(), suppress(Exception):
        warnings.simplefilter("ignore")  # about tags that nobody asks for
        exif.load(block.read())
        for group, values in (("Image", exif), ("EXIF", exif.get_ifd(ExifTags.IFD.Exif))):
            for number, value in values.items():
                name = _PILLOW_NAMES.get(number, ExifTags.TAGS.get(number, ""))
                text = value.decode("ascii", "replace") if isinstance(value, bytes) else value
                content = text if isinstance(text, str) else np.ravel(text).tolist()
                tags[f"{group} {name}"] = _PillowTag(content)
    return tags


def numbers(tags: Mapping[str, ExifTag], *names: str) -> list[float]:
    """Return the values of the first tag in the order of `names` that has finite numbers only.

    The list is empty if there is no such tag.
    """
    for name in names:
        values = getattr(tags.get(name), "values", None)
        with suppress(TypeError, ValueError, ZeroDivisionError, OverflowError):
            numbers = [float(v) for v in values] if isinstance(values, list) else []
            if numbers and np.isfinite(numbers).all():
                return numbers
    return []


def _text(tags: Mapping[str, ExifTag], *names: str) -> str:
    for name in names:
        values = getattr(tags.get(name), "values", None)
        if isinstance(values, str) and values.strip("\0 "):
            return values.strip("\0 ")
    return ""


def _camera_time(tags: Mapping[str, ExifTag]) -> datetime | None:
    """Return the first valid time of the tags; a blank or invalid offset from UTC is unknown."""
    for name, second_name, offset_name in _TIME_TAGS:
        match = _TIME.fullmatch(_text(tags, name))
        if match is None:
            continue
        year, _, month, day, hour, minute, second, fraction, own_offset = match.groups()
        fraction = _text(tags, second_name) or fraction or ""
        offset = _text(tags, offset_name) if own_offset is None else own_offset
        microseconds = f"{fraction[:6]:0<6}" if fraction.isdecimal() else "000000"
        text = f"{year}-{month:0>2}-{day:0>2}T{hour:0>2}:{minute}:{second}.{microseconds}"
        with suppress(ValueError):
            return datetime.fromisoformat(text + (offset if _UTC_OFFSET.fullmatch(offset) else ""))
    return None


def _iso(tags: Mapping[str, ExifTag]) -> float:
    """Return the ISO by the tags, 0 if they state none.

    PhotographicSensitivity, which exifread calls ISOSpeedRatings, ends at 65534: beyond, and if it
    is missing, the tag counts that SensitivityType names (as in exiv2).
    """
    iso = numbers(
        tags, "EXIF ISOSpeedRatings", "EXIF PhotographicSensitivity", "Image ISOSpeedRatings"
    )
    if iso and iso[0] not in (0, _ISO_ELSEWHERE):
        return iso[0]
    kind = numbers(tags, "EXIF SensitivityType")
    for name in _ISO_TAGS.get(int(kind[0]) if kind else 0, _ISO_TAGS[7]):
        stated = numbers(tags, f"EXIF {name}", *_OTHER_NAMES.get(name, ()))
        if stated and stated[0] > 0:
            return stated[0]
    return 0.0


def _nd_name(tags: Mapping[str, ExifTag]) -> str:
    text = _text(tags, "Image ImageDescription")
    return text.removeprefix("ND=") if text.startswith("ND=") else ""


def info_of(
    path: Path,
    tags: Mapping[str, ExifTag],
    fallback: tuple[float, float, float] = NO_EXPOSURE,
    *,
    lens_f_number: float = 0.0,
) -> FrameInfo:
    """Return the exposure, time and camera that the EXIF tags of a frame state.

    path : of the frame, for errors, and for exposures.csv in its folder, which is used where the
    tags lack a value. fallback : shutter time [s], f-number and ISO by LibRaw, used after it; 0 for
    a value that LibRaw lacks too. lens_f_number : f-number to use if all of them lack one, as for a
    lens without electronics; 0 for none. Raises InputError for an exposure time, f-number or ISO
    that is missing, impossible, or not the one that exposures.csv states.
    """
    stated = stated_exposure(path)
    in_tags = (
        (numbers(tags, "EXIF ExposureTime", "Image ExposureTime") or [0.0])[0],
        (numbers(tags, "EXIF FNumber", "Image FNumber") or [0.0])[0],
        _iso(tags),
    )
    values = [
        of_tags or own or of_libraw or of_lens
        for of_tags, own, of_libraw, of_lens in zip(
            in_tags, stated, fallback, (0.0, lens_f_number, 0.0), strict=True
        )
    ]
    for value, own, limits in zip(values, stated, _EXPOSURE_LIMITS, strict=True):
        _check_value(path, value, own, *limits)
    exposure = Exposure(values[0], values[1], values[2], _nd_name(tags))
    return FrameInfo(
        exposure, _camera_time(tags), _text(tags, "Image Make"), _text(tags, "Image Model")
    )


def _check_value(
    path: Path,
    value: float,
    stated: float,
    name: str,
    tag: str,
    example: str,
    low: float,
    high: float,
) -> None:
    """Raise InputError for a value that is 0, outside of low to high, or not the stated one.

    stated : by exposures.csv, 0 if it has none. name, tag, example : of the quantity, for errors.
    """
    unit = " s" if tag == "ExposureTime" else ""
    if not value:
        raise InputError(
            path,
            f"no {name} in the EXIF",
            "exposure time, f-number and ISO in the EXIF",
            f"write it with: exiftool -{tag}={example} FILE; or state it in {EXPOSURES_CSV} in the "
            "frame's folder",
        )
    if not low <= value <= high:
        raise InputError(
            path,
            f"{name} {value:g}{unit} in the EXIF",
            f"{low:g} to {high:g}{unit}",
            f"correct it with: exiftool -{tag}={example} FILE",
        )
    if stated and not 1 / _SAME_SETTING < stated / value < _SAME_SETTING:
        raise InputError(
            path,
            f"{name} {value:g}{unit} in the EXIF, but {stated:g}{unit} in {EXPOSURES_CSV}",
            "the same value, or none in the EXIF",
            f"correct or remove the line in {EXPOSURES_CSV}",
        )


def roll_deg_of(path: Path) -> float | None:
    """Return the camera's roll in degrees that EXIF Orientation states: 0, 90, 180 or -90.

    Positive is clockwise as seen from behind the camera. None if Orientation is missing or
    mirrored. fieldlum never turns pixels by it. Raises InputError for a file that is missing or
    empty.
    """
    tag = numbers(tags_of(path), "Image Orientation")
    return _ROLL_DEG.get(int(tag[0])) if tag else None


def white_balance_is_fixed(path: Path) -> bool:
    """Return whether EXIF WhiteBalance of a JPEG states 1, a manual setting (EXIF 2.32, 4.6.5).

    Raises InputError for a file that is missing or empty.
    """
    return numbers(tags_of(path), "EXIF WhiteBalance") == [1.0]


def same_model(model: str, wanted: str) -> bool:
    """Return whether two camera names are equal, or one is a sequence of words in the other.

    Case and spaces do not count; an empty name equals no other. The second rule exists because a
    frame may state the maker's name in front of the model.
    """
    a, b = (f" {' '.join(name.split())} ".casefold() for name in (model, wanted))
    return bool(a.strip() and b.strip()) and (a in b or b in a)


def rational(value: float) -> Fraction:
    """Return a positive number as the fraction that a camera writes.

    For example, 0.004 gives 1/250 and 5.6 gives 28/5. Below 1 a unit fraction is preferred if it
    differs by less than 1e-6 of the value.
    """
    inverse = Fraction(1, max(round(1 / value), 1)) if 0 < value < 1 else Fraction(0)
    if inverse and abs(float(inverse) / value - 1) < 1e-6:
        return inverse
    return Fraction(value).limit_denominator(1_000_000 if value < 1000 else 1000)


def time_tags(t_camera: datetime | None) -> dict[int, str]:
    """Return the EXIF tags (number: text) of the time a frame was taken; no tags for None.

    They are DateTimeOriginal, SubSecTimeOriginal (three digits) and, for a time with an offset from
    UTC, OffsetTimeOriginal.
    """
    if t_camera is None:
        return {}
    offset = t_camera.strftime("%z")
    return {
        36867: t_camera.strftime("%Y:%m:%d %H:%M:%S"),
        37521: f"{t_camera.microsecond // 1000:03d}",
        **({36881: f"{offset[:3]}:{offset[3:5]}"} if offset else {}),
    }
