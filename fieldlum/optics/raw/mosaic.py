"""Read the mosaic of a raw frame through LibRaw, without development."""

from __future__ import annotations

import io
import logging
import os
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Indices
from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure
from fieldlum.optics.raw.dng import channel_positions
from fieldlum.optics.raw.exif import ExifTag, FrameInfo, info_of, numbers, tags_of

# A larger mosaic is a damaged header; the largest sensors in use have 150 million pixels. Chosen.
_MAX_PIXELS = 400_000_000
_DAMAGE = ("data corrupted", "Unexpected end of file")  # messages of LibRaw's data streams
_STDERR = threading.Lock()
# First bytes of Panasonic (RW2) and Olympus (ORF) files, and those of a TIFF with the same content:
# LibRaw fills missing data of these files without a message.
_TIFF_VARIANTS = {b"IIU\0": b"II*\0", b"IIRO": b"II*\0", b"IIRS": b"II*\0", b"MMOR": b"MM\0*"}
_ACTIVE_AREA, _COLOUR_FILTER_ARRAY = 50829, 32803  # tag, and value of Photometric (DNG 1.7)
_PANASONIC_OFFSET = 280  # tag RawDataOffset: in newer files StripOffsets is a placeholder


@dataclass(frozen=True, slots=True)
class Mosaic:
    """One raw frame.

    counts: raw counts [h, w], black level included; cfa: colours of the top left 2 x 2 pixels row
    by row, such as "RGGB"; black_dn: black level for R, G1, G2, B, with G1 the green in the rows of
    red; white_dn: white level in the file, often above the true saturation; exposure: by the EXIF;
    t_camera: the camera's own clock, naive unless the file states its offset from UTC, None if not
    recorded; make, model: of the camera, "" if not recorded; colour_matrix: [3, 3], converts XYZ to
    camera RGB; None if neither the file nor LibRaw has it.
    """

    counts: NDArray[np.uint16]
    cfa: str
    black_dn: tuple[float, float, float, float]
    white_dn: float
    exposure: Exposure
    t_camera: datetime | None = None
    make: str = ""
    model: str = ""
    colour_matrix: Floats | None = None


def _damaged(path: Path, finding: str, expected: str) -> InputError:
    return InputError(path, finding, expected, "copy the file from the card again")


def _check_strips(path: Path) -> None:
    """Raise InputError for a TIFF-like raw whose data reach past the end of the file.

    LibRaw may fill the missing part with zeros, or crash.
    """
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(4)
    if head in _TIFF_VARIANTS:
        return _check_variant(path, _TIFF_VARIANTS[head])
    if head not in (b"II*\0", b"MM\0*"):
        return
    try:
        with tifffile.TiffFile(path) as tiff:
            tops: list[Any] = [tiff.pages[i] for i in range(min(len(tiff.pages), 16))]
            for page in tops + [sub for top in tops for sub in (getattr(top, "pages", None) or ())]:
                offsets, counts = page.dataoffsets, page.databytecounts
                bits = (
                    0
                    if page.compression != 1
                    else page.imagelength * page.imagewidth * page.bitspersample
                )
                ends = [at + n for at, n in zip(offsets, counts, strict=False)]
                if max(ends, default=0) > size or (
                    counts and 8 * sum(counts) < bits * page.samplesperpixel
                ):
                    raise _cut_short(path, size)
                if page.compression == 7 and counts and _bytes_at(path, offsets[0]) != b"\xff\xd8":
                    raise _damaged(
                        path,
                        "its pixels are no lossless JPEG",
                        "the compression that its tags state",
                    )
    except InputError:
        raise
    except Exception as error:
        raise _damaged(
            path, f"broken TIFF structure ({type(error).__name__})", "a raw file"
        ) from None


def _cut_short(path: Path, size: int) -> InputError:
    return _damaged(path, f"the file has {size} bytes, but its pixels end later", "a complete file")


def _check_variant(path: Path, magic: bytes) -> None:
    """Raise InputError for a maker's variant of TIFF whose data reach past the end of the file.

    Only offsets and lengths are checked: the other tags follow rules of the maker.
    """
    import tifffile

    size, end = path.stat().st_size, 0
    with suppress(Exception), path.open("rb") as file:
        content = io.BytesIO(magic + file.read()[4:])
        with tifffile.TiffFile(content) as tiff:
            tags = tiff.pages.first.tags
            lengths = np.ravel(tags.valueof("StripByteCounts", 0))
            offsets = np.ravel(tags.valueof(_PANASONIC_OFFSET) or tags.valueof("StripOffsets", 0))
            end = max(int(at) + int(n) for at, n in zip(offsets, lengths, strict=False))
    if end > size:
        raise _cut_short(path, size)


