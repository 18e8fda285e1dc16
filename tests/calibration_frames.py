"""Simulated frames of a small camera whose calibration is known."""

from pathlib import Path

import numpy as np

from fieldlum.core.records import Exposure
from fieldlum.optics.exposure import true_times_s, z_per_cdm2
from fieldlum.optics.profiles import (
    Bracket,
    CameraBody,
    CameraProfile,
    Colour,
    Lens,
    Sensor,
    Vignetting,
)
from fieldlum.optics.projection import LensGeometry, angle_of_radius
from fieldlum.optics.raw.writing import write_dng

SIZE = 240
TRUE_V = (1.0, 0.0, -0.10, 0.0, -0.22)
LENS = Lens((120.4, 119.3), 112.0, 186.0, vignetting=(Vignetting(5.6, TRUE_V),))
PROFILE = CameraProfile(
    CameraBody("sim", "raw", SIZE, SIZE),
    (LENS,),
    Bracket(5.6, 100.0, (0.5, 0.1)),
    sensor=Sensor("RGGB", (512.0,) * 4, (15800.0,) * 4, 16383.0, 4.0, 6.0),
    colour=Colour((0.25, 0.68, 0.07)),
)


def relative_angles() -> np.ndarray:
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5
    geometry = LensGeometry(LENS.centre_px, LENS.radius_px, LENS.full_angle_deg)
    radius = np.hypot(x - LENS.centre_px[0], y - LENS.centre_px[1]) / LENS.radius_px
    return angle_of_radius(geometry, radius) / geometry.half_angle_rad


def raw_frame(
    path: Path, rgb_cdm2: np.ndarray, exposure: Exposure, rng: np.random.Generator
) -> Path:
    """A mosaic of camera colours [h, w, 3] with the sensor's own noise."""
    per = z_per_cdm2(true_times_s(exposure.shutter_s), exposure.f_number, exposure.iso)
    mosaic = np.empty((SIZE, SIZE))
    for (r, c), channel in zip(((0, 0), (0, 1), (1, 0), (1, 1)), (0, 1, 1, 2), strict=True):
        mosaic[r::2, c::2] = rgb_cdm2[r::2, c::2, channel]
    electrons = rng.poisson(mosaic * per * (16383 - 512) * 4.0) + rng.normal(0, 6.0, mosaic.shape)
    counts = np.clip(np.rint(electrons / 4.0 + 512), 0, 15800).astype(np.uint16)
    write_dng(path, counts, cfa="RGGB", black_dn=(512,) * 4, white_dn=16383, exposure=exposure)
    return path


# The maker's sRGB codes of a chart's patches (X-Rite, ColorChecker Classic).
CHART_SRGB = np.loadtxt(
    """
    115 82 68 194 150 130 98 122 157 87 108 67 133 128 177 103 189 170
    214 126 44 80 91 166 193 90 99 94 60 108 157 188 64 224 163 46
    56 61 150 70 148 73 175 54 60 231 199 31 187 86 149 8 133 161
    243 243 242 200 200 200 160 160 160 122 122 121 85 85 85 52 52 52
    """.splitlines(),
    int,
).reshape(24, 3)
