"""Estimate where the camera sees the sky, and how much of the sun's beam arrives from there."""

from fieldlum.sky.sky_view.disc import disc_of_hours
from fieldlum.sky.sky_view.estimate import Captured, estimate, sky_view_of
from fieldlum.sky.sky_view.picture import (
    LOWEST_ALTITUDE_DEG,
    SUFFIX,
    SkyGrid,
    SkyPicture,
    cut_panorama,
    read_sky_picture,
    write_sky_picture,
)
from fieldlum.sky.sky_view.view import SkyView
