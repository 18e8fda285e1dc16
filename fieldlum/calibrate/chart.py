"""Find the 24-patch chart in a frame, and check that it is a chart.

Dark gaps separate the patches, so that an adaptive threshold shows the patches as holes. Holes with
four corners that are neighbours along their own edges get integer places on a lattice. The
homography from these places to pixels gives all 24 patches, including those that were not detected.
A candidate counts only if its 24 colours are those of a chart, in order. Nothing is random: a
picture always gives the same result.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fieldlum.calibrate.frames import LinearFrame
from fieldlum.core.arrays import Array, Floats, Mask
from fieldlum.core.errors import InputError
from fieldlum.optics.photometry import srgb_table

# ----------------------------------------------------------------------------------------------
# candidates for a chart's 6 x 4 patches: squares on a lattice


Quads = Floats  # [n, 4, 2] corners, clockwise as seen
Places = NDArray[np.int64]  # [n, 2] column and row on a lattice

# All limits of this module are chosen by trial on pictures of charts, not measured.
_BLUR_PX = 1.0  # sigma of the blur against noise; a gap is wider
_WINDOWS_PX = (11, 19, 35, 67)  # of the threshold: from one gap to several
_DARKER = 2.0  # codes of 255 by which a gap is darker than its surroundings
_MIN_AREA_PX2 = 30.0  # smallest area of a patch
_MAX_AREA = 1 / 30  # largest area of a patch, over that of the picture
# Distance of an outline from four straight sides, over the length of the outline; tried in order.
_CORNER_REL = (0.04, 0.08, 0.12)
_FILLED = 0.75  # area of an outline over that of its four corners
_SAME = 0.3  # sides: closer centres are one patch, found by two thresholds
_STEPS = (1.05, 1.15, 1.25, 1.35, 1.45, 1.55, 1.65)  # of a lattice, in sides: gaps are narrow
_OFF_STEP = 0.2  # distance of a neighbour from its place by a tried step, in steps
_LIKE = (0.45, 2.2)  # ratio of the areas of neighbours
_OFF_PLACE = 0.15  # distance of a patch from its place, in steps
_SIDE = (0.5, 1.1)  # side of a patch, in steps
_MIN_NEIGHBOURS = 6  # neighbours from which a lattice is fitted
_MIN_FOUND = 8  # patches of the 24 that must be found on it
_PATCH = 0.4  # half of a patch's side, in steps
_QUARTER = np.array([[0, 1], [-1, 0]])  # of a turn, of row vectors


def grids(picture: NDArray[np.uint8], rows: int, columns: int) -> Iterator[Quads]:
    """Yield candidates for a chart's patches in a picture [h, w, 3].

    A candidate [rows * columns, 4, 2] has the corners x, y [px] of all patches, row by row. The
    lattice with most detected patches comes first; mirror images are omitted. The caller must check
    that the colours are those of a chart.
    """
    fits = _lattices(_quads(picture))
    for lattice, places in sorted(fits, key=lambda fit: -len(fit[1])):
        yield from _laid_on(lattice, places, rows, columns)


# ----------------------------------------------------------------------------------------------
# four-cornered holes


def _quads(picture: NDArray[np.uint8]) -> Quads:
    import cv2

    corners: list[Floats] = []
    smooth = cv2.GaussianBlur(picture, (0, 0), _BLUR_PX)
    for grey in (smooth.max(axis=2), *np.moveaxis(smooth, 2, 0)):
        for window in _WINDOWS_PX:
            dark = cv2.adaptiveThreshold(
                np.ascontiguousarray(grey),
                255,
                cv2.ADAPTIVE_THRESH_MEAN_C,
                cv2.THRESH_BINARY_INV,
                window,
                _DARKER,
            )
            outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
            corners += [q for q in map(_four_corners, outlines) if q is not None]
    quads = np.array(corners).reshape(-1, 4, 2)
    return _apart(quads[_areas(quads) < _MAX_AREA * picture.shape[0] * picture.shape[1]])


def _four_corners(outline: Array) -> Floats | None:
    """Return the corners [4, 2] of an outline, clockwise as seen (y downwards).

    Return None unless the outline is nearly a convex quadrilateral.
    """
    import cv2

    area = cv2.contourArea(outline)
    if area < _MIN_AREA_PX2:
        return None
    length = cv2.arcLength(outline, True)
    for within in _CORNER_REL:
        corners = cv2.approxPolyDP(outline, within * length, True)[:, 0].astype(float)
        if len(corners) == 4:
            signed = _areas(corners[None], signed=True)[0]
            if not cv2.isContourConvex(corners.astype(np.int32)) or area < _FILLED * abs(signed):
                return None
            return corners if signed > 0 else corners[::-1]
    return None


def _areas(quads: Quads, signed: bool = False) -> Floats:
    """Return the areas [n] of quadrilaterals [n, 4, 2]; signed areas are positive if clockwise."""
    a, b = quads[:, 2] - quads[:, 0], quads[:, 3] - quads[:, 1]
    area = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return area if signed else np.abs(area)


def _apart(quads: Quads) -> Quads:
    """Return the largest quadrilateral at each place.

    Thresholds often find the same patch twice.
    """
    quads = quads[np.argsort(-_areas(quads), kind="stable")]
    centres, sides = quads.mean(axis=1), np.sqrt(_areas(quads))
    kept: list[int] = []
    for i, centre in enumerate(centres):
        near = np.linalg.norm(centres[kept] - centre, axis=1) < _SAME * sides[i]
        if not (near & (sides[kept] < 1.5 * sides[i])).any():
            kept.append(i)
    return quads[kept]


# ----------------------------------------------------------------------------------------------
# lattices


def _lattices(quads: Quads) -> Iterator[tuple[Floats, Places]]:
    """Yield homographies [3, 3] from places to pixels, and the places [n, 2] with a patch.

    The edges of each quadrilateral give the directions of a lattice, whose step is tried. The
    quadrilaterals around it that fit determine a homography, and this finds those further away.
    """
    centres, edges, areas = quads.mean(axis=1), _edges(quads), _areas(quads)
    is_taken = np.zeros(len(quads), bool)
    for seed in range(len(quads)):
        alike = (areas > _LIKE[0] * areas[seed]) & (areas < _LIKE[1] * areas[seed])
        at = (centres - centres[seed]) @ np.linalg.inv(edges[seed])  # in sides of this one
        best, members = np.full((3, 3), np.nan), np.zeros(len(quads), bool)
        for step in () if is_taken[seed] else _STEPS:
            place = np.rint(at / step)
            off = np.abs(at / step - place).max(axis=1)
            fits = alike & (off < _OFF_STEP) & (np.abs(place).max(axis=1) <= 2)
            if fits.sum() < _MIN_NEIGHBOURS or (np.ptp(place[fits], axis=0) == 0).any():
                continue
            h = _homography(place[fits], centres[fits], _OFF_PLACE * np.sqrt(areas[seed]))
            for _ in range(3):  # further patches are found as the homography improves
                place, fits = _on_places(h, quads)
                if fits.sum() < _MIN_FOUND:
                    break
                h = _homography(place[fits], centres[fits])
            if fits.sum() > max(members.sum(), _MIN_FOUND - 1):
                best, members = h, fits
        if members.any():
            is_taken |= members
            yield best, np.unique(_on_places(best, quads)[0][members].astype(np.int64), axis=0)


def _edges(quads: Quads) -> Floats:
    """Return the two directions of the sides of each quadrilateral, [n, 2, 2].

    For an upright quadrilateral these point right and down.
    """
    along = quads[:, 1] - quads[:, 0] + quads[:, 2] - quads[:, 3]
    down = quads[:, 3] - quads[:, 0] + quads[:, 2] - quads[:, 1]
    return 0.5 * np.stack([along, down], axis=1)


def _homography(
    places: NDArray[np.integer] | Floats, at_px: Floats, within_px: float = 0.0
) -> Floats:
    """Return the homography from places [n, 2] to pixels [n, 2]; NaN if there is none.

    within_px : limit of RANSAC; 0 uses all places.
    """
    import cv2

    h, _ = cv2.findHomography(
        places.astype(float), at_px, cv2.RANSAC if within_px else 0, within_px
    )
    return np.full((3, 3), np.nan) if h is None else np.asarray(h, np.float64)


def _on_places(h: Floats, quads: Quads) -> tuple[Floats, Mask]:
    """Return the nearest place [n, 2] of each quadrilateral, and whether it fits there [n].

    A quadrilateral fits if its centre is on the place and its size is that of a patch.
    """
    centres, nowhere = quads.mean(axis=1), np.zeros(len(quads), bool)
    if not np.isfinite(h).all() or abs(np.linalg.det(h)) < 1e-12:
        return np.full(centres.shape, np.nan), nowhere
    at = _projected(np.asarray(np.linalg.inv(h), np.float64), centres)
    place = np.rint(at)
    step = np.linalg.norm(
        _projected(h, place + np.array([1.0, 0.0])) - _projected(h, place), axis=1
    )
    side = np.sqrt(_areas(quads)) / np.maximum(step, 1e-9)
    near = np.abs(at - place).max(axis=1) < _OFF_PLACE
    return place, near & (side > _SIDE[0]) & (side < _SIDE[1])


def _projected(h: Floats, points: Floats) -> Floats:
    """Return points [..., 2] through a homography [3, 3]; NaN on its horizon."""
    out = points @ h[:, :2].T + h[:, 2]
    depth = out[..., 2:]
    return out[..., :2] / np.where(np.abs(depth) > 1e-9, depth, np.nan)


# ----------------------------------------------------------------------------------------------
# placements


def _laid_on(h: Floats, places: Places, rows: int, columns: int) -> Iterator[Quads]:
    """Yield placements of rows x columns patches on a lattice, most detected patches first."""
    grid = np.array([(c, r) for r in range(rows) for c in range(columns)])
    half = _PATCH * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    ways = []
    for quarter in range(4):
        turn = np.linalg.matrix_power(_QUARTER, quarter)
        shifts, counts = np.unique(
            (places[:, None] - grid @ turn).reshape(-1, 2), axis=0, return_counts=True
        )
        for shift, count in zip(
            shifts[counts >= _MIN_FOUND], counts[counts >= _MIN_FOUND], strict=True
        ):
            ways.append((-int(count), len(ways), (grid @ turn + shift)[:, None] + half @ turn))
    for _, _, patches in sorted(ways, key=lambda way: way[:2]):
        yield _projected(h, patches)


# ----------------------------------------------------------------------------------------------
# the chart by its colours


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
_MAX_SIDE_PX = 1600  # longest side [px] of the picture at size 1; chosen, limits the time


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

    size : relative to a picture whose longer side is at most _MAX_SIDE_PX pixels.
    """
    import cv2

    by = size * min(1.0, _MAX_SIDE_PX / max(picture.shape[:2]))
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
