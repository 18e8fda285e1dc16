"""Estimate the sky view from captures: what follows the sky, by pane, and the captured discs.

`ratio` tells which directions follow the sky. This module decides what they mean: open sky, partly
open, shut, or undecided, and checks the result with the discs in the captures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Progress, quiet
from fieldlum.core.room_states import parse_state
from fieldlum.sky.light import Light
from fieldlum.sky.sky_view.disc import disc_of_hours
from fieldlum.sky.sky_view.panes import pane_transmittance
from fieldlum.sky.sky_view.picture import SkyGrid, SkyPicture
from fieldlum.sky.sky_view.pose import CameraPose
from fieldlum.sky.sky_view.ratio import (
    FOLLOWS,
    FOLLOWS_NOT,
    follow,
    sky_reference,
    unmixed,
)
from fieldlum.sky.sky_view.sky_heading import heading_by_sky
from fieldlum.sky.sky_view.view import SkyView

# Sunlight inside a room also follows the sky a little: interior surfaces reach 1.2 % of the sky's
# luminance in the rooms of docs/sky-view.md. Less counts as shut.
LEAST_THROUGH = 0.02
# Luminous efficacy (5 %), camera scale (5 %), pyranometer (5 %) and the mean of real skies against
# Perez's (12 %), together; this scale is common to all directions.
SCALE_SD = 0.2
# Least ratio to the sky of a pane, as a share of the room's brightest: interior surfaces of the
# rooms of docs/sky-view.md reach 0.2, but do not follow the sky; a darker pane has bounds. Chosen.
_LEAST_SHARE = 0.05
_OPEN_U = 0.05  # of a pane's own transmittance, from direction to direction; chosen
_OPEN, _LEAST_OPEN = 0.9, 0.02  # openness that counts as all open, and as shut; chosen
_DISC_DEG2 = 0.223  # solid angle of the sun's disc
# What scatters (curtain, fabric) is this bright, as a share of the brightest ratio, and brighter by
# this logarithm with the sun behind it: a curtain by 1.1, a facade by less than 0.6.
_SCATTER_SHARE, _SCATTER_GLOW = 0.15, 0.6
# Share of the brightest ratio from which a direction may be sky behind glass; chosen.
_BRIGHT_SHARE, _BRIGHT_RATIO = 0.3, 0.25
LEAST_CAPTURES = 6  # fewer do not separate the sky from other light; chosen
_MOST_VALUES = 60_000_000  # captures times directions in memory: 240 MB; chosen
# What merge left out as too dark is between 0 and `SkyPicture.dark_cdm2`; its mean. Chosen.
_DARK_SHARE = 0.5
_TROPIC_DEG = 23.44  # the sun's largest declination
_HEADING_KNOWN_DEG = 0.3  # by discs; the sky alone is not better. Chosen.
_INSIDE_DEG, _HEADING_DIRECTIONS = 0.5, 400  # of open sky, for the heading; chosen
_DISC_LX = 1000.0  # beam whose disc cannot be missed in a picture; chosen
_SHOWN = 0.01  # share of the beam that counts as a disc in a check; chosen


@dataclass(frozen=True, slots=True)
class Captured:
    """What n captures give: the light outside, how to read the pictures, and the measured discs.

    read: returns the sky picture of a capture by its index. disc_share [n]: illuminance of the disc
    over that of the beam; 0 where the picture shows no disc, NaN where its size is not known.
    """

    light: Light
    read: Callable[[int], SkyPicture]
    disc_share: Floats

    def take(self, rows: Sequence[int]) -> Captured:
        """Return some of the captures, by index."""
        index = [int(row) for row in rows]
        return Captured(
            self.light[index], lambda k: self.read(index[k]), self.disc_share[np.array(index, int)]
        )


def usual_rows(states: Sequence[str] | None, count: int) -> list[int]:
    """Return the captures that show the usual view out: blinds up, no snow; lamps do not matter.

    states: of `count` captures, None if all are usual. If no capture is usual, all are returned.
    """
    if states is None:
        return list(range(count))
    plain = [k for k in range(count) if all(p.startswith("lamp=") for p in parse_state(states[k]))]
    return plain or list(range(count))


def estimate(
    captured: Captured,
    shut: Callable[[Floats], Mask] | None = None,
    progress: Progress = quiet,
    pose: CameraPose | None = None,
    latitude_deg: float | None = None,
) -> SkyView:
    """Return the sky view of captures of one state of the room.

    shut: returns, for directions [p, 3], whether a lens saw them; where a lens saw a direction, but
    no sky picture has it, merge found it too dark for the sky. latitude_deg: of the room;
    the sun never reaches some directions. Raises NotEnoughDataError without a capture with light.
    """
    lit = np.flatnonzero(captured.light.diffuse_lx > _DISC_LX)
    if not len(lit):
        raise NotEnoughDataError("a sky view needs captures by daylight; none has 1 000 lx outside")
    used = captured.take(lit.tolist())
    stack = _stack(used, shut, progress)
    pose = pose or CameraPose(axis_deg=stack.grid.heading_deg)
    light = used.light[stack.rows]
    decided = _decided(stack, light, pose, latitude_deg)
    turned = _turned(stack, light, decided)
    if turned is not pose:
        decided = _decided(stack, light, turned, latitude_deg)
    return _checked(decided, captured)


# ----------------------------------------------------------------------------------------------
# pictures


@dataclass(frozen=True, slots=True)
class _Stack:
    """Pictures of the captures `rows` on one grid, only pixels `kept` that have a value.

    luminance_cdm2 [n, p]: NaN where clipped or not seen. dark [h, w]: pixels that a lens saw, but
    that no picture has.
    """

    grid: SkyGrid
    rows: list[int]
    kept: Mask  # [h, w]
    dark: Mask
    luminance_cdm2: Floats32

    def placed(self, values: Array) -> Floats:
        """Return values [p] on the grid, [h, w], NaN for other pixels."""
        out = np.full(self.kept.shape, np.nan)
        out[self.kept] = values
        return out

    def columns(self, pixels: Indices | None = None) -> Indices:
        """Return the column in the pictures of flat indices of pixels; None: of all, [h, w]."""
        columns = np.maximum(np.cumsum(self.kept) - 1, 0)
        return columns.reshape(self.kept.shape) if pixels is None else columns[pixels]


def _stack(captured: Captured, seen: Callable[[Floats], Mask] | None, progress: Progress) -> _Stack:
    count = len(captured.light)
    some = sorted({0, count // 2, count - 1})
    grid = _common([captured.read(k).grid for k in some])
    kept = np.zeros((grid.height, grid.width), bool)
    for k in some:
        kept |= np.isfinite(_placed(captured.read(k), grid))
    most = max(LEAST_CAPTURES, _MOST_VALUES // max(int(kept.sum()), 1))
    rows = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
    in_lens = np.zeros(kept.shape, bool)
    if seen is not None:
        in_lens = seen(grid.rays().reshape(-1, 3)).reshape(kept.shape)
    light = np.empty((len(rows), int(kept.sum())), np.float32)
    for n, k in enumerate(rows):
        progress(n, len(rows), "sky view")
        picture = captured.read(k)
        values = _placed(picture, grid)
        if picture.dark_cdm2 is not None:
            values = np.where(np.isnan(values) & in_lens, _DARK_SHARE * picture.dark_cdm2, values)
        light[n] = np.where(np.isinf(values), np.nan, values)[kept]
    return _Stack(grid, rows, kept, in_lens & ~kept, light)


def _common(grids: Sequence[SkyGrid]) -> SkyGrid:
    """Return a grid that covers all `grids`, which have one step and one heading."""
    first = grids[0]
    step = first.step_deg
    top = max(g.first_altitude_deg for g in grids)
    left = min(g.first_azimuth_deg for g in grids)
    bottom = min(g.first_altitude_deg - g.height * step for g in grids)
    right = max(g.first_azimuth_deg + g.width * step for g in grids)
    return replace(
        first,
        first_altitude_deg=top,
        first_azimuth_deg=left,
        height=round((top - bottom) / step),
        width=round((right - left) / step),
    )


def _placed(picture: SkyPicture, grid: SkyGrid) -> Floats32:
    """Return a picture's luminance on a grid of the same step: NaN not seen, infinite clipped."""
    own = picture.grid
    shown = np.where(picture.clipped, np.float32(np.inf), picture.luminance_cdm2)
    if own == grid:
        return shown
    light = np.full((grid.height, grid.width), np.nan, np.float32)
    i = round((grid.first_altitude_deg - own.first_altitude_deg) / grid.step_deg)
    j = round((own.first_azimuth_deg - grid.first_azimuth_deg) / grid.step_deg)
    top, left = max(i, 0), max(j, 0)
    bottom, right = min(i + own.height, grid.height), min(j + own.width, grid.width)
    if bottom > top and right > left:
        source = (slice(top - i, bottom - i), slice(left - j, right - j))
        light[top:bottom, left:right] = shown[source]
    return light


