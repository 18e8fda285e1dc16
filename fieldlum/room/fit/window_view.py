"""Compare a guess with the picture of the windows: bright panes against dark walls show edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation

from fieldlum.core.arrays import Floats, Floats32, Indices, Mask
from fieldlum.learn.models.data import Dataset
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.room.fit.guess import Guess
from fieldlum.room.fit.renderer import OUTSIDE, surfaces
from fieldlum.room.scene.geometry import WALLS
from fieldlum.room.scene.view import pixel_rays

# Chosen: a tape that is 5 cm off and a camera that is, both seen from 1 m; error of a share at
# which a pixel is half wrong; panes over the room from which edges show; rays of a pixel each way.
MARGIN_DEG, WIDTH, LEAST_CONTRAST, SUB = 6.0, 0.25, 2.0, 2


@dataclass(frozen=True)
class WindowView:
    """How much pane q pixels near the windows show in the captures' median picture.

    share: of the luminance between that of the room (0) and of the panes in this row (1) [q];
    weights: share of the solid angle that the camera sees, 0 if the room is too bright to show
    edges [q]; rays: unit vectors, x east, y north, z up by the stated heading [r, 3]; pixel: index
    below q of each ray [r].
    """

    share: Floats
    weights: Floats
    rays: Floats32
    pixel: Indices

    def residuals(self, guess: Guess) -> Floats:
        """Return numbers [q] whose squares add up to the share of the view that is wrong."""
        seen = _shows_pane(guess, self.rays)
        error = np.bincount(self.pixel, seen, len(self.share)) / SUB**2 - self.share
        return np.sqrt(self.weights) * error / np.sqrt(error**2 + WIDTH**2)


def _shows_pane(guess: Guess, rays: Floats32) -> Mask:
    """Return which rays [r, 3] leave through both ends of a window's opening, [r]."""
    ends = surfaces(guess, rays)
    toward = rays @ guess.camera_turn.T
    shows = np.zeros(len(rays), bool)
    for rect in guess.windows:
        axis, side = WALLS[rect.wall]
        outward = toward[:, axis] * (1.0 if side else -1.0)
        here = (ends.surface == OUTSIDE) & (ends.axis == axis) & (outward > 0.0)
        reach = guess.thickness_m / np.where(here, outward, 1.0)
        for at, (low, high) in ((1 - axis, rect.u_m), (2, rect.z_m)):
            outer = ends.position_m[:, at] + reach * toward[:, at]
            here &= (outer > low) & (outer < high)
        shows |= here
    return shows


def window_view(data: Dataset, guess: Guess) -> WindowView:
    """Return the captures' median picture within 6 degrees of the windows of a guess."""
    height, width = data.shape
    _, middle = pixel_rays(height, data.heading_deg, 1)
    pane = _shows_pane(guess, middle.astype(np.float32)).reshape(height, width)
    margin = max(1, round(MARGIN_DEG / 180.0 * height))
    near = np.asarray(binary_dilation(pane, iterations=margin), bool) & data.seen
    chosen = np.flatnonzero(near)
    is_pane = pane.ravel()[chosen]
    weights = np.zeros(len(chosen))
    share = np.zeros(len(chosen))
    if is_pane.any() and not is_pane.all():
        level = data.luminance_cdm2.reshape(len(data), -1)[:, chosen]
        level = np.median(level / np.maximum(level[:, is_pane].mean(axis=1), 0.1)[:, None], axis=0)
        room, usual = float(np.median(level[~is_pane])), float(np.median(level[is_pane]))
        panes = np.full(height, usual)
        for row in np.unique(chosen[is_pane] // width):
            panes[row] = np.median(level[is_pane & (chosen // width == row)])
        bright = np.maximum(panes, LEAST_CONTRAST * room)[chosen // width]
        share = np.clip((level - room) / (bright - room), 0.0, 1.0)
        if usual > LEAST_CONTRAST * room:
            omega = equirect_solid_angles(height, width)
            weights = omega.ravel()[chosen] / omega[data.seen].sum()
    pixel, rays = pixel_rays(height, data.heading_deg, SUB)
    place = np.full(height * width, -1)
    place[chosen] = np.arange(len(chosen))
    of = place[pixel] >= 0
    return WindowView(share, weights, rays[of].astype(np.float32), place[pixel[of]])
