"""Check whether the pixels of a frame can be read."""

from __future__ import annotations

from pathlib import Path

from fieldlum.core.errors import InputError
from fieldlum.optics.raw.jpeg import read_jpeg
from fieldlum.optics.raw.mosaic import read_mosaic

_RAW = ".dng .cr2 .cr3 .crw .nef .nrw .arw .raf .rw2 .orf .pef .srw .raw"
RAW_SUFFIXES = tuple(_RAW.split())
_JPEG_SUFFIXES = (".jpg", ".jpeg")
_NO_FRAMES = {".json", ".toml", ".csv", ".txt", ".xmp", ".tmp", ".part"}


def is_jpeg(path: Path) -> bool:
    """Return whether a file's suffix is .jpg or .jpeg in any case; the content is not read."""
    return path.suffix.lower() in _JPEG_SUFFIXES


def possible_frames(folder: Path) -> list[Path]:
    """Return the files in a folder that can be frames, sorted by path.

    Hidden files, files with the suffix of a text or of an unfinished copy, and folders are omitted.
    """
    files = (path for path in folder.iterdir() if path.is_file() and path.name[0] != ".")
    return sorted(path for path in files if path.suffix.lower() not in _NO_FRAMES)


def unreadable(path: Path, *, camera_pixels: int = 0) -> str:
    """Return why the pixels of a JPEG or raw frame cannot be read; "" if they can.

    Decodes the frame, which takes some seconds for a large raw file. A missing f-number is no
    reason for a raw frame. camera_pixels : as for `read_jpeg`.
    """
    try:
        if is_jpeg(path):
            read_jpeg(path, camera_pixels=camera_pixels)
        else:  # a lens without electronics is no fault of the file
            read_mosaic(path, lens_f_number=1.0)
    except InputError as error:
        return error.found
    except OSError as error:
        return error.strerror or str(error)
    return ""
