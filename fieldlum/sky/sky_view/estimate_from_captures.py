"""Estimate the sky view from captures: what follows the sky, by pane, and the captured discs.

`sky_directions` finds which directions follow the sky. This module decides what they mean: open
sky, partly open, shut, or undecided, and checks the result with the discs in the captures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask, evenly_spread
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.progress import progress
from fieldlum.core.records import Site, listed
from fieldlum.core.room_states import parse_state
from fieldlum.core.statistics import nan_percentiles
from fieldlum.sky.daylight import Light
from fieldlum.sky.sky_view.measured_discs import MeasuredDiscs
from fieldlum.sky.sky_view.picture import SkyGrid, SkyPicture
from fieldlum.sky.sky_view.pose import CameraPose, pose_of_discs
from fieldlum.sky.sky_view.sky_directions import (
    BEAM_LX,
    MIN_CAPTURES,
    SOME,
    follow,
    sky_reference,
    sky_share,
)
from fieldlum.sky.sky_view.sky_heading import MIN_U_DEG, heading_by_sky
from fieldlum.sky.sky_view.view import SkyView
from fieldlum.sky.sky_view.visible_disc import disc_of_hours
from fieldlum.sky.sun import OBLIQUITY_DEG, SUN_SOLID_ANGLE_SR, celestial_pole
from fieldlum.sky.sun_disc import SUN_RADIUS_RAD

# Sunlight inside a room also follows the sky a little: interior surfaces reach 1.2 % of the sky's
# luminance in the rooms of docs/sky-view.md. Less counts as shut, and as no disc.
_SHUT = 0.02
_OPEN = 0.9  # openness that counts as all open; chosen
# Luminous efficacy (5 %), camera scale (5 %), pyranometer (5 %) and the mean of real skies against
# Perez's (12 %), together; this scale is common to all directions.
_SCALE_SD = 0.2
# Spread of the logarithm of the ratio to the sky, relative to that against other light, below which
# a direction follows the sky, and above which it does not. Sky reaches 0.3, sunlit facades 1.0
# (rooms of docs/sky-view.md).
_FOLLOWS, _FOLLOWS_NOT = 0.5, 1.0
# Shares of the brightest ratio: of a pane at least (interior surfaces reach 0.2 in the rooms of
# docs/sky-view.md, but do not follow the sky; a darker pane has bounds); of what scatters; and of
# what may be sky behind glass. Chosen.
_PANE_SHARE, _SCATTER_SHARE, _BRIGHT_SHARE = 0.05, 0.15, 0.3
# What scatters is brighter by this logarithm with the sun behind it: a curtain by 1.1, a facade by
# less than 0.6.
_FORWARD_SCATTER = 0.6
# Luminance over the expected sky's at the sun's place, below which something hides the sky there:
# real skies are within 40 % of Perez's, a white blind has 0.2 at most. Chosen.
_SHADED = 0.33
_MAX_VALUES = 60_000_000  # captures times directions in memory: 240 MB; chosen


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
        """Return the captures with the indices `rows`, from 0, in that order."""
        index = np.array(rows, int)
        return Captured(self.light[index], lambda k: self.read(index[k]), self.disc_share[index])


def sky_view_of(
    captured: Captured,
    discs: MeasuredDiscs,
    site: Site,
    heading_deg: float,
    seen: Callable[[Floats], Mask] | None = None,
) -> SkyView:
    """Return the sky view of n captures, on the grid [h, w] of the sky.

    Captures with blinds or snow are not used, unless all are so. discs: that merge measured;
    heading_deg: stated azimuth of the pictures' centre column; seen: as of `estimate`. Raises
    NotEnoughDataError without a capture by daylight.
    """
    marks = [parse_state(state) for state in captured.light.states or ()]
    usual = [k for k, parts in enumerate(marks) if all(p.startswith("lamp=") for p in parts)]
    captured = captured.take(usual) if usual else captured
    pose = pose_of_discs(discs, site, heading_deg)
    return estimate(captured, seen, pose, site.latitude_deg)


def estimate(
    captured: Captured,
    seen: Callable[[Floats], Mask] | None = None,
    pose: CameraPose | None = None,
    latitude_deg: float | None = None,
) -> SkyView:
    """Return the sky view of captures of one state of the room.

    seen: returns, for directions [p, 3], whether a lens saw them; where a lens saw a direction, but
    no sky picture has it, merge found it too dark for the sky. pose: of the camera, None for the
    stated heading. latitude_deg: of the room; the sun never reaches some directions. Raises
    NotEnoughDataError without a capture with light.
    """
    lit = np.flatnonzero(captured.light.diffuse_lx > BEAM_LX)
    if not len(lit):
        raise NotEnoughDataError("a sky view needs captures by daylight; none has 1 000 lx outside")
    stack = _stack(captured.take(lit.tolist()), seen)
    decided = _decided(stack, pose or CameraPose(axis_deg=stack.grid.heading_deg), latitude_deg)
    turned = _turned(stack, decided.view)
    if turned is not decided.view.pose:
        decided = _decided(stack, turned, latitude_deg)
    return _checked(_over_seasons(decided, stack), captured)


# ----------------------------------------------------------------------------------------------
# pictures


@dataclass(frozen=True, slots=True)
class _Stack:
    """Pictures of n captures in `light` on one grid, only pixels `kept` that have a value.

    luminance_cdm2 [n, p]: NaN where clipped or not seen. dark [h, w]: pixels that a lens saw, but
    that no picture has.
    """

    grid: SkyGrid
    light: Light
    kept: Mask  # [h, w]
    dark: Mask
    luminance_cdm2: Floats32

    def placed(self, values: Array) -> Floats:
        """Return values [p] on the grid, [h, w], NaN for other pixels."""
        out = np.full(self.kept.shape, np.nan)
        out[self.kept] = values
        return out

    @property
    def columns(self) -> Indices:
        """Column of each pixel in the pictures, flat [h w]."""
        return np.maximum(np.cumsum(self.kept) - 1, 0)


def _stack(captured: Captured, seen: Callable[[Floats], Mask] | None) -> _Stack:
    count = len(captured.light)
    samples = [captured.read(k) for k in sorted({0, count // 2, count - 1})]
    grid = max((picture.grid for picture in samples), key=lambda grid: grid.height * grid.width)
    kept = np.any([np.isfinite(_placed(picture, grid)) for picture in samples], axis=0)
    maximum = max(MIN_CAPTURES, _MAX_VALUES // max(int(kept.sum()), 1))
    rows = evenly_spread(count, maximum).tolist()
    lens = np.zeros(kept.size, bool) if seen is None else seen(grid.rays().reshape(-1, 3))
    in_lens = lens.reshape(kept.shape)
    light = np.empty((len(rows), int(kept.sum())), np.float32)
    for n, k in enumerate(rows):
        progress(n, len(rows), "sky view")
        picture = captured.read(k)
        values = _placed(picture, grid)
        # what merge left out as too dark is between 0 and this: half of it
        values = np.where(np.isnan(values) & in_lens, 0.5 * picture.dark_cdm2, values)
        light[n] = np.where(np.isinf(values), np.nan, values)[kept]
    return _Stack(grid, captured.light[rows], kept, in_lens & ~kept, light)


def _placed(picture: SkyPicture, grid: SkyGrid) -> Floats32:
    """Return a picture's luminance on a grid: NaN not seen, infinite clipped."""
    shown = np.where(picture.clipped, np.float32(np.inf), picture.luminance_cdm2)
    if picture.grid == grid:
        return shown
    i, j = (np.floor(at).astype(int) for at in picture.grid.pixels(grid.rays()))
    inside = (i >= 0) & (i < shown.shape[0]) & (j < shown.shape[1])
    return np.where(inside, shown[np.where(inside, i, 0), np.where(inside, j, 0)], np.nan)


