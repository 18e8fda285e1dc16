"""Raw mosaics and JPEG frames as the camera wrote them, read and written without development.

LibRaw opens raw files (through rawpy), but only the mosaic is used: `postprocess` rescales each
frame by its own maximum.
"""

from fieldlum.optics.raw.exif import FrameInfo, roll_deg_of, same_model, white_balance_is_fixed
from fieldlum.optics.raw.integrity import RAW_SUFFIXES, is_jpeg, possible_frames, unreadable
from fieldlum.optics.raw.jpeg import jpeg_size, read_jpeg
from fieldlum.optics.raw.mosaic import Mosaic, channel_positions, read_exif, read_mosaic
from fieldlum.optics.raw.writing import write_dng, write_jpeg
