"""Find the 24-patch chart in a frame, and check that it is a chart.

Dark gaps separate the patches, so that an adaptive threshold shows the patches as holes. Holes with
four corners that are neighbours along their own edges get integer places on a lattice. The
homography from these places to pixels gives all 24 patches, including those that were not detected.
A candidate counts only if its 24 colours are those of a chart, in order. Nothing is random: a
picture always gives the same result. OpenCV's own detector (cv2.mcc) found 7 of the 14 charts of
tests/test_calibrate_chart.py.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.readings import LinearFrame
from fieldlum.core.arrays import Array, Floats, Mask
from fieldlum.core.errors import InputError
from fieldlum.optics.photometry import srgb_table

Quads = Floats  # [n, 4, 2] corners, clockwise as seen

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
# Largest relative misfit of a chart's colours: any other order of the colours leaves 0.5 and more.
# Chosen.
_ALIKE = 0.2
# Limits of the search are chosen by trial on pictures of charts, not measured.
_SIZES = (1.0, 2.0)  # of the searched picture
_MAX_SIDE_PX = 1600  # longest side [px] of the picture at size 1; limits the time
_WINDOWS_PX = (11, 19, 35, 67)  # of the threshold: from one gap to several
_CORNER_REL = (0.04, 0.08, 0.12)  # distance of an outline from four sides, over its length
_STEPS = (1.05, 1.15, 1.25, 1.35, 1.45, 1.55, 1.65)  # of a lattice, in sides: gaps are narrow
_MIN_FOUND = 8  # patches of the 24 that must be found on it


def misfit(rgb: Floats) -> float:
    """Return the rms relative difference of 24 camera colours from those of a chart.

    rgb : [24, 3], linear, in any unit, row by row from the dark skin patch. The 3 x 3 matrix that
    fits camera colours best to the chart's is applied first. 0 is a perfect chart; the colours in
    another order give 0.5 and more.
    """
    chart = srgb_table()[_SRGB]
    weight = 1.0 / (chart.mean(axis=1, keepdims=True) + 0.03)
    camera = np.asarray(rgb, float) / max(float(np.max(rgb)), 1e-12)
    matrix = np.linalg.lstsq(camera * weight, chart * weight, rcond=None)[0]
    return float(np.sqrt(np.mean(((camera @ matrix - chart) * weight) ** 2)))


def patch_centres(corners: Floats) -> tuple[Array, float]:
    """Return the centres of a chart's patches, x and y [24, 2] px, and a radius within each [px].

    corners : x and y [4, 2] px of the outer corners of the field of patches, clockwise from the
    corner at the dark skin patch. Centres are row by row from that patch.
    """
    import cv2

    square = np.array([[0, 0], [COLUMNS, 0], [COLUMNS, ROWS], [0, ROWS]], np.float32)
    h = np.asarray(cv2.getPerspectiveTransform(square, corners.astype(np.float32)), float)
    rows, columns = np.mgrid[:ROWS, :COLUMNS].reshape(2, -1) + 0.5
    centres = _projected(h, np.stack([columns, rows], axis=1))
    gap = np.linalg.norm(centres[1] - centres[0]), np.linalg.norm(centres[COLUMNS] - centres[0])
    return centres, 0.25 * float(min(gap))


def find_chart(frame: LinearFrame) -> tuple[Array, float]:
    """Return the centres of a chart's patches, x and y [24, 2], and a radius within each patch.

    Both are in sensor pixels; patches are row by row from the dark skin patch. Raises InputError if
    no chart is detected.
    """
    import cv2

    light = frame.rgb / max(float(np.percentile(frame.rgb[..., 1], 99)), 1e-9)
    codes = 255 * np.clip(light, 0, 1) ** (1 / 2.2)
    picture = np.ascontiguousarray(codes[..., ::-1].astype(np.uint8))
    nearest = np.inf
    for size in _SIZES:
        by = size * min(1.0, _MAX_SIDE_PX / max(picture.shape[:2]))
        how = cv2.INTER_AREA if by < 1 else cv2.INTER_LINEAR
        sized = np.asarray(cv2.resize(picture, None, fx=by, fy=by, interpolation=how), np.uint8)
        for patches in (found / by for found in grids(sized)):
            side = float(np.linalg.norm(patches - np.roll(patches, 1, axis=1), axis=-1).min())
            centres = patches.mean(axis=1)
            nearest = min(nearest, off := _misfit_at(frame.rgb, centres, 0.2 * side))
            if off < _ALIKE:
                return centres * frame.step, 0.3 * side * frame.step
    best = f" (the best candidate has a misfit of {100 * nearest:.0f} %)"
    finding = "no colour chart found" + (best if np.isfinite(nearest) else "")
    expected = "a 24-patch chart, sharp and upright"
    raise InputError(frame.path, finding, expected, "state the chart's corners with --corners")


def _misfit_at(rgb: Floats, centres: Floats, half: float) -> float:
    """Return `misfit` of squares around 24 centres; infinite if one is outside the picture."""
    if not ((centres > half) & (centres < np.array(rgb.shape[1::-1]) - half)).all():
        return np.inf
    squares = [
        rgb[int(y - half) : int(y + half) + 1, int(x - half) : int(x + half) + 1]
        for x, y in centres
    ]
    return misfit(np.array([square.mean(axis=(0, 1), dtype=float) for square in squares]))


# ----------------------------------------------------------------------------------------------
# four-cornered holes


def _quads(picture: NDArray[np.uint8]) -> Quads:
    """Return the largest quadrilateral at each place of a picture [h, w, 3].

    Thresholds in R, G, B and their maximum often find the same patch several times.
    """
    import cv2

    corners: list[Floats] = []
    smooth = cv2.GaussianBlur(picture, (0, 0), 1.0)
    mean, inverse = cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV
    for grey in (smooth.max(axis=2), *np.moveaxis(smooth, 2, 0)):
        for window in _WINDOWS_PX:
            dark = cv2.adaptiveThreshold(
                np.ascontiguousarray(grey), 255, mean, inverse, window, 2.0
            )
            outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            corners += [q for q in map(_four_corners, outlines) if q is not None]
    quads = np.array(corners).reshape(-1, 4, 2)
    quads = quads[_areas(quads) < picture.shape[0] * picture.shape[1] / 30]
    quads = quads[np.argsort(-_areas(quads), kind="stable")]
    centres, sides = quads.mean(axis=1), np.sqrt(_areas(quads))
    kept: list[int] = []
    for i, centre in enumerate(centres):
        near = np.linalg.norm(centres[kept] - centre, axis=1) < 0.3 * sides[i]
        if not (near & (sides[kept] < 1.5 * sides[i])).any():
            kept.append(i)
    return quads[kept]


def _four_corners(outline: Array) -> Floats | None:
    """Return the corners [4, 2] of an outline, clockwise as seen (y downwards).

    Return None unless the outline is nearly a convex quadrilateral.
    """
    import cv2

    area, length = cv2.contourArea(outline), cv2.arcLength(outline, True)
    for within in _CORNER_REL if area > 30.0 else ():
        corners = cv2.approxPolyDP(outline, within * length, True)[:, 0]
        if len(corners) == 4:
            signed = cv2.contourArea(corners, oriented=True)
            if not cv2.isContourConvex(corners) or area < 0.75 * abs(signed):
                return None
            return np.asarray(corners if signed > 0 else corners[::-1], float)
    return None


def _areas(quads: Quads) -> Floats:
    """Return the areas [n] of quadrilaterals [n, 4, 2]."""
    a, b = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    return 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


# ----------------------------------------------------------------------------------------------
# lattices


def grids(picture: NDArray[np.uint8]) -> Iterator[Quads]:
    """Yield candidates for a chart's patches in a picture [h, w, 3].

    A candidate [24, 4, 2] has the corners x, y [px] of all patches, row by row. The lattice with
    most detected patches comes first; mirror images are omitted. The caller must check that the
    colours are those of a chart.
    """
    fits = list(_lattices(_quads(picture)))
    grid = np.array([(c, r) for r in range(ROWS) for c in range(COLUMNS)])
    half = 0.4 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    for lattice, places in sorted(fits, key=lambda fit: -len(fit[1])):
        ways = []
        for quarter in range(4):
            turn = np.linalg.matrix_power(np.array([[0, 1], [-1, 0]]), quarter)
            shifts = (places[:, None] - grid @ turn).reshape(-1, 2)
            for shift, count in zip(*np.unique(shifts, axis=0, return_counts=True), strict=True):
                if count >= _MIN_FOUND:
                    ways.append((-int(count), (grid @ turn + shift)[:, None] + half @ turn))
        for _, patches in sorted(ways, key=lambda way: way[0]):
            yield _projected(lattice, patches)


def _lattices(quads: Quads) -> Iterator[tuple[Floats, Floats]]:
    """Yield homographies [3, 3] from places to pixels, and the places [n, 2] with a patch.

    The edges of each quadrilateral give the directions of a lattice, whose step is tried. The
    quadrilaterals around it that fit determine a homography, and this finds those further away.
    """
    centres, areas = quads.mean(axis=1), _areas(quads)
    along = quads[:, 1] - quads[:, 0] + quads[:, 2] - quads[:, 3]
    down = quads[:, 3] - quads[:, 0] + quads[:, 2] - quads[:, 1]
    edges = 0.5 * np.stack([along, down], axis=1)
    is_taken = np.zeros(len(quads), bool)
    for seed in range(len(quads)):
        alike = (areas > 0.45 * areas[seed]) & (areas < 2.2 * areas[seed])
        at = (centres - centres[seed]) @ np.linalg.inv(edges[seed])  # in sides of this one
        best, members, best_places = None, np.zeros(len(quads), bool), centres
        for step in () if is_taken[seed] else _STEPS:
            place = np.rint(at / step)
            fits = alike & (np.abs(at / step - place).max(axis=1) < 0.2)
            fits &= np.abs(place).max(axis=1) <= 2
            if fits.sum() < 6 or (np.ptp(place[fits], axis=0) == 0).any():
                continue
            h = _homography(place[fits], centres[fits], 0.15 * np.sqrt(areas[seed]))
            for _ in range(3):  # further patches are found as the homography improves
                place, fits = _on_places(h, quads)
                if fits.sum() < _MIN_FOUND:
                    break
                h = _homography(place[fits], centres[fits])
            if fits.sum() > max(members.sum(), _MIN_FOUND - 1):
                best, members, best_places = h, fits, _on_places(h, quads)[0]
        if best is not None:
            is_taken |= members
            yield best, np.unique(best_places[members], axis=0)


def _homography(places: Floats, at_px: Floats, within_px: float = 0.0) -> Floats:
    """Return the homography from places [n, 2] to pixels [n, 2]; zero if there is none.

    within_px : limit of RANSAC; 0 uses all places.
    """
    import cv2

    h, _ = cv2.findHomography(places, at_px, cv2.RANSAC if within_px else 0, within_px)
    return np.zeros((3, 3)) if h is None else np.asarray(h, np.float64)


def _on_places(h: Floats, quads: Quads) -> tuple[Floats, Mask]:
    """Return the nearest place [n, 2] of each quadrilateral, and whether it fits there [n].

    A quadrilateral fits if its centre is on the place and its size is that of a patch.
    """
    centres = quads.mean(axis=1)
    if abs(np.linalg.det(h)) < 1e-12:
        return centres, np.zeros(len(quads), bool)
    at = _projected(np.asarray(np.linalg.inv(h), np.float64), centres)
    place = np.rint(at)
    across = _projected(h, place + np.array([1.0, 0.0])) - _projected(h, place)
    side = np.sqrt(_areas(quads)) / np.maximum(np.linalg.norm(across, axis=1), 1e-9)
    return place, (np.abs(at - place).max(axis=1) < 0.15) & (side > 0.5) & (side < 1.1)


def _projected(h: Floats, points: Floats) -> Floats:
    """Return points [..., 2] through a homography [3, 3]; NaN on its horizon."""
    out = points @ h[:, :2].T + h[:, 2]
    depth = out[..., 2:]
    return out[..., :2] / np.where(np.abs(depth) > 1e-9, depth, np.nan)
