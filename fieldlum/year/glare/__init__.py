"""Compute glare in every direction around a panorama, and of single pictures."""

from fieldlum.year.glare.metrics import dgp, glare_directions
from fieldlum.year.glare.pictures import (
    FISHEYE_VIEW,
    panorama_to_fisheye,
    reference_glare,
    reference_version,
)
from fieldlum.year.glare.sources import Views, panorama_views, position_index, view_azimuths_deg
