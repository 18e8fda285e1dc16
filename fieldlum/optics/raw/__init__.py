"""Raw mosaics and JPEG frames as the camera wrote them, read without development.

LibRaw opens raw files (through rawpy), but only the mosaic is used: `postprocess` rescales each
frame by its own maximum.
"""

import logging
import mmap
import sys
import warnings
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np

from fieldlum.core.arrays import Floats, Indices, UInts8, UInts16
from fieldlum.core.errors import InputError, kind_of, library_messages
from fieldlum.core.files import open_to_read
from fieldlum.core.records import MAX_PIXELS, Cfa
from fieldlum.optics.raw import exif
from fieldlum.optics.raw.exif import FrameInfo, roll_deg_of, same_model, white_balance_is_fixed

RAW_SUFFIXES = tuple(
    ".dng .cr2 .cr3 .crw .nef .nrw .arw .raf .rw2 .orf .pef .srw .raw".split()  # noqa: SIM905
)
_DAMAGE = ("data corrupted", "Unexpected end of file")  # messages of LibRaw's data streams
_ACTIVE_AREA, _COLOUR_FILTER_ARRAY = 50829, 32803  # tag, and value of Photometric (DNG 1.7)
# With the masked pixels at the edges, at most a tenth more.
_MAX_RAW_PIXELS = 11 * MAX_PIXELS // 10
MAX_CAMERA_PIXELS = 500_000_000  # by any profile; a sensor that merges shots gives 400 million
_COLOUR_MATRICES = (50722, 50721)  # tags ColorMatrix2 and 1


@dataclass(frozen=True, slots=True, kw_only=True)
class Mosaic(FrameInfo):
    """One raw frame, with what its EXIF states.

    counts: raw counts [h, w], black level included; cfa: colours of the top left 2 x 2 pixels row
    by row, such as "RGGB"; black_dn: black level for R, G1, G2, B, with G1 the green in the rows of
    red; white_dn: white level in the file, often above the true saturation; colour_matrix: [3, 3],
    converts XYZ to camera RGB; None if neither the file nor LibRaw has it.
    """

    counts: UInts16
    cfa: Cfa
    black_dn: tuple[float, ...]
    white_dn: float
    colour_matrix: Floats | None = None


def channel_positions(cfa: str) -> tuple[tuple[int, int], ...]:
    """Return the places (row, column, from 0) of R, G1, G2 and B in a mosaic's 2 x 2 cell.

    cfa: colours of the cell row by row, such as "RGGB". G1 is the green in the row of red, G2 the
    green in the row of blue.
    """
    red, blue = divmod(cfa.index("R"), 2), divmod(cfa.index("B"), 2)
    return red, (red[0], blue[1]), (blue[0], red[1]), blue


def is_jpeg(path: Path) -> bool:
    """Return whether a file's suffix is .jpg or .jpeg in any case; the content is not read."""
    return path.suffix.lower() in (".jpg", ".jpeg")


def frame_files(*sources: Path) -> list[Path]:
    """Return the files among paths, and for a folder the raw and JPEG files in it, sorted by path.

    Its subfolders may be of other brackets and are not read. A path that is no folder is returned
    as it is, even if it does not exist. Names that begin with `.` or `@` are omitted: systems give
    such names to thumbnails and deleted files. Raises InputError for a folder without frames.
    """
    found: list[Path] = []
    for source in sources:
        inside = [
            path
            for path in sorted(source.glob("[!.@]*"))
            if (path.suffix.lower() in RAW_SUFFIXES or is_jpeg(path)) and path.is_file()
        ]
        if source.is_dir() and not inside:
            expected, remedy = "a folder with raw or JPEG frames", "check the path of the folder"
            raise InputError(source, "no frames in this folder", expected, remedy)
        found += inside if source.is_dir() else [source]
    return found


# ----------------------------------------------------------------------------------------------
# complete raw files, opened by LibRaw


def _damaged(path: Path, finding: str, expected: str) -> InputError:
    """Return the error of a damaged file, whose remedy is a new copy from the card."""
    return InputError(path, finding, expected, "copy the file from the card again")


def _pages(tiff: Any) -> list[Any]:
    """Return the pages (pictures) of a tifffile.TiffFile: at most 16, and those inside of them."""
    tops: list[Any] = [tiff.pages[i] for i in range(min(len(tiff.pages), 16))]
    return tops + [sub for top in tops for sub in (getattr(top, "pages", None) or ())]


