"""Panoramas, lenses and the pixel grids of results: directions, solid angles, what is seen.

Axes: x east, y north, z up. Azimuth clockwise from north. A panorama is equirectangular, row 0 at
the zenith, W = 2H; the azimuth of column centre j is heading + ((j + .5)/W - .5) * 360 degrees, so
right is clockwise. Sensor coordinates: (0, 0) is the top left corner of the top left pixel, x
right, y down, seen from behind the camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
from typing import Annotated, Literal, Self

import numpy as np
from msgspec import Meta

from fieldlum.core.arrays import Array, ArrayLike, Floats, Indices, Mask
from fieldlum.core.strict_toml import Positive

# ----------------------------------------------------------------------------------------------
# panoramas


def row_solid_angles(height: int, width: int) -> Floats:
    """Return the solid angle of one pixel of each row of a panorama, in sr, [H].

    height, width: H, W in pixels; all pixels sum to 4 pi.
    """
    edges = np.cos(np.linspace(0.0, np.pi, height + 1))
    return (edges[:-1] - edges[1:]) * 2.0 * np.pi / width


def equirect_solid_angles(height: int, width: int) -> Floats:
    """Return the solid angle of each pixel of a panorama, in sr, [height, width]."""
    return np.repeat(row_solid_angles(height, width)[:, None], width, axis=1)


def column_azimuths_deg(width: int, heading_deg: float) -> Floats:
    """Return the azimuth of each column's centre, clockwise from north, in [0, 360) deg, [W].

    width: W; heading_deg: azimuth of the panorama's middle.
    """
    return (heading_deg + ((np.arange(width) + 0.5) / width - 0.5) * 360.0) % 360.0


def row_altitudes_deg(height: int) -> Floats:
    """Return the altitude of each row's centre, from the zenith down, in deg, [height]."""
    return 90.0 - (np.arange(height) + 0.5) / height * 180.0


def wrapped(maps: Array) -> Array:
    """Return a panorama with its last column before the first and its first after the last.

    [H, W, ...] becomes [H, W + 2, ...], so that interpolation is continuous across the seam.
    """
    return np.concatenate((maps[:, -1:], maps, maps[:, :1]), axis=1)


def signed_angle_deg(angle_deg: ArrayLike) -> Floats:
    """Return angles plus or minus full turns, in [-180, 180) deg, in the same shape."""
    return np.asarray((np.asarray(angle_deg, float) + 180.0) % 360.0 - 180.0, np.float64)


def smallest_arc(used: Mask) -> tuple[int, int]:
    """Return first column and width of the shortest run of columns that contains all marked ones.

    used: mask of a panorama's columns [W], of which at least one is marked. The run may continue
    from the last column to the first.
    """
    columns = np.flatnonzero(used)
    gaps = np.diff(columns, append=columns[0] + len(used))
    widest = int(np.argmax(gaps))
    return int(columns[(widest + 1) % len(columns)]), len(used) - int(gaps[widest]) + 1


def direction(altitude_deg: ArrayLike, azimuth_deg: ArrayLike) -> Floats:
    """Return unit vectors (x east, y north, z up), [..., 3]; azimuth clockwise from north.

    altitude_deg, azimuth_deg: shapes that broadcast to [...].
    """
    alt, az = np.radians(altitude_deg), np.radians(azimuth_deg)
    parts = (np.cos(alt) * np.sin(az), np.cos(alt) * np.cos(az), np.sin(alt))
    return np.stack(np.broadcast_arrays(*parts), axis=-1)


def across_axes(rays: Floats) -> tuple[Floats, Floats]:
    """Return two unit vectors at right angles to each unit vector and to each other, [..., 3] each.

    rays: [..., 3]. Where they are less than 64 degrees from level, the first points right, as seen
    along the ray with z up, and the second up.
    """
    other = np.where(np.abs(rays[..., 2:]) < 0.9, (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))
    side = np.cross(rays, other)
    side /= np.linalg.norm(side, axis=-1, keepdims=True)
    return side, np.cross(side, rays)


def altitude_azimuth_deg(rays: Array) -> tuple[Floats, Floats]:
    """Return altitude and azimuth of unit vectors [..., 3], the inverse of `direction`, [...] each.

    rays: x east, y north, z up. The azimuth is clockwise from north, in [-180, 180] deg.
    """
    altitude = np.degrees(np.arcsin(np.clip(rays[..., 2], -1.0, 1.0)))
    return altitude, np.degrees(np.arctan2(rays[..., 0], rays[..., 1]))


