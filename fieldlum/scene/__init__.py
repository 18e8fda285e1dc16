"""Compute, from room geometry, sun patches and how much of each pixel shows sky through a window.

Export rooms to Radiance.
"""

from fieldlum.scene.geometry import build
from fieldlum.scene.patches import disc_visibility, iter_sun_patches, sun_patches, window_fraction
from fieldlum.scene.view import look