# ----------------------------------------------------------------------------------------------
# decisions


@dataclass(frozen=True, slots=True)
class _Decided:
    """A sky view before the discs in captures, and directions that it does not decide [h, w].

    sky: follows the sky; bright: follows neither the sky nor other light; scatters: a curtain;
    changes: open in one season and shut in another, None before seasons are compared.
    """

    view: SkyView
    sky: Mask
    bright: Mask
    scatters: Mask
    changes: Mask | None = None


def _decided(stack: _Stack, pose: CameraPose, latitude_deg: float | None) -> _Decided:
    """Return openness, transmittance and bounds in each direction."""
    luminance, light, step_deg = stack.luminance_cdm2, stack.light, stack.grid.step_deg
    rays = pose.true_directions(stack.grid.rays()[stack.kept])
    reference = sky_reference(luminance, light, rays)
    seen = follow(luminance, light, rays, reference)
    ratio, spread = stack.placed(seen.ratio), stack.placed(seen.spread)
    relative = ratio / reference.brightest  # NaN if nothing follows the sky
    sky = (spread < _FOLLOWS) & (relative > _PANE_SHARE)
    pane = np.minimum(pane_transmittance(ratio, sky, step_deg), 1.0)  # [h, w]
    openness, u = np.where(sky, np.clip(ratio / pane, 0.0, 1.0), 0.0), np.zeros(sky.shape)
    mixed = _near(sky) & ~np.isnan(ratio) & (openness < _OPEN)
    shut = stack.kept & ~_near(sky)
    if mixed.any() and shut.any():
        at, front = stack.columns[mixed.ravel()], stack.columns[_nearest(shut)[mixed]]
        open_sky = reference.sky(light, rays[at]) * pane[mixed].astype(np.float32)
        openness[mixed], u[mixed] = sky_share(luminance[:, at], open_sky, luminance[:, front])
    openness[openness < _SHUT] = 0.0
    low, high = _bounds(openness, u, mixed, pane, step_deg)
    apart = ~sky & ~mixed & (stack.placed(_sun_passes(rays, latitude_deg, pose)) > 0.0)
    scatters = apart & (stack.placed(seen.forward) > _FORWARD_SCATTER) & (relative > _SCATTER_SHARE)
    bright = apart & (relative > _BRIGHT_SHARE) & (spread < _FOLLOWS_NOT)
    bright |= np.isnan(relative) & (ratio > _BRIGHT_SHARE)
    few = stack.placed(seen.count) < MIN_CAPTURES
    low = np.where(few, 0.0, low)
    high = np.where(scatters | bright | few, np.clip(1.3 * ratio, high, 1.0), high)
    u = np.minimum(np.hypot(u, _SCALE_SD * openness), 1.0)
    count = np.where(stack.dark, len(light), stack.placed(seen.count))
    blind = np.isnan(ratio) & ~stack.dark

    def channel(values: Floats) -> Floats32:
        return np.where(blind, np.nan, values).astype(np.float32)

    view = SkyView(
        stack.grid,
        openness=channel(openness),
        u=channel(u),
        count=channel(count),
        transmittance=channel(np.where(stack.dark, 0.0, pane)),
        low=channel(low),
        high=channel(high),
        captures=len(light),
        pose=pose,
    )
    return _Decided(view, sky, bright, scatters)


