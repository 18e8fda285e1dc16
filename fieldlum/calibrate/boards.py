"""Fit a lens to pictures of a chessboard.

OpenCV's omnidirectional model (Mei and Rives 2007) is fitted first. Its parameters are not unique,
but its rays and its poses of the boards are a good start. fieldlum's own mapping is then fitted to
the corners, together with all poses (bundle adjustment, Triggs et al. 1999). Therefore the residual
is that of the corners, and the centre has an uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fieldlum.calibrate import lens as lenses
from fieldlum.calibrate.lens import LensFit, Targets
from fieldlum.calibrate.lens_circle import grey_picture
from fieldlum.core.arrays import Array
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.optics.profiles import Lens
from fieldlum.optics.projection import LensGeometry, lens_pixels

MIN_BOARDS = 4  # chosen so that poses and lens can be separated, not measured
_MAX_MISS_PX = 3.0  # a larger residual is a failed fit; chosen, not measured


@dataclass(frozen=True, slots=True)
class Boards:
    """Chessboard corners on the sensor, their places on the board, and start values of a fit.

    corners [boards, points, 2] : x and y on the sensor [px]; points [points, 3] : their places on
    the board, with the side of a square as unit; poses [boards, 6] : start value of each board's
    rotation vector [rad] and position [squares] in OpenCV's camera frame; targets : rays of
    OpenCV's model, with their pixels, in the part of the picture that has corners.
    """

    corners: Array
    points: Array
    poses: Array
    targets: Targets


def chessboard_corners(path: Path, columns: int, rows: int) -> Array | None:
    """Return a chessboard's inner corners, x and y [rows * columns, 2] px; None without a board.

    columns, rows : numbers of inner corners along the board's sides. Raises InputError if the file
    cannot be read as a picture.
    """
    import cv2

    complete, corners = cv2.findChessboardCornersSB(
        grey_picture(path), (columns, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    if not complete:
        return None
    return np.asarray(corners, float).reshape(-1, 2) + 0.5  # OpenCV counts from a pixel's middle


def from_boards(
    corners: Sequence[Array],
    columns: int,
    rows: int,
    size_px: tuple[int, int],
    paths: Sequence[Path] = (),
) -> Boards:
    """Fit OpenCV's omnidirectional model to the corners of n boards; return its rays and poses.

    corners : results of `chessboard_corners`, one for each picture with a board; size_px : width
    and height of the pictures; paths : their files, for errors and the profile. Boards that OpenCV
    rejects are omitted. Raises NotEnoughDataError for fewer than four boards, InputError if the fit
    fails or its residual is above 3 px.
    """
    import cv2

    if len(corners) < MIN_BOARDS:
        raise NotEnoughDataError(
            f"pictures in which the chessboard was detected: {len(corners)}; expected at least "
            f"{MIN_BOARDS}; check the number of inner corners after --chessboard, and take sharp "
            "pictures in which the board reaches the edge of the lens circle"
        )
    board = np.zeros((1, rows * columns, 3))
    board[0, :, :2] = np.mgrid[:columns, :rows].T.reshape(-1, 2)
    # (1, N, C) is the one shape that OpenCV 4 and 5 both accept.
    places = [np.asarray(c - 0.5, np.float64).reshape(1, -1, 2) for c in corners]
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 300, 1e-9)
    omnidir: Any = cv2.omnidir
    flags = omnidir.CALIB_FIX_SKEW
    try:
        arguments = [board] * len(corners), places, size_px, None, None, None, flags, stop
        rms, k, xi, d, turns, shifts, used = omnidir.calibrate(*arguments)
    except cv2.error as error:
        raise InputError(
            "chessboard",
            f"OpenCV could not fit a lens ({str(error).splitlines()[0]})",
            "pictures with the board in many places, none seen edge-on",
            "take more pictures with the board in other places and tilts",
        ) from None
    if not np.isfinite(rms) or rms > _MAX_MISS_PX:
        finding = f"the residual of the lens fit is {rms:.1f} px"
        expected = f"at most {_MAX_MISS_PX:g} px"
        remedy = "take sharper pictures, with the board in more places and tilts"
        raise InputError("chessboard", finding, expected, remedy)
    corners_px = np.concatenate([np.asarray(c, float) for c in corners])
    targets = _model_rays(
        corners_px, np.asarray(k), np.asarray(d), float(np.ravel(xi)[0]), tuple(paths)
    )
    kept = np.ravel(used).astype(int)
    poses = np.concatenate([np.reshape(turns, (-1, 3)), np.reshape(shifts, (-1, 3))], axis=1)
    return Boards(np.stack([np.asarray(corners[i], float) for i in kept]), board[0], poses, targets)


def fit(boards: Boards, lens: Lens) -> LensFit:
    """Fit the lens to the rays of OpenCV's model, then lens and board poses to the corners.

    The fit starts from `lens`. The result has the pose (azimuth, tilt, roll) of `lens`, because
    boards do not determine it; its rms_px is the residual of the corners. Raises InputError or
    NotEnoughDataError as `fieldlum.calibrate.lens.fit` does.
    """
    from scipy.optimize import least_squares

    # Boards determine the lens's own axis only, not its pose.
    level = replace(lens, azimuth_deg=0.0, tilt_deg=0.0, roll_deg=0.0)
    start = lenses.fit(boards.targets, lens)
    powers = tuple(i + 1 for i, c in enumerate(start.lens.coefficients) if c)
    lens_fitted = start.lens
    figures = [
        *lens_fitted.centre_px,
        lens_fitted.radius_px,
        *(lens_fitted.coefficients[p - 1] for p in powers[1:]),
    ]

    def shown(x: Array) -> LensGeometry:
        return lenses.geometry_of_figures(
            level, x[: len(figures)], lens_fitted.mapping, powers, pose=False
        )

    def misses(x: Array) -> Array:
        turned = [_directions(boards.points, pose) for pose in x[len(figures) :].reshape(-1, 6)]
        px, py, _ = lens_pixels(shown(x), np.stack(turned))
        return np.concatenate(
            [(px - boards.corners[..., 0]).ravel(), (py - boards.corners[..., 1]).ravel()]
        )

    solved = least_squares(
        misses, [*figures, *boards.poses.ravel()], x_scale="jac", loss="soft_l1", max_nfev=60
    )
    geometry, residuals_px = shown(solved.x), misses(solved.x).reshape(2, -1)
    missed = np.hypot(*residuals_px)
    rms = float(np.sqrt(np.mean(missed**2)))
    u_px = rms / np.sqrt(2) * np.sqrt(np.diag(np.linalg.pinv(solved.jac.T @ solved.jac))[:2].max())
    new = lenses.with_mapping(lens_fitted, geometry)
    text = f"residual of the corners {rms:.2f} px rms, uncertainty of the centre {u_px:.2f} px"
    choice = replace(start.choice, line=f"{start.choice.line}; {text}")
    per_px = lens.full_angle_deg / 2 / geometry.radius_px
    return replace(start, lens=new, rms_px=rms, rms_deg=rms * per_px, choice=choice)


def _directions(points: Array, pose: Array) -> Array:
    """Return unit vectors [points, 3] of a board's points (x right, y forward, z up)."""
    from scipy.spatial.transform import Rotation

    at = Rotation.from_rotvec(pose[:3]).apply(points) + pose[3:]
    at = np.stack([at[:, 0], at[:, 2], -at[:, 1]], axis=1)
    return at / np.linalg.norm(at, axis=1, keepdims=True)


