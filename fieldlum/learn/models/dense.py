"""The network of Liu, Colburn and Inanici (2020): two dense branches, and its training.

One branch has the inputs pixel position, mean luminance, sun, irradiance and sky, the other the sun
patch. Source: Deep Neural Network Approach for Annual Luminance Simulations, J. Building
Performance Simulation 13(5), 2020. Inputs, sizes and loss follow the paper; where the authors' code
differs from their text, the text is followed.

The loss of a batch is ``S / b + 10 sqrt(S / T)``, with S = sum(w e^2) and T = sum(w t^2) over its b
pixels, their weights w, errors e and targets t. The loss depends on the network only through S, so
that torchrun's processes add up S, T and b before, and the gradients after the backward pass.
"""

import itertools
import math
import os
import pickle
import time
import warnings
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from fieldlum.core.arrays import Array, Floats, Floats32, Ints64
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.progress import progress
from fieldlum.learn.models import ModelState, Patch, Prediction, deserialised, serialised
from fieldlum.learn.models.baselines import Domain, domain_of
from fieldlum.learn.models.training_data import Dataset
from fieldlum.optics.projection import equirect_rays, signed_angle_deg
from fieldlum.session import codec, replacing
from fieldlum.sky.daylight import Light
from fieldlum.sky.perez import reinhart_patches

LOG_TOP = 9.2  # log10 of 1.6e9 cd/m2, the sun's disc (paper)
POWER = 1.0 / 1.5  # of the paper's preprocessing
# Largest number of uses of each training pixel (paper), and number of validations and checkpoints.
PASSES, EPOCHS = 90, 25
# Number of updates that a training shall reach before its batches become larger than the smallest,
# and limits of the pixels of a batch by kind of processor.
STEPS, MIN_BATCH, MAX_BATCH = 3000, 512, {"cpu": 8192, "cuda": 131_072}


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
    """Return luminance as the network's input: (log10 L / 9.2)^(1/1.5), in the same shape.

    The formula is the preprocessing of Liu, Colburn and Inanici (2020); 9.2 is log10 of the
    luminance of the sun's disc, 1.6e9 cd/m2. luminance_cdm2: [...]; values below 1 cd/m2 count as
    1, and values above 1.6e9 cd/m2 give results above 1.
    """
    return ((np.log10(np.maximum(luminance_cdm2, 1.0)) / LOG_TOP) ** POWER).astype(np.float32)


def decode(encoded: Array) -> Floats32:
    """Return the luminance [cd/m2] of values that `encode` returned, in the same shape [...].

    It is the inverse of `encode`, 10^(9.2 x^1.5). Values x are limited to 0 to 1, so that every
    prediction is between 1 and 1.6e9 cd/m2.
    """
    return (10.0 ** (LOG_TOP * np.clip(encoded, 0.0, 1.0) ** (1.0 / POWER))).astype(np.float32)


class Net(nn.Module):
    """The network of Liu, Colburn and Inanici (2020): two branches that are merged.

    Branch one has position, sun, irradiance, mean luminance and sky of a pixel as inputs, branch
    two the luminance of the pixel's sun patch. With the default `Shape` the network has 1 689 201
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
        x = torch.cat([x, F.relu(self.patch(patch))], dim=1)
        x = F.relu(self.merge(x))
        return self.out(x).squeeze(1)


# ----------------------------------------------------------------------------------------------
# inputs


@dataclass(frozen=True, slots=True)
class Inputs:
    """Inputs of branch one (docs/models.md) of n hours and of P pixels, to be combined in pairs.

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

    def at(self, light: Light) -> Self:
        """Return the inputs of the same pixels in the hours of `light`.

        Altitude is divided by 90 degrees, DNI by 1100 and DHI by 700 W/m2, as in the paper; azimuth
        is 0 at north, 0.5 at south and 0.75 at west.
        """
        azimuth_deg = signed_angle_deg(light.sun_azimuth_deg - 180.0) + 180.0
        columns = (light.sun_altitude_deg, azimuth_deg, light.dni_wm2, light.dhi_wm2)
        scaled = np.stack(columns, axis=1) / (90.0, 360.0, 1100.0, 700.0)
        device = self.pixel.device
        sky = np.pad(encode(light.sky_cdm2), ((0, 0), (0, 1)))
        sun = torch.from_numpy(scaled.astype(np.float32)).to(device)
        return replace(self, sun=sun, sky=torch.from_numpy(sky).to(device))