def equirect_rays(height: int, width: int, heading_deg: float) -> Floats:
    """Return the unit vector (x east, y north, z up) of each panorama pixel's centre, [H, W, 3].

    height, width: H, W; row 0 is at the zenith; heading_deg: azimuth of the middle, clockwise from
    north.
    """
    azimuths_deg = column_azimuths_deg(width, heading_deg)
    return direction(row_altitudes_deg(height)[:, None], azimuths_deg[None, :])


def equirect_pixel(
    altitude_deg: ArrayLike, azimuth_deg: ArrayLike, height: int, width: int, heading_deg: float
) -> tuple[Floats, Floats]:
    """Return the continuous (row, column) of directions in a panorama, [...] each.

    altitude_deg, azimuth_deg: of the directions [...]; height, width: in pixels; heading_deg:
    azimuth of the middle. Azimuths are clockwise from north. Pixel (i, j) covers [i, i + 1) x [j, j
    + 1); row 0 is the zenith, column W / 2 the heading. Columns wrap into [0, W).
    """
    row = (90.0 - np.asarray(altitude_deg, float)) / 180.0 * height
    turn = (np.asarray(azimuth_deg, float) - heading_deg) / 360.0 + 0.5
    return row, (turn % 1.0) * width


def flat_pixels(towards: Floats, shape: tuple[int, ...], heading_deg: float) -> Indices:
    """Return the index in the flattened panorama of the pixel in each direction, [...].

    towards: unit vectors [..., 3], x east, y north, z up; shape: (H, W) of the panorama;
    heading_deg: azimuth of its centre column, clockwise from north.
    """
    row, column = equirect_pixel(*altitude_azimuth_deg(towards), shape[0], shape[1], heading_deg)
    return np.ravel_multi_index((row.astype(int), column.astype(int)), shape, mode=("clip", "wrap"))


_COMPASS = tuple("N NNE NE ENE E ESE SE SSE S SSW SW WSW W WNW NW NNW".split())  # noqa: SIM905


def compass_name(azimuth_deg: float) -> str:
    """Return the nearest of the sixteen points of the compass, such as NNE, of any azimuth.

    azimuth_deg: clockwise from north.
    """
    return _COMPASS[round(azimuth_deg / 22.5) % 16]


def turned(vectors: ArrayLike, clockwise_deg: float) -> Floats:
    """Return vectors [..., 3] (x east, y north, z up) turned clockwise, seen from above."""
    x, y, z = np.moveaxis(np.asarray(vectors, float), -1, 0)
    sine, cosine = np.sin(np.radians(clockwise_deg)), np.cos(np.radians(clockwise_deg))
    return np.stack((x * cosine + y * sine, -x * sine + y * cosine, z), axis=-1)


def rotation(heading_deg: float, tilt_deg: float, roll_deg: float, axis_deg: float) -> Floats:
    """Return the matrix from a camera's stated axes to the true ones, [3, 3].

    Roll is applied first, then tilt, then heading. heading_deg: clockwise turn about the vertical;
    tilt_deg: the view axis at azimuth `axis_deg` goes up; roll_deg: the right-hand side goes down.
    All in world axes (x east, y north, z up).
    """
    from scipy.spatial.transform import Rotation

    sine, cosine = np.sin(np.radians(axis_deg)), np.cos(np.radians(axis_deg))
    ahead, right = np.array([sine, cosine, 0.0]), np.array([cosine, -sine, 0.0])
    tilt, roll = np.radians(tilt_deg), np.radians(roll_deg)
    tilted, rolled = Rotation.from_rotvec([tilt * right, roll * ahead]).as_matrix()
    return turned(np.eye(3), heading_deg).T @ tilted @ rolled


# ----------------------------------------------------------------------------------------------
# a lens on a sensor


Mapping = Literal["equidistant", "equisolid", "polynomial"]


