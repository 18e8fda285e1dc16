"""Estimate the sky view from captures: what follows the sky, by pane, and the captured discs.

`sky_directions` finds which directions follow the sky. This module decides what they mean: open
sky, partly open, shut, or undecided, and checks the result with the discs in the captures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from datetime import date, datetime
from typing import Any

import numpy as np
from scipy import ndimage

from fieldlum.core import room_states, statistics
from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask, evenly_spread
from fieldlum.core.errors import NotEnoughDataError
from fieldlum.core.progress import progress
from fieldlum.core.records import Site, counted, listed
from fieldlum.sky import perez, sun_disc
from fieldlum.sky.daylight import Light
from fieldlum.sky.sky_view import sky_directions, sky_heading
from fieldlum.sky.sky_view.measured_discs import MIN_DISCS, MeasuredDiscs
from fieldlum.sky.sky_view.picture import SkyGrid, SkyPicture
from fieldlum.sky.sky_view.pose import CameraPose, pose_of_discs
from fieldlum.sky.sky_view.sky_directions import BEAM_LX, MIN_CAPTURES, Followed, SkyReference
from fieldlum.sky.sky_view.view import LENS_PIXEL_DEG, REACH_DAYS, SkyView, between, undecided_u
from fieldlum.sky.sky_view.visible_disc import CLEAR_GLASS, disc_of_hours, efficacy_u
from fieldlum.sky.sun import OBLIQUITY_DEG, SUN_SOLID_ANGLE_SR, celestial_pole

# Sunlight inside a room also follows the sky a little: interior surfaces reach 1.2 % of the sky's
# luminance in the rooms of docs/sky-view.md. Less counts as shut, and as no disc.
_SHUT = 0.02
_OPEN = 0.9  # openness that counts as all open; chosen
# Luminous efficacy (5 %), camera scale (5 %), pyranometer (5 %) and the mean of real skies against
# Perez's (12 %), together; this scale is common to all directions.
_SCALE_SD = 0.2
_DISC_U = 0.15  # of a captured disc over that of the view, by edges and the beam; chosen
# Spread of the logarithm of the ratio to the sky, relative to that against other light, below which
# a direction follows the sky, and above which it does not. Sky reaches 0.3, sunlit facades 1.0
# (rooms of docs/sky-view.md).
_FOLLOWS, _FOLLOWS_NOT = 0.5, 1.0
# With so many captures the limits for what may be sky are twice those with very many
# (docs/validation.md). Chosen.
_FEW_CAPTURES = 12
# Shares of the brightest ratio: of a pane at least (interior surfaces reach 0.2 in the rooms of
# docs/sky-view.md, but do not follow the sky; a darker pane has bounds); of what scatters; and of
# what may be sky behind glass. Chosen.
_PANE_SHARE, _SCATTER_SHARE, _BRIGHT_SHARE = 0.05, 0.15, 0.3
# The same for what may be sky if no clear capture has the sun in front of the window: a sunlit
# facade then follows the sky as well as sky does. Chosen by draws of such captures in nine rooms
# (`python bench/sky_view_rooms.py OUT ROOM.toml ... --draws 2`).
_DIM_SHARE = 0.1
# What scatters is brighter by this logarithm with the sun behind it: a curtain by 1.1, a facade by
# less than 0.6.
_FORWARD_SCATTER = 0.6
# Luminance over the expected sky's at the sun's place, below which something hides the sky there:
# real skies are within 40 % of Perez's, a white blind has 0.2 at most. Chosen.
_SHADED, _HALF_SHADED = 0.33, 0.6
# Shares of the sky in view: so dark that a capture is through a blind; and worth a note. Chosen.
_COVERED_SHARE, _SOME_SKY = 0.2, 0.02
_BEFORE_YEAR = date(2026, 12, 31).toordinal()  # the day before a year without a leap day
# Of the sky's luminance, in the window: more passes no opening, whatever the errors above; less is
# darker than electrochromic glass, and 1/179 is what W/sr/m2 taken for cd/m2 give. Chosen. A window
# is 13 to 79 times as bright as the median of the picture in 22 rooms of other renderers, and other
# surfaces up to 4 times: below it the camera sees no window.
_TOO_BRIGHT, _TOO_DARK, _WINDOW_CONTRAST = 1.4, 0.01, 8.0
_CLEAR_GLASS = 0.3  # less is that of tinted glass: below half of EN 410's 0.7 for clear panes
_OF_SEASON = 12  # captures of a season that decide its leaves; fewer widen the bounds; chosen
_BRACKET_S = 300.0  # a disc's frame is within this of its capture's time; chosen
_MAX_VALUES = 60_000_000  # captures times directions in memory: 240 MB; chosen


@dataclass(frozen=True, slots=True)
class Captured:
    """What n captures give: the light outside, how to read the pictures, and the measured discs.

    read: returns the sky picture of a capture by its index. disc_share [n]: illuminance of the disc
    over that of the beam; 0 where the picture shows no disc, NaN where its size is not known.
    elsewhere_cdm2 [n, 2305]: luminance in `reinhart_patches`, NaN where not seen, if pictures have
    only a part of the sky.
    """

    light: Light
    read: Callable[[int], SkyPicture]
    disc_share: Floats
    elsewhere_cdm2: Floats32 | None = None

    def take(self, rows: Sequence[int]) -> Captured:
        """Return the captures with the indices `rows`, from 0, in that order."""
        index = np.array(rows, int)
        return Captured(
            self.light[index],
            lambda k: self.read(index[k]),
            self.disc_share[index],
            None if self.elsewhere_cdm2 is None else self.elsewhere_cdm2[index],
        )


def sky_view_of(
    captured: Captured,
    discs: MeasuredDiscs,
    site: Site,
    heading_deg: float,
    seen: Callable[[Floats], Mask] | None = None,
) -> SkyView:
    """Return the sky view of captures, with one for each state of blinds and tint.

    Captures with snow or use=no are not used, unless all captures by daylight have it. Without a
    capture of the usual state, the most frequent state is the main view. discs: those that merge
    measured;
    heading_deg: stated azimuth of the pictures' centre column, clockwise from north; seen: returns
    a mask [p] of the directions [p, 3] that a lens saw. Raises NotEnoughDataError without a capture
    by daylight, which is over 1 000 lx of diffuse light.
    """
    states = captured.light.states or ("",) * len(captured.light)
    lit = np.flatnonzero(captured.light.diffuse_lx > BEAM_LX).tolist()
    if not lit:
        raise NotEnoughDataError("a sky view needs captures by daylight; none has 1 000 lx outside")
    by_state: dict[str, list[int]] = {}
    left_out = {"snow=yes", "use=no"}
    for k in [k for k in lit if left_out.isdisjoint(room_states.parse_state(states[k]))] or lit:
        by_state.setdefault(room_states.cover_state(states[k]), []).append(k)
    captured = replace(captured, light=replace(captured.light, states=None))
    first = "" if "" in by_state else max(by_state, key=lambda state: len(by_state[state]))
    pose = pose_of_discs(partly_hidden(discs, captured), site, heading_deg)
    rows = by_state.pop(first)
    main = estimate(captured.take(rows), seen, pose, site.latitude_deg, is_marked=bool(first))
    views, notes = [*main.others], [*main.notes]
    for state, rows in sorted(by_state.items()):
        text = f"{state}: {counted(len(rows), 'capture')}"
        if len(rows) < MIN_CAPTURES:
            notes.append(f"{text}, too few for a view of its own (at least {MIN_CAPTURES})")
            continue
        view = estimate(captured.take(rows), seen, main.pose, site.latitude_deg, main)
        view = view.where(~np.isnan(view.low), replace(main, low=0.0 * main.low))
        views += [replace(each, state=state, others=()) for each in (view, *view.others)]
        more = [note for note in view.notes if note not in main.pose.notes]
        notes.append("; ".join([f"{text} have a view of their own", *more]))
    return replace(main, state=first, others=tuple(views), notes=tuple(notes))


def partly_hidden(discs: MeasuredDiscs, captured: Captured) -> MeasuredDiscs:
    """Return the discs with a larger uncertainty where an edge hides a part of the disc.

    captured: the captures, with the share of the beam that each disc has. An edge that hides a
    share h of the disc moves the centre of the visible part by 0.85 to 0.93 h of the radius. Of
    three discs or more the brightest is taken as not hidden; with fewer, the glass is taken as
    clear.
    """
    if not len(discs):
        return discs
    captures_s = np.array([t.timestamp() for t in captured.light.t_utc])
    discs_s = np.array([t.timestamp() for t in discs.t_utc])
    apart_s = np.abs(discs_s[:, None] - captures_s)  # [discs, captures]
    shares = np.nan_to_num(captured.disc_share)[apart_s.argmin(axis=1)]
    measured = (apart_s.min(axis=1) < _BRACKET_S) & (shares > 0.0)
    # share of the beam that a disc in full view has behind the pane
    full = CLEAR_GLASS if measured.sum() < MIN_DISCS else min(shares[measured].max(), CLEAR_GLASS)
    hidden = np.where(measured, np.clip(1.0 - shares / full, 0.0, 1.0), 0.0)
    moved_deg = 0.87 * np.degrees(sun_disc.SUN_RADIUS_RAD) * hidden
    return replace(discs, sigma_deg=np.hypot(discs.sigma_deg, moved_deg))


def estimate(
    captured: Captured,
    seen: Callable[[Floats], Mask] | None = None,
    pose: CameraPose | None = None,
    latitude_deg: float | None = None,
    usual: SkyView | None = None,
    is_marked: bool = False,
) -> SkyView:
    """Return the sky view of captures by daylight in one state of the room, with its seasons.

    seen: returns a mask [p] of the directions [p, 3] that a lens saw; where a lens saw a direction,
    but no sky picture has it, merge found it too dark for the sky. pose: of the camera, None for
    the stated heading. latitude_deg: of the room, which limits the directions that the sun reaches;
    None if unknown. usual: the view of the usual state, with the same pose, if the captures are of
    another state. is_marked: whether their state is that of a marked blind or tint.
    """
    sure_usual = usual is not None and bool(np.nanmax(usual.low, initial=0.0) > 0.0)
    is_sure = is_marked or sure_usual or bool((captured.disc_share > _SHUT).any())
    stack = _stack(captured, seen, usual)
    stack = replace(stack, latitude_deg=latitude_deg, is_sure=is_sure)
    pose = pose or CameraPose(axis_deg=stack.grid.heading_deg)
    covered = np.zeros(len(stack.light), bool) if usual else _covered(stack, pose)
    rest = np.setdiff1d(np.arange(len(captured.light)), stack.rows[covered])
    covered_utc = stack.light[covered].t_utc
    stack = stack.take(np.flatnonzero(~covered)) if covered.any() else stack
    decided = _decided(stack, pose)
    if usual is None and (turned := _turned(stack, decided.view)) is not pose:
        decided = _decided(stack, turned)
    decided = _over_seasons(decided, stack)
    view = _corrected_by_discs(decided, captured.take(rest.tolist()), covered_utc)
    if usual is not None:  # a marked blind or tint is darker than glass
        return view
    return replace(view, notes=(*_notes_on_level(decided.reference.brightest, stack), *view.notes))


# ----------------------------------------------------------------------------------------------
# pictures


@dataclass(frozen=True, slots=True)
class _Stack:
    """Pictures of n captures on one grid: luminances of the p pixels that have a value.

    light: outside at the n captures; rows [n]: their indices in `Captured`; kept [h, w]: the p
    pixels. luminance_cdm2 [n, p]: NaN where clipped or not seen. dark [h, w]: pixels that a lens
    saw, but that no picture has, because they are too dark; usually [h, w]: upper bound of the
    beam's share in the usual state of the room, 0 if the pictures are of that state. elsewhere_cdm2
    [n, m]: luminance in parts of the sphere that no picture has, at the patches `elsewhere` [m] of
    `reinhart_patches`. latitude_deg: of the place, None if the sun's path is not to be used.
    is_sure: whether a capture shows the sun's disc, the usual view is sure, or a tint or blind is
    marked.
    """

    grid: SkyGrid
    light: Light
    rows: Indices
    kept: Mask
    dark: Mask
    usually: Floats
    luminance_cdm2: Floats32
    elsewhere: Indices
    elsewhere_cdm2: Floats32
    latitude_deg: float | None = None
    is_sure: bool = True

    def placed(self, values: Array) -> Floats:
        """Return values [p] on the grid, [h, w], NaN for other pixels."""
        out = np.full(self.kept.shape, np.nan)
        out[self.kept] = values
        return out

    def take(self, index: Indices) -> _Stack:
        """Return the pictures of the captures with some indices, from 0."""
        names = ("light", "rows", "luminance_cdm2", "elsewhere_cdm2")
        return replace(self, **{name: getattr(self, name)[index] for name in names})

    @property
    def columns(self) -> Indices:
        """Column of each pixel of the grid in `luminance_cdm2`, [h w]; of others any column."""
        return np.maximum(np.cumsum(self.kept) - 1, 0)


def _stack(
    captured: Captured, seen: Callable[[Floats], Mask] | None, usual: SkyView | None
) -> _Stack:
    """Return the captures' pictures on one grid; of more than fit in memory, evenly spread ones.

    The grid is that of `usual`, the view of the room's usual state, or else the largest of three
    pictures (first, middle, last). A pixel is kept if one of these three has its value. seen: as of
    `estimate`, None if it is unknown what a lens saw.
    """
    count = len(captured.light)
    samples = [captured.read(k) for k in sorted({0, count // 2, count - 1})]
    largest = max((picture.grid for picture in samples), key=lambda grid: grid.height * grid.width)
    grid = usual.grid if usual else largest
    kept = np.any([np.isfinite(_placed(picture, grid)) for picture in samples], axis=0)
    maximum = max(MIN_CAPTURES, _MAX_VALUES // max(int(kept.sum()), 1))
    rows = evenly_spread(count, maximum)
    lens = np.zeros(kept.size, bool) if seen is None else seen(grid.rays().reshape(-1, 3))
    in_lens = lens.reshape(kept.shape)
    luminance = np.empty((len(rows), int(kept.sum())), np.float32)
    for n, k in enumerate(rows.tolist()):
        progress(n, len(rows), "sky view")
        picture = captured.read(k)
        values = _placed(picture, grid)
        # what merge left out as too dark is between 0 and dark_cdm2: take the middle
        values = np.where(np.isnan(values) & in_lens, 0.5 * picture.dark_cdm2, values)
        luminance[n] = np.where(np.isinf(values), np.nan, values)[kept]  # infinite: clipped
    usually = np.zeros(kept.shape) if usual is None else np.nan_to_num(usual.high)
    inside, row, column = grid.indices(perez.reinhart_patches().directions)
    other = np.flatnonzero(~inside | ~kept[row, column])
    if captured.elsewhere_cdm2 is None:
        other = other[:0]
        other_cdm2 = np.empty((len(rows), 0), np.float32)
    else:
        other_cdm2 = captured.elsewhere_cdm2[rows][:, other]
    dark = in_lens & ~kept
    light = captured.light[rows]
    return _Stack(grid, light, rows, kept, dark, usually, luminance, other, other_cdm2)


def _placed(picture: SkyPicture, grid: SkyGrid) -> Floats32:
    """Return a picture's luminance on a grid, [h, w]; NaN if not seen, infinite if clipped."""
    shown = np.where(picture.clipped, np.float32(np.inf), picture.luminance_cdm2)
    if picture.grid == grid:
        return shown
    inside, row, column = picture.grid.indices(grid.rays())
    return np.where(inside, shown[row, column], np.nan)


