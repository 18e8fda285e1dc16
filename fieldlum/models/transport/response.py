"""Compute how the pixels of a room respond to light, by a fitted model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fieldlum.light import Features, Kernel, Light, light_features
from fieldlum.models.transport.features import USUAL, PatchDescriptor, StateColumns
from fieldlum.models.transport.open_sky import OpenSky
from fieldlum.models.transport.physics import Physics
from fieldlum.models.transport.pixel_fit import PixelFit, Recipe, second_covariance

Array = NDArray[Any]


@dataclass(frozen=True, slots=True)
class LightBasis:
    """The captured hours, with which the kernel compares a new hour.

    captured: features of the n captured hours; captured_light: their light, of which only the sun's
    directions are used; projector: [n, r]; physics: the coarse room model, if hours or the prior
    mean use it; patches: descriptor of sun patches, if known.
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
    """Predicted hours at the P seen pixels, and the inputs of their uncertainty.

    luminance: [n, P] cd/m2; patch: the part due to direct sun [n, P] cd/m2; unit: luminance for F b
    = 1 [n, P] cd/m2; cross: kernel [n, captures]; second: kernel of the second stage [n, captures],
    or [n, 0] without one.
    """

    luminance: NDArray[np.floating]
    patch: NDArray[np.floating] | None
    unit: NDArray[np.floating]
    features: Features
    cross: Array
    second: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class RoomResponse:
    """The fitted response of the seen pixels to light.

    seen: [H, W]; arrays of pixels have the seen pixels only.
    """

    seen: NDArray[np.bool_]
    basis: LightBasis
    pixels: PixelFit
    open_sky: OpenSky
    patch_scale: float  # fitted factor on all sun patches
    recipe: Recipe

    def features(
        self, light: Light, patch: NDArray[np.float32] | None, sunlight: NDArray[np.float32] | None
    ) -> Features:
        """Return the features of n hours for the kernel.

        patch: [n, H, W] cd/m2, or None; sunlight: result of `Physics.sunlight` [n, k], or None.
        """
        basis = self.basis
        features = basis.states.add(light_features(light), light)
        if basis.captured.bounced is not None and sunlight is not None:
            assert basis.physics is not None
            features = replace(features, bounced=basis.physics.features(sunlight))
        if basis.patches is None or patch is None or self.recipe.below:
            return features
        return basis.patches.add(features, patch, light, self.open_sky.mask(self.seen))

    def maps(self, light: Light, patch: NDArray[np.float32] | None) -> SurfaceMaps:
        """Predict hours without the sun's disc; patch: direct sun [n, H, W] cd/m2, or None."""
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
    def patch_gain(self) -> NDArray[np.float32]:
        """Gain of the sun patch at each pixel, [P]."""
        return np.float32(self.patch_scale) * self.pixels.patch_gain.astype(np.float32)

    def _second(self, light: Light, features: Features) -> NDArray[np.float32]:
        if not len(self.pixels.second):
            return np.empty((len(light), 0), np.float32)
        known, captured = self.basis.captured_light, self.basis.captured.beam
        width = self.recipe.second
        covariance = second_covariance(light, known, features.beam, captured, width)
        return covariance.astype(np.float32)
