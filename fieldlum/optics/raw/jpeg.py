"""Read JPEG frames with their EXIF."""

from __future__ import annotations

import warnings
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.errors import InputError
from fieldlum.optics.raw.exif import FrameInfo, info_of, tags_of

# Largest frame without a profile that states more: 0.5 GB of codes. Chosen: phones have 108
# million pixels.
MAX_PIXELS = 160_000_000


@dataclass(frozen=True, slots=True)
class JpegFrame(FrameInfo):
    """A JPEG frame as the camera wrote it, with what its EXIF states.

    codes: values from 0 to 255 [h, w, 3], red first, not turned by the orientation tag.
    """

    codes: NDArray[np.uint8] = field(kw_only=True)


def read_jpeg(path: Path, *, camera_pixels: int = 0) -> JpegFrame:
    """Return the codes and the EXIF of a JPEG frame.

    camera_pixels : pixels of the camera by its profile, 0 without one; a frame may have as many,
    and at least `MAX_PIXELS`. Raises InputError for a file that cannot be read, is no complete
    JPEG, has more pixels, or whose EXIF lacks exposure time, f-number or ISO.
    """
    tags = tags_of(path)
    codes = _codes(path, max(MAX_PIXELS, camera_pixels))  # a cut file may lack its EXIF as well
    info = info_of(path, tags)
    return JpegFrame(info.exposure, info.t_camera, info.make, info.model, codes=codes)


def jpeg_size(path: Path) -> tuple[int, int]:
    """Return width and height [px] of a JPEG by its header, (0, 0) if it cannot be read."""
    from PIL.JpegImagePlugin import JpegImageFile

    with warnings.catch_warnings(), suppress(Exception):
        warnings.simplefilter("ignore")
        with JpegImageFile(path) as image:
            return image.size
    return 0, 0


def _codes(path: Path, max_pixels: int) -> NDArray[np.uint8]:
    """Return the codes [h, w, 3] of a JPEG's first picture.

    Pillow's class for JPEG is used directly: `Image.open` also reads the index of further pictures
    (MPF), which may be broken, and has a limit on pixels below those of current cameras.
    """
    from PIL.JpegImagePlugin import JpegImageFile

    with path.open("rb") as file:
        is_jpeg = file.read(3) == b"\xff\xd8\xff"
    try:
        with warnings.catch_warnings():
            # A warning is about data that are not used; damaged pixels are an error.
            warnings.simplefilter("ignore")
            with JpegImageFile(path) as image:
                width, height = image.size
                if width * height <= max_pixels:
                    return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
    except Exception as error:
        damage = f"the JPEG is damaged or cut short ({str(error).splitlines()[0][:80]})"
        finding = damage if is_jpeg else "the file is no JPEG"
        raise InputError(
            path, finding, "a complete JPEG", "copy the file from the card again"
        ) from None
    remedy = "state width_px and height_px of the camera in its profile, or copy the file again"
    raise InputError(path, f"{width} x {height} pixels", f"at most {max_pixels:,} pixels", remedy)
