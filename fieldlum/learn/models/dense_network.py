"""Define the paper's network: two dense branches.

One branch has the inputs pixel position, mean luminance, sun, irradiance and sky, the other the sun
patch. Source: Liu, Colburn, Inanici, Deep Neural Network Approach for Annual Luminance Simulations,
J. Building Performance Simulation 13(5), 2020. Inputs, sizes, loss and schedule follow the paper;
where the authors' code differs from their text, the text is followed. This module has the network,
its inputs and outputs; `dense_training` has the loop, `dense_schedule` batches and rates, `dense`
the fit.
"""

from __future__ import annotations

import itertools
import os
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from fieldlum.core.arrays import Array, Floats, Floats32
from fieldlum.optics.projection import equirect_rays, signed_angle_deg
from fieldlum.sky.light import Light
from fieldlum.sky.perez import reinhart_patches

LOG_TOP = 9.2  # log10 of 1.6e9 cd/m2, the sun's disc (paper)
POWER = 1.0 / 1.5  # of the paper's preprocessing
GAMMA = 10.0  # of the paper's preprocessing without a logarithm
DNI_TOP_WM2, DHI_TOP_WM2 = 1100.0, 700.0  # normalisation of the paper's inputs


@dataclass(frozen=True, slots=True)
class Shape:
    """The form of the network of Liu, Colburn and Inanici (2020).

    width, depth: units of each layer and number of layers in branch one; patch_width: units of
    branch two (200 in the form "cnn", by `dense_training.train`); sky_map: whether the luminance of
    the sky patch behind a pixel is an input; form: "cnn" trains with complete images as batches, as
    convolutions with kernel 1 would; curve: encoding of luminance, see `encode`. The defaults are
    the paper's final form, other values its ablations (Table 1 and Figure 8).
    """

    width: int = 600
    depth: int = 4
    patch_width: int = 400
    sky_map: bool = True
    form: Literal["dense", "cnn"] = "dense"
    curve: Literal["log", "gamma"] = "log"


# ----------------------------------------------------------------------------------------------
# normalisation


def encode(luminance_cdm2: Array, curve: str = "log") -> Floats32:
    """Return luminance encoded for the network, in the same shape: 1.6e9 cd/m2 becomes 1.

    Luminance below 1 cd/m2 counts as 1. The curve "log" is (log10 L / 9.2)^(1/1.5); "gamma" is (L /
    1.6e9)^(1/10). Larger luminances than 1.6e9 cd/m2 give values above 1.
    """
    floored = np.maximum(luminance_cdm2, 1.0)
    if curve == "gamma":
        return ((floored / 10.0**LOG_TOP) ** (1.0 / GAMMA)).astype(np.float32)
    return ((np.log10(floored) / LOG_TOP) ** POWER).astype(np.float32)


def decode(encoded: Array, curve: str = "log") -> Floats32:
    """Return the luminance [cd/m2] of values encoded by `encode` with the same curve.

    Values outside [0, 1] are clipped first, which bounds every prediction: the least result is 1,
    the largest 1.6e9 cd/m2.
    """
    inside = np.clip(encoded, 0.0, 1.0)
    if curve == "gamma":
        return np.maximum(10.0**LOG_TOP * inside**GAMMA, 1.0).astype(np.float32)
    return (10.0 ** (LOG_TOP * inside ** (1.0 / POWER))).astype(np.float32)


# ----------------------------------------------------------------------------------------------
# network


class Net(nn.Module):
    """The network of Liu, Colburn and Inanici (2020): two branches that are merged.

    Branch one has position, sun, irradiance, mean luminance and sky of a pixel as inputs, branch
    two the luminance of the sun patch there. With the default sizes the network has 1 689 201
    parameters, or 1 688 601 without the sky as the eighth input of branch one.
    """

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        sizes = [8 if shape.sky_map else 7] + [shape.width] * shape.depth
        self.scene = nn.ModuleList(nn.Linear(a, b) for a, b in itertools.pairwise(sizes))
        self.patch = nn.Linear(1, shape.patch_width)
        self.merge = nn.Linear(shape.width + shape.patch_width, shape.width)
        self.out = nn.Linear(shape.width, 1)

    def forward(self, scene: Tensor, patch: Tensor) -> Tensor:
        """Return the encoded luminance [b] of b pairs of an hour and a pixel.

        scene: input of branch one, by `scene_inputs` [b, 7 or 8]; patch: input of branch two, the
        encoded luminance of the sun patch [b, 1].
        """
        x = scene
        for layer in self.scene:
            x = F.relu(layer(x))
        x = torch.cat([x, F.relu(self.patch(patch)).to(x.dtype)], dim=1)
        x = F.relu(self.merge(x))
        with torch.autocast(
            x.device.type, enabled=False
        ):  # compute the last sum in full precision, because it is the result
            return self.out(x.float()).squeeze(1)


