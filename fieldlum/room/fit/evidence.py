"""Collect from the captures what a fit needs: sunny hours, pixels, and light below sun patches."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import timedelta

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from fieldlum.core.arrays import Floats, Floats32, Indices
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Room
from fieldlum.core.statistics import cauchy_weights
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics.projection import direction, equirect_solid_angles, signed_angle_deg
from fieldlum.room.fit import renderer
from fieldlum.room.fit.guess import Guess, guess_of
from fieldlum.room.fit.renderer import FLOOR, OUTSIDE, SHELL, Surfaces, surfaces, unit_patches
from fieldlum.room.fit.sunny_hours import (
    MIN_SUNNY_HOURS,
    SUNSHINE_WM2,
    direct_on_windows_lx,
    sunny_hours,
)
from fieldlum.room.scene.box_room import is_box_with_window, room_axes
from fieldlum.room.scene.view import pixel_rays
from fieldlum.sky import sun
from fieldlum.sky.light_similarity import Kernel, facades_of, light_features
from fieldlum.sky.sky_view.view import SkyView

# From a study of two rooms rendered by Radiance, before this code was written. docs/scene.md has
# later measurements.
MAX_HOURS = 60
PIXELS = 4000
DRAW = 0.637  # offset of the regular draw, 0 to 1; any other gives the same room
# Pixels of the searches before the last one. With a third of 1 000 pixels they fitted the pixels:
# from the truth, the misfit of the others rose (docs/scene.md).
COARSE_PIXELS = 1000
RAY_ROWS = 58  # rows of rays, at least; chosen: 3.1 degrees apart, as in the outside rooms
# Log error at which a pixel counts as half wrong: patches differ from the room by a factor of 3 to
# 20. With a narrow width (0.4) a lost patch costs as much as glare on a glossy floor: in a room by
# Radiance and one by Mitsuba exact patches then left half of the misfit of no patch, with 1.5 a
# tenth (docs/validation.md, rooms of other renderers).
WIDTH = 1.5
# Albedos that are tried, and the cost of one that is a factor of e off its start: less than a
# pixel in a thousand that is wrong. Chosen.
ALBEDOS, ALBEDO_COST = np.geomspace(0.03, 0.95, 37), 5e-4
WALLS_FACTOR = 2.0  # of a wall's albedo to the median of the walls, at most; chosen
# pixels nearer to a window are omitted, because they may look through it; chosen
_WINDOW_MARGIN_DEG = 4.0
_CLOCK_REACH_MIN = 20  # chosen: four times the prior's 5 minutes


@dataclass(frozen=True)
class SceneEvidence:
    """Captured light of n sunny hours at m sampled pixels, with which guesses are compared.

    log_seen [n, m]: ln of the captured luminance, cd/m2; below [n, m]: luminance estimated without
    direct sun, cd/m2; direct_lx [n]: of the sun, on a plane normal to it; rays [r, 3]: unit
    vectors, sub x sub in each pixel, x east, y north, z up by the stated heading; pixel [r]: for
    each ray, the index in `pixels` of its pixel; days [n]: local dates; clock [41, n, 2]: altitude
    and azimuth (clockwise from north) of the sun, deg, if the stated time were -20, -19 ... 20 min
    after the true time; rows [n]: indices of the hours in the captures; pixels [m]: flat indices in
    the panorama; spread: angle between neighbouring rays [rad]; skyline: what the sky view shows.
    """

    log_seen: Floats
    below: Floats
    direct_lx: Floats
    rays: Floats32
    pixel: Indices
    days: NDArray[np.datetime64]
    clock: Floats
    rows: Indices
    pixels: Indices
    sub: int
    spread: float
    skyline: Skyline

    def __len__(self) -> int:
        return len(self.rows)

    def coarse(self) -> SceneEvidence:
        """Return the evidence of about `COARSE_PIXELS` (1 000) pixels, evenly from all.

        Evidence with under 1.5 times as many pixels is returned unchanged.
        """
        every = max(1, round(len(self.pixels) / COARSE_PIXELS))
        keep = np.arange(0, len(self.pixels), every)
        rays, pixel = _rays_in(keep, self.rays, self.pixel)
        return replace(
            self,
            log_seen=self.log_seen[:, keep],
            below=self.below[:, keep],
            rays=rays,
            pixel=pixel,
            pixels=self.pixels[keep],
        )

    def suns_room(self, guess: Guess) -> Floats32:
        """Return unit vectors to the sun in room axes, by the guess's north and clock, [n, 3].

        Room axes: `fieldlum.room.fit.guess`. Between full minutes of the clock, and beyond 20, the
        sun's angles are linear in time.
        """
        minutes = guess.clock_min + _CLOCK_REACH_MIN  # after the first row of `clock`
        row = int(np.clip(np.floor(minutes), 0, len(self.clock) - 2))
        share = minutes - row
        altitude, azimuth = ((1.0 - share) * self.clock[row] + share * self.clock[row + 1]).T
        world = sun.direction(altitude, azimuth - guess.north_deg)
        return (world @ room_axes(guess.wall_azimuth_deg).T).astype(np.float32)

    def patches(self, guess: Guess, albedo: Floats) -> Floats:
        """Return the luminance of the guess's sun patches, cd/m2 [n, m].

        albedo: of west, east, south and north wall, floor and ceiling [6]; solids have their own.
        The sun follows the guess's north and clock.
        """
        tones = np.append(albedo, [solid.albedo for solid in guess.solids])
        return self._shine(guess, surfaces(guess, self.rays, self.spread), tones)

    def _shine(self, guess: Guess, ends: Surfaces, tones: Floats) -> Floats:
        """Return the luminance of sun patches where rays end, cd/m2 [n, m].

        ends: of the rays in the guess; tones: albedos of the shell's surfaces and the solids [6 +
        solids].
        """
        suns, tone = self.suns_room(guess), tones[ends.surface]
        shine = unit_patches(guess, ends, suns, self.pixel, self.sub, tone)
        return (self.direct_lx[:, None] / np.pi).astype(np.float32) * shine

    def relit(self, data: Dataset, patch: Floats) -> SceneEvidence:
        """Return the evidence with `below`, the light without direct sun, estimated again.

        data: all captures; patch: luminance of sun patches, which is subtracted, except where it is
        above the captured luminance, cd/m2 [n, m].
        """
        flat = data.luminance_cdm2.reshape(len(data), -1)[:, self.pixels]
        seen = np.maximum(flat, MIN_CDM2)
        # A patch that is brighter than the capture is not there: nothing is subtracted. Otherwise a
        # search could not find what hides the sun in only one or two hours, because the light of
        # these hours without the patch would be that of sunny ones.
        patch = np.where(patch > seen[self.rows], np.float32(0.0), patch)
        direct = np.zeros_like(seen)
        direct[self.rows] = patch
        below = indirect_component(data, seen, direct)[self.rows]
        level = levelled(below, seen[self.rows], patch, self.directions)
        return replace(self, below=np.maximum(level, MIN_CDM2).astype(np.float32))

    @property
    def directions(self) -> Floats:
        """The mean direction of each pixel's rays, unit vectors [m, 3]: x east, y north, z up."""
        total = np.stack([np.bincount(self.pixel, self.rays[:, k]) for k in range(3)], axis=1)
        return total / np.linalg.norm(total, axis=1, keepdims=True)

    def misfit(self, patch: Floats) -> Floats:
        """Return the share of the pixels that are wrong with some patches in each hour, [n].

        patch: luminance of sun patches, cd/m2 [n, m]. The share is the mean of e^2 / (e^2 + 1.5^2),
        0 to 1, e being the error of ln luminance (robust function of Geman and McClure; the width
        is `WIDTH`).
        """
        return _saturated(np.log(self.below + patch) - self.log_seen).mean(axis=1)

    def albedos(self, guess: Guess, start: Floats) -> Floats:
        """Return the albedo of each surface with which its sun patches fit best, [6].

        Surfaces are west, east, south and north wall, floor and ceiling. Of the values from 0.03 to
        0.95, which are 10 % apart, each has the smallest misfit plus cost of its departure from
        `start` [6]. Walls are within a factor of two of their median: misplaced patches would make
        them black.
        """
        ends = surfaces(guess, self.rays, self.spread)
        full = self._shine(guess, ends, np.ones(SHELL + len(guess.solids)))
        albedo = start.astype(float)
        hour, pixel = np.nonzero(full)
        of_pixel = np.full(len(self.pixels), -1)
        of_pixel[self.pixel] = ends.surface  # of the last ray of each pixel: edges are rare
        surface, shine = of_pixel[pixel], full[hour, pixel]
        below, seen = self.below[hour, pixel], self.log_seen[hour, pixel]
        for k in range(len(albedo)):
            on = surface == k
            light, dark, target = shine[on], below[on], seen[on]
            costs = [
                float(_saturated(np.log(dark + a * light) - target).sum() / self.log_seen.size)
                + ALBEDO_COST * np.log(a / albedo[k]) ** 2
                for a in ALBEDOS
            ]
            albedo[k] = ALBEDOS[int(np.argmin(costs))]
        median = float(np.median(albedo[:FLOOR]))
        albedo[:FLOOR] = albedo[:FLOOR].clip(median / WALLS_FACTOR, median * WALLS_FACTOR)
        return albedo


