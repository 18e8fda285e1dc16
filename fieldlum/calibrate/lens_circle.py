"""Detect the image circle of a fisheye in a frame; measure its shift; make it smaller."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.arrays import Array
from fieldlum.errors import InputError
from fieldlum.profiles import Lens
from fieldlum.projection import radius_of_angle
from fieldlum.raw import read_mosaic
from fieldlum.statistics import robust_sigma

EDGE_DIRECTIONS = 720  # rays along which the circle's edge is measured; chosen


def grey_picture(path: Path) -> NDArray[np.uint8]:
    """Read a raw, JPEG, PNG or TIFF file as grey codes 0 to 255 at sensor size, [h, w].

    A raw frame is stretched to its own brightness, so that its codes have no absolute meaning.
    Raises InputError for a file that cannot be read.
    """
    import cv2

    if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".tif", ".tiff"):
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        if picture is None:
            raise InputError(
                path,
                "OpenCV cannot read the file as a picture",
                "a JPEG, PNG or raw frame",
                "convert the file to JPEG or PNG, or copy it from the card again",
            )
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


def circle(picture: NDArray[np.uint8]) -> Circle:
    """Find the image circle in a picture [h, w] of 8-bit grey, from a bright frame.

    scikit-image's Hough transform finds the circle. The edge is then refined along 720 rays, as the
    place where linear light is half way between the light just inside the circle and the darkest
    place outside. Raises InputError if there is no circle.
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
        raise InputError(
            "circle",
            "no edges in the picture",
            "a bright frame that shows the complete lens circle",
            "photograph a bright, evenly lit wall and use that frame",
        )
    votes = hough_circle(edges, radii, full_output=False)
    best, y, x = np.unravel_index(int(votes.argmax()), votes.shape)
    return _refined(
        picture, float(x + 0.5) * step, float(y + 0.5) * step, float(radii[best]) * step
    )


def _refined(picture: NDArray[np.uint8], x: float, y: float, r: float) -> Circle:
    from scipy.ndimage import gaussian_filter, map_coordinates
    from scipy.optimize import least_squares

    # The edge is at half of the light, not at half of the code.
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
    if good.sum() < 60:
        raise InputError(
            "circle",
            "no clear edge of a lens circle",
            "a bright, evenly lit lens circle on a dark background",
            "photograph a bright, evenly lit wall and use that frame",
        )
    edge = np.stack(
        [x + np.cos(turn[good]) * out[first[good]], y + np.sin(turn[good]) * out[first[good]]]
    )

    def misses(p: Array) -> Array:
        return np.hypot(edge[0] - p[0], edge[1] - p[1]) - p[2]

    solved = least_squares(misses, (x, y, r), loss="soft_l1", f_scale=0.5)
    cx, cy, radius = (float(v) for v in solved.x)
    return Circle((cx, cy), radius, robust_sigma(misses(solved.x), 0.0))


def _size(picture: NDArray[np.uint8]) -> str:
    """Return width x height."""
    return f"{picture.shape[1]} x {picture.shape[0]}"


def shift_px(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> tuple[float, float]:
    """Return how far the scene in `after` moved from its place in `before` [px]: right, down.

    Negative numbers are left or up. By cross-correlation of grey pictures [h, w]. Raises InputError
    for different sizes.
    """
    from skimage.registration import phase_cross_correlation

    if before.shape != after.shape:
        raise InputError(
            "shift",
            f"pictures of {_size(before)} and {_size(after)} pixels",
            "two frames of one camera, with one size",
            "use frames of the same size",
        )
    window = np.outer(np.hanning(before.shape[0]), np.hanning(before.shape[1]))
    pair = [(p.astype(float) - p.mean()) * window for p in (before, after)]
    plain: Any = None  # scikit-image's type hint lacks None
    # Without normalisation, because with it the pattern of the mosaic, which does not move,
    # dominates the scene.
    (down, right), *_ = phase_cross_correlation(*pair, upsample_factor=50, normalization=plain)
    return -float(right), -float(down)


def circle_lens(lens: Lens, image_circle: Circle, full_angle_deg: float) -> Lens:
    """Return the lens with the circle's centre and radius, and with `full_angle_deg`.

    Its mapping and pose do not change.
    """
    return replace(
        lens,
        centre_px=(round(image_circle.centre_px[0], 2), round(image_circle.centre_px[1], 2)),
        radius_px=round(image_circle.radius_px, 2),
        full_angle_deg=full_angle_deg,
    )


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