# ----------------------------------------------------------------------------------------------
# decisions


@dataclass(frozen=True, slots=True)
class _Decided:
    """A sky view before it is compared with captured discs, and how it came about.

    Masks [h, w] of directions: sky, whose luminance follows the sky's; bright, which may be sky but
    follow it no better than other light; scatters, behind a curtain or fabric; changes, open in one
    season and shut in another (None before seasons are compared). reference: the sky in view;
    is_behind: whether no clear capture has the sun in front of most of the window; seasons: views
    that hold only near their days.
    """

    view: SkyView
    sky: Mask
    bright: Mask
    scatters: Mask
    reference: SkyReference
    is_behind: bool
    changes: Mask | None = None
    seasons: tuple[SkyView, ...] = ()


def _decided(stack: _Stack, pose: CameraPose, reference: SkyReference | None = None) -> _Decided:
    """Return the view that the pictures give: openness, transmittance and bounds by direction.

    pose: of the camera; reference: the sky that is in view, None to find it in the pictures.
    """
    rays = pose.true_directions(stack.grid.rays()[stack.kept])  # [p, 3]
    reference = reference or _reference(stack, rays, pose)
    by_pixel = sky_directions.follow(stack.luminance_cdm2, stack.light, rays, reference)  # [p]
    followed = Followed(*map(stack.placed, astuple(by_pixel)))  # [h, w]
    ratio, brightest = followed.ratio, reference.brightest  # NaN brightest: nothing follows the sky
    sky = (followed.spread < _FOLLOWS) & (ratio / brightest > _PANE_SHARE)
    pane = np.minimum(pane_transmittance(ratio, sky, stack.grid.step_deg), 1.0)
    openness, u, mixed = _openness(stack, rays, reference, ratio, sky, pane)
    low, high = _bounds(openness, u, mixed, pane, stack.grid.step_deg)
    passes = stack.placed(_sun_passes(rays, stack.latitude_deg, pose)) > 0.0
    apart = ~sky & ~mixed & passes
    # slats that are finer than a pixel show a disc at some heights of the sun: until there is more
    # evidence, between none and the disc without them
    slats = apart & (stack.usually > 0.0) & (ratio > _PANE_SHARE)
    high = np.where(slats, np.maximum(high, stack.usually), high)
    doubt = 1.0 + _FEW_CAPTURES / np.maximum(followed.count, 1.0)  # 1 with very many captures
    scatters, bright = _undecided(followed, brightest, apart & ~slats, doubt)
    dim = ratio > _DIM_SHARE * np.fmin(brightest, 1.0)
    is_behind = _sun_is_behind(stack.light, rays[((sky | dim) & passes)[stack.kept]])
    bright |= apart & ~slats & dim & is_behind
    few = followed.count < MIN_CAPTURES
    undecided = scatters | bright | few
    if brightest < _CLEAR_GLASS and not stack.is_sure:  # a facade can follow the sky as well
        undecided |= sky | mixed
        low, openness = np.zeros_like(low), np.where(undecided, 0.0, openness)
    widest = np.clip(1.3 * doubt * ratio, high, 1.0)  # with a margin of 30 %
    low, high = np.where(few | is_behind, 0.0, low), np.where(undecided, widest, high)
    u = np.where(undecided | slats, np.fmax(u, undecided_u(high - low, pane)), u)
    channels: dict[str, Any] = {
        "openness": openness,
        "u": np.minimum(np.hypot(u, _SCALE_SD * openness), 1.0),
        "count": np.where(stack.dark, len(stack.light), followed.count),
        "transmittance": np.where(stack.dark, 0.0, pane),
        "low": low,
        "high": high,
    }
    not_seen = np.isnan(ratio) & ~stack.dark
    for name, values in channels.items():
        channels[name] = np.where(not_seen, np.nan, values).astype(np.float32)
    view = SkyView(stack.grid, captures=len(stack.light), pose=pose, **channels)
    return _Decided(view, sky, bright, scatters, reference, is_behind)