def _saturated(log_error: Floats) -> Floats:
    """Return by how much a pixel counts as wrong, from 0 to 1, by its error of ln luminance."""
    squared = log_error**2
    return squared / (squared + WIDTH**2)


def require_box(room: Room) -> None:
    """Raise InputError for a room that is not a box or has no window."""
    if not is_box_with_window(room):
        finding = f"kind '{room.kind}', {len(room.window)} windows"
        remedy = "state the window in SITE.toml, or train with --scene none"
        raise InputError("[room]", finding, "a box with a window", remedy)


def scene_evidence(
    data: Dataset, room: Room, *, pixels: int = PIXELS, min_hours: int = MIN_SUNNY_HOURS
) -> SceneEvidence:
    """Collect sunny hours, sampled pixels and the light without direct sun from captures.

    Hours are those of `sunny_hours`, at most the 60 with most direct sun on a window. room: the
    stated box; pixels: number of pixels to draw, by solid angle, at least 4 degrees outside the
    windows. Raises InputError for a room that is not a box, has no window or is impossible,
    NotEnoughDataError for fewer than `min_hours` hours.
    """
    require_box(room)
    guess = guess_of(room, data.heading_deg)
    order = np.argsort(direct_on_windows_lx(data, room))[::-1][:MAX_HOURS]
    rows = np.sort(order[sunny_hours(data, room)[order]])  # in order of time
    if len(rows) < min_hours:
        raise NotEnoughDataError(
            f"{len(rows)} captures have direct sun of at least {SUNSHINE_WM2:.0f} W/m² on a "
            f"window, but at least {min_hours} are needed: capture clear hours, and check that "
            "wall_azimuth_deg is not turned; until then train uses the stated [room]"
        )
    chosen = _draw_pixels(data, guess, pixels)
    sub = max(1, round(RAY_ROWS / data.shape[0]))
    all_pixels, all_rays = pixel_rays(data.shape[0], data.heading_deg, sub)
    rays, pixel = _rays_in(chosen, all_rays, all_pixels)
    seen = np.maximum(data.luminance_cdm2.reshape(len(data), -1)[:, chosen], MIN_CDM2)
    evidence = SceneEvidence(
        log_seen=np.log(seen[rows]),
        below=seen[rows],
        direct_lx=data.light.direct_lx[rows],
        rays=rays.astype(np.float32),
        pixel=pixel,
        days=data.days[rows],
        clock=_clock_table(data, rows),
        rows=rows,
        pixels=chosen,
        sub=sub,
        spread=np.pi / data.shape[0] / sub,
        skyline=skyline_of(data.sky_view, guess, data.setup.site.latitude_deg),
    )
    return evidence.relit(data, np.zeros_like(evidence.below))


