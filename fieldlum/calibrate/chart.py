"""Find the 24-patch chart in a frame, and check that it is a chart.

Lattices of patches (chart_grid.py) are candidates. One counts only if its 24 colours are those of a
chart, in order.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.chart_grid import grids
from fieldlum.calibrate.frames import LinearFrame
from fieldlum.core.arrays import Array, Floats
from fieldlum.core.errors import InputError
from fieldlum.optics.photometry import srgb_table

# Luminous reflectance Y in percent, illuminant C, row by row from dark skin: McCamy, Marcus,
# Davidson, "A color-rendition chart", J. Appl. Photogr. Eng. 2(3), 1976.
CHART_Y = np.fromstring(
    """
     10.1  35.8  19.3  13.3  24.3  43.1
     30.1  12.0  19.8   6.6  44.3  43.1
      6.1  23.4  12.0  59.1  19.8  19.8
     90.0  59.1  36.2  19.8   9.0   3.1
    """,
    sep=" ",
)
ROWS, COLUMNS = 4, 6
# The maker's sRGB codes of the same patches (X-Rite, ColorChecker Classic).
_SRGB = np.fromstring(
    """
    115  82  68   194 150 130    98 122 157    87 108  67   133 128 177   103 189 170
    214 126  44    80  91 166   193  90  99    94  60 108   157 188  64   224 163  46
     56  61 150    70 148  73   175  54  60   231 199  31   187  86 149     8 133 161
    243 243 242   200 200 200   160 160 160   122 122 121    85  85  85    52  52  52
    """,
    int,
    sep=" ",
).reshape(24, 3)
# Largest relative misfit of a chart's colours: any other order of the colours leaves 0.6 and more.
# Chosen.
_ALIKE = 0.2
_IN_ORDER = 0.9  # correlation of ln Y with a chart's; chosen, not measured
_GRID_SIZES = (1.0, 2.0)  # sizes of the picture in which lattices are searched; chosen
_LONGEST = 1600  # longest side [px] of the picture at size 1; chosen, limits the time


def misfit(rgb: Floats) -> float:
    """Return the rms relative difference of 24 camera colours from those of a chart.

    rgb : [24, 3], linear, in any unit, row by row from the dark skin patch. The 3 x 3 matrix that
    fits camera colours best to the chart's is applied first. 0 is a perfect chart; the colours in
    another order give 0.6 and more.
    """
    chart = srgb_table()[_SRGB]
    weight = 1.0 / (chart.mean(axis=1, keepdims=True) + 0.03)
    camera = np.asarray(rgb, float) / max(float(np.max(rgb)), 1e-12)
    matrix = np.linalg.lstsq(camera * weight, chart * weight, rcond=None)[0]
    return float(np.sqrt(np.mean(((camera @ matrix - chart) * weight) ** 2)))


def in_order(luminance: Floats) -> bool:
    """Return whether luminances [24] of patches, in any unit, rise and fall like the chart's.

    Row by row from the dark skin patch. True for a correlation of the logarithms above 0.9.
    """
    logs = np.log(np.maximum(np.asarray(luminance, float), 1e-12))
    return float(np.corrcoef(logs, np.log(CHART_Y))[0, 1]) > _IN_ORDER


def patch_centres(corners: Floats) -> tuple[Array, float]:
    """Return the centres of a chart's patches, x and y [24, 2] px, and a radius within each [px].

    corners : x and y [4, 2] px of the outer corners of the field of patches, clockwise from the
    corner at the dark skin patch. Centres are row by row from that patch.
    """
    import cv2

    square = np.array([[0, 0], [COLUMNS, 0], [COLUMNS, ROWS], [0, ROWS]], np.float32)
    h = cv2.getPerspectiveTransform(square, corners.astype(np.float32))
    at = np.array([[c + 0.5, r + 0.5, 1.0] for r in range(ROWS) for c in range(COLUMNS)]) @ h.T
    centres = at[:, :2] / at[:, 2:]
    gap = np.linalg.norm(centres[1] - centres[0]), np.linalg.norm(centres[COLUMNS] - centres[0])
    return centres, 0.25 * float(min(gap))


def find_chart(frame: LinearFrame) -> tuple[Array, float]:
    """Return the centres of a chart's patches, x and y [24, 2], and a radius within each patch.

    Both are in sensor pixels; patches are row by row from the dark skin patch. Raises InputError if
    no chart is detected.
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
    finding = "no colour chart found"
    if np.isfinite(nearest):
        finding = (
            "no colour chart found: the best candidate has other colours, or the colours in "
            f"another order (misfit {100 * nearest:.0f} %)"
        )
    raise InputError(
        frame.path,
        finding,
        "a 24-patch chart, sharp and upright",
        "state the chart's corners with --corners",
    )


def _candidates(picture: NDArray[np.uint8]) -> Iterator[Floats]:
    """Yield candidates for a chart's patches: corners [24, 4, 2] row by row, in picture pixels."""
    for size in _GRID_SIZES:
        searched, by = _sized(picture, size)
        for patches in grids(searched, ROWS, COLUMNS):
            yield patches / by


def _sized(picture: NDArray[np.uint8], size: float) -> tuple[NDArray[np.uint8], float]:
    """Return the resized picture, and its size relative to the original.

    size : relative to a picture whose longer side is at most _LONGEST pixels.
    """
    import cv2

    by = size * min(1.0, _LONGEST / max(picture.shape[:2]))
    how = cv2.INTER_AREA if by < 1 else cv2.INTER_LINEAR
    sized = cv2.resize(picture, None, fx=by, fy=by, interpolation=how) if by != 1.0 else picture
    return np.asarray(sized, np.uint8), by


def _colours(rgb: Floats, patches: Floats) -> Floats | None:
    """Return mean colours [24, 3] of the middles of the patches.

    None if one is outside the picture.
    """
    h, w = rgb.shape[:2]
    half = 0.2 * float(np.linalg.norm(patches - np.roll(patches, 1, axis=1), axis=-1).min())
    means = []
    for x, y in patches.mean(axis=1):
        if not (half < x < w - half and half < y < h - half) or len(patches) != len(CHART_Y):
            return None
        part = rgb[int(y - half) : int(y + half) + 1, int(x - half) : int(x + half) + 1]
        means.append(part.reshape(-1, 3).mean(axis=0, dtype=float))
    return np.array(means)
