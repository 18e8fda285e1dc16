"""Compute sun patches from room geometry, and export rooms to Radiance."""

from fieldlum.room.scene.geometry import build
from fieldlum.room.scene.patches import (
    disc_visibility,
    iter_sun_patches,
    sun_patches,
)
from fieldlum.room.scene.view import look
