"""Glare in every direction around a panorama, and on single pictures."""

from fieldlum.glare.fisheye import FISHEYE_VIEW, panorama_to_fisheye
from fieldlum.glare.geometry import PAPER_VIEWS, Views, panorama_views, position_index, view_azimuths_deg
from fieldlum.glare.metrics import METRICS, dgi, dgp, dgps, glare_directions, ugr
from fieldlum.glare.reference import ReferenceGlare, reference_glare, reference_glare_of_file, reference_version

__all__ = [
    "FISHEYE_VIEW", "METRICS", "PAPER_VIEWS", "ReferenceGlare", "Views", "dgi", "dgp", "dgps", "glare_directions",
    "panorama_to_fisheye", "panorama_views", "position_index", "reference_glare", "reference_glare_of_file",
    "reference_version", "ugr", "view_azimuths_deg",
]  # fmt: skip
