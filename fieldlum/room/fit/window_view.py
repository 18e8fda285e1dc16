"""Compare a guess with the picture of the windows: bright panes against dark walls show edges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from fieldlum.core.arrays import Floats, Floats32, Indices
from fieldlum.learn.models.data import Dataset
from fieldlum.optics.projection import equirect_solid_angles
from fieldlum.room.fit.guess import Guess
from fieldlum.room.fit.renderer import BAR, OUTSIDE, seen_in_opening, surfaces
from fieldlum.room.scene.view import pixel_rays
from fieldlum.sky.sun import direction

RAY_DEG = 0.75  # chosen: between rays of a pixel; an edge moves a pixel's share in such steps
MARGIN_DEG = 6.0  # chosen: a tape that is 5 cm off and a camera that is, both seen from 1 m
WIDTH = 0.25  # chosen: error, as a share of the panes' luminance, at which a pixel is half wrong
_SMOOTH = 1.0  # chosen: weight of equal luminance in neighbouring rows, in pixels
_LEAST_CDM2 = 0.1  # chosen: for logarithms, far below any pane
_LEAST_PANE = 0.1  # chosen: of the mean pane; a row without panes has no level of its own
# Luminance of sill, head, jambs and room as shares of the mean pane's, and how many pixels of
# evidence this counts as. In five rendered rooms the reveals had 0.05 to 0.4. Without it, reveals
# as bright as panes let a window shrink by their width. Chosen.
_LEVELS = np.array([0.3, 0.15, 0.15, 0.05])
_LEVEL_WEIGHTS = np.array([20.0, 20.0, 20.0, 1e-3])
# Chosen: of the luminance that three quarters of the panes exceed; a brighter room shows no edges.
MAX_ROOM_SHARE = 0.5


@dataclass(frozen=True)
class WindowView:
    """The median picture of q pixels near the windows, and the rays that sample it.

    seen: luminance over that of the hour's mean pane, median of the hours [q]; row: of the picture,
    from 0 at the topmost of the pixels [q]; weights: share of the solid angle that the camera sees,
    all 0 if the room is too bright to show edges [q]; rays: unit vectors, x east, y north, z up by
    the stated heading [r, 3]; pixel: index below q of each ray [r]; per_pixel: rays in each pixel.
    """

    seen: Floats
    row: Indices
    weights: Floats
    rays: Floats32
    pixel: Indices
    per_pixel: int

    def thinned(self, every: int) -> WindowView:
        """Return the view at pixels 0, `every`, 2 `every` ..., with the same sum of weights."""
        keep = np.arange(0, len(self.seen), every)
        place = np.full(len(self.seen), -1)
        place[keep] = np.arange(len(keep))
        of = place[self.pixel] >= 0
        kept = float(self.weights[keep].sum())
        return replace(
            self,
            seen=self.seen[keep],
            row=self.row[keep],
            weights=self.weights[keep] * (float(self.weights.sum()) / max(kept, 1e-12)),
            rays=self.rays[of],
            pixel=place[self.pixel[of]],
        )

    def redrawn(self, rng: np.random.Generator) -> WindowView:
        """Return the view with random weights of its pixels (a Bayesian bootstrap).

        The sum of the weights is about the same.
        """
        share = rng.exponential(1.0, len(self.weights))
        return replace(self, weights=self.weights * share / max(share.mean(), 1e-12))

    def errors(self, guess: Guess) -> Floats:
        """Return predicted minus seen luminance of each pixel over that of its row's panes, [q].

        A pixel mixes panes, reveals and the room in the shares that the guess has, with the
        `levels` that explain the picture best.
        """
        return self._errors(self.shares(guess))

    def _errors(self, share: Floats) -> Floats:
        level = self.levels(share)
        pane, others = level[: -len(_LEVELS)][self.row], level[-len(_LEVELS) :]
        shown = share[:, 0] * pane + share[:, 1:] @ others
        return (shown - self.seen) / np.maximum(pane, _LEAST_PANE)

    def levels(self, share: Floats) -> Floats:
        """Return the luminances that explain the picture best, for pixels with the shares [q, 5].

        They are that of the panes in each picture row, then of sill, head, jambs and room, [rows +
        4], over the mean pane's luminance. The last four are drawn towards 0.3, 0.15, 0.15 and
        0.05, and neighbouring rows towards each other. share: see `shares`.
        """
        pane, rest = share[:, 0], share[:, 1:]
        rows = int(self.row.max()) + 1
        size = rows + len(_LEVELS)
        normal = np.zeros((size, size))
        index = np.arange(rows)
        normal[index, index] = np.bincount(self.row, pane**2, rows)
        cross = np.stack([np.bincount(self.row, pane * r, rows) for r in rest.T], axis=1)
        normal[:rows, rows:], normal[rows:, :rows] = cross, cross.T
        normal[rows:, rows:] = rest.T @ rest + np.diag(_LEVEL_WEIGHTS)
        normal[index[1:], index[1:]] += _SMOOTH
        normal[index[:-1], index[:-1]] += _SMOOTH
        normal[index[1:], index[:-1]] -= _SMOOTH
        normal[index[:-1], index[1:]] -= _SMOOTH
        right = np.concatenate([np.bincount(self.row, pane * self.seen, rows), rest.T @ self.seen])
        right[rows:] += _LEVEL_WEIGHTS * _LEVELS
        return np.linalg.solve(normal + 1e-9 * np.eye(size), right)

    def shares(self, guess: Guess) -> Floats:
        """Return the share of each pixel that shows pane, sill, head, jamb or the rest, [q, 5].

        The rest is room, furniture and bars.
        """
        return self.shares_of(self.kinds(guess))

    def kinds(self, guess: Guess) -> NDArray[np.int8]:
        """Return what each ray sees: `PANE`, `SILL`, `HEAD`, `JAMB` or `BAR` (0 to 4), [r].

        `BAR` is also the room and its furniture.
        """
        ends = surfaces(guess, self.rays)
        into = np.flatnonzero(ends.surface == OUTSIDE)
        turn = guess.camera_turn.T.astype(np.float32)
        kind = np.full(len(ends.surface), BAR, np.int8)
        kind[into] = seen_in_opening(guess, ends.position_m[into], self.rays[into] @ turn)
        return kind

    def shares_of(self, kind: NDArray[np.int8]) -> Floats:
        """Return the share of each pixel's rays that see each of the five kinds, [q, 5].

        kind: what each ray sees, 0 to 4: `PANE`, `SILL`, `HEAD`, `JAMB`, `BAR` (also room) [r].
        """
        count = len(self.seen)
        counts = np.bincount(self.pixel * (BAR + 1) + kind, minlength=count * (BAR + 1))
        return counts.reshape(count, BAR + 1) / self.per_pixel

    def residuals(self, guess: Guess) -> Floats:
        """Return numbers [q] whose squares add up to `misfit`; 0 if the picture shows no edges."""
        if not self.weights.any():
            return np.zeros(len(self.weights))
        return self._saturated(self.errors(guess))

    def _saturated(self, error: Floats) -> Floats:
        return np.sqrt(self.weights) * error / np.sqrt(error**2 + WIDTH**2)

    def misfit(self, guess: Guess) -> float:
        """Return the share of the camera's solid angle that the guess's windows leave wrong.

        It is the weighted sum of e^2 / (e^2 + 0.25^2), e being `errors`; 0 if the picture shows no
        edges.
        """
        return float((self.residuals(guess) ** 2).sum())

    def misfit_of(self, kind: NDArray[np.int8]) -> float:
        """Return `misfit` for rays that see `kind` [r]: `PANE`, `SILL`, `HEAD`, `JAMB` or `BAR`."""
        if not self.weights.any():
            return 0.0
        return float((self._saturated(self._errors(self.shares_of(kind))) ** 2).sum())


def window_view(data: Dataset, guess: Guess) -> WindowView:
    """Return the captures' median picture near the windows of a guess; empty if none is in view.

    Near is within 6 degrees. It is also empty if the pixels show only panes.
    """
    height, width = data.shape
    pixel, rays = pixel_rays(height, data.heading_deg, 1)
    away = surfaces(guess, rays.astype(np.float32)).surface == OUTSIDE
    grid = np.zeros(height * width, bool)
    grid[pixel] = away
    margin = max(1, round(MARGIN_DEG / 180.0 * height))
    dilated = binary_dilation(grid.reshape(height, width), iterations=margin)
    near = np.asarray(dilated, bool) & data.seen
    chosen = np.flatnonzero(near)
    is_pane = grid[chosen]
    if not is_pane.any() or is_pane.all():
        none = np.zeros(0)
        return WindowView(
            none, none.astype(np.intp), none, np.zeros((0, 3), np.float32), none.astype(np.intp), 1
        )
    level = np.maximum(data.luminance_cdm2.reshape(len(data), -1)[:, chosen], _LEAST_CDM2)
    panes = np.mean(level[:, is_pane], axis=1, keepdims=True)
    shown = np.median(level / panes, axis=0)
    omega = equirect_solid_angles(height, width)
    panes_low = np.quantile(shown[is_pane], 0.25)
    shows_edges = np.median(shown[~is_pane]) < MAX_ROOM_SHARE * panes_low
    weights = shows_edges * omega.ravel()[chosen] / omega[data.seen].sum()
    sub = int(np.clip(round(180.0 / height / RAY_DEG), 2, 4))
    pixel, rays = pixel_rays(height, data.heading_deg, sub)
    place = np.full(height * width, -1)
    place[chosen] = np.arange(len(chosen))
    of = place[pixel] >= 0
    row = chosen // width
    rays = _scattered(rays[of], 180.0 / height / sub)
    return WindowView(
        shown,
        row - row.min(),
        weights,
        rays.astype(np.float32),
        place[pixel[of]],
        sub**2,
    )


def _scattered(rays: Floats, step_deg: float) -> Floats:
    """Return rays [r, 3] moved at random by up to half the step between them.

    The jambs of a window are at one azimuth: regular rays of all rows would pass them at once, and
    the misfit would be flat between such steps.
    """
    off_deg = np.random.default_rng(0).uniform(-0.5, 0.5, (2, len(rays))) * step_deg
    altitude_deg = np.degrees(np.arcsin(np.clip(rays[:, 2], -1.0, 1.0))) + off_deg[0]
    azimuth_deg = np.degrees(np.arctan2(rays[:, 0], rays[:, 1])) + off_deg[1]
    return direction(altitude_deg, azimuth_deg)