def parameter_count(net: nn.Module) -> int:
    """Return the number of values in all parameter arrays of a network."""
    return sum(p.numel() for p in net.parameters())


# ----------------------------------------------------------------------------------------------
# inputs


@dataclass(frozen=True, slots=True)
class Canvas:
    """Inputs of P pixels that do not depend on the hour.

    fixed: x, y (0 to 1 from the left and the top) and encoded mean luminance [P, 3]; sky_patch:
    index from 0 of the nearest of 2305 sky patches, -1 at or below the horizon [P].
    """

    fixed: Tensor
    sky_patch: Tensor

    def to(self, device: torch.device) -> Canvas:
        """Return a copy whose tensors are on the device."""
        return Canvas(self.fixed.to(device), self.sky_patch.to(device))


def canvas(average_log10: Floats, heading_deg: float) -> Canvas:
    """Return the inputs of all P = H W pixels, row by row, that do not depend on the hour.

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
    return Canvas(torch.from_numpy(fixed.astype(np.float32)), torch.from_numpy(nearest))


@dataclass(frozen=True, slots=True)
class HourInputs:
    """Inputs of n hours that do not depend on the pixel.

    sun: the sun's altitude and azimuth, DNI and DHI, scaled as in `hours` [n, 4]; sky: encoded
    luminance of the 2305 sky patches [n, 2306], whose last column is 0, for pixels at or below the
    horizon; None without a sky map.
    """

    sun: Tensor
    sky: Tensor | None

    def to(self, device: torch.device) -> HourInputs:
        """Return a copy whose tensors are on the device."""
        return HourInputs(self.sun.to(device), None if self.sky is None else self.sky.to(device))


def hours(light: Light, shape: Shape) -> HourInputs:
    """Return the network's inputs of the hours of `light`, scaled to about 0 to 1.

    Altitude is divided by 90 degrees, DNI by 1100 and DHI by 700 W/m2; azimuth is 0 at north, 0.5
    at south and 0.75 at west. shape: its sky_map and curve are used.
    """
    from_south = signed_angle_deg(light.sun_azimuth_deg - 180.0)  # west positive
    columns = (
        light.sun_altitude_deg / 90.0,
        (from_south + 180.0) / 360.0,
        light.dni_wm2 / DNI_TOP_WM2,
        light.dhi_wm2 / DHI_TOP_WM2,
    )
    sky = None
    if shape.sky_map:
        sky = torch.from_numpy(np.pad(encode(light.sky_cdm2, shape.curve), ((0, 0), (0, 1))))
    return HourInputs(torch.from_numpy(np.stack(columns, axis=1).astype(np.float32)), sky)


def scene_inputs(canvas: Canvas, hours: HourInputs, hour: Tensor, pixel: Tensor) -> Tensor:
    """Return the input of branch one for b pairs of an hour and a pixel, [b, 7 or 8].

    hour, pixel: indices from 0 into `hours` and `canvas` [b]. Columns: x, y, altitude, azimuth,
    DNI, DHI, mean luminance and, with a sky map, the sky patch.
    """
    fixed, sun = canvas.fixed[pixel], hours.sun[hour]
    columns = [fixed[:, :2], sun, fixed[:, 2:]]
    if hours.sky is not None:
        columns.append(hours.sky[hour, canvas.sky_patch[pixel]].unsqueeze(1))
    return torch.cat(columns, dim=1)


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
    return "AVX512" in capability and _cpu_has("avx512_bf16")


def _cpu_has(flag: str) -> bool:
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="ignore") as file:  # noqa: PTH123
            return any(flag in line.split() for line in file if line.startswith("flags"))
    except OSError:
        return False
