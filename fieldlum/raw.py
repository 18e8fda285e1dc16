"""Raw mosaics and JPEG frames as the camera gave them: counts in, nothing developed; and the same files out.

LibRaw opens the file (through rawpy), but only its mosaic is used: `postprocess` rescales each frame by its own
maximum.
"""

from __future__ import annotations

import logging
import os
import struct
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.errors import InputError
from fieldlum.records import Exposure
from fieldlum.session import replacing

_LARGEST_PIXELS = 400_000_000
_DAMAGE = ("data corrupted", "Unexpected end of file")
_STDERR = threading.Lock()


@dataclass(frozen=True, slots=True)
class FrameInfo:
    """What a frame's EXIF says.

    t_camera is the camera's own clock: naive unless the file names its offset from UTC (OffsetTimeOriginal). The
    exposure's nd comes from a ImageDescription ``ND=name``, which a camera does not write: fieldlum and exiftool do.
    """

    exposure: Exposure
    t_camera: datetime | None = None
    make: str = ""
    model: str = ""


@dataclass(frozen=True, slots=True)
class Mosaic:
    """One raw frame. counts [h, w]; cfa names the top left 2 x 2 row by row; black_dn for R, G1, G2, B.

    G1 is the green in the rows of red. white_dn is the file's tag, often above the true plateau. colour_matrix [3, 3]
    takes XYZ to camera RGB, where the file or LibRaw knows it.
    """

    counts: NDArray[np.uint16]
    cfa: str
    black_dn: tuple[float, float, float, float]
    white_dn: float
    exposure: Exposure
    t_camera: datetime | None = None
    make: str = ""
    model: str = ""
    colour_matrix: NDArray[np.float64] | None = None


@dataclass(frozen=True, slots=True)
class JpegFrame:
    """codes [h, w, 3], red first, not turned by the orientation tag."""

    codes: NDArray[np.uint8]
    exposure: Exposure
    t_camera: datetime | None = None
    make: str = ""
    model: str = ""


# ---------------------------------------------------------------------------------------------- EXIF


def _tags(path: Path) -> dict[str, Any]:
    """exifread's tags; none for what it cannot read. Raises InputError for a file that is missing or empty."""
    import exifread

    logging.getLogger("exifread").setLevel(logging.CRITICAL)
    try:
        with path.open("rb") as file:
            if not file.read(1):
                raise InputError(path, "the file is empty", "a frame of a camera", "copy it from the card again")
            file.seek(0)
            with suppress(Exception):  # whatever a broken file makes of the parser: then it has no tags
                return dict(exifread.process_file(file, details=False))
    except OSError as error:
        raise InputError(path, error.strerror or str(error), "a readable file") from None
    return {}


def _numbers(tags: dict[str, Any], *names: str) -> list[float]:
    """The values of the first of `names` that is there and made of finite numbers."""
    for name in names:
        values = getattr(tags.get(name), "values", None)
        with suppress(TypeError, ValueError, ZeroDivisionError, OverflowError):
            numbers = [float(v) for v in values] if isinstance(values, list) else []
            if numbers and np.isfinite(numbers).all():
                return numbers
    return []


def _text(tags: dict[str, Any], *names: str) -> str:
    for name in names:
        values = getattr(tags.get(name), "values", None)
        if isinstance(values, str) and values.strip("\0 "):
            return values.strip("\0 ")
    return ""


def _camera_time(tags: dict[str, Any]) -> datetime | None:
    stamp = _text(tags, "EXIF DateTimeOriginal", "Image DateTimeOriginal", "Image DateTime")
    day, _, clock = stamp.partition(" ")
    second = _text(tags, "EXIF SubSecTimeOriginal")
    offset = _text(tags, "EXIF OffsetTimeOriginal")
    with suppress(ValueError):
        fraction = f".{second[:6]:0<6}" if second.isdigit() else ""
        return datetime.fromisoformat(f"{day.replace(':', '-')}T{clock}{fraction}{offset}")
    return None