def _bytes_at(path: Path, at: int) -> bytes:
    with path.open("rb") as file:
        file.seek(at)
        return file.read(2)


def opened(path: Path) -> Any:
    """Return a raw file as rawpy's object with unpacked pixels, which the caller must close.

    Raises InputError for a file that is damaged, is no raw file, or is not supported by LibRaw.
    """
    import rawpy

    with path.open("rb") as file:
        head = file.read(4)
    kinds = {
        b"\xff\xd8\xff": "a JPEG",
        b"\x89PN": "a PNG",
        b"BM": "a bitmap",
        b"\x76\x2f\x31": "an OpenEXR file",
    }
    for magic, kind in kinds.items():
        if head.startswith(magic):
            raise InputError(
                path,
                f"the file's content is {kind}",
                "a camera raw or JPEG",
                "give the file the suffix .jpg"
                if kind == "a JPEG"
                else "use the frame as the camera wrote it, raw or JPEG with its EXIF",
            )
    _check_strips(path)
    try:
        with _damage_messages() as damage:
            raw = rawpy.imread(str(path))
            raw.unpack()
    except Exception as error:
        reason = error.args[0] if error.args else type(error).__name__
        text = reason.decode("ascii", "replace") if isinstance(reason, bytes) else str(reason)
        raise InputError(
            path,
            f"LibRaw: {text}",
            "a raw file that LibRaw supports",
            "leave the file out if it is no frame; otherwise copy it from the card again or "
            "convert it to DNG",
        ) from None
    if damage:
        raw.close()
        raise _damaged(path, f"LibRaw: {damage[0]}", "a complete file")
    return raw


@contextmanager
def _damage_messages() -> Iterator[list[str]]:
    """Collect the messages of LibRaw about damaged data, which it writes to stderr only.

    LibRaw then continues as if the data were complete. All other text that is written to stderr
    meanwhile is passed on.
    """
    messages: list[str] = []
    with _STDERR, tempfile.TemporaryFile() as buffer:
        sys.stderr.flush()
        stderr = os.dup(2)
        os.dup2(buffer.fileno(), 2)
        try:
            yield messages
        finally:
            sys.stderr.flush()
            os.dup2(stderr, 2)
            os.close(stderr)
            buffer.seek(0)
            for line in buffer.read().splitlines(keepends=True):
                message = next((text for text in _DAMAGE if text.encode() in line), "")
                if message:
                    messages.append(message)
                else:
                    os.write(2, line)


def libraw_exposure(raw: Any) -> tuple[float, float, float]:
    """Return the shutter time [s], f-number and ISO that LibRaw read from a raw file.

    raw : an object of `opened`. A value that the file lacks is 0.
    """
    other = raw.other
    return (
        float(other.shutter_speed or 0.0),
        float(other.aperture or 0.0),
        float(other.iso_speed or 0.0),
    )


def _pattern(path: Path, raw: Any) -> tuple[str, Indices]:
    """Return the colours and LibRaw's colour indices of the top left 2 x 2 visible pixels.

    Raises InputError without a Bayer mosaic.
    """
    import rawpy

    flat = (
        raw.raw_type == rawpy.RawType.Flat
        and raw.raw_pattern is not None
        and raw.raw_pattern.shape == (2, 2)
    )
    if not flat:
        raise InputError(
            path,
            _other_than_bayer(raw),
            "a Bayer mosaic, with one colour in each pixel",
            "use a camera with a Bayer sensor",
        )
    index = np.asarray(raw.raw_colors_visible[:2, :2], int)
    letters = raw.color_desc.decode()
    cfa = "".join(letters[i] if i < len(letters) else "?" for i in index.ravel())
    if cfa not in ("RGGB", "BGGR", "GRBG", "GBRG"):
        raise InputError(
            path,
            f"a mosaic of the colour filters {cfa}",
            "a Bayer mosaic: one red, two green, one blue",
            "use a camera with a Bayer sensor",
        )
    return cfa, index


