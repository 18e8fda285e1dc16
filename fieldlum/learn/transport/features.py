"""Arrange captures as arrays [hours, seen pixels] for the solver, with features of their light."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fieldlum.core.arrays import Array, Floats, Floats32, Indices, Mask
from fieldlum.core.room_states import ADDED, OFF, indicators, parse_state
from fieldlum.learn.models.hour_weights import light_variance, sureness
from fieldlum.learn.transport.open_sky import LEAST_CDM2, OpenSky, open_sky_from_captures
from fieldlum.learn.transport.patch_descriptor import (
    PatchDescriptor,
    describe_patches,
    direct_flux_lx,
)
from fieldlum.learn.transport.patch_edges import edge_weights, refuted_patches
from fieldlum.optics.projection import equirect_pixel, equirect_rays
from fieldlum.room.scene.view import look
from fieldlum.sky.light import (
    LAMP_LX,
    Facades,
    Features,
    Light,
    facades_of,
    facades_unknown,
    light_features,
    one_facade,
)

if TYPE_CHECKING:
    from fieldlum.learn.models.data import Dataset
    from fieldlum.learn.transport.computed_light import ComputedLight


DISC_MARGIN = 2  # pixels around the sun that may have changed when its disc was removed; chosen


@dataclass(frozen=True, slots=True)
class StateColumns:
    """The states of the room with which captures are marked, as columns of features.

    always: whether there is also a lamp that is on in every hour not marked lamp=off; lamps: states
    that add light, such as "lamp=on"; changed: states that change the response to daylight, such as
    "blind=half".
    """

    always: bool = False
    lamps: tuple[str, ...] = ()
    changed: tuple[str, ...] = ()

    def add(self, features: Features, light: Light) -> Features:
        """Return `features` with `lamps` and `changed` set from the states in `light`.

        Without states the features are returned unchanged.
        """
        if not (self.always or self.lamps or self.changed):
            return features
        states = light.states or ("",) * len(light)
        on = indicators(states, self.lamps)  # [n, l]
        if self.always:
            lit = [float(OFF not in text) for text in states]
            on = np.concatenate((np.array(lit)[:, None], on), axis=1)
        lamps = on * (LAMP_LX / light.total_lx)[:, None] if on.shape[1] else None
        changed = indicators(states, self.changed) if self.changed else None
        return replace(features, lamps=lamps, changed=changed)


USUAL = StateColumns()  # lamps off, blinds up


def state_columns(light: Light) -> StateColumns:
    """Return the states with which any hour of `light` is marked; `always` is False."""
    parts = sorted({part for text in light.states or () for part in parse_state(text)})
    lamps = tuple(part for part in parts if part.startswith(ADDED))
    return StateColumns(False, lamps, tuple(part for part in parts if part not in lamps))


def facades_seen(data: Dataset) -> Facades:
    """Return the walls that let the sun in.

    For a box room with windows they are its window walls. Otherwise they are those of sixteen
    azimuths whose cosines to the sun best explain the light of the sun patches in sunny hours
    (non-negative least squares). Without sun patches in these hours, return `facades_unknown`.
    """
    if data.setup.room is not None and data.setup.room.kind == "box" and data.setup.room.window:
        return facades_of(data.setup.room)
    if data.patch_cdm2 is None:
        return facades_unknown()
    from scipy.optimize import nnls

    direct = data.light.direct_lx
    sunny = direct > 1000.0
    flux = direct_flux_lx(data.patch_cdm2, np.zeros(data.shape, bool))
    if not (sunny & (flux > 0.0)).any():
        return facades_unknown()
    azimuths = np.linspace(0.0, 337.5, 16)
    candidates = Facades(azimuths, np.ones(16))
    cosines = np.maximum(data.light.sun_direction[sunny] @ candidates.normals.T, 0.0)
    share = nnls(cosines, flux[sunny] / direct[sunny])[0]
    keep = share > 0.1 * share.max()
    if keep.sum() == 1:
        return one_facade(float(azimuths[keep][0]))
    return Facades(azimuths[keep], np.sqrt(share[keep] / share.max()))


# ----------------------------------------------------------------------------------------------
# training arrays


@dataclass(frozen=True, slots=True)
class TrainingArrays:
    """Captures as arrays for the solver: n hours, and the P pixels that the lens saw.

    luminance: captured [n, P] cd/m2; weights: solid angles [P]; patch: luminance of sun patches [n,
    P] cd/m2, None if they are not used; sky: light of the sky through windows [n, P] cd/m2; filled:
    values without weight, where the sun's disc was removed, a blind may hide a patch, or merge
    flagged [n, P]; unsure: relative variance of the irradiance (`light_variance`) [n]; counts:
    weight of each value by merge's flags and uncertainties, and by how near it is to the edge of a
    fitted scene's sun patch [n, P], None if all are equal;
    perez_sky: `Features.sky` of Perez's skies [n, 2305], set if `features` has the skies that the
    windows showed; fitted_patches: whether the patches are from a fitted room, so that their edges
    are off by some centimetres; computed: light of the stated room, None if it is not used;
    refuted: pixels in which the captures show no computed patch [P], None if not compared.
    """

    light: Light
    features: Features
    luminance: Floats32
    patch: Floats32 | None
    sky: Floats32
    filled: Mask
    weights: Array
    days: NDArray
    unsure: Array
    open_sky: OpenSky
    patches: PatchDescriptor | None
    facades: Facades
    states: StateColumns = USUAL
    counts: NDArray[np.float16] | None = None
    perez_sky: Floats32 | None = None
    fitted_patches: bool = False
    computed: ComputedLight | None = None
    refuted: Mask | None = None

    @property
    def trust(self) -> Array:
        """Weight of each value in a fit, 0 to 1, [n, P]."""
        trust = np.where(self.filled, 0.0, self.sureness[:, None])
        return trust if self.counts is None else trust * self.counts

    def taught(self, residual: Array) -> Array:
        """Return log residuals [n, P] times the weights of their values."""
        return residual if self.counts is None else residual * self.counts

    def without_flagged(self, error: Array) -> Array:
        """Return errors [n, P] with zero at flagged values, which have no truth to compare with."""
        return error if self.counts is None else np.where(self.counts > 0.0, error, 0.0)

    @property
    def sureness(self) -> Array:
        """Weight of each hour, [n]: 1 for exact irradiance, less if unsteady or unmeasured."""
        return sureness(self.unsure)

    def __getitem__(self, pixels: Indices | slice) -> TrainingArrays:
        """Return the arrays of some pixels."""
        return replace(
            self,
            luminance=self.luminance[:, pixels],
            patch=None if self.patch is None else self.patch[:, pixels],
            sky=self.sky[:, pixels],
            filled=self.filled[:, pixels],
            weights=self.weights[pixels],
            counts=None if self.counts is None else self.counts[:, pixels],
            computed=None if self.computed is None else self.computed[pixels],
            refuted=None if self.refuted is None else self.refuted[pixels],
        )

    def with_patch_scaled(self, factor: float) -> TrainingArrays:
        """Return the arrays with all patches multiplied by a factor."""
        assert self.patch is not None
        return replace(self, patch=self.patch * np.float32(factor))


def training_arrays_of(data: Dataset, *, with_patch: bool) -> TrainingArrays:
    """Return captures as arrays for the solver, with window pixels detected from the captures.

    with_patch: use the sun patches of `data`, if it has any; otherwise `patch` is None.
    """
    height, width = data.shape
    rays = equirect_rays(height, width, data.heading_deg)[data.seen]
    luminance = data.luminance_cdm2[:, data.seen]
    patch = data.patch_cdm2[:, data.seen] if with_patch and data.patch_cdm2 is not None else None
    open_sky = open_sky_from_captures(luminance, patch, data.light, rays)
    sky = np.zeros(luminance.shape, np.float32)
    sky[:, open_sky.index] = open_sky.luminance(data.light)
    states = state_columns(data.light)
    features, patches = states.add(light_features(data.light), data.light), None
    if patch is not None and data.patch_cdm2 is not None:
        mask = open_sky.mask(data.seen)
        patches = describe_patches(data.patch_cdm2, data.light, mask)
        features = patches.add(features, data.patch_cdm2, data.light, mask)
    filled = around_disc(data) | _patches_unknown(data)
    if data.counts is not None:
        filled |= data.counts == 0.0
    counts = None if data.counts is None else data.counts[:, data.seen]
    is_fitted = data.scene is not None
    if is_fitted and patch is not None and data.patch_cdm2 is not None:
        edges = edge_weights(data.patch_cdm2, data.seen, luminance, data.light.total_lx)
        counts = edges if counts is None else counts * edges
    return TrainingArrays(
        data.light,
        features,
        luminance,
        patch,
        sky,
        filled[:, data.seen],
        data.weights[data.seen],
        data.days,
        light_variance(data),
        open_sky,
        patches,
        facades_seen(data) if with_patch else facades_of(data.setup.room),
        states,
        counts,
        fitted_patches=is_fitted,
    )


def without_refuted(arrays: TrainingArrays, data: Dataset) -> TrainingArrays:
    """Return the arrays without the sun on ground outside that the captures do not show.

    data: captures, with the box room whose ground counts; without one nothing changes.
    """
    room = data.setup.room
    if arrays.patch is None or room is None or room.kind != "box":
        return arrays
    ground = look(room, data.shape[0], data.heading_deg).ground[data.seen]
    refuted = ground & refuted_patches(arrays.patch, arrays.luminance, arrays.trust)
    return replace(arrays, patch=np.where(refuted, np.float32(0.0), arrays.patch), refuted=refuted)


def _patches_unknown(data: Dataset) -> Mask:
    """Mark the pixels that a computed sun patch reaches while a blind was not up, [n, H, W]."""
    out = np.zeros(data.luminance_cdm2.shape, bool)
    if data.patch_cdm2 is None or data.light.states is None:
        return out
    blind = [any(p.startswith("blind") for p in parse_state(s)) for s in data.light.states]
    rows = np.flatnonzero(blind)
    out[rows] = data.patch_cdm2[rows] > 0.02 * data.luminance_cdm2[rows]
    return out


def around_disc(data: Dataset) -> Mask:
    """Return a mask [n, H, W], True at pixels from which the visible sun disc was removed.

    It includes a margin of two pixels; hours without a visible disc have no such pixel.
    """
    height, width = data.shape
    out = np.zeros((len(data), height, width), bool)
    hours = np.flatnonzero(data.disc_lx > 0.0)
    light = data.light
    row, column = equirect_pixel(
        light.shown_altitude_deg[hours],
        light.sun_azimuth_deg[hours],
        height,
        width,
        data.heading_deg,
    )
    for t, i, j in zip(hours, row.astype(int), column.astype(int), strict=True):
        rows = np.clip(np.arange(-DISC_MARGIN, DISC_MARGIN + 1) + i, 0, height - 1)
        columns = (np.arange(-DISC_MARGIN, DISC_MARGIN + 1) + j) % width
        out[t, rows[:, None], columns] = True
    return out


def pixel_scale(arrays: TrainingArrays, per: Floats | None = None) -> Array:
    """Return each pixel's usual luminance, without sky and sun patch, per lx of total light, [P].

    It is a geometric mean over the hours in which at most half of the pixel's luminance is window
    sky and at most 30 % is sun patch. per: luminance [n, P] cd/m2 to divide by instead of the total
    light, None for the total light. A pixel with one or two such hours is limited to the range of
    the other pixels; a pixel without such hours gets their median.
    """
    total = arrays.light.total_lx[:, None] if per is None else per
    luminance = np.maximum(arrays.luminance, LEAST_CDM2)
    direct = arrays.sky if arrays.patch is None else arrays.sky + arrays.patch
    unlit = (arrays.sky <= 0.5 * luminance) & ~arrays.filled
    if arrays.patch is not None:
        unlit &= arrays.patch <= 0.3 * luminance
    logs = np.log(np.maximum(luminance - direct, 0.02 * luminance) / total)
    count = unlit.sum(axis=0)
    mean = np.where(unlit, logs, 0.0).sum(axis=0) / np.maximum(count, 1)
    many, some = count >= 3, count > 0
    if not many.any():
        return np.exp(
            np.where(some, mean, np.median(mean[some]) if some.any() else np.median(logs))
        )
    low, middle, high = np.percentile(mean[many], (1, 50, 99))
    return np.exp(np.where(many, mean, np.where(some, np.clip(mean, low, high), middle)))
