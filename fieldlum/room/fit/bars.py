"""Find bars and transoms of windows from captured sun patches and from pictures of the windows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import median_filter

from fieldlum.core.arrays import Floats
from fieldlum.room.fit.evidence import SceneEvidence
from fieldlum.room.fit.guess import Bar, Guess
from fieldlum.room.fit.renderer import OUTSIDE, lit_entries, surfaces
from fieldlum.room.fit.window_view import WindowView
from fieldlum.room.scene.geometry import WALLS

# From the study of the office (docs/scene.md), whose bars are 8 cm wide and 12 cm deep. The other
# values were chosen with it and not varied since: slope of the sun against the window's normal
# above which the depth blurs a bar; dip of the light at a bar; width of the median around it;
# widths between noise and a column; depth from which the search starts.
CELL_M = 0.02
MAX_SLOPE = 0.6
MIN_DIP = 0.2
RUNNING_M = 1.0
MAX_BAR_M = 0.2
MIN_BAR_M = 0.015
START_DEPTH_M = 0.06
# share of a pixel's rays that must be lit, so that its brightness counts; chosen, not varied
_LIT_SHARE = 0.8


def without_bars(guess: Guess) -> Guess:
    """Return the guess without bars up to 20 cm wide: blinds and curtains stay."""
    covers = [bar for bar in guess.bars if bar.span_m[1] - bar.span_m[0] > MAX_BAR_M]
    return replace(guess, bars=tuple(covers))


@dataclass(frozen=True)
class WindowPicture:
    """The light that cells of a window's middle plane let through, as shares of clear glass.

    value: about 1 for clear glass, 0 for a bar [z, u]; weight: statistical weight, 0 without data
    [z, u]; u_m, z_m: edges of the 2 cm cells along the wall [u + 1] and in height [z + 1], in m.
    """

    value: Floats
    weight: Floats
    u_m: Floats
    z_m: Floats

    def profile(self, axis: int) -> Floats:
        """Return the weighted mean of `value` over z (axis 0) as [u], or over u (axis 1) as [z].

        It is NaN where no cell has data.
        """
        weight = self.weight.sum(axis=axis)
        with np.errstate(invalid="ignore", divide="ignore"):
            return (self.value * self.weight).sum(axis=axis) / np.where(weight > 0, weight, np.nan)


def window_picture(
    evidence: SceneEvidence, guess: Guess, number: int, albedo: Floats
) -> WindowPicture:
    """Return the share of the sun that each cell of a window lets through, from sunlit pixels.

    Lines from pixels that are lit in the guess towards the sun are followed to the window, as if it
    had no bars. number: index of the window from 0; albedo: of west, east, south and north wall,
    floor, ceiling and solids [6 + solids].
    """
    rect = guess.windows[number]
    axis, side = WALLS[rect.wall]
    along = 1 - axis
    only = replace(guess, windows=(rect,), bars=())
    ends = surfaces(guess, evidence.rays)
    suns = evidence.suns_room(guess)
    lit = lit_entries(only, ends, suns)
    pixel = evidence.pixel[lit.ray]
    pixels = len(evidence.pixels)
    flat = lit.hour * pixels + pixel
    cells = len(evidence) * pixels
    share = np.bincount(flat, minlength=cells) / evidence.sub**2
    strength = np.bincount(flat, lit.strength, cells) / evidence.sub**2
    full = evidence.direct_lx.repeat(pixels) * strength / np.pi
    full *= np.tile(evidence.pixel_albedo(ends, albedo), len(evidence))
    below = evidence.below.ravel()
    excess = np.exp(evidence.log_seen).ravel() - below
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.clip(excess / full, -0.2, 1.2)
        weight = 1.0 / (0.1 + 0.2 * below / full) ** 2
    outward = 1.0 if side else -1.0
    toward = suns[lit.hour, axis] * outward
    inner = guess.size_m[axis] if side else 0.0
    position = ends.position_m[lit.ray]
    reach = ((inner - position[:, axis]) * outward + guess.thickness_m / 2.0) / toward
    u = position[:, along] + reach * suns[lit.hour, along]
    z = position[:, 2] + reach * suns[lit.hour, 2]
    steep = np.hypot(suns[lit.hour, along], suns[lit.hour, 2]) < MAX_SLOPE * toward
    use = steep & (share[flat] > _LIT_SHARE) & np.isfinite(value[flat]) & np.isfinite(weight[flat])
    u_m = np.arange(rect.u_m[0], rect.u_m[1] + CELL_M, CELL_M)
    z_m = np.arange(rect.z_m[0], rect.z_m[1] + CELL_M, CELL_M)
    w = weight[flat][use]
    v = value[flat][use]
    total, *_ = np.histogram2d(z[use], u[use], (z_m, u_m), weights=w)
    mean, *_ = np.histogram2d(z[use], u[use], (z_m, u_m), weights=w * v)
    with np.errstate(divide="ignore", invalid="ignore"):
        return WindowPicture(np.where(total > 0, mean / total, 0.0), total, u_m, z_m)


def seen_picture(view: WindowView, guess: Guess, number: int) -> WindowPicture:
    """Return window `number` (from 0) as the camera sees it: luminance over that of its panes.

    It is made of the rays that end in the window; the guess's bars are ignored.
    """
    rect = guess.windows[number]
    axis, side = WALLS[rect.wall]
    along = 1 - axis
    bare = replace(guess, bars=())
    share = view.shares(bare)
    pane = view.levels(share)[view.row]  # [q]
    inner = guess.size_m[axis] if side else 0.0
    ends = surfaces(bare, view.rays)
    toward = view.rays @ bare.camera_turn.T.astype(np.float32)
    outward = toward[:, axis] * (1.0 if side else -1.0)
    use = (ends.surface == OUTSIDE) & (np.abs(ends.position_m[:, axis] - inner) < 1e-3)
    use &= share[view.pixel, 0] > _LIT_SHARE
    slope = guess.thickness_m / 2.0 / outward[use]
    u = ends.position_m[use, along] + slope * toward[use, along]
    z = ends.position_m[use, 2] + slope * toward[use, 2]
    value = np.clip(view.seen / np.maximum(pane, 0.1), 0.0, 1.2)[view.pixel[use]]
    u_m = np.arange(rect.u_m[0], rect.u_m[1] + CELL_M, CELL_M)
    z_m = np.arange(rect.z_m[0], rect.z_m[1] + CELL_M, CELL_M)
    total, *_ = np.histogram2d(z, u, (z_m, u_m))
    mean, *_ = np.histogram2d(z, u, (z_m, u_m), weights=value)
    return WindowPicture(mean / np.maximum(total, 1.0), total, u_m, z_m)


def bars_in_patches(evidence: SceneEvidence, guess: Guess, albedo: Floats) -> list[Bar]:
    """Return bars that the sun patches of a guess without bars show, in all its windows.

    albedo: of west, east, south and north wall, floor, ceiling and solids [6 + solids].
    """
    bars: list[Bar] = []
    for number in range(len(guess.windows)):
        bars += propose_bars(window_picture(evidence, guess, number, albedo), guess, number)
    return bars


def bars_in_picture(view: WindowView, guess: Guess) -> list[Bar]:
    """Return bars that the camera sees in the guess's windows; its own bars are ignored."""
    bars: list[Bar] = []
    for number in range(len(guess.windows)):
        bars += propose_bars(seen_picture(view, guess, number), guess, number)
    return bars


