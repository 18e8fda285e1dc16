"""Lens mappings, rays, solid angles and flux-conserving resampling.

Axes: x east, y north, z up. Azimuth clockwise from north. A panorama is equirectangular, row 0 at
the zenith, W = 2H; the azimuth of column centre j is heading + ((j + .5)/W - .5) * 360 degrees, so
right is clockwise.
"""

from fieldlum.optics.projection.coverage import (
    FULLY_SEEN_SHARE,
    NOT_SEEN,
    PARTLY_SEEN,
    SEEN,
    judged_text,
    seen_by_lenses,
    seen_shares,
    seen_words,
)
from fieldlum.optics.projection.grids import Equirect, Fisheye
from fieldlum.optics.projection.lens import (
    LensGeometry,
    angle_of_radius,
    lens_pixels,
    lens_rays,
    radius_of_angle,
    relative_radius,
)
from fieldlum.optics.projection.panorama import (
    altitude_azimuth_deg,
    column_azimuths_deg,
    compass_name,
    direction,
    equirect_pixel,
    equirect_rays,
    equirect_solid_angles,
    rotation,
    row_altitudes_deg,
    row_solid_angles,
    signed_angle_deg,
    smallest_arc,
    turned,
    wrapped,
)
from fieldlum.optics.projection.resample import Resampler, resampler