def _clock_table(data: Dataset, rows: Indices) -> Floats:
    """Return altitude and azimuth of the sun, deg, for c minutes of the clock's error, [c, n, 2].

    Stated times are -20 ... 20 min after the true ones. The captures' own sun angles are shifted by
    the sun's motion in that time. rows: indices of the n hours in the captures.
    """
    light, site = data.light[rows], data.setup.site
    stated = sun.position(light.t_utc, site)
    table = []
    for late_min in range(-_CLOCK_REACH_MIN, _CLOCK_REACH_MIN + 1):
        true = sun.position([t - timedelta(minutes=late_min) for t in light.t_utc], site)
        altitude = light.apparent_altitude_deg + true.altitude_deg - stated.altitude_deg
        azimuth = light.sun_azimuth_deg + signed_angle_deg(true.azimuth_deg - stated.azimuth_deg)
        table.append(np.stack([altitude, azimuth], axis=-1))
    return np.stack(table)


def _draw_pixels(data: Dataset, guess: Guess, count: int) -> Indices:
    """Return flat indices of pixels that are evenly spaced by solid angle.

    count: number of the pixels, of which a few can coincide. Pixels that may look through a window
    of the guess are not drawn.
    """
    height, width = data.shape
    _, middle = pixel_rays(height, data.heading_deg, 1)
    glass = surfaces(guess, middle.astype(np.float32)).surface == OUTSIDE
    margin = round(_WINDOW_MARGIN_DEG / 180.0 * height)
    near_glass = binary_dilation(glass.reshape(height, width), iterations=max(1, margin))
    usable = data.seen & ~np.asarray(near_glass, bool)
    omega = np.where(usable, equirect_solid_angles(height, width), 0.0).ravel()
    count = min(count, int((omega > 0.0).sum()))
    shares = (np.arange(count) + DRAW) / count
    return np.unique(np.searchsorted(np.cumsum(omega) / omega.sum(), shares))


