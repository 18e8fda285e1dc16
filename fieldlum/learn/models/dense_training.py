"""Train the dense network within a time budget, in one process or in those of torchrun.

The loss of a batch is ``S / b + 10 sqrt(S / T)``, with S = sum(w e^2) and T = sum(w t^2) over its b
pixels, their weights w, errors e and targets t. It depends on the network only through S, so that
processes add up S, T and b before, and the gradients after the backward pass.
"""

from __future__ import annotations

import math
import os
import pickle
import time
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch import distributed as dist

from fieldlum.core.arrays import Floats32
from fieldlum.core.errors import InputError, NotEnoughDataError
from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models import Patch
from fieldlum.learn.models.baselines import captured
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.dense import (
    DenseFitted,
    Inputs,
    Net,
    Shape,
    bfloat16_pays,
    encode,
    from_state,
    inputs_of,
    pick_device,
)
from fieldlum.session import replacing
from fieldlum.session.provenance import data_digest

__all__ = ["fit", "from_state"]  # what `model_registry` promises of a model's module

RATE, RER_SHARE = 1e-3, 10.0  # highest learning rate, weight of the relative error (paper)
PASSES = 90  # largest number of uses of a training pixel, on average (paper)
EPOCHS = 25  # number of validations and checkpoints
# Updates to reach before batches become larger than the smallest; pixels of a batch
STEPS, MIN_BATCH, MAX_BATCH = 3000, 512, {"cpu": 8192, "cuda": 131_072}


@dataclass(frozen=True, slots=True)
class TrainingPlan:
    """The length of a training: `steps` updates with `batch_pixels` pixels each."""

    steps: int
    batch_pixels: int


@dataclass(slots=True)
class Run:
    """The progress of a training, which is stored in its checkpoint.

    epoch, step: number of completed epochs and updates; rate: learning rate after the warm-up;
    best: least validation loss so far; elapsed_s, cpu_s: time used; skipped: number of updates
    omitted because the loss was not finite.
    """

    epoch: int = 0
    step: int = 0
    rate: float = RATE
    best: float = math.inf
    elapsed_s: float = 0.0
    cpu_s: float = 0.0
    skipped: int = 0

    def share(self, plan: TrainingPlan, budget_s: float | None) -> float:
        """Return the completed share of the updates, or of the time if that is larger."""
        return min(max(self.step / plan.steps, self.elapsed_s / (budget_s or math.inf)), 1.0)


def rate_of(plan: TrainingPlan, run: Run, budget_s: float | None) -> float:
    """Return the learning rate of the next update: a warm-up of 3 %, then a cosine to 0."""
    warm = min(1.0, (run.step + 1) / (0.03 * plan.steps + 1))
    return run.rate * warm * 0.5 * (1.0 + math.cos(math.pi * run.share(plan, budget_s)))


# ----------------------------------------------------------------------------------------------
# processes of torchrun; without it there is one


def rank() -> int:
    """Return the number of this process among torchrun's processes, from 0; 0 without torchrun."""
    return int(os.environ.get("RANK", "0"))


def world() -> int:
    """Return the number of processes that torchrun started; 1 without torchrun."""
    return int(os.environ.get("WORLD_SIZE", "1"))


def total(tensor: Tensor) -> Tensor:
    """Return `tensor` after each value in it was replaced by its sum over all processes."""
    if world() > 1:
        dist.all_reduce(tensor)
    return tensor


def agreed(value: float, device: torch.device) -> float:
    """Return in every process the value of the process with rank 0, so that all end together."""
    shared = torch.tensor([value if rank() == 0 else 0.0], dtype=torch.float64, device=device)
    return float(total(shared).item())


# ----------------------------------------------------------------------------------------------
# pixels


