"""Schedules of the dense network's training: the paper's, and a short one that fits a budget.

The paper's has three stages of batches; its rate falls when the validation error does not. The
short one has as many steps as the time allows, with a rate that falls to zero.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fieldlum.models.dense_network import Shape
from fieldlum.models.dense_pixels import PixelSampler

STAGES = (6, 3, 1)  # batch in images' worth of pixels (paper)
STAGE_EPOCHS = 30  # paper
PATIENCE_EPOCHS = 2  # paper
LEAST_RATE = 1e-10  # below it the next stage begins; not measured
VALIDATION_SHARE = 0.1  # of the images; not measured
SHORT_EPOCHS = 25  # validations of the short schedule; not measured
SHORT_VALIDATION_PIXELS = 60_000  # not measured
SHORT_STEPS = 3000  # target of a short schedule before its batches grow; not measured
SHORT_BATCH = (512, 8192)  # smallest and largest batch of the short schedule [px]; not measured
_WARM_SHARE = 0.03  # of the short schedule, in which the rate rises; not measured


@dataclass(frozen=True, slots=True)
class TrainingPlan:
    """Schedule of a training.

    paper: epochs over all pixels, at most `epochs`. short: `steps` of `batch_pixels`, with a rate
    that falls to 0.
    """

    schedule: Literal["paper", "short"] = "paper"
    epochs: int = STAGE_EPOCHS * len(STAGES)
    steps: int = 0
    batch_pixels: int = 0
    rate: float = 1e-3
    micro_pixels: int = 8192


@dataclass(slots=True)
class Run:
    """Everything in a checkpoint besides the tensors."""

    epoch: int = 0
    step: int = 0
    stage: int = 0
    stage_epoch: int = 0
    stale: int = 0
    rate: float = 1e-3
    best: float = math.inf
    elapsed_s: float = 0.0
    cpu_s: float = 0.0
    skipped: int = 0


def affordable_plan(
    pixels_per_s: float, count: int, budget_s: float, micro_pixels: int
) -> TrainingPlan:
    """Return the paper's schedule if it fits in the budget, else a short one.

    count: training pixels of all hours. The short one has as many steps as the measured speed
    allows.
    """
    affordable = pixels_per_s * budget_s
    if affordable >= TrainingPlan().epochs * count:
        return TrainingPlan(micro_pixels=micro_pixels)
    batch = int(np.clip(affordable / SHORT_STEPS, *SHORT_BATCH))
    steps = max(SHORT_EPOCHS, int(affordable / batch))
    return TrainingPlan("short", steps=steps, batch_pixels=batch, micro_pixels=micro_pixels)


# ----------------------------------------------------------------------------------------------
# pixels of a batch


def validation_split(n: int, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return row numbers of n images for training [k] and for validation [n - k].

    A tenth of the images validates, at least one; a single image validates itself.
    """
    order = np.random.default_rng(seed).permutation(n)
    cut = max(1, round(VALIDATION_SHARE * n))
    return (np.sort(order[cut:]), np.sort(order[:cut])) if n > 1 else (order, order)


def validation_numbers(total: int, plan: TrainingPlan, seed: int) -> Tensor:
    """Return all validation pixels [b]; in the short schedule a fixed random part of them."""
    if plan.schedule == "paper" or total <= SHORT_VALIDATION_PIXELS:
        return torch.arange(total)
    order = torch.randperm(total, generator=torch.Generator().manual_seed(seed))
    return order[:SHORT_VALIDATION_PIXELS]


def epoch_batches(
    pixels: PixelSampler, plan: TrainingPlan, run: Run, shape: Shape, seed: int
) -> Iterator[Tensor]:
    """Yield the numbers of each batch's pairs [b], for one epoch.

    They depend on (seed, epoch) alone, so that a resumed training repeats nothing. The form "cnn"
    takes complete images.
    """
    generator = torch.Generator().manual_seed(seed * 1_000_003 + run.epoch)
    images, per_image = pixels.target.shape
    device, complete = pixels.target.device, shape.form == "cnn"
    if plan.schedule == "short":
        total, size = len(pixels), plan.batch_pixels
        if complete:
            total, size = images, max(1, round(size / per_image))
        draws = range(-(-plan.steps // SHORT_EPOCHS))
        groups = (torch.randint(total, (size,), generator=generator) for _ in draws)
    else:
        total, size = len(pixels), STAGES[run.stage] * per_image
        if complete:
            total, size = images, STAGES[run.stage]
        groups = torch.randperm(total, generator=generator).split(size)
    for group in groups:
        yield (_all_pixels(group, per_image) if complete else group).to(device)


def _all_pixels(group: Tensor, per_image: int) -> Tensor:
    """Return the numbers of all pixels of a group of images."""
    return (group[:, None] * per_image + torch.arange(per_image)).reshape(-1)


# ----------------------------------------------------------------------------------------------
# rate and end


def short_rate(plan: TrainingPlan, run: Run, budget_s: float | None) -> float:
    """Return the rate: a short warm-up, then a cosine to zero over the steps or the time.

    The time counts if it ends first.
    """
    warm = min(1.0, (run.step + 1) / (_WARM_SHARE * plan.steps + 1))
    done = min(_done_share(plan, run, budget_s), 1.0)
    return run.rate * warm * 0.5 * (1.0 + math.cos(math.pi * done))


def update_paper_rate(run: Run, improved: bool) -> None:
    """Halve the rate after two epochs without gain.

    Take the next stage's batch after 30 epochs, or when the rate is below `LEAST_RATE`.
    """
    run.stale = 0 if improved else run.stale + 1
    run.stage_epoch += 1
    if run.stale >= PATIENCE_EPOCHS:
        run.rate, run.stale = run.rate / 2.0, 0
    if run.stage_epoch >= STAGE_EPOCHS or run.rate < LEAST_RATE:
        run.stage, run.stage_epoch, run.stale = run.stage + 1, 0, 0
        run.rate = max(run.rate, LEAST_RATE)


def passes(plan: TrainingPlan, run: Run, count: int) -> float:
    """Return how often each of `count` training pixels was used on average."""
    return run.step * plan.batch_pixels / count if plan.schedule == "short" else float(run.epoch)


def finished(plan: TrainingPlan, run: Run, budget_s: float | None) -> bool:
    """Return whether the budget, the steps, or the epochs and stages are used up."""
    if budget_s and run.elapsed_s >= budget_s:
        return True
    if plan.schedule == "short":
        return run.step >= plan.steps
    return run.epoch >= plan.epochs or run.stage >= len(STAGES)


def thousandths(plan: TrainingPlan, run: Run, budget_s: float | None) -> int:
    """Return how much of the training is done, 0 to 1000."""
    return min(1000, int(1000 * _done_share(plan, run, budget_s)))


def _done_share(plan: TrainingPlan, run: Run, budget_s: float | None) -> float:
    """Return the share of steps or epochs, or of the time if that ends first; it can exceed 1."""
    short = plan.schedule == "short"
    done = run.step / max(plan.steps, 1) if short else run.epoch / max(plan.epochs, 1)
    return max(done, run.elapsed_s / budget_s) if budget_s else done