def _check_strips(path: Path) -> None:
    """Raise InputError for a raw like a TIFF whose data reach past the end of the file.

    LibRaw may fill the missing part with zeros, or crash.
    """
    import tifffile

    logging.getLogger("tifffile").setLevel(logging.CRITICAL)
    with open_to_read(path) as file:
        head = file.read(4)
        if head not in (*exif.TIFF_VARIANTS, *exif.TIFF_VARIANTS.values()):
            return
        content = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
    content[:4] = exif.TIFF_VARIANTS.get(head, head)
    end = 0
    try:
        with tifffile.TiffFile(content) as tiff:  # pyright: ignore[reportArgumentType]
            if head in exif.TIFF_VARIANTS:
                end = _end_of_variant(tiff.pages.first.tags)
            else:
                end = max(_end_of(page, content, path) for page in _pages(tiff))
    except InputError:
        raise
    except Exception as error:
        if head in exif.TIFF_VARIANTS:  # its other tags follow rules of the maker
            return
        finding = f"broken TIFF structure ({type(error).__name__})"
        raise _damaged(path, finding, "a raw file") from None
    if end > len(content):
        raise _damaged(path, f"{len(content)} bytes, its pixels end later", "a complete file")


def _end_of_variant(tags: Any) -> int:
    """Return the byte after the last pixel in a variant of TIFF; tags: of its first page."""
    lengths = np.ravel(tags.valueof("StripByteCounts", 0))
    # tag 280, Panasonic's RawDataOffset: in newer files StripOffsets is a placeholder
    offsets = np.ravel(tags.valueof(280) or tags.valueof("StripOffsets", 0))
    return max(int(at) + int(n) for at, n in zip(offsets, lengths, strict=False))


def _end_of(page: Any, content: mmap.mmap, path: Path) -> int:
    """Return the byte after a page's last pixel in its file; sys.maxsize if strips are missing.

    page: of tifffile; content: the complete file. Raises InputError for pixels that are no lossless
    JPEG although the tags state it.
    """
    offsets, counts = page.dataoffsets, page.databytecounts
    if page.compression == 7 and counts and content[offsets[0] : offsets[0] + 2] != b"\xff\xd8":
        raise _damaged(path, "its pixels are no lossless JPEG", "what its tags state")
    bits = page.imagelength * page.imagewidth * page.bitspersample * page.samplesperpixel
    if page.compression == 1 and counts and 8 * sum(counts) < bits:
        return sys.maxsize
    return max((at + n for at, n in zip(offsets, counts, strict=False)), default=0)


def open_raw(path: Path) -> Any:
    """Return a raw file as rawpy's object with unpacked pixels, which the caller must close.

    Raises InputError for a file that is damaged, is no raw file, or is not supported by LibRaw, and
    OSError for one that cannot be opened. While LibRaw reads, stderr of the process is collected.
    """
    import rawpy

    with open_to_read(path) as file:
        kind = kind_of(file.read(16))
    if kind == "a JPEG picture":
        remedy = "name the camera's raw files" if is_jpeg(path) else "give the file the suffix .jpg"
        raise InputError(path, "the file's content is a JPEG", "a camera raw", remedy)
    _check_strips(path)
    try:
        with library_messages(*_DAMAGE) as damage:
            raw = rawpy.imread(str(path))
            size = (raw.sizes.raw_width, raw.sizes.raw_height)
            if is_small := 0 < size[0] * size[1] <= _MAX_RAW_PIXELS:
                raw.unpack()
    except Exception as error:
        reason = error.args[0] if error.args else type(error).__name__
        text = reason.decode("ascii", "replace") if isinstance(reason, bytes) else str(reason)
        remedy = "leave the file out if it is no frame; else copy it again or convert it to DNG"
        expected = "a raw file that LibRaw supports"
        raise InputError(path, kind or f"LibRaw: {text}", expected, remedy) from None
    if is_small and not damage:
        return raw
    raw.close()
    if not is_small:
        finding = f"a mosaic of {size[0]} x {size[1]} pixels"
        raise _damaged(path, finding, f"1 to {_MAX_RAW_PIXELS:,} pixels")
    raise _damaged(path, f"LibRaw: {damage[0]}", "a complete file")


def _fields(info: FrameInfo) -> dict[str, Any]:
    """Return the fields of a FrameInfo by name, for a record that adds pixels to them."""
    return {name: getattr(info, name) for name in ("exposure", "t_camera", "make", "model")}


