"""Glare in every direction around a panorama, and on single pictures."""

from fieldlum.glare.contrast import (
    ViewRegions,
    contrast_levels,
    melanopic_edi_lx,
    rammg,
    rammg_lightness,
)
from fieldlum.glare.fisheye import FISHEYE_VIEW, panorama_to_fisheye
from fieldlum.glare.geometry import (
    PAPER_VIEWS,
    Views,
    panorama_views,
    position_index,
    view_azimuths_deg,
)
from fieldlum.glare.metrics import METRICS, dgi, dgp, dgps, glare_directions, ugr
from fieldlum.glare.reference import (
    ReferenceGlare,
    reference_glare,
    reference_glare_of_file,
    reference_version,
)

__all__ = [
    "FISHEYE_VIEW",
    "METRICS",
    "PAPER_VIEWS",
    "ReferenceGlare",
    "ViewRegions",
    "Views",
    "contrast_levels",
    "dgi",
    "dgp",
    "dgps",
    "glare_directions",
    "melanopic_edi_lx",
    "panorama_to_fisheye",
    "panorama_views",
    "position_index",
    "rammg",
    "rammg_lightness",
    "reference_glare",
    "reference_glare_of_file",
    "reference_version",
    "ugr",
    "view_azimuths_deg",
]