@dataclass(frozen=True, slots=True)
class PixelSampler:
    """All pairs of one of n hours and one of P seen pixels, as tensors on one device.

    The index of a pair is hour times P plus the pixel's index in `seen`. inputs: of all pixels in
    the n hours; target: encoded luminance of the map [n, P]; patch: that of the sun patch [n, P], 0
    without patches; weight: in the loss: solid angle over the mean, times the value's weight in
    training [n, P]; seen: flat index of the pixel in the map [P]. The length is n times P.
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
        hour, place = numbers // len(self.seen), numbers % len(self.seen)
        scene, direct = self.inputs.scene(hour, self.seen[place]), self.patch[hour, place]
        return scene, direct.unsqueeze(1), self.target[hour, place], self.weight[hour, place]


def pixels_of(data: Dataset, pixels: Inputs, patch: Patch, device: torch.device) -> PixelSampler:
    """Return all pairs of an hour of `data` and a seen pixel, encoded, on the device.

    pixels: result of `inputs_of`; patch: with "none" sun patches are left out.
    """

    def flat(maps: Floats32) -> Tensor:
        return torch.from_numpy(np.stack([encode(m[data.seen]) for m in maps])).to(device)

    target = flat(data.luminance_cdm2)
    patches = None if patch == "none" else data.patch_cdm2
    weight = np.broadcast_to(data.weights[data.seen], target.shape)
    weight = weight if data.counts is None else weight * data.counts[:, data.seen]
    return PixelSampler(
        pixels.at(data.light),
        target,
        torch.zeros_like(target) if patches is None else flat(patches),
        torch.from_numpy(weight.astype(np.float32)).to(device),
        torch.from_numpy(np.flatnonzero(data.seen)).to(device),
    )


def validation_split(n: int, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
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

    half: whether products are computed in bfloat16.
    """

    def __init__(self, net: Net, pixels: PixelSampler, half: bool) -> None:
        self.net, self.pixels, self.half = net, pixels, half
        self.largest = MAX_BATCH[pixels.target.device.type]
        self.optimiser = torch.optim.Adam(net.parameters(), lr=RATE, fused=True)

    def sums(self, pixels: PixelSampler, numbers: Tensor) -> Tensor:
        """Return [S, T, count] of this process's part of a batch."""
        scene, direct, target, weight = pixels.batch(numbers[rank() :: world()])
        with torch.autocast(scene.device.type, torch.bfloat16, enabled=self.half):
            error = self.net(scene, direct) - target
        count = torch.tensor(float(len(target)), device=target.device)
        return torch.stack([(weight * v.square()).sum() for v in (error, target)] + [count])

    def step(self, numbers: Tensor, rate: float) -> float:
        """Update the weights once by the exact gradient of the batch's loss; return the loss.

        rate: learning rate. If the loss is NaN, the weights did not change.
        """
        self.optimiser.param_groups[0]["lr"] = rate
        self.optimiser.zero_grad()
        own = self.sums(self.pixels, numbers)
        parts = total(own.detach().double())
        error, target, count = parts.tolist()
        if not math.isfinite(error):
            return math.nan
        factor = 1.0 / count + 0.5 * RER_SHARE / math.sqrt(max(error * target, 1e-24))
        (factor * own[0]).backward()
        for parameter in self.net.parameters():
            if parameter.grad is not None:
                total(parameter.grad)
        self.optimiser.step()
        return loss_value(parts)

    def validate(self, pixels: PixelSampler, numbers: Tensor) -> float:
        """Return the loss of other pixels."""
        with torch.no_grad():
            parts = [self.sums(pixels, some).double() for some in numbers.split(self.largest)]
        return loss_value(total(torch.stack(parts).sum(dim=0)))

    def pixels_per_s(self) -> float:
        """Return the measured speed of training; the first of four batches also compiles."""
        device, start_s = self.pixels.target.device, 0.0
        count = min(self.largest, len(self.pixels))
        numbers = torch.arange(count, device=device).repeat(world())
        for k in range(4):
            start_s = time.monotonic() if k == 1 else start_s
            self.sums(self.pixels, numbers)[0].backward()
        return 3 * len(numbers) / max(time.monotonic() - start_s, 1e-6)

    def weights(self) -> dict[str, Tensor]:
        """Return a copy of the network's weights."""
        return {name: value.clone() for name, value in self.net.state_dict().items()}