# ----------------------------------------------------------------------------------------------
# decisions


@dataclass(frozen=True, slots=True)
class _Decided:
    """A sky view before the discs in captures, and directions that it does not decide [h, w].

    sky: follows the sky; bright: follows neither the sky nor other light; scatters: a curtain.
    """

    view: SkyView
    sky: Mask
    bright: Mask
    scatters: Mask


def _decided(stack: _Stack, light: Light, pose: CameraPose, latitude_deg: float | None) -> _Decided:
    """Return openness, transmittance and bounds in each direction."""
    rays = pose.true_directions(stack.grid.rays()[stack.kept])
    reference = sky_reference(stack.luminance_cdm2, light, rays)
    seen = follow(stack.luminance_cdm2, light, rays, reference)
    ratio, spread = stack.placed(seen.ratio), stack.placed(seen.spread)
    relative = ratio / reference.brightest  # NaN if nothing follows the sky
    sky = (spread < FOLLOWS) & (relative > _LEAST_SHARE) & (ratio > LEAST_THROUGH)
    pane = np.minimum(pane_transmittance(ratio, sky, stack.grid.step_deg), 1.0)  # [h, w]
    openness = np.where(sky, np.clip(ratio / pane, 0.0, 1.0), 0.0)
    u = np.where(sky, _OPEN_U, 0.0)
    mixed = _near(sky) & ~np.isnan(ratio) & (openness < _OPEN)
    shut = stack.kept & ~_near(sky)
    if mixed.any() and shut.any():
        at, front = (stack.columns(pixels)[mixed] for pixels in (None, _nearest(shut)))
        luminance = stack.luminance_cdm2
        open_sky = reference.sky(light, rays[at])
        openness[mixed], u[mixed] = unmixed(
            luminance[:, at], open_sky, luminance[:, front], pane[mixed]
        )
    openness[openness < _LEAST_OPEN] = 0.0
    low, high = _bounds(openness, u, mixed, pane, stack.grid.step_deg)
    apart = ~sky & ~mixed & (stack.placed(_sun_can_stand(rays, latitude_deg, pose)) > 0.0)
    scatters = apart & (stack.placed(seen.glow) > _SCATTER_GLOW) & (relative > _SCATTER_SHARE)
    bright = apart & (relative > _BRIGHT_SHARE) & (spread < FOLLOWS_NOT)
    bright |= np.isnan(relative) & (ratio > _BRIGHT_RATIO)
    few = len(light) < LEAST_CAPTURES
    low = np.zeros_like(low) if few else low
    high = np.where(scatters | bright | few, np.clip(1.3 * ratio, high, 1.0), high)
    u = np.minimum(np.hypot(u, SCALE_SD * openness), 1.0)
    count = np.where(stack.dark, len(light), stack.placed(seen.count))
    channels = openness, u, count, np.where(stack.dark, 0.0, pane), low, high
    blind = np.isnan(ratio) & ~stack.dark
    arrays = (np.where(blind, np.nan, values).astype(np.float32) for values in channels)
    view = SkyView(stack.grid, *arrays, captures=len(light), pose=pose)
    return _Decided(view, sky, bright, scatters)