def _nd_name(tags: dict[str, Any]) -> str:
    text = _text(tags, "Image ImageDescription")
    return text.removeprefix("ND=") if text.startswith("ND=") else ""


def _info(path: Path, tags: dict[str, Any], fallback: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> FrameInfo:
    """fallback: shutter, f-number and ISO as LibRaw found them, 0 where it did not. Raises InputError."""
    shutter = _numbers(tags, "EXIF ExposureTime", "Image ExposureTime") or [fallback[0]]
    f_number = _numbers(tags, "EXIF FNumber", "Image FNumber") or [fallback[1]]
    iso = _numbers(tags, "EXIF ISOSpeedRatings", "EXIF PhotographicSensitivity", "Image ISOSpeedRatings") or [
        fallback[2]
    ]
    wants = (
        ("exposure time", shutter[0], "ExposureTime", "1/250", 1e-7, 1e5),
        ("f-number", f_number[0], "FNumber", "5.6", 0.3, 1e3),
        ("ISO", iso[0], "ISO", "100", 1.0, 1e7),
    )
    for name, value, tag, example, low, high in wants:
        if not value:
            raise InputError(path, f"no {name} in its EXIF", remedy=f"write it with: exiftool -{tag}={example} FILE")
        if not low <= value <= high:
            raise InputError(
                path, f"{name} {value:g} in its EXIF", f"{low:g} to {high:g}", f"mend it: exiftool -{tag}="
            )
    exposure = Exposure(shutter[0], f_number[0], iso[0], _nd_name(tags))
    return FrameInfo(exposure, _camera_time(tags), _text(tags, "Image Make"), _text(tags, "Image Model"))


def read_exif(path: Path) -> FrameInfo:
    """EXIF of a JPEG or raw frame. Raises InputError, naming the remedy, when it has no exposure time."""
    tags = _tags(path)
    with suppress(InputError):
        return _info(path, tags)
    fallback = (0.0, 0.0, 0.0)
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        with _opened(path) as raw:
            fallback = _libraw_exposure(raw)
    return _info(path, tags, fallback)


# ---------------------------------------------------------------------------------------------- raw


def _check_strips(path: Path) -> None:
    """Refuse a TIFF-like raw whose data reach past its end: LibRaw may fill the rest with zeros, or fall over."""
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
    if head[:4] not in (b"II*\0", b"MM\0*"):
        return
    try:
        with tifffile.TiffFile(path) as tiff:
            tops: list[Any] = [tiff.pages[i] for i in range(min(len(tiff.pages), 16))]
            for page in tops + [sub for top in tops for sub in (getattr(top, "pages", None) or ())]:
                offsets, counts = page.dataoffsets, page.databytecounts
                bits = 0 if page.compression != 1 else page.imagelength * page.imagewidth * page.bitspersample
                ends = [at + n for at, n in zip(offsets, counts, strict=False)]
                if max(ends, default=0) > size or (counts and 8 * sum(counts) < bits * page.samplesperpixel):
                    raise InputError(path, f"{size} bytes, its pixels end later", "a whole file", "copy it again")
                if page.compression == 7 and counts and _bytes_at(path, offsets[0]) != b"\xff\xd8":
                    raise InputError(path, "its pixels are no lossless JPEG", "what its tags say", "copy it again")
    except InputError:
        raise
    except Exception as error:
        found = f"broken TIFF structure ({type(error).__name__})"
        raise InputError(path, found, "a raw file", "copy it from the card again") from None


def _bytes_at(path: Path, at: int) -> bytes:
    with path.open("rb") as file:
        file.seek(at)
        return file.read(2)


def _opened(path: Path) -> Any:
    """rawpy's own object, unpacked. Raises InputError for whatever LibRaw cannot open."""
    import rawpy

    with path.open("rb") as file:
        head = file.read(4)
    kinds = {b"\xff\xd8\xff": "a JPEG", b"\x89PN": "a PNG", b"BM": "a bitmap", b"\x76\x2f\x31": "an OpenEXR file"}
    for magic, kind in kinds.items():
        if head.startswith(magic):
            raise InputError(path, f"{kind} by its content", "a camera raw", "give it its true suffix")
    _check_strips(path)
    try:
        with _complaints() as complaints:
            raw = rawpy.imread(str(path))
            raw.unpack()
    except Exception as error:
        said = error.args[0] if error.args else type(error).__name__
        text = said.decode("ascii", "replace") if isinstance(said, bytes) else str(said)
        raise InputError(
            path, f"LibRaw: {text}", "a raw file that LibRaw supports", "copy it again, or convert it to DNG"
        ) from None
    if complaints:
        raw.close()
        raise InputError(path, f"LibRaw: {complaints[0]}", "a whole file", "copy it from the card again")
    return raw


@contextmanager
def _complaints() -> Iterator[list[str]]:
    """What LibRaw says about damaged data while it goes on as if nothing were: it tells stderr, and nobody else.

    All else that is written to stderr meanwhile is passed on.
    """
    found: list[str] = []
    with _STDERR, tempfile.TemporaryFile() as held:
        sys.stderr.flush()
        kept = os.dup(2)
        os.dup2(held.fileno(), 2)
        try:
            yield found
        finally:
            sys.stderr.flush()
            os.dup2(kept, 2)
            os.close(kept)
            held.seek(0)
            for line in held.read().splitlines(keepends=True):
                said = next((what for what in _DAMAGE if what.encode() in line), "")
                found.append(said) if said else os.write(2, line)


def _libraw_exposure(raw: Any) -> tuple[float, float, float]:
    other = raw.other
    return float(other.shutter_speed or 0.0), float(other.aperture or 0.0), float(other.iso_speed or 0.0)


def _pattern(path: Path, raw: Any) -> tuple[str, NDArray[np.intp]]:
    """Names and LibRaw colour indices of the top left 2 x 2 of the visible mosaic. Raises InputError if no Bayer."""
    import rawpy

    flat = raw.raw_type == rawpy.RawType.Flat and raw.raw_pattern is not None and raw.raw_pattern.shape == (2, 2)
    if not flat:
        kind = "an X-Trans mosaic" if raw.raw_type == rawpy.RawType.Flat else "three colours in each pixel"
        raise InputError(path, kind, "a Bayer mosaic, one colour a pixel", "use a camera with a Bayer sensor")
    index = np.asarray(raw.raw_colors_visible[:2, :2], int)
    letters = raw.color_desc.decode()
    cfa = "".join(letters[i] if i < len(letters) else "?" for i in index.ravel())
    if cfa not in ("RGGB", "BGGR", "GRBG", "GBRG"):
        raise InputError(path, f"colour filters {cfa}", "red, green, green, blue", "use a camera with a Bayer sensor")
    return cfa, index


def channel_positions(cfa: str) -> tuple[tuple[int, int], ...]:
    """(row, column) in the 2 x 2 cell of R, G1 (in the rows of red), G2, B."""
    red, blue = divmod(cfa.index("R"), 2), divmod(cfa.index("B"), 2)
    return red, (red[0], blue[1]), (blue[0], red[1]), blue


def _colour_matrix(raw: Any, tags: dict[str, Any]) -> NDArray[np.float64] | None:
    """XYZ to camera: LibRaw's own table, else the DNG's ColorMatrix2 or 1."""
    known = np.asarray(raw.rgb_xyz_matrix, float)[:3]
    if np.any(known):
        return known
    values = _numbers(tags, "Image ColorMatrix2", "Image Tag 0xC622", "Image ColorMatrix1", "Image Tag 0xC621")
    return np.reshape(values, (3, 3)) if len(values) == 9 and np.any(values) else None


def read_mosaic(path: Path) -> Mosaic:
    """The visible mosaic of a raw frame, undeveloped. Raises InputError, one line, for everything else."""
    tags = _tags(path)
    with _opened(path) as raw:
        cfa, index = _pattern(path, raw)
        counts = raw.raw_image_visible
        if not 0 < counts.size <= _LARGEST_PIXELS or min(counts.shape) < 2:
            raise InputError(path, f"a mosaic of {counts.shape}", "a picture of a sensible size", "copy it again")
        black = raw.black_level_per_channel
        black_dn = tuple(float(black[index[at]]) for at in channel_positions(cfa))
        info = _info(path, tags, _libraw_exposure(raw))
        white_dn = float(raw.white_level or 0)
        if not 0 <= max(black_dn) < white_dn:
            raise InputError(path, f"black {max(black_dn):g}, white {white_dn:g}", "black below white", "copy it again")
        return Mosaic(
            counts.astype(np.uint16),
            cfa,
            (black_dn[0], black_dn[1], black_dn[2], black_dn[3]),
            white_dn,
            info.exposure,
            info.t_camera,
            info.make,
            info.model,
            _colour_matrix(raw, tags),
        )


# ---------------------------------------------------------------------------------------------- JPEG


def read_jpeg(path: Path) -> JpegFrame:
    """Raises InputError for what is no whole JPEG, or has no exposure time."""
    import warnings

    from PIL import Image

    info = _info(path, _tags(path)) if path.is_file() else read_exif(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with Image.open(path, formats=("JPEG",)) as image:
                codes = np.asarray(image.convert("RGB"))
    except Exception as error:
        found = "no JPEG" if type(error).__name__ == "UnidentifiedImageError" else str(error).splitlines()[0]
        raise InputError(path, found, "a whole JPEG", "copy it from the card again") from None
    return JpegFrame(codes, info.exposure, info.t_camera, info.make, info.model)


def write_jpeg(
    path: Path,
    codes: NDArray[np.uint8],
    exposure: Exposure,
    *,
    t_camera: datetime | None = None,
    make: str = "fieldlum",
    model: str = "",
    quality: int = 97,
) -> None:
    """codes [h, w, 3] with EXIF; no chroma subsampling."""
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = make, model
    fields = exif.get_ifd(0x8769)
    fields[33434] = IFDRational(_rational(exposure.shutter_s))
    fields[33437] = IFDRational(_rational(exposure.f_number))
    fields[34855] = round(exposure.iso)
    if exposure.nd:
        exif[0x010E] = f"ND={exposure.nd}"
    for tag, text in _time_tags(t_camera).items():
        fields[tag] = text
    with replacing(path) as file:
        Image.fromarray(codes, "RGB").save(file, "JPEG", quality=quality, subsampling=0, exif=exif)


# ---------------------------------------------------------------------------------------------- DNG

_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _SRATIONAL = 1, 2, 3, 4, 5, 10
_FORMAT = {_BYTE: "B", _SHORT: "H", _LONG: "I"}
_XYZ_TO_SRGB = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)


def _rational(value: float) -> Fraction:
    """As a camera would write it: 1/250, 5.6 = 28/5; exact to 1e-6."""
    inverse = Fraction(1, max(round(1 / value), 1)) if 0 < value < 1 else Fraction(0)
    if inverse and abs(float(inverse) / value - 1) < 1e-6:
        return inverse
    return Fraction(value).limit_denominator(1_000_000 if value < 1000 else 1000)


def _time_tags(t_camera: datetime | None) -> dict[int, str]:
    """DateTimeOriginal, SubSecTimeOriginal and, for an aware time, OffsetTimeOriginal."""
    if t_camera is None:
        return {}
    offset = t_camera.strftime("%z")
    return {
        36867: t_camera.strftime("%Y:%m:%d %H:%M:%S"),
        37521: f"{t_camera.microsecond // 1000:03d}",
        **({36881: f"{offset[:3]}:{offset[3:5]}"} if offset else {}),
    }


def _packed(kind: int, value: Any) -> tuple[int, bytes]:
    if kind == _ASCII:
        text = value.encode("ascii", "replace") + b"\0"
        return len(text), text
    if kind in (_RATIONAL, _SRATIONAL):
        code = "i" if kind == _SRATIONAL else "I"
        parts = [Fraction(v).limit_denominator(1_000_000) for v in value]
        return len(parts), b"".join(struct.pack(f"<2{code}", p.numerator, p.denominator) for p in parts)
    return len(value), struct.pack(f"<{len(value)}{_FORMAT[kind]}", *value)


def _directory(tags: dict[int, tuple[int, Any]], at: int) -> bytes:
    """A TIFF directory that will stand at byte `at`, with the values that do not fit in it behind it."""
    body, data = struct.pack("<H", len(tags)), b""
    free = at + 2 + 12 * len(tags) + 4
    for tag in sorted(tags):
        kind, value = tags[tag]
        count, packed = _packed(kind, value)
        if len(packed) <= 4:
            body += struct.pack("<HHI", tag, kind, count) + packed.ljust(4, b"\0")
        else:
            body += struct.pack("<HHII", tag, kind, count, free + len(data))
            data += packed + b"\0" * (len(packed) % 2)
    return body + struct.pack("<I", 0) + data


def write_dng(
    path: Path,
    counts: NDArray[np.uint16],
    exposure: Exposure,
    *,
    black_dn: tuple[float, ...],
    white_dn: float,
    cfa: str = "RGGB",
    t_camera: datetime | None = None,
    make: str = "fieldlum",
    model: str = "",
    colour_matrix: ArrayLike = _XYZ_TO_SRGB,
) -> None:
    """An uncompressed DNG with an EXIF directory; LibRaw gives the counts back bit for bit.

    counts [h, w] 16-bit; black_dn for R, G1, G2, B; colour_matrix [3, 3] XYZ to camera.
    """
    exif: dict[int, tuple[int, Any]] = {
        33434: (_RATIONAL, [_rational(exposure.shutter_s)]),
        33437: (_RATIONAL, [_rational(exposure.f_number)]),
        34855: (_SHORT, [round(exposure.iso)]),
        **{tag: (_ASCII, text) for tag, text in _time_tags(t_camera).items()},
    }
    height, width = counts.shape
    cell = np.empty((2, 2))
    for at, value in zip(channel_positions(cfa), black_dn, strict=True):
        cell[at] = value

    def main(exif_at: int, pixels_at: int) -> dict[int, tuple[int, Any]]:
        return {
            254: (_LONG, [0]),
            256: (_LONG, [width]),
            257: (_LONG, [height]),
            258: (_SHORT, [16]),
            259: (_SHORT, [1]),  # uncompressed
            262: (_SHORT, [32803]),  # colour filter array
            **({270: (_ASCII, f"ND={exposure.nd}")} if exposure.nd else {}),
            271: (_ASCII, make),
            272: (_ASCII, model or "camera"),
            273: (_LONG, [pixels_at]),
            274: (_SHORT, [1]),
            277: (_SHORT, [1]),
            278: (_LONG, [height]),
            279: (_LONG, [counts.size * 2]),
            284: (_SHORT, [1]),
            33421: (_SHORT, [2, 2]),
            33422: (_BYTE, ["RGB".index(c) for c in cfa]),
            34665: (_LONG, [exif_at]),
            50706: (_BYTE, [1, 4, 0, 0]),
            50707: (_BYTE, [1, 1, 0, 0]),
            50708: (_ASCII, f"{make} {model or 'camera'}"),
            50713: (_SHORT, [2, 2]),
            50714: (_RATIONAL, cell.ravel().tolist()),
            50717: (_LONG, [round(white_dn)]),
            50721: (_SRATIONAL, np.asarray(colour_matrix, float).ravel().tolist()),
            50728: (_RATIONAL, [1, 1, 1]),
            50778: (_SHORT, [21]),  # D65
        }

    exif_at = 8 + len(_directory(main(0, 0), 8))
    pixels_at = exif_at + len(_directory(exif, exif_at))
    with replacing(path) as file:
        file.write(b"II*\0" + struct.pack("<I", 8) + _directory(main(exif_at, pixels_at), 8))
        file.write(_directory(exif, exif_at) + np.ascontiguousarray(counts, "<u2").tobytes())
