"""Arrange captures as arrays [hours, seen pixels] for the solver, with features of their light.

A real sky has clouds, which every capture shows through its windows. The ratio to Perez's sky is
treated as a log-normal field that is smooth in direction: window pixels determine it in their
directions, and away from them it returns to Perez's sky. The diffuse illuminance remains as
measured. A predicted year has no windows to look at and uses Perez's sky.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask, evenly_spread
from fieldlum.core.room_states import LAMP_OFF, LAMP_WORD, indicators, parse_state
from fieldlum.core.statistics import nan_percentiles
from fieldlum.learn.models.held_out_choice import light_variance, weight_of_variance
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics.projection import equirect_rays, equirect_solid_angles
from fieldlum.sky.daylight import Light
from fieldlum.sky.light_similarity import LAMP_LX, Facades, Features, facades_of, light_features
from fieldlum.sky.perez import reinhart_patches

MIN_CDM2 = 0.1  # in darker pixels relative errors have no meaning; not measured
# Weights of the cells and of their sum next to the sun's light in a coarse model of the room, whose
# variance is 5 (`Kernel.bounced`): variances of 0.5 and 1. Not measured.
CELL_WEIGHT, FLUX_WEIGHT = float(np.sqrt(0.1)), float(np.sqrt(0.2))


@dataclass(frozen=True, slots=True)
class StateColumns:
    """The lamps with which captures are marked, as columns of features.

    always: whether there is also a lamp that is on in every hour not marked lamp=off; lamps: states
    that add light, such as "lamp=on".
    """

    always: bool = False
    lamps: tuple[str, ...] = ()

    @classmethod
    def of(cls, light: Light) -> StateColumns:
        """Return columns for all lamps with which hours of `light` are marked."""
        parts = sorted({part for text in light.states or () for part in parse_state(text)})
        # False: no lamp that is always on
        return cls(False, tuple(part for part in parts if part.startswith(LAMP_WORD)))

    def features(self, light: Light) -> Features:
        """Return the features of the n hours of `light`, with columns for these states.

        `lamps` [n, l] is, for each of l lamps, 1 000 lx divided by the hour's total light while the
        lamp is on, else 0: luminance is fitted as a share of the total light outside, of which a
        lamp's constant light is less by day. With `always` the first column is a lamp that is on in
        all hours not marked lamp=off; then follow the states `self.lamps`. It is None without
        columns.
        """
        features, states = light_features(light), light.states or ("",) * len(light)
        if self.always or self.lamps:
            always = np.array([float(LAMP_OFF not in text) for text in states])[:, None]
            # the first column only with `self.always`
            on = np.hstack((always[:, : int(self.always)], indicators(states, self.lamps)))
            features = replace(features, lamps=on * (LAMP_LX / light.total_lx)[:, None])  # [n, l]
        return features


# ----------------------------------------------------------------------------------------------
# window pixels


@dataclass(frozen=True, slots=True)
class OpenSky:
    """The k window pixels: those of the camera's pixels that show sky through glass.

    index: their positions in the list of the P pixels that the lens saw [k]; share: captured
    luminance over that of the sky behind the glass (transmittance times unobstructed share, 0 to 1)
    [k]; directions: unit vectors from the camera, x east, y north, z up [k, 3].
    """

    index: Indices
    share: Floats32
    directions: Array

    def mask(self, seen: Mask) -> Mask:
        """Return a mask [H, W] of the window pixels; seen: mask of the P pixels."""
        out = np.zeros(seen.shape, bool)
        out.flat[np.flatnonzero(seen)[self.index]] = True
        return out

    def luminance(self, light: Light) -> Floats32:
        """Return the Perez sky's luminance behind these pixels times `share`, [n, k] cd/m2."""
        return light.sky_at(self.directions) * self.share