def _rays_in(chosen: Indices, rays: Floats, pixel: NDArray[np.integer]) -> tuple[Floats, Indices]:
    """Return k rays in chosen pixels [k, 3], and for each the index of its pixel in `chosen` [k].

    chosen: indices of m pixels [m], ascending; rays: all r rays [r, 3]; pixel: index of each ray's
    pixel [r].
    """
    of = np.isin(pixel, chosen)
    return rays[of], np.searchsorted(chosen, pixel[of])


# ----------------------------------------------------------------------------------------------
# the indirect component below the patches

# From a study of two rooms rendered by Radiance, before this code was written (docs/scene.md).
RANK = 15  # few enough features that smooth light cannot imitate a patch; chosen with the study
ROUNDS = 6
# Log errors that halve a pixel's weight: a sun patch only adds light, so brighter pixels lose
# weight sooner. Chosen with the study.
BRIGHTER, DARKER = 0.12, 0.5
# Of a round for an hour's level, one smooth field, for which dark pixels are noise; chosen with the
# study.
LEVEL_ROUNDS, LEVEL_DARKER = 12, 0.25
MIN_CDM2 = 0.1  # chosen: a luminance below that of a room by day
_RIDGE = 1e-3  # share of the mean diagonal that makes the system solvable; chosen
# Share of a pixel's light at which a sun patch halves the pixel's weight for the light below: the
# error of a stronger patch is large compared with the rest. Chosen.
_PATCH_SHARE = 0.3


