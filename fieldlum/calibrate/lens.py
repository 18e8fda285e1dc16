"""Fit a lens's mapping and pose to targets or chessboards, and find its image circle."""

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from fieldlum.calibrate import fit_steps
from fieldlum.calibrate.fit_charts import Chart, Place, grey_picture
from fieldlum.core.arrays import Array, Mask, UInts8
from fieldlum.core.errors import InputError
from fieldlum.core.statistics import robust_sigma
from fieldlum.optics.linear_light import check_frame
from fieldlum.optics.profiles import CameraProfile, Lens
from fieldlum.optics.projection import direction, lens_pixels, lens_rays

# The mappings that are tried, with the powers of the angle in a polynomial; held-out targets
# select one.
MODELS = {
    "equidistant": ("equidistant", ()),
    "equisolid": ("equisolid", ()),
    "two odd terms": ("polynomial", (1, 3)),
    "three odd terms": ("polynomial", (1, 3, 5)),
    "four terms": ("polynomial", (1, 2, 3, 4)),
}
# Shares of the radius. A target that misses by more than twice this is no reading error of a
# pixel, and with a larger median no lens fits the targets. Chosen, not measured.
MAX_MISS = 0.01
# A centre or radius that differs by more contradicts the profile. Chosen.
_MAX_CHANGE = 0.15
_WANTED = "x right and y down in pixels, azimuth clockwise from the camera's heading, altitude up"

Model = tuple[str, tuple[int, ...]]  # the mapping, and the powers of a polynomial
_POSE = ("azimuth_deg", "tilt_deg", "roll_deg")  # fields of a lens


@dataclass(frozen=True, slots=True)
class Targets:
    """Known directions of n targets, and their places on the sensor.

    x_px, y_px [n]: x to the right, y down. rays [n, 3]: unit vectors towards the targets, with y in
    the camera's heading, x to the right, z up. source: the file, for errors.
    """

    x_px: Array
    y_px: Array
    rays: Array
    source: Path | str = "targets"


class LensFit(NamedTuple):
    """A fitted lens, its held-out error, and warnings.

    widest_deg: largest angle of a target from the axis; the mapping extrapolates beyond it. choice:
    how the polynomial's order was chosen, with the rms distance of held-out targets or of
    chessboard corners [px]. warnings: sentences about omitted targets, and a circle or a pose far
    from the profile's.
    """

    lens: Lens
    widest_deg: float
    choice: fit_steps.OrderSelection
    warnings: tuple[str, ...] = ()


def from_table(path: Path, profile: CameraProfile) -> Targets:
    """Read targets from a csv with the columns x_px, y_px, azimuth_deg and altitude_deg.

    azimuth_deg is clockwise from the camera's heading, altitude_deg upwards from the horizon; x_px
    is to the right, y_px down. Raises InputError for an invalid csv, and for a target outside the
    frames of the profile's camera.
    """
    names = ("x_px", "y_px", "azimuth_deg", "altitude_deg")
    x, y, azimuth, altitude = fit_steps.columns(fit_steps.read_table(path, names), *names)
    body = profile.camera
    for k in np.flatnonzero((x < 0) | (x > body.width_px) | (y < 0) | (y > body.height_px)):
        finding = f"a target at x_px {x[k]:g}, y_px {y[k]:g}"
        expected = f"one inside {body.width_px} x {body.height_px} pixels, the size of {body.name}"
        raise InputError(path, finding, expected, "read x_px and y_px in a frame of that size")
    return Targets(x_px=x, y_px=y, rays=direction(altitude, azimuth), source=path)


# ----------------------------------------------------------------------------------------------
# targets


