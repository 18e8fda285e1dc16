"""The 24-patch chart in a frame: where its patches are, and whether what was found is a chart at
all.

Lattices of patches (chart_grid.py) are looked for first, then OpenCV's mcc is asked, at several
sizes of the picture. mcc alone misses many a good chart, as its random start falls, and now and
then finds one where none is. Whatever says where a chart may lie, it counts only when the 24
colours there are a chart's, in order.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.chart_grid import grids
from fieldlum.calibrate.frames import LinearFrame
from fieldlum.errors import InputError

Array = NDArray[np.floating]

# Luminous reflectance Y in percent, illuminant C, row by row from dark skin: McCamy, Marcus,
# Davidson, "A color-rendition chart", J. Appl. Photogr. Eng. 2(3), 1976.
CHART_Y = (
    10.1,
    35.8,
    19.3,
    13.3,
    24.3,
    43.1,
    30.1,
    12.0,
    19.8,
    6.6,
    44.3,
    43.1,
    6.1,
    23.4,
    12.0,
    59.1,
    19.8,
    19.8,
    90.0,
    59.1,
    36.2,
    19.8,
    9.0,
    3.1,
)
ROWS, COLUMNS = 4, 6
# The maker's sRGB codes of the same patches (X-Rite, ColorChecker Classic).
_SRGB = (
    (115, 82, 68),
    (194, 150, 130),
    (98, 122, 157),
    (87, 108, 67),
    (133, 128, 177),
    (103, 189, 170),
    (214, 126, 44),
    (80, 91, 166),
    (193, 90, 99),
    (94, 60, 108),
    (157, 188, 64),
    (224, 163, 46),
    (56, 61, 150),
    (70, 148, 73),
    (175, 54, 60),
    (231, 199, 31),
    (187, 86, 149),
    (8, 133, 161),
    (243, 243, 242),
    (200, 200, 200),
    (160, 160, 160),
    (122, 122, 121),
    (85, 85, 85),
    (52, 52, 52),
)
_ALIKE = 0.2  # relative misfit of a chart's colours; any other order of them leaves 0.6 and more
_IN_ORDER = 0.9  # correlation of ln Y
_GRID_SIZES = (1.0, 2.0)  # of the picture
_TRIES = (
    (1.0, 11),
    (1.0, 23),
    (2.0, 11),
    (0.5, 11),
    (1.5, 23),
    (0.7, 23),
)  # the same and mcc's smallest window [px]
_LONGEST = 1600  # px of the picture that is searched at size 1


def misfit(rgb: Array) -> float:
    """How far camera colours [24, 3] are from a chart's, through the best 3 x 3 matrix: rms
    relative to each patch.
    """
    from fieldlum.photometry import srgb_table

    chart = srgb_table()[np.array(_SRGB)]
    weight = 1.0 / (chart.mean(axis=1, keepdims=True) + 0.03)
    camera = np.asarray(rgb, float) / max(float(np.max(rgb)), 1e-12)
    matrix = np.linalg.lstsq(camera * weight, chart * weight, rcond=None)[0]
    return float(np.sqrt(np.mean(((camera @ matrix - chart) * weight) ** 2)))


def in_order(luminance: Array) -> bool:
    """Whether 24 luminances, in any unit, rise and fall as the chart's do."""
    logs = np.log(np.maximum(np.asarray(luminance, float), 1e-12))
    return float(np.corrcoef(logs, np.log(CHART_Y))[0, 1]) > _IN_ORDER


def patch_centres(corners: Array) -> tuple[NDArray[Any], float]:
    """Centres [24, 2] and a safe radius of the patches within the quadrilateral of corners [4,
    2].
    """
    import cv2

    square = np.array([[0, 0], [COLUMNS, 0], [COLUMNS, ROWS], [0, ROWS]], np.float32)
    h = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
    at = np.array([[c + 0.5, r + 0.5, 1.0] for r in range(ROWS) for c in range(COLUMNS)]) @ h.T
    centres = at[:, :2] / at[:, 2:]
    gap = np.linalg.norm(centres[1] - centres[0]), np.linalg.norm(centres[COLUMNS] - centres[0])
    return centres, 0.25 * float(min(gap))


