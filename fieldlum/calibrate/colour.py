"""Three numbers from camera colours to luminance: the maker's own, moved by readings as far as they prove it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.frames import LinearFrame, linear_frame, nearest_lens, transmission
from fieldlum.calibrate.keep import needed, read_table
from fieldlum.calibrate.order import Candidate, Choice, choose
from fieldlum.errors import InputError, NotEnoughDataError
from fieldlum.profiles import CameraProfile

Array = NDArray[np.floating]
READING_U = 0.02
PULLS = ((1.0, "near the prior"), (0.1, "half-way"), (0.01, "mostly the readings"), (1e-4, "free"))
LEAST = 4

# Luminous reflectance Y in percent, illuminant C, row by row from dark skin: McCamy, Marcus, Davidson, "A
# color-rendition chart", J. Appl. Photogr. Eng. 2(3), 1976.
CHART_Y = (
    10.1, 35.8, 19.3, 13.3, 24.3, 43.1,
    30.1, 12.0, 19.8, 6.6, 44.3, 43.1,
    6.1, 23.4, 12.0, 59.1, 19.8, 19.8,
    90.0, 59.1, 36.2, 19.8, 9.0, 3.1,
)  # fmt: skip
CHART_ROWS, CHART_COLUMNS = 4, 6
CHART_TRIES = 6
CHART_U = 0.03  # of a printed chart's patch


@dataclass(frozen=True, slots=True)
class Colours:
    """rgb [n, 3] camera colours, y [n] luminances in any one unit, u_rel [n], labels."""

    rgb: Array
    y: Array
    u_rel: Array
    labels: tuple[str, ...]
    frames: tuple[Path, ...]
    matrix: Array | None = None  # XYZ to camera, where the frames know it


@dataclass(frozen=True, slots=True)
class Fit:
    y_from_rgb: tuple[float, float, float]
    scale: float  # luminance over a . rgb with the new figures: what k would be multiplied by
    u_rel: float  # rms of the held-out errors
    residual: Array
    choice: Choice


# ---------------------------------------------------------------------------------------------- readings


def from_table(path: Path, profile: CameraProfile) -> Colours:
    """Spot readings: file, x_px, y_px, luminance_cdm2; optional radius_px (12), u_rel. Vignetting is taken out."""
    rows = read_table(path, ("file", "x_px", "y_px", "luminance_cdm2"), ("radius_px", "u_rel"))
    frames: dict[Path, LinearFrame] = {}
    rgb, y, u, labels = [], [], [], []
    for row in rows:
        file, x, at = needed(row, "file", path), needed(row, "x_px", path), needed(row, "y_px", path)
        frame = frames.setdefault(file, linear_frame(file, profile))
        patch = frame.patch(x, at, row.get("radius_px") or 12.0)
        lens = profile.lens[nearest_lens(profile, x, at)]
        rgb.append(patch.rgb / transmission(lens, frame.exposure.f_number, x, at))
        y.append(needed(row, "luminance_cdm2", path))
        u.append(float(np.hypot(row.get("u_rel") or READING_U, patch.u_rel)))
        labels.append(f"{file.stem} {x:g},{at:g}")
    matrix = next((f.colour_matrix for f in frames.values() if f.colour_matrix is not None), None)
    return Colours(np.array(rgb), np.array(y), np.array(u), tuple(labels), tuple(frames), matrix)


def from_chart(path: Path, profile: CameraProfile, corners_px: Sequence[float] = ()) -> Colours:
    """A 24-patch chart in a frame, evenly lit: found by OpenCV's mcc, or by its four outer patch-field corners.

    corners_px: x, y of the top left (dark skin), top right, bottom right (black) and bottom left corner.
    """
    frame = linear_frame(path, profile)
    centres, radius = _patch_centres(np.reshape(corners_px, (4, 2))) if len(corners_px) else find_chart(frame)
    rgb, u = [], []
    for x, y in centres:
        patch = frame.patch(x, y, radius)
        rgb.append(patch.rgb / transmission(profile.lens[nearest_lens(profile, x, y)], frame.exposure.f_number, x, y))
        u.append(float(np.hypot(CHART_U, patch.u_rel)))
    labels = tuple(f"patch {i + 1}" for i in range(len(CHART_Y)))
    return Colours(np.array(rgb), np.array(CHART_Y), np.array(u), labels, (path,), frame.colour_matrix)


def _patch_centres(corners: Array) -> tuple[NDArray[Any], float]:
    """Centres [24, 2] and a safe radius of the patches within the quadrilateral of corners [4, 2]."""
    import cv2

    square = np.array([[0, 0], [CHART_COLUMNS, 0], [CHART_COLUMNS, CHART_ROWS], [0, CHART_ROWS]], np.float32)
    h = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
    at = np.array([[c + 0.5, r + 0.5, 1.0] for r in range(CHART_ROWS) for c in range(CHART_COLUMNS)]) @ h.T
    centres = at[:, :2] / at[:, 2:]
    gap = np.linalg.norm(centres[1] - centres[0]), np.linalg.norm(centres[CHART_COLUMNS] - centres[0])
    return centres, 0.25 * float(min(gap))


def find_chart(frame: LinearFrame) -> tuple[NDArray[Any], float]:
    """Centres [24, 2] in sensor pixels and a safe radius of a chart's patches. Raises InputError when none is found.

    The detector starts from random clusters and may fail once on a good picture: it is asked CHART_TRIES times.
    """
    import cv2

    if not hasattr(cv2, "mcc"):
        raise InputError(frame.path, "an OpenCV without mcc", "opencv-contrib", "give --corners by hand")
    shown = np.clip(frame.rgb / max(float(np.percentile(frame.rgb[..., 1], 99)), 1e-9), 0, 1) ** (1 / 2.2)
    picture = np.ascontiguousarray((255 * shown[..., ::-1]).astype(np.uint8))
    for seed in range(CHART_TRIES):
        cv2.setRNGSeed(seed + 1)
        detector = getattr(cv2.mcc, "CCheckerDetector_create")()  # noqa: B009 (its stubs lack it)
        if detector.process(picture, 1):  # asked for a chart without one, it would crash
            patches = np.asarray(detector.getBestColorChecker().getColorCharts(), float).reshape(-1, 4, 2) * frame.step
            side = np.linalg.norm(patches - np.roll(patches, 1, axis=1), axis=-1).min()
            return patches.mean(axis=1), 0.3 * float(side)
    raise InputError(
        frame.path, "no colour chart found", "a 24-patch chart, sharp and upright", "give --corners by hand"
    )


# ---------------------------------------------------------------------------------------------- fit


def priors(colours: Colours, profile: CameraProfile) -> list[tuple[Array, str]]:
    """The profile's coefficients, and the luminance row of the frames' own matrix (camera to XYZ), of the same size."""
    of_profile = np.array(profile.colour.y_from_rgb)
    found: list[tuple[Array, str]] = [(of_profile, "the profile's coefficients")]
    if colours.matrix is not None:
        row = np.linalg.inv(colours.matrix)[1]
        grey = colours.rgb.mean(axis=0)
        found.append((row * float(of_profile @ grey) / float(row @ grey), "the file's colour matrix"))
    return found


def fit(colours: Colours, profile: CameraProfile) -> Fit:
    """Ridge towards the prior; how far to leave it is chosen on readings left out one by one.

    The new coefficients give the mean colour of the readings the same luminance as the prior did: only their
    proportion is fitted here, the absolute factor belongs to `calibrate scale` and is returned beside.
    Raises NotEnoughDataError under four readings.
    """
    n = len(colours.y)
    if n < LEAST:
        raise NotEnoughDataError(f"{n} readings are too few for three coefficients: take at least {LEAST} colours")
    if not ((colours.y > 0).all() and (colours.rgb[:, 1] > 0).all()):
        raise InputError(colours.frames[0], "readings or patches that are not positive", "colours that the frame holds")
    rows, each = np.arange(n), range(n)

    def candidate(prior: Array, pull: float, name: str, size: int) -> Candidate:
        errors = [(_predict(_solve(colours, prior, pull, rows != i), colours, i) - 1.0) ** 2 for i in each]
        return Candidate(name, size, np.array(errors))

    starts = priors(colours, profile)
    candidates = [candidate(start, np.inf, name, 0) for start, name in starts]
    prior = starts[int(np.argmin([c.errors.mean() for c in candidates]))][0]
    models = [(start, np.inf) for start, _ in starts] + [(prior, pull) for pull, _ in PULLS]
    candidates += [candidate(prior, pull, name, size) for size, (pull, name) in enumerate(PULLS, start=1)]
    choice = choose("colour", candidates)
    prior, pull = models[choice.index]
    raw = _solve(colours, prior, pull, rows >= 0)
    grey = (colours.rgb / (colours.rgb @ prior)[:, None]).mean(axis=0)
    scale = float(raw @ grey) / float(prior @ grey)
    a = raw / scale
    residual = colours.rgb @ raw / colours.y - 1.0
    u = float(np.sqrt(candidates[choice.index].errors.mean()))
    return Fit(
        (round(float(a[0]), 6), round(float(a[1]), 6), round(float(a[2]), 6)), scale, max(u, 0.001), residual, choice
    )


def _solve(colours: Colours, prior: Array, pull: float, rows: NDArray[np.bool_]) -> Array:
    """Minimise sum ((a . rgb / y - 1) / u)^2 + n pull / u^2 |share * (a - s prior)|^2, s the prior's own best scale."""
    rgb, y, u = colours.rgb[rows], colours.y[rows], colours.u_rel[rows]
    weighted = (rgb @ prior) / y / u
    s = float(weighted @ (1.0 / u) / (weighted @ weighted))
    if np.isinf(pull):
        return s * prior
    design, target = rgb / y[:, None] / u[:, None], 1.0 / u
    share = np.diag((rgb / y[:, None]).mean(axis=0) * np.sqrt(len(y) * pull) / np.median(u))
    stacked = np.concatenate([design, share]), np.concatenate([target, share @ (s * prior)])
    return np.linalg.lstsq(*stacked, rcond=None)[0]


def _predict(a: Array, colours: Colours, i: int) -> float:
    return float(colours.rgb[i] @ a / colours.y[i])