def _model_rays(
    corners_px: Array, k: Array, d: Array, xi: float, paths: tuple[Path, ...]
) -> Targets:
    """Return directions that OpenCV's model gives for the part of the picture with corners.

    They are a fan of rays, projected by the model.
    """
    import cv2

    angle = np.radians(np.arange(1.0, 110.0, 2.0))
    turn = np.radians(np.arange(0.0, 360.0, 15.0))
    a, t = (grid.ravel() for grid in np.meshgrid(angle, turn))
    # OpenCV's axes: x to the right, y down, z forward.
    away = np.stack([np.sin(a) * np.cos(t), np.sin(a) * np.sin(t), np.cos(a)], axis=1)
    zero = np.zeros((3, 1))
    shown, *_ = cv2.omnidir.projectPoints(away.reshape(1, -1, 3), zero, zero, k, xi, d)
    at = np.asarray(shown).reshape(-1, 2) + 0.5
    centre = k[:2, 2] + 0.5
    reach = np.percentile(np.linalg.norm(corners_px - centre, axis=1), 99.5)
    radius = np.linalg.norm(at - centre, axis=1)
    near = radius <= reach
    # fieldlum's axes: x right (east), y forward (north), z up.
    rays = np.stack([away[:, 0], away[:, 2], -away[:, 1]], axis=1)
    return Targets(at[near, 0], at[near, 1], rays[near], paths, pose_known=True)