def find_chart(frame: LinearFrame) -> tuple[NDArray[Any], float]:
    """Centres [24, 2] in sensor pixels and a safe radius of a chart's patches. Raises InputError
    when none is found.
    """
    shown = np.clip(frame.rgb / max(float(np.percentile(frame.rgb[..., 1], 99)), 1e-9), 0, 1) ** (
        1 / 2.2
    )
    picture = np.ascontiguousarray((255 * shown[..., ::-1]).astype(np.uint8))
    nearest = np.inf
    for patches in _candidates(picture):
        colours = _colours(frame.rgb, patches)
        if colours is None:
            continue
        off = misfit(colours)
        if off < _ALIKE:
            side = np.linalg.norm(patches - np.roll(patches, 1, axis=1), axis=-1).min()
            return patches.mean(axis=1) * frame.step, 0.3 * float(side) * frame.step
        nearest = min(nearest, off)
    found = "no colour chart found"
    if np.isfinite(nearest):
        found = (
            f"no colour chart found: what looks like one has other colours, or another order "
            f"({100 * nearest:.0f} %)"
        )
    raise InputError(
        frame.path, found, "a 24-patch chart, sharp and upright", "give --corners by hand"
    )


def _candidates(picture: NDArray[np.uint8]) -> Iterator[NDArray[np.float64]]:
    """Quadrilaterals [24, 4, 2] of what may be a chart's patches, row by row, in pixels of the
    picture.
    """
    for size in _GRID_SIZES:
        searched, by = _sized(picture, size)
        for patches in grids(searched, ROWS, COLUMNS):
            yield patches / by
    yield from _of_mcc(picture)


def _of_mcc(picture: NDArray[np.uint8]) -> Iterator[NDArray[np.float64]]:
    """What OpenCV's detector takes for a chart's patches; nothing where the installed OpenCV has
    none.
    """
    import cv2

    for seed, (size, window_px) in enumerate(_TRIES if hasattr(cv2, "mcc") else ()):
        searched, by = _sized(picture, size)
        asked = getattr(cv2.mcc, "DetectorParametersMCC")()  # noqa: B009 (OpenCV's stubs lack both)
        asked.adaptiveThreshWinSizeMin = window_px
        cv2.setRNGSeed(seed + 1)  # it starts from random clusters
        detector = getattr(cv2.mcc, "CCheckerDetector_create")()  # noqa: B009
        detector.setDetectionParams(asked)
        if detector.process(searched, 1):  # asked for a chart without one, it would crash
            yield (
                np.asarray(detector.getBestColorChecker().getColorCharts(), float).reshape(-1, 4, 2)
                / by
            )


def _sized(picture: NDArray[np.uint8], size: float) -> tuple[NDArray[np.uint8], float]:
    """The picture at a size relative to that of at most _LONGEST pixels, and the factor from the
    picture itself.
    """
    import cv2

    by = size * min(1.0, _LONGEST / max(picture.shape[:2]))
    how = cv2.INTER_AREA if by < 1 else cv2.INTER_LINEAR
    sized = cv2.resize(picture, None, fx=by, fy=by, interpolation=how) if by != 1.0 else picture
    return np.asarray(sized, np.uint8), by


def _colours(rgb: Array, patches: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Means [24, 3] over the middles of the patches; None where one lies outside the picture."""
    h, w = rgb.shape[:2]
    half = 0.2 * float(np.linalg.norm(patches - np.roll(patches, 1, axis=1), axis=-1).min())
    means = []
    for x, y in patches.mean(axis=1):
        if not (half < x < w - half and half < y < h - half) or len(patches) != len(CHART_Y):
            return None
        part = rgb[int(y - half) : int(y + half) + 1, int(x - half) : int(x + half) + 1]
        means.append(part.reshape(-1, 3).mean(axis=0, dtype=float))
    return np.array(means)
