"""Provide two baselines: the mean map, and the captured hour with the most similar light."""

from __future__ import annotations

import numpy as np

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models import Fitted, ModelState, Patch, Prediction
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.training_domain import Domain, captured
from fieldlum.sky.light import Light

LEAST_CDM2 = 1e-3  # for logarithms; well below what any camera resolves; chosen
# share of a pixel's light that remains at least when its sun patch is subtracted; not measured
LEAST_SHARE = 0.02


class MeanFitted:
    """A model that predicts the same map for every hour: the mean of log10 L of each pixel.

    log10_mean: this mean [H, W], L in cd/m2; domain: range of light in the captures; parameters:
    number of fitted values, H times W; held_out_mse: None, because errors on other days are not
    computed.
    """

    name = "mean"
    held_out_mse: Floats | None = None

    def __init__(self, log10_mean: Floats32, domain: Domain) -> None:
        self.log10_mean, self.domain = log10_mean, domain
        self.parameters = log10_mean.size

    def predict(self, light: Light, patch_cdm2: Floats32 | None = None) -> Prediction:
        """Predict the mean map for each of the n hours of `light`, [n, H, W].

        patch_cdm2 is not used. The prediction has no standard deviation, and NaN as expected error.
        Hours whose light is similar to that of the captures are trusted.
        """
        n = len(light.dni_wm2)
        maps = np.repeat((10.0**self.log10_mean)[None].astype(np.float32), n, axis=0)
        return Prediction(maps, None, np.full(n, np.nan), self.domain.holds(light))

    def state(self) -> ModelState:
        """Return what config.json and weights.npz must contain for `from_state` to rebuild it."""
        config = {"domain": self.domain.state(), "with_patch": False}
        return ModelState(config, {"log10_mean": self.log10_mean})


def fit_mean(
    data: Dataset,
    *,
    patch: Patch = "absolute",
    seed: int = 0,
    budget_s: float | None = None,
    progress: Progress = quiet,
) -> MeanFitted:
    """Fit the mean of log10 L (L at least 1e-3 cd/m2) of each pixel over the captures of `data`.

    The other arguments are those of every model's fit and are not used.
    """
    log10 = np.zeros(data.shape)
    # one by one, because the logarithm of all maps would double the memory
    for luminance in data.luminance_cdm2:
        log10 += np.log10(np.maximum(luminance, LEAST_CDM2)) / len(data)
    return MeanFitted(log10.astype(np.float32), captured(data.light))


class NearestFitted:
    """A model that predicts the map of the captured hour with the most similar sun and sky.

    That map is scaled by the ratio of global irradiances of the two hours. If with_patch is True,
    the map's sun patch (surfaces in direct sun) is replaced by that of the predicted hour.

    rest_cdm2: captured maps, without their sun patches if with_patch is True [m, H, W]; features:
    by `light_features` [m, 5]; scale: by `outside` [m]; domain: range of light in the captures;
    parameters: number of stored luminances; held_out_mse: None, because errors on other days are
    not computed.
    """

    name = "nearest"
    held_out_mse: Floats | None = None

    def __init__(
        self, rest_cdm2: Floats32, features: Floats, scale: Floats, with_patch: bool, domain: Domain
    ) -> None:
        self.rest_cdm2, self.features, self.scale = rest_cdm2, features, scale
        self.with_patch, self.domain = with_patch, domain
        self.parameters = rest_cdm2.size

    def predict(self, light: Light, patch_cdm2: Floats32 | None = None) -> Prediction:
        """Predict the scaled map of the capture with the most similar light to each hour.

        The result is [n, H, W] for n hours. patch_cdm2: luminance by direct sun in the n hours of
        `light` [n, H, W], which is added if the model was fitted with sun patches, and otherwise
        not used. The prediction has no standard deviation, and NaN as expected error. Hours whose
        light is similar to that of the captures are trusted. Raises ValueError without patch_cdm2
        for a model that was fitted with sun patches.
        """
        wanted, scale = light_features(light), outside(light)
        distance = ((wanted[:, None, :] - self.features[None]) ** 2).sum(axis=2)
        near = distance.argmin(axis=1)
        maps = self.rest_cdm2[near] * (scale / self.scale[near]).astype(np.float32)[:, None, None]
        if self.with_patch:
            if patch_cdm2 is None:
                raise ValueError("this model was trained with sun patches: pass patch_cdm2")
            maps += patch_cdm2
        return Prediction(maps, None, np.full(len(maps), np.nan), self.domain.holds(light))

    def state(self) -> ModelState:
        """Return what config.json and weights.npz must contain for `from_state` to rebuild it."""
        arrays = {"rest_cdm2": self.rest_cdm2, "features": self.features, "scale": self.scale}
        config = {"domain": self.domain.state(), "with_patch": self.with_patch}
        return ModelState(config, arrays)


def light_features(light: Light) -> Floats:
    """Return five features of each of n hours, [n, 5]; similar hours have similar values.

    With the beam share b = DNI / (DNI + DHI) these are the unit vector to the sun (three values)
    times (0.3 + b), b, and 0.3 log10 of (DHI plus 10 W/m2).
    """
    share = light.dni_wm2 / np.maximum(light.dni_wm2 + light.dhi_wm2, 1e-9)
    return np.column_stack(
        [light.sun_direction * (0.3 + share[:, None]), share, 0.3 * np.log10(light.dhi_wm2 + 10.0)]
    )


def outside(light: Light) -> Floats:
    """Return the global horizontal irradiance of each hour plus 1 W/m2, [n].

    Maps are scaled in proportion to it.
    """
    rise = np.maximum(np.sin(np.radians(light.sun_altitude_deg)), 0.0)
    return light.dni_wm2 * rise + light.dhi_wm2 + 1.0


def fit_nearest(
    data: Dataset,
    *,
    patch: Patch = "absolute",
    seed: int = 0,
    budget_s: float | None = None,
    progress: Progress = quiet,
) -> NearestFitted:
    """Return a model that stores the captured hours; only `data` and `patch` are used.

    With patch "absolute" the sun patches of `data`, if any, are subtracted from the maps; at least
    2 % of a pixel's light remains. With "gain" or "none" they stay in the maps. The other arguments
    are those of every model's fit.
    """
    with_patch = patch == "absolute" and data.patch_cdm2 is not None
    rest = data.luminance_cdm2
    if with_patch and data.patch_cdm2 is not None:
        rest = np.maximum(rest - data.patch_cdm2, np.float32(LEAST_SHARE) * rest)
    return NearestFitted(
        rest, light_features(data.light), outside(data.light), with_patch, captured(data.light)
    )


def from_state(state: ModelState) -> Fitted:
    """Return the baseline model, mean or nearest, that the content of a model folder describes.

    Raises KeyError, TypeError or ValueError for missing or wrong content.
    """
    config, arrays = state.config, state.arrays
    domain = Domain.from_state(config["domain"])
    if config["model"] == "mean":
        return MeanFitted(arrays["log10_mean"], domain)
    return NearestFitted(
        arrays["rest_cdm2"], arrays["features"], arrays["scale"], config["with_patch"], domain
    )
