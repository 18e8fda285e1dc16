"""Write plain DNG and JPEG frames with their EXIF, as a camera does."""

from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.core.arrays import ArrayLike, UInts8, UInts16
from fieldlum.core.records import Exposure
from fieldlum.optics.raw import channel_positions

# Types of TIFF values (TIFF 6.0, section 2), for the tags that Pillow does not know.
_BYTE, _ASCII, _SHORT, _LONG, _RATIONAL, _SRATIONAL = 1, 2, 3, 4, 5, 10
# XYZ (D65) to linear sRGB, IEC 61966-2-1 in Lindbloom's digits.
_XYZ_TO_SRGB = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)


def _fractions(*values: float) -> tuple[Any, ...]:
    """Return numbers as the fractions that a camera writes: 0.004 as 1/250."""
    from PIL.TiffImagePlugin import IFDRational

    numbers = [(value, int(1e9 / max(abs(value), 1.0))) for value in values]
    # numerator and denominator have 32 bits
    return tuple(IFDRational(Fraction(v).limit_denominator(limit)) for v, limit in numbers)


def _exif_fields(exposure: Exposure, t_camera: datetime | None) -> dict[int, Any]:
    """Return the tags of the Exif directory: exposure, and DateTimeOriginal with its fraction.

    A time with an offset from UTC has OffsetTimeOriginal too.
    """
    shutter_s, f_number = _fractions(exposure.shutter_s, exposure.f_number)
    # ExposureTime, FNumber, PhotographicSensitivity, then DateTimeOriginal with its fraction and
    # offset (EXIF 2.32)
    fields: dict[int, Any] = {33434: shutter_s, 33437: f_number, 34855: round(exposure.iso)}
    if t_camera is not None:
        fields[36867] = t_camera.strftime("%Y:%m:%d %H:%M:%S")
        fields[37521] = f"{t_camera.microsecond // 1000:03d}"
        if offset := t_camera.strftime("%z"):
            fields[36881] = f"{offset[:3]}:{offset[3:5]}"
    return fields


def write_dng(
    path: Path,
    counts: UInts16,
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

    A file at `path` is replaced; capture flushes it to disk and renames it. counts: [h, w] 16-bit,
    black level included. exposure: shutter time, f-number, ISO and the name of an ND filter for the
    EXIF. black_dn: black level for R, G1, G2, B, and white_dn: white level, both only recorded in
    the file. cfa: colours of the top left 2 x 2 pixels row by row. t_camera, make, model: time and
    camera for the EXIF, None or "" for none. colour_matrix: [3, 3], converts XYZ to camera RGB.
    """
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    black = dict(zip(channel_positions(cfa), black_dn, strict=True))
    height, width = counts.shape
    of_dng = {
        254: (_LONG, 0),  # NewSubfileType
        33421: (_SHORT, (2, 2)),  # CFARepeatPatternDim
        33422: (_BYTE, bytes("RGB".index(c) for c in cfa)),  # CFAPattern
        50706: (_BYTE, bytes((1, 4, 0, 0))),  # DNGVersion
        50707: (_BYTE, bytes((1, 1, 0, 0))),  # DNGBackwardVersion
        50708: (_ASCII, f"{make} {model or 'camera'}"),  # UniqueCameraModel
        50713: (_SHORT, (2, 2)),  # BlackLevelRepeatDim, then BlackLevel and WhiteLevel
        50714: (_RATIONAL, _fractions(*(black[at] for at in np.ndindex(2, 2)))),
        50717: (_LONG, round(white_dn)),
        50721: (_SRATIONAL, _fractions(*np.ravel(colour_matrix).tolist())),  # ColorMatrix1
        50728: (_RATIONAL, _fractions(1, 1, 1)),  # AsShotNeutral
        50778: (_SHORT, 21),  # CalibrationIlluminant1: D65
    }
    directory = ImageFileDirectory_v2(prefix=b"II")
    directory.tagtype.update({number: kind for number, (kind, _) in of_dng.items()})
    directory.update({number: value for number, (_, value) in of_dng.items()})
    # ImageDescription, Make, Model
    texts = {270: exposure.nd and f"ND={exposure.nd}", 271: make, 272: model}
    directory.update({number: text for number, text in texts.items() if text})
    # TIFF 6.0: size, 16 bits, uncompressed, colour filter array, one strip; Pillow adds to its
    # offset where the directory ends.
    directory.update({256: width, 257: height, 258: 16, 259: 1, 262: 32803, 273: 0, 274: 1})
    directory.update({277: 1, 278: height, 279: 2 * height * width, 284: 1})
    # the pointer to the Exif directory
    directory[34665] = _exif_fields(exposure, t_camera)
    with path.open("wb") as file:
        directory.save(file)
        file.write(np.ascontiguousarray(counts, "<u2").tobytes())


def write_jpeg(
    path: Path,
    codes: UInts8,
    exposure: Exposure,
    *,
    t_camera: datetime | None = None,
    make: str = "fieldlum",
    model: str = "",
    quality: int = 97,
) -> None:
    """Write codes [h, w, 3], red first, as a JPEG with EXIF, without chroma subsampling.

    A file at `path` is replaced. exposure: shutter time, f-number, ISO and the name of an ND filter
    for the EXIF; t_camera, make, model: time and camera for the EXIF, None or "" for none; quality:
    of the JPEG, 1 to 100.
    """
    from PIL import Image

    exif = Image.Exif()
    exif.update({0x010F: make, 0x0110: model})
    if exposure.nd:
        exif[0x010E] = f"ND={exposure.nd}"
    # WhiteBalance: manual
    exif.get_ifd(0x8769).update({**_exif_fields(exposure, t_camera), 41987: 1})
    with path.open("wb") as file:
        Image.fromarray(codes, "RGB").save(file, "JPEG", quality=quality, subsampling=0, exif=exif)