def open_sky_from_captures(
    luminance: Floats, patch: Floats | None, light: Light, rays: Array
) -> OpenSky:
    """Find the window pixels without any geometry: they follow the Perez sky behind them.

    luminance, patch: luminance of n captures and of sun patches at P pixels [n, P] cd/m2, patch is
    None if unknown; rays: unit vectors of the pixels, x east, y north, z up [P, 3]. Own method: a
    pixel above the horizon is a window if, over the hours, the logarithm of luminance over sky
    scatters less than half as much as that of luminance over total light, and luminance over sky is
    that of glass (0.05 to 1.2). Its `share` is the 10th percentile of luminance over sky, so that
    the sky rarely exceeds the captured luminance.
    """
    above = np.flatnonzero(rays[:, 2] > 0.0)
    captured = np.maximum(luminance[:, above], MIN_CDM2)
    ratio = np.log(captured / light.sky_at(rays[above]))
    plain = np.log(captured / light.total_lx[:, None].astype(np.float32))
    if patch is not None:
        lit = patch[:, above] > 0.3 * captured
        lit[:, lit.all(axis=0)] = False  # avoids pixels without any value; they are no windows
        ratio, plain = np.where(lit, np.nan, ratio), np.where(lit, np.nan, plain)
    low, middle, high = nan_percentiles(ratio, (10, 50, 90))
    spread = np.subtract(*nan_percentiles(plain, (90, 10)))
    share = np.exp(low)
    # A window pixel follows the sky behind it twice as well as the total light, and shows at least
    # 5 % of that sky; other pixels count as surfaces.
    window = (high - low < 0.5 * spread) & (share > 0.05) & (middle < np.log(1.2))
    return OpenSky(above[window], share[window].astype(np.float32), rays[above[window]])


# ----------------------------------------------------------------------------------------------
# sun patches


@dataclass(frozen=True, slots=True)
class PatchLight:
    """How maps of sun patches become features of an hour: their light in each cell, and its sum.

    A cell is a rectangle of pixels: a map is divided into at most 23 x 23 cells. norms: divisors
    from the captured hours, for the cells and for their sum [2], with which the features are about
    1 when the sun is in the room.
    """

    norms: Array

    @classmethod
    def of(cls, patch: Floats, light: Light, window: Mask) -> PatchLight:
        """Return the divisors for the n captures of `light`.

        patch: luminance of sun patches [n, H, W] cd/m2; window: mask [H, W], True at window pixels.
        The divisors are 1 if no sunny capture has a patch.
        """
        cells = _patch_cells(patch, window)
        # Less direct light than 20 lx is not visible in a room.
        sunny = light.direct_lx > 20.0
        if not cells[sunny].any():
            return cls(np.ones(2))
        size = np.stack((np.linalg.norm(cells, axis=1), cells @ _cell_roots(patch.shape)))
        share = size[:, sunny] / light.direct_lx[sunny]
        return cls(np.maximum(np.percentile(share, 75, axis=1), 0.1 * share.max(axis=1)))

    def features(self, patch: Floats, light: Light, window: Mask) -> Floats32:
        """Return the light of sun patches over total light, in c cells and, last, its sum.

        The result is [n, c + 1], scaled by `norms` and by the weights of cells and sum. patch:
        luminance of sun patches [n, H, W] cd/m2; window: mask [H, W], True at window pixels, which
        do not count.
        """
        cells = _patch_cells(patch, window)
        flux = (cells @ _cell_roots(patch.shape))[:, None]  # the roots by which cells are divided
        both = np.hstack((CELL_WEIGHT * cells / self.norms[0], FLUX_WEIGHT * flux / self.norms[1]))
        both[light.direct_lx == 0.0] = 0.0  # patches of a sun that no instrument measured
        return (both / light.total_lx[:, None]).astype(np.float32)


def _in_cells(picture: Floats) -> Floats:
    """Return the sums of a picture [H, W] over its cells, [c]."""
    for axis in (0, 1):
        size = picture.shape[axis]
        # At most 23 cells along each axis; a cell is about 8 x 16 degrees.
        edges = np.unique(np.linspace(0, size, min(23, size) + 1).astype(int))[:-1]
        picture = np.add.reduceat(picture, edges, axis=axis)
    return picture.ravel()