def indirect_component(data: Dataset, seen: Floats, patch: Floats) -> Floats:
    """Estimate the luminance that m pixels would show in n captures without direct sun on them.

    data: the n captures, for their light and room; seen: captured luminance; patch: luminance of
    known sun patches, which is subtracted, and values that it dominates count less; each and the
    result cd/m2 [n, m], `seen` and the result at least 0.1. Own method: light of sky and sun that
    changes smoothly between hours has few features, the 15 eigenvectors of the kernel (`Kernel`)
    with the largest eigenvalues, and 1. Each pixel is fitted by ridge regression on them, in rounds
    that reduce the weight of values brighter than the fit, because a sun patch only adds light.
    """
    features = light_features(data.light)
    kernel = Kernel(facades_of(data.setup.room))(features, features)  # [n, n]
    value, vector = np.linalg.eigh(kernel)
    rank = min(RANK, len(data) - 1)
    basis = vector[:, -rank:] * np.sqrt(np.maximum(value[-rank:], 0.0))  # [n, rank]
    size = np.sqrt(np.mean(basis**2) * rank)
    # float32 is precise to 1e-5 of the light, and twice as fast
    basis = (np.column_stack([basis, np.ones(len(data))]) / size).T.astype(np.float32)  # [k, n]
    products = (basis[:, None] * basis).reshape(-1, len(data))  # [k k, n]
    total_lx = data.light.total_lx[:, None].astype(np.float32)  # [n, 1]
    trust = cauchy_weights(patch, _PATCH_SHARE * seen)
    y = np.maximum(seen - patch, 0.02 * seen) / total_lx
    # the upper median of each pixel; sorting along rows is faster
    scale = np.partition(np.ascontiguousarray(y.T), len(y) // 2, axis=1)[:, len(y) // 2]
    y = (y / scale).astype(np.float32)  # [n, m] of median 1
    trust = trust.astype(np.float32)
    fit = np.maximum(np.minimum(y, 1.5), 0.05)
    weight = trust / (y * fit)
    minimum, terms = np.float32(0.05), len(basis)
    for _ in range(ROUNDS):
        normal = (products @ weight).T.reshape(-1, terms, terms)  # [m, k, k]
        mean = np.einsum("mkk->m", normal) / terms
        normal = normal + (_RIDGE * mean)[:, None, None] * np.eye(terms, dtype=np.float32)
        right = (basis @ (weight * y)).T[..., None]  # [m, k, 1]
        fit = np.maximum(basis.T @ np.linalg.solve(normal, right)[..., 0].T, minimum)
        error = np.log(y / fit)
        excess = np.where(error > 0.0, error / BRIGHTER, error / DARKER) ** 2
        weight = trust / (y * fit) / (1.0 + excess)
    return np.maximum(fit * scale * total_lx, MIN_CDM2)


def levelled(below: Floats, seen: Floats, patch: Floats, directions: Floats) -> Floats:
    """Return the light below patches, corrected for each hour by a smooth factor, [n, m] cd/m2.

    below: luminance estimated without direct sun; seen: captured; patch: of known sun patches; each
    [n, m] cd/m2; directions: unit vectors to the pixels [m, 3]. The features behind `below` do not
    determine how bright the room is under a sun that no other hour has. Therefore the logarithm of
    each hour is corrected by the nine polynomials of the direction up to the second order, in
    rounds that reduce the weight of pixels brighter than the fit. Own method.
    """
    x, y, z = directions.T
    terms = np.stack([np.ones_like(x), x, y, z, x * y, x * z, y * z, x * x, z * z], axis=1)
    log_ratio = np.log(np.maximum(seen - patch, 0.02 * seen) / below)  # [n, m]
    trust = cauchy_weights(patch, _PATCH_SHARE * seen)
    products = np.einsum("mk,ml->mkl", terms, terms).reshape(len(terms), -1)  # [m, 81]
    field = np.zeros_like(log_ratio)
    for number in range(LEVEL_ROUNDS):
        error = log_ratio - field
        excess = np.where(error > 0.0, error / BRIGHTER, error / LEVEL_DARKER) ** 2
        weight = trust / (1.0 + excess) if number else trust
        normal = (weight @ products).reshape(-1, 9, 9)
        normal = normal + 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(9)
        right = (weight * log_ratio) @ terms
        field = np.linalg.solve(normal, right[..., None])[..., 0] @ terms.T
    return below * np.exp(field)


# ----------------------------------------------------------------------------------------------
# the sky that the camera sees: window edges, buildings and trees outside

# Directions on the upper half of the sphere, on a spiral of equal areas: 1.3 degrees apart. Chosen.
_RAYS, _GOLDEN_DEG = 12000, 180.0 * (3.0 - 5**0.5)
_MARGIN_DEG = 1.0  # from the stated edges of a window: 5 cm of a tape at 3 m
# Openness from which a direction is open, and below which something is before the sky; largest
# standard uncertainty of openness that counts. Chosen.
_OPEN, _SHUT, _MAX_U = 0.85, 0.5, 0.3


@dataclass(frozen=True)
class Skyline:
    """The sky in directions that the camera sees through the stated windows.

    rays [s, 3]: unit vectors, x east, y north, z up by the stated heading; openness [s]: share of
    the sky that is seen there, 0 to 1; spread: size of a pixel of the sky view, rad.
    """

    rays: Floats32
    openness: Floats32
    spread: float

    def error(self, guess: Guess) -> Floats32:
        """Return the guess's openness less the seen one, times the root of a ray's share, [s].

        The share is of the full sphere, so that a direction counts as much as a pixel.
        """
        shown = renderer.sky_openness(guess, self.rays, self.spread)
        return np.float32(np.sqrt(0.5 / _RAYS)) * (shown - self.openness)


def skyline_of(view: SkyView | None, guess: Guess, latitude_deg: float) -> Skyline:
    """Return the skyline that a sky view shows inside the windows of the stated guess.

    Without a view it has no directions. A direction without open sky is omitted in two cases,
    because it does not show a building. First: it is at least as high as something that hangs above
    open sky in the same window, such as a blind, a canopy or a crown, and that the guess does not
    have. Second: the sun is there on no day of the year, and merge stored no luminance
    (transmittance 0 in the view). latitude_deg: of the place.
    """
    k = np.arange(_RAYS) + 0.5
    rays = direction(np.degrees(np.arcsin(k / _RAYS)), _GOLDEN_DEG * k % 360.0).astype(np.float32)
    spread, kept, openness = 0.0, np.zeros(_RAYS, bool), np.zeros(_RAYS, np.float32)
    # a margin of a degree; that of merge is 3.4 degrees
    highest = np.sin(np.radians(sun.OBLIQUITY_DEG + 1.0))
    sun_passes = abs(rays @ sun.celestial_pole(latitude_deg)) < highest
    if view is not None:
        inside, row, column = view.grid.indices(rays)
        known = np.where(view.u < _MAX_U, view.openness, np.float32(np.nan))
        below = np.logical_or.accumulate((known > _OPEN)[::-1])[::-1]  # open there or below
        openness = np.where(inside, known[row, column], np.float32(np.nan))
        spread = np.radians(view.grid.step_deg)
        margin = 2.0 * np.radians(_MARGIN_DEG) + spread
        # of bars and solids that are stated
        clear = renderer.sky_openness(guess, rays, margin) > _OPEN
        for rect in guess.windows:
            alone = replace(guess, windows=(rect,), solids=(), bars=())
            # the margin is half a soft edge
            glass = renderer.sky_openness(alone, rays, margin) > 0.99
            hangs = glass & clear & (openness < _SHUT) & below[row, column]
            lowest = rays[hangs, 2].min(initial=1.0)
            decided = (rays[:, 2] < lowest) & (sun_passes | (view.transmittance[row, column] > 0.0))
            kept |= glass & (openness >= np.where(decided, 0.0, _OPEN))
    return Skyline(rays[kept], openness[kept], spread)
