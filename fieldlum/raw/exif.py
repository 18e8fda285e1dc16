"""Read exposure, time and camera from the EXIF of a frame; compute the values to write it."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Protocol

import numpy as np

from fieldlum.errors import InputError, input_errors
from fieldlum.records import Exposure

# Roll of the camera by EXIF Orientation (EXIF 2.32). Mirrored orientations are written by no
# camera.
_ROLL_DEG = {1: 0.0, 3: 180.0, 6: 90.0, 8: -90.0}


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
        if not file.read(1):
            raise InputError(
                path, "the file is empty", "a frame of a camera", "copy it from the card again"
            )
        file.seek(0)
        with suppress(Exception):  # exifread may raise anything for a broken file
            return dict(exifread.process_file(file, details=False))
    return {}


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
    stamp = _text(tags, "EXIF DateTimeOriginal", "Image DateTimeOriginal", "Image DateTime")
    day, _, clock = stamp.partition(" ")
    second = _text(tags, "EXIF SubSecTimeOriginal")
    offset = _text(tags, "EXIF OffsetTimeOriginal")
    with suppress(ValueError):
        fraction = f".{second[:6]:0<6}" if second.isdigit() else ""
        return datetime.fromisoformat(f"{day.replace(':', '-')}T{clock}{fraction}{offset}")
    return None


def _nd_name(tags: Mapping[str, ExifTag]) -> str:
    text = _text(tags, "Image ImageDescription")
    return text.removeprefix("ND=") if text.startswith("ND=") else ""


def info_of(
    path: Path,
    tags: Mapping[str, ExifTag],
    fallback: tuple[float, float, float] = (0.0, 0.0, 0.0),
    *,
    lens_f_number: float = 0.0,
) -> FrameInfo:
    """Return the exposure, time and camera that the EXIF tags of a frame state.

    path : of the frame, for errors. fallback : shutter time [s], f-number and ISO by LibRaw, used
    where the tags lack a value; 0 for a value that LibRaw lacks too. lens_f_number : f-number to
    use if tags and fallback lack one, as for a lens without electronics; 0 for none. Raises
    InputError for an exposure time, f-number or ISO that is missing or impossible.
    """
    shutter = numbers(tags, "EXIF ExposureTime", "Image ExposureTime") or [fallback[0]]
    f_number = numbers(tags, "EXIF FNumber", "Image FNumber") or [fallback[1] or lens_f_number]
    iso = numbers(
        tags, "EXIF ISOSpeedRatings", "EXIF PhotographicSensitivity", "Image ISOSpeedRatings"
    ) or [fallback[2]]
    wants = (
        ("exposure time", shutter[0], "ExposureTime", "1/250", 1e-7, 1e5),
        ("f-number", f_number[0], "FNumber", "5.6", 0.3, 1e3),
        ("ISO", iso[0], "ISO", "100", 1.0, 1e7),
    )
    for name, value, tag, example, low, high in wants:
        if not value:
            raise InputError(
                path,
                f"no {name} in the EXIF",
                "exposure time, f-number and ISO in the EXIF",
                f"write it with: exiftool -{tag}={example} FILE",
            )
        unit = " s" if tag == "ExposureTime" else ""
        if not low <= value <= high:
            raise InputError(
                path,
                f"{name} {value:g}{unit} in the EXIF",
                f"{low:g} to {high:g}{unit}",
                f"correct it with: exiftool -{tag}={example} FILE",
            )
    exposure = Exposure(shutter[0], f_number[0], iso[0], _nd_name(tags))
    return FrameInfo(
        exposure, _camera_time(tags), _text(tags, "Image Make"), _text(tags, "Image Model")
    )


def roll_deg_of(path: Path) -> float | None:
    """Return the camera's roll in degrees that EXIF Orientation states: 0, 90, 180 or -90.

    Positive is clockwise as seen from behind the camera. None if Orientation is missing or
    mirrored. fieldlum never turns pixels by it. Raises InputError for a file that is missing or
    empty.
    """
    tag = numbers(tags_of(path), "Image Orientation")
    return _ROLL_DEG.get(int(tag[0])) if tag else None


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
