"""Detect the image circle of a fisheye in a frame, or make it smaller."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array
from fieldlum.core.errors import InputError
from fieldlum.core.statistics import robust_sigma
from fieldlum.optics.profiles import Lens
from fieldlum.optics.projection import radius_of_angle
from fieldlum.optics.raw import read_mosaic

EDGE_DIRECTIONS = 720  # rays along which the circle's edge is measured; chosen
# Share of the rays inside the picture whose edge is on the circle; how near, of the radius and in
# px. Evenly lit fields have 1.0, six exposures of a real room (8 mm fisheye) at most 0.71.
_MIN_ON_CIRCLE, _ON_CIRCLE_REL, _ON_CIRCLE_PX = 0.9, 0.005, 2.0
# of the profile's radius: a centre or radius that differs by more contradicts the profile; chosen
_MAX_CHANGE = 0.15
_PHOTOGRAPH = (
    "hold white paper in front of the lens, or point it at a bright, evenly lit wall, and take one "
    "frame without clipping that shows the complete circle"
)


def grey_picture(path: Path) -> NDArray[np.uint8]:
    """Read a raw, JPEG, PNG or TIFF file as grey codes 0 to 255 at sensor size, [h, w].

    A raw frame is stretched to its own brightness, so that its codes have no absolute meaning.
    Raises InputError for a file that cannot be read.
    """
    import cv2

    if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".tif", ".tiff"):
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        if picture is None:
            finding = "OpenCV cannot read the file as a picture"
            remedy = "convert the file to JPEG or PNG, or copy it from the card again"
            raise InputError(path, finding, "a JPEG, PNG or raw frame", remedy)
        return np.asarray(picture, np.uint8)
    counts = read_mosaic(path, lens_f_number=1.0).counts.astype(np.float32)
    rows, columns = (n // 2 * 2 for n in counts.shape)
    cell = counts[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2).mean(axis=(1, 3))
    cell = cv2.resize(cell, (columns, rows), interpolation=cv2.INTER_LINEAR)
    low, high = np.percentile(cell, [1, 99.5])
    return (255 * np.clip((cell - low) / max(high - low, 1e-6), 0, 1) ** (1 / 2.2)).astype(np.uint8)


@dataclass(frozen=True, slots=True)
class Circle:
    """The image circle of a fisheye: centre (x, y), radius and spread of its edge points, in px.

    u_px: standard deviation of the edge points' distance from the circle.
    """

    centre_px: tuple[float, float]
    radius_px: float
    u_px: float  # of the edge points about the circle


def circle(picture: NDArray[np.uint8], source: Path | str = "circle") -> Circle:
    """Find the image circle in a picture [h, w] of 8-bit grey, of an evenly lit bright field.

    scikit-image's Hough transform finds the circle. The edge is then refined along 720 rays, as the
    place where linear light is half way between the light just inside the circle and the darkest
    place outside. source : the file, for errors. Raises InputError if there is no circle, or if
    over a tenth of the rays have no edge there: in a picture of a room, edges of the room look like
    the circle's.
    """
    from skimage.feature import canny
    from skimage.transform import hough_circle, resize

    h, w = picture.shape
    step = max(max(h, w) / 240, 1.0)  # coarse, because the edge is refined at full size
    small = np.asarray(
        resize(picture.astype(float) / 255, (round(h / step), round(w / step)), anti_aliasing=True)
    )
    edges = canny(small, sigma=2.0)
    short, long = sorted(small.shape)
    radii = np.arange(int(0.2 * short), int(0.62 * long), 1)
    if not edges.any():
        raise _no_field(source, "no edges in the picture")
    votes = hough_circle(edges, radii, full_output=False)
    best, y, x = np.unravel_index(int(votes.argmax()), votes.shape)
    start = float(x + 0.5) * step, float(y + 0.5) * step, float(radii[best]) * step
    edge, rays = _edge_points(picture, *start)
    if edge.shape[1] < 60:
        raise _no_field(source, "no clear edge of a lens circle")
    image_circle, misses = _through(edge, start)
    near = np.abs(misses) < max(_ON_CIRCLE_REL * image_circle.radius_px, _ON_CIRCLE_PX)
    if near.sum() < _MIN_ON_CIRCLE * rays:
        share = f"only {100 * near.sum() / rays:.0f} % of the best circle's edge is in the picture"
        raise _no_field(source, f"{share}: this is no evenly lit bright field")
    return image_circle


def _no_field(source: Path | str, finding: str) -> InputError:
    expected = "a bright, evenly lit lens circle on a dark background"
    return InputError(source, finding, expected, _PHOTOGRAPH)


def _edge_points(picture: NDArray[np.uint8], x: float, y: float, r: float) -> tuple[Array, int]:
    """Return points x, y [2, n] on the edge of the circle, and the number of rays that reach it.

    The edge is at half of the light, not at half of the code. Rays leave x, y in 720 directions;
    those that leave the picture inside the circle are not counted.
    """
    from scipy.ndimage import gaussian_filter, map_coordinates

    light = (picture.astype(np.float32) / 255) ** 2.2
    smooth = 255 * gaussian_filter(light, 1.0)
    turn = np.arange(EDGE_DIRECTIONS) * 2 * np.pi / EDGE_DIRECTIONS
    out = np.arange(0.9 * r, 1.1 * r, 0.25)
    columns, rows = x + np.outer(np.cos(turn), out) - 0.5, y + np.outer(np.sin(turn), out) - 0.5
    line = map_coordinates(smooth, [rows, columns], order=1, mode="constant", cval=np.nan)
    inner = line[:, : len(out) // 5].mean(axis=1)
    outer = np.nanmin(np.where(np.isnan(line), np.inf, line), axis=1)
    below = line < ((inner + outer) / 2)[:, None]
    first = below.argmax(axis=1)
    good = below.any(axis=1) & (first > 0) & (inner > outer + 8)
    reached = np.isfinite(line[:, : len(out) // 2 + 1]).all(axis=1)
    away = out[first[good]]
    edge = np.stack([x + np.cos(turn[good]) * away, y + np.sin(turn[good]) * away])
    return edge, int((good | reached).sum())


def _through(edge: Array, start: tuple[float, float, float]) -> tuple[Circle, Array]:
    """Return the circle through points [2, n] by robust least squares, and their distances [px]."""
    from scipy.optimize import least_squares

    def misses(p: Array) -> Array:
        return np.hypot(edge[0] - p[0], edge[1] - p[1]) - p[2]

    solved = least_squares(misses, start, loss="soft_l1", f_scale=0.5)
    cx, cy, radius = (float(v) for v in solved.x)
    off = misses(solved.x)
    return Circle((cx, cy), radius, robust_sigma(off, 0.0)), off


def circle_lens(lens: Lens, image_circle: Circle, source: Path | str = "circle") -> Lens:
    """Return the lens with the circle's centre and radius; its mapping and pose do not change.

    source : the file, for errors. Raises InputError for a circle whose centre or radius differs
    from that of `lens` by over 15 % of the radius.
    """
    (x, y), radius = image_circle.centre_px, image_circle.radius_px
    change = max(
        np.hypot(x - lens.centre_px[0], y - lens.centre_px[1]), abs(radius - lens.radius_px)
    )
    if change > _MAX_CHANGE * lens.radius_px:
        raise InputError(
            source,
            f"a circle around {x:.0f}, {y:.0f} px of radius {radius:.0f} px; the profile has "
            f"{lens.centre_px[0]:.0f}, {lens.centre_px[1]:.0f} px and {lens.radius_px:.0f} px",
            f"a circle within {100 * _MAX_CHANGE:.0f} % of the profile's radius",
            f"{_PHOTOGRAPH}; if the profile's numbers are only a guess, first write numbers near "
            "the new ones into it",
        )
    return replace(lens, centre_px=(round(x, 2), round(y, 2)), radius_px=round(radius, 2))


def trimmed(lens: Lens, width_deg: float) -> Lens:
    """Return the lens without the outer `width_deg` of its image: half of its full angle shrinks.

    Directions inside map to the same pixels, with the same vignetting. Raises ValueError for a
    width that is not positive or leaves no picture.
    """
    half_deg = lens.full_angle_deg / 2.0 - width_deg
    if width_deg <= 0.0 or half_deg <= 0.0:
        raise ValueError(f"the image circle of {lens.full_angle_deg:g} degrees, {width_deg:g} less")
    share = half_deg / (lens.full_angle_deg / 2.0)
    radius = float(radius_of_angle(lens.geometry, np.radians(half_deg)))  # of the old one
    coefficients = tuple(c * share ** (k + 1) / radius for k, c in enumerate(lens.coefficients))
    vignetting = tuple(
        replace(v, coefficients=tuple(c * share**k for k, c in enumerate(v.coefficients)))
        for v in lens.vignetting
    )
    return replace(
        lens,
        radius_px=lens.radius_px * radius,
        full_angle_deg=2.0 * half_deg,
        coefficients=coefficients,
        vignetting=vignetting,
    )