def fit(targets: Targets, lens: Lens) -> LensFit:
    """Fit centre, radius, pose and mapping by robust least squares in pixels.

    The fit starts from `lens`. Mappings with none to three free terms are compared on held-out
    targets. Targets that no lens explains, at most a quarter, are omitted and listed in `warnings`.
    Raises NotEnoughDataError for fewer than eight targets; InputError for directions that are
    mirrored, outside the lens's full angle, or fit no lens.
    """
    n, directions = len(targets.x_px), np.unique(targets.rays.round(3), axis=0)
    # one more than the parameters of a lens with one free term: centre, radius, pose and the term
    remedy = "add targets all over the circle to the csv"
    fit_steps.require(len(directions), 8, "targets in different directions", remedy)
    start = _with_fitted_pose(targets, lens)
    # three targets for each parameter: centre, radius, pose, and all powers but the first
    models = {name: m for name, m in MODELS.items() if not m[1] or n >= 3 * (len(m[1]) + 5)}

    def solved(model: Model, rows: Mask) -> Lens:
        """Return the lens of a model that fits the targets of the mask `rows` best."""
        at = (targets.x_px[rows], targets.y_px[rows])
        return _solve(start, model, *at, lambda _: targets.rays[rows], pose=True)[0]

    every = [_misses(solved(model, np.ones(n, bool)), targets)[0] for model in models.values()]
    best = min(every, key=lambda missed: float(np.median(missed)))
    used = ~fit_steps.gross_errors(best, 2.0 * MAX_MISS * start.radius_px)
    _, fitted, choice = fit_steps.fit_and_choose(
        "lens",
        [(name, max(len(model[1]) - 1, 0), model) for name, model in models.items()],
        np.arange(n),
        lambda model, rows: solved(model, rows & used),
        lambda _, fit, held: np.where(used, _misses(fit, targets)[0] ** 2, np.nan)[held],
        unit="px",
    )
    missed_px, angle_rad = _misses(fitted, targets)
    _check(fitted, missed_px[used], angle_rad[used], targets)
    new = _rounded(fitted)
    return LensFit(
        new,
        widest_deg=float(np.degrees(angle_rad[used].max())),
        choice=choice,
        warnings=_warnings(targets, missed_px, used, new, lens),
    )


def level_lens(lens: Lens) -> Lens:
    """Return the lens with its axis along the heading: azimuth, tilt and roll are 0."""
    return replace(lens, **dict.fromkeys(_POSE, 0.0))


def _solve(
    start: Lens,
    model: Model,
    x_px: Array,
    y_px: Array,
    rays_of: Callable[[Array], Array],
    others: Array | Sequence[float] = (),
    *,
    pose: bool,
) -> tuple[Lens, Array, Any]:
    """Return the lens that fits places [n] best, the other unknowns [m], and scipy's solution.

    The fit is by robust least squares. start: the lens from which the search starts; model: mapping
    and powers, one of `MODELS`; x_px, y_px: the places. rays_of: returns the directions [n, 3] of
    the places for the other unknowns [m], which start at `others`. pose: the lens's pose is fitted
    too. The last result is that of `scipy.optimize.least_squares`.
    """
    mapping, powers = model
    names = _POSE if pose else ()
    of_lens = 3 + len(names) + len(powers[1:])  # number of the lens's unknowns, which come first

    def lens_of(unknowns: Array) -> Lens:
        """Return the lens: centre, radius, pose if it is fitted, all powers but the first.

        The first power follows, because the coefficients of a polynomial add up to 1.
        """
        x, y, radius_px, *rest = unknowns[:of_lens].tolist()
        terms, further = np.zeros(max(powers, default=0)), rest[len(names) :]
        if powers:
            terms[np.array(powers) - 1] = [1.0 - sum(further), *further]
        new = {"mapping": mapping, "coefficients": tuple(terms.tolist())}
        new |= zip(names, rest, strict=False)
        return replace(start, centre_px=(x, y), radius_px=radius_px, **new)

    def misses(unknowns: Array) -> Array:
        """Return the distances in x, then in y, of the lens's places from the given ones [px]."""
        x, y, _ = lens_pixels(lens_of(unknowns), rays_of(unknowns[of_lens:]))
        return np.concatenate([x - x_px, y - y_px])

    terms = dict(enumerate(start.coefficients, start=1))
    angles = [getattr(start, name) for name in names]
    begin = [*start.centre_px, start.radius_px, *angles, *(terms.get(p, 0.0) for p in powers[1:])]
    begin += list(others)
    solved = least_squares(misses, begin, x_scale="jac", loss="soft_l1", f_scale=2.0, max_nfev=400)
    return lens_of(solved.x), solved.x[of_lens:], solved


