"""False-colour PNGs of a session's panoramas, for a page."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

import numpy as np

from fieldlum.core.errors import InputError
from fieldlum.core.false_colour import colour_table, coloured, luminance_ends, png_of, shared_scale
from fieldlum.optics.images import read_panorama

MAX_WIDTH = 1840  # four times a panorama of 460; bounds the memory; chosen
_KEPT_PICTURES = 48  # of about 100 kB: what a page shows at once, and no more; chosen


def scale_of(paths: Iterable[Path]) -> tuple[float, float]:
    """Return the ends of one scale for several panoramas in cd/m2, see `shared_scale`.

    A panorama that cannot be read is left out: a merge may be writing it.
    """
    ends = []
    for path in paths:
        try:
            ends.append(_ends(path, path.stat().st_mtime_ns))
        except (InputError, OSError):
            continue
    return shared_scale(ends)


@lru_cache(maxsize=1024)
def _ends(path: Path, stamp: int) -> tuple[float, float] | None:
    return luminance_ends(read_panorama(path).seen_cdm2)


def picture_png(path: Path, width: int, low: float, high: float) -> bytes:
    """Return a panorama in false colour as PNG, at most `width` pixels wide.

    The scale is logarithmic from low to high [cd/m2]. Raises InputError for a damaged file, OSError
    for a missing one.
    """
    return _png(path, path.stat().st_mtime_ns, min(width, MAX_WIDTH), low, high)


@lru_cache(maxsize=_KEPT_PICTURES)
def _png(path: Path, stamp: int, width: int, low: float, high: float) -> bytes:
    import cv2

    values = read_panorama(path).seen_cdm2  # [H, W]
    if values.shape[1] > width:
        height = max(1, round(values.shape[0] * width / values.shape[1]))
        shrunk = cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA)
        values = np.asarray(shrunk, np.float32)
    return png_of(coloured(values, low, high))


def scale_png() -> bytes:
    """Return the colours of the scale from low to high as a PNG of 256 x 1 pixels."""
    return png_of(colour_table()[None])
