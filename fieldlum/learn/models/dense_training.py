"""Train the dense network: by the paper's schedule if there is time, else by a short one.

The loss of a batch is ``sum(w e^2) / b + 10 sqrt(sum(w e^2) / sum(w t^2))``. Both parts depend on
the network only through S = sum(w e^2), where b is the number of pixels, w their weight, e the
error and t the target. Therefore micro-batches (and the ranks of torchrun) add up the gradient of
S, and one factor at the end makes it the exact gradient of the batch's loss. A batch needs the
memory of one micro-batch.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from fieldlum.core.arrays import Floats
from fieldlum.core.records import Progress, quiet
from fieldlum.learn.models import Patch, distributed
from fieldlum.learn.models.data import Dataset
from fieldlum.learn.models.dense_network import Net, Shape, bfloat16_pays, canvas, pick_device
from fieldlum.learn.models.dense_pixels import PixelSampler, pixels_of
from fieldlum.learn.models.dense_schedule import (
    SHORT_EPOCHS,
    SHORT_VALIDATION_PIXELS,
    Run,
    TrainingPlan,
    affordable_plan,
    epoch_batches,
    finished,
    passes,
    short_rate,
    thousandths,
    update_paper_rate,
    validation_numbers,
    validation_split,
)
from fieldlum.learn.models.dense_state import keep, restore
from fieldlum.session.provenance import data_digest

RER_SHARE = 10.0  # weight of the relative error in the loss (paper)
_MICRO_PIXELS = {"cpu": 8192, "cuda": 131_072}  # pixels of a micro-batch; not measured
_TIMED_BATCHES = 3  # micro-batches whose time decides between the schedules; not measured
_ONE_UPDATE_S = 1e-3  # a budget that ends after one update


@dataclass(frozen=True, slots=True)
class TrainingRecord:
    """What config.json records of a training, under the key dense_training.

    schedule: "paper" or "short"; epochs, steps: number of completed epochs and batches; seconds,
    cpu_seconds: time used; pixels_seen_per_pixel: average number of uses of a training pixel;
    best_validation_loss: see `loss_value`; skipped_updates: number of updates omitted because the
    loss was not finite; seed: of all random numbers; device: "cpu" or "cuda"; bfloat16: whether
    products were computed in that precision; plan: length and learning rate; validation_slots:
    slots of the images for validation.
    """

    schedule: str
    epochs: int
    steps: int
    seconds: float
    cpu_seconds: float
    pixels_seen_per_pixel: float
    best_validation_loss: float
    skipped_updates: int
    seed: int
    device: str
    bfloat16: bool
    plan: TrainingPlan
    validation_slots: list[str]


class TrainedNet(NamedTuple):
    """A trained network.

    net: with the weights of the least validation loss; average_log10: mean of log10 L over the
    training images, at least 0 [H, W]; record: what config.json records of the training.
    """

    net: Net
    average_log10: Floats
    record: TrainingRecord


# ----------------------------------------------------------------------------------------------
# one batch


def _loss_parts(
    net: Net, pixels: PixelSampler, numbers: Tensor, micro: int, half: bool, learn: bool
) -> Tensor:
    """Return [S_error, S_target, count] summed over the batch and all ranks.

    With `learn`, also add the gradients of S_error.
    """
    parts = torch.zeros(3, dtype=torch.float64)
    for mine in numbers[distributed.rank() :: distributed.world()].split(micro):
        scene, direct, target, weight = pixels.batch(mine)
        with torch.set_grad_enabled(learn):
            with torch.autocast(scene.device.type, torch.bfloat16, enabled=half):
                error = net(scene, direct) - target
            squares = (weight * error.square()).sum()
        if learn:
            squares.backward()
        target2 = (weight * target.square()).sum()
        parts += torch.tensor([squares.item(), target2.item(), len(mine)], dtype=torch.float64)
    return distributed.total(parts.to(pixels.target.device)).cpu()


def loss_value(parts: Tensor) -> float:
    """Return the loss MSE + 10 RER of a batch; parts: [S_error, S_target, count].

    S_error, S_target: weighted sums of squared errors and of squared targets (encoded luminance)
    over `count` pixels. MSE is S_error / count; RER (relative error) is the root of S_error /
    S_target.
    """
    error, target, count = parts.tolist()
    return error / count + RER_SHARE * math.sqrt(error / max(target, 1e-12))


def _step(
    net: Net,
    optimiser: torch.optim.Optimizer,
    pixels: PixelSampler,
    numbers: Tensor,
    micro: int,
    half: bool,
) -> float:
    """Update the weights once by the exact gradient of the batch's loss; return the loss.

    If the loss is NaN, the weights did not change.
    """
    optimiser.zero_grad(set_to_none=False)
    parts = _loss_parts(net, pixels, numbers, micro, half, learn=True)
    error, target, count = parts.tolist()
    if not math.isfinite(error):
        return math.nan
    factor = 1.0 / count + 0.5 * RER_SHARE / math.sqrt(max(error * target, 1e-24))
    for parameter in net.parameters():
        if parameter.grad is not None:
            distributed.total(parameter.grad).mul_(factor)
    optimiser.step()
    return loss_value(parts)


# ----------------------------------------------------------------------------------------------
# the loop


def train(
    data: Dataset,
    shape: Shape,
    *,
    patch: Patch = "absolute",
    seed: int = 0,
    budget_s: float | None = None,
    least_passes: float = 0.0,
    plan: TrainingPlan | None = None,
    checkpoint: Path | None = None,
    stop_after_epochs: int | None = None,
    bfloat16: bool | None = None,
    progress: Progress = quiet,
) -> TrainedNet:
    """Train the network on `data`; return it with the weights of the least validation loss.

    patch: with "none" sun patches are not an input, otherwise they are one in cd/m2. plan: length
    and learning rate. None uses the paper's schedule if there is no budget_s [s] or it fits in it,
    else a short one by measured speed. least_passes: without a plan, end after one update if the
    budget does not allow this number of passes over the training pixels. checkpoint: path, written
    after each epoch; an existing one is continued, with its plan; None for none. stop_after_epochs:
    number of epochs after which this call ends early, as an interruption would. bfloat16: compute
    products in this precision; None does so where it is fast. Raises InputError for a checkpoint
    that cannot be used.
    """
    start_s, start_cpu_s = time.monotonic(), time.process_time()
    device = pick_device()
    distributed.join(device)
    half = bfloat16_pays(device) if bfloat16 is None else bfloat16
    if shape.form == "cnn":
        shape = replace(shape, patch_width=200)
    torch.manual_seed(seed)
    net = Net(shape).to(device)
    optimiser = torch.optim.Adam(net.parameters(), lr=1e-3, fused=True)
    teach, check = validation_split(len(data), seed)
    average = np.log10(np.maximum(data.luminance_cdm2[teach], 1.0)).mean(axis=0, dtype=np.float64)
    base = canvas(average, data.heading_deg)
    pixels = pixels_of(data.take(teach), base, shape, patch, device)
    exam = pixels_of(data.take(check), base, shape, patch, device)
    if plan is None:
        least = least_passes * len(pixels) + _validation_cost(len(exam)) if least_passes else 0.0
        spent_s = distributed.agreed(time.monotonic() - start_s, device)
        plan, budget_s = _make_plan(net, pixels, budget_s, half, spent_s, least)
    run, mark = Run(rate=plan.rate), data_digest(data.digest(), patch, seed)
    best = _weights(net)
    if checkpoint is not None and checkpoint.is_file():
        plan, best = restore(checkpoint, net, optimiser, run, shape, mark)
        start_s, start_cpu_s = start_s - run.elapsed_s, start_cpu_s - run.cpu_s
    exam_numbers = validation_numbers(len(exam), plan, seed).to(device)
    first_epoch = run.epoch
    while not finished(plan, run, budget_s):
        for batch in epoch_batches(pixels, plan, run, shape, seed):
            rate = short_rate(plan, run, budget_s) if plan.schedule == "short" else run.rate
            optimiser.param_groups[0]["lr"] = rate
            loss = _step(net, optimiser, pixels, batch, plan.micro_pixels, half)
            run.step += 1
            run.elapsed_s = distributed.agreed(time.monotonic() - start_s, device)
            text = f"loss {loss:.4f}  best {run.best:.4f}"
            progress(thousandths(plan, run, budget_s), 1000, text)
            if not math.isfinite(loss):
                run.skipped += 1
                net.load_state_dict(best)
                run.rate /= 2.0
            if budget_s and run.elapsed_s > budget_s:
                break
        parts = _loss_parts(net, exam, exam_numbers, 4 * plan.micro_pixels, half, learn=False)
        score = loss_value(parts)
        if improved := math.isfinite(score) and score < run.best:
            run.best, best = score, _weights(net)
        run.epoch += 1
        run.cpu_s = time.process_time() - start_cpu_s
        if plan.schedule == "paper":
            update_paper_rate(run, improved)
        if checkpoint is not None and distributed.rank() == 0:
            keep(checkpoint, net, optimiser, run, plan, shape, mark, best)
        if stop_after_epochs is not None and run.epoch - first_epoch >= stop_after_epochs:
            break
    net.load_state_dict(best)
    record = TrainingRecord(
        schedule=plan.schedule,
        epochs=run.epoch,
        steps=run.step,
        seconds=round(run.elapsed_s, 1),
        cpu_seconds=round(run.cpu_s, 1),
        pixels_seen_per_pixel=round(passes(plan, run, len(pixels)), 2),
        best_validation_loss=run.best,
        skipped_updates=run.skipped,
        seed=seed,
        device=device.type,
        bfloat16=half,
        plan=plan,
        validation_slots=[data.slots[i] for i in check],
    )
    return TrainedNet(net, average, record)


def _weights(net: Net) -> dict[str, Tensor]:
    """Return a copy of the network's weights."""
    return {name: value.clone() for name, value in net.state_dict().items()}