def _other_than_bayer(raw: Any) -> str:
    """Return what a raw file without a 2 x 2 mosaic has instead."""
    import rawpy

    if raw.raw_type != rawpy.RawType.Flat:
        return "the raw file has three colours in each pixel"
    shape = (0, 0) if raw.raw_pattern is None else raw.raw_pattern.shape
    if max(shape) <= 1:
        return "the raw file has no colour filters (a monochrome sensor)"
    name = "an X-Trans mosaic" if shape == (6, 6) else "a mosaic"
    return f"the raw file has {name} of {shape[0]} x {shape[1]} colour filters"


def _visible_shift(path: Path, raw: Any) -> tuple[int, int]:
    """Return by how many rows and columns LibRaw's visible mosaic starts inside a DNG's ActiveArea.

    LibRaw rounds an uneven start up to an even one. The colours follow, but the black levels, whose
    2 x 2 cell begins at the ActiveArea (DNG 1.7, BlackLevel), do not. (0, 0) for other files.
    """
    import tifffile

    with suppress(Exception), tifffile.TiffFile(path) as tiff:
        tops: list[Any] = list(tiff.pages)
        for page in tops + [sub for top in tops for sub in (getattr(top, "pages", None) or ())]:
            area = page.tags.valueof(_ACTIVE_AREA)
            if area is not None and page.photometric == _COLOUR_FILTER_ARRAY:
                return raw.sizes.top_margin - int(area[0]), raw.sizes.left_margin - int(area[1])
    return 0, 0


def _colour_matrix(raw: Any, tags: Mapping[str, ExifTag]) -> Floats | None:
    """Return the matrix from XYZ to camera, [3, 3]: LibRaw's, else the DNG's ColorMatrix2 or 1."""
    xyz_matrix = np.asarray(raw.rgb_xyz_matrix, float)[:3]
    if np.any(xyz_matrix):
        return xyz_matrix
    values = numbers(
        tags, "Image ColorMatrix2", "Image Tag 0xC622", "Image ColorMatrix1", "Image Tag 0xC621"
    )
    return np.reshape(values, (3, 3)) if len(values) == 9 and np.any(values) else None


def read_mosaic(path: Path, *, lens_f_number: float = 0.0) -> Mosaic:
    """Return the visible mosaic of a raw frame, without the masked pixels at its edges.

    lens_f_number : f-number to use if the frame states none; with 0 a missing one is an error.
    Raises InputError for a file that is damaged or that LibRaw cannot open, without a Bayer mosaic,
    or without exposure time, f-number or ISO.
    """
    tags = tags_of(path)
    with opened(path) as raw:
        cfa, index = _pattern(path, raw)
        counts = raw.raw_image_visible
        if not 0 < counts.size <= _MAX_PIXELS or min(counts.shape) < 2:
            raise _damaged(
                path,
                f"a mosaic of {' x '.join(map(str, counts.shape[::-1]))} pixels",
                f"at least 2 x 2 and at most {_MAX_PIXELS / 1e6:.0f} million pixels",
            )
        black = raw.black_level_per_channel
        down, right = _visible_shift(path, raw)
        black_dn = tuple(
            float(black[index[(row + down) % 2, (column + right) % 2]])
            for row, column in channel_positions(cfa)
        )
        info = info_of(path, tags, libraw_exposure(raw), lens_f_number=lens_f_number)
        white_dn = float(raw.white_level or 0)
        if not 0 <= max(black_dn) < white_dn:
            raise _damaged(
                path,
                f"black level {max(black_dn):g}, white level {white_dn:g}",
                "a black level below the white level",
            )
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


def read_exif(path: Path, *, lens_f_number: float = 0.0) -> FrameInfo:
    """Return the exposure, time and camera of a JPEG or raw frame by its EXIF.

    For a raw frame LibRaw provides values that the EXIF lacks. lens_f_number : f-number to use if
    the frame states none; with 0 a missing one is an error. Raises InputError without exposure
    time, f-number or ISO.
    """
    tags = tags_of(path)
    with suppress(InputError):
        return info_of(path, tags, lens_f_number=lens_f_number)
    fallback = (0.0, 0.0, 0.0)
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        with opened(path) as raw:
            fallback = libraw_exposure(raw)
    return info_of(path, tags, fallback, lens_f_number=lens_f_number)