def _cell_roots(shape: tuple[int, ...]) -> Floats:
    """Return the square root of each cell's solid angle, [c]; shape: of the maps, [..., H, W]."""
    return np.sqrt(_in_cells(equirect_solid_angles(*shape[-2:])))


def _patch_cells(patch: Floats, window: Mask) -> Floats:
    """Return light of sun patches in each of c cells over the root of its solid angle, [n, c].

    Squared differences of two hours then count each cell by its solid angle. patch: luminance of
    sun patches [n, H, W] cd/m2; window: mask of pixels that do not count.
    """
    weights = np.where(window, 0.0, equirect_solid_angles(*window.shape))
    # Brighter than a sunlit white wall (3e4 cd/m2) is a window or a disc, which counts as 3e4.
    lit = (np.minimum(picture, 3e4) * weights for picture in patch)
    return np.array([_in_cells(picture) for picture in lit]) / _cell_roots(patch.shape)


# ----------------------------------------------------------------------------------------------
# training arrays


@dataclass(frozen=True, slots=True)
class ComputedLight:
    """Luminance that was computed for the room in SITE.toml, at n hours and P pixels.

    luminance: of surfaces, without direct sun on them, under the skies of the fit [n, P] cd/m2;
    perez: the same under Perez's skies, as a year is predicted [n, P] cd/m2; gain: captured over
    computed luminance of each pixel, 0 at window pixels [P], by which both are already multiplied.
    """

    luminance: Floats32
    perez: Floats32
    gain: Array

    def __getitem__(self, pixels: Indices | slice) -> ComputedLight:
        """Return the computed light of the selected pixels, at all hours."""
        return ComputedLight(self.luminance[:, pixels], self.perez[:, pixels], self.gain[pixels])


@dataclass(frozen=True, slots=True)
class TrainingArrays:
    """Captures as arrays for the solver: n hours, and the P pixels that the lens saw.

    features: of `light`, as the kernel compares them; luminance: captured [n, P] cd/m2; patch:
    luminance of sun patches [n, P] cd/m2, None if they are not used; sky: light of the sky through
    windows [n, P] cd/m2; filled: True for values without weight, because `merge` flagged
    them [n, P]; trust: weight of each value by irradiance, flags and
    uncertainty, 0 to 1 [n, P]; weights: solid angles over their mean [P]; days: dates [n]; unsure:
    relative variance of the irradiance (`light_variance`) [n]; open_sky: the window pixels;
    facades: walls that let light in; states: marked lamps; computed: light of the
    stated room, None if it is not used.
    """

    light: Light
    features: Features
    luminance: Floats32
    patch: Floats32 | None
    sky: Floats32
    filled: Mask
    trust: Floats
    weights: Array
    days: NDArray
    unsure: Array
    open_sky: OpenSky
    facades: Facades
    states: StateColumns
    computed: ComputedLight | None = None

    @property
    def sureness(self) -> Array:
        """Weight of each hour, [n]: 1 for exact irradiance, less if unsteady or unmeasured."""
        return weight_of_variance(self.unsure)

    def under(self, sky_cdm2: Floats32) -> TrainingArrays:
        """Return the arrays with the features of other skies than Perez's.

        sky_cdm2: luminance of the sky patches in each hour [n, 2305] cd/m2.
        """
        sky = self.light.sky_features(sky_cdm2)
        return replace(self, features=replace(self.features, sky=sky))

    def __getitem__(self, pixels: Indices | slice) -> TrainingArrays:
        """Return the arrays of the pixels that indices or a slice select, at all hours."""
        names = ("luminance", "patch", "sky", "filled", "trust", "weights")
        every = {name: getattr(self, name) for name in names}
        selected = {name: v[..., pixels] for name, v in every.items() if v is not None}
        return replace(self, computed=self.computed and self.computed[pixels], **selected)


