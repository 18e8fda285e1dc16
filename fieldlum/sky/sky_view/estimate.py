"""Estimate the sky view from captures: what follows the sky, by pane, and the captured discs.

`regression` gives the factor of the sky in each direction. This module decides what it means:
open sky, partly open, shut, or undecided, and checks the result with the discs in the captures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from fieldlum.core.arrays import Floats, Floats32, Mask
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.records import Progress, quiet
from fieldlum.core.room_states import parse_state
from fieldlum.sky.light import Light
from fieldlum.sky.sky_view.disc import disc_of_hours
from fieldlum.sky.sky_view.panes import pane_transmittance
from fieldlum.sky.sky_view.picture import SkyGrid, SkyPicture
from fieldlum.sky.sky_view.pose import CameraPose
from fieldlum.sky.sky_view.regression import SkyFactor, seen_sky, sky_factor
from fieldlum.sky.sky_view.view import SkyView

# Sunlight inside a room also follows the sky a little: interior surfaces reach 1.2 % of the sky's
# luminance in the rooms of docs/sky-view.md. Less counts as shut.
LEAST_THROUGH = 0.02
# Behind dark glass (1 to 2 %) nearly all light is the sky's; on an interior surface at most 0.6.
_PURE_SHARE = 0.8
_SIGMAS = 3.0  # of a factor that counts as sky: 1 in 700 by chance; chosen
# Luminous efficacy (5 %), camera scale (5 %), pyranometer (5 %) and the mean of real skies against
# Perez's (12 %), together; this scale is common to all directions.
SCALE_SD = 0.15
# Least share of the typical luminance that follows the sky: below it, what is there is a surface
# with a glint of sky. Interior surfaces reach 0.35, slats that are 5 % open have more (rooms of
# docs/sky-view.md).
_LEAST_SHARE = 1.0 / 3.0
# Step of the first directions: half of the disc, at most 9 pixels; only for speed.
_THIN_DEG, _MOST_THIN = 0.6, 9
# Share of the light in sunny hours that shines through from behind, above which a pane scatters,
# and the least ratio to the sky of such a pane in nine of ten hours: an interior surface is as
# bright only while the sun is in the room. Chosen.
_SCATTERS, _SCATTER_RATIO = 0.1, 0.1
# Luminance over the sky's, from which a direction may be sky behind glass: a tinted pane of 0.25.
# Facades reach it too, so that it only leaves open what nothing else decides. Chosen.
_BRIGHT_RATIO = 0.25
LEAST_CAPTURES = 6  # fewer do not separate the sky from seven kinds of light; chosen
_MOST_VALUES = 60_000_000  # captures times directions in memory: 240 MB; chosen
# What merge left out as too dark is between 0 and `SkyPicture.dark_cdm2`; its mean. Chosen.
_DARK_SHARE = 0.5
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
) -> SkyView:
    """Return the sky view of captures of one state of the room.

    shut: returns, for directions [p, 3], whether a lens saw them; where a lens saw a direction, but
    no sky picture has it, merge found it too dark for the sky. Raises NotEnoughDataError without a
    capture with light.
    """
    lit = np.flatnonzero(captured.light.diffuse_lx > _DISC_LX)
    if not len(lit):
        raise NotEnoughDataError("a sky view needs captures by daylight; none has 1 000 lx outside")
    used = captured.take(lit.tolist())
    stack = _stack(used, shut, progress)
    used = used.take(stack.rows)
    pose = pose or CameraPose(axis_deg=stack.grid.heading_deg)
    view = _decided(stack, _factor(stack, used.light, pose), len(used.light))
    view = replace(view, pose=pose, notes=view.notes + pose.notes)
    if shut is not None:
        view = _with_dark(view, stack, shut)
    return _checked(view, captured)


# ----------------------------------------------------------------------------------------------
# pictures


@dataclass(frozen=True, slots=True)
class _Stack:
    """Pictures of the captures `rows` on one grid, only pixels `kept` that have a value, [n, p]."""

    grid: SkyGrid
    rows: list[int]
    kept: Mask  # [h * w]
    luminance_cdm2: Floats32
    usable: Mask


def _stack(captured: Captured, seen: Callable[[Floats], Mask] | None, progress: Progress) -> _Stack:
    count = len(captured.light)
    grids = [captured.read(k).grid for k in {0, count // 2, count - 1}]
    grid = _common(grids)
    kept = np.zeros(grid.height * grid.width, bool)
    for k in {0, count // 2, count - 1}:
        kept |= np.isfinite(_placed(captured.read(k), grid)[0]).ravel()
    most = max(LEAST_CAPTURES, _MOST_VALUES // max(int(kept.sum()), 1))
    rows = np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(int)).tolist()
    light = np.empty((len(rows), int(kept.sum())), np.float32)
    in_lens = None if seen is None else seen(grid.rays().reshape(-1, 3)[kept])
    usable = np.empty(light.shape, bool)
    for n, k in enumerate(rows):
        progress(n, len(rows), "sky view")
        picture = captured.read(k)
        values, clipped = _placed(picture, grid)
        light[n] = values.ravel()[kept]
        if picture.dark_cdm2 is not None and in_lens is not None:
            light[n][np.isnan(light[n]) & in_lens] = _DARK_SHARE * picture.dark_cdm2
        usable[n] = np.isfinite(light[n]) & ~clipped.ravel()[kept]
    return _Stack(grid, rows, kept, light, usable)


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


def _placed(picture: SkyPicture, grid: SkyGrid) -> tuple[Floats32, Mask]:
    """Return luminance and clipped pixels of a picture on a grid of the same step."""
    own = picture.grid
    if own == grid:
        return picture.luminance_cdm2, picture.clipped
    light = np.full((grid.height, grid.width), np.nan, np.float32)
    clipped = np.zeros(light.shape, bool)
    i = round((grid.first_altitude_deg - own.first_altitude_deg) / grid.step_deg)
    j = round((own.first_azimuth_deg - grid.first_azimuth_deg) / grid.step_deg)
    top, left = max(i, 0), max(j, 0)
    bottom, right = min(i + own.height, grid.height), min(j + own.width, grid.width)
    if bottom > top and right > left:
        source = (slice(top - i, bottom - i), slice(left - j, right - j))
        light[top:bottom, left:right] = picture.luminance_cdm2[source]
        clipped[top:bottom, left:right] = picture.clipped[source]
    return light, clipped


# ----------------------------------------------------------------------------------------------
# decisions


def _factor(stack: _Stack, light: Light, pose: CameraPose) -> SkyFactor:
    """Return the factor of the sky in all kept directions.

    In fine pictures every ninth direction is fitted first, and then only those near a direction
    that follows the sky a little; the others are shut.
    """
    from scipy.ndimage import binary_dilation

    grid, width = stack.grid, stack.grid.width
    rays = pose.true_directions(grid.rays().reshape(-1, 3)[stack.kept])
    place = np.flatnonzero(stack.kept)
    thin = int(np.clip(_THIN_DEG / grid.step_deg, 1, _MOST_THIN))
    is_first = ((place // width) % thin == thin // 2) & ((place % width) % thin == thin // 2)
    first = np.flatnonzero(is_first)
    light_first, usable_first = stack.luminance_cdm2[:, first], stack.usable[:, first]
    seen = seen_sky(light_first, usable_first, light, rays[first])
    factor = sky_factor(light_first, usable_first, light, rays[first], seen)
    if thin == 1:
        return factor
    follows = np.zeros(grid.height * width, bool)
    follows[place[first]] = (factor.through > 0.25 * LEAST_THROUGH) & (
        factor.through > 0.5 * _LEAST_SHARE * factor.ratio
    )
    size = 4 * thin + 1
    near = binary_dilation(follows.reshape(grid.height, width), np.ones((size, size)))
    some = np.flatnonzero(near.ravel()[stack.kept])
    fine = sky_factor(stack.luminance_cdm2[:, some], stack.usable[:, some], light, rays[some], seen)
    shut = SkyFactor(*np.zeros((len(fields(SkyFactor)), len(rays))))
    shut.count[:] = stack.usable.sum(axis=0)
    for part in fields(SkyFactor):
        getattr(shut, part.name)[some] = getattr(fine, part.name)
    shut.through[shut.count == 0] = np.nan
    return shut


def _decided(stack: _Stack, factor: SkyFactor, captures: int) -> SkyView:
    """Return openness, transmittance and bounds from the sky's factor in each direction."""
    grid = stack.grid

    def placed(values: Floats) -> Floats:
        out = np.full(grid.height * grid.width, np.nan)
        out[stack.kept] = values
        return out.reshape(grid.height, grid.width)

    through, u = placed(factor.through), placed(factor.u)
    ratio, behind = placed(factor.ratio), placed(factor.behind)
    least_ratio = placed(factor.least_ratio)
    u = np.hypot(u, SCALE_SD * through)
    sky = (through > _SIGMAS * u) & (through > _LEAST_SHARE * ratio)
    sky &= (through > LEAST_THROUGH) | (through > _PURE_SHARE * ratio)
    pane = pane_transmittance(through, sky, grid.step_deg)  # [h, w]
    low = np.where(sky, np.maximum(through - 2.0 * u, 0.0), 0.0)
    high = np.where(sky | (through + 2.0 * u > LEAST_THROUGH), through + 2.0 * u, 0.0)
    scatters = (behind > _SCATTERS) & (least_ratio > _SCATTER_RATIO)
    scatters &= through < _PURE_SHARE * ratio
    low = np.where(scatters, 0.0, low)
    high = np.where(scatters, np.maximum(high, ratio), high)
    high = np.minimum(high, 1.0)
    few = captures < LEAST_CAPTURES
    if few:
        low, high = np.zeros_like(low), np.minimum(np.maximum(high, ratio), 1.0)
    bright = np.nan_to_num(ratio) > _BRIGHT_RATIO
    if not sky.any():  # nothing follows the sky clearly: what is as bright as sky is not decided
        high = np.where(bright, np.minimum(np.maximum(high, 1.3 * ratio), 1.0), high)
    blind = np.isnan(through)
    openness = np.where(sky, np.clip(through / pane, 0.0, 1.0), 0.0)

    def channel(values: Floats) -> Floats32:
        return np.where(blind, np.nan, values).astype(np.float32)

    notes = _notes(grid, sky, bright, scatters, captures)
    return SkyView(
        grid,
        channel(openness),
        channel(np.minimum(u / pane, 1.0)),
        placed(factor.count).astype(np.float32),
        channel(pane),
        channel(low),
        channel(high),
        captures,
        notes=notes,
    )