def propose_bars(picture: WindowPicture, guess: Guess, number: int) -> list[Bar]:
    """Return vertical and horizontal bars of window `number` (from 0) at dips of its picture.

    A dip is over 20 % below the running median over 1 m and 1.5 to 20 cm wide, in the picture's
    mean over height (vertical bars) or along the wall (horizontal bars). The list is empty without
    dips.
    """
    middle = guess.thickness_m / 2.0
    half = min(START_DEPTH_M, 0.8 * middle)
    depth = (middle - half, middle + half)
    bars: list[Bar] = []
    for upright, edges, profile in (
        (True, picture.u_m, picture.profile(0)),
        (False, picture.z_m, picture.profile(1)),
    ):
        for low, high in _dips(profile, edges):
            bars.append(Bar(number, upright, (low, high), depth))
    return bars


def _dips(profile: Floats, edges: Floats) -> list[tuple[float, float]]:
    """Return the extents of the dips of a profile [k] with cell edges [k + 1].

    An extent is as wide as the dip's area.
    """
    good = np.isfinite(profile)
    if good.sum() < 20:
        return []
    filled = np.interp(np.arange(len(profile)), np.flatnonzero(good), profile[good])
    around = median_filter(filled, size=round(RUNNING_M / CELL_M) | 1, mode="nearest")
    drop = np.clip((around - filled) / np.maximum(around, 0.1), 0.0, 1.0)
    drop[~good] = 0.0
    deep = drop > MIN_DIP
    dips: list[tuple[float, float]] = []
    starts = np.flatnonzero(np.diff(np.concatenate([[0], deep.astype(int)])) == 1)
    stops = np.flatnonzero(np.diff(np.concatenate([deep.astype(int), [0]])) == -1) + 1
    for start, stop in zip(starts, stops, strict=True):
        reach = slice(max(start - 2, 0), min(stop + 2, len(drop)))
        area = float(drop[reach].sum()) * CELL_M
        at = np.arange(len(drop))[reach]
        centre = edges[0] + CELL_M * (0.5 + float((at * drop[reach]).sum() / drop[reach].sum()))
        if MIN_BAR_M <= area <= MAX_BAR_M:
            dips.append((centre - area / 2.0, centre + area / 2.0))
    return dips
