"""Show luminance pictures: false-colour PNG, regions, and an offline page."""

from fieldlum.view.measured_picture import MeasuredPicture, read_measured_picture
from fieldlum.view.regions import Region, parse_region, region_statistics

__all__ = [
    "MeasuredPicture",
    "Region",
    "parse_region",
    "read_measured_picture",
    "region_statistics",
]