def loss_value(parts: Tensor) -> float:
    """Return the loss MSE + 10 RER of a batch; parts: [S, T, count], see the module."""
    error, target, count = parts.tolist()
    return error / count + RER_SHARE * math.sqrt(error / max(target, 1e-12))


# ----------------------------------------------------------------------------------------------
# the loop


def affordable_plan(trainer: Trainer, budget_s: float | None) -> TrainingPlan:
    """Return as many updates as the time allows, and at most 90 passes over the training pixels.

    budget_s: available time, None for no limit. Raises NotEnoughDataError if it does not allow one
    pass: errors would depend on the processor's speed.
    """
    count = len(trainer.pixels)
    pixels = float(PASSES * count)
    if budget_s is not None:
        speed = agreed(trainer.pixels_per_s(), trainer.pixels.target.device)
        pixels = min(pixels, speed * budget_s)
    if pixels < count:
        raise NotEnoughDataError(
            "no time to train the network on every pixel of the captures once; raise --budget"
        )
    batch = int(np.clip(pixels / STEPS, MIN_BATCH, trainer.largest))
    return TrainingPlan(max(EPOCHS, int(pixels / batch)), batch)


def fit(
    data: Dataset,
    *,
    patch: Patch = "absolute",
    seed: int = 0,
    budget_s: float | None = None,
    plan: TrainingPlan | None = None,
    checkpoint: Path | None = None,
    stop_after_epochs: int | None = None,
    bfloat16: bool | None = None,
    progress: Progress = quiet,
    **form: Any,
) -> DenseFitted:
    """Train the network on `data`; return it with the weights of the least validation loss.

    patch: with "none" sun patches are not an input; seed: of all random numbers; budget_s: time
    limit [s]; plan: length, None for `affordable_plan`. checkpoint: path, written
    after each epoch; an existing one is continued, with its plan; None for none.
    stop_after_epochs: number of epochs after which this call ends early, as an interruption would.
    bfloat16: compute products in this precision; None does so where it is fast. form: fields of
    `Shape`. Raises InputError for a checkpoint that cannot be used, and as `affordable_plan`.
    """
    start_s, start_cpu_s = time.monotonic(), time.process_time()
    device = pick_device()
    if world() > 1 and not dist.is_initialized():
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
    shape = Shape(**form)
    torch.manual_seed(seed)
    net = Net(shape).to(device)
    teach, check = validation_split(len(data), seed)
    average = np.log10(np.maximum(data.luminance_cdm2[teach], 1.0)).mean(axis=0, dtype=np.float64)
    base = inputs_of(average, data.heading_deg, device)
    exam = pixels_of(data.take(check), base, patch, device)
    half = bfloat16_pays(device) if bfloat16 is None else bfloat16
    pixels = pixels_of(data.take(teach), base, patch, device)
    trainer = Trainer(net, pixels, half)
    if plan is None:
        spent_s = agreed(time.monotonic() - start_s, device)
        left_s = None if budget_s is None else max(budget_s - spent_s, 0.0)
        plan = affordable_plan(trainer, left_s)
    run, mark = Run(), data_digest(data.digest(), patch, seed)
    best = trainer.weights()
    if checkpoint is not None and checkpoint.is_file():
        plan, best = _restore(checkpoint, trainer, run, shape, mark)
        start_s, start_cpu_s = start_s - run.elapsed_s, start_cpu_s - run.cpu_s
    chance = torch.Generator().manual_seed(seed)
    numbers = torch.randperm(len(exam), generator=chance)[:60_000].to(device)
    last = math.inf if stop_after_epochs is None else run.epoch + stop_after_epochs
    while run.share(plan, budget_s) < 1.0 and run.epoch < last:
        # the random order depends only on the epoch: a resumed training has the same batches
        chance = torch.Generator().manual_seed(seed * 1_000_003 + run.epoch)
        for _ in range(-(-plan.steps // EPOCHS)):
            drawn = torch.randint(len(pixels), (plan.batch_pixels,), generator=chance)
            loss = trainer.step(drawn.to(device), rate_of(plan, run, budget_s))
            run.step += 1
            run.elapsed_s = agreed(time.monotonic() - start_s, device)
            share = run.share(plan, budget_s)
            progress(int(1000 * share), 1000, f"loss {loss:.4f}  best {run.best:.4f}")
            if not math.isfinite(loss):
                run.skipped += 1
                net.load_state_dict(best)
                run.rate /= 2.0
            if share >= 1.0:
                break
        score = trainer.validate(exam, numbers)
        if math.isfinite(score) and score < run.best:
            run.best, best = score, trainer.weights()
        run.epoch += 1
        run.cpu_s = time.process_time() - start_cpu_s
        if checkpoint is not None and rank() == 0:
            _store(checkpoint, trainer, run, plan, shape, mark, best)
    net.load_state_dict(best)
    about = {
        "epochs": run.epoch,
        "steps": run.step,
        "seconds": round(run.elapsed_s, 1),
        "cpu_seconds": round(run.cpu_s, 1),
        "pixels_seen_per_pixel": round(run.step * plan.batch_pixels / len(pixels), 2),
        "best_validation_loss": run.best,
        "skipped_updates": run.skipped,
        "seed": seed,
        "device": device.type,
        "bfloat16": half,
        "plan": asdict(plan),
        "validation_slots": [data.slots[i] for i in check],
    }
    domain, heading_deg = captured(data.light), data.heading_deg
    return DenseFitted(net, shape, average, heading_deg, patch, domain, about)


# ----------------------------------------------------------------------------------------------
# checkpoints


def _store(
    path: Path,
    trainer: Trainer,
    run: Run,
    plan: TrainingPlan,
    shape: Shape,
    mark: str,
    best: dict[str, Tensor],
) -> None:
    """Write a checkpoint atomically; best: weights with the least validation loss.

    mark: digest of training data, patch mode and seed, which `_restore` compares.
    """
    state = {"net": trainer.net.state_dict(), "best": best, "data": mark}
    state["optimiser"] = trainer.optimiser.state_dict()
    state |= {"run": asdict(run), "plan": asdict(plan), "shape": asdict(shape)}
    with replacing(path) as file:
        torch.save(state, file)


def _restore(
    path: Path, trainer: Trainer, run: Run, shape: Shape, mark: str
) -> tuple[TrainingPlan, dict[str, Tensor]]:
    """Load a checkpoint into trainer and run; return its plan and its best weights.

    Raises InputError if its shape or mark differ, and for a checkpoint that cannot be read or
    contains other objects than tensors, numbers and texts.
    """
    faults = (Warning, RuntimeError, LookupError, TypeError, EOFError, AttributeError)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # torch warns before it rejects files of other programs
            state = torch.load(path, map_location=pick_device(), weights_only=True)
        if state["shape"] != asdict(shape):
            raise KeyError("the checkpoint of another network")
        if state["data"] != mark:
            raise KeyError("a checkpoint of other pictures, other irradiance or another seed")
        trainer.net.load_state_dict(state["net"])
        trainer.optimiser.load_state_dict(state["optimiser"])
        for name, value in state["run"].items():
            setattr(run, name, value)
        return TrainingPlan(**state["plan"]), state["best"]
    except (*faults, pickle.UnpicklingError) as error:
        raise InputError(
            path,
            f"a checkpoint that cannot be used ({str(error).splitlines()[0][:120]})",
            "a checkpoint of this training",
            "delete the file to start the training again",
        ) from None