def _libraw_exposure(raw: Any) -> tuple[float, float, float]:
    """Return the shutter time [s], f-number and ISO that LibRaw read; 0 for a missing one."""
    other = raw.other
    return other.shutter_speed or 0.0, other.aperture or 0.0, float(other.iso_speed or 0.0)


def _pattern(path: Path, raw: Any) -> tuple[Cfa, Indices]:
    """Return the colours and LibRaw's colour indices of the top left 2 x 2 visible pixels.

    raw: the file as rawpy opened it. Raises InputError without a Bayer mosaic.
    """
    import rawpy

    shape = (1, 1) if raw.raw_pattern is None else raw.raw_pattern.shape
    found = f"a mosaic of {shape[0]} x {shape[1]} colour filters"
    if raw.raw_type != rawpy.RawType.Flat:
        found = "three colours in each pixel"
    elif shape == (2, 2):
        index = np.asarray(raw.raw_colors_visible[:2, :2], int)
        letters = raw.color_desc.decode()
        cfa = "".join(letters[i] if i < len(letters) else "?" for i in index.ravel())
        if cfa in get_args(Cfa):
            return cast("Cfa", cfa), index
        found = f"a mosaic of the colour filters {cfa}"
    expected = "a Bayer mosaic, of 2 x 2 filters: one red, two green, one blue"
    raise InputError(path, found, expected, "use a camera with a Bayer sensor")


def _visible_shift(path: Path, raw: Any) -> tuple[int, int]:
    """Return by how many rows and columns LibRaw's visible mosaic starts inside a DNG's ActiveArea.

    LibRaw rounds an uneven start up to an even one. The colours follow, but the black levels, whose
    2 x 2 cell begins at the ActiveArea (DNG 1.7, BlackLevel), do not. (0, 0) for other files.
    """
    import tifffile

    with suppress(Exception), tifffile.TiffFile(path) as tiff:
        for page in _pages(tiff):
            area = page.tags.valueof(_ACTIVE_AREA)
            if area is not None and page.photometric == _COLOUR_FILTER_ARRAY:
                return raw.sizes.top_margin - int(area[0]), raw.sizes.left_margin - int(area[1])
    return 0, 0


def _colour_matrix(raw: Any, tags: exif.Tags) -> Floats | None:
    """Return the matrix from XYZ to camera, [3, 3]: LibRaw's, else the DNG's ColorMatrix2 or 1."""
    xyz_matrix = np.asarray(raw.rgb_xyz_matrix, float)[:3]
    if np.any(xyz_matrix):
        return xyz_matrix
    values = exif.numbers(tags, *_COLOUR_MATRICES)
    return np.reshape(values, (3, 3)) if len(values) == 9 and np.any(values) else None


def read_mosaic(path: Path, *, lens_f_number: float = 0.0) -> Mosaic:
    """Return the visible mosaic of a raw frame, without the masked pixels at its edges.

    lens_f_number: f-number to use if the frame states none; with 0 a missing one is an error.
    Raises InputError for a file that is damaged or that LibRaw cannot open, without a Bayer mosaic,
    or without exposure time, f-number or ISO.
    """
    tags = exif.tags_of(path)
    with open_raw(path) as raw:
        cfa, index = _pattern(path, raw)
        counts = raw.raw_image_visible
        if not 0 < counts.size <= MAX_PIXELS or min(counts.shape) < 2:
            finding = f"a mosaic of {' x '.join(map(str, counts.shape[::-1]))} pixels"
            raise _damaged(path, finding, f"at least 2 x 2 and at most {MAX_PIXELS:,} pixels")
        black = raw.black_level_per_channel
        down, right = _visible_shift(path, raw)
        black_dn = tuple(
            float(black[index[(row + down) % 2, (column + right) % 2]])
            for row, column in channel_positions(cfa)
        )
        info = exif.info_of(path, tags, lambda _: _libraw_exposure(raw), lens_f_number)
        white_dn = float(raw.white_level or 0)
        if not 0 <= max(black_dn) < white_dn:
            finding = f"black level {max(black_dn):g}, white level {white_dn:g}"
            raise _damaged(path, finding, "a black level below the white level")
        return Mosaic(
            **_fields(info),
            counts=counts.astype(np.uint16),
            cfa=cfa,
            black_dn=black_dn,
            white_dn=white_dn,
            colour_matrix=_colour_matrix(raw, tags),
        )