@dataclass(frozen=True, slots=True)
class LensGeometry:
    """The mapping and pose of a lens on a sensor.

    centre_px: of the image circle, x right, y down, (0, 0) the sensor's top left corner; radius_px:
    of the image circle at half of full_angle_deg. mapping: distance from the centre proportional to
    the angle a from the axis (equidistant), to sin(a / 2) (equisolid), or a polynomial of a.
    coefficients: of the polynomial r / radius_px = sum c_k (angle / half angle)^(k + 1).
    azimuth_deg: of the optical axis, clockwise from the panorama's heading; tilt_deg: of the axis
    above the horizon; roll_deg: clockwise seen from behind the camera.
    """

    centre_px: tuple[float, float]
    radius_px: Positive
    full_angle_deg: Annotated[float, Meta(gt=0.0, le=300.0)]
    mapping: Mapping = "equisolid"
    coefficients: tuple[float, ...] = ()
    azimuth_deg: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0

    @property
    def half_angle_rad(self) -> float:
        """Half of the full angle, in radians."""
        return float(np.radians(self.full_angle_deg / 2))

    def axes(self) -> Floats:
        """Return the camera's axes right, up and forward as rows, [3, 3].

        They are unit vectors, x right of the panorama's heading, y along it, z up.
        """
        forward = direction(self.tilt_deg, self.azimuth_deg)
        right = direction(0.0, self.azimuth_deg + 90.0)
        up = np.cross(right, forward)
        sine, cosine = np.sin(np.radians(self.roll_deg)), np.cos(np.radians(self.roll_deg))
        return np.stack((cosine * right - sine * up, sine * right + cosine * up, forward))


def relative_radius(lens: LensGeometry, x_px: ArrayLike, y_px: ArrayLike) -> Floats:
    """Return the distance of sensor points from the image centre over radius_px, [...].

    x_px, y_px: on the sensor [...].
    """
    dx, dy = np.subtract(x_px, lens.centre_px[0]), np.subtract(y_px, lens.centre_px[1])
    return np.hypot(dx, dy) / lens.radius_px


def radius_of_angle(lens: LensGeometry, angle_rad: ArrayLike) -> Floats:
    """Return the distance from the image centre over radius_px at angles from the axis, [...].

    angle_rad: from the optical axis [...]. The result is 1 at half of the full angle.
    """
    angle = np.asarray(angle_rad, float)
    half = lens.half_angle_rad
    if lens.mapping == "equisolid":
        return np.sin(angle / 2) / np.sin(half / 2)
    if lens.mapping == "equidistant":
        return angle / half
    powers = (0.0, *lens.coefficients)
    return np.asarray(np.polynomial.polynomial.polyval(angle / half, powers), np.float64)


@lru_cache(maxsize=16)
def _inverse_table(lens: LensGeometry) -> tuple[Floats, Floats]:
    """Return radius (over radius_px) and angle [rad] of a polynomial mapping, [n] each, rising.

    The table ends where the polynomial stops rising. Raises ValueError if that is inside the image
    circle.
    """
    angles = np.linspace(0.0, min(1.15 * lens.half_angle_rad, np.pi), 4001)
    radii = radius_of_angle(lens, angles)
    falling = np.flatnonzero(np.diff(radii) <= 0)
    end = int(falling[0]) + 1 if falling.size else angles.size
    if angles[end - 1] < lens.half_angle_rad * 0.999:
        raise ValueError("the lens polynomial does not rise up to the edge of the circle")
    return radii[:end], angles[:end]


def angle_of_radius(lens: LensGeometry, radius: ArrayLike) -> Floats:
    """Return the angle from the axis [rad] of radii: the inverse of `radius_of_angle`, [...].

    radius: distance from the image centre over radius_px [...]. Beyond the reach of a polynomial or
    equisolid mapping the largest angle is returned. Raises ValueError for a polynomial that does
    not rise up to half of the full angle.
    """
    r = np.asarray(radius, float)
    if lens.mapping == "equisolid":
        return 2.0 * np.arcsin(np.clip(r * np.sin(lens.half_angle_rad / 2), -1.0, 1.0))
    if lens.mapping == "equidistant":
        return r * lens.half_angle_rad
    return np.interp(r, *_inverse_table(lens))


def lens_pixels(lens: LensGeometry, rays: Floats) -> tuple[Floats, Floats, Floats]:
    """Return sensor x, y [px] and angle from the axis [rad] of unit vectors, [...] each.

    rays: [..., 3], x right of the panorama's heading, y along it, z up. (0, 0) is the sensor's top
    left corner.
    """
    right, up, forward = np.moveaxis(np.asarray(rays, float) @ lens.axes().T, -1, 0)
    across = np.hypot(right, up)
    angle = np.arctan2(across, forward)
    scale = lens.radius_px * radius_of_angle(lens, angle) / np.maximum(across, 1e-300)
    return lens.centre_px[0] + scale * right, lens.centre_px[1] - scale * up, angle


