"""Write plain DNG files; state the positions of the colours in a Bayer cell."""

from __future__ import annotations

import struct
from datetime import datetime
from fractions import Fraction
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fieldlum.core.records import Exposure
from fieldlum.optics.raw.exif import rational, time_tags
from fieldlum.session import replacing

# Types and sizes of TIFF values (TIFF 6.0, section 2).
_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _SRATIONAL = 1, 2, 3, 4, 5, 10
_FORMAT = {_BYTE: "B", _SHORT: "H", _LONG: "I"}
# XYZ (D65) to linear sRGB, IEC 61966-2-1 in Lindbloom's digits.
_XYZ_TO_SRGB = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)


def channel_positions(cfa: str) -> tuple[tuple[int, int], ...]:
    """Return the places (row, column, from 0) of R, G1, G2 and B in a mosaic's 2 x 2 cell.

    cfa: colours of the cell row by row, such as "RGGB". G1 is the green in the row of red, G2 the
    green in the row of blue.
    """
    red, blue = divmod(cfa.index("R"), 2), divmod(cfa.index("B"), 2)
    return red, (red[0], blue[1]), (blue[0], red[1]), blue


@lru_cache(maxsize=256)  # frames of a camera repeat the same values
def _ratio(value: float | Fraction) -> tuple[int, int]:
    return Fraction(value).limit_denominator(1_000_000).as_integer_ratio()


def _packed(kind: int, value: Any) -> tuple[int, bytes]:
    if kind == _ASCII:
        text = value.encode("ascii", "replace") + b"\0"
        return len(text), text
    if kind in (_RATIONAL, _SRATIONAL):
        code = "i" if kind == _SRATIONAL else "I"
        parts = [_ratio(v) for v in value]
        return len(parts), b"".join(struct.pack(f"<2{code}", *part) for part in parts)
    return len(value), struct.pack(f"<{len(value)}{_FORMAT[kind]}", *value)


def _directory(tags: dict[int, tuple[int, Any]], at: int) -> bytes:
    """Return a TIFF directory for byte `at` of the file, followed by its longer values."""
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
    """Write an uncompressed DNG with an EXIF directory; LibRaw returns the same counts exactly.

    A file at `path` is replaced. counts : [h, w] 16-bit, black level included. exposure : shutter
    time, f-number, ISO and the name of an ND filter for the EXIF. black_dn : black level for R, G1,
    G2, B, and white_dn : white level, both only recorded in the file. cfa : colours of the top left
    2 x 2 pixels row by row. t_camera : time for the EXIF, None for no time. colour_matrix : [3, 3],
    converts XYZ to camera RGB.
    """
    exif: dict[int, tuple[int, Any]] = {
        33434: (_RATIONAL, [rational(exposure.shutter_s)]),
        33437: (_RATIONAL, [rational(exposure.f_number)]),
        34855: (_SHORT, [round(exposure.iso)]),
        **{tag: (_ASCII, text) for tag, text in time_tags(t_camera).items()},
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
            **({272: (_ASCII, model)} if model else {}),
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
