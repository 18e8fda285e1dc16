"""Raw mosaics and JPEG frames as the camera wrote them, read and written without development.

LibRaw opens raw files (through rawpy), but only the mosaic is used: `postprocess` rescales each
frame by its own maximum.
"""

from fieldlum.optics.raw.exif import FrameInfo, roll_deg_of, same_model, white_balance_is_fixed
from fieldlum.optics.raw.pixels import (
    RAW_SUFFIXES,
    Mosaic,
    channel_positions,
    frame_files,
    is_jpeg,
    jpeg_size,
    read_exif,
    read_jpeg,
    read_mosaic,
    unreadable,
)
from fieldlum.optics.raw.writing import write_dng, write_jpeg
