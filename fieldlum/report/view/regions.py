"""Regions of a picture and their statistics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fieldlum.core.arrays import Mask
from fieldlum.core.false_colour import rounded_scale
from fieldlum.optics.projection import direction
from fieldlum.report.view.measured_picture import MeasuredPicture

_COUNTS = {"rect": 4, "circle": 3, "cone": 3}
FORMS = "rect:x,y,w,h, circle:x,y,r, polygon:x1,y1,x2,y2,x3,y3... or cone:AZ,ALT,RADIUS"
COLUMNS = (
    "file",
    "region",
    "pixels",
    "solid_angle_sr",
    "mean_cdm2",
    "median_cdm2",
    "min_cdm2",
    "max_cdm2",
    "sd_cdm2",
)


@dataclass(frozen=True, slots=True)
class Region:
    """A region of a picture; `text` is as the user wrote it.

    values by kind, in pixels from the top left corner: rect left, top, width, height; circle x, y,
    radius; polygon x, y of each corner; in deg: cone azimuth, altitude, radius (half its width).
    """

    kind: str
    values: tuple[float, ...]
    text: str


def parse_region(text: str) -> Region:
    """Parse a region such as ``rect:10,20,100,50``; the forms are in `FORMS`.

    Raises ValueError for any other text, and for a radius, width or height that is not above 0.
    """
    kind, _, rest = text.partition(":")
    try:
        values = tuple(float(part) for part in rest.split(","))
    except ValueError:
        values = ()
    polygon = kind == "polygon" and len(values) >= 6 and len(values) % 2 == 0
    if not np.isfinite(values).all() or not (polygon or len(values) == _COUNTS.get(kind)):
        raise ValueError(f"{text!r}: write {FORMS}")
    sizes = {"rect": values[2:], "polygon": ()}.get(kind, values[-1:])
    if any(size <= 0 for size in sizes):
        raise ValueError(f"{text!r}: its size must be above 0")
    return Region(kind, values, text)


def region_mask(region: Region, picture: MeasuredPicture) -> Mask:
    """Return a mask [H, W]: True for pixels whose centres are in the region."""
    height, width = picture.luminance_cdm2.shape
    y, x = (np.arange(height) + 0.5)[:, None], (np.arange(width) + 0.5)[None, :]
    if region.kind == "rect":
        left, top, w, h = region.values
        return (x >= left) & (x < left + w) & (y >= top) & (y < top + h)
    if region.kind == "circle":
        cx, cy, radius = region.values
        return np.hypot(x - cx, y - cy) <= radius
    if region.kind == "polygon":
        from skimage.draw import polygon2mask

        corners = np.array(region.values).reshape(-1, 2)[:, ::-1] - 0.5  # rows, columns
        return np.asarray(polygon2mask((height, width), corners), bool)
    azimuth, altitude, radius = region.values
    return picture.cosine_to(direction(altitude, azimuth)) >= np.cos(np.radians(radius))


def region_statistics(region: Region, picture: MeasuredPicture) -> dict[str, float | str | None]:
    """Return the row of `COLUMNS` of a region; `pixels` is the number of pixels that count.

    Mean and standard deviation are weighted by solid angle, the median by pixels. Pixels that no
    lens saw do not count. Without a pixel the other figures are None.
    """
    mask = region_mask(region, picture) & np.isfinite(picture.luminance_cdm2)
    mask &= picture.solid_angle_sr > 0
    values = picture.luminance_cdm2[mask].astype(float)
    weights = picture.solid_angle_sr[mask].astype(float)
    row: dict[str, float | str | None] = dict.fromkeys(COLUMNS)
    row |= {"file": picture.name, "region": region.text, "pixels": float(len(values))}
    if len(values) == 0:
        return row
    mean = float(np.average(values, weights=weights))
    return row | {
        "solid_angle_sr": float(weights.sum()),
        "mean_cdm2": mean,
        "median_cdm2": float(np.median(values)),
        "min_cdm2": float(values.min()),
        "max_cdm2": float(values.max()),
        "sd_cdm2": float(np.sqrt(np.average((values - mean) ** 2, weights=weights))),
    }


def shared_scale(pictures: Sequence[MeasuredPicture]) -> tuple[float, float]:
    """Return the ends of a scale [cd/m2] for all pictures together.

    They are the lowest 1 % and the highest 99.9 % percentile of a picture's luminances above 0,
    rounded outwards to one digit, and at least a factor of ten apart; 1 and 1000 without such
    luminances.
    """
    lows, highs = [], []
    for picture in pictures:
        step = max(1, picture.luminance_cdm2.size // 200_000)
        values = picture.luminance_cdm2[picture.solid_angle_sr > 0].ravel()[::step]
        values = values[np.isfinite(values) & (values > 0)]
        if len(values):
            lows.append(float(np.percentile(values, 1)))
            highs.append(float(np.percentile(values, 99.9)))
    return rounded_scale(*((min(lows), max(highs)) if lows else (1.0, 1000.0)))