def _make_plan(
    net: Net,
    pixels: PixelSampler,
    budget_s: float | None,
    half: bool,
    spent_s: float,
    least_pixels: float,
) -> tuple[TrainingPlan, float | None]:
    """Return a plan and the time for it [s]; see `train`.

    spent_s: part of the budget that is used already; least_pixels: number of uses of training
    pixels below which a training must not begin, 0 to begin always. The speed with full
    micro-batches decides on the schedule. The short schedule can have smaller, slower batches:
    their speed decides whether the rest of the budget is enough.
    """
    micro = _MICRO_PIXELS[pixels.target.device.type]
    if budget_s is None:
        return TrainingPlan(micro_pixels=micro), None
    speed = _pixels_per_second(net, pixels, micro, micro, half)
    plan = affordable_plan(speed, len(pixels), budget_s, micro)
    if plan.schedule == "paper" or not least_pixels:
        return plan, budget_s
    if plan.batch_pixels < micro:
        speed = min(speed, _pixels_per_second(net, pixels, plan.batch_pixels, micro, half))
    return plan, budget_s if speed * (budget_s - spent_s) >= least_pixels else _ONE_UPDATE_S


def _validation_cost(count: int) -> float:
    """Return how many uses of a training pixel cost as much as all validations of the short plan.

    count: number of validation pixels. A validation has no gradient, which is two thirds of a use
    (a matrix product forward, two backward).
    """
    return SHORT_EPOCHS * min(count, SHORT_VALIDATION_PIXELS) / 3.0


def _pixels_per_second(net: Net, pixels: PixelSampler, batch: int, micro: int, half: bool) -> float:
    """Return the measured speed of training with batches of `batch` pixels, at most `micro`.

    As many pixels as in three micro-batches are timed; the batch before is not, because it also
    compiles.
    """
    device = pixels.target.device
    numbers = torch.arange(min(batch, len(pixels)), device=device).repeat(distributed.world())
    batches, start_s = _TIMED_BATCHES * (micro // batch), 0.0
    for k in range(1 + batches):
        start_s = time.monotonic() if k == 1 else start_s
        _loss_parts(net, pixels, numbers, micro, half, learn=True)
    seconds = max(time.monotonic() - start_s, 1e-6)
    return distributed.agreed(batches * len(numbers) / seconds, device)