def training_arrays_of(data: Dataset, *, with_patch: bool) -> TrainingArrays:
    """Return n captures at P seen pixels as arrays for the solver, with detected window pixels.

    Arrays have the shapes of `TrainingArrays`. with_patch: use the sun patches of `data`, if it has
    any; otherwise `patch` is None.
    """
    rays = equirect_rays(*data.shape, data.heading_deg)[data.seen]
    luminance, light = data.luminance_cdm2[:, data.seen], data.light
    patches = data.patch_cdm2 if with_patch else None
    patch = None if patches is None else patches[:, data.seen]
    open_sky = open_sky_from_captures(luminance, patch, light, rays)
    sky = np.zeros(luminance.shape, np.float32)
    sky[:, open_sky.index] = open_sky.luminance(light)
    filled, unsure = np.zeros(luminance.shape, bool), light_variance(data)
    trust = np.tile(weight_of_variance(unsure)[:, None], luminance.shape[1])
    if data.counts is not None:
        counts = data.counts[:, data.seen]
        trust, filled = trust * counts, counts == 0.0
    states = StateColumns.of(light)
    return TrainingArrays(
        light=light,
        features=states.features(light),
        luminance=luminance,
        patch=patch,
        sky=sky,
        filled=filled,
        trust=trust,
        weights=data.weights[data.seen],
        days=data.days,
        unsure=unsure,
        open_sky=open_sky,
        facades=facades_of(data.setup.room),
        states=states,
    )


def pixel_scale(arrays: TrainingArrays, per: Floats | None = None) -> Array:
    """Return P pixels' usual luminance without sky and sun patch, per lx of total light, [P].

    arrays: of n captures. The result is a geometric mean over the hours in which at most half of
    the pixel's luminance is window sky and at most 30 % is sun patch. per: luminance [n, P] cd/m2
    to divide by instead of the total light, None for the total light. A pixel with one or two such
    hours is limited to the range of the other pixels, a pixel without such hours gets their median:
    as the floor of surfaces, a window's own light would make the demo's DGP four times as wrong.
    """
    total = arrays.light.total_lx[:, None] if per is None else per
    luminance = np.maximum(arrays.luminance, MIN_CDM2)
    direct = arrays.sky if arrays.patch is None else arrays.sky + arrays.patch
    unlit = (arrays.sky <= 0.5 * luminance) & ~arrays.filled
    if arrays.patch is not None:
        unlit &= arrays.patch <= 0.3 * luminance
    logs = np.log(np.maximum(luminance - direct, 0.02 * luminance) / total)
    count = unlit.sum(axis=0)
    mean = np.where(unlit, logs, 0.0).sum(axis=0) / np.maximum(count, 1)  # [P]
    many = count >= 3  # a mean of three hours is taken as it is
    if not many.any():
        return np.exp(np.where(count > 0, mean, np.median(logs)))
    low, middle, high = np.percentile(mean[many], (1, 50, 99))
    return np.exp(np.where(many, mean, np.where(count > 0, np.clip(mean, low, high), middle)))


def computed_light(arrays: TrainingArrays, luminance: Floats32, perez: Floats32) -> ComputedLight:
    """Return computed luminance at the level that the captures show at each pixel.

    luminance, perez: computed under the skies of the fit and under Perez's, for n hours and P
    pixels [n, P] cd/m2. The gain is captured luminance over `luminance`, limited to a factor of 20
    below or above the median of all pixels.
    """
    # Any wall by day is far brighter than 1e-3 cd/m2, below which computed light has no meaning.
    gain = pixel_scale(arrays, np.maximum(luminance, np.float32(1e-3)))
    middle = np.median(gain)
    gain = np.clip(gain, middle / 20.0, middle * 20.0).astype(np.float32)  # black to white
    gain[arrays.open_sky.index] = 0.0
    return ComputedLight(luminance * gain, perez * gain, gain)


# ----------------------------------------------------------------------------------------------
# skies that windows show


# Distance between two unit vectors over which clouds change the ratio to Perez's sky, and standard
# deviation of a ratio's noise over that of the field: the best of six pairs in the room mitsuba_a;
# the likeliest pair of each room (0.1 to 1.0, 0.01 to 0.25) is no better.
CLOUD_WIDTH, NOISE_SHARE = 0.3, 0.2


