"""Read and write JPEG frames with their EXIF."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.errors import InputError
from fieldlum.raw.exif import info_of, rational, tags_of, time_tags
from fieldlum.records import Exposure
from fieldlum.session import replacing


@dataclass(frozen=True, slots=True)
class JpegFrame:
    """A JPEG frame as the camera wrote it.

    codes: values from 0 to 255 [h, w, 3], red first, not turned by the orientation tag; exposure:
    by the EXIF; t_camera: time by the camera's own clock, naive unless the EXIF states its offset
    from UTC; None if not recorded; make, model: of the camera, "" if not recorded.
    """

    codes: NDArray[np.uint8]
    exposure: Exposure
    t_camera: datetime | None = None
    make: str = ""
    model: str = ""


def read_jpeg(path: Path) -> JpegFrame:
    """Return the codes and the EXIF of a JPEG frame.

    Raises InputError for a file that cannot be read, is no complete JPEG, or whose EXIF lacks
    exposure time, f-number or ISO.
    """
    import warnings

    from PIL import Image

    info = info_of(path, tags_of(path))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            with Image.open(path, formats=("JPEG",)) as image:
                codes = np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
    except Exception as error:
        finding = (
            "the file is no JPEG"
            if type(error).__name__ == "UnidentifiedImageError"
            else str(error).splitlines()[0]
        )
        raise InputError(
            path, finding, "a complete JPEG", "copy the file from the card again"
        ) from None
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
    """Write codes [h, w, 3], red first, as a JPEG with EXIF, without chroma subsampling.

    A file at `path` is replaced. exposure: shutter time, f-number, ISO and the name of an ND filter
    for the EXIF; t_camera: time for the EXIF, None for no time; quality: 1 to 100, as in Pillow.
    """
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    exif = Image.Exif()
    exif[0x010F], exif[0x0110] = make, model
    fields = exif.get_ifd(0x8769)
    fields[33434] = IFDRational(rational(exposure.shutter_s))
    fields[33437] = IFDRational(rational(exposure.f_number))
    fields[34855] = round(exposure.iso)
    if exposure.nd:
        exif[0x010E] = f"ND={exposure.nd}"
    for tag, text in time_tags(t_camera).items():
        fields[tag] = text
    with replacing(path) as file:
        Image.fromarray(codes, "RGB").save(file, "JPEG", quality=quality, subsampling=0, exif=exif)