def _reference(stack: _Stack, rays: Floats, pose: CameraPose) -> SkyReference:
    """Return the sky in view, by the pictures and by what the panoramas show elsewhere.

    rays: true directions of the pixels kept [p, 3]; pose: of the camera.
    """
    step = max(1, len(rays) // (10 * sky_directions.SOME))  # every step-th direction is enough
    patches = perez.reinhart_patches()
    others = pose.true_directions(patches.directions[stack.elsewhere])
    altitude = np.arcsin(np.clip(rays[::step, 2], -1.0, 1.0))
    size_sr = step * np.radians(stack.grid.step_deg) ** 2
    return sky_directions.sky_reference(
        np.concatenate([stack.luminance_cdm2[:, ::step], stack.elsewhere_cdm2], axis=1),
        stack.light,
        np.concatenate([rays[::step], others]),
        np.concatenate([size_sr * np.cos(altitude), patches.solid_angles_sr[stack.elsewhere]]),
    )


def _openness(
    stack: _Stack, rays: Floats, reference: SkyReference, ratio: Floats, sky: Mask, pane: Floats
) -> tuple[Floats, Floats, Mask]:
    """Return the share of open sky, its standard uncertainty, and the mixed pixels, [h, w] each.

    A mixed pixel shows sky and what is in front of it: its share is fitted to all captures, with
    the nearest opaque pixel as the foreground. rays: true directions of the pixels kept [p, 3];
    ratio: luminance over the sky's; sky: mask of what follows it; pane: transmittance; [h, w] each.
    """
    openness, u = np.where(sky, np.clip(ratio / pane, 0.0, 1.0), 0.0), np.zeros(sky.shape)
    sky_and_edge = np.asarray(ndimage.binary_dilation(sky, np.ones((3, 3))), bool)
    mixed = sky_and_edge & ~np.isnan(ratio) & (openness < _OPEN)
    opaque = stack.kept & ~sky_and_edge
    if mixed.any() and opaque.any():
        at, in_front = stack.columns[mixed.ravel()], stack.columns[_nearest(opaque)[mixed]]
        open_sky = reference.sky(stack.light, rays[at]) * pane[mixed].astype(np.float32)
        shown = sky_directions.away_from_sun(stack.luminance_cdm2[:, at], stack.light, rays[at])
        through = stack.luminance_cdm2[:, in_front]
        openness[mixed], u[mixed] = sky_directions.sky_share(shown, open_sky, through)
    openness[openness < _SHUT] = 0.0
    return openness, u, mixed


def _undecided(
    followed: Followed, brightest: float, apart: Mask, doubt: Floats
) -> tuple[Mask, Mask]:
    """Return masks [h, w] of what scatters, such as a curtain, and of what is bright as sky.

    followed: maps [h, w]; brightest: ratio of the brightest sky, NaN if nothing follows the sky;
    apart: directions that the sun passes and that are neither sky nor mixed [h, w]; doubt: factor
    on the limit for what may be sky, larger with few captures [h, w].
    """
    is_forward = followed.forward > _FORWARD_SCATTER
    scatters = apart & is_forward & (followed.ratio / brightest > _SCATTER_SHARE)
    is_bright = followed.ratio > _BRIGHT_SHARE * min(brightest, 1.0)  # a pane's at most 1
    bright = apart & is_bright & (followed.spread < _FOLLOWS_NOT * doubt)
    if np.isnan(brightest):
        bright |= followed.ratio > _BRIGHT_SHARE
    return scatters, bright


def _sun_is_behind(light: Light, rays: Floats) -> bool:
    """Return whether no clear capture has the sun in front of most of the window.

    light: outside at the captures; rays: directions of the window that the sun reaches [p, 3]. The
    answer is False if less than a quarter of the captures are clear: the spread over all captures
    is robust against so few.
    """
    clear_share = (light.direct_lx > sky_directions.STRONG_BEAM_LX).mean()
    is_lit = sky_directions.sun_in_front(light, rays).any(axis=0)
    return bool(len(rays) and is_lit.mean() < 0.5 and clear_share > 0.25)


def _season(light: Light) -> Indices:
    """Return the quarter of the year, centred on solstices (0: 21 December) and equinoxes, [n]."""
    return np.round((light.day_of_year + 10) / 91.3).astype(int) % 4


def _covered(stack: _Stack, pose: CameraPose) -> Mask:
    """Return a mask [n] of captures in which much more of the sky is dark than usual in the season.

    An unmarked blind or a tint hides it. If three or more captures show it by a luminance below a
    third of the usual, then those below 0.6 of it are in the mask too.
    """
    step = max(1, stack.luminance_cdm2.shape[1] // (4 * sky_directions.SOME))
    rays = pose.true_directions(stack.grid.rays()[stack.kept][::step])
    season, covered = _season(stack.light), np.zeros(len(stack.light), bool)
    for shade in (_SHADED, _HALF_SHADED):
        dark = sky_directions.dark_shares(stack.luminance_cdm2[:, ::step], stack.light, rays, shade)
        usual = np.array([np.median(dark[season == k]) for k in season])
        covered |= dark > usual + _COVERED_SHARE
        if covered.sum() < 3:
            break
    return covered


def _over_seasons(decided: _Decided, stack: _Stack) -> _Decided:
    """Return the view with wider bounds of the beam's share where leaves hide sky in some seasons.

    There sky of one season is dark in another, and no capture shows when leaves come and fall, so
    that the share of the sun's beam that arrives is from 0 (no disc) to that through open sky. A
    season with 12 or more captures also gets a view of its own, in `seasons` of the result, for the
    days around its captures. decided: the view of all captures, whose pictures are `stack`.
    """
    view, season = decided.view, _season(stack.light)
    groups = [np.flatnonzero(season == k) for k in range(4)]  # captures of each season
    groups = [rows for rows in groups if len(rows) >= MIN_CAPTURES]
    if len(groups) < 2 or not decided.sky.any():
        return decided
    year = decided.reference
    seasonal = [(rows, replace(year, log_ratio=year.log_ratio[rows])) for rows in groups]
    # the foreground indoors is darker than half of the sky behind a pane
    pane_sky = 0.5 * np.median(view.through[decided.sky])
    rays = view.pose.true_directions(stack.grid.rays()[stack.kept])
    usual, sky = _seasonal_ratios(stack, rays, seasonal, pane_sky)
    hidden = [stack.placed(dark) > 0.0 for dark in usual < 0.5 * sky]  # [h, w] for each season
    changes = np.any(hidden, axis=0) & (stack.placed(sky) > pane_sky)
    # bounds [h, w] of the beam's share for the days of the year that no capture decides
    low = np.where(changes, np.float32(0.0), view.low)
    highest = np.clip((1.0 + 2.0 * _SCALE_SD) * stack.placed(sky), view.high, 1.0)
    high = np.where(changes, highest, view.high).astype(np.float32)
    undecided = undecided_u(high - low, view.transmittance)
    u = np.where(changes, np.fmax(view.u, undecided), view.u).astype(np.float32)
    view, seasons = replace(view, low=low, high=high, u=u), []
    if changes.sum() < _SOME_SKY * decided.sky.sum():
        return replace(decided, view=view)
    for (rows, reference), dark in zip(seasonal, hidden, strict=True):
        if len(rows) < _OF_SEASON:
            continue
        alone = _decided(stack.take(rows), view.pose, reference)
        of_season = alone.view.where(changes & (alone.sky | dark), view)
        days = np.unique(stack.light[rows].day_of_year).tolist()
        seasons.append(replace(of_season, days=tuple(days)))
    return replace(decided, view=view, changes=changes, seasons=tuple(seasons))


def _seasonal_ratios(
    stack: _Stack, rays: Floats, seasons: Sequence[tuple[Indices, SkyReference]], pane: np.floating
) -> tuple[Floats, Floats]:
    """Return each season's median ratio to Perez's sky [k, p], and the largest that is sky [p].

    seasons: the captures of each of k seasons, and the sky that is in view then; rays: of the
    pixels kept [p, 3]; pane: half of the ratio behind a pane. The second is 0 where no season shows
    sky, and where the first shows that the seasons are alike.
    """
    by_perez = (
        stack.luminance_cdm2[rows] / np.maximum(stack.light[rows].sky_at(rays), 1e-3)
        for rows, _ in seasons
    )
    usual = np.array([statistics.nan_percentiles(ratio, (50.0,))[0] for ratio in by_perez])
    # real skies of a season are within 40 % of Perez's
    differs = usual.min(axis=0) < 0.7 * usual.max(axis=0)
    likely = differs & (usual.max(axis=0) > 0.7 * pane)
    sky = np.zeros(len(rays))
    for rows, reference in seasons:
        luminance = stack.luminance_cdm2[rows][:, likely]
        seen = sky_directions.follow(luminance, stack.light[rows], rays[likely], reference)
        sky[likely] = np.maximum(sky[likely], np.where(seen.spread < _FOLLOWS, seen.ratio, 0.0))
    return usual, sky


def _sun_passes(rays: Floats, latitude_deg: float | None, pose: CameraPose) -> Mask:
    """Return a mask [p] of directions that the sun reaches on some day of the year.

    These are the ones between the declinations of the two solstices, widened by the uncertainty of
    the camera's heading and level. rays: [p, 3]; latitude_deg: of the place; None gives all True.
    """
    if latitude_deg is None:
        return np.ones(len(rays), bool)
    declination = np.arcsin(np.clip(rays @ celestial_pole(latitude_deg), -1.0, 1.0))
    margin_deg = 1.5 + 2.0 * pose.heading_sd_deg  # half a degree, and two of the level
    return np.abs(declination) < np.radians(OBLIQUITY_DEG + margin_deg)


def _turned(stack: _Stack, view: SkyView) -> CameraPose:
    """Return the view's pose, with a heading by the open sky unless discs give a better one.

    It is the same object if the heading does not change.
    """
    if view.pose.heading_sd_deg < sky_heading.MIN_U_DEG:
        return view.pose
    margin_px = int(np.ceil(0.5 / stack.grid.step_deg))  # half a degree from an edge
    open_sky = stack.kept & (view.openness >= _OPEN)
    at = np.flatnonzero(ndimage.binary_erosion(open_sky, np.ones((3, 3)), iterations=margin_px))
    at = at[:: max(1, len(at) // sky_directions.SOME)]
    rays = view.pose.true_directions(stack.grid.rays().reshape(-1, 3)[at])
    luminance = stack.luminance_cdm2[:, stack.columns[at]]
    correction = sky_heading.heading_by_sky(luminance, stack.light, rays, view.pose.axis_deg)
    return view.pose if correction is None else view.pose.with_heading(*correction)


def _nearest(marked: Mask) -> Indices:
    """Return, for each pixel of a map, the flat index of the nearest marked one, [h, w]."""
    nearest = ndimage.distance_transform_edt(~marked, return_distances=False, return_indices=True)
    row, column = np.asarray(nearest)
    return row * marked.shape[1] + column


def _bounds(
    openness: Floats, u: Floats, mixed: Mask, pane: Floats, step_deg: float
) -> tuple[Floats, Floats]:
    """Return the lower and upper 95 % bound of the share of the beam that arrives, [h, w] each.

    openness, u: share of open sky and its standard uncertainty; mixed: pixels of sky and edge;
    pane: transmittance; all [h, w]; step_deg: size of a pixel. A mixed pixel is blurred with its
    neighbours. If it is larger than the sun's disc, all of the disc or none may be visible in it;
    so too in an open pixel between two mixed ones, a gap between slats, in a lens's own pixels.
    """
    # a pixel is the mean over this angle: a lens blurs over two of its pixels
    blurred_deg = step_deg * (2.0 if step_deg < LENS_PIXEL_DEG else 1.0)
    pixel_sr = np.radians(blurred_deg) ** 2
    if blurred_deg > step_deg and pixel_sr > SUN_SOLID_ANGLE_SR:
        mixed = mixed | ((openness >= _OPEN) & between(mixed))
    larger = np.where(mixed, max(1.0, pixel_sr / SUN_SOLID_ANGLE_SR), 1.0)
    around = np.where(mixed, ndimage.maximum_filter(openness, 3), openness)
    within = np.where(mixed, ndimage.minimum_filter(openness, 3), openness)
    maximum = np.where(around > 0.0, np.clip((around + 2.0 * u) * larger, 0.0, 1.0), 0.0)
    minimum = 1.0 - np.clip((1.0 - within + 2.0 * u) * larger, 0.0, 1.0)
    high = np.minimum(maximum * pane * (1.0 + 2.0 * _SCALE_SD), 1.0)
    return minimum * pane * (1.0 - 2.0 * _SCALE_SD), high


def _notes_on_level(level: float, stack: _Stack) -> list[str]:
    """Return a warning if no glass explains `level`, a note if only dark glass does, or nothing.

    level: luminance of the brightest sky in the window over that expected from the irradiance, NaN
    without sky. The window's contrast is tested only in complete pictures: those that merge cuts
    out (where some pixels are `dark`) have bright places only.
    """
    if len(stack.light) < MIN_CAPTURES:
        return []
    is_impossible = level > _TOO_BRIGHT
    if level < _TOO_DARK and not stack.dark.any():
        usual = statistics.nan_percentiles(stack.luminance_cdm2, (50.0,))[0]
        is_impossible = np.nanmax(usual) > _WINDOW_CONTRAST * np.nanmedian(usual)
    if not is_impossible:
        if not _TOO_DARK < level < _CLEAR_GLASS:
            return []
        no_disc = "no disc is certain: mark a tint, or capture a clear hour with the sun in view"
        text = (
            f"the pictures show {level:.2g} of the sky's luminance that the measured irradiance "
            "gives: true of tinted glass, screens, or a view without open sky; if the glass is "
            "clear (0.6 to 0.9), check the camera's factor k and the unit of the irradiance"
        )
        return [text if stack.is_sure else f"{text}; {no_disc}"]
    return [
        f"WARNING: the sky in the window has {level:.2g} of the luminance that the measured "
        "irradiance gives it: check the pictures' unit (cd/m2; W/sr/m2 are 179 times less), "
        "the camera's factor k and the diffuse irradiance"
    ]


def _notes(decided: _Decided) -> tuple[str, ...]:
    """Return sentences for the user: what the captures leave undecided, and which to add."""
    sky, scatters, captures = decided.sky, decided.scatters, decided.view.captures
    notes = []
    if captures < MIN_CAPTURES:
        few = f"where the sky is needs {MIN_CAPTURES} captures, here {captures}"
        notes.append(f"{few}: the sun's disc has bounds only; capture overcast and clear hours")
    elif captures < _FEW_CAPTURES:
        notes.append(
            f"{captures} captures give a first look at where the sky is, and bounds of the sun's "
            f"disc may be wrong; capture {_FEW_CAPTURES} or more hours, overcast and clear, with "
            "the sun in front of the window and behind it"
        )
    if decided.is_behind:
        notes.append(
            "no clear capture has the sun in front of the window, and a sunlit facade looks like "
            "sky: no disc is certain; capture a clear hour with the sun in front, or overcast hours"
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
            f"{100 * share:.0f} % of the glazing may scatter (a curtain, fabric): how much "
            "of the disc passes is between 0 and its brightness; a capture with the sun behind it "
            "settles it"
        )
    if decided.changes is not None:
        share = (decided.changes * weight).sum() / max((sky * weight).sum(), 1e-9)
        day = np.arange(1, 366)
        away = [view.days_from(day) for view in decided.seasons]
        far = np.min([np.full(365, 365), *away], axis=0) > REACH_DAYS
        months = {date.fromordinal(_BEFORE_YEAR + int(k)).replace(day=1) for k in day[far]}
        notes.append(
            f"{100 * share:.0f} % of the sky in view is open in one season and hidden in another "
            f"(leaves): captures decide it for {REACH_DAYS} days before and after them; whether "
            "the sun's disc is seen there is not known in the rest of the year: "
            f"in (parts of) {listed([f'{m:%B}' for m in sorted(months)], 12) or 'no month'}"
        )
    return tuple(notes)


# ----------------------------------------------------------------------------------------------
# captured discs


def _corrected_by_discs(
    decided: _Decided, captured: Captured, covered: Sequence[datetime]
) -> SkyView:
    """Return the view, with its seasons in `others`, corrected where captures show a disc or none.

    covered: times of captures through an unmarked blind that was found before; they are not in
    `captured`. The notes name them, and the captures that contradict the view.
    """
    # Only captures with a strong beam decide, if it is known whether they show a disc.
    strong = (captured.light.direct_lx > BEAM_LX) & ~np.isnan(captured.disc_share)
    captured = captured.take(np.flatnonzero(strong).tolist())
    # Scattering panes behind which several suns showed no disc are shut.
    suns = decided.view.pose.in_pictures(captured.light.apparent_sun_direction)
    shut = _panes_without_disc(decided.view, decided.scatters, suns, captured.disc_share)
    # All discs together correct the transmittance. Then each capture that contradicts a view of its
    # days corrects that view where the sun was.
    gain, views, contradictions = _gain(decided.view, captured), [], dict.fromkeys(covered, _DARK)
    for view in (decided.view, *decided.seasons):
        holds = view.days_from(captured.light.day_of_year) <= REACH_DAYS
        then = captured.take(np.flatnonzero(holds).tolist()) if view.days else captured
        corrected, contradictions_then = _corrected(_scaled(view, gain, shut), then)
        views.append(corrected)
        contradictions |= contradictions_then
    decided = replace(decided, scatters=decided.scatters & ~shut)
    notes = (*_notes(decided), *decided.view.pose.notes, *_contradiction_notes(contradictions))
    return replace(views[0], notes=notes, others=tuple(views[1:]))


def _contradiction_notes(contradictions: Mapping[datetime, str]) -> Iterator[str]:
    """Yield sentences that name the captures that contradict the view, by their times.

    contradictions: what a capture shows: "a disc", "no disc", or `_DARK` for one that is dark where
    others show sky.
    """
    shown = {f"{t:%Y-%m-%d %H:%M} UTC": contradictions[t] for t in sorted(contradictions)}
    dark = [time for time, kind in shown.items() if kind == _DARK]
    if named := [f"{time} ({kind} captured)" for time, kind in shown.items() if kind != _DARK]:
        found = f"{counted(len(named), 'capture')} contradicted the sky view, corrected there"
        yield f"{found}: {listed(named, 3)}; check the heading and the clock"
    if dark:
        yield (
            f"{counted(len(dark), 'capture')} dark where others show sky, not used there: "
            f"{listed(dark, 3)}; a thin bar hid the sun, or a blind was down: mark a blind "
            "(fieldlum status --mark)"
        )


_DARK = "dark"  # what a capture through a blind shows


def _gain(view: SkyView, captured: Captured) -> Floats:
    """Return the factor by which captured discs correct the transmittance of each row of the grid.

    The factor is the mean of 1 and of the ratio of captured discs to the view's discs, weighted by
    both uncertainties; without such discs it is 1 [h]. The luminous efficacy of the beam is
    uncertain for low suns, but has the same error at the same altitude: there a disc counts most.
    Of two discs the larger counts, of more the 60th percentile: an edge may hide a part. If one or
    two discs are far from the view's, they show an edge between slats or leaves, not the pane, and
    do not count.
    """
    disc = disc_of_hours(view, captured.light)
    is_clear = captured.disc_share > _SHUT
    is_clear &= (disc.low_lx > 0.5 * disc.best_lx) & (disc.best_lx > 0.0)
    light = captured.light[is_clear]
    log_ratio = np.log(captured.disc_share[is_clear] * light.direct_lx / disc.best_lx[is_clear])
    u_disc, u_row = map(efficacy_u, (light.apparent_altitude_deg, view.grid.altitudes_deg))
    if len(log_ratio) < MIN_DISCS:
        u_ratio = np.sqrt(_SCALE_SD**2 + _DISC_U**2 + u_disc**2)
        log_ratio, u_disc = (x[np.abs(log_ratio) < 2.0 * u_ratio] for x in (log_ratio, u_disc))
    if not len(log_ratio):
        return np.ones(view.grid.height)
    weight = 1.0 / (_DISC_U**2 + (u_row[:, None] - u_disc) ** 2)  # [h, discs]
    ratios = np.broadcast_to(-log_ratio, weight.shape)
    measured = -np.quantile(ratios, 0.4, axis=1, weights=weight, method="inverted_cdf")
    shrunk = measured / (1.0 + 1.0 / (weight.sum(axis=1) * (_SCALE_SD**2 + u_row**2)))
    return np.clip(np.exp(shrunk), 0.5, 1.5)


def _scaled(view: SkyView, gain: Floats, shut: Mask) -> SkyView:
    """Return the view with transmittance and bounds times `gain` [h], and no sky where `shut`.

    gain: a factor for each row; shut: mask [h, w].
    """
    gain = gain.astype(np.float32)[:, None]
    shares = np.where(shut, np.float32(0.0), [view.openness, view.low, view.high])
    low, high = np.minimum(shares[1:] * gain, 1.0)
    pane = np.minimum(view.transmittance * gain, 1.0)
    return replace(view, openness=shares[0], transmittance=pane, low=low, high=high)


def _corrected(view: SkyView, captured: Captured) -> tuple[SkyView, dict[datetime, str]]:
    """Return the view, corrected where captures contradict it, and what those show by their times.

    A capture contradicts if it shows a disc where the view is shut, or none where it is open. The
    directions of the sun's disc then get the captured share, with bounds of 20 %. A capture that is
    dark at the sun's place, as through a blind, does not correct the view.
    """
    light, rays, contradictions = captured.light, view.grid.rays(), {}
    arrays = {name: getattr(view, name).copy() for name in ("openness", "low", "high")}
    disc_deg = np.degrees(sun_disc.SUN_RADIUS_RAD) + 0.5 * view.grid.step_deg
    for k, sun in enumerate(view.pose.in_pictures(light.apparent_sun_direction)):
        share = captured.disc_share[k]
        off_deg = np.degrees(np.arccos(np.clip(rays @ sun, -1.0, 1.0)))
        near, at = off_deg <= disc_deg + view.pose.heading_sd_deg, off_deg <= disc_deg
        if not at.any() or np.isnan(view.low[near]).any():
            continue
        missed = share > _SHUT >= view.high[near].max()
        if not missed and not share < _SHUT < view.low[near].min():
            continue  # no contradiction
        row, column = np.unravel_index(np.argmin(off_deg), off_deg.shape)
        shown = np.nan_to_num(_placed(captured.read(k), view.grid)[row, column])  # NaN: too dark
        sky_cdm2 = light[[k]].sky_at(light.apparent_sun_direction[[k]])[0, 0]
        if not missed and shown < _SHADED * view.transmittance[row, column] * sky_cdm2:
            contradictions[light.t_utc[k]] = _DARK
            continue
        contradictions[light.t_utc[k]] = "a disc" if missed else "no disc"
        pane = np.maximum(np.nan_to_num(view.transmittance[at]), _SHUT)
        arrays["openness"][at] = np.clip(share / pane, 0.0, 1.0)
        arrays["low"][at], arrays["high"][at] = missed * np.minimum((0.8 * share, 1.2 * share), 1.0)
    return replace(view, **arrays), contradictions


def _panes_without_disc(view: SkyView, scatters: Mask, suns: Floats, measured: Floats) -> Mask:
    """Return a mask [h, w] of the scattering panes that show no disc in three captures or more.

    None of the captures may show a disc in such a pane. suns [n, 3]: where the captures show the
    sun; measured [n]: disc's share of the beam; scatters: mask of all scattering panes [h, w].
    """
    panes = np.empty(scatters.shape, np.int32)
    ndimage.label(scatters, output=panes)
    inside, row, column = view.grid.indices(suns)
    at = panes[row[inside], column[inside]]  # pane in front of each sun, 0 for none
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
    of the directions that follow the sky; both [h, w]; step_deg: size of a pixel. Connected
    directions are one pane, whose transmittance is the smoothed mean of its open pixels. A pane
    under three pixels wide may have no open pixel: it gets that of the nearest wider pane, and what
    is next to large panes gets theirs.
    """
    labels = np.empty(sky.shape, np.int32)
    count = int(ndimage.label(sky, np.ones((3, 3)), output=labels))  # pyright: ignore[reportArgumentType]
    level = np.where(sky, through, 0.0)
    sizes_deg2 = np.bincount(labels.ravel(), minlength=count + 1) * step_deg**2
    large = 1 + np.flatnonzero(sizes_deg2[1:] >= _MIN_PANE_DEG2)  # label 0 is no pane
    if not len(large):
        return np.maximum(np.nan_to_num(through), 1e-6)
    for pane in large:
        inside = labels == pane
        bright = float(np.quantile(through[inside], 0.9))
        open_ = inside & (through >= _OPEN_SHARE * bright)
        sigma = _SMOOTH_DEG / step_deg
        weight = ndimage.gaussian_filter(open_.astype(float), sigma, truncate=3.0)
        mean = ndimage.gaussian_filter(np.where(open_, through, 0.0), sigma, truncate=3.0)
        smooth = np.where(weight > 1e-6, mean / np.maximum(weight, 1e-9), bright)
        level[inside] = np.maximum(smooth, _OPEN_SHARE * bright)[inside]
    inner = np.asarray(ndimage.binary_erosion(sky, np.ones((3, 3))), bool)
    wide = np.intersect1d(large, labels[inner])
    if len(wide):
        narrow = np.isin(labels, np.setdiff1d(large, wide))
        like_wide = level.flat[_nearest(np.isin(labels, wide))]
        level[narrow] = np.maximum(like_wide, through)[narrow]
    of_large = np.isin(labels, large)
    nearest = _nearest(of_large)
    distance_px = np.hypot(*(np.unravel_index(nearest, sky.shape) - np.indices(sky.shape)))
    near_large = ~of_large & (distance_px * step_deg <= _SMOOTH_DEG)
    single = np.maximum(np.nan_to_num(through), 1e-6)
    beside = np.where(near_large, np.maximum(level.flat[nearest], single), single)
    return np.where(of_large, level, beside)
