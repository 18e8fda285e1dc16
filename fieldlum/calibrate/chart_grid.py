"""Find candidates for a chart's 6 x 4 patches in a picture: squares on a lattice.

Dark gaps separate the patches, so that an adaptive threshold shows the patches as holes. Holes with
four corners that are neighbours along their own edges get integer places on a lattice. The
homography from these places to pixels gives all 24 patches, including those that were not detected.
Nothing is random: a picture always gives the same result.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats, Mask

Quads = Floats  # [n, 4, 2] corners, clockwise as seen
Places = NDArray[np.int64]  # [n, 2] column and row on a lattice

# All limits of this module are chosen by trial on pictures of charts, not measured.
_BLUR_PX = 1.0  # sigma of the blur against noise; a gap is wider
_WINDOWS_PX = (11, 19, 35, 67)  # of the threshold: from one gap to several
_DARKER = 2.0  # codes of 255 by which a gap is darker than its surroundings
_LEAST_AREA_PX2 = 30.0  # smallest area of a patch
_MOST_AREA = 1 / 30  # largest area of a patch, over that of the picture
# Distance of an outline from four straight sides, over the length of the outline; tried in order.
_CORNER_REL = (0.04, 0.08, 0.12)
_FILLED = 0.75  # area of an outline over that of its four corners
_SAME = 0.3  # sides: closer centres are one patch, found by two thresholds
_STEP = (1.0, 1.7)  # distance of a neighbour along an edge, in sides
_ASIDE = 0.3  # distance of a neighbour across an edge, in sides
_LIKE = (0.45, 2.2)  # ratio of the areas of neighbours
_OFF_PLACE = 0.15  # distance of a patch from its place, in steps
_SIDE = (0.5, 1.1)  # side of a patch, in steps
_LEAST_GROWN = 6  # neighbours from which a lattice is fitted
_LEAST_SEEN = 8  # patches of the 24 that must be found on it
_PATCH = 0.4  # half of a patch's side, in steps
_QUARTER = np.array([[0, 1], [-1, 0]])  # of a turn, of row vectors


def grids(picture: NDArray[np.uint8], rows: int, columns: int) -> Iterator[Quads]:
    """Yield candidates for a chart's patches in a picture [h, w, 3].

    A candidate [rows * columns, 4, 2] has the corners x, y [px] of all patches, row by row. The
    lattice with most detected patches comes first; mirror images are omitted. The caller must check
    that the colours are those of a chart.
    """
    quads = _quads(picture)
    fits = (_fitted(quads, members, places) for members, places in _components(quads))
    for lattice, places in sorted(
        (fit for fit in fits if fit is not None), key=lambda fit: -len(fit[1])
    ):
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
    return _apart(quads[_areas(quads) < _MOST_AREA * picture.shape[0] * picture.shape[1]])


def _four_corners(outline: Array) -> Floats | None:
    """Return the corners [4, 2] of an outline, clockwise as seen (y downwards).

    Return None unless the outline is nearly a convex quadrilateral.
    """
    import cv2

    area = cv2.contourArea(outline)
    if area < _LEAST_AREA_PX2:
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


def _components(quads: Quads) -> list[tuple[list[int], Places]]:
    """Return groups of neighbouring quadrilaterals: indices, and places on a lattice."""
    centres, edges, areas = quads.mean(axis=1), _edges(quads), _areas(quads)
    inverse = np.linalg.inv(edges) if len(quads) else edges
    components, taken = [], np.zeros(len(quads), bool)
    for seed in range(len(quads)):
        if taken[seed]:
            continue
        place = {seed: ((0, 0), np.eye(2, dtype=np.int64))}
        queue = deque([seed])
        while queue:
            i = queue.popleft()
            at, turned = place[i]
            along = (centres - centres[i]) @ inverse[i]  # in sides of this one
            like = (areas > _LIKE[0] * areas[i]) & (areas < _LIKE[1] * areas[i])
            for axis in (0, 1):
                step, aside = along[:, axis], np.abs(along[:, 1 - axis])
                near = (
                    like & (np.abs(step) > _STEP[0]) & (np.abs(step) < _STEP[1]) & (aside < _ASIDE)
                )
                for j in np.flatnonzero(near).tolist():
                    if j in place:
                        continue
                    move = int(np.sign(step[j])) * turned[axis]
                    place[j] = (
                        (at[0] + int(move[0]), at[1] + int(move[1])),
                        _turned(inverse[i], edges[j]) @ turned,
                    )
                    queue.append(j)
        members = list(place)
        taken[members] = True
        components.append((members, np.array([place[m][0] for m in members])))
    return components


def _edges(quads: Quads) -> Floats:
    """Return the two directions of the sides of each quadrilateral, [n, 2, 2].

    For an upright quadrilateral these point right and down.
    """
    along = quads[:, 1] - quads[:, 0] + quads[:, 2] - quads[:, 3]
    down = quads[:, 3] - quads[:, 0] + quads[:, 2] - quads[:, 1]
    return 0.5 * np.stack([along, down], axis=1)


def _turned(inverse: Floats, edges: Floats) -> NDArray[np.int64]:
    """Return the rotation [2, 2] by quarter turns between two quadrilaterals' own directions."""
    c, s = (edges @ inverse)[0]
    quarter = round(float(np.arctan2(s, c)) / (np.pi / 2)) % 4
    return np.linalg.matrix_power(_QUARTER, quarter)


def _fitted(quads: Quads, members: list[int], places: Places) -> tuple[Floats, Places] | None:
    """Return the homography [3, 3] from places to pixels, and the places [n, 2] with a patch."""
    if len(members) < _LEAST_GROWN or (np.ptp(places, axis=0) == 0).any():
        return None
    centres, side = quads.mean(axis=1), float(np.sqrt(np.median(_areas(quads[members]))))
    h = _homography(places, centres[members], _OFF_PLACE * side)
    place, there = _on_places(h, quads)
    if there.sum() < _LEAST_SEEN:
        return None
    # Fit again with the patches across a gap.
    place, there = _on_places(_homography(place[there], centres[there]), quads)
    if there.sum() < _LEAST_SEEN:
        return None
    return _homography(place[there], centres[there]), np.unique(
        place[there].astype(np.int64), axis=0
    )


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
            shifts[counts >= _LEAST_SEEN], counts[counts >= _LEAST_SEEN], strict=True
        ):
            ways.append((-int(count), len(ways), (grid @ turn + shift)[:, None] + half @ turn))
    for _, _, patches in sorted(ways, key=lambda way: way[:2]):
        yield _projected(h, patches)
