"""Grids of a result: equirectangular panoramas and equidistant fisheyes."""

from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Floats
from fieldlum.optics.projection.lens import LensGeometry, lens_rays
from fieldlum.optics.projection.panorama import direction, row_solid_angles, turned


@dataclass(frozen=True, slots=True)
class Equirect:
    """A panorama grid of `height` rows, zenith first, and 2 `height` columns, or a part of it.

    Its vectors are x right, y ahead (the heading, at the middle column), z up. part: first row,
    first column, rows and columns of the part; None for all of it.
    """

    height: int
    part: tuple[int, int, int, int] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and of columns."""
        return (self.height, 2 * self.height) if self.part is None else self.part[2:]

    @property
    def first_row(self) -> int:
        """Row of the complete panorama with which the grid begins."""
        return 0 if self.part is None else self.part[0]

    @property
    def pixel_rad(self) -> float:
        """Angle across one pixel at the horizon, in rad."""
        return float(np.pi / self.height)

    def zenith_angle_rad(self, rows: Floats) -> Floats:
        """Return the angle from the zenith at continuous rows of the grid, [rows]."""
        return (rows + self.first_row) / self.height * np.pi

    def rays(self, rows: Floats, columns: Floats) -> Floats:
        """Return unit vectors at each continuous row and column, [rows, columns, 3].

        rows, columns : 0 to the grid's height and width. x right, y ahead, z up.
        """
        first_column = 0 if self.part is None else self.part[1]
        altitude = 90.0 - (rows + self.first_row) / self.height * 180.0
        azimuth = ((columns + first_column) / (2 * self.height) - 0.5) * 360.0
        return direction(altitude[:, None], azimuth[None, :])

    def weight(self, rows: Floats, columns: Floats) -> Floats:
        """Return the sine of the zenith angle at continuous rows and columns, [rows, columns]."""
        return np.broadcast_to(
            np.sin(self.zenith_angle_rad(rows))[:, None], (rows.size, columns.size)
        )

    def solid_angles(self) -> Floats:
        """Return the solid angle of each pixel, in sr, [rows, columns]."""
        rows, columns = self.shape
        angles = row_solid_angles(self.height, 2 * self.height)
        return np.repeat(angles[self.first_row : self.first_row + rows, None], columns, axis=1)


@dataclass(frozen=True, slots=True)
class Fisheye:
    """A square equidistant picture (Radiance -vta) of `size` x `size` pixels.

    Only azimuth, tilt and roll of `pose` are used; `full_angle_deg` spans the width.
    """

    size: int
    full_angle_deg: float
    pose: LensGeometry

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and of columns."""
        return self.size, self.size

    @property
    def pixel_rad(self) -> float:
        """Angle across one pixel in the radial direction, in rad."""
        return float(np.radians(self.full_angle_deg) / self.size)

    @property
    def geometry(self) -> LensGeometry:
        """The equidistant lens of this picture, in the pose of `pose`."""
        half = self.size / 2
        return replace(
            self.pose,
            centre_px=(half, half),
            radius_px=half,
            full_angle_deg=self.full_angle_deg,
            mapping="equidistant",
            coefficients=(),
        )

    def view(self, heading_deg: float) -> str:
        """Return Radiance's view options; `heading_deg` is the azimuth of the panorama's centre."""
        _, up, forward = turned(self.geometry.axes(), heading_deg)
        vd, vu = (" ".join(f"{value:.6f}" for value in np.round(v, 6) + 0.0) for v in (forward, up))
        angle = f"{self.full_angle_deg:g}"
        return f"-vta -vd {vd} -vu {vu} -vv {angle} -vh {angle}"

    def rays(self, rows: Floats, columns: Floats) -> Floats:
        """Return unit vectors at each continuous row and column, [rows, columns, 3].

        (0, 0) is the top left corner. x right, y ahead (the panorama's heading), z up.
        """
        return lens_rays(self.geometry, columns[None, :], rows[:, None])

    def angles(self, rows: Floats, columns: Floats) -> Floats:
        """Return the angles from the axis at continuous rows and columns, rad, [rows, columns]."""
        half = self.size / 2
        return np.hypot(columns[None, :] - half, rows[:, None] - half) * self.pixel_rad

    def weight(self, rows: Floats, columns: Floats) -> Floats:
        """Return sin(a) / a, a the angle from the axis, [rows, columns]; 0 outside the circle."""
        angle = self.angles(rows, columns)
        return np.where(
            angle <= np.radians(self.full_angle_deg) / 2, np.abs(np.sinc(angle / np.pi)), 0.0
        )

    def solid_angles(self) -> Floats:
        """Return the solid angle of each pixel, in sr, [size, size]; 0 outside the circle."""
        centre = np.arange(self.size) + 0.5
        return self.weight(centre, centre) * self.pixel_rad**2


Target = Equirect | Fisheye
