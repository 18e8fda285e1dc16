"""Provide the network of Liu, Colburn and Inanici (2020) as a model.

See `dense_network` and `dense_training`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
import torch

from fieldlum.core.arrays import Floats, Floats32
from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models import ModelState, Patch, Prediction
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.dense_network import (
    DHI_TOP_WM2,
    DNI_TOP_WM2,
    LOG_TOP,
    POWER,
    Net,
    Shape,
    bfloat16_pays,
    canvas,
    decode,
    encode,
    hours,
    parameter_count,
    pick_device,
    scene_inputs,
)
from fieldlum.learn.models.dense_training import train
from fieldlum.learn.models.training_domain import Domain, captured
from fieldlum.sky.light import Light

PREDICT_PIXELS = 16384  # pixels of a chunk that fits into the processor's cache; not measured


class DenseFitted:
    """A trained network with everything that its prediction needs.

    net, shape: the network and its form; average_log10: mean of log10 L over the training images
    [H, W]; heading_deg: azimuth of the maps' centre column; patch: how sun patches are used;
    domain: range of light in the captures; training: content of a `TrainingRecord`; parameters:
    number of fitted values; held_out_mse: None, because errors on days without captures are not
    computed for a network.
    """

    name = "dense"
    held_out_mse: Floats | None = None

    def __init__(
        self,
        net: Net,
        shape: Shape,
        average_log10: Floats,
        heading_deg: float,
        patch: Patch,
        domain: Domain,
        training: Mapping[str, Any],
    ) -> None:
        self.net, self.shape, self.patch = net.eval(), shape, patch
        self.domain, self.training = domain, training
        self.average_log10, self.heading_deg = average_log10, heading_deg
        self.parameters = parameter_count(net)
        self._device = pick_device()
        self._canvas = canvas(average_log10, heading_deg).to(self._device)
        self.net.to(self._device)

    def _encoded(self, light: Light, patch_cdm2: Floats32 | None) -> Iterator[Floats32]:
        """Yield the encoded map [H W] of each hour."""
        at = hours(light, self.shape).to(self._device)
        pixels = torch.arange(self._canvas.fixed.shape[0], device=self._device)  # [H W]
        direct = torch.zeros(len(pixels), 1, device=self._device)
        for k in range(len(light)):
            if patch_cdm2 is not None and self.patch != "none":
                encoded = torch.from_numpy(encode(patch_cdm2[k].reshape(-1, 1), self.shape.curve))
                direct = encoded.to(self._device)
            parts = []
            for pixel in pixels.split(PREDICT_PIXELS):
                scene = scene_inputs(self._canvas, at, torch.full_like(pixel, k), pixel)
                parts.append(self.net(scene, direct[pixel]))
            yield torch.cat(parts).float().cpu().numpy()

    def predict(self, light: Light, patch_cdm2: Floats32 | None = None) -> Prediction:
        """Predict maps of the n hours of `light`, [n, H, W].

        patch_cdm2: luminance by direct sun in these hours [n, H, W]. Raises ValueError without it
        for a network trained with sun patches; other networks do not use it. The network has no
        variance: `log10_sd` is None, the expected error NaN, and `trusted` only means that the
        hour's light is similar to captured light.
        """
        if self.patch != "none" and patch_cdm2 is None:
            raise ValueError("this network was trained with sun patches: pass patch_cdm2")
        height, width = self.average_log10.shape
        out = np.empty((len(light), height, width), np.float32)
        fast = bfloat16_pays(self._device)
        with (
            torch.inference_mode(),
            torch.autocast(self._device.type, torch.bfloat16, enabled=fast),
        ):
            for k, encoded in enumerate(self._encoded(light, patch_cdm2)):
                out[k] = decode(encoded, self.shape.curve).reshape(height, width)
        return Prediction(out, None, np.full(len(out), np.nan), self.domain.holds(light))

    def state(self) -> ModelState:
        """Return what config.json and weights.npz must contain for `from_state` to rebuild it."""
        config = {
            "shape": asdict(self.shape),
            "patch": self.patch,
            "inputs": ["px", "py", "altitude", "azimuth", "dni", "dhi", "average"]
            + ["sky"] * self.shape.sky_map,
            "normalisation": {
                "floor_cdm2": 1.0,
                "log10_top": LOG_TOP,
                "power": POWER,
                "dni_top_wm2": DNI_TOP_WM2,
                "dhi_top_wm2": DHI_TOP_WM2,
            },
            "domain": self.domain.state(),
            "dense_training": self.training,
        }
        weights = {
            f"net.{name}": value.detach().cpu().numpy()
            for name, value in self.net.state_dict().items()
        }
        return ModelState(config, {"average_log10": self.average_log10, **weights})


def from_state(state: ModelState) -> DenseFitted:
    """Return the network that the content of a model folder describes.

    Raises KeyError, TypeError or ValueError for missing or wrong content.
    """
    config, arrays = state.config, state.arrays
    shape = Shape(**config["shape"])
    net = Net(shape)
    weights = {
        k.removeprefix("net."): torch.from_numpy(v.copy())
        for k, v in arrays.items()
        if k.startswith("net.")
    }
    try:
        net.load_state_dict(weights)
    except RuntimeError as error:
        raise ValueError(str(error).splitlines()[0]) from None
    domain = Domain.from_state(config["domain"])
    about = config["dense_training"]
    return DenseFitted(
        net, shape, arrays["average_log10"], config["heading_deg"], config["patch"], domain, about
    )


def fit(
    data: Dataset,
    *,
    patch: Patch = "absolute",
    seed: int = 0,
    budget_s: float | None = None,
    progress: Progress = quiet,
    **options: Any,
) -> DenseFitted:
    """Train the network on `data`; seed: of all random numbers; budget_s: time for training [s].

    patch: with "none" sun patches are not an input, otherwise they are one in cd/m2. budget_s None:
    no limit. options: fields of `Shape`, and other arguments of `dense_training.train`, such as its
    plan and the path of a checkpoint. Raises InputError for a checkpoint that cannot be used.
    """
    shape = Shape(
        **{name: options.pop(name) for name in list(options) if name in Shape.__dataclass_fields__}
    )
    net, average, record = train(
        data, shape, patch=patch, seed=seed, budget_s=budget_s, progress=progress, **options
    )
    domain, about = captured(data.light), asdict(record)
    return DenseFitted(net, shape, average, data.heading_deg, patch, domain, about)