def _misses(lens: Lens, targets: Targets) -> tuple[Array, Array]:
    """Return each target's distance from its place by the lens [px], and axis angle [rad], [n]."""
    x, y, angle_rad = lens_pixels(lens, targets.rays)
    return np.hypot(x - targets.x_px, y - targets.y_px), angle_rad


def _check(lens: Lens, missed_px: Array, angle_rad: Array, targets: Targets) -> None:
    """Raise InputError for a fitted lens that its own targets contradict.

    missed_px, angle_rad [n]: results of `_misses`.
    """
    if np.median(missed_px) > MAX_MISS * lens.radius_px:
        finding = f"the best lens misses half of the targets by over {np.median(missed_px):.0f} px"
        remedy = "check the targets' signs and units, and the columns x_px and y_px"
        raise InputError(targets.source, finding, _WANTED, remedy)
    fit_steps.refuse_beyond_lens(float(np.degrees(angle_rad.max())), lens, targets.source)


def _warnings(
    targets: Targets, missed_px: Array, used: Mask, new: Lens, before: Lens
) -> tuple[str, ...]:
    """Return warnings of omitted targets, and of a circle or pose far from the profile's.

    missed_px [n]: distances of the targets from the fit; used [n]: True for targets that were not
    omitted; new, before: the fitted lens and the profile's.
    """
    far = [
        f"{targets.x_px[i]:g}, {targets.y_px[i]:g} (off by {missed_px[i]:.0f} px)"
        for i in np.flatnonzero(~used)
    ]
    texts = [f"left out because no lens explains them: {'; '.join(far)}"] if far else []
    if (change := _change(_circle(new), _circle(before))) > _MAX_CHANGE:
        x, y, radius = _circle(before)
        texts.append(
            f"centre or radius differs by {100 * change:.0f} % of the radius from the profile's "
            f"({x:.0f}, {y:.0f} px, radius {radius:.0f} px): if that is right, state places in "
            "complete frames, not in previews"
        )
    turn = new.axes() @ before.axes().T
    turned_deg = float(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
    if turned_deg > 30.0:  # no camera is mounted that badly
        texts.append(
            f"the fitted pose (azimuth {new.azimuth_deg:.1f}, tilt {new.tilt_deg:.1f}, roll "
            f"{new.roll_deg:.1f} deg) is turned by {turned_deg:.0f} deg from the profile's: if the "
            "camera was not turned, state azimuths from the camera's heading, not from north"
        )
    return tuple(texts)


def _with_fitted_pose(targets: Targets, lens: Lens) -> Lens:
    """Return the lens with the pose that its targets give, from which a fit can start.

    The pose is the rotation from the directions by the level lens to the true ones. Raises
    InputError if only mirrored directions fit, which means that a sign is wrong.
    """
    rays = lens_rays(level_lens(lens), targets.x_px, targets.y_px)
    miss, turn = _rotation_between(rays, targets.rays)
    mirrored_miss, _ = _rotation_between(rays * (-1.0, 1.0, 1.0), targets.rays)
    if mirrored_miss < 0.5 * miss and miss > 0.1:
        finding = "the targets fit a lens only as a mirror image"
        remedy = "check the targets for a wrong sign, or for x and y exchanged"
        raise InputError(targets.source, finding, _WANTED, remedy)
    left, tilt, roll = turn.as_euler("ZXY", degrees=True).tolist()
    return replace(lens, azimuth_deg=-left, tilt_deg=tilt, roll_deg=roll)


def _rotation_between(directions: Array, true: Array) -> tuple[float, Any]:
    """Return the median error of the rotation from directions to `true` ones, and the rotation.

    Both are unit vectors [n, 3]; the error is the chord between rotated and true ones. The
    rotation, an object of scipy, solves Wahba's problem (1965), with less weight for gross errors.
    """
    off, turn = np.ones(len(directions)), Rotation.identity()
    for _ in range(10):
        with warnings.catch_warnings(action="ignore"):  # of places that are all on one ray
            turn = Rotation.align_vectors(true, directions, weights=1.0 / np.maximum(off, 0.02))[0]
        off = np.linalg.norm(true - turn.apply(directions), axis=1)
    return float(np.median(off)), turn


def _rounded(lens: Lens) -> Lens:
    """Return a fitted lens with the digits that a profile has, and angles within 180 degrees."""
    x, y = np.round(lens.centre_px, 3).tolist()
    pose = {name: round((getattr(lens, name) + 180) % 360 - 180, 4) for name in _POSE}
    terms = tuple(np.round(lens.coefficients, 7).tolist())
    radius_px = round(lens.radius_px, 3)
    return replace(lens, centre_px=(x, y), radius_px=radius_px, coefficients=terms, **pose)


# ----------------------------------------------------------------------------------------------
# chessboards
#
# Lens and poses of all boards are fitted together to the corners (bundle adjustment, Triggs et al.
# 1999), from poses by the profile's lens: first with the most flexible mapping, whose rays to the
# corners choose the mapping, then with that one.


def frame_picture(path: Path, profile: CameraProfile) -> UInts8:
    """Read a frame of the profile's camera as grey codes 0 to 255, [h, w].

    Raises InputError for a file that cannot be read, or a frame of another size.
    """
    grey = grey_picture(path)
    check_frame(path, grey.shape, "", profile)
    return grey


def chessboard_corners(picture: UInts8, columns: int, rows: int) -> Array | None:
    """Return a chessboard's inner corners, x and y [rows * columns, 2] px; None without a board.

    The corners are row by row, `columns` in each row. Both coordinates are 0.5 in the middle of the
    first pixel. picture: grey codes [h, w]; columns, rows: numbers of inner corners along the
    board's sides.
    """
    how = cv2.CALIB_CB_NORMALIZE_IMAGE
    complete, corners = cv2.findChessboardCornersSB(picture, (columns, rows), flags=how)
    # OpenCV counts from a pixel's middle.
    return np.asarray(corners, float).reshape(-1, 2) + 0.5 if complete else None


def fit_boards(
    corners: Sequence[Array], columns: int, rows: int, lens: Lens
) -> tuple[LensFit, Targets]:
    """Fit a lens and the poses of n chessboards; return the fit, and the corners as its targets.

    corners: results of `chessboard_corners` [rows * columns, 2] px, one for each picture with a
    board; columns, rows: numbers of inner corners along the board's sides. The fit starts from
    `lens`, and the result has its pose (azimuth, tilt, roll), because boards do not determine it;
    its rms is the residual of the corners. Raises NotEnoughDataError for fewer than four boards,
    InputError for corners that no lens explains.
    """
    remedy = "check the corners after --chessboard; take sharp pictures, also at the circle's edge"
    fit_steps.require(len(corners), 4, "pictures in which the chessboard was detected", remedy)
    points = np.zeros((rows * columns, 3))
    points[:, :2] = np.mgrid[:columns, :rows].T.reshape(-1, 2)

    def rays_of(poses: Array) -> Array:
        """Return the directions [corners, 3] of all corners; poses [6 n]: see `_board_pose`."""
        boards = [(Rotation.from_rotvec(p[:3]), p[3:]) for p in poses.reshape(-1, 6)]
        places = np.concatenate([turn.apply(points) + position for turn, position in boards])
        return places / np.linalg.norm(places, axis=-1, keepdims=True)

    x, y = np.concatenate(corners).T
    level = level_lens(lens)
    poses = np.concatenate([_board_pose(level, c, points) for c in corners])
    _, poses, _ = _solve(level, MODELS["four terms"], x, y, rays_of, poses, pose=False)
    rays = rays_of(poses)[:, [0, 2, 1]] @ lens.axes()  # from the optical axis to the heading
    targets = Targets(x_px=x, y_px=y, rays=rays, source="chessboard")
    start = fit(targets, lens)
    powers = tuple(i + 1 for i, c in enumerate(start.lens.coefficients) if c)
    model, own = (start.lens.mapping, powers), level_lens(start.lens)
    fitted, _, solved = _solve(own, model, x, y, rays_of, poses, pose=False)
    rms = float(np.sqrt(2.0 * np.mean(solved.fun**2)))  # of distances; x and y are separate
    u_px = rms / np.sqrt(2) * np.sqrt(np.diag(np.linalg.pinv(solved.jac.T @ solved.jac))[:2].max())
    text = f"residual of the corners {rms:.2f} px rms, uncertainty of the centre {u_px:.2f} px"
    choice = replace(start.choice, rms=rms, line=f"{start.choice.line}; {text}")
    new = replace(_rounded(fitted), **{name: getattr(lens, name) for name in _POSE})
    return start._replace(lens=new, choice=choice), targets


def _board_pose(level: Lens, corners: Array, points: Array) -> Array:
    """Return the pose of a board, [6]: rotation vector [rad], then position [squares].

    level: a lens that looks along the heading; corners: the board's in the picture, x and y [n, 2]
    px; points: the same on the board, in squares [n, 3]. The corners are projected to a plane in
    front of the board, as a pinhole camera sees them.
    """
    rays = lens_rays(level, *corners.T)
    turn = Rotation.align_vectors([[0.0, 0.0, 1.0]], [rays.mean(axis=0)])[0]
    flat = turn.apply(rays)
    places = np.ascontiguousarray(flat[:, :2] / flat[:, 2:])
    _, rotation, position = cv2.solvePnP(points, places, np.eye(3), None)
    own = turn.inv() * Rotation.from_rotvec(np.ravel(rotation))
    return np.concatenate([own.as_rotvec(), turn.inv().apply(np.ravel(position))])


# ----------------------------------------------------------------------------------------------
# image circle


class Circle(NamedTuple):
    """The image circle of a fisheye: centre (x, y) and radius in px.

    u_px: standard uncertainty of the radius: the edge points' distance from the circle, and 1 px
    for the place of the edge between light and dark. edge: x, y [2, n] of n points on the edge
    [px].
    """

    centre_px: tuple[float, float]
    radius_px: float
    u_px: float
    edge: Array


def circle(
    picture: UInts8, lens: Lens, source: Path | str = "circle", *, guessed: bool = False
) -> Circle:
    """Find the lens's image circle in a picture [h, w] of 8-bit grey of an evenly lit field.

    The search begins at the circle of `lens`, first widely, then closely. The edge is the place
    where linear light is half way between the light just inside the circle and the darkest place
    outside, along 720 rays. source: the file, for errors. guessed: the circle of `lens` was never
    measured, and the search begins at the bright area instead. Raises InputError if over a tenth of
    the rays have no edge on the circle (in a picture of a room, its edges look like the circle's),
    and for a circle whose centre or radius differs from where the search began by over 15 % of the
    radius.
    """
    start = _bright_area(picture) if guessed else _circle(lens)
    fitted, edge, on_circle, off = start, np.empty((2, 0)), 0.0, np.empty(0)  # x, y, radius

    def misses(circle: Array) -> Array:
        """Return how far the edge points are outside a circle of x, y and radius [px]."""
        return np.hypot(edge[0] - circle[0], edge[1] - circle[1]) - circle[2]

    for reach in (2.0 * _MAX_CHANGE, 0.1, 0.1):
        edge, rays = _edge_points(picture, fitted, reach)
        if edge.shape[1] < 60:
            on_circle = 0.0
            break
        fitted = least_squares(misses, fitted, loss="soft_l1", f_scale=0.5).x
        off = misses(fitted)
        # Evenly lit fields have a share of 1.0, six exposures of a real room at most 0.71.
        on_circle = (np.abs(off) < max(0.005 * fitted[2], 2.0)).sum() / rays
    if on_circle < 0.9 or _change(fitted, start) > _MAX_CHANGE:
        x, y, radius = start
        whose = "the bright area" if guessed else "the profile's circle"
        finding = f"{100 * on_circle:.0f} % of the edge of a circle"
        near = f"{whose} at {x:.0f}, {y:.0f} px, radius {radius:.0f} px"
        expected = f"an evenly lit circle on black, within {100 * _MAX_CHANGE:.0f} % of {near}"
        remedy = "take a frame of white paper in front of the lens, without clipping"
        raise InputError(source, finding, expected, remedy)
    x, y, radius = fitted.tolist()
    return Circle((x, y), radius, float(np.hypot(robust_sigma(off, 0.0), 1.0)), edge)


def _circle(lens: Lens) -> Array:
    """Return centre x, y and radius of a lens's image circle [px], [3]."""
    return np.array([*lens.centre_px, lens.radius_px])


def _change(circle: Array, before: Array) -> float:
    """Return how far a circle is from another, as a share of the other's radius.

    circle, before: x, y and radius, [3]. It is the larger of the centre's and the radius's change.
    """
    x, y, radius = circle - before
    return float(max(np.hypot(x, y), abs(radius)) / before[2])


def _bright_area(picture: UInts8) -> Array:
    """Return centre x, y and radius [px] of a disc as large as a picture's bright area, [3].

    An area is bright if its linear light is above the middle between dark and bright.
    """
    light = (picture / 255.0) ** 2.2
    low, high = np.percentile(light, (1.0, 99.0))
    rows, columns = np.nonzero(light >= (low + high) / 2)
    return np.array([columns.mean() + 0.5, rows.mean() + 0.5, np.sqrt(len(rows) / np.pi)])


def _edge_points(picture: UInts8, around: Array, reach: float) -> tuple[Array, int]:
    """Return n points x, y [2, n] on the edge of a circle, and the number of rays that reach it.

    around: x, y and radius of the circle [px]. The edge is searched within `reach`, a share of the
    radius. Rays that leave the picture inside the circle are not counted.
    """
    smooth = 255 * gaussian_filter((picture.astype(np.float32) / 255) ** 2.2, 1.0)
    turn = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    x, y, radius = around
    # distances from the centre at which each ray is sampled, every quarter of a pixel
    out = radius * (1.0 - reach) + np.arange(0.0, 2 * reach * radius, 0.25)
    columns, rows = x + np.outer(np.cos(turn), out) - 0.5, y + np.outer(np.sin(turn), out) - 0.5
    # light along each ray [720, distances], NaN outside the picture
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


# ----------------------------------------------------------------------------------------------
# charts


def chart(targets: Targets, fit: LensFit) -> Chart:
    """Return a chart of the targets' distances from the centre over their angles from the axis."""
    x, y, angle_rad = lens_pixels(fit.lens, targets.rays)
    x0, y0 = fit.lens.centre_px
    read, fitted = np.hypot(targets.x_px - x0, targets.y_px - y0), np.hypot(x - x0, y - y0)
    angle = ("angle from the optical axis [deg]", np.degrees(angle_rad))
    title = f"lens, {fit.lens.mapping}; rms {fit.choice.rms:.2g} px"
    distance = ("distance from the centre [px]", read)
    return Chart(title, read / fitted - 1.0, (), angle, distance, fitted)


def circle_chart(circle: Circle, source: Path) -> Chart:
    """Return a chart of the image circle's edge points over the frame `source`."""
    (x, y), radius = circle.centre_px, circle.radius_px
    distance = np.hypot(circle.edge[0] - x, circle.edge[1] - y)
    title = f"centre {x:.1f}, {y:.1f}, radius {radius:.1f} px, uncertainty {circle.u_px:.1f} px"
    places = [Place(source, x_px, y_px) for x_px, y_px in circle.edge.T.tolist()]
    return Chart(title, distance / radius - 1.0, places)
