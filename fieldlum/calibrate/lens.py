"""Where a lens puts a direction: from known directions, from a chessboard, or from the circle's edge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.keep import needed, read_table
from fieldlum.calibrate.order import Candidate, Choice, choose, folds
from fieldlum.errors import InputError, NotEnoughDataError
from fieldlum.profiles import Lens
from fieldlum.projection import LensGeometry, direction, lens_pixels

Array = NDArray[Any]
LEAST = 8
POWERS = {
    "polynomial of one term": (1,),
    "two odd terms": (1, 3),
    "three odd terms": (1, 3, 5),
    "four terms": (1, 2, 3, 4),
}
EDGE_DIRECTIONS = 720


@dataclass(frozen=True, slots=True)
class Targets:
    """x_px, y_px [n] on the sensor and unit vectors [n, 3] in the panorama's frame (heading = north)."""

    x_px: Array
    y_px: Array
    rays: Array
    frames: tuple[Path, ...] = ()
    pose_known: bool = False  # directions are relative to the optical axis itself


@dataclass(frozen=True, slots=True)
class Fit:
    lens: Lens
    rms_px: float  # held-out
    rms_deg: float
    residual_px: Array
    widest_deg: float  # the largest angle that a target had: beyond it the mapping is an extrapolation
    choice: Choice


# ---------------------------------------------------------------------------------------------- known directions


def from_table(path: Path) -> Targets:
    """Targets from a csv: x_px, y_px, azimuth_deg, altitude_deg relative to the camera's heading and the horizon."""
    rows = read_table(path, ("x_px", "y_px", "azimuth_deg", "altitude_deg"))
    columns = {n: np.array([needed(row, n, path) for row in rows]) for n in rows[0]}
    rays = np.stack([direction(a, b) for a, b in zip(columns["altitude_deg"], columns["azimuth_deg"], strict=True)])
    return Targets(columns["x_px"], columns["y_px"], rays, (path,))


def _geometry(lens: Lens, figures: Array, mapping: str, powers: tuple[int, ...], pose: bool) -> LensGeometry:
    """The lens with fitted figures: centre x, y, radius, [azimuth, tilt, roll], then the polynomial's higher terms."""
    x, y, radius, *rest = figures.tolist()
    angles = rest[:3] if pose else (lens.azimuth_deg, lens.tilt_deg, lens.roll_deg)
    coefficients: tuple[float, ...] = ()
    if mapping == "polynomial":
        terms = np.zeros(max(powers))
        extra = rest[3:] if pose else rest
        for power, share in zip(powers[1:], extra, strict=True):
            terms[power - 1] = share
        terms[powers[0] - 1] = 1.0 - sum(extra)  # r = 1 at half of the full angle
        coefficients = tuple(float(t) for t in terms)
    return LensGeometry((x, y), radius, lens.full_angle_deg, mapping, coefficients, *angles)  # type: ignore[arg-type]


def _solve(targets: Targets, rows: NDArray[np.bool_], lens: Lens, mapping: str, powers: tuple[int, ...]) -> Array:
    from scipy.optimize import least_squares

    pose = not targets.pose_known
    start = [*lens.centre_px, lens.radius_px]
    start += [lens.azimuth_deg, lens.tilt_deg, lens.roll_deg] if pose else []
    start += [0.0] * (len(powers) - 1)
    scale = [lens.radius_px * 0.01] * 3 + ([1.0] * 3 if pose else []) + [0.05] * (len(powers) - 1)

    def misses(figures: Array) -> Array:
        x, y, _ = lens_pixels(_geometry(lens, figures, mapping, powers, pose), targets.rays[rows])
        return np.concatenate([x - targets.x_px[rows], y - targets.y_px[rows]])

    return least_squares(misses, start, x_scale=scale, loss="soft_l1", f_scale=2.0, max_nfev=400).x


