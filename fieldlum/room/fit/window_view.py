"""Compare a guess with the picture of the windows: bright panes against dark walls show edges."""

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation, binary_erosion

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.room.fit.guess import Guess
from fieldlum.room.fit.renderer import SHELL, surfaces
from fieldlum.room.scene.box_room import WALLS
from fieldlum.room.scene.view import pixel_rays

# Chosen: a tape that is 5 cm off and a camera that is, both seen from 1 m; error of a share at
# which a pixel is half wrong; panes over the room from which edges show; weight of a pixel against
# one of the sun patches: with 1 the picture, which knows no bars, outweighed them in five rooms.
MARGIN_DEG, WIDTH, MIN_CONTRAST, WEIGHT = 6.0, 0.25, 2.0, 0.25


@dataclass(frozen=True)
class WindowView:
    """How much pane q pixels near the windows show in the captures' median picture.

    share: of the luminance between that of the room (0) and of the panes in this row (1) [q];
    weights: share of the solid angle that the camera sees, 0 in rows whose panes are hardly
    brighter than the room [q]; rays: of the pixels' centres, unit vectors, x east, y north, z up by
    the stated heading [q, 3]; spread: the height of a pixel [rad].
    """

    share: Floats
    weights: Floats
    rays: Floats32
    spread: float

    def residuals(self, guess: Guess) -> Floats:
        """Return numbers [q] whose squares add up to the share of the view that is wrong."""
        error = _pane_share(guess, self.rays, self.spread) - self.share
        return np.sqrt(self.weights) * error / np.sqrt(error**2 + WIDTH**2)


def _pane_share(guess: Guess, rays: Floats32, spread: float) -> Floats:
    """Return the share of each ray's width that leaves through both ends of an opening, [r].

    rays [r, 3]; spread: their width [rad]. Shares grow steadily as an edge crosses a ray: hard
    edges would cross the rays of all rows at once, and a search would not see between such steps.
    """
    ends = surfaces(guess, rays, spread)
    toward = rays @ guess.camera_turn.T
    shows = np.zeros(len(rays))
    for rect in guess.windows:
        axis, side = WALLS[rect.wall]
        outward = toward[:, axis] * (1.0 if side else -1.0)
        here = (ends.surface < SHELL) & (ends.axis == axis) & (outward > 0.0)
        slope = toward[here] / outward[here, None]
        flat = np.hypot(1.0, slope[:, 1 - axis])
        reach = flat * np.hypot(flat, slope[:, 2])  # of a ray 1 m away from the wall
        far = np.abs(ends.position_m[here, axis] - guess.camera_m[axis])
        share = np.ones(len(slope))
        for at, (low, high), width in ((1 - axis, rect.u_m, flat**2), (2, rect.z_m, reach)):
            inner = ends.position_m[here, at]
            outer = inner + guess.thickness_m * slope[:, at]
            beyond = (np.minimum(inner, outer) - low, high - np.maximum(inner, outer))
            for edge in beyond:
                share *= np.clip(edge / (spread * far * width) + 0.5, 0.0, 1.0)
        shows[here] += share
    return shows


def window_view(data: Dataset, guess: Guess) -> WindowView:
    """Return the captures' median picture within 6 degrees of the windows of a guess.

    The pane luminance of a row is the median of its pixels inside the window. Pixels on the
    window's edge do not count: they are partly wall, and would move sill and head outwards.
    """
    height, width = data.shape
    rays, spread = pixel_rays(height, data.heading_deg, 1)[1].astype(np.float32), np.pi / height
    pane = (_pane_share(guess, rays, spread) > 0.5).reshape(height, width)
    margin = max(1, round(MARGIN_DEG / 180.0 * height))
    near = np.asarray(binary_dilation(pane, iterations=margin), bool) & data.seen
    chosen = np.flatnonzero(near)
    is_pane = pane.ravel()[chosen]
    weights, share = np.zeros((2, len(chosen)))
    if is_pane.any() and not is_pane.all():
        level = data.luminance_cdm2.reshape(len(data), -1)[:, chosen]
        level = np.median(level / np.maximum(level[:, is_pane].mean(axis=1), 0.1)[:, None], axis=0)
        room = float(np.median(level[~is_pane]))
        within = np.asarray(binary_erosion(pane, border_value=1), bool).ravel()[chosen]
        within = within if within.any() else is_pane
        row = chosen // width
        rows = np.unique(row[within])
        panes = np.interp(row, rows, [np.median(level[within & (row == k)]) for k in rows])
        shown = panes > MIN_CONTRAST * room
        share = np.clip((level - room) / np.maximum(panes - room, room), 0.0, 1.0)
        omega = equirect_solid_angles(height, width)
        weights = WEIGHT * shown * omega.ravel()[chosen] / omega[data.seen].sum()
    return WindowView(share, weights, rays[chosen], spread)
