"""Read and write luminance pictures: EXR and Radiance .hdr, with headers for other programs."""

from fieldlum.optics.images.exr import calibration_mark, read_exr, write_panorama
from fieldlum.optics.images.panorama import read_panorama
from fieldlum.optics.images.programs import radiance_program
from fieldlum.optics.images.radiance import (
    encode_rgbe,
    read_radiance_hdr,
    read_radiance_header,
    read_radiance_luminance,
    write_radiance_hdr,
)
from fieldlum.optics.images.radiance_header import (
    PANORAMA_LINE,
    RADIANCE_LM_PER_W,
    RADIANCE_Y,
    RadianceHeader,
)
