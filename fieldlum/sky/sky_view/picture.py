"""Hold the luminance around what can be sky, at the sensor's resolution, of one capture.

`merge` writes one file for each slot, panoramas/SLOT.sky.npz. For a csv of panoramas the picture is
cut from the panorama, at the panorama's own size.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.errors import input_errors
from fieldlum.core.records import Flag, Panorama, parse_utc, utc_text
from fieldlum.optics.images import read_panorama
from fieldlum.optics.projection import altitude_azimuth_deg, direction
from fieldlum.session.codec import NPZ_ERRORS
from fieldlum.session.writing import replacing

FORMAT = 1  # of the file; docs/file-formats.md
SUFFIX = ".sky.npz"
# Lowest altitude of a cut: refraction and half a disc at the horizon, and a camera 1 degree off
# level. Chosen.
LOWEST_ALTITUDE_DEG = -2.0
# Codes of luminance in a file: 0 is missing, 1 to 65535 are log10 cd/m2 from -2 to 10, in steps of
# 0.04 %. A disc is 10^9.3 cd/m2.
_LOG10_RANGE = (-2.0, 10.0)
_MOST_CODE = 65535


@dataclass(frozen=True, slots=True)
class SkyGrid:
    """An equirectangular part of the sphere, with square pixels in altitude and azimuth.

    Row 0 is at the top. first_altitude_deg: upper edge of row 0; first_azimuth_deg: left edge of
    column 0, clockwise from the panorama's centre column; step_deg: size of a pixel; heading_deg:
    azimuth of the panorama's centre column, clockwise from true north, as stated.
    """

    first_altitude_deg: float
    first_azimuth_deg: float
    step_deg: float
    heading_deg: float
    height: int
    width: int

    @property
    def altitudes_deg(self) -> Floats:
        """Altitude of each row's centre, [height]."""
        return self.first_altitude_deg - (np.arange(self.height) + 0.5) * self.step_deg

    @property
    def azimuths_deg(self) -> Floats:
        """Azimuth of each column's centre, clockwise from true north, [width]."""
        return (
            self.heading_deg
            + self.first_azimuth_deg
            + (np.arange(self.width) + 0.5) * self.step_deg
        )

    def rays(self, rows: slice = slice(None)) -> Floats:
        """Return the unit vector to each pixel's centre, of some rows, [rows, width, 3]."""
        return direction(self.altitudes_deg[rows, None], self.azimuths_deg[None, :])

    def pixels(self, towards: ArrayLike) -> tuple[Floats, Floats]:
        """Return the continuous (row, column) of unit vectors [..., 3], [...] each.

        Pixel (i, j) covers [i, i + 1) x [j, j + 1). Columns wrap into [0, 360 / step_deg).
        """
        altitude, azimuth = altitude_azimuth_deg(np.asarray(towards, float))
        row = (self.first_altitude_deg - altitude) / self.step_deg
        turn = (azimuth - self.heading_deg - self.first_azimuth_deg) % 360.0
        return row, turn / self.step_deg


@dataclass(frozen=True, slots=True)
class SkyPicture:
    """The luminance of one capture in the directions that can be sky.

    luminance_cdm2 [h, w] : NaN where no lens saw or where merge did not keep it. clipped [h, w] :
    True where the luminance is a lower bound. rgb [h, w, 3] : None without colour. dark_cdm2 : what
    merge saw but did not keep is darker than this; None if it kept all.
    """

    luminance_cdm2: Floats32
    clipped: Mask
    grid: SkyGrid
    t_utc: datetime | None = None
    rgb: Floats32 | None = None
    dark_cdm2: float | None = None


