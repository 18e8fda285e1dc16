"""Whether a frame's pixels can be read."""

from __future__ import annotations

from pathlib import Path

from fieldlum.errors import InputError
from fieldlum.raw.jpeg import read_jpeg
from fieldlum.raw.mosaic import read_mosaic

JPEG_SUFFIXES = (".jpg", ".jpeg")


def unreadable(path: Path) -> str:
    """Return why the pixels of a frame cannot be read, or an empty text.

    Decodes the frame, which takes some seconds for a large raw file.
    """
    try:
        read_jpeg(path) if path.suffix.lower() in JPEG_SUFFIXES else read_mosaic(
            path, lens_f_number=1.0
        )  # a lens without electronics is no fault of the file
    except InputError as error:
        return error.found
    except OSError as error:
        return error.strerror or str(error)
    return ""
