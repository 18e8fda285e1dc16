"""Show luminance in false colour, with one colour map, scale and encoding for every picture."""

from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, UInts8

COLOUR_MAP = "inferno"  # perceptually uniform, and readable without red and green
# Ends of the scale of pictures that are compared between hours and rooms. Chosen.
RANGE_CDM2 = (1.0, 10_000.0)
UNSEEN_RGB = (120, 120, 120)  # of pixels without a value; grey is no colour of the scale; chosen


@lru_cache(maxsize=1)
def colour_table() -> UInts8:
    """Return the RGB colours (0 to 255) of the scale from its low to its high end, [256, 3].

    All callers share the array, so it must not be changed.
    """
    import matplotlib

    return np.rint(matplotlib.colormaps[COLOUR_MAP](np.arange(256))[:, :3] * 255).astype(np.uint8)


def coloured(
    luminance_cdm2: Floats | Floats32, low: float = RANGE_CDM2[0], high: float = RANGE_CDM2[1]
) -> UInts8:
    """Return false colours of luminances [...] as RGB [..., 3], 0 to 255.

    low, high: ends of the logarithmic scale [cd/m2], 0 < low < high. Values outside the scale get
    the colour of its nearer end; values that are not finite get `UNSEEN_RGB`.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        position = np.log(np.maximum(luminance_cdm2, 1e-9) / low) / np.log(high / low)  # 0 to 1
    rgb = colour_table()[np.nan_to_num(np.clip(position * 255.0 + 0.5, 0, 255)).astype(np.uint8)]
    rgb[~np.isfinite(luminance_cdm2)] = UNSEEN_RGB
    return rgb


def png_of(rgb: UInts8) -> bytes:
    """Return the content of a PNG file of an RGB image [H, W, 3], 0 to 255.

    Raises ValueError if it cannot be encoded.
    """
    import cv2

    succeeded, data = cv2.imencode(".png", np.ascontiguousarray(rgb[..., ::-1]))  # OpenCV has BGR
    if not succeeded:
        raise ValueError("the picture could not be encoded")
    return data.tobytes()


def luminance_ends(luminance_cdm2: Floats | Floats32) -> tuple[float, float] | None:
    """Return the 1 % and 99.9 % percentiles of the luminances above 0 [cd/m2]; None without any.

    luminance_cdm2: [...]; values that are not finite do not count. Of 400 000 or more values only
    every second, third and so on is used. The percentages are chosen.
    """
    # 200 000 to 400 000 values are enough for these percentiles. Chosen.
    values = luminance_cdm2.ravel()[:: max(1, luminance_cdm2.size // 200_000)]
    values = values[np.isfinite(values) & (values > 0)]
    if not len(values):
        return None
    return float(np.percentile(values, 1.0)), float(np.percentile(values, 99.9))


def shared_scale(ends: Iterable[tuple[float, float] | None]) -> tuple[float, float]:
    """Return the low and the high end of one scale [cd/m2] for several pictures.

    ends: `luminance_ends` of each picture; None is ignored. The scale goes from the least low end
    to the greatest high end, rounded outwards to one digit, and is at least a factor of ten wide;
    without a picture it is 1 to 1000.
    """
    # the last pair changes neither minimum nor maximum; with it, zip has a pair without pictures
    lows, highs = zip(*(pair for pair in ends if pair), (np.inf, 0.0), strict=True)
    low, high = (min(lows), max(highs)) if max(highs) else (1.0, 1000.0)
    return _one_digit(low, np.floor), _one_digit(max(high, 10.0 * low), np.ceil)


def _one_digit(value: float, rounding: np.ufunc) -> float:
    """Return a positive value with one significant digit; rounding: numpy.floor or numpy.ceil."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(f"{rounding(value / power) * power:.1g}")