def _over_seasons(decided: _Decided, stack: _Stack) -> _Decided:
    """Return the view with wider bounds where sky of one season is dark in another, as by leaves.

    No capture shows when leaves come and fall: bounds there are from no disc to that of open sky.
    """
    view, light = decided.view, stack.light
    # four parts of the year, centred on solstices (0 is 21 December) and equinoxes
    season = np.array([round((t.timetuple().tm_yday + 10) / 91.3) % 4 for t in light.t_utc])
    parts = [np.flatnonzero(season == k) for k in np.unique(season)]
    parts = [rows for rows in parts if len(rows) >= MIN_CAPTURES]
    if len(parts) < 2 or not decided.sky.any():
        return decided
    rays = view.pose.true_directions(stack.grid.rays()[stack.kept])
    # real skies of a season are within 40 % of Perez's; indoors is darker than half of a pane's sky
    pane_sky = 0.5 * np.median(view.through[decided.sky])
    by_perez = (
        stack.luminance_cdm2[rows] / np.maximum(light[rows].sky_at(rays), 1e-3) for rows in parts
    )
    quick = np.array([nan_percentiles(ratio, (50.0,))[0] for ratio in by_perez])
    likely = (quick.min(axis=0) < 0.7 * quick.max(axis=0)) & (quick.max(axis=0) > 0.7 * pane_sky)
    sky, darkest = np.zeros(len(rays)), np.full(len(rays), np.inf)
    for rows in parts if likely.any() else ():
        luminance, of_part = stack.luminance_cdm2[rows], light[rows]
        reference = sky_reference(luminance, of_part, rays)
        seen = follow(luminance[:, likely], of_part, rays[likely], reference)
        follows = np.where(seen.spread < _FOLLOWS, seen.ratio, 0.0)
        sky[likely] = np.maximum(sky[likely], follows)
        darkest[likely] = np.minimum(darkest[likely], seen.ratio)
    changes = stack.placed((darkest < 0.5 * sky) & (sky > pane_sky)) > 0.0
    sky = stack.placed(sky)
    low = np.where(changes, np.float32(0.0), view.low)
    high = np.where(changes, np.clip((1.0 + 2.0 * _SCALE_SD) * sky, view.high, 1.0), view.high)
    view = replace(view, low=low, high=high.astype(np.float32))
    return replace(decided, view=view, changes=changes)