def fit(targets: Targets, lens: Lens) -> Fit:
    """Centre, radius, pose and mapping by robust least squares in pixels, from the profile's lens as a start.

    Mappings are tried from none to four free terms on targets held out. Raises NotEnoughDataError under eight targets.
    """
    n = len(targets.x_px)
    if n < LEAST:
        raise NotEnoughDataError(f"{n} targets are too few for a lens: take at least {LEAST}, spread over the circle")
    models: list[tuple[str, str, tuple[int, ...]]] = [
        ("equidistant", "equidistant", ()),
        ("equisolid", "equisolid", ()),
    ]
    models += [(name, "polynomial", powers) for name, powers in POWERS.items() if n >= 3 * (len(powers) + 5)][1:]
    candidates = [
        Candidate(name, max(len(powers) - 1, 0), _held_out(targets, lens, mapping, powers))
        for name, mapping, powers in models
    ]
    choice = choose("lens", candidates, "px", 1.0)
    _, mapping, powers = models[choice.index]
    figures = _solve(targets, np.ones(n, bool), lens, mapping, powers)
    found = _geometry(lens, figures, mapping, powers, not targets.pose_known)
    x, y, angle = lens_pixels(found, targets.rays)
    residual = np.hypot(x - targets.x_px, y - targets.y_px)
    rms = float(np.sqrt(candidates[choice.index].errors.mean()))
    widest = float(np.degrees(angle.max()))
    new = replace(
        lens,
        centre_px=(round(found.centre_px[0], 3), round(found.centre_px[1], 3)),
        radius_px=round(found.radius_px, 3),
        mapping=found.mapping,
        coefficients=tuple(round(c, 7) for c in found.coefficients),
        azimuth_deg=round((found.azimuth_deg + 180) % 360 - 180, 4),
        tilt_deg=round(found.tilt_deg, 4),
        roll_deg=round(found.roll_deg, 4),
    )
    return Fit(new, rms, rms * lens.full_angle_deg / 2 / found.radius_px, residual, widest, choice)


def _held_out(targets: Targets, lens: Lens, mapping: str, powers: tuple[int, ...]) -> Array:
    n = len(targets.x_px)
    errors = np.zeros(n)
    for held in folds(np.arange(n), 6):
        figures = _solve(targets, ~held, lens, mapping, powers)
        x, y, _ = lens_pixels(_geometry(lens, figures, mapping, powers, not targets.pose_known), targets.rays[held])
        errors[held] = (x - targets.x_px[held]) ** 2 + (y - targets.y_px[held]) ** 2
    return errors


# ---------------------------------------------------------------------------------------------- chessboard


