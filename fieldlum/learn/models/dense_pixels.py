"""Provide training pixels of the dense network: pairs of an hour and a seen pixel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fieldlum.core.arrays import Floats32
from fieldlum.learn.models import Patch
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.dense_network import (
    Canvas,
    HourInputs,
    Shape,
    encode,
    hours,
    scene_inputs,
)


@dataclass(frozen=True, slots=True)
class PixelSampler:
    """All pairs of one of n hours and one of P seen pixels, as tensors on one device.

    The index of a pair is hour times P plus the pixel's index in `seen`. canvas, hours: inputs of
    all pixels and of the n hours; target: encoded luminance of the map [n, P]; patch: that of the
    sun patch [n, P], None without patches; weight: solid angle of the pixel over the mean of the
    seen pixels [P]; seen: flat index of the pixel in the map [P]; counts: further weight of a pixel
    in an hour [n, P], None for 1. The length is n times P.
    """

    canvas: Canvas
    hours: HourInputs
    target: Tensor
    patch: Tensor | None
    weight: Tensor
    seen: Tensor
    counts: Tensor | None = None

    def __len__(self) -> int:
        return self.target.numel()

    def batch(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return inputs, targets and weights of b pairs of an hour and a pixel.

        numbers: indices of the pairs [b]. The results are the scene inputs [b, 7 or 8], the encoded
        luminance of the sun patch [b, 1] (0 without patches), the encoded target [b] and the weight
        in the loss [b].
        """
        hour = numbers // len(self.seen)
        place = numbers - hour * len(self.seen)
        scene = scene_inputs(self.canvas, self.hours, hour, self.seen[place])
        direct = torch.zeros_like(scene[:, 0]) if self.patch is None else self.patch[hour, place]
        weight = self.weight[place]
        if self.counts is not None:
            weight = weight * self.counts[hour, place]
        return scene, direct.unsqueeze(1), self.target[hour, place], weight


def pixels_of(
    data: Dataset, base: Canvas, shape: Shape, patch: Patch, device: torch.device
) -> PixelSampler:
    """Return all pairs of an hour of `data` and a seen pixel, encoded, on the device.

    base: inputs of the pixels that do not depend on the hour, by `canvas`. shape: its curve and
    sky_map are used. patch: with "none" sun patches are left out, otherwise they are used in cd/m2.
    """
    seen_index = np.flatnonzero(data.seen)

    def flat(maps: Floats32) -> Tensor:
        rows = [torch.from_numpy(encode(m.reshape(-1)[seen_index], shape.curve)) for m in maps]
        return torch.stack(rows).to(device)

    use_patch = patch != "none" and data.patch_cdm2 is not None
    weight = torch.from_numpy(data.weights.reshape(-1)[seen_index].astype(np.float32))
    counts = None
    if data.counts is not None:
        counts = torch.from_numpy(data.counts.reshape(len(data), -1)[:, seen_index]).to(device)
    return PixelSampler(
        base.to(device),
        hours(data.light, shape).to(device),
        flat(data.luminance_cdm2),
        flat(data.patch_cdm2) if use_patch and data.patch_cdm2 is not None else None,
        weight.to(device),
        torch.from_numpy(seen_index).to(device),
        counts,
    )
