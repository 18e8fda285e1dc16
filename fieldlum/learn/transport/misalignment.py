"""Compare sunny captures with sun patches computed for any setting of north, clock and camera."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import timedelta
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats, Floats32, Indices
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.transport.arrays import MIN_CDM2, training_arrays_of
from fieldlum.learn.transport.solve import basis_of, fit_pixels
from fieldlum.optics.projection import equirect_solid_angles, signed_angle_deg
from fieldlum.room.scene.points import SunPoints
from fieldlum.room.scene.view import SceneView
from fieldlum.sky import sun
from fieldlum.sky.light import Kernel, facades_of

HOURS = 48  # those with most direct sun in view; bounds the time; chosen
LEAST_HOURS = 3  # not measured
FAINT = 0.02  # of the most direct sun in view: hours below it are not used; not measured
PIXELS = 4000  # bounds the time; chosen
_LEAST_REST = 0.05  # of a captured value, that patches leave; chosen
SUB = 2  # rays per pixel in each direction; bounds the time; chosen
NOISE = 1e-2  # relative variance of the light below the patches; chosen
WIDTH = 0.4  # log error at which a pixel counts as half wrong; not measured
MOST_TURN_DEG, MOST_SHIFT_PX = 3.0, 3  # reach of the search; not measured


@dataclass(frozen=True)
class Evidence:
    """n sunny captures at the m pixels that sun patches reach or nearly reach.

    rows: indices of the captures in `data` [n]; pixels: flat indices in a map [m]; weights: of the
    pixels, with the sum 1 [m]; log_seen: ln of the captured luminance [n, m]; background: estimated
    luminance without any patch [n, m] cd/m2; groups: captures of equal value are resampled together
    [n]; points, view: surface points at the m pixels and the view of the room, None without a box
    room; rates: change of the sun's altitude and azimuth [n] each, degrees per minute; gains:
    factors on the patches, first for those in `data`, second for those computed from the room.
    """

    data: Dataset
    rows: Indices
    pixels: Indices
    weights: Array
    log_seen: Array
    background: Array
    groups: NDArray
    points: SunPoints | None
    view: SceneView | None
    rates: tuple[Array, Array]
    gains: tuple[float, float]

    @cached_property
    def everywhere(self) -> SunPoints | None:
        """Return the surface points of all pixels; None without a box room."""
        return None if self.view is None else self.view.sun_points()

    def given(self, right_px: float = 0.0, down_px: float = 0.0) -> Array:
        """Return the sun patches of `data`, moved right and down by these pixels, [n, m] cd/m2."""
        assert self.data.patch_cdm2 is not None
        return moved(self.data.patch_cdm2[self.rows], self.pixels, right_px, down_px)

    def computed(
        self, turn_deg: float = 0.0, fast_min: float = 0.0, *, full_maps: bool = False
    ) -> Array:
        """Return sun patches computed for a wrong north and a wrong clock, [n, m] cd/m2.

        turn_deg: by how much room and camera are turned further clockwise than stated; fast_min:
        by how much the stated times are later than the true ones. With `full_maps`, the result is
        complete maps [n, H, W]. Requires a box room.
        """
        points = self.everywhere if full_maps else self.points
        assert points is not None
        patch = self._of(points, turn_deg, fast_min)
        return patch.reshape(len(patch), *self.data.shape) if full_maps else patch

    def _of(self, points: SunPoints, turn_deg: float, fast_min: float) -> Array:
        """Return patches at the targets of `points`, cd/m2 [n, targets]."""
        light = self.data.light[self.rows]
        towards = sun.direction(
            light.shown_altitude_deg - fast_min * self.rates[0],
            light.sun_azimuth_deg - turn_deg - fast_min * self.rates[1],
        )
        return np.stack(
            [
                points.direct(d) * e
                for d, e in zip(points.scene.to_room(towards), light.direct_lx, strict=True)
            ]
        )

    def walled(self, turn_deg: float) -> Array:
        """Return sun patches computed for a room turned by `turn_deg` clockwise, [n, m] cd/m2.

        Sun and camera keep their stated directions, so everything in the room moves across the
        picture. Requires a box room.
        """
        assert self.view is not None
        width = self.data.shape[1]
        row, column = np.divmod(self.pixels, width)
        source = column - turn_deg * width / 360.0  # where a pixel's patch would be now
        left_column = np.floor(source).astype(int)
        share = source - left_column
        sources = np.concatenate(
            (row * width + left_column % width, row * width + (left_column + 1) % width)
        )
        needed, place = np.unique(sources, return_inverse=True)
        patch = self._of(self.view.sun_points(needed), turn_deg, 0.0)  # [n, needed]
        at_left, at_right = np.split(place, 2)
        return patch[:, at_left] * (1.0 - share) + patch[:, at_right] * share

    def light(self, patch: Array, gain: float) -> Array:
        """Return the expected ln luminance, ln(background + gain * patch), [n, m].

        patch: sun patches [n, m] cd/m2; gain: factor on them.
        """
        return np.log(self.background + gain * patch)

    def misfit(self, patch: Array, gain: float) -> Array:
        """Return how much sun patches contradict the captures: share of wrong pixels, 0 to 1, [n].

        It is a weighted mean of squared log errors that saturate: a sunlit pixel predicted dark
        counts about one, a small error little. patch: [n, m] cd/m2; gain: factor on the patches.
        """
        error = (self.light(patch, gain) - self.log_seen) ** 2
        return (error / (error + WIDTH**2)) @ self.weights


def moved(maps: Floats, pixels: Indices, right_px: float, down_px: float) -> Array:
    """Return maps [n, H, W] moved right and down by fractions of a pixel, at m pixels only, [n, m].

    Values are interpolated linearly; the left and right edges join. pixels: flat indices [m].
    """
    height, width = maps.shape[1:]
    row, column = np.divmod(pixels, width)
    y, x = np.clip(row - down_px, 0.0, height - 1.0), column - right_px
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    v, u = y - i, x - j
    below = np.minimum(i + 1, height - 1)
    upper = maps[:, i, j % width] * (1.0 - u) + maps[:, i, (j + 1) % width] * u
    lower = maps[:, below, j % width] * (1.0 - u) + maps[:, below, (j + 1) % width] * u
    return upper * (1.0 - v) + lower * v


def evidence_of(data: Dataset, sub: int = SUB) -> Evidence | None:
    """Return the at most 48 captures with most direct sun in view, prepared for comparison.

    Return None if `data` has no sun patches, or if under three captures show them. sub: rays per
    pixel in each direction when patches are computed.
    """
    if data.patch_cdm2 is None:
        return None
    flux = np.minimum(data.patch_cdm2, 3e4)[:, data.seen] @ data.weights[data.seen]
    order = np.argsort(flux)[::-1][:HOURS]
    rows = np.sort(order[flux[order] > FAINT * flux.max()])
    if len(rows) < LEAST_HOURS:
        return None
    light, site = data.light[rows], data.setup.site
    now, then = (
        sun.position([t + timedelta(minutes=m) for t in light.t_utc], site) for m in (-0.5, 0.5)
    )
    azimuth = signed_angle_deg(then.azimuth_deg - now.azimuth_deg)
    days = data.days[rows]
    parts = Evidence(
        data,
        rows,
        np.empty(0, np.intp),
        np.empty(0),
        np.empty(0),
        np.empty(0),
        days if len(np.unique(days)) >= LEAST_HOURS else np.arange(len(rows)),
        None,
        None,
        (then.altitude_deg - now.altitude_deg, azimuth),
        (1.0, 1.0),
    )
    return _filled(parts, data, sub)


def _filled(parts: Evidence, data: Dataset, sub: int) -> Evidence | None:
    """Choose the pixels, and find the light without patches there."""
    from scipy.ndimage import binary_dilation

    room = data.setup.room
    view = None
    assert data.patch_cdm2 is not None
    lit = (data.patch_cdm2[parts.rows] > 0.0).any(axis=0)
    near = np.asarray(binary_dilation(lit, iterations=MOST_SHIFT_PX), bool)
    if room is not None and room.kind == "box" and room.window:
        from fieldlum.room.scene.view import look

        view = look(room, data.shape[0], data.heading_deg, sub)
        parts = replace(parts, view=view)
        for turn in (-MOST_TURN_DEG, 0.0, MOST_TURN_DEG):
            near = near | (parts.computed(turn, full_maps=True) > 0.0).any(axis=0)
    pixels = np.flatnonzero(near & data.seen)
    if not len(pixels):
        return None
    weights = equirect_solid_angles(*data.shape).ravel()[pixels]
    if len(pixels) > PIXELS:
        drawn = np.random.default_rng(0).choice(
            len(pixels), PIXELS, replace=False, p=weights / weights.sum()
        )
        pixels, weights = np.sort(pixels[drawn]), np.ones(PIXELS)
    points = None if view is None else view.sun_points(pixels)
    captured, background = _without_patches(data, pixels)
    background = background[parts.rows]
    captured = captured[parts.rows]
    parts = replace(
        parts,
        pixels=pixels,
        weights=weights / weights.sum(),
        log_seen=np.log(captured),
        background=background,
        points=points,
    )
    made = [parts.given(), parts.given() if points is None else parts.computed()]
    stated_gain, computed = (_brightness(captured - background, patch) for patch in made)
    return replace(parts, gains=(stated_gain, computed))


def _without_patches(data: Dataset, pixels: Indices) -> tuple[Array, Array]:
    """Return captured light, and the light below the patches that robust rounds find, [n, m] each.

    The robust rounds do not use the patches.
    """
    only = np.zeros(data.seen.size, bool)
    only[pixels] = True
    arrays = training_arrays_of(replace(data, seen=only.reshape(data.shape)), with_patch=False)
    kernel = Kernel(facades_of(data.setup.room))
    basis = basis_of(kernel(arrays.features, arrays.features))
    fitted = fit_pixels(arrays, basis, NOISE, lambda finished, total: None)
    surface = (
        np.maximum(basis.values @ fitted.b.T, fitted.minimum)
        * arrays.light.total_lx[:, None]
        * fitted.scale
    )
    background = surface + fitted.sky_gain * arrays.sky
    return np.maximum(arrays.luminance, MIN_CDM2), np.maximum(background, MIN_CDM2)


def below_patches(evidence: Evidence, maps: Floats32, gain: float) -> Evidence:
    """Return the evidence with the light below sun patches estimated again, for a gain on them.

    maps: sun patches of all captures [N, H, W] cd/m2, which are subtracted, times `gain`.
    """
    data, pixels = evidence.data, evidence.pixels
    luminance = data.luminance_cdm2.reshape(len(data), -1).copy()
    captured, patch = luminance[:, pixels], maps.reshape(len(data), -1)[:, pixels]
    luminance[:, pixels] = np.maximum(captured - gain * patch, _LEAST_REST * captured)
    rest = replace(data, luminance_cdm2=luminance.reshape(maps.shape))
    _, below = _without_patches(rest, pixels)
    return replace(evidence, background=below[evidence.rows], gains=(gain, gain))


def _brightness(excess: Array, patch: Array) -> float:
    """Return the patches' gain without using their position.

    In each hour, compare the brighter half of the pixels that a patch must fill with as many of the
    brightest pixels; return the median over hours.
    """
    ratios = []
    for over, lit in zip(excess, patch, strict=True):
        count = int((lit > 0.0).sum() + 1) // 2
        if count >= 4:
            ratios.append(np.sort(over)[-count:].mean() / np.sort(lit)[-count:].mean())
    gain = float(np.median(ratios)) if ratios else 1.0
    return gain if gain > 0.0 else 1.0