def _notes(
    grid: SkyGrid, sky: Mask, bright: Mask, scatters: Mask, captures: int
) -> tuple[str, ...]:
    notes = []
    if captures < LEAST_CAPTURES:
        notes.append(
            f"{captures} captures do not show where the sky is (at least {LEAST_CAPTURES}): the "
            "sun's disc has bounds only; capture overcast and clear hours"
        )
    if not sky.any() and bright.any():
        notes.append(
            "no direction follows the sky clearly, although some are as bright as sky behind "
            "glass: whether the sun is seen there is not known; capture overcast hours, or an hour "
            "with the sun in the window"
        )
    elif not sky.any():
        notes.append("the camera sees no sky: no hour shows the sun's disc")
    weight = np.cos(np.radians(grid.altitudes_deg))[:, None]
    share = (scatters * weight).sum() / max(((sky | scatters) * weight).sum(), 1e-9)
    if share > 0.05:
        notes.append(
            f"{100 * share:.0f} % of the glazing scatters (a curtain, fabric, leaves): how much of "
            "the disc passes is between 0 and its brightness; a capture with the sun behind it "
            "settles it"
        )
    return tuple(notes)


def _with_dark(view: SkyView, stack: _Stack, seen: Callable[[Floats], Mask]) -> SkyView:
    """Return the view with pixels shut that a lens saw but merge did not store as possible sky."""
    absent = ~stack.kept.reshape(view.grid.height, view.grid.width)
    rays = view.grid.rays()[absent]
    dark = absent.copy()
    dark[absent] = seen(rays) if len(rays) else False

    def shut(values: Floats32, value: float) -> Floats32:
        return np.where(dark, np.float32(value), values)

    return replace(
        view,
        openness=shut(view.openness, 0.0),
        u=shut(view.u, 0.0),
        count=shut(view.count, view.captures),
        transmittance=shut(view.transmittance, 0.0),
        low=shut(view.low, 0.0),
        high=shut(view.high, 0.0),
    )


