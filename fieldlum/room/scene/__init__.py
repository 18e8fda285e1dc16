"""Trace a box room: sun patches, what pixels show, and its light; read and write Radiance rooms."""

from fieldlum.room.scene.box_room import build
from fieldlum.room.scene.sun_patches import sun_patches
from fieldlum.room.scene.trace import disc_visibility
from fieldlum.room.scene.view import traced_view
