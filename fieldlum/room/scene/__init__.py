"""Compute, from room geometry, sun patches and how much of each pixel shows sky through a window.

Export rooms to Radiance.
"""

from fieldlum.room.scene.geometry import build
from fieldlum.room.scene.patches import (
    disc_visibility,
    iter_sun_patches,
    sun_patches,
    window_fraction,
)
from fieldlum.room.scene.view import look