def write_sky_picture(path: Path, picture: SkyPicture) -> None:
    """Write a picture as .npz: luminance coded in 16 bits, to 0.04 %; colour is not stored."""
    least, most = _LOG10_RANGE
    light = np.asarray(picture.luminance_cdm2, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        step = (np.log10(np.maximum(light, 10.0**least)) - least) / (most - least)
    code = np.where(np.isfinite(light), 1.0 + np.clip(step, 0.0, 1.0) * (_MOST_CODE - 1), 0.0)
    grid = picture.grid
    with replacing(path) as file:
        np.savez_compressed(
            file,
            format=FORMAT,
            code=np.round(code).astype(np.uint16),
            clipped=np.packbits(picture.clipped),
            first_altitude_deg=grid.first_altitude_deg,
            first_azimuth_deg=grid.first_azimuth_deg,
            step_deg=grid.step_deg,
            heading_deg=grid.heading_deg,
            t_utc=utc_text(picture.t_utc) if picture.t_utc else "",
            dark_cdm2=np.nan if picture.dark_cdm2 is None else picture.dark_cdm2,
        )


def read_sky_picture(path: Path) -> SkyPicture:
    """Read a picture that `write_sky_picture` wrote. Raises InputError for other content."""
    expected = f"a sky picture of format 1 to {FORMAT}"
    with (
        input_errors(path, expected, "merge the bracket again (fieldlum merge)", *NPZ_ERRORS),
        path.open("rb") as file,
        np.load(file, allow_pickle=False) as stored,
    ):
        if int(stored["format"]) > FORMAT:
            raise ValueError(f"format {int(stored['format'])}")
        code = stored["code"]
        height, width = code.shape
        least, most = _LOG10_RANGE
        table = 10.0 ** (
            least + (np.arange(_MOST_CODE + 1) - 1.0) / (_MOST_CODE - 1) * (most - least)
        )
        table[0] = np.nan
        clipped = np.unpackbits(stored["clipped"], count=height * width).reshape(height, width)
        grid = SkyGrid(
            float(stored["first_altitude_deg"]),
            float(stored["first_azimuth_deg"]),
            float(stored["step_deg"]),
            float(stored["heading_deg"]),
            height,
            width,
        )
        moment, dark = str(stored["t_utc"]), float(stored["dark_cdm2"])
        return SkyPicture(
            table.astype(np.float32)[code],
            clipped.astype(bool),
            grid,
            parse_utc(moment) if moment else None,
            dark_cdm2=None if np.isnan(dark) else dark,
        )


def cut_panorama(panorama: Panorama, heading_deg: float | None = None) -> SkyPicture:
    """Return the rows of a panorama that can be sky, at the panorama's own size.

    heading_deg: azimuth of the centre column, None for that of the panorama.
    """
    height, width = panorama.luminance_cdm2.shape
    step_deg = 180.0 / height
    rows = min(height, int(np.ceil((90.0 - LOWEST_ALTITUDE_DEG) / step_deg)))
    light = np.array(panorama.luminance_cdm2[:rows], np.float32)
    flags = np.zeros(light.shape, np.uint16) if panorama.flags is None else panorama.flags[:rows]
    light[(flags & Flag.OUTSIDE_LENS) > 0] = np.nan
    return SkyPicture(
        light,
        (flags & (Flag.CLIPPED_HIGH | Flag.BLOOM)) > 0,
        SkyGrid(
            90.0,
            -180.0,
            step_deg,
            panorama.heading_deg if heading_deg is None else heading_deg,
            rows,
            width,
        ),
        panorama.t_utc,
        None if panorama.rgb is None else np.asarray(panorama.rgb[:rows], np.float32),
    )


def sky_picture(panorama: Path, heading_deg: float | None = None) -> SkyPicture:
    """Return the sky picture of a panorama's file.

    It is that of merge, SLOT.sky.npz in the same folder; without one it is cut from the panorama.
    heading_deg: azimuth of the centre column where the panorama's file has none. Raises InputError
    for an unusable file.
    """
    own = panorama.with_name(panorama.name.removesuffix(panorama.suffix) + SUFFIX)
    if own.is_file():
        return read_sky_picture(own)
    return cut_panorama(read_panorama(panorama), heading_deg)
