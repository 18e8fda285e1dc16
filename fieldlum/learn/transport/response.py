"""Compute how the pixels of a room respond to light, by a fitted model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fieldlum.core.arrays import Array, Floats, Floats32, Mask
from fieldlum.learn.transport.features import USUAL, StateColumns
from fieldlum.learn.transport.open_sky import OpenSky
from fieldlum.learn.transport.patch_descriptor import PatchDescriptor
from fieldlum.learn.transport.physics import Physics
from fieldlum.learn.transport.pixel_fit import PixelFit, Recipe, second_covariance
from fieldlum.sky.light import Features, Kernel, Light, light_features


@dataclass(frozen=True, slots=True)
class LightBasis:
    """The n captured hours, and how a new hour becomes r features.

    The features of new hours are kernel(new, captured) @ projector. captured: what the kernel
    compares, of the captured hours; captured_light: their light, of which only the sun's directions
    are used; projector: [n, r]; physics: the coarse room model, None if the fit does not use it;
    patches: how maps of sun patches become features, None if sun patches are not used; states:
    lamps and blinds with which captures are marked.
    """

    kernel: Kernel
    captured: Features
    captured_light: Light
    projector: Array
    physics: Physics | None
    patches: PatchDescriptor | None
    states: StateColumns = USUAL


@dataclass(frozen=True, slots=True)
class SurfaceMaps:
    """Predicted luminance of n hours at the P pixels the lens saw, and inputs of its uncertainty.

    luminance: without the sun's disc [n, P] cd/m2; patch: direct sun on surfaces, which is included
    in it before the second stage [n, P] cd/m2, None without sun patches; unit: luminance of a
    surface of usual brightness: total light times the pixel's scale [n, P] cd/m2; features: of the
    hours; cross: covariance to the captures [n, captures]; second: that of the second stage [n,
    captures], or [n, 0] without one.
    """

    luminance: Floats
    patch: Floats | None
    unit: Floats
    features: Features
    cross: Array
    second: Floats32


@dataclass(frozen=True, slots=True)
class RoomResponse:
    """The fitted response of the room's pixels to light.

    seen: mask [H, W], True at the P pixels that the lens saw; all arrays over pixels have these
    only; basis: captured hours; pixels: fitted values; open_sky: the window pixels; patch_scale:
    fitted factor on all sun patches; recipe: settings of the fit.
    """

    seen: Mask
    basis: LightBasis
    pixels: PixelFit
    open_sky: OpenSky
    patch_scale: float
    recipe: Recipe

    def features(self, light: Light, patch: Floats32 | None, sunlight: Floats32 | None) -> Features:
        """Return the features of n hours that the kernel compares.

        patch: luminance of sun patches [n, H, W] cd/m2, None without them; sunlight: result of
        `Physics.sunlight` [n, k], None without a coarse room model.
        """
        basis = self.basis
        features = basis.states.add(light_features(light), light)
        if basis.captured.bounced is not None and sunlight is not None:
            assert basis.physics is not None
            features = replace(features, bounced=basis.physics.features(sunlight))
        if basis.patches is None or patch is None or self.recipe.below:
            return features
        return basis.patches.add(features, patch, light, self.open_sky.mask(self.seen))

    def maps(self, light: Light, patch: Floats32 | None) -> SurfaceMaps:
        """Predict n hours without the sun's disc.

        patch: luminance of direct sun on surfaces [n, H, W] cd/m2; None adds no direct sun.
        """
        pixels, basis = self.pixels, self.basis
        sunlight = None if basis.physics is None else basis.physics.sunlight(light)
        features = self.features(light, patch, sunlight)
        cross = basis.kernel(features, basis.captured)  # [n, captures]
        coefficients = (cross @ basis.projector).astype(np.float32)  # [n, r]
        unit = light.total_lx.astype(np.float32)[:, None] * pixels.scale.astype(np.float32)
        surface = coefficients @ pixels.b.T  # [n, P]
        if pixels.computed.any() and basis.physics is not None and sunlight is not None:
            computed = basis.physics.luminance(light, sunlight, self.seen)
            surface += computed * pixels.computed.astype(np.float32) / unit
        surface = np.maximum(surface, pixels.least.astype(np.float32))
        luminance = surface * unit  # [n, P] cd/m2
        direct = None
        if patch is not None:
            direct = patch[:, self.seen] * self.patch_gain  # [n, P] cd/m2
            luminance += direct
        window = self.open_sky.index  # [k]
        sky_gain = pixels.sky_gain[window].astype(np.float32)
        luminance[:, window] += sky_gain * self.open_sky.luminance(light)
        second = self._second(light, features)  # [n, captures or 0]
        if second.size:
            luminance *= np.exp(second @ pixels.second)
        return SurfaceMaps(luminance, direct, unit, features, cross, second)

    @property
    def patch_gain(self) -> Floats32:
        """Fitted over computed luminance of the sun patch at each pixel, [P]."""
        return np.float32(self.patch_scale) * self.pixels.patch_gain.astype(np.float32)

    def _second(self, light: Light, features: Features) -> Floats32:
        if not len(self.pixels.second):
            return np.empty((len(light), 0), np.float32)
        captured_light, captured = self.basis.captured_light, self.basis.captured.beam
        width = self.recipe.second
        covariance = second_covariance(light, captured_light, features.beam, captured, width)
        return covariance.astype(np.float32)
