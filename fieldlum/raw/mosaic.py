"""The mosaic of a raw frame through LibRaw, undeveloped."""

from __future__ import annotations

import io
import logging
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import InputError
from fieldlum.raw.dng import channel_positions
from fieldlum.raw.exif import FrameInfo, info_of, numbers, tags_of
from fieldlum.records import Exposure

_LARGEST_PIXELS = 400_000_000
_DAMAGE = ("data corrupted", "Unexpected end of file")
_STDERR = threading.Lock()
# Panasonic (RW2) and Olympus (ORF): LibRaw fills up what is missing of them without a word.
_TIFF_COUSINS = {b"IIU\0": b"II*\0", b"IIRO": b"II*\0", b"IIRS": b"II*\0", b"MMOR": b"MM\0*"}
_PANASONIC_OFFSET = 280  # RawDataOffset: in newer files StripOffsets is a placeholder


@dataclass(frozen=True, slots=True)
class Mosaic:
    """One raw frame. counts [h, w]; cfa names the top left 2 x 2 row by row; black_dn for R, G1,
    G2, B.

    G1 is the green in the rows of red. white_dn is the file's tag, often above the true plateau.
    colour_matrix [3, 3] takes XYZ to camera RGB, where the file or LibRaw knows it.
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


def _check_strips(path: Path) -> None:
    """Refuse a TIFF-like raw whose data reach past its end: LibRaw may fill the rest with zeros,
    or fall over.
    """
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(4)
    if head in _TIFF_COUSINS:
        return _check_cousin(path, _TIFF_COUSINS[head])
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
                    raise InputError(
                        path, f"{size} bytes, its pixels end later", "a whole file", "copy it again"
                    )
                if page.compression == 7 and counts and _bytes_at(path, offsets[0]) != b"\xff\xd8":
                    raise InputError(
                        path,
                        "its pixels are no lossless JPEG",
                        "what its tags say",
                        "copy it again",
                    )
    except InputError:
        raise
    except Exception as error:
        found = f"broken TIFF structure ({type(error).__name__})"
        raise InputError(path, found, "a raw file", "copy it from the card again") from None


def _check_cousin(path: Path, magic: bytes) -> None:
    """The same for a maker's own kind of TIFF, by offsets and lengths alone: its other tags keep
    to their own rules.
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
        raise InputError(
            path, f"{size} bytes, its pixels end later", "a whole file", "copy it again"
        )


def _bytes_at(path: Path, at: int) -> bytes:
    with path.open("rb") as file:
        file.seek(at)
        return file.read(2)


def opened(path: Path) -> Any:
    """rawpy's own object, unpacked. Raises InputError for whatever LibRaw cannot open."""
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
                path, f"{kind} by its content", "a camera raw", "give it its true suffix"
            )
    _check_strips(path)
    try:
        with _complaints() as complaints:
            raw = rawpy.imread(str(path))
            raw.unpack()
    except Exception as error:
        said = error.args[0] if error.args else type(error).__name__
        text = said.decode("ascii", "replace") if isinstance(said, bytes) else str(said)
        raise InputError(
            path,
            f"LibRaw: {text}",
            "a raw file that LibRaw supports",
            "copy it again, or convert it to DNG",
        ) from None
    if complaints:
        raw.close()
        raise InputError(
            path, f"LibRaw: {complaints[0]}", "a whole file", "copy it from the card again"
        )
    return raw


@contextmanager
def _complaints() -> Iterator[list[str]]:
    """What LibRaw says about damaged data while it goes on as if nothing were: it tells stderr, and
    nobody else.

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


def libraw_exposure(raw: Any) -> tuple[float, float, float]:
    other = raw.other
    return (
        float(other.shutter_speed or 0.0),
        float(other.aperture or 0.0),
        float(other.iso_speed or 0.0),
    )


def _pattern(path: Path, raw: Any) -> tuple[str, NDArray[np.intp]]:
    """Names and LibRaw colour indices of the top left 2 x 2 of the visible mosaic. Raises
    InputError if no Bayer.
    """
    import rawpy

    flat = (
        raw.raw_type == rawpy.RawType.Flat
        and raw.raw_pattern is not None
        and raw.raw_pattern.shape == (2, 2)
    )
    if not flat:
        kind = (
            "an X-Trans mosaic"
            if raw.raw_type == rawpy.RawType.Flat
            else "three colours in each pixel"
        )
        raise InputError(
            path, kind, "a Bayer mosaic, one colour a pixel", "use a camera with a Bayer sensor"
        )
    index = np.asarray(raw.raw_colors_visible[:2, :2], int)
    letters = raw.color_desc.decode()
    cfa = "".join(letters[i] if i < len(letters) else "?" for i in index.ravel())
    if cfa not in ("RGGB", "BGGR", "GRBG", "GBRG"):
        raise InputError(
            path,
            f"colour filters {cfa}",
            "red, green, green, blue",
            "use a camera with a Bayer sensor",
        )
    return cfa, index


def _colour_matrix(raw: Any, tags: dict[str, Any]) -> NDArray[np.float64] | None:
    """XYZ to camera: LibRaw's own table, else the DNG's ColorMatrix2 or 1."""
    known = np.asarray(raw.rgb_xyz_matrix, float)[:3]
    if np.any(known):
        return known
    values = numbers(
        tags, "Image ColorMatrix2", "Image Tag 0xC622", "Image ColorMatrix1", "Image Tag 0xC621"
    )
    return np.reshape(values, (3, 3)) if len(values) == 9 and np.any(values) else None


def read_mosaic(path: Path) -> Mosaic:
    """The visible mosaic of a raw frame, undeveloped. Raises InputError, one line, for
    everything else.
    """
    tags = tags_of(path)
    with opened(path) as raw:
        cfa, index = _pattern(path, raw)
        counts = raw.raw_image_visible
        if not 0 < counts.size <= _LARGEST_PIXELS or min(counts.shape) < 2:
            raise InputError(
                path, f"a mosaic of {counts.shape}", "a picture of a sensible size", "copy it again"
            )
        black = raw.black_level_per_channel
        black_dn = tuple(float(black[index[at]]) for at in channel_positions(cfa))
        info = info_of(path, tags, libraw_exposure(raw))
        white_dn = float(raw.white_level or 0)
        if not 0 <= max(black_dn) < white_dn:
            raise InputError(
                path,
                f"black {max(black_dn):g}, white {white_dn:g}",
                "black below white",
                "copy it again",
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


def read_exif(path: Path) -> FrameInfo:
    """EXIF of a JPEG or raw frame. Raises InputError, naming the remedy, when it has no exposure
    time.
    """
    tags = tags_of(path)
    with suppress(InputError):
        return info_of(path, tags)
    fallback = (0.0, 0.0, 0.0)
    if path.suffix.lower() not in (".jpg", ".jpeg"):
        with opened(path) as raw:
            fallback = libraw_exposure(raw)
    return info_of(path, tags, fallback)