def inputs_of(average_log10: Floats, heading_deg: float, device: torch.device) -> Inputs:
    """Return the inputs of all P = H W pixels, row by row, without hours; `Inputs.at` adds these.

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
    for rows in np.array_split(up, max(1, len(up) // 8192)):  # limits the memory
        nearest[rows] = (rays[rows] @ directions.T).argmax(axis=1)
    return Inputs(
        pixel=torch.from_numpy(fixed.astype(np.float32)).to(device),
        sky_patch=torch.from_numpy(nearest).to(device),
        sun=torch.empty(0, 4),
        sky=torch.empty(0, 2306),
    )


def pick_device() -> torch.device:
    """Return the GPU of this process, or the CPU if there is no GPU.

    With torchrun, process k of a machine gets its GPU number k.
    """
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))


# ----------------------------------------------------------------------------------------------
# the model


@dataclass(frozen=True)
class DenseFitted:
    """A trained network with everything that its prediction needs.

    net, shape: the network and its form; average_log10: mean of log10 L [cd/m2] over the training
    images [H, W]; heading_deg: azimuth of the maps' centre column, clockwise from north; patch: how
    sun patches are used; domain: range of light in the captures; training: what config.json records
    of the training; held_out_mse: None, because errors on days without captures are not computed
    for a network.
    """

    net: Net
    shape: Shape
    average_log10: Floats
    heading_deg: float
    patch: Patch
    domain: Domain
    training: Mapping[str, Any]
    name: str = field(default="dense", init=False)
    held_out_mse: None = field(default=None, init=False)

    @property
    def parameters(self) -> int:
        """Number of fitted values."""
        return sum(p.numel() for p in self.net.parameters())

    def predict(self, light: Light, patch_cdm2: Floats32 | None = None) -> Prediction:
        """Predict maps of the n hours of `light`, [n, H, W] cd/m2.

        patch_cdm2: luminance by direct sun in these hours [n, H, W]. Raises ValueError without it
        for a network trained with sun patches; other networks do not use it. The network has no
        variance: `log10_sd` is None, the expected error NaN, and `trusted` only means that the
        hour's light is similar to captured light.
        """
        if self.patch != "none" and patch_cdm2 is None:
            raise ValueError("this network was trained with sun patches: pass patch_cdm2")
        device, net = pick_device(), self.net.eval().to(pick_device())
        inputs = inputs_of(self.average_log10, self.heading_deg, device).at(light)
        pixels = torch.arange(len(inputs.pixel), device=device)  # [H W]
        direct = torch.zeros(len(pixels), 1, device=device)
        out = np.empty((len(light), *self.average_log10.shape), np.float32)
        with torch.inference_mode():
            for k in range(len(light)):
                if patch_cdm2 is not None and self.patch != "none":
                    direct = torch.from_numpy(encode(patch_cdm2[k].reshape(-1, 1))).to(device)
                # 16 384 pixels at a time, which fit into the processor's cache
                parts = [
                    net(inputs.scene(torch.full_like(chunk, k), chunk), direct[chunk])
                    for chunk in pixels.split(16384)
                ]
                out[k] = decode(torch.cat(parts).cpu().numpy()).reshape(out.shape[1:])
        return self.domain.prediction(out, light)

    def state(self) -> ModelState:
        """Return what config.json and weights.npz must contain for `from_state` to rebuild it."""
        arrays: dict[str, Array] = {"average_log10": self.average_log10}
        config = {
            "shape": asdict(self.shape),
            "patch": self.patch,
            "domain": serialised(self.domain, "domain.", arrays),
            "dense_training": self.training,
        }
        for name, value in self.net.state_dict().items():
            arrays[f"net.{name}"] = value.detach().cpu().numpy()
        return ModelState(config, arrays)


def from_state(state: ModelState) -> DenseFitted:
    """Return the network that the content of a model folder describes.

    Raises KeyError, RuntimeError, TypeError or ValueError for missing or wrong content.
    """
    config, arrays = state.config, state.arrays
    shape = deserialised(Shape, config["shape"], arrays)
    net = Net(shape)
    weights = {
        name.removeprefix("net."): torch.from_numpy(value.copy())
        for name, value in arrays.items()
        if name.startswith("net.")
    }
    net.load_state_dict(weights)
    domain, about = deserialised(Domain, config["domain"], arrays), config["dense_training"]
    average, heading_deg = arrays["average_log10"], config["heading_deg"]
    return DenseFitted(net, shape, average, heading_deg, config["patch"], domain, about)


# ----------------------------------------------------------------------------------------------
# processes of torchrun; without it there is one


def rank() -> int:
    """Return the number of this process among torchrun's processes, from 0; 0 without torchrun."""
    return int(os.environ.get("RANK", "0"))


