"""Store one capture's luminance in the directions that can be sky, at the sensor's resolution.

`merge` writes one file for each slot, panoramas/SLOT.sky.npz. For a csv of panoramas the picture is
cut from the panorama, at the panorama's own size.
"""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import ArrayLike, Floats, Floats32, Indices, Mask
from fieldlum.core.files import replacing
from fieldlum.core.records import Flag, Panorama
from fieldlum.optics.projection import altitude_azimuth_deg, direction
from fieldlum.session.codec import open_arrays

FORMAT = 1  # of the file; docs/file-formats.md
SUFFIX = ".sky.npz"
# Lowest altitude of a cut: refraction and half a disc at the horizon, and a camera 1 degree off
# level. Chosen.
LOWEST_ALTITUDE_DEG = -2.0
# Codes of luminance in a file: 0 is missing, 1 to 65535 are log10 cd/m2 from -2 to 10, in steps of
# 0.04 %. A disc is 10^9.3 cd/m2.
_LOG10_RANGE = (-2.0, 10.0)
_MAX_CODE = 65535


@dataclass(frozen=True, slots=True, kw_only=True)
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
        left_deg = self.heading_deg + self.first_azimuth_deg
        return left_deg + (np.arange(self.width) + 0.5) * self.step_deg

    def rays(self) -> Floats:
        """Return the unit vector to each pixel's centre, [height, width, 3].

        The vectors have x east, y north, z up.
        """
        return direction(self.altitudes_deg[:, None], self.azimuths_deg[None, :])

    def pixels(self, towards: ArrayLike) -> tuple[Floats, Floats]:
        """Return the continuous (row, column) of unit vectors [..., 3], [...] each.

        Pixel (i, j) covers [i, i + 1) x [j, j + 1). Columns wrap into [0, 360 / step_deg). The
        vectors have x east, y north, z up.
        """
        altitude, azimuth = altitude_azimuth_deg(np.asarray(towards, float))
        row = (self.first_altitude_deg - altitude) / self.step_deg
        turn = (azimuth - self.heading_deg - self.first_azimuth_deg) % 360.0
        return row, turn / self.step_deg

    def indices(self, towards: ArrayLike) -> tuple[Mask, Indices, Indices]:
        """Return whether unit vectors [..., 3] are on the grid, their rows and columns, [...] each.

        Row and column of directions that are not on the grid, or are NaN, are 0.
        """
        row, column = (np.floor(at).astype(np.intp) for at in self.pixels(towards))
        inside = (row >= 0) & (row < self.height) & (column >= 0) & (column < self.width)
        return inside, np.where(inside, row, 0), np.where(inside, column, 0)


@dataclass(frozen=True, slots=True)
class SkyPicture:
    """The luminance of one capture in the directions that can be sky.

    luminance_cdm2 [h, w]: NaN where no lens saw, or where merge omitted pixels as too dark for sky.
    clipped [h, w]: True where the luminance is a lower bound. dark_cdm2: the omitted pixels are
    darker than this; NaN if none was omitted.
    """

    luminance_cdm2: Floats32
    clipped: Mask
    grid: SkyGrid
    dark_cdm2: float = float("nan")


def write_sky_picture(path: Path, picture: SkyPicture) -> None:
    """Write a picture as .npz: log10 of luminance in codes of 16 bits, in steps of 0.04 %.

    Luminances are limited to 0.01 to 1e10 cd/m2. The file appears complete or not at all.
    """
    minimum, maximum = _LOG10_RANGE
    light = np.asarray(picture.luminance_cdm2, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (np.log10(np.maximum(light, 10.0**minimum)) - minimum) / (maximum - minimum)
    code = np.where(np.isfinite(light), 1.0 + np.clip(share, 0.0, 1.0) * (_MAX_CODE - 1), 0.0)
    table = asdict(picture.grid)
    del table["height"], table["width"]  # the shape of code
    with replacing(path) as file:
        np.savez_compressed(
            file,
            format=FORMAT,
            code=np.round(code).astype(np.uint16),
            clipped=np.packbits(picture.clipped),
            dark_cdm2=picture.dark_cdm2,
            **table,
        )


def read_sky_picture(path: Path) -> SkyPicture:
    """Read a picture that `write_sky_picture` wrote. Raises InputError for other content."""
    remedy = "merge the bracket again (fieldlum merge)"
    with open_arrays(path, "a sky picture", remedy, FORMAT) as stored:
        code = stored["code"]
        height, width = code.shape
        minimum, maximum = _LOG10_RANGE
        steps = (np.arange(_MAX_CODE + 1) - 1.0) / (_MAX_CODE - 1)
        table = 10.0 ** (minimum + steps * (maximum - minimum))
        table[0] = np.nan
        clipped = np.unpackbits(stored["clipped"], count=height * width).reshape(height, width)
        names = ("first_altitude_deg", "first_azimuth_deg", "step_deg", "heading_deg")
        corner = {name: float(stored[name]) for name in names}
        grid = SkyGrid(**corner, height=height, width=width)
        light = table.astype(np.float32)[code]
        return SkyPicture(light, clipped.astype(bool), grid, float(stored["dark_cdm2"]))


def cut_panorama(panorama: Panorama) -> SkyPicture:
    """Return the rows of a panorama that can be sky, at the panorama's own size.

    They go from the zenith to 2 degrees below the horizon (`LOWEST_ALTITUDE_DEG`).
    """
    height, width = panorama.luminance_cdm2.shape
    step_deg = 180.0 / height
    rows = min(height, int(np.ceil((90.0 - LOWEST_ALTITUDE_DEG) / step_deg)))
    light = panorama.seen_cdm2[:rows]
    flags = np.zeros(light.shape, np.uint16) if panorama.flags is None else panorama.flags[:rows]
    clipped = (flags & (Flag.CLIPPED_HIGH | Flag.BLOOM)) > 0
    grid = SkyGrid(
        first_altitude_deg=90.0,
        first_azimuth_deg=-180.0,
        step_deg=step_deg,
        heading_deg=panorama.heading_deg,
        height=rows,
        width=width,
    )
    return SkyPicture(light, clipped, grid)