def grey_picture(path: Path) -> NDArray[np.uint8]:
    """Any raw, JPEG or PNG as 8-bit grey at full sensor size. Raises InputError."""
    import cv2

    if path.suffix.lower() in (".jpg", ".jpeg", ".png", ".tif", ".tiff"):
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        if picture is None:
            raise InputError(path, "no picture that OpenCV reads", "a JPEG, PNG or raw frame")
        return np.asarray(picture, np.uint8)
    from fieldlum.raw import read_mosaic

    counts = read_mosaic(path).counts.astype(np.float32)
    rows, columns = (n // 2 * 2 for n in counts.shape)
    cell = counts[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2).mean(axis=(1, 3))
    cell = cv2.resize(cell, (columns, rows), interpolation=cv2.INTER_LINEAR)
    low, high = np.percentile(cell, [1, 99.5])
    return (255 * np.clip((cell - low) / max(high - low, 1e-6), 0, 1) ** (1 / 2.2)).astype(np.uint8)


def chessboard_corners(path: Path, columns: int, rows: int) -> Array | None:
    """Inner corners [rows * columns, 2] in sensor coordinates; None where the board is not found."""
    import cv2

    found, corners = cv2.findChessboardCornersSB(
        grey_picture(path), (columns, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    return np.asarray(corners, float).reshape(-1, 2) + 0.5 if found else None  # OpenCV's zero is a pixel's middle


def from_boards(
    corners: Sequence[Array], columns: int, rows: int, size_px: tuple[int, int], paths: Sequence[Path] = ()
) -> Targets:
    """Directions from boards [rows * columns, 2] by OpenCV's omnidirectional model (Mei and Rives 2007).

    Its figures are not unique, its rays are: the model is asked for rays, and those are what our lens is fitted to.
    size_px: width, height. Raises NotEnoughDataError under four boards, InputError where the fit does not converge.
    """
    import cv2

    if len(corners) < 4:
        raise NotEnoughDataError(f"the board was found in {len(corners)} pictures: take at least four, up to the edge")
    board = np.zeros((1, rows * columns, 3))
    board[0, :, :2] = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    # (1, N, C): the one shape that OpenCV 4 and 5 both take
    places = [np.asarray(c - 0.5, np.float64).reshape(1, -1, 2) for c in corners]
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 300, 1e-9)
    omnidir: Any = cv2.omnidir
    flags = omnidir.CALIB_FIX_SKEW
    try:
        rms, k, xi, d, *_ = omnidir.calibrate([board] * len(corners), places, size_px, None, None, None, flags, stop)
    except cv2.error as error:
        raise InputError("chessboard", str(error).splitlines()[0], "boards in many places, none edge-on") from None
    if not np.isfinite(rms) or rms > 3:
        raise InputError(
            "chessboard", f"a fit that misses by {rms:.1f} px", "at most 3 px: sharper, more varied boards"
        )
    seen = np.concatenate([np.asarray(c, float) for c in corners])
    return _model_rays(seen, np.asarray(k), np.asarray(d), float(np.ravel(xi)[0]), tuple(paths))


def _model_rays(seen: Array, k: Array, d: Array, xi: float, paths: tuple[Path, ...]) -> Targets:
    """Directions over the part of the picture where corners were: the model's projection of a fan of rays."""
    import cv2

    angle = np.radians(np.arange(1.0, 110.0, 2.0))
    turn = np.radians(np.arange(0.0, 360.0, 15.0))
    a, t = (grid.ravel() for grid in np.meshgrid(angle, turn))
    away = np.stack([np.sin(a) * np.cos(t), np.sin(a) * np.sin(t), np.cos(a)], axis=1)  # OpenCV: x right, y down
    zero = np.zeros((3, 1))
    shown, *_ = cv2.omnidir.projectPoints(away.reshape(1, -1, 3), zero, zero, k, xi, d)
    at = np.asarray(shown).reshape(-1, 2) + 0.5
    centre = k[:2, 2] + 0.5
    reach = np.percentile(np.linalg.norm(seen - centre, axis=1), 99.5)
    radius = np.linalg.norm(at - centre, axis=1)
    near = radius <= reach
    rays = np.stack([away[:, 0], away[:, 2], -away[:, 1]], axis=1)  # ours: x right (east), y forward (north), z up
    return Targets(at[near, 0], at[near, 1], rays[near], paths, pose_known=True)


# ---------------------------------------------------------------------------------------------- circle and shift


@dataclass(frozen=True, slots=True)
class Circle:
    centre_px: tuple[float, float]
    radius_px: float
    u_px: float  # of the edge points about the circle


def circle(picture: NDArray[np.uint8]) -> Circle:
    """The image circle of a bright frame: scikit-image's Hough transform, refined on the edge along 720 rays.

    The edge is where the brightness passes half of that just inside. Raises InputError when there is no circle.
    """
    from skimage.feature import canny
    from skimage.transform import hough_circle, resize

    h, w = picture.shape
    step = max(max(h, w) / 240, 1.0)  # coarse: the edge is refined at full size
    small = np.asarray(resize(picture.astype(float) / 255, (round(h / step), round(w / step)), anti_aliasing=True))
    edges = canny(small, sigma=2.0)
    short, long = sorted(small.shape)
    radii = np.arange(int(0.2 * short), int(0.62 * long), 1)
    if not edges.any():
        raise InputError("circle", "no edge in the picture", "a bright frame with the whole circle in it")
    votes = hough_circle(edges, radii, full_output=False)
    best, y, x = np.unravel_index(int(votes.argmax()), votes.shape)
    return _refined(picture, float(x + 0.5) * step, float(y + 0.5) * step, float(radii[best]) * step)


def _refined(picture: NDArray[np.uint8], x: float, y: float, r: float) -> Circle:
    from scipy.ndimage import gaussian_filter, map_coordinates
    from scipy.optimize import least_squares

    light = (picture.astype(np.float32) / 255) ** 2.2  # half of the light, not half of the code, marks the edge
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
        raise InputError("circle", "no clear edge of a circle", "a bright, evenly lit frame with a dark surround")
    edge = np.stack([x + np.cos(turn[good]) * out[first[good]], y + np.sin(turn[good]) * out[first[good]]])

    def misses(p: Array) -> Array:
        return np.hypot(edge[0] - p[0], edge[1] - p[1]) - p[2]

    found = least_squares(misses, (x, y, r), loss="soft_l1", f_scale=0.5)
    cx, cy, radius = (float(v) for v in found.x)
    return Circle((cx, cy), radius, float(1.4826 * np.median(np.abs(misses(found.x)))))


def shift_px(before: NDArray[np.uint8], after: NDArray[np.uint8]) -> tuple[float, float]:
    """How far the picture moved, x right and y down, by scikit-image's phase correlation. [px]"""
    from skimage.registration import phase_cross_correlation

    if before.shape != after.shape:
        raise InputError("shift", f"pictures of {before.shape} and {after.shape}", "two frames of one camera")
    window = np.outer(np.hanning(before.shape[0]), np.hanning(before.shape[1]))
    pair = [(p.astype(float) - p.mean()) * window for p in (before, after)]
    plain: Any = None  # its type hint forgets None
    # Without normalisation: with it the mosaic's own pattern, which does not move, outvotes the scene.
    (down, right), *_ = phase_cross_correlation(*pair, upsample_factor=50, normalization=plain)
    return -float(right), -float(down)


def circle_lens(lens: Lens, found: Circle, full_angle_deg: float) -> Lens:
    """The lens with the circle's centre and radius; its mapping stays."""
    return replace(
        lens,
        centre_px=(round(found.centre_px[0], 2), round(found.centre_px[1], 2)),
        radius_px=round(found.radius_px, 2),
        full_angle_deg=full_angle_deg,
    )
