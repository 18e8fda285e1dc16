"""False-colour PNGs of a session's panoramas, for a page."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from fieldlum.core.arrays import Floats32
from fieldlum.core.false_colour import colour_table, coloured, png_of, rounded_scale
from fieldlum.core.records import Flag
from fieldlum.optics.images import read_panorama

MAX_WIDTH = 1840  # four times a panorama of 460; bounds the memory; chosen
_KEPT_PICTURES = 48  # of about 100 kB: what a page shows at once, and no more; chosen


def luminance_ends(path: Path) -> tuple[float, float]:
    """Return the 1 % and 99.9 % percentiles of a panorama's seen pixels above 0, in cd/m2.

    The result is 1 and 1000 if there are none.
    """
    return _ends(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1024)
def _ends(path: Path, stamp: int) -> tuple[float, float]:
    values = _seen(path)
    values = values[np.isfinite(values) & (values > 0)]
    if not len(values):
        return 1.0, 1000.0
    low, high = np.percentile(values, (1.0, 99.9))
    return float(low), float(high)


def scale_of(paths: list[Path]) -> tuple[float, float]:
    """Return the ends of one scale for several panoramas [cd/m2], rounded outwards to one digit.

    They are from the lowest 1 % to the highest 99.9 % percentile; 1 to 1000 without panoramas.
    """
    ends = [luminance_ends(path) for path in paths] or [(1.0, 1000.0)]
    return rounded_scale(min(low for low, _ in ends), max(high for _, high in ends))


def picture_png(path: Path, width: int, low: float, high: float) -> bytes:
    """Return a panorama in false colour as PNG, at most `width` pixels wide.

    The scale is logarithmic from low to high [cd/m2]. Raises InputError for a damaged file, OSError
    for a missing one.
    """
    return _png(path, path.stat().st_mtime_ns, min(width, MAX_WIDTH), low, high)


@lru_cache(maxsize=_KEPT_PICTURES)
def _png(path: Path, stamp: int, width: int, low: float, high: float) -> bytes:
    import cv2

    values = _seen(path)  # [H, W]
    if values.shape[1] > width:
        height = max(1, round(values.shape[0] * width / values.shape[1]))
        shrunk = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)
        values = np.asarray(shrunk, np.float32)
    return png_of(coloured(values, low, high))


def scale_png() -> bytes:
    """Return the colours of the scale from low to high as a PNG of 256 x 1 pixels."""
    return png_of(colour_table()[None])


def _seen(path: Path) -> Floats32:
    panorama = read_panorama(path)
    values = np.array(panorama.luminance_cdm2, np.float32)
    if panorama.flags is not None:
        values[(panorama.flags & Flag.OUTSIDE_LENS) > 0] = np.nan
    return values
