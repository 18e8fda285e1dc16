"""Provide the network of Liu, Colburn and Inanici (2020) as a model: two dense branches.

One branch has the inputs pixel position, mean luminance, sun, irradiance and sky, the other the sun
patch. Source: Deep Neural Network Approach for Annual Luminance Simulations, J. Building
Performance Simulation 13(5), 2020. Inputs, sizes and loss follow the paper; where the authors' code
differs from their text, the text is followed. `dense_training` has the loop.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from fieldlum.core.arrays import Array, Floats, Floats32
from fieldlum.learn.models import ModelState, Patch, Prediction
from fieldlum.learn.models.baselines import Domain
from fieldlum.optics.projection import equirect_rays, signed_angle_deg
from fieldlum.sky.light import Light
from fieldlum.sky.perez import reinhart_patches

LOG_TOP = 9.2  # log10 of 1.6e9 cd/m2, the sun's disc (paper)
POWER = 1.0 / 1.5  # of the paper's preprocessing
DNI_TOP_WM2, DHI_TOP_WM2 = 1100.0, 700.0  # normalisation of the paper's inputs


@dataclass(frozen=True, slots=True)
class Shape:
    """The form of the network of Liu, Colburn and Inanici (2020).

    width, depth: units of each layer and number of layers in branch one; patch_width: units of
    branch two. The defaults are the paper's final form.
    """

    width: int = 600
    depth: int = 4
    patch_width: int = 400


def encode(luminance_cdm2: Array) -> Floats32:
    """Return luminance encoded for the network, in the same shape: (log10 L / 9.2)^(1/1.5).

    Luminance below 1 cd/m2 counts as 1. Larger luminances than 1.6e9 cd/m2 give values above 1.
    """
    return ((np.log10(np.maximum(luminance_cdm2, 1.0)) / LOG_TOP) ** POWER).astype(np.float32)


def decode(encoded: Array) -> Floats32:
    """Return the luminance [cd/m2] of encoded values; they are clipped to [0, 1] first.

    That bounds every prediction: the least result is 1, the largest 1.6e9 cd/m2.
    """
    inside = np.clip(encoded, 0.0, 1.0)
    return (10.0 ** (LOG_TOP * inside ** (1.0 / POWER))).astype(np.float32)


class Net(nn.Module):
    """The network of Liu, Colburn and Inanici (2020): two branches that are merged.

    Branch one has position, sun, irradiance, mean luminance and sky of a pixel as inputs, branch
    two the luminance of the sun patch there. With the default sizes the network has 1 689 201
    parameters.
    """

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        sizes = [8] + [shape.width] * shape.depth
        self.scene = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        self.patch = nn.Linear(1, shape.patch_width)
        self.merge = nn.Linear(shape.width + shape.patch_width, shape.width)
        self.out = nn.Linear(shape.width, 1)

    def forward(self, scene: Tensor, patch: Tensor) -> Tensor:
        """Return the encoded luminance [b] of b pairs of an hour and a pixel.

        scene: input of branch one, by `Inputs.scene` [b, 8]; patch: input of branch two, the
        encoded luminance of the sun patch [b, 1].
        """
        x = scene
        for layer in self.scene:
            x = F.relu(layer(x))
        x = torch.cat([x, F.relu(self.patch(patch)).to(x.dtype)], dim=1)
        x = F.relu(self.merge(x))
        with torch.autocast(x.device.type, enabled=False):  # the result needs full precision
            return self.out(x.float()).squeeze(1)


def parameter_count(net: nn.Module) -> int:
    """Return the number of values in all parameter arrays of a network."""
    return sum(p.numel() for p in net.parameters())


# ----------------------------------------------------------------------------------------------
# inputs


@dataclass(frozen=True, slots=True)
class Inputs:
    """Inputs of branch one for all pairs of one of n hours and one of P pixels.

    pixel: x, y (0 to 1 from the left and the top) and encoded mean luminance [P, 3]; sky_patch:
    index of the nearest of 2305 sky patches, -1 at or below the horizon [P]; sun: altitude,
    azimuth, DNI and DHI, scaled to about 0 to 1 [n, 4]; sky: encoded luminance of the sky patches
    [n, 2306], whose last column is 0, for pixels at or below the horizon.
    """

    pixel: Tensor
    sky_patch: Tensor
    sun: Tensor
    sky: Tensor

    def scene(self, hour: Tensor, pixel: Tensor) -> Tensor:
        """Return the input of branch one for b pairs of an hour and a pixel, [b, 8].

        hour, pixel: indices from 0 [b]. Columns: x, y, altitude, azimuth, DNI, DHI, mean luminance,
        sky patch.
        """
        fixed, sky = self.pixel[pixel], self.sky[hour, self.sky_patch[pixel]]
        return torch.cat([fixed[:, :2], self.sun[hour], fixed[:, 2:], sky.unsqueeze(1)], dim=1)

    def at(self, light: Light) -> Inputs:
        """Return the inputs of the same pixels in the hours of `light`.

        Altitude is divided by 90 degrees, DNI by 1100 and DHI by 700 W/m2; azimuth is 0 at north,
        0.5 at south and 0.75 at west.
        """
        from_south = signed_angle_deg(light.sun_azimuth_deg - 180.0)  # west positive
        columns = (
            light.sun_altitude_deg / 90.0,
            (from_south + 180.0) / 360.0,
            light.dni_wm2 / DNI_TOP_WM2,
            light.dhi_wm2 / DHI_TOP_WM2,
        )
        device = self.pixel.device
        sky = np.pad(encode(light.sky_cdm2), ((0, 0), (0, 1)))
        sun = torch.from_numpy(np.stack(columns, axis=1).astype(np.float32)).to(device)
        return replace(self, sun=sun, sky=torch.from_numpy(sky).to(device))


def inputs_of(average_log10: Floats, heading_deg: float, device: torch.device) -> Inputs:
    """Return the inputs of all P = H W pixels, row by row, for no hour yet (`Inputs.at`).

    average_log10: mean of log10 L [cd/m2] over training images, at least 0 [H, W]; heading_deg:
    azimuth of the maps' centre column, clockwise from north.
    """
    height, width = average_log10.shape
    y, x = np.mgrid[0:height, 0:width]
    average = (average_log10 / LOG_TOP) ** POWER
    fixed = np.stack([x / (width - 1), y / (height - 1), average], axis=-1).reshape(-1, 3)
    rays = equirect_rays(height, width, heading_deg).reshape(-1, 3)
    nearest = np.full(len(rays), -1)
    up = np.flatnonzero(rays[:, 2] > 0)
    directions = reinhart_patches().directions
    for rows in np.array_split(up, max(1, len(up) // 8192)):
        nearest[rows] = (rays[rows] @ directions.T).argmax(axis=1)
    pixel = torch.from_numpy(fixed.astype(np.float32)).to(device)
    empty = torch.empty(0, 4), torch.empty(0, 2306)
    return Inputs(pixel, torch.from_numpy(nearest).to(device), *empty)


# ----------------------------------------------------------------------------------------------
# processor


def pick_device() -> torch.device:
    """Return the GPU of this process, or the CPU if there is no GPU.

    With torchrun, process k of a machine gets its GPU number k.
    """
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))


def bfloat16_pays(device: torch.device) -> bool:
    """Return whether the hardware itself computes products in bfloat16.

    Emulated ones are slower than float32.
    """
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capability = torch.backends.cpu.get_cpu_capability()
    flags = Path("/proc/cpuinfo")
    native = flags.is_file() and "avx512_bf16" in flags.read_text(errors="ignore").split()
    return "AVX512" in capability and native


# ----------------------------------------------------------------------------------------------
# the model


class DenseFitted:
    """A trained network with everything that its prediction needs.

    net, shape: the network and its form; average_log10: mean of log10 L over the training images
    [H, W]; heading_deg: azimuth of the maps' centre column; patch: how sun patches are used;
    domain: range of light in the captures; training: what config.json records of it; parameters:
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
        self._device = pick_device()
        self.net, self.shape, self.patch = net.eval().to(self._device), shape, patch
        self.domain, self.training = domain, training
        self.average_log10, self.heading_deg = average_log10, heading_deg
        self.parameters = parameter_count(net)
        self._inputs = inputs_of(average_log10, heading_deg, self._device)

    def _encoded(self, light: Light, patch_cdm2: Floats32 | None) -> Iterator[Floats32]:
        """Yield the encoded map [H W] of each hour."""
        inputs = self._inputs.at(light)
        pixels = torch.arange(len(inputs.pixel), device=self._device)  # [H W]
        direct = torch.zeros(len(pixels), 1, device=self._device)
        for k in range(len(light)):
            if patch_cdm2 is not None and self.patch != "none":
                encoded = torch.from_numpy(encode(patch_cdm2[k].reshape(-1, 1)))
                direct = encoded.to(self._device)
            # pixels of a chunk that fits into the processor's cache
            parts = [
                self.net(inputs.scene(torch.full_like(pixel, k), pixel), direct[pixel])
                for pixel in pixels.split(16384)
            ]
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
        device, fast = self._device, bfloat16_pays(self._device)
        with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=fast):
            for k, encoded in enumerate(self._encoded(light, patch_cdm2)):
                out[k] = decode(encoded).reshape(height, width)
        return Prediction(out, None, np.full(len(out), np.nan), self.domain.holds(light))

    def state(self) -> ModelState:
        """Return what config.json and weights.npz must contain for `from_state` to rebuild it."""
        config = {
            "shape": asdict(self.shape),
            "patch": self.patch,
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
    table = config["shape"]
    if table.get("curve", "log") != "log":  # a variant of earlier versions
        raise ValueError("a network with another encoding of luminance")
    shape = Shape(table["width"], table["depth"], table["patch_width"])
    net = Net(shape)
    weights = {
        name.removeprefix("net."): torch.from_numpy(value.copy())
        for name, value in arrays.items()
        if name.startswith("net.")
    }
    try:
        net.load_state_dict(weights)
    except RuntimeError as error:
        raise ValueError(str(error).splitlines()[0]) from None
    domain, about = Domain.from_state(config["domain"]), config["dense_training"]
    average, heading_deg = arrays["average_log10"], config["heading_deg"]
    return DenseFitted(net, shape, average, heading_deg, config["patch"], domain, about)