def world() -> int:
    """Return the number of processes that torchrun started; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def sum_over_ranks(tensor: Tensor) -> Tensor:
    """Replace each value of `tensor`, in place, by its sum over all processes; return it."""
    if world() > 1:
        torch.distributed.all_reduce(tensor)
    return tensor


def rank_0_value(value: float, device: torch.device) -> float:
    """Return in every process the `value` (such as elapsed seconds) of the process with rank 0.

    With it, all processes decide equally when training ends. device: of this process.
    """
    shared = torch.tensor([value if rank() == 0 else 0.0], dtype=torch.float64, device=device)
    return float(sum_over_ranks(shared).item())


# ----------------------------------------------------------------------------------------------
# pixels


@dataclass(frozen=True, slots=True)
class PixelSampler:
    """All pairs of one of n hours and one of P seen pixels, as tensors on one device.

    The index of a pair is the hour's index times P plus the pixel's index in `seen`. inputs: of all
    pixels of the map in the n hours; target: luminance of the map, encoded by `encode` to about 0
    to 1 [n, P]; patch: luminance of the sun patch, encoded in the same way, 0 without patches
    [n, P]; weight: of the pair in the loss: solid angle of the pixel divided by the mean one, times
    the weight of its value in training [n, P]; seen: flat index of each pixel in the map [P]. The
    length is n times P.
    """

    inputs: Inputs
    target: Tensor
    patch: Tensor
    weight: Tensor
    seen: Tensor

    def __len__(self) -> int:
        return self.target.numel()

    def batch(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return inputs, targets and weights of b pairs of an hour and a pixel.

        numbers: indices of the pairs [b]. The results are the scene inputs [b, 8], the encoded
        luminance of the sun patch [b, 1], the encoded target [b] and the weight in the loss [b].
        """
        hour, pixel = numbers // len(self.seen), numbers % len(self.seen)
        scene, direct = self.inputs.scene(hour, self.seen[pixel]), self.patch[hour, pixel]
        return scene, direct.unsqueeze(1), self.target[hour, pixel], self.weight[hour, pixel]


def pixels_of(data: Dataset, pixels: Inputs, patch: Patch, device: torch.device) -> PixelSampler:
    """Return all pairs of an hour of `data` and a seen pixel, encoded, on the device.

    pixels: result of `inputs_of`; patch: with "none" sun patches are left out.
    """

    def encoded(maps: Floats32) -> Tensor:
        """Return the encoded luminance of the P seen pixels of maps [n, H, W], [n, P]."""
        return torch.from_numpy(np.stack([encode(m[data.seen]) for m in maps])).to(device)

    target = encoded(data.luminance_cdm2)
    patches = None if patch == "none" else data.patch_cdm2
    weight = np.broadcast_to(data.weights[data.seen], target.shape)
    weight = weight if data.counts is None else weight * data.counts[:, data.seen]
    return PixelSampler(
        inputs=pixels.at(data.light),
        target=target,
        patch=torch.zeros_like(target) if patches is None else encoded(patches),
        weight=torch.from_numpy(weight.astype(np.float32)).to(device),
        seen=torch.from_numpy(np.flatnonzero(data.seen)).to(device),
    )