def read_exif(path: Path, *, lens_f_number: float = 0.0) -> FrameInfo:
    """Return the exposure, time and camera of a JPEG or raw frame by its EXIF.

    For a raw frame LibRaw provides values that the EXIF lacks, for a JPEG exiftool or exiv2 where
    it is installed. lens_f_number: f-number to use if the frame states none; with 0 a missing one
    is an error. Raises InputError without exposure time, f-number or ISO.
    """
    tags = exif.tags_of(path)
    try:
        return exif.info_of(path, tags, _by_program, lens_f_number)
    except InputError:
        if is_jpeg(path):
            _codes(path, MAX_CAMERA_PIXELS)  # damage is the cause, if the file is damaged
        raise


def _by_program(path: Path) -> tuple[float, float, float]:
    """Return shutter time [s], f-number and ISO by LibRaw, of a JPEG by exiftool; 0 for missing."""
    if is_jpeg(path):
        return exif.by_other_program(path)
    with open_raw(path) as raw:
        return _libraw_exposure(raw)


# ----------------------------------------------------------------------------------------------
# JPEG frames


@dataclass(frozen=True, slots=True)
class JpegFrame(FrameInfo):
    """A JPEG frame as the camera wrote it, with what its EXIF states.

    codes: values from 0 to 255 [h, w, 3], red first, not turned by the orientation tag.
    """

    codes: UInts8 = field(kw_only=True)


def read_jpeg(path: Path, *, camera_pixels: int = 0) -> JpegFrame:
    """Return the codes and the EXIF of a JPEG frame.

    camera_pixels: pixels of the camera by its profile, 0 without one; a frame may have as many (up
    to 500 million), and at least `MAX_PIXELS`. Raises InputError for a file that cannot be read, is
    no complete JPEG, has more pixels, or whose EXIF lacks exposure time, f-number or ISO.
    """
    tags = exif.tags_of(path)
    # Before the exposure, because a cut file may lack it as well.
    codes = _codes(path, max(MAX_PIXELS, min(camera_pixels, MAX_CAMERA_PIXELS)))
    return JpegFrame(**_fields(exif.info_of(path, tags, _by_program)), codes=codes)


def jpeg_size(path: Path) -> tuple[int, int]:
    """Return width and height [px] of a JPEG by its header, (0, 0) if it cannot be read."""
    from PIL.JpegImagePlugin import JpegImageFile

    with warnings.catch_warnings(action="ignore"), suppress(Exception), open_to_read(path) as file:
        return JpegImageFile(file).size
    return 0, 0


def _codes(path: Path, max_pixels: int) -> UInts8:
    """Return the codes [h, w, 3] of a JPEG's first picture.

    Pillow's class for JPEG is used directly: `Image.open` also reads the index of further pictures
    (MPF), which may be broken, and has a limit on pixels below those of current cameras.
    max_pixels: more are refused.
    """
    from PIL.JpegImagePlugin import JpegImageFile

    with open_to_read(path) as file:
        kind = kind_of(file.read(16))
    try:
        # A warning is about data that are not used; damaged pixels are an error.
        with warnings.catch_warnings(action="ignore"), JpegImageFile(path) as image:
            width, height = image.size
            if width * height <= max_pixels:
                return np.asarray(image if image.mode == "RGB" else image.convert("RGB"))
    except Exception as error:
        damage = f"the JPEG is damaged or cut short ({str(error).splitlines()[0][:80]})"
        if kind and kind != "a JPEG picture":
            remedy = "name the JPEG files that the camera wrote"
            found = f"the file is no JPEG, but {kind}"
            raise InputError(path, found, "a complete JPEG", remedy) from None
        finding = damage if kind else "the file is no JPEG"
        raise _damaged(path, finding, "a complete JPEG") from None
    remedy = "state width_px and height_px of the camera in its profile, or copy the file again"
    raise InputError(path, f"{width} x {height} pixels", f"at most {max_pixels:,} pixels", remedy)


def unreadable(path: Path, *, camera_pixels: int = 0) -> str:
    """Return why the pixels of a JPEG or raw frame cannot be read; "" if they can.

    Decodes the frame, which takes some seconds for a large raw file. A missing f-number is no
    reason for a raw frame. camera_pixels: pixels of the camera by its profile, which a JPEG may
    have, 0 without a profile.
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