# ----------------------------------------------------------------------------------------------
# captured discs


def _checked(view: SkyView, captured: Captured) -> SkyView:
    """Return the view, corrected where captures show a disc or none; contradictions are named."""
    light, share = captured.light, captured.disc_share
    strong = np.flatnonzero((light.direct_lx > _DISC_LX) & ~np.isnan(share))
    if not len(strong):
        return view
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
    without = _panes_without_disc(view, suns, measured)
    for values in arrays.values():
        values[without] = 0.0
    if both.sum() >= 3:
        gain = float(np.clip(np.median(measured[both] / expected[both]), 0.5, 1.5))
        arrays["transmittance"] = (view.transmittance * gain).astype(np.float32)
        arrays["low"] *= gain
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
    return replace(view, **arrays, notes=view.notes + (note if named else ()))


def _panes_without_disc(view: SkyView, suns: Floats, measured: Floats) -> Mask:
    """Return the scattering panes in which three captures show no disc and none shows one, [h, w].

    suns [n, 3]; measured [n]: share of the beam. A pane that scatters has bounds from 0 on.
    """
    from scipy.ndimage import label

    undecided = (view.low <= 0.0) & (view.high > 0.0)
    panes = np.empty(undecided.shape, np.int32)
    label(undecided, output=panes)
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
