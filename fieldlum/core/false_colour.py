"""False colour of luminance: one colour map, scale and encoding for every picture."""

from collections.abc import Iterable
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Floats, Floats32

COLOUR_MAP = "inferno"  # perceptually uniform, and readable without red and green
RANGE_CDM2 = (1.0, 10_000.0)  # of pictures that are compared between hours and rooms; chosen
UNSEEN_RGB = (120, 120, 120)  # grey is no colour of the scale; chosen


@lru_cache(maxsize=1)
def colour_table() -> NDArray[np.uint8]:
    """Return the RGB colours of the scale from its low to its high end, [256, 3]."""
    import matplotlib

    return np.rint(matplotlib.colormaps[COLOUR_MAP](np.arange(256))[:, :3] * 255).astype(np.uint8)


def coloured(
    luminance_cdm2: Floats | Floats32, low: float = RANGE_CDM2[0], high: float = RANGE_CDM2[1]
) -> NDArray[np.uint8]:
    """Return RGB [..., 3] of luminances, on a logarithmic scale from low to high [cd/m2].

    Values outside the scale get the colour of its nearer end; not finite ones `UNSEEN_RGB`.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.log(np.maximum(luminance_cdm2, 1e-9) / low) / np.log(high / low)
    rgb = colour_table()[np.nan_to_num(np.clip(share * 255.0 + 0.5, 0, 255)).astype(np.uint8)]
    rgb[~np.isfinite(luminance_cdm2)] = UNSEEN_RGB
    return rgb


def png_of(rgb: NDArray[np.uint8]) -> bytes:
    """Return an image [H, W, 3] as PNG bytes. Raises ValueError for one that cannot be coded."""
    import cv2

    good, data = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))
    if not good:
        raise ValueError("the picture could not be encoded")
    return data.tobytes()


def luminance_ends(luminance_cdm2: Floats | Floats32) -> tuple[float, float] | None:
    """Return the 1 % and 99.9 % percentiles of the luminances above 0 [cd/m2]; None without any.

    luminance_cdm2: [...]; values that are not finite do not count.
    """
    values = luminance_cdm2.ravel()[:: max(1, luminance_cdm2.size // 200_000)]
    values = values[np.isfinite(values) & (values > 0)]
    if not len(values):
        return None
    return float(np.percentile(values, 1.0)), float(np.percentile(values, 99.9))


def shared_scale(ends: Iterable[tuple[float, float] | None]) -> tuple[float, float]:
    """Return the ends of one scale [cd/m2] for pictures with these `luminance_ends`.

    They are rounded outwards to one digit, and at least a factor of ten apart; 1 and 1000 without
    a picture.
    """
    lows, highs = zip(*(pair for pair in ends if pair), (np.inf, 0.0), strict=True)
    low, high = (min(lows), max(highs)) if max(highs) else (1.0, 1000.0)
    return _one_digit(low, np.floor), _one_digit(max(high, 10.0 * low), np.ceil)


def _one_digit(value: float, rounding: np.ufunc) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(f"{rounding(value / power) * power:.1g}")