def seen_sky(arrays: TrainingArrays) -> Floats32 | None:
    """Return the sky of each of n captures, estimated from its window pixels, [n, 2305] cd/m2.

    Return None without window pixels, or if the skies differ from Perez's by under 5 % (rms). A
    window pixel's median ratio to Perez's sky over the captures counts as the transmittance of the
    glass, so that only differences between captures matter. The diffuse illuminance of each capture
    does not change.
    """
    ratios, directions = _patch_ratios(arrays)  # [n, k], [k, 3]
    finite = ratios[np.isfinite(ratios)]
    # Any cloud changes the sky by more than 5 % (rms).
    if not len(finite) or (finite**2).mean() < 0.05**2:
        return None
    patches = reinhart_patches()
    factor = np.exp(_interpolated(ratios, directions, patches.directions))  # [n, 2305]
    perez = arrays.light.sky_cdm2
    horizontal = patches.solid_angles_sr * patches.directions[:, 2]  # [2305] sr
    sky = perez * factor
    level = (perez @ horizontal) / np.maximum(sky @ horizontal, MIN_CDM2)  # [n]
    return (sky * level[:, None]).astype(np.float32)


def _patch_ratios(arrays: TrainingArrays) -> tuple[Array, Array]:
    """Return how much brighter than usual windows showed k sky patches, and their directions.

    The first is ln of the patch's ratio to Perez's sky over its median in the n captures [n, k],
    NaN where a capture does not show the patch; the second are unit vectors [k, 3].
    """
    window = arrays.open_sky.index
    perez = arrays.sky[:, window]  # [n, w]
    captured = np.maximum(arrays.luminance[:, window], MIN_CDM2)
    # A sky under 5 cd/m2 cannot be separated from the room's reflection in the glass.
    valid = ~arrays.filled[:, window] & (perez > 5.0)
    if arrays.patch is not None:
        # A window pixel with more than 2 % direct sun does not show the sky.
        valid &= arrays.patch[:, window] < 0.02 * captured
    # Hours with a blind, or with a lamp that the glass reflects, do not show the sky.
    if arrays.light.states is not None:
        valid &= np.array([not state for state in arrays.light.states])[:, None]
    # The median over five captures or more is a sky patch's usual share.
    often = np.flatnonzero(valid.sum(axis=0) >= 5)
    valid, captured, perez = valid[:, often], captured[:, often], perez[:, often]
    ratios = np.where(valid, np.log(captured / np.maximum(perez, MIN_CDM2)), np.nan)
    ratios = ratios - np.nanmedian(ratios, axis=0)  # [n, w]
    everywhere = reinhart_patches().directions
    nearest = np.argmax(arrays.open_sky.directions[often] @ everywhere.T, axis=1)  # [w]
    patches, member = np.unique(nearest, return_inverse=True)
    of_patch = np.eye(len(patches))[member]  # 1 where window pixel w shows patch k, [w, k]
    counts, sums = valid @ of_patch, np.where(valid, ratios, 0.0) @ of_patch
    means = np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)
    used = evenly_spread(len(patches), 80)  # limits the time
    return means[:, used], everywhere[patches[used]]


def _interpolated(ratios: Array, directions: Array, wanted: Array) -> Array:
    """Return the ratios of `_patch_ratios` to expect in the directions `wanted` [m, 3], [n, m].

    ratios: ln of seen over usual luminance of k sky patches in n captures [n, k], NaN where a
    capture does not show the patch; directions: unit vectors of these patches [k, 3]. The ratio is
    treated as a Gaussian field that is smooth in direction and returns to 0.
    """
    shown = np.isfinite(ratios)  # [n, k]
    own, cross = (np.exp((directions @ b.T - 1.0) / CLOUD_WIDTH**2) for b in (directions, wanted))
    noise = np.where(shown, NOISE_SHARE**2, 1e6)  # [n, k]
    covariance = own + noise[:, :, None] * np.eye(len(directions))
    weights = np.linalg.solve(covariance, np.where(shown, ratios, 0.0)[:, :, None])[:, :, 0]
    return weights @ cross