def _sun_passes(rays: Floats, latitude_deg: float | None, pose: CameraPose) -> Mask:
    """Return where the sun passes on some day of the year, of directions [p, 3]; True if unknown.

    It stays within the tropics' declination; the camera's heading and level have uncertainties.
    """
    if latitude_deg is None:
        return np.ones(len(rays), bool)
    declination = np.arcsin(np.clip(rays @ celestial_pole(latitude_deg), -1.0, 1.0))
    margin_deg = 1.5 + 2.0 * pose.heading_sd_deg  # half a degree, and two of the level
    return np.abs(declination) < np.radians(OBLIQUITY_DEG + margin_deg)


def _turned(stack: _Stack, view: SkyView) -> CameraPose:
    """Return the pose with the heading by the open sky, if discs do not give it better."""
    from scipy.ndimage import binary_erosion

    if view.pose.heading_sd_deg < MIN_U_DEG:
        return view.pose
    inside = int(np.ceil(0.5 / stack.grid.step_deg))  # half a degree from an edge
    open_sky = stack.kept & (view.openness >= _OPEN)
    at = np.flatnonzero(binary_erosion(open_sky, np.ones((3, 3)), iterations=inside))
    at = at[:: max(1, len(at) // SOME)]
    rays = view.pose.true_directions(stack.grid.rays().reshape(-1, 3)[at])
    luminance = stack.luminance_cdm2[:, stack.columns[at]]
    correction = heading_by_sky(luminance, stack.light, rays, view.pose.axis_deg)
    return view.pose if correction is None else view.pose.with_heading(*correction)


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

    pixel_sr = np.radians(step_deg) ** 2
    larger = np.where(mixed, max(1.0, pixel_sr / SUN_SOLID_ANGLE_SR), 1.0)
    around = np.where(mixed, maximum_filter(openness, 3), openness)
    within = np.where(mixed, minimum_filter(openness, 3), openness)
    maximum = np.where(around > 0.0, np.clip((around + 2.0 * u) * larger, 0.0, 1.0), 0.0)
    minimum = 1.0 - np.clip((1.0 - within + 2.0 * u) * larger, 0.0, 1.0)
    high = np.minimum(maximum * pane * (1.0 + 2.0 * _SCALE_SD), 1.0)
    return minimum * pane * (1.0 - 2.0 * _SCALE_SD), high


def _notes(decided: _Decided) -> tuple[str, ...]:
    sky, scatters, captures = decided.sky, decided.scatters, decided.view.captures
    notes = []
    if captures < MIN_CAPTURES:
        notes.append(
            f"{captures} captures do not show where the sky is (at least {MIN_CAPTURES}): the "
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
    if decided.changes is not None:
        share = (decided.changes * weight).sum() / max((sky * weight).sum(), 1e-9)
        if share > 0.02:
            notes.append(
                f"{100 * share:.0f} % of the sky in view is open in one season and hidden in "
                "another (leaves): whether the sun's disc is seen there is not known, all year"
            )
    return tuple(notes)


# ----------------------------------------------------------------------------------------------
# captured discs


def _checked(decided: _Decided, captured: Captured) -> SkyView:
    """Return the view, corrected where captures show a disc or none; contradictions are named."""
    view, share, direct_lx = decided.view, captured.disc_share, captured.light.direct_lx
    strong = np.flatnonzero((direct_lx > BEAM_LX) & ~np.isnan(share))
    light, measured = captured.light[strong], share[strong]
    shaded = _shaded(view, captured.take(strong.tolist()))
    suns = view.pose.in_pictures(light.apparent_sun_direction)
    without = _panes_without_disc(view, decided.scatters, suns, measured)
    names = ("openness", "transmittance", "low", "high")
    arrays = {name: getattr(view, name).copy() for name in names}
    for name in ("openness", "low", "high"):
        arrays[name][without] = 0.0
    disc = disc_of_hours(view, light)
    sure = (measured > _SHUT) & (disc.low_lx > 0.5 * disc.best_lx) & (disc.best_lx > 0.0)
    if sure.sum() >= 3:
        beam_lx = light.direct_lx[sure]
        ratio = measured[sure] * beam_lx / disc.best_lx[sure]
        # strong beams: a weak one's efficacy is uncertain, and it causes little glare
        gain = np.quantile(ratio, 0.5, weights=beam_lx, method="inverted_cdf")
        for name in names[1:]:
            arrays[name] = np.minimum(arrays[name] * np.clip(gain, 0.5, 1.5), 1.0, dtype=np.float32)
    when = [f"{t:%Y-%m-%d %H:%M} UTC" for t in light.t_utc]
    wrong = _correct(arrays, view, suns, np.where(shaded, np.nan, measured))
    notes = _notes(replace(decided, scatters=decided.scatters & ~without)) + view.pose.notes
    if wrong:
        named = [f"{when[k]} ({what} captured)" for k, what in wrong]
        notes += (
            f"{len(named)} captures contradict the sky view, which was corrected there: "
            f"{listed(named, 3)}; check the heading and the clock",
        )
    if shaded.any():
        named = [when[k] for k in np.flatnonzero(shaded)]
        notes += (
            f"{len(named)} captures are dark at the sun's place, where others show sky: "
            f"{listed(named, 3)}; a blind was probably down: mark it (fieldlum status --mark)",
        )
    return replace(view, **arrays, notes=notes)


def _shaded(view: SkyView, captured: Captured) -> Mask:
    """Return the captures without a disc that are dark at the sun's place, where the view is open.

    What hides the disc there is not permanent, as a blind that nobody marked: [n].
    """
    shaded = captured.disc_share < _SHUT
    shaded &= disc_of_hours(view, captured.light).low_lx > _SHUT * captured.light.direct_lx
    for k in np.flatnonzero(shaded).tolist():
        sun = captured.light[[k]].apparent_sun_direction
        row, column = (int(at[0]) for at in view.grid.pixels(view.pose.in_pictures(sun)))
        shown = np.nan_to_num(_placed(captured.read(k), view.grid)[row, column])  # NaN: too dark
        sky_cdm2 = captured.light[[k]].sky_at(sun)[0, 0]
        shaded[k] = shown < _SHADED * view.transmittance[row, column] * sky_cdm2
    return shaded


def _correct(
    arrays: dict[str, Floats32], view: SkyView, suns: Floats, measured: Floats
) -> list[tuple[int, str]]:
    """Correct `arrays` where captures contradict the view; return their index and what they show.

    suns [n, 3]; measured [n]: share of the beam.
    """
    rays, wrong = view.grid.rays(), []
    disc_deg = np.degrees(SUN_RADIUS_RAD) + 0.5 * view.grid.step_deg
    for k, (sun, share) in enumerate(zip(suns, measured, strict=True)):
        off_deg = np.degrees(np.arccos(np.clip(rays @ sun, -1.0, 1.0)))
        near, at = off_deg <= disc_deg + view.pose.heading_sd_deg, off_deg <= disc_deg
        if not at.any() or np.isnan(view.low[near]).any():
            continue
        missed = share > _SHUT >= view.high[near].max()
        if missed or share < _SHUT < view.low[near].min():
            pane = np.maximum(np.nan_to_num(view.transmittance[at]), _SHUT)
            arrays["openness"][at] = np.clip(share / pane, 0.0, 1.0)
            bounds = missed * np.minimum((0.8 * share, 1.2 * share), 1.0)
            arrays["low"][at], arrays["high"][at] = bounds
            wrong.append((k, "a disc" if missed else "no disc"))
    return wrong


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
    shown = measured[inside] > _SHUT
    hidden = [k for k in np.unique(at[at > 0]) if (at == k).sum() >= 3 and not shown[at == k].any()]
    return np.isin(panes, hidden)


# ----------------------------------------------------------------------------------------------
# panes

# A pane this small takes the transmittance of the nearest larger one: gaps between leaves and slats
# are not panes. A pane of 40 cm at 8 m has 8 square degrees. Chosen.
_MIN_PANE_DEG2 = 8.0
# Transmittance changes by 5 % in 10 degrees at 60 degrees of incidence (EN 410).
_SMOOTH_DEG = 5.0
_OPEN_SHARE = 0.75  # of the pane's bright tenth: less is a partly open pixel; chosen


def pane_transmittance(through: Floats, sky: Mask, step_deg: float) -> Floats:
    """Return the transmittance of the pane in each direction, [h, w].

    through: openness times transmittance, which is the result if no pane is large enough; sky: mask
    of the directions that follow the sky; step_deg: size of a pixel. Connected directions are one
    pane.
    """
    from scipy.ndimage import gaussian_filter, label

    labels = np.empty(sky.shape, np.int32)
    count = int(label(sky, np.ones((3, 3)), output=labels))  # pyright: ignore[reportArgumentType]
    level = np.where(sky, through, 0.0)
    sizes = np.bincount(labels.ravel(), minlength=count + 1) * step_deg**2
    large = np.flatnonzero(sizes >= _MIN_PANE_DEG2)
    large = large[large > 0]
    if not len(large):
        return np.maximum(np.nan_to_num(through), 1e-6)
    for pane in large:
        inside = labels == pane
        bright = float(np.quantile(through[inside], 0.9))
        open_ = inside & (through >= _OPEN_SHARE * bright)
        sigma = _SMOOTH_DEG / step_deg
        weight = gaussian_filter(open_.astype(float), sigma, truncate=3.0)
        mean = gaussian_filter(np.where(open_, through, 0.0), sigma, truncate=3.0)
        smooth = np.where(weight > 1e-6, mean / np.maximum(weight, 1e-9), bright)
        level[inside] = np.maximum(smooth, _OPEN_SHARE * bright)[inside]
    of_large = np.isin(labels, large)
    nearest = _nearest(of_large)
    far = np.hypot(*(np.unravel_index(nearest, sky.shape) - np.indices(sky.shape)))
    near = ~of_large & (far * step_deg <= _SMOOTH_DEG)
    own = np.maximum(np.nan_to_num(through), 1e-6)
    return np.where(of_large, level, np.where(near, np.maximum(level.flat[nearest], own), own))
