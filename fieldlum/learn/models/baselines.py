"""Provide two baselines: the mean map, and the captured hour with the most similar light.

Models without a variance trust hours whose light is in the `Domain` of the captures.
"""

from dataclasses import dataclass, field

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.learn.models import ModelState, Patch, Prediction, deserialised, state_of
from fieldlum.learn.models.training_data import Dataset
from fieldlum.sky.daylight import Light
from fieldlum.sky.sun import horizontal_beam


@dataclass(frozen=True, slots=True)
class Domain:
    """The suns in the captures of a model, by which it trusts hours of similar light.

    sun_directions: unit vectors to the sun in captures with a DNI of 60 W/m2 or more [k, 3].
    """

    sun_directions: Floats

    def prediction(self, maps_cdm2: Floats32, light: Light) -> Prediction:
        """Return maps [n, H, W] cd/m2 as the prediction for the n hours of `light`.

        It has no standard deviation and NaN as expected error. Hours with light similar to captured
        light are trusted: the sun must be within 12 degrees of that of a sunny capture, or the DNI
        below 60 W/m2, with which the sun lights a room less than the sky does. Both limits are
        chosen.
        """
        cosine = (light.sun_direction @ self.sun_directions.T).max(axis=1, initial=-1.0)
        is_similar = (cosine >= np.cos(np.radians(12.0))) | (light.dni_wm2 < 60.0)
        return Prediction(maps_cdm2, None, np.full(len(maps_cdm2), np.nan), is_similar)


def domain_of(light: Light) -> Domain:
    """Return the `Domain` of captures with the light `light`: the suns of its sunny hours."""
    return Domain(light.sun_direction[light.dni_wm2 >= 60.0])


# ----------------------------------------------------------------------------------------------
# models


@dataclass(frozen=True)
class MeanFitted:
    """A model that predicts the same map for every hour: the mean of log10 L of each pixel.

    log10_mean: this mean [H, W], L in cd/m2; domain: range of light in the captures.
    """

    log10_mean: Floats32
    domain: Domain
    name: str = field(default="mean", init=False)
    held_out_mse: None = field(default=None, init=False)

    @property
    def parameters(self) -> int:
        """Number of fitted values, H times W."""
        return self.log10_mean.size

    def predict(self, light: Light, patch_cdm2: Floats32 | None = None) -> Prediction:
        """Predict the mean map for each of the n hours of `light`, [n, H, W].

        patch_cdm2 is not used. The prediction has no standard deviation, and NaN as expected error.
        Hours whose light is similar to that of the captures are trusted.
        """
        mean = (10.0**self.log10_mean)[None].astype(np.float32)
        return self.domain.prediction(np.repeat(mean, len(light), axis=0), light)

    def state(self) -> ModelState:
        """Return what config.json and weights.npz must contain for `from_state` to rebuild it."""
        return state_of(self, False)  # without sun patches


def fit_mean(data: Dataset, **_: object) -> MeanFitted:
    """Fit the mean of log10 L (L at least 1e-3 cd/m2) of each pixel over the captures of `data`.

    Options of other models are not used.
    """
    log10 = np.zeros(data.shape)
    # Map by map, because the logarithm of all maps would double the memory.
    for luminance in data.luminance_cdm2:
        # The logarithm needs a value above 0; no camera resolves so little.
        log10 += np.log10(np.maximum(luminance, 1e-3)) / len(data)
    return MeanFitted(log10.astype(np.float32), domain_of(data.light))


@dataclass(frozen=True)
class NearestFitted:
    """A model that predicts the map of the captured hour with the most similar sun and sky.

    That map is scaled by the ratio of global irradiances of the two hours. If with_patch is True,
    the map's sun patch (surfaces in direct sun) is replaced by that of the predicted hour.

    rest_cdm2: maps of m captures, without their sun patches if with_patch is True [m, H, W];
    features: by `similarity_features` [m, 5]; scale: by `level_wm2` [m]; domain: range of light in
    the captures.
    """

    rest_cdm2: Floats32
    features: Floats
    scale: Floats
    with_patch: bool
    domain: Domain
    name: str = field(default="nearest", init=False)
    held_out_mse: None = field(default=None, init=False)

    @property
    def parameters(self) -> int:
        """Number of stored luminances."""
        return self.rest_cdm2.size

    def predict(self, light: Light, patch_cdm2: Floats32 | None = None) -> Prediction:
        """Predict the scaled map of the capture with the most similar light to each hour.

        The result is [n, H, W] for n hours. patch_cdm2: luminance by direct sun in the n hours of
        `light` [n, H, W], which is added if the model was fitted with sun patches, and otherwise
        not used. The prediction has no standard deviation, and NaN as expected error. Hours whose
        light is similar to that of the captures are trusted. Raises ValueError without patch_cdm2
        for a model that was fitted with sun patches.
        """
        distance = ((similarity_features(light)[:, None] - self.features) ** 2).sum(axis=2)
        nearest = distance.argmin(axis=1)  # index of a capture for each hour [n]
        scale = (level_wm2(light) / self.scale[nearest]).astype(np.float32)
        maps = self.rest_cdm2[nearest] * scale[:, None, None]
        if self.with_patch:
            if patch_cdm2 is None:
                raise ValueError("this model was trained with sun patches: pass patch_cdm2")
            maps += patch_cdm2
        return self.domain.prediction(maps, light)

    def state(self) -> ModelState:
        """Return what config.json and weights.npz must contain for `from_state` to rebuild it."""
        return state_of(self, self.with_patch)


def similarity_features(light: Light) -> Floats:
    """Return five features of each of n hours, [n, 5]; similar hours have similar values.

    With the beam share b = DNI / (DNI + DHI) these are the unit vector to the sun (three values)
    times (0.3 + b), b, and 0.3 log10 of (DHI plus 10 W/m2). Own choice.
    """
    share = light.dni_wm2 / np.maximum(light.dni_wm2 + light.dhi_wm2, 1e-9)
    return np.column_stack(
        [light.sun_direction * (0.3 + share[:, None]), share, 0.3 * np.log10(light.dhi_wm2 + 10.0)]
    )


def level_wm2(light: Light) -> Floats:
    """Return the global horizontal irradiance of each hour plus 1 W/m2, [n].

    Maps are scaled in proportion to it; 1 W/m2 keeps the ratio of two dark hours finite.
    """
    return horizontal_beam(light.dni_wm2, light.sun_altitude_deg) + light.dhi_wm2 + 1.0


def fit_nearest(data: Dataset, *, patch: Patch = "absolute", **_: object) -> NearestFitted:
    """Return a model that stores the captured hours; only `data` and `patch` are used.

    With patch "absolute" the sun patches of `data`, if any, are subtracted from the maps; at least
    2 % of a pixel's light remains. With "gain" or "none" they stay in the maps.
    """
    patches = data.patch_cdm2 if patch == "absolute" else None
    rest, light = data.luminance_cdm2, data.light
    if patches is not None:
        rest = np.maximum(rest - patches, np.float32(0.02) * rest)
    with_patch, features = patches is not None, similarity_features(light)
    return NearestFitted(rest, features, level_wm2(light), with_patch, domain_of(light))


def from_state(state: ModelState) -> MeanFitted | NearestFitted:
    """Return the baseline model, mean or nearest, that the content of a model folder describes.

    Raises KeyError, TypeError or ValueError for missing or wrong content.
    """
    name = state.config["model"]
    kind = MeanFitted if name == "mean" else NearestFitted
    return deserialised(kind, state.config[name], state.arrays)
