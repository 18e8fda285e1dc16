"""From room geometry to sun patches, to the window's share of each pixel, and to Radiance."""

from __future__ import annotations

from fieldlum.scene.drawn_rooms import RoomUncertainty as RoomUncertainty
from fieldlum.scene.drawn_rooms import draw_rooms as draw_rooms
from fieldlum.scene.drawn_rooms import drawn_disc_shares as drawn_disc_shares
from fieldlum.scene.drawn_rooms import stated_uncertainty as stated_uncertainty
from fieldlum.scene.drawn_rooms import uncertainty_of_draws as uncertainty_of_draws
from fieldlum.scene.geometry import BoxScene as BoxScene
from fieldlum.scene.geometry import build as build
from fieldlum.scene.patches import disc_visibility as disc_visibility
from fieldlum.scene.patches import iter_sun_patches as iter_sun_patches
from fieldlum.scene.patches import sun_patches as sun_patches
from fieldlum.scene.patches import window_fraction as window_fraction
from fieldlum.scene.sun_disc import SunPatches as SunPatches
from fieldlum.scene.view import look as look
