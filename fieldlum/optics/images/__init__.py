"""Read and write luminance pictures: EXR and Radiance .hdr, with headers for other programs."""

from fieldlum.optics.images.exr import calibration_mark, read_exr, read_panorama, write_panorama
from fieldlum.optics.images.radiance import (
    PANORAMA_LINE,
    RADIANCE_CHROMATICITIES,
    RADIANCE_LM_PER_W,
    RADIANCE_Y,
    RadianceHeader,
    encode_rgbe,
    luminance_weights,
    radiance_program,
    read_radiance_hdr,
    rgb_to_xyz,
    write_radiance_hdr,
)