def _sun_can_stand(rays: Floats, latitude_deg: float | None, pose: CameraPose) -> Mask:
    """Return where the sun passes on some day of the year, of directions [p, 3]; True if unknown.

    It stays within the tropics' declination; the camera's heading and level have uncertainties.
    """
    if latitude_deg is None:
        return np.ones(len(rays), bool)
    latitude = np.radians(latitude_deg)
    pole = np.array([0.0, np.cos(latitude), np.sin(latitude)])
    declination = np.arcsin(np.clip(rays @ pole, -1.0, 1.0))
    margin_deg = 0.5 + 2.0 * float(np.hypot(pose.heading_sd_deg, pose.level_sd_deg))
    return np.abs(declination) < np.radians(_TROPIC_DEG + margin_deg)


def _turned(stack: _Stack, light: Light, decided: _Decided) -> CameraPose:
    """Return the pose with the heading by the open sky, if discs do not give it better."""
    from scipy.ndimage import binary_erosion

    pose = decided.view.pose
    if pose.heading_sd_deg < _HEADING_KNOWN_DEG:
        return pose
    pixels = int(np.ceil(_INSIDE_DEG / stack.grid.step_deg))
    square = np.ones((3, 3))
    open_sky = stack.kept & (decided.view.openness >= _OPEN)
    at = np.flatnonzero(binary_erosion(open_sky, square, iterations=pixels))
    at = at[:: max(1, len(at) // _HEADING_DIRECTIONS)]
    luminance = stack.luminance_cdm2[:, stack.columns(at)]
    rays = pose.true_directions(stack.grid.rays().reshape(-1, 3)[at])
    correction = heading_by_sky(luminance, light, rays, pose.axis_deg)
    return pose if correction is None else pose.with_heading(*correction)


def _near(sky: Mask) -> Mask:
    """Return the pixels that are sky or touch it."""
    from scipy.ndimage import binary_dilation

    return np.asarray(binary_dilation(sky, np.ones((3, 3))), bool)


def _nearest(marked: Mask) -> Indices:
    """Return the flat index of the nearest marked pixel, [h, w]."""
    from scipy.ndimage import distance_transform_edt

    found = np.empty((2, *marked.shape), np.int32)
    distance_transform_edt(~marked, return_distances=False, return_indices=True, indices=found)
    return found[0] * marked.shape[1] + found[1]


def _bounds(
    openness: Floats, u: Floats, mixed: Mask, pane: Floats, step_deg: float
) -> tuple[Floats, Floats]:
    """Return 95 % bounds of the beam's share, [h, w] each.

    A mixed pixel blurs what its neighbours show, and one that is larger than the sun's disc may
    show all of it or none.
    """
    from scipy.ndimage import maximum_filter, minimum_filter

    larger = np.where(mixed, max(1.0, step_deg**2 / _DISC_DEG2), 1.0)
    around = np.where(mixed, maximum_filter(openness, 3), openness)
    within = np.where(mixed, minimum_filter(openness, 3), openness)
    most = np.where(around > 0.0, np.clip((around + 2.0 * u) * larger, 0.0, 1.0), 0.0)
    least = 1.0 - np.clip((1.0 - within + 2.0 * u) * larger, 0.0, 1.0)
    high = np.minimum(most * pane * (1.0 + 2.0 * SCALE_SD), 1.0)
    return least * pane * (1.0 - 2.0 * SCALE_SD), high


def _notes(decided: _Decided) -> tuple[str, ...]:
    sky, scatters, captures = decided.sky, decided.scatters, decided.view.captures
    notes = []
    if captures < LEAST_CAPTURES:
        notes.append(
            f"{captures} captures do not show where the sky is (at least {LEAST_CAPTURES}): the "
            "sun's disc has bounds only; capture overcast and clear hours"
        )
    if not sky.any() and decided.bright.any():
        notes.append(
            "no direction follows the sky clearly, although some are as bright as sky behind "
            "glass: whether the sun is seen there is not known; capture overcast hours, or an hour "
            "with the sun in the window"
        )
    elif not sky.any():
        notes.append("the camera sees no sky: no hour shows the sun's disc")
    weight = np.cos(np.radians(decided.view.grid.altitudes_deg))[:, None]
    share = (scatters * weight).sum() / max(((sky | scatters) * weight).sum(), 1e-9)
    if share > 0.05:
        notes.append(
            f"{100 * share:.0f} % of the glazing scatters (a curtain, fabric): how much of "
            "the disc passes is between 0 and its brightness; a capture with the sun behind it "
            "settles it"
        )
    return tuple(notes)


# ----------------------------------------------------------------------------------------------
# captured discs


def _checked(decided: _Decided, captured: Captured) -> SkyView:
    """Return the view, corrected where captures show a disc or none; contradictions are named."""
    light, share = captured.light, captured.disc_share
    view, scatters = decided.view, decided.scatters
    strong = np.flatnonzero((light.direct_lx > _DISC_LX) & ~np.isnan(share))
    if not len(strong):
        return replace(view, notes=_notes(decided) + view.pose.notes)
    some, measured = light[strong], share[strong]
    disc_deg = 0.2665 + 0.5 * view.grid.step_deg
    near = _near_shares(view, some, disc_deg + view.pose.heading_sd_deg)
    inside = _near_shares(view, some, disc_deg)
    phantom = (measured < _SHOWN) & (near[0] > _SHOWN)
    missed = (measured > _SHOWN) & (near[1] <= _SHOWN)
    expected = disc_of_hours(view, some).best_lx / some.direct_lx
    both = (measured > _SHOWN) & (expected > _SHOWN) & (inside[0] > 0.5 * expected)
    arrays = {name: getattr(view, name).copy() for name in ("openness", "low", "high")}
    suns = view.pose.in_pictures(some.shown_sun_direction)
    without = _panes_without_disc(view, scatters, suns, measured)
    for values in arrays.values():
        values[without] = 0.0
    if both.sum() >= 3:
        gain = float(np.clip(np.median(measured[both] / expected[both]), 0.5, 1.5))
        arrays["transmittance"] = np.minimum(view.transmittance * gain, 1.0).astype(np.float32)
        arrays["low"] = np.minimum(arrays["low"] * gain, 1.0)
        arrays["high"] = np.minimum(arrays["high"] * gain, 1.0)
    cosine = np.cos(np.radians(0.2665 + 0.5 * view.grid.step_deg))
    rays = view.grid.rays()
    for k in np.flatnonzero(phantom | missed):
        at = rays @ suns[k] >= cosine
        pane = np.maximum(np.nan_to_num(view.transmittance[at]), LEAST_THROUGH)
        arrays["openness"][at] = np.clip(measured[k] / pane, 0.0, 1.0)
        arrays["low"][at] = 0.0 if phantom[k] else 0.8 * measured[k]
        arrays["high"][at] = 0.0 if phantom[k] else min(1.2 * measured[k], 1.0)
    named = [
        f"{some.t_utc[k]:%Y-%m-%d %H:%M} UTC ({'no disc' if phantom[k] else 'a disc'} captured)"
        for k in np.flatnonzero(phantom | missed)
    ]
    note = (
        f"{len(named)} captures contradict the sky view, which was corrected there: "
        f"{', '.join(named[:3])}; check the heading and the clock",
    )
    notes = _notes(replace(decided, scatters=scatters & ~without)) + view.pose.notes
    return replace(view, **arrays, notes=notes + (note if named else ()))


def _panes_without_disc(view: SkyView, scatters: Mask, suns: Floats, measured: Floats) -> Mask:
    """Return the scattering panes in which three captures show no disc and none shows one, [h, w].

    suns [n, 3]; measured [n]: share of the beam.
    """
    from scipy.ndimage import label

    panes = np.empty(scatters.shape, np.int32)
    label(scatters, output=panes)
    row, column = view.grid.pixels(suns)
    inside = (row >= 0) & (row < view.grid.height) & (column < view.grid.width)
    at = panes[row[inside].astype(int), column[inside].astype(int)]
    shown = measured[inside] > _SHOWN
    hidden = [k for k in np.unique(at[at > 0]) if (at == k).sum() >= 3 and not shown[at == k].any()]
    return np.isin(panes, hidden)


def _near_shares(view: SkyView, light: Light, reach: float) -> tuple[Floats, Floats]:
    """Return the lowest low and the highest high within `reach` degrees of the sun, [n] each."""
    rays = view.grid.rays().reshape(-1, 3)
    low, high = view.low.ravel(), view.high.ravel()
    least, most = np.zeros(len(light)), np.ones(len(light))
    for k, sun in enumerate(view.pose.in_pictures(light.shown_sun_direction)):
        at = rays @ sun >= np.cos(np.radians(reach))
        if at.any() and not np.isnan(low[at]).any():
            least[k], most[k] = low[at].min(), high[at].max()
    return least, most