def lens_rays(lens: LensGeometry, x_px: ArrayLike, y_px: ArrayLike) -> Floats:
    """Return the unit vectors [..., 3] of sensor points; the inverse of `lens_pixels`.

    x_px, y_px: on the sensor [...]. The vectors have x right of the panorama's heading, y along it
    and z up. Raises ValueError as `angle_of_radius` does.
    """
    dx = np.asarray(x_px, float) - lens.centre_px[0]
    dy = lens.centre_px[1] - np.asarray(y_px, float)
    radius = np.hypot(dx, dy)
    angle = angle_of_radius(lens, radius / lens.radius_px)
    across = np.sin(angle) / np.maximum(radius, 1e-300)
    return np.stack((dx * across, dy * across, np.cos(angle)), axis=-1) @ lens.axes()


# ----------------------------------------------------------------------------------------------
# grids of a result


@dataclass(frozen=True, slots=True)
class Equirect:
    """A panorama grid of `height` rows, zenith first, and 2 `height` columns, or a part of it.

    Vectors of its pixels are x right, y ahead (the heading, at the middle column), z up. part:
    first row, first column, rows and columns of the part; None for all of it.
    """

    height: int
    part: tuple[int, int, int, int] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and of columns."""
        return (self.height, 2 * self.height) if self.part is None else self.part[2:]

    @property
    def corner(self) -> tuple[int, int]:
        """Row and column of the complete panorama with which the grid begins."""
        return (0, 0) if self.part is None else self.part[:2]

    @property
    def pixel_rad(self) -> float:
        """Angle across one pixel at the horizon, in rad."""
        return float(np.pi / self.height)

    def rays(self, rows: Floats, columns: Floats) -> Floats:
        """Return unit vectors at each continuous row and column, [rows, columns, 3].

        rows, columns: 0 to the grid's height and width. x right, y ahead, z up.
        """
        altitude = 90.0 - (rows + self.corner[0]) / self.height * 180.0
        azimuth = ((columns + self.corner[1]) / (2 * self.height) - 0.5) * 360.0
        return direction(altitude[:, None], azimuth[None, :])

    def weight(self, rows: Floats, columns: Floats) -> Floats:
        """Return the solid angle of places over that at the horizon, [rows, columns].

        It is the sine of the zenith angle at continuous rows and columns.
        """
        down = np.sin((rows + self.corner[0]) / self.height * np.pi)
        return np.broadcast_to(down[:, None], (rows.size, columns.size))

    def solid_angles(self) -> Floats:
        """Return the solid angle of each pixel, in sr, [rows, columns]."""
        (rows, columns), first = self.shape, self.corner[0]
        return equirect_solid_angles(self.height, 2 * self.height)[first : first + rows, :columns]


@dataclass(frozen=True, slots=True)
class Fisheye:
    """A square equidistant picture (Radiance -vta) of `size` x `size` pixels.

    lens: the picture as a lens, with its full angle, azimuth, tilt and roll.
    """

    size: int
    lens: LensGeometry

    @classmethod
    def of_size(cls, size: int, lens: LensGeometry) -> Self:
        """Return an equidistant picture with the full angle and the pose of any lens."""
        half = size / 2
        circle = {"centre_px": (half, half), "radius_px": half}
        return cls(size, replace(lens, **circle, mapping="equidistant", coefficients=()))

    @property
    def shape(self) -> tuple[int, int]:
        """Number of rows and of columns."""
        return self.size, self.size

    @property
    def pixel_rad(self) -> float:
        """Angle across one pixel in the radial direction, in rad."""
        return self.lens.half_angle_rad / self.lens.radius_px

    def view(self, heading_deg: float) -> str:
        """Return Radiance's view options; `heading_deg` is the azimuth of the panorama's centre."""
        _, up, forward = turned(self.lens.axes(), heading_deg)
        vd, vu = (" ".join(f"{value:.6f}" for value in np.round(v, 6) + 0.0) for v in (forward, up))
        angle = f"{self.lens.full_angle_deg:g}"
        return f"-vta -vd {vd} -vu {vu} -vv {angle} -vh {angle}"

    def rays(self, rows: Floats, columns: Floats) -> Floats:
        """Return unit vectors at each continuous row and column, [rows, columns, 3].

        (0, 0) is the top left corner. x right, y ahead (the panorama's heading), z up.
        """
        return lens_rays(self.lens, columns[None, :], rows[:, None])

    def weight(self, rows: Floats, columns: Floats) -> Floats:
        """Return the solid angle of places over that on the axis, [rows, columns].

        It is sin(a) / a, with a the angle from the axis, and 0 outside the circle.
        """
        radius = relative_radius(self.lens, columns[None, :], rows[:, None])
        angle = radius * self.lens.half_angle_rad
        return np.where(radius <= 1.0, np.abs(np.sinc(angle / np.pi)), 0.0)

    def solid_angles(self) -> Floats:
        """Return the solid angle of each pixel, in sr, [size, size]; 0 outside the circle."""
        centre = np.arange(self.size) + 0.5
        return self.weight(centre, centre) * self.pixel_rad**2


Target = Equirect | Fisheye


# ----------------------------------------------------------------------------------------------
# the share of a view that a camera saw


# From this share on a direction counts as seen. A dual fisheye without the nadir sees over 99 %; 2
# % of a hemisphere of 10 000 cd/m2 changes DGP by 0.04, which the bounds of DGP include. Chosen.
FULLY_SEEN_SHARE = 0.98
SEEN, PARTLY_SEEN, NOT_SEEN = "seen", "partly seen", "not seen"


def seen_shares(seen_mask: Mask, heading_deg: float, azimuths_deg: ArrayLike) -> Floats:
    """Return the share, 0 to 1, of a uniform field's vertical illuminance that was seen, [d].

    seen_mask: [H, W], True for panorama pixels that a lens saw; heading_deg: azimuth of the
    panorama's middle; azimuths_deg: [d], horizontal view directions, clockwise from north.
    """
    height, width = seen_mask.shape
    rays = equirect_rays(height, width, heading_deg).reshape(-1, 3)
    ahead = direction(0.0, np.atleast_1d(np.asarray(azimuths_deg, float)))  # (d, 3)
    solid_angles = equirect_solid_angles(height, width).reshape(-1, 1)  # (H W, 1)
    cosine = np.clip(rays @ ahead.T, 0.0, None) * solid_angles  # (H W, d)
    return np.clip(seen_mask.ravel() @ cosine / cosine.sum(axis=0), 0.0, 1.0)


def seen_words(shares: Floats) -> tuple[str, ...]:
    """Return "seen" (from 0.98), "partly seen" (from 0.5) or "not seen" for each share, [d].

    A direction that is not seen gets no result: a 180-degree lens sees half of the cosine-weighted
    hemisphere at 90 degrees from its axis.
    """
    return tuple(
        SEEN if s >= FULLY_SEEN_SHARE else PARTLY_SEEN if s >= 0.5 else NOT_SEEN for s in shares
    )


def seen_by_lenses(
    lenses: Sequence[LensGeometry], turns_deg: Sequence[float], height: int = 90
) -> Mask:
    """Return True for panorama pixels whose centre at least one lens sees, [height, 2 height].

    The middle of the panorama is at its heading. turns_deg: headings of the turned camera minus the
    panorama's heading; (0,) for a fixed camera.
    """
    rays = equirect_rays(height, 2 * height, 0.0)
    seen = np.zeros(rays.shape[:2], bool)
    for lens, turn_deg in product(lenses, turns_deg):
        axis = direction(lens.tilt_deg, lens.azimuth_deg + turn_deg)
        seen |= rays @ axis >= np.cos(lens.half_angle_rad)
    return seen


def judged_text(seen_mask: Mask, heading_deg: float) -> str:
    """Return one sentence on which views can be judged from these pixels; empty if all can.

    Directions are in full degrees, clockwise from north, with points of the compass. seen_mask: [H,
    W], True for panorama pixels that a lens saw; heading_deg: azimuth of the panorama's middle.
    """
    words = seen_words(seen_shares(seen_mask, heading_deg, np.arange(360.0)))
    if all(word == SEEN for word in words):
        return ""
    weights = equirect_solid_angles(*seen_mask.shape)
    share = float(weights[seen_mask].sum() / weights.sum())
    fully, partly = (_arcs_text([w == word for w in words]) for word in (SEEN, PARTLY_SEEN))
    others = "; other view directions get no result" if NOT_SEEN in words else ""
    return (
        f"the camera sees {100 * share:.0f} % of all directions: glare can be computed for views "
        f"to {fully}, and only bounds of glare for views to {partly}{others}"
    )


def _arcs_text(good: Sequence[bool]) -> str:
    """Return the arcs of marked azimuths as text, such as "350° (N) to 10° (N)".

    good [360]: whether each full degree, clockwise from north, is marked.
    """
    if all(good):
        return "every direction"
    starts = [k for k in range(360) if good[k] and not good[k - 1]]
    # each arc ends, because not all azimuths are marked
    ends = [next(e for e in range(k, 720) if not good[(e + 1) % 360]) % 360 for k in starts]
    named = [[f"{k}° ({compass_name(k)})" for k in arc] for arc in zip(starts, ends, strict=True)]
    return ", ".join(" to ".join(arc) for arc in named) or "no direction"
