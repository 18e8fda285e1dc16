"""Read frames as linear camera colours, and average them over patches."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.errors import InputError
from fieldlum.core.records import Exposure
from fieldlum.core.statistics import standard_error
from fieldlum.optics.linear_light import (
    black_dn,
    check_frame,
    frame_z_per_cdm2,
    full_dn,
    linear_counts,
    response_tables,
    vignetting_of,
)
from fieldlum.optics.photometry import saturation_plateau, vignetting_at
from fieldlum.optics.profiles import CameraProfile, Lens
from fieldlum.optics.projection import angle_of_radius, relative_radius
from fieldlum.optics.raw import channel_positions, is_jpeg, read_jpeg, read_mosaic

FULL = 0.97  # of the saturation; brighter pixels do not count. Chosen, not measured.
_MAX_CLIPPED = 0.2  # largest share of clipped pixels in a patch. Chosen, not measured.


class Place(NamedTuple):
    """Where a reading was taken: x_px, y_px on a frame, or azimuth and altitude of a panorama."""

    path: Path
    x: float
    y: float


@dataclass(frozen=True, slots=True)
class Patch:
    """Mean camera R, G and B [3] of a disc on the sensor, in cd/m2 at the profile's k.

    The tenth of the pixels with the smallest and the tenth with the largest values do not count.
    u_rel : relative standard uncertainty of the mean green. clipped : share (0 to 1) of the disc's
    pixels that are saturated, or too dark for the response, and therefore omitted.
    """

    rgb: Floats
    u_rel: float
    clipped: float


@dataclass(frozen=True, slots=True)
class LinearFrame:
    """Camera colours [h, w, 3] in cd/m2 at the profile's k, not corrected for vignetting.

    rgb [h, w, 3]; bad [h, w] : True for pixels not to use: above 0.97 of the saturation, or outside
    the codes for which a JPEG's response is valid; step : sensor pixels along the edge of a pixel
    of rgb, 2 for raw and 1 for JPEG; colour_matrix : XYZ to camera colours [3, 3] as stored in a
    raw file, else None. A filter in front of the lens is not corrected.
    """

    path: Path
    rgb: Floats32
    bad: Mask
    step: int
    exposure: Exposure
    colour_matrix: Floats | None = None

    def patch(self, x_px: float, y_px: float, radius_px: float) -> Patch:
        """Return the mean colour of the good pixels in a disc of the sensor around x_px, y_px.

        All in sensor pixels. Raises InputError for a disc that is not completely
        in the picture, or if over a fifth of its pixels are bad.
        """
        h, w = self.bad.shape
        x, y, r = x_px / self.step, y_px / self.step, max(radius_px / self.step, 1.0)
        if not (r <= x <= w - r and r <= y <= h - r):
            raise InputError(
                self.path,
                f"a patch at x {x_px:g}, y {y_px:g} px with a radius of {radius_px:g} px",
                f"a patch inside the picture of {w * self.step} x {h * self.step} px",
                "correct x_px, y_px or radius_px",
            )
        rows, columns = slice(int(y - r), int(y + r) + 1), slice(int(x - r), int(x + r) + 1)
        yy, xx = np.mgrid[rows, columns]
        disc = (xx + 0.5 - x) ** 2 + (yy + 0.5 - y) ** 2 <= r**2
        values, bad = self.rgb[rows, columns][disc], self.bad[rows, columns][disc]
        if bad.mean() > _MAX_CLIPPED:
            share = f"{100 * bad.mean():.0f} % of the patch at x {x_px:g}, y {y_px:g} px"
            raise InputError(
                self.path,
                f"{share} is clipped, or too dark for the camera's response",
                f"at most {100 * _MAX_CLIPPED:.0f} % of such pixels",
                "use a frame that exposes the patch well",
            )
        return _mean(values[~bad], float(bad.mean()))


def _mean(values: Floats32, clipped: float) -> Patch:
    """Return the trimmed mean of values [n, 3]; its uncertainty is from the spread of green."""
    from scipy.stats import trim_mean

    rgb = np.asarray(trim_mean(values.astype(float), 0.1, axis=0), float)
    error = float(np.nan_to_num(standard_error(values[:, 1])))
    return Patch(rgb, error / max(float(rgb[1]), 1e-12), clipped)


def linear_frame(path: Path, profile: CameraProfile) -> LinearFrame:
    """Read a raw or JPEG frame as linear camera colours; a raw cell of 2 x 2 is one pixel.

    Raises InputError if the frame cannot be read or is of another camera.
    """
    return _from_jpeg(path, profile) if is_jpeg(path) else _from_mosaic(path, profile)


def _from_jpeg(path: Path, profile: CameraProfile) -> LinearFrame:
    frame, r = read_jpeg(path, camera_pixels=profile.camera.pixels), profile.response
    check_frame(path, frame.codes.shape, frame.model, profile)
    tables = response_tables(profile)  # [256, 3]
    z = np.stack([tables[frame.codes[..., c], c] for c in range(3)], axis=-1)
    brightest = frame.codes.max(axis=-1)
    bad = (brightest > r.high_code) | (brightest < r.low_code)
    rgb = z / frame_z_per_cdm2(frame.exposure, profile)
    return LinearFrame(path, rgb.astype(np.float32), bad, 1, frame.exposure)


def _from_mosaic(path: Path, profile: CameraProfile) -> LinearFrame:
    mosaic, sensor = read_mosaic(path, lens_f_number=profile.camera.fixed_f_number), profile.sensor
    check_frame(path, mosaic.counts.shape, mosaic.model, profile)
    black = black_dn(mosaic, profile)
    rows, columns = (n // 2 * 2 for n in mosaic.counts.shape)
    planes = [mosaic.counts[r:rows:2, c:columns:2] for r, c in channel_positions(mosaic.cfa)]
    plateaus = [saturation_plateau(plane, mosaic.white_dn) for plane in planes]
    cells = [plane.astype(np.float32) for plane in planes]
    full = full_dn(mosaic, profile, plateaus)
    bad = np.any([cell > FULL * limit for cell, limit in zip(cells, full, strict=True)], axis=0)
    red, green_1, green_2, blue = (
        linear_counts(cell - b, b, profile) / (sensor.white_dn - b)
        for cell, b in zip(cells, black, strict=True)
    )
    z = np.stack([red, (green_1 + green_2) / 2, blue], axis=-1)
    rgb = z / frame_z_per_cdm2(mosaic.exposure, profile)
    return LinearFrame(path, rgb.astype(np.float32), bad, 2, mosaic.exposure, mosaic.colour_matrix)


# ----------------------------------------------------------------------------------------------
# lens


def nearest_lens(profile: CameraProfile, x_px: float, y_px: float) -> int:
    """Return the index of the lens in whose image circle a place on the sensor is most central.

    The distance from the centre counts relative to the circle's radius.
    """
    return int(np.argmin([relative_radius(lens.geometry, x_px, y_px) for lens in profile.lens]))


def relative_angle(lens: Lens, x_px: float, y_px: float) -> float:
    """Return a place's angle from the lens's axis, over half of the lens's full angle.

    x_px, y_px : on the sensor. 0 on the axis, 1 at the edge of the image circle.
    """
    geometry = lens.geometry
    radius = relative_radius(geometry, x_px, y_px)
    return float(angle_of_radius(geometry, radius) / geometry.half_angle_rad)


def transmission(profile: CameraProfile, f_number: float, x_px: float, y_px: float) -> float:
    """Return the transmission relative to the axis of the nearest lens, at a place on the sensor.

    A value divided by it is corrected for vignetting. It is 1 if the lens has no curve. Raises
    InputError if the lens only has curves for other apertures.
    """
    lens = profile.lens[nearest_lens(profile, x_px, y_px)]
    coefficients, _ = vignetting_of(lens, f_number)
    return float(vignetting_at(coefficients, relative_angle(lens, x_px, y_px)))