def validation_split(n: int, seed: int) -> tuple[Ints64, Ints64]:
    """Return the indices from 0 of images for training [k] and for validation [n - k], each sorted.

    A tenth of the n images, but at least one, is drawn by `seed` for validation; a single image is
    used for both.
    """
    order = np.random.default_rng(seed).permutation(n)
    cut = max(1, round(0.1 * n))
    return (np.sort(order[cut:]), np.sort(order[:cut])) if n > 1 else (order, order)


# ----------------------------------------------------------------------------------------------
# one batch


class Trainer:
    """A network in training, with its training pixels and Adam, as the paper trains it.

    largest: limit of the pixels of a batch (`MAX_BATCH`).
    """

    def __init__(self, net: Net, pixels: PixelSampler) -> None:
        self.net, self.pixels = net, pixels
        self.largest = MAX_BATCH[pixels.target.device.type]
        self.optimiser = torch.optim.Adam(net.parameters(), fused=True)

    def sums(self, pixels: PixelSampler, numbers: Tensor) -> Tensor:
        """Return three sums over this process's part of a batch, for `loss_value`, [3].

        They are the weighted squared errors, the weighted squared targets (both of encoded
        luminance), and the number of pixels. numbers: indices of the batch's pairs in `pixels`.
        """
        scene, direct, target, weight = pixels.batch(numbers[rank() :: world()])
        error = self.net(scene, direct) - target
        count = torch.tensor(float(len(target)), device=target.device)
        return torch.stack([(weight * v.square()).sum() for v in (error, target)] + [count])

    def step(self, numbers: Tensor, rate: float) -> float:
        """Update the weights once by the exact gradient of the batch's loss; return that loss.

        numbers: indices of the batch's pairs; rate: learning rate; loss: `loss_value`, NaN if it is
        not finite: then the weights do not change. With E and T the weighted sums of squared errors
        and targets of the batch's b pixels, the loss is E / b + 10 sqrt(E / T), so that its
        gradient is that of E times 1 / b + 5 / sqrt(E T). Each process differentiates its own part
        of E, and the parts are summed.
        """
        self.optimiser.param_groups[0]["lr"] = rate
        self.optimiser.zero_grad()
        own_parts = self.sums(self.pixels, numbers)  # of this process
        parts = sum_over_ranks(own_parts.detach().double())
        error, target, count = parts.tolist()
        if not math.isfinite(error):
            return math.nan
        factor = 1.0 / count + 5.0 / math.sqrt(max(error * target, 1e-24))
        (factor * own_parts[0]).backward()
        for parameter in self.net.parameters():
            if parameter.grad is not None:
                sum_over_ranks(parameter.grad)
        self.optimiser.step()
        return loss_value(parts)

    def validate(self, pixels: PixelSampler, numbers: Tensor) -> float:
        """Return the loss (`loss_value`) of some pairs of held-out `pixels`, over all processes.

        numbers: indices of the pairs.
        """
        with torch.no_grad():
            parts = [self.sums(pixels, batch).double() for batch in numbers.split(self.largest)]
        return loss_value(sum_over_ranks(torch.stack(parts).sum(dim=0)))

    def pixels_per_s(self) -> float:
        """Return the speed of training by all processes, measured on three batches: pixels per s.

        A first batch is not measured, because it also compiles.
        """
        device, start_s = self.pixels.target.device, 0.0
        count = min(max(self.largest // 8, MIN_BATCH), len(self.pixels))
        numbers = torch.arange(count, device=device).repeat(world())
        for k in range(4):
            start_s = time.monotonic() if k == 1 else start_s
            self.sums(self.pixels, numbers)[0].backward()
        return 3 * len(numbers) / max(time.monotonic() - start_s, 1e-6)

    def weights(self) -> dict[str, Tensor]:
        """Return a copy of the network's weights by name, as torch's `state_dict` does."""
        return {name: value.clone() for name, value in self.net.state_dict().items()}


def loss_value(parts: Tensor) -> float:
    """Return the loss MSE + 10 RER of a batch (Liu, Colburn and Inanici 2020).

    parts: sums of `Trainer.sums` over all processes [3]. MSE is the first divided by the third, RER
    the root of the first divided by the second.
    """
    error, target, count = parts.tolist()
    return error / count + 10.0 * math.sqrt(error / max(target, 1e-12))


# ----------------------------------------------------------------------------------------------
# the loop


@dataclass(slots=True)
class Run:
    """The length and the progress of a training, which are stored in its checkpoint.

    steps, batch_pixels: planned number of updates, and number of pixels in each; epoch, step:
    number of completed epochs and updates; rate: learning rate after the warm-up (paper); best:
    smallest validation loss so far; elapsed_s, cpu_s: time used; skipped: number of updates omitted
    because the loss was not finite.
    """

    steps: int
    batch_pixels: int
    epoch: int = 0
    step: int = 0
    rate: float = 1e-3
    best: float = math.inf
    elapsed_s: float = 0.0
    cpu_s: float = 0.0
    skipped: int = 0

    def share(self, budget_s: float | None) -> float:
        """Return the completed share (0 to 1) of the updates, or of the time if that is larger.

        budget_s: time limit of the training [s]; None for no limit.
        """
        return min(max(self.step / self.steps, self.elapsed_s / (budget_s or math.inf)), 1.0)

    def rate_now(self, budget_s: float | None) -> float:
        """Return the learning rate of the next update, which falls to 0 as a cosine of `share`.

        In the first 3 % of the updates it also rises linearly from 0. budget_s: time limit of the
        training [s]; None for no limit.
        """
        warm = min(1.0, (self.step + 1) / (0.03 * self.steps + 1))
        return self.rate * warm * 0.5 * (1.0 + math.cos(math.pi * self.share(budget_s)))


def affordable_run(trainer: Trainer, budget_s: float | None) -> Run:
    """Return a training of as many updates as the time allows, at most 90 uses of each pixel.

    budget_s: available time [s], None for no limit. The trainer's speed is measured for it. Raises
    NotEnoughDataError if it does not allow one use of each pixel: errors would depend on the
    processor's speed.
    """
    count = len(trainer.pixels)
    pixels = float(PASSES * count)  # in all updates together
    if budget_s is not None:
        speed = rank_0_value(trainer.pixels_per_s(), trainer.pixels.target.device)
        pixels = min(pixels, speed * budget_s)
    if pixels < count:
        found = "no time to train the network on every pixel of the captures once"
        raise NotEnoughDataError(f"{found}; raise --budget")
    batch = int(np.clip(pixels / STEPS, MIN_BATCH, trainer.largest))
    return Run(max(EPOCHS, int(pixels / batch)), batch)


def fit(
    data: Dataset,
    *,
    patch: Patch = "absolute",
    seed: int = 0,
    budget_s: float | None = None,
    plan: Run | None = None,
    checkpoint: Path | None = None,
    shape: Shape = Shape(),
) -> DenseFitted:
    """Train the network on `data`; return it with the weights of the smallest validation loss.

    patch: with "none" sun patches are not an input; seed: of all random numbers; budget_s: time
    limit [s], None for no limit; plan: length of the training, None for `affordable_run`.
    checkpoint: path of a file that is written after each epoch, None for none; an existing one is
    continued, with its length. shape: form of the network. Raises InputError for a checkpoint that
    cannot be used, and NotEnoughDataError for a limit too short to use each pixel once.
    """
    start_s, start_cpu_s = time.monotonic(), time.process_time()
    device = pick_device()
    if world() > 1 and not torch.distributed.is_initialized():
        torch.distributed.init_process_group("nccl" if device.type == "cuda" else "gloo")
    torch.manual_seed(seed)
    net = Net(shape).to(device)
    train, validation = validation_split(len(data), seed)
    average = np.log10(np.maximum(data.luminance_cdm2[train], 1.0)).mean(axis=0, dtype=np.float64)
    base = inputs_of(average, data.heading_deg, device)
    held_out = pixels_of(data.take(validation), base, patch, device)
    trainer = Trainer(net, pixels_of(data.take(train), base, patch, device))
    if plan is None:
        spent_s = rank_0_value(time.monotonic() - start_s, device)
        plan = affordable_run(trainer, budget_s and max(budget_s - spent_s, 0.0))
    run, best = replace(plan), trainer.weights()
    mark = codec.data_digest(data.digest(), patch, seed, shape)
    if checkpoint is not None and checkpoint.is_file():
        run, best = restore(checkpoint, trainer, mark)
    # A continued training began earlier, by the time that its checkpoint states.
    start_s, start_cpu_s = start_s - run.elapsed_s, start_cpu_s - run.cpu_s
    numbers = torch.randperm(len(held_out), generator=torch.Generator().manual_seed(seed))[:60_000]
    while run.share(budget_s) < 1.0:
        _train_epoch(trainer, run, best, budget_s, seed, start_s)
        loss = trainer.validate(held_out, numbers.to(device))
        if math.isfinite(loss) and loss < run.best:
            run.best, best = loss, trainer.weights()
        run.epoch += 1
        run.cpu_s = time.process_time() - start_cpu_s
        if checkpoint is not None and rank() == 0:
            store(checkpoint, trainer, run, best, mark)
    net.load_state_dict(best)
    about = {
        "epochs": run.epoch,
        "steps": run.step,
        "seconds": round(run.elapsed_s, 1),
        "cpu_seconds": round(run.cpu_s, 1),
        "pixels_seen_per_pixel": run.step * run.batch_pixels / len(trainer.pixels),
        "best_validation_loss": run.best,
        "skipped_updates": run.skipped,
        "seed": seed,
        "device": device.type,
        "validation_slots": [data.slots[i] for i in validation],
    }
    return DenseFitted(net, shape, average, data.heading_deg, patch, domain_of(data.light), about)


def _train_epoch(
    trainer: Trainer,
    run: Run,
    best: dict[str, Tensor],
    budget_s: float | None,
    seed: int,
    start_s: float,
) -> None:
    """Update the weights until the epoch or the time ends; `trainer` and `run` change in place.

    A loss that is not finite restores the weights `best`, of the smallest validation loss so far,
    and halves the learning rate. budget_s: time limit of the training [s], None for none; start_s:
    time.monotonic() at its start; seed: of the drawn pixels, which depend on seed and epoch only,
    so that a continued training has the same batches.
    """
    device = trainer.pixels.target.device
    generator = torch.Generator().manual_seed(seed * 1_000_003 + run.epoch)
    for _ in range(math.ceil(run.steps / EPOCHS)):
        drawn = torch.randint(len(trainer.pixels), (run.batch_pixels,), generator=generator)
        loss = trainer.step(drawn.to(device), run.rate_now(budget_s))
        run.step += 1
        run.elapsed_s = rank_0_value(time.monotonic() - start_s, device)
        share = run.share(budget_s)
        progress(int(1000 * share), 1000, f"loss {loss:.4f}  best {run.best:.4f}")
        if not math.isfinite(loss):
            run.skipped += 1
            trainer.net.load_state_dict(best)
            run.rate /= 2.0
        if share >= 1.0:
            break


def store(path: Path, trainer: Trainer, run: Run, best: dict[str, Tensor], mark: str) -> None:
    """Write the checkpoint that `restore` loads; `mark` is stored with it."""
    state = {"net": trainer.net.state_dict(), "optimiser": trainer.optimiser.state_dict()}
    with replacing(path) as file:
        torch.save(state | {"best": best, "run": asdict(run), "mark": mark}, file)


def restore(path: Path, trainer: Trainer, mark: str) -> tuple[Run, dict[str, Tensor]]:
    """Load a checkpoint into the trainer; return its run and its best weights by name.

    mark: digest of training data, patch mode, seed and shape. Raises InputError if it differs, and
    for a file that cannot be read or contains other objects than tensors, numbers and texts.
    """
    faults = (Warning, RuntimeError, LookupError, TypeError, EOFError, AttributeError)
    try:
        with warnings.catch_warnings(action="error"):  # torch warns before it rejects other files
            state = torch.load(path, map_location=pick_device(), weights_only=True)
        if state["mark"] != mark:
            raise KeyError("a checkpoint of other pictures, other irradiance or another seed")
        trainer.net.load_state_dict(state["net"])
        trainer.optimiser.load_state_dict(state["optimiser"])
        return Run(**state["run"]), state["best"]
    except (*faults, pickle.UnpicklingError) as error:
        finding = f"a checkpoint that cannot be used ({str(error).splitlines()[0][:120]})"
        remedy = "delete the file to start the training again"
        raise InputError(path, finding, "a checkpoint of this training", remedy) from None
