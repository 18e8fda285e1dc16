"""Raw mosaics and JPEG frames as the camera wrote them, read and written without development.

LibRaw opens raw files (through rawpy), but only the mosaic is used: `postprocess` rescales each
frame by its own maximum.
"""

from fieldlum.raw.dng import channel_positions, write_dng
from fieldlum.raw.exif import FrameInfo, roll_deg_of, same_model
from fieldlum.raw.integrity import RAW_SUFFIXES, is_jpeg, possible_frames, unreadable
from fieldlum.raw.jpeg import jpeg_size, read_jpeg, write_jpeg
from fieldlum.raw.mosaic import Mosaic, read_exif, read_mosaic
